"""Initial point of interior point: a coarse solution of the same program by reduced space.

A step of interior point factorises the matrix of all positions and parameters, which takes as long
as dozens of sweeps of reduced space. Far from the optimum its steps also move nuisance parameters
by many prior deviations, because the equations of motion hold only at the end. So reduced space
first brings the parameters near the optimum, along motions that satisfy the equations of motion.
IPOPT then solves the whole program from these positions, parameters and multipliers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse.linalg as spla

from ..arrays import Array
from ..errors import SimulationError
from ..program.collocation import Collocation, carried_over
from .condensed import Condensed
from .recorder import Ended, Recorder
from .reduced_space import ReducedSpace
from .solution import Iteration, Solution, Status, constraint_multipliers

# Longest last step of a parameter's logarithm: Newton's method converges quadratically from there.
NEAR = 1e-3
# Sweeps after which the best point so far is taken: the work of a few iterations of IPOPT.
MAX_SWEEPS = 100
# How a coarse solve may end without a point that is worth starting from.
UNUSABLE = (Status.NOT_SIMULABLE, Status.NUMERICAL_FAILURE, Status.DIVERGED)


@dataclass(frozen=True, eq=False)
class InitialPoint:
    """Where interior point starts.

    Attributes
    ----------
    coarse : Solution
        The solution by reduced space; its collocation is the problem read at these estimates.
    is_usable : bool
        Whether its variables satisfy the equations of motion to the end of the recordings.
    is_near : bool
        Whether the optimum is within about `NEAR`, so that Newton's method converges.
    note : str
        How the point was found, for people.
    """

    coarse: Solution
    is_usable: bool
    is_near: bool
    note: str


def coarse_solution(
    recorder: Recorder, start: Array | None, *, max_time_s: float = np.inf
) -> InitialPoint:
    """Search for an initial point by reduced space, from the start given or the guess.

    Every line of the search is added to the recorder.

    Parameters
    ----------
    recorder : Recorder
        Of the solve that needs the point.
    start : (variables,) ndarray, optional
    max_time_s : float
        Time after which the search ends with `Status.TIME_LIMIT` [s].
    """

    def follow(line: Iteration) -> None:
        recorder.add(line)
        if recorder.elapsed_s > max_time_s:
            raise Ended(Status.TIME_LIMIT)

    method = ReducedSpace(tolerance=NEAR, max_iterations=MAX_SWEEPS)
    coarse = method(recorder.collocation, follow, start)
    # Reduced space gives multipliers only where a part of the trajectory was not simulated.
    reached_end = coarse.given_multipliers is None
    is_usable = reached_end and coarse.status not in UNUSABLE and bool(np.isfinite(coarse.z).all())
    is_near = is_usable and coarse.status is Status.CONVERGED
    count = coarse.iterations
    sweeps = f"{count} sweep{'s' * (count != 1)} of reduced space" if count else "the start given"
    then = "IPOPT solved the whole program from there"
    if is_near:
        note = f"initial point: {sweeps}, to within {100 * NEAR:g} % of a parameter; {then}"
    elif is_usable:
        note = f"initial point: {sweeps} ({coarse.status.value}); {then}"
    else:
        note = f"initial point: reduced space found none ({coarse.message.rstrip('.')})"
    return InitialPoint(coarse, is_usable, is_near, note)


@dataclass(frozen=True, eq=False)
class Multipliers:
    """Initial multipliers of a program as IPOPT gets it.

    Attributes
    ----------
    constraints : (constraints,) ndarray
    bounds : (variables,) ndarray
        Of the bounds of the variables, positive at upper bounds; zero without bounds.
    """

    constraints: Array
    bounds: Array


def adjoint_multipliers(
    program: Collocation, collocation: Collocation, z: Array
) -> Multipliers | None:
    """Return the multipliers that make the Lagrangian stationary in all positions.

    Parameters
    ----------
    program : Collocation
        The program as IPOPT gets it: `collocation` itself, or explicit, or condensed.
    collocation : Collocation
    z : (variables,) ndarray
        Variables of `collocation`.

    Returns
    -------
    Multipliers or None
        None where a timestep's equations are singular.
    """
    try:
        of_motion = constraint_multipliers(collocation, z)
    except SimulationError:
        return None
    whole = program.whole if isinstance(program, Condensed) else program
    at = carried_over(z, collocation, whole)
    constraints = np.zeros(whole.constraints)
    constraints[: len(of_motion)] = of_motion
    gradient, jacobian = whole.gradient(at), whole.jacobian(at)
    if added := whole.added():
        # As many rows as variables: their multipliers follow from those of all other rows.
        slope = gradient + jacobian.T @ constraints
        own = jacobian[-added:, -added:].T.tocsc()
        constraints[-added:] = -spla.spsolve(own, slope[-added:])
    if isinstance(program, Condensed):
        constraints = constraints[program.kept_rows]
        at = carried_over(z, collocation, program)
        gradient, jacobian = program.gradient(at), program.jacobian(at)
    lower, upper = program.bounds()
    bounded = (lower < upper) & (np.isfinite(lower) | np.isfinite(upper))
    bounds = np.where(bounded, -(gradient + jacobian.T @ constraints), 0.0)
    found = Multipliers(constraints, bounds)
    return found if np.isfinite(constraints).all() and np.isfinite(bounds).all() else None
