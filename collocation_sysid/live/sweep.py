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

from ..arrays import Array
from ..fem.body import Linearisation
from ..model.dynamics import StencilRow
from ..program.channel import Motion, Slopes
from ..program.least_squares import LeastSquares
from ..program.marching import RowEquations, extrapolated, solve_row
from ..program.newton import NewtonFailure, simulation_error
from ..program.reading import as_squares, lagrange_weights
from ..program.rest import start_state
from ..program.sweep import Columns, Forward, GraspMotion, LastRows, Step
from .felt import LATE, Felt, Poses
from .model import NEAR, TOGETHER, Model

# Largest correction of a row, divided by the size of the body, after which the row is not
# linearised again: the next correction would be about its square.
LAST_STEP = 3e-4
# Factor of this limit for rows that are solved together; beyond the limit another pass follows.
ROUGH = 10
# Largest delay of samples that are still used, in samples.
LATEST = 5


class Sample(NamedTuple):
    """Measured values of a time between or at rows.

    Attributes
    ----------
    back : float
        Time of the sample, in rows before the row after which it is evaluated.
    values : (M, 3) or (m,)
        Marker positions, or values of an instrument; NaN where missing.
    of : int
        0 for markers, or the number of the instrument, from 1 on.
    """

    back: float
    values: Array
    of: int = 0


class LoggedRow(NamedTuple):
    """Input of one row of the grid.

    Attributes
    ----------
    poses : Poses
        Poses of the grasps that move.
    readings : list of Sample
        Samples that are evaluated after this row.
    """

    poses: Poses
    readings: list[Sample]


class Kept(NamedTuple):
    """Initial guess of a row for a later pass.

    Attributes
    ----------
    flat : (P,)
        Transformed parameters of the pass, see `Model.flat`.
    x : (3n,)
        Positions [m].
    columns : (3n, m) float32
        Derivatives Z of the positions by these transformed parameters.
    """

    flat: Array
    x: Array
    columns: NDArray[np.float32]


class Said(NamedTuple):
    """Residuals of a sample, linear in the transformed parameters, see `Model.flat`.

    Attributes
    ----------
    at_zero : (G, 3) or (m,)
        Residuals extrapolated to transformed parameters of zero; NaN where missing.
    slope : (…, P)
        Derivatives by the transformed parameters.
    of : int
        Instrument, see `Sample`.
    """

    at_zero: Array
    slope: Array
    of: int = 0

    def at(self, flat: Array) -> Array:
        """Return the residuals at transformed parameters, to first order."""
        return self.at_zero + self.slope @ flat


# A row as `Kept`; positions and columns of markers and of the points of custom sensors,
# (3M + …, 1 + m); and wrenches with their derivatives by all parameters, (sensors, 6, 1 + P).
Read = tuple[Kept, Array, Array]


@dataclass(frozen=True, eq=False)
class State:
    """State on which the next row depends.

    Attributes
    ----------
    row : int
        Number of rows done.
    end : int
        Index of the next row in the template.
    x, force : (rows, 3n)
        Positions and forces of the rows of the template.
    given : (rows, g, 1 + m)
        Columns of the prescribed positions of the grasped dofs.
    felt : Felt
        Reaction forces of grasps with a sensor.
    memory : LastRows or None
        Columns of the last rows; None at the start.
    read : tuple of Read
        Observed quantities of the last rows, the latest one last.
    """

    row: int
    end: int
    x: Array
    force: Array
    given: Array
    felt: Felt
    memory: LastRows | None
    read: tuple[Read, ...]


class LiveSweep:
    """Forward pass at parameters p, row after row.

    Parameters
    ----------
    model : Model
    p : (P,)
        Linearisation point.
    known : LeastSquares
        Information from before its first row.
    start : State, optional
        State at which the pass begins; the start of the recording by default.
    at : (P,), optional
        Linearisation point of that state, which is moved to p along its columns. Columns by
        transformed parameters stay the same.

    Attributes
    ----------
    information : LeastSquares
        Information at p in the transformed parameters, from `known` and all samples so far.
    longest_m : float
        Longest correction so far [m].

    Raises
    ------
    SimulationError
        If the start cannot be computed.
    """

    def __init__(
        self,
        model: Model,
        p: Array,
        known: LeastSquares,
        start: State | None = None,
        at: Array | None = None,
    ) -> None:
        self.model = model
        self.p = p
        self.solver = model.solver
        self.flat = model.flat(p)
        self.rates = model.rates(self.flat)
        collocation = model.collocation
        segment = model.segment
        self.segment = segment
        self.phi = p[collocation.nq :]
        self.setting = segment.setting(p[: collocation.nq], self.phi)
        self.dynamics = self.setting.dynamics
        self.carried = model.carried(self.phi)
        self.shape_functions = segment.markers.channel.shape(self.phi)
        points_and_weights = [
            self.shape_functions,
            *(points.shape(self.phi) for points in model.looked),
        ]
        self._looked = tuple(
            np.concatenate(part)
            for part in zip(*((nodes, at.weights) for nodes, at in points_and_weights), strict=True)
        )
        self.longest_m = 0.0
        self.grasped = segment.grasping.dofs
        self.moving = segment.moving
        self.sensed = segment.sensed_dofs
        self.count = 1 + len(self.moving)
        self.mass_kg = self.dynamics.mass.kg[0]
        # Loads are always there: what acts on one row acts on every one.
        self.forces = self.dynamics.forces.rows(slice(1))
        self._rows = {} if self.setting.mass_moves else model.known_rows
        self.information = known
        state = self._begin() if start is None or at is None else self._moved(start, at)
        self._resume(state)

    # State ------------------------------------------------------------------------------------

    def _begin(self) -> State:
        """Return the state before the first row."""
        rows = self.model.rows
        dofs = self.segment.dofs
        empty = np.zeros((rows, dofs))
        given = np.zeros((rows, len(self.grasped), self.count))
        felt = Felt.nothing(rows, len(self.sensed), self.count, len(self.model.first_poses))
        return State(0, 0, empty, empty, given, felt, None, ())

    def _moved(self, state: State, at: Array) -> State:
        """Return a state moved from the linearisation point `at` to p, to first order."""
        if state.memory is None or (at == self.p).all():
            return state
        moving = self.moving
        flat = self.model.flat(at)
        old_rates = self.model.rates(flat)
        change = (self.flat - flat)[moving]
        step = change / old_rates[moving]
        factors = np.ones(self.count)
        factors[1:] = (self.rates / old_rates)[moving]
        force = state.force.copy()
        memory = state.memory
        last = state.end - 1
        for k, columns in enumerate(memory.increments[: last + 1]):
            force[last - k, self.solver.free] += columns[:, 1:] @ step
        solutions, increments = (
            tuple(columns * factors for columns in each)
            for each in (memory.solutions, memory.increments)
        )
        memory = replace(memory, solutions=solutions, increments=increments)
        stored = [each for each, *_ in state.read]
        columns_of_rows = np.empty((len(stored), self.segment.dofs, self.count))
        columns_of_rows[..., 1:] = [each.columns for each in stored]
        columns_of_rows[..., 0] = columns_of_rows[..., 1:] @ change + [each.x for each in stored]
        x = state.x.copy()
        known_rows = min(len(stored), state.end)
        x[state.end - known_rows : state.end] = columns_of_rows[len(stored) - known_rows :, :, 0]
        point_columns = self._seen(columns_of_rows)
        point_columns[..., 1:] *= self.rates[moving]
        stored_rows = [
            Kept(self.flat, w[:, 0], k.columns)
            for w, k in zip(columns_of_rows, stored, strict=True)
        ]
        all_wrenches = np.array([wrenches for *_, wrenches in state.read])
        all_wrenches[..., 0] += all_wrenches[..., 1:] @ ((self.flat - flat) / old_rates)
        all_wrenches[..., 1:] *= self.rates / old_rates
        read = tuple(zip(stored_rows, point_columns, all_wrenches, strict=True))
        felt = state.felt.at(step, factors)
        return replace(state, x=x, force=force, felt=felt, memory=memory, read=read)

    def _resume(self, state: State) -> None:
        """Continue from a state, whose arrays are copied."""
        self.row = state.row
        self.end = state.end
        self.x = state.x.copy()
        self.force = state.force.copy()
        self.given = state.given.copy()
        grasped = None
        if self.segment.nuisance.moves_grasps:
            grasped = GraspMotion.along(self.solver, self.grasped, self.given)
        self.columns = Columns(self.setting, self.count, step=True, grasped=grasped)
        self.felt = state.felt.copy()
        self.forward = Forward(self.solver, self.columns, state.memory, self.felt.held)
        most = (2 * self.model.samples_around + LATEST + 2) * self.model.substeps + 4 + TOGETHER
        most += self.model.late
        self.read: deque[Read] = deque(state.read, maxlen=most)

    @property
    def is_rough(self) -> bool:
        """Whether a correction was so long that its square is not negligible."""
        return self.longest_m > LAST_STEP * self.model.size_m

    @property
    def state(self) -> State:
        """Copy of the state on which the next row depends."""
        return State(
            row=self.row,
            end=self.end,
            x=self.x.copy(),
            force=self.force.copy(),
            given=self.given.copy(),
            felt=self.felt.copy(),
            memory=self.forward.last,
            read=tuple(self.read),
        )

    # Rows -------------------------------------------------------------------------------------

    def advance(self, poses: Sequence[Poses], guesses: Sequence[Array] = ()) -> list[Kept]:
        """Compute further rows with given poses; return them for later passes.

        Fewer rows than given are computed if one is far from its initial guess: later guesses are
        then wrong, too.

        Parameters
        ----------
        poses : sequence of Poses
            Poses of the moving grasps, for at most `TOGETHER` rows.
        guesses : sequence of (3n,), optional
            Initial guesses of the positions; extrapolated by default.

        Returns
        -------
        list of Kept
            The computed rows, at least one.

        Raises
        ------
        SimulationError
            If a row cannot be solved.
        """
        poses = [self.model.poses_of(each) for each in poses]
        first = self._make_room(len(poses))
        count = len(poses)
        goals, slopes = self.model.goals(self.carried, poses)
        self.felt.place(first, poses)
        self.given[first : first + count, :, 1 + self.segment.nq :] = slopes
        if first < self.dynamics.first_row:
            self.x[first] = self._start(poses[0])
            self._done(1)
            return self._kept([np.zeros(self.forward.shape)])
        for k, t in enumerate(range(first, first + count)):
            self.x[t] = guesses[k] if guesses else self._guess(t, poses[k])
            self.x[t, self.grasped] = goals[k]
        remaining = range(first, first + count)
        computed = []
        last_length = np.inf
        is_careful = False
        while remaining:
            limit = LAST_STEP * self.model.size_m * (1 if len(remaining) == 1 else ROUGH)
            rows, length = self._advanced(remaining, limit)
            accepted = len(remaining) if length is None else len(rows) - 1
            computed += rows[:accepted]
            self._done(accepted)
            if length is None:
                break
            t = remaining[accepted]
            if length < last_length / 2:
                self.x[t] += rows[accepted][:, 0]
                last_length = length
            elif not is_careful:
                self.x[t] = self._carefully(t, poses[t - first])
                is_careful = True
                last_length = np.inf
            else:
                self._fail(NewtonFailure(self.x[t], "Newton's steps do not get shorter"))
            remaining = range(t, t + 1)
        return self._kept(computed)

    def _done(self, count: int) -> None:
        """Record that rows are done."""
        self.row = self.row + count
        self.end = self.end + count

    def _make_room(self, count: int) -> int:
        """Shift the template if necessary for more rows; return the index of the next row in it."""
        surplus = self.end + count - self.model.rows
        if surplus > 0:
            for each in (self.x, self.force, self.given, *self.felt.arrays):
                each[:-surplus] = each[surplus:]
            self.end -= surplus
        return self.end

    def _guess(self, t: int, poses: Poses) -> Array:
        """Return x_t on a cubic polynomial through the last four rows, or through fewer at the
        start.
        """
        if t == 0:
            return self._start(poses)
        if t < 4:
            return extrapolated(self.x[:t], np.zeros(self.segment.dofs))
        return 4 * (self.x[t - 1] + self.x[t - 3]) - 6 * self.x[t - 2] - self.x[t - 4]

    def _start(self, poses: Poses) -> Array:
        """Return the positions of the start (3n,) with grasps at given poses."""
        goals_m = np.full(self.segment.dofs, np.nan)
        goals_m[self.grasped] = self.model.goals(self.carried, [poses])[0][0]
        experiment = self.model.at_start(poses)
        return start_state(experiment, self.forces, self.model.newton, goals_m=goals_m)[0]

    def _linearised(self, here: range) -> tuple[Linearisation, tuple[Array, Array]]:
        """Return forces with derivatives at guessed rows, and the right-hand sides of their
        columns.

        Corrections of the previous rows count as done and are set to zero.
        """
        for past in (*self.forward.past, *self.forward.past_increments):
            past[:, 0] = 0.0
        rows = slice(here.start, here.stop)
        known = slice(here.stop)
        p, q, w, s = (table[rows, known] for table in self.model.stencils)
        x = self.x[known]
        force = self.force[known]
        free = self.solver.free
        nu = q @ x
        acceleration = s @ x
        at = self.forces.linearise(p @ x, nu, self.model.out[: len(here)])
        force[rows] = at.force
        residual = (w @ force - self.mass_kg * acceleration)[:, free]
        return at, self.columns.sides(rows, at, acceleration, residual, free)

    def _row(self, t: int) -> StencilRow:
        """Return the coefficients of a row, cached while the masses do not depend on parameters."""
        if t not in self._rows:
            self._rows[t] = StencilRow.of(self.dynamics, t)
        return self._rows[t]

    def _advanced(self, here: range, limit: float) -> tuple[list[Array], float | None]:
        """Solve rows once; return their columns (3n, 1 + m), and None if all are accepted.

        Otherwise the last columns are those of the first row that is not accepted, because its
        correction is longer than the limit or its matrix is singular, and the second value is the
        length of that correction or NaN.

        Parameters
        ----------
        here : range
            Indices of the rows in the template.
        limit : float
            Largest accepted correction [m].
        """
        solver = self.solver
        forward = self.forward
        at, sides = self._linearised(here)
        solved: list[Array] = []
        for k, (t, right, force) in enumerate(zip(here, *sides, strict=True)):
            row = self._row(t)
            before = forward.last
            row_columns = np.zeros(forward.shape)
            by_position = at.by_position[k]
            by_velocity = at.by_velocity[k]
            by_position_skew = at.by_position_skew[k]
            by_velocity_skew = at.by_velocity_skew[k]
            block = row.block(by_position, by_velocity, solver.pattern)
            skew_block = row.skew_block(by_position_skew, by_velocity_skew)
            solved.append(row_columns)
            try:
                factor = solver.factoriser.factorise(block, skew_block, self.model.room)
                step = Step(
                    t,
                    row,
                    at.force[k],
                    by_position,
                    by_velocity,
                    factor,
                    by_position_skew,
                    by_velocity_skew,
                )
                forward.advance(step, right, force, row_columns)
            except np.linalg.LinAlgError:
                return solved, np.nan
            length = float(np.abs(row_columns[:, 0]).max(initial=0.0))
            if not length <= limit:
                self.forward = Forward(solver, self.columns, before, self.felt.held)
                return solved, length
            self.longest_m = max(self.longest_m, length)
            self.x[t] += row_columns[:, 0]
            if forward.weighs_past:
                # Correct the forces by their increment in this row.
                self.force[t, solver.free] += forward.past_increments[0][:, 0]
        return solved, None

    def _kept(self, columns: Sequence[Array]) -> list[Kept]:
        """Return the last rows for later passes, from their columns (3n, 1 + m).

        Observed quantities of these rows are stored, too.
        """
        rows = slice(self.end - len(columns), self.end)
        all_columns = np.array(columns)
        all_columns[:, :, 0] = self.x[rows]
        by_flat = (all_columns[:, :, 1:] / self.rates[self.moving]).astype(np.float32)
        pairs = zip(self.x[rows].copy(), by_flat, strict=True)
        stored_rows = [Kept(self.flat, *pair) for pair in pairs]
        self.felt.corrected(rows, all_columns[:, self.sensed])
        self.read.extend(zip(stored_rows, self._seen(all_columns), self._told(rows), strict=True))
        return stored_rows

    def _told(self, here: slice) -> Array:
        """Return wrenches and their derivatives available at rows, (rows, sensors, 6, 1 + P).

        They are zero in the first rows, where they are not known.
        """
        sensors = self.model.sensors
        size = self.model.size
        wrenches = np.zeros((here.stop - here.start, len(sensors), 6, 1 + size))
        if not sensors:
            return wrenches
        first = max(here.start, int(sensors[0][0].grid[0]) + LATE)
        if first >= here.stop:
            return wrenches
        *_, w, s = self.model.stencils
        x = self.x[: here.stop, self.sensed]
        rows = np.arange(first, here.stop)
        reactions, channels = self.felt.wrenches(sensors, self.setting, x, (w, s), rows)
        motion = Motion(x, lambda: reactions)
        for k, channel in enumerate(channels):
            value, slopes = channel.linearised(motion, self.phi, self.moving, size)
            sensor_wrenches = wrenches[first - here.start :, k]
            sensor_wrenches[..., 0] = value.reshape(-1, 6)
            sensor_wrenches[..., 1:] = slopes.by.reshape(-1, 6, size)
        return wrenches

    def _seen(self, whole: Array) -> Array:
        """Return the values at observed points (…, 3M + …, k) of columns (…, 3n, k) of the body."""
        nodes, weights = self._looked
        *rows, dofs, count = whole.shape
        at = whole.reshape(*rows, dofs // 3, 3, count)[..., nodes, :, :]
        return np.einsum("ma,...maik->...mik", weights, at).reshape(*rows, -1, count)

    def _carefully(self, t: int, poses: Poses) -> Array:
        """Return x_t, with the displacement of the grasp applied in parts if necessary."""
        if t == 0:
            return self._start(poses)
        equations = RowEquations(self.dynamics, self.x, self.force, t)
        goal = self.x[t, self.grasped]
        try:
            return solve_row(self.model.newton, equations, self.x[t], self.x[t - 1], goal)
        except NewtonFailure as failure:
            self._fail(failure)

    def _fail(self, failure: NewtonFailure) -> NoReturn:
        """Raise the `SimulationError` of a row that cannot be solved."""
        model = self.model
        what = f"the step at row {self.row}"
        time_s = self.row * model.interval_s / model.substeps
        raise simulation_error(model.newton, failure, time_s, what) from failure

    # Readings ---------------------------------------------------------------------------------

    def linearised(self, pairs: Sequence[tuple[Sample, int]]) -> list[Said]:
        """Return the linearised residuals of samples.

        Parameters
        ----------
        pairs : sequence of (Sample, int)
            Samples, and the number of rows computed since the row after which each is evaluated.
        """
        residuals: list[Said | None] = [None] * len(pairs)
        for of in {sample.of for sample, _ in pairs}:
            positions = [k for k, (sample, _) in enumerate(pairs) if sample.of == of]
            samples = [pairs[k] for k in positions]
            pairs_of_instrument = (
                self._of_instrument(of, samples)
                if of
                else (self._of_markers(*pair) for pair in samples)
            )
            for k, (residual, slope) in zip(positions, pairs_of_instrument, strict=True):
                slope /= self.rates
                residuals[k] = Said(residual - slope @ self.flat, slope, of)
        return [each for each in residuals if each is not None]

    def _of_instrument(
        self, of: int, pairs: Sequence[tuple[Sample, int]]
    ) -> Iterator[tuple[Array, Array]]:
        """Yield residuals and derivatives by p of samples of an instrument.

        They are evaluated from the rows around each sample.
        """
        model = self.model
        reading, stencil, observable = self.model.instruments[of - 1]
        at = [self.row - 1 - sample.back - rows for sample, rows in pairs]
        needed_rows = range(stencil.rows(min(at)).start, stencil.rows(max(at)).stop)
        _, point_columns, wrenches = zip(
            *(self.read[k + stencil.late - self.row] for k in needed_rows), strict=True
        )
        step_s = model.interval_s / model.substeps
        begins_s = float(model.experiment.t_s[0])
        known_s, t_s = (begins_s + step_s * np.array(rows) for rows in (needed_rows, at))
        sensor = reading.of_some(known_s, t_s, np.array([sample.values for sample, _ in pairs]))
        if isinstance(observable, slice):
            columns = self.moving
            place = slice(3 * observable.start, 3 * observable.stop)
            values = np.array(point_columns)[:, place]
        else:
            columns = np.arange(model.size)
            values = np.array(wrenches)[:, observable]
        values = values.reshape(len(needed_rows), -1, 3, 1 + len(columns))
        slopes = Slopes.along(columns, values[..., 1:])
        residual, slope = sensor.linearised(values[..., 0], slopes, self.phi, model.size)
        return zip(np.where(sensor.there(len(needed_rows)), residual, np.nan), slope, strict=True)

    def _of_markers(self, reading: Sample, rows: int) -> tuple[Array, Array]:
        """Return residuals (M, 3) of a marker sample and their derivatives (M, 3, P) by p.

        Residuals of missing markers are NaN.

        Parameters
        ----------
        reading : Sample
        rows : int
            Number of rows computed since the row after which the sample is evaluated.
        """
        model = self.model
        neighbours = self.model.samples_around
        markers = self.model.markers
        back = reading.back + rows
        backs = [back - k * model.substeps for k in range(-neighbours, neighbours + 1)]
        x, point_columns = (np.array(part) for part in zip(*map(self._at, backs), strict=True))
        point_columns = point_columns[:, : 3 * len(self.shape_functions[0])]
        values = point_columns[..., 0].reshape(len(point_columns), -1, 3)
        slopes = markers.channel.slopes_of(
            x, self.shape_functions, self.moving, point_columns[..., 1:]
        )
        since_s = (self.row - 1 - back) / model.substeps * model.interval_s
        markers = markers.later(since_s)
        residual, slope = markers.linearised(values, slopes, self.phi, model.size)
        return residual[0] - reading.values / markers.sigmas[:, None], slope[0]

    def _at(self, back: float) -> tuple[Array, Array]:
        """Return positions and observed points at a time, in rows before the last one.

        Times before the start give the start.
        """
        nearest = round(back)
        last = len(self.read) - 1
        if abs(back - nearest) <= NEAR or not last:
            stored, point_columns, _ = self.read[min(max(last - nearest, 0), last)]
            return stored.x, point_columns
        first = int(np.clip(np.floor(back) - 1, 0, max(0, last - 3)))
        rows = [first + k for k in range(min(4, last + 1))]
        weights = lagrange_weights(back, rows)
        stored, point_columns, _ = zip(*(self.read[last - row] for row in rows), strict=True)
        return np.tensordot(weights, [k.x for k in stored], 1), np.tensordot(
            weights, point_columns, 1
        )

    def take(self, said: Sequence[Said]) -> None:
        """Add linearised residuals to the information; missing ones are skipped."""
        self.information = self.added(self.information, said)

    def added(self, known: LeastSquares, said: Sequence[Said]) -> LeastSquares:
        """Return information with linearised residuals added, with the weights of the loss at p."""
        if not said:
            return known
        at_zero = np.concatenate([each.at_zero for each in said])
        is_present = np.isfinite(at_zero)
        rows_present = is_present.any(axis=1)
        slopes = np.concatenate([each.slope for each in said])[rows_present]
        is_present = is_present[rows_present]
        residual = np.where(is_present, at_zero[rows_present] + slopes @ self.flat, 0.0)
        rows, slopes = as_squares(residual, slopes, self.model.collocation.huber)
        return known.add(rows[is_present], slopes[is_present], self.flat)
