"""Nuisance parameters φ of one recording: marker places, clocks, gravity, grasp, loads and cameras.

Every φ is a number of prior standard deviations, so its prior adds φ² to the loss. The table in
`recording.nuisance` lists the possible rows; an entry of φ is one axis of one component of a row.

A rigid motion x' = R(a) (x − c) + c + d of grasps and body in the frame of the markers has the
middle c of the body in its first pose as pivot. In the frame of the body it changes only what
markers measure, and the direction of gravity, which becomes R(a)ᵀ g.

The pose of the undeformed body in its grasp is H X = R(a_h) (X − c_h) + c_h + d_h with the middle
c_h of the grasped nodes; these are held at U_t H X.

A tension T acts on the body as max(0, f T − b), a pressure p as f p − b.

Experiments share those nuisance parameters whose `scope` is the same word in both, and whose label
is the same: the place of a marker by its name, the pose of the cameras or of the clamp by its axis.
Such a parameter is one entry of p with one prior, see `nuisance_indices`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from typing import Any, NamedTuple, TypeVar, get_args

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array, Index
from ..common.files import reason
from ..errors import InputError
from ..recording.deviation import Component, Deviation, RecordingQuantities
from ..recording.experiment import Experiment
from ..recording.grasp import Grasp, prescribed_nodes
from ..recording.loads import Force, LoadTime, PointMass
from ..recording.nuisance import (
    CLAMP_TURN,
    GRASP_SHIFT,
    GRASP_TURN,
    JOINING,
    OBSTACLE_OFFSET,
    OBSTACLE_TILT,
    OBSTACLE_TIME,
    PLACE,
    POSE_TURN,
    PRESSURE_LAG,
    PRESSURE_OFFSET,
    SMALLEST_FACTOR,
    SPECIMEN_FACTORS,
    START_ACCELERATION,
    START_VELOCITY,
    STRAIN_ZERO,
    TARE,
    TENSION_OFFSET,
    TILT,
    TIME,
    ZERO,
    cayley_rotation,
)
from ..recording.obstacle import Obstacle
from ..recording.obstacle_solids import orthogonal_axes
from .generated_functions import GeneratedFunction

Load = TypeVar("Load", PointMass, Force)

# Largest deviation of a delay from the current whole number of samples: the range of interpolation.
LARGEST_SHIFT_SAMPLES = 2.0
# Largest delay as a fraction of the recording's duration; more would leave too few samples.
LARGEST_DELAY_FRACTION = 0.25
# Largest delay of a joining load, in prior standard deviations: more than any true value.
LARGEST_JOINING_DELAY_SIGMAS = 4.0
# Factor that keeps a joining load inside the recording: at its ends it would join at once or never.
INSIDE_RECORDING_FACTOR = 1 - 1e-9


class TimedLoad(NamedTuple):
    """Load that joins or leaves at an estimated time."""

    load: PointMass | Force
    change: LoadTime  # which time of the load is estimated

    @property
    def declared_s(self) -> float:
        """Time given by the user [s]."""
        return getattr(self.load, self.change)


@dataclass(frozen=True)
class NuisanceEntry:
    """One nuisance parameter."""

    row: Deviation  # row of the table of nuisance parameters
    # Index of the component among those of the kind `row.of`: marker, grasp, actuator (tendons,
    # then pressures), load, camera or sensor of the experiment; 0 for a parameter of the recording.
    number: int
    axis: int  # index of the axis of a vector-valued row
    label: str  # label with unit, such as "place of tip, x [m]"
    sigma: float  # prior standard deviation, in the unit of the label

    def unit_in_label(self) -> str:
        """Return the unit of the parameter, taken from its label."""
        return self.label.rpartition("[")[2].rstrip("]")


@dataclass(frozen=True, eq=False)
class NuisanceMap(RecordingQuantities):
    """Nuisance parameters φ of one experiment, and the quantities that depend on them.

    All methods take φ in prior standard deviations, all k of them unless an argument is described
    otherwise; values with units are φ · `scales`.
    """

    entries: tuple[NuisanceEntry, ...]  # (k,): definition of each parameter
    names: tuple[str, ...]  # (k,): names with units, such as "swing: place of tip, x [m]"
    scales: Array  # (k,): prior standard deviations, in the units of the names
    # (k,): largest change of φ in one step of the solver; infinite for parameters that enter
    # linearly.
    step_limits: Array
    grasp_pivot_m: Array  # (3,): pivot c_h of the motion of the body in its grasp
    grasp_middles_m: Array  # (G, 3): middle of the nodes of each grasp that is not an obstacle
    # (A, 3): factor f, loss b and logarithm of the lag over the stated lag of each tension and
    # pressure, as stated.
    declared_calibration: Array
    # Loads with an estimated time, in the order of their parameters.
    timed_loads: tuple[TimedLoad, ...]
    # (G, 3): displacement of the node of each grasp per unit of strain [m]; empty unless the
    # experiment is a specimen without a mesh.
    strain_shifts_m: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def from_experiment(cls, experiment: Experiment, pivot_m: Array | None = None) -> NuisanceMap:
        """Return the nuisance parameters of an experiment.

        A parameter that recordings share has the same name in all of them.

        Parameters
        ----------
        pivot_m : (3,), optional
            Pivot c; by default the middle of the body in its first pose. Pass that of another
            recording if the rigid motion is shared with it.

        Raises
        ------
        InputError
            If a custom expression fails, has the wrong shape, or is not finite at zero.
        """
        entries = tuple(_entries(experiment))
        body = experiment.body
        scope = experiment.nuisance.scope
        middle_m = experiment.rigid_positions(experiment.t_s[:1])[0].mean(axis=0)
        scales = np.array([entry.sigma for entry in entries], dtype=float)
        # Of each kind once: a body may carry thousands of markers.
        rows = {entry.row.name: entry.row for entry in entries}
        steps = {name: row.step(experiment) for name, row in rows.items() if row.step is not None}
        reach = [min(e.row.reach, steps.get(e.row.name, np.inf) / e.sigma) for e in entries]
        grasped_nodes = prescribed_nodes(experiment.body_grasps)
        nuisance_map = cls(
            entries=entries,
            names=tuple(f"{scope.get(e.row.name, experiment.name)}: {e.label}" for e in entries),
            scales=scales,
            step_limits=np.array(reach),
            interval_s=experiment.timestep_s,
            duration_s=experiment.duration_s,
            gravity_m_s2=np.array(experiment.gravity_m_s2),
            pivot_m=middle_m if pivot_m is None else pivot_m,
            grasp_pivot_m=body.nodes_m[grasped_nodes if len(grasped_nodes) else slice(None)].mean(
                axis=0
            ),
            grasp_middles_m=np.array(
                [body.nodes_m[grasp.nodes].mean(axis=0) for grasp in experiment.body_grasps]
            ).reshape(-1, 3),
            declared_calibration=np.array(
                [a.make_calibration() for a in experiment.actuators]
            ).reshape(-1, 3),
            timed_loads=tuple(timed for _, timed in _timed_loads(experiment)),
            recorded_s=(float(experiment.t_s[0]), float(experiment.t_s[-1])),
            strain_shifts_m=_strain_shifts_m(experiment),
        )
        for row in experiment.nuisance.own:
            if row.stiffness is None:
                nuisance_map._require_valid_expression(row)
        return nuisance_map

    def _require_valid_expression(self, row: Deviation) -> None:
        y = ca.SX.sym("y", 3)
        t_s = ca.SX.sym("t_s")
        values = ca.SX.sym("values", max(1, len(row.axes.split())))
        kind = "reading" if row.reading else "clock"
        what = f"{kind} of the nuisance parameter {row.name!r}"
        try:
            expression: Any = row.reading and row.reading(y, values, t_s, self)
            expression = ca.SX(row.clock(values, t_s, self) if row.clock else expression)
        except Exception as error:
            raise InputError(f"the {what} failed: {reason(error)}") from error
        expected = (3, 1) if row.reading else (1, 1)
        if expression.shape != expected:
            raise InputError(f"the {what} has the shape {expression.shape}; expected {expected}")
        slopes = ca.Function(
            "slopes", [y, values, t_s], [expression, ca.jacobian(expression, values)]
        )
        evaluated = slopes([0.1, 0.2, 0.3], 0.0, self.interval_s)
        if not all(np.isfinite(part.full()).all() for part in evaluated):
            raise InputError(
                f"the {what}, or its derivative with respect to the parameter, is not finite "
                "where the parameter is zero; expected a formula that is smooth there, which "
                "√s, log(s) and 1/s of a parameter s are not"
            )

    @property
    def size(self) -> int:
        """Number k of nuisance parameters."""
        return len(self.names)

    def iterate_values(self, phi: Array) -> Iterator[tuple[NuisanceEntry, str, float]]:
        """Yield entry, name and value (in the entry's unit) of each parameter at φ (k,), in the
        order of φ, without the places of markers.
        """
        for entry, name, value in zip(self.entries, self.names, phi * self.scales, strict=True):
            if entry.row != PLACE:
                yield entry, name, float(value)

    def indices_of_rows(self, *rows: Deviation, component: int | None = None) -> Index:
        """Return the indices in φ of some rows, of all components or of one, ascending.

        Their order is that of φ, whatever the order of `rows`. Rows that are not estimated have no
        entries, so that the result may be empty.

        Parameters
        ----------
        component : int, optional
            Number of the instance, such as the index of a camera; None for all.
        """
        names = {row.name for row in rows}
        return self._indices_where(lambda e: e.row.name in names and component in (None, e.number))

    def indices_of_labels(self, labels: Iterable[str]) -> Index:
        """Return the indices in φ of the parameters with some labels, in their order."""
        places = {entry.label: k for k, entry in enumerate(self.entries)}
        return np.array([places[label] for label in labels], dtype=np.int64)

    def _indices_where(self, chosen: Callable[[NuisanceEntry], bool]) -> Index:
        return np.array([k for k, e in enumerate(self.entries) if chosen(e)], dtype=np.int64)

    @cached_property
    def motion_indices(self) -> Index:
        """Indices in φ, ascending, of the parameters that affect the motion: gravity, grasps,
        obstacles, loads, actuators.
        """
        return self._indices_where(lambda e: e.row.changes_motion)

    @cached_property
    def actuator_indices(self) -> Index:
        """Indices in φ of the calibration of tensions and pressures."""
        return self._indices_where(lambda e: "drives" in e.row.changes)

    def actuator_calibration_indices(self, number: int) -> list[int]:
        """Return the indices in φ of factor, loss and logarithm of the lag of one actuator; −1 for a
        parameter that is not estimated.

        Parameters
        ----------
        number : int
            Index of the actuator: tendons first, then pressures.
        """
        columns = {TENSION_OFFSET.name: 1, PRESSURE_OFFSET.name: 1, PRESSURE_LAG.name: 2}
        indices = [-1, -1, -1]
        for k in self.actuator_indices:
            if self.entries[k].number == number:
                indices[columns.get(self.entries[k].row.name, 0)] = int(k)
        return indices

    def actuator_calibration(self, phi: Array) -> Array:
        """Return factor f, loss b and logarithm of the lag over the stated lag of each tendon and
        pressure at φ (k,), as a new array (A, 3); the stated ones where they are not estimated.
        """
        calibration = self.declared_calibration.copy()
        values = phi * self.scales
        for number in range(len(calibration)):
            for column, place in enumerate(self.actuator_calibration_indices(number)):
                calibration[number, column] += 0.0 if place < 0 else values[place]
        return calibration

    # What markers read --------------------------------------------------------------------------

    def marker_indices(self, count: int) -> Index:
        """Return the indices in φ (count, f) of the parameters on which the measurement of each of
        `count` markers depends: those of the marker, then those of all markers.

        f is the same for all markers; it may be 0.
        """
        read = self._indices_where(lambda e: e.row.reading is not None or e.row.clock is not None)
        single = [k for k in read if self.entries[k].row.of == "marker"]
        of_marker = [[k for k in single if self.entries[k].number == m] for m in range(count)]
        common = np.tile(np.setdiff1d(read, single), (count, 1))
        return np.hstack(
            [np.array(of_marker, dtype=np.int64).reshape(count, -1 if count else 0), common]
        )

    @cached_property
    def clock_indices(self) -> Index:
        """Indices in φ of the parameters that shift the times at which markers were measured."""
        return self._indices_where(lambda e: e.row.clock is not None)

    def marker_delay_s(self, phi: ca.SX, places: Index, t_s: ca.SX) -> ca.SX:
        """Return the delay of a marker's measurement relative to the time t_s [s]: the sum of all
        clocks, 0 without any.

        Parameters
        ----------
        phi : SX
            Parameters at the indices `places`, in prior standard deviations.
        places : array of int
            Indices in φ of the marker, a row of `marker_indices`.
        t_s : SX
            Time of the sample.
        """
        values = self.values_by_row(phi, places)
        return sum((row.clock(values[row], t_s, self) for row in values if row.clock), ca.SX(0))

    def marker_measurement(self, y: ca.SX, phi: ca.SX, places: Index, t_s: ca.SX) -> ca.SX:
        """Return the measured position (3,) [m] of a marker whose true position is y (3,) [m].

        Effects common to all markers are applied before those of the single marker.

        Parameters
        ----------
        y : (3,) SX
        phi : SX
            Parameters at the indices `places`, in prior standard deviations.
        places : array of int
            Indices in φ of the marker, a row of `marker_indices`.
        t_s : SX
            Time of the sample [s].
        """
        values = self.values_by_row(phi, places)
        for row in sorted(values, key=lambda row: row.of == "marker"):
            y = y if row.reading is None else row.reading(y, values[row], t_s, self)
        return y

    # What moves the body ------------------------------------------------------------------------

    @cached_property
    def affects_grasps(self) -> bool:
        """Whether any φ that affects the motion is not of gravity; only then may prescribed
        positions depend on φ (loads and actuators count, too).
        """
        return len(np.setdiff1d(self.motion_indices, self.gravity_indices)) > 0

    def displacement_zero_indices(self, number: int) -> Index:
        """Return the indices in φ of the zeros of the displacement of the grasp with index
        `number`, axis by axis; empty if they are not estimated.
        """
        return self.indices_of_rows(ZERO, component=number)

    @cached_property
    def strain_zero_indices(self) -> Index:
        """Indices in φ of the zero of the strain of a specimen; empty if it is not estimated."""
        return self.indices_of_rows(STRAIN_ZERO)

    def obstacle_parameters(self, number: int) -> list[tuple[Deviation, int, int]]:
        """Return row, axis and index in φ of every nuisance parameter of an obstacle, ascending in
        φ; empty for a gripper.

        Parameters
        ----------
        number : int
            Index among the grasps, in which obstacles follow the grippers.
        """
        own = (k for k in self.motion_indices.tolist() if self.entries[k].row.of == "obstacle")
        here = ((self.entries[k], k) for k in own if self.entries[k].number == number)
        return [(entry.row, entry.axis, k) for entry, k in here]

    def with_grasps(self, grasps: Sequence[Grasp], phi: Array) -> tuple[Grasp, ...]:
        """Return grasps and obstacles at their poses at φ (k,): with the hand–eye transform and the
        zeros of displacement and strain, obstacles with offset, tilt and delay.

        Parameters
        ----------
        grasps : sequence of Grasp
            In the order of the experiment's `grasps`; not modified.
        phi : (k,)
        """
        return tuple(self._with_grasp(k, grasp, phi=phi) for k, grasp in enumerate(grasps))

    def _with_grasp(self, number: int, grasp: Grasp, phi: Array) -> Grasp:
        """Return one grasp or obstacle at its pose at φ."""
        if isinstance(grasp, Obstacle):
            deviations: dict[Deviation, Array] = {}
            for row, axis, place in self.obstacle_parameters(number):
                deviations.setdefault(row, np.zeros(2))[axis] = phi[place] * self.scales[place]
            zeros = np.zeros(2)
            offset, delay_s = (
                deviations.get(r, zeros)[0] for r in (OBSTACLE_OFFSET, OBSTACLE_TIME)
            )
            return grasp.displaced(offset, deviations.get(OBSTACLE_TILT, zeros), delay_s=delay_s)
        zero_m = np.zeros(3)
        for place in self.displacement_zero_indices(number):
            zero_m[self.entries[place].axis] = phi[place] * self.scales[place]
        for place in self.strain_zero_indices:
            zero_m += phi[place] * self.scales[place] * self.strain_shifts_m[number]
        motion = self.grasp_motion_matrix(phi, number)
        return replace(grasp, poses=grasp.poses.after(motion).with_shift(zero_m))

    def bounds(self, samples: int) -> tuple[Array, Array]:
        """Return the lowest and the highest φ with valid measurements and loads, (k,) each, in
        prior standard deviations.

        They are those of the rows, except for the clock and the times of loads, whose bounds follow
        from the recording, and for the factors of the stress of a specimen, at least
        `SMALLEST_FACTOR`. They may be infinite.

        Parameters
        ----------
        samples : int
            Number of whole samples by which marker measurements are currently shifted. The delay
            may deviate from it by `LARGEST_SHIFT_SAMPLES` samples, within `LARGEST_DELAY_FRACTION`
            of the duration, or within `LARGEST_SHIFT_SAMPLES` samples if that is more.
        """
        low = np.array([entry.row.low for entry in self.entries])
        factors = self.indices_of_rows(*SPECIMEN_FACTORS.values())
        low[factors] = (SMALLEST_FACTOR - 1) / self.scales[factors]
        high = np.array([entry.row.high for entry in self.entries])
        for k in self.indices_of_rows(TIME):
            middle_s = samples * self.interval_s
            unit = self.scales[k]
            range_s = LARGEST_SHIFT_SAMPLES * self.interval_s
            largest_s = max(range_s, LARGEST_DELAY_FRACTION * self.duration_s)
            low[k] = max(middle_s - range_s, -largest_s) / unit
            high[k] = min(middle_s + range_s, largest_s) / unit
        for k, timed in zip(self.indices_of_rows(JOINING), self.timed_loads, strict=True):
            margins = (np.array(self.recorded_s) - timed.declared_s) / self.scales[k]
            low[k], high[k] = np.clip(
                INSIDE_RECORDING_FACTOR * margins,
                -LARGEST_JOINING_DELAY_SIGMAS,
                LARGEST_JOINING_DELAY_SIGMAS,
            )
        return low, high

    def with_times(self, experiment: Experiment, phi: Array) -> Experiment:
        """Return the experiment with its loads joining and leaving at the times estimated by φ
        (k,); the experiment itself if no time is estimated. The argument is not modified.

        Its loads must be those from which this map was made: other objects keep their times.
        """
        if not self.timed_loads:
            return experiment
        late_s = (phi * self.scales)[self.indices_of_rows(JOINING)]

        def moved(load: Load) -> Load:
            times = {
                timed.change: timed.declared_s + float(late)
                for timed, late in zip(self.timed_loads, late_s, strict=True)
                if timed.load is load
            }
            return replace(load, **times) if times else load

        masses = map(moved, experiment.masses)
        forces = map(moved, experiment.forces)
        return replace(experiment, masses=masses, forces=forces)

    @cached_property
    def stiffness_indices(self) -> Index:
        """Indices in φ of the parameters that change the stiffness."""
        return self._indices_where(lambda e: "stiffness" in e.row.changes)

    @cached_property
    def start_indices(self) -> Index:
        """Indices in φ of the motion at the first time."""
        return self.indices_of_rows(START_ACCELERATION, START_VELOCITY)

    def number_of_start(self, phi: int) -> int:
        """Return the index of one of `start_indices` in the forces of `start_forces_n`."""
        entry = self.entries[phi]
        return 6 * (entry.row.name == START_VELOCITY.name) + entry.axis

    def with_start(self, experiment: Experiment, phi: Array) -> Experiment:
        """Return the experiment with the motion at its first time that φ (k,) estimates known."""
        if not len(self.start_indices):
            return experiment
        known = experiment.start_motion
        motion = np.zeros(12) if known is None else known.copy()
        for k in self.start_indices.tolist():
            motion[self.number_of_start(k)] += phi[k] * self.scales[k]
        return replace(experiment, start_motion=motion)

    def with_stiffness(self, experiment: Experiment, phi: Array) -> Experiment:
        """Return the experiment with the changes of its stiffness that φ (k,) estimates known."""
        known = dict(experiment.known_deviations)
        for k in self.stiffness_indices.tolist():
            name = self.entries[k].row.name
            known[name] = known.get(name, 0.0) + float(phi[k] * self.scales[k])
        return replace(experiment, known_deviations=known) if known else experiment

    @cached_property
    def grasp_indices(self) -> Index:
        """Indices in φ of rotation and shift of the body in its grasp, and of turned grasps."""
        return self.indices_of_rows(GRASP_TURN, GRASP_SHIFT, CLAMP_TURN)

    @cached_property
    def grasp_motion(self) -> GeneratedFunction:
        """Expression of H C X for a point X, of the φ of `grasp_indices`; the data are X, then 1 for
        the grasp that turns it by C, 0 for others.
        """
        size = 3 + len(self.grasp_middles_m)
        return GeneratedFunction(self._displaced_point, len(self.grasp_indices), data_size=size)

    def grasp_motion_data(self, points_m: Array, number: int | None = None) -> Array:
        """Return the data of `grasp_motion` for points (3, n) of the grasp with an index."""
        chosen = np.zeros((len(self.grasp_middles_m), points_m.shape[1]))
        if number is not None:
            chosen[number] = 1.0
        return np.vstack([points_m, chosen])

    def _displaced_point(self, phi: ca.SX, data: ca.SX) -> ca.SX:
        """Return H C X (3,) of a point X [m] as an expression of the φ of `grasp_indices`."""
        values = self.values_by_row(phi, self.grasp_indices)
        point, chosen = data[:3], data[3:]
        if CLAMP_TURN in values:
            middle = ca.DM(self.grasp_middles_m).T @ chosen
            turn = ca.reshape(values[CLAMP_TURN], 3, -1) @ chosen
            point = cayley_rotation(turn) @ (point - middle) + middle
        if GRASP_TURN in values:
            pivot = ca.DM(self.grasp_pivot_m)
            point = cayley_rotation(values[GRASP_TURN]) @ (point - pivot) + pivot
        if GRASP_SHIFT in values:
            point = point + values[GRASP_SHIFT]
        return point

    def grasp_motion_matrix(self, phi: Array, number: int | None = None) -> Array:
        """Return the motion H C at φ (…, k) of the grasp with an index, by default H alone, as a
        matrix (…, 4, 4), [[R, p], [0, 1]], with p in metres; the identity if it is not estimated.
        """
        data = self.grasp_motion_data(np.eye(3, 4), number)
        u = np.moveaxis(phi[..., self.grasp_indices], -1, 0)[..., None]
        shape = (*phi.shape[:-1], 4)
        images = self.grasp_motion.evaluate(
            np.broadcast_to(u, (len(u), *shape)),
            np.broadcast_to(data.reshape(-1, *(1 for _ in shape[1:]), 4), (len(data), *shape)),
        )
        matrix = np.zeros((*shape, 4))
        matrix[..., :3, :] = np.moveaxis(images, 0, -2)
        matrix[..., :3, :3] -= matrix[..., :3, 3:]
        matrix[..., 3, 3] = 1.0
        return matrix

    def gravity(self, phi: Array) -> Array:
        """Return gravity (3,) [m/s²] in the frame of the body at φ (k,), in prior standard
        deviations; the array `gravity_m_s2` itself if no parameter rotates it.
        """
        if not len(self.gravity_indices):
            return self.gravity_m_s2
        return ca.evalf(self.gravity_expression(ca.SX(phi[self.gravity_indices]))).full().ravel()

    @cached_property
    def gravity_indices(self) -> Index:
        """Indices in φ of the parameters that rotate gravity in the frame of the body."""
        return self.indices_of_rows(TILT, POSE_TURN)

    def gravity_expression(self, phi: ca.SX) -> ca.SX:
        """Return gravity (3,) in the frame of the body [m/s²] as an expression of the φ of
        `gravity_indices` (in prior standard deviations): tilted first, then rotated into the frame
        of the body.
        """
        values = self.values_by_row(phi, self.gravity_indices)
        gravity = ca.DM(self.gravity_m_s2)
        if TILT in values:
            size = ca.norm_2(gravity)
            across = ca.DM(orthogonal_axes(self.gravity_m_s2).T)
            tilted = gravity + size * (across @ values[TILT])
            gravity = size * tilted / ca.norm_2(tilted)
        if POSE_TURN in values:
            gravity = cayley_rotation(values[POSE_TURN]).T @ gravity
        return ca.SX(gravity)

    def values_by_row(self, phi: ca.SX, places: Index) -> dict[Deviation, ca.SX]:
        """Return parameters with units by row, each a column vector; rows without an index are left
        out.

        Parameters
        ----------
        phi : SX
            Parameters at the indices `places`, in prior standard deviations.
        places : array of int
            Indices in φ.
        """
        values = phi * self.scales[places][:, None]
        parts = {}
        for position, k in enumerate(places):
            parts.setdefault(self.entries[k].row, []).append(values[position])
        return {row: ca.vertcat(*each) for row, each in parts.items()}


def _strain_shifts_m(experiment: Experiment) -> Array:
    """Return the displacement (G, 3) of each grasp of a specimen per strain; (0, 3) for a mesh."""
    if experiment.specimen is None:
        return np.zeros((0, 3))
    moving = experiment.specimen.displaced_nodes()
    still = np.zeros(3), np.zeros(3)
    return np.array([sum(moving.get(int(g.nodes[0]), still)) for g in experiment.body_grasps])


def _entries(experiment: Experiment) -> Iterator[NuisanceEntry]:
    """Yield in the order of φ: by component, kind, axis; unknowns of custom sensors come last."""
    for _, rows in groupby(experiment.nuisance.kinds, key=lambda row: row.of):
        applicable = [row for row in rows if row.applies(experiment)]
        for number, component_name in (
            _components(experiment, applicable[0].of) if applicable else ()
        ):
            for row in applicable:
                for axis, name, unit, sigma in _component_axes(experiment, row, number=number):
                    label = row.label.format(which=component_name, axis=name)
                    yield NuisanceEntry(
                        row, number, axis=axis, label=f"{label} [{unit}]", sigma=sigma
                    )
    declared: set[str] = set()
    for number, sensor in enumerate(experiment.readings):
        for axis, (row, label, sigma) in enumerate(sensor.unknown_rows(experiment)):
            if label not in declared:
                yield NuisanceEntry(row, number, axis=axis, label=label, sigma=sigma)
            declared.add(label)


def _components(experiment: Experiment, of: Component) -> Iterable[tuple[int, str]]:
    """Return index and name of all components; "place" are markers of estimated position."""
    # Indices of obstacles follow those of grasps, those of pressures those of tendons.
    names = experiment.markers.names
    if of == "recording":
        return [(0, "")]
    if of == "images":  # the measurement itself declares what is unknown about its camera
        return []
    if of == "marker":
        return enumerate(names)
    if of == "place":
        return [(m, names[m]) for m in np.flatnonzero(experiment.place_sigma_m > 0).tolist()]
    if of == "grasp":
        return [(k, str(k + 1)) for k in range(len(experiment.body_grasps))]
    if of == "obstacle":
        return enumerate((each.name for each in experiment.obstacles), len(experiment.body_grasps))
    if of == "camera":
        return enumerate(experiment.camera_names)
    if of == "load":
        return enumerate(which for which, _ in _timed_loads(experiment))
    if of == "sensor":
        count = len(experiment.sensors_by_grasp)
        return [(k, f" {k + 1}" if count > 1 else "") for k in range(count)]
    if of == "tendon":
        return enumerate(tendon.name for tendon in experiment.tendons)
    pressures = (pressure.name for pressure in experiment.pressures)
    return enumerate(pressures, start=len(experiment.tendons))


def _component_axes(
    experiment: Experiment, row: Deviation, number: int
) -> list[tuple[int, str, str, float]]:
    """Return index, name, unit and σ of each estimated axis of a component."""
    sigma = experiment.nuisance.sigma(row)
    names = row.axes.split() or [""]
    if row == PLACE:
        sigma = float(experiment.place_sigma_m[number])
        count = experiment.markers.place_dimension(experiment.body)
        names = (["along"], ["first", "second"], names)[count - 1]
    if not sigma:
        return []
    if row == TARE:
        sensor = [*experiment.sensors_by_grasp.values()][number]
        return [
            (k, name, unit, sigma * sigma_k) for k, name, unit, sigma_k in sensor.component_noises()
        ]
    if not row.applies_to(experiment, number):
        return []
    axes = [(axis, name, row.unit, sigma) for axis, name in enumerate(names)]
    return [each for each in axes if row != ZERO or each[1] in experiment.grasps[number].zero]


def _timed_loads(experiment: Experiment) -> list[tuple[str, TimedLoad]]:
    """Return label and load for every estimated time of a load, masses first."""
    if not experiment.nuisance.joining_s:
        return []
    verbs: dict[LoadTime, str] = {"from_s": "joining", "until_s": "leaving"}
    return [
        (f"{verbs[change]} of {kind} {number}", TimedLoad(load, change))
        for kind, loads in (("mass", experiment.masses), ("force", experiment.forces))
        for number, load in enumerate(loads, start=1)
        for change in get_args(LoadTime)
        if experiment.changes_within(load, change)
    ]


@dataclass(frozen=True, eq=False)
class NuisanceIndices:
    """Indices of an experiment's nuisance parameters φ in p."""

    # (k,): index in p = (q, φ_1, φ_2, …) of each, that of the first experiment that shares it.
    indices: Index
    # (k,) of bool: false for those that an earlier experiment has already.
    is_first: NDArray[np.bool_]
    # (3,) or None: point about which the shared camera pose rotates [m]; None means the
    # experiment's own.
    pivot_m: Array | None = None


def nuisance_indices(experiments: Sequence[Experiment], first: int) -> list[NuisanceIndices]:
    """Assign the nuisance parameters of each experiment to entries of p.

    A parameter gets a new entry, in the order of the experiments, unless an earlier experiment
    shares it.

    Parameters
    ----------
    first : int
        Index in p of the first nuisance parameter.

    Returns
    -------
    list of NuisanceIndices
        One entry for each experiment.

    Raises
    ------
    InputError
        If experiments share a parameter of objects that differ, with different priors, or a marker
        with different stated places.
    """
    indices = []
    known = dict[Any, tuple[int, NuisanceEntry, Experiment]]()
    leaders = dict[Any, Experiment]()
    for experiment in experiments:
        nuisance = NuisanceMap.from_experiment(experiment)
        scopes = experiment.nuisance.scope
        places = np.zeros(nuisance.size, dtype=np.int64)
        before = first
        for k, entry in enumerate(nuisance.entries):
            scope = scopes.get(entry.row.name)
            # What is not shared is nobody else's.
            which = (len(indices), k) if scope is None else (scope, entry.label)
            places[k], other, of = known.setdefault(which, (first, entry, experiment))
            first += places[k] == first
            leader = leaders.setdefault((scope, entry.row), experiment)
            if scope is not None:
                _require_same_objects(leader, experiment, row=entry.row)
                _require_same_prior((of, other), (experiment, entry))
        leader = leaders.get((scopes.get(POSE_TURN.name), POSE_TURN), experiment)
        pivot_m = None if leader is experiment else NuisanceMap.from_experiment(leader).pivot_m
        indices.append(NuisanceIndices(places, places >= before, pivot_m=pivot_m))
    return indices


def _require_same_objects(leader: Experiment, experiment: Experiment, row: Deviation) -> None:
    theirs = row.same(leader)
    ours = row.same(experiment)
    for entry in ours:
        if theirs[entry] != ours[entry]:
            raise _sharing_error(
                experiment,
                row,
                result=f"'{leader.name}', which has another {entry}",
                expected=f"the same {entry}",
            )


def _require_same_prior(
    one: tuple[Experiment, NuisanceEntry], other: tuple[Experiment, NuisanceEntry]
) -> None:
    """Check that a shared parameter has one prior, a marker one stated place."""
    leader, first = one
    experiment, second = other
    row = second.row
    label = second.label
    if not np.isclose(first.sigma, second.sigma, rtol=1e-9, atol=0):
        difference = f"'{leader.name}', where the {label} has the prior {first.sigma:g}"
        raise _sharing_error(
            experiment, row, result=difference, expected=f"the same prior as here, {second.sigma:g}"
        )
    if row == PLACE:
        places = [_declared_place(*one), _declared_place(*other)]
        rounding_m = 1e-9 * np.nanmax(np.abs(places), initial=0.0)
        if not np.allclose(*places, rtol=0, atol=rounding_m, equal_nan=True):
            difference = (
                f"'{leader.name}', which states another {label.partition(',')[0]} on the body"
            )
            raise _sharing_error(
                experiment,
                row,
                result=difference,
                expected="the same position in both recordings, or in neither",
            )


def _declared_place(experiment: Experiment, entry: NuisanceEntry) -> Array:
    """Return the stated place (3,) of a marker on the undeformed body [m], NaN if there is none."""
    markers = experiment.markers
    at = markers.predict_positions(experiment.body.nodes_m)[entry.number]
    return at if markers.located[entry.number] else np.full(3, np.nan)


def _sharing_error(
    experiment: Experiment, row: Deviation, result: str, expected: str
) -> InputError:
    key = row.key or row.name
    message = f"{key} is shared with {result}; expected {expected}, or a separate scope"
    return InputError(message, None, where=f"experiment '{experiment.name}'")
