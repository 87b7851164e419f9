"""Topics of a robot's log: what each can be used for, and the tables of their numbers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby, islice
from pathlib import Path
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...common.text_files import HAND_WRITTEN_BYTES, read_text
from ...errors import InputError, hint_at
from ..gap_interpolation import interpolate_without_gaps
from .camera_messages import camera_data_kind, is_camera_model, use_of_camera_message
from .log_frames import (
    STATIC_TOPIC_SUFFIX,
    Edges,
    chains_from,
    moving_chains,
    poses_through_frames,
    read_transforms,
)
from .logs import Log, TopicAddress, open_log, require_packages
from .messages import (
    AXES,
    PIXEL_COLUMNS,
    POSE,
    WRENCH,
    frame_of_message,
    is_transforms,
    message_rows,
    point_of_message,
)
from .text import Table

# Largest excess of a joint over its limits [rad or m]: noise of its sensor.
JOINT_LIMIT_SLACK = 0.01
# Number of first messages from which the use of a topic is recognised.
_FIRST = 20
TOPIC_LIST_SEPARATOR = ","
# Beginning of the use of topics with points.
_TRACKS = "marker tracks: "


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
    path = Path(path)
    with open_log(path, episode=0) as log:
        first = {name: log.first(name) for name in log.topics}
        points = [name for name, each in first.items() if point_of_message(each) is not None]
        together = [f"{path.name}#{','.join(points)}"] if len(points) > 1 else []
        marker_frames = [
            frame_of_message(each)
            for each in first.values()
            if not is_transforms(each) and _possible_uses([each]).startswith(_TRACKS)
        ]
        return [
            _describe_topic(
                log,
                path,
                name=name,
                marker_frames=dict.fromkeys(marker_frames),
                together=together if name in points else (),
            )
            for name in log.topics
        ]


def topic_table(address: TopicAddress) -> Table:
    """Return the table of a topic, or of several topics with one point each, whose names are
    separated by commas; times count from the log's first message, see `measurement_time_s`.

    Numbers that a message does not have are NaN.

    Raises
    ------
    InputError
        If the topic does not exist, has no messages, holds camera data or no known data, or if
        frames or a robot's description are needed and missing; and if one of several topics has no
        points, or their frames differ.
    """
    topic = address.topic
    with open_log(address.log, address.episode) as log:
        if TOPIC_LIST_SEPARATOR in topic:
            return _points_table(log, [name.strip() for name in topic.split(TOPIC_LIST_SEPARATOR)])
        if (first := log.first(topic)) is None:
            raise InputError(f"the topic {topic} has no messages; expected a topic with numbers")
        if kind := camera_data_kind(first):
            raise InputError(f"the topic {topic} contains {kind}; expected a topic with numbers")
        if is_transforms(first):
            return _table(POSE, *poses_through_frames(_transforms(log, topic), address))
        t_s, messages = log.read(topic)
        rows = message_rows(messages)
        unit = address.unit or log.unit
    columns = list(dict.fromkeys(name for row in rows for name in row))
    if not columns:
        raise InputError(
            f"the topic {topic} contains neither poses, points, wrenches, joint positions "
            "nor numbers; expected a topic with one of these"
        )
    values = np.array([[row.get(name, np.nan) for name in columns] for row in rows])
    if address.robot is not None:
        return _table(POSE, t_s, _poses_from_joints(columns, values, address=address, unit=unit))
    return _table(columns, t_s, values)


def _table(columns: Iterable[str], t_s: Array, values: Array) -> Table:
    """Return the table of values (T, columns); messages name lines as of its CSV file."""
    return Table(["t_s", *columns], np.column_stack([t_s, values]), range(2, len(t_s) + 2))


def _points_table(log: Log, topics: Sequence[str]) -> Table:
    """The times are those of the longest topic; the points of others are interpolated."""
    tracks = []
    frames: dict[str, set[str]] = {}
    for topic in topics:
        t_s, messages = log.read(topic)
        points = [point_of_message(message) for message in messages]
        if not points:
            raise InputError(f"the topic {topic} has no messages; expected a topic with points")
        if None in points:
            raise InputError(
                f"the topic {topic} has no single point per message; expected points, such as "
                "PointStamped, in each of several topics"
            )
        frames[topic] = {frame_of_message(message) for message in messages} - {""}
        tracks.append((t_s, np.array(points)))
    if len(set().union(*frames.values())) > 1:
        stated = "; ".join(
            f"{topic}: {', '.join(sorted(of)) or 'none'}" for topic, of in frames.items()
        )
        raise InputError(
            f"points of one marker table have different frame_id ({stated}); expected one frame: "
            "publish or convert all points in the world frame of the robot's poses"
        )
    times = max((t_s for t_s, _ in tracks), key=len)
    values = np.hstack([interpolate_without_gaps(times, *track) for track in tracks])
    columns = [f"{marker}_{axis}" for marker in _marker_names(topics) for axis in AXES]
    return _table(columns, times, values)


def _marker_names(topics: Iterable[str]) -> list[str]:
    """Return the topics without the parts that all have at their beginning and their end."""
    paths = [topic.strip("/").split("/") for topic in topics]
    for _ in range(2):  # from the beginning, then from the end
        levels = [len({*names}) for names in zip(*paths, strict=False)][:-1]
        common = next((k for k, count in enumerate(levels) if count > 1), len(levels))
        paths = [path[common:][::-1] for path in paths]
    return ["/".join(path) for path in paths]


def _transforms(log: Log, topic: str) -> Edges:
    topics = (topic + STATIC_TOPIC_SUFFIX, topic)
    return read_transforms(log, [name for name in topics if name in log.topics])


def _describe_topic(
    log: Log, path: Path, name: str, marker_frames: Iterable[str], together: Iterable[str]
) -> LogTopic:
    kind, count = log.topics[name]
    first = list(islice(log.messages(name), _FIRST))
    span = first[-1][0] - first[0][0] if len(first) > 1 else 0
    serves, frame = "", ""
    write = [f"{path.name}#{name}"]
    if first and is_transforms(first[0][1]):
        edges = _transforms(log, name)
        chains = moving_chains(edges)
        chains += chains_from(edges, marker_frames, chains=chains)
        serves = "poses of one frame relative to another" if chains else "static frames"
        write = [f"{write[0]}#{parent}>{child}" for parent, child in chains]
        moving = name.removesuffix(STATIC_TOPIC_SUFFIX)
        if moving != name and moving in log.topics:
            serves += f", part of the chains of {moving}"
    elif first:
        messages = [message for _, message in first]
        serves = _possible_uses(messages)
        frame = frame_of_message(messages[0])
        if is_camera_model(messages[0]):
            write = []
        if serves.startswith("positions"):
            write.append(f"{write[0]}#ROBOT.urdf#BASE>TOOL")
    return LogTopic(
        name,
        kind,
        messages=count,
        rate_hz=1e9 * (len(first) - 1) / span if span > 0 else None,
        serves=serves,
        write=(*(write if serves else ()), *together),
        frame=frame,
    )


def _possible_uses(messages: Sequence[Any]) -> str:
    if use := use_of_camera_message(messages[0]):
        return use
    columns = set[str]().union(*message_rows(messages))
    if not columns:
        return ""
    if columns == {*POSE}:
        return "poses of a grasp or an obstacle"
    if columns == {*WRENCH}:
        return "wrench of a grasp, force of an obstacle"
    if hasattr(messages[0], "name") and hasattr(messages[0], "position"):
        return "positions of joints; poses with the robot's URDF"
    if all(column.rpartition("_")[2] in PIXEL_COLUMNS for column in columns):
        tracked = sorted({column.rpartition("_")[0] for column in columns})
        return "image tracks: " + ", ".join(tracked)
    if all(column[-2:] in ("_x", "_y", "_z") for column in columns):
        markers = sorted({column[:-2] for column in columns})
        spaces = groupby(markers, key=lambda marker: marker.rpartition("/")[0])
        return _TRACKS + "; ".join(", ".join(markers) for _, markers in spaces)
    return "numbers: a pressure, a tension, a reading"


def _poses_from_joints(
    columns: list[str], values: Array, address: TopicAddress, unit: str | None
) -> Array:
    """Return poses (T, 7) of a link from joint positions by the URDF file."""
    require_packages("pytransform3d")
    from pytransform3d.transformations import pq_from_transform
    from pytransform3d.urdf import UrdfTransformManager

    assert address.robot is not None
    if address.frames is None:
        raise InputError(
            f"found no frames after {address.robot.name}; expected two, as in "
            f"{address.robot.name}#base>tool"
        )
    robot = UrdfTransformManager(check=False)
    text = read_text(address.robot, "a description of the robot (URDF)", HAND_WRITTEN_BYTES)
    try:
        robot.load_urdf(text)
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
    limits: dict[str, tuple[float, float]] = {}
    for name in columns:
        with suppress(KeyError):
            limits[name] = robot.get_joint_limits(name)
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
                low, high = limits[name]
                # The library would silently clip it.
                if not low - JOINT_LIMIT_SLACK <= angle <= high + JOINT_LIMIT_SLACK:
                    hint = (
                        "" if address.unit else "; if these are degrees, append #deg to the topic"
                    )
                    raise InputError(
                        f"the joint {name} is at {angle:.4g}, outside its limits {low:.4g} to "
                        f"{high:.4g} in {address.robot.name}; expected positions within the limits "
                        f"of the recorded robot{hint}"
                    )
                robot.set_joint(name, angle)
        poses[row] = pq_from_transform(robot.get_transform(child, parent))[[0, 1, 2, 4, 5, 6, 3]]
    return poses
