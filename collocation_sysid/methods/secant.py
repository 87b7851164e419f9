"""What Gauss–Newton leaves out of the Hessian, learned from the steps taken.

The Hessian of ‖r‖² is 2 (SᵀS + B) with B = Σ r_i ∇²r_i, which is small where the residuals are.
Where they are not, as with measurement noise, Gauss–Newton converges slowly; the update of
Dennis, Gay and Welsch (NL2SOL, 1981) makes it superlinear at no cost.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular

from ..arrays import Array
from ..program.least_squares import LeastSquares
from .horizon import Point

# B may not take more than this share of the curvature of SᵀS away in any direction.
LARGEST_SHARE = 0.9


def updated(b: Array, before: Point, after: Point) -> Array:
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
