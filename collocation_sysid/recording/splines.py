"""Smooth motion through samples: cubic between them, but not through a jump."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline, PPoly

from ..arrays import Array, Index

# No motion that its samples resolve is this many times slower just before and just after.
_JUMP_RATIO = 10.0
# Of the whole range: less is rounding.
_LEAST_JUMP = 1e-3


def jumps(t_s: Array, values: Array) -> Index:
    """Return the intervals in which values (m, k) jump, numbered by their first sample.

    A jump is a change that is more than 10 times as fast as those just before and just after.
    """
    change = np.linalg.norm(np.diff(values, axis=0), axis=1)
    rate = change / np.diff(t_s)
    large = change > _LEAST_JUMP * np.linalg.norm(np.ptp(values, axis=0))
    around = np.maximum(rate[:-2], rate[2:])
    return 1 + np.flatnonzero(large[1:-1] & (rate[1:-1] > _JUMP_RATIO * around))


def smooth_spline(t_s: Array, values: Array) -> PPoly:
    """Return the cubic spline through values (m, k), m > 1, with two continuous derivatives.

    Across a jump it is linear, and separate splines end on either side: one spline would
    overshoot around it. Few samples make a parabola or a line.
    """
    broken = jumps(t_s, values)
    coefficients = np.zeros((4, len(t_s) - 1, values.shape[1]))
    for first, end in pairwise([0, *(broken + 1), len(t_s)]):
        if end - first > 1:
            piece = CubicSpline(t_s[first:end], values[first:end])
            coefficients[:, first : end - 1] = piece.c
    coefficients[3, broken] = values[broken]
    steps_s = (t_s[broken + 1] - t_s[broken])[:, None]
    coefficients[2, broken] = (values[broken + 1] - values[broken]) / steps_s
    return PPoly(coefficients, t_s)
