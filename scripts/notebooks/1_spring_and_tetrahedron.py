# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 1 · Spring and tetrahedron
#
# Tutorial on direct collocation, part 1 of 4. Next part: [2 · Cylinder](2_cylinder.ipynb)
#
# The tutorial explains how the stiffness and the damping of a soft body are estimated from its
# recorded motion. Part 1 derives the method for a spring and for one tetrahedron, with CasADi and
# without the toolbox. Part 2 applies the toolbox to a foam cylinder. Part 3 examines the
# uncertainty of the estimates.
#
# **You will learn** how
#
# - to write parameter estimation as a nonlinear program with the equations of motion as
#   constraints (direct collocation), and why it is sparse;
# - collocation differs from shooting and from a penalty method;
# - to compute standard errors from the null space of the constraint Jacobian;
# - the time integration scheme biases the estimates;
# - the elastic force and the stiffness matrix of a finite element follow from its energy.
#
# **Prerequisites:** calculus, linear algebra, Newton's second law, NumPy.
#
# **Time:** about 45 minutes of reading; the cells run in about half a minute (measured:
# 23 to 37 s on two cores that other programs used too).

# %%
# %matplotlib inline
from itertools import pairwise
from time import perf_counter

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import null_space
from scipy.optimize import minimize, root
from scipy.spatial.transform import Rotation

import collocation_sysid as cs

BLUE = "#0072B2"
VERMILION = "#D55E00"
GREEN = "#009E73"
plt.rcParams.update(
    {
        "figure.dpi": 110,
        "figure.constrained_layout.use": True,
        "font.size": 8,
        "axes.titlelocation": "left",
        "axes.titlesize": 8,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "grid.color": "#E4E4E4",
        "lines.linewidth": 1.1,
        "lines.markersize": 4,
    }
)


def ipopt_options(max_iterations=3000):
    """Return options of `casadi.nlpsol` with which IPOPT prints nothing."""
    ipopt = {"print_level": 0, "sb": "yes", "max_iter": max_iterations}
    return {"ipopt": ipopt, "print_time": False}


# %% [markdown]
# ## 1.1 A spring
#
# A mass $m$ is attached to a spring. The mass is displaced by 50 mm and released at rest, and its
# position is measured for one second at 100 Hz. The mass $m$ is known; the stiffness $k$ and the
# damping coefficient $c$ are to be estimated.
#
# ### Elastic energy and force
#
# The elastic force is the negative gradient of an energy $\Psi(x)$:
# $f_e = -\partial\Psi/\partial x$. CasADi computes the derivative by automatic differentiation.

# %%
x, v, k, c = (ca.SX.sym(name) for name in "xvkc")
spring_energy = k * x**2 / 2
force = -ca.gradient(spring_energy, x) - c * v
print(force)

# %% [markdown]
# For a spring the gradient is trivial. In section 1.4 the same line of code computes the force of
# a tetrahedron.
#
# The equation of motion $m\ddot x = f(x, \dot x)$ of a linear spring has a closed-form solution.
# The synthetic measurements are this solution with normally distributed noise of 1 mm.

# %%
MASS = 0.1  # kg
STIFFNESS = 40.0  # N/m, the true value
DAMPING = 0.08  # N s/m, the true value
PULL = 0.05  # m, initial displacement
SIGMA = 0.001  # m, standard deviation of the noise
DT = 0.01  # s, sampling interval


def exact_position(t, stiffness=STIFFNESS, damping=DAMPING):
    """Return the exact positions of the released mass [m] at the times t [s]."""
    decay = damping / (2 * MASS)
    damped = np.sqrt(stiffness / MASS - decay**2)
    return PULL * np.exp(-decay * t) * (np.cos(damped * t) + decay / damped * np.sin(damped * t))


t = np.arange(101) * DT
y = exact_position(t) + SIGMA * np.random.default_rng(0).normal(size=len(t))

omega = np.sqrt(STIFFNESS / MASS)
zeta = DAMPING / (2 * np.sqrt(STIFFNESS * MASS))
print(f"ω = {omega:.3g} rad/s, that is {omega / (2 * np.pi):.2f} Hz; damping ratio ζ = {zeta:.3g}")

# %% [markdown]
# ### Midpoint rule
#
# The positions $x_0, x_1, \dots$ on a time grid, here the sampling times, are unknowns. The
# **midpoint rule** evaluates the force once in each interval,
#
# $$F_t = f\Big(\tfrac{x_t + x_{t-1}}2,\ \tfrac{x_t - x_{t-1}}{\Delta t}\Big),$$
#
# and requires at each time that mass times acceleration equals the mean of the forces in the two
# adjacent intervals:
#
# $$c_t = \tfrac12 (F_t + F_{t-1}) - m\,\frac{x_t - 2x_{t-1} + x_{t-2}}{\Delta t^2} = 0.$$
#
# The first step starts at rest: $c_1 = \tfrac12 F_1 - m\,(x_1 - x_0)/\Delta t^2 = 0$.
#
# ### Direct collocation
#
# A simulation would compute the positions step by step for given $k$ and $c$. **Direct
# collocation** treats all positions and the parameters as unknowns of one nonlinear program,
#
# $$\min_{k,\,c,\,x_0 \dots x_T} \sum_t \Big(\frac{x_t - y_t}{\sigma}\Big)^2
# \quad\text{subject to}\quad c_t(x_t, x_{t-1}, x_{t-2};\, k, c) = 0.$$
#
# The function below builds this program. Positions are expressed in units of the initial
# displacement (50 mm), because solvers converge best if the unknowns are of order one.
#
# Textbooks on trajectory optimisation usually present direct collocation with the **trapezoidal
# rule**, with positions and velocities as unknowns, $m(v_t - v_{t-1}) = \tfrac{\Delta t}2(f_t +
# f_{t-1})$ and $x_t - x_{t-1} = \tfrac{\Delta t}2(v_t + v_{t-1})$, or with **Hermite–Simpson**, a
# cubic polynomial in each interval with the equations of motion also at its midpoint (fourth
# order, twice the number of unknowns). If the velocities are eliminated from the trapezoidal rule
# and the force is linear in $x$ and $v$, the equations $c_t$ above result. For nonlinear forces,
# the midpoint rule uses the force at the mean state instead of the mean of the forces. The
# midpoint rule has no velocities as unknowns and adds no numerical damping.

# %%
spring_force = ca.Function("f", [x, v, k, c], [force])


def spring_program(steps, dt):
    """Return the nonlinear program of the spring, discretised by the midpoint rule."""
    theta = ca.SX.sym("theta", 2)
    Z = ca.SX.sym("z", steps)
    Y = ca.SX.sym("y", steps)
    X = PULL * Z
    F = spring_force((X[1:] + X[:-1]) / 2, (X[1:] - X[:-1]) / dt, theta[0], theta[1])
    first = F[0] / 2 - MASS * (X[1] - X[0]) / dt**2
    others = (F[1:] + F[:-1]) / 2 - MASS * (X[2:] - 2 * X[1:-1] + X[:-2]) / dt**2
    loss = ca.sumsqr((X - Y) / SIGMA)
    return {"x": ca.vertcat(theta, Z), "p": Y, "f": loss, "g": ca.vertcat(first, others)}


program = spring_program(len(t), DT)
solver = ca.nlpsol("spring", "ipopt", program, ipopt_options())

# %% [markdown]
# The initial guess of the parameters is poor: a quarter of the true stiffness and twelve times
# the true damping. The initial guess of the positions is the measured positions themselves. This
# possibility is an advantage of collocation: because the trajectory is an unknown, measurements
# of the trajectory can serve as its initial guess.


# %%
def identify(solver, y, guess=(10.0, 1.0)):
    """Return the parameters (k, c), the trajectory [m] and the number of iterations."""
    lower = np.concatenate([[0, 0], np.full(len(y), -np.inf)])
    result = solver(x0=np.concatenate([guess, y / PULL]), p=y, lbx=lower, lbg=0, ubg=0)
    assert solver.stats()["success"], solver.stats()["return_status"]
    z = result["x"].full().ravel()
    return z[:2], PULL * z[2:], solver.stats()["iter_count"]


(k_estimate, c_estimate), trajectory, iterations = identify(solver, y)
print(f"k = {k_estimate:.2f} N/m (true value {STIFFNESS:g})")
print(f"c = {c_estimate:.4f} N s/m (true value {DAMPING:g})")
print(f"{iterations} iterations from the guess k = 10, c = 1")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(7.1, 2.4))
left.plot(t, 1e3 * y, "k.", label="measured, 1 mm noise")
left.plot(t, 1e3 * trajectory, color=BLUE, label="fitted")
left.set(title="Fitted trajectory", xlabel="time [s]", ylabel="position [mm]", ylim=(-50, 75))
left.legend()
right.plot(t, 1e3 * (trajectory - y), "k.", label="fitted − measured")
right.plot(t, 1e3 * (trajectory - exact_position(t)), color=VERMILION, label="fitted − true")
right.set(title="Residuals and error", xlabel="time [s]", ylabel="difference [mm]", ylim=(-3, 4))
right.legend()
plt.show()

# %% [markdown]
# The error of the fitted trajectory is much smaller than the noise of a single measurement,
# because 101 samples determine only three numbers: two parameters and the initial position.
#
# ### Shooting methods and local minima
#
# A *shooting* method simulates the motion with trial parameters and minimises the difference
# between simulation and measurements. As a function of $k$ (with the true $c$), the loss of
# shooting has local minima: at a wrong frequency the simulated and the measured oscillation lose
# their phase relation. If a descent method starts outside the basin of the global minimum, it
# converges to a local minimum.

# %%
trials = np.geomspace(4, 400, 600)
shooting_loss = np.array([np.mean((exact_position(t, k) - y) ** 2) / SIGMA**2 for k in trials])
is_minimum = (shooting_loss[1:-1] < shooting_loss[:-2]) & (shooting_loss[1:-1] < shooting_loss[2:])
minima = np.flatnonzero(is_minimum) + 1
guesses = np.array([4.0, 8.0, 15.0, 30.0, 60.0, 120.0, 250.0, 400.0])
estimates = np.array([identify(solver, y, (guess, 1.0))[0][0] for guess in guesses])
print(f"local minima of the shooting loss: {len(minima)}")
print(f"estimates by collocation from eight guesses: {np.unique(estimates.round(2))}")
assert len(minima) > 1
assert np.ptp(estimates) < 1e-3

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(7.1, 2.4))
left.loglog(trials, shooting_loss, color=BLUE)
left.plot(trials[minima], shooting_loss[minima], "o", color=VERMILION, label="local minima")
left.axvline(STIFFNESS, color="black", lw=0.6)
left.set(title="Loss of shooting", xlabel="k [N/m]", ylabel="mean squared error / σ²")
left.legend()
right.loglog(guesses, estimates, "o-", color=BLUE)
right.axhline(STIFFNESS, color="black", lw=0.6)
right.set(title="Estimate by collocation", xlabel="guess of k [N/m]", ylabel="k [N/m]")
right.set_ylim(4, 400)
plt.show()

# %% [markdown]
# Collocation has the same global minimum, but its iterates need not satisfy the equations of
# motion. If collocation starts at the measured trajectory, its first steps approximately solve a
# regression of accelerations on positions and velocities. This regression is linear in $k$ and
# $c$.
#
# Collocation does not have this advantage in every problem, because the local minima of shooting
# occur only for an oscillation over many periods. For soft bodies that swing once or twice, as in
# part 2, shooting with Gauss–Newton steps converged from 40 of 40 guesses that were wrong by up
# to a factor of ten, as many as with collocation (`docs/studies.md`).
#
# ### Sparsity
#
# The program has many unknowns, but each equation depends on few of them: $c_t$ depends on $x_t$,
# $x_{t-1}$, $x_{t-2}$ and the parameters. The constraint Jacobian is a narrow band next to two
# dense columns, so that the cost of its factorisation is proportional to the number of time steps.

# %%
small = spring_program(16, DT)
jacobian_sparsity = ca.jacobian(small["g"], small["x"]).sparsity()
lagrangian = small["f"] + ca.dot(ca.SX.sym("w", 15), small["g"])
hessian_sparsity = ca.hessian(lagrangian, small["x"])[0].sparsity()

figure, (left, right) = plt.subplots(1, 2, figsize=(7.1, 3.1))
left.spy(ca.DM(jacobian_sparsity, 1).full(), markersize=4, color=BLUE)
left.set(title="Jacobian of the constraints", ylabel="equations of motion")
right.spy(ca.DM(hessian_sparsity, 1).full(), markersize=4, color=BLUE)
right.set(title="Hessian of the Lagrangian", ylabel="k, c | positions")
right.axhline(1.5, color=VERMILION, lw=0.8)
for axes in (left, right):
    axes.axvline(1.5, color=VERMILION, lw=0.8)
    axes.xaxis.set_ticks_position("bottom")
    axes.set_xlabel("k, c | positions")
    axes.grid(False)
plt.show()

# %% [markdown]
# ### Standard errors
#
# The derivatives at the solution also give the covariance of the estimates. To first order, the
# unknowns can change only along directions $N$ that preserve the equations of motion: the null
# space of the constraint Jacobian. For the spring, this null space has three dimensions, because
# $k$, $c$ and $x_0$ determine the trajectory. Restricted to these directions, the loss is that of
# linear least squares, hence
#
# $$\operatorname{cov}(z) = N\,\big(N^T H^T H N / \sigma^2\big)^{-1} N^T,$$
#
# where $H$ selects the measured positions from the unknowns $z$.

# %%
constraint_jacobian = ca.Function(
    "J", [program["x"], program["p"]], [ca.jacobian(program["g"], program["x"])]
)


def null_space_at(theta, trajectory):
    """Return a basis (2 + steps, 3) of the changes that preserve the equations of motion."""
    z = np.concatenate([theta, trajectory / PULL])
    return null_space(constraint_jacobian(z, trajectory).full())


def covariance_at(theta, trajectory):
    """Return the covariance (2, 2) of k and c."""
    N = null_space_at(theta, trajectory)
    weighted = PULL * N[2:] / SIGMA
    return N[:2] @ np.linalg.inv(weighted.T @ weighted) @ N[:2].T


predicted = covariance_at((k_estimate, c_estimate), trajectory)
std_errors = np.sqrt(np.diag(predicted))
k_error, c_error = std_errors
print(f"k = {k_estimate:.2f} ± {k_error:.2f} N/m, c = {c_estimate:.4f} ± {c_error:.4f} N s/m")
assert abs(c_estimate - DAMPING) < 4 * c_error

# %% [markdown]
# A Monte Carlo simulation checks the prediction: 200 recordings of the same motion, each with
# independent noise.

# %%
rng = np.random.default_rng(1)
recordings = [exact_position(t) + SIGMA * rng.normal(size=len(t)) for _ in range(200)]
samples = np.array([identify(solver, recording, (30.0, 0.1))[0] for recording in recordings])
inside = np.abs(samples - samples.mean(axis=0)) < 1.96 * std_errors
print(f"standard deviation of the estimates (k, c): {samples.std(axis=0, ddof=1)}")
print(f"predicted standard errors:                  {std_errors}")
print(f"share within 1.96 predicted standard errors: {inside.mean(axis=0)}, expected 0.95")
assert np.allclose(samples.std(axis=0), std_errors, rtol=0.25)

bias = samples[:, 0].mean() / STIFFNESS - 1
step_bias = (omega * DT) ** 2 / 6
print(f"bias of k: {100 * bias:.2f} %; (ωΔt)²/6 = {100 * step_bias:.2f} %")
assert np.isclose(bias, step_bias, rtol=0.1)


# %%
def ellipse(mean, covariance, deviations=2.448):
    """Return points (100, 2) on the 95 % region of a bivariate normal distribution."""
    angle = np.linspace(0, 2 * np.pi, 100)
    circle = np.array([np.cos(angle), np.sin(angle)])
    return (np.array(mean)[:, None] + deviations * np.linalg.cholesky(covariance) @ circle).T


figure, axes = plt.subplots(figsize=(3.8, 2.8))
axes.plot(*samples.T, ".", color=BLUE, label="200 estimates")
outline = ellipse(samples.mean(axis=0), predicted)
axes.plot(*outline.T, color=VERMILION, label="predicted 95 % region")
axes.plot(STIFFNESS, DAMPING, "k+", ms=10, mew=1.5, label="true values")
axes.set(title="Estimates from 200 recordings", xlabel="k [N/m]", ylabel="c [N s/m]")
axes.set_ylim(top=axes.get_ylim()[1] + 0.006)
axes.legend()
plt.show()

# %% [markdown]
# The predicted covariance is correct, but the mean of $k$ differs from the true value by about ten
# standard errors. **The standard error describes the effect of the noise, not that of model
# errors.** Here the model error is the time discretisation: the midpoint rule lowers the
# frequency by the relative amount $(\omega\Delta t)^2/12$, and the fit compensates with a
# stiffness that is larger by twice this amount. Section 1.3 examines such errors.
#
# ## 1.2 Penalty or constraint?
#
# The paper on which this toolbox is based did not impose the equations of motion as constraints.
# Instead, it added the squared residuals of these equations to the loss,
#
# $$\min_{\theta,\,x}\ \sum_t \Big(\frac{x_t - y_t}{\sigma}\Big)^2 + \frac\rho2 \sum_t c_t^2,$$
#
# and minimised the sum by nonlinear conjugate gradients (CG). This penalty method needs neither
# constraints nor the solution of linear systems, but it needs a value of the penalty weight
# $\rho$. The next cells compare seven values of $\rho$ and two minimisers: Newton's method until
# it converges, and 1000 iterations of CG, which is a realistic number for a large mesh.

# %%
rho = ca.SX.sym("rho")
penalised = program["f"] + rho / 2 * ca.sumsqr(program["g"])
data = ca.vertcat(program["p"], rho)
newton = ca.nlpsol(
    "penalty", "ipopt", {"x": program["x"], "p": data, "f": penalised}, ipopt_options(500)
)
hessian, gradient = ca.hessian(penalised, program["x"])
penalty_at = ca.Function("values", [program["x"], data], [penalised, gradient])
hessian_at = ca.Function("H", [program["x"], data], [hessian])
violation = ca.Function("c", [program["x"], program["p"]], [ca.mmax(ca.fabs(program["g"]))])


def minimise_by_cg(rho, iterations=1000):
    """Return the unknowns after at most a number of iterations of conjugate gradients."""

    def loss_and_gradient(z):
        loss, gradient = penalty_at(z, np.append(y, rho))
        return float(loss), gradient.full().ravel()

    start = np.concatenate([[10.0, 1.0], y / PULL])
    options = {"maxiter": iterations, "gtol": 1e-6}
    return minimize(loss_and_gradient, start, jac=True, method="CG", options=options).x


def deviation(z):
    """Return the larger deviation of k and c from the constrained estimate, in standard errors."""
    return np.max(np.abs(z[:2] - (k_estimate, c_estimate)) / std_errors)


# %%
weights = np.geomspace(1e-2, 1e10, 7)
outcomes = {"minimum (Newton)": [], "CG, 1000 iterations": []}
conditions = []
z = np.concatenate([(k_estimate, c_estimate), trajectory / PULL])
for weight in weights[::-1]:
    z = newton(x0=z, p=np.append(y, weight))["x"].full().ravel()
    for outcome, minimiser in zip(outcomes.values(), (z, minimise_by_cg(weight)), strict=True):
        outcome.insert(0, (deviation(minimiser), float(violation(minimiser, y))))
    conditions.insert(0, np.linalg.cond(hessian_at(z, np.append(y, weight)).full()))

# %%
figure, (first, second, third) = plt.subplots(1, 3, figsize=(7.1, 2.7), sharex=True)
for (label, outcome), colour in zip(outcomes.items(), (BLUE, VERMILION), strict=True):
    deviations, violations = np.transpose(outcome)
    first.loglog(weights, deviations, "o-", color=colour, label=label)
    second.loglog(weights, violations, "o-", color=colour, label=label)
first.axhline(1, color="black", lw=0.6)
first.set(title="Deviation of k and c", ylabel="standard errors", ylim=(1e-6, 3e4))
second.set(title="Residual of the equations", ylabel="largest |c| [N]")
figure.legend(*first.get_legend_handles_labels(), loc="outside lower center", ncols=2)
third.loglog(weights, conditions, "o-", color=BLUE)
third.set(title="Condition of the Hessian", ylabel="condition number")
for axes in (first, second, third):
    axes.set_xlabel("ρ [1/N²]")
plt.show()

# %% [markdown]
# - **Small ρ:** the trajectory violates the equations of motion and follows the noise. The
#   parameters are biased.
# - **Large ρ:** the minimum approaches the constrained solution, but the condition number grows in
#   proportion to ρ. CG does not converge within its budget: the residuals of the equations of
#   motion are smaller, but the parameters are wrong.
# - **Intermediate ρ:** both errors are present, and the data give no criterion for the choice of
#   ρ.
#
# With constraints, no such weight is needed. Each iteration requires the solution of a linear
# system, which is inexpensive because the system is sparse. In Table I of the paper, the penalty
# method gave λ = 734 Pa and μ = 183 Pa for true values of 200 and 300 Pa.

# %%
best_deviation, best_violation = min(outcomes["CG, 1000 iterations"])
print(f"best CG result: {best_deviation:.0f} standard errors from the constrained estimate,")
print(f"largest residual {best_violation:.1f} N; largest spring force {STIFFNESS * PULL:.1f} N")
assert best_deviation > 3

# %% [markdown]
# ## 1.3 Numerical damping of the time integration scheme
#
# The paper uses the **backward Euler** scheme, with force and velocity at the end of the step:
#
# $$c_t = f\Big(x_t, \frac{x_t - x_{t-1}}{\Delta t}\Big)
# - m\,\frac{x_t - 2x_{t-1} + x_{t-2}}{\Delta t^2} = 0.$$
#
# Backward Euler has numerical damping: an oscillation of angular frequency $\omega$ decays as if
# its damping ratio were larger by about $\omega\Delta t/2$. At a step of 10 ms this numerical
# damping ratio is 0.1, five times the damping ratio of the spring, which is 0.02. A fit
# compensates the numerical damping by an estimate of $c$ that is too small.


# %%
def euler_program(steps, dt):
    """Return the nonlinear program of the spring, discretised by backward Euler."""
    theta = ca.SX.sym("theta", 2)
    Z = ca.SX.sym("z", steps)
    Y = ca.SX.sym("y", steps)
    X = PULL * Z
    F = spring_force(X[1:], (X[1:] - X[:-1]) / dt, theta[0], theta[1])
    first = F[0] - MASS * (X[1] - X[0]) / dt**2
    others = F[1:] - MASS * (X[2:] - 2 * X[1:-1] + X[:-2]) / dt**2
    loss = ca.sumsqr((X - Y) / SIGMA)
    return {"x": ca.vertcat(theta, Z), "p": Y, "f": loss, "g": ca.vertcat(first, others)}


# %% [markdown]
# The data of the next comparison contain no noise, so that all errors of the estimates are due to
# the scheme.

# %%
steps_s = np.array([0.00125, 0.0025, 0.005, 0.01, 0.02])
by_scheme = {}
for name, build in (("backward Euler", euler_program), ("midpoint", spring_program)):
    results = []
    for dt in steps_s:
        exact = exact_position(np.arange(round(1 / dt) + 1) * dt)
        scheme_solver = ca.nlpsol("s", "ipopt", build(len(exact), dt), ipopt_options())
        results.append(identify(scheme_solver, exact, (30.0, 0.1))[0])
    by_scheme[name] = np.array(results)
    print(f"{name}: c / true value = {(by_scheme[name][:, 1] / DAMPING).round(3)}")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(7.1, 2.6))
added_ratio = omega * steps_s / 2
for (name, results), colour in zip(by_scheme.items(), (VERMILION, BLUE), strict=True):
    left.semilogx(added_ratio, results[:, 1] / DAMPING, "o-", color=colour, label=name)
    right.semilogx(added_ratio, results[:, 0] / STIFFNESS, "o-", color=colour, label=name)
left.plot(added_ratio, 1 - added_ratio / zeta, "--", color=VERMILION, label="1 − (ωΔt/2) / ζ")
left.set(title="Estimate of c", ylabel="c / true value", ylim=(-0.3, 1.4))
right.set(title="Estimate of k", ylabel="k / true value")
for axes in (left, right):
    axes.axhline(1, color="black", lw=0.6)
    axes.axvline(zeta, color="black", lw=0.6, ls=":")
    axes.set_xticks(added_ratio, [f"{number:g}" for number in added_ratio])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("ωΔt/2 (dotted: ζ)")
    axes.legend()
plt.show()

# %% [markdown]
# If the numerical damping exceeds the damping of the spring, the estimate of $c$ is at its lower
# bound, zero. For large steps the stiffness is biased too, by 5 % for the largest step. The
# solver converges without a warning. The **midpoint rule** has no numerical damping; it lowers
# the frequency, and this error decreases with $\Delta t^2$.
#
# For every scheme, the error becomes smaller with **substeps**, that is, with several time steps
# between two sampling times. To check whether the number of substeps is sufficient, double it. If
# an estimate changes by more than its standard error, the smaller number was insufficient.

# %%
euler = by_scheme["backward Euler"]
midpoint = by_scheme["midpoint"]
assert euler[3, 1] < 1e-3 * DAMPING  # at 10 ms
assert 1.04 < euler[4, 0] / STIFFNESS < 1.06  # at 20 ms
assert np.allclose(midpoint[:, 1], DAMPING, rtol=0.05)
assert np.isclose(midpoint[4, 0] - STIFFNESS, 4 * (midpoint[3, 0] - STIFFNESS), rtol=0.1)

# %% [markdown]
# ## 1.4 A tetrahedron
#
# A tetrahedron of soft sponge with edges of 10 cm is held at three corners; the fourth corner is
# free. Its position has three components, and the isotropic material has *two* elastic constants,
# the Lamé constants: the shear modulus $\mu$ and $\lambda$, which resists a change of volume.
# Young's modulus and Poisson's ratio are
# $E = \mu\frac{3\lambda+2\mu}{\lambda+\mu}$ and $\nu = \frac{\lambda}{2(\lambda+\mu)}$.
#
# ### Neo-Hookean energy
#
# The displacement in a linear tetrahedron is affine. The **deformation gradient** $F$ is therefore
# constant; it maps the undeformed edges to the deformed ones. The compressible Neo-Hookean energy
# density is
#
# $$\psi = \tfrac12\lambda(\ln J)^2 - \mu\ln J + \tfrac12\mu(\operatorname{tr}F^TF - 3),
# \qquad J = \det F.$$

# %%
SIDE = 0.10  # m
DENSITY = 300.0  # kg/m³
GRAVITY = 9.81  # m/s²
corners = SIDE * np.array(
    [[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(3) / 2, 0], [0.5, np.sqrt(3) / 6, -np.sqrt(2 / 3)]]
)
rest_edges = (corners[:3] - corners[3]).T  # columns: from the free corner to the held corners
volume = abs(np.linalg.det(rest_edges)) / 6
corner_mass = DENSITY * volume / 4

P = ca.SX.sym("P", 3, 4)  # positions, one column for each corner
V = ca.SX.sym("V", 3, 4)  # velocities
lam = ca.SX.sym("lam")
mu = ca.SX.sym("mu")
gamma_r = ca.SX.sym("gamma_r")
F = (P[:, :3] - ca.repmat(P[:, 3], 1, 3)) @ np.linalg.inv(rest_edges)
log_j = ca.log(ca.det(F))
energy = volume * (lam * log_j**2 / 2 - mu * log_j + mu * (ca.sumsqr(F) - 3) / 2)
print(f"volume {1e6 * volume:.0f} cm³, lumped mass of a corner {1e3 * corner_mass:.1f} g")

# %% [markdown]
# ### Force, stiffness matrix and Rayleigh damping
#
# As for the spring, the elastic force is $f_e = -\partial\Psi/\partial x$. The tangent stiffness
# matrix is $K = \partial^2\Psi/\partial x^2 = -\partial f_e/\partial x$. Stiffness-proportional
# **Rayleigh damping** adds the force $f_d = -\gamma_r K v$.

# %%
elastic = -ca.gradient(energy, P)
stiffness = ca.hessian(energy, ca.vec(P))[0]
damping = -gamma_r * ca.reshape(stiffness @ ca.vec(V), 3, 4)

constants = [lam, mu, gamma_r]
energy_at = ca.Function("energy", [P, *constants], [energy])
force_at = ca.Function("force", [P, V, *constants], [elastic + damping])
stiffness_at = ca.Function("stiffness", [P, *constants], [stiffness])

# %% [markdown]
# Central differences verify the derivatives: those of the energy must agree with the force, and
# those of the force with the stiffness matrix. The truncation error decreases with $h^2$, and the
# rounding error increases with $1/h$.

# %%
TRUE_CONSTANTS = (200.0, 300.0, 0.009)  # λ [Pa], μ [Pa], γ_r [s]
no_velocity = np.zeros((3, 4))
deformed = corners.T + 0.1 * SIDE * np.random.default_rng(2).normal(size=(3, 4))
direction = np.random.default_rng(3).normal(size=(3, 4))


def central_difference(function, h):
    """Return the central difference of a function along `direction` with step h."""
    forward = np.array(function(deformed + h * direction))
    backward = np.array(function(deformed - h * direction))
    return (forward - backward) / (2 * h)


def energy_of(positions):
    """Return the elastic energy [J]."""
    return energy_at(positions, *TRUE_CONSTANTS)


def elastic_force_of(positions):
    """Return the elastic forces (3, 4) [N]."""
    return force_at(positions, no_velocity, *TRUE_CONSTANTS)


slope = -np.sum(elastic_force_of(deformed).full() * direction)
force_change = -stiffness_at(deformed, *TRUE_CONSTANTS).full() @ direction.T.ravel()
sizes = np.geomspace(1e-9, 1e-3, 13)
force_errors = []
stiffness_errors = []
for h in sizes:
    force_errors.append(abs(central_difference(energy_of, h) / slope - 1).item())
    difference = central_difference(elastic_force_of, h).T.ravel() - force_change
    stiffness_errors.append(np.linalg.norm(difference) / np.linalg.norm(force_change))
assert min(force_errors) < 1e-8
assert min(stiffness_errors) < 1e-8

# %%
figure, axes = plt.subplots(figsize=(3.8, 2.6))
axes.loglog(sizes, force_errors, "o-", color=BLUE, label="force")
axes.loglog(sizes, stiffness_errors, "o-", color=VERMILION, label="stiffness matrix")
axes.set(title="Verification by central differences", xlabel="h [m]", ylabel="relative difference")
axes.legend()
plt.show()

# %% [markdown]
# The toolbox computes the same forces and stiffness matrix for a mesh of one tetrahedron:

# %%
mesh = cs.TetMesh(corners, np.array([[0, 1, 2, 3]]))
body = cs.Body(mesh, "neo-hookean", density_kg_m3=DENSITY, damping="rayleigh")
moduli = {"lambda_pa": TRUE_CONSTANTS[0], "mu_pa": TRUE_CONSTANTS[1]}
toolbox_force = body.elastic_force(deformed.T, **moduli)
toolbox_stiffness = body.stiffness(deformed.T, **moduli).toarray()
assert np.allclose(toolbox_force, elastic_force_of(deformed).full().T)
assert np.allclose(toolbox_stiffness, stiffness_at(deformed, *TRUE_CONSTANTS).full())

# %% [markdown]
# ### Sign of the damping force
#
# The paper defines $K = \partial f_e/\partial x$ and writes $f_d = -\gamma_r K v$. With this
# definition the force is $+\gamma_r\,\partial^2\Psi/\partial x^2\,v$, which increases the energy.
# The energy balance shows the correct sign: the total energy of a body must not increase if no
# external force does work. The next cell displaces the free corner by 1 mm, releases it, and
# computes $\Psi + \tfrac12 m |v|^2$ for both signs.


# %%
def released_energy(sign, steps=600, dt=0.0005):
    """Return the energy [J] at each step after the release, with the damping times `sign`."""
    position = corners[3] + [0.0006, 0.0, -0.0008]
    velocity = np.zeros(3)
    energies = []
    for _ in range(steps):
        positions = corners.T.copy()
        positions[:, 3] = position
        velocities = np.zeros((3, 4))
        velocities[:, 3] = sign * velocity
        energies.append(float(energy_of(positions)) + corner_mass * velocity @ velocity / 2)
        corner_force = force_at(positions, velocities, *TRUE_CONSTANTS).full()[:, 3]
        velocity = velocity + dt * corner_force / corner_mass
        position = position + dt * velocity
    return np.array(energies)


dissipating = released_energy(+1)
literal = released_energy(-1)
print(f"energy after 0.3 s, −γ_r ∂²Ψ/∂x² v: {dissipating[-1] / dissipating[0]:.3f} of the initial")
print(f"energy after 0.3 s, +γ_r ∂²Ψ/∂x² v: {literal[-1] / literal[0]:.0f} times the initial")
assert dissipating[-1] < 0.2 * dissipating[0]
assert literal[-1] > 5 * literal[0]

# %%
figure, axes = plt.subplots(figsize=(3.8, 2.6))
release_times = 0.0005 * np.arange(600)
axes.semilogy(release_times, 1e6 * literal, color=VERMILION, label=r"$+\gamma_r\,\Psi_{xx}\,v$")
axes.semilogy(release_times, 1e6 * dissipating, color=BLUE, label=r"$-\gamma_r\,\Psi_{xx}\,v$")
axes.set(title="Energy after release", xlabel="time [s]", ylabel="Ψ + kinetic energy [µJ]")
axes.legend()
plt.show()

# %% [markdown]
# ### Synthetic recording
#
# A robot translates and rotates the three held corners for 0.4 s. The reference motion of the free
# corner is computed by the Runge–Kutta method DOP853 of SciPy, independently of the collocation
# schemes. Initially the sponge is in static equilibrium under gravity. The position of the free
# corner is measured at 200 Hz with 0.5 mm noise.


# %%
CORNER_SIGMA = 0.0005  # m, standard deviation of the noise
weight_n = np.array([0, 0, -corner_mass * GRAVITY])


def held_corners(t):
    """Return the positions (3, 3) of the held corners at time t, one column each [m]."""
    share = 1 - np.cos(2 * np.pi * 2.5 * t)
    turn = Rotation.from_rotvec([0.25 * share, 0.35 * np.sin(9 * t) * share, 0.0])
    return turn.apply(corners[:3]).T + np.outer([0.02, -0.015, 0.025], [share] * 3)


def state_derivative(t, state):
    """Return the time derivative of the state (position, velocity) of the free corner."""
    held_velocity = (held_corners(t + 1e-6) - held_corners(t - 1e-6)) / 2e-6
    positions = np.column_stack([held_corners(t), state[:3]])
    velocities = np.column_stack([held_velocity, state[3:]])
    total = force_at(positions, velocities, *TRUE_CONSTANTS).full()[:, 3] + weight_n
    return np.concatenate([state[3:], total / corner_mass])


def acceleration_at_rest(position):
    """Return the acceleration of the free corner at time zero without velocity."""
    return state_derivative(0.0, np.append(position, np.zeros(3)))[3:]


equilibrium = root(acceleration_at_rest, corners[3]).x
times = np.arange(81) * 0.005
initial_state = np.append(equilibrium, np.zeros(3))
reference = solve_ivp(
    state_derivative, (0, times[-1]), initial_state, method="DOP853", t_eval=times, rtol=1e-8
).y[:3]
measured = reference + CORNER_SIGMA * np.random.default_rng(4).normal(size=reference.shape)

# %% [markdown]
# ### Nonlinear program
#
# The program has the same structure as that of the spring, with three force components instead of
# one. Only the free corner is unknown; the positions of the held corners are prescribed. One more
# equation states the initial static equilibrium, $f(x_0, 0) = 0$. The parameters are represented
# by their logarithms $q$, so that steps of the solver are relative changes for moduli and damping
# alike.


# %%
def sponge_program(times):
    """Return the nonlinear program of the tetrahedron, discretised by the midpoint rule."""
    steps = len(times)
    dt = times[1] - times[0]
    q = ca.SX.sym("q", 3)
    Z = ca.SX.sym("z", 3, steps)
    Y = ca.SX.sym("y", 3, steps)
    X = SIDE * Z
    theta = [ca.exp(q[i]) for i in range(3)]
    states = [ca.horzcat(held_corners(t), X[:, i]) for i, t in enumerate(times)]
    forces = [
        force_at((before + after) / 2, (after - before) / dt, *theta)[:, 3] + weight_n
        for before, after in pairwise(states)
    ]
    inertia = corner_mass / dt**2
    rows = [force_at(states[0], no_velocity, *theta)[:, 3] + weight_n]
    rows.append(forces[0] / 2 - inertia * (X[:, 1] - X[:, 0]))
    for i in range(2, steps):
        mean_force = (forces[i - 1] + forces[i - 2]) / 2
        rows.append(mean_force - inertia * (X[:, i] - 2 * X[:, i - 1] + X[:, i - 2]))
    loss = ca.sumsqr((X - Y) / CORNER_SIGMA)
    return {"x": ca.vertcat(q, ca.vec(Z)), "p": ca.vec(Y), "f": loss, "g": ca.vertcat(*rows)}


sponge = sponge_program(times)
sponge_solver = ca.nlpsol("sponge", "ipopt", sponge, ipopt_options())

# %%
start = np.concatenate([np.log([400.0, 150.0, 0.02]), measured.T.ravel() / SIDE])
start_time = perf_counter()
result = sponge_solver(x0=start, p=measured.T.ravel(), lbg=0, ubg=0)
elapsed_s = perf_counter() - start_time
stats = sponge_solver.stats()
assert stats["success"]
sponge_z = result["x"].full().ravel()
print(f"{len(sponge_z)} unknowns, {stats['iter_count']} iterations, {elapsed_s:.2f} s")

# %% [markdown]
# As for the spring, the standard errors follow from the null space of the constraint Jacobian.
# Here the null space has three dimensions, one for each parameter, because the initial
# equilibrium determines the initial position.

# %%
sponge_rows = ca.jacobian(sponge["g"], sponge["x"])
N = null_space(ca.Function("J", [sponge["x"]], [sponge_rows])(sponge_z).full())
weighted = SIDE * N[3:] / CORNER_SIGMA
sponge_covariance = N[:3] @ np.linalg.inv(weighted.T @ weighted) @ N[:3].T
relative_errors = np.sqrt(np.diag(sponge_covariance))
for i, name in enumerate(("λ [Pa]", "μ [Pa]", "γ_r [s]")):
    value = np.exp(sponge_z[i])
    print(f"{name:8}{value:9.4g} ± {100 * relative_errors[i]:.1f} %, true {TRUE_CONSTANTS[i]:g}")
assert N.shape[1] == 3
assert np.all(np.abs(sponge_z[:3] - np.log(TRUE_CONSTANTS)) < 4 * relative_errors + 0.02)

# %%
figure, axes = plt.subplots(figsize=(4.7, 2.6))
fitted = SIDE * sponge_z[3:].reshape(-1, 3).T
for i, colour in enumerate((BLUE, VERMILION, GREEN)):
    axes.plot(times, 1e3 * (measured[i] - corners[3, i]), ".", color=colour)
    axes.plot(times, 1e3 * (fitted[i] - corners[3, i]), color=colour, label="xyz"[i])
axes.set(title="Free corner: measured (dots), fitted (lines)", xlabel="time [s]")
axes.set_ylabel("displacement [mm]")
axes.legend()
plt.show()

# %% [markdown]
# ### Block structure of the Jacobian
#
# The band consists of 3 × 3 blocks instead of single entries. For a mesh of $n$ nodes the blocks
# are $3n \times 3n$ and sparse, because the force at a node depends on adjacent nodes only. The
# initial equilibrium $c_0$ does not depend on the third parameter, $\gamma_r$, because the
# velocity is zero.

# %%
short = sponge_program(times[:8])
pattern = ca.jacobian(short["g"], short["x"]).sparsity()
figure, axes = plt.subplots(figsize=(4, 3.4))
axes.spy(ca.DM(pattern, 1).full(), markersize=4, color=BLUE)
axes.axvline(2.5, color=VERMILION, lw=0.8)
for i in range(1, 8):
    axes.axhline(3 * i - 0.5, color="#B0B0B0", lw=0.4)
    axes.axvline(3 * i + 2.5, color="#B0B0B0", lw=0.4)
axes.set_xticks([1, *(3 * i + 4 for i in range(8))], ["θ", *(f"$x_{i}$" for i in range(8))])
axes.set_yticks([3 * i + 1 for i in range(8)], [f"$c_{i}$" for i in range(8)])
axes.xaxis.set_ticks_position("bottom")
axes.set_title("Constraint Jacobian of eight time steps")
axes.grid(False)
plt.show()

# %% [markdown]
# ## Exercises
#
# The solutions follow in the last section.
#
# 1. **Numerical damping.** Insert $x_t = z^t$ into the midpoint rule of an undamped spring and show
#    that $|z| = 1$ for every step size. What is $|z|$ for backward Euler?
# 2. **Fewer samples.** Half of the samples of the spring are missing. Compare the standard errors
#    of $k$ and $c$ without every second sample and without the second half of the recording.
# 3. **Hardening spring.** Add $\tfrac14 k_3 x^4$ to the energy, simulate data with
#    $k_3 = 4000\ \mathrm{N/m^3}$, and estimate $k$, $c$ and $k_3$. Compare the standard errors of
#    $k_3$ for initial displacements of 50 mm and 10 mm.
# 4. **Rigid rotation.** Rotate the tetrahedron by 30° without deformation. What is its energy
#    with the material `neo-hookean`, and with `linear`? When is the material `linear` applicable?
#
# Next part: [2 · Cylinder](2_cylinder.ipynb)
#
# ## Solutions
#
# **1.** With $h = \omega\Delta t$ the midpoint rule gives
# $(z-1)^2 + \tfrac{h^2}{4}(z+1)^2 = 0$, whose roots are on the unit circle. Backward Euler gives
# $(1+h^2)z^2 - 2z + 1 = 0$, $|z| = 1/\sqrt{1+h^2} \approx 1 - h^2/2$: a damping ratio of $h/2$.

# %% jupyter={"source_hidden": true}
for h in (0.05, 0.2, 1.0):
    midpoint_roots = np.roots([1 + h**2 / 4, -2 + h**2 / 2, 1 + h**2 / 4])
    euler_roots = np.roots([1 + h**2, -2, 1])
    print(f"h = {h:4}: |z| midpoint {abs(midpoint_roots[0]):.6f}, Euler {abs(euler_roots[0]):.4f}")
    assert np.allclose(abs(midpoint_roots), 1)
    assert np.allclose(abs(euler_roots), 1 / np.sqrt(1 + h**2))

# %% [markdown]
# **2.** Without every second sample, both standard errors increase by a factor of $\sqrt2$. The
# second half of the recording contains more information than the first half, because the effects
# of an error of the frequency and of the damping grow with time. Without the second half, the
# standard error of $k$ increases most.

# %% jupyter={"source_hidden": true}
N = null_space_at((k_estimate, c_estimate), trajectory)
factors = {}
for name, kept in (("every second sample", np.arange(len(t)) % 2 == 0), ("first half", t <= 0.5)):
    weighted = PULL * N[2:][kept] / SIGMA
    covariance = N[:2] @ np.linalg.inv(weighted.T @ weighted) @ N[:2].T
    factors[name] = np.sqrt(np.diag(covariance)) / std_errors
    k_factor, c_factor = factors[name]
    print(f"{name:19}: standard error of k × {k_factor:.2f}, of c × {c_factor:.2f}")
assert np.allclose(factors["every second sample"], np.sqrt(2), rtol=0.05)
assert factors["first half"][0] > factors["first half"][1] > 2

# %% [markdown]
# **3.** The energy has one more term. The ratio of the cubic to the linear force is
# $k_3x^2/k = 25\,\%$ at 50 mm, but only 1 % at 10 mm, so that the standard error of $k_3$ is much
# larger.


# %% jupyter={"source_hidden": true}
def identify_hardening_spring(pull, k3=4000.0, dt=0.005):
    """Return k3 and its standard error [N/m³] from one recording with an initial displacement."""
    times = np.arange(201) * dt

    def derivative(_, state):
        position, velocity = state
        total = -STIFFNESS * position - k3 * position**3 - DAMPING * velocity
        return [velocity, total / MASS]

    exact = solve_ivp(
        derivative, (0, 1), [pull, 0.0], method="DOP853", t_eval=times, rtol=1e-9, atol=1e-12
    ).y[0]
    measured = exact + SIGMA * np.random.default_rng(6).normal(size=len(times))
    theta = ca.SX.sym("theta", 3)
    Z = ca.SX.sym("z", len(times))
    X = pull * Z
    scale = np.array([10.0, 0.1, 1000.0])
    stiff, damp, cubic = ca.vertsplit(theta * scale)
    middle = (X[1:] + X[:-1]) / 2
    F = -stiff * middle - cubic * middle**3 - damp * (X[1:] - X[:-1]) / dt
    first = F[0] / 2 - MASS * (X[1] - X[0]) / dt**2
    others = (F[1:] + F[:-1]) / 2 - MASS * (X[2:] - 2 * X[1:-1] + X[:-2]) / dt**2
    unknowns = ca.vertcat(theta, Z)
    rows = ca.vertcat(first, others)
    nlp = {"x": unknowns, "f": ca.sumsqr((X - measured) / SIGMA), "g": rows}
    guess = np.concatenate([[3.0, 1.0, 1.0], measured / pull])
    z = ca.nlpsol("s", "ipopt", nlp, ipopt_options())(x0=guess, lbg=0, ubg=0)["x"]
    N = null_space(ca.Function("J", [unknowns], [ca.jacobian(rows, unknowns)])(z).full())
    weighted = pull * N[3:] / SIGMA
    covariance = N[:3] @ np.linalg.inv(weighted.T @ weighted) @ N[:3].T
    return float(z[2]) * scale[2], np.sqrt(covariance[2, 2]) * scale[2]


k3_errors = []
for pull in (0.05, 0.01):
    k3_estimate, k3_error = identify_hardening_spring(pull)
    k3_errors.append(k3_error)
    assert abs(k3_estimate - 4000) < 4 * k3_error
    print(f"displacement {1e3 * pull:.0f} mm: k₃ = {k3_estimate:.0f} ± {k3_error:.0f} N/m³")
assert k3_errors[1] > 10 * k3_errors[0]

# %% [markdown]
# **4.** The energy is zero for `neo-hookean`, because $F^TF$ is invariant under rotation. The
# material `linear` uses the strain $\operatorname{sym}F - I$, which is not zero for a rotation.
# The material `linear` is applicable only if no part of the body rotates by more than a few
# degrees, hence not to swung bodies.

# %% jupyter={"source_hidden": true}
rotated = Rotation.from_rotvec([0, np.pi / 6, 0]).apply(corners)
energies_j = {}
for material in ("neo-hookean", "linear"):
    rotated_body = cs.Body(mesh, material, density_kg_m3=DENSITY)
    energies_j[material] = float(rotated_body.energy(rotated, **moduli))
    print(f"{material:12}: {1e3 * energies_j[material]:.3g} mJ")
assert abs(energies_j["neo-hookean"]) < 1e-12
assert energies_j["linear"] > 1e-3
