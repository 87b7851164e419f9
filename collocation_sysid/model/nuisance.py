"""Nuisance parameters φ of an experiment: places, clock, gravity, the body in its grasp, cameras.

Every φ is a number of prior standard deviations, so that its prior is φ² in the loss. What there
may be is the table of `recording.nuisance`; an entry of φ is one component of a row, on one axis.

Grasps and body are off by the rigid motion x' = R(a) (x − c) + c + d in the frame of the markers,
c being the middle of the undeformed body in its first pose. In the body's frame that changes
nothing but what the markers read, and the direction of gravity, which becomes R(a)ᵀ g.

In the grasp the undeformed body is off by H X = R(a_h) (X − c_h) + c_h + d_h, c_h being the middle
of the grasped nodes: they are held at U_t H X.

A tension T is max(0, f T − b) at the body, a pressure p is f p − b.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from typing import Any, NamedTuple, TypeVar, get_args

import casadi as ca
import numpy as np

from ..arrays import Array, Index
from ..errors import InputError
from ..fem.constants import unit_of, without_unit
from ..files import reason
from ..recording.experiment import Experiment
from ..recording.grasp import Grasp, held_nodes
from ..recording.loads import Change, Force, PointMass
from ..recording.nuisance import (
    DEPTH_BIAS,
    DEPTH_EDGE,
    DEPTH_SCALE,
    GAUGE,
    GRASP_SHIFT,
    GRASP_TURN,
    JOINING,
    OBSTACLE_OFFSET,
    OBSTACLE_TILT,
    OBSTACLE_TIME,
    PLACE,
    PRESSURE_LOST,
    TARE,
    TENSION_LOST,
    TILT,
    TIME,
    TURN,
    ZERO,
    NuisanceRow,
    Of,
    rotation,
)
from ..recording.obstacle import Obstacle
from ..recording.wrench import COMPONENTS, UNITS, Wrench
from .generated import Generated

Load = TypeVar("Load", PointMass, Force)

# Samples are read between neighbours, up to this many away from the chart's.
LARGEST_SHIFT_SAMPLES = 2.0
# A time shift may be this share of the recording.
LARGEST_SHIFT_SHARE = 0.25
# A load joins within this many standard deviations of its prior, further than any that is right,
# and within the recording: not quite at its ends, where it would join at once or never.
LARGEST_DELAY, NARROWER = 4.0, 1 - 1e-9
MOVING = {"gravity", "grasps", "loads", "drives"}


class Timed(NamedTuple):
    """A load that joins or leaves at an estimated time."""

    load: PointMass | Force
    change: Change

    @property
    def stated_s(self) -> float:
        """The time stated."""
        return getattr(self.load, self.change)


@dataclass(frozen=True)
class Entry:
    """One φ.

    Attributes
    ----------
    row : NuisanceRow
    number : int
        Of the component: marker, grasp, actuator, load or sensor of the experiment.
    axis : int
        Of the vector.
    label : str
        With its unit.
    sigma : float
        Prior standard deviation, in the unit.
    """

    row: NuisanceRow
    number: int
    axis: int
    label: str
    sigma: float

    @property
    def unit(self) -> str:
        """Of the label."""
        return self.label.rpartition("[")[2].rstrip("]")


@dataclass(frozen=True, eq=False)
class NuisanceMap:
    """φ of one experiment: what each is, and the gravity and grasps it makes.

    Attributes
    ----------
    entries : (k,) what each is
    names : (k,) with units, such as "swing: place of tip, x [m]"
    scales : (k,) prior standard deviations, in the names' units
    reach : (k,) φ that a step may move at a time: what enters linearly needs no trust region
    interval_s : float, between samples
    duration_s : float
    gravity_m_s2 : (3,) as stated
    pivot_m : (3,) c
    grasp_pivot_m : (3,) c_h
    stated_off : (A, 2) f and b of tensions and pressures as stated
    timed : what joins or leaves, in the order of their φ
    recorded_s : first and last time of the recording
    """

    entries: tuple[Entry, ...]
    names: tuple[str, ...]
    scales: Array
    reach: Array
    interval_s: float
    duration_s: float
    gravity_m_s2: Array
    pivot_m: Array
    grasp_pivot_m: Array
    stated_off: Array
    timed: tuple[Timed, ...]
    recorded_s: tuple[float, float]

    @classmethod
    def of(cls, experiment: Experiment, pivot_m: Array | None = None) -> NuisanceMap:
        """What the experiment wants estimated; the pivot is another recording's where one is given.

        What recordings share has the same name in all of them.
        """
        entries, body = tuple(_entries(experiment)), experiment.body
        scope = experiment.nuisance.scope
        middle_m = experiment.rigid_positions(experiment.t_s[:1])[0].mean(axis=0)
        scales = np.array([entry.sigma for entry in entries], dtype=float)
        steps = {e.row.name: e.row.step(experiment) for e in entries if e.row.step is not None}
        reach = [min(e.row.reach, steps.get(e.row.name, np.inf) / e.sigma) for e in entries]
        held = held_nodes(experiment.gripping)
        found = cls(
            entries,
            tuple(f"{scope.get(e.row.name, experiment.name)}: {e.label}" for e in entries),
            scales,
            np.array(reach),
            experiment.timestep_s,
            experiment.duration_s,
            np.array(experiment.gravity_m_s2),
            middle_m if pivot_m is None else pivot_m,
            body.nodes_m[held if len(held) else slice(None)].mean(axis=0),
            np.array([a.off for a in experiment.actuators]).reshape(-1, 2),
            tuple(timed for _, timed in _timed(experiment)),
            (float(experiment.t_s[0]), float(experiment.t_s[-1])),
        )
        for row in experiment.nuisance.own:
            found._require_smooth(row)
        return found

    def _require_smooth(self, row: NuisanceRow) -> None:
        """Refuse an expression of a user's own that cannot be read with, or has no slopes."""
        y, t_s = ca.SX.sym("y", 3), ca.SX.sym("t_s")
        values = ca.SX.sym("values", max(1, len(row.axes.split())))
        what = "reading" if row.reading else "clock"
        try:
            made: Any = row.reading and row.reading(y, values, t_s, self)
            made = ca.SX(row.clock(values, t_s, self) if row.clock else made)
        except Exception as error:
            raise InputError(f"the {what} of {row.name} failed: {reason(error)}") from error
        wanted = (3, 1) if row.reading else (1, 1)
        if made.shape != wanted:
            found = f"the {what} of {row.name} has the shape {made.shape}"
            raise InputError(f"{found}; expected {wanted}")
        slopes = ca.Function("slopes", [y, values, t_s], [made, ca.jacobian(made, values)])
        at = slopes([0.1, 0.2, 0.3], 0.0, self.interval_s)
        if not all(np.isfinite(part.full()).all() for part in at):
            raise InputError(f"the {what} of {row.name} or its slopes are not finite at zero")

    @property
    def size(self) -> int:
        """Number k of φ."""
        return len(self.names)

    def valued(self, phi: Array) -> Iterator[tuple[Entry, str, float]]:
        """Each φ but the places of markers, which say nothing by themselves: name and value."""
        for entry, name, value in zip(self.entries, self.names, phi * self.scales, strict=True):
            if entry.row != PLACE:
                yield entry, name, float(value)

    def places(self, *rows: NuisanceRow, of: int | None = None) -> Index:
        """Positions in φ of some rows, of all components or of one."""
        return self._where(lambda e: e.row in rows and of in (None, e.number))

    def _where(self, chosen: Callable[[Entry], bool]) -> Index:
        return np.array([k for k, e in enumerate(self.entries) if chosen(e)], dtype=np.int64)

    @cached_property
    def moving(self) -> Index:
        """Positions in φ of what changes the motion: gravity, grasps, loads and what drives it."""
        return self._where(lambda e: not MOVING.isdisjoint(e.row.changes))

    @cached_property
    def of_drives(self) -> Index:
        """Positions in φ of what tensions and pressures may be off by."""
        return self._where(lambda e: "drives" in e.row.changes)

    def drive_places(self, number: int) -> tuple[int, int]:
        """Positions in φ of the factor and of what is lost of an actuator, −1 where it has none."""
        found = [-1, -1]
        for k in self.of_drives:
            if self.entries[k].number == number:
                found[self.entries[k].row in (TENSION_LOST, PRESSURE_LOST)] = int(k)
        return found[0], found[1]

    def drives(self, phi: Array) -> Array:
        """F and b (A, 2) of tensions and pressures."""
        found, values = self.stated_off.copy(), phi * self.scales
        for number in range(len(found)):
            for column, place in enumerate(self.drive_places(number)):
                found[number, column] += 0.0 if place < 0 else values[place]
        return found

    # What markers read --------------------------------------------------------------------------

    def of_markers(self, count: int) -> Index:
        """(count, f) positions in φ of what the reading of each marker depends on."""
        read = self._where(lambda e: e.row.reading is not None or e.row.clock is not None)
        one = [k for k in read if self.entries[k].row.of == "marker"]
        each = [[k for k in one if self.entries[k].number == m] for m in range(count)]
        common = np.tile(np.setdiff1d(read, one), (count, 1))
        return np.hstack(
            [np.array(each, dtype=np.int64).reshape(count, -1 if count else 0), common]
        )

    @cached_property
    def of_clock(self) -> Index:
        """Positions in φ of what shifts the times at which markers are seen."""
        return self._where(lambda e: e.row.clock is not None)

    def late_s(self, phi: ca.SX, places: Index, t_s: ca.SX) -> ca.SX:
        """How much later than at t_s a marker was seen, at its φ."""
        values = self.by_row(phi, places)
        return sum((row.clock(values[row], t_s, self) for row in values if row.clock), ca.SX(0))

    def read(self, y: ca.SX, phi: ca.SX, places: Index, t_s: ca.SX) -> ca.SX:
        """What is read of a marker at y (3,), at its φ: first as all are seen, then as it is."""
        values = self.by_row(phi, places)
        for row in sorted(values, key=lambda row: row.of == "marker"):
            y = y if row.reading is None else row.reading(y, values[row], t_s, self)
        return y

    # What moves the body ------------------------------------------------------------------------

    @cached_property
    def moves_grasps(self) -> bool:
        """Whether the body may be off in its grasps, or these in their zero."""
        return len(np.setdiff1d(self.moving, self.of_gravity)) > 0

    def zero(self, number: int) -> Index:
        """Positions in φ of the zeros of a grasp, along its axes in turn."""
        return self.places(ZERO, of=number)

    def of_obstacle(self, number: int) -> list[tuple[NuisanceRow, int, int]]:
        """Row, axis and position in φ of all that is not known of an obstacle."""
        own = (k for k in self.moving.tolist() if self.entries[k].row.of == "obstacle")
        here = ((self.entries[k], k) for k in own if self.entries[k].number == number)
        return [(entry.row, entry.axis, k) for entry, k in here]

    def with_grasps(self, grasps: Sequence[Grasp], phi: Array) -> tuple[Grasp, ...]:
        """Grasps and obstacles where φ has them."""
        motion = self.in_grasp(phi)
        return tuple(self._with_grasp(k, grasp, motion, phi) for k, grasp in enumerate(grasps))

    def _with_grasp(self, number: int, grasp: Grasp, motion: Array, phi: Array) -> Grasp:
        if isinstance(grasp, Obstacle):
            off: dict[NuisanceRow, Array] = {}
            for row, axis, place in self.of_obstacle(number):
                off.setdefault(row, np.zeros(2))[axis] = phi[place] * self.scales[place]
            nothing = np.zeros(2)
            offset, late = (off.get(r, nothing)[0] for r in (OBSTACLE_OFFSET, OBSTACLE_TIME))
            return grasp.off_by(offset, off.get(OBSTACLE_TILT, nothing), late)
        zero_m = np.zeros(3)
        for place in self.zero(number):
            zero_m[self.entries[place].axis] = phi[place] * self.scales[place]
        return replace(grasp, poses=grasp.poses.after(motion).shifted(zero_m))

    def limits(self, samples: int) -> tuple[Array, Array]:
        """Lowest and highest φ (k,), where samples are read about this many whole ones away."""
        low = np.array([entry.row.low for entry in self.entries])
        high = np.array([entry.row.high for entry in self.entries])
        for k in self.places(TIME):
            about, unit = samples * self.interval_s, self.scales[k]
            around = LARGEST_SHIFT_SAMPLES * self.interval_s
            furthest = max(around, LARGEST_SHIFT_SHARE * self.duration_s)
            low[k] = max(about - around, -furthest) / unit
            high[k] = min(about + around, furthest) / unit
        for k, timed in zip(self.places(JOINING), self.timed, strict=True):
            way = (np.array(self.recorded_s) - timed.stated_s) / self.scales[k]
            low[k], high[k] = np.clip(NARROWER * way, -LARGEST_DELAY, LARGEST_DELAY)
        return low, high

    def with_times(self, experiment: Experiment, phi: Array) -> Experiment:
        """The experiment with its loads joining and leaving when φ says."""
        if not self.timed:
            return experiment
        late_s = (phi * self.scales)[self.places(JOINING)]

        def moved(load: Load) -> Load:
            times = {
                timed.change: timed.stated_s + float(late)
                for timed, late in zip(self.timed, late_s, strict=True)
                if timed.load is load
            }
            return replace(load, **times) if times else load

        masses, forces = map(moved, experiment.masses), map(moved, experiment.forces)
        return replace(experiment, masses=masses, forces=forces)

    @cached_property
    def of_grasps(self) -> Index:
        """Positions in φ of what moves the body in its grasps."""
        return self.places(GRASP_TURN, GRASP_SHIFT)

    @cached_property
    def in_grasps(self) -> Generated:
        """H X of a point X, of the φ of `of_grasps`."""
        return Generated(self._carried, len(self.of_grasps), 3)

    def _carried(self, phi: ca.SX, point: ca.SX) -> ca.SX:
        values = self.by_row(phi, self.of_grasps)
        if GRASP_TURN in values:
            pivot = ca.DM(self.grasp_pivot_m)
            point = rotation(values[GRASP_TURN]) @ (point - pivot) + pivot
        if GRASP_SHIFT in values:
            point = point + values[GRASP_SHIFT]
        return point

    def in_grasp(self, phi: Array) -> Array:
        """H as a 4×4 matrix [[R, p], [0, 1]]."""
        points = np.hstack([np.zeros((3, 1)), np.eye(3)])
        images = self.in_grasps.value(phi[self.of_grasps], points)
        matrix = np.eye(4)
        matrix[:3] = np.column_stack([images[:, 1:] - images[:, :1], images[:, 0]])
        return matrix

    def gravity(self, phi: Array) -> Array:
        """Gravity (3,) in the body's frame."""
        if not len(self.of_gravity):
            return self.gravity_m_s2
        return ca.evalf(self.gravity_expression(ca.SX(phi[self.of_gravity]))).full().ravel()

    @cached_property
    def of_gravity(self) -> Index:
        """Positions in φ of what turns gravity, in the body's frame."""
        return self.places(TILT, TURN)

    def gravity_expression(self, phi: ca.SX) -> ca.SX:
        """Gravity (3,) in the body's frame, of the φ of `of_gravity`."""
        values, gravity = self.by_row(phi, self.of_gravity), ca.DM(self.gravity_m_s2)
        if TILT in values:
            gravity = self._tilted(values[TILT])
        if TURN in values:
            gravity = rotation(values[TURN]).T @ gravity
        return ca.SX(gravity)

    def by_row(self, phi: ca.SX, places: Index) -> dict[NuisanceRow, ca.SX]:
        """By row, of φ at some places, with units."""
        sized, found = phi * self.scales[places][:, None], {}
        for at, k in enumerate(places):
            found.setdefault(self.entries[k].row, []).append(sized[at])
        return {row: ca.vertcat(*each) for row, each in found.items()}

    def _tilted(self, angles: ca.SX) -> ca.SX:
        size = float(np.linalg.norm(self.gravity_m_s2))
        if size == 0:
            return ca.SX(ca.DM(self.gravity_m_s2))
        down = self.gravity_m_s2 / size
        # Two axes across gravity: those that complete it to a basis.
        across = np.linalg.svd(down[None])[2][1:]
        tilted = down + ca.mtimes(ca.DM(across.T), angles)
        return ca.SX(size * tilted / ca.norm_2(tilted))


def _entries(experiment: Experiment) -> Iterator[Entry]:
    """Every φ of an experiment, in order."""
    for _, rows in groupby(experiment.nuisance.rows, key=lambda row: row.of):
        here = [row for row in rows if row.applies(experiment)]
        for number, which in _components(experiment, here[0].of) if here else ():
            for row in here:
                for axis, name, unit, sigma in _axes(experiment, row, number):
                    label = row.label.format(which=which, axis=name)
                    yield Entry(row, number, axis, f"{label} [{unit}]", sigma)
    for number, gauge in enumerate(experiment.readings):
        for axis, (name, sigma) in enumerate(gauge.unknowns.items()):
            label = f"{without_unit(name)} of {gauge.name} [{unit_of(name) or '1'}]"
            yield Entry(GAUGE, number, axis, label, sigma)


def _components(experiment: Experiment, of: Of) -> Iterable[tuple[int, str]]:
    """Numbers and names of all there are of a kind."""
    names = experiment.markers.names
    if of == "recording":
        return [(0, "")]
    if of == "marker":
        return enumerate(names)
    if of == "place":
        return [(m, names[m]) for m in np.flatnonzero(experiment.place_sigma_m > 0).tolist()]
    if of == "grasp":
        return [(k, str(k + 1)) for k in range(len(experiment.gripping))]
    if of == "obstacle":
        return enumerate((each.name for each in experiment.obstacles), len(experiment.gripping))
    if of == "depth":
        return enumerate(depth.name for depth in experiment.depths)
    if of == "load":
        return enumerate(which for which, _ in _timed(experiment))
    if of == "sensor":
        count = len(_wrenches(experiment))
        return [(k, f" {k + 1}" if count > 1 else "") for k in range(count)]
    if of == "tendon":
        return enumerate(tendon.name for tendon in experiment.tendons)
    pressures = (pressure.name for pressure in experiment.pressures)
    return enumerate(pressures, start=len(experiment.tendons))


def _axes(
    experiment: Experiment, row: NuisanceRow, number: int
) -> list[tuple[int, str, str, float]]:
    """Number, name, unit and deviation of each axis of a row's component; none if exact."""
    sigma, names = experiment.nuisance.sigma(row), row.axes.split() or [""]
    if row == PLACE:
        sigma = float(experiment.place_sigma_m[number])
        names = ["first", "second"] if experiment.markers.on_surface else names
    if not sigma:
        return []
    if row == TARE:
        wrench = _wrenches(experiment)[number]
        own = np.flatnonzero(wrench.measured).tolist()
        return [(k, COMPONENTS[k], UNITS[k], sigma * float(wrench.sigmas[k])) for k in own]
    if row in (OBSTACLE_TILT, OBSTACLE_TIME):
        obstacle = experiment.grasps[number]
        assert isinstance(obstacle, Obstacle)
        if not (obstacle.shape.flat if row == OBSTACLE_TILT else len(obstacle.poses.t_s) > 1):
            return []
    if row in (DEPTH_BIAS, DEPTH_SCALE) and experiment.depths[number].camera.matrix is None:
        return []
    if row == DEPTH_EDGE and not len(experiment.depths[number].images_m):
        return []
    found = [(axis, name, row.unit, sigma) for axis, name in enumerate(names)]
    return [each for each in found if row != ZERO or each[1] in experiment.grasps[number].zero]


def _wrenches(experiment: Experiment) -> list[Wrench]:
    return [grasp.wrench for grasp in experiment.grasps if grasp.wrench is not None]


def _timed(experiment: Experiment) -> list[tuple[str, Timed]]:
    """What joins or leaves at a time that is to be estimated, and its label."""
    if not experiment.nuisance.joining_s:
        return []
    said: dict[Change, str] = {"from_s": "joining", "until_s": "leaving"}
    return [
        (f"{said[change]} of {kind} {number}", Timed(load, change))
        for kind, loads in (("mass", experiment.masses), ("force", experiment.forces))
        for number, load in enumerate(loads, start=1)
        for change in get_args(Change)
        if experiment.changes(load, change)
    ]
