"""Solve linearised equations of motion forward and backward in time, block by block.

The Jacobian c_x is block lower-triangular in time, so that with one factorisation a timestep
c_x Y = −R (forward) and c_xᵀ y = −g (backward) are solved without ever forming it. With
G = ∂F/∂ξ, C = ∂F/∂ν at evaluation t (see `model.schemes`), one step forward is the tangent of one
step of the scheme:

    −A Y_t = R_t + w_0 F' + Σ_{j≥1} w_j dF_{t−j} − M Σ_{i≥1} s_i Y_{t−i} / Δt²,
    F' = F_R + G Σ_{i≥1} p_i Y_{t−i} + C Σ_{i≥1} q_i Y_{t−i} / Δt,
    −A = −∂c_t/∂x_t = −w_0 (p_0 G + q_0 C / Δt) + s_0 M / Δt²,

and dF_t follows from the row itself. For the feasibility step p, R is c and F_R is zero; for
Z = dx/dq, R is zero and F_R is ∂F/∂q. Grasped dofs that move have their Y given. With memory F' has
what it brings, see `model.viscoelasticity`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..errors import SimulationError
from ..fem.body import Linearisation
from ..model.dynamics import Dynamics, StencilRow, weighted
from ..model.force_history import Carrying
from ..model.histories import AnyHistory
from ..model.setting import Setting
from ..model.viscoelasticity import Slopes
from .block_band import Submatrix
from .factorisation import Choice, Factor, Factoriser
from .lapack import one_blas_thread
from .reaction import HeldForces
from .segment import Segment
from .stopwatch import Stopwatch

if TYPE_CHECKING:
    from ..fem.kernels.skyline import Room

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
    last : LastRows
        To continue with later rows.
    held : HeldForces
        Of the dofs of grasps whose wrench is measured, by the step and by p.
    """

    step: Array
    by_p: Array
    violation_n: float
    indefinite: int
    last: LastRows
    held: HeldForces


@dataclass(frozen=True, eq=False)
class LastRows:
    """What the next row depends on, most recent row first.

    Attributes
    ----------
    solutions : (3n, c) Y_{t−i}
    increments : (free, c) dF_{t−j}
    forces : (free,) total forces F_{t−j} at the evaluations
    carried : columns of what is carried
    """

    solutions: tuple[Array, ...]
    increments: tuple[Array, ...]
    forces: tuple[Array, ...] = ()
    carried: tuple[Array, ...] = ()


class Step(NamedTuple):
    """One timestep's F, G, C (lower triangles), −∂c_t/∂x_t factorised, and their skew parts."""

    t: int
    row: StencilRow
    force: Array
    by_position: Array
    by_velocity: Array
    factor: Factor
    skew: Array
    rate_skew: Array


@dataclass(frozen=True, eq=False)
class Chunk:
    """Rows that are linearised together: their steps, and what they have at once."""

    here: slice
    at: Linearisation
    steps: list[Step]


@dataclass(frozen=True, eq=False)
class GraspMotion:
    """Columns Y of grasped dofs, which are given: the way to their goals, and ∂goal/∂φ.

    Attributes
    ----------
    dofs : (g,)
    columns : (N, g, c)
    holds : (N, g) bool, those that are held at a time
    """

    dofs: Index
    columns: Array
    holds: NDArray[np.bool_]

    @classmethod
    def along(cls, solver: Sweep, dofs: Index, columns: Array) -> GraspMotion:
        """Those of dofs (g,) that move by `columns` (N, g, c)."""
        return cls(dofs, columns, solver.dynamics.taken[:, dofs] | ~np.isin(dofs, solver.free))

    @property
    def count(self) -> int:
        """C."""
        return self.columns.shape[-1]

    def place(self, t: int, solution: Array) -> None:
        """Put them into Y_t (3n, columns), in place."""
        here = self.holds[t]
        solution[self.dofs[here]] = self.columns[t, here]

    def force(self, solver: Sweep, step: Step) -> Array | float:
        """What their motion at t adds to F' (free, columns)."""
        now = np.where(self.holds[step.t, :, None], self.columns[step.t], 0.0)
        # What is only parameters of other kinds does not move them.
        moved = np.flatnonzero(now.any(axis=0))
        if not len(moved):
            return 0.0
        p, q, force = step.row.p[0], step.row.q[0], np.zeros((len(solver.free), self.count))
        skew = step.row.skew(0, step.skew, step.rate_skew)
        matrix = solver.beside.of(p * step.by_position + q * step.by_velocity, skew)
        force[:, moved] = matrix @ now[:, moved]
        return force


@dataclass(frozen=True, eq=False)
class Columns:
    """What is carried through the rows.

    Attributes
    ----------
    setting : Setting
    count : int
    by_p : bool
        Whether the last are by the parameters that move the body.
    step : bool
        Whether the first is the way to the equations.
    grasped : GraspMotion, optional
        Where grasped dofs move.
    """

    setting: Setting
    count: int
    by_p: bool = True
    step: bool = False
    grasped: GraspMotion | None = None

    @classmethod
    def by_parameters(cls, solver: Sweep, setting: Setting, x: Array | None = None) -> Columns:
        """By all that moves the body, and in front, where x (N, 3n) is given, the step from it."""
        first, count, grasped = int(x is not None), len(solver.segment.moving), None
        if setting.held.moves:
            held = setting.held
            goals = held.positions_m[: solver.dynamics.rows]
            columns = np.zeros((*goals.shape, first + count))
            columns[..., first + solver.segment.nq :] = held.by_phi[: len(goals)]
            if x is not None:
                columns[..., 0] = np.nan_to_num(goals - x[:, held.dofs])
            grasped = GraspMotion.along(solver, held.dofs, columns)
        return cls(setting, first + count, step=x is not None, grasped=grasped)

    @classmethod
    def along(cls, solver: Sweep, setting: Setting, moved: Array) -> Columns:
        """By grasped dofs that move by `moved` (N, g, c)."""
        grasped = GraspMotion.along(solver, setting.held.dofs, moved)
        return cls(setting, grasped.count, by_p=False, grasped=grasped)

    def sides(
        self,
        rows: slice,
        at: Linearisation,
        acceleration: Array,
        residual: Array | None,
        free: Index,
    ) -> tuple[Array, Array]:
        """R (k, free, c) and F_R (k, 3n, c) of some rows.

        Parameters
        ----------
        acceleration : (k, 3n)
        residual : (k, free), where the first column is the way to the equations
        """
        count, size = acceleration.shape
        right, force = (np.zeros((count, k, self.count)) for k in (len(free), size))
        if residual is not None:
            right[..., 0] = residual
        if self.by_p:
            first = int(self.step)
            force[..., first:] = self.setting.force_slopes(rows, at.by_theta)
            right[..., first:] -= self.setting.inertia_slopes(rows, acceleration[:, free], free)
        return right, force

    def of_inputs(self, t: int) -> Array:
        """(U, c) derivatives of the inputs of an evaluation."""
        own = self.setting.by_p[t]
        none = np.zeros((len(own), int(self.step) if self.by_p else self.count))
        return np.hstack([none, own]) if self.by_p else none


class Sweep:
    """Forward and backward substitution in time for the first rows of one experiment.

    Parameters
    ----------
    segment : Segment
    rows : int, optional
        Grid times to take, all by default.
    stopwatch : Stopwatch, optional
    factorisation : {"auto", "band", "sparse", "supernodal"}
        See `program.factorisation`.
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
        self.segment = segment
        self.body, self.pattern = segment.body, segment.pattern
        self.free, self.sensed = segment.free_dofs, segment.sensed_dofs
        self.factoriser = Factoriser.of(self.pattern, self.free, factorisation)
        self.matrix = Submatrix(self.pattern, self.free)
        self.beside = Submatrix(self.pattern, self.free, segment.grasping.dofs)
        self.of_sensed = Submatrix(self.pattern, self.sensed)
        self._takes = bool(self.dynamics.taken.any())

    def __reduce__(self) -> tuple[type[Sweep], tuple[Segment, int, None, Choice]]:
        return Sweep, (self.segment, self.dynamics.rows, None, self.factorisation)

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
        carried = Columns.by_parameters(self, setting, x)
        columns = np.zeros((*x.shape, carried.count))
        held = HeldForces.nothing(len(x), len(self.sensed), carried.count)
        march = Forward(self, carried, known.last if known else None, held)
        if known is not None:
            done = len(known.step)
            columns[:done, :, 0], columns[:done, :, 1:] = known.step, known.by_p
            march.violation_n, march.indefinite = known.violation_n, known.indefinite
            held.begin(known.held)
        for _ in march.rows(x, 0 if known is None else len(known.step), columns):
            pass
        found = columns[:, :, 0], columns[:, :, 1:], march.violation_n, march.indefinite
        return Tangent(*found, march.last, held)

    def sensitivities(
        self, x: Array, setting: Setting, held: HeldForces | None = None
    ) -> Iterator[Array]:
        """Z_t (3n, m), row by row; nothing but the last few rows is kept, and `held` filled.

        Raises
        ------
        SimulationError
            Where a timestep's equations are singular or not finite.
        """
        return Forward(self, Columns.by_parameters(self, setting), held=held).rows(x)

    @one_blas_thread()
    def backward(self, x: Array, setting: Setting, gradient: Array) -> Array:
        """Multipliers y (N, 3n) [1/N] of the rows with c_xᵀ y = −`gradient` (N, 3n) [1/m].

        Dofs that a grasp holds have zeros.
        """
        reach, free, y = self.dynamics.reach, self.free, np.zeros_like(x)
        pulled = -gradient[:, free]  # what is left for the rows that are still to come
        along, later = self.dynamics_at(setting).histories(x), deque[StencilRow](maxlen=reach)
        carried = [history.backward() for history in along]
        for chunk in self.chunks(x, setting, backward=True, along=along):
            for step in reversed(chunk.steps):
                t, row = step.t, step.row
                p, q, mass = row.p, row.q, row.mass_kg[free]
                by_state = by_rate = 0.0
                for own in (each.pulled() for each in carried):
                    by_state, by_rate = by_state + own[0][free], by_rate + own[1][free]
                known = np.zeros(x.shape[1])
                for j, other in enumerate(later, 1):
                    known += other.w[j] * y[t + j]
                known[self.dynamics.taken[t]] = 0
                pulled[t] -= p[0] * by_state + q[0] * by_rate
                if known.any():
                    by_position = self.matrix.of(step.by_position, -step.skew) @ known
                    pulled[t] -= p[0] * by_position
                    pulled[t] -= q[0] * (self.matrix.of(step.by_velocity, -step.rate_skew) @ known)
                # (w_0 (p_0 G + q_0 C) − s_0 M) y_t = what is left; the factor is of its negative.
                right = self.without_taken(t, pulled[t])
                y[t, free] = -step.factor.solve(right, transposed=True)
                force_weight = known + row.w[0] * y[t]
                by_position = self.matrix.of(step.by_position, -step.skew) @ force_weight
                by_position += by_state
                by_velocity = self.matrix.of(step.by_velocity, -step.rate_skew) @ force_weight
                by_velocity += by_rate
                for each in carried:
                    each.retreat(force_weight)
                for i in range(1, min(reach, t) + 1):
                    pulled[t - i] -= p[i] * by_position + q[i] * by_velocity
                    pulled[t - i] += row.s[i] * mass * y[t, free]
                later.appendleft(row)
        return y

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
        """LastRows that takes."""
        return self.chunk * self._step_bytes

    @property
    def _step_bytes(self) -> int:
        solver = self.factoriser
        numbers = solver.unsymmetric_numbers if self.body.unsymmetric else solver.numbers
        return 8 * (self.body.linearisation_width + numbers)

    def dynamics_at(self, setting: Setting) -> Dynamics:
        """The equations of motion of the rows at a setting."""
        return setting.dynamics.first_rows(self.dynamics.rows)

    def chunks(
        self,
        x: Array,
        setting: Setting,
        backward: bool = False,
        first: int = 0,
        along: Sequence[AnyHistory] = (),
    ) -> Iterator[Chunk]:
        """Blocks and factors of every row from `first` on, computed side by side."""
        dynamics = self.dynamics_at(setting)
        xi, nu = dynamics.evaluation_states(x)
        starts = range(max(first, dynamics.first_row), dynamics.rows, self.chunk)
        rooms = [self.factoriser.room(1 + self.body.unsymmetric) for _ in range(self.chunk)]
        for start in reversed(starts) if backward else starts:
            here = slice(start, min(start + self.chunk, dynamics.rows))
            seen = slice(start - dynamics.first_row, here.stop - dynamics.first_row)
            with self.stopwatch.evaluating():
                at = dynamics.forces_along(along, here).linearise(xi[seen], nu[seen])
            with self.stopwatch.solving():
                rows = [StencilRow.of(dynamics, t) for t in range(start, here.stop)]
                factors = self._factorise(dynamics, at, here, rows, rooms)
            numbers = range(start, here.stop)
            parts = numbers, rows, at.force, at.by_position, at.by_velocity, factors
            steps = map(Step, *parts, at.by_position_skew, at.by_velocity_skew)
            yield Chunk(here, at, list(steps))

    def _factorise(
        self,
        dynamics: Dynamics,
        at: Linearisation,
        here: slice,
        rows: list[StencilRow],
        rooms: Sequence[Room | None] = (),
    ) -> list[Factor]:
        pattern, taken = self.pattern, dynamics.taken[here]

        def matrix(k: int) -> tuple[Array, Array]:
            values = rows[k].block(at.by_position[k], at.by_velocity[k], pattern)
            skew = rows[k].skew_block(at.by_position_skew[k], at.by_velocity_skew[k])
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


class Forward:
    """Columns carried forward, row by row; it remembers the last few rows.

    Attributes
    ----------
    violation_n, indefinite : see `Tangent`
    """

    def __init__(
        self,
        solver: Sweep,
        columns: Columns,
        last: LastRows | None = None,
        held: HeldForces | None = None,
    ) -> None:
        self.solver, self.columns = solver, columns
        self.held = held if len(solver.sensed) else None
        self.violation_n, self.indefinite = 0.0, 0
        size, reach = solver.pattern.size, solver.dynamics.reach
        self.shape, self._of_free = (size, columns.count), (len(solver.free), columns.count)
        nothing = (np.zeros(shape) for shape in (self.shape, self._of_free, len(solver.free)))
        solutions, increments, forces = ((each,) * reach for each in nothing)
        last = last or LastRows(solutions, increments, forces)
        self.past = deque(last.solutions, maxlen=reach)
        self.past_increments = deque(last.increments, maxlen=reach)
        self.past_forces = deque(last.forces, maxlen=reach)
        # Also where these rows do not: they may be continued.
        self.weighs_past = bool(solver.segment.dynamics.tables.w[:, 1:].any())
        self.carried: list[Slopes | Carrying] = []
        self._known = last.carried

    @property
    def last(self) -> LastRows:
        """What later rows depend on."""
        carried = tuple(each.columns for each in self.carried)
        past = tuple(self.past), tuple(self.past_increments), tuple(self.past_forces)
        return LastRows(*past, carried)

    def rows(self, x: Array, done: int = 0, out: Array | None = None) -> Iterator[Array]:
        """Y_t (3n, c) at x (N, 3n) after rows that are done, also into `out` (N, 3n, c)."""
        solver, columns, setting = self.solver, self.columns, self.columns.setting
        dynamics, first = solver.dynamics_at(setting), solver.dynamics.first_row
        along, acceleration = dynamics.histories(x), dynamics.acceleration(x)
        known = self._known or [None] * len(along)
        pairs = zip(along, known, strict=True)
        self.carried = [each.forward(columns.of_inputs, done, own) for each, own in pairs]
        for t in range(done, first):  # the start is given
            for each in self.carried:
                each.advance(lambda: np.zeros(self.shape), lambda: np.zeros(self.shape))
            start = np.zeros(self.shape)
            if columns.grasped is not None:
                columns.grasped.place(t, start)
            self.past.appendleft(start)
            yield np.zeros(self.shape)
        for chunk in solver.chunks(x, setting, first=done, along=along):
            residual = None
            if columns.step:
                residual = np.stack([self._residual(s, acceleration[s.t]) for s in chunk.steps])
                self.violation_n = max(self.violation_n, float(np.abs(residual).max(initial=0.0)))
            of_rows = acceleration[chunk.here], residual, solver.free
            sides = columns.sides(chunk.here, chunk.at, *of_rows)
            for step, right, force in zip(chunk.steps, *sides, strict=True):
                self.indefinite += not step.factor.positive_definite
                found = np.zeros(self.shape) if out is None else out[step.t]
                with solver.stopwatch.solving():
                    self.advance(step, right, force, found)
                yield found

    def _residual(self, step: Step, acceleration: Array) -> Array:
        """c_t on the free dofs; to be called for every row in turn."""
        solver, row = self.solver, step.row
        force = solver.without_taken(step.t, step.force[solver.free])
        total = row.w[0] * force - (row.mass_kg * acceleration)[solver.free]
        if self.weighs_past:
            total += weighted(row.w, self.past_forces, force.shape)
            self.past_forces.appendleft(force)
        return solver.without_taken(step.t, total)

    def advance(self, step: Step, right: Array, force: Array, found: Array) -> None:
        """Put Y_t into `found` (3n, c), from R_t (free, c) and F_R (3n, c)."""
        t, solver, given = step.t, self.solver, self.columns.grasped
        row, free = step.row, solver.free
        w, s, mass = row.w, row.s, row.mass_kg.take(free)[:, None]
        if self.weighs_past:
            right += weighted(w, self.past_increments, self._of_free)
        right -= mass * weighted(s, self.past, self.shape).take(free, axis=0)
        for each in self.carried:
            force = force + each.force()
        forced = force.take(free, axis=0)
        forced += self._of_past(step, row)
        if given is not None:
            forced += given.force(solver, step)
        solver.without_taken(t, right)
        solver.without_taken(t, forced)
        solution = step.factor.solve(right + w[0] * forced)
        if self.weighs_past:
            self.past_increments.appendleft((s[0] * mass * solution - right) / w[0])
        found[free] = solution
        if given is not None:
            given.place(t, found)
        for each in self.carried:
            each.advance(
                lambda: self._evaluated(row.p, found), lambda: self._evaluated(row.q, found)
            )
        if self.held is not None:
            self._sense(self.held, step, force, found)
        self.past.appendleft(found)

    def _sense(self, held: HeldForces, step: Step, force: Array, found: Array) -> None:
        """Note F_t and dF_t of the dofs whose grasp has a sensor."""
        row, dofs, matrix = step.row, self.solver.sensed, self.solver.of_sensed
        held.force[step.t] = step.force[dofs]
        state, rate = (self._evaluated(weights, found) for weights in (row.p, row.q))
        slopes = force[dofs] + matrix.of(step.by_position, step.skew) @ state
        held.slopes[step.t] = slopes + matrix.of(step.by_velocity, step.rate_skew) @ rate

    def _evaluated(self, weights: Sequence[float], found: Array) -> Array:
        """Σ_i weights[i] Y_{t−i} (3n, c): how ξ, or ν, of row t changes."""
        return weights[0] * found + weighted(weights, self.past, self.shape)

    def _of_past(self, step: Step, row: StencilRow) -> Array | float:
        """G Σ p_i Y_{t−i} + C Σ q_i Y_{t−i}, with as few products as the stencil allows."""
        matrix = self.solver.matrix
        if not row.lags:
            return 0.0
        if len(row.lags) == 1:
            (i,) = row.lags
            block = row.p[i] * step.by_position
            block += row.q[i] * step.by_velocity
            return matrix.of(block, row.skew(i, step.skew, step.rate_skew)) @ self.past[i - 1]
        past = weighted(row.q, self.past, self.shape)
        total = matrix.of(step.by_velocity, step.rate_skew) @ past
        if any(row.p[1:]):
            past = weighted(row.p, self.past, self.shape)
            total += matrix.of(step.by_position, step.skew) @ past
        return total
