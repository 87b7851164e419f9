"""Solve linearised equations of motion forward and backward in time, block by block.

The Jacobian c_x is block lower-triangular in time, so that with one factorisation a timestep
c_x Y = −R (forward) and c_xᵀ y = −g (backward) are solved without ever forming it. With
G = ∂F/∂ξ, C = ∂F/∂ν at evaluation t (see `nlp.schemes`), one step forward is the tangent of one
step of the scheme:

    −A Y_t = R_t + w_0 F' + Σ_{j≥1} w_j dF_{t−j} − M Σ_{i≥1} s_i Y_{t−i} / Δt²,
    F' = F_R + G Σ_{i≥1} p_i Y_{t−i} + C Σ_{i≥1} q_i Y_{t−i} / Δt,
    −A = −∂c_t/∂x_t = −w_0 (p_0 G + q_0 C / Δt) + s_0 M / Δt²,

and dF_t follows from the row itself. For the feasibility step p, R is c and F_R is zero; for
Z = dx/dq, R is zero and F_R is ∂F/∂q. With memory F' has what it brings, see `nlp.memory`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..errors import SimulationError
from ..fem.body import Linearisation
from .dynamics import Dynamics
from .factorisation import NONE, Choice, Factor, Factoriser
from .lapack import one_blas_thread
from .memory import History, Slopes, Weights
from .reaction import HeldForces, HeldRows
from .row import Row, weighted
from .segment import Segment
from .setting import Setting
from .stopwatch import Stopwatch
from .unsymmetric import both_triangles, in_both_triangles, signs_by_column, signs_by_row

if TYPE_CHECKING:
    from ..fem.batched.skyline import Room

# Element results and factors of this size at most are kept at a time.
CHUNK_BYTES = 128e6
# So many narrow factors at most, each chunk's in the memory of the one before: fetching it anew
# costs as much as half a factorisation.
ROOMS = 16


@dataclass(frozen=True, eq=False)
class Tangent:
    """The feasibility step and the sensitivities of one experiment at (x, q).

    Attributes
    ----------
    step : (N, 3n) p = −c_x⁻¹ c [m]
    by_p : (N, 3n, m) Z = −c_x⁻¹ c_p [m]
    violation_n : float
        Largest |c|.
    indefinite : int
        Timesteps whose block −∂c_t/∂x_t is not positive definite.
    memory : Memory
        To continue with later rows.
    held : HeldForces
        Of the dofs of grasps whose wrench is measured, by the step and by p.
    """

    step: Array
    by_p: Array
    violation_n: float
    indefinite: int
    memory: Memory
    held: HeldForces


@dataclass(frozen=True, eq=False)
class Memory:
    """What the next row depends on, most recent row first; (free, 1 + m) each.

    Attributes
    ----------
    solutions : Y_{t−i}
    increments : dF_{t−j}
    forces : (3n,) total forces F_{t−j} at the evaluations
    overstress : dm of each branch
    """

    solutions: tuple[Array, ...]
    increments: tuple[Array, ...]
    forces: tuple[Array, ...]
    overstress: tuple[Array, ...] = ()


@dataclass(frozen=True, eq=False)
class Step:
    """One timestep's F, G, C (lower triangles), ∂F/∂θ, −∂c_t/∂x_t factorised, G's skew part, ν."""

    t: int
    row: Row
    force: Array
    by_position: Array
    by_velocity: Array
    by_theta: Array
    factor: Factor
    skew: Array
    velocity: Array


class BlockSolver:
    """Forward and backward substitution in time for the first rows of one experiment.

    Parameters
    ----------
    segment : Segment
    rows : int, optional
        Grid times to take, all by default.
    stopwatch : Stopwatch, optional
    factorisation : {"auto", "band", "sparse", "supernodal"}
        See `nlp.factorisation`.
    """

    def __init__(
        self,
        segment: Segment,
        rows: int | None = None,
        stopwatch: Stopwatch | None = None,
        factorisation: Choice = "auto",
    ) -> None:
        self.stopwatch = stopwatch or Stopwatch()
        self.factorisation: Choice = factorisation
        self.dynamics = segment.dynamics.first_rows(rows or segment.grid_rows)
        self._takes = bool(self.dynamics.taken.any())
        self.segment = segment
        self.body, self.pattern = segment.body, segment.pattern
        self.free = segment.free_dofs
        self.factoriser = Factoriser.of(self.pattern, self.free, factorisation)
        full_rows, full_columns, source = self.pattern.full
        place = np.full(self.pattern.size, -1)
        place[self.free] = np.arange(len(self.free))
        kept = (place[full_rows] >= 0) & (place[full_columns] >= 0)
        signs = signs_by_row(self.pattern)[kept]
        self._source = source[kept], in_both_triangles(self.pattern, source[kept], signs)
        # Sorted by column; the matrices are symmetric, so that serves for rows as well.
        held = np.full(self.pattern.size, -1)
        held[segment.grasping.dofs] = np.arange(len(segment.grasping.dofs))
        beside = (place[full_rows] >= 0) & (held[full_columns] >= 0)
        shape = (len(self.free), len(segment.grasping.dofs))
        numbers, places = np.arange(1, beside.sum() + 1), (place[full_rows], held[full_columns])
        self._held = sp.csr_array((numbers, (places[0][beside], places[1][beside])), shape=shape)
        # Its data are their own numbers, in the order that compressing them gave.
        order = np.asarray(self._held.data, dtype=np.int64) - 1
        origin, signs = source[beside][order], signs_by_column(self.pattern)[beside][order]
        self._held_source = origin, in_both_triangles(self.pattern, origin, signs)
        self._held = self._held.astype(float)
        self.sensed = segment.sensed_dofs
        self.sensed_rows = HeldRows(self.pattern, self.sensed)
        counts = np.bincount(place[full_columns[kept]], minlength=len(self.free))
        indptr = np.concatenate([[0], np.cumsum(counts)])
        self._matrix = sp.csr_array(
            (np.zeros(kept.sum()), place[full_rows[kept]], indptr),
            shape=(len(self.free), len(self.free)),
        )

    def __reduce__(self) -> tuple[type[BlockSolver], tuple[Segment, int, None, Choice]]:
        return BlockSolver, (self.segment, self.dynamics.rows, None, self.factorisation)

    @one_blas_thread()
    def forward(self, x: Array, setting: Setting, known: Tangent | None = None) -> Tangent:
        """The step p and the sensitivities Z at x (N, 3n).

        Parameters
        ----------
        known : Tangent, optional
            That of the first rows, at the same positions and parameters: it is continued.

        Raises
        ------
        SimulationError
            Where a timestep's equations are singular or not finite.
        """
        count = 1 + len(self.segment.moving)
        columns = np.zeros((*x.shape, count))
        history, theta_q = self.dynamics.history(x, setting.theta), setting.columns()
        violation, indefinite, done = 0.0, 0, 0
        if known is not None:
            violation, indefinite, done = known.violation_n, known.indefinite, len(known.step)
            columns[:done, :, 0], columns[:done, :, 1:] = known.step, known.by_p
        acceleration = self.dynamics.acceleration(x)
        given = GivenMotion.of(self, setting, x)
        memory = known.memory if known else None
        held = HeldForces.nothing(len(x), len(self.sensed), count)
        if known is not None:
            held.begin(known.held)
        march = Forward(self, setting, (len(self.free), count), memory, held)
        march.remember(history, theta_q, done)
        for step in self._steps(x, setting, first=done, history=history):
            indefinite += not step.factor.positive_definite
            right, force = np.zeros(march.shape), np.zeros((x.shape[1], count))
            residual = march.residual(step, acceleration[step.t])
            violation = max(violation, float(np.abs(residual).max(initial=0.0)))
            right[:, 0] = residual
            if setting.mass_moves:
                right[:, 1:] -= march.inertia_slopes(step, acceleration[step.t])
            force[:, 1:] = march.force_slopes(step)
            with self.stopwatch.solving():
                columns[step.t, self.free] = march.advance(step, right, force, given)
        if given is not None:
            columns[done:, given.held_dofs] = given.of_held[done:]
        step_m, by_p = columns[:, :, 0], columns[:, :, 1:]
        return Tangent(step_m, by_p, violation, indefinite, march.memory, held)

    def sensitivities(
        self, x: Array, setting: Setting, held: HeldForces | None = None
    ) -> Iterator[Array]:
        """Z_t (3n, m), row by row; nothing but the last few rows is kept, and `held` filled.

        Raises
        ------
        SimulationError
            Where a timestep's equations are singular or not finite.
        """
        shape = (x.shape[1], len(self.segment.moving))
        march = Forward(self, setting, (len(self.free), shape[1]), held=held)
        given, history = GivenMotion.of(self, setting), self.dynamics.history(x, setting.theta)
        march.remember(history, setting.columns(first=0))
        acceleration = self.dynamics.acceleration(x)
        yield from np.zeros((self.dynamics.first_row, *shape))
        for step in self._steps(x, setting, history=history):
            row, right = np.zeros(shape), np.zeros(march.shape)
            if setting.mass_moves:
                right -= march.inertia_slopes(step, acceleration[step.t])
            row[self.free] = march.advance(step, right, march.force_slopes(step), given)
            if given is not None:
                row[given.held_dofs] = given.of_held[step.t]
            yield row

    def response(
        self, x: Array, setting: Setting, moved: Array, held: HeldForces | None = None
    ) -> Iterator[Array]:
        """How every row of x, (3n, c), follows grasped dofs that move by `moved` (N, g, c).

        `held` is filled on the way.

        Raises
        ------
        SimulationError
            Where a timestep's equations are singular or not finite.
        """
        count = moved.shape[2]
        given = GivenMotion.along(self, setting.held.dofs, moved)
        march = Forward(self, setting, (len(self.free), count), held=held)
        history = self.dynamics.history(x, setting.theta)
        march.remember(history, np.zeros((len(setting.theta), count)))
        yield from np.zeros((self.dynamics.first_row, x.shape[1], count))
        for step in self._steps(x, setting, history=history):
            row, right = np.zeros((x.shape[1], count)), np.zeros(march.shape)
            row[self.free] = march.advance(step, right, np.zeros_like(row), given)
            row[given.held_dofs] = given.of_held[step.t]
            yield row

    @one_blas_thread()
    def backward(self, x: Array, setting: Setting, gradient: Array) -> Array:
        """Multipliers y (N, 3n) [1/N] of the rows with c_xᵀ y = −`gradient` (N, 3n) [1/m].

        Dofs that a passing grasp holds have zeros.
        """
        dynamics, reach = self.dynamics_at(setting), self.dynamics.reach
        rows = [Row.of(dynamics, t, setting.theta) for t in range(dynamics.rows)]
        y = np.zeros((dynamics.rows, len(self.free)))
        pulled = -gradient[:, self.free]  # what is left for the rows that are still to come
        history = self.dynamics.history(x, setting.theta)
        weights = Weights(history) if history else None
        for step in self._steps(x, setting, backward=True, history=history):
            t = step.t
            through_stress = weights.pulled()[self.free] if weights else 0.0
            lags = range(min(reach, t) + 1)
            mass = rows[t].mass_kg[self.free]
            later = [j for j in range(1, reach + 1) if t + j < dynamics.rows]
            known = self.without_taken(
                t,
                sum(
                    (rows[t + j].w[j] * y[t + j] for j in later if rows[t + j].w[j]),
                    np.zeros(len(self.free)),
                ),
            )
            row = rows[t]
            p, q, w = row.p, row.q, row.w[0]
            pulled[t] -= p[0] * through_stress
            by_position, by_velocity = None, None
            if known.any():
                by_position = self.apply(step.by_position, known, -step.skew)
                by_velocity = self.apply(step.by_velocity, known)
                pulled[t] -= p[0] * by_position + q[0] * by_velocity
            # (w_0 (p_0 G + q_0 C) − s_0 M) y_t = what is left, and the factor is of its negative.
            right = self.without_taken(t, pulled[t])
            y[t] = -step.factor.solve(right, transposed=True)
            force_weight = known + w * y[t]
            by_position = self.apply(step.by_position, force_weight, -step.skew) + through_stress
            by_velocity = self.apply(step.by_velocity, force_weight)
            if weights:
                whole = np.zeros(x.shape[1])
                whole[self.free] = force_weight
                weights.retreat(whole)
            for i in lags:
                if i > 0:
                    pulled[t - i] -= p[i] * by_position + q[i] * by_velocity
                    pulled[t - i] += row.s[i] * mass * y[t]
        full = np.zeros_like(x)
        full[:, self.free] = y
        return full

    def without_taken(self, t: int, rows: Array) -> Array:
        """Rows (free, …) with zeros at what a passing grasp holds at t, in place."""
        if self._takes:
            rows[self.dynamics.taken[t, self.free]] = 0
        return rows

    @property
    def chunk(self) -> int:
        """Timesteps that are evaluated and factorised at a time."""
        most = ROOMS if self.factoriser.skyline else self.dynamics.rows
        # Each thread has one to factorise, however large it is.
        least = min(self.body.threads, self.dynamics.rows)
        return max(least, min(self.dynamics.rows, most, int(CHUNK_BYTES / self._step_bytes)))

    @property
    def chunk_bytes(self) -> int:
        """Memory that takes."""
        return self.chunk * self._step_bytes

    @property
    def _step_bytes(self) -> int:
        solver = self.factoriser
        numbers = solver.unsymmetric_numbers if self.body.unsymmetric else solver.numbers
        return 8 * (self.body.linearisation_width + numbers)

    def apply(self, lower: Array, columns: Array, skew: Array = NONE) -> Array:
        """Product of a matrix, given by lower triangles of its two parts, on the free dofs."""
        self._matrix.data = _entries(lower, skew, self._source)
        return self._matrix @ columns

    def apply_held(self, lower: Array, columns: Array, skew: Array = NONE) -> Array:
        """Product (free, …) of its columns of grasped dofs, with `columns` (g, …)."""
        self._held.data = _entries(lower, skew, self._held_source)
        return self._held @ columns

    def dynamics_at(self, setting: Setting) -> Dynamics:
        """The equations of motion of the rows at a setting."""
        return setting.dynamics.first_rows(self.dynamics.rows)

    def _steps(
        self,
        x: Array,
        setting: Setting,
        backward: bool = False,
        first: int = 0,
        history: History | None = None,
    ) -> Iterator[Step]:
        """Blocks and factors of every row from `first` on, computed in chunks side by side."""
        dynamics, theta = self.dynamics_at(setting), setting.theta
        xi, nu = dynamics.evaluation_states(x)
        starts = range(max(first, dynamics.first_row), dynamics.rows, self.chunk)
        rooms = [self.factoriser.room(1 + self.body.unsymmetric) for _ in range(self.chunk)]
        for start in reversed(starts) if backward else starts:
            stop = min(start + self.chunk, dynamics.rows)
            here = slice(start - dynamics.first_row, stop - dynamics.first_row)
            with self.stopwatch.evaluating():
                forces = setting.dynamics.forces.rows(slice(start, stop))
                carried = dynamics.carried(history, slice(start, stop))
                at = forces.linearise(xi[here], nu[here], theta, carried=carried)
            with self.stopwatch.solving():
                rows = [Row.of(dynamics, t, theta) for t in range(start, stop)]
                factors = self._factorise(dynamics, at, slice(start, stop), rows, rooms)
            order = range(stop - start)
            for k in reversed(order) if backward else order:
                yield Step(
                    start + k,
                    rows[k],
                    at.force[k],
                    at.by_position[k],
                    at.by_velocity[k],
                    at.by_theta[k],
                    factors[k],
                    at.by_position_skew[k],
                    nu[start - dynamics.first_row + k],
                )

    def _factorise(
        self,
        dynamics: Dynamics,
        at: Linearisation,
        here: slice,
        rows: list[Row],
        rooms: Sequence[Room | None] = (),
    ) -> list[Factor]:
        pattern, taken = self.pattern, dynamics.taken[here]

        def matrix(k: int) -> tuple[Array, Array]:
            values = rows[k].block(at.by_position[k], at.by_velocity[k], pattern)
            skew = rows[k].skew_block(at.by_position_skew[k])
            if taken[k].any():
                size = np.abs(values[pattern.diagonal]).mean()
                gone = taken[k][pattern.rows] | taken[k][pattern.columns]
                values[gone] = 0
                values[pattern.diagonal[taken[k]]] = size
                if skew.size:
                    skew[gone] = 0
            return values, skew

        try:
            count, threads = len(at.force), self.body.threads
            return self.factoriser.factorise_each(matrix, count, threads, rooms)
        except np.linalg.LinAlgError as error:
            raise SimulationError(
                f"experiment '{self.segment.experiment.name}': the linearised equations of "
                f"motion cannot be solved: {error}",
                float(dynamics.t_s[here.start]),
            ) from error


def _entries(lower: Array, skew: Array, sources: tuple[Index, Index]) -> Array:
    """Entries of a matrix from the lower triangle, or from both of one with a skew part."""
    if not skew.size:
        return np.take(lower, sources[0])
    return np.take(both_triangles(lower, skew), sources[1])


@dataclass(frozen=True, eq=False)
class GivenMotion:
    """Columns Y of grasped dofs, which are given: the way to their goals, and ∂goal/∂φ.

    Attributes
    ----------
    held_dofs : (h,) dofs held throughout
    of_held : (N, h, columns)
    of_evaluations : (N, g, columns) and over time, Σ_i p_i Y_{t−i} and Σ_i q_i Y_{t−i} of grasped
        dofs; of those held for a while the past is in the rows before
    taken : (N, g) bool, those held for a while
    places : (g,) where they are among the free dofs; −1 for those held throughout
    columns : (N, g, columns)
    """

    held_dofs: Index
    of_held: Array
    of_evaluations: tuple[Array, Array]
    taken: NDArray[np.bool_]
    places: Index
    columns: Array

    @classmethod
    def of(
        cls, solver: BlockSolver, setting: Setting, x: Array | None = None
    ) -> GivenMotion | None:
        """Those of a setting, with the way from x (N, 3n) in front; None where all is zero."""
        held, dynamics = setting.held, solver.dynamics
        if not held.moves:
            return None
        rows, shared = dynamics.rows, setting.nq
        goals = held.positions_m[:rows]
        columns = np.zeros((*goals.shape, shared + held.by_phi.shape[2]))
        columns[..., shared:] = held.by_phi[:rows]
        if x is not None:
            way = np.nan_to_num(goals - x[:, held.dofs])
            columns = np.concatenate([way[..., None], columns], axis=2)
        return cls.along(solver, held.dofs, columns)

    @classmethod
    def along(cls, solver: BlockSolver, dofs: Index, columns: Array) -> GivenMotion:
        """Those of dofs (g,) that move by `columns` (N, g, c)."""
        dynamics = solver.dynamics
        taken = dynamics.taken[:, dofs]
        passing = np.isin(dofs, solver.free)
        throughout = np.where(passing[:, None], 0.0, columns)
        now = np.where((taken & passing)[..., None], columns, 0.0)
        p, q = dynamics.tables.p, dynamics.tables.q / dynamics.step_s
        evaluated = [
            dynamics.combine(table, throughout) + table[:, :1, None] * now for table in (p, q)
        ]
        return cls(
            held_dofs=dofs[~passing],
            of_held=columns[:, ~passing],
            of_evaluations=(evaluated[0], evaluated[1]),
            taken=taken & passing,
            places=np.where(passing, np.searchsorted(solver.free, dofs), -1),
            columns=columns,
        )

    def force(self, solver: BlockSolver, step: Step) -> Array:
        """What their motion adds to F' (free, columns)."""
        position, velocity = (each[step.t] for each in self.of_evaluations)
        # What is only parameters of other kinds does not move them.
        moved = np.flatnonzero(position.any(axis=0) | velocity.any(axis=0))
        force = np.zeros((len(solver.free), position.shape[1]))
        if len(moved):
            force[:, moved] = solver.apply_held(step.by_position, position[:, moved], step.skew)
            force[:, moved] += solver.apply_held(step.by_velocity, velocity[:, moved])
        return force

    def place_taken(self, t: int, solution: Array) -> None:
        """Put those held for a while into Y_t (free, columns), in place."""
        here = self.taken[t]
        solution[self.places[here]] = self.columns[t, here]


class Forward:
    """Substitution row by row; remembers the last few rows."""

    def __init__(
        self,
        solver: BlockSolver,
        setting: Setting,
        shape: tuple[int, int],
        memory: Memory | None = None,
        held: HeldForces | None = None,
    ) -> None:
        self.solver = solver
        self.held = held if len(solver.sensed) else None
        self.setting = setting
        self.shape = shape
        reach = solver.dynamics.reach
        nothing = (np.zeros(shape),) * reach
        memory = memory or Memory(nothing, nothing, (np.zeros(len(solver.free)),) * reach)
        self.past = deque(memory.solutions, maxlen=reach)
        self.past_increments = deque(memory.increments, maxlen=reach)
        self.past_forces = deque(memory.forces, maxlen=reach)
        # Also where these rows do not: they may be continued.
        self.weighs_past = bool(solver.segment.dynamics.tables.w[:, 1:].any())
        self.slopes: Slopes | None = None
        self._overstress = memory.overstress

    @property
    def memory(self) -> Memory:
        """What later rows depend on."""
        overstress = tuple(self.slopes.columns) if self.slopes else ()
        return Memory(
            tuple(self.past), tuple(self.past_increments), tuple(self.past_forces), overstress
        )

    def remember(self, history: History | None, theta_q: Array, done: int = 0) -> None:
        """Follow the memory of a body that has one, after rows that are done."""
        if history is None:
            return
        self.slopes = Slopes(history, theta_q, done, self._overstress)
        if not done and self.solver.dynamics.first_row:
            # The start is given.
            self.slopes.advance(np.zeros((self.solver.pattern.size, theta_q.shape[1])))

    def residual(self, step: Step, acceleration: Array) -> Array:
        """c_t on the free dofs; to be called for every row in turn."""
        solver, row = self.solver, step.row
        force = step.force[solver.free]
        solver.without_taken(step.t, force)
        total = row.w[0] * force - (row.mass_kg * acceleration)[solver.free]
        if self.weighs_past:
            total += weighted(row.w, self.past_forces, force.shape)
            self.past_forces.appendleft(force)
        return solver.without_taken(step.t, total)

    def force_slopes(self, step: Step) -> Array:
        """∂F/∂p (3n, m)."""
        return self.setting.force_slopes(step.t, step.by_theta)

    def inertia_slopes(self, step: Step, acceleration: Array) -> Array | float:
        """∂(M a)/∂p on the free dofs."""
        free = self.solver.free
        return self.setting.inertia_slopes(step.t, acceleration[free], free)

    def advance(
        self, step: Step, right: Array, force: Array, given: GivenMotion | None = None
    ) -> Array:
        """Y_t from R_t (free, columns) and F_R (3n, columns), and from how grasped dofs move."""
        t, solver = step.t, self.solver
        row = step.row
        w, s, mass = row.w, row.s, row.mass_kg.take(solver.free)[:, None]
        if self.weighs_past:
            right += weighted(w, self.past_increments, self.shape)
        right -= mass * weighted(s, self.past, self.shape)
        if self.slopes is not None:
            force = force + self.slopes.force()
        forced = force.take(solver.free, axis=0)
        forced += self._of_past(step, row)
        if given is not None:
            forced += given.force(solver, step)
        solver.without_taken(t, right)
        solver.without_taken(t, forced)
        solution = step.factor.solve(right + w[0] * forced)
        if self.weighs_past:
            self.past_increments.appendleft((s[0] * mass * solution - right) / w[0])
        if given is not None:
            given.place_taken(t, solution)
        if self.slopes is not None:
            self.slopes.advance(self._evaluated(row.p, solution, t, given, 0))
        if self.held is not None:
            state, rate = (
                self._evaluated(weights, solution, t, given, order)
                for order, weights in enumerate((row.p, row.q))
            )
            self._sense(self.held, step, force, state, rate)
        self.past.appendleft(solution)
        return solution

    def _sense(self, held: HeldForces, step: Step, force: Array, state: Array, rate: Array) -> None:
        """Note F_t and dF_t of the dofs whose grasp has a sensor."""
        t, rows, dofs = step.t, self.solver.sensed_rows, self.solver.sensed
        held.force[t] = step.force[dofs]
        held.slopes[t] = force[dofs] + rows.of(step.by_position, step.skew) @ state
        held.slopes[t] += rows.of(step.by_velocity, NONE) @ rate

    def _evaluated(
        self,
        weights: Sequence[float],
        solution: Array,
        t: int,
        given: GivenMotion | None,
        order: int,
    ) -> Array:
        """Σ_i weights[i] Y_{t−i} (3n, columns) of all dofs: how ξ, or ν, of row t changes."""
        found = np.zeros((self.solver.pattern.size, self.shape[1]))
        found[self.solver.free] = weights[0] * solution + weighted(weights, self.past, self.shape)
        if given is not None:
            found[given.held_dofs] = given.of_evaluations[order][t, given.places < 0]
        return found

    def _of_past(self, step: Step, row: Row) -> Array:
        """G Σ p_i Y_{t−i} + C Σ q_i Y_{t−i}, with as few products as the stencil allows."""
        if not row.lags:
            return np.zeros(self.shape)
        if len(row.lags) == 1:
            (i,) = row.lags
            block = row.p[i] * step.by_position
            block += row.q[i] * step.by_velocity
            return self.solver.apply(block, self.past[i - 1], row.p[i] * step.skew)
        total = self.solver.apply(step.by_velocity, weighted(row.q, self.past, self.shape))
        if any(row.p[1:]):
            past = weighted(row.p, self.past, self.shape)
            total += self.solver.apply(step.by_position, past, step.skew)
        return total
