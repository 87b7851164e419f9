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
# # 4 · Plan
#
# Tutorial on direct collocation, part 4 of 4. Previous part: [3 · Trust](3_trust.ipynb)
#
# A hand holds a soft bar by its upper end. The lower end, the tip, shall move by 80 mm in 0.6 s
# and be at rest at once. This part identifies the bar, plans the motion of the hand, executes
# it, and identifies the bar again from the execution. Motion planning is experimental.
#
# **You will learn** how
#
# - a plan moves the hand ahead of the tip, so that no vibration remains;
# - the plan states a band in which the tip is expected;
# - an execution is compared with its prediction, and is identified from.
#
# **Prerequisites:** part 2.
#
# **Time:** about 20 minutes of reading and exercises; all cells take 40 s of computing time.

# %%
# %matplotlib inline
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs

BLUE, ORANGE, VERMILION = "#0072B2", "#E69F00", "#D55E00"
plt.rcParams.update({"figure.dpi": 110, "figure.constrained_layout.use": True, "font.size": 8})

# %% [markdown]
# ## 4.1 The real bar
#
# The "real" bar is simulated, but not with the model that is identified: it has another damping law,
# and smaller time steps. Only its marker tracks, with noise of 0.5 mm, are used below. In the study
# of the documentation, the real body is that of another program, with another mesh.

# %%
NOISE_M = 5e-4
SIZE_M = (0.02, 0.02, 0.12)
MARKERS_M = np.array([[0.01, 0.01, 0.0], [0.0, 0.01, 0.03], [0.02, 0.01, 0.06], [0.01, 0.0, 0.09]])
NAMES = ["tip", "low", "middle", "high"]
TRUTH = {"young_pa": 2e4, "poisson": 0.4, "gamma_r_s": 0.01, "gamma_m_1_s": 0.1}
noise = np.random.default_rng(0)


def recording(body, poses, t_s, tracks_m):
    """Return the experiment of a body whose upper end is held."""
    held = np.flatnonzero(body.nodes_m[:, 2] > SIZE_M[2] - 1e-3)
    markers = cs.Markers(t_s, tracks_m, NOISE_M, NAMES, places_m=MARKERS_M)
    return cs.Experiment(
        body,
        t_s,
        [cs.Grasp(held, poses)],
        markers,
        nuisance=cs.Nuisance.none(),
        air_density_kg_m3="none",
    )


def measure(poses, t_s):
    """Return marker tracks (T, M, 3) of the real bar, with noise."""
    body = cs.Body(cs.box_mesh(SIZE_M, (1, 1, 4)), density_kg_m3=800.0, damping="rayleigh")
    still = recording(body, poses, t_s, np.zeros((len(t_s), len(NAMES), 3)))
    tracks_m = cs.simulate(still, TRUTH, "midpoint", substeps=4).markers_m
    return tracks_m + noise.normal(scale=NOISE_M, size=tracks_m.shape)


# %% [markdown]
# ## 4.2 Identify
#
# The hand swings the bar for one second. The model has the default damping law. All assumptions about
# the description are declared exact, because the recording is simulated. The verdict finds residuals that
# are not noise, but does not name the damping law; the plan is made with the wrong one.

# %%
t_s = 0.02 * np.arange(51)
sway_m = 0.02 * np.sin(14 * t_s) * np.clip(t_s / 0.2, 0, 1) ** 3
still_quaternions = np.tile([0, 0, 0, 1.0], (len(t_s), 1))
swing = cs.PoseSequence(t_s, np.outer(sway_m, [1, 0.3, 0]), still_quaternions)
model = cs.Body(cs.box_mesh(SIZE_M, (1, 1, 4)), density_kg_m3=800.0)
recorded = replace(recording(model, swing, t_s, measure(swing, t_s)), name="swing")
unknown = {
    "young_pa": cs.Unknown(3e4),
    "poisson": 0.4,
    "gamma_r_s": cs.Unknown(0.02),
    "gamma_m_1_s": 0.1,
}
exact = cs.UncertaintyOptions(assumptions=cs.Assumptions.exact())
run = cs.run(cs.Problem([recorded], unknown, uncertainty=exact))
print(run.table())

# %% [markdown]
# ## 4.3 Plan
#
# The task states where the tip shall be over time; the limits are those of the robot. The whole motion
# of the tip is inside the band with 95 %, as far as the recording shows how wrong the model is.

# %%
DURATION_S = 0.6
share = np.linspace(0, 1, 121)
smooth = share**4 * (35 - 84 * share + 70 * share**2 - 20 * share**3)
task = cs.Task.model_validate(
    {
        "duration_s": DURATION_S,
        "sample_s": 0.01,
        "reference": [
            {
                "point": "tip",
                "t_s": (DURATION_S * share).tolist(),
                "position_m": [(0.08 * way, np.nan, np.nan) for way in smooth.tolist()],
                "relative": True,
                "sigma_m": 2e-4,
            }
        ],
        "hand": {"free": ["x"]},
    }
)
limits = cs.Limits.model_validate(
    {
        "workspace_m": ((-0.3, -0.3, -0.3), (0.3, 0.3, 0.4)),
        "speed_m_s": 1.5,
        "acceleration_m_s2": 20.0,
        "rotation_deg": 60.0,
        "angular_speed_deg_s": 360.0,
        "angular_acceleration_deg_s2": 3000.0,
    }
)
plan = cs.plan_motion(run, task, limits)
error = plan.tracking_error(plan.program.references[0])
assert error.band_m
print(f"predicted error of the tip: {1e3 * error.rms_m:.2f} mm RMS, {1e3 * error.largest_m:.2f} mm")
print(f"95 % band: ± {1e3 * error.band_m:.2f} mm; limits reached: {plan.active_limits}")

# %% [markdown]
# ## 4.4 Execute
#
# The real bar is moved by the planned hand, and by a hand that moves as the tip shall, which would be
# right for a rigid body.

# %%
seen_s = np.linspace(0, 1, 101)
rate_s = np.linspace(0, 1, 401)
planned_poses = plan.poses(rate_s)
way = np.clip(rate_s / DURATION_S, 0, 1)
rigid_m = np.outer(0.08 * np.interp(way, share, smooth), [1, 0, 0])
rigid_poses = cs.PoseSequence(rate_s, rigid_m, np.tile([0, 0, 0, 1.0], (len(rate_s), 1)))
executed_m = measure(planned_poses, seen_s)
rigidly_m = measure(rigid_poses, seen_s)

wanted_m = 0.08 * np.interp(seen_s, DURATION_S * share, smooth)
figure, axes = plt.subplots(2, 1, sharex=True, figsize=(6, 4.5))
axes[0].plot(rate_s, 1e3 * planned_poses.positions_m[:, 0], color=ORANGE, label="hand, planned")
axes[0].plot(seen_s, 1e3 * wanted_m, "k--", label="tip, wanted")
moved = {"planned": (executed_m, BLUE), "rigid": (rigidly_m, VERMILION)}
rms_mm = {}
for name, (tracks_m, colour) in moved.items():
    tip = tracks_m[:, 0, 0] - 0.01
    axes[0].plot(seen_s, 1e3 * tip, color=colour, label=f"tip, {name}")
    axes[1].plot(seen_s, 1e3 * (tip - wanted_m), color=colour)
    rms_mm[name] = 1e3 * np.sqrt(np.mean((tip - wanted_m) ** 2))
axes[0].legend()
axes[0].set_ylabel("x [mm]")
axes[1].set_ylabel("error of the tip [mm]")
axes[1].set_xlabel("time [s]")
plt.show()
print("RMS error:", ", ".join(f"{name} {value:.1f} mm" for name, value in rms_mm.items()))
assert rms_mm["planned"] < rms_mm["rigid"] / 2

# %% [markdown]
# The planned hand starts ahead of the tip, and brakes so that the bar is at rest when it arrives.
#
# ## 4.5 Identify again
#
# The execution is a recording, too. First it is compared with the prediction: with fixed constants, a
# run states a verdict on the prediction, as `collocation-sysid solve` does of the file check.toml that the
# command `plan` writes. Then the bar is identified from both recordings (identify.toml).

# %%
samples = slice(0, len(plan.t_s))
execution = plan.execution(plan.t_s, executed_m[samples])
prediction = cs.run(cs.Problem([execution], run.parameters))
print("prediction:", prediction.trust.verdict, *prediction.trust.reasons)
off_mm = 1e3 * (executed_m[samples, 0, 0] - plan.points_m["tip"][:, 0])
print(f"off the predicted tip: {np.std(off_mm):.2f} mm, of which {1e3 * NOISE_M:.2f} mm are noise")
again = cs.run(cs.Problem([recorded, execution], unknown, uncertainty=exact))
for name in ("young_pa", "gamma_r_s"):
    before, after = (
        f"{each.estimates[name].value:.{digits}f} ± {each.std_error(name):.{digits}f}"
        for each in (run, again)
        for digits in [max(0, 1 - int(np.floor(np.log10(each.std_error(name)))))]
    )
    print(f"{name}: {before}, with the execution {after}")
assert again.std_error("gamma_r_s") > 5 * run.std_error("gamma_r_s")

# %% [markdown]
# Because the damping law is wrong, the recordings disagree on $\gamma_r$ by more than their noise. Its
# combined interval contains this difference, and is much wider than that of the first recording.
#
# **Exercise.** Which duration is the shortest with which the tip stays within 3 mm of its path?
#
# **Solution.** The keys `largest_error_m` and `shortest` of the task make the duration free:
# `cs.plan_motion(run, task.model_copy(update={"largest_error_m": 3e-3, "shortest": True}), limits)`.
# The plan's `binding_limits` name the limits of the robot that prevent a shorter motion.
