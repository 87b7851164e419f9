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
# Order of the differences that show noise alone, and the variance of white noise in these and in
# second differences: sums of the squared binomial coefficients.
FOURTH_DIFFERENCE = 4
FOURTH_DIFFERENCE_VARIANCE = 70.0
SECOND_DIFFERENCE_VARIANCE = 6.0
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
    earlier = np.clip(np.searchsorted(t_s, at_s, side="right") - 1, 0, len(t_s) - 2)
    fraction = (at_s - t_s[earlier]) / np.diff(t_s)[earlier]
    is_between = (fraction >= 0.0) & (fraction <= 1.0) & ~is_gap(t_s)[earlier]
    share = _along_values(fraction, values)
    before = values[earlier]
    after = values[earlier + 1]
    between = np.where(
        _along_values(is_between, values), (1.0 - share) * before + share * after, np.nan
    )
    # At a sample its neighbour does not matter, even if that one is missing.
    between = np.where(np.abs(share) <= SAME_TIME_INTERVALS, before, between)
    return np.where(np.abs(share - 1.0) <= SAME_TIME_INTERVALS, after, between)


def interpolation_error(at_s: Array, t_s: Array, values: Array) -> Array:
    """Return the estimated RMS error of `interpolate_without_gaps` for each series, without that of
    the noise, from second differences; 0 where noise explains these.

    Between two samples the error of a straight line is s (1 − s) / 2 times the second difference,
    with s the share of the way. The variance of the noise is that of fourth differences, over 70.

    Parameters
    ----------
    at_s : (T,) array
        Times of the interpolation [s], within those of the samples.
    t_s : (S,) array
        Times of the samples, nearly even [s].
    values : (S, M, …) array
        Values of M series; NaN where missing.

    Returns
    -------
    (M,) array
        In the unit of the values; 0 for a series with fewer than five consecutive samples.
    """
    if len(t_s) < FOURTH_DIFFERENCE + 1:
        return np.zeros(values.shape[1])
    earlier = np.searchsorted(t_s, at_s, side="right") - 1
    earlier = np.clip(earlier, 0, len(t_s) - 2)
    share = np.clip((at_s - t_s[earlier]) / np.diff(t_s)[earlier], 0.0, 1.0)
    weight = np.mean((share * (1.0 - share) / 2.0) ** 2)
    lost = np.concatenate([[False], is_gap(t_s)])
    # A sample after a gap is no neighbour of the one before.
    known = np.where(_along_values(lost, values), np.nan, values)
    second = _mean_squares(np.diff(known, n=2, axis=0))
    noise = _mean_squares(np.diff(known, n=FOURTH_DIFFERENCE, axis=0)) / FOURTH_DIFFERENCE_VARIANCE
    curvature = np.maximum(second - SECOND_DIFFERENCE_VARIANCE * noise, 0.0)
    error: Array = np.sqrt(weight * curvature)
    return error


def _mean_squares(values: Array) -> Array:
    """Return the mean squares (M,) of values (S, M, …) other than NaN; 0 without any."""
    by_series = np.moveaxis(values, 1, 0).reshape(values.shape[1], -1)
    squares = np.nan_to_num(by_series**2).sum(axis=1)
    counts = np.isfinite(by_series).sum(axis=1)
    return squares / np.maximum(counts, 1)


def _along_values(of_times: NDArray, values: Array) -> NDArray:
    """Return numbers (T,) with the shape (T, 1, …) that multiplies values (T, …)."""
    return of_times.reshape(-1, *np.ones(values.ndim - 1, dtype=int))
