"""Frames of a log: the frames in which its topics are stated, and transforms between them.

Use this module to relate recordings of one log that are stated in different frames, such as poses
in the frame of cameras and gravity in that of a robot's base.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ...common.array_types import Array
from ...errors import InputError, hint_at
from .logs import Log, TopicAddress, open_log, require_packages
from .messages import (
    frame_of_message,
    is_transforms,
    measurement_time_s,
    nested_field,
    pose_of_message,
    transform_frames,
)

# Ending of the name of the topic with fixed frames.
STATIC_TOPIC_SUFFIX = "_static"
# Parts of the names of topics or types that hold transforms between frames; others are not read.
TRANSFORM_NAMES = ("tf", "transform")
# Largest difference of the numbers of poses of a transform that does not move [m, 1]: rounding.
SAME_POSE = 1e-9

# A parent frame and its child.
Edge = tuple[str, str]
# Poses by time [s] of each child in its parent.
Edges = dict[Edge, dict[float, tuple[float, ...]]]


@dataclass(frozen=True)
class TopicFrames:
    """Frames in which the messages of a topic are stated; empty where a topic does not state one."""

    parent: str = ""  # frame of the components: of positions, or of forces
    child: str = ""  # frame whose pose the messages hold

    @classmethod
    def read(cls, address: TopicAddress) -> TopicFrames:
        """Return the frames of a topic from its address or its first message; of several topics,
        separated by commas, those of the first. Both are empty if the topic does not exist.

        Raises
        ------
        InputError
            If the log cannot be read.
        """
        if address.frames is not None:
            return cls(*address.frames)
        topic = address.topic.partition(",")[0].strip()
        with open_log(address.log, address.episode) as log:
            first = log.first(topic) if topic in log.topics else None
        transforms = nested_field(first, "transforms") or [first]
        if (edge := transform_frames(transforms[0])) is not None:
            return cls(*edge)
        child = nested_field(first, "child_frame_id")
        return cls(frame_of_message(first), str(child or "").lstrip("/"))


@dataclass(frozen=True)
class LogFrames:
    """Transforms between the frames of a log."""

    name: str = ""  # name of the log, for messages; "" without a log
    edges: Edges = field(default_factory=dict)

    @classmethod
    def read(cls, address: TopicAddress) -> LogFrames:
        """Read the transforms of all topics of a log.

        Raises
        ------
        InputError
            If the log cannot be read.
        """
        with open_log(address.log, address.episode) as log:
            topics = [
                name
                for name, (kind, _) in log.topics.items()
                if any(part in f"{name} {kind}".lower() for part in TRANSFORM_NAMES)
                and is_transforms(log.first(name))
            ]
            return cls(address.log.name, read_transforms(log, topics))

    def is_connected(self, parent: str, child: str) -> bool:
        """Whether a chain of transforms, static or moving, leads from one frame to another."""
        return frame_path(self.edges, parent, child) is not None

    def static_transform(self, parent: str, child: str) -> Array | None:
        """Return the pose (4, 4) of a frame in another one from static transforms alone; None if
        the frames are not connected, or if a frame between them moves.
        """
        path = frame_path(self.edges, parent, child)
        if path is None or not all(map(self._is_static, path)):
            return None
        return _pose_along(path, parent, child, lambda edge: _first_matrix(self.edges[edge]))

    def static_neighbours(self, frame: str) -> list[str]:
        """Names of the other frames that static transforms connect with a frame."""
        return [
            name
            for name in dict.fromkeys(name for edge in self.edges for name in edge)
            if name != frame and self.static_transform(frame, name) is not None
        ]

    def _is_static(self, edge: Edge) -> bool:
        """Whether all poses of an edge are the same, in `SAME_POSE`."""
        poses = np.array(list(self.edges[edge].values()))
        return bool(np.ptp(poses, axis=0).max() <= SAME_POSE)


def read_transforms(log: Log, topics: Iterable[str]) -> Edges:
    """Return the transforms in some topics. Those of static topics have the time 0; of a pair of
    frames in both kinds of topics the moving ones are kept, and of several at a time the first.
    """
    edges: Edges = {}
    for topic in topics:
        is_fixed = topic.endswith(STATIC_TOPIC_SUFFIX)
        poses: Edges = {}
        for at_ns, message in log.messages(topic):
            for each in nested_field(message, "transforms") or [message]:
                pose = pose_of_message(each)
                if (edge := transform_frames(each)) is not None and pose is not None:
                    t_s = 0.0 if is_fixed else measurement_time_s(each, at_ns, log.start_ns)
                    poses.setdefault(edge, {}).setdefault(t_s, pose)
        edges |= {edge: of for edge, of in poses.items() if not (is_fixed and edge in edges)}
    return edges


def _first_matrix(poses: Mapping[float, tuple[float, ...]]) -> Array:
    """Return the matrix (4, 4) of the first pose: position (x, y, z) and quaternion (x, y, z, w)."""
    pose = next(iter(poses.values()))
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(pose[3:]).as_matrix()
    matrix[:3, 3] = pose[:3]
    return matrix


def _pose_along(
    path: Iterable[Edge], parent: str, child: str, pose_of: Callable[[Edge], Array]
) -> Array:
    """Return the pose (…, 4, 4) of a frame in another one, along the path between them."""
    above = {edge[1]: edge for edge in path}

    def in_root(frame: str) -> Array:
        pose = np.eye(4)
        while frame in above:
            pose = pose_of(above[frame]) @ pose
            frame = above[frame][0]
        return pose

    return np.linalg.inv(in_root(parent)) @ in_root(child)


def moving_chains(edges: Edges) -> list[Edge]:
    """Return pairs of a root frame and each frame that moves in it; leaf frames come first.

    A root is a frame that has no parent. A frame moves if an edge between it and the root has
    several poses.
    """
    above = {child: parent for parent, child in edges}
    moving = {child for (_, child), poses in edges.items() if len(poses) > 1}
    chains = []
    for frame in above:
        chain = [frame]
        while (parent := above.get(chain[-1])) is not None and parent not in chain:
            chain.append(parent)
        if chain[-1] not in above and moving & set(chain):
            chains.append((chain[-1], frame))
    carrying = set(above.values())
    return sorted(chains, key=lambda chain: chain[1] in carrying)


def chains_from(edges: Edges, frames: Iterable[str], chains: Iterable[Edge]) -> list[Edge]:
    """Return pairs of each of some frames and each frame that moves in it, apart from `chains`.

    Parameters
    ----------
    frames : iterable of str
        Frames at which chains begin; those without a transform are ignored.
    chains : iterable of (str, str)
        Pairs of a root frame and a frame that moves in it, see `moving_chains`.
    """
    known = list(chains)
    return [
        (frame, child)
        for frame in frames
        for _, child in known
        if (frame, child) not in known
        and any(len(edges[edge]) > 1 for edge in frame_path(edges, frame, child) or ())
    ]


def poses_through_frames(edges: Edges, address: TopicAddress) -> tuple[Array, Array]:
    """Return times (T,) [s] and poses (T, 7) of one frame in another: position, then quaternion (x,
    y, z, w), through all frames between them.

    The times are those of the most frequent transform; others are interpolated along screw motions.
    """
    require_packages("pytransform3d")
    from pytransform3d.trajectories import pqs_from_transforms
    from pytransform3d.transform_manager import NumpyTimeseriesTransform as Series

    parent, child = requested_frames(edges, address)
    path = frame_path(edges, parent, child)
    if not path:
        raise InputError(
            f"no chain of frames leads from {parent} to {child}; expected a transform (tf or "
            "tf_static) between each frame and the next"
        )
    moving = [np.array(sorted(edges[edge])) for edge in path if len(edges[edge]) > 1]
    if not moving:
        raise InputError(
            f"{child} does not move relative to {parent} in this log; expected two frames that "
            "move relative to each other. If the grasp, obstacle or camera is at rest, omit its poses"
        )
    first = max(t[0] for t in moving)
    last = min(t[-1] for t in moving)
    times = max((t[(t >= first) & (t <= last)] for t in moving), key=len)
    if not len(times):
        raise InputError(
            f"the transforms between {parent} and {child} have no common time span; expected a "
            "log in which all of them are recorded at the same time, or poses in a table"
        )

    def pose_of(edge: Edge) -> Array:
        if len(edges[edge]) == 1:
            return _first_matrix(edges[edge])
        at_s, poses = zip(*sorted(edges[edge].items()), strict=True)
        matrices: Array = Series(at_s, np.array(poses)[:, [0, 1, 2, 6, 3, 4, 5]]).as_matrix(times)
        return matrices

    matrices = _pose_along(path, parent, child, pose_of)
    return times, pqs_from_transforms(matrices)[:, [0, 1, 2, 4, 5, 6, 3]]


def requested_frames(edges: Mapping[Edge, Any], address: TopicAddress) -> Edge:
    """Return the parent and the child frame that an address states; without a statement, those of
    the only transform.

    Raises
    ------
    InputError
        If a frame does not exist, or none are stated and there is more than one transform.
    """
    frames = list(dict.fromkeys(frame for edge in edges for frame in edge))
    if address.frames is None:
        if len(edges) == 1:
            return next(iter(edges))
        example = f"{address.log.name}#{address.topic}#{frames[0]}>{frames[-1]}"
        raise InputError(
            f"the topic has the frames {', '.join(frames)}; expected two of them, as in {example}"
        )
    for frame in address.frames:
        if frame not in frames:
            raise InputError(
                f"there is no frame {frame!r}; expected one of "
                f"{', '.join(frames)}{hint_at(frame, frames)}"
            )
    return address.frames


def frame_path(edges: Iterable[Edge], parent: str, child: str) -> list[Edge] | None:
    """Return the edges on the path from one frame through the common ancestor to the other, those
    above `child` first; none for a frame and itself. None if the frames are not connected.
    """
    if parent == child:
        return []
    above = {edge[1]: edge for edge in edges}

    def up(frame: str) -> list[Edge]:
        """Return the edges from a frame to its root, or to a repeated edge in a loop."""
        passed: list[Edge] = []
        while frame in above and above[frame] not in passed:
            passed.append(above[frame])
            frame = above[frame][0]
        return passed

    ours = up(child)
    theirs = up(parent)
    path = [edge for edge in (*ours, *theirs) if (edge in ours) != (edge in theirs)]
    roots = {(each[-1][0] if each else frame) for each, frame in ((ours, child), (theirs, parent))}
    return path if path and len(roots) == 1 else None
