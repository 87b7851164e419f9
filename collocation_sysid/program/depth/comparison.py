"""Residuals of depth cameras in a fit: distances of points from the surface, and of outlines."""

from __future__ import annotations

import numpy as np

from ...common.array_types import Array
from ..experiment_iterate import ExperimentIterate
from .outline_residual import OutlineResidual
from .residual import DepthResidual


def depth_residuals(iterate: ExperimentIterate) -> list[tuple[DepthResidual, Array]]:
    """Return the measurement residuals of the depth cameras, each with the values (n, e, 3) of its
    observable: positions of the surface nodes [m].
    """
    return [
        (residual, values)
        for residual, values in iterate.residuals_of(DepthResidual)
        if not isinstance(residual, OutlineResidual)
    ]


def outline_distances_px(iterate: ExperimentIterate) -> list[tuple[OutlineResidual, Array]]:
    """Return the measurement residuals of the outlines, each with the signed distances (n,) of
    outline points from their edges [pixels]; points without an edge are left out.
    """
    distances = []
    for residual, values in iterate.residuals_of(OutlineResidual):
        distances_px = residual.signed_distances_px(values, iterate.phi)
        distances.append((residual, distances_px[np.isfinite(distances_px)]))
    return distances
