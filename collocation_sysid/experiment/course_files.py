"""Tensions and pressures over time: CSV with the columns t_s, and tension_n or pressure_pa."""

from __future__ import annotations

from pathlib import Path

from ..arrays import Array
from ..errors import InputError
from .clock import first_time_fault
from .formats.plain import read_grid
from .formats.text import Grid, decode, listed, numbers, read_bytes

# Pressures far above these are likely in another unit, tensions in grams or from a raw sensor.
LARGEST_PA, LARGEST_N = 1e8, 1e5


def read_tension(path: str | Path) -> tuple[Array, Array]:
    """Read the tension of a tendon, `t_s` (T,) and `tension_n` (T,), columns in any order.

    Raises
    ------
    InputError
        If a column is missing or unknown, a cell is not a number, time does not increase, or a
        tension is negative; the line is named.
    """
    table, t_s, tension = _read(path, "tension_n", "newtons")
    for row in (tension < 0).nonzero()[0]:
        raise InputError(
            f"tension_n is {tension[row]:g}; expected 0 or more, since a tendon only pulls: take "
            "the sensor's offset off",
            path,
            f"line {table.lines[row]}",
        )
    _refuse_above(LARGEST_N, tension, "tension_n", table)
    return t_s, tension


def read_pressure(path: str | Path) -> tuple[Array, Array]:
    """Read a pressure above the surroundings', `t_s` (T,) and `pressure_pa` (T,); see above."""
    table, t_s, pressure = _read(path, "pressure_pa", "pascals above the surroundings")
    _refuse_above(LARGEST_PA, pressure, "pressure_pa", table)
    return t_s, pressure


def _read(path: str | Path, name: str, unit: str) -> tuple[Grid, Array, Array]:
    table = read_grid(path, decode(read_bytes(path), path))
    if sorted(table.columns) != sorted(("t_s", name)):
        raise InputError(
            f"the columns are {listed(table.columns)}; expected t_s in seconds and {name} in "
            f"{unit}, each once: columns are named after their units",
            path,
            "line 1",
        )
    columns = [table.columns.index(column) for column in ("t_s", name)]
    values = numbers(table, columns, blank_allowed=False)
    if fault := first_time_fault(values[:, 0]):
        raise InputError(fault[1], path, f"line {table.lines[fault[0]]}")
    return table, values[:, 0], values[:, 1]


def _refuse_above(largest: float, values: Array, name: str, table: Grid) -> None:
    for row in (abs(values) > largest).nonzero()[0]:
        raise InputError(
            f"{name} is {values[row]:g}, which no soft body bears; check the unit of the column",
            table.path,
            f"line {table.lines[row]}",
        )
