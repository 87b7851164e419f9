"""Files of poses, markers and custom sensors in the project's own format: CSV in SI units."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..common.array_types import Array
from ..common.files import replaced_file
from .marker_files import MarkerTable
from .pose_files import POSE_COLUMNS
from .poses import PoseSequence
from .sources.plain_csv import SIGMA

_DIGITS = "%.12g"


def write_poses_csv(path: str | Path, poses: PoseSequence) -> None:
    """Write poses as `read_poses` reads them, without their interpolation; the file is replaced
    only when it is complete.
    """
    values = np.column_stack([poses.t_s, poses.positions_m, poses.quaternions_xyzw])
    _write_csv(path, POSE_COLUMNS, values=values)


def write_markers_csv(
    path: str | Path,
    t_s: ArrayLike,
    names: Sequence[str],
    positions_m: ArrayLike,
    sigma_m: ArrayLike | None = None,
) -> None:
    """Write marker tracks (T, M, 3) [m], and σ (T, M) [m] of each sample if given, as `read_markers`
    reads them; a sample with a coordinate that is not finite becomes three blank cells.

    Raises
    ------
    InputError
        If shapes disagree or time does not increase.
    """
    table = MarkerTable(np.asarray(t_s), tuple(names), positions_m=np.asarray(positions_m))
    header = ["t_s", *(f"{name}_{axis}" for name in table.names for axis in "xyz")]
    values = [table.t_s, table.positions_m.reshape(len(table.t_s), -1)]
    if sigma_m is not None:
        header += [f"{name}{SIGMA}" for name in table.names]
        values.append(np.asarray(sigma_m))
    _write_csv(path, header, values=np.column_stack(values))


def write_columns_csv(path: str | Path, columns: Mapping[str, ArrayLike]) -> None:
    """Write columns (T,) under their names, blank for NaN; the file is replaced only when it is
    complete.
    """
    _write_csv(
        path, [*columns], values=np.column_stack([np.asarray(each) for each in columns.values()])
    )


def write_gauge_csv(
    path: str | Path, t_s: ArrayLike, names: Sequence[str], values: ArrayLike
) -> None:
    """Write values (S, m) of a custom sensor at times (S,) [s], with one name per column, as
    `read_custom_sensor` reads them; NaN becomes a blank cell.
    """
    _write_csv(path, ["t_s", *names], values=np.column_stack([np.asarray(t_s), np.asarray(values)]))


def _write_csv(path: str | Path, header: Sequence[str], values: Array) -> None:
    """Write rows with 12 digits, NaN as blank; a file is replaced only when complete."""
    with replaced_file(path) as draft, open(draft, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for row in values + 0.0:  # without the sign of a zero
            writer.writerow("" if math.isnan(value) else _DIGITS % value for value in row)
