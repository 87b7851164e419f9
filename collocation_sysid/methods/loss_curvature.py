"""Second derivatives of the loss that Gauss–Newton neglects.

The Hessian of ‖r‖² is 2 (SᵀS + B) with S = ∂r/∂p and B = Σ r_i ∇²r_i, which is small if the
residuals are small. If they are not, as with measurement noise, Gauss–Newton converges slowly.
`secant_update` approximates B from the steps by the update of Dennis, Gay and Welsch (NL2SOL,
1981), which converges superlinearly at no cost; `exact_curvature` computes B from the Lagrangian.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
from scipy.linalg import solve_triangular

from ..common.array_types import Array
from ..errors import InputError
from ..program.collocation import Collocation
from ..program.least_squares import SquareRootInformation
from ..program.stopwatch import Stopwatch
from ..program.sweep import Sweep
from .horizon import Iterate
from .solution import constraint_multipliers


def secant_update(curvature: Array, previous: Iterate, after: Iterate) -> Array:
    """Return B (np, np) after an accepted step, by the update of Dennis, Gay and Welsch; the given
    array itself if the score does not increase along the step.

    B is what Gauss–Newton neglects: the Hessian of the loss is 2 (SᵀS + B). The given array is not
    modified.

    Parameters
    ----------
    curvature : (np, np) array
        B before the step.
    previous : Iterate
        Iterate before the step.
    after : Iterate
        Iterate after the step, which was evaluated as a trial from `previous`.
    """
    step = after.p - previous.p
    change = after.fit.score - previous.fit.score
    curvature_step = after.fit.score - after.previous_slopes_residual  # B · step
    change_dot_step = float(change @ step)
    if change_dot_step <= 0:
        return curvature
    previous_curvature = float(step @ curvature @ step)
    if previous_curvature != 0:  # scale down a B that exceeds the curvature along this step
        curvature = curvature * min(1.0, abs(float(step @ curvature_step) / previous_curvature))
    missing = curvature_step - curvature @ step
    rank_two = np.outer(missing, change) / change_dot_step
    return (
        curvature
        + rank_two
        + rank_two.T
        - (missing @ step) / change_dot_step**2 * np.outer(change, change)
    )


def with_curvature(fit: SquareRootInformation, curvature: Array) -> SquareRootInformation:
    """Return a least-squares problem with the normal matrix SᵀS + B instead of SᵀS.

    The gradient at zero is unchanged, so the minimiser is that of the model with B. Only np rows
    are kept, without the part of the residual that no step can reduce: losses of the result differ
    from the model's by a constant.

    The problem is returned unchanged if B is zero, S is rank-deficient, or their sum is not positive
    definite.

    Parameters
    ----------
    fit : SquareRootInformation
        Residuals with slopes S, in np parameters; not modified.
    curvature : (np, np) array
        B, symmetric and finite.
    """
    triangle = fit.jacobian[: len(curvature)]
    right = fit.residual[: len(curvature)]
    if not curvature.any() or np.abs(np.diag(triangle)).min() < 1e-12 * np.abs(triangle).max():
        return fit
    half = solve_triangular(triangle, curvature, trans=1)
    relative = solve_triangular(triangle, half.T, trans=1)
    relative = (relative + relative.T) / 2
    try:
        factor = np.linalg.cholesky(np.eye(len(curvature)) + relative)
    except np.linalg.LinAlgError:
        return fit
    right = solve_triangular(factor, right, lower=True)
    return SquareRootInformation(np.column_stack([factor.T @ triangle, right]))


def require_second_derivatives(collocation: Collocation) -> None:
    """Do nothing, or raise an `InputError` if the problem has no exact second derivatives: for
    materials with memory, forces with internal variables, measured forces and custom sensors of
    grasp forces.
    """
    if collocation.has_eliminated_histories:
        raise InputError(
            "hessian = 'exact' is not available for materials with memory (prony) and forces "
            "with internal variables; expected 'gauss-newton'"
        )
    if any(len(transcription.sensed_dofs) for transcription in collocation.transcriptions):
        raise InputError(
            "hessian = 'exact' is not available for measured forces and readings of grasps; "
            "expected 'gauss-newton'"
        )


def exact_curvature(
    collocation: Collocation, iterate: Iterate, stopwatch: Stopwatch | None = None
) -> Array:
    """Return B (np, np), symmetric, at an iterate of the complete recordings, by one backward
    sweep.

    B is what Gauss–Newton neglects of the Hessian, see `secant_update`. It follows from the reduced
    Hessian Wᵀ ∇²(L + yᵀ g) W of the Lagrangian with W = (I, Z), the sensitivities Z and the
    multipliers y of the equations of motion.

    Parameters
    ----------
    collocation : Collocation
        Problem with second derivatives, which is not checked, see `require_second_derivatives`.
    iterate : Iterate
        Iterate of all rows; its trajectories must be in this process.

    Raises
    ------
    SimulationError
        If the equations of a time step are singular.
    """
    projected = [each.x + each.step for each in iterate.trajectories]
    z = collocation.pack(iterate.p, projected)
    multipliers = constraint_multipliers(collocation, z, stopwatch=stopwatch)
    directions = tangent_directions(collocation, [each.by_p for each in iterate.trajectories])
    reduced = reduced_hessian(collocation, z, multipliers, directions)
    return reduced / (2 * collocation.loss_scale) - iterate.fit.information


def reduced_hessian(
    collocation: Collocation, z: Array, multipliers: Array, directions: Array
) -> Array:
    """Return Wᵀ ∇²(L + yᵀ g) W (c, c), symmetric, for multipliers y and c `directions` W."""
    indptr, indices = collocation.hessian_structure
    values = collocation.hessian_values(z, 1.0, multipliers=multipliers)
    upper = sp.csc_array((values, indices, indptr), shape=(len(z), len(z)))
    half = directions.T @ (upper @ directions)
    return half + half.T - directions.T @ (upper.diagonal()[:, None] * directions)


def tangent_directions(collocation: Collocation, by_p: Sequence[Array]) -> Array:
    """Return the changes (variables, np) of all variables, without lifted ones, per unit of each
    parameter along the linearised equations of motion, from the `sensitivities` of the positions.
    """
    moving = [s.parameter_indices[s.dynamic_parameters] for s in collocation.transcriptions]
    # The first column, of zeros, is there also where nothing is estimated.
    units = np.eye(collocation.nq + collocation.nphi + 1)[:, 1:]
    return np.column_stack(
        [
            Collocation.pack(
                collocation,
                unit,
                [each @ unit[own] for each, own in zip(by_p, moving, strict=True)],
            )
            for unit in units
        ]
    )[:, 1:]


def sensitivities(collocation: Collocation, z: Array) -> list[Array]:
    """Return the sensitivities dx/dp of each experiment at z, (N, 3n, m) [m per unit of p].

    The m parameters p are q and those φ of the experiment that change its motion, in the order of
    `Transcription.dynamic_parameters`. Prescribed dofs have zeros, and so has x_0 unless it follows
    as an equilibrium.

    Parameters
    ----------
    z : (variables,) array
        Variables that satisfy the equations of motion.

    Returns
    -------
    list of (N, 3n, m) arrays
        Sensitivities at the N grid times of each experiment.

    Raises
    ------
    SimulationError
        If the equations of a step are singular.
    """
    return [
        np.stack(list(Sweep(part.transcription).sensitivities(part.x, part.equations)))
        for part in collocation.iterates(z)
    ]
