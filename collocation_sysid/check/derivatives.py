"""Derivatives at the guess against differences, on the first samples of every experiment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..experiment.experiment import Experiment
from ..nlp.collocation import Collocation
from ..problem import Problem

# All kinds of rows are among these samples; derivatives do not depend on how many follow.
SAMPLES = 12
STEP = 1e-5


def shortened(problem: Problem, samples: int) -> Problem:
    """The same problem with the first samples of every experiment only."""
    return replace(
        problem, experiments=tuple(first_samples(e, samples) for e in problem.experiments)
    )


def first_samples(experiment: Experiment, samples: int) -> Experiment:
    """The same experiment with its first samples only."""
    markers, here = experiment.markers, slice(samples)
    tracks = markers.positions_m[here]
    if not np.isfinite(tracks).any():
        tracks = np.nan_to_num(tracks)  # at least one sample has to be there
    markers = replace(markers, t_s=markers.t_s[here], positions_m=tracks)
    return replace(experiment, t_s=experiment.t_s[here], markers=markers)


def derivative_errors(collocation: Collocation, z: Array) -> tuple[float, float]:
    """Largest relative deviations of J and H along a random direction at a disturbed start."""
    rng = np.random.default_rng(0)
    if collocation.remembers:
        return _first_derivatives_error(collocation, z, rng), 0.0
    point = z + 1e-3 * rng.normal(size=len(z))
    direction = rng.normal(size=len(z))
    multipliers = rng.normal(size=collocation.constraints)

    def lagrangian_gradient(at: Array) -> Array:
        return collocation.gradient(at) + collocation.jacobian(at).T @ multipliers

    hessian = collocation.hessian(point, 1.0, multipliers)
    return (
        _deviation(
            collocation.constraint_values, collocation.jacobian(point) @ direction, point, direction
        ),
        _deviation(lagrangian_gradient, hessian @ direction, point, direction),
    )


def _first_derivatives_error(collocation: Collocation, z: Array, rng: np.random.Generator) -> float:
    """That of Jᵀ alone, which is all that methods for bodies with memory use."""
    point, direction = z + 1e-3 * rng.normal(size=len(z)), rng.normal(size=len(z))
    multipliers = rng.normal(size=collocation.constraints)
    exact = collocation.pulled_back(point, multipliers) @ direction

    def lagrangian(at: Array) -> Array:
        return np.array([multipliers @ collocation.constraint_values(at)])

    return _deviation(lagrangian, np.array([exact]), point, direction)


def _deviation(function, exact: Array, point: Array, direction: Array) -> float:
    ahead, behind, far_ahead, far_behind = (
        function(point + k * STEP * direction) for k in (1, -1, 2, -2)
    )
    differences = (8 * (ahead - behind) - (far_ahead - far_behind)) / (12 * STEP)
    return float(np.abs(differences - exact).max() / np.abs(exact).max())
