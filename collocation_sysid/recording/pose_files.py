"""Files of poses: CSV with quaternions or 4×4 matrices, and NumPy archives of matrices."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..common.array_files import load_arrays
from ..common.array_types import Array
from ..common.files import DAMAGE
from ..errors import InputError
from .poses import PoseSequence, first_matrix_fault, first_pose_fault
from .sources.columns import find_time, name_and_unit
from .sources.messages import POSE
from .sources.source import as_table, open_source
from .sources.text import Table, is_number, names_file_in_errors, numeric_cells, times_in_column
from .sources.units import METRES_PER_UNIT, expected_units, require_length_unit, si_factor

POSE_COLUMNS = ("t_s", *POSE)

_MATRIX_COLUMNS = tuple(f"m{row}{column}" for row in range(4) for column in range(4))
_ORDERS = ("xyzw", "wxyz")
_ZIP = b"PK\x03\x04"


@names_file_in_errors
def read_poses(
    path: str | Path, quaternion: str | None = None, length_unit: str | None = None
) -> PoseSequence:
    """Read poses of a grasp, which map undeformed to current positions.

    A CSV has the columns t_s, x_m, y_m, z_m (or in other units, also as "Time (ms)" and "X [mm]";
    or x, y, z and `length_unit`) and a quaternion, in any order: qx, qy, qz, qw, or q0 … q3 or q1 …
    q4 and its order in `quaternion`. A CSV without column names holds t, x, y, z and a quaternion,
    whose order and unit are `quaternion` and `length_unit`. A CSV with m00, m01 … m33 beside t_s
    holds 4×4 matrices row by row, a NumPy archive (.npz) has them as `matrices` (T, 4, 4) beside
    `t_s` (T,); both in metres unless `length_unit` is given.

    Parameters
    ----------
    quaternion : {"xyzw", "wxyz"}, optional
        Order of a quaternion whose columns do not name its components.
    length_unit : {"m", "cm", "mm", "in"}, optional
        Unit of the positions, where the columns do not name it.

    Raises
    ------
    InputError
        If a column is missing, unknown or repeated, a cell is not a number, time does not increase,
        a quaternion is not of unit norm or a matrix is no rigid motion; the line is named. Also if
        order or unit is neither in the file nor given, or both disagree.
    """
    require_length_unit(length_unit)
    if quaternion not in (None, *_ORDERS):
        raise InputError(f"quaternion is {quaternion!r}; expected one of {', '.join(_ORDERS)}")
    source = open_source(path)
    if isinstance(source, bytes) and source.startswith(_ZIP):
        t_s, matrices = _read_archive(path)
        places = [f"index {k}" for k in range(len(t_s))]
        return _from_matrices(t_s, matrices, length_unit=length_unit, row_names=places)
    grid = _with_column_names(as_table(source, names_required=False))
    lines = [f"line {line}" for line in grid.lines]
    time = find_time(grid)
    if time is None:
        raise _column_error(grid)
    t_s = times_in_column(grid, *time)
    others = [k for k in range(len(grid.columns)) if k != time[0]]
    if sorted(grid.columns[k] for k in others) == sorted(_MATRIX_COLUMNS):
        matrices = _read_columns(grid, map(grid.columns.index, _MATRIX_COLUMNS)).reshape(-1, 4, 4)
        return _from_matrices(t_s, matrices, length_unit=length_unit, row_names=lines)
    axes, metres = _position_columns(grid, length_unit)
    components = _quaternion_columns(grid, quaternion, columns=[k for k in others if k not in axes])
    positions_m = _read_columns(grid, axes) * metres
    return _checked_sequence(
        t_s, positions_m, quaternions=_read_columns(grid, components), row_names=lines
    )


def _checked_sequence(
    t_s: Array, positions_m: Array, quaternions: Array, row_names: list[str]
) -> PoseSequence:
    """Return a smooth sequence from positions (T, 3) [m] and quaternions (T, 4), x, y, z, w."""
    if fault := first_pose_fault(t_s, positions_m, quaternions_xyzw=quaternions):
        raise InputError(fault[1], where=row_names[fault[0]])
    return PoseSequence(t_s, positions_m, quaternions_xyzw=quaternions)


# Columns ------------------------------------------------------------------------------------------


def _read_columns(grid: Table, places: Iterable[int]) -> Array:
    """Return the cells of columns (indices) as numbers; blank cells are refused."""
    return numeric_cells(grid, list(places), blank_allowed=False)


def _with_column_names(table: Table) -> Table:
    """Name eight unnamed columns t_s, x, y, z and q0 to q3, whose order is stated elsewhere."""
    if len(table.columns) != 8 or not all(map(is_number, table.columns)):
        return table
    names = ["t_s", "x", "y", "z", "q0", "q1", "q2", "q3"]
    return Table(names, np.vstack([table.columns, table.cells]), [1, *table.lines])


def _column_error(grid: Table) -> InputError:
    return grid.error_at(
        f"the columns are {', '.join(grid.columns)}; expected {', '.join(POSE_COLUMNS)}, each once "
        "(or t_s and m00, m01 … m33)"
    )


def _position_columns(grid: Table, length_unit: str | None) -> tuple[list[int], float]:
    """Return the indices of x, y, z (or capitals), and the factor to metres."""
    parts = [name_and_unit(column) for column in grid.columns]
    axes = [k for axis in "xyz" for k, (name, _) in enumerate(parts) if name.lower() == axis]
    units = [parts[k][1] for k in axes]
    metres = [si_factor(unit or length_unit or "m", "length") for unit in units]
    if len(axes) == 3 and None in metres:
        wrong = metres.index(None)
        raise grid.error_at(
            f"column {grid.columns[axes[wrong]]} has the unit {units[wrong]}; expected "
            f"{expected_units(str(units[wrong]), 'length')}"
        )
    if len(axes) != 3 or len(set(metres)) > 1:
        raise _column_error(grid)
    named = ", ".join(grid.columns[k] for k in axes)
    if length_unit is None and None in units:
        raise grid.error_at(
            f"the columns {named} state no unit; expected length_unit, one of "
            f"{', '.join(METRES_PER_UNIT)}, or columns such as x_m, y_m, z_m"
        )
    if length_unit and any(
        unit and si_factor(unit, "length") != METRES_PER_UNIT[length_unit] for unit in units
    ):
        raise grid.error_at(
            f"length_unit is '{length_unit}', but the columns are {named}; expected the same "
            "unit, or no length_unit"
        )
    return axes, float(metres[0] or 1.0)


def _quaternion_columns(grid: Table, order: str | None, columns: list[int]) -> list[int]:
    """Return the indices of the columns of the quaternion in the order x, y, z, w."""
    place = {grid.columns[k]: k for k in columns}
    if sorted(place) == ["qw", "qx", "qy", "qz"]:
        named = "".join(name[1] for name in place)
        if order not in (None, named):
            raise grid.error_at(
                f"quaternion is '{order}', but the columns are {', '.join(place)}; expected the "
                "same order, or no quaternion"
            )
        return [place[f"q{axis}"] for axis in "xyzw"]
    numbered = sorted(place)
    if len(columns) != 4 or numbered not in (["q0", "q1", "q2", "q3"], ["q1", "q2", "q3", "q4"]):
        raise _column_error(grid)
    if order is None:
        raise grid.error_at(
            f"the columns {', '.join(numbered)} do not state which one is the scalar; expected "
            "quaternion = 'xyzw' or 'wxyz', or columns qx, qy, qz, qw"
        )
    return [place[numbered[order.index(axis)]] for axis in "xyzw"]


# Matrices -----------------------------------------------------------------------------------------


def _read_archive(path: str | Path) -> tuple[Array, Array]:
    """Return `t_s` (T,) and `matrices` (T, 4, 4) of a NumPy archive, in its unit."""
    try:
        arrays = load_arrays(path)
    except InputError:
        raise
    except (*DAMAGE, OSError) as error:
        raise InputError(f"this is not a NumPy archive of numbers: {error}") from error
    shapes = {key: array.shape for key, array in arrays.items()}
    shape = shapes.get("t_s", ())
    if len(shape) != 1 or shapes.get("matrices") != (*shape, 4, 4) or not shape[0]:
        raise InputError(
            "the archive contains "
            f"{', '.join(f'{key} {size}' for key, size in shapes.items()) or 'nothing'}; expected "
            "t_s (T,) and matrices (T, 4, 4)"
        )
    try:
        return arrays["t_s"].astype(np.float64), arrays["matrices"].astype(np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"t_s and matrices must hold numbers: {error}") from error


def _from_matrices(
    t_s: Array, matrices: Array, length_unit: str | None, row_names: list[str]
) -> PoseSequence:
    """Return the poses of matrices (T, 4, 4) at times (T,) [s]."""
    if fault := first_matrix_fault(t_s, matrices):
        raise InputError(fault[1], where=row_names[fault[0]])
    metres = METRES_PER_UNIT[length_unit or "m"]
    quaternions = Rotation.from_matrix(matrices[:, :3, :3]).as_quat()
    return _checked_sequence(
        t_s, matrices[:, :3, 3] * metres, quaternions=quaternions, row_names=row_names
    )
