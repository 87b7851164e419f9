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

from ..common.array_types import Array
from ..errors import SimulationError
from ..program.collocation import Collocation, convert_variables
from ..program.lifted.lifted_collocation import lifted_count
from .condensed_program import CondensedCollocation, complete_program
from .reduced_space import ReducedSpace
from .solution import Iteration, Solution, Status, constraint_multipliers
from .solve_recorder import Recorder, SearchEnded

# Longest last step of a parameter's logarithm: Newton's method converges quadratically from there.
LARGEST_CORRECTION = 1e-3
# Sweeps after which the best point so far is taken: the work of a few iterations of IPOPT.
MAX_SWEEPS = 100
# How a coarse solve may end without a point that is worth starting from.
UNUSABLE = (Status.NOT_SIMULABLE, Status.NUMERICAL_FAILURE, Status.DIVERGED)


@dataclass(frozen=True, eq=False)
class InitialPoint:
    """Initial point of IPOPT.

    Attributes
    ----------
    coarse : Solution
        Solution by reduced space; its collocation contains the measurements associated at these
        estimates.
    is_usable : bool
        Whether its variables satisfy the equations of motion to the end of the recordings.
    is_close : bool
        Whether the optimum is within about `LARGEST_CORRECTION`, so that Newton's method converges.
    note : str
        Explanation for the user how the point was computed.
    """

    coarse: Solution
    is_usable: bool
    is_close: bool
    note: str


def compute_initial_point(
    recorder: Recorder, start: Array | None, *, max_time_s: float = np.inf
) -> InitialPoint:
    """Compute an initial point by reduced space, and add every iteration to the recorder.

    Whether it can be used and whether it is near the optimum are attributes of the result; a failed
    search is no error. The collocation of the recorder is unchanged; exceptions of its `watch` are
    not caught.

    Parameters
    ----------
    recorder : Recorder
        Recorder of the solve that needs the point.
    start : (variables,) array, optional
        Initial variables of reduced space; the guess by default.
    max_time_s : float
        Time after which the search ends with `Status.TIME_LIMIT` [s].
    """

    def record(line: Iteration) -> None:
        """Record an iteration, and raise `SearchEnded` if the time is over."""
        recorder.add(line)
        if recorder.elapsed_s > max_time_s:
            raise SearchEnded(Status.TIME_LIMIT)

    method = ReducedSpace(
        tolerance=LARGEST_CORRECTION, max_iterations=MAX_SWEEPS
    )
    coarse = method(recorder.collocation, record, start)
    # Reduced space gives multipliers only where a part of the trajectory was not simulated.
    reached_end = coarse.initial_multipliers is None
    is_usable = (
        reached_end
        and coarse.status not in UNUSABLE
        and bool(np.isfinite(coarse.z).all())
    )
    is_close = is_usable and coarse.status is Status.CONVERGED
    count = coarse.iterations
    sweeps = (
        f"{count} sweep{'s' * (count != 1)} of reduced space"
        if count
        else ("the given initial values")
    )
    continuation = "IPOPT solved the complete program from there"
    if is_close:
        note = (
            f"initial point: {sweeps}, which determined the parameters to "
            f"{100 * LARGEST_CORRECTION:g} %; {continuation}"
        )
    elif is_usable:
        note = (
            f"initial point: {sweeps} ({coarse.status.value}); {continuation}"
        )
    else:
        note = f"initial point: the method reduced-space found none ({coarse.message.rstrip('.')})"
    return InitialPoint(coarse, is_usable, is_close=is_close, note=note)


@dataclass(frozen=True, eq=False)
class InitialMultipliers:
    """Initial multipliers of the program that is passed to IPOPT.

    Attributes
    ----------
    constraints : (constraints,) array
        Multipliers of the constraints.
    bounds : (variables,) array
        Multipliers of the bounds, positive at upper bounds; zero for variables without bounds.
    """

    constraints: Array
    bounds: Array


def adjoint_multipliers(
    program: Collocation, collocation: Collocation, z: Array
) -> InitialMultipliers | None:
    """Return the multipliers that make the Lagrangian stationary in all positions.

    Parameters
    ----------
    program : Collocation
        Program that is passed to IPOPT: `collocation` itself, with lifted variables, or condensed.
    collocation : Collocation
        Problem.
    z : (variables,) array
        Variables of `collocation`.

    Returns
    -------
    InitialMultipliers or None
        None if the equations of a time step are singular or a multiplier is not finite.
    """
    try:
        of_motion = constraint_multipliers(collocation, z)
    except SimulationError:
        return None
    complete = complete_program(program)
    variables = convert_variables(z, collocation, target=complete)
    constraints = np.zeros(complete.constraint_count)
    constraints[: len(of_motion)] = of_motion
    gradient = complete.gradient(variables)
    jacobian = complete.jacobian(variables)
    if added := lifted_count(complete):
        # As many rows as variables: their multipliers follow from those of all other rows.
        slope = gradient + jacobian.T @ constraints
        lifted_jacobian = jacobian[-added:, -added:].T.tocsc()
        constraints[-added:] = -spla.spsolve(lifted_jacobian, slope[-added:])
    if isinstance(program, CondensedCollocation):
        constraints = constraints[program.remaining_rows]
        variables = convert_variables(z, collocation, target=program)
        gradient = program.gradient(variables)
        jacobian = program.jacobian(variables)
    lower, upper = program.bounds()
    bounded = (lower < upper) & (np.isfinite(lower) | np.isfinite(upper))
    bounds = np.where(bounded, -(gradient + jacobian.T @ constraints), 0.0)
    multipliers = InitialMultipliers(constraints, bounds)
    return (
        multipliers
        if np.isfinite(constraints).all() and np.isfinite(bounds).all()
        else None
    )
