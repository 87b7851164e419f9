"""Scores of predictions: errors relative to the deflection and to the stated noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...common.checked_arrays import float_array, require_shape
from ...common.files import damage_refused, read_json, require_size
from ...common.written_files import is_written_here
from ...errors import InputError, listed, require_among
from .prediction_files import PREDICTION_SUFFIXES, find_prediction, prediction_name, read_prediction
from .signals import AXES, RecordingSignals, Signal

# File of a benchmark folder with its bodies, and file of a body with all about it but the arrays.
CONTENT_FILE = "benchmark.json"
BODY_FILE = "body.json"
REMEDY = "write the benchmark again, into another folder"

PREDICTION = "prediction"
SIMULATION = "collocation_sysid"
UNDEFORMED = "undeformed body"


@dataclass(frozen=True, eq=False)
class StoredRecording:
    """A recording of a benchmark folder."""

    body: str  # name of its body, which is that of the folder
    name: str  # name in the names of files
    is_held_out: bool  # whether the constants were identified without the recording
    signals: RecordingSignals


@dataclass(frozen=True)
class Score:
    """Errors of one prediction of one recording."""

    body: str
    recording: str
    # "prediction", "collocation_sysid" for the forward simulation of this package, or "undeformed
    # body" for the undeformed body, which its grasp moves rigidly and has no loads.
    source: str
    quantity: str
    unit: str  # unit of the errors: m, N or Pa
    is_held_out: bool  # whether the constants were identified without the recording
    count: int  # number of measured positions of markers, or of loads
    rms: float  # RMS distance of predicted and measured markers, or RMS difference of loads
    largest: float  # largest distance or difference
    # `rms` relative to the largest deflection, which is the largest error of the undeformed body.
    deflection_share: float
    sigmas: float  # RMS of the differences over their stated standard deviations
    # RMS distance of the markers if the mean difference of each is subtracted, which errors of
    # marker positions on the body do not change much; None for loads.
    rms_without_offsets: float | None


UNITS = {"markers": "m", "forces": "N", "stresses": "Pa"}


def score_benchmark(folder: str | Path, body: str | None = None) -> list[Score]:
    """Return the scores of the predictions in a benchmark folder; nothing is written.

    Parameters
    ----------
    folder : str or Path
        Folder that `write_benchmark` wrote, with a prediction file of each recording added to the
        folder of its body.
    body : str, optional
        Name of the only body to score; all by default.

    Returns
    -------
    list of Score
        For each recording three: the prediction, the forward simulation of this package, and the
        undeformed body.

    Raises
    ------
    InputError
        If the folder is no benchmark or was changed, has no such body, or if a prediction is
        missing or invalid.
    """
    folder = Path(folder)
    names = read_bodies(folder)
    if body is not None:
        require_among(body, names, source=folder, where="--body")
        names = (body,)
    recordings = [each for name in names for each in read_recordings(folder, name)]
    files = _prediction_files(folder, recordings)
    scores = []
    for recording, file in zip(recordings, files, strict=True):
        prediction = read_prediction(file, recording.signals.measured)
        signals = {
            PREDICTION: prediction,
            SIMULATION: recording.signals.simulated,
            UNDEFORMED: recording.signals.undeformed,
        }
        scores += [score(recording, source, predicted=signal) for source, signal in signals.items()]
    return scores


def _prediction_files(folder: Path, recordings: list[StoredRecording]) -> list[Path]:
    """Return the prediction file of each recording, in the same order."""
    files = []
    missing = []
    for recording in recordings:
        file = find_prediction(folder / recording.body, recording.name)
        if file is None:
            name = prediction_name(recording.name)
            missing.append(f"{recording.body}/{name}{PREDICTION_SUFFIXES[0]}")
        else:
            files.append(file)
    if missing:
        raise InputError(
            f"found no {listed(missing)}; expected a prediction of each recording, as .csv or .npz, "
            "see README.md; --body NAME scores one body",
            folder,
        )
    return files


def score(recording: StoredRecording, source: str, predicted: Signal) -> Score:
    """Return the score of a prediction of a recording.

    Parameters
    ----------
    recording : StoredRecording
        Recording with measured values, which must not all equal those of the undeformed body
        (otherwise `ZeroDivisionError`).
    source : str
        Who predicted it, see `Score`.
    predicted : Signal
        Prediction at the samples of the measured signal, with the same columns; a NaN counts as not
        measured. At least one marker, with all its coordinates, or one load must be both measured
        and predicted (otherwise `ValueError`).
    """
    signals = recording.signals
    measured = signals.measured
    errors = _errors(predicted, measured)
    distances = _distances(errors, measured)
    deflections = _distances(_errors(signals.undeformed, measured), measured)
    without_offsets = None
    if measured.quantity == "markers":
        centred = errors - np.nanmean(errors, axis=0)
        without_offsets = _rms(_distances(centred, measured))
    return Score(
        body=recording.body,
        recording=recording.name,
        source=source,
        quantity=measured.quantity,
        unit=UNITS[measured.quantity],
        is_held_out=recording.is_held_out,
        count=distances.size,
        rms=_rms(distances),
        largest=float(distances.max()),
        deflection_share=_rms(distances) / float(deflections.max()),
        sigmas=_rms((errors / signals.sigma)[np.isfinite(errors)]),
        rms_without_offsets=without_offsets,
    )


def _errors(predicted: Signal, measured: Signal) -> Array:
    """Return predicted minus measured values (T, C); NaN where nothing was measured."""
    return predicted.values - measured.values


def _distances(errors: Array, measured: Signal) -> Array:
    """Return distances of markers [m], or magnitudes of differences, without NaN."""
    sizes = np.abs(errors)
    if measured.quantity == "markers":
        sizes = np.linalg.norm(errors.reshape(len(errors), -1, len(AXES)), axis=2)
    return sizes[np.isfinite(sizes)]


def _rms(values: Array) -> float:
    """Return the root of the mean square of at least one value, of any shape; NaN if one is NaN."""
    return float(np.sqrt(np.mean(values**2)))


def _unchanged(folder: Path, name: str) -> Path:
    """Return the file called `name` in a benchmark folder; a file that does not exist is accepted."""
    file = folder / name
    if file.exists() and not is_written_here(file, folder):
        raise InputError(
            "this file was changed after it was written, so that scores would not be comparable; "
            f"{REMEDY}",
            file,
        )
    return file


def read_bodies(folder: Path) -> tuple[str, ...]:
    """Return the names of the bodies of a benchmark folder."""
    content = read_json(_unchanged(folder, CONTENT_FILE), "a benchmark folder")
    with damage_refused(folder, CONTENT_FILE, REMEDY):
        return tuple(str(name) for name in content["bodies"])


def read_recordings(folder: Path, body: str) -> list[StoredRecording]:
    """Return the recordings of a body with their measured and simulated values."""
    file = _unchanged(folder, f"{body}/{BODY_FILE}")
    content = read_json(file, "the folder of a body of a benchmark")
    with damage_refused(file.parent, BODY_FILE, REMEDY):
        return [
            StoredRecording(
                body=body,
                name=recording["file_name"],
                is_held_out=bool(recording["is_held_out"]),
                signals=_read_signals(folder, body, recording=recording),
            )
            for recording in content["recordings"]
        ]


def _read_signals(folder: Path, body: str, recording: Mapping[str, Any]) -> RecordingSignals:
    """Return the measured and predicted signals of a recording of a body; blank cells are NaN."""
    tables = {}
    for role in ("measured", "simulated", "undeformed"):
        file = _unchanged(folder, f"{body}/{recording['files'][role]}")
        require_size(file)
        try:
            tables[role] = np.atleast_2d(np.genfromtxt(file, delimiter=",", skip_header=1))
        except OSError as error:
            raise InputError(
                f"this file cannot be read ({error.strerror}); {REMEDY}", file
            ) from error
    shape = (len(tables["measured"]), 1 + len(recording["columns"]))
    for role, table in tables.items():
        require_shape(table.shape, shape, f"the table {recording['files'][role]}")
    measured = Signal(
        recording["quantity"],
        recording["key"],
        keys=tables["measured"][:, 0],
        columns=tuple(recording["columns"]),
        values=tables["measured"][:, 1:],
    )
    return RecordingSignals(
        measured,
        float_array(recording["sigma"], "sigma", (len(measured.columns),)),
        simulated=measured.with_values(tables["simulated"][:, 1:]),
        undeformed=measured.with_values(tables["undeformed"][:, 1:]),
    )
