"""Extrapolation of the solutions of earlier time steps, as the first guess of the next one."""

from __future__ import annotations

import numpy as np

from ...common.array_types import Array

# Number of earlier values that are used: more do not decrease the number of iterations.
MOST_VALUES = 6


def next_value(values: Array) -> Array:
    """Return an extrapolation (…) of equally spaced values (k, …), oldest first, k ≥ 1, by the
    polynomial that would have predicted the last of them best; zero if none is better than zero.

    The degree follows from the values: high for a smooth motion, low where it oscillates within
    steps or after an impact.
    """
    differences = values[-MOST_VALUES:]
    guess = np.zeros_like(differences[-1])
    while len(differences):
        latest = differences[-1]
        differences = np.diff(differences, axis=0)
        # The next difference is the error of the last prediction with the latest one.
        if len(differences) and np.linalg.norm(differences[-1]) >= np.linalg.norm(latest):
            break
        guess += latest
    return guess
