"""From frames, as they come, to rows of the time grid.

The grid is the problem's, from the first frame on. Rows that no frame is at (substeps, frames that
are missing or between) take the poses from a polynomial through the last four frames, or straight
between two where more than a few are missing. Nothing waits: a row is there as soon as a pose at
its time or later is. Markers are read where their own times are.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from ..arrays import Array
from ..program.reading import lagrange_weights
from ..recording.clock import TIME_TOLERANCE_S
from .frames import Told
from .model import Around
from .sweep import LATEST, LoggedRow, Sample

# Frames this near in time, in samples, are of one time.
TOLERANCE = 0.1
# Poses between frames are cubic over so few samples, straight over more, and beyond the second
# nothing is known of the motion.
FEW, LONGEST = 3, 10


@dataclass(eq=False)
class Intake:
    """Frames that have come.

    Attributes
    ----------
    interval_s : float
        Of samples.
    substeps : int
    around : int
        Samples before and after one that its reading needs.
    leap_m : float
        Farther no grasp goes from a sample to the next.
    instruments : sequence of Around
        Rows that a sample of each is read from.
    counts : Counter
        Of what was wrong with frames.
    """

    interval_s: float
    substeps: int
    around: int
    leap_m: float = np.inf
    instruments: Sequence[Around] = ()
    counts: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.begin_anew()

    def begin_anew(self) -> None:
        """Forget all frames."""
        self.start_s: float | None = None
        self.rows = 0
        self.last_s = -np.inf
        self._times: deque[float] = deque(maxlen=8 * LATEST)
        self._poses: deque[tuple[float, Array, Array]] = deque(maxlen=4)
        self._waiting: list[Told] = []
        self._too_late = 0

    @property
    def last_pose_s(self) -> float | None:
        """When the last pose was."""
        return self._poses[-1][0] if self._poses else None

    def seen(self, log: Sequence[LoggedRow]) -> Iterator[tuple[float, Array]]:
        """When markers were seen, in samples from the first row on, and where, (M, 3)."""
        for of, when, tracks_m in self.told(log):
            if not of:
                yield when, tracks_m

    def told(self, log: Sequence[LoggedRow]) -> Iterator[Told]:
        """All that was read, markers being number 0, its times in samples from the first row on."""
        for number, row in enumerate(log):
            for back, values, of in row.readings:
                yield of, (number - back) / self.substeps, values
        for of, t_s, values in self._waiting:
            yield of, (t_s - (self.start_s or 0.0)) / self.interval_s, values

    def is_lost(self, t_s: float) -> bool:
        """Whether a time is so long after the last pose that nothing is known of the motion.

        So it is where many frames in turn are too late: their clock was set back.
        """
        if self._too_late >= LONGEST:
            return True
        gone_s = t_s - (t_s if self.last_pose_s is None else self.last_pose_s)
        return gone_s > (LONGEST + TOLERANCE) * self.interval_s

    def take(
        self,
        t_s: float,
        pose: tuple[Array, Array] | None,
        tracks_m: Array,
        told: Sequence[Told] = (),
    ) -> tuple[list[LoggedRow], list[Sample], list[str]]:
        """The rows a frame completes, what can be read after the last row, and what was odd.

        Parameters
        ----------
        t_s : float
        pose : positions (G, 3) and quaternions (G, 4) of the grasps that move; None where missing
        tracks_m : (M, 3), NaN where missing
        told : what else came with it
        """
        sample_s, said = self.interval_s, []
        if any(abs(t_s - other) <= TOLERANCE * sample_s for other in self._times):
            self.counts["doubled"] += 1
            return [], [], [f"a frame at {t_s:.6g} s has come already: left out"]
        late = t_s < self.last_s
        if late:
            if self.last_s - t_s > LATEST * sample_s:
                self.counts["late"] += 1
                self._too_late += 1
                return [], [], [f"the frame of {t_s:.6g} s is too late: left out"]
            self.counts["unordered"] += 1
            said.append(f"the frame of {t_s:.6g} s is late: its markers count, its pose does not")
        self._too_late = 0
        self._times.append(t_s)
        begun = self.start_s is not None or pose is not None
        if begun and not self.is_lost(t_s):
            if np.isfinite(tracks_m).any():
                self._waiting.append((0, t_s, tracks_m))
            near = [each for each in told if abs(each[1] - t_s) <= LATEST * sample_s]
            self.counts["late"] += len(told) - len(near)
            self._waiting += near
        if not late:
            if pose is not None and self._leaps(t_s, pose[0]):
                pose = None
                said.append(f"the grasp of {t_s:.6g} s is too far from the last: left out")
            said += self._gap(t_s)
            self.last_s = t_s
            if pose is not None:
                self._add_pose(t_s, *pose)
            else:
                self.counts["without a pose"] += 1
        rows = self._due()
        return rows, self._ready() if not rows else [], said

    def _leaps(self, t_s: float, positions_m: Array) -> bool:
        if not self._poses:
            return False
        before_s, before_m, _ = self._poses[-1]
        samples = max(1.0, (t_s - before_s) / self.interval_s)
        return bool(np.abs(positions_m - before_m).max() > samples * self.leap_m)

    def _gap(self, t_s: float) -> list[str]:
        if not np.isfinite(self.last_s):
            return []
        missing = round((t_s - self.last_s) / self.interval_s) - 1
        off = (t_s - self.start_s) / self.interval_s if self.start_s is not None else 0.0
        said = []
        if missing > 0:
            self.counts["dropped"] += missing
            said.append(f"{missing} frames before {t_s:.6g} s are missing: bridged")
        if abs(off - round(off)) > TOLERANCE:
            if not self.counts["off the grid"]:
                said.append(f"the frame of {t_s:.6g} s lies between samples: such are read there")
            self.counts["off the grid"] += 1
        return said

    def _add_pose(self, t_s: float, positions_m: Array, quaternions: Array) -> None:
        if self._poses:
            before = self._poses[-1][2]
            signs = np.where(np.sum(quaternions * before, axis=1) < 0, -1.0, 1.0)
            quaternions = quaternions * signs[:, None]
        elif self.start_s is None:
            self.start_s = t_s
        self._poses.append((t_s, positions_m, quaternions))

    def _time_s(self, row: int) -> float:
        assert self.start_s is not None
        return self.start_s + row * self.interval_s / self.substeps

    def _due(self) -> list[LoggedRow]:
        """The rows that there are poses for."""
        found: list[tuple[Array, Array, list[Sample]]] = []
        if self.start_s is None:
            return []
        until_s = self._poses[-1][0] + TOLERANCE * self.interval_s
        while self._time_s(self.rows) <= until_s:
            pose = self._pose_at(self._time_s(self.rows))
            self.rows += 1
            found.append((*pose, self._ready()))
        if not found:
            return []
        places, quaternions, readings = zip(*found, strict=True)
        flat = Rotation.from_quat(np.concatenate(quaternions)).as_matrix()
        turns = flat.reshape(len(found), -1, 3, 3)
        poses = (tuple(zip(*each, strict=True)) for each in zip(turns, places, strict=True))
        return [LoggedRow(*each) for each in zip(poses, readings, strict=True)]

    def _pose_at(self, t_s: float) -> tuple[Array, Array]:
        """Positions (G, 3) and quaternions (G, 4), not of unit length, between those there are."""
        for at_s, positions_m, quaternions in self._poses:
            if abs(at_s - t_s) <= TIME_TOLERANCE_S:
                return positions_m, quaternions
        times, places, quaternions = (list(each) for each in zip(*self._poses, strict=True))
        far = any(b - a > (FEW + TOLERANCE) * self.interval_s for a, b in pairwise(times))
        used = slice(-2, None) if far else slice(None)
        weights = lagrange_weights(t_s, times[used])
        position_m, quaternion = (
            np.einsum("k,kgi->gi", weights, each[used]) for each in (places, quaternions)
        )
        return position_m, quaternion

    def _ready(self) -> list[Sample]:
        """What can be read after the rows there are."""
        if self.start_s is None or not self.rows:
            return []
        now_s = self._time_s(self.rows - 1)
        step_s, room_s = self.interval_s / self.substeps, TOLERANCE * self.interval_s
        latest_s = now_s - self.around * self.interval_s + room_s

        def ready(of: int, t_s: float) -> bool:
            if not of:
                return t_s <= latest_s
            around = self.instruments[of - 1]
            rows = around.rows(self.rows - 1 - (now_s - t_s) / step_s)
            return rows.stop + around.late <= self.rows

        found = [each for each in self._waiting if ready(*each[:2])]
        self._waiting = [each for each in self._waiting if not ready(*each[:2])]
        # Before the first row nothing is known.
        found = [each for each in found if each[1] >= self.start_s - (0 if each[0] else room_s)]
        return [Sample((now_s - t_s) / step_s, values, of) for of, t_s, values in found]
