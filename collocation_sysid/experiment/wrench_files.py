"""Wrench files: CSV with t_s and any of fx_n, fy_n, fz_n, tx_nm, ty_nm, tz_nm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import InputError, hint_at
from .clock import TIME_TOLERANCE_S, first_time_fault, unrounded_s
from .formats.plain import read_grid
from .formats.text import Grid, decode, listed, numbers, read_bytes
from .wrench import COMPONENTS

WRENCH_COLUMNS = tuple(f"{c}_{'n' if c.startswith('f') else 'nm'}" for c in COMPONENTS)

# So many samples must lie within an experiment.
FEWEST = 3
# What people write, and what it says.
_OTHER_UNITS = {
    "kg": "kilograms, which are a mass",
    "kgf": "kilograms-force",
    "mn": "millinewtons",
    "kn": "kilonewtons",
    "lbf": "pounds-force",
    "nmm": "newton millimetres",
    "mnm": "millinewton metres",
}
_FACTORS = {"kgf": 9.80665, "mn": 1e-3, "kn": 1e3, "lbf": 4.4482216, "nmm": 1e-3, "mnm": 1e-3}


def read_wrench(path: str | Path) -> tuple[Array, Array]:
    """Read what a grasp gives the body over time, columns in any order; blank cells are missing.

    Returns
    -------
    t_s : (S,) array
    values : (S, 6) array
        fx, fy, fz [N], tx, ty, tz [N m]; NaN where missing.

    Raises
    ------
    InputError
        If a column names no unit or another one, is unknown or repeated, a cell is not a number,
        or time does not increase; the line is named.
    """
    table = read_grid(path, decode(read_bytes(path), path))
    for column in table.columns:
        _check_column(column, table)
    if "t_s" not in table.columns or len(table.columns) < 2:
        raise _other_columns(table, "")
    t_s = numbers(table, [table.columns.index("t_s")], blank_allowed=False)[:, 0]
    if fault := first_time_fault(t_s):
        raise InputError(fault[1], path, f"line {table.lines[fault[0]]}")
    values = np.full((len(t_s), 6), np.nan)
    for k, name in enumerate(WRENCH_COLUMNS):
        if name in table.columns:
            values[:, k] = numbers(table, [table.columns.index(name)], blank_allowed=True)[:, 0]
    named = [name for name in WRENCH_COLUMNS if name in table.columns]
    if empty := [name for name in named if _blank(values, name)]:
        raise InputError(f"column {empty[0]} is blank throughout; leave it out", path)
    return (unrounded_s(t_s) if len(t_s) > 2 else t_s), values


def within(at_s: Array, t_s: Array, name: str, static: bool) -> NDArray[np.bool_]:
    """Return which samples at `at_s` (S,) of a file lie within an experiment's times `t_s` (T,).

    Of a static experiment one is enough.

    Raises
    ------
    InputError
        If fewer than three do: clocks or units differ.
    """
    inside = (at_s >= t_s[0] - TIME_TOLERANCE_S) & (at_s <= t_s[-1] + TIME_TOLERANCE_S)
    fewest = 1 if static else FEWEST
    if inside.sum() >= fewest:
        return inside
    span = [f"{t[0]:.6g} s to {t[-1]:.6g} s" for t in (at_s, t_s)]
    ratio = np.ptp(at_s) / max(np.ptp(t_s), TIME_TOLERANCE_S)
    thousand = 300 < ratio < 3000
    hint = (
        f"{name} seems to be in milliseconds"
        if thousand
        else "both need one clock, in seconds; subtract where they began"
    )
    raise InputError(
        f"{name} runs from {span[0]}, the experiment from {span[1]}: {int(inside.sum())} samples "
        f"are in common; expected {fewest} at least. {hint}"
    )


def _blank(values: Array, name: str) -> bool:
    return bool(np.isnan(values[:, WRENCH_COLUMNS.index(name)]).all())


def _check_column(column: str, table: Grid) -> None:
    if column in ("t_s", *WRENCH_COLUMNS):
        if table.columns.count(column) > 1:
            raise _other_columns(table, f"; {column} is there twice")
        return
    what, _, unit = column.lower().replace("·", "").partition("_")
    if what in COMPONENTS:
        wanted = WRENCH_COLUMNS[COMPONENTS.index(what)]
        if not unit:
            raise InputError(
                f"column {column} names no unit; expected {wanted}", table.path, "line 1"
            )
        times = f": multiply by {_FACTORS[unit]:g}" if unit in _FACTORS else ""
        said = f" ({_OTHER_UNITS[unit]})" if unit in _OTHER_UNITS else ""
        raise InputError(
            f"column {column} has the unit {unit}{said}; expected {wanted}{times}",
            table.path,
            "line 1",
        )
    if what in ("t", "time", "timestamp"):
        raise InputError(
            f"column {column} is no time in seconds; expected t_s, on the clock of the poses",
            table.path,
            "line 1",
        )
    raise _other_columns(table, f": {column} is none of them{hint_at(column, WRENCH_COLUMNS)}")


def _other_columns(table: Grid, why: str) -> InputError:
    return InputError(
        f"the columns are {listed(table.columns)}; expected t_s and any of "
        f"{listed(WRENCH_COLUMNS)}, each once{why}",
        table.path,
        "line 1",
    )
