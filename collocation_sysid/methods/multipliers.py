"""Multipliers of the equations of motion, from one sweep backward in time."""

from __future__ import annotations

import numpy as np

from ..arrays import Array
from ..fem.kernels import side_by_side
from ..program.collocation import Collocation, Part
from ..program.stopwatch import Stopwatch
from ..program.sweep import Sweep


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

    def of(part: Part) -> Array:
        segment = part.segment
        gradient = collocation.loss_scale * part.gradient()[0]
        solver = Sweep(segment, stopwatch=stopwatch)
        y = segment.force_n * solver.backward(part.x, part.setting, gradient)
        return segment.of_rows(y)

    found = side_by_side(of, collocation.parts(z), collocation.threads)
    multipliers = np.concatenate(found)
    if any(segment.grasp_rows.any() for segment in collocation.segments):
        _add_grasps(collocation, z, multipliers)
    return multipliers


def _add_grasps(collocation: Collocation, z: Array, multipliers: Array) -> None:
    """Give the grasp rows, which are unit rows, what is left of the gradient."""
    slope = collocation.gradient(z) + collocation.pulled_back(z, multipliers)
    for part in collocation.parts(slope):
        segment, grasped = part.segment, part.segment.grasp_rows
        multipliers[segment.rows][grasped] = -segment.of_rows(part.x)[grasped] / segment.length_m
