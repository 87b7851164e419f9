"""Copies of an experiment with a part of its measurements, or with placeholders for them.

Solvers, checks and studies use these functions where they need a shorter recording, so that they do
not depend on the kinds of sensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..common.array_types import Array
from ..common.time_dependence import at_times
from .experiment import Experiment
from .grasp import Grasp
from .measurement import Measurement
from .poses import PoseSequence
from .sample_times import TIME_TOLERANCE_S
from .time_tables import FEWEST_SHARED_SAMPLES

# Twice the standard deviation of a sample less the mean of two others, in that of a sample.
NOISE_OF_CURVATURE = 2.5
# Fewest samples of a placeholder, which resampling and a low-pass need.
FEWEST_PLACEHOLDERS = 3


def first_samples(experiment: Experiment, count: int) -> Experiment:
    """Return the experiment with its first samples, see `shortened_experiment`.

    Parameters
    ----------
    count : int
        Number of samples; it is increased to three and to the first sample with a marker, and as in
        `shortened_experiment`, but not beyond the recording.
    """
    first_visible = experiment.markers.first_visible_sample
    count = max(count, first_visible + 1, FEWEST_SHARED_SAMPLES)
    return shortened_experiment(experiment, min(len(experiment.t_s), count))


def shortened_experiment(
    experiment: Experiment, count: int, *, shortens_sensors: bool = False
) -> Experiment:
    """Return the experiment with its first samples; sensors without a measurement in them are left
    out, if they cannot ignore later ones.

    Parameters
    ----------
    experiment : Experiment
        Experiment to shorten; not modified.
    count : int
        Least number of samples. It is increased until every sensor has what it needs, such as a
        camera points and three images (one if the experiment is static), but not beyond the
        recording.
    shortens_sensors : bool
        Whether later samples of force sensors are removed, and those sensors with fewer than three
        samples (one if static) or no measured component; and zeros are put in the place of markers
        of which no sample remains. By default force sensors keep their samples after the end, which
        are ignored.
    """
    fewest = 1 if experiment.is_static else FEWEST_SHARED_SAMPLES
    for sensor in experiment.separate_sensors:
        times_s = sensor.sample_times_s
        inside_s = times_s[times_s >= experiment.t_s[0] - TIME_TOLERANCE_S][:fewest]
        needed_s = max(sensor.first_useful_s, inside_s[-1]) - TIME_TOLERANCE_S
        count = max(count, int(np.searchsorted(experiment.t_s, needed_s)) + 1)
    t_s = experiment.t_s[:count]

    def shortened(sensor: Measurement) -> Measurement | None:
        if sensor is not experiment.markers:
            until = sensor.until_time(t_s[-1] + TIME_TOLERANCE_S)
            return sensor.within(t_s, fewest) if shortens_sensors else until
        first = at_times(experiment.markers, slice(count))
        # At least one sample has to be present.
        is_empty = shortens_sensors and not first.has_samples()
        return first.with_zeros_at(first.t_s) if is_empty else first

    return experiment.with_measurements(map(shortened, experiment.measurements), t_s=t_s)


def without_later_measurements(experiment: Experiment, end_s: float) -> Experiment:
    """Return the experiment without the measurements after `end_s` [s]; its times stay.

    Markers and measured forces become NaN, and other sensors do as they declare, see
    `Measurement.without_later_values`. The experiment itself is not modified.
    """
    return experiment.with_measurements(
        each.without_later_values(end_s) for each in experiment.measurements
    )


def thinned_experiment(experiment: Experiment, *, many: int, most: int) -> Experiment:
    """Return the experiment with at most `most` unlabelled points in each sample of those sensors
    that have more than `many` in one; itself if there is no such sensor.
    """
    has_many = [max(each.point_counts, default=0) > many for each in experiment.measurements]
    if not any(has_many):
        return experiment
    return experiment.with_measurements(
        sensor.thinned(most) if many_points else sensor
        for sensor, many_points in zip(experiment.measurements, has_many, strict=True)
    )


def smooth_distance(experiment: Experiment, *, most: int, share: float) -> int:
    """Return the largest distance n of samples of a motion, from 1 to `most`, between which the
    marker tracks are linear, to a share of their standard deviation and the noise; 1 with other
    measurements and with obstacles.
    """
    markers = experiment.markers
    is_alone = experiment.measurements == (markers,) and not experiment.obstacles
    if experiment.is_static or not is_alone or markers.offsets_s is not None:
        return 1
    tracks = np.asarray(markers.positions_m)
    noise_m = NOISE_OF_CURVATURE * float(np.sqrt(np.mean(markers.sigma_m**2)))
    is_seen = np.isfinite(tracks).any(axis=(0, 2))
    varying_m = float(np.sqrt(np.nanmean(np.nanvar(tracks[:, is_seen], axis=0))))
    for distance in range(most, 1, -1):
        half = max(1, distance // 2)
        bend = tracks[half:-half] - (tracks[: -2 * half] + tracks[2 * half :]) / 2
        known = bend[np.isfinite(bend)]
        if known.size and np.sqrt(np.mean(known**2)) < noise_m + share * varying_m:
            return distance
    return 1


def with_some_samples(experiment: Experiment, distance: int) -> Experiment:
    """Return a recording of markers with every n-th sample, from the first on."""
    rows = np.arange(0, len(experiment.t_s), distance)
    some = at_times(experiment.markers, rows)
    return experiment.with_measurements([some], t_s=experiment.t_s[rows])


def moved_grasp(grasp: Grasp, poses: PoseSequence, t_s: Array) -> Grasp:
    """Return a grasp with other poses, over the times `t_s` (T,) [s], before anything is measured.

    A sensor of the grasp has zeros as placeholders, at its own rate over these times, and NaN for
    components that it does not measure.
    """
    moved = replace(grasp, poses=poses)
    if grasp.wrench is None:
        return moved
    sample_times_s = grasp.wrench.t_s
    rate_hz = (len(sample_times_s) - 1) / max(np.ptp(sample_times_s), 1e-300)
    count = max(FEWEST_PLACEHOLDERS, 1 + int(np.ptp(t_s) * rate_hz + 1e-6))
    placeholder = grasp.wrench.with_zeros_at(t_s[0] + np.arange(count) / rate_hz)
    return replace(moved, wrench=placeholder)


def measured_count(experiment: Experiment) -> int:
    """Return how many numbers the markers (coordinates) and force sensors (components) measure."""
    sensors = experiment.sensors_by_grasp.values()
    of_sensors = sum(int(each.is_measured.sum()) for each in sensors)
    return 3 * experiment.markers.sample_count + of_sensors


def main_measurement(experiments: Sequence[Experiment]) -> tuple[str, str]:
    """Return the kind of measurement that dominates, as plural text, and the key that states its
    noise: markers, else depth cameras, else force sensors, else other sensors.
    """
    known = (m for each in experiments for m in each.measurements if m.has_samples())
    main = min(known, key=lambda each: each.precedence)
    return main.measurement_text, main.noise_key


def is_load_only(experiment: Experiment) -> bool:
    """Return whether a static experiment measures forces only, so that no measurement shows the
    shape of the body between the faces.
    """
    return bool(
        experiment.is_static
        and experiment.sensors_by_grasp
        and not experiment.markers.sample_count
        and not experiment.separate_sensors
    )
