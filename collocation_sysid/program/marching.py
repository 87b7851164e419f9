"""Simulation with a collocation scheme, row by row: trajectories that satisfy its
constraints to solver tolerance.
"""

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
    """Simulate all rows of a scheme.

    Parameters
    ----------
    experiment : Experiment
        The experiment, which states the start.
    dynamics : Dynamics
        Discrete equations of motion at the parameters.
    options : NewtonOptions, optional
        Options of Newton's method.
    progress : callable, optional
        Called with the share of the rows done.

    Returns
    -------
    (N, 3n) array
        Positions [m].

    Raises
    ------
    SimulationError
        If a step fails; names its time and element.
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
    """Continue a trajectory until its end or until a step fails.

    Parameters
    ----------
    experiment : Experiment
        The experiment, which states the start.
    dynamics : Dynamics
        Discrete equations of motion at the parameters.
    known : (k, 3n) array, optional
        First rows [m]; by default the start of the experiment is computed.
    options : NewtonOptions, optional
        Options of Newton's method.
    progress : callable, optional
        Called with the share of the rows done.
    stopwatch : Stopwatch, optional
        Accumulates the time spent.
    near : (N, 3n) array, optional
        Trajectory at other parameters, as the first guess of equilibria.

    Returns
    -------
    (r, 3n) array
        The rows computed, including `known`; all N if nothing failed.
    SimulationError or None
        Why the simulation stopped early.
    """
    if (massless := dynamics.body.massless(dynamics.theta)) is not None:
        failure = SimulationError(massless, float(dynamics.t_s[0]))
        return np.zeros((0, dynamics.body.pattern.size)) if known is None else known, failure
    if (unreachable := dynamics.body.unreachable(dynamics.theta)) is not None:
        failure = RestShapeError(unreachable)
        return np.zeros((0, dynamics.body.pattern.size)) if known is None else known, failure
    solvers = Solvers(experiment, options, stopwatch)
    is_prescribed = ~np.isnan(dynamics.goals_m)
    x = np.zeros((dynamics.rows, dynamics.body.pattern.size))
    v0 = np.zeros(x.shape[1])
    if known is None:
        try:
            at_start = dynamics.forces.rows(slice(1))
            start_guess = None if near is None else near[0]
            solver = solvers.holding(is_prescribed[0])
            goals_m = dynamics.goals_m[0]
            x[0], v0 = start_state(experiment, at_start, solver, start_guess, goals_m)
        except SimulationError as failure:
            return x[:0], failure
        known = x[:1]
    done = len(known)
    x[:done] = known
    forces = np.zeros_like(x)  # total force at every evaluation so far
    xi, nu = dynamics.evaluation_states(x)
    first = dynamics.first_row
    known_evaluations = done - dynamics.first_row
    histories = dynamics.histories(x[:done])
    intervals = dynamics.until_next_s
    if known_evaluations > 0:
        known_rows = slice(first, done)
        forces[known_rows] = dynamics.forces_along(histories, known_rows).total(
            xi[:known_evaluations], nu[:known_evaluations]
        )
    dynamics.without_taken(forces)
    previous_histories = tuple(history.last for history in histories)
    for t in range(done, dynamics.rows):
        row = RowEquations(dynamics, x, forces, t, previous_histories)
        solver = solvers.holding(is_prescribed[t])
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
        if previous_histories:
            (xi_t,), (nu_t,) = row.states(x[t])
            previous_histories = following(
                row.forces, previous_histories, xi_t, nu_t, intervals[t - 1]
            )
        if progress:
            progress(t / (dynamics.rows - 1))
    return x, None


def extrapolated(x: Array, first_step: Array) -> Array:
    """Return an extrapolation of the next row from rows x (k, 3n); with one row, by
    `first_step` (3n,).
    """
    if len(x) > 2:
        return 3 * (x[-1] - x[-2]) + x[-3]
    return x[-1] + (x[-1] - x[-2] if len(x) > 1 else first_step)


def _carried_on(x: Array, held: Index, goal: Array) -> Array:
    """Return an extrapolation of the next equilibrium: the last increment, scaled by that
    of the prescribed dofs.
    """
    if len(x) < 2:
        return x[-1]
    before = x[-1, held] - x[-2, held]
    way = goal - x[-1, held]
    share = float(before @ way) / max(float(before @ before), np.finfo(float).tiny)
    return x[-1] + share * (x[-1] - x[-2])


class RowEquations:
    """Row t of the discrete equations of motion as a function of x_t alone.

    Parameters
    ----------
    dynamics : Dynamics
        Equations of motion.
    x : (N, 3n) array
        Positions [m]; rows before t are used.
    forces : (N, 3n) array
        Total forces at the evaluations before t [N].
    t : int
        Index of the row.
    left : sequence
        History variables after row t − 1; empty if there are none.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        x: Array,
        forces: Array,
        t: int,
        left: Sequence[AnyLeft] = (),
    ) -> None:
        self.dynamics = dynamics
        self.row = StencilRow.of(dynamics, t)
        self.forces = dynamics.forces.rows(slice(t, t + 1))
        if left:
            self.forces = ahead(self.forces, left, float(dynamics.until_next_s[t - 1]))
        self.forces_before = dynamics.forces.rows(slice(t - 1, t)) if dynamics.static else None
        self.rest = self.forces
        contacts = []
        if not dynamics.static:
            self.rest, contacts = self.forces.without_contact()
        self.contact = NearContact(contacts, self.rest.theta, self.rest.pattern)
        row = self.row
        first = max(0, t - dynamics.reach)
        shape = x.shape[1:]
        past = x[first:t][::-1]
        past_forces = forces[first:t][::-1]
        self.xi = weighted(row.p, past, shape)
        self.nu = weighted(row.q, past, shape)
        self.known = weighted(row.w, past_forces, shape)
        self.known -= row.mass_kg * weighted(row.s, past, shape)
        self.known -= row.mass_kg * row.r * dynamics.start_velocity_m_s

    def under(self, share: float) -> RowEquations:
        """Return the row at a share of the change of a static load; other rows keep the
        full load.
        """
        scaled = copy(self)
        if self.forces_before is not None:
            scaled.rest = self.forces_before.towards(self.forces, share)
        return scaled

    def force(self, x: Array) -> Array:
        """Return the force F_t (3n,) [N]."""
        states = self.states(x)
        rest = self.rest.total(*states)[0]
        return rest + self.contact.force(*states) if self.contact.acts else rest

    def states(self, x: Array) -> tuple[Array, Array]:
        """Return ξ_t [m] and ν_t [m/s], each (1, 3n), from x_t (3n,)."""
        return (self.xi + self.row.p[0] * x)[None], (self.nu + self.row.q[0] * x)[None]

    def balanced(self, force: Array, x: Array) -> Array:
        """Return c_t (3n,) from the force F_t and x_t."""
        row = self.row
        return row.w[0] * force + self.known - row.s[0] * row.mass_kg * x

    def residual(self, x: Array) -> Array:
        """Return c_t (3n,) [N]."""
        return self.balanced(self.force(x), x)

    def linearise(self, x: Array) -> tuple[Array, Array, Array]:
        """Return c_t (3n,), and lower triangles of the symmetric and the skew part of
        −∂c_t/∂x_t.
        """
        states = self.states(x)
        row = self.row
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
    """Solve one row; where Newton's method fails, apply the grasps' displacement (and a static
    load) in smaller increments.

    Static rows stay on the branch of stable equilibria.

    Parameters
    ----------
    solver : Solver
        Newton's method for the dofs prescribed at this time.
    row : RowEquations
        The row.
    guess : (3n,) array
        First guess [m].
    previous : (3n,) array
        Positions of the row before [m].
    held : (h,) array
        Prescribed positions of the prescribed dofs [m].

    Raises
    ------
    NewtonFailure
        If an increment fails after all halvings.
    """
    origin = previous[solver.held]

    def solve(near: Array, share: float) -> Array:
        start = near.copy()
        step = row.under(share)
        # To the last digit at the end: bounds hold it there.
        goal = held if share == 1 else origin + share * (held - origin)
        if row.dynamics.static:
            return solver.newton(start, step.residual, step.linearise, True, goal)
        start[solver.held] = goal
        return solver.newton(start, step.residual, step.linearise)

    return followed(solve, previous, solver.options.halvings, guess)
