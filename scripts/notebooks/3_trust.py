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
# # 3 · Trust
#
# Tutorial on direct collocation, part 3 of 4. Previous part: [2 · Cylinder](2_cylinder.ipynb)
#
# This part examines the uncertainty of the parameters that part 2 estimated from the recording of a
# swinging foam cylinder.
#
# **You will learn** how
#
# - correlated errors make combinations of parameters more accurate than the parameters;
# - a profile likelihood gives an interval if the loss is not quadratic;
# - to detect and estimate a wrong marker position;
# - autocorrelated noise increases the standard errors;
# - the combined interval and the verdict of a run are formed from noise and systematic effects.
#
# **Prerequisites:** part 2; normal distribution, covariance matrix, linear least squares.
#
# **Time:** about 30 minutes of reading; the cells run in about one and a half minutes (measured:
# 71 to 98 s on two cores that other programs used too).

# %%
# %matplotlib inline
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from scipy.linalg import toeplitz
from scipy.signal import lfilter

import collocation_sysid as cs

BLUE = "#0072B2"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
VERMILION = "#D55E00"
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

# %% [markdown]
# ## 3.1 Correlation of the estimates
#
# The next cell repeats the run of part 2. The data are synthetic, so that the true values can be
# listed for comparison. The printed standard errors are statistical: they describe the effect of
# the noise only. Systematic effects are excluded until section 3.6, because the data are simulated
# without them.

# %%
TRUE_VALUES = {
    "lambda_pa": 800.0,
    "mu_pa": 600.0,
    "gamma_r_s": 0.006,
    "gamma_m_1_s": 1.5,
    "young_pa": 600.0 * (3 * 800.0 + 2 * 600.0) / (800.0 + 600.0),
    "poisson": 800.0 / (2 * (800.0 + 600.0)),
}


def statistical_error(run, name):
    """Return the statistical standard error of an estimate; NaN if it is not identified."""
    error = run.estimates[name].statistical_std_error
    return np.nan if error is None else error


def print_estimates(run):
    """Print the estimates of a run with their statistical standard errors, and the true values."""
    for name, estimate in run.estimates.items():
        error = statistical_error(run, name)
        text = "not identified" if np.isnan(error) else f"± {error:.2g}"
        print(f"{name:12}{estimate.value:10.4g} {text:15} true value {TRUE_VALUES[name]:.4g}")


described = cs.Problem.read(cs.datasets.fetch("foam_cylinder") / "problem.toml")
exact = replace(described.uncertainty, assumptions=cs.Assumptions.exact())
problem = replace(described, uncertainty=exact)
cylinder = problem.experiments[0]
markers = cylinder.markers
measured_m = markers.positions_m
run = cs.run(problem, "reduced-space")
uncertainty = run.uncertainty
assert uncertainty is not None
print_estimates(run)

# %% [markdown]
# The relative standard errors of λ and μ are 4 % and 0.7 %, but that of Young's modulus $E$, a
# function of both, is only 0.3 %. The errors of λ and μ are *correlated*: a slender body in this
# motion mainly bends, its bending stiffness is proportional to $E$, and many pairs (λ, μ) have
# nearly the same $E$. Poisson's ratio ν affects only the small lateral deformations.

# %%
moduli = np.array([run.solution.parameters[name] for name in ("lambda_pa", "mu_pa")])
# `covariance` is that of the logarithms of the parameters.
moduli_covariance = uncertainty.covariance[:2, :2] * np.outer(moduli, moduli)
relative_errors = np.sqrt(np.diag(uncertainty.covariance))
young_error = statistical_error(run, "young_pa") / run.estimates["young_pa"].value
print(f"relative standard errors of λ and μ: {(100 * relative_errors[:2]).round(2)} %")
print(f"relative standard error of E: {100 * young_error:.2f} %")
assert np.allclose(100 * relative_errors[:2], [3.8, 0.7], atol=0.3)
assert young_error < 0.004


# %%
def ellipse(mean, covariance, deviations=2.448):
    """Return points (100, 2) on the 95 % region of a bivariate normal distribution."""
    angle = np.linspace(0, 2 * np.pi, 100)
    circle = np.array([np.cos(angle), np.sin(angle)])
    return (np.array(mean)[:, None] + deviations * np.linalg.cholesky(covariance) @ circle).T


SYMBOLS = [r"$\lambda$", r"$\mu$", r"$\gamma_r$", r"$\gamma_m$"]
lambda_grid, mu_grid = np.meshgrid(np.linspace(650, 900, 50), np.linspace(580, 650, 50))
young_grid = mu_grid * (3 * lambda_grid + 2 * mu_grid) / (lambda_grid + mu_grid)

figure, (left, right) = plt.subplots(1, 2, figsize=(7.1, 2.8))
levels = np.arange(1475, 1700, 25)
lines = left.contour(lambda_grid, mu_grid, young_grid, levels, colors="#909090", linewidths=0.6)
left.clabel(lines, fmt="E = %.0f Pa", fontsize=6)
left.plot(*ellipse(moduli, moduli_covariance).T, color=BLUE, label="95 % region")
left.plot(*moduli, "o", color=BLUE, label="estimate")
left.plot(800, 600, "+", color=VERMILION, ms=10, mew=1.5, label="true values")
left.set(title="Errors of λ and μ, lines of constant E", xlabel="λ [Pa]", ylabel="μ [Pa]")
left.legend()
correlation = uncertainty.correlation
right.imshow(correlation, vmin=-1, vmax=1, cmap="RdBu_r")
for (i, j), value in np.ndenumerate(correlation):
    colour = "white" if abs(value) > 0.6 else "black"
    right.text(j, i, f"{value:.2f}", ha="center", va="center", color=colour)
right.set(title="Correlation matrix of the estimates")
right.set_xticks(range(4), SYMBOLS)
right.set_yticks(range(4), SYMBOLS)
right.grid(False)
plt.show()

# %% [markdown]
# The two damping parameters are correlated as well. At *one* frequency, only the damping ratio
# $\zeta = \gamma_r\omega/2 + \gamma_m/2\omega$ is identifiable; a motion with two frequencies is
# needed to identify both parameters.
#
# ## 3.2 Profile likelihood
#
# A standard error assumes that the loss is a quadratic function of the logarithm of the
# parameter. The **profile likelihood** makes no such assumption: for each value of one parameter,
# all other parameters are fitted, and the increase of the minimum loss is computed. The 95 %
# interval ends where this increase is 3.84, the 95 % quantile of the χ² distribution with one
# degree of freedom.
#
# The difference between both is visible in a poor experiment, with only one marker, at half the
# length of the cylinder, and noise of 3 mm instead of 0.5 mm. The parameters are now $E$ and ν
# instead of λ and μ. One step per sample is sufficient, because the noise exceeds the error of
# the time step.

# %%
is_kept = np.array(markers.names) == "middle_1"
added_sigma_m = np.sqrt(0.003**2 - 0.0005**2)
noisy_m = measured_m + added_sigma_m * np.random.default_rng(0).normal(size=measured_m.shape)
poor_markers = replace(
    markers,
    positions_m=np.where(is_kept[:, None], noisy_m, np.nan),
    sigma_m=np.full(len(is_kept), 0.003),
)
young_and_poisson = cs.Parameters(
    (
        cs.Parameter("young_pa", 1000.0, 10.0, 1e6),
        cs.Parameter("poisson", 0.3, 0.02, 0.48),
        *problem.parameters.items[2:],
    )
)
poor_problem = replace(
    problem,
    experiments=(replace(cylinder, markers=poor_markers),),
    parameters=young_and_poisson,
    substeps=1,
    uncertainty=replace(problem.uncertainty, profile=("poisson",)),
)
poor_run = cs.run(poor_problem, "reduced-space", seek_causes=False)
poor_uncertainty = poor_run.uncertainty
assert poor_uncertainty is not None
print_estimates(poor_run)
profile = poor_run.profiles["poisson"]
print(profile.sentence)

# %%
best = poor_run.solution.parameters["poisson"]
deviation = np.sqrt(poor_uncertainty.covariance[1, 1])
nu = np.linspace(profile.values.min(), profile.values.max(), 100)
increase = profile.rises

figure, axes = plt.subplots(figsize=(5.6, 2.8))
axes.plot(nu, (np.log(nu / best) / deviation) ** 2, "--", color=ORANGE, label="quadratic in ln ν")
axes.plot(profile.values, increase, "o-", color=BLUE, label="profile")
axes.axhline(profile.threshold, color="black", lw=0.6, label="3.84")
axes.axvline(TRUE_VALUES["poisson"], color=VERMILION, lw=0.8, ls=":", label="true value")
axes.set(title="Profile likelihood of ν, one marker", xlabel="ν", ylabel="increase of the loss")
axes.set_ylim(0, 16)
axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
plt.show()
low, high = profile.interval
assert low is not None
assert high is not None
assert low < TRUE_VALUES["poisson"] < high
assert high - low > 0.3

# %% [markdown]
# The profile deviates strongly from the quadratic function. Small values of ν are hardly
# excluded; the upper end of the interval is where the foam becomes nearly incompressible. The
# relative standard error of $E$ is 7 %, but ν is practically not identified. No numerical method
# can identify ν better, because the measurements do not contain the information. Possible
# remedies are more markers, a motion with more twist and shear, or a value of ν from another
# source, as a prior or as a fixed value.
#
# ## 3.3 Wrong marker position
#
# The recorded positions of the marker `tip_1` are shifted by 4 mm along x, as by a systematic error
# of the motion capture system. Three runs treat the data differently:
#
# - with the stated noise, assumed independent,
# - with the default settings, which compare the residuals with the stated noise,
# - with an unknown offset for each marker (a nuisance parameter with a prior of 5 mm).

# %%
shifted_m = measured_m.copy()
tip = markers.names.index("tip_1")
shifted_m[:, tip, 0] += 0.004
shifted = replace(cylinder, markers=replace(markers, positions_m=shifted_m))
with_offsets = replace(shifted, nuisance=cs.Nuisance.none(camera_offset_m=0.005))
stated_noise = replace(problem.uncertainty, noise="given", errors="independent")
offset_runs = {
    "stated noise": cs.run(
        replace(problem, experiments=(shifted,), uncertainty=stated_noise),
        "reduced-space",
        seek_causes=False,
    ),
    "default": cs.run(replace(problem, experiments=(shifted,)), "reduced-space", seek_causes=False),
    "offsets estimated": cs.run(
        replace(problem, experiments=(with_offsets,)), "reduced-space", seek_causes=False
    ),
}
for name, each in offset_runs.items():
    print(f"{name}: {1e3 * each.solution.rms_m:.2f} mm RMS, ", end="")
    print(f"{1e3 * each.noise_rms_m:.2f} mm expected")
    print_estimates(each)
offset_m = offset_runs["offsets estimated"].nuisance("camera offset of tip_1, x")
print(f"estimated offset of tip_1 along x: {1e3 * offset_m:.2f} mm, true value 4 mm")
assert abs(offset_m - 0.004) < 0.0005


# %%
def relative_deviations(run):
    """Return deviations (4,) from the true values and statistical standard errors, relative."""
    names = list(TRUE_VALUES)[:4]
    true_values = np.array([TRUE_VALUES[name] for name in names])
    values = np.array([run.estimates[name].value for name in names])
    errors = np.array([statistical_error(run, name) for name in names])
    return values / true_values - 1, errors / true_values


figure, axes = plt.subplots(figsize=(5, 2.8))
colours = (VERMILION, ORANGE, BLUE)
for shift, colour, (name, each) in zip((-0.2, 0, 0.2), colours, offset_runs.items(), strict=True):
    deviations, errors = relative_deviations(each)
    axes.errorbar(
        np.arange(4) + shift, 100 * deviations, 196 * errors, fmt="o", color=colour, label=name
    )
axes.axhline(0, color="black", lw=0.6)
axes.set_xticks(range(4), SYMBOLS)
axes.set(title="Deviation from the true value, statistical 95 % interval", ylabel="%")
axes.legend()
plt.show()

# %% [markdown]
# With the stated noise, both damping parameters deviate by more than four standard errors: the
# intervals are narrow and wrong. By default, the toolbox finds that the residuals are larger than
# the stated noise, enlarges the standard errors, and reports the marker. Only the estimation of
# the offset removes the bias; the standard errors are then hardly larger than with the correct
# position.

# %%
deviations, errors = relative_deviations(offset_runs["stated noise"])
assert np.all(np.abs(deviations[2:]) > 4 * errors[2:])
deviations, errors = relative_deviations(offset_runs["offsets estimated"])
assert np.all(np.abs(deviations) < 3 * errors)
print("verdict:", offset_runs["default"].trust.verdict)
print(offset_runs["default"].diagnoses[tip].sentence)

# %% [markdown]
# ## 3.4 Autocorrelated noise
#
# Noise of a camera is nearly independent from frame to frame. Other errors are not: a marker on a
# soft base, a calibration error, or a model error. In a first-order autoregressive process, each
# error is $\varphi$ times the previous one plus an independent term. Then 100 samples contain less
# information than 100 independent samples.
#
# In a linear model, an estimate is a linear function $A$ of the noise with covariance $\Sigma$,
# hence $\operatorname{cov} = A\,\Sigma A^T$. The next cell evaluates this formula for the spring
# of part 1, whose position is known in closed form. $A$ is the pseudo-inverse of the derivatives
# of the position with respect to $k$, $c$ and the initial displacement.

# %%
MASS = 0.1  # kg
t = 0.01 * np.arange(101)
spring_parameters = np.array([40.0, 0.08, 0.05])  # k [N/m], c [N s/m], displacement [m]


def spring_position(parameters):
    """Return the positions (101,) of the released mass [m]."""
    stiffness, damping, pull = parameters
    decay = damping / (2 * MASS)
    damped = np.sqrt(stiffness / MASS - decay**2)
    return pull * np.exp(-decay * t) * (np.cos(damped * t) + decay / damped * np.sin(damped * t))


columns = []
for step in 1e-5 * np.diag(spring_parameters):
    difference = spring_position(spring_parameters + step) - spring_position(
        spring_parameters - step
    )
    columns.append(difference / (2 * step.sum()))
A = np.linalg.pinv(np.column_stack(columns))[:2]
coefficients = np.array([0.0, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95])
independent = np.sqrt(np.diag(A @ A.T))
factors = []
for phi in coefficients:
    noise_correlation = toeplitz(phi ** np.arange(len(t)))
    factors.append(np.sqrt(np.diag(A @ noise_correlation @ A.T)) / independent)

figure, axes = plt.subplots(figsize=(3.8, 2.6))
for each, name, colour in zip(np.transpose(factors), "kc", (BLUE, VERMILION), strict=True):
    axes.plot(coefficients, each, "o-", color=colour, label=name)
axes.axhline(1, color="black", lw=0.6)
axes.set(title="Standard error relative to independent noise", xlabel="φ", ylabel="factor")
axes.set_ylim(bottom=0)
axes.legend()
plt.show()
assert np.allclose(factors[0], 1)
assert np.max(factors) > 2

# %% [markdown]
# For the same variance of the noise, the standard errors increase by a factor of up to more than
# two. (Beyond φ = 0.8 the factor decreases, because the spectrum of such slow noise has little
# power at the frequency of the oscillation, 3 Hz.) The toolbox tests the residuals for
# autocorrelation, and includes it in the standard errors if the test is significant. The next cell
# adds autocorrelated noise to the markers of the cylinder.

# %%
phi = 0.9
innovations = np.random.default_rng(5).normal(size=(300, *measured_m.shape[1:]))
process = lfilter([1], [1, -phi], 0.001 * np.sqrt(1 - phi**2) * innovations, axis=0)
correlated_markers = replace(
    markers,
    positions_m=measured_m + process[-len(cylinder.t_s) :],
    sigma_m=np.full(6, np.hypot(0.001, 0.0005)),
)
correlated = replace(cylinder, markers=correlated_markers)
young_errors = {}
for errors in ("independent", "auto"):
    options = replace(problem.uncertainty, errors=errors)
    each = cs.run(
        replace(problem, experiments=(correlated,), uncertainty=options),
        "reduced-space",
        seek_causes=False,
    )
    used = "none" if each.uncertainty is None else each.uncertainty.errors
    print(f'errors = "{errors}", used: {used}')
    print_estimates(each)
    young_errors[errors] = statistical_error(each, "young_pa")
for note in each.all_notes:
    print("·", note)
assert used == "autocorrelated"
assert young_errors["auto"] > 1.5 * young_errors["independent"]

# %% [markdown]
# ## 3.5 Choice of the motion
#
# The standard errors depend on the motion. `collocation-sysid plan` with a table `[information]` in
# the task computes a motion that minimises them within the limits of a robot, for all parameters
# or for some of them. For this cylinder, two motions of two seconds were computed
# (`docs/howto/plan.md`). The motion for ν gives standard errors of 0.022 % for ν, and of 0.12 and
# 0.25 % for the damping parameters. The motion for the damping parameters gives 0.32 % for ν, and
# 0.049 and 0.066 % for the damping parameters.
#
# ## 3.6 Combined interval and verdict
#
# Sections 3.1 to 3.4 treat the effect of the noise: the *statistical* uncertainty (type A in the
# *Guide to the Expression of Uncertainty in Measurement*, GUM). The estimates also depend on
# assumptions that the data do not test: the size of the body, a uniform density, isotropy, the
# calibration of the cameras. These *systematic effects* (type B) have stated standard deviations.
# To first order, the error of an estimate is a sum of independent contributions, and the
# **combined** standard uncertainty is the root of the sum of their squares. The **combined 95 %
# interval** is the one to publish.

# %%
run = cs.run(described, "reduced-space")
print(run.table())

# %% [markdown]
# The columns `± stat` and `± syst` are the statistical and the systematic part. Although the data
# are synthetic, the toolbox includes the effects that a real recording would have; the problem
# file excludes only some of them, such as `damping_law = "none"`. The estimates are corrected for what the
# fit finds of the effects, and are less accurate than in section 3.1, because the data have none.
# The combined intervals contain the true values. For purely synthetic data,
# `cs.Assumptions.exact()` excludes all of these effects.

# %%
names = ["young_pa", "mu_pa", "lambda_pa", "poisson", "gamma_r_s", "gamma_m_1_s"]
labels = ["$E$", r"$\mu$", r"$\lambda$", r"$\nu$", r"$\gamma_r$", r"$\gamma_m$"]
MAIN_EFFECTS = {  # label and colour by name in the budget
    "noise": ("noise", VERMILION),
    "mass": ("mass", BLUE),
    "surface": ("surface", SKY),
    "anisotropy": ("anisotropy", GREEN),
}

figure, (left, right) = plt.subplots(1, 2, figsize=(7.1, 2.8))
for row, name in enumerate(names):
    estimate = run.estimates[name]
    low, high = run.interval(name)
    left.plot([low / estimate.value, high / estimate.value], [row, row], color=BLUE, lw=7)
    low, high = estimate.statistical95 or (np.nan, np.nan)
    left.plot([low / estimate.value, high / estimate.value], [row, row], color=VERMILION, lw=2)
    left.plot(TRUE_VALUES[name] / estimate.value, row, "k|", ms=12)
left.set(title="95 % intervals: combined (blue), statistical (orange)", xscale="log")
left.set(xlabel="value / estimate (black: true value)")
left.set_xticks([0.8, 1, 1.25], ["0.8", "1", "1.25"])
left.set_xticks([], minor=True)
sums = np.zeros(len(names))
for effect, (label, colour) in MAIN_EFFECTS.items():
    shares = np.array([run.budget[name].shares.get(effect, 0.0) for name in names])
    right.barh(range(len(names)), shares, left=sums, color=colour, label=label)
    sums = sums + shares
right.barh(range(len(names)), 1 - sums, left=sums, color="#C0C0C0", label="other effects")
right.set(title="Shares of the combined variance", xlim=(0, 1))
right.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, frameon=False)
for axes in (left, right):
    axes.set_yticks(range(len(names)), labels)
    axes.invert_yaxis()
plt.show()

for name in names:
    low, high = run.interval(name)
    assert low < TRUE_VALUES[name] < high
    assert np.isclose(sum(run.budget[name].shares.values()), 1)
    shares = run.budget[name].shares
    assert max(shares, key=lambda effect: shares[effect]) == "noise"

# %% [markdown]
# The effects are estimated together with the parameters, as far as the recording determines them.
# The noise therefore contributes more to the standard errors than in section 3.1, for $E$ more than
# four times as much, and is the largest share of the variance of every estimate, about half or more:
# more recordings of this kind would reduce the combined intervals. The largest other contribution
# to the variance of $E$ and μ is the mass of the body, for which the problem file states a
# standard deviation of 1 %. The budget therefore shows which measurement to improve.
#
# The **verdict** summarises the checks of a run: `good` (no reason for doubt was found), `check`
# (usable after checking the listed reasons) or `doubtful` (something is wrong with the data, the
# model or the solution). The verdict considers convergence, the size and the pattern of the
# residuals, parameters at a bound, the forward simulation, and the discretisation error
# ([verdict](../../docs/howto/trust.md)). It does not consider the width of the intervals: the
# table marks an estimate whose interval is wider than its value as "not determined", here none.

# %%
print("verdict:", run.trust.verdict)
print("not determined:", [name for name in names if not run.estimates[name].is_determined])
assert run.trust.verdict == "good"
assert all(run.estimates[name].is_determined for name in names)

# %% [markdown]
# `collocation-sysid explain budget` describes the systematic effects, their standard deviations and
# how to state your own.
#
# ## Exercises
#
# The solutions follow in the last section.
#
# 1. **One marker.** Only one marker can be recorded. Which markers give the smallest standard
#    errors of $E$ and $\gamma_r$?
# 2. **Mass of the body.** The body was weighed to 0.1 %. State this in
#    `[uncertainty.assumptions]` (`mass = 0.001`). How do the combined standard uncertainties of $E$
#    and μ change?
#
# This is the last part. The [how-to pages](../../docs/howto) describe further kinds of
# measurements, and `docs/theory.md` the complete model.
#
# ## Solutions
#
# **1.** The cell makes a run for each marker. The markers at the tip give smaller standard errors
# than those at half the length of the cylinder, because the displacement of the tip is larger.

# %% jupyter={"source_hidden": true}
single = {}
for marker in markers.names:
    is_kept = np.array(markers.names) == marker
    positions_m = np.where(is_kept[:, None], measured_m, np.nan)
    one_marker = replace(cylinder, markers=replace(markers, positions_m=positions_m))
    each = cs.run(
        replace(problem, experiments=(one_marker,), parameters=young_and_poisson),
        "reduced-space",
        seek_causes=False,
    )
    relative = {
        name: statistical_error(each, name) / estimate.value
        for name, estimate in each.estimates.items()
    }
    single[marker] = relative["young_pa"], relative["gamma_r_s"]
    print(
        f"{marker:9}: E {100 * relative['young_pa']:.2f} %, γ_r {100 * relative['gamma_r_s']:.1f} %"
    )
tips = [single[f"tip_{i}"] for i in (1, 2, 3)]
middles = [single[f"middle_{i}"] for i in (1, 2, 3)]
assert np.all(np.max(tips, axis=0) < np.min(middles, axis=0))

# %% [markdown]
# **2.** The combined uncertainties decrease by more than a tenth. The surface of the mesh is then
# the largest contribution to the variance of $E$ beside the noise.

# %% jupyter={"source_hidden": true}
assumptions = replace(described.uncertainty.assumptions, mass=0.001)
options = replace(described.uncertainty, assumptions=assumptions)
measured_run = cs.run(replace(described, uncertainty=options), "reduced-space")
for name in ("young_pa", "mu_pa"):
    before = run.std_error(name)
    after = measured_run.std_error(name)
    shares = measured_run.budget[name].shares
    _, largest, *_ = sorted(shares, key=lambda effect: -shares[effect])
    print(
        f"{name}: ± {before:.1f} → ± {after:.1f} Pa, largest contribution beside noise: {largest}"
    )
    assert after < 0.9 * before
assert measured_run.trust.verdict == "good"
young_shares = measured_run.budget["young_pa"].shares
assert sorted(young_shares, key=lambda effect: -young_shares[effect])[:2] == ["noise", "surface"]
