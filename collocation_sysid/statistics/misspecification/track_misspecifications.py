"""Misspecification hypotheses about tracks that the software of the cameras has changed: copies of
a track, and filtered tracks.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import KDTree

from ...common.array_types import Array
from ...program.experiment_iterate import ExperimentIterate
from ...recording.experiment import Experiment
from .misspecification_hypothesis import Hypothesis

# RMS distance of two tracks over that of independent noise at one place, up to which they are the
# same.
SAME_TRACK = 1.4
# Distance of two tracks at one sample, over σ, up to which they are compared.
NEAR = 10.0
# Distance of two stated places over that of the tracks, from which on the places are different.
OTHER_PLACE = 5.0
# Fewest samples whose spectrum is examined.
FEWEST_SAMPLES = 32
# Largest amplitude of noise over σ above twice the cutoff of a filter.
STOPPED = 0.15
# Amplitude of filtered noise over σ at the cutoff; the largest frequency with more is the cutoff.
PASSED = 0.5
# Largest amplitude in the highest quarter of the band over that in the quarter below: a filter
# falls, noise is flat.
FALLING = 0.5


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
        is_placed = bool(markers.located[i] and markers.located[j])
        places_m = markers.predict_positions(experiment.body.nodes_m)
        apart_m = float(np.linalg.norm(places_m[i] - places_m[j]))
        if is_placed and apart_m < OTHER_PLACE * max(rms_m, noise_m):
            continue
        code = "markers-same" if is_placed else "markers-same/unplaced"
        data = {"first": names[i], "second": names[j], "by_mm": 1e3 * rms_m}
        yield Hypothesis(code, f"'{experiment.name}'", data=data, strength=OTHER_PLACE)
        return


def filtered_tracks(part: ExperimentIterate) -> Iterator[Hypothesis]:
    """Yield the hypothesis that the tracks of a fitted experiment were low-passed, if the spectrum
    of its residuals is that of noise at low frequencies and falls far below it at high ones.
    """
    experiment = part.transcription.experiment
    markers = experiment.markers
    if experiment.is_static or len(experiment.t_s) < FEWEST_SAMPLES:
        return
    complete = markers.is_measured.all(axis=0)
    if not complete.any():
        return
    predicted_m = part.transcription.markers.predict_positions(part.x, part.phi)
    scaled = ((predicted_m - markers.positions_m) / markers.sigma_m[:, None])[:, complete]
    frequency_hz, amplitude = _amplitudes(scaled, experiment.timestep_s)
    cutoff = _cutoff(amplitude)
    if cutoff is None:
        return
    high = float(np.sqrt(np.mean(amplitude[2 * cutoff :] ** 2)))
    data = {"frequency_hz": float(frequency_hz[cutoff]), "percent": 100 * high}
    yield Hypothesis("tracks-filtered", f"'{experiment.name}'", data=data, strength=1 / STOPPED)


def _amplitudes(values: Array, interval_s: float) -> tuple[Array, Array]:
    """Return frequencies (F,) [Hz] and the amplitudes (F,) of values (T, k) at them, 1 for white
    noise of variance one; the mean and a linear trend are left out.
    """
    count = len(values)
    ramp = np.linspace(-1.0, 1.0, count)
    basis = np.column_stack([np.ones(count), ramp])
    detrended = values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
    window = np.hanning(count)[:, None]
    spectrum = np.fft.rfft(window * detrended, axis=0)
    power = np.mean(np.abs(spectrum) ** 2, axis=1) / np.sum(window**2)
    return np.array(np.fft.rfftfreq(count, interval_s), dtype=float), np.sqrt(power)


def _cutoff(amplitude: Array) -> int | None:
    """Return the index of the cutoff of a low-pass filter in amplitudes (F,) over σ; None if they
    are not those of filtered noise.
    """
    count = len(amplitude)
    passed = np.flatnonzero(amplitude >= PASSED)
    if not len(passed) or not 2 < passed[-1] < 2 * count // 5:
        return None
    cutoff = int(passed[-1])

    def level(first: int, last: int) -> float:
        return float(np.sqrt(np.mean(amplitude[first:last] ** 2)))

    falls = level(3 * count // 4, count) < FALLING * level(count // 2, 3 * count // 4)
    return cutoff if level(2 * cutoff, count) < STOPPED and falls else None
