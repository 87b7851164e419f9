"""Simulation with a collocation scheme, row by row: trajectories that satisfy its
constraints to solver tolerance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from ...common.array_types import Array, Index
from ...common.time_dependence import at_times, interpolate_in_time
from ...errors import SimulationError
from ...fem.rest_shape import RestShapeError
from ...model.dynamics import Dynamics, StencilRow, weighted_sum_of_past
from ...model.internal_variables import PreviousState, advance_states, insert_previous_states
from ...recording.experiment import Experiment
from ..linear_algebra.lapack import one_blas_thread
from ..stopwatch import Stopwatch
from .condensed_steps import StepEquations
from .homogeneous_equilibria import homogeneous_equilibria
from .initial_equilibrium import initial_state
from .newton_linearisation import LaggedStress, NewtonLinearisation
from .newton_solver import (
    NewtonFailure,
    NewtonOptions,
    NewtonSolver,
    NewtonSolvers,
    SolutionPath,
    simulation_error,
)

# Called with the share of the work that is done, between 0 and 1.
Progress = Callable[[float], None]


def simulate_scheme(
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
    x, failure = continue_simulation(
        experiment, dynamics, known=None, options=options, progress=progress
    )
    if failure is not None:
        raise failure
    return x


@one_blas_thread()
def continue_simulation(
    experiment: Experiment,
    dynamics: Dynamics,
    known: Array | None = None,
    options: NewtonOptions | None = None,
    progress: Progress | None = None,
    stopwatch: Stopwatch | None = None,
    approximate_solution: Array | None = None,
) -> tuple[Array, SimulationError | None]:
    """Continue a trajectory until its end or until a step fails.

    Parameters
    ----------
    experiment : Experiment
        The experiment, which states the start.
    dynamics : Dynamics
        Discrete equations of motion at the parameters.
    known : (k, 3n) array, optional
        First rows [m], at least one; by default the start of the experiment is computed.
    progress : callable, optional
        Called with the share of the rows done.
    stopwatch : Stopwatch, optional
        Accumulates the time spent.
    approximate_solution : (N, 3n) array, optional
        Trajectory at other parameters, as the first guess of equilibria; its steps are those of a
        motion where it predicted the row before better than the motion itself.

    Returns
    -------
    (r, 3n) array
        The rows computed, including `known`; all N if nothing failed, and possibly none.
    SimulationError or None
        Why the simulation stopped early; it is not raised.
    """
    x = np.zeros((dynamics.row_count, *dynamics.theta.shape[1:2], dynamics.body.pattern.size))
    failure = _body_failure(dynamics)
    if failure is not None:
        return x[:0] if known is None else known, failure
    options = options or NewtonOptions()
    if experiment.specimen is not None and not dynamics.body.has_memory:
        equilibria = homogeneous_equilibria(experiment, dynamics, options, approximate_solution)
        if equilibria is not None:
            return equilibria, None
    solvers = NewtonSolvers(experiment, options, stopwatch=stopwatch)
    is_prescribed = ~np.isnan(dynamics.prescribed_m)
    v0 = np.zeros(x.shape[1:])
    if known is None:
        guess = None if approximate_solution is None else approximate_solution[0]
        try:
            x[0], v0 = initial_state(
                experiment,
                at_times(dynamics.forces, slice(1)),
                solver=solvers.for_prescribed(is_prescribed[0]),
                guess=guess,
                prescribed_m=dynamics.prescribed_m[0],
            )
        except SimulationError as failure:
            return x[:0], failure
        known = x[:1]
    done = len(known)
    x[:done] = known
    # Total force at every evaluation so far.
    forces, previous_histories = forces_and_histories(dynamics, x, row_count=done)
    intervals = dynamics.intervals_to_next_s
    # Equilibria that depend on no history, nor on the side from which an obstacle was approached.
    is_any_order = dynamics.is_static and not previous_histories and not experiment.obstacles
    held_m = np.nan_to_num(dynamics.prescribed_m[:, is_prescribed.any(axis=0)])
    guesses: list[Array] = []
    nearest = 1  # guess that missed least at the row before
    for t in range(done, dynamics.row_count):
        solver = solvers.for_prescribed(is_prescribed[t])
        goal = dynamics.prescribed_m[t, solver.is_prescribed]
        before = _nearest(held_m[:t], held_m[t]) if is_any_order else t - 1
        row = RowEquations(
            dynamics, x, forces=forces, t=t, previous=previous_histories, before=before
        )
        if not dynamics.is_static:
            guesses = [extrapolate(x[:t], dynamics.step_s * v0)]
            if approximate_solution is not None:
                # Impacts make a motion rough, but much less its distance from a similar one.
                last = slice(max(0, t - 3), t)
                distance_m = extrapolate(x[last] - approximate_solution[last], 0.0 * v0)
                guesses += [approximate_solution[t] + distance_m]
            guess = guesses[min(nearest, len(guesses) - 1)]
        elif approximate_solution is None:
            guess = _extrapolate_static(x[: before + 1], solver.is_prescribed, goal=goal)
        else:
            # What was missed at the row before is missed here too.
            guess = approximate_solution[t] + x[before]
            guess -= approximate_solution[before]
        try:
            x[t] = solve_row(solver, row, guess=guess, previous=x[before], prescribed_m=goal)
        except NewtonFailure as failure:
            return x[:t], simulation_error(
                solver,
                failure,
                time_s=float(dynamics.t_s[t]),
                what=f"time step {t}",
                static=dynamics.is_static,
            )
        if len(guesses) > 1:
            nearest = int(np.argmin([np.abs(x[t] - each).max() for each in guesses]))
        forces[t] = row.force(x[t])
        forces[t, ..., dynamics.is_temporarily_prescribed[t]] = 0
        if previous_histories:
            (xi_t,), (nu_t,) = row.states(x[t])
            previous_histories = advance_states(
                row.forces, previous_histories, x=xi_t, v=nu_t, interval_s=intervals[t - 1]
            )
        if progress:
            progress(t / (dynamics.row_count - 1))
    return x, None


def _body_failure(dynamics: Dynamics) -> SimulationError | None:
    """Return why the body cannot be simulated at all: a node without mass, or no rest shape."""
    if dynamics.theta.ndim > 1:  # of many bodies, which have been asked one by one
        return None
    massless = dynamics.body.mass_problem(dynamics.theta)
    if massless is not None:
        return SimulationError(massless, float(dynamics.t_s[0]))
    unreachable = dynamics.body.rest_shape_failure(dynamics.theta)
    if unreachable is not None:
        return RestShapeError(unreachable)
    return None


def forces_and_histories(
    dynamics: Dynamics, x: Array, row_count: int
) -> tuple[Array, tuple[PreviousState, ...]]:
    """Return the forces at the evaluations of known rows, and the history variables after them."""
    forces = np.zeros_like(x)
    histories = dynamics.histories(x[:row_count])
    evaluations = row_count - dynamics.first_row
    if evaluations > 0:
        xi, nu = dynamics.evaluation_states(x)
        rows = slice(dynamics.first_row, row_count)
        known_forces = dynamics.forces_with_histories(histories, rows)
        forces[rows] = known_forces.total(xi[:evaluations], nu[:evaluations])
    dynamics.zero_prescribed_forces(forces.swapaxes(1, -1))
    return forces, tuple(history.extract_final_state() for history in histories)


def extrapolate(x: Array, first_step: Array) -> Array:
    """Return an extrapolation (3n,) of the next row from rows x (k, 3n); from one row, x_0 +
    `first_step` (3n,) [m].
    """
    if len(x) == 1:
        return x[0] + first_step
    return x[-1] + next_value(np.diff(x[-1 - MOST_VALUES :], axis=0))


def _nearest(before_m: Array, now_m: Array) -> int:
    """Return the row of prescribed positions (t, k) nearest to those of row t, the last of equal ones."""
    distance = np.linalg.norm(before_m - now_m, axis=1)
    return len(distance) - 1 - int(np.argmin(distance[::-1]))


def _extrapolate_static(x: Array, prescribed: Index, goal: Array) -> Array:
    """Return the last equilibrium plus the last increment, scaled by the prescribed dofs."""
    if len(x) < 2:
        return x[-1]
    before = x[-1, prescribed] - x[-2, prescribed]
    way = goal - x[-1, prescribed]
    share = float(before @ way) / max(float(before @ before), np.finfo(float).tiny)
    return x[-1] + share * (x[-1] - x[-2])


class RowEquations(StepEquations):
    """Row t of the discrete equations of motion as a function of x_t alone.

    Parameters
    ----------
    x : (N, 3n) array
        Positions [m]; rows before t are used.
    forces : (N, 3n) array
        Total forces at the evaluations before t [N].
    t : int
        Index of the row, at least 1.
    previous : sequence of PreviousState
        History variables after row t − 1; empty if there are none.
    before : int, optional
        Row from which the equilibrium of row t is sought; by default t − 1.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        x: Array,
        forces: Array,
        t: int,
        previous: Sequence[PreviousState] = (),
        before: int | None = None,
    ) -> None:
        self.dynamics = dynamics
        self.row = StencilRow.from_dynamics(dynamics, t)
        self.forces = at_times(dynamics.forces, slice(t, t + 1))
        if previous:
            self.forces = insert_previous_states(
                self.forces, previous, interval_s=float(dynamics.intervals_to_next_s[t - 1])
            )
        self.rest = self.forces.without_local_forces()
        before = t - 1 if before is None else before
        self.rest_before = (
            at_times(dynamics.forces, slice(before, before + 1)).without_local_forces()
            if dynamics.is_static
            else None
        )
        row = self.row
        super().__init__(
            self.forces.local_forces(),
            rates=(row.p[0], row.q[0]),
            local_weight=row.w[0],
            stress=LaggedStress(
                self.rest,
                self.states,
                weight=row.w[0] * row.p[0],
                velocity_slope=row.q[0] / row.p[0],
            ),
        )
        first = max(0, t - dynamics.largest_lag)
        shape = x.shape[1:]
        past = x[first:t][::-1]
        past_forces = forces[first:t][::-1]
        self.xi = weighted_sum_of_past(row.p, past, shape=shape)
        self.nu = weighted_sum_of_past(row.q, past, shape=shape)
        self.inertia = -row.mass_kg * weighted_sum_of_past(row.s, past, shape=shape)
        self.inertia -= row.mass_kg * row.r * dynamics.start_velocity_m_s
        self.known = self.inertia + weighted_sum_of_past(row.w, past_forces, shape=shape)

    def with_load_step(self, share: float) -> RowEquations:
        """Return a copy of a static row with loads between those of the previous sample (share 0)
        and its own (share 1), or of a row of a motion with this share of all forces.
        """
        if share == 1:
            return self
        scaled = copy(self)
        if self.rest_before is not None:
            scaled.rest = interpolate_in_time(self.rest_before, self.rest, share=share)
        else:
            scaled.row = replace(self.row, w=(share * self.row.w[0], *self.row.w[1:]))
            scaled.known = self.inertia + share * (self.known - self.inertia)
            scaled.local_weight = share * self.local_weight
            scaled.stress = replace(self.stress, weight=share * self.stress.weight)
        return scaled

    def without_forces(self, free: Index, previous: Array) -> Array:
        """Return x_t (3n,) [m] of a motion without forces, with the dofs that are not `free` as in
        `previous` (3n,) [m].
        """
        x = previous.copy()
        x[free] = self.inertia[free] / (self.row.s[0] * self.row.mass_kg[free])
        return x

    def force(self, x: Array) -> Array:
        """Return the force F_t (3n,) [N] at the evaluation state that follows from x_t = `x` (3n,)
        [m], with local forces.
        """
        states = self.states(x)
        rest = self.rest.total(*states).reshape(x.shape)
        return rest + self.local.force(*states) if self.local.parts else rest

    def states(self, x: Array) -> tuple[Array, Array]:
        row = self.row
        return np.atleast_2d(self.xi + row.p[0] * x), np.atleast_2d(self.nu + row.q[0] * x)

    def _residual_from(self, force: Array, x: Array) -> Array:
        """Return c_t (3n,) [N] from the force F_t (3n,) [N] and x_t (3n,) [m]."""
        row = self.row
        return row.w[0] * force + self.known - row.s[0] * row.mass_kg * x

    def residual_without_local(self, x: Array) -> Array:
        return self._residual_from(self.rest.total(*self.states(x)).reshape(x.shape), x)

    def linearise_without_local(self, x: Array) -> NewtonLinearisation:
        row = self.row
        at = self.rest.linearise(*self.states(x))
        own = 0 if x.ndim == 1 else slice(None)
        matrix = row.block(at.by_position[own], at.by_velocity[own], pattern=self.rest.pattern)
        skew = row.skew_block(at.by_position_skew[own], at.by_velocity_skew[own])
        return NewtonLinearisation(self._residual_from(at.force[own], x), matrix, skew=skew)


def solve_row(
    solver: NewtonSolver, row: RowEquations, guess: Array, previous: Array, prescribed_m: Array
) -> Array:
    """Return the solution x_t (3n,) [m] of one row; where Newton's method fails, the grasps'
    displacement is applied in smaller increments, with the change of static loads, or with all
    forces of a motion. A motion without forces is known, and the stiff stresses of a thin plate that
    moves so far that Newton's method fails are then small beside the inertia of its nodes.

    Static rows stay on the branch of stable equilibria.

    Parameters
    ----------
    solver : NewtonSolver
        Newton's method for the dofs prescribed at this time.
    guess : (3n,) array
        First guess [m].
    previous : (3n,) array
        Positions of the row before [m].
    prescribed_m : (h,) array
        Prescribed positions of the h prescribed dofs [m].

    Raises
    ------
    NewtonFailure
        If an increment fails after all halvings.
    """
    if guess.ndim > 1:
        guess[:, solver.is_prescribed] = prescribed_m
        return solver.solve_step(guess, row)
    origin = previous[solver.is_prescribed]
    is_static = row.dynamics.is_static
    first = previous if is_static else row.without_forces(solver.free, previous)
    path = SolutionPath(first, halvings=solver.options.max_halvings, guess=guess)
    while path.share < 1.0:
        start, share = path.next_guess()
        # Exact at the end, because bounds of the collocation program are.
        goal = prescribed_m if share == 1 else origin + share * (prescribed_m - origin)
        equations = row.with_load_step(share)
        try:
            if is_static:
                solution = solver.solve_equilibrium(
                    start, equations.residual, linearise=equations.linearise, prescribed_m=goal
                )
            else:
                start = start.copy()
                start[solver.is_prescribed] = goal
                solution = solver.solve_step(start, equations)
        except NewtonFailure:
            if not path.shorten():
                raise
        else:
            path.accept(solution)
    return path.x


# Number of earlier values that are used: more do not decrease the number of iterations.
MOST_VALUES = 6


def next_value(values: Array) -> Array:
    """Return an extrapolation (…) of equally spaced values (k, …), oldest first, k ≥ 1, by the
    polynomial that would have predicted the last of them best; zero if none is better than zero.

    The degree follows from the values: high for a smooth motion, low where it oscillates within
    steps or after an impact.
    """
    differences = values[-MOST_VALUES:]
    guess = np.zeros_like(differences[-1])
    while len(differences):
        latest = differences[-1]
        differences = np.diff(differences, axis=0)
        # The next difference is the error of the last prediction with the latest one.
        if len(differences) and np.linalg.norm(differences[-1]) >= np.linalg.norm(latest):
            break
        guess += latest
    return guess
