"""
A hand that moves so that the tip draws a circle
================================================

A soft bar hangs from a hand. The hand is planned such that the free end moves along a circle and is
at rest at the end. A hand that draws the circle itself makes the bar swing.
"""

# sphinx_gallery_thumbnail_path = 'pictures/6_planned_motion.png'
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs

body = cs.Body(cs.box_mesh((0.02, 0.02, 0.12), (1, 1, 4)), density_kg_m3=800.0)
t_s = 0.02 * np.arange(50)
poses = np.tile(np.eye(4), (len(t_s), 1, 1))
poses[:, 0, 3] = 0.02 * np.sin(14 * t_s) * np.minimum(1, t_s / 0.2) ** 3
held = cs.Box((-1, -1, 0.119), (1, 1, 1))
places_m = [(0.01, 0.01, 0.0), (0.0, 0.01, 0.03), (0.02, 0.01, 0.06)]
seen = cs.Markers(
    t_s, np.zeros((len(t_s), 3, 3)), 5e-4, ["tip", "low", "middle"], places_m=places_m
)
swing = cs.Experiment(body, t_s, [cs.Grasp(held, poses)], seen, name="swing")
known = {"poisson": 0.4, "gamma_m_1_s": 0.1}
tracks_m = cs.simulate(swing, {"young_pa": 2e4, "gamma_r_s": 0.01, **known}).markers_m
tracks_m += np.random.default_rng(5).normal(scale=5e-4, size=tracks_m.shape)

# %%
# The constants of the bar come from a recording in which the hand sways. All assumptions are declared
# exact, because the recording is simulated with the same mesh.
unknown = {"young_pa": cs.Unknown(3e4), "gamma_r_s": cs.Unknown(0.02)}
exact = cs.UncertaintyOptions(assumptions=cs.Assumptions.exact())
recorded = cs.with_markers(swing, tracks_m)
run = cs.run(cs.Problem([recorded], {**unknown, **known}, uncertainty=exact))
print(run.table())

# %%
# The task: a circle with a radius of 40 mm in 0.9 s. The limits are those of the robot.
share = np.linspace(0, 1, 91)
angle = 2 * np.pi * share**4 * (35 - 84 * share + 70 * share**2 - 20 * share**3)
circle_m = 0.04 * np.column_stack([1 - np.cos(angle), np.sin(angle), 0 * angle])
reference = {
    "point": "tip",
    "t_s": (0.9 * share).tolist(),
    "position_m": circle_m.tolist(),
    "relative": True,
}
task = cs.Task.model_validate({"duration_s": 0.9, "sample_s": 0.015, "reference": [reference]})
limits = cs.Limits.model_validate(
    {
        "workspace_m": [(-0.3, -0.3, -0.3), (0.3, 0.3, 0.4)],
        "speed_m_s": 1.5,
        "acceleration_m_s2": 15.0,
        "rotation_deg": 60.0,
        "angular_speed_deg_s": 360.0,
        "angular_acceleration_deg_s2": 3000.0,
    }
)
plan = cs.plan_motion(run, task, limits)
error = plan.tracking_error(plan.program.references[0])
print(
    f"largest error of the tip {1e3 * error.largest_m:.2f} mm, 95 % ± {1e3 * error.band_m:.2f} mm"
)
assert error.largest_m < 0.003

# %%
# The film has the hand (dark), the body, and the tip beside its reference.
folder = cs.write_plan(plan, Path(tempfile.mkdtemp()) / "plan")
folder / "motion.gif"

# %%
# From above: the planned hand and the tip, and the tip of a bar whose hand draws the circle itself.
after_s = plan.t_s
rigid = np.tile(np.eye(4), (len(after_s), 1, 1))
rigid[:, :3, 3] = np.column_stack([np.interp(after_s, 0.9 * share, c) for c in circle_m.T])
tip = cs.Markers(after_s, np.zeros((len(after_s), 1, 3)), 5e-4, ["tip"], places_m=places_m[:1])
rigidly = cs.Experiment(body, after_s, [cs.Grasp(held, rigid)], tip, name="rigid")
paths = {
    "tip, planned": plan.points_m["tip"],
    "tip, the hand draws the circle": cs.simulate(rigidly, run.parameters).markers_m[:, 0],
}
for name, path_m in paths.items():
    plt.plot(*(1e3 * (path_m - path_m[0]).T[:2]), label=name)
plt.plot(*1e3 * plan.motion.derivatives(after_s).value.T[:2], label="hand, planned")
plt.plot(*1e3 * circle_m.T[:2], "k--", lw=1, label="reference")
plt.axis("equal")
plt.xlabel("x [mm]")
plt.ylabel("y [mm]")
plt.legend()
plt.show()
