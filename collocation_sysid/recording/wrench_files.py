"""Wrench files: any of fx_n, fy_n, fz_n, tx_nm, ty_nm, tz_nm, or a machine's force or stress."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import InputError
from .clock import TIME_TOLERANCE_S, unrounded_s
from .formats.columns import FORCE, FORCES, STRESS, TORQUES, read_columns

WRENCH_COLUMNS = tuple(quantity.column for quantity in (*FORCES, *TORQUES))

# So many samples must lie within an experiment.
FEWEST = 3


def read_wrench(
    path: str | Path,
    columns: Mapping[str, str] | None = None,
    axis: str = "z",
    sign: int = 1,
    area_m2: float | None = None,
    symmetry: int = 1,
    timed: bool = True,
) -> tuple[Array, Array]:
    """Read what a grasp gives the body over time, columns in any order; blank cells are missing.

    Parameters
    ----------
    path : str or Path
    columns : mapping, optional
        The column of fx, fy, fz, tx, ty, tz, or of a machine's force or stress, and of t, where
        their names are not recognised.
    axis : {"x", "y", "z"}
        Along which a machine's force or stress acts.
    sign : {1, -1}
        What multiplies the file's values: -1 where a positive one pulls the body the other way.
    area_m2 : float, optional
        The undeformed area that an engineering stress multiplies.
    symmetry : int
        The body is one of so many equal parts of what was measured.
    timed : bool
        Whether there must be times; else rows count as seconds where there are none.

    Returns
    -------
    t_s : (S,) array
    values : (S, 6) array
        fx, fy, fz [N], tx, ty, tz [N m]; NaN where missing.

    Raises
    ------
    InputError
        If a column names no unit or one of something else, is unknown or repeated, a cell is not a
        number, or time does not increase; the line is named.
    """
    components = [quantity.key for quantity in (*FORCES, *TORQUES)]
    wanted = (*FORCES, *TORQUES, FORCE) if area_m2 is None else (STRESS,)
    found = read_columns(path, wanted, columns, blank_allowed=True, timed=timed)
    values = np.full((len(found.t_s), 6), np.nan)
    for key, column in found.values.items():
        component = key if key in components else f"f{axis}"
        values[:, components.index(component)] = sign * (area_m2 or 1.0) / symmetry * column
    return (unrounded_s(found.t_s) if len(found.t_s) > 2 else found.t_s), values


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
