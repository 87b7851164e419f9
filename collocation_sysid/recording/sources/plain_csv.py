"""Plain CSV of marker tracks, the project's own format, with a row of column names.

Wide: t_s, then <name>_x, <name>_y, <name>_z for each marker, in metres, and optionally <name>_sigma,
the standard deviation of its coordinates in each sample. Long: t_s, marker, and x_m,
y_m, z_m (or _cm, _mm, _in; or x, y, z and a given unit); a marker without a row at a time is
missing there. In both, the unit may stand in brackets behind the names, as in "tip_x (mm)" or "tip X
(mm)", a blank cell or NaN is a missing sample, as is a coordinate x or y of which no marker has a column,
and (0, 0, 0) is a measured place. A column "Frame" of
a wide table is ignored.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...errors import InputError, listed
from ..sample_times import first_unordered_time
from .columns import find_time
from .raw_tracks import LabelChooser, RawTracks
from .text import Table, numeric_cells, times_in_column
from .units import METRES_PER_UNIT, length_unit_of_spelling

_BRACKETED = re.compile(r"(?P<name>.*?)\s*[(\[](?P<unit>[^()\[\]]+)[)\]]")
# A column of a marker: the axis behind its name, as in "tip_x", "tip X" or "tip:x".
_PLACE = re.compile(r"(?P<marker>.+?)[ .:_](?P<axis>[xyz]|sigma)", re.IGNORECASE)
# End of the name of a column of standard deviations.
SIGMA = "_sigma"
# Columns without a measurement.
_IGNORED = ("Frame", "frame")
# Number of columns that messages list.
_LISTED = 8


def read(given: Table, choose: LabelChooser) -> RawTracks:
    """Read the table of a plain CSV file, wide or long (with a column "marker"); `choose` returns
    the indices of the markers to read from their labels.

    Raises
    ------
    InputError
        If columns are missing or unknown, a cell is neither blank nor a number, or time does not
        increase.
    """
    table, unit, to_seconds = _without_units(given)
    read = _read_long if "marker" in table.columns else _read_wide
    tracks = read(table, choose, to_seconds)
    return tracks if unit is None else replace(tracks, unit=unit, unit_key="the columns' names")


def _without_units(table: Table) -> tuple[Table, str | None, float]:
    """Return the table without units, the unit of the coordinates, and the factor to seconds."""
    columns = [*table.columns]
    units: dict[str | None, str] = {}
    places = []
    for k, column in enumerate(table.columns):
        parts = _BRACKETED.fullmatch(column)
        name, stated = (column, "") if parts is None else (parts["name"], parts["unit"].strip())
        if place := _PLACE.fullmatch(name):
            name = f"{place['marker']}_{place['axis'].lower()}"
        if not (name in ("x", "y", "z") or name.endswith(("_x", "_y", "_z", SIGMA))):
            continue
        unit = length_unit_of_spelling(stated)
        if stated and unit not in METRES_PER_UNIT:
            raise table.error_at(
                f"column {column} has the unit {stated}; expected one of "
                f"{', '.join(METRES_PER_UNIT)}: convert its values"
            )
        units[unit] = column
        columns[k] = name
        places.append(k)
    if len(units) > 1:
        raise table.error_at(
            f"the columns {listed(units.values())} have different units; expected the same of all"
        )
    to_seconds = 1.0
    if "t_s" not in columns and (time := find_time(table, measured=places)) is not None:
        columns[time[0]], to_seconds = "t_s", time[1]
    return replace(table, columns=columns), next(iter(units), None), to_seconds


def _read_wide(table: Table, choose: LabelChooser, to_seconds: float) -> RawTracks:
    """Read a table with three columns for each marker, in metres unless another unit is stated."""
    table = _with_blank_axis(table)
    labels = _wide_labels(table)
    place = {column: k for k, column in enumerate(table.columns)}
    places = [[place[f"{label}_{axis}"] for axis in "xyz"] for label in labels]
    chosen = choose(labels)
    cells = numeric_cells(table, [k for at in chosen for k in places[at]], blank_allowed=True)
    tracks = RawTracks(
        [labels[k] for k in chosen],
        cells.reshape(-1, len(chosen), 3),
        t_s=times_in_column(table, place["t_s"], to_seconds),
        zeros_are_missing=False,
        default_unit="m",
    )
    noises = [place.get(f"{labels[k]}{SIGMA}") for k in chosen]
    if noises == [None] * len(noises):
        return tracks
    sigmas = np.full((len(table.cells), len(chosen)), np.nan)
    for k, column in enumerate(noises):
        if column is not None:
            sigmas[:, k] = numeric_cells(table, [column], blank_allowed=True)[:, 0]
    return replace(tracks, sigmas=sigmas)


def _with_blank_axis(table: Table) -> Table:
    """Return the table with blank columns for x or y if no marker has it: what was measured in the
    plane across this axis. Columns of x and y alone may be pixels.
    """
    of_z = [column[:-2] for column in table.columns if column.endswith("_z")]
    missing = [axis for axis in "xy" if not any(c.endswith(f"_{axis}") for c in table.columns)]
    if not of_z or len(missing) != 1:
        return table
    blank = np.full((len(table.cells), len(of_z)), "", dtype=object)
    columns = [*table.columns, *(f"{label}_{missing[0]}" for label in of_z)]
    return replace(table, columns=columns, cells=np.hstack([table.cells, blank]))


def _wide_labels(table: Table) -> list[str]:
    """The columns are t_s and, for each marker, <name>_x, <name>_y and <name>_z, in any order."""
    header = [column for column in table.columns if column not in _IGNORED]
    labels = dict.fromkeys(
        column[:-2] for column in header if len(column) > 2 and column[-2:] in ("_x", "_y", "_z")
    )
    expected = ["t_s", *(f"{label}_{axis}" for label in labels for axis in "xyz")]
    counts = Counter(header)
    known = {*expected, *(f"{label}{SIGMA}" for label in labels)}
    faulty = {
        "unknown": [column for column in header if column not in known],
        "missing": [column for column in expected if column not in counts],
        "repeated": sorted(column for column, count in counts.items() if count > 1),
    }
    faults = [f"{what} {_first_columns(columns)}" for what, columns in faulty.items() if columns]
    if not faults and labels:
        return list(labels)
    raise InputError(
        f"the columns are {_first_columns(header)} ({'; '.join(faults) or 'no markers'}); expected t_s "
        "and, for each marker, <name>_x, <name>_y, <name>_z; or a C3D, TRC, Qualisys TSV, Motive or "
        "Vicon CSV file; pixels of a video belong to [[experiment.image_tracks]]",
        where="line 1",
    )


def _first_columns(columns: Sequence[str]) -> str:
    more = len(columns) - _LISTED
    return ", ".join(columns[:_LISTED]) + (f" and {more} more" if more > 0 else "")


def _read_long(table: Table, choose: LabelChooser, to_seconds: float) -> RawTracks:
    """Read a table with one row for each marker and time; only chosen markers are checked."""
    axes, unit = _long_columns(table)
    of_row = table.cells[:, table.columns.index("marker")].tolist()
    if "" in of_row:
        raise table.error_at("column marker is blank; expected a name", of_row.index(""))
    labels = list(dict.fromkeys(of_row))
    chosen = [labels[k] for k in choose(labels)]
    times = numeric_cells(table, [table.columns.index("t_s")], blank_allowed=False)
    row_t_s = to_seconds * times[:, 0]
    t_s, frame = np.unique(row_t_s, return_inverse=True)
    coordinates = np.full((len(t_s), len(chosen), 3), np.nan)
    for k, label in enumerate(chosen):
        own = [i for i, other in enumerate(of_row) if other == label]
        rows = replace(table, cells=table.cells[own], lines=[table.lines[i] for i in own])
        if fault := first_unordered_time(row_t_s[own]):
            raise rows.error_at(f"marker '{label}': {fault[1]}", fault[0])
        columns = [table.columns.index(axis) for axis in axes]
        coordinates[frame[own], k] = numeric_cells(rows, columns, blank_allowed=True)
    return RawTracks(
        chosen,
        coordinates,
        unit=unit,
        unit_key="the columns' names",
        t_s=t_s,
        zeros_are_missing=False,
    )


def _long_columns(table: Table) -> tuple[list[str], str | None]:
    """Return the columns of x, y and z, and the unit in their names, such as "mm" of x_mm."""
    for unit in (None, *METRES_PER_UNIT):
        axes = [f"{axis}_{unit}" if unit else axis for axis in "xyz"]
        if sorted(table.columns) == sorted(["t_s", "marker", *axes]):
            return axes, unit
    raise InputError(
        f"the columns are {', '.join(table.columns)}; expected t_s, marker, and x_m, y_m, z_m "
        "(or _cm, _mm, _in, or x, y, z)",
        where="line 1",
    )
