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
# # Collocation from scratch
#
# **What is a soft object made of?** A robot holds it, swings it, and cameras track a few points on
# it. From the motion we want the stiffness and the damping of its material, and an honest error
# bar. This notebook builds the method in three sizes:
#
# 1. one **spring** — the whole idea in ten lines;
# 2. one **tetrahedron** — the same with a deformable solid;
# 3. a **foam cylinder** — the same with 84 nodes, by the toolbox.
#
# Between them: why the equations of motion should be constraints and not a penalty, what the
# integration scheme does to the answer, a sign to get right, and, most important, what data can
# and cannot tell. Seven exercises with solutions are at the end.
#
# You need: calculus, a little linear algebra, Newton's law. Reading takes an hour, running a
# minute.

# %%
# %matplotlib inline
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory
from time import perf_counter

import casadi as ca
import matplotlib as mpl
import numpy as np
from IPython.display import display
from scipy.integrate import solve_ivp
from scipy.linalg import null_space, toeplitz
from scipy.optimize import minimize, root
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.fem.moduli import engineering_constants as engineering_moduli
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.parameters import Parameter, Parameters
from collocation_sysid.recording import prescribed_nodes
from collocation_sysid.recording.nuisance import Nuisance
from collocation_sysid.result.figure_style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    SKY,
    VERMILION,
    add_legend,
    new_figure,
    style_axes,
)
from collocation_sysid.runs.check import check_problem
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.profile_likelihood import profile_of_solution
from collocation_sysid.statistics.residual_diagnostics import diagnose_markers
from collocation_sysid.statistics.uncertainty import ErrorModel, uncertainty_from_fit

mpl.rcParams["figure.dpi"] = 110
HERE = [Path.cwd(), *Path.cwd().parents]
PROBLEMS = next(path / "problems" for path in HERE if (path / "problems").is_dir())


# %%
def panels(columns, height_mm=62.0, width_mm=180.0, **options):
    """A figure with some axes side by side."""
    figure = new_figure(width_mm, height_mm)
    return figure, figure.subplots(1, columns, **options)


def quiet(**options):
    """Options that keep IPOPT silent."""
    return {"ipopt": {"print_level": 0, "sb": "yes"} | options, "print_time": False}


# %% [markdown]
# # 1 · One spring
#
# A mass $m$ hangs on a spring. We pull it 50 mm away, let go, and film it for a second at 100 Hz.
# We know $m$. We want the stiffness $k$ and the damping $c$.
#
# ## Energy → force
#
# Everything elastic in this notebook starts from an **energy** $\Psi(x)$. The force is what lowers
# it: $f_e = -\partial\Psi/\partial x$. CasADi differentiates for us.

# %%
x, v, k, c = (ca.SX.sym(name) for name in "xvkc")
energy = k * x**2 / 2
force = -ca.gradient(energy, x) - c * v
print(force)

# %% [markdown]
# Not exciting for a spring — but the line stays the same for a tetrahedron.
#
# Nature solves $m\ddot x = f(x, \dot x)$ exactly; here is that solution, and what a camera with
# 1 mm of noise makes of it.

# %%
MASS, STIFFNESS, DAMPING, PULL = 0.1, 40.0, 0.08, 0.05  # kg, N/m, N s/m, m
SIGMA = 0.001


def nature(t, stiffness=STIFFNESS, damping=DAMPING):
    """Position of the released mass."""
    decay, omega = damping / (2 * MASS), np.sqrt(stiffness / MASS)
    damped = np.sqrt(omega**2 - decay**2)
    return PULL * np.exp(-decay * t) * (np.cos(damped * t) + decay / damped * np.sin(damped * t))


DT = 0.01
t = np.arange(101) * DT
y = nature(t) + SIGMA * np.random.default_rng(0).normal(size=len(t))

omega = np.sqrt(STIFFNESS / MASS)
zeta = DAMPING / (2 * np.sqrt(STIFFNESS * MASS))
print(f"ω = {omega:.3g} rad/s, that is {omega / (2 * np.pi):.2f} Hz; damping ratio ζ = {zeta:.3g}")

# %% [markdown]
# ## Force → discrete motion
#
# Choose a grid of times, here those of the camera, and unknown positions $x_0, x_1, \dots$ on it.
# The **midpoint scheme** evaluates the force once in each interval,
#
# $$F_t = f\Big(\tfrac{x_t + x_{t-1}}2,\ \tfrac{x_t - x_{t-1}}{\Delta t}\Big),$$
#
# and asks at each time that mass times acceleration be the mean of the two forces around it:
#
# $$c_t = \tfrac12 (F_t + F_{t-1}) - m\,\frac{x_t - 2x_{t-1} + x_{t-2}}{\Delta t^2} = 0.$$
#
# The first step starts from rest: $c_1 = \tfrac12 F_1 - m\,(x_1 - x_0)/\Delta t^2 = 0$.
#
# ## Discrete motion → nonlinear program
#
# A *simulation* would now go step by step with given $k, c$. **Collocation** does not simulate. It
# takes *all* positions and the parameters as unknowns of one optimisation problem,
#
# $$\min_{k,\,c,\,x_0 \dots x_T} \sum_t \Big(\frac{x_t - y_t}{\sigma}\Big)^2
# \quad\text{subject to}\quad c_t(x_t, x_{t-1}, x_{t-2};\, k, c) = 0,$$
#
# and hands it to a solver. Here it is, in ten lines. Positions are counted in units of the pull
# (50 mm): solvers like unknowns near one.
#
# Textbooks of trajectory optimisation mean the same by *direct collocation*, mostly with the
# **trapezoidal rule**, where position and velocity are unknowns at every time,
# $m(v_t - v_{t-1}) = \tfrac{\Delta t}2(f_t + f_{t-1})$ and
# $x_t - x_{t-1} = \tfrac{\Delta t}2(v_t + v_{t-1})$,
# or **Hermite–Simpson**, a cubic in each interval with the equations of motion also in its middle:
# fourth order for twice the unknowns. Eliminate the velocities from the trapezoidal rule, and for a
# force linear in $x$ and $v$ exactly the rows $c_t$ above are left; for others midpoint has the
# force of the mean in place of the mean of the forces, needs no velocities at all, and keeps the
# energy of a body that swings.

# %%
spring_force = ca.Function("f", [x, v, k, c], [force])


def spring_program(steps, dt):
    theta, Z, Y = ca.SX.sym("theta", 2), ca.SX.sym("z", steps), ca.SX.sym("y", steps)
    X = PULL * Z
    F = spring_force((X[1:] + X[:-1]) / 2, (X[1:] - X[:-1]) / dt, theta[0], theta[1])
    first = F[0] / 2 - MASS * (X[1] - X[0]) / dt**2
    others = (F[1:] + F[:-1]) / 2 - MASS * (X[2:] - 2 * X[1:-1] + X[:-2]) / dt**2
    motion = ca.vertcat(first, others)
    loss = ca.sumsqr((X - Y) / SIGMA)
    return {"x": ca.vertcat(theta, Z), "p": Y, "f": loss, "g": motion}


program = spring_program(len(t), DT)
solver = ca.nlpsol("spring", "ipopt", program, quiet())

# %% [markdown]
# The starting point: a poor guess of the parameters — and for the positions *the measurements
# themselves*. That is a luxury of collocation: the path is an unknown like any other, so what we
# have seen of it can be its first guess.


# %%
def identify(solver, y, guess=(10.0, 1.0)):
    """Parameters (k, c), the path, and the number of iterations."""
    lower = np.concatenate([[0, 0], np.full(len(y), -np.inf)])
    found = solver(x0=np.concatenate([guess, y / PULL]), p=y, lbx=lower, lbg=0, ubg=0)
    assert solver.stats()["success"], solver.stats()["return_status"]
    z = found["x"].full().ravel()
    return z[:2], PULL * z[2:], solver.stats()["iter_count"]


(k_found, c_found), path, iterations = identify(solver, y)
print(f"k = {k_found:.2f} N/m (truth {STIFFNESS:g}), c = {c_found:.4f} N s/m (truth {DAMPING:g})")
print(f"{iterations} iterations from the guess k = 10, c = 1")

# %%
figure, (left, right) = panels(2)
left.plot(t, 1e3 * y, ".", color=BLACK, ms=3, label="camera, 1 mm noise")
left.plot(t, 1e3 * path, color=BLUE, lw=1.1, label="collocation")
style_axes(left, "The fitted path", "time [s]", "position [mm]")
left.set_ylim(top=75)
add_legend(left)
right.plot(t, 1e3 * (path - y), ".", color=BLACK, ms=3, label="fitted − measured")
right.plot(t, 1e3 * (path - nature(t)), color=VERMILION, lw=1.1, label="fitted − true")
style_axes(right, "What is left", "time [s]", "error [mm]")
right.set_ylim(top=3.5)
add_legend(right)
display(figure)

# %% [markdown]
# The fitted path is far closer to the truth than any single measurement: all 101 samples together
# decide two parameters and the starting point.
#
# ## Why not simulate and compare?
#
# *Shooting* simulates with trial parameters and compares with the data. Its loss over $k$ (with
# the right $c$) has a narrow valley, because a wrong frequency goes out of step with the data. A
# search that starts outside the valley ends in a wrong one.

# %%
trials = np.geomspace(4, 400, 600)
shooting_loss = np.array([np.mean((nature(t, k) - y) ** 2) / SIGMA**2 for k in trials])
valleys = np.flatnonzero(
    (shooting_loss[1:-1] < shooting_loss[:-2]) & (shooting_loss[1:-1] < shooting_loss[2:])
)
guesses = np.array([4.0, 8.0, 15.0, 30.0, 60.0, 120.0, 250.0, 400.0])
answers = np.array([identify(solver, y, (guess, 1.0))[0][0] for guess in guesses])
print(f"shooting has {len(valleys)} valleys; collocation's answers: {np.unique(answers.round(2))}")

# %%
figure, (left, right) = panels(2)
left.loglog(trials, shooting_loss, color=BLUE, lw=1.1)
left.plot(trials[1:-1][valleys], shooting_loss[1:-1][valleys], "o", color=VERMILION, ms=4)
left.axvline(STIFFNESS, color=BLACK, lw=0.6)
style_axes(left, "Shooting: loss and its valleys", "k [N/m]", "mean squared error / σ²")
right.loglog(guesses, answers, "o-", color=BLUE, ms=4, lw=1.1)
right.axhline(STIFFNESS, color=BLACK, lw=0.6)
right.set_ylim(4, 400)
style_axes(right, "Collocation: answer by guess", "guess of k [N/m]", "identified k [N/m]")
display(figure)

# %% [markdown]
# Collocation has the same minimum, but its iterates need not obey the equations of motion on the
# way. Starting from the measured path, it mainly asks "which $k$ and $c$ fit these accelerations?",
# which is an easy question.
#
# That is no law. The valleys belong to an oscillation over many periods, and to a search that only
# goes downhill. For the soft bodies of sections 4 to 6, which swing once or twice, shooting with
# Gauss–Newton steps found the answer from the same guesses as collocation: 40 of 40 within a
# factor of ten (`docs/studies.md`).
#
# ## What the program looks like
#
# More unknowns, but hardly any of them meet: $c_t$ knows only $x_t, x_{t-1}, x_{t-2}$ and the
# parameters. The constraint Jacobian is a thin band beside two dense columns. That is why a
# problem with 100,000 unknowns can be solved at all.

# %%
small = spring_program(16, DT)
unknowns = ca.SX.sym("z", 18)
jacobian = ca.Function("J", [small["x"]], [ca.jacobian(small["g"], small["x"])])
hessian = ca.hessian(small["f"] + ca.dot(ca.SX.sym("w", 15), small["g"]), small["x"])[0]

figure, (left, right) = panels(2, height_mm=78)
for axes, pattern, title in (
    (left, jacobian.sparsity_out(0), "Jacobian of the constraints"),
    (right, hessian.sparsity(), "Hessian of the Lagrangian"),
):
    axes.spy(ca.DM(pattern, 1).full(), markersize=4, color=BLUE)
    axes.axvline(1.5, color=VERMILION, lw=0.8)
    axes.xaxis.set_ticks_position("bottom")
    style_axes(axes, title, "k, c | positions", "")
    axes.grid(False)
left.set_ylabel("equations of motion", fontsize=7.5)
right.axhline(1.5, color=VERMILION, lw=0.8)
right.set_ylabel("k, c | positions", fontsize=7.5)
display(figure)

# %% [markdown]
# ## How sure are we?
#
# The optimum has an error bar, and the same matrices give it. Near the answer the path may only
# move in directions $N$ that keep the equations of motion satisfied, that is in the null space of
# their Jacobian: here three, because $k$, $c$ and $x_0$ determine the rest. In these directions
# the loss is an ordinary least-squares problem, so
#
# $$\operatorname{cov}(z) = N\,\big(N^T H^T H N / \sigma^2\big)^{-1} N^T$$
#
# with $H$ picking the measured positions out of $z$.

# %%
constraint_jacobian = ca.Function(
    "J", [program["x"], program["p"]], [ca.jacobian(program["g"], program["x"])]
)


def covariance_of(theta, path):
    """(2, 2) covariance of (k, c)."""
    matrix = constraint_jacobian(np.concatenate([theta, path / PULL]), path).full()
    N = null_space(matrix)
    measured = PULL * N[2:] / SIGMA
    return N[:2] @ np.linalg.inv(measured.T @ measured) @ N[:2].T


predicted = covariance_of((k_found, c_found), path)
k_error, c_error = np.sqrt(np.diag(predicted))
print(f"k = {k_found:.2f} ± {k_error:.2f} N/m,  c = {c_found:.4f} ± {c_error:.4f} N s/m")
assert abs(c_found - DAMPING) < 4 * c_error

# %% [markdown]
# Believe it? Film the same swing 200 times, each with new noise, and look how the answers scatter.

# %%
rng = np.random.default_rng(1)
films = [nature(t) + SIGMA * rng.normal(size=len(t)) for _ in range(200)]
scatter = np.array([identify(solver, film, (30.0, 0.1))[0] for film in films])
inside = np.abs(scatter - scatter.mean(axis=0)) < 1.96 * np.array([k_error, c_error])
print(f"scatter: {scatter.std(axis=0, ddof=1)}, predicted: {np.array([k_error, c_error])}")
print(f"within 1.96 predicted deviations: {inside.mean(axis=0)} (should be 0.95)")
assert np.allclose(scatter.std(axis=0), [k_error, c_error], rtol=0.25)
bias = scatter[:, 0].mean() / STIFFNESS - 1
print(
    f"mean of k: {100 * bias:.2f} % above the truth; (ωΔt)²/6 = {100 * (omega * DT) ** 2 / 6:.2f} %"
)
assert np.isclose(bias, (omega * DT) ** 2 / 6, rtol=0.1)


# %%
def ellipse(mean, covariance, deviations=2.448):
    """Points on the ellipse that holds 95 % of a plane normal distribution."""
    angle = np.linspace(0, 2 * np.pi, 100)
    circle = np.array([np.cos(angle), np.sin(angle)])
    return (np.array(mean)[:, None] + deviations * np.linalg.cholesky(covariance) @ circle).T


figure, axes = panels(1, width_mm=90)
axes.plot(*scatter.T, ".", color=BLUE, ms=4, label="answers to 200 films")
outline = ellipse(scatter.mean(axis=0), predicted)
axes.plot(*outline.T, color=VERMILION, lw=1.1, label="predicted from one film, 95 %")
axes.plot(STIFFNESS, DAMPING, "+", color=BLACK, ms=10, mew=1.5, label="truth")
style_axes(axes, "Two hundred films of one swing", "k [N/m]", "c [N s/m]")
axes.set_ylim(top=axes.get_ylim()[1] + 0.006)
add_legend(axes)
display(figure)

# %% [markdown]
# The cloud has the size we said. But it misses the truth in $k$ by many of its widths! **An error
# bar speaks of the noise, not of the model.** Part of our model is the scheme: midpoint swings too
# slowly by $(\omega\Delta t)^2/12$, and the fit makes up for it with a spring stiffer by twice
# that share. Half a per cent is nothing here — until the error bar is a tenth of it. Section 3 is
# about this.
#
# # 2 · Penalty or constraint?
#
# The paper behind this toolbox did not constrain the path. It added the violations to the loss,
#
# $$\min_{\theta,\,x}\ \sum_t \Big(\frac{x_t - y_t}{\sigma}\Big)^2 + \frac\rho2 \sum_t c_t^2,$$
#
# and let nonlinear conjugate gradients (CG) run. No constraints, no linear systems: attractive.
# But what should $\rho$ be? We try seven values, and minimise in two ways: *exactly*, with
# Newton's method, and with *1000 iterations of CG* — as one would on a big mesh, where nobody can
# wait for more.

# %%
rho = ca.SX.sym("rho")
penalised = program["f"] + rho / 2 * ca.sumsqr(program["g"])
parameters = ca.vertcat(program["p"], rho)
exact = ca.nlpsol(
    "penalty", "ipopt", {"x": program["x"], "p": parameters, "f": penalised}, quiet(max_iter=500)
)
penalty_at = ca.Function(
    "values", [program["x"], parameters], [penalised, ca.gradient(penalised, program["x"])]
)
curvature = ca.Function("H", [program["x"], parameters], [ca.hessian(penalised, program["x"])[0]])
violation = ca.Function("c", [program["x"], program["p"]], [ca.mmax(ca.fabs(program["g"]))])


def by_cg(rho, budget=1000):
    """The unknowns after some iterations of conjugate gradients."""

    def loss_and_gradient(z):
        loss, gradient = penalty_at(z, np.append(y, rho))
        return float(loss), gradient.full().ravel()

    start = np.concatenate([[10.0, 1.0], y / PULL])
    options = {"maxiter": budget, "gtol": 1e-6}
    return minimize(loss_and_gradient, start, jac=True, method="CG", options=options).x


# %%
weights = np.geomspace(1e-2, 1e10, 7)
z = np.concatenate([(k_found, c_found), path / PULL])
found = {"exact minimum": [], "CG, 1000 iterations": []}
conditions = []
for weight in weights[::-1]:
    z = exact(x0=z, p=np.append(y, weight))["x"].full().ravel()
    for ends, at in zip(found.values(), (z, by_cg(weight)), strict=True):
        off = (at[:2] - (k_found, c_found)) / (k_error, c_error)
        ends.append((np.abs(off).max(), float(violation(at, y))))
    conditions.append(np.linalg.cond(curvature(z, np.append(y, weight)).full()))

# %%
figure, (first, second, third) = panels(3, sharex=True)
for (label, ends), colour in zip(found.items(), (BLUE, VERMILION), strict=True):
    off, violated = np.array(ends)[::-1].T
    first.loglog(weights, off, "o-", ms=3, lw=1.1, color=colour, label=label)
    second.loglog(weights, violated, "o-", ms=3, lw=1.1, color=colour, label=label)
first.axhline(1, color=BLACK, lw=0.6)
first.set_ylim(1e-6, 3e4)
third.loglog(weights, conditions[::-1], "o-", ms=3, lw=1.1, color=BLUE)
style_axes(first, "k, c: off the constrained answer", "ρ [1/N²]", "error bars")
style_axes(second, "Broken law of motion", "ρ [1/N²]", "largest |c| [N]")
style_axes(third, "Condition of the Hessian", "ρ [1/N²]", "condition number")
add_legend(second)
display(figure)

# %% [markdown]
# - **ρ small:** the path may disobey. It follows the noise, and the parameters pay for it.
# - **ρ large:** the exact minimum approaches the constrained answer — but the condition number
#   grows with ρ, and a method without second derivatives gets stuck: its path obeys the law of
#   motion better, with the *wrong* parameters.
# - **in between** lies a compromise of the two, and nothing in the data says where.
#
# So ρ is a *knob without a right position*. Hard constraints have no knob. They cost a linear
# system per iteration, but one so sparse that it is cheap. In the paper's Table I the penalty
# method ended at λ = 734 and μ = 183 Pa where the truth was 200 and 300.

# %%
best = min(found["CG, 1000 iterations"])
print(f"the best CG run is {best[0]:.0f} error bars off and leaves {best[1]:.1f} N unbalanced")
print(f"the spring itself never pulls with more than {STIFFNESS * PULL:.1f} N")
assert best[0] > 3

# %% [markdown]
# # 3 · The scheme is part of the model
#
# The paper uses **backward Euler**: force and velocity at the new time,
#
# $$c_t = f\Big(x_t, \frac{x_t - x_{t-1}}{\Delta t}\Big)
# - m\,\frac{x_t - 2x_{t-1} + x_{t-2}}{\Delta t^2} = 0.$$
#
# It is robust, and it *damps by itself*: a vibration of angular frequency $\omega$ loses energy as
# if its damping ratio were larger by about $\omega\Delta t/2$. At 10 ms our spring gets 0.1 from
# the scheme, five times its own 0.02. What will an honest fit do with that? It has only one knob:
# take the surplus away from $c$.


# %%
def euler_program(steps, dt):
    theta, Z, Y = ca.SX.sym("theta", 2), ca.SX.sym("z", steps), ca.SX.sym("y", steps)
    X = PULL * Z
    F = spring_force(X[1:], (X[1:] - X[:-1]) / dt, theta[0], theta[1])
    first = F[0] - MASS * (X[1] - X[0]) / dt**2
    others = F[1:] - MASS * (X[2:] - 2 * X[1:-1] + X[:-2]) / dt**2
    loss = ca.sumsqr((X - Y) / SIGMA)
    return {"x": ca.vertcat(theta, Z), "p": Y, "f": loss, "g": ca.vertcat(first, others)}


# %% [markdown]
# Perfect data this time, no noise: whatever is wrong now, the scheme did it.

# %%
steps_s = np.array([0.00125, 0.0025, 0.005, 0.01, 0.02])
by_scheme = {}
for name, build in (("backward Euler", euler_program), ("midpoint", spring_program)):
    by_scheme[name] = []
    for dt in steps_s:
        clean = nature(np.arange(round(1 / dt) + 1) * dt)
        scheme_solver = ca.nlpsol("s", "ipopt", build(len(clean), dt), quiet())
        by_scheme[name].append(identify(scheme_solver, clean, (30.0, 0.1))[0])
    by_scheme[name] = np.array(by_scheme[name])
    print(name, "c / truth:", (by_scheme[name][:, 1] / DAMPING).round(3))

# %%
figure, (left, right) = panels(2)
surplus = omega * steps_s / 2
for (name, found_by), colour in zip(by_scheme.items(), (VERMILION, BLUE), strict=True):
    left.semilogx(surplus, found_by[:, 1] / DAMPING, "o-", ms=4, color=colour, label=name)
    right.semilogx(surplus, found_by[:, 0] / STIFFNESS, "o-", ms=4, color=colour, label=name)
left.plot(surplus, 1 - surplus / zeta, "--", color=VERMILION, lw=0.8, label="1 − (ωΔt/2) / ζ")
left.set_ylim(-0.3, 1.4)
for axes, what in ((left, "c"), (right, "k")):
    axes.axhline(1, color=BLACK, lw=0.6)
    axes.axvline(zeta, color=BLACK, lw=0.6, ls=":")
    axes.set_xticks(surplus, [f"{number:g}" for number in surplus])
    axes.set_xticks([], minor=True)
    style_axes(axes, f"Identified {what}, perfect data", "ωΔt/2   (dotted: ζ)", f"{what} / truth")
    add_legend(axes)
display(figure)

# %% [markdown]
# As soon as the scheme damps more than the spring does, $c$ falls to its bound of zero. Then the
# stiffness has to give: 5 % at the largest step. No warning, no bad convergence: IPOPT is content.
# The **midpoint** scheme adds no damping at any step; it only swings too slowly, and that error
# falls with $\Delta t^2$.
#
# A remedy for any scheme: **substeps**, a grid finer than the camera's. Rule: solve again with
# twice as many; if the answer moves by more than its error bar, you needed them.

# %%
euler, midpoint = by_scheme["backward Euler"], by_scheme["midpoint"]
assert euler[3, 1] < 1e-3 * DAMPING  # at 10 ms
assert 1.04 < euler[4, 0] / STIFFNESS < 1.06  # at 20 ms
assert np.allclose(midpoint[:, 1], DAMPING, rtol=0.05)
assert np.isclose(midpoint[4, 0] - STIFFNESS, 4 * (midpoint[3, 0] - STIFFNESS), rtol=0.1)

# %% [markdown]
# # 4 · One tetrahedron
#
# Now a solid. A tetrahedron of soft sponge, 10 cm wide, is held at three corners; the fourth hangs
# free. Where the spring had one coordinate, the free corner has three, and the material has *two*
# moduli: $\mu$ resists shear, $\lambda$ resists a change of volume. (In engineers' terms:
# $E = \mu\frac{3\lambda+2\mu}{\lambda+\mu}$ and $\nu = \frac{\lambda}{2(\lambda+\mu)}$.)
#
# ## Energy
#
# Inside a tetrahedron the motion is affine, so one matrix tells it all: the **deformation
# gradient** $F$, which maps edges at rest to edges now. The Neo-Hookean energy per volume is
#
# $$\psi = \tfrac12\lambda(\ln J)^2 - \mu\ln J + \tfrac12\mu(\operatorname{tr}F^TF - 3),
# \qquad J = \det F.$$

# %%
SIDE, DENSITY, GRAVITY = 0.10, 300.0, 9.81  # m, kg/m³, m/s²
corners = SIDE * np.array(
    [[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(3) / 2, 0], [0.5, np.sqrt(3) / 6, -np.sqrt(2 / 3)]]
)
rest_edges = (corners[:3] - corners[3]).T  # columns: from the free corner to the held ones
volume = abs(np.linalg.det(rest_edges)) / 6
corner_mass = DENSITY * volume / 4

P, V = ca.SX.sym("P", 3, 4), ca.SX.sym("V", 3, 4)  # positions and velocities, one column a corner
lam, mu, gamma_r = ca.SX.sym("lam"), ca.SX.sym("mu"), ca.SX.sym("gamma_r")
F = (P[:, :3] - ca.repmat(P[:, 3], 1, 3)) @ np.linalg.inv(rest_edges)
log_j = ca.log(ca.det(F))
energy = volume * (lam * log_j**2 / 2 - mu * log_j + mu * (ca.sumsqr(F) - 3) / 2)
print(f"volume {1e6 * volume:.0f} cm³, {1e3 * corner_mass:.1f} g at each corner")

# %% [markdown]
# ## Energy → force → stiffness
#
# As for the spring: the force is the downhill slope of the energy, the stiffness
# $K = \partial^2\Psi/\partial x^2 = -\partial f_e/\partial x$ is its curvature. **Rayleigh
# damping** makes a friction force of it, $f_d = -\gamma_r K v$: what is stiff is damped.

# %%
elastic = -ca.gradient(energy, P)
stiffness = ca.hessian(energy, ca.vec(P))[0]
damping = -gamma_r * ca.reshape(stiffness @ ca.vec(V), 3, 4)

sponge = [lam, mu, gamma_r]
energy_at = ca.Function("energy", [P, *sponge], [energy])
force_at = ca.Function("force", [P, V, *sponge], [elastic + damping])
stiffness_at = ca.Function("stiffness", [P, *sponge], [stiffness])
print(f"the force is a graph of {force_at.n_instructions()} elementary operations")

# %% [markdown]
# Never trust a derivative you have not checked, not even a computer's. Central differences of the
# energy should give the force, those of the force the stiffness — up to $h^2$, and up to rounding
# when $h$ is tiny: the tell-tale V.

# %%
TRUTH = (200.0, 300.0, 0.009)  # λ Pa, μ Pa, γ_r s
still = np.zeros((3, 4))
bent = corners.T + 0.1 * SIDE * np.random.default_rng(2).normal(size=(3, 4))
direction = np.random.default_rng(3).normal(size=(3, 4))


def difference(function, h):
    """Central difference along the direction."""
    ahead, behind = function(bent + h * direction), function(bent - h * direction)
    return (np.array(ahead) - np.array(behind)) / (2 * h)


slope = -np.sum(force_at(bent, still, *TRUTH).full() * direction)
bend = -stiffness_at(bent, *TRUTH).full() @ direction.T.ravel()
sizes = np.geomspace(1e-9, 1e-3, 13)
slope_error = [abs(difference(lambda p: energy_at(p, *TRUTH), h) / slope - 1) for h in sizes]
bend_error = [
    np.linalg.norm(difference(lambda p: force_at(p, still, *TRUTH), h).T.ravel() - bend)
    / np.linalg.norm(bend)
    for h in sizes
]
slope_error = np.ravel(slope_error)
assert slope_error.min() < 1e-8
assert min(bend_error) < 1e-8

# %%
figure, axes = panels(1, width_mm=90)
axes.loglog(sizes, slope_error, "o-", ms=3, lw=1.1, color=BLUE, label="energy → force")
axes.loglog(sizes, bend_error, "o-", ms=3, lw=1.1, color=VERMILION, label="force → stiffness")
style_axes(axes, "Derivative against central differences", "step h [m]", "relative difference")
add_legend(axes)
display(figure)

# %% [markdown]
# The toolbox computes the same numbers for its meshes:

# %%
mesh = cs.TetMesh(corners, np.array([[0, 1, 2, 3]]))
body = cs.Body(mesh, "neo-hookean", density_kg_m3=DENSITY, damping="rayleigh")
moduli = {"lambda_pa": TRUTH[0], "mu_pa": TRUTH[1]}
assert np.allclose(body.elastic_force(bent.T, **moduli), force_at(bent, still, *TRUTH).full().T)
assert np.allclose(body.stiffness(bent.T, **moduli).toarray(), stiffness_at(bent, *TRUTH).full())

# %% [markdown]
# ## A sign to get right
#
# The paper defines $K = \partial f_e/\partial x$ and writes $f_d = -\gamma_r K v$. Read literally,
# that is $+\gamma_r\,\partial^2\Psi/\partial x^2\,v$: a friction that *pushes*. The sign is easily
# lost on paper and easily found by energy: a body that nobody drives may never gain any. Hold the
# three corners still, displace the fourth by 1 mm, let go, and add up
# $\Psi + \tfrac12 m |v|^2$.


# %%
def release(sign, steps=600, dt=0.0005):
    """Elastic and kinetic energy [J] of the released corner, damped by sign · γ_r K v."""
    at, speed, energies = corners[3] + [0.0006, 0.0, -0.0008], np.zeros(3), []
    for _ in range(steps):
        place, motion = corners.T.copy(), np.zeros((3, 4))
        place[:, 3], motion[:, 3] = at, sign * speed
        kinetic = corner_mass * speed @ speed / 2
        energies.append(float(energy_at(place, *TRUTH)) + kinetic)
        speed = speed + dt * force_at(place, motion, *TRUTH).full()[:, 3] / corner_mass
        at = at + dt * speed
    return np.array(energies)


right_sign, wrong_sign = release(+1), release(-1)
print(f"after 0.3 s: right sign ×{right_sign[-1] / right_sign[0]:.3f}", end=", ")
print(f"literal sign ×{wrong_sign[-1] / wrong_sign[0]:.0f}")
assert right_sign[-1] < 0.2 * right_sign[0]
assert wrong_sign[-1] > 5 * wrong_sign[0]

# %%
figure, axes = panels(1, width_mm=90)
clock = 0.0005 * np.arange(600)
for energies, colour, label in (
    (wrong_sign, VERMILION, r"$+\gamma_r\,\partial^2\Psi/\partial x^2\ v$, literal"),
    (right_sign, BLUE, r"$-\gamma_r\,\partial^2\Psi/\partial x^2\ v$"),
):
    axes.semilogy(clock, 1e6 * energies, color=colour, lw=1.1, label=label)
style_axes(axes, "Energy of a body nobody drives", "time [s]", "Ψ + kinetic energy [µJ]")
add_legend(axes)
display(figure)

# %% [markdown]
# ## Swing it
#
# A robot takes the three corners on a trip of 0.4 s, with a turn. "Nature" is this time an
# accurate integrator of SciPy's that knows nothing of our schemes. The sponge hangs at rest at
# first. The camera sees the free corner at 200 Hz, with 0.5 mm of noise.


# %%
def held_corners(t):
    """Positions (3, 3) of the held corners, one column each."""
    share = 1 - np.cos(2 * np.pi * 2.5 * t)
    turn = Rotation.from_rotvec([0.25 * share, 0.35 * np.sin(9 * t) * share, 0.0])
    return turn.apply(corners[:3]).T + np.outer([0.02, -0.015, 0.025], [share] * 3)


weight = np.array([0, 0, -corner_mass * GRAVITY])


def acceleration(t, state):
    """Rate of (position, velocity) of the free corner."""
    moved = (held_corners(t + 1e-6) - held_corners(t - 1e-6)) / 2e-6
    place = np.column_stack([held_corners(t), state[:3]])
    motion = np.column_stack([moved, state[3:]])
    force = force_at(place, motion, *TRUTH).full()[:, 3] + weight
    return np.concatenate([state[3:], force / corner_mass])


at_rest = root(lambda x: acceleration(0.0, np.append(x, np.zeros(3)))[3:], corners[3]).x
times = np.arange(81) * 0.005
true_path = solve_ivp(
    acceleration, (0, times[-1]), np.append(at_rest, np.zeros(3)), "DOP853", times, rtol=1e-8
).y[:3]
seen = true_path + 0.0005 * np.random.default_rng(4).normal(size=true_path.shape)

# %% [markdown]
# ## The program
#
# The same lines as for the spring, with a force of three components. Only the free corner is
# unknown; the grasped ones are where the robot says. One more equation: the sponge hangs at rest
# at the start, $f(x_0, 0) = 0$. The parameters enter by their logarithms: a step then means "so
# many per cent", for kilopascals as for milliseconds.


# %%
def sponge_program(times, sigma=0.0005):
    steps, dt = len(times), times[1] - times[0]
    q, Z, Y = ca.SX.sym("q", 3), ca.SX.sym("z", 3, steps), ca.SX.sym("y", 3, steps)
    theta = [ca.exp(q[i]) for i in range(3)]
    state = [ca.horzcat(held_corners(t), SIDE * Z[:, i]) for i, t in enumerate(times)]
    forces = [
        force_at((a + b) / 2, (b - a) / dt, *theta)[:, 3] + weight for a, b in pairwise(state)
    ]
    x, inertia = SIDE * Z, corner_mass / dt**2
    rows = [force_at(state[0], still, *theta)[:, 3] + weight]
    rows.append(forces[0] / 2 - inertia * (x[:, 1] - x[:, 0]))
    for i in range(2, steps):
        mean = (forces[i - 1] + forces[i - 2]) / 2
        rows.append(mean - inertia * (x[:, i] - 2 * x[:, i - 1] + x[:, i - 2]))
    loss = ca.sumsqr((x - Y) / sigma)
    return {"x": ca.vertcat(q, ca.vec(Z)), "p": ca.vec(Y), "f": loss, "g": ca.vertcat(*rows)}


sponge_nlp = sponge_program(times)
sponge_solver = ca.nlpsol("sponge", "ipopt", sponge_nlp, quiet())

# %%
start = np.concatenate([np.log([400.0, 150.0, 0.02]), seen.T.ravel() / SIDE])
since = perf_counter()
found = sponge_solver(x0=start, p=seen.T.ravel(), lbg=0, ubg=0)
took, stats = perf_counter() - since, sponge_solver.stats()
assert stats["success"]
sponge_z = found["x"].full().ravel()
print(f"{len(sponge_z)} unknowns, {stats['iter_count']} iterations, {took:.2f} s")

# %% [markdown]
# The error bars come from the null space, as before. It has three directions now: the sponge
# starts at rest, so its material alone decides its path.

# %%
sponge_rows = ca.jacobian(sponge_nlp["g"], sponge_nlp["x"])
sponge_jacobian = ca.Function("J", [sponge_nlp["x"]], [sponge_rows])
N = null_space(sponge_jacobian(sponge_z).full())
measured = SIDE * N[3:] / 0.0005
sponge_covariance = N[:3] @ np.linalg.inv(measured.T @ measured) @ N[:3].T
relative = np.sqrt(np.diag(sponge_covariance))
for i, name in enumerate(("λ", "μ", "γ_r")):
    value = np.exp(sponge_z[i])
    print(f"{name:4}{value:9.4g} ± {100 * relative[i]:.1f} %   truth {TRUTH[i]:g}")
assert np.all(np.abs(sponge_z[:3] - np.log(TRUTH)) < 4 * relative + 0.02)

# %%
figure, axes = panels(1, width_mm=120)
fitted = SIDE * sponge_z[3:].reshape(-1, 3).T
for i, colour in enumerate((BLUE, VERMILION, GREEN)):
    axes.plot(times, 1e3 * (seen[i] - corners[3, i]), ".", color=colour, ms=3)
    axes.plot(times, 1e3 * (fitted[i] - corners[3, i]), color=colour, lw=1.1, label="xyz"[i])
style_axes(axes, "The free corner: seen (dots) and fitted", "time [s]", "displacement [mm]")
add_legend(axes)
display(figure)

# %% [markdown]
# ## Its sparsity
#
# Blocks of 3 × 3 in place of single entries, the same band. With a mesh of $n$ nodes the blocks are
# $3n \times 3n$, and *they* are sparse too: a node's force depends on its neighbours only. (Why
# does $c_0$ not meet the third parameter, $\gamma_r$? Nothing moves at rest.)

# %%
short = sponge_program(times[:8])
pattern = ca.jacobian(short["g"], short["x"]).sparsity()
figure, axes = panels(1, height_mm=85, width_mm=100)
axes.spy(ca.DM(pattern, 1).full(), markersize=4, color=BLUE)
axes.axvline(2.5, color=VERMILION, lw=0.8)
for i in range(1, 8):
    axes.axhline(3 * i - 0.5, color="#B0B0B0", lw=0.4)
    axes.axvline(3 * i + 2.5, color="#B0B0B0", lw=0.4)
axes.set_xticks([1, *(3 * i + 4 for i in range(8))], ["θ", *(f"$x_{i}$" for i in range(8))])
axes.set_yticks([3 * i + 1 for i in range(8)], [f"$c_{i}$" for i in range(8)])
style_axes(axes, "Constraint Jacobian of eight timesteps")
axes.grid(False)
display(figure)

# %% [markdown]
# # 5 · The swinging cylinder
#
# A foam cylinder, 16 cm long, hangs from a robot's hand and is swung for 0.4 s; six markers,
# 0.5 mm of noise, 100 Hz. Its mesh has 84 nodes and 198 tetrahedra. The energy is the sum of the
# tetrahedra's energies, so forces and stiffnesses are sums too, and everything of section 4
# carries over. A **problem file** says what is held, what moves, what was seen:

# %%
FOLDER = PROBLEMS / "foam_cylinder"
print((FOLDER / "problem.toml").read_text())

# %%
problem = cs.Problem.read(FOLDER / "problem.toml")
cylinder = problem.experiments[0]
finished = cs.run(problem, "reduced-space")
solution, uncertainty = finished.solution, finished.uncertainty
assert solution.status.converged
assert uncertainty is not None
assert (len(problem.bodies[0].nodes_m), len(problem.bodies[0].cells)) == (84, 198)
print(solution.message, f"{solution.iterations} sweeps, {solution.timing.total:.1f} s")

# %% [markdown]
# ## Two ways to solve the same program
#
# `interior-point` gives the whole program to IPOPT, as we did. That is the reference; here it takes
# half a minute. `reduced-space` uses what we saw in the null space: *given θ, the equations of
# motion leave the path no freedom*. Linearise them,
#
# $$c + c_X\,\mathrm dX + c_\theta\,\mathrm d\theta = 0
# \;\Rightarrow\; \mathrm dX = \underbrace{-c_X^{-1}c}_{p} + \underbrace{-c_X^{-1}c_\theta}_{Z}\,
# \mathrm d\theta,$$
#
# and only four unknowns are left. $c_X$ is block-triangular in time, so $p$ and $Z$ cost one small
# factorisation per timestep. The optimum is the same.

# %%
CYLINDER_TRUTH = {
    "lambda_pa": 800.0,
    "mu_pa": 600.0,
    "gamma_r_s": 0.006,
    "gamma_m_1_s": 1.5,
}
exact_young, exact_poisson = engineering_moduli(800.0, 600.0)
CYLINDER_TRUTH |= {"young_pa": exact_young, "poisson": exact_poisson}


def table(estimates, truth=CYLINDER_TRUTH):
    """Print values, error bars and truths."""
    for name, estimate in estimates.items():
        bar = (
            "no error bar"
            if estimate.statistical_std_error is None
            else f"± {estimate.statistical_std_error:.2g}"
        )
        print(f"{name:12} {estimate.value:9.4g} {bar:12}  truth {truth[name]:g}")


table({**uncertainty.estimates, **uncertainty.derived})
for name, estimate in uncertainty.derived.items():
    assert abs(estimate.value - CYLINDER_TRUTH[name]) < 4 * (estimate.statistical_std_error or 0), (
        name
    )

# %%
figure, axes = panels(1, height_mm=58)
surface, moved = problem.bodies[0].mesh.surface, solution.positions_m[0]
every = np.linspace(0, len(moved) - 1, 6).astype(int)
for place, step in enumerate(every):
    x_mm, z_mm = 1e3 * moved[step][:, 0] + 205 * place, 1e3 * moved[step][:, 2]
    axes.triplot(x_mm, z_mm, surface, lw=0.3, color=SKY)
    held = prescribed_nodes(cylinder.grasps)
    axes.plot(x_mm[held], z_mm[held], ".", color=BLACK, ms=3)
sample_of = solution.collocation.substeps
for place, step in enumerate(every):
    marks = 1e3 * cylinder.markers.positions_m[round(step / sample_of)]
    axes.plot(marks[:, 0] + 205 * place, marks[:, 2], ".", color=VERMILION, ms=6)
    time_s = step * cylinder.timestep_s / sample_of
    axes.text(205 * place, 60, f"{time_s:.2f} s", ha="center", fontsize=7)
axes.set_aspect("equal")
axes.set_ylim(-200, 90)
style_axes(axes, "Seen from the side: mesh, held nodes (black), markers (orange)", "", "z [mm]")
axes.set_xticks([])
axes.grid(False)
display(figure)

# %%
seen_m, fitted_m, t_s = cylinder.markers.positions_m, solution.readings_m[0], cylinder.t_s
figure, axes = panels(3, sharex=True)
tip = cylinder.markers.names.index("tip_1")
for i, axis in enumerate(axes):
    axis.plot(t_s, 1e3 * seen_m[:, tip, i], ".", color=BLACK, ms=4, label="seen")
    axis.plot(t_s, 1e3 * fitted_m[:, tip, i], color=BLUE, lw=1.1, label="fitted")
    style_axes(axis, f"tip_1, {'xyz'[i]}", "time [s]", "position [mm]" if i == 0 else "")
add_legend(axes[0])
display(figure)

# %% [markdown]
# The fit leaves distances of $\sqrt3$ times the noise of a coordinate, as it should. And because a
# good fit can hide a broken model, every run simulates forward with the parameters found — with
# *another* integrator — and compares again:

# %%
rollout = finished.rollouts["swing"]
assert not isinstance(rollout, str), rollout
noise_mm = 1e3 * np.sqrt(3) * 0.0005
print(
    f"fit {1e3 * solution.rms_m:.3f} mm RMS, forward simulation {1e3 * rollout.rms_m:.3f} mm RMS,",
    end=" ",
)
print(f"√3 · noise {noise_mm:.3f} mm; law of motion broken by {solution.max_violation_n:.1e} N")
assert abs(1e3 * solution.rms_m / noise_mm - 1) < 0.1
assert rollout.rms_m < 1.1 * solution.rms_m

# %% [markdown]
# The Jacobian has the picture of the tetrahedron's: four dense columns, a band of blocks, and in
# each block the graph of the mesh.

# %%
collocation = solution.collocation
width, height = (
    3 * len(problem.bodies[0].nodes_m),
    collocation.transcriptions[0].constraints_per_time,
)
jacobian = collocation.jacobian(solution.z)
figure, (left, right) = panels(2, height_mm=80)
left.spy(jacobian[: 4 * height, : 4 + 4 * width], markersize=0.25, color=BLUE, aspect="auto")
style_axes(left, "The first four timesteps", "θ (at the far left) and node positions", "motion")
right.spy(jacobian[:height, 4 : 4 + width], markersize=0.6, color=BLUE, aspect="auto")
style_axes(right, "One block: who pulls on whom", "node positions", "motion")
for axes in (left, right):
    axes.xaxis.set_ticks_position("bottom")
    axes.grid(False)
    axes.spines[:].set_visible(True)
rows, columns = collocation.constraint_count, collocation.variable_count
print(f"{rows} × {columns}, of which {100 * jacobian.nnz / rows / columns:.2f} % are not zero")
display(figure)

# %% [markdown]
# ## The scheme again
#
# Section 3 with a real body: backward Euler on the camera's grid of 10 ms against midpoint.


# %%
def fit(experiment, parameters=problem.parameters, scheme="midpoint", substeps=2):
    """The solution by reduced space, and the linear problem near it."""
    program = cs.Collocation([experiment], parameters, scheme, substeps)
    found = ReducedSpace()(program)
    assert found.status.converged, found.message
    return found, linearise_fit(found.collocation, found.z)


print("                    E Pa      ν      γ_r s   γ_m 1/s   RMS mm")
schemes = {}
for scheme, substeps in (("backward-euler", 1), ("backward-euler", 4), ("midpoint", 2)):
    found, _ = fit(cylinder, scheme=scheme, substeps=substeps)
    lambda_pa, mu_pa, gamma_r, gamma_m = found.theta
    young, poisson = engineering_moduli(lambda_pa, mu_pa)
    schemes[scheme, substeps] = young, gamma_r, gamma_m
    print(f"{scheme:15}×{substeps}{young:9.0f}{poisson:8.3f}", end="")
    print(f"{gamma_r:10.5f}{gamma_m:9.3f}{1e3 * found.rms_m:9.2f}")
print(f"{'truth':16}{exact_young:10.0f}{exact_poisson:8.3f}{0.006:10.5f}{1.5:9.3f}{noise_mm:9.2f}")

# %%
young, gamma_r, gamma_m = schemes["backward-euler", 1]
assert gamma_r < 2e-5  # both dampings at their lower bounds
assert gamma_m < 2e-3
assert abs(young / exact_young - 1) > 0.02
_, _, gamma_m = schemes["midpoint", 2]
assert abs(gamma_m / 1.5 - 1) < 0.1

# %% [markdown]
# At 10 ms backward Euler damps so much that *both* dampings end at their lower bounds, and $E$ and
# $\nu$ shift to save what they can. The RMS is the only witness: twice the noise. With four
# substeps the stiffness is nearly right, the damping $\gamma_r$ still is not — and now the RMS says
# nothing.

# %% [markdown]
# # 6 · What data can and cannot tell
#
# ## Some combinations are known better than their parts
#
# λ is known to 4 %, μ to 0.7 %, and yet $E$, made of both, to 0.3 %. The errors of λ and μ are
# *correlated*: a swinging slender body mostly bends, bending feels $E$, and many pairs (λ, μ) have
# nearly the same $E$. How the cross-section thins — that is ν — shows only in small side motions.

# %%
values = solution.parameters
lame = np.array([values["lambda_pa"], values["mu_pa"]])
lame_covariance = uncertainty.covariance[:2, :2] * np.outer(lame, lame)
per_cent = 100 * np.sqrt(np.diag(uncertainty.covariance)[:2])
young_found = uncertainty.derived["young_pa"]
assert np.allclose(per_cent, [3.8, 0.7], atol=0.3)
assert (young_found.statistical_std_error or 0) < 0.004 * young_found.value

# %%
lambdas = np.linspace(650, 900, 50)
mus = np.linspace(580, 650, 50)
first, second = np.meshgrid(lambdas, mus)
young = second * (3 * first + 2 * second) / (first + second)

figure, (left, right) = panels(2)
levels = np.arange(1475, 1700, 25)
at_right = (levels - 2610 + np.sqrt((2610 - levels) ** 2 + 8 * 870 * levels)) / 4  # μ at λ = 870
places = [(870, place) for place in at_right if 582 < place < 648]
lines = left.contour(lambdas, mus, young, levels, colors="#909090", linewidths=0.6)
left.clabel(lines, fmt="E = %.0f Pa", fontsize=6, manual=places)
left.plot(*ellipse(lame, lame_covariance).T, color=BLUE, lw=1.2, label="95 % region")
left.plot(*lame, "o", color=BLUE, ms=4, label="answer")
left.plot(800, 600, "+", color=VERMILION, ms=10, mew=1.5, label="truth")
style_axes(left, "λ and μ err nearly along a line of constant E", "λ [Pa]", "μ [Pa]")
add_legend(left)
names = [r"$\lambda$", r"$\mu$", r"$\gamma_r$", r"$\gamma_m$"]
image = right.imshow(uncertainty.correlation, vmin=-1, vmax=1, cmap="RdBu_r")
for (i, j), value in np.ndenumerate(uncertainty.correlation):
    ink = "white" if abs(value) > 0.6 else "black"
    right.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=7, color=ink)
style_axes(right, "Correlation of the errors")
right.grid(False)
right.set_xticks(range(4), names)
right.set_yticks(range(4), names)
display(figure)
for sentence in finished.all_notes:
    print("·", sentence)

# %% [markdown]
# The two dampings are as entangled: at *one* frequency only $\zeta = \gamma_r\omega/2 +
# \gamma_m/2\omega$ can be seen. It takes motion at two frequencies to tell them apart.
#
# ## A poor experiment, and the profile likelihood
#
# Keep one marker in the middle of the body, and make the camera six times worse. An error bar
# assumes that the loss is a parabola in the logarithm. The **profile likelihood** assumes nothing:
# hold ν at a value, fit everything else, and see how much the loss rises. Where it has risen by
# 3.84 the 95 % interval ends.

# %%
markers, rng = cylinder.markers, np.random.default_rng(0)
only = np.array(markers.names) == "middle_1"
worse = seen_m + rng.normal(size=seen_m.shape) * np.sqrt(0.003**2 - 0.0005**2)
poor = replace(
    cylinder,
    markers=replace(
        markers,
        positions_m=np.where(only[:, None], worse, np.nan),
        sigma_m=np.full(len(only), 0.003),
    ),
)
engineering = Parameters(
    (
        Parameter("young_pa", 1000.0, 10.0, 1e6),
        Parameter("poisson", 0.3, 0.02, 0.48),
        *problem.parameters.items[2:],
    )
)
poor_solution, poor_fit = fit(poor, engineering, substeps=1)  # its noise hides the step's error
poor_uncertainty = uncertainty_from_fit(poor_fit, engineering, poor_solution.q)
table(poor_uncertainty.estimates)

# %%
profile = profile_of_solution(poor_solution, poor_fit, poor_uncertainty, "poisson")
print(profile.message)

# %%
figure, axes = panels(1, width_mm=110)
rise = profile.losses - profile.losses.min()
best, deviation = poor_solution.parameters["poisson"], np.sqrt(poor_uncertainty.covariance[1, 1])
nu = np.linspace(profile.values.min(), profile.values.max(), 100)
axes.plot(nu, (np.log(nu / best) / deviation) ** 2, "--", color=ORANGE, label="parabola in ln ν")
axes.plot(profile.values, rise, "o-", color=BLUE, ms=4, lw=1.1, label="profile")
axes.axhline(profile.threshold, color=BLACK, lw=0.6, label="3.84: end of the 95 % interval")
axes.axvline(exact_poisson, color=VERMILION, lw=0.8, ls=":", label="truth")
axes.set_ylim(0, 16)
style_axes(axes, "Poisson's ratio from one bad marker", "ν", "rise of the loss")
add_legend(axes)
display(figure)
low, high = profile.interval
assert low is not None
assert high is not None
assert low < exact_poisson < high

# %% [markdown]
# The loss is far from a parabola: downwards ν is almost free, upwards it ends where the foam would
# become hard to compress. $E$ is still known to some per cent, ν could be nearly anything. No
# solver will repair that: the information is not in the data. What helps is a better experiment —
# more markers, motion that twists and shears — or a value of ν from elsewhere, as a prior or fixed.
#
# ## A marker that sits elsewhere
#
# Let `tip_1` be seen 4 mm beside the place that the problem file says. The fit cannot know; it
# bends the material to explain the geometry. Unless the offset is an unknown too (with a prior of
# 5 mm, say).

# %%
shifted = seen_m.copy()
shifted[:, tip, 0] += 0.004
wrong = replace(cylinder, markers=replace(markers, positions_m=shifted))
aware = replace(wrong, nuisance=Nuisance.none(camera_offset_m=0.005))
offsets = {}
for name, experiment in (("as told", wrong), ("offset estimated", aware)):
    found, local = fit(experiment)
    bars = uncertainty_from_fit(
        local, problem.parameters, found.q, ErrorModel("given", "independent")
    )
    offsets[name] = np.log(list(found.parameters.values())), np.sqrt(np.diag(bars.covariance))
    print(f"{name}: RMS {1e3 * found.rms_m:.2f} mm")
    table(bars.estimates)
first_unknown = 0.005 * found.collocation.iterates(found.z)[0].phi[3 * tip]
print(f"estimated offset of tip_1 along x: {1e3 * first_unknown:.2f} mm (truth 4)")
assert abs(first_unknown - 0.004) < 0.0005

# %%
figure, axes = panels(1, width_mm=120)
truth_q = np.log(list(CYLINDER_TRUTH.values())[:4])
for shift, colour, (name, (q, deviations)) in zip(
    (-0.1, 0.1), (VERMILION, BLUE), offsets.items(), strict=True
):
    error, bar = 100 * (q - truth_q), 196 * deviations
    axes.errorbar(np.arange(4) + shift, error, bar, fmt="o", color=colour, ms=4, label=name)
axes.axhline(0, color=BLACK, lw=0.6)
axes.set_xticks(range(4), names)
style_axes(axes, "A marker 4 mm off: error and 95 % error bar", "", "error [%]")
add_legend(axes)
display(figure)

# %% [markdown]
# Told the wrong place, both dampings are off by five standard errors. Only a small error bar that
# is wrong is worse than a large one. The RMS gives it away, and the toolbox looks at the residuals
# of every marker:

# %%
off = np.abs(offsets["as told"][0] - truth_q) / offsets["as told"][1]
assert (off[2:] > 4).all()
_, local = fit(wrong)
print(diagnose_markers(local)[tip].sentence)

# %% [markdown]
# ## Noise with a memory
#
# Camera noise forgets from one frame to the next. Other errors do not: a soft marker base, a
# calibration, a model that is not quite right. If each error is $\varphi$ times the last plus
# something new, 100 samples are not 100 independent witnesses. On the spring the true covariance is
# simple: an estimate is a linear map $A$ of the noise, so $\operatorname{cov} = A\,\Sigma A^T$.

# %%
N = null_space(constraint_jacobian(np.concatenate([(k_found, c_found), path / PULL]), path).full())
A = N[:2] @ np.linalg.pinv(PULL * N[2:])
memory = np.array([0.0, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95])
widening = []
for phi in memory:
    noise_covariance = SIGMA**2 * toeplitz(phi ** np.arange(len(t)))
    widening.append(np.sqrt(np.diag(A @ noise_covariance @ A.T)) / (k_error, c_error))

figure, axes = panels(1, width_mm=90)
for factors, name, colour in zip(np.transpose(widening), "kc", (BLUE, VERMILION), strict=True):
    axes.plot(memory, factors, "o-", ms=4, lw=1.1, color=colour, label=name)
axes.axhline(1, color=BLACK, lw=0.6)
style_axes(axes, "How much too small the error bars are", "memory φ of the noise", "true / assumed")
axes.set_ylim(bottom=0)
add_legend(axes)
display(figure)
assert np.allclose(widening[0], 1)
assert np.max(widening) > 2

# %% [markdown]
# Same size of noise, and the error bars are too small by more than two. (Beyond φ = 0.8 it gets
# better again: noise that slow no longer looks like a swing of 3 Hz.) The toolbox therefore tests
# the residuals for memory, and widens the error bars when it finds some. On the cylinder:

# %%
phi = 0.9
fresh = 0.001 * np.sqrt(1 - phi**2) * np.random.default_rng(5).normal(size=(300, *seen_m.shape[1:]))
slow = lfilter([1], [1, -phi], fresh, axis=0)[-len(t_s) :]
drifting = replace(
    cylinder, markers=replace(markers, positions_m=seen_m + slow, sigma_m=np.full(6, 0.00112))
)
found, local = fit(drifting)
for errors in ("independent", "auto"):
    bars = uncertainty_from_fit(local, problem.parameters, found.q, ErrorModel(errors=errors))
    print(f"errors = {errors!r} → {bars.errors}")
    table(bars.estimates)
print("\n".join(bars.notes))
assert bars.errors == "autocorrelated"

# %% [markdown]
# ## Another motion tells something else
#
# The motion is yours to choose. `collocation-sysid design` looks for the one whose recording makes
# the error bars smallest within a robot's limits, for all parameters or for some (`--for poisson`).
# For this cylinder, in two seconds and at most 15 m/s², it found two that differ: *the motion for
# $\nu$ shakes the hand by a few centimetres at 3 Hz, where the cylinder's bending is resonant, and
# hardly turns it; the one for the two dampings swings it at about 1 Hz through half a metre, at up
# to 1.4 m/s, and turns it by up to 80°.* The first tells $\nu$ to 0.34 % and the dampings to 0.30
# and 0.46 %, the second $\nu$ to 0.65 % and the dampings to 0.17 and 0.21 %.

# %% [markdown]
# # 7 · Bring your own data
#
# You need three files and a description:
#
# | file | what |
# |---|---|
# | mesh | tetrahedra at rest, any format meshio reads (or a closed surface scan) |
# | poses | `t_s,x_m,y_m,z_m,qx,qy,qz,qw`: undeformed to current position of what is held |
# | markers | `t_s,<name>_x,<name>_y,<name>_z,…`, blank where not seen; or C3D, TRC, … |
#
# On the command line:
#
#     collocation-sysid new my_object                     # a commented problem file
#     collocation-sysid check my_object/problem.toml      # look before you solve
#     collocation-sysid solve my_object/problem.toml
#
# The same from Python. Here the cylinder's files stand in for yours.

# %%
MY_PROBLEM = """
title = "My object"

[object]
mesh = "mesh.vtu"
mass_kg = 0.012
material = "neo-hookean"
damping = "rayleigh"

[parameters]
young_pa    = { guess = 1000.0, lower = 10.0, upper = 1e6 }
poisson     = { guess = 0.3, lower = 0.02, upper = 0.48 }
gamma_r_s   = { guess = 0.01, lower = 1e-5, upper = 1.0 }
gamma_m_1_s = { guess = 1.0, lower = 1e-3, upper = 100.0 }

[environment]
air_density_kg_m3 = "none"            # simulated without air

[[experiment]]
name = "swing"
nuisance = "none"                     # simulated: clock, gravity, grasp and places are exact
start = "equilibrium"
gravity_m_s2 = [0.0, 0.0, -9.81]
grasp = { nodes = { box_m = [[-1, -1, -0.001], [1, 1, 0.001]] }, poses = "poses.csv" }

[experiment.markers]
file = "markers.csv"
sigma_m = 0.0005
[experiment.markers.reference_m]      # where they are glued on the body at rest
tip_1    = [0.03, 0, 0.16]
tip_2    = [-0.015, 0.025981, 0.16]
tip_3    = [-0.015, -0.025981, 0.16]
middle_1 = [-0.03, 0, 0.087273]
middle_2 = [0.015, 0.025981, 0.087273]
middle_3 = [0.015, -0.025981, 0.087273]

[transcription]
scheme = "midpoint"
substeps = 2
"""
desk = TemporaryDirectory()
mine = Path(desk.name)
for mine_name, name in (
    ("mesh.vtu", "foam_cylinder.vtu"),
    ("poses.csv", "swing_poses.csv"),
    ("markers.csv", "swing_markers.csv"),
):
    copyfile(FOLDER / name, mine / mine_name)

# %% [markdown]
# Mistakes are answered with file, key, what was found and what was expected:

# %%
typo = MY_PROBLEM.replace("mass_kg = 0.012", "mass_g = 12")
(mine / "problem.toml").write_text(typo)
try:
    cs.Problem.read(mine / "problem.toml")
except cs.InputError as error:
    print(str(error).replace(str(mine), "."))

# %% [markdown]
# **Check** before you solve: sizes, where the markers ended up on the body, whether the grid can
# follow its vibrations, and what is likely to go wrong. (The advice on elements is good, and does
# not matter here only because the data come from the same coarse mesh.)

# %%
(mine / "problem.toml").write_text(MY_PROBLEM)
my_problem = cs.Problem.read(mine / "problem.toml")
findings = check_problem(my_problem)
(body,) = findings.bodies
print(f"{body.nodes} nodes, {body.elements} elements, {findings.timesteps} timesteps")
print(f"{findings.variables} unknowns, {findings.jacobian_nonzeros} nonzeros in the Jacobian")
print(f"derivatives agree with differences: {findings.derivatives_agree}")
print(f"farthest marker from the body: {1e3 * findings.largest_marker_distance_m:.1f} mm")
for sentence in (*findings.notes, *findings.warnings):
    print("·", sentence)

# %% [markdown]
# **Solve**, and keep everything in a run folder: `result.json`, plots, the trajectory, frames for
# ParaView.

# %%
my_run = cs.run(my_problem)
assert my_run.uncertainty is not None
table({**my_run.uncertainty.estimates, **my_run.uncertainty.derived})
my_run.save(mine / "run")
print("run/:", ", ".join(sorted(path.name for path in (mine / "run").iterdir())))

# %%
for sentence in my_run.all_notes:
    print("·", sentence)

# %% [markdown]
# Before you believe a number, ask in this order:
#
# 1. Is the RMS the size of the camera's noise? If it is larger, the model lacks something.
# 2. Does the answer stay put with twice the substeps, and with a finer mesh or `tet10` elements?
#    (Linear tetrahedra are too stiff in bending, and near ν = 0.5 they lock.)
# 3. Are the residuals white? Does a held-out recording (`validation = true`) fit as well?
# 4. Then, and only then: how large are the error bars, and what is confounded with what?

# %% [markdown]
# # Exercises
#
# Solutions follow in the last section, their code folded.
#
# 1. **No damping of its own.** Put $x_t = z^t$ into the midpoint rows of an undamped spring and
#    show that $|z| = 1$ at any step. What is $|z|$ for backward Euler?
# 2. **Fewer samples.** Half of the spring's film is lost. Is it worse to lose every other frame or
#    the second half? Guess first, for $k$ and for $c$.
# 3. **A spring that hardens.** Add $\tfrac14 k_3 x^4$ to the energy, make data with
#    $k_3 = 4000\ \mathrm{N/m^3}$, and identify $k$, $c$, $k_3$. How well would you know $k_3$ from
#    a pull of 10 mm instead of 50?
# 4. **Turning is not stretching.** Turn the tetrahedron by 30° without deforming it. Which energy
#    does it have with the material `neo-hookean`, which with `linear`? When may one use the latter?
# 5. **Enough substeps?** Solve the cylinder with midpoint and 1, 2 and 4 substeps. Is 2 enough?
# 6. **One marker only.** Which one would you keep to learn $E$? Which for ν? (All you need is in
#    `linearised_fit`: residual slopes by parameter, marker by marker.)
# 7. **Where are the markers?** Delete `reference_m` from your problem file: the places become
#    unknowns, started from the first samples. What do the RMS and the error bars say, and what was
#    it that the ruler told?
#
# # Solutions
#
# **1.** With $h = \omega\Delta t$ midpoint gives
# $(z-1)^2 + \tfrac{h^2}{4}(z+1)^2 = 0$: both roots on the unit circle. Backward Euler gives
# $(1+h^2)z^2 - 2z + 1 = 0$, $|z| = 1/\sqrt{1+h^2} \approx 1 - h^2/2$: a damping ratio of $h/2$.

# %% jupyter={"source_hidden": true}
for h in (0.05, 0.2, 1.0):
    midpoint_roots = np.roots([1 + h**2 / 4, -2 + h**2 / 2, 1 + h**2 / 4])
    euler_roots = np.roots([1 + h**2, -2, 1])
    print(f"h = {h:4}: |z| midpoint {abs(midpoint_roots[0]):.6f}, Euler {abs(euler_roots[0]):.4f}")
    assert np.allclose(abs(midpoint_roots), 1)
    assert np.allclose(abs(euler_roots), 1 / np.sqrt(1 + h**2))

# %% [markdown]
# **2.** Every other frame: $\sqrt2$ for both. The second half is worth more, because a small error
# of the frequency grows with time, and so does the loss of amplitude: $k$ suffers more.

# %% jupyter={"source_hidden": true}
costs = {}
for name, kept in (("every other frame", np.arange(len(t)) % 2 == 0), ("first half", t <= 0.5)):
    rows = PULL * N[2:][kept] / SIGMA
    lost = np.sqrt(np.diag(N[:2] @ np.linalg.inv(rows.T @ rows) @ N[:2].T)) / (k_error, c_error)
    print(f"{name:18}: error bar of k × {lost[0]:.2f}, of c × {lost[1]:.2f}")
    costs[name] = lost
assert np.allclose(costs["every other frame"], np.sqrt(2), rtol=0.05)
assert costs["first half"][0] > costs["first half"][1] > 2

# %% [markdown]
# **3.** One more term in the energy, nothing else changes. The cubic force is
# $k_3x^2/k = 25\,\%$ of the linear one at 50 mm and 1 % at 10 mm, where it drowns.


# %% jupyter={"source_hidden": true}
def hardening(pull, k3=4000.0):
    """Relative deviations of (k, c, k3) and the values, from one film."""
    film = np.arange(201) * 0.005
    swing = solve_ivp(
        lambda _, s: [s[1], (-STIFFNESS * s[0] - k3 * s[0] ** 3 - DAMPING * s[1]) / MASS],
        (0, 1), [pull, 0.0], "DOP853", film, rtol=1e-9, atol=1e-12,
    ).y[0]  # fmt: skip
    filmed = swing + SIGMA * np.random.default_rng(6).normal(size=len(film))
    theta, Z = ca.SX.sym("theta", 3), ca.SX.sym("z", len(film))
    X, scale = pull * Z, ca.DM([10.0, 0.1, 1000.0])
    stiff, damp, cubic = ca.vertsplit(theta * scale)
    middle, speed = (X[1:] + X[:-1]) / 2, (X[1:] - X[:-1]) / 0.005
    pulls = -stiff * middle - cubic * middle**3 - damp * speed
    rows = (pulls[1:] + pulls[:-1]) / 2 - MASS * (X[2:] - 2 * X[1:-1] + X[:-2]) / 0.005**2
    start = pulls[0] / 2 - MASS * (X[1] - X[0]) / 0.005**2
    unknowns, rows = ca.vertcat(theta, Z), ca.vertcat(start, rows)
    nlp = {"x": unknowns, "f": ca.sumsqr((X - filmed) / SIGMA), "g": rows}
    guess = np.concatenate([[3.0, 1.0, 1.0], filmed / pull])
    z = ca.nlpsol("s", "ipopt", nlp, quiet())(x0=guess, lbg=0, ubg=0)["x"]
    free = null_space(ca.Function("J", [unknowns], [ca.jacobian(rows, unknowns)])(z).full())
    seen = pull * free[3:] / SIGMA
    spread = np.sqrt(np.diag(free[:3] @ np.linalg.inv(seen.T @ seen) @ free[:3].T))
    return z[:3].full().ravel() * scale.full().ravel(), spread * scale.full().ravel()


for pull in (0.05, 0.01):
    (_, _, k3_found), (_, _, k3_bar) = hardening(pull)
    assert abs(k3_found - 4000) < 4 * k3_bar
    print(f"pulled by {1e3 * pull:.0f} mm: k₃ = {k3_found:.0f} ± {k3_bar:.0f} N/m³")

# %% [markdown]
# **4.** Turning costs nothing with `neo-hookean`: $F^TF$ does not see a rotation. `linear` uses
# $\operatorname{sym}F - I$, which is not zero for a rotation. It may be used only where nothing
# turns by more than a few degrees — never for a swung body.

# %% jupyter={"source_hidden": true}
turned = Rotation.from_rotvec([0, np.pi / 6, 0]).apply(corners)
works_j = {}
for material in ("neo-hookean", "linear"):
    at_work = cs.Body(mesh, material, density_kg_m3=DENSITY).energy(turned, **moduli)
    works_j[material] = float(at_work)
    print(f"{material:12}: {1e3 * works_j[material]:.3g} mJ")
assert abs(works_j["neo-hookean"]) < 1e-12
assert works_j["linear"] > 1e-3

# %% [markdown]
# **5.** From 1 to 2 substeps μ moves by three error bars, from 2 to 4 by one (and from there to ∞
# by a third of one, as the error falls with $\Delta t^2$). So 1 is too few, and who quotes error
# bars this small should take 4.

# %% jupyter={"source_hidden": true}
bars = np.sqrt(np.diag(uncertainty.covariance))
answers = {count: fit(cylinder, substeps=count)[0].q for count in (1, 2, 4)}
for few, many in ((1, 2), (2, 4)):
    moved = (answers[many] - answers[few]) / bars
    print(f"{few} → {many} substeps: (λ, μ, γ_r, γ_m) move by {moved.round(2)} error bars")
assert np.all(np.abs(answers[4] - answers[2]) < 1.5 * bars)

# %% [markdown]
# **6.** Take only one marker's rows of the slopes. The tips tell more of both: they move most.

# %% jupyter={"source_hidden": true}
_, local = fit(cylinder, engineering)
(block,) = local.blocks
alone = {}
for i, name in enumerate(block.marker_names):
    slopes = block.jacobian[:, i].reshape(-1, 4)
    for_young, for_poisson, *_ = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    print(f"{name:9}: E to {100 * for_young:.2f} %, ν to {100 * for_poisson:.1f} %")
    alone[name] = for_young, for_poisson
tips, middles = ([alone[f"{place}_{i}"] for i in (1, 2, 3)] for place in ("tip", "middle"))
assert np.all(np.max(tips, axis=0) < np.min(middles, axis=0))

# %% [markdown]
# **7.** The places become unknowns, and the fit finds them: the RMS is that of the noise, and the
# truth is within the error bars. But these are wider. How far the body sags is no longer seen, as
# nobody knows where the markers were before; only how it swings is.
#
# The cure is to measure better than the fit does by itself. It finds the places to some tenths of
# a millimetre, so `reference_sigma_m = 0.001`, places from a ruler that are good to 1 mm and still
# estimated, adds nothing (try it); those from a caliper, `reference_sigma_m = 0.0001`, do, and one
# that was read a little wrongly no longer falsifies the answer.

# %% jupyter={"source_hidden": true}
first, last = MY_PROBLEM.index("[experiment.markers.ref"), MY_PROBLEM.index("[transcription]")
no_ruler = MY_PROBLEM[:first] + MY_PROBLEM[last:]
spread = {}
sigma = "sigma_m = 0.0005\n"
measured = MY_PROBLEM.replace(sigma, sigma + "reference_sigma_m = 0.0001\n")
texts = {"exactly known": MY_PROBLEM, "to 0.1 mm": measured, "not known": no_ruler}
for name, text in texts.items():
    (mine / "problem.toml").write_text(text)
    loaded = cs.Problem.read(mine / "problem.toml")
    found, local = fit(loaded.experiments[0], loaded.parameters)
    bars = uncertainty_from_fit(local, loaded.parameters, found.q, ErrorModel(errors="independent"))
    spread[name] = np.sqrt(np.diag(bars.covariance))
    print(f"places {name}: RMS {1e3 * found.rms_m:.2f} mm")
    table(bars.estimates)
    assert 1e3 * found.rms_m < 1.05 * noise_mm
young = [spread[name][0] for name in texts]
assert young[0] < young[1] < young[2]
desk.cleanup()
