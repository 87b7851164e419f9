"""March a collocation scheme forward: trajectories that satisfy its constraints exactly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy

import numpy as np

from ..arrays import Array, Index
from ..errors import SimulationError
from ..fem.rest_shape import RestShapeError
from ..model.dynamics import Dynamics, StencilRow, weighted
from ..model.histories import AnyLeft, ahead, following
from ..recording.experiment import Experiment
from .lapack import one_blas_thread
from .near_contact import NearContact
from .newton import (
    NewtonFailure,
    NewtonOptions,
    Solver,
    Solvers,
    followed,
    simulation_error,
)
from .rest import start_state
from .stopwatch import Stopwatch

Progress = Callable[[float], None]


def march(
    experiment: Experiment,
    dynamics: Dynamics,
    options: NewtonOptions | None = None,
    progress: Progress | None = None,
) -> Array:
    """Positions (N, 3n) that satisfy the scheme's equations, one row after another.

    Raises
    ------
    SimulationError
        Naming time and element of the step that failed.
    """
    x, failure = march_on(experiment, dynamics, None, options, progress)
    if failure is not None:
        raise failure
    return x


@one_blas_thread()
def march_on(
    experiment: Experiment,
    dynamics: Dynamics,
    known: Array | None = None,
    options: NewtonOptions | None = None,
    progress: Progress | None = None,
    stopwatch: Stopwatch | None = None,
    near: Array | None = None,
) -> tuple[Array, SimulationError | None]:
    """Continue a trajectory as far as it goes.

    Parameters
    ----------
    known : (k, 3n) ndarray, optional
        The first rows; the experiment's start by default.
    near : (N, 3n) ndarray, optional
        A trajectory at other parameters: where equilibria are looked for first.

    Returns
    -------
    x : (r, 3n) ndarray
        The rows reached, `known` included; all N where nothing failed.
    failure : SimulationError or None
        Why it stopped.
    """
    if (massless := dynamics.body.massless(dynamics.theta)) is not None:
        failure = SimulationError(massless, float(dynamics.t_s[0]))
        return np.zeros((0, dynamics.body.pattern.size)) if known is None else known, failure
    if (unreachable := dynamics.body.unreachable(dynamics.theta)) is not None:
        failure = RestShapeError(unreachable)
        return np.zeros((0, dynamics.body.pattern.size)) if known is None else known, failure
    solvers = Solvers(experiment, options, stopwatch)
    held = ~np.isnan(dynamics.goals_m)
    x = np.zeros((dynamics.rows, dynamics.body.pattern.size))
    v0 = np.zeros(x.shape[1])
    if known is None:
        try:
            at_start, beside = dynamics.forces.rows(slice(1)), None if near is None else near[0]
            solver, goals_m = solvers.holding(held[0]), dynamics.goals_m[0]
            x[0], v0 = start_state(experiment, at_start, solver, beside, goals_m)
        except SimulationError as failure:
            return x[:0], failure
        known = x[:1]
    done = len(known)
    x[:done] = known
    forces = np.zeros_like(x)  # total force at every evaluation so far
    xi, nu = dynamics.evaluation_states(x)
    first, seen = dynamics.first_row, done - dynamics.first_row
    along, intervals = dynamics.histories(x[:done]), dynamics.until_next_s
    if seen > 0:
        here = slice(first, done)
        forces[here] = dynamics.forces_along(along, here).total(xi[:seen], nu[:seen])
    dynamics.without_taken(forces)
    left = tuple(history.last for history in along)
    for t in range(done, dynamics.rows):
        row = RowEquations(dynamics, x, forces, t, left)
        solver = solvers.holding(held[t])
        goal = dynamics.goals_m[t, solver.held]
        if not dynamics.static:
            guess = extrapolated(x[:t], dynamics.step_s * v0)
        elif near is None:
            guess = _carried_on(x[:t], solver.held, goal)
        else:
            guess = near[t]
        try:
            x[t] = solve_row(solver, row, guess, x[t - 1], goal)
        except NewtonFailure as failure:
            time_s = float(dynamics.t_s[t])
            static = dynamics.static
            return x[:t], simulation_error(
                solver, failure, time_s, f"the step at row {t}", static=static
            )
        forces[t] = row.force(x[t])
        forces[t, dynamics.taken[t]] = 0
        if left:
            (xi_t,), (nu_t,) = row.states(x[t])
            left = following(row.forces, left, xi_t, nu_t, intervals[t - 1])
        if progress:
            progress(t / (dynamics.rows - 1))
    return x, None


def extrapolated(x: Array, first_step: Array) -> Array:
    """The next row, extrapolated."""
    if len(x) > 2:
        return 3 * (x[-1] - x[-2]) + x[-3]
    return x[-1] + (x[-1] - x[-2] if len(x) > 1 else first_step)


def _carried_on(x: Array, held: Index, goal: Array) -> Array:
    """The next equilibrium, as far on as what is held goes on from the last two."""
    if len(x) < 2:
        return x[-1]
    before, way = x[-1, held] - x[-2, held], goal - x[-1, held]
    share = float(before @ way) / max(float(before @ before), np.finfo(float).tiny)
    return x[-1] + share * (x[-1] - x[-2])


class RowEquations:
    """Row t of the discrete equations as a function of x_t alone."""

    def __init__(
        self,
        dynamics: Dynamics,
        x: Array,
        forces: Array,
        t: int,
        left: Sequence[AnyLeft] = (),
    ) -> None:
        self.dynamics, self.row = dynamics, StencilRow.of(dynamics, t)
        self.forces = dynamics.forces.rows(slice(t, t + 1))
        if left:
            self.forces = ahead(self.forces, left, float(dynamics.until_next_s[t - 1]))
        self.forces_before = dynamics.forces.rows(slice(t - 1, t)) if dynamics.static else None
        self.rest, contacts = self.forces, []
        if not dynamics.static:
            self.rest, contacts = self.forces.without_contact()
        self.contact = NearContact(contacts, self.rest.theta, self.rest.pattern)
        row = self.row
        first, shape = max(0, t - dynamics.reach), x.shape[1:]
        past, past_forces = x[first:t][::-1], forces[first:t][::-1]
        self.xi = weighted(row.p, past, shape)
        self.nu = weighted(row.q, past, shape)
        self.known = weighted(row.w, past_forces, shape)
        self.known -= row.mass_kg * weighted(row.s, past, shape)
        self.known -= row.mass_kg * row.r * dynamics.start_velocity_m_s

    def under(self, share: float) -> RowEquations:
        """The same when a share of the change of a static load has come."""
        found = copy(self)
        if self.forces_before is not None:
            found.rest = self.forces_before.towards(self.forces, share)
        return found

    def force(self, x: Array) -> Array:
        """F_t."""
        states = self.states(x)
        rest = self.rest.total(*states)[0]
        return rest + self.contact.force(*states) if self.contact.acts else rest

    def states(self, x: Array) -> tuple[Array, Array]:
        """ξ_t and ν_t, (1, 3n) each."""
        return (self.xi + self.row.p[0] * x)[None], (self.nu + self.row.q[0] * x)[None]

    def balanced(self, force: Array, x: Array) -> Array:
        """c_t from F_t."""
        row = self.row
        return row.w[0] * force + self.known - row.s[0] * row.mass_kg * x

    def residual(self, x: Array) -> Array:
        """c_t."""
        return self.balanced(self.force(x), x)

    def linearise(self, x: Array) -> tuple[Array, Array, Array]:
        """c_t and the lower triangles of both parts of −∂c_t/∂x_t."""
        states, row = self.states(x), self.row
        at = self.rest.linearise(*states)
        matrix = row.block(at.by_position[0], at.by_velocity[0], self.rest.pattern)
        skew = row.skew_block(at.by_position_skew[0], at.by_velocity_skew[0])
        if not self.contact.acts:
            return self.balanced(at.force[0], x), matrix, skew
        force, symmetric, askew = self.contact.linearise(*states, (row.p[0], row.q[0]))
        matrix -= row.w[0] * symmetric
        if askew.size:
            skew -= row.w[0] * askew
        return self.balanced(at.force[0] + force, x), matrix, skew


def solve_row(
    solver: Solver, row: RowEquations, guess: Array, previous: Array, held: Array
) -> Array:
    """Solve one row; where Newton fails, move the grasp in ever smaller parts of its way.

    So does a static load change then. Static rows keep to the branch that is stable.
    """
    origin = previous[solver.held]

    def solve(near: Array, share: float) -> Array:
        start, step = near.copy(), row.under(share)
        # To the last digit at the end: bounds hold it there.
        goal = held if share == 1 else origin + share * (held - origin)
        if row.dynamics.static:
            return solver.newton(start, step.residual, step.linearise, True, goal)
        start[solver.held] = goal
        return solver.newton(start, step.residual, step.linearise)

    return followed(solve, previous, solver.options.halvings, guess)
