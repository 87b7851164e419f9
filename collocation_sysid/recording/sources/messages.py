"""Numbers, points, poses and frames in the messages of logs.

Messages are recognised by their fields, not by the names of their types: a wrench has a force and a
torque, a marker a name and a point, a pose a point and a quaternion.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

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

Row = dict[str, float]


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


def message_rows(messages: Sequence[Any]) -> list[Row]:
    """Return the numbers of each message by their columns, of the first kind that it has: a wrench,
    joint positions, a pose, points, a single number or a list of numbers; empty if it has none.

    If there are markers of several namespaces, whose names may be the same, the names begin with the
    namespace.
    """
    spaces = {nested_field(item, "ns") for each in messages for item in first_list(each)}
    by_namespace = len(spaces - {None, ""}) > 1
    return [_message_values(each, by_namespace=by_namespace) for each in messages]


def _message_values(message: Any, *, by_namespace: bool) -> Row:
    wrench = nested_field(message, "wrench") or message
    if _is_vector(force := nested_field(wrench, "force")):
        values = [*_vector(force), *_vector(nested_field(wrench, "torque"))]
        return dict(zip(WRENCH, values, strict=True))
    if hasattr(message, "name") and hasattr(message, "position"):
        pairs = zip(message.name, message.position, strict=True)
        return {str(name): float(value) for name, value in pairs}
    if (pose := pose_of_message(message)) is not None:
        return dict(zip(POSE, pose, strict=True))
    items = {
        _item_name(item, k, by_namespace=by_namespace): item
        for k, item in enumerate(first_list(message))
    }
    points = {name: _position_of_item(item) for name, item in items.items()}
    if (point := point_of_message(message)) is not None:
        points = {nested_field(message, "header.frame_id") or "point": point}
    if points := {name: place for name, place in points.items() if place is not None}:
        return {f"{name}_{axis}": p[k] for name, p in points.items() for k, axis in enumerate(AXES)}
    if pixels := _pixels_of_items(items):
        return pixels
    for name, column in _NUMBER_FIELDS.items():
        if isinstance(value := nested_field(message, name), (int, float)):
            return {column: float(value)}
        if name == "data" and isinstance(value, (list, np.ndarray)) and len(np.shape(value)) == 1:
            return {f"{column}_{k}": float(each) for k, each in enumerate(value)}
    return {}


def pose_of_message(message: Any) -> tuple[float, ...] | None:
    """Return position and quaternion (x, y, z, w) of a message; None without."""
    for position, rotation in _POSES:
        if hasattr(turned := nested_field(message, rotation), "w"):
            return (*_vector(nested_field(message, position)), *_vector(turned), turned.w)
    return None


def _pixels_of_items(items: dict[str, Any]) -> Row:
    """Return pixels of the items of a list, and how sure the tracker is, by column."""
    row: Row = {}
    for name, item in items.items():
        places = (nested_field(item, path) if path else item for path in _PIXELS)
        pixel = next((found for each in places if (found := _pixel(each)) is not None), None)
        if pixel is None:
            continue
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
    if _is_vector(item):
        return _vector(item)
    return next((_vector(p) for name in _POINTS if _is_vector(p := nested_field(item, name))), None)


def _item_name(item: Any, index: int, *, by_namespace: bool) -> str:
    """Return the name of an item, after namespace and slash if asked; without one `index` + 1."""
    names = (nested_field(item, name) for name in _NAMES)
    name = str(next((name for name in names if name not in (None, "")), index + 1))
    return (
        f"{namespace}/{name}" if by_namespace and (namespace := nested_field(item, "ns")) else name
    )


def nested_field(message: Any, path: str) -> Any:
    """Return the nested field at a path of names with dots between them; None
    if it does not exist.
    """
    for name in path.split("."):
        message = getattr(message, name, None)
    return message


def _is_vector(value: Any) -> bool:
    return all(hasattr(value, axis) for axis in AXES)


def _vector(value: Any) -> tuple[float, ...]:
    return tuple(float(getattr(value, axis)) for axis in AXES)


def frame_of_message(message: Any) -> str:
    """Return the name of the frame of a message, or of its first item, without a leading slash;
    empty if neither names one.
    """
    first = next(iter(first_list(message)), None)
    frame = nested_field(message, "header.frame_id") or nested_field(first, "header.frame_id")
    return str(frame or "").lstrip("/")


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
    is_one = child and parent and pose_of_message(transform) and not hasattr(transform, "twist")
    return (parent.lstrip("/"), child.lstrip("/")) if is_one else None
