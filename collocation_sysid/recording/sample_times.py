"""Sample times: checks of even spacing, and rounding in files."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..common.array_types import Array
from ..errors import InputError

# Largest deviation of a time step from the mean step, as a share of it.
STEP_TOLERANCE = 0.01
# Difference of equal times [s]: rounding of the ends of windows.
TIME_TOLERANCE_S = 1e-9
# Largest rounding of printed times, in steps: more could hide a lost frame.
_ROUNDING_LIMIT = 0.3
# Shortest time step [s]: no clock resolves less, and rates of shorter steps overflow.
SHORTEST_STEP_S = 1e-12
_PRINTED_DECIMALS = range(10)


def sample_interval_s(t_s: ArrayLike, what: str) -> float:
    """Return the mean time between samples, which must be the same throughout.

    Steps may differ from the mean by `STEP_TOLERANCE` of it, and by the rounding of times to the
    decimals in the file.

    Parameters
    ----------
    t_s : (T,) array
        At least two sample times.
    what : str
        What was sampled, for messages.

    Raises
    ------
    InputError
        If there are fewer than two samples, time does not increase, or the spacing is uneven; the
        row is named, counting from 1.
    """
    times = np.asarray(t_s, dtype=np.float64)
    if times.ndim != 1 or len(times) < 2:
        raise InputError(
            f"{what}: the number of samples is {times.size}; expected at least two, because the "
            "interval between samples is needed"
        )
    if fault := first_unordered_time(times):
        raise InputError(f"{what}: {fault[1]}", None, where=f"row {fault[0] + 1}")
    steps = np.diff(times)
    if not has_even_steps(times):
        # A lost frame also shifts the mean, and with it every other step: name the worst.
        typical_s = float(np.median(steps))
        row = int(np.argmax(np.abs(steps - typical_s)))
        raise InputError(
            f"{what}: the time jumps by {steps[row]:.6g} s from t_s = {times[row]:.9g} to "
            f"{times[row + 1]:.9g}, where other steps are {typical_s:.6g} s; samples must be "
            "evenly spaced: fill lost frames with blank rows, or set resample_hz",
            None,
            where=f"row {row + 2}",
        )
    return float(times[-1] - times[0]) / len(steps)


def has_even_steps(t_s: Array) -> bool:
    """Whether the steps of at least two times (T,) differ from their mean by at most
    `STEP_TOLERANCE` of it, and by the rounding of times to the decimals in the file; false for NaN.
    """
    steps_s = np.diff(t_s)
    mean_s = float(t_s[-1] - t_s[0]) / len(steps_s)
    tolerance_s = STEP_TOLERANCE * mean_s + printed_rounding_s(t_s)
    return bool((np.abs(steps_s - mean_s) <= tolerance_s).all())


def first_unordered_time(t_s: Array) -> tuple[int, str] | None:
    """Return the index, from 0, of the first time that is not more than `SHORTEST_STEP_S` after its
    predecessor, and a message; None if all times increase. NaN counts as not increasing.
    """
    faulty = np.flatnonzero(~(np.diff(t_s) > SHORTEST_STEP_S))
    if not faulty.size:
        return None
    row = int(faulty[0]) + 1
    return (row, f"t_s = {t_s[row]:.9g} follows {t_s[row - 1]:.9g}; time must increase")


def evenly_spaced_s(t_s: Array) -> Array:
    """Return evenly spaced times with the same first and last time and number
    as `t_s` (T,), T > 0.
    """
    return np.linspace(t_s[0], t_s[-1], len(t_s))


def printed_rounding_s(t_s: Array) -> float:
    """Return the unit of the last decimal [s] if rounding to it made even times uneven, else 0.

    Times of 30 Hz printed as 0.033, 0.067, 0.1 give 0.001; times 0.01, 0.02, 0.03 are even without
    rounding and give 0, as do times that need more than 9 decimals. The result is limited to
    `_ROUNDING_LIMIT` mean steps.
    """
    mean_s = float(t_s[-1] - t_s[0]) / max(len(t_s) - 1, 1)
    if np.abs(t_s - evenly_spaced_s(t_s)).max() <= 1e-6 * mean_s:
        return 0.0
    for decimals in _PRINTED_DECIMALS:
        if np.allclose(t_s, np.round(t_s, decimals), rtol=1e-13, atol=1e-13):
            return min(10.0**-decimals, _ROUNDING_LIMIT * mean_s)
    return 0.0


def unrounded_s(t_s: Array) -> Array:
    """Return evenly spaced times if rounding to the printed decimals explains all unevenness of
    `t_s` (T,).

    Other times are returned unchanged.
    """
    even = evenly_spaced_s(t_s)
    return even if np.abs(t_s - even).max() <= printed_rounding_s(t_s) else t_s
