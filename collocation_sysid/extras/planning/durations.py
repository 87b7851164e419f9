"""Durations of a task: the shortest that suffices, found by bisection.

A task is stretched to another duration with all times of its references. Bisection assumes that a
longer duration is not worse.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from .planned_program import PlannedProgram
from .reduced_solver import HandLimitsExcludeTask, smoothest_motion

# Relative accuracy of a shortest duration, and the largest factor from the stated duration.
ACCURACY, LARGEST_FACTOR = 0.02, 16.0
T = TypeVar("T")


def shortest(
    attempt: Callable[[float], T | None], stated_s: float, first: T | None
) -> tuple[float, T] | None:
    """Return the shortest duration that suffices, within `ACCURACY`, and what `attempt` returned for
    it; None if none up to `LARGEST_FACTOR` times the stated duration does.

    Parameters
    ----------
    attempt : callable
        Function of a duration [s] that returns None if it does not suffice.
    stated_s : float
        Stated duration [s], which is tried first.
    first : optional
        What `attempt` returned for the stated duration.
    """
    factor = 2.0 if first is None else 0.5
    best = None if first is None else (stated_s, first)
    other_s = stated_s
    while True:
        previous_s, other_s = other_s, factor * other_s
        if not 1 / LARGEST_FACTOR <= other_s / stated_s <= LARGEST_FACTOR:
            return best
        found = attempt(other_s)
        if found is not None:
            best = other_s, found
        if (found is None) == (first is not None):
            break
    fails_s = previous_s if first is None else other_s
    assert best is not None
    while best[0] / fails_s > 1 + ACCURACY:
        middle_s = float(np.sqrt(best[0] * fails_s))
        found = attempt(middle_s)
        if found is None:
            fails_s = middle_s
        else:
            best = middle_s, found
    return best


def shortest_of_hand(program: PlannedProgram) -> float | None:
    """Return the shortest duration in which the hand reaches its end within its limits [s], longer
    than that of the task; None if there is none.
    """

    def attempt(duration_s: float) -> bool | None:
        try:
            smoothest_motion(program.with_duration(duration_s))
        except (HandLimitsExcludeTask, np.linalg.LinAlgError):
            return None
        return True

    found = shortest(attempt, program.task.duration_s, None)
    return None if found is None else found[0]
