"""Calibrations of cameras in the files of other programs, recognised by their content.

| program | form | keys |
|---|---|---|
| OpenCV | YAML with `%YAML:1.0`, XML, JSON | `camera_matrix`, `distortion_coefficients`, `image_width` |
| OpenCV in Python | .npz | `mtx` and `dist`, or `K` and `D` |
| camodocal | YAML with `%YAML:1.0` | `model_type: PINHOLE`, `projection_parameters` |
| MATLAB | JSON of `cameraParameters.toStruct` | `IntrinsicMatrix` or `K`, `RadialDistortion` |
| ROS `camera_info` | YAML | `camera_matrix`, `distortion_model`; messages `k`, `d`, `width` |
| a log | `LOG#TOPIC` | messages `k`, `d`, `width` of CameraInfo or Foxglove's CameraCalibration |
| Kalibr | YAML | `cam0`: `intrinsics`, `distortion_model`, `resolution` |
| Anipose | TOML | `[cam_0]`: `name`, `matrix`, `distortions`, `rotation`, `translation` |
| COLMAP | text `cameras.txt` | `CAMERA_ID MODEL WIDTH HEIGHT PARAMS` |

Poses are those of Anipose alone, in the unit of length in which its board was measured: Kalibr states
poses of cameras relative to each other, and the world of COLMAP has no scale.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ...common.array_files import load_arrays
from ...common.array_types import Array
from ...common.files import DAMAGE, reason, require_regular, require_size
from ...common.text_files import parse_json, parse_toml, parse_xml, parse_yaml, read_text
from ...errors import InputError, listed
from ..camera import Lens
from .camera_messages import is_camera_model, message_field
from .logs import TopicAddress, open_log

# Largest size of a file [bytes]: far more than the cameras of a laboratory need.
LARGEST_BYTES = 1_000_000
# Names of a quantity in files of OpenCV and ROS, in lower case without underscores.
MATRIX_KEYS = ("cameramatrix", "matrix", "mtx", "intrinsicmatrix", "k", "m1", "m")
DISTORTION_KEYS = (
    "distortioncoefficients",
    "distcoeffs",
    "distcoeff",
    "distortion",
    "distortions",
    "dist",
    "d",
    "d1",
)
WIDTH_KEYS = ("imagewidth", "width", "w")
HEIGHT_KEYS = ("imageheight", "height", "h")
SIZE_KEYS = ("imagesize", "size", "resolution", "imgsize")
# Lenses by the name of the model in a file, in lower case.
LENSES: dict[str, Lens] = {
    "plumb_bob": "pinhole",
    "rational_polynomial": "pinhole",
    "radtan": "pinhole",
    "pinhole": "pinhole",
    "none": "pinhole",
    "": "pinhole",
    "equidistant": "fisheye",
    "equi": "fisheye",
    "fisheye": "fisheye",
    "kannala_brandt": "fisheye",
}
# Models of COLMAP: indices of fx, fy, cx, cy among the parameters, and where those of the
# distortion go in the order of OpenCV.
COLMAP_MODELS: dict[str, tuple[tuple[int, int, int, int], tuple[int, ...], Lens]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), (), "pinhole"),
    "PINHOLE": ((0, 1, 2, 3), (), "pinhole"),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3,), "pinhole"),
    "RADIAL": ((0, 0, 1, 2), (3, 4), "pinhole"),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7), "pinhole"),
    "FULL_OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11), "pinhole"),
    "OPENCV_FISHEYE": ((0, 1, 2, 3), (4, 5, 6, 7), "fisheye"),
}
# Words of keys that state the lens: one that is not understood is refused.
_OF_LENS = re.compile(
    r"fisheye|disto|lens|model|mirror|^xi$|tilt|prism|radial|tangential|skew|omni|^projectionparam"
)
# Other keys without an effect on the lens; those that are not among them are noted.
_KNOWN_KEYS = re.compile(
    r"cameraname|name|calibrationtime|calibrationdate|flags?(value)?|n(rof)?frames|board.*|square.*"
    r"|.*error.*|rms|extrinsic.*|gridpoints|imagepoints|rectificationmatrix|projectionmatrix|r|p"
    r"|binning.*|roi|header|estimate.*|numradial.*|worldunits|worldpoints|rvecs?|tvecs?|[rt]vectors"
    r"|rotationvectors|translationvectors|markersize|aspectratio|focallength|principalpoint"
    r"|version|typeid"
)
# MATLAB counts pixels from (1, 1), OpenCV from (0, 0).
_FIRST_PIXEL_OF_MATLAB = 1.0
# COLMAP counts pixels from the corner of the image, OpenCV from the centre of the first pixel.
CORNER_OF_PIXEL = 0.5


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration of one camera."""

    name: str  # name in the file; "" without one
    matrix: Array  # (3, 3)
    distortion: Array  # (k,): in the order of OpenCV
    model: Lens = "pinhole"
    # (int, int) or None: columns and rows of the images; None if the file does not state them.
    size_px: tuple[int, int] | None = None
    # (4, 4) or None: transform from the camera to the world of the file; None if it states none.
    pose: Array | None = None
    unread: tuple[str, ...] = ()  # keys of the file that are not understood


def read_calibration(path: str | Path, camera: str | None = None) -> Calibration:
    """Read the calibration of one camera.

    Parameters
    ----------
    camera : str, optional
        Name or number of the camera in a file of several; not needed for a file of one.

    Raises
    ------
    InputError
        If the file is not recognised, a key is missing or has another form, or the file has several
        cameras and none is chosen. The message names file and key.
    """
    file = Path(path)
    address = TopicAddress.from_path(path)
    if address is None:
        require_regular(file)
        require_size(file, LARGEST_BYTES)
    try:
        return _camera_of_topic(address) if address else _camera_of_file(file, camera)
    except InputError as error:
        where = ": ".join(filter(None, (str(file), error.where)))
        raise InputError(error.message, error.source, where) from error


def _camera_of_topic(address: TopicAddress) -> Calibration:
    with open_log(address.log, address.episode) as log:
        message = log.first(address.topic)
    if not is_camera_model(message):
        raise InputError(
            f"the topic {address.topic} has no camera model; expected messages with k, d, width "
            "and height, such as CameraInfo"
        )
    names = ("k", "d", "distortion_model", "width", "height")
    content = {name: message_field(message, name) for name in names}
    for name in ("k", "d"):
        content[name] = np.asarray(content[name], dtype=float).tolist()
    return _opencv_camera(content)


def _camera_of_file(file: Path, camera: str | None) -> Calibration:
    if zipfile.is_zipfile(file):
        return _opencv_camera(_archive(file))
    what = "a calibration of OpenCV, ROS, Kalibr, Anipose or COLMAP"
    text = read_text(file, what, LARGEST_BYTES)
    cameras = _colmap_cameras(text) if _is_colmap(text) else _cameras_of(_parsed(text, file))
    if camera is None and len(cameras) == 1:
        return cameras[0]
    chosen = [c for k, c in enumerate(cameras) if camera in (c.name, str(k))]
    if len(chosen) == 1:
        return chosen[0]
    names = listed([c.name or str(k) for k, c in enumerate(cameras)])
    found = "several cameras" if camera is None else f"no camera {camera!r}"
    raise InputError(f"found {found}; expected the name of one of {names}")


def _cameras_of(content: Mapping[str, Any]) -> list[Calibration]:
    cameras = {
        key: each
        for key, each in content.items()
        if isinstance(each, Mapping) and {"intrinsics", "distortions"} & each.keys()
    }
    if any("intrinsics" in each for each in cameras.values()):
        return [_kalibr_camera(key, each) for key, each in cameras.items()]
    if cameras:
        return [_anipose_camera(key, each) for key, each in cameras.items()]
    return [_opencv_camera(content)]


def _archive(file: Path) -> Mapping[str, Any]:
    try:
        return {name: array.tolist() for name, array in load_arrays(file).items()}
    except InputError:
        raise
    except (*DAMAGE, OSError, zipfile.BadZipFile) as error:
        raise InputError(
            f"this archive cannot be read ({error}); expected arrays, such as mtx and dist"
        ) from error


def _parsed(text: str, file: Path) -> Mapping[str, Any]:
    # OpenCV writes a directive and tags that other readers of YAML refuse.
    plain = re.sub(r"^%YAML[: ][^\n]*\n", "", text.lstrip("\ufeff")).replace("!!opencv-matrix", "")
    readers = (parse_json, lambda text: parse_toml(text, file), _opencv_xml, parse_yaml)
    fault = "no table"
    for read in readers:
        try:
            content = read(plain)
        except ValueError as error:
            fault = reason(error)
            continue
        if isinstance(content, Mapping):
            return content
    raise InputError(
        "found neither YAML, JSON, XML, TOML nor cameras.txt; expected a calibration of OpenCV, ROS, "
        f"Kalibr, Anipose or COLMAP (the last error is {fault})"
    )


def _opencv_xml(text: str) -> Any:
    root = parse_xml(text.lstrip())
    if root.tag != "opencv_storage":
        return None
    content: dict[str, Any] = {}
    for each in root:
        data = each.find("data")
        words = ((each if data is None else data).text or "").split()
        if data is None and len(words) == 1:
            content[each.tag] = parse_yaml(words[0])
        else:
            content[each.tag] = words
    return content


def _numbers(value: Any, key: str) -> Array:
    """Return a list of numbers, or a matrix of OpenCV and ROS (a table with `data`), as an array."""
    data = value.get("data") if isinstance(value, Mapping) else value
    try:
        numbers = np.asarray(data, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.array(np.nan)
    if not np.isfinite(numbers).all():
        raise InputError(f"found {value!r}; expected numbers", where=key)
    return numbers


def _matrix(value: Any, key: str) -> Array:
    numbers = _numbers(value, key)
    if numbers.size != 9:
        raise InputError(
            f"found {numbers.size} numbers; expected the nine of a camera matrix", where=key
        )
    return numbers.reshape(3, 3)


def _coefficients(numbers: Array, model: Lens, key: str) -> Array:
    """Return distortion coefficients (k,), without zeros beyond those that the model has."""
    flat = numbers.ravel()
    most = 4 if model == "fisheye" else 8
    if flat[most:].any():
        why = "those of thin prisms and tilted sensors are not supported"
        why = "those of a fisheye lens" if model == "fisheye" else why
        raise InputError(
            f"found {len(flat)} coefficients; expected at most {most} that are not zero: {why}",
            where=key,
        )
    flat = flat[:most]
    if model == "pinhole" and len(flat) > 5:
        return np.append(flat, np.zeros(8 - len(flat))) if flat[5:].any() else flat[:5]
    return flat


def _lens(name: Any, key: str) -> Lens:
    lens = LENSES.get(str(name or "").lower())
    if lens is None:
        known = listed([repr(each) for each in LENSES if each])
        raise InputError(f"found {name!r}; expected one of {known}", where=key)
    return lens


def _plain(key: Any) -> str:
    return re.sub(r"[_\s-]", "", str(key)).lower()


def _value(content: Mapping[str, Any], names: tuple[str, ...]) -> tuple[str, Any]:
    """Return key and value of the first of some names that a table has; "" and None for none."""
    plain = {_plain(key): key for key in content}
    found = next((plain[name] for name in names if name in plain), None)
    return ("", None) if found is None else (str(found), content[found])


def _size(content: Mapping[str, Any]) -> tuple[int, int] | None:
    width_key, width = _value(content, WIDTH_KEYS)
    _, height = _value(content, HEIGHT_KEYS)
    size_key, size = _value(content, SIZE_KEYS)
    if width is None or height is None:
        if size is None:
            return None
        numbers = _numbers(size, size_key)
    else:
        numbers = _numbers([width, height], width_key)
    if numbers.shape != (2,) or (numbers < 1).any():
        raise InputError(
            f"found {numbers.tolist()}; expected columns and rows of the images",
            where=size_key or width_key,
        )
    return int(numbers[0]), int(numbers[1])


def _opencv_camera(content: Mapping[str, Any]) -> Calibration:
    """Return the camera of a file with the keys of OpenCV, ROS, camodocal or MATLAB."""
    plain = {_plain(key): str(key) for key in content}
    matrix_key, matrix = _value(content, MATRIX_KEYS)
    key, distortion = _value(content, DISTORTION_KEYS)
    used = {matrix_key, key}
    projection_key, projection = _value(content, ("projectionparameters",))
    if isinstance(projection, Mapping):
        fx, fy, cx, cy = (projection.get(name) for name in ("fx", "fy", "cx", "cy"))
        matrix_key, matrix = projection_key, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
        key, values = _value(content, ("distortionparameters",))
        values = values if isinstance(values, Mapping) else {}
        distortion = [values.get(name, 0) for name in ("k1", "k2", "p1", "p2")]
        used |= {projection_key, key}
        if more := values.keys() - {"k1", "k2", "p1", "p2"}:
            raise InputError(f"found {listed(map(str, more))}; expected k1, k2, p1, p2", where=key)
    if matrix is None:
        raise InputError(
            f"found the keys {listed(list(map(str, content))) or 'none'}; expected the matrix of a "
            "camera as camera_matrix or K, or the cameras of Kalibr or Anipose"
        )
    numbers = np.zeros(0) if distortion is None else _numbers(distortion, key)
    nine = _matrix(matrix, matrix_key)
    radial_key, radial = _value(content, ("radialdistortion",))
    if radial_key and distortion is None:
        tangential_key, tangential = _value(content, ("tangentialdistortion",))
        key, used = radial_key, used | {radial_key, tangential_key, plain.get("skew", "")}
        k = np.append(_numbers(radial, radial_key), [0.0, 0.0, 0.0])
        p = np.append(
            _numbers([] if tangential is None else tangential, tangential_key), [0.0, 0.0]
        )
        numbers = np.array([k[0], k[1], p[0], p[1], k[2]])
        # Older versions store the transposed matrix.
        nine = nine.T if _plain(matrix_key) == "intrinsicmatrix" else nine
        nine = nine - np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]]) * _FIRST_PIXEL_OF_MATLAB
    model_key, model = _value(content, ("distortionmodel", "cameramodel", "modeltype", "model"))
    lens = _lens(model, model_key)
    for flag in [given for name, given in plain.items() if "fisheye" in name]:
        used.add(flag)
        lens = "fisheye" if _is_true(content[flag], flag) else lens
    size_keys = {*WIDTH_KEYS, *HEIGHT_KEYS, *SIZE_KEYS}
    left = {
        name: given
        for name, given in plain.items()
        if given not in {*used, model_key} and name not in size_keys
    }
    for name, given in left.items():
        if _OF_LENS.search(name) and not _KNOWN_KEYS.fullmatch(name):
            known = "matrix, distortion, model and size of a pinhole or fisheye camera"
            raise InputError(f"found {content[given]!r}; expected only {known}", where=given)
    size = _size(content)
    if key == radial_key and size is not None and _value(content, SIZE_KEYS)[0]:
        size = size[1], size[0]  # rows come first in MATLAB
    return Calibration(
        str(_value(content, ("cameraname", "name"))[1] or ""),
        nine,
        _coefficients(numbers, lens, key),
        lens,
        size,
        unread=tuple(given for name, given in left.items() if not _KNOWN_KEYS.fullmatch(name)),
    )


def _is_true(value: Any, key: str) -> bool:
    word = str(value).lower()
    if word in ("true", "1", "yes", "on"):
        return True
    if word in ("false", "0", "no", "off", "none", ""):
        return False
    raise InputError(f"found {value!r}; expected 0 or 1", where=key)


def _kalibr_camera(name: str, content: Mapping[str, Any]) -> Calibration:
    key = f"{name}.intrinsics"
    kind = content.get("camera_model", "pinhole")
    if kind != "pinhole":
        raise InputError(f'found {kind!r}; expected "pinhole"', where=f"{name}.camera_model")
    intrinsics = _numbers(content.get("intrinsics"), key)
    if intrinsics.shape != (4,):
        raise InputError(f"found {intrinsics.size}; expected fu, fv, pu, pv", where=key)
    fu, fv, pu, pv = intrinsics.tolist()
    lens = _lens(content.get("distortion_model"), f"{name}.distortion_model")
    key = f"{name}.distortion_coeffs"
    numbers = _numbers(content.get("distortion_coeffs", ()), key)
    return Calibration(
        name,
        np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1]]),
        _coefficients(numbers, lens, key),
        lens,
        _size(content),
    )


def _anipose_camera(key: str, content: Mapping[str, Any]) -> Calibration:
    """Return a camera of Anipose, whose rotation and translation are from world to camera."""
    is_fisheye = _is_true(content.get("fisheye", False), f"{key}.fisheye")
    lens: Lens = "fisheye" if is_fisheye else "pinhole"
    distortion = _numbers(content["distortions"], f"{key}.distortions")
    pose = None
    if {"rotation", "translation"} <= content.keys():
        turn = _numbers(content["rotation"], f"{key}.rotation")
        shift = _numbers(content["translation"], f"{key}.translation")
        if turn.shape != (3,) or shift.shape != (3,):
            raise InputError(
                "found other than three numbers; expected a rotation vector and a translation",
                where=f"{key}.rotation",
            )
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(turn).as_matrix().T
        pose[:3, 3] = -pose[:3, :3] @ shift
    return Calibration(
        str(content.get("name", key)),
        _matrix(content.get("matrix"), f"{key}.matrix"),
        _coefficients(distortion, lens, f"{key}.distortions"),
        lens,
        _size(content),
        pose,
    )


def _is_colmap(text: str) -> bool:
    lines = [line for line in text.splitlines() if line.strip() and line[:1] != "#"]
    return bool(lines) and all(
        re.match(rf"\s*\d+\s+({'|'.join(COLMAP_MODELS)}|[A-Z_]+)\s+\d+\s+\d+\s", f"{line} ")
        for line in lines
    )


def _colmap_cameras(text: str) -> list[Calibration]:
    cameras = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        name, kind, width, height, *rest = words
        where = f"line {number}"
        if kind not in COLMAP_MODELS:
            raise InputError(f"found {kind}; expected one of {listed(COLMAP_MODELS)}", where=where)
        (fx, fy, cx, cy), places, lens = COLMAP_MODELS[kind]
        parameters = _numbers(rest, f"line {number}")
        if len(parameters) != max(fx, fy, cx, cy, *places) + 1:
            raise InputError(
                f"found {len(parameters)} parameters; expected those of {kind}", where=where
            )
        matrix = np.eye(3)
        matrix[0, 0], matrix[1, 1] = parameters[fx], parameters[fy]
        matrix[:2, 2] = parameters[[cx, cy]] - CORNER_OF_PIXEL
        coefficients = parameters[list(places)]
        cameras.append(Calibration(name, matrix, coefficients, lens, (int(width), int(height))))
    return cameras
