"""Number of time steps from sample to sample that a motion with impacts needs."""

from __future__ import annotations

import numpy as np

from .experiment import Experiment

# Largest number of time steps per sample that is chosen for impacts.
MOST_IMPACT_STEPS = 16
# Note on this number.
IMPACT_NOTE = (
    "{} time steps per sample are used, because the body moves by several times the noise of its "
    "markers from sample to sample and may strike an obstacle"
)


def impact_steps(experiment: Experiment) -> int:
    """Return the number of time steps per sample, at most `MOST_IMPACT_STEPS`, with which a body
    moves relative to its obstacles by at most the noise of its markers in a step; 1 without
    markers, without obstacles, and for equilibria.

    A scheme places an impact at the end of a step, or distributes it over the step: the error of
    the positions afterwards is of first order, a share of the motion in a step.
    """
    markers = experiment.markers
    if experiment.is_static or not experiment.obstacles or not len(markers.names):
        return 1
    sigma_m = float(np.sqrt(np.mean(markers.sigma_m**2)))
    moved_m = 0.0
    for obstacle in experiment.obstacles:
        places_m = markers.positions_m - obstacle.poses.at(experiment.t_s)[1][:, None]
        squares_m2 = (np.diff(places_m, axis=0) ** 2).sum(axis=2)
        is_seen = np.isfinite(squares_m2)
        counts = is_seen.sum(axis=1)
        sums_m2 = np.where(is_seen, squares_m2, 0.0).sum(axis=1)
        mean_m2 = float((sums_m2 / np.maximum(counts, 1)).max())
        # The noise of both ends, with three coordinates each.
        moved_m = max(moved_m, np.sqrt(max(0.0, mean_m2 - 6 * sigma_m**2)))
    return int(np.clip(np.ceil(moved_m / sigma_m), 1, MOST_IMPACT_STEPS))
