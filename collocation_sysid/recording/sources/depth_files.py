"""Depth images and clouds of points from files, from all files of a folder, or from a topic of a
log.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ...common.array_files import load_array, load_arrays
from ...common.array_types import Array
from ...common.checked_arrays import float_array
from ...common.files import in_counting_order, reason, require_regular, require_size
from ...errors import InputError, located
from . import ply
from .camera_messages import (
    ENCODINGS,
    camera_data_kind,
    camera_matrix,
    decode_cloud,
    decode_image,
    distortion_coefficients,
    is_camera_model,
    read_png,
)
from .logs import Log, TopicAddress, open_log
from .source import read_table
from .text import names_file_in_errors, times_in_column

# Depth of one count of an integer image if none is stated [m], as is usual for depth cameras.
USUAL_COUNT_M = 1e-3
# Largest length in a depth file [m]. Depths in micrometres that are read as metres are below it, so
# that a wrong unit is named by `check`; damaged floating-point numbers are mostly far above it.
LARGEST_LENGTH_M = 1e6
# Endings of files with images, and with clouds of points.
IMAGES = (".png", ".exr")
CLOUDS = (".ply", ".pcd", ".npy", ".xyz")
# Name of the topic with the camera model, beside the topics of the camera's images.
CAMERA = "camera_info"
# Part of the names of topics with rectified images.
RECTIFIED = re.compile(r"(?<![a-z])rect(ified)?(?![a-z])")
# Names of the columns of normals.
NORMALS = ("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z")


@dataclass(frozen=True, eq=False)
class DepthFileContent:
    """Depth data of a file or a folder: either images or clouds."""

    images_m: Sequence[Array]  # sequence of (rows, columns): depth images; empty for clouds
    # list of (P, 3) or (P, 6): clouds of points, with normals where known; empty for images.
    clouds_m: list[Array]
    t_s: Array | None = None  # (S,) or None: sample times; None if they are not stated
    # Camera model; None where it is not stated.
    matrix: Array | None = None
    pose: Array | None = None
    distortion: Array | None = None


@dataclass(frozen=True, eq=False)
class _LazyImages(Sequence[Array]):
    """Images [m] that are decoded when accessed, as all of them may not fit into memory."""

    messages: Sequence[Any]
    count_m: float | None  # depth of one count of an integer image; None for a millimetre
    path: Path  # file, for messages

    def __len__(self) -> int:
        return len(self.messages)

    def __getitem__(self, place: Any) -> Any:
        with located(self.path):
            return _in_metres(decode_image(self.messages[place]), self.count_m)


@names_file_in_errors
def read_depth(
    path: Path, count_m: float | None, length_m: float, known_camera_fields: Container[str] = ()
) -> DepthFileContent:
    """Read a file, a topic of a log, or all files of a folder in the order of their names.

    Parameters
    ----------
    path : Path
        A path with `#` and a topic behind that of a log, see `TopicAddress`.
    count_m : float, optional
        Depth of one count of an integer image; by default a millimetre. Archives (.npz) state their
        own.
    length_m : float
        Unit of clouds [m]; those of archives (.npz) are in metres.
    known_camera_fields : container of str
        "matrix" and "distortion" if they are known otherwise; they are then not read from a log.

    Raises
    ------
    InputError
        If it is none of these, is damaged, contains a length above `LARGEST_LENGTH_M`, or a package
        that reads it is missing.
    """
    if (address := TopicAddress.from_path(path)) is not None:
        return _read_topic(
            path, address, count_m=count_m, length_m=length_m, known=known_camera_fields
        )
    if path.is_dir():
        return _read_folder(path, count_m, length_m=length_m)
    require_regular(path)
    if path.suffix.lower() in (".xyz", ".ply", ".pcd"):
        require_size(path)
    kind = path.suffix.lower()
    if kind not in _READERS:
        expected = ", ".join(_READERS)
        raise InputError(
            f"the file has {'the ending ' + kind if kind else 'no ending'}; expected one of "
            f"{expected}"
        )
    try:
        content = _READERS[kind](path)
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        raise InputError(
            f"the file cannot be read ({reason(error)}); expected a valid {kind} file"
        ) from error
    if isinstance(content, DepthFileContent):
        return content
    if kind in CLOUDS:
        return DepthFileContent([], [_scaled_cloud(content, length_m)])
    return DepthFileContent([_in_metres(content, count_m)], [])


def _read_topic(
    path: Path, address: TopicAddress, count_m: float | None, length_m: float, known: Container[str]
) -> DepthFileContent:
    with open_log(address.log, address.episode) as log:
        t_s, messages = log.read(address.topic)
        camera = _camera_of_topic(log, address.topic)
    kind = camera_data_kind(messages[0]) if messages else ""
    if not kind:
        content = "other messages" if messages else "no messages"
        raise InputError(
            f"the topic {address.topic} has {content}; expected depth images "
            f"({', '.join(ENCODINGS)}, compressedDepth) or clouds of points"
        )
    if "images" not in kind:
        clouds = [
            _scaled_cloud(_points_from_columns(decode_cloud(each)), length_m) for each in messages
        ]
        return DepthFileContent([], clouds, t_s=t_s)
    images = _LazyImages(messages, count_m, path=path)
    matrix = None
    distortion = None
    if camera is not None:
        rectified = RECTIFIED.search(address.topic.lower()) is not None
        with located(f"{address.log}#{camera[0]}"):
            if "matrix" not in known:
                matrix = camera_matrix(camera[1], rectified, shape=images[0].shape)
            if "distortion" not in known:
                distortion = distortion_coefficients(camera[1], rectified)
    return DepthFileContent(images, [], t_s=t_s, matrix=matrix, distortion=distortion)


def _camera_of_topic(log: Log, topic: str) -> tuple[str, Any] | None:
    """Return the nearest camera_info in a namespace or above and its message, or None."""
    above = [str(each) for each in PurePosixPath(topic).parents]
    names = [f"{each.rstrip('/')}/{CAMERA}" for each in above]
    if (name := next((each for each in names if each in log.topics), None)) is None:
        return None
    message = log.first(name)
    return (name, message) if is_camera_model(message) else None


def _read_folder(path: Path, count_m: float | None, length_m: float) -> DepthFileContent:
    kinds = (*IMAGES, *CLOUDS)
    files = in_counting_order(each for each in path.iterdir() if each.suffix.lower() in kinds)
    if not files:
        raise InputError(
            f"the folder contains no files {', '.join((*IMAGES, *CLOUDS))}; expected depth images "
            "or point clouds of one of these types"
        )
    if len(kinds := {each.suffix.lower() for each in files}) > 1:
        raise InputError(
            f"the folder contains {', '.join(sorted(kinds))} files; expected files of one type only"
        )
    parts = [read_depth(each, count_m, length_m=length_m) for each in files]
    times = path / "times.csv"
    t_s = None
    if times.is_file():
        with located(times):
            t_s = times_in_column(read_table(times), 0)
            if len(t_s) != len(files):
                raise InputError(
                    f"found {len(t_s)} times for the {len(files)} images or clouds of the folder; "
                    "expected one time for each file"
                )
    images = [image for part in parts for image in part.images_m]
    return DepthFileContent(images, [cloud for part in parts for cloud in part.clouds_m], t_s=t_s)


def _in_metres(image: Array, count_m: float | None) -> Array:
    """Return depths [m]; integers are counts of `count_m` [m] or millimetres, floats are metres."""
    if image.ndim != 2:
        raise InputError(
            f"the image has the shape {image.shape}; expected (rows, columns): one channel with "
            "depths"
        )
    if image.dtype.kind in "iu":
        return image * (USUAL_COUNT_M if count_m is None else count_m)
    metres = image.astype(float)
    _require_possible_lengths(metres)
    return metres


def _require_possible_lengths(values_m: Array) -> None:
    """Refuse lengths beyond `LARGEST_LENGTH_M`; not finite ones pass."""
    largest_m = np.max(np.abs(values_m), initial=0.0, where=np.isfinite(values_m))
    if largest_m > LARGEST_LENGTH_M:
        raise InputError(
            f"the largest length in the file is {largest_m:.3g} m; expected at most "
            f"{LARGEST_LENGTH_M:,.0f} m: the file is damaged, or its unit differs from the stated "
            "one (length_unit, count_m)"
        )


def _scaled_cloud(points: Array, length_m: float) -> Array:
    """Return points (P, 3) or (P, 6) in metres; normals in the last three columns are unchanged."""
    with np.errstate(invalid="ignore"):  # a damaged file may have signalling NaN
        points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] not in (3, 6):
        raise InputError(
            f"a cloud has the shape {points.shape}; expected 3 columns x, y, z, or 6 columns with "
            "the normals nx, ny, nz"
        )
    places_m = length_m * points[:, :3]
    _require_possible_lengths(places_m)
    return np.hstack([places_m, points[:, 3:]])


def _read_npz(path: Path) -> DepthFileContent:
    """One image or cloud may lack the axis of samples; counts are in `USUAL_COUNT_M` by default."""
    arrays = load_arrays(path)
    names = [name for name in ("depth_m", "depth_counts", "points_m") if name in arrays]
    if len(names) != 1:
        raise InputError(
            f"the archive contains {', '.join(arrays) or 'nothing'}; expected exactly one of "
            "depth_m, depth_counts (with count_m) and points_m, and optionally t_s, "
            "camera_matrix, camera_pose"
        )
    clouded = names[0] == "points_m"
    columns = (3, 6) if clouded else (None,)
    shapes = [(*first, None, last) for first in ((), (None,)) for last in columns]
    values = float_array(arrays[names[0]], names[0], shapes, finite=False)
    if names[0] == "depth_counts":
        values *= float(float_array(arrays.get("count_m", USUAL_COUNT_M), "count_m", ()))
    samples = [np.asarray(each, dtype=float) for each in (values if values.ndim == 3 else [values])]
    for sample in samples:
        _require_possible_lengths(sample)
    camera_shapes = {"t_s": ((), (None,)), "camera_matrix": (3, 3), "camera_pose": (4, 4)}
    camera = (
        float_array(arrays[name], name, shapes) if name in arrays else None
        for name, shapes in camera_shapes.items()
    )
    return DepthFileContent([] if clouded else samples, samples if clouded else [], *camera)


@contextmanager
def standard_error_silenced() -> Iterator[None]:
    """Discard what compiled code writes to the standard error of this process."""
    try:
        saved_descriptor = os.dup(2)
    except OSError:  # it is closed
        yield
        return
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(saved_descriptor, 2)
        os.close(saved_descriptor)


def _read_exr(path: Path) -> Array:
    """Read depths of an OpenEXR image in its unit: channel Z, else R, Y, V, or the first."""
    try:
        library = import_module("OpenEXR")
    except ImportError as missing:
        raise InputError(
            "reading .exr images needs the package OpenEXR, which is not installed: pip install "
            "'collocation-sysid[exr]', or convert the images to .npz"
        ) from missing
    # What the library writes on both streams it also raises.
    with redirect_stdout(None), standard_error_silenced():
        channels: Mapping[str, Any] = library.File(str(path)).channels()
    names = [name for name in ("Z", "R", "Y", "V") if name in channels] or [*channels]
    return np.asarray(channels[names[0]].pixels, dtype=float)


def _points_from_columns(columns: Mapping[str, Array]) -> Array:
    """Return points (P, 3), or (P, 6) with normals, from columns by name."""
    if not {*"xyz"} <= {*columns}:
        raise InputError(
            f"the point cloud has the columns {', '.join(columns)}; expected x, y and z among them"
        )
    normals: Sequence[str] = next((names for names in NORMALS if {*names} <= {*columns}), ())
    return np.column_stack([columns[name] for name in (*"xyz", *normals)])


def _read_pcd(path: Path) -> Array:
    """Read the points (P, 3) or (P, 6) of a PCD file, ascii or binary, in its own unit."""
    raw = path.read_bytes()
    head = dict[str, list[str]]()
    begins = 0
    while "DATA" not in head:
        ends = raw.find(b"\n", begins)
        if ends < 0:
            raise InputError("the file has no line that begins with DATA; expected a PCD file")
        words = raw[begins:ends].decode("ascii", "replace").split()
        head |= {words[0]: words[1:]} if words and words[0] != "#" else {}
        begins = ends + 1
    kinds = zip(head["TYPE"], head["SIZE"], strict=True)
    counts = head.get("COUNT", ["1"] * len(head["FIELDS"]))
    fields = zip(head["FIELDS"], kinds, counts, strict=True)
    form = np.dtype([(f, f"<{t.lower()}{s}", (int(c),)) for f, (t, s), c in fields])
    if head["DATA"] == ["binary"]:
        rows = np.frombuffer(raw, form, int(head["POINTS"][0]), begins)
        columns = {name: rows[name][:, 0] for name in rows.dtype.names or ()}
    elif head["DATA"] == ["ascii"]:
        values = np.loadtxt(raw[begins:].decode("ascii").splitlines(), ndmin=2)
        columns = dict(zip(head["FIELDS"], values.T, strict=True))
    else:
        raise InputError(
            f"the PCD file has DATA {' '.join(head['DATA'])}; expected ascii or binary: convert "
            "it, for example with pcl_convert_pcd_ascii_binary"
        )
    return _points_from_columns(columns)


_READERS: dict[str, Callable[[Path], Array | DepthFileContent]] = {
    ".npz": _read_npz,
    ".png": read_png,
    ".exr": _read_exr,
    ".ply": lambda path: _points_from_columns(ply.read_columns(path)),
    ".pcd": _read_pcd,
    ".npy": load_array,
    ".xyz": lambda path: np.loadtxt(path, ndmin=2),
}
