"""Multipliers of the equations of motion, from one sweep backward in time."""

from __future__ import annotations

import numpy as np

from ..arrays import Array
from ..nlp.collocation import Collocation
from ..nlp.stopwatch import Stopwatch
from ..nlp.tangent import BlockSolver


def constraint_multipliers(
    collocation: Collocation, z: Array, stopwatch: Stopwatch | None = None
) -> Array:
    """Multipliers (constraints,) that make the Lagrangian stationary in the positions.

    From c_xᵀ y = −∂L/∂x, in the scaling of the NLP.

    Raises
    ------
    SimulationError
        Where a timestep's equations are singular.
    """
    q, positions = collocation.unpack(z)
    parts = []
    own = collocation.unpack_own(z)
    for segment, x, phi in zip(collocation.segments, positions, own, strict=True):
        gradient = collocation.loss_scale * segment.observation.gradient(x, phi)[0]
        y = BlockSolver(segment, stopwatch=stopwatch).backward(
            x, segment.constants.theta(q), gradient
        )
        y *= segment.force_n
        parts.append(y[segment.dynamics.first_row :, segment.row_dofs].ravel())
    multipliers = np.concatenate(parts)
    if any(s.explicit_grasps or s.dynamics.taken is not None for s in collocation.segments):
        _add_grasps(collocation, z, multipliers)
    return multipliers


def _add_grasps(collocation: Collocation, z: Array, multipliers: Array) -> None:
    """Give the grasp rows, which are unit rows, what is left of the gradient."""
    slope = collocation.gradient(z) + collocation.jacobian(z).T @ multipliers
    _, left = collocation.unpack(slope)
    start = 0
    for segment, rest in zip(collocation.segments, left, strict=True):
        stop = start + segment.constraints
        grasped = np.zeros((segment.grid_rows, segment.dofs), dtype=bool)
        grasped[:, segment.held_dofs] = segment.explicit_grasps
        if segment.dynamics.taken is not None:
            grasped |= segment.dynamics.taken
        first = segment.dynamics.first_row
        grasped, rest = grasped[first:, segment.row_dofs], rest[first:, segment.row_dofs]
        rows = multipliers[start:stop].reshape(segment.constraint_times, -1)
        rows[grasped] = -rest[grasped] / segment.length_m
        start = stop
