"""Files of readings of one's own: t_s, and a column for each number."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import InputError, hint_at
from .clock import first_time_fault, unrounded_s
from .formats.plain import read_grid
from .formats.text import decode, listed, numbers, read_bytes


def read_gauge(path: str | Path, columns: Sequence[str] = ()) -> tuple[Array, Array, list[str]]:
    """Read times (S,) and what an instrument said then (S, m); NaN where a cell is blank.

    Parameters
    ----------
    path : str or Path
    columns : sequence of str
        Those of its numbers; all besides t_s by default. Their names are given back.

    Raises
    ------
    InputError
        If a column is missing or repeated, a cell is not a number, or time does not increase; the
        line is named.
    """
    grid = read_grid(path, decode(read_bytes(path), path))
    wanted = list(columns) or [name for name in grid.columns if name != "t_s"]
    for name in ("t_s", *wanted):
        if (count := grid.columns.count(name)) != 1:
            found = f"{count} columns are called" if count else "there is no column"
            hint = "" if count else hint_at(name, grid.columns)
            raise InputError(
                f"{found} {name!r}; expected one among {listed(grid.columns)}{hint}",
                path,
                f"line {grid.names_line}",
            )
    t_s = numbers(grid, [grid.columns.index("t_s")], False)[:, 0]
    if fault := first_time_fault(t_s):
        raise InputError(fault[1], path, f"line {grid.lines[fault[0]]}")
    values = numbers(grid, [grid.columns.index(name) for name in wanted], True)
    return unrounded_s(t_s) if len(t_s) > 2 else t_s, np.asarray(values), wanted
