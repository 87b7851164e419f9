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
# # 2 · Cylinder
#
# Tutorial on direct collocation, part 2 of 4. Previous part:
# [1 · Spring and tetrahedron](1_spring_and_tetrahedron.ipynb). Next part:
# [3 · Trust](3_trust.ipynb)
#
# This part estimates the material parameters of a foam cylinder from a recording in which a robot
# swings the cylinder. The method is that of part 1; the toolbox applies it to a mesh of 198
# tetrahedra.
#
# **You will learn** how
#
# - to read, solve and inspect a problem in Python;
# - the reduced-space method solves the nonlinear program, and how it differs from an
#   interior-point method;
# - a forward simulation verifies a solution;
# - the time integration scheme affects the estimates of a finite element model;
# - an ordinary camera replaces motion capture;
# - to write a problem file for your own data, check it, and solve it.
#
# **Prerequisites:** part 1, or familiarity with direct collocation and finite elements.
#
# **Time:** about 30 minutes of reading; the cells run in about one minute (measured: 49 to 63 s on
# two cores that other programs used too; the first run also compiles kernels).

# %%
# %matplotlib inline
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs

BLUE = "#0072B2"
SKY = "#56B4E9"
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
CYLINDER = cs.datasets.fetch("foam_cylinder")

# %% [markdown]
# ## 2.1 Problem file
#
# The foam cylinder is 16 cm long, hangs from a robot's gripper and is swung for 0.4 s. A motion
# capture system records six markers at 100 Hz; the noise has a standard deviation of 0.5 mm. The
# data are synthetic, so that the true parameters are known.
#
# The elastic energy of the mesh is the sum of the energies of its tetrahedra. Forces and stiffness
# matrices are therefore sums as well. A **problem file** states the body, the parameters, the
# grasp, the measurements and the discretisation:

# %%
print((CYLINDER / "problem.toml").read_text())

# %% [markdown]
# `cs.run` solves the problem, verifies the solution by a forward simulation, and computes the
# uncertainties. `run.solution` is the solution of the nonlinear program. The data are simulated
# without the systematic effects of a real recording (part 3), which are therefore excluded.

# %%
problem = cs.Problem.read(CYLINDER / "problem.toml")
exact = replace(problem.uncertainty, assumptions=cs.Assumptions.exact())
problem = replace(problem, uncertainty=exact)
run = cs.run(problem, "reduced-space")
solution = run.solution
assert solution.status.converged
mesh = problem.bodies[0].mesh
assert (len(problem.bodies[0].nodes_m), len(problem.bodies[0].cells)) == (84, 198)
print(solution.message)
print(f"{solution.iterations} iterations, {solution.timing.total:.1f} s")


# %%
def youngs_modulus(lambda_pa, mu_pa):
    """Return Young's modulus [Pa]."""
    return mu_pa * (3 * lambda_pa + 2 * mu_pa) / (lambda_pa + mu_pa)


def poissons_ratio(lambda_pa, mu_pa):
    """Return Poisson's ratio."""
    return lambda_pa / (2 * (lambda_pa + mu_pa))


TRUE_VALUES = {
    "lambda_pa": 800.0,
    "mu_pa": 600.0,
    "gamma_r_s": 0.006,
    "gamma_m_1_s": 1.5,
    "young_pa": youngs_modulus(800.0, 600.0),
    "poisson": poissons_ratio(800.0, 600.0),
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


print_estimates(run)
for name, estimate in run.estimates.items():
    assert abs(estimate.value - TRUE_VALUES[name]) < 4 * statistical_error(run, name), name

# %% [markdown]
# The values `± …` are statistical standard errors: they describe the effect of the noise. Part 3
# explains the combined uncertainty, which also contains systematic effects.
#
# The figures show the fitted motion.

# %%
cylinder = problem.experiments[0]
substeps = solution.collocation.substeps
positions_mm = 1e3 * solution.positions_m[0]
markers_mm = 1e3 * cylinder.markers.positions_m
held_nodes = cylinder.grasps[0].nodes
spacing_mm = 270.0

figure, axes = plt.subplots(figsize=(7.1, 2.3))
for column, step in enumerate(np.linspace(0, len(positions_mm) - 1, 6).astype(int)):
    sample = round(step / substeps)
    shape = positions_mm[step] + [spacing_mm * column, 0, 0]
    points = markers_mm[sample] + [spacing_mm * column, 0, 0]
    axes.triplot(shape[:, 0], shape[:, 2], mesh.surface, lw=0.3, color=SKY)
    axes.plot(shape[held_nodes, 0], shape[held_nodes, 2], "k.", ms=3)
    axes.plot(points[:, 0], points[:, 2], ".", color=VERMILION, ms=6)
    axes.text(spacing_mm * column, 60, f"{cylinder.t_s[sample]:.2f} s", ha="center")
axes.set(title="Side view: mesh, held nodes (black), markers (orange)", ylabel="z [mm]")
axes.set(aspect="equal", ylim=(-200, 90), xticks=[])
axes.grid(False)
plt.show()

# %%
measured_m = cylinder.markers.positions_m
fitted_m = solution.readings_m[0]
tip = cylinder.markers.names.index("tip_1")
figure, panels = plt.subplots(1, 3, figsize=(7.1, 2.3), sharex=True)
for i, axes in enumerate(panels):
    axes.plot(cylinder.t_s, 1e3 * measured_m[:, tip, i], "k.", label="measured")
    axes.plot(cylinder.t_s, 1e3 * fitted_m[:, tip, i], color=BLUE, label="fitted")
    axes.set(title=f"Marker tip_1, {'xyz'[i]}", xlabel="time [s]")
panels[0].set_ylabel("position [mm]")
panels[0].legend()
plt.show()

# %% [markdown]
# ## 2.2 Interior-point and reduced-space methods
#
# The method `interior-point` passes the complete nonlinear program to IPOPT, as in part 1. For
# this cylinder, IPOPT takes about 20 s, most of it for the factorisation of linear systems.
#
# The method `reduced-space` eliminates the trajectory: for given parameters $\theta$ the equations
# of motion determine the positions $X$. The linearised equations of motion are
#
# $$c + c_X\,\mathrm dX + c_\theta\,\mathrm d\theta = 0
# \;\Rightarrow\; \mathrm dX = \underbrace{-c_X^{-1}c}_{p} + \underbrace{-c_X^{-1}c_\theta}_{Z}\,
# \mathrm d\theta.$$
#
# The matrix $c_X$ is block lower triangular in time. Hence $p$ and $Z$ require one sparse
# factorisation for each time step, and the remaining least-squares problem has only four
# unknowns. The optimum of the reduced-space method is that of the nonlinear program.
#
# The Jacobian has the structure found for the tetrahedron: four dense columns and a band of blocks
# with the sparsity of the mesh.

# %%
collocation = solution.collocation
width = 3 * len(problem.bodies[0].nodes_m)
height = collocation.transcriptions[0].constraints_per_time
jacobian = collocation.jacobian(solution.z)
figure, (left, right) = plt.subplots(1, 2, figsize=(7.1, 3.1))
left.spy(jacobian[: 4 * height, : 4 + 4 * width], markersize=0.25, color=BLUE, aspect="auto")
left.set(title="First four time steps", xlabel="parameters (first four columns) and positions")
right.spy(jacobian[:height, 4 : 4 + width], markersize=0.6, color=BLUE, aspect="auto")
right.set(title="One block", xlabel="positions at one time")
for axes in (left, right):
    axes.set_ylabel("equations of motion")
    axes.xaxis.set_ticks_position("bottom")
    axes.grid(False)
plt.show()
rows = collocation.constraint_count
columns = collocation.variable_count
print(f"{rows} × {columns}, {100 * jacobian.nnz / rows / columns:.2f} % nonzero")

# %% [markdown]
# `collocation.casadi()` is the same program as a CasADi function, for `casadi.nlpsol` and programs
# of your own; the page [For optimal-control users](../../docs/howto/optimal_control.md) continues
# here. At the solution the equations of motion hold, $g = 0$, and with the multipliers $y$ the
# derivatives $\nabla f + g_z^T y$ by all variables vanish that no bounds prescribe.

# %%
nlp = collocation.casadi()
z, multipliers = solution.z, solution.multipliers
violation = np.abs(nlp.g(z, []).full()).max()
is_free = np.ravel(nlp.arguments["lbx"]) < np.ravel(nlp.arguments["ubx"])
gradient = (nlp.grad_f(z, []) + nlp.jac_g(z, []).T @ multipliers).full().ravel()
stationarity = np.abs(gradient[is_free]).max()
print(f"largest |g| {violation:.1e}, largest |∇f + g_zᵀy| {stationarity:.1e}")
assert violation < 1e-8
assert stationarity < 1e-4

# %% [markdown]
# ## 2.3 Verification by forward simulation
#
# The RMS distance between fitted and measured markers should be $\sqrt3$ times the standard
# deviation of the noise of one coordinate, because a distance has three components. A small
# distance does not show that the equations of motion are satisfied. Therefore each run simulates
# the experiment with the estimated parameters and a different integrator (Newmark's method), and
# compares the simulated markers with the measured ones.

# %%
rollout = run.rollouts["swing"]
assert not isinstance(rollout, str), rollout
assert rollout.rms_m
noise_mm = 1e3 * np.sqrt(3) * 0.0005
print(f"fit                   {1e3 * solution.rms_m:.3f} mm RMS")
print(f"forward simulation    {1e3 * rollout.rms_m:.3f} mm RMS")
print(f"√3 times the noise    {noise_mm:.3f} mm")
print(f"largest residual of the equations of motion {solution.max_violation_n:.1e} N")
assert abs(1e3 * solution.rms_m / noise_mm - 1) < 0.1
assert rollout.rms_m < 1.1 * solution.rms_m

# %% [markdown]
# ## 2.4 Time integration schemes
#
# The next cell repeats the comparison of section 1.3 for the cylinder: backward Euler with one and
# with four steps per sample, and the midpoint rule with two. `cs.solve` computes only the solution,
# without verification and uncertainties.

# %%
solutions = {}
for scheme, substeps in (("backward-euler", 1), ("backward-euler", 4), ("midpoint", 2)):
    variant = replace(problem, scheme=scheme, substeps=substeps)
    solutions[scheme, substeps] = cs.solve(variant, "reduced-space")

print(f"{'scheme, steps':18}{'E [Pa]':>8}{'ν':>8}{'γ_r [s]':>10}{'γ_m [1/s]':>11}{'RMS [mm]':>10}")
for (scheme, substeps), each in solutions.items():
    lambda_pa, mu_pa, gamma_r, gamma_m = each.parameters.values()
    young = youngs_modulus(lambda_pa, mu_pa)
    poisson = poissons_ratio(lambda_pa, mu_pa)
    print(f"{scheme + f', {substeps}':18}{young:8.0f}{poisson:8.3f}", end="")
    print(f"{gamma_r:10.5f}{gamma_m:11.3f}{1e3 * each.rms_m:10.2f}")
print(f"{'true values':18}{TRUE_VALUES['young_pa']:8.0f}{TRUE_VALUES['poisson']:8.3f}", end="")
print(f"{0.006:10.5f}{1.5:11.3f}{noise_mm:10.2f}")

# %%
lambda_pa, mu_pa, gamma_r, gamma_m = solutions["backward-euler", 1].parameters.values()
assert gamma_r < 2e-5  # its lower bound is 1e-5
assert gamma_m < 2e-3  # its lower bound is 1e-3
assert abs(youngs_modulus(lambda_pa, mu_pa) / TRUE_VALUES["young_pa"] - 1) > 0.02
assert solutions["backward-euler", 1].rms_m > 1.5e-3 * noise_mm
assert solutions["backward-euler", 4].parameters["gamma_r_s"] < 0.9 * 0.006
assert solutions["backward-euler", 4].rms_m < 1.05e-3 * noise_mm
assert abs(solutions["midpoint", 2].parameters["gamma_m_1_s"] / 1.5 - 1) < 0.1

# %% [markdown]
# With one step of 10 ms per sample, the numerical damping of backward Euler exceeds the damping
# of the material: both damping parameters are at their lower bounds, and $E$ and $\nu$ are
# biased. The RMS distance of about twice the noise indicates the error. With four substeps the
# moduli are nearly correct. The estimate of $\gamma_r$ is still too small, and the RMS distance
# no longer indicates this error.

# %% [markdown]
# ## 2.5 A camera instead of motion capture
#
# An ordinary camera measures pixels, not positions. `cs.Camera` states its calibration and pose,
# and `cs.ImageTracks` the pixels of points that a program has tracked in the video. Here a camera
# at a distance of 0.6 m films 22 dots on the side of the cylinder that it sees. Their pixels are
# simulated with the true parameters, and noise of 0.5 pixels is added:

# %%
(swing,) = problem.experiments
nodes_m = swing.body.nodes_m
dots_m = nodes_m[(nodes_m[:, 1] > 0.02) & (nodes_m[:, 2] > 0.01)]
names = [f"dot_{number}" for number in range(len(dots_m))]
camera_pose = np.eye(4)  # x to the right, y downwards, z forward
camera_pose[:3, :3] = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).T
camera_pose[:3, 3] = [0.02, -0.6, -0.08]
camera = cs.Camera(
    [[1000, 0, 640], [0, 1000, 360], [0, 0, 1]], pose=camera_pose, size_px=(1280, 720)
)
film = cs.ImageTracks("phone", camera, swing.t_s, None, names, places_m=dots_m, sigma_px=0.5)
filmed = replace(swing, markers=None, readings=[film])
true_parameters = {name: TRUE_VALUES[name] for name in solution.parameters if name in TRUE_VALUES}
simulated = cs.simulate(filmed, true_parameters, "midpoint", substeps=2)
pixels = simulated.custom_sensor_values[0].reshape(len(swing.t_s), len(names), 2)
pixels = pixels + np.random.default_rng(2).normal(scale=0.5, size=pixels.shape)

# %%
figure, axes = plt.subplots(figsize=(3.4, 2.6))
axes.plot(*pixels.transpose(2, 0, 1), color=SKY, linewidth=0.6)
axes.plot(*pixels[0].T, ".", color=BLUE, label="first image")
axes.plot(*pixels[-1].T, ".", color=VERMILION, label="last image")
axes.set(xlabel="u [px]", ylabel="v [px]", aspect="equal", title="Tracks of 22 dots in the video")
axes.invert_yaxis()
axes.legend()
plt.show()

# %% [markdown]
# The tracks replace the markers. What is uncertain about a camera is estimated with the parameters:
# here the pose (1°, 5 mm), the focal length (0.5 %), the principal point (2 pixels), the clock
# (5 ms) and the places of the dots (1 mm).

# %%
tracked = replace(filmed, readings=[replace(film, pixels=pixels)])
by_camera = cs.solve(replace(problem, experiments=(tracked,)), "reduced-space")
assert by_camera.status.converged
print("            true   markers    camera")
for name, value in true_parameters.items():
    markers_value, camera_value = (each.parameters[name] for each in (solution, by_camera))
    print(f"{name:11} {value:5.4g} {markers_value:9.4g} {camera_value:9.4g}")
assert abs(by_camera.parameters["mu_pa"] / TRUE_VALUES["mu_pa"] - 1) < 0.05

# %% [markdown]
# In a problem file the tracks are a table `[[experiment.image_tracks]]`; the page
# [From a phone video to a modulus](../../docs/howto/image_tracks.md) leads from filming to the
# answer, also where neither the places of the points nor the pose of the camera are known.

# %% [markdown]
# ## 2.6 Bring your own data
#
# Three data files and a problem file are needed:
#
# | file | content |
# |---|---|
# | mesh | undeformed tetrahedral mesh in a format of meshio, or a closed surface mesh |
# | poses | `t_s,x_m,y_m,z_m,qx,qy,qz,qw`: rigid motion of the held nodes from the undeformed body |
# | markers | `t_s,<name>_x,<name>_y,<name>_z,…`, empty where not visible; or C3D, TRC |
#
# On the command line:
#
#     collocation-sysid new my_object                     # writes a commented problem file
#     collocation-sysid check my_object/problem.toml      # finds mistakes before a solve
#     collocation-sysid solve my_object/problem.toml      # writes a run folder
#
# In the following cells, copies of the files of the cylinder take the place of your own files.

# %%
MY_PROBLEM = """
title = "My object"

[object]
mesh = "mesh.vtu"
rest_shape = "stress_free"            # the mesh is the shape without gravity
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
[experiment.markers.reference_m]      # positions on the undeformed body
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
temporary = TemporaryDirectory()
folder = Path(temporary.name)
for name, source in (
    ("mesh.vtu", "foam_cylinder.vtu"),
    ("poses.csv", "swing_poses.csv"),
    ("markers.csv", "swing_markers.csv"),
):
    copyfile(CYLINDER / source, folder / name)

# %% [markdown]
# ### Error messages
#
# An invalid problem file raises `cs.InputError`. The error message states the file, the key, the
# value found and the values expected:

# %%
misspelt = MY_PROBLEM.replace("mass_kg = 0.012", "mass_g = 12")
(folder / "problem.toml").write_text(misspelt)
try:
    cs.Problem.read(folder / "problem.toml")
except cs.InputError as error:
    print(str(error).replace(str(folder), "."))
else:
    raise AssertionError("the misspelt key was accepted")

# %% [markdown]
# ### Check
#
# `collocation-sysid check` reports the size of the problem, the distance of the markers from the
# body, whether the time grid resolves the vibrations of the body, and probable mistakes. In a
# terminal the command is `collocation-sysid check problem.toml`; the next cell runs the same
# command from Python. (A finer mesh, which the advice may recommend, is not needed here, because
# the data were simulated with this mesh.)

# %%
(folder / "problem.toml").write_text(MY_PROBLEM)
command = [sys.executable, "-m", "collocation_sysid", "check", "problem.toml"]
plain_output = os.environ | {"FORCE_COLOR": "", "COLUMNS": "100", "PYTHONIOENCODING": "utf-8"}
checked = subprocess.run(
    command, cwd=folder, env=plain_output, capture_output=True, encoding="utf-8", check=False
)
print(checked.stdout)
assert checked.returncode == 0, checked.stderr

# %% [markdown]
# ### Solve
#
# `run.save` writes a run folder with `result.json`, plots, the trajectory, and frames for ParaView.

# %%
my_problem = cs.Problem.read(folder / "problem.toml")
my_run = cs.run(my_problem)
print_estimates(my_run)
my_run.save(folder / "run")
print("run folder:", ", ".join(sorted(path.name for path in (folder / "run").iterdir())))

# %%
print(my_run)

# %% [markdown]
# Before you use an estimate, answer these questions in this order:
#
# 1. Does the RMS distance agree with the noise of the measurements? If the RMS distance is
#    larger, the model lacks an effect.
# 2. Do the estimates remain the same with twice the number of substeps, and with a finer mesh or
#    `tet10` elements? (Linear tetrahedra are too stiff in bending, and near ν = 0.5 they lock.)
#    The command `collocation-sysid refine` measures the errors of time step and mesh.
# 3. Are the residuals uncorrelated? Is a recording that was not fitted (`validation = true`)
#    predicted equally well?
# 4. How large are the combined intervals, and which effects contribute most? See part 3.
#
# ## Exercises
#
# The solutions follow in the last section.
#
# 1. **Number of substeps.** Solve the cylinder by the midpoint rule with 1, 2 and 4 substeps. Are
#    2 substeps sufficient?
# 2. **Unknown marker positions.** Delete `reference_m` from the problem file. The positions of the
#    markers on the body are then estimated. How do the RMS distance and the standard errors
#    change? Which accuracy of the measured positions (`reference_sigma_m`) is useful?
#
# Next part: [3 · Trust](3_trust.ipynb)
#
# ## Solutions
#
# **1.** The cell prints the changes of the logarithms of the parameters in units of their
# statistical standard errors. From 1 to 2 substeps, μ changes by about three standard errors;
# from 2 to 4 substeps, it changes by 0.8 standard errors. The error decreases with $\Delta t^2$,
# so that the remaining error with 4 substeps is about a third of the change from 2 to 4 substeps.
# With 2 substeps the error of μ is therefore about one standard error, with 4 substeps a quarter.
# The values in `run.estimates` are corrected for the estimated error of the time step.

# %% jupyter={"source_hidden": true}
uncertainty = run.uncertainty
assert uncertainty is not None
std_errors = np.sqrt(np.diag(uncertainty.covariance))
logarithms = {}
for substeps in (1, 2, 4):
    each = cs.solve(replace(problem, substeps=substeps), "reduced-space")
    logarithms[substeps] = np.log(list(each.parameters.values()))
changes = {}
for few, many in ((1, 2), (2, 4)):
    changes[few] = (logarithms[many] - logarithms[few]) / std_errors
    print(f"{few} → {many} substeps: change of (λ, μ, γ_r, γ_m) {changes[few].round(2)}")
assert np.max(np.abs(changes[1])) > 2
assert np.max(np.abs(changes[2])) < 1.5

# %% [markdown]
# **2.** The RMS distance still agrees with the noise, and the true values are within the
# intervals, but the standard errors are larger: the static deflection under gravity cannot be
# separated from the unknown positions of the markers, so that only the motion is informative.
#
# The fit determines the positions to some tenths of a millimetre. Positions measured to 1 mm
# (`reference_sigma_m = 0.001`) therefore add nothing, whereas positions measured to 0.1 mm
# (`reference_sigma_m = 0.0001`) reduce the standard errors. Stating a standard deviation instead
# of exact positions also limits the bias that a wrong position causes.

# %% jupyter={"source_hidden": true}
first = MY_PROBLEM.index("[experiment.markers.reference_m]")
last = MY_PROBLEM.index("[transcription]")
sigma = "sigma_m = 0.0005\n"
texts = {
    "exact": MY_PROBLEM,
    "known to 0.1 mm": MY_PROBLEM.replace(sigma, sigma + "reference_sigma_m = 0.0001\n"),
    "known to 1 mm": MY_PROBLEM.replace(sigma, sigma + "reference_sigma_m = 0.001\n"),
    "unknown": MY_PROBLEM[:first] + MY_PROBLEM[last:],
}
young_errors = []
for name, text in texts.items():
    (folder / "problem.toml").write_text(text)
    described = cs.Problem.read(folder / "problem.toml")
    each = cs.run(replace(described, uncertainty=exact), seek_causes=False)
    young_pa = each.parameters["young_pa"]
    young_errors.append(statistical_error(each, "young_pa"))
    print(f"positions {name:16}: RMS {1e3 * each.solution.rms_m:.2f} mm, ", end="")
    print(f"E = {young_pa:.0f} ± {young_errors[-1]:.1f} Pa")
    assert 1e3 * each.solution.rms_m < 1.05 * noise_mm
    assert abs(young_pa - TRUE_VALUES["young_pa"]) < 1.96 * young_errors[-1]
exact_error, fine_error, coarse_error, unknown_error = young_errors
assert exact_error < fine_error < 0.97 * unknown_error
assert coarse_error > 0.98 * unknown_error
temporary.cleanup()
