"""Force files: CSV with the columns t_s, fx_n, fy_n, fz_n."""

from __future__ import annotations

from pathlib import Path

from ..arrays import Array
from ..errors import InputError
from .clock import first_time_fault
from .formats.plain import read_grid
from .formats.text import decode, listed, numbers, read_bytes

FORCE_COLUMNS = ("t_s", "fx_n", "fy_n", "fz_n")


def read_forces(path: str | Path) -> tuple[Array, Array]:
    """Read a force over time, its columns in any order.

    Returns
    -------
    t_s : (T,) array
    force_n : (T, 3) array

    Raises
    ------
    InputError
        If a column is missing or unknown, a cell is not a number, or time does not increase; the
        line is named.
    """
    table = read_grid(path, decode(read_bytes(path), path))
    if sorted(table.columns) != sorted(FORCE_COLUMNS):
        raise InputError(
            f"the columns are {listed(table.columns)}; expected {listed(FORCE_COLUMNS)}, each once",
            path,
            "line 1",
        )
    columns = [table.columns.index(name) for name in FORCE_COLUMNS]
    values = numbers(table, columns, blank_allowed=False)
    if fault := first_time_fault(values[:, 0]):
        raise InputError(fault[1], path, f"line {table.lines[fault[0]]}")
    return values[:, 0], values[:, 1:]
