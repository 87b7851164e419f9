"""Implicit Newmark (β = ¼, γ = ½), the reference integrator, with a step of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..experiment.experiment import Experiment
from .dynamics import external_force
from .lapack import one_blas_thread
from .newton import NewtonFailure, NewtonOptions, Solver, simulation_error
from .parameters import Theta
from .rest import start_state

Array = NDArray[np.float64]
Progress = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class _NewmarkState:
    """Positions, velocities and accelerations at one time, each (3n,)."""

    t_s: float
    x: Array
    v: Array
    a: Array


@one_blas_thread()
def newmark(
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
            state = _advance_to(experiment, solver, theta, load, state, goal)
        x[k], v[k] = state.x, state.v
        if progress:
            progress(k / (len(times) - 1))
    return x, v


def _advance_to(
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
            state = _step(experiment, solver, theta, load, state, end)
        except NewtonFailure as failure:
            step /= 2
            if step < smallest:
                raise simulation_error(solver, failure, state.t_s, "a Newmark step") from failure
    return state


def _step(
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
    if not solver.is_upright(guess):
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
