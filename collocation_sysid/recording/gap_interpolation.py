"""Linear interpolation of sampled positions in time that does not bridge lost samples.

Use this module where a value between two samples is wanted only if they are consecutive. A sampling
interval counts as a gap if it is longer than `LARGEST_GAP_INTERVALS` median intervals.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array

# Sampling interval, in median intervals, above which samples were lost: at twice the median one is.
LARGEST_GAP_INTERVALS = 1.5
# Distance of equal times, in sampling intervals: rounding of the times.
SAME_TIME_INTERVALS = 1e-6


def is_gap(t_s: Array) -> NDArray[np.bool_]:
    """Return whether each interval between the times (S,) is a gap, (S − 1,); S ≥ 2."""
    intervals_s = np.diff(t_s)
    return intervals_s > LARGEST_GAP_INTERVALS * np.median(intervals_s)


def interpolate_without_gaps(at_s: Array, t_s: Array, values: Array) -> Array:
    """Return values at other times, linear between consecutive samples.

    Parameters
    ----------
    at_s : (T,) array
        Times [s].
    t_s : (S,) array
        Times of the samples, increasing [s].
    values : (S, …) array
        Values of the samples; NaN where missing.

    Returns
    -------
    (T, …) array
        NaN in gaps, before the first and after the last sample, and beside a missing sample. At a
        time within `SAME_TIME_INTERVALS` of a sample it is the value of that sample, whatever its
        neighbours are; a single sample is found at exactly its own time only.
    """
    if len(t_s) < 2:
        is_sample = _along_values(at_s == t_s[0], values)
        return np.where(is_sample, values[0], np.nan)
    earlier = np.clip(
        np.searchsorted(t_s, at_s, side="right") - 1, 0, len(t_s) - 2
    )
    fraction = (at_s - t_s[earlier]) / np.diff(t_s)[earlier]
    is_between = (fraction >= 0.0) & (fraction <= 1.0) & ~is_gap(t_s)[earlier]
    share = _along_values(fraction, values)
    before = values[earlier]
    after = values[earlier + 1]
    between = np.where(
        _along_values(is_between, values),
        (1.0 - share) * before + share * after,
        np.nan,
    )
    # At a sample its neighbour does not matter, even if that one is missing.
    between = np.where(np.abs(share) <= SAME_TIME_INTERVALS, before, between)
    return np.where(np.abs(share - 1.0) <= SAME_TIME_INTERVALS, after, between)


def _along_values(of_times: NDArray, values: Array) -> NDArray:
    """Return numbers (T,) with the shape (T, 1, …) that multiplies values (T, …)."""
    return of_times.reshape(-1, *np.ones(values.ndim - 1, dtype=int))
