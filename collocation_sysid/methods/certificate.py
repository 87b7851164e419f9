"""Optimality of a solution of the complete program: conditions of first and second order.

The first-order conditions (Karush, Kuhn and Tucker) are stationarity of the Lagrangian L = f + yᵀ g,
feasibility, and complementarity of bounds. The second-order condition is that the reduced Hessian
Wᵀ ∇²L W is positive definite; the columns of W, a basis of the null space of the constraints,
are the changes of all variables per change of a parameter, along the linearised constraints. If
both hold, the solution is a strict local minimum (Nocedal and Wright, Numerical Optimization,
theorem 12.6).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse.linalg as spla

from ..common.array_types import Array
from ..errors import SimulationError
from ..program.collocation import BOUND_TOLERANCE, Collocation, convert_variables
from ..program.lifted.collocation import lifted_count, with_lifted_variables
from .loss_curvature import reduced_hessian, sensitivities, tangent_directions
from .starts.initial_point import adjoint_multipliers

# Eigenvalues of the reduced Hessian below this share of the largest are rounding.
SMALLEST_CURVATURE = 1e-12


@dataclass(frozen=True)
class Certificate:
    """Conditions of optimality at a solution, in the scaling of the program."""

    # Largest violations of the conditions of first order.
    stationarity: float
    feasibility: float
    complementarity: float
    # (free parameters,): eigenvalues of the reduced Hessian, ascending; parameters at a bound are
    # not varied.
    curvatures: Array

    @property
    def flat_count(self) -> int:
        """Number of eigenvalues that are not positive."""
        return int(np.sum(self.curvatures <= SMALLEST_CURVATURE * self.curvatures.max(initial=0)))

    @property
    def is_strict_minimum(self) -> bool:
        """Whether the reduced Hessian is positive definite."""
        return self.flat_count == 0

    @property
    def sentence(self) -> str:
        """Sentence for the user."""
        count = len(self.curvatures)
        meaning = (
            "is positive definite: a strict local minimum"
            if self.is_strict_minimum
            else f"has {self.flat_count} of {count} eigenvalues that are not positive: some "
            "combination of the parameters is not determined, or the point is no minimum"
        )
        return (
            f"optimality of the complete program: stationarity {self.stationarity:.1e}, feasibility "
            f"{self.feasibility:.1e}, complementarity {self.complementarity:.1e}; the reduced "
            f"Hessian of {count} free parameter{'s' * (count != 1)} {meaning}"
        )


def certify(collocation: Collocation, z: Array, multipliers: Array) -> Certificate | None:
    """Return the conditions of optimality at variables z; None if the constraints do
    not determine the positions there.

    Parameters
    ----------
    z : (variables,) array
        Variables.
    multipliers : (constraints,) array
        Multipliers of the constraints. With lifted variables the Hessian has those of the adjoint
        equations, which include them.
    """
    program = with_lifted_variables(collocation)
    try:
        by_p = sensitivities(collocation, z)
    except SimulationError:
        return None
    of_constraints = multipliers
    if added := lifted_count(program):
        adjoint = adjoint_multipliers(program, collocation, z=z)
        if adjoint is None:
            return None
        of_constraints = adjoint[0]
    variables = convert_variables(z, collocation, target=program)
    lower, upper = program.bounds()
    distance = np.minimum(variables - lower, upper - variables)
    parameters = np.r_[: program.nq, program.phi_columns]
    is_free = distance[parameters] > BOUND_TOLERANCE
    basis = tangent_directions(collocation, by_p)[:, is_free]
    if added:
        rows = program.jacobian(variables)[-added:].tocsc()
        of_lifted = np.asarray(spla.spsolve(rows[:, -added:], -rows[:, :-added] @ basis))
        basis = np.concatenate([basis, of_lifted.reshape(added, -1)])
    reduced = reduced_hessian(program, variables, of_constraints, basis)
    curvatures = np.asarray(np.linalg.eigvalsh(reduced), dtype=float)

    slope = collocation.gradient(z) + collocation.jacobian_vjp(z, multipliers)
    complementarity = np.abs(slope[parameters] * distance[parameters])[~is_free]
    return Certificate(
        collocation.kkt_residual(z, multipliers),
        float(np.abs(collocation.constraint_values(z)).max(initial=0.0)),
        float(complementarity.max(initial=0.0)),
        curvatures,
    )
