"""Initial point of interior point: a coarse solution of the same program by reduced space.

A step of interior point factorises the matrix of all positions and parameters, which takes as long
as dozens of sweeps of reduced space. Far from the optimum its steps also move nuisance parameters
by many prior deviations, because the equations of motion hold only at the end. So reduced space
first brings the parameters to the optimum, along motions that satisfy the equations of motion. IPOPT
solves the whole program from these positions, parameters and multipliers; where they satisfy its
conditions it factorises nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse.linalg as spla

from ...common.array_types import Array
from ...errors import SimulationError
from ...program.collocation import Collocation, convert_variables
from ...program.lifted.collocation import lifted_count
from ..condensed_program import CondensedCollocation, complete_program
from ..reduced_space import ReducedSpace
from ..solution import Iteration, Solution, Status, constraint_multipliers
from ..solve_recorder import Recorder, SearchEnded

# Longest last step of a parameter's logarithm, below the tolerance of reduced space: times the
# curvature of the loss it is the error of IPOPT's conditions.
LARGEST_CORRECTION = 1e-12
# Sweeps after which the best point so far is taken: the work of a few iterations of IPOPT.
MAX_SWEEPS = 100
# How a coarse solve may end without a point that is worth starting from.
UNUSABLE = (Status.NOT_SIMULABLE, Status.NUMERICAL_FAILURE, Status.DIVERGED)


@dataclass(frozen=True, eq=False)
class InitialPoint:
    """Initial point of IPOPT."""

    # Solution by reduced space; its collocation contains the measurements associated at these
    # estimates.
    coarse: Solution
    # Whether its variables satisfy the equations of motion to the end of the recordings.
    is_usable: bool
    # Whether it is an optimum, so that Newton's method converges.
    is_close: bool
    note: str  # explanation for the user how the point was computed


def compute_initial_point(
    recorder: Recorder, start: Array | None, *, max_time_s: float = np.inf
) -> InitialPoint:
    """Compute an initial point by reduced space, and add every iteration to the recorder.

    Whether it can be used and whether it is near the optimum are attributes of the result; a failed
    search is no error. The collocation of the recorder is unchanged; exceptions of its `watch` are
    not caught.

    Parameters
    ----------
    start : (variables,) array, optional
        Initial variables of reduced space; the guess by default.
    max_time_s : float
        Time after which the search ends with `Status.TIME_LIMIT` [s].
    """

    def record(line: Iteration) -> None:
        recorder.add(replace(line, time_s=recorder.measure_elapsed_s()))
        if recorder.measure_elapsed_s() > max_time_s:
            raise SearchEnded(Status.TIME_LIMIT)

    method = ReducedSpace(tolerance=LARGEST_CORRECTION, max_iterations=MAX_SWEEPS)
    coarse = method(recorder.collocation, record, start)
    is_usable = _reaches_end(coarse)
    is_close = is_usable and coarse.status is Status.CONVERGED
    count = coarse.iterations
    sweeps = (
        f"{count} sweep{'s' * (count != 1)} of reduced space"
        if count
        else ("the given initial values")
    )
    continuation = "from there the complete program was given to IPOPT"
    if is_usable:
        note = f"initial point: {sweeps} ({coarse.status.value}); {continuation}"
    else:
        note = f"initial point: the method reduced-space found none ({coarse.message.rstrip('.')})"
    return InitialPoint(coarse, is_usable, is_close=is_close, note=note)


def _reaches_end(solution: Solution) -> bool:
    """Return whether variables satisfy the equations of motion to the end of the recordings."""
    # Reduced space gives multipliers only where a part of the trajectory was not simulated.
    return (
        solution.initial_multipliers is None
        and solution.status not in UNUSABLE
        and bool(np.isfinite(solution.z).all())
    )


def adjoint_multipliers(
    program: Collocation, collocation: Collocation, z: Array, known: Array | None = None
) -> tuple[Array, Array] | None:
    """Return the multipliers that make the Lagrangian stationary in all positions, or those of other
    variables and of bounds that belong to known ones.

    Parameters
    ----------
    program : Collocation
        Program that is passed to IPOPT: `collocation` itself, with lifted variables, or condensed.
    z : (variables,) array
        Variables of `collocation`.
    known : (constraints,) array, optional
        Multipliers of `collocation`; by default those that follow from z.

    Returns
    -------
    ((constraints,) array, (variables,) array) or None
        Multipliers of the constraints and of the bounds, which are positive at upper bounds and
        zero for variables without bounds; None if the equations of a time step are singular or a
        multiplier is not finite.
    """
    try:
        of_motion = constraint_multipliers(collocation, z) if known is None else known
    except SimulationError:
        return None
    complete = complete_program(program)
    variables = convert_variables(z, collocation, target=complete)
    constraints = np.zeros(complete.constraint_count)
    constraints[: len(of_motion)] = of_motion
    jacobian = complete.jacobian(variables)
    slope = complete.gradient(variables) + jacobian.T @ constraints
    if added := lifted_count(complete):
        # As many rows as variables: their multipliers follow from those of all other rows.
        lifted_jacobian = jacobian[-added:, -added:].T.tocsc()
        constraints[-added:] = -spla.spsolve(lifted_jacobian, slope[-added:])
        slope += jacobian[-added:].T @ constraints[-added:]
    if isinstance(program, CondensedCollocation):
        constraints = constraints[program.remaining_rows]
        variables = convert_variables(z, collocation, target=program)
        # Constraints of eliminated positions do not depend on the remaining variables.
        slope = program.condense_gradient(variables, slope)
    bounds = _bound_multipliers(program, variables, slope)
    is_finite = np.isfinite(constraints).all() and np.isfinite(bounds).all()
    return (constraints, bounds) if is_finite else None


def _bound_multipliers(program: Collocation, variables: Array, slope: Array) -> Array:
    """Return multipliers (variables,) that balance the slope at active bounds."""
    # A bound is active if its multiplier is larger than the distance to it. Elsewhere a multiplier
    # would be an error of the complementarity, larger by the distance.
    lower, upper = program.bounds()
    distance = np.where(slope > 0, variables - lower, upper - variables)
    is_active = (lower < upper) & (np.abs(slope) > distance)
    return np.where(is_active, -slope, 0.0)
