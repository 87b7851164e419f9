"""One pass over a recording at one point p: motion, sensitivities and what the markers say.

A few rows of the grid at a time take what the last ones left (positions, forces, the columns Z by
the parameters that move the body) and leave the same for the next. They are linearised together at
their guesses; each row is then solved once, for its correction and its columns: a Gauss–Newton step
on the collocation equations, whose defect is of second order in the correction, as in the
reduced-space method. A row whose correction is long is linearised again, alone, where that led.
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

# A row's correction over the body's size: the next one would be its square. Where rows are solved
# together it may be so many times as long, and another pass follows.
LAST_STEP, ROUGH = 3e-4, 10
# Readings may come this many samples late.
LATEST = 5


class Sample(NamedTuple):
    """Numbers, NaN where missing, so many rows before the row they are read after.

    Markers are (M, 3); an instrument has a number from 1 on, and is (m,).
    """

    back: float
    values: Array
    of: int = 0


class LoggedRow(NamedTuple):
    """What came with one row of the grid."""

    poses: Poses
    readings: list[Sample]


class Kept(NamedTuple):
    """What a later pass starts a row from: x (3n,) at `flat` (P,), and its slopes by that, Z."""

    flat: Array
    x: Array
    columns: NDArray[np.float32]


class Said(NamedTuple):
    """Residuals (G, 3) of a reading, NaN where missing, as if flat were 0; slopes by flat.

    `of` is what it is, see `Sample`.
    """

    at_zero: Array
    slope: Array
    of: int = 0

    def at(self, flat: Array) -> Array:
        """(M, 3) the residuals, to first order."""
        return self.at_zero + self.slope @ flat


# A row, x and the columns of the markers and then of what readings look at, (3M + …, 1 + m), and
# what grasps gave before, with its slopes by all parameters, (sensors, 6, 1 + P).
Read = tuple[Kept, Array, Array]


@dataclass(frozen=True, eq=False)
class State:
    """What the next row depends on.

    Attributes
    ----------
    row, end : int
        Rows done, and the place of the next one in the template.
    x, force : (rows, 3n) of the template
    given : (rows, g, 1 + m) of grasped dofs
    felt : Felt
    memory : LastRows, None at first
    read : tuple of rows with their markers, latest last
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
    """A pass at p.

    Parameters
    ----------
    model : Model
    p : (P,)
    known : LeastSquares
        What was known before its first row.
    start : State, optional
        Where it begins; where the recording does by default.
    at : (P,), optional
        The p of that state, which is moved along its columns: by what is flat it keeps them.

    Raises
    ------
    SimulationError
        Where there is no start.
    """

    def __init__(
        self,
        model: Model,
        p: Array,
        known: LeastSquares,
        start: State | None = None,
        at: Array | None = None,
    ) -> None:
        self.model, self.p, self.solver = model, p, model.solver
        self.flat = model.flat(p)
        self.rates = model.rates(self.flat)
        collocation, segment = model.collocation, model.segment
        self.segment, self.phi = segment, p[collocation.nq :]
        self.setting = segment.setting(p[: collocation.nq], self.phi)
        self.dynamics = self.setting.dynamics
        self.carried = model.carried(self.phi)
        self.shape_functions = segment.markers.channel.shape(self.phi)
        looks = [self.shape_functions, *(points.shape(self.phi) for points in model.looked)]
        self._looked = tuple(
            np.concatenate(part)
            for part in zip(*((nodes, at.weights) for nodes, at in looks), strict=True)
        )
        self.longest_m = 0.0
        self.grasped, self.moving = segment.grasping.dofs, segment.moving
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
        rows, dofs = self.model.rows, self.segment.dofs
        empty, given = np.zeros((rows, dofs)), np.zeros((rows, len(self.grasped), self.count))
        felt = Felt.nothing(rows, len(self.sensed), self.count, len(self.model.first_poses))
        return State(0, 0, empty, empty, given, felt, None, ())

    def _moved(self, state: State, at: Array) -> State:
        if state.memory is None or (at == self.p).all():
            return state
        moving, flat = self.moving, self.model.flat(at)
        was, way = self.model.rates(flat), (self.flat - flat)[moving]
        step, grown = way / was[moving], np.ones(self.count)
        grown[1:] = (self.rates / was)[moving]
        force, memory, last = state.force.copy(), state.memory, state.end - 1
        for k, columns in enumerate(memory.increments[: last + 1]):
            force[last - k, self.solver.free] += columns[:, 1:] @ step
        solutions, increments = (
            tuple(columns * grown for columns in each)
            for each in (memory.solutions, memory.increments)
        )
        memory = replace(memory, solutions=solutions, increments=increments)
        kept = [each for each, *_ in state.read]
        whole = np.empty((len(kept), self.segment.dofs, self.count))
        whole[..., 1:] = [each.columns for each in kept]
        whole[..., 0] = whole[..., 1:] @ way + [each.x for each in kept]
        x, known = state.x.copy(), min(len(kept), state.end)
        x[state.end - known : state.end] = whole[len(kept) - known :, :, 0]
        seen = self._seen(whole)
        seen[..., 1:] *= self.rates[moving]
        moved = [Kept(self.flat, w[:, 0], k.columns) for w, k in zip(whole, kept, strict=True)]
        told = np.array([wrenches for *_, wrenches in state.read])
        told[..., 0] += told[..., 1:] @ ((self.flat - flat) / was)
        told[..., 1:] *= self.rates / was
        read = tuple(zip(moved, seen, told, strict=True))
        felt = state.felt.at(step, grown)
        return replace(state, x=x, force=force, felt=felt, memory=memory, read=read)

    def _resume(self, state: State) -> None:
        self.row, self.end = state.row, state.end
        self.x, self.force, self.given = state.x.copy(), state.force.copy(), state.given.copy()
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
        """Whether rows are off by more than the square of a short correction."""
        return self.longest_m > LAST_STEP * self.model.size_m

    @property
    def state(self) -> State:
        """What the next row depends on."""
        arrays = self.x.copy(), self.force.copy(), self.given.copy()
        felt = self.felt.copy()
        return State(self.row, self.end, *arrays, felt, self.forward.last, tuple(self.read))

    # Rows -------------------------------------------------------------------------------------

    def advance(self, poses: Sequence[Poses], guesses: Sequence[Array] = ()) -> list[Kept]:
        """Go on by rows, at most `TOGETHER`, with the grasps there.

        It ends at a row that is far from where it was guessed: what comes after is as well.

        Raises
        ------
        SimulationError
            Where a row cannot be solved.
        """
        poses = [self.model.poses_of(each) for each in poses]
        first, count = self._make_room(len(poses)), len(poses)
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
        here, found, last, careful = range(first, first + count), [], np.inf, False
        while here:
            limit = LAST_STEP * self.model.size_m * (1 if len(here) == 1 else ROUGH)
            rows, length = self._advanced(here, limit)
            good = len(here) if length is None else len(rows) - 1
            found += rows[:good]
            self._done(good)
            if length is None:
                break
            t = here[good]
            if length < last / 2:
                self.x[t] += rows[good][:, 0]
                last = length
            elif not careful:
                self.x[t], careful, last = self._carefully(t, poses[t - first]), True, np.inf
            else:
                self._fail(NewtonFailure(self.x[t], "Newton's steps do not get shorter"))
            here = range(t, t + 1)
        return self._kept(found)

    def _done(self, count: int) -> None:
        """Be done with so many rows."""
        self.row, self.end = self.row + count, self.end + count

    def _make_room(self, count: int) -> int:
        surplus = self.end + count - self.model.rows
        if surplus > 0:
            for each in (self.x, self.force, self.given, *self.felt.arrays):
                each[:-surplus] = each[surplus:]
            self.end -= surplus
        return self.end

    def _guess(self, t: int, poses: Poses) -> Array:
        """x_t on a cubic through the last four rows, as far as there are that many."""
        if t == 0:
            return self._start(poses)
        if t < 4:
            return extrapolated(self.x[:t], np.zeros(self.segment.dofs))
        return 4 * (self.x[t - 1] + self.x[t - 3]) - 6 * self.x[t - 2] - self.x[t - 4]

    def _start(self, poses: Poses) -> Array:
        goals_m = np.full(self.segment.dofs, np.nan)
        goals_m[self.grasped] = self.model.goals(self.carried, [poses])[0][0]
        experiment = self.model.at_start(poses)
        return start_state(experiment, self.forces, self.model.newton, goals_m=goals_m)[0]

    def _linearised(self, here: range) -> tuple[Linearisation, tuple[Array, Array]]:
        """Rows where they are guessed to be, on from the rows before as they are."""
        for past in (*self.forward.past, *self.forward.past_increments):
            past[:, 0] = 0.0
        rows, known = slice(here.start, here.stop), slice(here.stop)
        p, q, w, s = (table[rows, known] for table in self.model.stencils)
        x, force, free = self.x[known], self.force[known], self.solver.free
        nu, acceleration = q @ x, s @ x
        at = self.forces.linearise(p @ x, nu, self.model.out[: len(here)])
        force[rows] = at.force
        residual = (w @ force - self.mass_kg * acceleration)[:, free]
        return at, self.columns.sides(rows, at, acceleration, residual, free)

    def _row(self, t: int) -> StencilRow:
        if t not in self._rows:
            self._rows[t] = StencilRow.of(self.dynamics, t)
        return self._rows[t]

    def _advanced(self, here: range, limit: float) -> tuple[list[Array], float | None]:
        """Columns (3n, 1 + m) of rows that are corrected.

        They end with the first that is further than the limit, or singular, which is not: then
        that one's length, or NaN.
        """
        solver, forward, (at, sides) = self.solver, self.forward, self._linearised(here)
        found: list[Array] = []
        for k, (t, right, force) in enumerate(zip(here, *sides, strict=True)):
            row, before, whole = self._row(t), forward.last, np.zeros(forward.shape)
            parts = at.by_position[k], at.by_velocity[k]
            skew = at.by_position_skew[k], at.by_velocity_skew[k]
            matrix = row.block(*parts, solver.pattern), row.skew_block(*skew)
            found.append(whole)
            try:
                factor = solver.factoriser.factorise(*matrix, self.model.room)
                step = Step(t, row, at.force[k], *parts, factor, *skew)
                forward.advance(step, right, force, whole)
            except np.linalg.LinAlgError:
                return found, np.nan
            length = float(np.abs(whole[:, 0]).max(initial=0.0))
            if not length <= limit:
                self.forward = Forward(solver, self.columns, before, self.felt.held)
                return found, length
            self.longest_m = max(self.longest_m, length)
            self.x[t] += whole[:, 0]
            if forward.weighs_past:
                # What the row says F_t is then.
                self.force[t, solver.free] += forward.past_increments[0][:, 0]
        return found, None

    def _kept(self, columns: Sequence[Array]) -> list[Kept]:
        """The last rows, whose columns (3n, 1 + m) these are."""
        here, whole = slice(self.end - len(columns), self.end), np.array(columns)
        whole[:, :, 0] = self.x[here]
        by_flat = (whole[:, :, 1:] / self.rates[self.moving]).astype(np.float32)
        pairs = zip(self.x[here].copy(), by_flat, strict=True)
        found = [Kept(self.flat, *pair) for pair in pairs]
        self.felt.corrected(here, whole[:, self.sensed])
        self.read.extend(zip(found, self._seen(whole), self._told(here), strict=True))
        return found

    def _told(self, here: slice) -> Array:
        """What grasps gave as rows tell it, (rows, sensors, 6, 1 + P); zero where they do not."""
        sensors, size = self.model.sensors, self.model.size
        found = np.zeros((here.stop - here.start, len(sensors), 6, 1 + size))
        if not sensors:
            return found
        first = max(here.start, int(sensors[0][0].grid[0]) + LATE)
        if first >= here.stop:
            return found
        *_, w, s = self.model.stencils
        x, rows = self.x[: here.stop, self.sensed], np.arange(first, here.stop)
        forced, channels = self.felt.wrenches(sensors, self.setting, x, (w, s), rows)
        motion = Motion(x, lambda: forced)
        for k, channel in enumerate(channels):
            value, slopes = channel.linearised(motion, self.phi, self.moving, size)
            told = found[first - here.start :, k]
            told[..., 0] = value.reshape(-1, 6)
            told[..., 1:] = slopes.by.reshape(-1, 6, size)
        return found

    def _seen(self, whole: Array) -> Array:
        """What is looked at has of columns (…, 3n, k) of the body, (…, 3M + …, k)."""
        (nodes, weights), (*rows, dofs, count) = self._looked, whole.shape
        at = whole.reshape(*rows, dofs // 3, 3, count)[..., nodes, :, :]
        return np.einsum("ma,...maik->...mik", weights, at).reshape(*rows, -1, count)

    def _carefully(self, t: int, poses: Poses) -> Array:
        """x_t, with the grasp's way taken in parts where that is needed."""
        if t == 0:
            return self._start(poses)
        equations = RowEquations(self.dynamics, self.x, self.force, t)
        goal = self.x[t, self.grasped]
        try:
            return solve_row(self.model.newton, equations, self.x[t], self.x[t - 1], goal)
        except NewtonFailure as failure:
            self._fail(failure)

    def _fail(self, failure: NewtonFailure) -> NoReturn:
        model, what = self.model, f"the step at row {self.row}"
        time_s = self.row * model.interval_s / model.substeps
        raise simulation_error(model.newton, failure, time_s, what) from failure

    # Readings ---------------------------------------------------------------------------------

    def linearised(self, pairs: Sequence[tuple[Sample, int]]) -> list[Said]:
        """What each sample says that was read so many rows before the last one."""
        found: list[Said | None] = [None] * len(pairs)
        for of in {sample.of for sample, _ in pairs}:
            here = [k for k, (sample, _) in enumerate(pairs) if sample.of == of]
            own = [pairs[k] for k in here]
            each = self._of_instrument(of, own) if of else (self._of_markers(*pair) for pair in own)
            for k, (residual, slope) in zip(here, each, strict=True):
                slope /= self.rates
                found[k] = Said(residual - slope @ self.flat, slope, of)
        return [said for said in found if said is not None]

    def _of_instrument(
        self, of: int, pairs: Sequence[tuple[Sample, int]]
    ) -> Iterator[tuple[Array, Array]]:
        """The same as `_of_markers` of an instrument, from the rows around its samples."""
        model, (reading, around, looked) = self.model, self.model.instruments[of - 1]
        at = [self.row - 1 - sample.back - rows for sample, rows in pairs]
        here = range(around.rows(min(at)).start, around.rows(max(at)).stop)
        _, seen, told = zip(*(self.read[k + around.late - self.row] for k in here), strict=True)
        step_s, begins_s = model.interval_s / model.substeps, float(model.experiment.t_s[0])
        known_s, t_s = (begins_s + step_s * np.array(rows) for rows in (here, at))
        some = reading.of_some(known_s, t_s, np.array([sample.values for sample, _ in pairs]))
        if isinstance(looked, slice):
            columns, place = self.moving, slice(3 * looked.start, 3 * looked.stop)
            values = np.array(seen)[:, place]
        else:
            columns, values = np.arange(model.size), np.array(told)[:, looked]
        values = values.reshape(len(here), -1, 3, 1 + len(columns))
        slopes = Slopes.along(columns, values[..., 1:])
        residual, slope = some.linearised(values[..., 0], slopes, self.phi, model.size)
        return zip(np.where(some.there(len(here)), residual, np.nan), slope, strict=True)

    def _of_markers(self, reading: Sample, rows: int) -> tuple[Array, Array]:
        """Residuals (M, 3) of what was read, NaN where missing, and their slopes (M, 3, P) by p."""
        model, around, markers = self.model, self.model.samples_around, self.model.markers
        back = reading.back + rows
        backs = [back - k * model.substeps for k in range(-around, around + 1)]
        x, seen = (np.array(part) for part in zip(*map(self._at, backs), strict=True))
        seen = seen[:, : 3 * len(self.shape_functions[0])]
        values = seen[..., 0].reshape(len(seen), -1, 3)
        slopes = markers.channel.slopes_of(x, self.shape_functions, self.moving, seen[..., 1:])
        since_s = (self.row - 1 - back) / model.substeps * model.interval_s
        markers = markers.later(since_s)
        residual, slope = markers.linearised(values, slopes, self.phi, model.size)
        return residual[0] - reading.values / markers.sigmas[:, None], slope[0]

    def _at(self, back: float) -> tuple[Array, Array]:
        """X and what the markers have so many rows before the last; the start before the start."""
        nearest = round(back)
        last = len(self.read) - 1
        if abs(back - nearest) <= NEAR or not last:
            kept, seen, _ = self.read[min(max(last - nearest, 0), last)]
            return kept.x, seen
        first = int(np.clip(np.floor(back) - 1, 0, max(0, last - 3)))
        rows = [first + k for k in range(min(4, last + 1))]
        weights = lagrange_weights(back, rows)
        kept, seen, _ = zip(*(self.read[last - row] for row in rows), strict=True)
        return np.tensordot(weights, [k.x for k in kept], 1), np.tensordot(weights, seen, 1)

    def take(self, said: Sequence[Said]) -> None:
        """Add what readings say, of those that are there."""
        self.information = self.added(self.information, said)

    def added(self, known: LeastSquares, said: Sequence[Said]) -> LeastSquares:
        """What is known, and what readings say besides, with the loss's weights."""
        if not said:
            return known
        at_zero = np.concatenate([each.at_zero for each in said])
        there = np.isfinite(at_zero)
        here = there.any(axis=1)
        slopes, there = np.concatenate([each.slope for each in said])[here], there[here]
        residual = np.where(there, at_zero[here] + slopes @ self.flat, 0.0)
        rows, slopes = as_squares(residual, slopes, self.model.collocation.huber)
        return known.add(rows[there], slopes[there], self.flat)
