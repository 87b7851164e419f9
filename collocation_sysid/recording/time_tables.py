"""Tables of loads and measurements over time: columns with units, in any order."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..common.array_types import Array
from ..errors import InputError, hint_at
from .poses import PoseSequence
from .sample_times import TIME_TOLERANCE_S, unrounded_s
from .sources.columns import (
    ANGLE,
    DISPLACEMENT,
    DISPLACEMENTS,
    FORCES,
    PRESSURE,
    STRAIN,
    TENSION,
    TIME,
    TORQUE,
    Quantity,
    QuantityTable,
    find_time,
    read_columns,
)
from .sources.source import read_table
from .sources.text import names_file_in_errors, numeric_cells, times_in_column

# Largest plausible pressure [Pa]: larger ones are likely in another unit.
LARGEST_PA = 1e8
# Largest plausible tension [N]: larger ones are likely in another unit, or raw counts of a sensor.
LARGEST_N = 1e5
# Least number of samples of a file within a moving experiment: fewer come from different clocks.
FEWEST_SHARED_SAMPLES = 3


def read_forces(path: str | Path, notes: list[str] | None = None) -> tuple[Array, Array]:
    """Read a force over time: t_s, fx_n, fy_n, fz_n, columns in any order; `notes` are added to.

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
    table = _noted(read_columns(path, FORCES, requires_all=True), notes)
    return table.t_s, np.column_stack([table.values[quantity.key] for quantity in FORCES])


def read_tension(path: str | Path, notes: list[str] | None = None) -> tuple[Array, Array]:
    """Read the tension of a tendon, `t_s` (T,) and `tension_n` (T,), columns in any order; `notes`
    are added to.

    Raises
    ------
    InputError
        If a column is missing or unknown, a cell is not a number, time does not increase, or a
        tension is negative; the line is named.
    """
    return _read_limited(path, TENSION, largest=LARGEST_N, at_least=0.0, notes=notes)


def read_pressure(path: str | Path, notes: list[str] | None = None) -> tuple[Array, Array]:
    """Read a pressure above the surroundings', `t_s` (T,) and `pressure_pa` (T,), columns in any
    order; `notes` are added to.

    Raises
    ------
    InputError
        If a column is missing or unknown, a cell is not a number, time does not increase, or a
        pressure is implausibly large; the line is named.
    """
    return _read_limited(
        path,
        PRESSURE,
        largest=LARGEST_PA,
        notes=notes,
        other_kinds={"absolute": "the pressure above that of the surroundings"},
    )


def _noted(table: QuantityTable, notes: list[str] | None) -> QuantityTable:
    """Return the table, whose notes are added to a list, if there is one."""
    if notes is not None:
        notes += table.notes
    return table


@names_file_in_errors
def _read_limited(
    path: str | Path,
    quantity: Quantity,
    largest: float,
    notes: list[str] | None,
    at_least: float = -np.inf,
    other_kinds: Mapping[str, str] | None = None,
) -> tuple[Array, Array]:
    table = _noted(read_columns(path, [quantity], other_kinds=other_kinds), notes)
    values = table.values[quantity.key]
    for row in (~((values >= at_least) & (abs(values) <= largest))).nonzero()[0]:
        is_so = f"{quantity.column} is {values[row]:g}"
        if abs(values[row]) > largest:
            why = f", too large for a soft body; expected at most {largest:g}: check the unit of the column"
        else:
            why = "; expected 0 or more, because a tendon only pulls: subtract the offset of the sensor"
        raise table.grid.error_at(is_so + why, int(row))
    return table.t_s, values


# Displacements of a grasp ------------------------------------------------------------------------


def read_displacement(
    path: str | Path,
    columns: Mapping[str, str] | None = None,
    axis: str = "z",
    sign: int = 1,
    length_m: float | None = None,
    timed: bool = True,
    scale: float = 1.0,
    other_columns: Collection[str] = (),
    header_line: int | None = None,
    point_m: Sequence[float] | None = None,
    notes: list[str] | None = None,
) -> PoseSequence:
    """Read displacements from the undeformed place over time, such as those of a crosshead.

    A table has t_s and any of x_m, y_m and z_m (or _cm, _mm, _in), or a machine's displacement,
    angle or strain, in any order; along the other axes nothing moves.

    Parameters
    ----------
    columns : mapping, optional
        Names of the columns of x, y, z, or of a machine's displacement, angle or strain, and of t,
        if their names are not recognised.
    axis : {"x", "y", "z"}
        Axis of a machine's displacement, angle or strain.
    sign : {1, -1}
        Factor on the file's values: -1 if positive values go against the axis.
    length_m : float, optional
        Undeformed length that an engineering strain multiplies; given if the file holds a strain.
    timed : bool
        Whether times are required; otherwise rows are numbered in seconds if there are no times.
    scale : float
        Factor on the displacements: share that the modelled part of the specimen has.
    other_columns : collection of str
        Columns of the file that hold something else, such as the noise of a force.
    header_line : int, optional
        Line of the column names, see `read_columns`.
    point_m : (3,) sequence, optional
        Point of the axis of rotation; needed if the file has angles.
    notes : list of str, optional
        Words of column names that are not understood are added to it.

    Returns
    -------
    PoseSequence
        Translations, and rotations about the axis if the file has angles.

    Raises
    ------
    InputError
        If a column is missing, unknown, repeated or without unit, a cell is not a number, or time
        does not increase; the line is named.
    """
    table = _read_displacements(
        path, columns, axis, length_m, timed=timed, other=other_columns, header_line=header_line
    )
    _noted(table, notes)
    factor = sign * scale
    shifts = axis_components(table, DISPLACEMENTS, axis=axis)
    shifts_m = factor * (length_m or 1.0) * np.nan_to_num(shifts)
    turns = np.zeros((len(table.t_s), 3))
    if ANGLE.key in table.values:
        if point_m is None:
            raise InputError(
                "found a column of angles, but not point_m; expected point_m, a point of the axis of "
                "rotation",
                str(path),
            )
        turns[:, "xyz".index(axis)] = factor * table.values[ANGLE.key]
        centre = np.asarray(point_m, dtype=float)
        shifts_m = shifts_m + centre - Rotation.from_rotvec(turns).apply(centre)
    return PoseSequence(table.t_s, shifts_m, quaternions_xyzw=Rotation.from_rotvec(turns).as_quat())


def displaced_axes(
    path: str | Path,
    columns: Mapping[str, str] | None = None,
    axis: str = "z",
    length_m: float | None = None,
    other_columns: Collection[str] = (),
    header_line: int | None = None,
) -> str:
    """Return the axes along which a file has displacements, such as "z" or "xy"; empty if it has
    none, and without regard to their values.

    Arguments and errors are those of `read_displacement`; times are not required.
    """
    table = _read_displacements(
        path, columns, axis, length_m, timed=False, other=other_columns, header_line=header_line
    )
    shifts = axis_components(table, DISPLACEMENTS, axis=axis)
    is_present = np.asarray(np.isfinite(shifts).any(axis=0))
    return "".join(each for each, there in zip("xyz", is_present, strict=True) if there)


def other_axes(axis: str) -> dict[str, str]:
    """Return the axes that the names of a machine's columns may not state, with the remedy."""
    return {each: f'axis = "{each}"' for each in "xyz" if each != axis}


def _read_displacements(
    path: str | Path,
    columns: Mapping[str, str] | None,
    axis: str,
    length_m: float | None,
    timed: bool,
    other: Collection[str],
    header_line: int | None,
) -> QuantityTable:
    """Read a displacement, or a strain if the undeformed length `length_m` [m] is given."""
    quantities = (*DISPLACEMENTS, DISPLACEMENT, ANGLE) if length_m is None else (STRAIN,)
    return read_columns(
        path,
        quantities,
        column_names=columns,
        requires_times=timed,
        other_columns=other,
        header_line=header_line,
        other_kinds={**other_axes(axis), "volume": "the strain along the axis"},
    )


def axis_components(table: QuantityTable, quantities: Sequence[Quantity], axis: str) -> Array:
    """Return the values (T, n) of n quantities of a table, one for each axis, in the order of
    `quantities`; NaN where missing.

    A machine's quantity, whose name contains no axis, becomes the component along `axis` ("x", "y"
    or "z").
    """
    places = {quantity.key: k for k, quantity in enumerate(quantities)}
    places |= {TORQUE.key: 3 + "xyz".index(axis), ANGLE.key: len(quantities)}
    values = np.full((len(table.t_s), len(quantities) + 1), np.nan)
    for key, column in table.values.items():
        values[:, places.get(key, "xyz".index(axis))] = column
    return values[:, :-1]


def without_rounding(t_s: Array) -> Array:
    """Return times without the rounding of the file, see `unrounded_s`; two or fewer stay."""
    return unrounded_s(t_s) if len(t_s) > 2 else t_s


@names_file_in_errors
def read_points(path: str | Path) -> Array:
    """Read points (k, 3) [m] from columns x_m, y_m and z_m; a missing column is zero.

    Raises
    ------
    InputError
        If there are fewer than two of these columns, or a cell is not a number; the line is named.
    """
    grid = read_table(path)
    found = [name for name in ("x_m", "y_m", "z_m") if grid.columns.count(name) == 1]
    if len(found) < 2:
        raise grid.error_at(
            f"found the columns {', '.join(grid.columns)}; expected x_m, y_m and z_m, of which one "
            "may be missing in a plane"
        )
    columns = [grid.columns.index(name) for name in found]
    values = numeric_cells(grid, columns, blank_allowed=False)
    points = np.zeros((len(values), 3))
    points[:, [("x_m", "y_m", "z_m").index(name) for name in found]] = values
    return points


# Custom sensors -----------------------------------------------------------------------------------


@names_file_in_errors
def read_custom_sensor(
    path: str | Path, columns: Sequence[str] = ()
) -> tuple[Array, Array, list[str]]:
    """Return sample times (S,) [s] of a custom sensor, its values (S, m), NaN where a cell is blank,
    and the names of their m columns.

    Parameters
    ----------
    columns : sequence of str
        Columns of the values; all besides the times by default.

    Raises
    ------
    InputError
        If a column is missing or repeated, a cell is not a number, or time does not increase; the
        line is named.
    """
    grid = read_table(path)
    time = find_time(grid, [k for k, name in enumerate(grid.columns) if name in columns])
    time_name = TIME.column if time is None else grid.columns[time[0]]
    names = list(columns) or [name for name in grid.columns if name != time_name]
    for name in (time_name, *names):
        if (count := grid.columns.count(name)) != 1:
            there = f"{count} columns are called" if count else "there is no column"
            hint = "" if count else hint_at(name, grid.columns)
            among = ", ".join(grid.columns)
            raise grid.error_at(f"{there} {name!r}; expected one among {among}{hint}")
    assert time is not None  # otherwise there is no such column
    t_s = times_in_column(grid, *time)
    values = numeric_cells(grid, [grid.columns.index(name) for name in names], blank_allowed=True)
    return without_rounding(t_s), np.asarray(values), names


def is_within_experiment(
    sample_times_s: Array, t_s: Array, name: str, is_static: bool
) -> NDArray[np.bool_]:
    """Return which samples lie within an experiment's times, as (S,) bool; its ends are included.

    Parameters
    ----------
    sample_times_s : (S,) array
        Sample times of a file.
    t_s : (T,) array
        Times of the experiment.
    name : str
        What was sampled, for messages.
    is_static : bool
        Whether one sample is enough.

    Raises
    ------
    InputError
        If fewer than three samples do (one if static), as when clocks or units differ.
    """
    is_inside = (sample_times_s >= t_s[0] - TIME_TOLERANCE_S) & (
        sample_times_s <= t_s[-1] + TIME_TOLERANCE_S
    )
    fewest = 1 if is_static else FEWEST_SHARED_SAMPLES
    if is_inside.sum() >= fewest:
        return is_inside
    span = [f"{t[0]:.6g} s to {t[-1]:.6g} s" for t in (sample_times_s, t_s)]
    ratio = np.ptp(sample_times_s) / max(np.ptp(t_s), TIME_TOLERANCE_S)
    hint = (
        f"{name} seems to be in milliseconds"
        if 300 < ratio < 3000
        else "both need the same clock, in seconds; subtract their starting times"
    )
    raise InputError(
        f"{name} runs from {span[0]}, the experiment from {span[1]}: {int(is_inside.sum())} "
        f"samples are common to both; expected at least {fewest}. {hint}"
    )
