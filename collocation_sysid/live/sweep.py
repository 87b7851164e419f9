"""One pass over a recording at one point p: motion, sensitivities and what the markers say.

A row of the grid takes what the last few rows left (positions, forces, the columns Z by the
parameters that move the body) and leaves the same for the next. Newton's steps end where they are
short; the last factor and slopes serve the columns, as in the reduced-space method: as a rule there
is one linearisation and one factorisation, and where the guess is extrapolated forces alone again.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..methods.robust import huberised
from ..nlp.marching import RowEquations, extrapolated, solve_row
from ..nlp.newton import NewtonFailure, NewtonOptions, Solver, simulation_error
from ..nlp.rest import start_state
from ..nlp.row import Row
from ..nlp.tangent import Forward, GivenMotion, Memory, Step
from .information import Information
from .model import Model, Poses

# Newton's last step over the body's size: the next one would be its square. Slopes of a state that
# many times as far away serve for it too: they are off by as small a share.
LAST_STEP, SAME_SLOPES = 1e-5, 30
# Iterations before the way of the grasp is taken in parts, and to what accuracy that is done.
QUICK = 6
CAREFUL = NewtonOptions(tolerance=1e-6)
# Readings this near to a row, in rows, are of that row; others lie between four of them.
NEAR = 1e-3
# Readings may come this many samples late.
LATEST = 5


# x (3n,), its columns Z, and those of the markers.
Read = tuple[Array, NDArray[np.float32], Array]


class Reading(NamedTuple):
    """Markers (M, 3), NaN where missing, so many rows before the row they are read after."""

    back: float
    tracks_m: Array


class LoggedRow(NamedTuple):
    """What came with one row of the grid."""

    poses: Poses
    readings: list[Reading]


@dataclass(frozen=True, eq=False)
class Kept:
    """What a later pass starts a row from: x (3n,) and Z (3n, m)."""

    x: Array
    columns: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class State:
    """What the next row depends on.

    Attributes
    ----------
    row : int
        Rows done.
    x, force : (rows, 3n) of the last rows of the template
    given : (rows, g, columns) of grasped dofs
    memory : Memory
    read : tuple of (x, Z, Z of the markers), latest last
    """

    row: int
    x: Array
    force: Array
    given: Array
    memory: Memory
    read: tuple[Read, ...]


class Sweep:
    """A pass at p.

    Parameters
    ----------
    model : Model
    p : (P,)
    known : Information
        What was known before its first row.
    start : State, optional
        Where it begins; where the recording does by default.
    at : (P,), optional
        The p of that state, which is moved along its columns: what the state depends on by way of
        what is no longer kept, it depends on as it did there.

    Raises
    ------
    SimulationError
        Where there is no start.
    """

    def __init__(
        self,
        model: Model,
        p: Array,
        known: Information,
        start: State | None = None,
        at: Array | None = None,
    ) -> None:
        self.model, self.p, self.solver = model, p, model.solver
        collocation, segment = model.collocation, model.segment
        self.segment, self.phi = segment, p[collocation.nq :]
        self.setting = segment.setting(p[: collocation.nq], self.phi)
        self.dynamics = self.setting.dynamics.first_rows(model.rows)
        self.carried = model.carried(self.phi)
        self.operator = segment.observation.operator(self.phi)
        self.reading = segment.observation.reading(self.phi)
        self.clock = self._weights_in_time()
        self.newton = Solver(segment.experiment, CAREFUL)
        self.held = np.setdiff1d(np.arange(segment.dofs), self.solver.free)
        self.size_m = float(np.linalg.norm(np.ptp(segment.body.nodes_m, axis=0)))
        self.moving = segment.moving
        self.information, self.known = known, known
        state = self._begin() if start is None or at is None else self._moved(start, p - at)
        self._resume(state)

    # State ------------------------------------------------------------------------------------

    def _begin(self) -> State:
        rows, dofs, count = self.model.rows, self.segment.dofs, len(self.moving)
        grasped = len(self.segment.grasping.dofs)
        empty = np.zeros((rows, dofs))
        memory = Forward(self.solver, self.setting, (len(self.solver.free), count)).memory
        return State(0, empty, empty.copy(), np.zeros((rows, grasped, count)), memory, ())

    def _moved(self, state: State, step: Array) -> State:
        step = step[self.moving]
        if not step.any():
            return state
        x, force, free = state.x.copy(), state.force.copy(), self.solver.free
        dofs, last = self.segment.grasping.dofs, min(state.row, self.model.rows) - 1
        x[:, dofs] += state.given @ step
        memory = state.memory
        for k, columns in enumerate(memory.solutions[: last + 1]):
            x[last - k, free] += columns @ step
        for k, columns in enumerate(memory.increments[: last + 1]):
            force[last - k, free] += columns @ step
        read = tuple((at + own @ step, own, seen) for at, own, seen in state.read)
        return State(state.row, x, force, state.given, memory, read)

    def _resume(self, state: State) -> None:
        self.row = state.row
        self.x, self.force, self.given = state.x.copy(), state.force.copy(), state.given.copy()
        shape = (len(self.solver.free), len(self.moving))
        self.forward = Forward(self.solver, self.setting, shape, state.memory)
        most = (2 * self.model.samples_around + LATEST + 2) * self.model.substeps + 4
        self.read: deque[Read] = deque(state.read, maxlen=most)

    @property
    def state(self) -> State:
        """What the next row depends on."""
        return State(
            self.row,
            self.x.copy(),
            self.force.copy(),
            self.given.copy(),
            self.forward.memory,
            tuple(self.read),
        )

    # Rows -------------------------------------------------------------------------------------

    def advance(self, poses: Poses, guess: Array | None = None) -> Kept:
        """Go on by a row, with the grasps there.

        Raises
        ------
        SimulationError
            Where the row cannot be solved.
        """
        t = self._make_room()
        poses = self.model.poses_of(poses)
        goal, slopes = self.model.goals(self.carried, poses)
        self.given[t, :, self.segment.nq :] = slopes
        dofs = self.segment.grasping.dofs
        given = None
        if self.segment.nuisance.moves_grasps:
            given = GivenMotion.along(self.solver, dofs, self.given)
        by_p = np.zeros((self.segment.dofs, len(self.moving)))
        if t < self.dynamics.first_row:
            self.x[t] = self._start(poses)
        else:
            step, self.x[t], self.force[t] = self._solved(t, poses, goal, guess)
            right = np.zeros((len(self.solver.free), len(self.moving)))
            if self.setting.mass_moves:
                right -= self.forward.inertia_slopes(step, self._acceleration(t, step.row))
            slopes_n = self.forward.force_slopes(step)
            by_p[self.solver.free] = self.forward.advance(step, right, slopes_n, given)
        by_p[self.held] = self.given[t, np.searchsorted(dofs, self.held)]
        kept = Kept(self.x[t].copy(), by_p.astype(np.float32))
        self.read.append((kept.x, kept.columns, self.operator @ by_p))
        self.row += 1
        return kept

    def _make_room(self) -> int:
        if self.row < self.model.rows:
            return self.row
        for each in (self.x, self.force, self.given):
            each[:-1] = each[1:]
        return self.model.rows - 1

    def _start(self, poses: Poses) -> Array:
        experiment = self.model.at_start(poses, self.phi)
        return start_state(experiment, self.setting.theta, self.newton)[0]

    def _acceleration(self, t: int, row: Row) -> Array:
        reach = min(t, self.dynamics.reach)
        return np.tensordot(row.s[: reach + 1], self.x[t - reach : t + 1][::-1], 1)

    def _solved(
        self, t: int, poses: Poses, goal: Array, guess: Array | None
    ) -> tuple[Step, Array, Array]:
        """Row t: its last linearisation, x_t, and F_t."""
        dofs = self.segment.grasping.dofs
        equations = RowEquations(self.dynamics, self.setting.theta, self.x, self.force, t)
        if guess is None:
            guess = self._guess(t) if t else self._start(poses)
        near = guess.copy()
        near[dofs] = goal
        try:
            return self._quick(t, equations, near.copy())
        except NewtonFailure:
            pass
        try:
            if t == 0:
                return self._quick(t, equations, self._start(poses))
            near = solve_row(self.newton, equations, near, self.x[t - 1], goal)
            return self._quick(t, equations, near)
        except NewtonFailure as failure:
            time_s = self.row * self.model.interval_s / self.model.substeps
            what = f"the step at row {self.row}"
            raise simulation_error(self.newton, failure, time_s, what) from failure

    def _guess(self, t: int) -> Array:
        """x_t on a cubic through the last four rows, as far as there are that many."""
        if t < 4:
            return extrapolated(self.x[:t], np.zeros(self.segment.dofs))
        return 4 * (self.x[t - 1] + self.x[t - 3]) - 6 * self.x[t - 2] - self.x[t - 4]

    def _quick(self, t: int, equations: RowEquations, x: Array) -> tuple[Step, Array, Array]:
        """Newton's method without safeguards, as long as its steps get shorter."""
        solver, row, theta = self.solver, equations.row, self.setting.theta
        pattern, free, last, step = solver.pattern, solver.free, np.inf, None
        short = LAST_STEP * self.size_m
        for _ in range(QUICK):
            if step is None or last > SAME_SLOPES * short:
                xi, nu = equations.states(x)
                at = equations.forces.linearise(xi, nu, theta)
                matrix = row.block(at.by_position[0], at.by_velocity[0], pattern)
                skew = row.skew_block(at.by_position_skew[0])
                try:
                    factor = solver.factoriser.factorise(matrix, skew)
                except np.linalg.LinAlgError as error:
                    raise NewtonFailure(x, f"the equations are singular: {error}") from error
                parts = at.force[0], at.by_position[0], at.by_velocity[0], at.by_theta[0]
                step = Step(t, row, *parts, factor, at.by_position_skew[0], nu[0])
                force = at.force[0]
            else:
                force = equations.force(x)
            newton = step.factor.solve(equations.balanced(force, x)[free])
            length = float(np.abs(newton).max(initial=0.0))
            if not length < last / 2:
                raise NewtonFailure(x, "Newton's steps do not get shorter")
            x[free] += newton
            if length <= short:
                # What the row says F_t is, after the last step: w_0 F_t + … = s_0 M x_t.
                force = force.copy()
                inertia = row.s[0] * row.mass_kg * x
                force[free] = ((inertia - equations.known) / row.w[0])[free]
                return step, x, force
            last = length
        raise NewtonFailure(x, f"Newton took more than {QUICK} iterations")

    # Markers ----------------------------------------------------------------------------------

    def linearised(self, reading: Reading) -> tuple[Array, Array]:
        """Residuals (M, 3) of what was read, NaN where missing, and their slopes (M, 3, P)."""
        model, around = self.model, self.model.samples_around
        sigma = self.segment.experiment.markers.sigma_m[:, None]
        backs = [reading.back - k * model.substeps for k in range(-around, around + 1)]
        x, columns = (np.array(part) for part in zip(*map(self._at, backs), strict=True))
        if not model.reads_plainly:
            found = model.observation.linearised(x, self.phi, columns, self.moving, self.segment.nq)
            return found[0][around] - reading.tracks_m / sigma, found[1][around]
        (nodes, places), (weights, rates) = self.reading, self.clock
        at_m = np.tensordot(weights, x, 1).reshape(-1, 3)[nodes]
        read = np.einsum("ma,mai->mi", places.weights, at_m)
        slope = np.zeros((*read.shape, model.size))
        slope[..., self.moving] = np.tensordot(weights, columns, 1).reshape(*read.shape, -1)
        if around:
            moves_m = np.tensordot(rates, x, 1).reshape(-1, 3)[nodes]
            (time,) = self.segment.nq + self.segment.nuisance.places("time")
            slope[..., time] = np.einsum("ma,mai->mi", places.weights, moves_m)
        observation = model.observation
        for m in observation.chart.estimated:
            own = self.segment.nq + observation.place_places[m]
            slope[m][:, own] = at_m[m].T @ places.slopes[m]
        return (read - reading.tracks_m) / sigma, slope / sigma[..., None]

    def _weights_in_time(self) -> tuple[Array, Array]:
        """Weights of the samples around one as the clock is off, and their slopes by its φ."""
        around, places = self.model.samples_around, self.segment.nuisance.places("time")
        if not around:
            return np.ones(1), np.zeros(1)
        at = np.arange(-around, around + 1.0)
        unit = float(self.segment.nuisance.scales[places[0]]) / self.model.interval_s
        late = unit * float(self.phi[places[0]])
        # Of a polynomial of fourth order central differences with a step of one, and half of
        # one, are exact to rounding when combined.
        wide, near = (
            (lagrange(at, late + h) - lagrange(at, late - h)) / (2 * h) for h in (1.0, 0.5)
        )
        return lagrange(at, late), unit * (4 * near - wide) / 3

    def _at(self, back: float) -> tuple[Array, Array]:
        """X and the markers' columns so many rows before the last; the start before the start."""
        nearest = round(back)
        last = len(self.read) - 1
        if abs(back - nearest) <= NEAR or not last:
            x, _, columns = self.read[min(max(last - nearest, 0), last)]
            return x, columns
        first = int(np.clip(np.floor(back) - 1, 0, max(0, last - 3)))
        rows = [first + k for k in range(min(4, last + 1))]
        weights = lagrange(np.array(rows, dtype=float), back)
        x, _, columns = zip(*(self.read[last - row] for row in rows), strict=True)
        return np.tensordot(weights, x, 1), np.tensordot(weights, columns, 1)

    def take(self, residual: Array, slope: Array) -> None:
        """Add what markers say, of those that are there."""
        self.information = self.information.with_rows(*self.rows_of(residual, slope), self.p)

    def rows_of(self, residual: Array, slope: Array) -> tuple[Array, Array]:
        """Residuals (k,) of the markers (M, 3) that are there, with the loss's weights."""
        here = np.isfinite(residual[:, 0])
        rows, slopes = residual[here].ravel(), slope[here].reshape(-1, slope.shape[2])
        if self.model.collocation.huber is None:
            return rows, slopes
        return huberised(rows, slopes, self.model.collocation.huber)


def lagrange(at: Array, wanted: float) -> Array:
    """Weights of values at points (k,) in the polynomial through them, at another."""
    weights = np.ones(len(at))
    for k, point in enumerate(at):
        for other in (*at[:k], *at[k + 1 :]):
            weights[k] *= (wanted - other) / (point - other)
    return weights
