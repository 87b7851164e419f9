"""Initial rest of a stream: detects when the motion begins after a long time at rest.

Frames at rest repeat one equilibrium. They contain no information on damping and little on
stiffness, but every pass over the window would repeat them, and a search for initial values would
compare its trials by them. After a long rest the estimation therefore begins at the last frames
before the motion, as if the stream had begun there.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from ...common.array_types import Array
from .frames import Frame

# Displacement of a grasp, in body sizes, below which it is at rest: noise of poses is less.
LARGEST_REST_BODY_SIZES = 0.002
# The same in standard deviations of the noise of the poses, where that is larger.
LARGEST_REST_DEVIATIONS = 6.0
# Number of first frames from which the noise of the poses is estimated, and of frames at rest after
# which the estimation begins anew with the motion: those that decide a search for initial values.
LONG_REST_FRAMES = 20
# Number of frames before the detected motion with which the estimation begins: a motion that
# begins smoothly is detected late.
REPLAYED_FRAMES = 10
# Standard deviation of a marker at rest, in that of its noise, above which the body is moving.
LARGEST_MARKER_DEVIATIONS = 3.0


@dataclass(eq=False)
class InitialRest:
    """Frames since the start of a stream while no grasp moves."""

    body_size_m: float
    sigma_m: Array  # (M,): noise of the markers [m]
    is_over: bool = False  # whether a grasp has moved
    _largest_rest_m: float = 0.0
    _first: list[Frame] = field(default_factory=list)
    _recent: deque[Frame] = field(default_factory=lambda: deque(maxlen=REPLAYED_FRAMES))

    def frames_before_motion(self, frame: Frame) -> list[Frame]:
        """Add a frame and return the last frames at rest, at most `REPLAYED_FRAMES`, if the motion
        begins with this one after a long rest of grasps and body; otherwise an empty list.

        A rest is long from `LONG_REST_FRAMES` frames with a pose on. Frames without a pose are
        ignored, and so are all frames after the first motion, so that the list is not empty at most
        once.
        """
        if self.is_over or frame.pose is None:
            return []
        if len(self._first) < LONG_REST_FRAMES:
            self._first.append(frame)
            self._recent.append(frame)
            if len(self._first) == LONG_REST_FRAMES:
                self._largest_rest_m = self._largest_displacement_at_rest_m()
                self.is_over = not self._is_at_rest(self._first)
            return []
        if self._is_at_rest([frame]):
            self._recent.append(frame)
            return []
        self.is_over = True
        return list(self._recent) if self._is_body_still() else []

    def _is_at_rest(self, frames: list[Frame]) -> bool:
        """Return whether no grasp of these frames, which have poses, is displaced from the first
        frame by more than noise; the first `LONG_REST_FRAMES` frames must have been added.
        """
        first = self._first[0]
        return all(
            self._displacement_m(frame, reference=first) <= self._largest_rest_m for frame in frames
        )

    def _largest_displacement_at_rest_m(self) -> float:
        """Return the displacement [m] up to which a grasp is at rest: a share of the body's size,
        or a multiple of the noise of the poses if that is larger.
        """
        steps_m = [
            self._displacement_m(after, reference=before) for before, after in pairwise(self._first)
        ]
        noise_m = float(np.sqrt(np.mean(np.square(steps_m)) / 2))
        return max(LARGEST_REST_BODY_SIZES * self.body_size_m, LARGEST_REST_DEVIATIONS * noise_m)

    def _displacement_m(self, frame: Frame, reference: Frame) -> float:
        """Return the largest displacement [m] of a grasp from one frame to another, both with
        poses: its translation, plus its rotation as that of a point at the distance of the body's
        size.
        """
        assert frame.pose is not None
        assert reference.pose is not None
        positions_m, quaternions = frame.pose
        first_positions_m, first_quaternions = reference.pose
        shifts_m = np.linalg.norm(positions_m - first_positions_m, axis=1)
        back = Rotation.from_quat(first_quaternions).inv()
        angles = (Rotation.from_quat(quaternions) * back).magnitude()
        return float(np.max(shifts_m + angles * self.body_size_m, initial=0.0))

    def _is_body_still(self) -> bool:
        """Return whether each coordinate of the markers of the recent frames scatters by no more
        than noise (`LARGEST_MARKER_DEVIATIONS`); true if no marker is visible twice.
        """
        tracks_m = np.array([frame.tracks_m for frame in self._recent])
        visible = np.isfinite(tracks_m).sum(axis=0) > 1
        if not visible.any():
            return True
        scatter_m = np.nanstd(np.where(visible, tracks_m, 0.0), axis=0)
        largest_m = LARGEST_MARKER_DEVIATIONS * self.sigma_m[:, None]
        return bool((scatter_m <= largest_m)[visible].all())
