"""Whether the poses in a file tell a grasp's motion over the whole of its recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import InputError
from .poses import PoseSequence

# Poses further apart do not tell how a grasp moves between them.
LONGEST_STEP_S = 1.0
# Poses that differ by less, in metres and in a quaternion's components, are of one that stands.
STILL = 1e-6


def refuse_untold(
    poses: PoseSequence, t_s: Array, held_s: tuple[float, float], file: str | Path
) -> None:
    """Refuse poses that leave open how a grasp moves while it holds.

    Parameters
    ----------
    poses : PoseSequence
    t_s : (T,) times of the recording's samples
    held_s : (float, float)
        First and last time at which the grasp holds.
    file : str or Path
        Where the poses are from.

    Raises
    ------
    InputError
        Of a single pose, of poses that are missing for more than a sample at an end, and of a
        smooth motion that is sampled below 1 Hz.
    """
    first_s, last_s = max(t_s[0], held_s[0]), min(t_s[-1], held_s[1])
    lasts = f"the recording lasts from {first_s:.6g} s to {last_s:.6g} s"
    if len(poses.t_s) == 1:
        raise InputError(
            f"holds one pose, and {lasts}; expected poses over all of it, or the same pose at "
            "both times if the grasp stands still",
            file,
        )
    step_s = _typical_step_s(poses, first_s, last_s)
    if poses.interpolation == "smooth" and step_s > LONGEST_STEP_S:
        raise InputError(
            f"the poses move and are {step_s:.6g} s apart, and {lasts}; expected several a second, "
            "with t_s in seconds and not in milliseconds; or interpolation = 'linear' or 'hold' if "
            "that is how it moves between them",
            file,
        )
    start_s, end_s = poses.t_s[[0, -1]]
    slack_s = 1.01 * float(np.median(np.diff(t_s))) if len(t_s) > 1 else 0.0
    shared = np.count_nonzero((t_s >= start_s) & (t_s <= end_s))  # none if of two recordings
    if shared > 2 and (start_s > first_s + slack_s or end_s < last_s - slack_s):
        window = f"[{max(start_s, t_s[0]):.6g}, {min(end_s, t_s[-1]):.6g}]"
        raise InputError(
            f"the poses run from {start_s:.6g} s to {end_s:.6g} s, and {lasts}; expected poses "
            f"over all of it, in seconds of the same clock: add rows, or set window_s = {window}",
            file,
        )


def _typical_step_s(poses: PoseSequence, first_s: float, last_s: float) -> float:
    """Median time from pose to pose within a span, of those between which the grasp moves."""
    shift_m = np.abs(np.diff(poses.positions_m, axis=0)).max(axis=1)
    turn = np.abs(np.diff(poses.quaternions_xyzw, axis=0)).max(axis=1)
    within = (poses.t_s[1:] > first_s) & (poses.t_s[:-1] < last_s)
    steps_s = np.diff(poses.t_s)[within & (np.maximum(shift_m, turn) > STILL)]
    return float(np.median(steps_s)) if len(steps_s) else 0.0
