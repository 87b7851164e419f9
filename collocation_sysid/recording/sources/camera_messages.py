"""Messages of depth cameras: images, clouds of points, and camera models.

Supported are the messages of ROS (sensor_msgs) and of Foxglove (RawImage, CameraCalibration), which
have the same fields. Messages are recognised by their fields.
"""

from __future__ import annotations

from base64 import b64decode
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...common.files import reason
from ...errors import InputError

# Of pixels: integers count, floats are metres.
ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
# Of columns of clouds, by their numbers there.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# Before the PNG of an image that is packed for depth: a word, and two numbers of how.
_PACKED = np.dtype([("kind", "<i4"), ("scale", "<f4"), ("shift", "<f4")])


def camera_data_kind(message: Any) -> str:
    """Return a description of the camera data in a message, such as "depth images, 640 x 480";
    empty if it contains none.
    """
    if hasattr(message, "point_step") and hasattr(message, "fields"):
        return "clouds of points"
    if getattr(message, "encoding", None) in ENCODINGS and hasattr(message, "step"):
        return f"depth images, {message.width} x {message.height}"
    packed = str(getattr(message, "format", ""))
    if hasattr(message, "data") and ("compressedDepth" in packed or "16UC1" in packed):
        return "compressed depth images"
    return ""


def use_of_camera_message(message: Any) -> str:
    """Return the possible use of a message with camera data, or with a camera model, as a
    description and a key; empty for other messages.
    """
    if kind := camera_data_kind(message):
        return f"{kind}: [[experiment.depth]]"
    if is_camera_model(message):
        return "calibration of a camera; its matrix is used for depth images in the same namespace"
    return ""


def is_camera_model(message: Any) -> bool:
    """Return whether a message holds a camera model: fields k (of 9 numbers), p and d; false for
    None.
    """
    return (
        all(message_field(message, name) is not None for name in "kpd")
        and len(message_field(message, "k")) == 9
    )


def camera_matrix(message: Any, rectified: bool, shape: tuple[int, int]) -> Array:
    """Return the matrix (3, 3) of the camera model in a message.

    Parameters
    ----------
    rectified : bool
        Whether the images are rectified; then the matrix is that of the projection p, unless p is
        missing or zero.
    shape : (int, int)
        Rows and columns of the images.

    Raises
    ------
    InputError
        If the model is for images of another size, or for a part of an image.
    """
    size = [getattr(message, name, 0) for name in ("height", "width")]
    binned = [getattr(message, f"binning_{axis}", 0) for axis in "xy"]
    part = getattr(message, "roi", None)
    offset = [getattr(part, f"{axis}_offset", 0) for axis in "xy"]
    if size != [*shape] or max(binned) > 1 or any(offset):
        rows, columns = size
        raise InputError(
            f"the camera info describes images of {columns} x {rows} pixels, with binning {binned} "
            f"and the offset {offset} of a region of interest, but the images have {shape[1]} x "
            f"{shape[0]} pixels; expected a camera info for complete images of this size: state "
            "camera.matrix instead"
        )
    projection = np.asarray(message_field(message, "p"), dtype=float)
    if rectified and projection.size == 12 and projection.any():
        return projection.reshape(3, 4)[:, :3]
    return np.asarray(message_field(message, "k"), dtype=float).reshape(3, 3)


def distortion_coefficients(message: Any, rectified: bool) -> Array:
    """Return the distortion coefficients of the camera model; empty for rectified images, or if all
    are zero.

    Raises
    ------
    InputError
        If the lens model is not that of Brown and Conrady with at most eight coefficients.
    """
    coefficients = np.asarray(message_field(message, "d"), dtype=float)
    if rectified or not coefficients.any():
        return np.zeros(0)
    kind = getattr(message, "distortion_model", "plumb_bob")
    most = {"plumb_bob": 5, "rational_polynomial": 8}.get(kind, -1)
    if len(coefficients) > most:
        raise InputError(
            f"the camera info has the distortion model {kind} with {len(coefficients)} "
            "coefficients; expected plumb_bob with at most five or rational_polynomial with eight: "
            "use the topic of rectified images, or state camera.distortion"
        )
    return coefficients


def message_field(message: Any, name: str) -> Any:
    """Return a field of a message, None without it; ROS 1 and Foxglove use capitals for ROS 2's
    names.
    """
    return getattr(message, name, getattr(message, name.upper(), None))


def decode_image(message: Any) -> Any:
    """Return the pixels (rows, columns) of an image message: integer counts of a depth unit, or
    floats in metres.

    The message must be one for which `camera_data_kind` is an image.

    Raises
    ------
    InputError
        If a compressed image cannot be decoded, or the message has another number of bytes than its
        size states.
    """
    if not hasattr(message, "encoding"):
        return _decode_compressed(str(message.format), _message_data(message))
    order = ">" if getattr(message, "is_bigendian", 0) else "<"
    form = np.dtype(order + ENCODINGS[message.encoding])
    return _unpadded_rows(message, message.step, size=form.itemsize).view(form)


def _decode_compressed(kind: str, data: bytes) -> Any:
    """Return pixels: counts, or metres for compressed 32FC1, NaN without depth."""
    packed = "compressedDepth" in kind
    try:
        counts = read_png(BytesIO(data[_PACKED.itemsize :] if packed else data))
    except InputError:
        raise
    except Exception as error:  # the library has exceptions of its own
        raise InputError(
            f"the topic has an image of the format {kind!r} that is not a PNG ({reason(error)}); "
            "expected PNG: use the topic of uncompressed images, or compress the images as PNG"
        ) from error
    if not packed or "32FC1" not in kind:
        return counts
    how = np.frombuffer(data, _PACKED, 1)[0]
    with np.errstate(divide="ignore"):
        return np.where(counts > 0, float(how["scale"]) / (counts - float(how["shift"])), np.nan)


def read_png(source: Path | BytesIO) -> Any:
    """Return the counts (rows, columns) of a PNG image with 16 bits and one channel, as int64.

    Raises
    ------
    InputError
        If the image has other bits or channels.
    PIL.UnidentifiedImageError
        If the source is no image.
    """
    from PIL.Image import open as opened

    image = opened(source)
    if image.mode not in ("I;16", "I;16B", "I"):
        raise InputError(
            f"the image has the mode {image.mode}; expected depths of 16 bits in one channel (mode "
            "I;16)"
        )
    return np.asarray(image).astype(np.int64)


def decode_cloud(message: Any) -> dict[str, Array]:
    """Return the columns (P,) of a cloud of points by name, as floats.

    Raises
    ------
    InputError
        If its fields are of unknown types, do not lie within the bytes of a point, or repeat, or
        the message has another number of bytes.
    """
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
        columns = ", ".join(f"{each.name} of type {each.datatype}" for each in fields)
        raise InputError(
            f"a cloud has the fields {columns} in points of {message.point_step} bytes; expected "
            "each name once, of the types 1 to 8 of sensor_msgs/PointField, within these bytes"
        ) from error
    rows = _unpadded_rows(message, message.row_step, size=message.point_step)
    points = np.frombuffer(rows.tobytes(), form)
    return {name: points[name].astype(float) for name in form.names or ()}


def _unpadded_rows(message: Any, step: int, size: int) -> Any:
    """Return the bytes (rows, columns × size) of a message, without the padding of its rows."""
    data = np.frombuffer(_message_data(message), "u1")
    height = message.height
    if len(data) != height * step or step < message.width * size:
        raise InputError(
            f"a message has {len(data)} bytes; expected {height} rows of {message.width} times "
            f"{size} bytes, with {step} bytes from row to row"
        )
    return np.ascontiguousarray(data.reshape(height, step)[:, : message.width * size])


def _message_data(message: Any) -> bytes:
    """Return the data of a message; JSON messages have it in base64."""
    return b64decode(message.data) if isinstance(message.data, str) else bytes(message.data)
