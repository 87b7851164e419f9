"""Predictions of a simulator: CSV tables and NPZ archives, at the samples of a recording."""

from __future__ import annotations

import csv
import zipfile
from pathlib import Path

import numpy as np

from ...common.array_files import load_arrays
from ...common.array_types import Array, Index
from ...common.files import reason, require_regular, require_size
from ...errors import InputError, excerpt, hint_at, listed
from .signals import Signal

PREDICTION_SUFFIXES = (".csv", ".npz")
# Name of the array of predicted values in an NPZ archive.
VALUES_NAME = "values"
# Largest difference of a predicted from a required time, in intervals between samples: a body
# that moves by its whole size within a sample is then misplaced by a thousandth of that.
TIME_TOLERANCE = 1e-3


def prediction_name(recording: str) -> str:
    """Return the name of the prediction file of a recording without its suffix, "swing_prediction"
    for the recording with the file name "swing".
    """
    return f"{recording}_prediction"


def find_prediction(folder: Path, recording: str) -> Path | None:
    """Return the prediction file of a recording, RECORDING_prediction.csv or .npz in a folder; None
    if there is none.

    Parameters
    ----------
    folder : Path
        Folder of the body.
    recording : str
        File name of the recording, "file_name" in body.json.

    Raises
    ------
    InputError
        If there are both a CSV table and an NPZ archive.
    """
    name = prediction_name(recording)
    files = [folder / f"{name}{suffix}" for suffix in PREDICTION_SUFFIXES]
    present = [file for file in files if file.exists()]
    if len(present) > 1:
        raise InputError(
            f"found {present[0].name} and {present[1].name}; expected one of them: delete the other",
            folder,
        )
    return present[0] if present else None


def read_prediction(file: Path, measured: Signal) -> Signal:
    """Return a prediction at the samples of the measured signal.

    The file may have more rows, such as all time steps, and more columns than needed.

    Parameters
    ----------
    file : Path
        CSV table with the columns of `measured`, or NPZ archive with the arrays `t_s` (or `sample`)
        (N,) and `values` (N, C), of markers also (N, M, 3).
    measured : Signal
        Its keys are the samples at which values are needed.

    Raises
    ------
    InputError
        If the file cannot be read, a column, sample or number is missing, or a value is not finite.
    """
    require_regular(file)
    require_size(file)
    keys, values = (
        _read_archive(file, measured) if file.suffix == ".npz" else _read_table(file, measured)
    )
    rows = _rows_of_samples(file, keys, measured=measured)
    return measured.with_values(values[rows])


def _read_table(file: Path, measured: Signal) -> tuple[Array, Array]:
    """Return keys (N,) and values (N, C) of a CSV table; other columns are ignored."""
    try:
        with file.open(newline="", encoding="utf-8-sig") as lines:
            rows = [row for row in csv.reader(lines)]
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(
            f"this file cannot be read ({reason(error)}); expected a CSV table", file
        ) from error
    header = [name.strip() for name in rows[0]] if rows else []
    needed = (measured.key, *measured.columns)
    for name in needed:
        if header.count(name) != 1:
            found = excerpt(", ".join(header)) or "no columns"
            what = "twice" if name in header else f"missing; found {found}"
            raise InputError(
                f"the column {name!r} is {what}{hint_at(name, header)}; expected the columns "
                f"{excerpt(','.join(needed))}, separated by commas",
                file,
            )
    places = [header.index(name) for name in needed]
    numbers = [
        [
            _number(file, line, row=row, place=place, name=name)
            for place, name in zip(places, needed, strict=True)
        ]
        for line, row in enumerate(rows[1:], start=2)
        if any(cell.strip() for cell in row)
    ]
    table = np.array(numbers, dtype=np.float64).reshape(-1, len(needed))
    return table[:, 0], table[:, 1:]


def _number(file: Path, line: int, *, row: list[str], place: int, name: str) -> float:
    """Return the finite number in a cell of a table."""
    text = row[place] if place < len(row) else ""
    try:
        number = float(text)
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise InputError(
            f"found {excerpt(text)!r}; expected a finite number",
            file,
            where=f"line {line}, column {name!r}",
        )
    return number


def _read_archive(file: Path, measured: Signal) -> tuple[Array, Array]:
    """Return the keys (N,) and the values (N, C) of an NPZ archive: its arrays called
    `measured.key` and "values". Positions of markers (N, M, 3) become (N, 3 M).
    """
    try:
        arrays = load_arrays(file)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, InputError):
            raise error.located(file) from error
        raise InputError(
            f"this file cannot be read ({reason(error)}); expected an archive of numpy.savez", file
        ) from error
    for name in (measured.key, VALUES_NAME):
        if name not in arrays:
            raise InputError(
                f"the array {name!r} is missing; found {listed(arrays) or 'no arrays'}; expected "
                f"{measured.key} and {VALUES_NAME}",
                file,
            )
    keys = _real_numbers(file, measured.key, array=arrays[measured.key])
    values = _real_numbers(file, VALUES_NAME, array=arrays[VALUES_NAME])
    count = len(measured.columns)
    shapes: list[tuple[int, ...]] = [(keys.size, count)]
    if measured.quantity == "markers":
        shapes.append((keys.size, count // 3, 3))
    if keys.ndim != 1 or values.shape not in shapes:
        raise InputError(
            f"found {measured.key} {keys.shape} and {VALUES_NAME} {values.shape}; expected (N,) and "
            f"(N, {count}), the columns in the order of {measured.columns[0]} … "
            f"{measured.columns[-1]}",
            file,
        )
    return keys, values.reshape(keys.size, count)


def _real_numbers(file: Path, name: str, array: Array) -> Array:
    """Return an array of an archive as floats."""
    if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        raise InputError(
            "found an array with values that are not finite numbers; expected real, finite numbers",
            file,
            where=name,
        )
    return np.asarray(array, dtype=np.float64)


def _rows_of_samples(file: Path, keys: Array, measured: Signal) -> Index:
    """Return the index (T,) of the row nearest to each of the T measured samples."""
    needed = measured.keys
    if not keys.size:
        raise InputError(
            f"the prediction has no rows; expected one for each of {needed.size} samples", file
        )
    rows = np.abs(keys[None, :] - needed[:, None]).argmin(axis=1)
    interval = np.diff(needed).min(initial=1.0)
    missing = np.abs(keys[rows] - needed) > TIME_TOLERANCE * interval
    if missing.any():
        first = needed[missing][0]
        raise InputError(
            f"there is no row with {measured.key} = {first:.12g}, nor for {missing.sum() - 1} other "
            f"samples of {needed.size}; the nearest is {keys[rows[missing][0]]:.12g}; expected rows "
            f"at the times of the file _times.csv, to {TIME_TOLERANCE * interval:.1g}",
            file,
        )
    return rows
