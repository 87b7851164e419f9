"""Assignment of unevenly recorded frames to evenly spaced samples.

Use this module for recordings with lost or jittered frames: the samples are evenly spaced, a lost
frame is a sample without a measurement, and each frame keeps its own time as an offset from its
sample, at which the model is evaluated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..common.array_types import Array, Index
from ..errors import InputError
from .gap_interpolation import LARGEST_GAP_INTERVALS
from .marker_files import MarkerTable
from .sample_times import (
    STEP_TOLERANCE,
    evenly_spaced_s,
    has_even_steps,
    printed_rounding_s,
    sample_interval_s,
)

# Largest deviation of a frame from even times, in samples: near 0.5 its sample is ambiguous.
LARGEST_JITTER_SAMPLES = 0.4
# Largest share of lost frames: beyond it the rate of the recording is not known.
LARGEST_LOST_SHARE = 0.3
# Repetitions of the assignment: the first fit of the times corrects the interval by less than 1 %.
ASSIGNMENTS = 3


@dataclass(frozen=True, eq=False)
class FrameAssignment:
    """Evenly spaced samples, and the sample of each frame."""

    t_s: Array  # (T,): times of the samples [s]
    samples: Index  # (F,) of int: index, from 0, of the sample of each frame, increasing
    # (F,): time of each frame less that of its sample [s]; 0 for the first and the last frame.
    offsets_s: Array
    jitter_s: Array  # (F,): deviation of the times of the frames from the line fitted to them [s]

    @property
    def interval_s(self) -> float:
        """Time between samples [s]."""
        return float(self.t_s[-1] - self.t_s[0]) / (len(self.t_s) - 1)

    def spread(self, values: Array) -> Array:
        """Return values (F, …) of the frames as those of the samples (T, …); NaN where a frame was
        lost.
        """
        spread_values = np.full((len(self.t_s), *values.shape[1:]), np.nan)
        spread_values[self.samples] = values
        return spread_values


def assign_frames(t_s: Array) -> FrameAssignment | None:
    """Assign frames at the times `t_s` (F,) [s], increasing, to evenly spaced samples.

    The first and the last sample have the times of the first and the last frame, so that no sample
    is outside of the recording. The numbers of the samples follow from the mean of the steps
    without lost frames, recognised by the median; a fit of the times by a line refines them.

    Returns
    -------
    FrameAssignment or None
        None if two frames have the same sample, a frame is more than `LARGEST_JITTER_SAMPLES` from
        the line, or more than `LARGEST_LOST_SHARE` of the samples have no frame.
    """
    steps_s = np.diff(t_s)
    single = steps_s < LARGEST_GAP_INTERVALS * np.median(steps_s)
    interval_s = float(steps_s[single].mean())
    samples = np.concatenate([[0], np.cumsum(np.rint(steps_s / interval_s))])
    start_s = float(t_s[0])
    for _ in range(ASSIGNMENTS):
        if (np.diff(samples) < 1).any():
            return None
        interval_s, start_s = np.polyfit(samples, t_s - t_s[0], deg=1)
        samples = np.rint((t_s - t_s[0] - start_s) / interval_s)
        samples -= samples[0]
    jitter_s = t_s - t_s[0] - start_s - interval_s * samples
    count = int(samples[-1]) + 1
    if (
        (np.diff(samples) < 1).any()
        or np.abs(jitter_s).max() > LARGEST_JITTER_SAMPLES * interval_s
        or count - len(t_s) > LARGEST_LOST_SHARE * count
    ):
        return None
    indices = samples.astype(np.int64)
    grid_s = np.linspace(t_s[0], t_s[-1], count)
    return FrameAssignment(grid_s, indices, offsets_s=t_s - grid_s[indices], jitter_s=jitter_s)


def evenly_sampled(table: MarkerTable) -> tuple[MarkerTable, list[str]]:
    """Return marker tracks at evenly spaced samples, and a note if frames were lost or jittered.

    Even times, up to `STEP_TOLERANCE` and the rounding of the file, are replaced by exactly even
    ones. Otherwise lost frames become missing samples, and if the times of the frames differ from
    those of the samples, the table has `offsets_s`. No position is changed.

    Parameters
    ----------
    table : MarkerTable
        At the times of the frames, without offsets.

    Raises
    ------
    InputError
        If there are fewer than two frames, or `assign_frames` finds no samples; the step is named
        that deviates most, and a rate for `resample_hz`.
    """
    t_s = table.t_s
    if len(t_s) < 2 or has_even_steps(t_s):
        sample_interval_s(t_s, "markers")
        return replace(table, t_s=evenly_spaced_s(t_s)), []
    assignment = assign_frames(t_s)
    if assignment is None:
        raise _irregularity(t_s)
    rounding_s = printed_rounding_s(t_s)
    tolerance_s = STEP_TOLERANCE * assignment.interval_s + rounding_s
    is_jittered = bool(np.abs(assignment.offsets_s).max() > tolerance_s)
    offsets_s = None
    if is_jittered and table.names:
        offsets_s = np.nan_to_num(assignment.spread(assignment.offsets_s))
    even = MarkerTable(
        assignment.t_s,
        table.names,
        positions_m=assignment.spread(table.positions_m),
        notes=table.notes,
        offsets_s=offsets_s,
        sigma_m=None if table.sigma_m is None else assignment.spread(table.sigma_m),
    )
    note = _assignment_note(assignment, is_jittered=is_jittered, has_markers=bool(table.names))
    return even, [note]


def _assignment_note(assignment: FrameAssignment, is_jittered: bool, has_markers: bool) -> str:
    """Without markers the frames are only times, and the model is not compared there."""
    parts = []
    if lost := (len(assignment.t_s) - len(assignment.samples)):
        longest = int(np.diff(assignment.samples).max(initial=1)) - 1
        gap = f", up to {longest} in succession" if longest > 1 else ""
        parts.append(
            f"{lost} of {len(assignment.t_s)} frames {'was' if lost == 1 else 'were'} lost{gap}: "
            "missing samples"
        )
    if is_jittered:
        jitter_ms = 1e3 * assignment.jitter_s
        parts.append(
            f"the times of the frames deviate by {np.std(jitter_ms):.2g} ms RMS, at most "
            f"{np.abs(jitter_ms).max():.2g} ms, from an even "
            f"{1 / assignment.interval_s:.6g} Hz"
            + has_markers
            * ": the model is evaluated at the time of each frame"
        )
    return "; ".join(parts)


def _irregularity(t_s: Array) -> InputError:
    steps_s = np.diff(t_s)
    typical_s = float(np.median(steps_s))
    row = int(np.argmax(np.abs(steps_s - typical_s)))
    return InputError(
        f"markers: the time jumps by {steps_s[row]:.6g} s from t_s = {t_s[row]:.9g} to "
        f"{t_s[row + 1]:.9g}, where other steps are {typical_s:.6g} s; the frames have no common "
        f"rate: expected frames within {LARGEST_JITTER_SAMPLES:g} intervals of even times, at "
        f"most {LARGEST_LOST_SHARE:.0%} of them lost; cut the recording by window_s, or set "
        f"resample_hz = {1 / typical_s:.3g}",
        where=f"row {row + 2}",
    )
