"""Forward simulation: the rest state, implicit Newmark, and any collocation scheme.

Newmark (β = ¼, γ = ½) is the reference integrator with a step of its own; stepping a collocation
scheme gives trajectories that satisfy the collocation constraints exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError, SimulationError
from ..experiment.experiment import Experiment
from .dynamics import Dynamics, external_force
from .factorisation import Factor, Factoriser
from .parameters import Parameters, Theta, as_theta

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Progress = Callable[[float], None]
Residual = Callable[[Array], Array]
Linearise = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True)
class NewtonOptions:
    """Newton's method for one implicit step or the rest state.

    Attributes
    ----------
    tolerance : float
        Length of the last Newton step over the body's size.
    iterations : int
        Iterations before a step is given up.
    backtracks : int
        Halvings of a Newton step before it is given up.
    halvings : int
        How often a time step (Newmark) or the grasp's motion in it (schemes) is halved.
    """

    tolerance: float = 1e-10
    iterations: int = 30
    backtracks: int = 25
    halvings: int = 8


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Node positions over time, and the markers they carry.

    Attributes
    ----------
    t_s : (T,)
    positions_m : (T, n, 3)
    velocities_m_s : (T, n, 3)
    markers_m : (T, M, 3)
    """

    t_s: Array
    positions_m: Array
    velocities_m_s: Array
    markers_m: Array


class _NewtonFailure(Exception):
    """Newton did not converge; carries the worst state for the message."""

    def __init__(self, x: Array, reason: str) -> None:
        self.x = x
        self.reason = reason
        super().__init__(reason)


class Solver:
    """Newton with backtracking on the free dofs of a body with given held dofs.

    Parameters
    ----------
    experiment : Experiment
        Its body and which nodes are held.
    options : NewtonOptions
    """

    def __init__(self, experiment: Experiment, options: NewtonOptions | None = None) -> None:
        self.body = experiment.body
        self.options = options or NewtonOptions()
        self.free = (3 * experiment.free_nodes[:, None] + np.arange(3)).ravel()
        self.held = (3 * experiment.held_nodes[:, None] + np.arange(3)).ravel()
        self.factoriser = Factoriser(self.body.pattern, self.free)
        self._size_m = float(np.linalg.norm(np.ptp(self.body.nodes_m, axis=0)))

    def newton(
        self,
        x: Array,
        residual: Residual,
        linearise: Linearise,
        keep_definite: bool = False,
    ) -> Array:
        """Solve residual(x) = 0 for the free dofs, starting at x (3n,).

        A step is accepted when the next one, computed with the same factor, is shorter
        (Deuflhard's natural monotonicity test), no element is inverted, and with
        `keep_definite` only while −∂r/∂x stays positive definite.

        Parameters
        ----------
        residual : x -> (3n,)
        linearise : x -> residual (3n,) and lower triangle (m,) of −∂r/∂x
        """
        x = x.copy()
        self._require_upright(x)
        tolerance = self.options.tolerance * self._size_m
        value, matrix = linearise(x)
        factor = self._factorise(matrix, x, keep_definite)
        for _ in range(self.options.iterations):
            step = factor.solve(value[self.free])
            length = float(np.linalg.norm(step, np.inf))
            if length <= tolerance:
                x[self.free] += step
                return x
            x, factor, value = self._backtrack(x, step, factor, residual, linearise, keep_definite)
        raise _NewtonFailure(x, f"Newton took more than {self.options.iterations} iterations")

    def _backtrack(
        self,
        x: Array,
        step: Array,
        factor: Factor,
        residual: Residual,
        linearise: Linearise,
        keep_definite: bool,
    ) -> tuple[Array, Factor, Array]:
        length = np.linalg.norm(step)
        share = 1.0
        for _ in range(self.options.backtracks):
            trial = x.copy()
            trial[self.free] += share * step
            if self._upright(trial):
                next_step = factor.solve(residual(trial)[self.free])
                if np.linalg.norm(next_step) <= (1 - share / 4) * length:
                    value, matrix = linearise(trial)
                    try:
                        return trial, self._factorise(matrix, trial, keep_definite), value
                    except _NewtonFailure:
                        pass
            share /= 2
        raise _NewtonFailure(x, "no step along Newton's direction makes progress")

    def _factorise(self, matrix: Array, x: Array, keep_definite: bool) -> Factor:
        try:
            factor = self.factoriser.factorise(matrix)
        except np.linalg.LinAlgError as error:
            raise _NewtonFailure(x, f"the equations are singular: {error}") from error
        if keep_definite and not factor.positive_definite:
            raise _NewtonFailure(x, "the stiffness is not positive definite")
        return factor

    def _upright(self, x: Array) -> bool:
        return bool(self.body.volume_ratios(x).min() > 0)

    def _require_upright(self, x: Array) -> None:
        if not self._upright(x):
            raise _NewtonFailure(x, "an element is inverted before the first iteration")

    def worst_element(self, x: Array) -> int:
        """The element with the smallest det F."""
        return int(self.body.volume_ratios(x)[0].min(axis=1).argmin())


def _fail(solver: Solver, failure: _NewtonFailure, time_s: float, what: str) -> SimulationError:
    element = solver.worst_element(failure.x)
    ratio = float(solver.body.volume_ratios(failure.x)[0, element].min())
    return SimulationError(
        f"{what} failed: {failure.reason}; the worst element has det F = {ratio:.3g}. "
        "Stiffer parameters, a smaller timestep or a finer mesh may help",
        time_s,
        element,
    )


def rest_state(
    experiment: Experiment,
    theta: Theta,
    time_s: float | None = None,
    start: Array | None = None,
    solver: Solver | None = None,
) -> Array:
    """Static equilibrium (3n,) under gravity and external forces, grasped nodes held.

    Starts from the undeformed shape carried by the grasp, or from `start`; where Newton fails
    the load is applied in steps.

    Raises
    ------
    SimulationError
        If no stable equilibrium is found.
    """
    solver = solver or Solver(experiment)
    t_s = np.atleast_1d(experiment.t_s[0] if time_s is None else time_s)
    body = experiment.body
    load = external_force(experiment)
    elastic = Theta(theta.lambda_pa, theta.mu_pa, 0.0, 0.0)
    still = np.zeros((1, body.pattern.size))
    x = experiment.rigid_positions(t_s).ravel() if start is None else start.copy()
    x[solver.held] = experiment.held_positions(t_s).ravel()

    def solve(x: Array, share: float) -> Array:
        def residual(state: Array) -> Array:
            return body.force(state, still, elastic)[0] + share * load

        def linearise(state: Array) -> tuple[Array, Array]:
            forces = body.linearise(state, still, elastic)
            return forces.force[0] + share * load, -forces.by_position[0]

        return solver.newton(x, residual, linearise, keep_definite=True)

    reached, increment = 0.0, 1.0
    while reached < 1.0:
        try:
            x = solve(x, min(1.0, reached + increment))
            reached = min(1.0, reached + increment)
        except _NewtonFailure as failure:
            increment /= 2
            if increment < 0.5**solver.options.halvings:
                raise _fail(solver, failure, float(t_s[0]), "finding the rest state") from failure
    return x


def start_state(experiment: Experiment, theta: Theta, solver: Solver) -> tuple[Array, Array]:
    """x_0 and v_0, each (3n,), after the experiment's start rule."""
    velocity = experiment.start_velocities_m_s
    v0 = np.zeros(experiment.body.pattern.size) if velocity is None else np.ravel(velocity).copy()
    if experiment.start == "equilibrium":
        return rest_state(experiment, theta, solver=solver), v0
    if experiment.start_positions_m is not None:
        return experiment.start_positions_m.ravel().copy(), v0
    return experiment.rigid_positions(experiment.t_s[:1]).ravel(), v0


def simulate(
    experiment: Experiment,
    parameters: Parameters | Mapping[str, float] | Sequence[float],
    integrator: str = "newmark",
    timestep_s: float | None = None,
    substeps: int = 1,
    options: NewtonOptions | None = None,
    progress: Progress | None = None,
) -> Trajectory:
    """Simulate an experiment forward from its start.

    Parameters
    ----------
    experiment : Experiment
    parameters : Parameters (their guesses), a mapping by name, or (λ, μ, γ_r, γ_m)
    integrator : str
        "newmark", or a scheme of `schemes.SCHEMES` on the collocation grid.
    timestep_s : float, optional
        Newmark's step, rounded to divide the sample interval; a quarter of it by default.
    substeps : int
        Grid steps between samples for a scheme.
    options : NewtonOptions, optional
    progress : callable, optional
        Called with the share done, between 0 and 1.

    Returns
    -------
    Trajectory at the experiment's samples

    Raises
    ------
    SimulationError
        When a step fails even after halvings; names time and element.
    """
    theta = as_theta(parameters)
    if integrator == "newmark":
        step = timestep_s or experiment.timestep_s / 4
        count = max(1, round(experiment.timestep_s / step))
        x, v = _newmark(experiment, theta, count, options, progress)
    else:
        dynamics = Dynamics.of(experiment, integrator, substeps)
        grid = march(experiment, dynamics, theta, options, progress)
        x = grid[::substeps]
        v = np.gradient(grid, dynamics.step_s, axis=0)[::substeps]
    shape = (len(x), -1, 3)
    positions = x.reshape(shape)
    markers = experiment.markers.observe(positions)
    return Trajectory(experiment.t_s, positions, v.reshape(shape), markers)


def march(
    experiment: Experiment,
    dynamics: Dynamics,
    theta: Theta,
    options: NewtonOptions | None = None,
    progress: Progress | None = None,
) -> Array:
    """Positions (N, 3n) that satisfy the scheme's equations, one row after another.

    Raises
    ------
    SimulationError
        Naming time and element of the step that failed.
    """
    solver = Solver(experiment, options)
    held = experiment.held_positions(dynamics.t_s).reshape(dynamics.rows, -1)
    x = np.zeros((dynamics.rows, dynamics.body.pattern.size))
    x[0], v0 = start_state(experiment, theta, solver)
    forces = np.zeros_like(x)  # total force at every evaluation so far
    if dynamics.first_row == 0:
        still = np.zeros_like(x[:1])
        forces[0] = dynamics.body.force(x[:1], still, theta)[0] + dynamics.external_force_n
    for t in range(1, dynamics.rows):
        row = _Row(dynamics, theta, x, forces, t)
        guess = x[t - 1] + (x[t - 1] - x[t - 2] if t > 1 else dynamics.step_s * v0)
        try:
            x[t] = _solve_row(solver, row, guess, x[t - 1], held[t])
        except _NewtonFailure as failure:
            time_s = float(dynamics.t_s[t])
            raise _fail(solver, failure, time_s, f"the step at row {t}") from failure
        forces[t] = row.force(x[t])
        if progress:
            progress(t / (dynamics.rows - 1))
    return x


class _Row:
    """Row t of the discrete equations as a function of x_t alone."""

    def __init__(self, dynamics: Dynamics, theta: Theta, x: Array, forces: Array, t: int) -> None:
        self.dynamics, self.theta = dynamics, theta
        table, step, mass = dynamics.tables, dynamics.step_s, dynamics.body.dof_mass
        past = range(1, min(dynamics.reach, t) + 1)
        zero = np.zeros(x.shape[1])
        self.p, self.q = table.p[t, 0], table.q[t, 0] / step
        self.w, self.s = table.w[t, 0], table.s[t, 0] / step**2
        self.xi = sum((table.p[t, i] * x[t - i] for i in past), zero)
        self.nu = sum((table.q[t, i] * x[t - i] for i in past), zero) / step
        self.known = sum((table.w[t, j] * forces[t - j] for j in past), zero)
        self.known -= mass * sum((table.s[t, i] * x[t - i] for i in past), zero) / step**2
        self.known -= mass * table.r[t] * dynamics.start_velocity_m_s / step

    def force(self, x: Array) -> Array:
        """F_t."""
        force = self.dynamics.body.force(*self._states(x), self.theta)[0]
        return force + self.dynamics.external_force_n

    def _states(self, x: Array) -> tuple[Array, Array]:
        return (self.xi + self.p * x)[None], (self.nu + self.q * x)[None]

    def residual(self, x: Array) -> Array:
        """c_t."""
        return self.w * self.force(x) + self.known - self.s * self.dynamics.body.dof_mass * x

    def linearise(self, x: Array) -> tuple[Array, Array]:
        """c_t and the lower triangle of −∂c_t/∂x_t."""
        body = self.dynamics.body
        at = body.linearise(*self._states(x), self.theta)
        matrix = -self.w * (self.p * at.by_position[0] + self.q * at.by_velocity[0])
        matrix[body.pattern.diagonal] += self.s * body.dof_mass
        force = at.force[0] + self.dynamics.external_force_n
        return self.w * force + self.known - self.s * body.dof_mass * x, matrix


def _solve_row(solver: Solver, row: _Row, guess: Array, previous: Array, held: Array) -> Array:
    """Solve one row; where Newton fails, move the grasp in ever smaller parts of its way."""
    try:
        start = guess.copy()
        start[solver.held] = held
        return solver.newton(start, row.residual, row.linearise)
    except _NewtonFailure:
        pass
    x, reached, increment = previous.copy(), 0.0, 1.0
    origin = previous[solver.held]
    while reached < 1.0:
        goal = min(1.0, reached + increment)
        start = x.copy()
        start[solver.held] = origin + goal * (held - origin)
        try:
            x, reached = solver.newton(start, row.residual, row.linearise), goal
        except _NewtonFailure:
            increment /= 2
            if increment < 0.5**solver.options.halvings:
                raise
    return x


@dataclass(frozen=True, eq=False)
class _NewmarkState:
    """Positions, velocities and accelerations at one time, each (3n,)."""

    t_s: float
    x: Array
    v: Array
    a: Array


def _newmark(
    experiment: Experiment,
    theta: Theta,
    steps_per_sample: int,
    options: NewtonOptions | None,
    progress: Progress | None,
) -> tuple[Array, Array]:
    """Positions and velocities (T, 3n) at the samples."""
    solver = Solver(experiment, options)
    times = experiment.t_s
    x, v = (np.zeros((len(times), solver.body.pattern.size)) for _ in range(2))
    x[0], v[0] = start_state(experiment, theta, solver)
    load = external_force(experiment)
    force = solver.body.force(x[:1], v[:1], theta)[0] + load
    acceleration = force / solver.body.dof_mass
    acceleration[solver.held] = 0.0
    state = _NewmarkState(float(times[0]), x[0], v[0], acceleration)
    step = experiment.timestep_s / steps_per_sample
    for k in range(1, len(times)):
        for j in range(1, steps_per_sample + 1):
            goal = float(times[k - 1] + j * step)
            state = _newmark_to(experiment, solver, theta, load, state, goal)
        x[k], v[k] = state.x, state.v
        if progress:
            progress(k / (len(times) - 1))
    return x, v


def _newmark_to(
    experiment: Experiment,
    solver: Solver,
    theta: Theta,
    load: Array,
    state: _NewmarkState,
    goal_s: float,
) -> _NewmarkState:
    """Advance to `goal_s`, in halves where Newton fails."""
    smallest = (goal_s - state.t_s) * 0.5**solver.options.halvings
    step = goal_s - state.t_s
    while goal_s - state.t_s > 0.5 * smallest:
        try:
            end = goal_s if step >= goal_s - state.t_s else state.t_s + step
            state = _newmark_step(experiment, solver, theta, load, state, end)
        except _NewtonFailure as failure:
            step /= 2
            if step < smallest:
                raise _fail(solver, failure, state.t_s, "a Newmark step") from failure
    return state


def _newmark_step(
    experiment: Experiment,
    solver: Solver,
    theta: Theta,
    load: Array,
    state: _NewmarkState,
    end_s: float,
) -> _NewmarkState:
    """One step of β = ¼, γ = ½ (average acceleration); held dofs follow the grasp."""
    body, h = solver.body, end_s - state.t_s
    x_held, v_held, a_held = _held_motion(experiment, end_s, h)
    slope = 2.0 / h
    known_v = -slope * state.x - state.v
    known_a = -(slope**2) * state.x - 2 * slope * state.v - state.a

    def kinematics(x: Array) -> tuple[Array, Array]:
        v, a = slope * x + known_v, slope**2 * x + known_a
        # Finite differences of a grasp's motion ring under this rule; its own motion does not.
        v[solver.held], a[solver.held] = v_held, a_held
        return v, a

    def residual(x: Array) -> Array:
        v, a = kinematics(x)
        return body.force(x, v, theta)[0] + load - body.dof_mass * a

    def linearise(x: Array) -> tuple[Array, Array]:
        v, a = kinematics(x)
        at = body.linearise(x, v, theta)
        matrix = -(at.by_position[0] + slope * at.by_velocity[0])
        matrix[body.pattern.diagonal] += slope**2 * body.dof_mass
        return at.force[0] + load - body.dof_mass * a, matrix

    guess = state.x + h * state.v + 0.5 * h * h * state.a
    guess[solver.held] = x_held
    if not solver._upright(guess):
        guess = state.x.copy()
        guess[solver.held] = x_held
    x = solver.newton(guess, residual, linearise)
    return _NewmarkState(end_s, x, *kinematics(x))


def _held_motion(experiment: Experiment, time_s: float, h: float) -> tuple[Array, Array, Array]:
    """Position, velocity and acceleration of the held dofs, by central differences."""
    times = np.clip([time_s - h, time_s, time_s + h], experiment.t_s[0], experiment.t_s[-1])
    before, now, after = experiment.held_positions(times).reshape(3, -1)
    span = times[2] - times[0]
    velocity = (after - before) / span
    if times[2] - times[1] < 0.5 * h:
        return now, velocity, np.zeros_like(now)
    return now, velocity, (after - 2 * now + before) / h**2


def with_markers(experiment: Experiment, positions_m: ArrayLike) -> Experiment:
    """The same experiment with other marker tracks (T, M, 3)."""
    tracks = np.asarray(positions_m, dtype=float)
    if tracks.shape != experiment.markers.positions_m.shape:
        raise InputError(
            f"marker tracks have shape {tracks.shape}, "
            f"expected {experiment.markers.positions_m.shape}"
        )
    return replace(experiment, markers=replace(experiment.markers, positions_m=tracks))
