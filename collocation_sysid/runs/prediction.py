"""References of the predictions of recordings.

A prediction is compared with two references: the same prediction with the nuisance parameters of the
fitted recordings (blind), and the measurements of a fitted recording (copy).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..common.array_types import Array, Index
from ..features.measurement_results import CopyError
from ..features.measurements import (
    copied,
    copied_times_s,
    instrument_misfits,
    prediction_error,
    reason_against_copy,
)
from ..methods.solution import Solution
from ..program.transcription import Transcription
from ..recording import Experiment
from ..recording.nuisance import CLOCK_RATE, DEPTH_TIME, JOINING, OBSTACLE_TIME, SENSOR_TIME, TIME
from ..recording.sample_times import TIME_TOLERANCE_S
from ..statistics.assessment import InstrumentMisfit


def fit_misfits(solution: Solution) -> dict[str, list[InstrumentMisfit]]:
    """Return the RMS of (fit − measurement) / σ of each measurement, by name of the recording."""
    return {
        part.transcription.experiment.name: instrument_misfits(
            part.transcription.experiment,
            solution.fitted_values[part.transcription.experiment.name],
        )
        for part in solution.parts
    }


# Blind predictions --------------------------------------------------------------------------------


def nuisance_of_fitted_recordings(transcription: Transcription, solution: Solution) -> Array:
    """Return nuisance parameters φ (k,) for a recording that is not fitted, from the fitted ones,
    in units of the prior standard deviations of that recording.

    Each is the mean of the estimates, in physical units, of the parameters with the same label in
    the fitted recordings, divided by its own prior standard deviation. The place of a marker that
    is estimated is the mean of its places on the body [m] in the fitted recordings that have a
    marker of this name, estimated or exact; its entries in φ are the displacement from the
    recording's own place at φ = 0 to that mean, along the directions of its own prior. Where no
    fitted recording has the label or the marker, φ is zero, the mean of the prior. The recording's
    own measurements are not compared, and φ is not limited to its bounds.

    Parameters
    ----------
    transcription : Transcription
        Transcription of the recording to be predicted.
    """
    nuisance = transcription.nuisance
    places = transcription.markers.observable.coordinate_parameters
    known: dict[str, list[float]] = {}
    for part in solution.parts:
        for entry, _, value in part.transcription.nuisance.iterate_values(part.phi):
            known.setdefault(entry.label, []).append(value)
    phi = np.zeros(nuisance.size)
    for k, entry in enumerate(nuisance.entries):
        phi[k] = np.mean(known.get(entry.label, [0.0])) / entry.sigma
    start_m = transcription.marker_places_m(np.zeros(nuisance.size))
    for number in transcription.association.markers.estimated.tolist():
        name = transcription.experiment.markers.names[number]
        places_m = [
            part.transcription.marker_places_m(part.phi)[
                part.transcription.experiment.markers.names.index(name)
            ]
            for part in solution.parts
            if name in part.transcription.experiment.markers.names
        ]
        if places_m:
            directions_m = (
                transcription.association.markers.sigma_m[number]
                * transcription.association.markers.axes[number]
            )
            way_m = np.mean(places_m, axis=0) - start_m[number]
            phi[places[number]] = np.linalg.pinv(directions_m) @ way_m
    return phi


# Times of a recording that are its own: when it, a load or an obstacle began, and by which clock.
ONSETS = (TIME, CLOCK_RATE, OBSTACLE_TIME, JOINING, SENSOR_TIME, DEPTH_TIME)


def unknown_onsets(transcription: Transcription) -> Index:
    """Return the indices in φ, ascending, of onsets and clocks that the description of a recording
    declares as unknown: their prior is stated, and is not the default.
    """
    stated = transcription.experiment.nuisance
    own = [row for row in stated.own if row.clock is not None]
    declared = [row for row in ONSETS if stated.sigma(row) not in (None, row.sigma)]
    return transcription.nuisance.indices_of_rows(*declared, *own)


# Copies of other recordings -----------------------------------------------------------------------


def nearest_recording_error(
    experiment: Experiment, fitted: Iterable[Experiment]
) -> CopyError | str:
    """Return how well the nearest fitted recording's measurements predict a recording.

    Measurements are compared sample by sample, at equal times after the start. The nearest one has
    the smallest RMS of the markers, or of the forces if no markers are compared.

    Parameters
    ----------
    experiment : Experiment
        Recording to predict.
    fitted : iterable of Experiment
        Fitted recordings; may be empty.

    Returns
    -------
    CopyError or str
        Name and errors of the nearest recording; a text with the reasons if no fitted recording has
        the same instruments and times.
    """
    reasons = {}
    copies = []
    for other in fitted:
        reason = _reason_against_copy(experiment, other)
        if reason:
            reasons[other.name] = reason
            continue
        error = prediction_error(experiment, copied(experiment, other))
        copies.append(CopyError(other.name, error))
    if not copies:
        explanation = "; ".join(f"{name}: {reason}" for name, reason in reasons.items())
        return f"no fitted recording has the same samples ({explanation})"
    return min(copies, key=lambda each: each.error.main)


def _reason_against_copy(experiment: Experiment, other: Experiment) -> str:
    """Return why `other` is no prediction of a recording, such as other markers, or ""."""
    if reason := reason_against_copy(experiment, other):
        return reason
    starts_s = experiment.t_s[0], other.t_s[0]
    for here_s, there_s in copied_times_s(experiment, other):
        if len(here_s) != len(there_s):
            return f"{len(there_s)} samples instead of {len(here_s)}"
        if np.abs((here_s - starts_s[0]) - (there_s - starts_s[1])).max() > TIME_TOLERANCE_S:
            return "other times"
    return ""
