"""Equilibria of a homogeneous specimen without memory, all samples at once.

The samples do not depend on each other, and the cell has at most four free displacements, so that
Newton's method iterates on small systems of all samples together.
"""

from __future__ import annotations

import numpy as np

from ...common.array_types import Array
from ...model.dynamics import Dynamics
from ...recording.experiment import Experiment
from ...recording.homogeneous_deformation import AXES, CELL_SIZE_M
from .newton_solver import NewtonOptions

# Largest number of halvings of a step that would invert an element.
MOST_HALVINGS = 10


def homogeneous_equilibria(
    experiment: Experiment, dynamics: Dynamics, options: NewtonOptions, guess: Array | None
) -> Array | None:
    """Return the stable equilibria (N, 3n) [m] of all rows of the dynamics of a specimen without
    memory.

    None if a sample is not found: then the path of the samples before it must be followed.

    Parameters
    ----------
    guess : (N, 3n) array, optional
        Equilibria at other parameters [m]; by default those of an incompressible material.
    """
    is_prescribed = ~np.isnan(dynamics.prescribed_m)
    if (is_prescribed != is_prescribed[0]).any():
        return None
    free = np.flatnonzero(~is_prescribed[0])
    x = _incompressible(experiment, dynamics) if guess is None else guess.copy()
    x[is_prescribed] = dynamics.prescribed_m[is_prescribed]
    nu = np.zeros_like(x)
    rows, columns, source = dynamics.pattern.full
    place = np.full(dynamics.pattern.size, -1)
    place[free] = np.arange(len(free))
    kept = (place[rows] >= 0) & (place[columns] >= 0)
    matrix = np.zeros((len(x), len(free), len(free)))
    body = dynamics.body
    if body.volume_ratios(x).min() <= 0:
        return None
    size_m = float(np.linalg.norm(np.ptp(body.nodes_m, axis=0)))
    for _ in range(options.max_iterations):
        at = dynamics.forces.linearise(x, nu)
        matrix[:, place[rows[kept]], place[columns[kept]]] = -at.by_position[:, source[kept]]
        try:
            np.linalg.cholesky(matrix)
            step = np.linalg.solve(matrix, at.force[:, free, None])[..., 0]
        except np.linalg.LinAlgError:
            return None
        for _ in range(MOST_HALVINGS):
            trial = x.copy()
            trial[:, free] += step
            is_inverted = (body.volume_ratios(trial) <= 0).any(axis=(1, 2))
            if not is_inverted.any():
                break
            step[is_inverted] /= 2
        else:
            return None
        x = trial
        if not np.abs(step).max(initial=0.0) > options.tolerance * size_m:
            return x if np.isfinite(x).all() else None
    return None


def _incompressible(experiment: Experiment, dynamics: Dynamics) -> Array:
    """Return positions (N, 3n) of which the free stretches keep the volume."""
    assert experiment.specimen is not None
    nodes = len(AXES)
    corners = dynamics.prescribed_m.reshape(dynamics.row_count, -1, 3)[:, 1 : 1 + nodes]
    gradients = np.nan_to_num(corners.transpose(0, 2, 1)) / CELL_SIZE_M
    axes = [AXES.index(axis) for axis in experiment.specimen.free]
    if axes:
        gradients[:, axes, axes] = 1.0
        stretch = np.linalg.det(gradients) ** (-1 / len(axes))
        gradients[:, axes, axes] = stretch[:, None]
    points_m = dynamics.body.nodes_m
    return (points_m @ gradients.transpose(0, 2, 1)).reshape(dynamics.row_count, -1)
