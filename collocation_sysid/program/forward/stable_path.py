"""Whether static equilibria belong to one path of stable equilibria.

From each sample the path is followed to the next one, in steps that chord iterations certify: a
step counts only if the iterates contract towards its equilibrium. Definiteness of the stiffness is
not required on the way, so that the path passes a bifurcation, beyond which Newton's method for
stable equilibria finds those of another branch. The samples leave the path where the stiffness on
it loses definiteness, or where it leads to another equilibrium than that of the sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse.linalg import ArpackError

from ...common.array_types import Array
from ...model.dynamics import Dynamics
from ...model.forces import Forces
from ...model.internal_variables import advance_states
from ...recording.experiment import Experiment
from ..linear_algebra.factorisation import Factor
from ..linear_algebra.lapack import one_blas_thread
from .initial_equilibrium import partial_displacement, static_equations
from .loss_of_stability import StabilityLoss, find_stability_loss
from .newton_solver import Linearise, NewtonFailure, NewtonSolver, NewtonSolvers, Residual
from .scheme_simulation import RowEquations, forces_and_histories

# Largest ratio of successive chord corrections; with it the error is at most the last correction.
CONTRACTION = 0.5
# Largest number of chord corrections of a step.
CORRECTIONS = 40
# Last correction over the size of the body.
ACCURACY = 1e-9
# Distance of a sample from the path, over the size of the body, from which on it is on another one.
DISTANCE = 1e-4
# Part of that way to which a loss of stability is located.
LOCATED = 1 / 16
# Shortest step, as a share of the way from sample to sample.
SHORTEST_STEP = 0.5**16
# Largest number of steps from sample to sample, each with a factorisation.
STEPS = 60

# Equations at a share of the loads between two samples, and the positions (3n,) of prescribed dofs.
Equations = Callable[[float], tuple[Residual, Linearise, Array]]


@dataclass(frozen=True, eq=False)
class BranchChange:
    """First sample that is not on the path of stable equilibria from the sample before."""

    time_s: float  # time of the sample [s]
    lost_s: float  # time up to which the path is stable, interpolated between the samples [s]
    # Mode in which the body loses its stability there; None if it is not known.
    loss: StabilityLoss | None

    def describe(self) -> str:
        """Return how the body leaves the path, for messages."""
        if self.loss is None:
            return (
                "it has another equilibrium there: add samples before, or end the recording there"
            )
        return f"at {self.lost_s:.4g} s {self.loss.describe()}"


@one_blas_thread()
def find_branch_change(experiment: Experiment, dynamics: Dynamics, x: Array) -> BranchChange | None:
    """Return the first sample of a static experiment that is not on the path of stable equilibria
    from the sample before, or from the unloaded body; None if there is none.

    None also for specimens and experiments with obstacles. Where the path cannot be
    followed, as at a limit point, nothing is known about that sample.

    Parameters
    ----------
    dynamics : Dynamics
        Its equations of motion at the parameters.
    x : (N, 3n) array
        Equilibria at the samples [m].
    """
    if experiment.specimen is not None or experiment.obstacles:
        return None
    solvers = NewtonSolvers(experiment)
    is_prescribed = ~np.isnan(dynamics.prescribed_m)
    forces, previous = forces_and_histories(dynamics, x, row_count=1)
    intervals = dynamics.intervals_to_next_s
    for t in range(len(x)):
        solver = solvers.for_prescribed(is_prescribed[t])
        time_s = float(dynamics.t_s[t])
        if t == 0:
            if not experiment.is_balanced_at_start or previous:
                continue
            origin = experiment.rigid_positions([time_s])[0].ravel()
            equations = _first_equations(experiment, dynamics, solver, goal_m=x[0])
        else:
            origin = x[t - 1]
            row = RowEquations(dynamics, x, forces=forces, t=t, previous=previous)
            equations = _row_equations(row, origin, goal_m=x[t])
            forces[t] = row.force(x[t])
            forces[t, dynamics.is_temporarily_prescribed[t]] = 0
            if previous:
                (xi_t,), (nu_t,) = row.states(x[t])
                previous = advance_states(
                    row.forces, previous, x=xi_t, v=nu_t, interval_s=intervals[t - 1]
                )
        last, share, is_known = _follow(solver, equations, origin)
        is_on_path = np.abs(last - x[t]).max() <= DISTANCE * solver.size_m
        if not is_known or (share == 1 and is_on_path):
            continue
        before_s = float(dynamics.t_s[max(t - 1, 0)])
        lost_s = before_s + share * (time_s - before_s)
        try:
            loss = find_stability_loss(experiment, dynamics.theta, x=last, time_s=lost_s)
        except (ArpackError, RuntimeError, np.linalg.LinAlgError):
            loss = None
        return BranchChange(time_s, lost_s, loss)
    return None


def _first_equations(
    experiment: Experiment, dynamics: Dynamics, solver: NewtonSolver, goal_m: Array
) -> Equations:
    """Return the equations from the body without loads, carried by grasps, to the first sample."""
    time_s = float(dynamics.t_s[0])
    forces = Forces.from_experiment(experiment, time_s, theta=dynamics.theta)
    shape = experiment.rigid_positions([time_s])[0]

    def at(share: float) -> tuple[Residual, Linearise, Array]:
        residual, linearise = static_equations(forces.at_share(share), share, free=solver.free)
        goal = (
            goal_m
            if share == 1
            else partial_displacement(experiment, shape, time_s=time_s, share=share).ravel()
        )
        return residual, linearise, goal

    return at


def _row_equations(row: RowEquations, origin_m: Array, goal_m: Array) -> Equations:
    def at(share: float) -> tuple[Residual, Linearise, Array]:
        equations = row.with_load_step(share)
        goal = goal_m if share == 1 else origin_m + share * (goal_m - origin_m)
        return equations.residual, equations.linearise, goal

    return at


def _follow(solver: NewtonSolver, equations: Equations, x: Array) -> tuple[Array, float, bool]:
    """Return the last stable equilibrium (3n,) [m], its share, and whether the path ends there."""
    share = 0.0
    longest = 1.0
    stable = None
    for _ in range(STEPS):
        at = equations(share)[1](x)
        try:
            factor = solver.factorise(at, x, keep_definite=True)
        except NewtonFailure:
            if stable is None or share - stable[1] <= LOCATED:
                return x, share, stable is not None
            longest = (share - stable[1]) / 2
            x, share = stable
            continue
        if share == 1:
            return x, share, True
        stable = x, share
        step = min(longest, 1 - share)
        while step >= SHORTEST_STEP:
            residual, _, goal = equations(share + step)
            trial = _corrected(solver, factor, residual, x, goal_m=goal, stiffness=at.symmetric)
            if trial is not None:
                break
            step /= 4
        else:
            return x, share, False
        x, share, longest = trial, min(share + step, 1.0), 2 * step
    return x, share, False


def _corrected(
    solver: NewtonSolver,
    factor: Factor,
    residual: Residual,
    x: Array,
    goal_m: Array,
    stiffness: Array,
) -> Array | None:
    """Return the equilibrium (3n,) [m] near x by chord steps, or None if they do not contract."""
    way = np.zeros_like(x)
    way[solver.is_prescribed] = (goal_m - x)[solver.is_prescribed]
    coupling = solver.pattern.products(stiffness[None], way[None])[0]
    correction = solver.step(factor, residual(x) - coupling)
    state = x + way
    if not np.abs(correction).max(initial=0.0) <= solver.size_m:
        return None
    state[solver.free] += correction
    limit = solver.size_m / CONTRACTION
    for _ in range(CORRECTIONS):
        if not solver.has_no_inverted_element(state):
            return None
        correction = solver.step(factor, residual(state))
        length = float(np.abs(correction).max(initial=0.0))
        if length <= ACCURACY * solver.size_m:
            return state
        if not length <= CONTRACTION * limit:
            return None
        limit = length
        state[solver.free] += correction
    return None
