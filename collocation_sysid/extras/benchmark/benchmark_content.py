"""Content of a benchmark folder as it is read again for a score."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...common.checked_arrays import float_array, require_shape
from ...common.files import damage_refused, read_json, require_size
from ...common.written_files import is_written_here
from ...errors import InputError
from .signals import RecordingSignals, Signal

# File of a benchmark folder with its bodies, and file of a body with all about it but the arrays.
CONTENT_FILE = "benchmark.json"
BODY_FILE = "body.json"
REMEDY = "write the benchmark again, into another folder"


@dataclass(frozen=True, eq=False)
class StoredRecording:
    """A recording of a benchmark folder.

    Attributes
    ----------
    body : str
        Name of its body, which is that of the folder.
    name : str
        Name in the names of files.
    is_held_out : bool
        Whether the constants were identified without the recording.
    """

    body: str
    name: str
    is_held_out: bool
    signals: RecordingSignals


@dataclass(frozen=True, eq=False)
class BenchmarkContent:
    """Bodies and recordings of a benchmark folder.

    Attributes
    ----------
    recordings : tuple of StoredRecording
        Recordings of all bodies.
    """

    folder: Path
    bodies: tuple[str, ...]
    recordings: tuple[StoredRecording, ...]

    @classmethod
    def read(cls, folder: Path) -> BenchmarkContent:
        """Return the bodies and recordings of a benchmark folder, with all measured and simulated
        values.

        Predictions in the folder are not read.

        Raises
        ------
        InputError
            If it is no benchmark folder, is damaged, or one of its files was changed.
        """
        content = read_json(_unchanged(folder, CONTENT_FILE), "a benchmark folder")
        with damage_refused(folder, CONTENT_FILE, REMEDY):
            bodies = tuple(str(name) for name in content["bodies"])
        recordings = tuple(
            recording for body in bodies for recording in _read_recordings(folder, body)
        )
        return cls(folder, bodies, recordings=recordings)


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


def _read_recordings(folder: Path, body: str) -> list[StoredRecording]:
    """Return the recordings of the body called `body` from a benchmark folder."""
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
