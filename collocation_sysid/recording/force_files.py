"""What acts over time: forces at nodes, tensions of tendons, pressures, as tables with units."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import InputError
from .formats.columns import FORCES, PRESSURE, TENSION, Quantity, read_columns
from .formats.text import Grid

# Pressures far above these are likely in another unit, tensions in grams or from a raw sensor.
LARGEST_PA, LARGEST_N = 1e8, 1e5


def read_forces(path: str | Path) -> tuple[Array, Array]:
    """Read a force over time: t_s, fx_n, fy_n, fz_n, in any order.

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
    found = read_columns(path, FORCES, all_of=True)
    return found.t_s, np.column_stack([found.values[quantity.key] for quantity in FORCES])


def read_tension(path: str | Path) -> tuple[Array, Array]:
    """Read the tension of a tendon, `t_s` (T,) and `tension_n` (T,), columns in any order.

    Raises
    ------
    InputError
        If a column is missing or unknown, a cell is not a number, time does not increase, or a
        tension is negative; the line is named.
    """
    grid, t_s, tension = _one(path, TENSION, LARGEST_N)
    for row in (tension < 0).nonzero()[0]:
        raise InputError(
            f"tension_n is {tension[row]:g}; expected 0 or more, since a tendon only pulls: take "
            "the sensor's offset off",
            path,
            f"line {grid.lines[row]}",
        )
    return t_s, tension


def read_pressure(path: str | Path) -> tuple[Array, Array]:
    """Read a pressure above the surroundings', `t_s` (T,) and `pressure_pa` (T,); see above."""
    return _one(path, PRESSURE, LARGEST_PA)[1:]


def _one(path: str | Path, quantity: Quantity, largest: float) -> tuple[Grid, Array, Array]:
    found = read_columns(path, [quantity])
    values = found.values[quantity.key]
    for row in (abs(values) > largest).nonzero()[0]:
        raise InputError(
            f"{quantity.column} is {values[row]:g}, which no soft body bears; check the unit of "
            "the column",
            path,
            f"line {found.grid.lines[row]}",
        )
    return found.grid, found.t_s, values
