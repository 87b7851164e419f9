"""Plain CSV, this project's own, with a row of column names.

Wide: t_s, then <name>_x, <name>_y, <name>_z for each marker, in metres. Long: t_s, marker, and
x_m, y_m, z_m (or _cm, _mm, _in; or x, y, z and a unit given); a marker without a row at a time is
missing there. In both a blank cell or NaN is a missing sample, and (0, 0, 0) is a measured place.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path

import numpy as np

from ...errors import InputError
from ..clock import first_time_fault
from . import Choose, RawTracks
from .text import Grid, Row, grid, is_number, listed, numbers, separated_rows
from .units import METRES_PER_UNIT, UNITS, si_factor

_AXES = ("x", "y", "z")
_OTHER_FORMATS = "a C3D, TRC, Qualisys TSV or Motive CSV file"


def read_grid(path: str | Path, text: str) -> Grid:
    """Return a file of separated cells with a row of column names.

    What a machine writes above the names is left out; units in a row of their own are joined to
    the names, as in "Load (N)".

    Raises
    ------
    InputError
        If it is none, has no rows, or rows of different lengths.
    """
    rows = separated_rows(text, path)
    names = 0 if "t_s" in rows[0].cells else max(_first_of_numbers(rows) - 1, 0)
    header = rows[names].cells
    if names and all(map(_is_unit, header)):
        above = rows[names - 1].cells
        header = [f"{a} ({u.strip('()[]')})" for a, u in zip_longest(above, header, fillvalue="")]
    return grid(path, header, rows[names + 1 :], rows[names].line)


def _first_of_numbers(rows: Sequence[Row]) -> int:
    """Which row is the first that holds several cells of numbers only; 0 where none does."""
    numeric = (k for k, r in enumerate(rows) if len(r.cells) > 1 and _holds_numbers(r.cells))
    return next(numeric, 0)


def _holds_numbers(cells: Sequence[str]) -> bool:
    return all(is_number(cell.replace(",", ".")) for cell in cells if cell)


def _is_unit(cell: str) -> bool:
    bare = cell.strip("()[]")
    bracketed = cell in (f"({bare})", f"[{bare}]")
    return not bare or bracketed or any(si_factor(bare, dimension) for dimension in UNITS)


def read(path: str | Path, text: str, choose: Choose) -> RawTracks:
    """Read a plain CSV file, wide or long."""
    table = read_grid(path, text)
    return (_read_long if "marker" in table.columns else _read_wide)(table, choose)


def _read_wide(table: Grid, choose: Choose) -> RawTracks:
    labels = _wide_labels(table)
    chosen = [labels[k] for k in choose(labels)]
    columns = [table.columns.index(f"{label}_{axis}") for label in chosen for axis in _AXES]
    t_s = numbers(table, [table.columns.index("t_s")], blank_allowed=False)[:, 0]
    return RawTracks(
        labels=chosen,
        coordinates=numbers(table, columns, blank_allowed=True).reshape(-1, len(chosen), 3),
        t_s=t_s,
        lines=table.lines,
        zeros_are_missing=False,
        default_unit="m",
    )


def _wide_labels(table: Grid) -> list[str]:
    """Names of the markers in the file, in the order of their first columns."""
    header = table.columns
    labels = dict.fromkeys(
        column[:-2] for column in header if len(column) > 2 and column[-2:] in ("_x", "_y", "_z")
    )
    expected = ["t_s", *(f"{label}_{axis}" for label in labels for axis in _AXES)]
    unknown = [column for column in header if column not in expected]
    missing = [column for column in expected if column not in header]
    repeated = sorted({column for column in header if header.count(column) > 1})
    faults = [
        f"{what} {listed(columns)}"
        for what, columns in (("unknown", unknown), ("missing", missing), ("repeated", repeated))
        if columns
    ]
    if not faults and labels:
        return list(labels)
    raise InputError(
        f"columns {'; '.join(faults) or 'hold no markers'}; expected t_s and, for each marker, "
        f"<name>_x, <name>_y, <name>_z; found {listed(header)}; or {_OTHER_FORMATS}",
        table.path,
        "line 1",
    )


def _read_long(table: Grid, choose: Choose) -> RawTracks:
    axes, unit = _long_layout(table)
    of_row = _markers_of_rows(table)
    labels = list(dict.fromkeys(of_row))
    chosen = [labels[k] for k in choose(labels)]
    row_t_s = numbers(table, [table.columns.index("t_s")], blank_allowed=False)[:, 0]
    t_s, frame = np.unique(row_t_s, return_inverse=True)
    coordinates = np.full((len(t_s), len(chosen), 3), np.nan)
    for k, label in enumerate(chosen):
        own = [i for i, other in enumerate(of_row) if other == label]
        rows = Grid(table.path, table.columns, [table.rows[i] for i in own])
        if fault := first_time_fault(row_t_s[own]):
            line = rows.lines[fault[0]]
            raise InputError(f"marker '{label}': {fault[1]}", table.path, f"line {line}")
        columns = [table.columns.index(axis) for axis in axes]
        coordinates[frame[own], k] = numbers(rows, columns, blank_allowed=True)
    return RawTracks(
        labels=chosen,
        coordinates=coordinates,
        unit=unit,
        unit_key="the columns' names",
        t_s=t_s,
        zeros_are_missing=False,
    )


def _long_layout(table: Grid) -> tuple[list[str], str | None]:
    """The columns of x, y and z, and the unit in their names."""
    for unit in (None, *METRES_PER_UNIT):
        axes = [f"{axis}_{unit}" if unit else axis for axis in _AXES]
        if sorted(table.columns) == sorted(["t_s", "marker", *axes]):
            return axes, unit
    raise InputError(
        f"the columns are {listed(table.columns)}; expected t_s, marker, and x_m, y_m, z_m "
        "(or _cm, _mm, _in, or x, y, z)",
        table.path,
        "line 1",
    )


def _markers_of_rows(table: Grid) -> list[str]:
    place = table.columns.index("marker")
    of_row = [row.cells[place] for row in table.rows]
    if "" in of_row:
        line = table.lines[of_row.index("")]
        raise InputError("column marker is blank; expected a name", table.path, f"line {line}")
    return of_row
