"""Motion of markers at the beginning of a recording that the motion of the grasps does not explain.

A body that starts in equilibrium moves only after its grasps: until the first motion that stands
out from the noise, its markers move about as far as the grasps have moved. A body that still swings
moves much farther.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..common.array_types import Array
from ..recording.experiment import Experiment
from ..statistics.distributions import chi2_sf
from ..statistics.hypothesis import Hypothesis

# Fewest samples of the initial interval: third differences need four.
FEWEST_SAMPLES = 6
# Longest initial interval, as a share of the recording.
LONGEST_SHARE = 0.25
# Probability that noise alone counts as motion, for each interval.
FALSE_ALARM = 1e-6
# Factor by which the noise may exceed the largest of its estimates.
NOISE_MARGIN = 1.5
# RMS displacement of markers over the extent of the motion of the grasp, from which on it is no
# response from rest. A displacement that grows evenly has an RMS of 0.29 of its extent, so that
# markers may move 3.5 times as far as the grasp; a base that jumps gives a factor of two.
LARGEST_RESPONSE = 1.0
# Deviation of the clocks that is allowed for, in standard deviations of its prior.
CLOCK_DEVIATIONS = 3.0
# Variance of third differences of white noise, over that of the noise: 1 + 9 + 9 + 1.
THIRD_DIFFERENCES = 20.0


def initial_motion(experiment: Experiment) -> tuple[float, float, float] | None:
    """Return the motion in the shortest initial interval in which the markers move by more than
    noise: the length of the interval [s], the RMS displacement of the markers from their mean
    positions without that of noise [m], and the largest distance of a point of the body, moved
    rigidly with its grasp, between two times of the interval [m].

    None if there is no such interval within the first quarter of the recording, or without a
    marker that is present at each of its samples.

    Parameters
    ----------
    experiment : Experiment
        A recording with grasps.

    Notes
    -----
    The noise of a marker is the largest of its σ and of what the third differences of its track
    show, in the whole recording (median) and in the interval (RMS).
    """
    t_s = experiment.t_s
    most = int(LONGEST_SHARE * len(t_s))
    markers = experiment.markers
    positions_m = markers.positions_at_samples_m
    noise_m = np.maximum(markers.sigma_m, _typical_noise_m(positions_m))
    for count in range(FEWEST_SAMPLES, most + 1):
        is_complete = markers.is_complete[:count].all(axis=0)
        if not is_complete.any():
            return None
        tracks_m = positions_m[:count, is_complete]
        differences = np.diff(tracks_m, n=3, axis=0)
        local_m = np.sqrt(np.mean(differences**2, axis=(0, 2)))
        deviation_m = NOISE_MARGIN * np.maximum(
            noise_m[is_complete], local_m / np.sqrt(THIRD_DIFFERENCES)
        )
        scaled = (tracks_m - tracks_m.mean(axis=0)) / deviation_m[:, None]
        freedom = (count - 1) * tracks_m.shape[1] * 3
        if chi2_sf(float(np.sum(scaled**2)), freedom) < FALSE_ALARM:
            variance = tracks_m.var(axis=0).sum(axis=1) - 3 * deviation_m**2
            duration_s = float(t_s[count - 1] - t_s[0])
            markers_m = float(np.sqrt(max(0.0, variance.mean())))
            return duration_s, markers_m, _grasp_motion_m(experiment, count)
    return None


def initial_motion_hypotheses(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield the hypothesis that a body which starts in equilibrium was not at rest, if its markers
    move much farther than its grasps in the initial interval.

    Nothing is yielded for another start, for a body under load for a finite time, without grasps
    throughout the recording, or with actuators, obstacles or loads that change, which move a body
    without its grasps.
    """
    grasps = experiment.body_grasps
    if (
        experiment.is_static
        or experiment.start != "equilibrium"
        or np.isfinite(experiment.loaded_since_s)
        or experiment.actuators
        or experiment.obstacles
        or _loads_change(experiment)
        or not grasps
        or not all(each.is_active(experiment.t_s).all() for each in grasps)
    ):
        return
    motion = initial_motion(experiment)
    if motion is None:
        return
    duration_s, markers_m, grasp_m = motion
    limit_m = LARGEST_RESPONSE * grasp_m
    if markers_m > limit_m:
        data = {"by_mm": 1e3 * markers_m, "within_ms": 1e3 * duration_s, "grasp_mm": 1e3 * grasp_m}
        strength = float(markers_m / max(limit_m, markers_m / 10))
        yield Hypothesis("not-at-rest", f"'{experiment.name}'", data=data, strength=strength)


def _loads_change(experiment: Experiment) -> bool:
    loads = (
        experiment.declared_node_forces_n(experiment.t_s),
        experiment.point_mass_at_nodes_kg(experiment.t_s),
    )
    return any(np.ptp(each, axis=0).max(initial=0.0) > 0 for each in loads)


def _grasp_motion_m(experiment: Experiment, count: int) -> float:
    """Return the largest extent [m] of a point moved rigidly with its grasp in `count` samples."""
    t_s = experiment.t_s
    prior_s = experiment.nuisance.time_shift_s or 0.0
    end_s = t_s[count - 1] + CLOCK_DEVIATIONS * prior_s
    times_s = t_s[t_s <= max(end_s, t_s[count])]
    positions_m = experiment.rigid_positions(times_s)
    return float(np.linalg.norm(np.ptp(positions_m, axis=0), axis=1).max())


def _typical_noise_m(tracks_m: Array) -> Array:
    """Return each marker's noise (M,) [m] from third differences of tracks (T, M, 3)."""
    squares = np.sum(np.diff(tracks_m, n=3, axis=0) ** 2, axis=2)
    noise_m = np.zeros(tracks_m.shape[1])
    # The median of χ² with three degrees of freedom is 2.37, the mean 3.
    median = 2.366
    for k in range(tracks_m.shape[1]):
        known = squares[np.isfinite(squares[:, k]), k]
        if len(known):
            noise_m[k] = np.sqrt(np.median(known) / median / THIRD_DIFFERENCES)
    return noise_m
