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
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.sparse import csgraph

from ..common.array_types import Array
from ..program.collocation import BOUND_TOLERANCE, Collocation, convert_variables
from ..program.lifted.lifted_collocation import with_lifted_variables
from .starts.initial_point import adjoint_multipliers

# Eigenvalues of the reduced Hessian below this share of the largest are rounding.
SMALLEST_CURVATURE = 1e-12
# Unknowns of time steps that are factorised together.
LARGEST_BLOCK = 1000


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
    """Return the conditions of optimality at variables z, by factorisations of groups of time steps;
    None if the constraints do not determine the positions there.

    Parameters
    ----------
    collocation : Collocation
        Problem.
    z : (variables,) array
        Variables.
    multipliers : (constraints,) array
        Multipliers of the constraints, for the first-order conditions. The Hessian has those of the
        adjoint equations, which include lifted variables.
    """
    program = with_lifted_variables(collocation)
    adjoint = adjoint_multipliers(program, collocation, z=z)
    if adjoint is None:
        return None
    variables = convert_variables(z, collocation, target=program)
    lower, upper = program.bounds()
    is_parameter = np.zeros(len(variables), dtype=bool)
    is_parameter[: program.nq] = True
    is_parameter[program.phi_columns] = True
    is_position = ~is_parameter & (lower < upper)
    jacobian = program.jacobian(variables).tocsc()
    by_position = jacobian[:, np.flatnonzero(is_position)]
    if by_position.shape[0] != by_position.shape[1]:
        return None
    distance = np.minimum(variables - lower, upper - variables)
    is_free = is_parameter & (distance > BOUND_TOLERANCE)
    try:
        solution = _solve_in_steps(by_position, jacobian[:, np.flatnonzero(is_free)].toarray())
    except RuntimeError:  # singular
        return None
    basis = np.zeros((len(variables), int(is_free.sum())))
    basis[np.flatnonzero(is_free), np.arange(basis.shape[1])] = 1.0
    basis[is_position] = -solution
    hessian = program.hessian(variables, 1.0, multipliers=adjoint[0])
    reduced = basis.T @ (hessian @ basis)
    curvatures = np.asarray(np.linalg.eigvalsh((reduced + reduced.T) / 2), dtype=float)

    slope = collocation.gradient(z) + collocation.jacobian_vjp(z, multipliers)
    of_parameters = np.concatenate([slope[: collocation.nq], slope[collocation.phi_columns]])
    distances = np.concatenate([distance[: program.nq], distance[program.phi_columns]])
    at_bound = distances <= BOUND_TOLERANCE
    complementarity = np.abs(of_parameters * distances)[at_bound]
    return Certificate(
        collocation.kkt_residual(z, multipliers),
        float(np.abs(collocation.constraint_values(z)).max(initial=0.0)),
        float(complementarity.max(initial=0.0)),
        curvatures,
    )


def _solve_in_steps(matrix: sp.csc_array, right: Array) -> Array:
    """Solve a sparse system of the equations of motion, a few blocks of its block triangular form, which
    are the time steps, at a time.
    """
    match = csgraph.maximum_bipartite_matching(matrix.tocsr(), perm_type="row")
    if (match < 0).any():
        raise RuntimeError("the matrix is structurally singular")
    by_row = matrix.tocsr()[match]
    count, step = csgraph.connected_components(by_row, connection="strong")
    rows, columns = by_row.nonzero()
    if (step[rows] < step[columns]).any():
        step = count - 1 - step  # the steps on which others depend come first
    group = (np.cumsum(np.bincount(step)) // LARGEST_BLOCK)[step]
    order = np.argsort(group, kind="stable")
    solution = np.zeros_like(right)
    for block in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
        equations = by_row[block]
        rest = right[match[block]] - equations @ solution
        solution[block] = spla.splu(equations[:, block].tocsc()).solve(rest)
    return solution
