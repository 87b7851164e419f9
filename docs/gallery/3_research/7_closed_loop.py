"""
Plan, execute, identify, plan again
===================================

A soft bar hangs from a hand, and its tip shall draw a circle. The stiffness in the data sheet is
twice the true one. The first plan is executed, the recording of the execution identifies the bar,
and the next plan is made for the identified bar. MuJoCo executes the plans, with another mesh,
another law, another damping and another integrator.
"""

# sphinx_gallery_thumbnail_path = 'pictures/7_closed_loop.png'
from dataclasses import replace

import matplotlib.pyplot as plt
import mujoco
import numpy as np

import collocation_sysid as cs

SIZE_M, MASS_KG, HAND_KG = (0.02, 0.02, 0.12), 0.04, 1e4
SAMPLE_S, STEP_S, LENGTH_S = 0.015, 1e-4, 1.5

# %%
# The true bar: a flex of MuJoCo with 99 nodes, E = 20 kPa, held by a body on three slides.
mesh = cs.box_mesh(SIZE_M, (2, 2, 10))
held = np.flatnonzero(mesh.points_m[:, 2] > 0.119)
MARKED_M = np.array([(0.01, 0.01, 0.0), (0.0, 0.01, 0.036), (0.02, 0.01, 0.072)])
marked = [int(np.linalg.norm(mesh.points_m - each, axis=1).argmin()) for each in MARKED_M]


def words(array) -> str:
    return " ".join(map(str, np.ravel(array).tolist()))


slides = "".join(f'<joint type="slide" axis="{words(axis)}"/>' for axis in np.eye(3, dtype=int))
model = mujoco.MjModel.from_xml_string(f"""
<mujoco>
  <option timestep="{STEP_S}" jacobian="sparse"/>
  <worldbody><body name="hand" gravcomp="1">
    {slides}<inertial pos="0 0 0" mass="{HAND_KG}" diaginertia="1 1 1"/>
    <flexcomp name="bar" type="direct" dim="3" mass="{MASS_KG}" radius="0.0005"
              point="{words(mesh.points_m)}" element="{words(mesh.tetrahedra)}">
      <pin id="{words(held)}"/>
      <contact contype="0" conaffinity="0" selfcollide="none"/>
      <elasticity young="20e3" poisson="0.3" damping="0.004"/>
    </flexcomp>
  </body></worldbody>
</mujoco>""")
free = np.setdiff1d(np.arange(len(mesh.points_m)), held)
# MuJoCo gives all vertices the same mass; here each has a quarter of that of its tetrahedra.
lumped_kg = cs.Body(mesh, mass_kg=MASS_KG).node_mass
model.body_mass[model.flex_vertbodyid[free]] = lumped_kg[free]
mujoco.mj_setConst(model, mujoco.MjData(model))
noise = np.random.default_rng(0)


def execute(motion) -> np.ndarray:
    """Markers (T, 3, 3) of the true bar [m]; a stiff control moves its heavy hand."""
    data = mujoco.MjData(model)
    per_sample = round(SAMPLE_S / STEP_S)
    steps = np.arange(-10_000, round(LENGTH_S / STEP_S) + 1)  # the bar first comes to rest
    place, speed, acceleration = (each[:, :3] for each in motion.derivatives(STEP_S * steps))
    tracks_m = []
    for k, step in enumerate(steps):
        if step >= 0 and step % per_sample == 0:
            mujoco.mj_forward(model, data)
            tracks_m.append(data.flexvert_xpos[marked].copy())
        error, rate = place[k] - data.qpos[:3], speed[k] - data.qvel[:3]
        data.qfrc_applied[:3] = HAND_KG * (acceleration[k] + 300**2 * error + 600 * rate)
        mujoco.mj_step(model, data)
        data.qvel *= 0.997 if step < 0 else 1.0
    return np.array(tracks_m)


# %%
# The bar of the plans: 63 nodes, and a recording in which nothing moves, for the names and places
# of the markers.
body = cs.Body(cs.box_mesh(SIZE_M, (2, 2, 6)), mass_kg=MASS_KG)
t_s = SAMPLE_S * np.arange(10)
still = cs.Experiment(
    body,
    t_s,
    [cs.Grasp(cs.Box((-1, -1, 0.119), (1, 1, 1)), np.tile(np.eye(4), (10, 1, 1)))],
    cs.Markers(t_s, np.zeros((10, 3, 3)), 3e-4, ["tip", "low", "middle"], places_m=MARKED_M),
    air_density_kg_m3="none",
    nuisance=cs.Nuisance.none(),
)
share = np.linspace(0, 1, 91)
angle = 2 * np.pi * share**4 * (35 - 84 * share + 70 * share**2 - 20 * share**3)
circle_m = 0.04 * np.column_stack([1 - np.cos(angle), np.sin(angle), 0 * angle])
reference = {
    "point": "tip",
    "t_s": (1.2 * share).tolist(),
    "position_m": circle_m.tolist(),
    "relative": True,
}
task = cs.Task(duration_s=1.2, sample_s=SAMPLE_S, hand={"intervals": 32}, reference=[reference])
limits = cs.Limits(
    workspace_m=[(-0.3, -0.3, -0.3), (0.3, 0.3, 0.4)],
    speed_m_s=1.5,
    acceleration_m_s2=15.0,
    rotation_deg=60.0,
    angular_speed_deg_s=360.0,
    angular_acceleration_deg_s2=3000.0,
)

# %%
# Three rounds. Each plan uses the constants that all executions before it have identified. The
# error of the tip counts during the motion and 0.3 s after it.
guesses = {"young_pa": 40e3, "gamma_r_s": 0.01}
after_s = SAMPLE_S * np.arange(round(LENGTH_S / SAMPLE_S) + 1)
wanted_m = np.column_stack([np.interp(after_s, 1.2 * share, c) for c in circle_m.T])
executions, tips_m, errors_mm = [], [], []
for number in (1, 2, 3):
    unknown = {name: cs.Unknown(value) for name, value in guesses.items()}
    constants = {**unknown, "poisson": 0.3, "gamma_m_1_s": 0.0}
    plan = cs.plan_motion(cs.Problem([still], constants), task, limits)
    tracks_m = execute(plan.motion)
    noisy_m = tracks_m + noise.normal(scale=3e-4, size=tracks_m.shape)
    executions.append(replace(plan.execution(after_s, noisy_m), name=f"round {number}"))
    tips_m.append(tracks_m[:, 0] - tracks_m[0, 0])
    errors_mm.append(1e3 * np.linalg.norm(tips_m[-1] - wanted_m, axis=1))
    print(f"round {number}: E = {guesses['young_pa']:.0f} Pa,", end=" ")
    print(f"error of the tip {errors_mm[-1].mean():.2f} mm, at most {errors_mm[-1].max():.2f} mm")
    found = cs.solve(cs.Problem(executions, constants)).parameters
    guesses = {name: found[name] for name in guesses}
assert all(each.mean() < 0.1 * errors_mm[0].mean() for each in errors_mm[1:])

# %%
# From above, and the distance of the tip from the circle. After the second round, the remaining error
# is that of mesh, law and damping, and of the plan itself.
_, (above, over_time) = plt.subplots(1, 2, figsize=(10, 4))
for number, (tip_m, error_mm) in enumerate(zip(tips_m, errors_mm, strict=True), 1):
    above.plot(*1e3 * tip_m.T[:2], label=f"tip, round {number}")
    over_time.semilogy(after_s, error_mm, label=f"round {number}")
above.plot(*1e3 * circle_m.T[:2], "k--", lw=1, label="reference")
above.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
over_time.set(xlabel="time [s]", ylabel="error of the tip [mm]", ylim=(0.05, None))
above.legend(loc="center", fontsize="small")
over_time.legend()
plt.show()
