"""Messages of depth cameras: images, clouds of points, and how a camera projects.

As ROS has them in sensor_msgs, and Foxglove in RawImage and CameraCalibration, of the same fields.
They are known by what they hold.
"""

from __future__ import annotations

from base64 import b64decode
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array
from ...errors import InputError
from ...files import reason

# Of pixels: integers count, floats are metres.
ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
# Of columns of clouds, by their numbers there.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# Before the PNG of an image that is packed for depth: a word, and two numbers of how.
_PACKED = np.dtype([("kind", "<i4"), ("scale", "<f4"), ("shift", "<f4")])


def depth_in(message: Any) -> str:
    """What of depth a message holds, in words; empty if nothing."""
    if hasattr(message, "point_step") and hasattr(message, "fields"):
        return "clouds of points"
    if getattr(message, "encoding", None) in ENCODINGS and hasattr(message, "step"):
        return f"depth images, {message.width} x {message.height}"
    packed = str(getattr(message, "format", ""))
    if hasattr(message, "data") and ("compressedDepth" in packed or "16UC1" in packed):
        return "packed depth images"
    return ""


def is_camera(message: Any) -> bool:
    """Whether it says how a camera projects."""
    return all(_told(message, name) is not None for name in "kpd") and len(_told(message, "k")) == 9


def matrix_of(message: Any, rectified: bool, shape: tuple[int, int]) -> Array:
    """Matrix (3, 3) of a camera whose images have so many rows and columns.

    Raises
    ------
    InputError
        If it tells of images of another size, or of a part of one.
    """
    size = [getattr(message, name, 0) for name in ("height", "width")]
    binned = [getattr(message, f"binning_{axis}", 0) for axis in "xy"]
    part = getattr(message, "roi", None)
    offset = [getattr(part, f"{axis}_offset", 0) for axis in "xy"]
    if size != [*shape] or max(binned) > 1 or any(offset):
        rows, columns = size
        raise InputError(
            f"is the camera of images of {columns} x {rows} pixels, binned by {binned}, from "
            f"{offset} on, beside images of {shape[1]} x {shape[0]}; expected one of whole images "
            "of that size: state camera.matrix"
        )
    whole = np.asarray(_told(message, "p"), dtype=float)
    if rectified and whole.size == 12 and whole.any():
        return whole.reshape(3, 4)[:, :3]
    return np.asarray(_told(message, "k"), dtype=float).reshape(3, 3)


def distortion_of(message: Any, rectified: bool) -> Array:
    """What the lens of a camera bends; nothing in rectified images.

    Raises
    ------
    InputError
        If the lens is none of Brown and Conrady's.
    """
    bent = np.asarray(_told(message, "d"), dtype=float)
    if rectified or not bent.any():
        return np.zeros(0)
    kind = getattr(message, "distortion_model", "plumb_bob")
    if kind != "plumb_bob" or len(bent) > 5:
        raise InputError(
            f"has the lens {kind} with {len(bent)} numbers; expected plumb_bob with five: take the "
            "topic of rectified images, or state camera.distortion"
        )
    return bent


def _told(message: Any, name: str) -> Any:
    """ROS 1 and Foxglove write what ROS 2 has in small letters in capital ones."""
    return getattr(message, name, getattr(message, name.upper(), None))


def image_of(message: Any) -> Any:
    """The pixels (rows, columns) of an image: integers that count, or metres."""
    if not hasattr(message, "encoding"):
        return _unpacked(str(message.format), _bytes(message))
    order = ">" if getattr(message, "is_bigendian", 0) else "<"
    form = np.dtype(order + ENCODINGS[message.encoding])
    return _rows(message, message.step, form.itemsize).view(form)


def _unpacked(kind: str, data: bytes) -> Any:
    packed = "compressedDepth" in kind
    try:
        counts = png(BytesIO(data[_PACKED.itemsize :] if packed else data))
    except InputError:
        raise
    except Exception as error:  # the library has exceptions of its own
        raise InputError(
            f"has an image of the format {kind!r} that is no PNG ({reason(error)}): take the topic "
            "of images that are not packed, or have them packed as PNG"
        ) from error
    if not packed or "32FC1" not in kind:
        return counts
    how = np.frombuffer(data, _PACKED, 1)[0]
    with np.errstate(divide="ignore"):
        return np.where(counts > 0, float(how["scale"]) / (counts - float(how["shift"])), np.nan)


def png(source: Path | BytesIO) -> Any:
    """The counts (rows, columns) of a PNG."""
    from PIL.Image import open as opened

    image = opened(source)
    if image.mode not in ("I;16", "I;16B", "I"):
        raise InputError(f"has the mode {image.mode}; expected depths of 16 bits in one channel")
    return np.asarray(image).astype(np.int64)


def columns_of(message: Any) -> dict[str, Array]:
    """The columns (P,) of a cloud by name."""
    order = ">" if getattr(message, "is_bigendian", 0) else "<"
    fields = list(message.fields)
    try:
        form = np.dtype(
            {
                "names": [str(each.name) for each in fields],
                "formats": [order + _TYPES[each.datatype] for each in fields],
                "offsets": [each.offset for each in fields],
                "itemsize": message.point_step,
            }
        )
    except (KeyError, ValueError) as error:
        told = ", ".join(f"{each.name} of type {each.datatype}" for each in fields)
        raise InputError(
            f"has the columns {told} in points of {message.point_step} bytes; expected each once, "
            "of types 1 to 8, within these"
        ) from error
    rows = _rows(message, message.row_step, message.point_step)
    points = np.frombuffer(rows.tobytes(), form)
    return {name: points[name].astype(float) for name in form.names or ()}


def _rows(message: Any, step: int, size: int) -> Any:
    """(rows, columns × size) bytes, without what fills the rows up."""
    data, height = np.frombuffer(_bytes(message), "u1"), message.height
    if len(data) != height * step or step < message.width * size:
        raise InputError(
            f"has {len(data)} bytes in a message; expected {height} rows of {message.width} times "
            f"{size} bytes, {step} from row to row"
        )
    return np.ascontiguousarray(data.reshape(height, step)[:, : message.width * size])


def _bytes(message: Any) -> bytes:
    """What a message holds; as text where it is JSON."""
    return b64decode(message.data) if isinstance(message.data, str) else bytes(message.data)
