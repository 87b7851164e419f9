"""What Gauss–Newton leaves out of the Hessian: learned from the steps taken, or exactly.

The Hessian of ‖r‖² is 2 (SᵀS + B) with B = Σ r_i ∇²r_i, which is small where the residuals are.
Where they are not, as with measurement noise, Gauss–Newton converges slowly; the update of
Dennis, Gay and Welsch (NL2SOL, 1981) makes it superlinear at no cost.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular

from ..arrays import Array
from ..errors import InputError
from ..program.collocation import Collocation
from ..program.least_squares import LeastSquares
from ..program.stopwatch import Stopwatch
from .horizon import Iterate
from .solution import constraint_multipliers

# B may not take more than this share of the curvature of SᵀS away in any direction.
LARGEST_SHARE = 0.9


def updated(b: Array, before: Iterate, after: Iterate) -> Array:
    """B (np, np) after a step from one point to another that was tried from it."""
    step = after.p - before.p
    change = after.fit.score - before.fit.score
    wanted = after.fit.score - after.crossed  # B · step
    along = float(change @ step)
    if along <= 0:
        return b
    old = float(step @ b @ step)
    if old != 0:  # a B that has become too large shrinks to what this step saw
        b = b * min(1.0, abs(float(step @ wanted) / old))
    missing = wanted - b @ step
    rank_two = np.outer(missing, change) / along
    return b + rank_two + rank_two.T - (missing @ step) / along**2 * np.outer(change, change)


def with_curvature(fit: LeastSquares, b: Array) -> LeastSquares:
    """A triangle with SᵀS + B in place of SᵀS; the same as it is where that is indefinite.

    Parameters
    ----------
    b : (np, np)
    """
    triangle, right = fit.slope[: len(b)], fit.residual[: len(b)]
    if not b.any() or np.abs(np.diag(triangle)).min() < 1e-12 * np.abs(triangle).max():
        return fit
    half = solve_triangular(triangle, b, trans=1)
    relative = solve_triangular(triangle, half.T, trans=1)
    relative = (relative + relative.T) / 2
    if np.linalg.eigvalsh(relative)[0] < -LARGEST_SHARE:
        return fit
    factor = np.linalg.cholesky(np.eye(len(b)) + relative)
    right = solve_triangular(factor, right, lower=True)
    return LeastSquares(np.column_stack([factor.T @ triangle, right]))


def require_second_derivatives(collocation: Collocation) -> None:
    """Refuse what has none.

    Raises
    ------
    InputError
        For what is carried, such as by materials with memory, and what is measured of grasps.
    """
    if collocation.remembers:
        raise InputError(
            "hessian = 'exact' has no second derivatives of materials with memory (prony), nor of "
            "forces that carry something; expected 'gauss-newton'"
        )
    if any(len(segment.sensed_dofs) for segment in collocation.segments):
        raise InputError(
            "hessian = 'exact' has no second derivatives of measured wrenches, nor of readings of "
            "grasps; expected "
            "'gauss-newton'"
        )


def exact_curvature(
    collocation: Collocation, point: Iterate, stopwatch: Stopwatch | None = None
) -> Array:
    """B (np, np) of the Hessian 2 (SᵀS + B) of the loss in p, at a point of the whole horizon.

    From the reduced Hessian Wᵀ ∇²(L + yᵀ g) W of the Lagrangian with W = (I, Z); one sweep
    backward for the multipliers y.

    Raises
    ------
    SimulationError
        Where a timestep's equations are singular.
    """
    projected = [each.x + each.tangent.step for each in point.trajectories]
    z = collocation.pack(point.p, projected)
    multipliers = constraint_multipliers(collocation, z, stopwatch)
    directions = np.column_stack([_direction(collocation, point, k) for k in range(len(point.p))])
    hessian = collocation.hessian(z, 1.0, multipliers)
    reduced = directions.T @ (hessian @ directions) / (2 * collocation.loss_scale)
    return (reduced + reduced.T) / 2 - point.fit.information


def _direction(collocation: Collocation, point: Iterate, k: int) -> Array:
    """Variables per unit of p_k along the equations of motion."""
    unit = np.eye(len(point.p))[k]
    moved = [
        each.tangent.by_p @ unit[segment.places[segment.moving]]
        for each, segment in zip(point.trajectories, collocation.segments, strict=True)
    ]
    return collocation.pack(unit, moved)
