"""Topics of a robot's log: what each can be used for, and conversion of messages to tables.

Messages are recognised by their fields, not by the names of their types: a wrench has a force and a
torque, a marker a name and a point, a pose a point and a quaternion.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import groupby, islice
from pathlib import Path
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...common.files import require_regular
from ...errors import InputError, hint_at
from .camera_messages import camera_data_kind, is_camera_model, use_of_camera_message
from .logs import Log, TopicAddress, open_log, require_packages, require_topic

AXES = ("x", "y", "z")
POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
WRENCH = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")
# Where messages hold a pose, a point or a single number; the first that is there is it.
_POSES = (
    ("pose.pose.position", "pose.pose.orientation"),
    ("pose.position", "pose.orientation"),
    ("transform.translation", "transform.rotation"),
    ("translation", "rotation"),
    ("position", "orientation"),
)
_POINTS = ("pose.pose.position", "pose.position", "position", "translation", "point", "pose")
_NAMES = ("marker_name", "name", "id", "ns", "child_frame_id")
_NUMBER_FIELDS = {
    "fluid_pressure": "pressure_pa",
    "range": "range_m",
    "data": "data",
    "value": "value",
}
_LISTS = (
    "transforms",
    "markers",
    "poses",
    "points",
    "objects",
    "rigidbodies",
    "detections",
    "tracks",
)
# Where items of a list hold a pixel, and how sure the tracker is of it; "" is the item itself.
_PIXELS = (
    "pixel",
    "centre",
    "center",
    "bbox.center.position",
    "bbox.center",
    "position",
    "point",
    "",
)
_LIKELIHOODS = ("likelihood", "confidence", "score", "visibility")
PIXEL_COLUMNS = ("u", "v", "likelihood")
# Largest difference of stamp and recording time on one clock [ns], a day: otherwise the stamp is of
# another clock, such as a simulation's.
SAME_CLOCK_NS = 86_400 * 10**9
# Largest excess of a joint over its limits [rad or m]: noise of its sensor.
JOINT_LIMIT_SLACK = 0.01
# Number of first messages from which the use of a topic is recognised.
_FIRST = 20

# Ending of the name of the topic with fixed frames.
STATIC_TOPIC_SUFFIX = "_static"

Row = dict[str, float]
# Poses by time of each child in its parent.
Edges = dict[tuple[str, str], dict[float, tuple[float, ...]]]


@dataclass(frozen=True)
class LogTopic:
    """A topic of a log, and its possible uses."""

    name: str
    type: str
    messages: int  # number of messages
    rate_hz: float | None  # rate of the first messages; None for fewer than two
    serves: str  # possible uses in words; empty if the topic cannot be used
    # Text to write in a problem file in place of a file, one for each way to read the topic.
    write: tuple[str, ...]
    # Frame in which the first message states its values; empty if it names none, and for
    # transforms.
    frame: str = ""


def list_topics(path: str | Path) -> list[LogTopic]:
    """Return the topics of a log; of a dataset, with the rates of its episode 0.

    Raises
    ------
    InputError
        If the path is no log, the log is damaged, or a package that reads it is missing.
    """
    with open_log(Path(path), episode=0) as log:
        marker_frames = _marker_frames(log)
        topics = [
            _describe_topic(log, Path(path), name=name, marker_frames=marker_frames)
            for name in log.topics
        ]
        points = [
            each.name
            for each in topics
            if any(
                point_of_message(message) is not None
                for _, message in islice(log.messages(each.name), 1)
            )
        ]
    together = f"{Path(path).name}#{','.join(points)}"
    return [
        replace(each, write=(*each.write, together))
        if len(points) > 1 and each.name in points
        else each
        for each in topics
    ]


def topic_as_csv(address: TopicAddress) -> bytes:
    """Return the content of a CSV file equivalent to a topic; times count from the log's first
    message, see `measurement_time_s`.

    Numbers that a message does not have are blank cells.

    Raises
    ------
    InputError
        If the topic does not exist, has no messages, holds camera data or no known data, or if
        frames or a robot's description are needed and missing.
    """
    with open_log(address.log, address.episode) as log:
        require_topic(log, address.topic)
        messages = list(log.messages(address.topic))
        if not messages:
            raise InputError(
                f"the topic {address.topic} has no messages; expected a topic with numbers"
            )
        if kind := camera_data_kind(messages[0][1]):
            raise InputError(
                f"the topic {address.topic} contains {kind}; expected a topic with numbers"
            )
        if is_transforms(messages[0][1]):
            return csv_content(
                POSE,
                *_poses_through_frames(
                    _all_transforms(log, messages, topic=address.topic), address
                ),
            )
        times, ordered = sort_by_time(messages, log.start_ns)
        by_namespace = has_namespaces(ordered)
        rows = [_message_values(each, by_namespace=by_namespace) for each in ordered]
        unit = address.unit or log.unit
    columns = list(dict.fromkeys(name for row in rows for name in row))
    if not columns:
        raise InputError(
            f"the topic {address.topic} contains neither poses, points, wrenches, joint positions "
            "nor numbers; expected a topic with one of these"
        )
    values = np.array([[row.get(name, np.nan) for name in columns] for row in rows])
    if address.robot is not None:
        return csv_content(
            POSE, times, values=_poses_from_joints(columns, values, address=address, unit=unit)
        )
    return csv_content(columns, times, values=values)


def _marker_frames(log: Log) -> list[str]:
    """Return the frames of topics with points, each once, by their first messages."""
    frames = []
    for name in log.topics:
        for _, message in islice(log.messages(name), 1):
            is_other = is_transforms(message) or camera_data_kind(message)
            frame = frame_of_message(message)
            if (
                frame
                and not is_other
                and _pose_of_message(message) is None
                and _points_of_message(message, by_namespace=False)
            ):
                frames.append(frame)
    return list(dict.fromkeys(frames))


def frame_of_message(message: Any) -> str:
    """Return the name of the frame of a message, or of its first item, without a leading slash;
    empty if neither names one.
    """
    first = next(iter(first_list(message)), None)
    frame = nested_field(message, "header.frame_id") or nested_field(first, "header.frame_id")
    return str(frame or "").lstrip("/")


def _describe_topic(log: Log, path: Path, name: str, marker_frames: Iterable[str]) -> LogTopic:
    """Return type, count, rate, possible uses and addresses of a topic."""
    kind, count = log.topics[name]
    first = list(islice(log.messages(name), _FIRST))
    span = first[-1][0] - first[0][0] if len(first) > 1 else 0
    rate = 1e9 * (len(first) - 1) / span if span > 0 else None
    serves = ""
    write = [f"{path.name}#{name}"]
    is_stated = bool(first) and not is_transforms(first[0][1])
    frame = frame_of_message(first[0][1]) if is_stated else ""
    if first and is_transforms(first[0][1]):
        edges = _all_transforms(log, log.messages(name), topic=name)
        chains = moving_chains(edges)
        chains += chains_from(edges, marker_frames, chains=chains)
        serves = "poses of one frame relative to another" if chains else "static frames"
        write = [f"{write[0]}#{parent}>{child}" for parent, child in chains]
        if name.removesuffix(STATIC_TOPIC_SUFFIX) in log.topics and name.endswith(
            STATIC_TOPIC_SUFFIX
        ):
            serves += f", part of the chains of {name.removesuffix(STATIC_TOPIC_SUFFIX)}"
    elif first and (use := use_of_camera_message(first[0][1])):
        serves = use
        if is_camera_model(first[0][1]):
            write = []
    elif first:
        messages = [message for _, message in first]
        by_namespace = has_namespaces(messages)
        columns = set[str]().union(
            *(_message_values(each, by_namespace=by_namespace) for each in messages)
        )
        serves = _possible_uses(columns, messages[0])
        if serves.startswith("positions"):
            write.append(f"{write[0]}#ROBOT.urdf#BASE>TOOL")
    return LogTopic(
        name,
        kind,
        messages=count,
        rate_hz=rate,
        serves=serves,
        write=tuple(write if serves else ()),
        frame=frame,
    )


def _possible_uses(columns: set[str], message: Any) -> str:
    """Return the possible uses of messages as text, from columns and an example."""
    if not columns:
        return ""
    if columns == {*POSE}:
        return "poses of a grasp or an obstacle"
    if columns == {*WRENCH}:
        return "wrench of a grasp, force of an obstacle"
    if hasattr(message, "name") and hasattr(message, "position"):
        return "positions of joints; poses with the robot's URDF"
    if all(column.rpartition("_")[2] in PIXEL_COLUMNS for column in columns):
        tracked = sorted({column.rpartition("_")[0] for column in columns})
        return "image tracks: " + ", ".join(tracked)
    if all(column[-2:] in ("_x", "_y", "_z") for column in columns):
        markers = sorted({column[:-2] for column in columns})
        spaces = groupby(markers, key=lambda marker: marker.rpartition("/")[0])
        return "marker tracks: " + "; ".join(", ".join(markers) for _, markers in spaces)
    return "numbers: a pressure, a tension, a reading"


# From messages to rows ----------------------------------------------------------------------------


def sort_by_time(messages: list[tuple[int, Any]], start_ns: int) -> tuple[Array, list[Any]]:
    """Return the times (S,) [s] of messages, ascending, and the messages in this order; of messages
    with the same time the first is kept.

    Parameters
    ----------
    messages : list of (int, message)
        Times of recording [ns], and messages.
    start_ns : int
        Time of recording of the log's first message.
    """
    t_s = np.array(
        [measurement_time_s(message, at_ns, start_ns=start_ns) for at_ns, message in messages]
    )
    times, first = np.unique(t_s, return_index=True)
    return times, [messages[k][1] for k in first]


def measurement_time_s(message: Any, recorded_ns: int, start_ns: int) -> float:
    """Return the time of measurement of a message [s], or of its recording if it has no stamp or
    the stamp is zero.

    The time counts from the log's first message; it is absolute if the stamp differs by more than
    `SAME_CLOCK_NS` from the recording, as it is then of another clock.

    Parameters
    ----------
    recorded_ns : int
        Time at which the message was recorded [ns].
    start_ns : int
        Time at which the first message of the log was recorded [ns].
    """
    first = next(iter(first_list(message)), None)
    stamps = (
        nested_field(message, "header.stamp"),
        nested_field(message, "timestamp"),
        nested_field(first, "header.stamp"),
    )
    stamped_ns = next((_nanoseconds(each) for each in stamps if each is not None), 0)
    if not stamped_ns:
        return (recorded_ns - start_ns) / 1e9
    is_another = abs(stamped_ns - recorded_ns) > SAME_CLOCK_NS
    return (stamped_ns - (0 if is_another else start_ns)) / 1e9


def _nanoseconds(stamp: Any) -> int:
    """Return a stamp in nanoseconds; a missing field counts as 0."""
    counted = {10**9: ("sec", "seconds", "secs"), 1: ("nanosec", "nsec", "nanos", "nsecs")}
    return sum(
        factor * int(next((getattr(stamp, name) for name in names if hasattr(stamp, name)), 0))
        for factor, names in counted.items()
    )


def _message_values(message: Any, *, by_namespace: bool) -> Row:
    """Return the numbers of a message by their columns, of the first kind that it has: a wrench,
    joint positions, a pose, points, a single number or a list of numbers; empty if it has none.

    With `by_namespace` the names of markers begin with their namespace.
    """
    wrench = nested_field(message, "wrench") or message
    if _is_vector(force := nested_field(wrench, "force")):
        values = [*_vector(force), *_vector(nested_field(wrench, "torque"))]
        return dict(zip(WRENCH, values, strict=True))
    if hasattr(message, "name") and hasattr(message, "position"):
        pairs = zip(message.name, message.position, strict=True)
        return {str(name): float(value) for name, value in pairs}
    if (pose := _pose_of_message(message)) is not None:
        return dict(zip(POSE, pose, strict=True))
    points = _points_of_message(message, by_namespace=by_namespace)
    if points:
        return {f"{name}_{axis}": p[k] for name, p in points.items() for k, axis in enumerate(AXES)}
    if pixels := _pixels_of_message(message, by_namespace=by_namespace):
        return pixels
    for name, column in _NUMBER_FIELDS.items():
        if isinstance(value := nested_field(message, name), (int, float)):
            return {column: float(value)}
        if name == "data" and isinstance(value, (list, np.ndarray)) and len(np.shape(value)) == 1:
            return {f"{column}_{k}": float(each) for k, each in enumerate(value)}
    return {}


def _pose_of_message(message: Any) -> tuple[float, ...] | None:
    """Return position and quaternion (x, y, z, w) of a message; None without."""
    for position, rotation in _POSES:
        if hasattr(turned := nested_field(message, rotation), "w"):
            return (*_vector(nested_field(message, position)), *_vector(turned), turned.w)
    return None


def _points_of_message(message: Any, *, by_namespace: bool) -> dict[str, tuple[float, ...]]:
    """Return positions (x, y, z) by name: of a single point, or of those items of the first list
    that have a position; empty if there are none.

    A single point is named by its frame, else "point"; for items see `_item_name`.
    """
    if (one := point_of_message(message)) is not None:
        return {nested_field(message, "header.frame_id") or "point": one}
    items = enumerate(first_list(message))
    places = {
        _item_name(item, k, by_namespace=by_namespace): _position_of_item(item) for k, item in items
    }
    return {key: place for key, place in places.items() if place is not None}


def _pixels_of_message(message: Any, *, by_namespace: bool) -> Row:
    """Return pixels of the first list, and how sure the tracker is, by column."""
    row: Row = {}
    for k, item in enumerate(first_list(message)):
        places = (nested_field(item, path) if path else item for path in _PIXELS)
        pixel = next((found for each in places if (found := _pixel(each)) is not None), None)
        if pixel is None:
            continue
        name = _item_name(item, k, by_namespace=by_namespace)
        row |= {f"{name}_u": pixel[0], f"{name}_v": pixel[1]}
        results = nested_field(item, "results")
        held = [item, *(results if results is not None else ())]
        held += [nested_field(each, "hypothesis") for each in held[1:]]
        found = (getattr(each, key, None) for each in held for key in _LIKELIHOODS)
        if (likelihood := next((each for each in found if each is not None), None)) is not None:
            row[f"{name}_likelihood"] = float(likelihood)
    return row


def _pixel(value: Any) -> tuple[float, float] | None:
    """Return the fields u and v of a value, or x and y of one without z; None without."""
    for axes in ("uv", "xy"):
        if all(hasattr(value, axis) for axis in axes) and not hasattr(value, "z"):
            return float(getattr(value, axes[0])), float(getattr(value, axes[1]))
    return None


def point_of_message(message: Any) -> tuple[float, ...] | None:
    """Return the position (x, y, z) of a message with a single point; None if it has none."""
    one = nested_field(message, "point")
    return _vector(one) if _is_vector(one) else None


def first_list(message: Any) -> Any:
    """Return the first list of `_LISTS` in a message that is not empty; empty if there is none."""
    lists = (nested_field(message, name) for name in _LISTS)
    return next((each for each in lists if each is not None and len(each)), ())


def _position_of_item(item: Any) -> tuple[float, ...] | None:
    """Return the position of an item of a list; None if it has none."""
    if _is_vector(item):
        return _vector(item)
    return next((_vector(p) for name in _POINTS if _is_vector(p := nested_field(item, name))), None)


def _item_name(item: Any, index: int, *, by_namespace: bool) -> str:
    """Return the name of an item of a list; its number, `index` + 1, if it has none. With
    `by_namespace` its namespace and a slash are put before it, if it has one.
    """
    names = (nested_field(item, name) for name in _NAMES)
    name = str(next((name for name in names if name not in (None, "")), index + 1))
    return (
        f"{namespace}/{name}" if by_namespace and (namespace := nested_field(item, "ns")) else name
    )


def has_namespaces(messages: Iterable[Any]) -> bool:
    """Return whether the messages hold markers of several namespaces, whose names may be the
    same.
    """
    return (
        len(
            {nested_field(item, "ns") for each in messages for item in first_list(each)}
            - {None, ""}
        )
        > 1
    )


def nested_field(message: Any, path: str) -> Any:
    """Return the nested field at a path of names with dots between them; None
    if it does not exist.
    """
    for name in path.split("."):
        message = getattr(message, name, None)
    return message


def _is_vector(value: Any) -> bool:
    """Return whether a value has the fields x, y and z."""
    return all(hasattr(value, axis) for axis in AXES)


def _vector(value: Any) -> tuple[float, ...]:
    """Return the fields x, y and z as numbers."""
    return tuple(float(getattr(value, axis)) for axis in AXES)


# Frames and joints --------------------------------------------------------------------------------


def is_transforms(message: Any) -> bool:
    """Return whether a message places frames in others: it has a list of transforms, or is a
    transform itself.
    """
    return nested_field(message, "transforms") is not None or transform_frames(message) is not None


def transform_frames(transform: Any) -> tuple[str, str] | None:
    """Return the parent and the child frame of a transform, without a leading slash; None if the
    message is no transform. Odometry, which has a twist, is none.
    """
    child = nested_field(transform, "child_frame_id")
    parent = nested_field(transform, "parent_frame_id") or nested_field(
        transform, "header.frame_id"
    )
    is_one = child and parent and _pose_of_message(transform) and not hasattr(transform, "twist")
    return (parent.lstrip("/"), child.lstrip("/")) if is_one else None


def poses_of_transforms(messages: Iterable[tuple[int, Any]], start_ns: int) -> Edges:
    """Return poses of child frames in their parents, by (parent, child) and time [s], from messages
    with their times of recording [ns]; times count from `start_ns` [ns].

    Of several poses at a time the first is kept; messages without transforms are ignored.
    """
    edges: Edges = {}
    for at_ns, message in messages:
        for each in nested_field(message, "transforms") or [message]:
            pose = _pose_of_message(each)
            if (edge := transform_frames(each)) is not None and pose is not None:
                edges.setdefault(edge, {}).setdefault(
                    measurement_time_s(each, at_ns, start_ns=start_ns), pose
                )
    return edges


def _all_transforms(log: Log, moving: Iterable[tuple[int, Any]], topic: str) -> Edges:
    """Return the poses of a topic's transforms `moving` and of the fixed transforms in its static
    topic, which have the time 0, by (parent, child) and time [s].

    Of a pair of frames in both topics the moving transforms are kept.
    """
    still = (
        log.messages(topic + STATIC_TOPIC_SUFFIX)
        if topic + STATIC_TOPIC_SUFFIX in log.topics
        else ()
    )
    fixed = {
        edge: {0.0: next(iter(of.values()))}
        for edge, of in poses_of_transforms(still, log.start_ns).items()
    }
    return fixed | poses_of_transforms(moving, log.start_ns)


def moving_chains(edges: Edges) -> list[tuple[str, str]]:
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


def chains_from(
    edges: Edges, frames: Iterable[str], chains: Iterable[tuple[str, str]]
) -> list[tuple[str, str]]:
    """Return pairs of each of some frames and each frame that moves in it, apart from `chains`.

    Parameters
    ----------
    frames : iterable of str
        Frames at which chains begin; those without a transform are ignored.
    chains : iterable of (str, str)
        Pairs of a root frame and a frame that moves in it, see `moving_chains`.
    """
    known = list(chains)
    connected = {name for edge in edges for name in edge}
    found = []
    for frame in frames:
        for _, child in known:
            pair = frame, child
            if frame not in connected or frame == child or pair in known:
                continue
            try:
                path = frame_path(edges, frame, child=child)
            except InputError:  # not connected
                continue
            if any(len(edges[edge]) > 1 for edge in path):
                found.append(pair)
    return found


def _poses_through_frames(edges: Edges, address: TopicAddress) -> tuple[Array, Array]:
    """Return times (T,) [s] and poses (T, 7) of one frame in another: position, then quaternion (x,
    y, z, w), through all frames between them.

    The times are those of the most frequent transform; others are interpolated along screw motions.
    """
    require_packages("pytransform3d")
    from pytransform3d.trajectories import pqs_from_transforms, transforms_from_pqs
    from pytransform3d.transform_manager import NumpyTimeseriesTransform as Series
    from pytransform3d.transform_manager import StaticTransform as Static
    from pytransform3d.transform_manager import TemporalTransformManager as Manager

    parent, child = requested_frames(edges, address)
    path = frame_path(edges, parent, child=child)
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
    manager = Manager(check=False)
    for edge in path:
        at_s = np.array(sorted(edges[edge]))
        poses = np.array([edges[edge][t] for t in at_s])[:, [0, 1, 2, 6, 3, 4, 5]]
        if len(at_s) > 1:
            series: Any = Series(at_s, poses)
        else:
            series = Static(transforms_from_pqs(poses[0]))
        manager.add_transform(edge[1], edge[0], series)
    matrices = manager.get_transform_at_time(child, parent, times)
    return times, pqs_from_transforms(matrices)[:, [0, 1, 2, 4, 5, 6, 3]]


def requested_frames(
    edges: Mapping[tuple[str, str], Any], address: TopicAddress
) -> tuple[str, str]:
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


def frame_path(
    edges: Mapping[tuple[str, str], Any], parent: str, child: str
) -> list[tuple[str, str]]:
    """Return the edges (parent, child) on the path from one frame through the common ancestor to
    the other, those above `child` first.

    Raises
    ------
    InputError
        If the frames are not connected, or are the same.
    """
    above = {child: (parent, child) for parent, child in edges}

    def up(frame: str) -> list[tuple[str, str]]:
        """Return the edges from a frame to its root, or to a repeated edge in a loop."""
        passed: list[tuple[str, str]] = []
        while frame in above and above[frame] not in passed:
            passed.append(above[frame])
            frame = above[frame][0]
        return passed

    ours = up(child)
    theirs = up(parent)
    path = [edge for edge in (*ours, *theirs) if (edge in ours) != (edge in theirs)]
    roots = {(each[-1][0] if each else frame) for each, frame in ((ours, child), (theirs, parent))}
    if not path or len(roots) > 1:
        raise InputError(
            f"no chain of frames leads from {parent} to {child}; expected a transform (tf or "
            "tf_static) between each frame and the next"
        )
    return path


def _poses_from_joints(
    columns: list[str], values: Array, address: TopicAddress, unit: str | None
) -> Array:
    """Return poses (T, 7) of a link from joint positions by the URDF file."""
    require_packages("pytransform3d")
    from pytransform3d.transformations import pq_from_transform
    from pytransform3d.urdf import UrdfTransformManager

    assert address.robot is not None
    require_regular(address.robot)
    if address.frames is None:
        raise InputError(
            f"found no frames after {address.robot.name}; expected two, as in "
            f"{address.robot.name}#base>tool"
        )
    robot = UrdfTransformManager(check=False)
    try:
        robot.load_urdf(address.robot.read_text(encoding="utf-8"))
    except Exception as error:  # lxml's and the library's own
        raise InputError(f"this is not a valid URDF file: {error}", address.robot) from error
    parent, child = address.frames
    for frame in address.frames:
        if not robot.has_frame(frame):
            links = [node for node in robot.nodes if isinstance(node, str)]
            raise InputError(
                f"there is no link {frame!r}; expected one of the links of the robot: "
                f"{', '.join(links)}{hint_at(frame, links)}",
                address.robot,
            )
    if unit is None:
        raise InputError(
            "the log does not state the unit of the joint positions; expected #rad or #deg after "
            "the topic"
        )
    limits = {name: robot.get_joint_limits(name) for name in columns if _has_joint(robot, name)}
    if not limits:
        joints = ", ".join(columns)
        raise InputError(
            f"the robot has none of the joints {joints} of the log; expected the description of "
            "the recorded robot",
            address.robot,
        )
    poses = np.empty((len(values), 7))
    for row, position in enumerate(values):
        for name, value in zip(columns, position, strict=True):
            if name in limits:
                angle = np.radians(value) if unit == "deg" else value
                _require_joint_limits(name, angle, limits=limits[name], address=address)
                robot.set_joint(name, angle)
        poses[row] = pq_from_transform(robot.get_transform(child, parent))[[0, 1, 2, 4, 5, 6, 3]]
    return poses


def _has_joint(robot: Any, name: str) -> bool:
    """Return whether a robot has a joint of this name."""
    try:
        robot.get_joint_limits(name)
    except KeyError:
        return False
    return True


def _require_joint_limits(
    name: str, angle: float, limits: tuple[float, float], address: TopicAddress
) -> None:
    """Raise an `InputError` if a joint is at an angle or displacement beyond its limits [rad or m]
    by more than `JOINT_LIMIT_SLACK`: the library would silently clip it. The message names the
    robot of `address`.
    """
    if not limits[0] - JOINT_LIMIT_SLACK <= angle <= limits[1] + JOINT_LIMIT_SLACK:
        hint = "" if address.unit else "; if these are degrees, append #deg to the topic"
        raise InputError(
            f"the joint {name} is at {angle:.4g}, outside its limits {limits[0]:.4g} to "
            f"{limits[1]:.4g} in {address.robot and address.robot.name}; expected positions within "
            f"the limits of the recorded robot{hint}"
        )


def csv_content(columns: Any, t_s: Array, values: Array) -> bytes:
    """Return times (T,) and values (T, columns) as the bytes of a CSV file with a row of names; NaN
    becomes a blank cell.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("t_s", *columns))
    for t, row in zip(t_s.tolist(), values.tolist(), strict=True):
        writer.writerow((repr(t), *("" if x != x else repr(x) for x in row)))
    return text.getvalue().encode()
