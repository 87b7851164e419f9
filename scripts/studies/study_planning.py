"""Execution of planned motions by a body of another program: MuJoCo's flex.

A cylinder of MuJoCo (energy of St. Venant and Kirchhoff, damping of MuJoCo, a fine mesh) is recorded
once. A body of this package with a coarser mesh and default damping law is identified from six noisy
markers. Six motions are planned and executed in MuJoCo: the tip moves along a circle, moves by
200 mm from rest to rest along a path of least jerk, by a hand that moves during the same time, that
may begin 0.1 s earlier and end 0.1 s later, or that may turn, or on any path, and stays where it is
while the hand moves by 50 mm. The tip is compared with its
reference for the plan, and for hands that move as if the body were rigid, with and without a
zero-vibration shaper.

    python scripts study_planning
    python scripts study_planning --tasks circle
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
from script_arguments import make_parser
from studies import markdown, number

import collocation_sysid as cs
from collocation_sysid.common.array_types import Array
from collocation_sysid.extras.planning import MotionPlan, Task, plan_motion
from collocation_sysid.extras.planning.hand_limits import Limits

mujoco: Any = import_module("mujoco")

HEIGHT_M, RADIUS_M, MASS_KG = 0.12, 0.02, 0.06
PLANT = {"young_pa": 20e3, "poisson": 0.3, "gamma_r_s": 4e-3}
MATERIAL = "st-venant-kirchhoff"
PLANT_MESH, MODEL_MESH = (2, 10), (2, 6)  # rings and layers
# Time step of MuJoCo and time between samples [s].
STEP_S, SAMPLE_S = 1e-4, 0.01
SETTLING_S = 1.2
# Natural frequency of the control of MuJoCo's hand [rad/s], and its mass [kg] and inertia [kg m²],
# beside which those of the body are negligible.
CONTROL_RAD_S, HAND_KG = 300.0, 1e4
NOISE_M = 3e-4
# Time after each motion in which the tip is compared with its reference [s].
AFTER_S = 0.5
TIP_M = np.array([[0.0, 0.0, 0.0]])
LIMITS = Limits.model_validate(
    {
        "workspace_m": ((-0.4, -0.4, -0.3), (0.4, 0.4, 0.4)),
        "speed_m_s": 2.0,
        "acceleration_m_s2": 20.0,
        "rotation_deg": 60.0,
        "angular_speed_deg_s": 360.0,
        "angular_acceleration_deg_s2": 5000.0,
    }
)
# Coordinates (T, 6) of the hand at times since the start [s].
Motion = Callable[[Array], Array]


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--tasks", nargs="*", choices=list(TASKS), default=list(TASKS))
    arguments = parser.parse_args()
    plant = Plant()
    recorded = recording(plant)
    exact = cs.UncertaintyOptions(assumptions=cs.Assumptions.exact())
    run = cs.run(cs.Problem([recorded], unknown(), uncertainty=exact))
    print(run.table(), run.trust.verdict, *run.trust.reasons, sep="\n    ", flush=True)
    rows = []
    for name in arguments.tasks:
        wanted = TASKS[name]()
        plan = plan_motion(run, wanted.task, LIMITS)
        motions: dict[str, Motion] = {"rigid": wanted.rigid_hand}
        motions["plan"] = lambda t_s, plan=plan: plan.motion.derivatives(t_s).value
        motions["rigid, shaped"] = Shaper.at(plan, run).shaped(wanted)
        for title, motion in motions.items():
            t_s, tip = executed(plant, motion, wanted.task.duration_s + AFTER_S)
            values = errors_of(t_s, tip, wanted)
            rows.append((name, title, *(number(value, 1e3) for value in values)))
            print(*rows[-1], f"hand off by {1e6 * plant.lag_m:.2g} µm", flush=True)
            if title == "plan":
                print(band_report(tip, plan), flush=True)
    print(markdown(("task", "hand", "RMS mm", "largest mm", "residual vibration mm"), rows))


# The plant ----------------------------------------------------------------------------------------


class Plant:
    """Cylinder of MuJoCo that hangs from a hand with the coordinates x, y, z and angle about y."""

    def __init__(self) -> None:
        mesh = cs.cylinder_mesh(RADIUS_M, HEIGHT_M, *PLANT_MESH)
        self.tip = int(np.linalg.norm(mesh.points_m - TIP_M, axis=1).argmin())
        held = np.flatnonzero(mesh.points_m[:, 2] > HEIGHT_M - 1e-3)
        self.points_m = mesh.points_m
        self.model = mujoco.MjModel.from_xml_string(_description(mesh, held))
        self.data = mujoco.MjData(self.model)
        # Each free vertex gets a quarter of the mass of each of its tetrahedra.
        body = cs.Body(mesh, mass_kg=MASS_KG)
        free = np.setdiff1d(np.arange(len(mesh.points_m)), held)
        self.model.body_mass[self.model.flex_vertbodyid[free]] = body.node_mass[free]
        mujoco.mj_setConst(self.model, self.data)
        self._settle()
        self.state = self.data.qpos.copy(), self.data.qvel.copy()

    def _settle(self) -> None:
        for _ in range(round(SETTLING_S / STEP_S)):
            self._step(np.zeros(4), np.zeros(4), np.zeros(4))
            self.data.qvel *= 0.997

    def _step(self, place: Array, speed: Array, acceleration: Array) -> None:
        data = self.data
        error, rate = place - data.qpos[:4], speed - data.qvel[:4]
        wanted = acceleration + CONTROL_RAD_S**2 * error + 2 * CONTROL_RAD_S * rate
        wanted[2] += 9.81
        data.qfrc_applied[:4] = HAND_KG * wanted
        mujoco.mj_step(self.model, data)

    def simulate(self, motion: Motion, time_s: float) -> tuple[Array, Array, Array]:
        """Return times (T,) [s], positions (T, n, 3) of the vertices [m], and poses (T, 4, 4)."""
        self.data.qpos[:], self.data.qvel[:] = self.state
        count = round(time_s / SAMPLE_S)
        each = round(SAMPLE_S / STEP_S)
        fine_s = STEP_S * np.arange(count * each + 2.0)
        places = motion(fine_s)[:, [0, 1, 2, 4]]
        speeds = np.gradient(places, STEP_S, axis=0)
        accelerations = np.gradient(speeds, STEP_S, axis=0)
        positions, poses = [], np.tile(np.eye(4), (count + 1, 1, 1))
        for sample in range(count + 1):
            mujoco.mj_forward(self.model, self.data)
            positions.append(self.data.flexvert_xpos.copy())
            hand = self.data.body("hand")
            poses[sample, :3, 3], poses[sample, :3, :3] = hand.xpos, hand.xmat.reshape(3, 3)
            if sample == count:
                break
            for k in range(sample * each, (sample + 1) * each):
                self._step(places[k], speeds[k], accelerations[k])
        self.lag_m = float(np.abs(self.data.qpos[:4] - places[count * each]).max())
        return SAMPLE_S * np.arange(count + 1.0), np.array(positions), poses


def _description(mesh: cs.TetMesh, held: Any) -> str:
    """Return MuJoCo's description of the hand and the cylinder."""

    def words(array: Any) -> str:
        return " ".join(map(str, np.ravel(array).tolist()))

    slides = "".join(
        f'<joint name="{name}" type="slide" axis="{axis}"/>'
        for name, axis in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1"))
    )
    return f"""
<mujoco>
  <option timestep="{STEP_S}" jacobian="sparse"/>
  <worldbody>
    <body name="hand">
      {slides}
      <joint name="about_y" type="hinge" axis="0 1 0" pos="0 0 {HEIGHT_M}"/>
      <inertial pos="0 0 {HEIGHT_M}" mass="{HAND_KG}" diaginertia="{HAND_KG} {HAND_KG} {HAND_KG}"/>
      <flexcomp name="foam" type="direct" dim="3" mass="{MASS_KG}" radius="0.0005"
                point="{words(mesh.points_m)}" element="{words(mesh.tetrahedra)}">
        <pin id="{words(held)}"/>
        <contact contype="0" conaffinity="0" selfcollide="none"/>
        <elasticity young="{PLANT["young_pa"]}" poisson="{PLANT["poisson"]}"
                    damping="{PLANT["gamma_r_s"]}"/>
      </flexcomp>
    </body>
  </worldbody>
</mujoco>"""


# Identification -----------------------------------------------------------------------------------


def swing(t_s: Array) -> Array:
    """Return the coordinates (T, 6) of the hand in the recording."""
    coordinates = np.zeros((len(t_s), 6))
    begins = np.clip(t_s / 0.2, 0, 1) ** 3
    coordinates[:, 0] = 0.02 * np.sin(16 * t_s) * begins
    coordinates[:, 2] = 0.015 * np.sin(23 * t_s) * begins
    coordinates[:, 4] = 0.15 * np.sin(11 * t_s) * begins
    return coordinates


def recording(plant: Plant) -> cs.Experiment:
    """Return the recording of six noisy markers of the plant with a body of the coarse mesh."""
    t_s, positions_m, poses = plant.simulate(swing, 1.2)
    wanted = 1e-3 * np.array(
        [[0, 0, 0], [20, 0, 0], [0, 20, 24], [-20, 0, 48], [0, -20, 72], [20, 0, 96]]
    )
    nodes = [int(np.linalg.norm(plant.points_m - each, axis=1).argmin()) for each in wanted]
    tracks_m = positions_m[:, nodes]
    tracks_m = tracks_m + np.random.default_rng(0).normal(scale=NOISE_M, size=tracks_m.shape)
    names = ["tip", *(f"side_{k}" for k in range(1, len(nodes)))]
    markers = cs.Markers(t_s, tracks_m, NOISE_M, names, places_m=plant.points_m[nodes])
    mesh = cs.cylinder_mesh(RADIUS_M, HEIGHT_M, *MODEL_MESH)
    held = np.flatnonzero(mesh.points_m[:, 2] > HEIGHT_M - 1e-3)
    return cs.Experiment(
        cs.Body(mesh, MATERIAL, mass_kg=MASS_KG),
        t_s,
        [cs.Grasp(held, poses)],
        markers,
        name="swing",
        nuisance=cs.Nuisance.none(),
        air_density_kg_m3="none",
    )


def unknown() -> dict[str, Any]:
    """Return the parameters that are estimated."""
    free = {name: cs.Unknown() for name in ("young_pa", "gamma_r_s", "gamma_m_1_s")}
    return {**free, "poisson": PLANT["poisson"]}


# Tasks --------------------------------------------------------------------------------------------


def smooth(t_s: Array, duration_s: float) -> Array:
    """Return the share of the way of the motion with the least jerk from rest to rest."""
    share = np.clip(t_s / duration_s, 0, 1)
    return share**3 * (10 - 15 * share + 6 * share**2)


@dataclass(frozen=True)
class Wanted:
    """Task, and the hand that would do it if the body were rigid."""

    task: Task
    # Displacement (T, 3) of the tip from its place before the motion, by the share of the way.
    tip: Motion
    hand: Motion  # coordinates (T, 6) of the rigid hand, by the share of the way
    from_s: float = 0.0  # time from which the tip is compared with its reference [s]
    # Time for which the planned hand may move before the tip does, and after it [s].
    lead_s: float = 0.0

    @property
    def way_s(self) -> float:
        """Time in which the tip moves [s]."""
        return self.task.duration_s - 2 * self.lead_s

    def tip_at(self, t_s: Array) -> Array:
        """Return the displacement (T, 3) of the tip from its place before the motion [m]."""
        return self.tip(smooth(t_s - self.lead_s, self.way_s))

    def rigid_hand(self, t_s: Array) -> Array:
        """Return the coordinates (T, 6) of the hand of a rigid body."""
        return self.hand(smooth(t_s - self.lead_s, self.way_s))


def _task(way_s: float, tip: Motion, lead_s: float = 0.0, **hand: Any) -> Task:
    t_s = np.linspace(0, way_s, 101)
    standing = [0.0] if lead_s else []
    after = np.arange(0.1, lead_s + 0.35, 0.1)
    t_s = np.concatenate([standing, lead_s + t_s, lead_s + way_s + after])
    reference = {
        "point": "tip",
        "t_s": t_s.tolist(),
        "position_m": [tuple(each) for each in tip(smooth(t_s - lead_s, way_s)).tolist()],
        "relative": True,
    }
    return Task.model_validate(
        {
            "duration_s": way_s + 2 * lead_s,
            "sample_s": SAMPLE_S,
            "reference": [reference],
            "end": {"window_s": 0.3},
            "hand": {"intervals": 24} | hand,
        }
    )


def circle() -> Wanted:
    """The tip moves along a circle with a radius of 50 mm in 1 s."""

    def tip(share: Array) -> Array:
        angle = 2 * np.pi * share
        return 0.05 * np.column_stack([1 - np.cos(angle), np.sin(angle), 0 * angle])

    return Wanted(_task(1.0, tip), tip, lambda share: np.pad(tip(share), ((0, 0), (0, 3))))


def straight() -> Wanted:
    """The tip moves by 200 mm in 0.5 s, and rests."""

    def tip(share: Array) -> Array:
        return np.outer(share, [0.2, 0.0, 0.0])

    return Wanted(_task(0.5, tip), tip, lambda share: np.pad(tip(share), ((0, 0), (0, 3))))


def ahead() -> Wanted:
    """The same by a hand that may move 0.1 s before the tip does, and 0.1 s after it."""
    wanted = straight()
    return replace(wanted, task=_task(0.5, wanted.tip, 0.1, intervals=32), lead_s=0.1)


def turning() -> Wanted:
    """The same by a hand that may turn, within the 0.5 s."""
    wanted = straight()
    free = wanted.task.hand.model_copy(update={"free": ["x", "z", "ry"], "jerk_weight": 1e-5})
    return replace(wanted, task=wanted.task.model_copy(update={"hand": free}))


def arrival() -> Wanted:
    """The tip arrives 200 mm away after 0.5 s, on any path, and rests."""
    wanted = straight()
    (reference,) = wanted.task.reference
    late = reference.model_copy(update={"from_s": wanted.task.duration_s})
    task = wanted.task.model_copy(update={"reference": [late]})
    return Wanted(task, wanted.tip, wanted.hand, from_s=task.duration_s)


def still() -> Wanted:
    """The tip stays while the hand moves by 50 mm in 0.5 s, and turns."""

    def tip(share: Array) -> Array:
        return np.zeros((len(share), 3))

    def hand(share: Array) -> Array:
        angle = np.arcsin(0.05 / HEIGHT_M) * share
        coordinates = np.zeros((len(share), 6))
        coordinates[:, 0] = HEIGHT_M * np.sin(angle)
        coordinates[:, 2] = HEIGHT_M * (np.cos(angle) - 1)
        coordinates[:, 4] = angle
        return coordinates

    task = _task(0.5, tip, free=["x", "z", "ry"], end_m=(0.05, 0.0, np.nan))
    return Wanted(task, tip, hand)


TASKS = {
    "circle": circle,
    "straight": straight,
    "ahead": ahead,
    "turning": turning,
    "arrival": arrival,
    "still": still,
}


@dataclass(frozen=True)
class Shaper:
    """Zero-vibration shaper: two impulses, half a damped period apart."""

    delay_s: float
    first: float

    @classmethod
    def at(cls, plan: MotionPlan, run: Any) -> Shaper:
        """Return the shaper of the lowest mode of the identified body."""
        omega = 2 * np.pi * plan.program.lowest_hz
        values = {name: run.estimates[name].value for name in ("gamma_r_s", "gamma_m_1_s")}
        ratio = values["gamma_r_s"] * omega / 2 + values["gamma_m_1_s"] / (2 * omega)
        root = np.sqrt(1 - ratio**2)
        return cls(np.pi / (omega * root), 1 / (1 + np.exp(-ratio * np.pi / root)))

    def shaped(self, wanted: Wanted) -> Motion:
        """Return the rigid hand, shaped; both impulses are within the time in which the tip moves."""
        way_s = wanted.way_s - self.delay_s

        def motion(t_s: Array) -> Array:
            begins = wanted.lead_s, wanted.lead_s + self.delay_s
            parts = [wanted.hand(smooth(t_s - begin_s, way_s)) for begin_s in begins]
            return self.first * parts[0] + (1 - self.first) * parts[1]

        return motion


# Execution ----------------------------------------------------------------------------------------


def executed(plant: Plant, motion: Motion, time_s: float) -> tuple[Array, Array]:
    """Return times (T,) [s] and displacements (T, 3) [m] of the tip of the plant."""
    t_s, positions_m, _ = plant.simulate(motion, time_s)
    tip = positions_m[:, plant.tip]
    return t_s, tip - tip[0]


def errors_of(t_s: Array, tip: Array, wanted: Wanted) -> tuple[float, float, float]:
    """Return RMS and largest distance of the tip from its reference, and the largest distance from
    its mean place after the motion [m].
    """
    distance = np.linalg.norm(tip - wanted.tip_at(t_s), axis=1)
    distance = distance[t_s >= wanted.from_s - 1e-9]
    after = tip[t_s >= wanted.task.duration_s - 1e-9]
    vibration = np.linalg.norm(after - after.mean(axis=0), axis=1).max()
    return float(np.sqrt(np.mean(distance**2))), float(distance.max()), float(vibration)


def band_report(tip: Array, plan: MotionPlan) -> str:
    """Return the state of a plan, and how its band agrees with the executed tip."""
    half = plan.half_widths_m
    assert half is not None
    predicted = plan.expected_m["tip"]
    off = np.abs(tip[: len(predicted)] - (predicted - predicted[0]))
    error = plan.tracking_error(plan.program.references[0])
    return (
        f"plan: {plan.answer.status} in {plan.seconds:.1f} s, predicted RMS "
        f"{1e3 * error.rms_m:.3g} mm, largest {1e3 * error.largest_m:.3g} mm, band ± "
        f"{1e3 * half['tip'].max():.3g} mm; the executed tip is off the prediction by up to "
        f"{1e3 * off.max():.3g} mm, with {100 * (off <= half['tip']).mean():.0f} % of its coordinates "
        "inside the band"
    )


if __name__ == "__main__":
    main()
