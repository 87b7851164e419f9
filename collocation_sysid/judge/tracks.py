"""Misspecification hypotheses about tracks that are copies of others, about filtered ones, as by
the software of cameras, and about markers that have each other's names.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy
from scipy.spatial import KDTree

from ..common.array_types import Array
from ..program.experiment_iterate import ExperimentIterate
from ..recording.experiment import Experiment
from ..recording.measurement import root_mean
from ..recording.nuisance import PLACE
from ..statistics.distributions import largest_deviation
from ..statistics.hypothesis import Hypothesis
from ..statistics.thresholds import RARE
from .doubt import exchanged_names

# RMS distance of two tracks over that of independent noise at one place, up to which they are the
# same.
SAME_TRACK = 1.4
# Distance of two tracks at one sample, over σ, up to which they are compared.
NEAR = 10.0
# Distance of two stated places over that of the tracks, from which on the places are different; the
# same of fitted places from the stated ones of their markers, over that from those of others.
OTHER_PLACE = 5.0
# Fewest different values of a series that can be a copy of another one.
FEWEST_VALUES = 5
# Largest difference of the intervals between samples, over their mean, of a series with a spectrum.
EVEN = 0.01
# Fewest samples whose spectrum is examined.
FEWEST_SAMPLES = 32
# Largest amplitude of noise over σ above twice the cutoff of a filter.
STOPPED = 0.15
# Amplitude of filtered noise over σ at the cutoff; the largest frequency with more is the cutoff.
PASSED = 0.5
# Largest amplitude in the highest quarter of the band over that in the quarter below: a filter
# falls, noise is flat.
FALLING = 0.5


def exchanged_places(part: ExperimentIterate) -> Iterator[Hypothesis]:
    """Yield the markers that a fit puts at the stated places of each other, as far from their own as
    no error of a place is: their names are exchanged.
    """
    markers = part.transcription.experiment.markers
    estimated = part.transcription.nuisance.indices_of_rows(PLACE)
    if len(markers.names) < 2 or not len(estimated):
        return
    if np.abs(part.phi[estimated]).max() <= largest_deviation(len(estimated), RARE):
        return
    stated_m = part.transcription.marker_places_m(np.zeros(len(part.phi)))
    fitted_m = part.transcription.marker_places_m(part.phi)
    distances_m = np.linalg.norm(fitted_m[:, None] - stated_m, axis=2)
    _, chosen = scipy.optimize.linear_sum_assignment(distances_m**2)
    exchanged = np.flatnonzero(chosen != np.arange(len(chosen)))
    if not len(exchanged):
        return
    own_m, other_m = (
        root_mean(distances_m[exchanged, k] ** 2) for k in (exchanged, chosen[exchanged])
    )
    if own_m > OTHER_PLACE * other_m:
        yield Hypothesis(
            "markers-exchanged",
            f"'{part.transcription.experiment.name}'",
            data={"names": exchanged_names(markers.names, chosen)},
            strength=own_m / max(other_m, 1e-12),
        )


def same_tracks(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield the pair of markers whose tracks are the same up to noise, if their stated places are
    not; nothing if there is none.
    """
    markers = experiment.markers
    tracks_m = markers.positions_at_samples_m
    names = markers.names
    if len(names) < 2:
        return
    fullest_m = tracks_m[int(np.isfinite(tracks_m[..., 0]).sum(axis=1).argmax())]
    seen = np.flatnonzero(np.isfinite(fullest_m[:, 0]))
    near = KDTree(fullest_m[seen]).query_pairs(NEAR * float(np.max(markers.sigma_m)))
    for i, j in sorted((int(seen[a]), int(seen[b])) for a, b in near):
        away_m = np.linalg.norm(tracks_m[:, i] - tracks_m[:, j], axis=1)
        noise_m = float(np.sqrt(3 * (markers.sigma_m[i] ** 2 + markers.sigma_m[j] ** 2)))
        if np.isfinite(away_m).sum() < 2:
            continue
        rms_m = float(np.sqrt(np.nanmean(away_m**2)))
        if rms_m > SAME_TRACK * noise_m:
            continue
        places_m = markers.predict_positions(experiment.body.nodes_m)
        apart_m = float(np.linalg.norm(places_m[i] - places_m[j]))
        is_placed = markers.located[i] and markers.located[j]
        if not is_placed or apart_m < OTHER_PLACE * max(rms_m, noise_m):
            continue
        data = {"first": names[i], "second": names[j], "by_mm": 1e3 * rms_m}
        of = f"'{experiment.name}'"
        yield Hypothesis("markers-same", of, data=data, strength=OTHER_PLACE)
        return


def filtered_tracks(experiment: Experiment, fitted_m: Array) -> Iterator[Hypothesis]:
    """Yield the hypothesis that the tracks of a fitted experiment, with predictions (T, M, 3) [m], were
    low-passed, if their residuals have a spectrum of noise at low frequencies that falls far below it
    at high ones.
    """
    markers = experiment.markers
    if experiment.is_static:
        return
    scaled = (fitted_m - markers.positions_m) / markers.sigma_m[:, None]
    scaled = scaled.reshape(len(scaled), -1)
    used = np.isfinite(scaled).any(axis=1)
    complete = np.isfinite(scaled[used]).all(axis=0)
    if used.sum() < FEWEST_SAMPLES or not complete.any():
        return
    intervals_s = np.diff(markers.t_s[used])
    if np.ptp(intervals_s) > EVEN * intervals_s.mean():
        return
    frequency_hz, amplitude = _amplitudes(scaled[used][:, complete], float(intervals_s.mean()))
    cutoff = _cutoff(amplitude)
    if cutoff is not None:
        high = float(np.sqrt(np.mean(amplitude[2 * cutoff :] ** 2)))
        data = {"frequency_hz": float(frequency_hz[cutoff]), "percent": 100 * high}
        of = f"'{experiment.name}'"
        yield Hypothesis("tracks-filtered", of, data=data, strength=1 / STOPPED)


def _amplitudes(values: Array, interval_s: float) -> tuple[Array, Array]:
    """Return frequencies (F,) [Hz] and amplitudes of detrended values, 1 for white noise."""
    count = len(values)
    ramp = np.linspace(-1.0, 1.0, count)
    basis = np.column_stack([np.ones(count), ramp])
    detrended = values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
    window = np.hanning(count)[:, None]
    spectrum = np.fft.rfft(window * detrended, axis=0)
    power = np.mean(np.abs(spectrum) ** 2, axis=1) / np.sum(window**2)
    return np.array(np.fft.rfftfreq(count, interval_s), dtype=float), np.sqrt(power)


def _cutoff(amplitude: Array) -> int | None:
    """Return the index of the cutoff of a low-pass in amplitudes (F,) over σ; None without."""
    count = len(amplitude)
    passed = np.flatnonzero(amplitude >= PASSED)
    if not len(passed) or not 2 < passed[-1] < 2 * count // 5:
        return None
    cutoff = int(passed[-1])

    def level(first: int, last: int) -> float:
        return float(np.sqrt(np.mean(amplitude[first:last] ** 2)))

    falls = level(3 * count // 4, count) < FALLING * level(count // 2, 3 * count // 4)
    return cutoff if level(2 * cutoff, count) < STOPPED and falls else None
