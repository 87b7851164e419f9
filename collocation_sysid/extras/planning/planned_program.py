"""Optimal-control problem of a plan: residuals, effort of the hand, and limits.

With the unknowns c of the splines of the hand and of tensions and pressures, the motion x(c) of the
body, the references y* at the samples and the mass M of the body, the plan minimises

    Σ_k mean_t ‖(S_k x − y*_k)/σ_k‖² + mean_t Σ_i (m_i/M) ‖v_i/(ω₁ σ_rest)‖² + w mean ‖jerk/j₀‖²

subject to limits g(c) ≤ 0 of the hand and the signals. All residuals are linear in the positions x
at the grid times (velocities are differences), so that they are one sparse matrix. The second term
is the mean kinetic energy in the window after the motion, in units of that of a vibration with the
amplitude σ_rest at the lowest natural frequency ω₁. The unit j₀ of the jerk is ten times the largest
acceleration over the duration; for tensions and pressures it is the largest third derivative of the
smoothest change over the whole range.

For a static recording, each sample is an equilibrium, and the second term is omitted. With
information in the task, its criterion takes the place of the first two terms, see
`InformationCriterion`.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, cast

import casadi as ca
import numpy as np
import scipy.sparse as sp
from scipy.spatial.transform import Rotation

from ...common.array_types import Array, Index
from ...common.time_dependence import at_times
from ...errors import InputError
from ...program.driven_motion import Drive, DrivenMotion
from ...program.forward.initial_equilibrium import equilibrium
from ...program.modes.natural import natural_modes
from ...recording import Experiment, PoseSequence
from .body_limits import BodyLimits
from .hand_limits import WITHIN, HandBounds, Limits
from .information import InformationCriterion
from .path_terms import AugmentedCosts, PathCost, PathLimit, PathValues
from .planned_body import PlannedBody
from .signals import Signal, task_signals
from .spline_motion import HAND, LIMIT_POINTS, HandFrame, HandLimits, PoseLimit, SplineSpace
from .task import (
    AXES,
    Reference,
    Task,
    point_names,
    point_places,
    require_reachable_starts,
    sampled_references,
)

# Fewest and largest numbers of samples of a plan.
FEWEST_SAMPLES, MOST_SAMPLES = 10, 20_000
# Samples of a motion of equilibria, where the task does not state the time between them.
EQUILIBRIA = 40
# Fewest samples of the window after the motion.
FEWEST_AT_REST = 4
# Jerk in units of the limit of the acceleration over the duration: that of a motion which changes
# between the limits in a tenth of its duration.
JERK_UNIT = 10.0
# Largest third derivative of the change with the least jerk, in units of the change over the cube of
# its duration.
SIGNAL_JERK_UNIT = 60.0
# Least variance in a direction of the parameters that scenarios vary, over the largest.
SMALLEST_VARIANCE = 1e-8
# Poses per sample that the simulation of a plan interpolates.
POSES_PER_SAMPLE = 4


class LinearisedLimits(NamedTuple):
    """Limits of a hand near some unknowns, to first order; linear limits are exact."""

    vectors: Array  # (k, 3): vectors whose norms must not exceed one
    vector_slopes: Array  # (k, 3, c): their derivatives by the unknowns
    rows: Array  # (m,): values that must not be positive
    row_slopes: Array  # (m, c): their derivatives


@dataclass(frozen=True, eq=False)
class LimitsOverTime:
    """Limits of a hand and of signals at all times at which they hold, as functions of the unknowns."""

    at_time: HandLimits  # limits at one time
    t_s: Array  # (T,): times since the start [s]
    # (T, 3k, c) and (T, 3k): the k coordinates and their two derivatives as an affine function of
    # the unknowns.
    matrix: Array
    constant: Array

    @classmethod
    def in_space(cls, at_time: HandLimits, space: SplineSpace) -> LimitsOverTime:
        """Build for the motions of a space of splines."""
        t_s = np.linspace(0.0, space.duration_s, LIMIT_POINTS * space.intervals + 1)
        matrices, constants = zip(*(space.affine(t_s, order) for order in range(3)), strict=True)
        return cls(
            at_time, t_s, np.concatenate(matrices, axis=1), np.concatenate(constants, axis=1)
        )

    def linearise(self, c: Array) -> LinearisedLimits:
        """Return the limits near unknowns c (c,), time by time."""
        states = (self.matrix @ c + self.constant).T
        parts = []
        for function in self._slopes:
            values, slopes = (each.full() for each in function(states))
            by_state = slopes.reshape(len(values), len(self.t_s), len(states)).transpose(1, 0, 2)
            parts += [values.T.ravel(), (by_state @ self.matrix).reshape(-1, len(c))]
        vectors, vector_slopes, rows, row_slopes = parts
        return LinearisedLimits(
            vectors.reshape(-1, 3), vector_slopes.reshape(-1, 3, len(c)), rows, row_slopes
        )

    @cached_property
    def _slopes(self) -> tuple[ca.Function, ca.Function]:
        """Vectors and rows with their slopes, at all times."""
        state = ca.SX.sym("state", self.matrix.shape[1])
        functions = []
        for each in (self.at_time.vectors, self.at_time.rows):
            values = each(state)
            slopes = ca.densify(ca.jacobian(values, state))
            functions.append(ca.Function("slopes", [state], [values, slopes]).map(len(self.t_s)))
        return functions[0], functions[1]

    @property
    def names(self) -> tuple[str, ...]:
        """Name of the limit of each vector, then of each row."""
        count = len(self.t_s)
        return self.at_time.vector_names * count + self.at_time.row_names * count

    @property
    def times_s(self) -> Array:
        """Time of each vector, then of each row [s]."""
        kinds = (self.at_time.vector_names, self.at_time.row_names)
        return np.concatenate([np.repeat(self.t_s, len(names)) for names in kinds])

    def shares(self, c: Array) -> Array:
        """Return the share of each limit that is used: norms of vectors, and one plus the rows."""
        near = self.linearise(c)
        return np.concatenate([np.linalg.norm(near.vectors, axis=1), 1 + near.rows])


@dataclass(frozen=True, eq=False)
class PlannedProgram:
    """Optimal-control problem of a task for a body."""

    body: PlannedBody
    task: Task
    limits: Limits  # limits of the robot
    experiment: Experiment  # experiment of the plan, with the hand standing at its initial pose
    driven: DrivenMotion  # motion of the body as a function of the hand's
    space: SplineSpace  # motions of the hand, and signals
    start: Array  # (3n,): equilibrium before the motion [m]
    references: list[Reference]  # references at the samples
    # Lowest natural frequency of the body about the equilibrium; NaN if there is none.
    lowest_hz: float
    signals: tuple[Signal, ...]  # tensions and pressures that the plan chooses
    pose_limits: PoseLimit | None = None  # limits of the joints, see `HandLimits`

    @classmethod
    def from_task(
        cls, body: PlannedBody, task: Task, limits: Limits, pose_limits: PoseLimit | None = None
    ) -> PlannedProgram:
        """Build the problem.

        Raises
        ------
        InputError
            If the limits exclude the start or the end, a point is unknown, or the times do not fit.
        SimulationError
            If the body has no equilibrium in the initial pose.
        """
        template = body.template
        if task.avoid.clearance_m is not None and not template.obstacles:
            raise InputError(
                "the recording has no obstacles; expected clearance_m for a body beside one",
                None,
                where="avoid.clearance_m",
            )
        if task.avoid.largest_stretch is not None and not template.body.is_solid:
            raise InputError(
                "a rod hardly stretches; expected largest_stretch for a solid body",
                None,
                where="avoid.largest_stretch",
            )
        usual_s = task.duration_s / EQUILIBRIA if template.is_static else template.timestep_s
        sample_s = task.sample_s or usual_s
        count = round(task.duration_s / sample_s)
        if not FEWEST_SAMPLES <= count <= MOST_SAMPLES:
            raise InputError(
                f"{task.duration_s:g} s are {task.duration_s / sample_s:.6g} samples of "
                f"{sample_s:g} s; expected {FEWEST_SAMPLES} to {MOST_SAMPLES}",
                None,
                where="duration_s" if task.sample_s is None else "sample_s",
            )
        # The motion ends at a sample, so that the window begins at rest.
        sample_s = task.duration_s / count
        rotation, translation = body.start_pose
        hand_m = rotation @ body.hand_m + translation
        bounds = limits.bounds_from(hand_m)
        signals = task_signals(task, template)
        space = _space(task, bounds, signals)
        names, places = point_names(task), point_places(task, body.marker_places_m)
        points = dict(zip(names, places, strict=True)) or _farthest_node(body)
        substeps = body.problem.choose_first_substeps()

        def standing(samples: int) -> tuple[Experiment, DrivenMotion]:
            """Return the experiment with `samples` samples in which the hand stands."""
            t_s = template.t_s[0] + sample_s * np.arange(samples)
            experiment = body.experiment(None, t_s, points)
            return experiment, DrivenMotion.from_experiment(
                experiment,
                body.problem.parameters,
                body.problem.scheme,
                substeps=substeps,
                q=body.q,
            )

        _, brief = standing(3)
        goals = brief.stated_goals_m
        start = brief.simulate(Drive(goals, np.zeros((*goals.shape, 0))))[0]
        lowest_hz = np.nan if template.is_static else _lowest_frequency_hz(brief, start)
        if template.is_static and task.end.window_s is not None:
            raise InputError(
                f"found {task.end.window_s:g}, but the recording is static: each sample of the plan "
                "is an equilibrium; expected no window_s",
                None,
                where="end.window_s",
            )
        task = task.without_rest if template.is_static or task.information else task
        window = _window_samples(task, sample_s, lowest_hz)
        experiment, driven = standing(count + 1 + window)
        since_s = np.asarray(sample_s * np.arange(count + 1 + window), dtype=np.float64)
        started = experiment.markers.predict_positions(start.reshape(1, -1, 3))[0]
        index = {name: k for k, name in enumerate(points)}
        first = started[[index[name] for name in names]] if names else np.zeros((0, 3))
        references = sampled_references(task, since_s, places, first)
        size_m = float(np.ptp(start.reshape(-1, 3), axis=0).max())
        require_reachable_starts(task, references, first, size_m)
        hand = experiment, driven, space, start, references, lowest_hz, signals
        program = cls(body, task, limits, *hand, pose_limits)
        program.require_start_within_limits()
        if program.criterion is not None:
            program.criterion.require_identifiable()
        return program

    def require_start_within_limits(self) -> None:
        """Raise an `InputError` if the hand exceeds the limits of its joints before the motion, the body
        its own, or a function of the task cannot be evaluated there.
        """
        joints = np.array(self.hand_limits.names) == "joint_limits"
        standing_c = np.zeros(self.space.size)
        if (excess := self.hand_limits.shares(standing_c)[joints].max(initial=0.0) - 1) > 0:
            raise InputError(
                f"the hand exceeds them before the motion, by {excess:.2g}; expected values that are "
                "not positive where the motion begins",
                None,
                where="hand.joint_limits",
            )
        _, limits = self.path_costs, self.path_limits
        standing = np.tile(self.start, (len(self.grid_since_s), 1))
        if limits is not None and (excess := limits.evaluate(standing)[:, 0].max()) > 0:
            raise InputError(
                f"a limit is exceeded before the motion, by {excess:.2g} of its scale; expected "
                "limits that the body keeps at rest",
                None,
                where="limits",
            )
        if self.body_limits is None:
            return
        avoid = self.task.avoid
        for key, value in self.body_limits.extremes(self.start[None]).items():
            limit = getattr(avoid, key)
            if value > limit if key == "largest_stretch" else value < limit:
                side = "above" if key == "largest_stretch" else "below"
                raise InputError(
                    f"found {limit:g}, but it is {value:.4g} before the motion; expected a value "
                    f"{side} this",
                    None,
                    where=f"avoid.{key}",
                )

    def with_duration(self, duration_s: float) -> PlannedProgram:
        """Return the program with another duration [s] of the hand's motion, for the limits of the
        hand alone: samples and references are those of this program.
        """
        task = self.task.stretched(duration_s)
        return replace(self, task=task, space=_space(task, self.bounds, self.signals))

    def scenarios(self) -> tuple[PlannedProgram, ...]:
        """Return programs whose parameters are at 2k points around those of this program, so that
        means over these points equal means over their statistical distribution to second order (k is
        the rank of the covariance): effects act alike in recording and execution.

        Raises
        ------
        SimulationError
            If the body has no equilibrium with some of these parameters.
        """
        covariance = self.body.statistical_covariance
        assert covariance is not None
        variances, directions = np.linalg.eigh(covariance)
        chosen = np.flatnonzero(variances > SMALLEST_VARIANCE * variances.max(initial=0.0))
        steps = directions[:, chosen] * np.sqrt(len(chosen) * variances[chosen])
        found = []
        for step in np.concatenate([steps.T, -steps.T]):
            driven = replace(self.driven, q=self.driven.q + step)
            start = equilibrium(self.experiment, driven.theta, start=self.start)
            other = replace(self, driven=driven, start=start)
            # The hand and the residuals are the same.
            vars(other).update({name: getattr(self, name) for name in SHARED})
            found.append(other)
        return tuple(found)

    # The hand -------------------------------------------------------------------------------------

    @cached_property
    def bounds(self) -> HandBounds:
        """Limits of the hand relative to its initial position."""
        return self.limits.bounds_from(self.frame.position_m)

    @cached_property
    def frame(self) -> HandFrame:
        """Initial pose of the hand with the grasped nodes."""
        rotation, translation = self.body.start_pose
        grasp = self.experiment.grasps[self.body.grasp_number]
        arms = (self.experiment.body.nodes_m[grasp.nodes] - self.body.hand_m) @ rotation.T
        return HandFrame(rotation, rotation @ self.body.hand_m + translation, arms)

    @cached_property
    def grid_since_s(self) -> Array:
        """Grid times (N,) since the start [s]."""
        return self.driven.t_s - self.driven.t_s[0]

    @cached_property
    def coordinates_at_grid(self) -> tuple[Array, Array]:
        """Matrix (N, 6, c) and constant (N, 6) of the hand's coordinates at the grid times."""
        matrix, constant = self.space.affine(self.grid_since_s)
        return matrix[:, :HAND], constant[:, :HAND]

    @cached_property
    def _amplitudes(self) -> tuple[Array, Array]:
        """Amplitudes of all tendons and pressures at the evaluations as an affine function of the
        unknowns: matrix (N, a, c) and constant (N, a).
        """
        by_unknown, given = self.space.affine(self.driven.evaluated_s - self.driven.t_s[0])
        constant = np.array(self.driven.stated_amplitudes)
        matrix = np.zeros((*constant.shape, self.space.size))
        for k, signal in enumerate(self.signals, HAND):
            matrix[:, signal.number] = signal.slope * by_unknown[:, k]
            value = given[:, k] + signal.initial - signal.offset
            constant[:, signal.number] = signal.slope * value
        return matrix, constant

    @cached_property
    def planned_columns(self) -> Index:
        """Places of the planned grasp's dofs among the prescribed ones."""
        grasp = self.experiment.grasps[self.body.grasp_number]
        return np.searchsorted(self.driven.dofs, grasp.prescribed_dofs)

    def drive(self, c: Array) -> Drive:
        """Return what drives the body at the unknowns c (c,), with derivatives."""
        matrix, constant = self.coordinates_at_grid
        positions, slopes = self.frame.positions(matrix @ c + constant)
        rows = len(self.grid_since_s)
        goals = self.driven.stated_goals_m.copy()
        by_control = np.zeros((*goals.shape, len(c)))
        goals[:, self.planned_columns] = positions.reshape(rows, -1)
        by_control[:, self.planned_columns] = slopes.reshape(rows, -1, 6) @ matrix
        if not self.signals:
            return Drive(goals, by_control)
        matrix, constant = self._amplitudes
        return Drive(goals, by_control, matrix @ c + constant, matrix)

    def coordinates(self, c: Array, t_s: Array) -> Array:
        """Return the coordinates (T, 6) of the hand at times since the start."""
        return self.space.motion(c).derivatives(t_s).value

    def commands(self, c: Array, t_s: Array) -> dict[str, Array]:
        """Return the commands (T,) of tendons and pressures [N, Pa] at times since the start, by
        name, within their limits.
        """
        values, rates, _ = self.space.signals(c).derivatives(t_s)
        return {
            each.name: np.clip(
                each.command(values[:, k], rates[:, k]), each.lowest, each.highest
            )
            for k, each in enumerate(self.signals)
        }  # fmt: skip

    def poses(self, c: Array, t_s: Array) -> PoseSequence:
        """Return the poses of the grasped body at times (T,) since the start [s], as grasps have
        them: a grasped node at X of the undeformed body is at R X + p. Times of the poses are those
        of the experiment.
        """
        coordinates = self.coordinates(c, t_s)
        turned = Rotation.from_rotvec(coordinates[:, 3:]) * Rotation.from_matrix(
            self.frame.rotation
        )
        placed = self.frame.position_m + coordinates[:, :3] - turned.apply(self.body.hand_m)
        return PoseSequence(t_s + self.experiment.t_s[0], placed, quaternions_xyzw=turned.as_quat())

    def moved_experiment(self, c: Array) -> Experiment:
        """Return the experiment of the plan at the unknowns c, with points in place of the
        measurements.
        """
        t_s = self.experiment.t_s
        fine_s = np.linspace(0.0, t_s[-1] - t_s[0], POSES_PER_SAMPLE * (len(t_s) - 1) + 1)
        markers = self.experiment.markers
        places_m = markers.predict_positions(self.experiment.body.nodes_m)
        points = dict(zip(markers.names, places_m, strict=True))
        commands = {
            name: (t_s[0] + fine_s, values) for name, values in self.commands(c, fine_s).items()
        }
        return self.body.experiment(self.poses(c, fine_s), t_s, points, commands)

    @cached_property
    def criterion(self) -> InformationCriterion | None:
        """Criterion of the information; None if the task has none."""
        section = self.task.information
        if section is None:
            return None
        return InformationCriterion(section, self.body, self.driven, self.moved_experiment)

    @cached_property
    def body_limits(self) -> BodyLimits | None:
        """Limits of the body; None if the task has none."""
        avoid = self.task.avoid
        if avoid.largest_stretch is None and avoid.clearance_m is None:
            return None
        theta = self.driven.theta
        return BodyLimits(self.experiment, theta, self.sample_rows, **vars(avoid))

    @cached_property
    def reference_places_m(self) -> list[Array]:
        """Places of the points of the references on the undeformed body, each once."""
        names, places = point_names(self.task), point_places(self.task, self.body.marker_places_m)
        return [*dict(zip(names, places, strict=True)).values()]

    @cached_property
    def path_costs(self) -> PathValues | None:
        """Residuals of the costs that the task states as functions; None if there are none."""
        return self._path_values(self.task.costs)

    def with_path_costs(self, costs: AugmentedCosts) -> PlannedProgram:
        """Return the program with other residuals in place of `path_costs`."""
        other = copy(self)
        vars(other)["path_costs"] = costs
        return other

    @cached_property
    def path_limits(self) -> PathValues | None:
        """Limits that the task states as functions; None if there are none."""
        return self._path_values(self.task.limits)

    def _path_values(self, terms: Sequence[PathCost | PathLimit]) -> PathValues | None:
        hand = self.experiment.grasps[self.body.grasp_number].nodes
        return PathValues.from_terms(
            terms,
            self.reference_places_m,
            self.experiment.body,
            hand,
            self.start,
            self.grid_since_s,
            self.sample_rows,
        )

    def exceeds_path_limits(self, x: Array) -> bool:
        """Whether a motion x (N, 3n) [m] exceeds a `PathLimit` of the task."""
        limits = self.path_limits
        return limits is not None and bool(limits.evaluate(x).max() > 1 / WITHIN - 1)

    @cached_property
    def hand_limits(self) -> LimitsOverTime:
        """Limits of the hand and of the signals."""
        at_time = HandLimits.from_bounds(
            self.bounds, self.frame, self.space.free, self.pose_limits, self.signals
        )
        return LimitsOverTime.in_space(at_time, self.space)

    # The residuals --------------------------------------------------------------------------------

    @cached_property
    def residual_rows(self) -> list[tuple[str, sp.csr_array, Array]]:
        """Residuals S x − b of each reference, then of the rest at the end, in units of their
        deviations: name of the point or "rest", S (m, N · 3n) [1/m] and b (m,).
        """
        rows = [(each.name, *self._reference_rows(each)) for each in self.references]
        if self.task.end.at_rest:
            rows.append(("rest", *self._rest_rows()))
        return rows

    @cached_property
    def residuals(self) -> tuple[sp.csr_array, Array]:
        """Matrix S (m, N · 3n) and vector b (m,) of all residuals S x − b of the body."""
        size = len(self.grid_since_s) * self.driven.transcription.dof_count
        if not self.residual_rows:
            return sp.csr_array((0, size)), np.zeros(0)
        _, matrices, targets = zip(*self.residual_rows, strict=True)
        return sp.csr_array(sp.vstack(matrices)), np.concatenate(targets)

    @cached_property
    def effort(self) -> tuple[Array, Array]:
        """Matrix (k, c) and constant (k,) of the weighted jerk of the hand and of the signals, an
        affine residual.
        """
        matrix, constant = self.space.jerk()
        limits, duration_s = self.limits, self.space.duration_s
        growth = np.radians(limits.angular_acceleration_deg_s2)
        unit = np.repeat([limits.acceleration_m_s2, growth], 3) * JERK_UNIT / duration_s
        spans = np.array([each.span for each in self.signals])
        unit = np.concatenate([unit, SIGNAL_JERK_UNIT * spans / duration_s**3])
        weights = [self.task.hand.jerk_weight] * HAND
        weights += [each.section.jerk_weight for each in self.signals]
        weight = np.sqrt(np.array(weights) / len(matrix)) / unit
        scaled = matrix * weight[:, None]
        return scaled.reshape(-1, self.space.size), (constant * weight).ravel()

    def point_weights(self, name: str) -> sp.csr_array:
        """Return the weights (3, 3n) of the node positions in the position of a point."""
        markers = self.experiment.markers
        placement = markers.placement
        number = markers.names.index(name)
        weights = np.zeros((3, self.driven.transcription.dof_count))
        for axis in range(3):
            weights[axis, 3 * placement.nodes[number] + axis] = placement.weights[number]
        return sp.csr_array(weights)

    @property
    def sample_rows(self) -> Index:
        """Grid times of the samples."""
        substeps = self.driven.transcription.substeps
        return np.arange(len(self.experiment.t_s)) * substeps

    def _reference_rows(self, reference: Reference) -> tuple[sp.csr_array, Array]:
        at_point = self.point_weights(reference.name)
        rows = self.sample_rows
        last = len(self.grid_since_s) - 1
        step_s = self.grid_since_s[1]
        blocks, targets = [], []
        for values, unit, is_velocity in (
            (reference.position_m, reference.sigma_m, False),
            (reference.velocity_m_s, reference.sigma_m_s, True),
        ):
            samples, axes = np.nonzero(np.isfinite(values))
            if not len(samples):
                continue
            scale = 1 / (unit * np.sqrt(len(np.unique(samples))))
            at = rows[samples]
            if is_velocity:
                before, after = np.maximum(at - 1, 0), np.minimum(at + 1, last)
                weight = scale / ((after - before) * step_s)
                select = _selection(after, len(self.grid_since_s), weight)
                select = select - _selection(before, len(self.grid_since_s), weight)
            else:
                select = _selection(at, len(self.grid_since_s), np.full(len(at), scale))
            # Row r has the product of its time's weights and its axis' weights.
            blocks.append(_row_products(select, sp.csr_array(at_point[axes])))
            targets.append(scale * values[samples, axes])
        return sp.csr_array(sp.vstack(blocks)), np.concatenate(targets)

    def _rest_rows(self) -> tuple[sp.csr_array, Array]:
        """Return the residuals of the velocity of all nodes after the motion."""
        transcription = self.driven.transcription
        free = transcription.free_dofs
        mass = transcription.dynamics.mass.inertia_at(0)[free]
        weight = np.sqrt(mass / (mass.sum() / 3))
        step_s = transcription.dynamics.step_s
        first = round(self.task.duration_s / step_s)
        rows = np.arange(first, len(self.grid_since_s) - 1)
        omega = 2 * np.pi * self.lowest_hz
        scale = 1 / (omega * self.task.end.sigma_m * step_s * np.sqrt(len(rows)))
        weights = np.full(len(rows), scale)
        difference = _selection(rows + 1, len(self.grid_since_s), weights)
        difference = difference - _selection(rows, len(self.grid_since_s), weights)
        of_dofs = sp.csr_array(
            (weight, (np.arange(len(free)), free)), shape=(len(free), transcription.dof_count)
        )
        matrix = sp.csr_array(sp.kron(difference, of_dofs))
        return matrix, np.zeros(len(rows) * len(free))

    def linearise(self, c: Array, x: Array, slopes: Array) -> tuple[Array, Array]:
        """Return the derivatives (m, c) by the unknowns, and the values (m,), of the residuals of
        the body for a motion x (N, 3n) with derivatives (N, 3n, c).
        """
        flat = slopes.reshape(-1, len(c))
        if self.criterion is not None:
            rows, values = self.criterion.linearise(c, x, slopes)
        else:
            matrix, target = self.residuals
            rows, values = matrix @ flat, matrix @ x.ravel() - target
        if self.path_costs is None:
            return rows, values
        costs, by_x = self.path_costs.linearise(x)
        return np.concatenate([rows, by_x @ flat]), np.concatenate([values, costs.ravel()])

    def objective_parts(self, c: Array, x: Array) -> dict[str, float]:
        """Return the parts of the objective at unknowns c and motion x (N, 3n): of each reference,
        of the rest at the end, of the information, of the costs, and of the jerk.
        """
        parts: dict[str, float] = {}
        flat = x.ravel()
        for name, matrix, target in self.residual_rows:
            value = float(np.sum((matrix @ flat - target) ** 2))
            parts[name] = parts.get(name, 0.0) + value
        if self.criterion is not None:
            parts["information"] = self.criterion.value(c, x)
        if self.path_costs is not None:
            parts["costs"] = float(np.sum(self.path_costs.evaluate(x) ** 2))
        matrix, constant = self.effort
        parts["jerk"] = float(np.sum((matrix @ c + constant) ** 2))
        return parts

    def largest_error_m(self, x: Array) -> float:
        """Return the largest distance of a point from its reference and, if the body rests at the
        end, of a node from its mean position after the motion, in a motion x (N, 3n) [m].
        """
        sampled = x[self.sample_rows]
        largest = 0.0
        for each in self.references:
            points = sampled @ self.point_weights(each.name).toarray().T
            deviation = np.nan_to_num(points - each.position_m)
            largest = max(largest, float(np.linalg.norm(deviation, axis=1).max()))
        return max(largest, self.residual_vibration_m(sampled) or 0.0)

    def residual_vibration_m(self, sampled: Array) -> float | None:
        """Return the largest distance of a node from its mean position after the motion [m], for
        positions (T, 3n) at the samples; None if the body need not be at rest.
        """
        if not self.task.end.at_rest:
            return None
        since_s = self.experiment.t_s - self.experiment.t_s[0]
        nodes = sampled[since_s >= self.task.duration_s - 1e-9].reshape(
            -1, sampled.shape[1] // 3, 3
        )
        return float(np.linalg.norm(nodes - nodes.mean(axis=0), axis=2).max())

    def objective(self, c: Array, x: Array) -> float:
        """Return the objective at unknowns c and motion x (N, 3n)."""
        return sum(self.objective_parts(c, x).values())

    def simulate(self, c: Array, near: Array | None = None, drive: Drive | None = None) -> Array:
        """Return the motion (N, 3n) [m] at the unknowns c, see `DrivenMotion.simulate`; `drive` is
        that of c, where it is known.
        """
        return self.driven.simulate(drive or self.drive(c), start=self.start, near=near)


# What programs with other constants have in common with the original, see `scenarios`.
SHARED = (
    "bounds",
    "frame",
    "coordinates_at_grid",
    "planned_columns",
    "_amplitudes",
    "hand_limits",
    "residual_rows",
    "residuals",
    "path_costs",
    "path_limits",
    "effort",
)


def _selection(rows: Index, count: int, weights: Array) -> sp.csr_array:
    """Return a matrix (k, count) with one weight in each row."""
    return sp.csr_array((weights, (np.arange(len(rows)), rows)), shape=(len(rows), count))


def _row_products(left: sp.csr_array, right: sp.csr_array) -> sp.csr_array:
    """Return the matrix (k, a · b) whose rows are the Kronecker products of the rows of two matrices
    (k, a) and (k, b).
    """
    count, many = cast(tuple[int, int], left.shape)
    width = cast(tuple[int, int], right.shape)[1]
    entries = sp.coo_array(left)
    first, place = entries.coords
    counts = np.diff(right.indptr)[first]
    rows = np.repeat(first, counts)
    offsets = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    source = right.indptr[rows] + offsets
    columns = np.repeat(place, counts) * width + right.indices[source]
    values = np.repeat(entries.data, counts) * right.data[source]
    return sp.csr_array((values, (rows, columns)), shape=(count, many * width))


def _farthest_node(body: PlannedBody) -> dict[str, Array]:
    """Return the node that is farthest from the hand, for a task without references."""
    nodes_m = body.template.body.nodes.points_m
    farthest = np.linalg.norm(nodes_m - body.hand_m, axis=1).argmax()
    return {"farthest node": nodes_m[farthest]}


def _space(task: Task, bounds: HandBounds, signals: Sequence[Signal]) -> SplineSpace:
    """Return the space of the hand's motions and of the signals; an `InputError` if the end is
    beyond the workspace.
    """
    hand = task.hand
    free = np.array([AXES.index(axis) for axis in hand.free], dtype=np.int64)
    end = np.full(6, np.nan)
    if hand.end_m is not None:
        end[:3] = hand.end_m
        within = (bounds.low_m < end[:3]) & (end[:3] < bounds.high_m)
        if not (within | np.isnan(end[:3])).all():
            raise InputError(
                f"the hand ends {list(hand.end_m)} m from its start, outside the workspace; "
                "expected an end within workspace_m of the limits",
                None,
                where="hand.end_m",
            )
    if hand.end_rotation_deg is not None:
        end[3:] = np.radians(hand.end_rotation_deg)
        angle = float(np.linalg.norm(np.nan_to_num(hand.end_rotation_deg)))
        if angle >= bounds.limits.rotation_deg:
            raise InputError(
                f"the hand turns by {angle:g}° until its end; expected less than rotation_deg = "
                f"{bounds.limits.rotation_deg:g} of the limits",
                None,
                where="hand.end_rotation_deg",
            )
    end[np.setdiff1d(np.arange(6), free)] = 0.0
    reach = bounds.reach
    units = np.repeat(np.minimum(reach.value, reach.second * task.duration_s**2 / 4), 3)
    return SplineSpace(
        task.duration_s,
        hand.intervals,
        np.concatenate([np.sort(free), HAND + np.arange(len(signals))]),
        np.concatenate([end, [each.end for each in signals]]),
        np.concatenate([units, [each.span for each in signals]]),
    )


def _lowest_frequency_hz(driven: DrivenMotion, start: Array) -> float:
    """Return the lowest natural frequency about the equilibrium [Hz]; NaN if nothing oscillates."""
    transcription = driven.transcription
    forces = at_times(transcription.dynamics.with_theta(driven.theta).forces, slice(1))
    found = natural_modes(forces, start, free_dofs=transcription.free_dofs, count=1)
    return float(found.frequencies_hz[0]) if len(found.frequencies_hz) else np.nan


def _window_samples(task: Task, sample_s: float, lowest_hz: float) -> int:
    """Return the number of samples after the motion in which the body is at rest; 0 if it need not
    be.
    """
    end = task.end
    if not end.at_rest:
        return 0
    if end.window_s is None and not np.isfinite(lowest_hz):
        raise InputError(
            "the body has no natural frequency from which the window of rest follows; expected "
            "window_s, or at_rest = false",
            None,
            where="end.window_s",
        )
    window_s = 0.5 / lowest_hz if end.window_s is None else end.window_s
    samples = int(np.ceil(window_s / sample_s - 1e-9))
    if samples > MOST_SAMPLES or (end.window_s is not None and samples < FEWEST_AT_REST):
        raise InputError(
            f"found window_s = {window_s:g}, which is {samples:g} samples of {sample_s:g} s; "
            f"expected {FEWEST_AT_REST} to {MOST_SAMPLES}",
            None,
            where="end.window_s",
        )
    return max(samples, FEWEST_AT_REST)
