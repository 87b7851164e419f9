"""One clock for an experiment: poses and markers on the same evenly spaced times."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..arrays import Array
from ..errors import InputError
from .clock import STEP_TOLERANCE, even_times_s, rounding_s, sample_interval_s
from .poses import PoseSequence
from .readers import MarkerTable

# Rows of a marker file further apart than this many usual steps have lost frames between them.
_GAP_STEPS = 1.5
_SAME_TIME_STEPS = 1e-6


def align(
    poses: PoseSequence,
    table: MarkerTable,
    window_s: tuple[float, float] | None = None,
    resample_hz: float | None = None,
    every: int = 1,
) -> tuple[Array, PoseSequence, MarkerTable]:
    """Put poses and markers on one evenly spaced time grid.

    Without `resample_hz` the grid is the markers' own time and no measurement is changed; the
    poses must have a sample at each of those times, and may have more in between. With it, both
    are interpolated to that rate: markers linearly, and only between two present neighbours;
    poses linearly with SLERP. The grid depends on `table`, `window_s` and `resample_hz` only, so
    several pose sequences align to the same one. A single pose goes with any time.

    Parameters
    ----------
    poses : PoseSequence
        Poses of one grasp.
    table : MarkerTable
        Marker tracks on the same clock.
    window_s : (float, float), optional
        Samples before the first or after the second time are cut.
    resample_hz : float, optional
        Rate of the new grid, which starts at the first sample left.
    every : int
        Only every so-manieth sample of the markers is used.

    Returns
    -------
    t_s : (T,) array
        The grid.
    poses : PoseSequence
        Poses over the grid, with a sample at each of its times unless it is a single pose.
    table : MarkerTable
        Markers on the grid.

    Raises
    ------
    InputError
        If the window is empty, the markers' time is uneven, or the poses do not cover it or lack
        samples at it.
    """
    table = table if window_s is None else _cut(table, window_s)
    if every > 1:
        table = MarkerTable(table.t_s[::every], table.names, table.positions_m[::every])
    if resample_hz is not None:
        return _resample(poses, table, resample_hz)
    step_s = sample_interval_s(table.t_s, "markers")
    grid = even_times_s(table.t_s)
    poses = _matched(poses, table.t_s, step_s, grid)
    return grid, poses, MarkerTable(grid, table.names, table.positions_m)


def _cut(table: MarkerTable, window_s: tuple[float, float]) -> MarkerTable:
    first_s, last_s = window_s
    steps = np.diff(table.t_s)
    slack_s = STEP_TOLERANCE * float(np.median(steps)) if steps.size else 0.0
    kept = (table.t_s >= first_s - slack_s) & (table.t_s <= last_s + slack_s)
    if not kept.any():
        raise InputError(
            f"window_s = [{first_s:g}, {last_s:g}] holds no marker sample; "
            f"the markers run from {table.t_s[0]:.9g} s to {table.t_s[-1]:.9g} s"
        )
    return MarkerTable(table.t_s[kept], table.names, table.positions_m[kept])


def _resample(
    poses: PoseSequence, table: MarkerTable, rate_hz: float
) -> tuple[Array, PoseSequence, MarkerTable]:
    if not (np.isfinite(rate_hz) and rate_hz > 0.0):
        raise InputError(f"resample_hz is {rate_hz:g}; expected a rate above 0")
    t_s = table.t_s
    count = int(np.floor((t_s[-1] - t_s[0]) * rate_hz + _SAME_TIME_STEPS)) + 1
    if count < 2:
        raise InputError(
            f"resample_hz = {rate_hz:g} leaves one sample between {t_s[0]:.9g} s and "
            f"{t_s[-1]:.9g} s; raise it or widen window_s"
        )
    grid = t_s[0] + np.arange(count) / rate_hz
    resampled = MarkerTable(grid, table.names, _between_neighbours(table, grid))
    if len(poses.t_s) == 1:
        return grid, poses, resampled
    rotations, positions_m = replace(poses, interpolation="linear").at(grid)
    quaternions = Rotation.from_matrix(rotations).as_quat()
    return grid, PoseSequence(grid, positions_m, quaternions, poses.interpolation), resampled


def _between_neighbours(table: MarkerTable, grid: Array) -> Array:
    """Marker positions on the grid; NaN beside a missing sample or in a gap of the time."""
    t_s, x = table.t_s, table.positions_m
    k = np.clip(np.searchsorted(t_s, grid, side="right") - 1, 0, len(t_s) - 2)
    step_s = t_s[k + 1] - t_s[k]
    fraction = ((grid - t_s[k]) / step_s)[:, None, None]
    between = (1.0 - fraction) * x[k] + fraction * x[k + 1]
    between[step_s > _GAP_STEPS * np.median(np.diff(t_s))] = np.nan
    # On a sample its neighbour does not matter, even if that one is missing.
    on_earlier = fraction <= _SAME_TIME_STEPS
    on_later = fraction >= 1.0 - _SAME_TIME_STEPS
    return np.where(on_earlier, x[k], np.where(on_later, x[k + 1], between))


def _matched(poses: PoseSequence, t_s: Array, step_s: float, grid: Array) -> PoseSequence:
    """Poses from the first to the last marker time, with their samples moved onto the grid."""
    if len(poses.t_s) == 1:
        return poses
    tolerance_s = STEP_TOLERANCE * step_s + 0.5 * (rounding_s(t_s) + rounding_s(poses.t_s))
    later = np.clip(np.searchsorted(poses.t_s, t_s), 1, len(poses.t_s) - 1)
    nearest = later - (t_s - poses.t_s[later - 1] < poses.t_s[later] - t_s)
    apart = np.abs(poses.t_s[nearest] - t_s) > tolerance_s
    if apart.any():
        raise InputError(_mismatch(poses, t_s, float(t_s[apart][0])))
    kept = slice(nearest[0], nearest[-1] + 1)
    return replace(
        poses,
        t_s=np.interp(poses.t_s[kept], poses.t_s[nearest], grid),
        positions_m=poses.positions_m[kept],
        quaternions_xyzw=poses.quaternions_xyzw[kept],
    )


def _mismatch(poses: PoseSequence, t_s: Array, lacking_s: float) -> str:
    found = (
        f"there is no pose at the marker time {lacking_s:.9g} s: poses run from "
        f"{poses.t_s[0]:.9g} s to {poses.t_s[-1]:.9g} s at {_rate_hz(poses.t_s):.6g} Hz, "
        f"markers from {t_s[0]:.9g} s to {t_s[-1]:.9g} s at {_rate_hz(t_s):.6g} Hz"
    )
    if poses.t_s[0] <= lacking_s <= poses.t_s[-1]:
        return f"{found}; set resample_hz to bring both to one rate"
    return f"{found}; cut the experiment with window_s, and set resample_hz if the rates differ"


def _rate_hz(t_s: Array) -> float:
    return (len(t_s) - 1) / float(t_s[-1] - t_s[0])
