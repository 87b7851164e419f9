"""Frames of a log: the frames in which its topics are stated, and static transforms between them.

Use this module to relate recordings of one log that are stated in different frames, such as poses
in the frame of cameras and gravity in that of a robot's base.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ...common.array_types import Array
from ...errors import InputError
from .logs import Log, TopicAddress, open_log
from .topics import (
    STATIC_TOPIC_SUFFIX,
    Edges,
    frame_of_message,
    frame_path,
    is_transforms,
    nested_field,
    poses_of_transforms,
    transform_frames,
)

# Parts of the names of topics or types that hold transforms between frames; others are not read.
TRANSFORM_NAMES = ("tf", "transform")
# Largest difference of the numbers of poses of a transform that does not move [m, 1]: rounding.
SAME_POSE = 1e-9


@dataclass(frozen=True)
class TopicFrames:
    """Frames in which the messages of a topic are stated; empty where a topic does not state one."""

    parent: str = ""  # frame of the components: of positions, or of forces
    child: str = ""  # frame whose pose the messages hold


@dataclass(frozen=True)
class LogFrames:
    """Transforms between the frames of a log."""

    name: str  # name of the log, for messages
    edges: Edges  # mapping: poses of child frames in their parents, by (parent, child) and time [s]

    @classmethod
    def read(cls, address: TopicAddress) -> LogFrames:
        """Read the transforms of all topics of the log of an address.

        Raises
        ------
        InputError
            If the log cannot be read.
        """
        edges: Edges = {}
        with open_log(address.log, address.episode) as log:
            for topic in _transform_topics(log):
                poses = poses_of_transforms(log.messages(topic), log.start_ns)
                for edge, of in poses.items():
                    if topic.endswith(STATIC_TOPIC_SUFFIX):
                        edges.setdefault(edge, {0.0: next(iter(of.values()))})
                    else:
                        edges[edge] = of
        return cls(address.log.name, edges)

    @property
    def names(self) -> list[str]:
        """Names of the frames, each once."""
        return list(dict.fromkeys(name for edge in self.edges for name in edge))

    def is_connected(self, parent: str, child: str) -> bool:
        """Whether a chain of transforms, static or moving, leads from one frame to another."""
        if parent == child:
            return True
        try:
            frame_path(self.edges, parent, child=child)
        except InputError:
            return False
        return True

    def static_transform(self, parent: str, child: str) -> Array | None:
        """Return the pose (4, 4) of a frame in another one from static transforms alone; None if
        the frames are not connected, or if a frame between them moves.
        """
        if parent == child:
            return np.eye(4)
        if not self.is_connected(parent, child):
            return None
        path = frame_path(self.edges, parent, child=child)
        if not all(map(self._is_static, path)):
            return None
        return np.linalg.inv(self._pose_in_root(parent, path)) @ (self._pose_in_root(child, path))

    def static_neighbours(self, frame: str) -> list[str]:
        """Names of the other frames that static transforms connect with a frame."""
        return [
            name
            for name in self.names
            if name != frame and self.static_transform(frame, name) is not None
        ]

    def _is_static(self, edge: tuple[str, str]) -> bool:
        """Whether all poses of an edge are the same, in `SAME_POSE`."""
        poses = np.array(list(self.edges[edge].values()))
        return bool(np.ptp(poses, axis=0).max() <= SAME_POSE)

    def _pose_in_root(self, frame: str, path: Iterable[tuple[str, str]]) -> Array:
        """Return the pose (4, 4) in the uppermost frame of a path of static edges."""
        above = {child: parent for parent, child in path}
        pose = np.eye(4)
        while frame in above:
            edge = above[frame], frame
            pose = _matrix(next(iter(self.edges[edge].values()))) @ pose
            frame = edge[0]
        return pose


def _matrix(pose: tuple[float, ...]) -> Array:
    """Return the matrix (4, 4) of a position (x, y, z) and a quaternion (x, y, z, w)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(pose[3:]).as_matrix()
    matrix[:3, 3] = pose[:3]
    return matrix


def _transform_topics(log: Log) -> list[str]:
    """Return the names of the topics of a log whose first message holds transforms."""
    return [
        name
        for name, (kind, _) in log.topics.items()
        if any(part in f"{name} {kind}".lower() for part in TRANSFORM_NAMES)
        and any(is_transforms(message) for _, message in islice(log.messages(name), 1))
    ]


def topic_frames(path: str | Path) -> TopicFrames | None:
    """Return the frames in which a topic of a log is stated, from its address or its first message;
    None if the path names no topic of a log, or a topic that does not exist.

    Of several topics, separated by commas, the first is read.

    Raises
    ------
    InputError
        If the log cannot be read.
    """
    if (address := TopicAddress.from_path(path)) is None:
        return None
    if address.frames is not None:
        return TopicFrames(*address.frames)
    topic = address.topic.partition(",")[0].strip()
    with open_log(address.log, address.episode) as log:
        if topic not in log.topics:
            return None
        first = next((m for _, m in islice(log.messages(topic), 1)), None)
    transforms = nested_field(first, "transforms") or [first]
    if (edge := transform_frames(transforms[0])) is not None:
        return TopicFrames(*edge)
    child = nested_field(first, "child_frame_id")
    return TopicFrames(frame_of_message(first), str(child or "").lstrip("/"))
