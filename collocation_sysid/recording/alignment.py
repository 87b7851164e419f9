"""Poses and markers of an experiment on one evenly spaced time grid.

Samples are evenly spaced. A lost frame is a sample without a measurement, and each frame keeps its
own time as an offset from its sample, at which the model is evaluated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..common.array_types import Array, Index
from ..common.time_dependence import at_times
from ..errors import InputError
from .gap_interpolation import LARGEST_GAP_INTERVALS, SAME_TIME_INTERVALS, interpolate_without_gaps
from .marker_files import MarkerTable
from .poses import PoseSequence
from .sample_times import (
    STEP_TOLERANCE,
    evenly_spaced_s,
    has_even_steps,
    printed_rounding_s,
    sample_interval_s,
    unrounded_s,
)

# Units of times, over a second, and relative difference of durations that are the same.
UNITS_OF_TIMES = {1e3: "ms", 1e6: "us"}
SAME_DURATION = 0.2
# Delay of the first sample after the first pose, over the duration of the samples, that is noted.
LARGEST_DELAY = 0.25
# Fewest samples of a motion: an acceleration needs three.
_FEWEST_SAMPLES = 3


@dataclass(frozen=True, eq=False)
class AlignedRecording:
    """Poses and markers on one time grid."""

    t_s: Array  # (T,): the grid, evenly spaced unless the experiment is static
    poses: tuple[PoseSequence, ...]  # poses of each grasp
    table: MarkerTable  # markers on the grid
    notes: tuple[str, ...]  # what was cut or interpolated, without a full stop


def align(
    poses: Sequence[PoseSequence],
    table: MarkerTable,
    window_s: tuple[float, float] | None = None,
    resample_hz: float | None = None,
    every: int = 1,
    grasp_intervals_s: Sequence[tuple[float, float]] | None = None,
    static: bool = False,
) -> AlignedRecording:
    """Put poses and markers on one evenly spaced time grid over the time that they share.

    Without `resample_hz` the grid has the markers' own rate and no measurement is changed: lost
    frames become missing samples, and jittered frames keep their times as `offsets_s` of the table.
    With it, markers are interpolated to that rate, linearly and only between two present
    neighbours. Poses keep their samples: if these agree with the grid up to the rounding of either
    file, they are moved onto it; otherwise `PoseSequence.interpolation` gives the poses at the
    grid. A single pose goes with any time.

    Parameters
    ----------
    poses : sequence of PoseSequence
        Poses of each grasp.
    table : MarkerTable
        Marker tracks on the same clock.
    window_s : (float, float), optional
        Samples before the first or after the second time are cut.
    resample_hz : float, optional
        Rate of the new grid, which starts at the first sample that is kept.
    every : int
        Use every n-th of the marker samples that are kept, lost ones included, from the first on,
        before any resampling; 1 for all.
    grasp_intervals_s : sequence of (float, float), optional
        First and last time at which each grasp holds; its poses need not cover other times. The
        whole recording by default.
    static : bool
        Whether the grid is the markers' own time, however it is spaced, and one sample is enough;
        `resample_hz` is then ignored.

    Raises
    ------
    InputError
        If the window is empty, the markers' frames have no common rate, the rate is not positive or
        leaves one sample, or a cut to the time of the poses leaves fewer than three samples.
    """
    began_s, lasts_s = table.t_s[0], np.ptp(table.t_s)
    table = table if window_s is None else _cut_to_window(table, window_s)
    grasp_intervals_s = grasp_intervals_s or [(-np.inf, np.inf)] * len(poses)
    table, notes = _cut_to_poses(
        table, poses, grasp_intervals_s=grasp_intervals_s, fewest=1 if static else _FEWEST_SAMPLES
    )
    t_s = table.t_s
    if resample_hz is None and not static:
        table, frame_notes = evenly_sampled(table)
        notes += frame_notes
        if frame_notes:
            t_s = table.t_s
    if every > 1:
        table = at_times(table, slice(None, None, every))
        t_s = t_s[::every]
    grid = table.t_s
    if resample_hz is not None and not static:
        t_s = grid = _even_grid(table.t_s, resample_hz)
        sigma_m = table.sigma_m
        if sigma_m is not None:
            sigma_m = interpolate_without_gaps(grid, table.t_s, sigma_m)
        table = MarkerTable(
            grid,
            table.names,
            positions_m=interpolate_without_gaps(grid, table.t_s, table.positions_m),
            sigma_m=sigma_m,
        )
    moved = []
    for k, sequence in enumerate(poses):
        name = "the poses" if len(poses) == 1 else f"the poses of grasp {k + 1}"
        delay_s = began_s - sequence.t_s[0]
        if len(sequence.t_s) > 1 and delay_s > LARGEST_DELAY * lasts_s:
            notes.append(
                f"the samples begin {delay_s:.6g} s after {name}: if both files were begun at the same "
                "moment, subtract this from the times of the samples"
            )
        matched = _poses_on_grid(sequence, t_s, grid=grid)
        if matched is None:
            matched = replace(sequence, t_s=unrounded_s(sequence.t_s))
            notes.append(f"{name}{_interpolation_note(matched, grid)}")
        notes += [f"{name}{note}" for note in _jump_notes(matched, grid)]
        moved.append(matched)
    return AlignedRecording(grid, tuple(moved), table=table, notes=tuple(notes))


def _cut_to_poses(
    table: MarkerTable,
    poses: Sequence[PoseSequence],
    grasp_intervals_s: Sequence[tuple[float, float]],
    fewest: int,
) -> tuple[MarkerTable, list[str]]:
    """Return the markers at times for which each active grasp has a pose, and notes on cuts."""
    t_s = table.t_s
    is_inside = np.ones(len(t_s), dtype=bool)
    moving = [
        (p, window_s)
        for p, window_s in zip(poses, grasp_intervals_s, strict=True)
        if len(p.t_s) > 1
    ]
    for sequence, (from_s, until_s) in moving:
        slack_s = _tolerance_s(sequence, t_s)
        # A grasp must not be evaluated beyond its first or last pose.
        if from_s < sequence.t_s[0] - slack_s:
            is_inside &= t_s >= sequence.t_s[0] - slack_s
        if until_s > sequence.t_s[-1] + slack_s:
            is_inside &= t_s <= sequence.t_s[-1] + slack_s
    if is_inside.all():
        return table, []
    spans = " and ".join(_span_text(sequence.t_s) for sequence, _ in moving)
    if is_inside.sum() < fewest:
        raise InputError(
            f"poses run {spans}, markers {_span_text(t_s)}: they share {is_inside.sum()} marker "
            f"samples; expected at least {fewest}: check that both belong to the same recording "
            "and use the same clock, and check window_s" + _clock_remedy(moving[0][0].t_s, t_s)
        )
    cut = t_s[is_inside]
    ends = [
        f"{length_s:.6g} s at the {end}"
        for length_s, end in ((cut[0] - t_s[0], "start"), (t_s[-1] - cut[-1], "end"))
        if length_s > 0
    ]
    note = (
        f"the markers were cut to the time of the poses by {' and '.join(ends)}, "
        f"{(~is_inside).sum()} of {len(t_s)} samples: poses run {spans}, markers ran "
        f"{_span_text(t_s)}"
    )
    if cut[0] > t_s[0]:
        note += f"; start now refers to the state at {cut[0]:.9g} s"
    return at_times(table, is_inside), [note]


def _cut_to_window(table: MarkerTable, window_s: tuple[float, float]) -> MarkerTable:
    """Times up to `STEP_TOLERANCE` median intervals beyond the window [s] count as inside."""
    first_s, last_s = window_s
    steps = np.diff(table.t_s)
    slack_s = STEP_TOLERANCE * float(np.median(steps)) if steps.size else 0.0
    is_inside = (table.t_s >= first_s - slack_s) & (table.t_s <= last_s + slack_s)
    if not is_inside.any():
        raise InputError(
            f"window_s = [{first_s:g}, {last_s:g}] contains no marker sample; expected a window "
            f"within the times of the markers, from {table.t_s[0]:.9g} s to {table.t_s[-1]:.9g} s"
        )
    return at_times(table, is_inside)


def _even_grid(t_s: Array, rate_hz: float) -> Array:
    if not (np.isfinite(rate_hz) and rate_hz > 0.0):
        raise InputError(f"resample_hz is {rate_hz:g}; expected a rate above 0")
    count = int(np.floor((t_s[-1] - t_s[0]) * rate_hz + SAME_TIME_INTERVALS)) + 1
    if count < 2:
        raise InputError(
            f"resample_hz = {rate_hz:g} leaves one sample between {t_s[0]:.9g} s and "
            f"{t_s[-1]:.9g} s; raise it or widen window_s"
        )
    return t_s[0] + np.arange(count) / rate_hz


def _poses_on_grid(poses: PoseSequence, t_s: Array, grid: Array) -> PoseSequence | None:
    """Move pose samples at marker times onto the grid; None if a marker time has no pose."""
    # Samples between these are moved by the interpolated shift; positions and rotations stay.
    if len(poses.t_s) == 1:
        return poses
    slack_s = _tolerance_s(poses, t_s)
    within = (t_s >= poses.t_s[0] - slack_s) & (t_s <= poses.t_s[-1] + slack_s)
    times = t_s[within]
    if len(times) < 2:
        return poses
    later = np.clip(np.searchsorted(poses.t_s, times), 1, len(poses.t_s) - 1)
    nearest = later - (times - poses.t_s[later - 1] < poses.t_s[later] - times)
    if (np.abs(poses.t_s[nearest] - times) > slack_s).any():
        return None
    moved = poses.t_s + np.interp(poses.t_s, times, grid[within] - poses.t_s[nearest])
    moved[nearest] = grid[within]
    samples = slice(nearest[0] if within[0] else 0, nearest[-1] + 1 if within[-1] else None)
    return replace(
        poses,
        t_s=moved[samples],
        positions_m=poses.positions_m[samples],
        quaternions_xyzw=poses.quaternions_xyzw[samples],
    )


def _tolerance_s(poses: PoseSequence, t_s: Array) -> float:
    """Return the largest time difference [s] at which a pose and a marker count as simultaneous."""
    step_s = float(np.median(np.diff(t_s))) if len(t_s) > 1 else 0.0
    return STEP_TOLERANCE * step_s + 0.5 * (printed_rounding_s(t_s) + printed_rounding_s(poses.t_s))


def _interpolation_note(poses: PoseSequence, grid: Array) -> str:
    """Return the predicate of a note; the caller adds the subject."""
    how = "held" if poses.interpolation == "hold" else f"interpolated ({poses.interpolation})"
    at = f"{_rate_hz(grid):.6g} Hz {_span_text(grid)}" if len(grid) > 1 else _span_text(grid)
    return f", recorded at {_rate_hz(poses.t_s):.6g} Hz, were {how} at the markers' times, {at}"


def _jump_notes(poses: PoseSequence, grid: Array) -> list[str]:
    """Return the predicate of a note on jumps in smoothly interpolated poses, or an empty list."""
    if poses.interpolation != "smooth":
        return []
    at_s = poses.jumps_s[(poses.jumps_s >= grid[0]) & (poses.jumps_s < grid[-1])]
    if not at_s.size:
        return []
    others = f" and {at_s.size - 1} more times" if at_s.size > 1 else ""
    return [
        f" jump after t = {at_s[0]:.6g} s{others}; between the two poses of a jump the motion "
        "is interpolated linearly, not smoothly"
    ]


def _rate_hz(t_s: Array) -> float:
    return (len(t_s) - 1) / float(t_s[-1] - t_s[0])


def _clock_remedy(pose_times_s: Array, marker_times_s: Array) -> str:
    """Return the cause of times without overlap: their unit or zero points; "" if they overlap."""
    ratio = np.ptp(marker_times_s) / max(np.ptp(pose_times_s), 1e-300)
    for factor, unit in UNITS_OF_TIMES.items():
        for of, other, size in (("markers", "poses", ratio), ("poses", "markers", 1 / ratio)):
            if abs(size / factor - 1) < SAME_DURATION:
                return (
                    f"; the times of the {of} last about {factor:g} times as long as those of the "
                    f"{other}, as if they were in {unit}: call their column t_{unit}"
                )
    overlap_s = min(pose_times_s[-1], marker_times_s[-1]) - max(pose_times_s[0], marker_times_s[0])
    if overlap_s > 0:
        return ""
    later_s = pose_times_s[0] - marker_times_s[0]
    return (
        f"; if both begin at the same moment, their clocks differ by {abs(later_s):.12g} s: "
        f"{'subtract this from' if later_s > 0 else 'add this to'} the times of the poses"
    )


def _span_text(t_s: Array) -> str:
    return f"from {t_s[0]:.12g} s to {t_s[-1]:.12g} s"


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
