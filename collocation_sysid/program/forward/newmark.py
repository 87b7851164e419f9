"""Implicit Newmark method (β = ¼, γ = ½, average acceleration): the reference integrator.

All forces F but local ones (`model.local_force`) are evaluated at both ends of a step. Local forces
act by their mean over the step, C(ξ, ν) at ξ = (x_0 + x_1)/2 and ν = (x_1 − x_0)/h, whose work is
the loss of their energy; forces at both ends would add energy at every impact:

    M (v_1 − v_0) = h/2 (F_0 + F_1) + h C,    x_1 − x_0 = h/2 (v_0 + v_1).

The accelerations a = M⁻¹ F of states are therefore those without local forces.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ...common.time_dependence import PARTS_OVER_TIME, at_times, over_time
from ...model.force_term import States
from ...model.forces import Forces
from ...model.internal_variables import (
    PreviousState,
    advance_states,
    insert_previous_states,
    start_states,
)
from ...recording.experiment import Experiment
from ...recording.grasp import prescribed_dofs
from ..linear_algebra.lapack import one_blas_thread
from ..observables import ReactionForces
from .condensed_steps import StepEquations
from .initial_equilibrium import initial_state
from .newton_linearisation import LaggedStress, NewtonLinearisation
from .newton_solver import (
    NewtonFailure,
    NewtonOptions,
    NewtonSolver,
    NewtonSolvers,
    simulation_error,
)
from .scheme_simulation import MOST_VALUES, next_value

# Relative difference up to which two steps have the same length.
SAME_STEP = 1e-6
# Called with the share of the work that is done, between 0 and 1.
Progress = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class _State:
    t_s: float  # time [s]
    # (3n,): positions [m], velocities [m/s] and accelerations without local forces [m/s²].
    x: Array
    v: Array
    a: Array
    # History variables after the step; empty if there are none.
    previous_histories: tuple[PreviousState, ...] = ()
    # (3n,) or None: mean of the local forces over the step that led here [N]; None if there are
    # none.
    local_n: Array | None = None
    # (k, 3n): differences of the latest positions from their guesses by position, velocity and
    # acceleration at the start of their steps [m], and the length of these steps [s].
    corrections_m: Array | None = None
    step_s: float = 0.0


@dataclass(frozen=True, eq=False)
class _Loads:
    """Forces and prescribed motion of T steps."""

    forces: Forces = field(metadata=PARTS_OVER_TIME)  # at their ends; local ones averaged
    # (3, T, p): positions [m], velocities [m/s] and accelerations [m/s²] at the ends of all dofs that
    # are prescribed at some time.
    motion: Array = field(metadata=over_time(axis=1))


@one_blas_thread()
def simulate_newmark(
    experiment: Experiment,
    theta: Array,
    steps_per_sample: int,
    options: NewtonOptions | None,
    progress: Progress | None,
    sensed: Index,
) -> tuple[Array, Array, ReactionForces]:
    """Simulate an experiment by Newmark's method.

    Parameters
    ----------
    theta : (k,) array
        Constants of the body.
    steps_per_sample : int
        Time steps between samples.
    progress : callable or None
        Called with the share of the samples done.
    sensed : (g,) array
        Dofs whose reaction forces are wanted.

    Returns
    -------
    x, v : (T, 3n) arrays
        Positions [m] and velocities [m/s] at the samples.
    reactions : ReactionForces
        Reaction forces on the sensed dofs at all steps, without derivatives.

    Raises
    ------
    SimulationError
        If a step fails even after halvings.
    """
    stepper = _Stepper(experiment, theta, options=options)
    times = experiment.t_s
    state = stepper.initial_state()
    x, v = (np.repeat(start[None], len(times), axis=0) for start in (state.x, state.v))
    step = experiment.timestep_s / steps_per_sample
    rows = (len(times) - 1) * steps_per_sample + 1
    reactions_and_positions = np.zeros((2, rows, *state.x.shape[:-1], len(sensed)))
    at_start = stepper.forces(state.t_s)
    reactions_and_positions[:, 0] = _reactions_and_positions(state, at_start, sensed)
    means_n = np.zeros_like(reactions_and_positions[0])
    if state.local_n is not None:
        means_n[0] = state.local_n[sensed]
    ends_s = times[:-1, None] + step * np.arange(1, steps_per_sample + 1)
    loads = stepper.loads(ends_s.ravel(), ends_s.ravel(), step)
    for k in range(1, len(times)):
        for j in range(1, steps_per_sample + 1):
            row = (k - 1) * steps_per_sample + j
            now = at_times(loads, slice(row - 1, row))
            state = stepper.advance(state, float(ends_s[k - 1, j - 1]), now)
            reactions_and_positions[:, row] = _reactions_and_positions(state, now.forces, sensed)
            if state.local_n is not None:
                means_n[row] = state.local_n[sensed]
        x[k] = state.x
        v[k] = state.v
        if progress:
            progress(k / (len(times) - 1))
    # Local forces at a time are the mean over the steps before and after it.
    reactions_and_positions[0, 1:-1] -= (means_n[1:-1] + means_n[2:]) / 2
    reactions_and_positions[0, [0, -1]] -= means_n[[0, -1]]
    reactions, positions = reactions_and_positions
    return x, v, ReactionForces(reactions, position_m=positions)


def _force_n(state: _State, forces: Forces) -> Array:
    """Return all forces (3n,) [N] but local ones."""
    for each in state.previous_histories:
        forces = each.insert_at_same_time(forces)
    return forces.without_local_forces().total(state.x, state.v).reshape(state.x.shape)


def _reactions_and_positions(state: _State, forces: Forces, dofs: Index) -> tuple[Array, Array]:
    """Return reactions without local ones [N] and positions [m]."""
    if not len(dofs):
        return state.x[..., dofs], state.x[..., dofs]
    reaction_n = forces.mass.inertia_at(0) * state.a - _force_n(state, forces)
    return reaction_n[..., dofs], state.x[..., dofs]


class _NewmarkEquations(StepEquations):
    """Force balance F + 2 C − M a of a step in its end positions; local forces C in its middle."""

    # `prescribed` (3, p): positions [m], velocities [m/s] and accelerations [m/s²] at the end.

    def __init__(
        self,
        state: _State,
        step_s: float,
        forces: Forces,
        prescribed_dofs: Index,
        prescribed: Array,
    ) -> None:
        rest = forces.without_local_forces()
        super().__init__(
            forces.local_forces(),
            rates=(0.5, 1 / step_s),
            local_weight=2.0,
            stress=LaggedStress(rest, self._end_states, velocity_slope=2.0 / step_s),
        )
        self.mass_kg = forces.mass.inertia_at(0)
        self._state = state
        self._step_s = step_s
        self._forces = rest
        self._prescribed_dofs = prescribed_dofs
        self._prescribed = prescribed
        # Derivative of the velocity at the end by the position at the end.
        slope = 2.0 / step_s
        self._slope = slope
        self._known_v = -slope * state.x - state.v
        self._known_a = -(slope**2) * state.x - 2 * slope * state.v - state.a

    def extrapolation(self) -> Array:
        """Return a guess (3n,) [m]: free dofs keep the acceleration, local forces their mean."""
        state = self._state
        h = self._step_s
        mass = self.mass_kg
        guess = state.x + h * state.v + 0.5 * h * h * state.a
        if state.local_n is not None:
            guess += 0.5 * h * h * state.local_n / np.where(mass > 0, mass, np.inf)
        return self.with_prescribed_positions(guess)

    def with_prescribed_positions(self, x: Array) -> Array:
        moved = x.copy()
        moved[..., self._prescribed_dofs] = self._prescribed[0]
        return moved

    def kinematics(self, x: Array) -> tuple[Array, Array]:
        v = self._slope * x + self._known_v
        a = self._slope**2 * x + self._known_a
        # Finite differences of a grasp's motion ring under this rule; its own motion does not.
        v[..., self._prescribed_dofs] = self._prescribed[1]
        a[..., self._prescribed_dofs] = self._prescribed[2]
        return v, a

    def _end_states(self, x: Array) -> tuple[Array, Array]:
        """Return positions x [m] and velocities [m/s] at the end of the step, (1, 3n) each."""
        return np.atleast_2d(x), np.atleast_2d(self.kinematics(x)[0])

    def states(self, x: Array) -> tuple[Array, Array]:
        before = self._state.x
        return (before + x)[None] / 2, (x - before)[None] / self._step_s

    def residual_without_local(self, x: Array) -> Array:
        v, a = self.kinematics(x)
        return self._forces.total(x, v).reshape(x.shape) - self.mass_kg * a

    def linearise_without_local(self, x: Array) -> NewtonLinearisation:
        v, a = self.kinematics(x)
        slope = self._slope
        at = self._forces.linearise(x, v)
        matrix = -(at.by_position + slope * at.by_velocity)
        matrix[:, self._forces.pattern.diagonal] += slope**2 * self.mass_kg
        skew = -at.by_position_skew
        if at.by_velocity_skew.size:
            skew = skew - slope * at.by_velocity_skew
        own = 0 if x.ndim == 1 else slice(None)
        return NewtonLinearisation(at.force[own] - self.mass_kg * a, matrix[own], skew=skew[own])


class _Stepper:
    """Newmark steps of one experiment."""

    def __init__(self, experiment: Experiment, theta: Array, options: NewtonOptions | None) -> None:
        self.experiment = experiment
        self.theta = theta
        self.body = experiment.body
        self.options = options or NewtonOptions()
        self.solvers = NewtonSolvers(experiment, options)
        self._prescribed_dofs = prescribed_dofs(experiment.grasps)

    def initial_state(self) -> _State:
        """Return the initial state, with accelerations in balance with the forces."""
        time_s = float(self.experiment.t_s[0])
        solver = self._solver(time_s)
        forces = self.forces(time_s)
        x, v = initial_state(self.experiment, forces, solver)
        previous_histories = start_states(forces, x, v=v, loaded_s=self.experiment.loaded_since_s)
        state = _State(time_s, x, v=v, a=np.zeros_like(x), previous_histories=previous_histories)
        if forces.has_local_forces:
            state = replace(state, local_n=self._local_n(forces, x, v))
        return self._balanced(state, time_s, dofs=solver.free)

    def advance(self, state: _State, target_s: float, loads: _Loads) -> _State:
        """Return the state at `target_s` [s] under its loads; steps that fail are halved."""
        whole = step = target_s - state.t_s
        smallest = step * 0.5**self.options.max_halvings
        state = self._after_release(state, target_s)
        while target_s - state.t_s > 0.5 * smallest:
            solver = self._solver(target_s)
            try:
                end_s = target_s if step >= target_s - state.t_s else state.t_s + step
                if step < whole:
                    loads = self.loads(
                        np.array([end_s]), np.array([target_s]), step_s=end_s - state.t_s
                    )
                state = self._step(solver, state, end_s, loads)
            except NewtonFailure as failure:
                step /= 2
                if step < smallest or self.theta.ndim > 1:
                    raise simulation_error(
                        solver, failure, time_s=state.t_s, what="a time step of the Newmark method"
                    ) from failure
        return state

    def forces(self, load_s: float) -> Forces:
        """Return the forces at `load_s`, local ones at each state."""
        return Forces.from_experiment(self.experiment, load_s, theta=self.theta)

    def _local_n(self, forces: Forces, x: Array, v: Array) -> Array:
        """Return the sum of the local forces (3n,) [N] at positions x and velocities v, (3n,)."""
        total_n = np.zeros_like(x)
        for term in forces.external_terms:
            if term.is_local:
                total_n += term.force(States(x[None], v[None], theta=self.theta))[0]
        return total_n

    def _solver(self, time_s: float) -> NewtonSolver:
        return self.solvers.for_prescribed(self.experiment.is_prescribed(time_s)[0])

    def _after_release(self, state: _State, goal_s: float) -> _State:
        """Return new accelerations at dofs released before `goal_s`."""
        before = self._solver(state.t_s)
        after = self._solver(goal_s)
        if before is after:
            return state
        return self._balanced(state, goal_s, dofs=np.setdiff1d(after.free, before.free))

    def _balanced(self, state: _State, load_s: float, dofs: NDArray[np.int64]) -> _State:
        """Return accelerations of dofs from the forces at `load_s`, without local ones."""
        acceleration = state.a.copy()
        forces = self.forces(load_s)
        force_n = _force_n(state, forces)
        acceleration[..., dofs] = (force_n / forces.mass.inertia_at(0))[..., dofs]
        return replace(state, a=acceleration)

    def _step(self, solver: NewtonSolver, state: _State, end_s: float, loads: _Loads) -> _State:
        h = end_s - state.t_s
        forces = insert_previous_states(loads.forces, state.previous_histories, interval_s=h)
        held = np.searchsorted(self._prescribed_dofs, solver.is_prescribed)
        equations = _NewmarkEquations(
            state,
            h,
            forces=forces,
            prescribed_dofs=solver.is_prescribed,
            prescribed=loads.motion[:, 0, held],
        )
        extrapolated = equations.extrapolation()
        known = state.corrections_m if abs(h - state.step_s) <= SAME_STEP * h else None
        guess = extrapolated if known is None else extrapolated + next_value(known)
        if not solver.has_no_inverted_element(guess):
            guess = equations.with_prescribed_positions(state.x)
        x = solver.solve_step(guess, equations)
        correction_m = (x - extrapolated)[None]
        if known is not None:
            correction_m = np.concatenate([known[1 - MOST_VALUES :], correction_m])
        v, a = equations.kinematics(x)
        local_n = None
        if equations.local.parts:
            mass = equations.mass_kg
            xi, nu = equations.states(x)
            local_n = self._local_n(loads.forces, xi[0], nu[0])
            # Prescribed dofs have the acceleration of the grasp.
            free = solver.free
            a[free] -= 2 * local_n[free] / np.where(mass[free] > 0, mass[free], 1.0)
        previous_histories = advance_states(
            forces, state.previous_histories, x=x, v=v, interval_s=h
        )
        return _State(
            end_s,
            x,
            v=v,
            a=a,
            previous_histories=previous_histories,
            local_n=local_n,
            corrections_m=correction_m,
            step_s=h,
        )

    def loads(self, end_s: Array, load_s: Array, step_s: float) -> _Loads:
        """Return the loads at `load_s` (T,) [s]; the motion is that at `end_s` by differences."""
        # At the ends of a grasp's time, differences are one-sided and the acceleration is zero if
        # there is no later pose.
        experiment = self.experiment
        motion = np.zeros((3, len(end_s), len(self._prescribed_dofs)))
        for grasp in experiment.grasps:
            rows = np.flatnonzero(grasp.is_active(load_s))
            if not len(rows):
                continue
            # Its poses before it holds and after it has let go do not matter.
            first = max(grasp.from_s, float(experiment.t_s[0]))
            last = min(grasp.until_s, float(experiment.t_s[-1]))
            times = np.clip(np.add.outer([-step_s, 0.0, step_s], end_s[rows]), first, last)
            positions_m = grasp.positions_at(experiment.body.nodes_m, times.ravel())
            held_m = positions_m[..., grasp.axis_indices]
            before, now, after = held_m.reshape(3, len(rows), len(grasp.prescribed_dofs))
            velocity = (after - before) / (times[2] - times[0])[:, None]
            is_central = (times[2] - times[1] > 0.5 * step_s)[:, None]
            acceleration = np.where(is_central, (after - 2 * now + before) / step_s**2, 0.0)
            dofs = np.searchsorted(self._prescribed_dofs, grasp.prescribed_dofs)
            motion[:, rows[:, None], dofs] = now, velocity, acceleration
        forces = Forces.from_experiment(experiment, load_s, theta=self.theta, step_s=step_s)
        return _Loads(forces, motion)
