"""The Lagrangian's curvature in the parameters, exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..nlp.collocation import Collocation
from ..nlp.stopwatch import Stopwatch
from .horizon import Point
from .multipliers import constraint_multipliers

Array = NDArray[np.float64]


def exact_curvature(
    collocation: Collocation, point: Point, stopwatch: Stopwatch | None = None
) -> Array:
    """B (nq, nq) of the Hessian 2 (SᵀS + B) of ‖r‖² in q, at a point of the whole horizon.

    With W = (I, Z) the multipliers' part Wᵀ ∇²(yᵀ g) W of the Lagrangian's reduced Hessian; one
    sweep backward for the multipliers y.

    Raises
    ------
    SimulationError
        Where a timestep's equations are singular.
    """
    projected = [x + tangent.step for x, tangent in zip(point.x, point.tangents, strict=True)]
    z = collocation.pack(point.q, projected)
    multipliers = constraint_multipliers(collocation, z, stopwatch)
    directions = np.column_stack(
        [
            collocation.pack(unit, [tangent.by_q[..., k] for tangent in point.tangents])
            for k, unit in enumerate(np.eye(len(point.q)))
        ]
    )
    hessian = collocation.hessian(z, 0.0, multipliers)
    reduced = directions.T @ (hessian @ directions) / (2 * collocation.loss_scale)
    return (reduced + reduced.T) / 2
