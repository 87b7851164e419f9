"""One forward pass over a recording at one parameter point p: motion, sensitivities and residuals.

A few rows of the grid at a time continue from the state of the previous ones (positions, forces,
and the columns Z of derivatives by the parameters that affect the motion). They are linearised
together at their initial guesses; each row is then solved once, for its Newton correction and its
columns: a Gauss–Newton step on the collocation equations, whose error is of second order in the
correction, as in the reduced-space method. A row with a long correction is linearised again, alone,
at the corrected position.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..common.time_dependence import at_times
from ..fem.body import Linearisation
from ..model.dynamics import StencilRow
from ..recording.poses import Poses
from .forward.initial_equilibrium import initial_state
from .forward.newton_solver import NewtonFailure, simulation_error
from .forward.scheme_simulation import RowEquations, extrapolate, solve_row
from .least_squares import SquareRootInformation
from .measurement_residual import huber_as_least_squares, lagrange_weights
from .observables import ObservableDerivatives, ObservedMotion, PointPositions
from .reactions.grasps import DELAY_STEPS, GraspReactions
from .streaming_model import ROW_TOLERANCE, ROWS_PER_CHUNK, StreamingModel
from .sweep import (
    FactorisedStep,
    ForwardState,
    ForwardSubstitution,
    PrescribedColumns,
    SweepColumns,
)

# Largest correction of a row, divided by the size of the body, after which the row is not
# linearised again: the next correction would be about its square.
LARGEST_CORRECTION = 3e-4
# Factor of this limit for rows that are solved together; beyond the limit another pass follows.
CHUNK_CORRECTION_FACTOR = 10
# Largest delay of samples that are still used, in samples.
LARGEST_SAMPLE_DELAY = 5


class Sample(NamedTuple):
    """Measured values of a time between or at rows."""

    # Time of the sample, in rows before the row after which it is evaluated; 0 for that row itself.
    rows_back: float
    # (M, 3) or (m,): marker positions [m], or values of an instrument; NaN where missing.
    values: Array
    # 0 for markers, or the number of the instrument in `StreamingModel.instruments`, from 1 on.
    instrument: int = 0


class LoggedRow(NamedTuple):
    """Input of one row of the grid."""

    poses: Poses  # poses of the grasps that move, in the order of `StreamingModel.moving_grasps`
    samples: list[Sample]  # samples that are evaluated after this row; often empty


class StoredRow(NamedTuple):
    """Initial guess of a row for a later pass."""

    transformed: Array  # (P,): transformed parameters of the pass, see `StreamingModel.transformed`
    x: Array  # (3n,): positions [m]
    # (3n, m) float32: derivatives Z of the positions by these transformed parameters.
    columns: NDArray[np.float32]


class LinearisedResidual(NamedTuple):
    """Residuals of a sample, linear in the parameters of `StreamingModel.transformed`."""

    # (G, 3): residuals in standard deviations, extrapolated to transformed parameters of zero; NaN
    # where missing.
    at_zero: Array
    slope: Array  # (G, 3, P): derivatives by the transformed parameters
    instrument: int = 0  # instrument, see `Sample`

    def evaluate_at(self, transformed: Array) -> Array:
        """Return the residuals (G, 3) at transformed parameters (P,), to first order; NaN where
        missing.
        """
        return self.at_zero + self.slope @ transformed


# A row as `StoredRow`; positions and columns of markers and of the points of custom sensors,
# (3M + …, 1 + m); and resultants with their derivatives by all parameters, (sensors, 6, 1 + P).
ObservedRow = tuple[StoredRow, Array, Array]


@dataclass(frozen=True, eq=False)
class SweepState:
    """State on which the next row depends."""

    row: int  # number of rows done since the start of the recording
    end: int  # index of the next row in the template, whose rows before it are the latest ones
    # (rows, 3n): positions [m] and forces [N] of the rows of the template.
    x: Array
    force: Array
    # (rows, g, 1 + m): columns of the prescribed positions of the grasped dofs.
    prescribed_columns: Array
    reactions: GraspReactions  # reaction forces of grasps with a sensor
    last_rows: ForwardState | None  # columns of the last rows; None at the start
    # Observed quantities of the last rows, the latest one last.
    observed_rows: tuple[ObservedRow, ...]


class StreamingSweep:
    """Forward pass at parameters p, row after row.

    Parameters
    ----------
    model : StreamingModel
        The program; its buffers are used.
    p : (P,)
        Linearisation point.
    prior_information : SquareRootInformation
        Information from before its first row, in the transformed parameters.
    start : SweepState, optional
        State at which the pass begins, not modified; the start of the recording by default, also
        without `at`.
    at : (P,), optional
        Linearisation point of that state, which is moved to p along its columns. Columns by
        transformed parameters stay the same.

    Attributes
    ----------
    information : SquareRootInformation
        Information in the transformed parameters, from `prior_information` and all residuals added.
    longest_m : float
        Longest accepted correction so far [m].

    Raises
    ------
    SimulationError
        By `advance`, if the start or a row cannot be computed.
    """

    def __init__(
        self,
        model: StreamingModel,
        p: Array,
        prior_information: SquareRootInformation,
        start: SweepState | None = None,
        at: Array | None = None,
    ) -> None:
        self.model = model
        self.p = p
        self.solver = model.solver
        self.transformed = model.transformed(p)
        self.rates = model.transformation_derivatives(self.transformed)
        collocation = model.collocation
        transcription = model.transcription
        self.transcription = transcription
        self.phi = p[collocation.nq :]
        self.setting = transcription.equations_at(p[: collocation.nq], self.phi)
        self.dynamics = self.setting.dynamics
        self.displaced_nodes = model.displaced_nodes(self.phi)
        self.shape_functions = transcription.markers.observable.shape_functions(self.phi)
        points_and_weights = [
            self.shape_functions,
            *(points.shape_functions(self.phi) for points in model.observed_points),
        ]
        self._observables = tuple(
            np.concatenate(part)
            for part in zip(*((nodes, at.weights) for nodes, at in points_and_weights), strict=True)
        )
        self.longest_m = 0.0
        self.grasped = transcription.prescribed_motion.dofs
        self.moving = transcription.dynamic_parameters
        self.sensed = transcription.sensed_dofs
        self.count = 1 + len(self.moving)
        self.mass_kg = self.dynamics.mass.inertia_kg[0]
        # Loads are always there: what acts on one row acts on every one.
        self.forces = at_times(self.dynamics.forces, slice(1))
        self._rows = {} if self.setting.mass_depends_on_parameters else model.cached_rows
        self.information = prior_information
        state = (
            self._initial_state() if start is None or at is None else self._moved_state(start, at)
        )
        self._resume(state)

    # State ------------------------------------------------------------------------------------

    def _initial_state(self) -> SweepState:
        """Return the state before the first row, all zero."""
        rows = self.model.template_rows
        dofs = self.transcription.dof_count
        empty = np.zeros((rows, dofs))
        node_loads = np.zeros((rows, len(self.grasped), self.count))
        reactions = GraspReactions.zeros(
            rows, len(self.sensed), columns=self.count, grasps=len(self.model.first_poses)
        )
        return SweepState(
            0,
            0,
            x=empty,
            force=empty,
            prescribed_columns=node_loads,
            reactions=reactions,
            last_rows=None,
            observed_rows=(),
        )

    def _moved_state(self, state: SweepState, at: Array) -> SweepState:
        """Return `state` at the parameters of this pass, to first order."""
        if state.last_rows is None or (at == self.p).all():
            return state
        moving = self.moving
        transformed = self.model.transformed(at)
        old_rates = self.model.transformation_derivatives(transformed)
        change = (self.transformed - transformed)[moving]
        step = change / old_rates[moving]
        factors = np.ones(self.count)
        factors[1:] = (self.rates / old_rates)[moving]
        force = state.force.copy()
        memory = state.last_rows
        last = state.end - 1
        for k, columns in enumerate(memory.increments[: last + 1]):
            force[last - k, self.solver.free] += columns[:, 1:] @ step
        solutions, increments = (
            tuple(columns * factors for columns in each)
            for each in (memory.solutions, memory.increments)
        )
        memory = replace(memory, solutions=solutions, increments=increments)
        stored = [each for each, *_ in state.observed_rows]
        columns_of_rows = np.empty((len(stored), self.transcription.dof_count, self.count))
        columns_of_rows[..., 1:] = [each.columns for each in stored]
        columns_of_rows[..., 0] = columns_of_rows[..., 1:] @ change + [each.x for each in stored]
        x = state.x.copy()
        known_rows = min(len(stored), state.end)
        x[state.end - known_rows : state.end] = columns_of_rows[len(stored) - known_rows :, :, 0]
        point_columns = self._at_points(columns_of_rows)
        point_columns[..., 1:] *= self.rates[moving]
        stored_rows = [
            StoredRow(self.transformed, w[:, 0], columns=k.columns)
            for w, k in zip(columns_of_rows, stored, strict=True)
        ]
        all_resultants = np.array([resultants for *_, resultants in state.observed_rows])
        all_resultants[..., 0] += all_resultants[..., 1:] @ (
            (self.transformed - transformed) / old_rates
        )
        all_resultants[..., 1:] *= self.rates / old_rates
        read = tuple(zip(stored_rows, point_columns, all_resultants, strict=True))
        reactions = state.reactions.moved_to(step, factors)
        return replace(
            state, x=x, force=force, reactions=reactions, last_rows=memory, observed_rows=read
        )

    def _resume(self, state: SweepState) -> None:
        """Set the state of this pass, in place, to a given one, whose arrays are copied."""
        self.row = state.row
        self.end = state.end
        self.x = state.x.copy()
        self.force = state.force.copy()
        self.prescribed_columns = state.prescribed_columns.copy()
        grasped = None
        if self.transcription.nuisance.affects_grasps:
            grasped = PrescribedColumns.from_columns(
                self.solver, self.grasped, columns=self.prescribed_columns
            )
        self.columns = SweepColumns(self.setting, self.count, has_step=True, prescribed=grasped)
        self.reactions = state.reactions.copy()
        self.forward = ForwardSubstitution(
            self.solver, self.columns, last=state.last_rows, grasp_forces=self.reactions.forces
        )
        most = (
            (2 * self.model.neighbouring_samples + LARGEST_SAMPLE_DELAY + 2)
            * self.model.collocation.substeps
            + 4
            + ROWS_PER_CHUNK
        )
        most += self.model.largest_delay_rows
        self.read: deque[ObservedRow] = deque(state.observed_rows, maxlen=most)

    def needs_another_pass(self) -> bool:
        """Return whether an accepted correction was longer than `LARGEST_CORRECTION` body sizes, so
        that its square is not negligible.
        """
        return self.longest_m > LARGEST_CORRECTION * self.model.body_size_m

    def copy_state(self) -> SweepState:
        """Return the state on which the next row depends; its arrays are copied, except the columns
        of the last rows.
        """
        return SweepState(
            row=self.row,
            end=self.end,
            x=self.x.copy(),
            force=self.force.copy(),
            prescribed_columns=self.prescribed_columns.copy(),
            reactions=self.reactions.copy(),
            last_rows=self.forward.copy_state(),
            observed_rows=tuple(self.read),
        )

    # Rows -------------------------------------------------------------------------------------

    def advance(self, poses: Sequence[Poses], guesses: Sequence[Array] = ()) -> list[StoredRow]:
        """Compute further rows with given poses; return them for later passes.

        Fewer rows than given are computed if one is far from its initial guess: later guesses are
        then wrong, too. At the start of an experiment whose row 0 is given, this row alone is
        computed. The caller passes the remaining poses again.

        Parameters
        ----------
        poses : sequence of Poses
            Poses of the moving grasps, for one to `ROWS_PER_CHUNK` rows.
        guesses : sequence of (3n,), optional
            Initial guesses of the positions [m], one for each row; extrapolated by default.

        Returns
        -------
        list of StoredRow
            The computed rows, at least one.

        Raises
        ------
        SimulationError
            If a row cannot be solved.
        """
        poses = [self.model.all_poses(each) for each in poses]
        first = self._make_room(len(poses))
        count = len(poses)
        goals, slopes = self.model.prescribed_positions(self.displaced_nodes, poses)
        self.reactions.set_poses(first, poses)
        self.prescribed_columns[first : first + count, :, 1 + self.transcription.nq :] = slopes
        if first < self.dynamics.first_row:
            self.x[first] = self._start_positions(poses[0])
            self._count_rows(1)
            return self._store_rows([np.zeros(self.forward.shape)])
        for k, t in enumerate(range(first, first + count)):
            self.x[t] = guesses[k] if guesses else self._extrapolate(t, poses[k])
            self.x[t, self.grasped] = goals[k]
        remaining = range(first, first + count)
        computed = []
        last_length = np.inf
        is_careful = False
        while remaining:
            limit = (
                LARGEST_CORRECTION
                * self.model.body_size_m
                * (1 if len(remaining) == 1 else CHUNK_CORRECTION_FACTOR)
            )
            rows, length = self._solve_rows(remaining, limit)
            accepted = len(remaining) if length is None else len(rows) - 1
            computed += rows[:accepted]
            self._count_rows(accepted)
            if length is None:
                break
            t = remaining[accepted]
            if length < last_length / 2:
                self.x[t] += rows[accepted][:, 0]
                last_length = length
            elif not is_careful:
                self.x[t] = self._solve_carefully(t, poses[t - first])
                is_careful = True
                last_length = np.inf
            else:
                self._fail(NewtonFailure(self.x[t], "Newton's steps do not get shorter"))
            remaining = range(t, t + 1)
        return self._store_rows(computed)

    def _count_rows(self, count: int) -> None:
        """Increase the counters of completed rows by `count`, in place."""
        self.row = self.row + count
        self.end = self.end + count

    def _make_room(self, count: int) -> int:
        """Discard the oldest rows so that `count` fit; return the next index."""
        surplus = self.end + count - self.model.template_rows
        if surplus > 0:
            for each in (self.x, self.force, self.prescribed_columns, *self.reactions.arrays):
                each[:-surplus] = each[surplus:]
            self.end -= surplus
        return self.end

    def _extrapolate(self, t: int, poses: Poses) -> Array:
        """Return an initial guess of the positions (3n,) of row t of the template, on a cubic
        polynomial through the last four rows, or through fewer at the start; row 0 is the initial
        state for `poses`.
        """
        if t == 0:
            return self._start_positions(poses)
        if t < 4:
            return extrapolate(self.x[:t], np.zeros(self.transcription.dof_count))
        return 4 * (self.x[t - 1] + self.x[t - 3]) - 6 * self.x[t - 2] - self.x[t - 4]

    def _start_positions(self, poses: Poses) -> Array:
        """Solve the initial state (3n,) with grasps at given poses."""
        goals_m = np.full(self.transcription.dof_count, np.nan)
        goals_m[self.grasped] = self.model.prescribed_positions(self.displaced_nodes, [poses])[0][0]
        experiment = self.model.at_start(poses)
        return initial_state(experiment, self.forces, self.model.newton, prescribed_m=goals_m)[0]

    def _linearise(self, here: range) -> tuple[Linearisation, tuple[Array, Array]]:
        """Return forces with derivatives at the guessed rows `here` of the template, and the
        right-hand sides (R, F_R) of their columns, see `SweepColumns.right_hand_sides`.

        The corrections of previous rows, column 0 of the state, are contained in their positions:
        they are set to zero, in place.
        """
        for past in (*self.forward.past, *self.forward.past_increments):
            past[:, 0] = 0.0
        rows = slice(here.start, here.stop)
        known = slice(here.stop)
        p, q, w, s = self.model.stencils
        x = self.x[known]
        force = self.force[known]
        free = self.solver.free
        acceleration = s[rows, known] @ x
        at = self.forces.linearise(
            p[rows, known] @ x, q[rows, known] @ x, out=self.model.linearisation_memory[: len(here)]
        )
        force[rows] = at.force
        total = w[rows, known] @ force
        residual = (total - self.mass_kg * acceleration)[:, free]
        return at, self.columns.right_hand_sides(
            rows, at, acceleration=acceleration, residual=residual, free=free
        )

    def _stencil_row(self, t: int) -> StencilRow:
        """Return the coefficients of row t, cached in model or pass."""
        if t not in self._rows:
            self._rows[t] = StencilRow.from_dynamics(self.dynamics, t)
        return self._rows[t]

    def _solve_rows(self, here: range, limit: float) -> tuple[list[Array], float | None]:
        """Take one Newton step in each row; return their columns (3n, 1 + m), and None if all
        corrections are accepted.

        Column 0 of a row is the correction of its positions [m], the others are sensitivities.
        Accepted corrections are added to the positions, in place. At the first row that is not
        accepted, because its correction is longer than the limit or its matrix is singular, the
        work stops; the last columns are then those of this row, its positions are unchanged, and
        the second value is the length of the correction [m], or NaN for a singular matrix.
        """
        solver = self.solver
        forward = self.forward
        at, sides = self._linearise(here)
        solved: list[Array] = []
        for k, (t, right, force) in enumerate(zip(here, *sides, strict=True)):
            row = self._stencil_row(t)
            before = forward.copy_state()
            row_columns = np.zeros(forward.shape)
            by_position = at.by_position[k]
            by_velocity = at.by_velocity[k]
            by_position_skew = at.by_position_skew[k]
            by_velocity_skew = at.by_velocity_skew[k]
            block = row.block(by_position, by_velocity, pattern=solver.pattern)
            skew_block = row.skew_block(by_position_skew, by_velocity_skew)
            solved.append(row_columns)
            try:
                factor = solver.factoriser.factorise(
                    block, skew_block, buffer=self.model.factor_memory
                )
                step = FactorisedStep(
                    t,
                    row,
                    force=at.force[k],
                    by_position=by_position,
                    by_velocity=by_velocity,
                    factor=factor,
                    skew=by_position_skew,
                    rate_skew=by_velocity_skew,
                )
                forward.solve_step(step, right, force=force, out=row_columns)
            except np.linalg.LinAlgError:
                return solved, np.nan
            length = float(np.abs(row_columns[:, 0]).max(initial=0.0))
            if not length <= limit:
                self.forward = ForwardSubstitution(
                    solver, self.columns, last=before, grasp_forces=self.reactions.forces
                )
                return solved, length
            self.longest_m = max(self.longest_m, length)
            self.x[t] += row_columns[:, 0]
            if forward.weighs_past:
                # Correct the forces by their increment in this row.
                self.force[t, solver.free] += forward.past_increments[0][:, 0]
        return solved, None

    def _store_rows(self, columns: Sequence[Array]) -> list[StoredRow]:
        """Correct reactions, store observed quantities, return the last rows."""
        rows = slice(self.end - len(columns), self.end)
        all_columns = np.array(columns)
        all_columns[:, :, 0] = self.x[rows]
        by_transformed = (all_columns[:, :, 1:] / self.rates[self.moving]).astype(np.float32)
        pairs = zip(self.x[rows].copy(), by_transformed, strict=True)
        stored_rows = [StoredRow(self.transformed, *pair) for pair in pairs]
        self.reactions.apply_correction(rows, all_columns[:, self.sensed])
        self.read.extend(
            zip(
                stored_rows,
                self._at_points(all_columns),
                self._observed_resultants(rows),
                strict=True,
            )
        )
        return stored_rows

    def _observed_resultants(self, here: slice) -> Array:
        """Return the reaction resultants of the sensors and their derivatives (rows, sensors, 6, 1
        + P).

        Index 0 of the last axis has the value [N, N m], the others the derivatives with respect to
        p. At row k the resultant is that of `DELAY_STEPS` rows before. Rows before the first
        available resultant are zero.
        """
        sensors = self.model.reaction_sensors
        size = self.model.parameter_count
        resultants = np.zeros((here.stop - here.start, len(sensors), 6, 1 + size))
        if not sensors:
            return resultants
        first = max(here.start, int(sensors[0][0].known_rows[0]) + DELAY_STEPS)
        if first >= here.stop:
            return resultants
        _, _, w, s = self.model.stencils
        x = self.x[: here.stop, self.sensed]
        rows = np.arange(first, here.stop)
        reactions, channels = self.reactions.resultants(
            sensors, self.setting, x=x, weights=(w, s), rows=rows
        )
        motion = ObservedMotion(x, reactions)
        for k, channel in enumerate(channels):
            value, slopes = channel.linearise(motion, self.phi, columns=self.moving, size=size)
            sensor_resultants = resultants[first - here.start :, k]
            sensor_resultants[..., 0] = value.reshape(-1, 6)
            sensor_resultants[..., 1:] = slopes.by_common.reshape(-1, 6, size)
        return resultants

    def _at_points(self, columns: Array) -> Array:
        """Interpolate columns (…, 3n, k) at markers and observed points."""
        nodes, weights = self._observables
        *rows, dofs, count = columns.shape
        at = columns.reshape(*rows, dofs // 3, 3, count)[..., nodes, :, :]
        return np.einsum("ma,...maik->...mik", weights, at).reshape(*rows, -1, count)

    def _solve_carefully(self, t: int, poses: Poses) -> Array:
        """Solve row t (3n,), the displacement of grasps in parts."""
        if t == 0:
            return self._start_positions(poses)
        equations = RowEquations(self.dynamics, self.x, forces=self.force, t=t)
        goal = self.x[t, self.grasped]
        try:
            return solve_row(
                self.model.newton,
                equations,
                guess=self.x[t],
                previous=self.x[t - 1],
                prescribed_m=goal,
            )
        except NewtonFailure as failure:
            self._fail(failure)

    def _fail(self, failure: NewtonFailure) -> NoReturn:
        """Raise the `SimulationError` of the next row."""
        model = self.model
        what = f"time step {self.row}"
        time_s = self.row * model.experiment.timestep_s / model.collocation.substeps
        raise simulation_error(model.newton, failure, time_s=time_s, what=what) from failure

    # Readings ---------------------------------------------------------------------------------

    def linearise_samples(self, pairs: Sequence[tuple[Sample, int]]) -> list[LinearisedResidual]:
        """Return the linearised residuals of samples, in the order of `pairs`; the rows that they
        need must still be stored.

        Parameters
        ----------
        pairs : sequence of (Sample, int)
            Samples, and for each the number of rows that have been computed since the row after
            which it is evaluated.
        """
        residuals: list[LinearisedResidual | None] = [None] * len(pairs)
        for of in {sample.instrument for sample, _ in pairs}:
            positions = [k for k, (sample, _) in enumerate(pairs) if sample.instrument == of]
            samples = [pairs[k] for k in positions]
            pairs_of_instrument = (
                self._instrument_residuals(of, samples)
                if of
                else (self._marker_residuals(*pair) for pair in samples)
            )
            for k, (residual, slope) in zip(positions, pairs_of_instrument, strict=True):
                slope /= self.rates
                residuals[k] = LinearisedResidual(
                    residual - slope @ self.transformed, slope, instrument=of
                )
        return [each for each in residuals if each is not None]

    def _instrument_residuals(
        self, of: int, pairs: Sequence[tuple[Sample, int]]
    ) -> Iterator[tuple[Array, Array]]:
        """Yield residuals over σ and ∂p of each sample, or NaN."""
        model = self.model
        kind, stencil, observable = self.model.instruments[of - 1]
        at = [self.row - 1 - sample.rows_back - rows for sample, rows in pairs]
        needed_rows = range(
            stencil.rows_of_sample(min(at)).start, stencil.rows_of_sample(max(at)).stop
        )
        stored_rows, point_columns, resultants = zip(
            *(self.read[k + stencil.delay - self.row] for k in needed_rows), strict=True
        )
        x = np.array([each.x for each in stored_rows])
        step_s = model.experiment.timestep_s / model.collocation.substeps
        begins_s = float(model.experiment.t_s[0])
        known_s, t_s = (begins_s + step_s * np.array(rows) for rows in (needed_rows, at))
        sensor = kind.with_samples(
            known_s, x, t_s, measurements=np.array([sample.values for sample, _ in pairs])
        )
        points = sensor.observable
        if isinstance(observable, slice) and isinstance(points, PointPositions):
            place = slice(3 * observable.start, 3 * observable.stop)
            values = np.array(point_columns)[:, place]
            slopes = points.derivatives_from(
                x, points.shape_functions(self.phi), columns=self.moving, changes=values[..., 1:]
            )
            values = values.reshape(len(values), -1, 3, values.shape[2])
        else:
            columns = np.arange(model.parameter_count)
            values = np.array(resultants)[:, observable]
            values = values.reshape(len(values), -1, 3, 1 + len(columns))
            slopes = ObservableDerivatives.without_own(columns, values[..., 1:])
        residual, slope = sensor.linearise(
            values[..., 0], slopes, phi=self.phi, size=model.parameter_count
        )
        return zip(
            np.where(sensor.compared_with(len(needed_rows)), residual, np.nan), slope, strict=True
        )

    def _marker_residuals(self, sample: Sample, rows: int) -> tuple[Array, Array]:
        """Return residuals (M, 3) of a marker sample, in standard deviations, and their derivatives
        (M, 3, P) with respect to p.

        Residuals of missing markers are NaN.
        """
        model = self.model
        neighbours = self.model.neighbouring_samples
        markers = self.model.marker_model
        back = sample.rows_back + rows
        backs = [back - k * model.collocation.substeps for k in range(-neighbours, neighbours + 1)]
        x, point_columns = (
            np.array(part) for part in zip(*map(self._interpolated_row, backs), strict=True)
        )
        point_columns = point_columns[:, : 3 * len(self.shape_functions[0])]
        values = point_columns[..., 0].reshape(len(point_columns), -1, 3)
        slopes = markers.observable.derivatives_from(
            x, self.shape_functions, columns=self.moving, changes=point_columns[..., 1:]
        )
        since_s = (self.row - 1 - back) / model.collocation.substeps * model.experiment.timestep_s
        markers = markers.shifted(since_s)
        residual, slope = markers.linearise(
            values, slopes, phi=self.phi, size=model.parameter_count
        )
        return residual[0] - sample.values / markers.sigmas[:, None], slope[0]

    def _interpolated_row(self, back: float) -> tuple[Array, Array]:
        """Return positions (3n,) [m] and observed points (3M + …, 1 + m) at, or between, stored
        rows.

        Column 0 of the points has the values [m], the others the derivatives. Between rows, four
        are interpolated by a cubic polynomial; times before the first stored row are extrapolated.
        """
        nearest = round(back)
        last = len(self.read) - 1
        if abs(back - nearest) <= ROW_TOLERANCE or not last:
            stored, point_columns, _ = self.read[min(max(last - nearest, 0), last)]
            return stored.x, point_columns
        first = int(np.clip(np.floor(back) - 1, 0, max(0, last - 3)))
        rows = [first + k for k in range(min(4, last + 1))]
        weights = lagrange_weights(back, rows)
        stored, point_columns, _ = zip(*(self.read[last - row] for row in rows), strict=True)
        return np.tensordot(weights, [k.x for k in stored], 1), np.tensordot(
            weights, point_columns, 1
        )

    def add_residuals(self, residuals: Sequence[LinearisedResidual]) -> None:
        """Add linearised residuals to `information`, in place of which a new object is stored;
        missing numbers are skipped.
        """
        self.information = self.with_residuals(self.information, residuals)

    def with_residuals(
        self, known: SquareRootInformation, residuals: Sequence[LinearisedResidual]
    ) -> SquareRootInformation:
        """Return the information `known` with linearised residuals added; missing numbers are
        skipped.

        With Huber's loss, residuals are weighted by their values at the parameters of this pass.
        """
        hubers = [self.model.huber_of(each.instrument) for each in residuals]
        for huber in dict.fromkeys(hubers):
            alike = [each for each, own in zip(residuals, hubers, strict=True) if own == huber]
            at_zero = np.concatenate([each.at_zero for each in alike])
            is_present = np.isfinite(at_zero)
            rows_present = is_present.any(axis=1)
            slopes = np.concatenate([each.slope for each in alike])[rows_present]
            is_present = is_present[rows_present]
            residual = np.where(is_present, at_zero[rows_present] + slopes @ self.transformed, 0.0)
            rows, slopes = huber_as_least_squares(residual, slopes, huber=huber)
            known = known.with_rows(
                rows[is_present], slopes[is_present], parameters=self.transformed
            )
        return known
