"""The Lagrangian's curvature in the parameters, exactly."""

from __future__ import annotations

import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..program.collocation import Collocation
from ..program.stopwatch import Stopwatch
from .horizon import Point
from .multipliers import constraint_multipliers


def require_second_derivatives(collocation: Collocation) -> None:
    """Refuse what has none.

    Raises
    ------
    InputError
        For materials with memory, and what is measured of grasps.
    """
    if collocation.remembers:
        raise InputError(
            "hessian = 'exact' has no second derivatives of materials with memory (prony); "
            "expected 'gauss-newton'"
        )
    if any(len(segment.sensed_dofs) for segment in collocation.segments):
        raise InputError(
            "hessian = 'exact' has no second derivatives of measured wrenches, nor of readings of "
            "grasps; expected "
            "'gauss-newton'"
        )


def exact_curvature(
    collocation: Collocation, point: Point, stopwatch: Stopwatch | None = None
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


def _direction(collocation: Collocation, point: Point, k: int) -> Array:
    """Variables per unit of p_k along the equations of motion."""
    unit = np.eye(len(point.p))[k]
    moved = [
        each.tangent.by_p @ unit[segment.places[segment.moving]]
        for each, segment in zip(point.trajectories, collocation.segments, strict=True)
    ]
    return collocation.pack(unit, moved)
