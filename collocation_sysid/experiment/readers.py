"""Pose and marker files: CSV with the unit in the column name or in `length_unit`.

Poses: columns t_s, x_m, y_m, z_m, qx, qy, qz, qw in any order. Markers: t_s, then <name>_x,
<name>_y, <name>_z for each marker; a blank cell or NaN is a missing sample.
"""

from __future__ import annotations

import csv
import difflib
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from .arrays import FloatArray, read_only_floats, read_only_tracks
from .clock import first_time_fault
from .grasp import PoseSequence, first_pose_fault

POSE_COLUMNS = ("t_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
METRES_PER_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}

_AXES = ("x", "y", "z")
_DIGITS = "%.12g"


@dataclass(frozen=True, eq=False)
class MarkerTable:
    """Marker tracks as measured, before they are tied to a body.

    Parameters
    ----------
    t_s : (T,) array
        Sample times, strictly increasing.
    names : tuple of str
        M marker names.
    positions_m : (T, M, 3) array
        NaN where missing; a sample with one coordinate missing loses all three.
    """

    t_s: FloatArray
    names: tuple[str, ...]
    positions_m: FloatArray

    def __post_init__(self) -> None:
        names = tuple(self.names)
        t_s = read_only_floats(self.t_s, (None,), "t_s of the markers")
        if fault := first_time_fault(t_s):
            raise InputError(fault[1], where=f"row {fault[0] + 1}")
        shape = (len(t_s), len(names), 3)
        positions = read_only_tracks(self.positions_m, shape, "marker positions")
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "t_s", t_s)
        object.__setattr__(self, "positions_m", positions)


def read_poses_csv(path: str | Path) -> PoseSequence:
    """Read grasp poses; the quaternion's columns are told apart by name, in any order.

    Raises
    ------
    InputError
        If a column is missing, unknown or repeated, a cell is not a number, time does not
        increase, or a quaternion is not of unit norm; the line is named.
    """
    header, lines, rows = _read_csv(path)
    if sorted(header) != sorted(POSE_COLUMNS):
        raise InputError(
            f"the columns are {_listed(header)}; expected {_listed(POSE_COLUMNS)}, each once",
            path,
            "line 1",
        )
    columns = [header.index(name) for name in POSE_COLUMNS]
    values = _numbers(path, header, lines, rows, columns, blank_allowed=False)
    t_s, positions_m, quaternions = values[:, 0], values[:, 1:4], values[:, 4:]
    if fault := first_pose_fault(t_s, positions_m, quaternions):
        raise InputError(fault[1], path, f"line {lines[fault[0]]}")
    return PoseSequence(t_s, positions_m, quaternions)


def read_markers_csv(
    path: str | Path, names: Sequence[str] | None = None, length_unit: str = "m"
) -> MarkerTable:
    """Read marker tracks.

    Parameters
    ----------
    path : str or Path
        The file.
    names : sequence of str, optional
        Markers to take, in this order; by default all, in the file's order.
    length_unit : {"m", "cm", "mm", "in"}
        Unit of the coordinates in the file.

    Raises
    ------
    InputError
        If the columns are not as expected, a marker asked for is not there, a cell is not a
        number, or time does not increase; the line is named.
    """
    if length_unit not in METRES_PER_UNIT:
        raise InputError(
            f"length_unit is {length_unit!r}; expected one of {_listed(METRES_PER_UNIT)}"
        )
    header, lines, rows = _read_csv(path)
    there = _marker_names(path, header)
    taken = there if names is None else _asked_for(path, there, names)
    columns = [header.index(f"{name}_{axis}") for name in taken for axis in _AXES]
    t_s = _numbers(path, header, lines, rows, [header.index("t_s")], blank_allowed=False)[:, 0]
    if fault := first_time_fault(t_s):
        raise InputError(fault[1], path, f"line {lines[fault[0]]}")
    values = _numbers(path, header, lines, rows, columns, blank_allowed=True)
    positions = values.reshape(len(rows), len(taken), 3) * METRES_PER_UNIT[length_unit]
    return MarkerTable(t_s, tuple(taken), positions)


def write_poses_csv(path: str | Path, poses: PoseSequence) -> None:
    """Write poses in the format `read_poses_csv` reads; the file appears whole or not at all."""
    values = np.column_stack([poses.t_s, poses.positions_m, poses.quaternions_xyzw])
    _write_csv(path, POSE_COLUMNS, values)


def write_markers_csv(
    path: str | Path, t_s: ArrayLike, names: Sequence[str], positions_m: ArrayLike
) -> None:
    """Write marker tracks (T, M, 3) in metres as `read_markers_csv` reads them, blank for NaN."""
    table = MarkerTable(np.asarray(t_s), tuple(names), np.asarray(positions_m))
    header = ["t_s", *(f"{name}_{axis}" for name in table.names for axis in _AXES)]
    tracks = table.positions_m.reshape(len(table.t_s), -1)
    _write_csv(path, header, np.column_stack([table.t_s, tracks]))


def _read_csv(path: str | Path) -> tuple[list[str], list[int], list[list[str]]]:
    """Header, line number of each row, and rows of stripped cells; blank lines are skipped."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            cells = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path) from error
    except UnicodeDecodeError:
        raise InputError(
            "is not a CSV text file (UTF-8); expected comma-separated values", path
        ) from None
    except csv.Error as error:
        raise InputError(f"is not a CSV text file: {error}", path) from error
    cells = [(line, row) for line, row in cells if any(row)]
    if not cells:
        raise InputError("is empty; expected a line of column names, then rows of numbers", path)
    header = cells[0][1]
    if len(header) == 1 and any(mark in header[0] for mark in ";\t"):
        raise InputError(
            "the cells are separated by semicolons or tabs; expected commas, and points in numbers",
            path,
            "line 1",
        )
    if len(cells) == 1:
        raise InputError("has column names but no rows of numbers", path)
    for line, row in cells[1:]:
        if len(row) != len(header):
            raise InputError(
                f"{len(row)} cells, but the header has {len(header)} columns", path, f"line {line}"
            )
    return header, [line for line, _ in cells[1:]], [row for _, row in cells[1:]]


def _numbers(
    path: str | Path,
    header: list[str],
    lines: list[int],
    rows: list[list[str]],
    columns: list[int],
    blank_allowed: bool,
) -> FloatArray:
    """The cells of some columns as (rows, columns); NaN where blank."""
    values = np.empty((len(rows), len(columns)))
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            cell = row[column]
            try:
                value = float(cell) if cell else math.nan
            except ValueError:
                value = math.inf
            if math.isinf(value) or (math.isnan(value) and not blank_allowed):
                or_blank = " or a blank cell" if blank_allowed else ""
                raise InputError(
                    f"column {header[column]} holds '{cell}'; expected a number{or_blank}",
                    path,
                    f"line {lines[i]}",
                )
            values[i, j] = value
    return values


def _marker_names(path: str | Path, header: list[str]) -> list[str]:
    """Names of the markers in the file, in the order of their first columns."""
    names = dict.fromkeys(
        column[:-2] for column in header if len(column) > 2 and column[-2:] in ("_x", "_y", "_z")
    )
    expected = ["t_s", *(f"{name}_{axis}" for name in names for axis in _AXES)]
    unknown = [column for column in header if column not in expected]
    missing = [column for column in expected if column not in header]
    repeated = sorted({column for column in header if header.count(column) > 1})
    faults = [
        f"{what} {_listed(columns)}"
        for what, columns in (("unknown", unknown), ("missing", missing), ("repeated", repeated))
        if columns
    ]
    if not faults and names:
        return list(names)
    raise InputError(
        f"columns {'; '.join(faults) or 'hold no markers'}; expected t_s and, for each marker, "
        f"<name>_x, <name>_y, <name>_z; found {_listed(header)}",
        path,
        "line 1",
    )


def _asked_for(path: str | Path, there: list[str], names: Sequence[str]) -> list[str]:
    if not names:
        raise InputError("no markers are asked for; leave the names out to take all of them", path)
    for name in names:
        if name not in there:
            close = difflib.get_close_matches(name, there, n=1)
            hint = f"; did you mean '{close[0]}'?" if close else ""
            raise InputError(f"no marker '{name}'; the file has {_listed(there)}{hint}", path)
        if list(names).count(name) > 1:
            raise InputError(f"marker '{name}' is asked for more than once", path)
    return list(names)


def _write_csv(path: str | Path, header: Sequence[str], values: FloatArray) -> None:
    """Write beside the target and rename, so that a reader never meets half a file."""
    target = Path(path)
    draft = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        with open(draft, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(header)
            for row in values:
                writer.writerow("" if math.isnan(value) else _DIGITS % value for value in row)
        os.replace(draft, target)
    finally:
        draft.unlink(missing_ok=True)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names)
