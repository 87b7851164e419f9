"""Nuisance parameters φ of an experiment: places, clock, gravity, the body in its grasp, cameras.

Every φ is a number of prior standard deviations, so that its prior is φ² in the loss. In their
order, those that the experiment's `Nuisance` names:

=====================  ====================================================================
place of each marker   X_m on the undeformed body, two or three a marker [m], see `charts`
camera offset          b_m of each marker, three [m]
time shift             τ [s]
turn of the pose       a (3), Cayley's parameters times two: to third order a rotation vector
shift of the pose      d (3) [m]
tilt of gravity        two angles about axes across it [rad]
turn in the grasp      a_h (3), likewise, about axes of the undeformed body
shift in the grasp     d_h (3) [m]
zero of a grasp        of each axis along which a displacement's zero is not known [m]
tare of a sensor       of each component that it measures [N] or [N m], see `sensor`
its clock              τ, how much later than its times say it measured [s]
its lag                T of a first-order low-pass [s]
its tool               mass [kg], and centre (3) about the sensor's point [m]
factor                 f less one, of each tension, and of each pressure
lost                   b of each tension [N], and of each pressure [Pa]
joining                how much later than stated a point mass or force joins, or leaves [s]
=====================  ====================================================================

Grasps and body are off by the rigid motion x' = R(a) (x − c) + c + d in the frame of the markers,
c being the middle of the undeformed body in its first pose. In the body's frame that changes
nothing but what the markers read, and the direction of gravity, which becomes R(a)ᵀ g.

In the grasp the undeformed body is off by H X = R(a_h) (X − c_h) + c_h + d_h, c_h being the middle
of the grasped nodes: they are held at U_t H X.

A tension T is max(0, f T − b) at the body, a pressure p is f p − b.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeVar, get_args

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..experiment.actuator import Actuator
from ..experiment.experiment import Experiment
from ..experiment.grasp import Grasp, held_nodes
from ..experiment.loads import Change, Force, PointMass
from ..experiment.wrench import COMPONENTS, UNITS

Load = TypeVar("Load", PointMass, Force)

# Samples are read between neighbours, up to this many away from the chart's.
LARGEST_SHIFT_SAMPLES = 2.0
# A time shift may be this share of the recording.
LARGEST_SHIFT_SHARE = 0.25
# The clock and the lag of a sensor may be this many deviations of their priors.
SENSOR_DEVIATIONS = 3.0
# A load joins within this many standard deviations of its prior, further than any that is right,
# and within the recording: not quite at its ends, where it would join at once or never.
LARGEST_DELAY, NARROWER = 4.0, 1 - 1e-9
# A place may move this many edges of the mesh in a step.
EDGES_A_STEP = 2.0
KINDS = (
    "place",
    "offset",
    "time",
    "turn",
    "shift",
    "tilt",
    "grasp-turn",
    "grasp-shift",
    "factor",
    "lost",
    "joining",
)
# Those of a grasp's zero have its number behind them.
OF_GRASP = "zero"
# Those of a sensor have its number behind them: "tare 0".
OF_SENSOR = ("tare", "sensor-time", "sensor-lag", "tool-mass", "tool-centre")
# The time at which a load joins may move this many samples in a step.
SAMPLES_A_STEP = 2.0


class Timed(NamedTuple):
    """A load that joins or leaves at an estimated time."""

    load: PointMass | Force
    change: Change

    @property
    def stated_s(self) -> float:
        """The time stated."""
        return getattr(self.load, self.change)


@dataclass(frozen=True, eq=False)
class NuisanceMap:
    """φ of one experiment: what each is, and the gravity and grasps it makes.

    Attributes
    ----------
    names : (k,) with units, such as "swing: place of tip, x [m]"
    kinds : (k,) of `KINDS`, or of `OF_SENSOR` with the sensor's number
    scales : (k,) prior standard deviations, in the names' units
    reach : (k,) φ that a step may move at a time: what enters linearly needs no trust region
    interval_s : float, between samples
    duration_s : float
    gravity_m_s2 : (3,) as stated
    pivot_m : (3,) c
    grasp_pivot_m : (3,) c_h
    stated_off : (A, 2) f and b of tensions and pressures as stated
    driving : (A, 2) which φ their estimates are, −1 where they have none
    timed : of each φ of the kind "joining", what joins or leaves
    recorded_s : first and last time of the recording
    """

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    scales: Array
    reach: Array
    interval_s: float
    duration_s: float
    gravity_m_s2: Array
    pivot_m: Array
    grasp_pivot_m: Array
    stated_off: Array
    driving: Index
    timed: tuple[Timed, ...]
    recorded_s: tuple[float, float]

    @classmethod
    def of(cls, experiment: Experiment) -> NuisanceMap:
        """What the experiment wants estimated."""
        entries = _entries(experiment)
        kinds, labels, scales = zip(*entries, strict=True) if entries else ((), (), ())
        scales = np.array(scales, dtype=float)
        body = experiment.body
        edge_m = float(body.mesh.quality().edge_mean_m)
        linear = np.array([k in ("offset", "shift") or k.startswith("tare") for k in kinds])
        reach = np.where(linear, 1e3, 1.0).astype(float)
        of_place = np.array([kind == "place" for kind in kinds], dtype=bool)
        reach[of_place] = np.minimum(1e3, EDGES_A_STEP * edge_m / scales[of_place])
        of_joining = np.array([kind == "joining" for kind in kinds], dtype=bool)
        joining_s = SAMPLES_A_STEP * experiment.timestep_s
        reach[of_joining] = np.minimum(1.0, joining_s / scales[of_joining])
        held = held_nodes(experiment.grasps)
        return cls(
            tuple(f"{experiment.name}: {label}" for label in labels),
            tuple(kinds),
            scales,
            reach,
            experiment.timestep_s,
            experiment.duration_s,
            np.array(experiment.gravity_m_s2),
            experiment.rigid_positions(experiment.t_s[:1])[0].mean(axis=0),
            body.nodes_m[held if len(held) else slice(None)].mean(axis=0),
            np.array([a.off for a in experiment.actuators]).reshape(-1, 2),
            _driving(experiment, labels),
            tuple(timed for _, timed in _timed(experiment)),
            (float(experiment.t_s[0]), float(experiment.t_s[-1])),
        )

    @property
    def size(self) -> int:
        """Number k of φ."""
        return len(self.names)

    def places(self, *kinds: str) -> NDArray[np.int64]:
        """Positions in φ of some kinds."""
        return np.array([i for i, kind in enumerate(self.kinds) if kind in kinds], dtype=np.int64)

    @cached_property
    def moving(self) -> NDArray[np.int64]:
        """Positions in φ of what changes the motion: gravity, grasps, loads and what drives it."""
        zeros = {kind for kind in self.kinds if kind.startswith(OF_GRASP)}
        kinds = ("turn", "tilt", "grasp-turn", "grasp-shift", *zeros, "joining", "factor", "lost")
        return self.places(*kinds)

    @cached_property
    def of_drives(self) -> NDArray[np.int64]:
        """Positions in φ of what tensions and pressures may be off by."""
        return self.places("factor", "lost")

    def drives(self, phi: Array) -> tuple[Array, Array]:
        """F and b (A, 2) of tensions and pressures, and their derivatives (2 A, k) by φ."""
        slopes = np.zeros((self.driving.size, self.size))
        estimated = np.flatnonzero(self.driving.ravel() >= 0)
        places = self.driving.ravel()[estimated]
        slopes[estimated, places] = self.scales[places]
        return self.stated_off + (slopes @ phi).reshape(-1, 2), slopes

    @cached_property
    def moves_grasps(self) -> bool:
        """Whether the body may be off in its grasps, or these in their zero."""
        return len(np.setdiff1d(self.moving, self.places("turn", "tilt"))) > 0

    def zero(self, number: int) -> NDArray[np.int64]:
        """Positions in φ of the zeros of a grasp, along its axes in turn."""
        return self.places(f"{OF_GRASP} {number}")

    def zero_m(self, number: int, grasp: Grasp, phi: Array) -> Array:
        """(3,) by how much a grasp is off."""
        found = np.zeros(3)
        for axis, place in zip(grasp.zero, self.zero(number), strict=False):
            found["xyz".index(axis)] = phi[place] * self.scales[place]
        return found

    def limits(self, samples: int) -> tuple[Array, Array]:
        """Lowest and highest φ (k,), where samples are read about this many whole ones away."""
        low, high = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        for k in self.places("time"):
            about, unit = samples * self.interval_s, self.scales[k]
            around = LARGEST_SHIFT_SAMPLES * self.interval_s
            furthest = max(around, LARGEST_SHIFT_SHARE * self.duration_s)
            low[k] = max(about - around, -furthest) / unit
            high[k] = min(about + around, furthest) / unit
        for k, kind in enumerate(self.kinds):
            if kind.startswith(("sensor-time", "sensor-lag", "tool-mass")):
                low[k] = -SENSOR_DEVIATIONS if kind.startswith("sensor-time") else 0.0
                high[k] = np.inf if kind.startswith("tool-mass") else SENSOR_DEVIATIONS
        for k, timed in zip(self.places("joining"), self.timed, strict=True):
            way = (np.array(self.recorded_s) - timed.stated_s) / self.scales[k]
            low[k], high[k] = np.clip(NARROWER * way, -LARGEST_DELAY, LARGEST_DELAY)
        return low, high

    def with_times(self, experiment: Experiment, phi: Array) -> Experiment:
        """The experiment with its loads joining and leaving when φ says."""
        if not self.timed:
            return experiment
        late_s = (phi * self.scales)[self.places("joining")]

        def moved(load: Load) -> Load:
            times = {
                timed.change: timed.stated_s + float(late)
                for timed, late in zip(self.timed, late_s, strict=True)
                if timed.load is load
            }
            return replace(load, **times) if times else load

        masses, forces = map(moved, experiment.masses), map(moved, experiment.forces)
        return replace(experiment, masses=masses, forces=forces)

    def of_sensor(self, kind: str, number: int) -> NDArray[np.int64]:
        """Positions in φ of what is not known of a sensor."""
        return self.places(f"{kind} {number}")

    @cached_property
    def of_grasps(self) -> NDArray[np.int64]:
        """Positions in φ of what moves the body in its grasps."""
        return self.places("grasp-turn", "grasp-shift")

    def carried(self, points_m: Array, phi: Array) -> tuple[Array, Array]:
        """H X of points (m, 3), and its derivatives (m, 3, h) by φ of `of_grasps`."""
        if not len(self.of_grasps):
            return points_m, np.zeros((len(points_m), 3, 0))
        own = np.repeat(phi[self.of_grasps, None], len(points_m), axis=1)
        value, first = self._carried.map(len(points_m))(own, points_m.T)
        slopes = first.full().reshape(3, len(points_m), -1).transpose(1, 0, 2)
        return value.full().T, slopes

    def carried_curvature(self, points_m: Array, phi: Array) -> Array:
        """Second derivatives (m, 3, h, h) of H X by φ of `of_grasps`."""
        if not len(self.of_grasps):
            return np.zeros((len(points_m), 3, 0, 0))
        own, count = phi[self.of_grasps], len(points_m)
        second = self._carried_curvature.map(count)(
            np.repeat(own[:, None], count, axis=1), points_m.T
        )
        shaped = [h.full().reshape(len(own), count, -1).transpose(1, 0, 2) for h in second]
        return np.stack(shaped, axis=1)

    @cached_property
    def _carried(self) -> ca.Function:
        phi, point, moved = self._moved
        first = ca.densify(ca.jacobian(moved, phi))
        return ca.Function("carried", [phi, point], [moved, first])

    @cached_property
    def _carried_curvature(self) -> ca.Function:
        phi, point, moved = self._moved
        second = [ca.densify(ca.hessian(moved[i], phi)[0]) for i in range(3)]
        return ca.Function("carried_curvature", [phi, point], second)

    @cached_property
    def _moved(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """φ of the grasps, X, and H X."""
        phi, point = ca.SX.sym("phi", len(self.of_grasps)), ca.SX.sym("X", 3)
        kinds, moved = [self.kinds[k] for k in self.of_grasps], point
        values = phi * self.scales[self.of_grasps]
        if turn := [k for k, kind in enumerate(kinds) if kind == "grasp-turn"]:
            pivot = ca.DM(self.grasp_pivot_m)
            moved = rotation(values[turn]) @ (point - pivot) + pivot
        if shift := [k for k, kind in enumerate(kinds) if kind == "grasp-shift"]:
            moved = moved + values[shift]
        return phi, point, moved

    def in_grasp(self, phi: Array) -> Array:
        """H as a 4×4 matrix [[R, p], [0, 1]]."""
        images, _ = self.carried(np.vstack([np.zeros(3), np.eye(3)]), phi)
        matrix = np.eye(4)
        matrix[:3] = np.column_stack([(images[1:] - images[0]).T, images[0]])
        return matrix

    def gravity(self, phi: Array) -> tuple[Array, Array, Array]:
        """Gravity (3,) in the body's frame, and its derivatives by φ: (3, k) and (3, k, k)."""
        own, first = self.of_gravity, np.zeros((3, self.size))
        second = np.zeros((3, self.size, self.size))
        if not len(own):
            return self.gravity_m_s2, first, second
        value, slopes, *curvatures = (part.full() for part in self._gravity(phi[own]))
        first[:, own] = slopes
        second[:, own[:, None], own] = curvatures
        return value.ravel(), first, second

    @cached_property
    def of_gravity(self) -> NDArray[np.int64]:
        """Positions in φ of what turns gravity, in the body's frame."""
        return self.places("tilt", "turn")

    @cached_property
    def _gravity(self) -> ca.Function:
        phi = ca.SX.sym("phi", len(self.of_gravity))
        gravity = self.gravity_expression(phi)
        second = [ca.densify(ca.hessian(gravity[i], phi)[0]) for i in range(3)]
        return ca.Function("gravity", [phi], [gravity, ca.jacobian(gravity, phi), *second])

    def gravity_expression(self, phi: ca.SX) -> ca.SX:
        """Gravity (3,) in the body's frame, of the φ of `of_gravity`."""
        values = phi * self.scales[self.of_gravity][:, None]
        kinds, gravity = [self.kinds[k] for k in self.of_gravity], ca.DM(self.gravity_m_s2)
        if tilt := [k for k, kind in enumerate(kinds) if kind == "tilt"]:
            gravity = self._tilted(values[tilt])
        if turn := [k for k, kind in enumerate(kinds) if kind == "turn"]:
            gravity = rotation(values[turn]).T @ gravity
        return ca.SX(gravity)

    def _tilted(self, angles: ca.SX) -> ca.SX:
        size = float(np.linalg.norm(self.gravity_m_s2))
        if size == 0:
            return ca.SX(ca.DM(self.gravity_m_s2))
        down = self.gravity_m_s2 / size
        # Two axes across gravity: those that complete it to a basis.
        across = np.linalg.svd(down[None])[2][1:]
        tilted = down + ca.mtimes(ca.DM(across.T), angles)
        return ca.SX(size * tilted / ca.norm_2(tilted))


def _entries(experiment: Experiment) -> list[tuple[str, str, float]]:
    """Kind, label and deviation of every φ."""
    wanted, markers, entries = experiment.nuisance, experiment.markers, []
    axes = ("first", "second") if markers.on_surface else tuple("xyz")
    for marker, sigma_m in zip(markers.names, experiment.place_sigma_m, strict=True):
        if sigma_m > 0:
            entries += [("place", f"place of {marker}, {axis} [m]", sigma_m) for axis in axes]

    def add(kind: str, what: str, unit: str, sides: str, deviation: float | None) -> None:
        if deviation:
            entries.extend((kind, f"{what}, {s} [{unit}]", deviation) for s in sides.split())

    for marker in markers.names:
        add("offset", f"camera offset of {marker}", "m", "x y z", wanted.camera_offset_m)
    if wanted.time_shift_s and not experiment.static:
        entries.append(("time", "time shift [s]", wanted.time_shift_s))
    add("turn", "turn of the pose", "rad", "x y z", wanted.pose_turn_rad)
    add("shift", "shift of the pose", "m", "x y z", wanted.pose_shift_m)
    if np.any(experiment.gravity_m_s2):
        add("tilt", "tilt of gravity", "rad", "first second", wanted.gravity_rad)
    # Nothing but what markers see tells how the body is off in its grasp.
    if experiment.grasps and experiment.start == "equilibrium" and markers.names:
        add("grasp-turn", "turn in the grasp", "rad", "x y z", wanted.hand_eye_rad)
        add("grasp-shift", "shift in the grasp", "m", "x y z", wanted.hand_eye_m)
    for k, grasp in enumerate(experiment.grasps):
        which = f"zero of grasp {k + 1}"
        add(f"{OF_GRASP} {k}", which, "m", " ".join(grasp.zero), wanted.displacement_zero_m)
    for actuator in experiment.actuators:
        factor, lost = wanted.off(actuator)
        if factor:
            entries.append(("factor", _factor_of(actuator.name), factor))
        if lost:
            entries.append(("lost", _lost_of(actuator), lost))
    entries += [("joining", label, wanted.joining_s) for label, _ in _timed(experiment)]
    return entries + _sensor_entries(experiment)


def _sensor_entries(experiment: Experiment) -> list[tuple[str, str, float]]:
    """The same of the sensors of the grasps."""
    wanted, entries = experiment.nuisance, []
    wrenches = [grasp.wrench for grasp in experiment.grasps if grasp.wrench is not None]
    for number, wrench in enumerate(wrenches):
        which = "" if len(wrenches) == 1 else f" {number + 1}"

        def add(kind: str, what: str, unit: str, deviation: float | None, number: int = number):
            if deviation:
                entries.append((f"{kind} {number}", f"{what} [{unit}]", deviation))

        tare = wanted.tare or 0.0
        for k in np.flatnonzero(wrench.measured):
            what = f"tare{which} of {COMPONENTS[k]}"
            add("tare", what, UNITS[k], tare * float(wrench.sigmas[k]))
        if not experiment.static:
            add("sensor-time", f"time shift of the sensor{which}", "s", wanted.sensor_time_s)
            add("sensor-lag", f"lag of the sensor{which}", "s", wanted.sensor_lag_s)
        add("tool-mass", f"mass of the tool{which}", "kg", wanted.tool_kg)
        for axis in "xyz" if wanted.tool_kg else "":
            add("tool-centre", f"centre of the tool{which}, {axis}", "m", wanted.tool_m)
    return entries


def _factor_of(name: str) -> str:
    return f"{name}, more than stated [1]"


def _lost_of(actuator: Actuator) -> str:
    return f"{actuator.name}, lost [{actuator.unit}]"


def _driving(experiment: Experiment, labels: Sequence[str]) -> Index:
    """(A, 2) places among the labels of what each actuator may be off by, or −1."""
    place = {label: k for k, label in enumerate(labels)}
    found = [
        (place.get(_factor_of(a.name), -1), place.get(_lost_of(a), -1))
        for a in experiment.actuators
    ]
    return np.array(found, dtype=np.int64).reshape(-1, 2)


def _timed(experiment: Experiment) -> list[tuple[str, Timed]]:
    """What joins or leaves at a time that is to be estimated, and its label."""
    if not experiment.nuisance.joining_s:
        return []
    said: dict[Change, str] = {"from_s": "joining", "until_s": "leaving"}
    return [
        (f"{said[change]} of {kind} {number} [s]", Timed(load, change))
        for kind, loads in (("mass", experiment.masses), ("force", experiment.forces))
        for number, load in enumerate(loads, start=1)
        for change in get_args(Change)
        if experiment.changes(load, change)
    ]


def rotation(turn: ca.SX) -> ca.SX:
    """Rotation matrix of Cayley's parameters `turn` / 2; smooth and rational."""
    half = ca.skew(turn / 2)
    return ca.SX.eye(3) + 2 / (1 + ca.sumsqr(turn) / 4) * (half + half @ half)
