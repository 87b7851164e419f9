"""Several topics of a log with one point each, such as PointStamped, read as one marker table.

The address lists the topics with commas, as in ``run.mcap#/markers/tip,/markers/base``. Each marker
has the name of that part of its topic by which the topics differ.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...common.array_types import Array
from ...errors import InputError
from ..gap_interpolation import interpolate_without_gaps
from .logs import Log, TopicAddress, open_log, require_topic
from .topics import AXES, csv_content, nested_field, point_of_message, sort_by_time, topic_as_csv

TOPIC_LIST_SEPARATOR = ","


def address_as_csv(address: TopicAddress) -> bytes:
    """Return the content of a CSV file equivalent to a topic, or to several topics with one point
    each, see `topic_as_csv` for the former.

    Times of several topics are those of the topic with the most messages; points of the others are
    interpolated linearly between their own times, and are missing beyond them or in gaps.

    Raises
    ------
    InputError
        As `topic_as_csv`; and if one of several topics has no points, or their frames differ.
    """
    names = [name.strip() for name in address.topic.split(TOPIC_LIST_SEPARATOR)]
    if len(names) == 1:
        return topic_as_csv(address)
    with open_log(address.log, address.episode) as log:
        tracks = {name: _track(log, name) for name in names}
    _require_one_frame({name: track[2] for name, track in tracks.items()})
    times = max((t_s for t_s, _, _ in tracks.values()), key=len)
    markers = marker_names(names)
    values = np.concatenate(
        [interpolate_without_gaps(times, *tracks[name][:2]) for name in names], axis=1
    )
    columns = [f"{marker}_{axis}" for marker in markers for axis in AXES]
    return csv_content(columns, times, values=values)


def marker_names(topics: list[str]) -> list[str]:
    """Return a name for the marker of each topic: the topics without the parts that all have in
    common at their beginning and their end, with slashes between the remaining parts.
    """
    parts = [topic.strip("/").split("/") for topic in topics]
    shortest = min(map(len, parts))
    head = 0
    while head < shortest - 1 and len({each[head] for each in parts}) == 1:
        head += 1
    tail = 0
    while tail < shortest - 1 - head and len({each[-1 - tail] for each in parts}) == 1:
        tail += 1
    return ["/".join(each[head : len(each) - tail]) for each in parts]


def _track(log: Log, topic: str) -> tuple[Array, Array, set[str]]:
    """Return times (S,) [s], points (S, 3) [m] and the frames of a topic."""
    require_topic(log, topic)
    messages = list(log.messages(topic))
    if not messages:
        raise InputError(f"the topic {topic} has no messages; expected a topic with points")
    t_s, ordered = sort_by_time(messages, log.start_ns)
    points = [point_of_message(message) for message in ordered]
    if any(point is None for point in points):
        raise InputError(
            f"the topic {topic} has no single point per message; expected points, such as "
            "PointStamped, in each of several topics"
        )
    frames = {_frame(message) for message in ordered} - {""}
    return t_s, np.array(points), frames


def _frame(message: Any) -> str:
    """Return the frame that the header of a message names; empty if there is none."""
    return str(nested_field(message, "header.frame_id") or "").lstrip("/")


def _require_one_frame(frames: dict[str, set[str]]) -> None:
    """Raise an `InputError` if points are in different frames, by topic."""
    if len(set().union(*frames.values())) <= 1:
        return
    stated = "; ".join(
        f"{topic}: {', '.join(sorted(of)) or 'none'}" for topic, of in frames.items()
    )
    raise InputError(
        f"points of one marker table have different frame_id ({stated}); expected one frame: "
        "publish or convert all points in the world frame of the robot's poses"
    )
