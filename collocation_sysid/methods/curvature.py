"""Second derivatives of the loss that Gauss–Newton neglects.

The Hessian of ‖r‖² is 2 (SᵀS + B) with S = ∂r/∂p and B = Σ r_i ∇²r_i, which is small if the
residuals are small. If they are not, as with measurement noise, Gauss–Newton converges slowly.
`updated` approximates B from the steps by the update of Dennis, Gay and Welsch (NL2SOL, 1981),
which converges superlinearly at no cost; `exact_curvature` computes B from the Lagrangian.
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
    """Return B (np, np) after an accepted step, by the update of Dennis, Gay and Welsch.

    Parameters
    ----------
    b : (np, np) array
        B before the step.
    before : Iterate
        Iterate before the step.
    after : Iterate
        Iterate after the step, which was evaluated as a trial from `before`.
    """
    step = after.p - before.p
    change = after.fit.score - before.fit.score
    curvature_step = after.fit.score - after.crossed  # B · step
    change_along_step = float(change @ step)
    if change_along_step <= 0:
        return b
    previous_curvature = float(step @ b @ step)
    if previous_curvature != 0:  # a B that has become too large shrinks to what this step saw
        b = b * min(1.0, abs(float(step @ curvature_step) / previous_curvature))
    missing = curvature_step - b @ step
    rank_two = np.outer(missing, change) / change_along_step
    return (
        b
        + rank_two
        + rank_two.T
        - (missing @ step) / change_along_step**2 * np.outer(change, change)
    )


def with_curvature(fit: LeastSquares, b: Array) -> LeastSquares:
    """Return a least-squares problem with the normal matrix SᵀS + B instead of SᵀS.

    The problem is returned unchanged if B is zero, S is rank-deficient, or B reduces the curvature
    too much (`LARGEST_SHARE`).

    Parameters
    ----------
    fit : LeastSquares
        Residuals with slopes S.
    b : (np, np) array
        B, symmetric.
    """
    triangle = fit.slope[: len(b)]
    right = fit.residual[: len(b)]
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
    """Raise `InputError` if the problem has no exact second derivatives.

    Raises
    ------
    InputError
        For materials with memory, forces with internal variables, measured wrenches and custom
        sensors of grasp forces.
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
    """Return B (np, np) at an iterate of the complete recordings, by one backward sweep.

    B follows from the reduced Hessian Wᵀ ∇²(L + yᵀ g) W of the Lagrangian with W = (I, Z), the
    sensitivities Z and the multipliers y of the equations of motion.

    Parameters
    ----------
    collocation : Collocation
        Problem.
    point : Iterate
        Iterate of all rows; its trajectories must be in this process.
    stopwatch : Stopwatch, optional
        Stopwatch that measures the sweep.

    Raises
    ------
    SimulationError
        If the equations of a time step are singular.
    """
    projected = [each.x + each.tangent.step for each in point.trajectories]
    z = collocation.pack(point.p, projected)
    multipliers = constraint_multipliers(collocation, z, stopwatch)
    directions = np.column_stack([_direction(collocation, point, k) for k in range(len(point.p))])
    hessian = collocation.hessian(z, 1.0, multipliers)
    reduced = directions.T @ (hessian @ directions) / (2 * collocation.loss_scale)
    return (reduced + reduced.T) / 2 - point.fit.information


def _direction(collocation: Collocation, point: Iterate, k: int) -> Array:
    """Return the change of all variables per unit of parameter k (an index), along the
    equations of motion.
    """
    unit = np.eye(len(point.p))[k]
    position_changes = [
        each.tangent.by_p @ unit[segment.places[segment.moving]]
        for each, segment in zip(point.trajectories, collocation.segments, strict=True)
    ]
    return collocation.pack(unit, position_changes)
