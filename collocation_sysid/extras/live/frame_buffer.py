"""Frame buffer: turns frames, as they arrive, into time steps with poses and samples.

The time grid is that of the problem, starting at the first frame with a pose. Time steps without a
frame (substeps, missing frames, frames between samples) get their poses from a cubic polynomial
through the last four frames, or a straight line between two frames if more than a few are missing.
There is no waiting: a time step is available as soon as a pose at its time or later has arrived.
Markers are evaluated at their own times.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from ...common.array_types import Array
from ...program.streaming import (
    LARGEST_SAMPLE_DELAY,
    LoggedRow,
    Sample,
    StreamStencil,
    lagrange_weights,
)
from ...recording.sample_times import TIME_TOLERANCE_S
from .frames import InstrumentSample

# Largest difference, in samples, of two times that count as equal.
TIME_TOLERANCE_SAMPLES = 0.1
# Largest gap between frames, in samples, over which poses are interpolated by a cubic polynomial;
# over a larger gap they are interpolated linearly.
LARGEST_CUBIC_GAP = 3
# Largest gap between poses, in samples, after which the motion counts as unknown.
LARGEST_GAP = 10


@dataclass(frozen=True, eq=False)
class BufferedFrame:
    """Result of adding a frame to the buffer."""

    # Rows that the frame completes, in order of time, with the samples to evaluate after each.
    rows: list[LoggedRow]
    # Samples to evaluate after the last earlier row; empty if the frame completes rows, which then
    # contain them.
    late_samples: list[Sample]
    notes: list[str]  # irregularities of the frame, as sentences for the user


@dataclass(eq=False)
class FrameBuffer:
    """Buffer of the frames that have arrived.

    Attributes
    ----------
    start_s : float or None
        Time of the first frame with a pose, at which the grid begins; None before it.
    rows : int
        Number of rows completed since the start.
    last_s : float
        Largest time of a frame; −∞ before the first.
    """

    interval_s: float  # time between samples
    substeps: int  # time steps between samples
    neighbouring_samples: int  # number of samples before and after one that its evaluation needs
    largest_jump_m: float = np.inf  # largest distance that a grasp can move between two samples
    instruments: Sequence[StreamStencil] = ()  # rows that a sample of each instrument needs
    # Numbers of irregularities of frames, by kind; changed in place.
    counts: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Discard all frames, rows and waiting samples, and wait for a new start; `counts` stay."""
        self.start_s: float | None = None
        self.rows = 0
        self.last_s = -np.inf
        self._times: deque[float] = deque(maxlen=8 * LARGEST_SAMPLE_DELAY)
        self._poses: deque[tuple[float, Array, Array]] = deque(maxlen=4)
        self._waiting: list[InstrumentSample] = []
        self._too_late = 0

    @property
    def last_pose_s(self) -> float | None:
        """Time of the last pose [s]; None if there is none since the start or a reset."""
        return self._poses[-1][0] if self._poses else None

    def marker_samples(self, log: Sequence[LoggedRow]) -> Iterator[tuple[float, Array]]:
        """Yield time and positions (M, 3) [m] of all marker samples of `all_samples`, NaN where
        missing; times are in samples from the first row on, 1.5 for half way between the second and
        the third.
        """
        for of, when, tracks_m in self.all_samples(log):
            if not of:
                yield when, tracks_m

    def all_samples(self, log: Sequence[LoggedRow]) -> Iterator[InstrumentSample]:
        """Yield instrument number, time and values of all samples; markers have the number 0, their
        values are (M, 3).

        Times are in samples from the first row on. Samples that still wait for rows come last. The
        buffer is not changed.

        Parameters
        ----------
        log : sequence of LoggedRow
            All rows since the start, with their samples.
        """
        for number, row in enumerate(log):
            for back, values, of in row.samples:
                yield of, (number - back) / self.substeps, values
        for of, t_s, values in self._waiting:
            yield of, (t_s - (self.start_s or 0.0)) / self.interval_s, values

    def is_motion_unknown(self, t_s: float) -> bool:
        """Return whether the time t_s is so long after the last pose that the motion is unknown,
        that is more than `LARGEST_GAP` samples; false before the first pose.

        This is also the case after `LARGEST_GAP` frames in turn that were too late, because the
        sender's clock was set back.
        """
        if self._too_late >= LARGEST_GAP:
            return True
        gone_s = t_s - (t_s if self.last_pose_s is None else self.last_pose_s)
        return gone_s > (LARGEST_GAP + TIME_TOLERANCE_SAMPLES) * self.interval_s

    def add_frame(
        self,
        t_s: float,
        pose: tuple[Array, Array] | None,
        tracks_m: Array,
        instrument_samples: Sequence[InstrumentSample] = (),
    ) -> BufferedFrame:
        """Add a frame; return the rows that it completes, with samples and notes.

        A frame with the time of an earlier one, or more than `LARGEST_SAMPLE_DELAY` samples before
        the last frame, is ignored with a note; of a slightly late frame the pose is ignored, and so
        is a pose that is implausibly far from the last one. Missing poses are interpolated once the
        next pose arrives. Before the first pose, and while the motion is unknown
        (`is_motion_unknown`), samples are discarded. Irregularities are counted in `counts`.

        Parameters
        ----------
        t_s : float
            Time of the frame.
        pose : (positions, quaternions) or None
            Positions (G, 3) [m] and quaternions (G, 4) of the G grasps that move; None if missing.
        tracks_m : (M, 3)
            Marker positions, NaN where missing.
        instrument_samples : sequence of InstrumentSample
            Samples of the other instruments, each with its own time; those farther than
            `LARGEST_SAMPLE_DELAY` samples from t_s are discarded.
        """
        sample_s = self.interval_s
        notes = []
        if any(abs(t_s - other) <= TIME_TOLERANCE_SAMPLES * sample_s for other in self._times):
            self.counts["doubled"] += 1
            return BufferedFrame(
                [],
                [],
                notes=[f"a frame at {t_s:.6g} s was received before: the second one is ignored"],
            )
        late = t_s < self.last_s
        if late:
            if self.last_s - t_s > LARGEST_SAMPLE_DELAY * sample_s:
                self.counts["late"] += 1
                self._too_late += 1
                return BufferedFrame(
                    [], [], notes=[f"the frame at {t_s:.6g} s arrived too late and is ignored"]
                )
            self.counts["unordered"] += 1
            notes.append(f"the frame at {t_s:.6g} s is late: its markers are used, its pose is not")
        self._too_late = 0
        self._times.append(t_s)
        has_started = self.start_s is not None or pose is not None
        if has_started and not self.is_motion_unknown(t_s):
            if np.isfinite(tracks_m).any():
                self._waiting.append((0, t_s, tracks_m))
            on_time = [
                each
                for each in instrument_samples
                if abs(each[1] - t_s) <= LARGEST_SAMPLE_DELAY * sample_s
            ]
            self.counts["late"] += len(instrument_samples) - len(on_time)
            self._waiting += on_time
        if not late:
            if pose is not None and self._is_jump(t_s, pose[0]):
                pose = None
                notes.append(
                    f"the pose at {t_s:.6g} s is ignored, because it is implausibly far from the last one"
                )
            notes += self._note_gaps(t_s)
            self.last_s = t_s
            if pose is not None:
                self._add_pose(t_s, *pose)
            else:
                self.counts["without a pose"] += 1
        rows = self._completed_rows()
        late_samples = self._available_samples() if not rows else []
        return BufferedFrame(rows, late_samples, notes=notes)

    def _is_jump(self, t_s: float, positions_m: Array) -> bool:
        """Return whether a coordinate of a moving grasp (G, 3) differs from its last one by more
        than `largest_jump_m` for each sample until t_s, at least one; false before the first pose.
        """
        if not self._poses:
            return False
        before_s, before_m, _ = self._poses[-1]
        samples = max(1.0, (t_s - before_s) / self.interval_s)
        return bool(np.abs(positions_m - before_m).max() > samples * self.largest_jump_m)

    def _note_gaps(self, t_s: float) -> list[str]:
        """Count missing frames and frames between samples, and return notes about them.

        Each gap is noted, of frames between samples only the first. Nothing is counted for the
        first frame.
        """
        if not np.isfinite(self.last_s):
            return []
        missing = round((t_s - self.last_s) / self.interval_s) - 1
        offset = (t_s - self.start_s) / self.interval_s if self.start_s is not None else 0.0
        notes = []
        if missing > 0:
            self.counts["dropped"] += missing
            notes.append(
                f"{missing} frames before {t_s:.6g} s are missing: the motion of the grasp is "
                "interpolated there"
            )
        if abs(offset - round(offset)) > TIME_TOLERANCE_SAMPLES:
            if not self.counts["off the grid"]:
                notes.append(
                    f"the frame at {t_s:.6g} s lies between samples: markers are evaluated at the "
                    "times of their frames, by interpolation"
                )
            self.counts["off the grid"] += 1
        return notes

    def _add_pose(self, t_s: float, positions_m: Array, quaternions: Array) -> None:
        """Store a pose, with the sign of each quaternion nearest to the previous one."""
        if self._poses:
            before = self._poses[-1][2]
            signs = np.where(np.sum(quaternions * before, axis=1) < 0, -1.0, 1.0)
            quaternions = quaternions * signs[:, None]
        elif self.start_s is None:
            self.start_s = t_s
        self._poses.append((t_s, positions_m, quaternions))

    def _time_s(self, row: int) -> float:
        """Return the time [s] of a time step, given by its index from the start of the grid, which
        must be known.
        """
        assert self.start_s is not None
        return self.start_s + row * self.interval_s / self.substeps

    def _completed_rows(self) -> list[LoggedRow]:
        """Return the new rows, up to the last pose, and increase `rows` by their number; none
        before the first pose.
        """
        rows: list[tuple[Array, Array, list[Sample]]] = []
        if self.start_s is None:
            return []
        until_s = self._poses[-1][0] + TIME_TOLERANCE_SAMPLES * self.interval_s
        while self._time_s(self.rows) <= until_s:
            pose = self._pose_at(self._time_s(self.rows))
            self.rows += 1
            rows.append((*pose, self._available_samples()))
        if not rows:
            return []
        positions, quaternions, samples = zip(*rows, strict=True)
        matrices = Rotation.from_quat(np.concatenate(quaternions)).as_matrix()
        rotations = matrices.reshape(len(rows), -1, 3, 3)
        logged = []
        for k, row_samples in enumerate(samples):
            poses = tuple(zip(rotations[k], positions[k], strict=True))
            logged.append(LoggedRow(poses, row_samples))
        return logged

    def _pose_at(self, t_s: float) -> tuple[Array, Array]:
        """Return positions (G, 3) [m] and quaternions (G, 4) x y z w, not normalised, of the moving
        grasps at the time t_s [s], interpolated through the last poses, at most four.
        """
        for at_s, positions_m, quaternions in self._poses:
            if abs(at_s - t_s) <= TIME_TOLERANCE_S:
                return positions_m, quaternions
        times, places, quaternions = (list(each) for each in zip(*self._poses, strict=True))
        has_large_gap = any(
            b - a > (LARGEST_CUBIC_GAP + TIME_TOLERANCE_SAMPLES) * self.interval_s
            for a, b in pairwise(times)
        )
        used = slice(-2, None) if has_large_gap else slice(None)
        weights = lagrange_weights(t_s, times[used])
        position_m, quaternion = (
            np.einsum("k,kgi->gi", weights, each[used]) for each in (places, quaternions)
        )
        return position_m, quaternion

    def _available_samples(self) -> list[Sample]:
        """Return the waiting samples that can be evaluated with the rows so far, and remove them
        from the buffer.
        """
        if self.start_s is None or not self.rows:
            return []
        now_s = self._time_s(self.rows - 1)
        step_s = self.interval_s / self.substeps
        room_s = TIME_TOLERANCE_SAMPLES * self.interval_s
        latest_s = now_s - self.neighbouring_samples * self.interval_s + room_s

        def ready(of: int, t_s: float) -> bool:
            """Return whether the rows that a sample at t_s needs are available; `of` is the number
            of its instrument, 0 for markers.
            """
            if not of:
                return t_s <= latest_s
            instrument = self.instruments[of - 1]
            rows = instrument.rows_of_sample(self.rows - 1 - (now_s - t_s) / step_s)
            return rows.stop + instrument.delay <= self.rows

        available = [each for each in self._waiting if ready(*each[:2])]
        self._waiting = [each for each in self._waiting if not ready(*each[:2])]
        # Before the first row nothing is known.
        available = [
            each for each in available if each[1] >= self.start_s - (0 if each[0] else room_s)
        ]
        return [
            Sample((now_s - t_s) / step_s, values, instrument=of) for of, t_s, values in available
        ]
