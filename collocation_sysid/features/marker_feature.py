"""Markers in checks and runs: predicted positions and their errors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..common.array_types import Array, root_mean
from ..methods.solution import Solution
from ..program.collocation import ExperimentIterate
from ..program.simulation import Trajectory
from ..program.transcription import Transcription
from ..recording import write_markers_csv
from ..recording.experiment import Experiment
from ..statistics.instrument_misfit import InstrumentMisfit, misfit
from .feature import Feature, Units
from .measurement_results import (
    InstrumentPrediction,
    PictureKind,
    PredictionErrors,
    PredictionResiduals,
    Samples,
)

# File of predicted tracks.
PREDICTED_FILE = "predicted_markers.csv"
# Keys of markers that describe their file.
KEYS_OF_FILE = (
    "names",
    "labels",
    "length_unit",
    "rate_hz",
    "template_m",
    "template_window_s",
    "max_template_residual_m",
)


def samples(experiment: Experiment) -> Iterator[Samples]:
    """Yield the coordinates of all markers; nothing without a marker."""
    markers = experiment.markers
    if markers.names:
        names = [f"{name} {axis}" for name in markers.names for axis in "xyz"]
        yield Samples("the markers", names, markers.is_measured.reshape(-1, len(names)))


def predict(transcription: Transcription, trajectory: Trajectory, phi: Array) -> dict[str, Any]:
    """Return the predicted marker positions (T, M, 3) [m]."""
    return {"markers_m": transcription.markers.predict_samples(trajectory.positions_m, phi)}


def fitted(part: ExperimentIterate, _: Solution) -> dict[str, Any]:
    """Return the fitted marker positions (T, M, 3) [m]."""
    return {"markers_m": part.transcription.markers.predict_positions(part.x, part.phi)}


def copied(experiment: Experiment, other: Experiment) -> dict[str, Any]:
    """Return the measured positions of another recording in the order of the experiment's markers;
    NaN where missing.
    """
    markers = other.markers
    order = [markers.names.index(name) for name in experiment.markers.names]
    known_m = np.where(markers.is_present[..., None], markers.positions_m, np.nan)
    return {"markers_m": known_m[:, order]}


def copied_times_s(experiment: Experiment, other: Experiment) -> Iterable[tuple[Array, Array]]:
    """Return the times of both recordings if the experiment has a marker sample."""
    if experiment.markers.count_samples():
        return ((experiment.t_s, other.t_s),)
    return ()


def reason_against_copy(experiment: Experiment, other: Experiment) -> str:
    """Return that the recordings have different markers; "" if they have the same."""
    own = set(experiment.markers.names)
    return "other markers" if own != set(other.markers.names) else ""


def errors(experiment: Experiment, predicted: InstrumentPrediction) -> dict[str, Any]:
    """Return RMS and largest distance of the markers [m]; None without any."""
    markers = experiment.markers
    distance_m = np.sqrt(markers.squared_distances_m2(predicted.markers_m))
    present_m = distance_m[markers.is_present & np.isfinite(distance_m)]
    return {
        "rms_m": root_mean(present_m**2) if present_m.size else None,
        "max_m": float(present_m.max()) if present_m.size else None,
    }


def misfits(experiment: Experiment, predicted: InstrumentPrediction) -> Iterator[InstrumentMisfit]:
    """Yield the differences of all markers together, over their σ; nothing without a sample."""
    markers = experiment.markers
    if not markers.is_present.any():
        return
    difference_m = (predicted.markers_m - markers.positions_m)[markers.is_present]
    squares_m2 = markers.squared_distances_m2(predicted.markers_m)[markers.is_present]
    sigma_m = np.broadcast_to(markers.sigma_m, markers.is_present.shape)[markers.is_present]
    rms_m = root_mean(squares_m2[np.isfinite(squares_m2)])
    yield misfit(
        "the markers",
        "sigma_m",
        ratio=difference_m / sigma_m[:, None],
        size=f"{1e3 * rms_m:.3g} mm RMS",
    )


def step_differences(
    part: ExperimentIterate, trajectory: Trajectory, _: InstrumentPrediction, share: float
) -> Iterator[Array]:
    """Yield the changes (T, M, 3) of the residuals of the markers; zero where not predicted."""
    transcription = part.transcription
    fitted_m = transcription.markers.predict_positions(part.x, part.phi)
    way_m = share * (trajectory.markers_m - fitted_m)
    yield np.nan_to_num(way_m / transcription.experiment.markers.sigma_m[:, None])


def write_predicted(experiment: Experiment, trajectory: Trajectory, folder: Path) -> None:
    """Write the predicted tracks of the markers into a folder."""
    write_markers_csv(
        folder / PREDICTED_FILE,
        experiment.markers.t_s,
        names=experiment.markers.names,
        positions_m=trajectory.markers_m,
    )


def read_predicted(table: dict[str, Any]) -> None:
    """Let the table of an experiment read the predicted tracks, in place, if it has markers."""
    if "markers" in table:
        for key in KEYS_OF_FILE:
            table["markers"].pop(key, None)
        table["markers"]["file"] = PREDICTED_FILE


def prediction_residuals(
    experiment: Experiment, trajectory: Trajectory, _: InstrumentPrediction
) -> PredictionResiduals | None:
    """Return the differences of the markers [m]; None without a sample of any."""
    markers = experiment.markers
    if not markers.count_samples():
        return None
    return PredictionResiduals(
        experiment.t_s,
        trajectory.markers_m - markers.positions_m,
        is_counted=markers.is_present,
        unit="m",
    )


def fit_rms(solution: Solution) -> dict[str, float | None]:
    """Return the RMS distance of the markers [m]; 0 without samples."""
    return {"m": solution.rms_m}


def error_texts(error: PredictionErrors, _: Units) -> Iterator[str]:
    """Yield RMS and largest distance in words; nothing without markers."""
    if error.rms_m:
        largest = "" if error.max_m is None else f", at most {1e3 * error.max_m:.2f} mm"
        yield f"{1e3 * error.rms_m:.3f} mm RMS{largest}"


MARKERS = Feature(
    "markers",
    picture_kinds=[
        PictureKind(
            "tracks",
            "Measured, fitted and simulated markers, the residual below.",
            before="error",
            is_leading=True,
        )
    ],
    samples=samples,
    predict=predict,
    fitted=fitted,
    copied=copied,
    copied_times_s=copied_times_s,
    reason_against_copy=reason_against_copy,
    errors=errors,
    misfits=misfits,
    step_differences=step_differences,
    write_predicted=write_predicted,
    read_predicted=read_predicted,
    prediction_residuals=prediction_residuals,
    fit_rms=fit_rms,
    error_texts=error_texts,
)
