"""Frames of a live recording: validation, and reading from JSON lines or rows of a table.

`FrameReader` reads text; `parse_pose`, `parse_markers`, `parse_custom_readings` and
`parse_wrenches` validate values given in Python.
"""

from __future__ import annotations

import json
import reprlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ...common.array_types import Array, Index
from ...errors import InputError
from ...features.image_tracks.tracks import ImageTracks
from ...problem import Problem
from ...problem.gripper_transforms import gripper_transforms
from ...program.streaming import StreamingModel
from ...recording.custom_sensor import CustomSensor
from ...recording.measured_wrench import WRENCH_COLUMNS, Wrench
from ...recording.poses import first_matrix_fault, first_pose_fault
from ...recording.sources.messages import POSE
from ...recording.sources.text import number_from_text

Pose = Any

_KEYS = ("t_s", "pose", "markers", "wrench", "readings")
_POSE_KEYS = ("position_m", "quaternion_xyzw")
_SAMPLE_KEYS = ("t_s", "values")
# Sample of an instrument: number of the instrument (from 1), time, and values (m,), NaN if missing.
# Instruments are the custom sensors, then the sensors of grasps.
InstrumentSample = tuple[int, float, Array]
# Largest accepted number of metres or seconds; beyond it, doubles do not resolve micrometres or
# microseconds.
LARGEST_NUMBER = 1e10


@dataclass(frozen=True, eq=False)
class Frame:
    """Measurements of one time: poses, markers and samples of instruments.

    Attributes
    ----------
    t_s : float
        Time.
    pose : (positions, quaternions) or None
        Positions (G, 3) and quaternions (G, 4) of the grasps that move; None if missing.
    tracks_m : (M, 3)
        Marker positions [m]; NaN where missing.
    has_wrench : bool
        Whether the frame contains a wrench, even if the problem has no sensor for it.
    instrument_samples : tuple of InstrumentSample
        Samples of instruments, at their own times.
    """

    t_s: float
    pose: tuple[Array, Array] | None
    tracks_m: Array
    has_wrench: bool = False
    instrument_samples: tuple[InstrumentSample, ...] = ()


def parse_pose(
    pose: Pose | None, grasp_numbers: Sequence[int] | Index
) -> tuple[Array, Array] | None:
    """Return positions (G, 3) [m] and unit quaternions (G, 4) of the moving grasps, x y z w; None
    if the pose or that of a grasp is missing.

    Parameters
    ----------
    pose : Pose, mapping, sequence or None
        Pose of the only moving grasp: a 4×4 matrix, a tuple (position, quaternion), or a mapping
        with the keys "position_m" and "quaternion_xyzw". For several grasps a sequence of poses in
        the order of `grasp_numbers`. For any number of grasps a mapping of their numbers, as text
        such as "1", to poses.
        Entries that are None, and numbers that the mapping omits, are missing.
    grasp_numbers : sequence of int
        Numbers of the G moving grasps, counted from 1.

    Raises
    ------
    InputError
        If a value is not a pose (see `_parse_single_pose`; quaternions must have the norm 1), or
        for an unknown grasp or a wrong number of poses.
    """
    if pose is None:
        return None
    if isinstance(pose, Mapping) and not set(pose) & set(_POSE_KEYS):
        known = [str(number) for number in grasp_numbers]
        if unknown := [name for name in pose if name not in known]:
            raise InputError(
                f"found a pose of grasp {reprlib.repr(unknown[0])}; expected the number of a grasp, "
                f"{', '.join(known)}"
            )
        each = [pose.get(name) for name in known]
    elif len(grasp_numbers) == 1:
        each = [pose]
    else:
        each = list(pose) if isinstance(pose, Sequence) else [pose]
        if len(each) != len(grasp_numbers):
            raise InputError(
                f"found {len(each)} poses; expected {len(grasp_numbers)}, one for each moving grasp"
            )
    if any(one is None for one in each):
        return None
    parts = [_parse_single_pose(one) for one in each]
    return np.array([part[0] for part in parts]), np.array([part[1] for part in parts])


def _parse_single_pose(pose: Pose) -> tuple[Array, Array]:
    """Return position (3,) [m] and unit quaternion (4,), x y z w, of one pose."""
    if isinstance(pose, Mapping):
        if missing := [key for key in _POSE_KEYS if key not in pose]:
            raise InputError(f"the pose has no {missing[0]}; expected {' and '.join(_POSE_KEYS)}")
        pose = tuple(pose[key] for key in _POSE_KEYS)
    if isinstance(pose, tuple) and len(pose) == 2:
        position = _parse_array(pose[0], (3,))
        quaternion = _parse_array(pose[1], (4,))
        fault = first_pose_fault(np.zeros(1), position[None], quaternions_xyzw=quaternion[None])
        if fault is not None:
            raise InputError(fault[1].replace(" at t_s = 0", ""))
        return position, quaternion / np.linalg.norm(quaternion)
    matrix = _parse_array(pose, (4, 4))
    fault = first_matrix_fault(np.zeros(1), matrix[None])
    if fault is not None:
        raise InputError(fault[1].replace(" at t_s = 0", ""))
    return matrix[:3, 3], Rotation.from_matrix(matrix[:3, :3]).as_quat()


def parse_markers(
    markers: ArrayLike | Mapping[str, Any] | None,
    names: Sequence[str],
    size: int = 3,
    what: str = "marker",
) -> Array:
    """Return marker positions (M, 3) [m], NaN where missing.

    A marker of which any coordinate is None or NaN is missing as a whole.

    Parameters
    ----------
    markers : (M, 3) array, mapping of name to (3,), or None
        Positions in the order of `names`, or by name; all are missing if None. In a mapping,
        markers that are omitted or None are missing.
    names : sequence of str
        Names of the M markers.
    size, what : int, str
        Number of coordinates, and what messages call a marker: two for points in images.

    Raises
    ------
    InputError
        For unknown markers, another shape, text, or coordinates beyond `LARGEST_NUMBER` in
        magnitude, such as infinity.
    """
    tracks = np.full((len(names), size), np.nan)
    if markers is None:
        return tracks
    if not isinstance(markers, Mapping):
        tracks = _parse_array(markers, tracks.shape)
    else:
        for name, place in markers.items():
            if name not in names:
                raise InputError(
                    f"found a {what} {reprlib.repr(name)}; expected one of {', '.join(names)}"
                )
            if place is not None:
                tracks[list(names).index(name)] = _parse_array(place, (size,))
    return np.where(np.isfinite(tracks).all(axis=1, keepdims=True), tracks, np.nan)


def parse_custom_readings(
    readings: Mapping[str, Any] | None, gauges: Sequence[CustomSensor], t_s: float
) -> tuple[InstrumentSample, ...]:
    """Return samples of custom sensors, each as number of the instrument (from 1), time [s] and
    values (m,); a sample without a time has the time of the frame.

    Parameters
    ----------
    readings : mapping of name to samples, or None
        Samples of each sensor: its m values (or a number, if there is one; of image tracks pixels
        (N, 2), or pixels by point), a mapping with exactly the keys "t_s" and "values", or a list
        of such mappings. None, also as values, for no sample; single values that are None or NaN
        are missing and become NaN.
    gauges : sequence of CustomSensor
        Custom sensors of the problem; instrument k is the k-th of them, from 1.
    t_s : float
        Time of the frame [s].

    Raises
    ------
    InputError
        If `readings` is no mapping, for unknown sensors, other keys, a time that is not finite, and
        values that are text, of the wrong number, or beyond `LARGEST_NUMBER` in magnitude.
    """
    if readings is None:
        return ()
    if not isinstance(readings, Mapping):
        raise InputError(f"readings are {reprlib.repr(readings)}; expected samples by name")
    names = [gauge.name for gauge in gauges]
    collected = []
    for name, samples in readings.items():
        if name not in names:
            known = (
                f"one of {', '.join(names)}"
                if names
                else "none, because the problem has no readings"
            )
            raise InputError(f"found a reading {reprlib.repr(name)}; expected {known}")
        number = names.index(name)
        gauge, what = gauges[number], f"the reading '{name}'"
        counts = (gauge.measured_values.shape[1],)
        points = gauge.names if isinstance(gauge, ImageTracks) else ()
        parsed = _parse_samples(samples, what, counts, t_s=t_s, names=points)
        collected += [(number + 1, *sample) for sample in parsed]
    return tuple(collected)


def parse_wrenches(
    wrench_data: Any, wrenches: Mapping[int, Wrench], instruments_before: int, t_s: float
) -> tuple[InstrumentSample, ...]:
    """Return samples of the sensors of grasps, each as number of the instrument, time [s] and
    values (6,); a sample without a time has the time of the frame.

    Components that the sensor does not measure are NaN, and so are all torques if only three values
    are given. Empty if `wrench_data` is None or the problem has no sensor.

    Parameters
    ----------
    wrench_data : wrench, mapping of grasp number to wrench, or None
        Force [N] and torque [N m], 6 values or the first 3 of them; or a mapping with exactly the
        keys "t_s" and "values", or a list of such mappings. With several sensors a mapping of these
        by the number of the grasp, as text such as "1". None, also as values, for no sample; single
        values that are None or NaN become NaN.
    wrenches : mapping of grasp number to Wrench
        Sensors of the problem, by the number of the grasp from 1 on.
    instruments_before : int
        Number of instruments that precede these sensors.
    t_s : float
        Time of the frame [s].

    Raises
    ------
    InputError
        For unknown sensors, one wrench for several sensors, other keys, a time that is not finite,
        and values that are text, neither 6 nor 3, or beyond `LARGEST_NUMBER` in magnitude.
    """
    if wrench_data is None or not wrenches:
        return ()
    known = {str(number): k for k, number in enumerate(wrenches)}
    if not isinstance(wrench_data, Mapping) or set(wrench_data) & set(_SAMPLE_KEYS):
        if len(known) > 1:
            raise InputError(
                f"found one wrench; expected those of the grasps {' and '.join(known)}, by number"
            )
        wrench_data = dict.fromkeys(known, wrench_data)
    if unknown := [name for name in wrench_data if name not in known]:
        expected = ", ".join(known)
        raise InputError(
            f"found a wrench of grasp {reprlib.repr(unknown[0])}; expected the number of a grasp "
            f"with a sensor, {expected}"
        )
    collected = []
    for name, samples in wrench_data.items():
        measured = wrenches[int(name)].measured_components
        what = f"the wrench of grasp {name}"
        for at_s, values in _parse_samples(samples, what, (len(measured), 3), t_s=t_s):
            wrench_values = np.where(measured, np.pad(values, (0, 6 - len(values))), np.nan)
            wrench_values[len(values) :] = np.nan
            collected.append((instruments_before + known[name] + 1, at_s, wrench_values))
    return tuple(collected)


def _parse_samples(
    samples: Any, what: str, counts: Sequence[int], t_s: float, names: Sequence[str] = ()
) -> Iterator[tuple[float, Array]]:
    """Yield time [s] and values of the samples of one instrument, whose number is one of `counts`,
    or pixels (2N,) of points with `names`, by name or (N, 2); missing samples are skipped.
    """
    several = isinstance(samples, Sequence) and any(isinstance(s, Mapping) for s in samples)
    for sample in samples if several else [samples]:
        at_s = t_s
        values = sample
        if isinstance(sample, Mapping) and not (names and set(sample).isdisjoint(_SAMPLE_KEYS)):
            if set(sample) != set(_SAMPLE_KEYS):
                keys = ", ".join(map(reprlib.repr, sample)) or "nothing"
                raise InputError(f"a sample of {what} has the keys {keys}; expected t_s and values")
            at_s = parse_time(sample["t_s"])
            values = sample["values"]
        if values is not None:
            try:
                if names:
                    yield at_s, parse_markers(values, names, size=2, what="point").ravel()
                else:
                    yield at_s, _parse_numbers(values, counts)
            except InputError as error:
                raise InputError(f"{what}: {error.message}") from error


def _parse_numbers(values: Any, counts: Sequence[int]) -> Array:
    """Return values (m,), whose number is one of `counts`; messages expect the first."""
    one = isinstance(values, (int, float)) and not isinstance(values, bool)
    size = np.shape(values)
    is_known = len(size) == 1 and size[0] in counts
    return _parse_array([values] if one else values, size if is_known else (counts[0],))


def _parse_array(raw_values: Any, shape: tuple[int, ...]) -> Array:
    """Return an array of floats of the given shape; entries that are None become NaN."""
    size = " × ".join(map(str, shape))
    try:
        values = np.array(raw_values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"found {reprlib.repr(raw_values)}; expected {size} numbers") from None
    if values.shape != shape:
        sizes = " × ".join(map(str, values.shape)) or "single"
        raise InputError(f"found {sizes} numbers; expected {size} numbers")
    if (beyond := np.abs(values) > LARGEST_NUMBER).any():
        raise InputError(f"found {values[beyond][0]:g}; expected numbers up to {LARGEST_NUMBER:g}")
    return values


class FrameReader:
    """Reader of frames from lines of text: JSON objects, or a table whose first line is the header.

    Parameters
    ----------
    grasps : sequence of int
        Numbers of the grasps that move, counted from 1.
    names : sequence of str
        Names of the markers.
    source : str
        Name of the source for messages.
    gauges : sequence of CustomSensor
        Custom sensors of the problem; in a table their columns have the names that the sensors
        state.
    wrenches : mapping of grasp number to Wrench
        Sensors of grasps of the problem, by the number of the grasp from 1 on.
    gripper_transforms : sequence of (4, 4) array or None
        Pose of the undeformed body in the frame of each moving grasp's gripper, by which the poses
        in the lines are multiplied; None, and an empty sequence, for poses of the body itself.

    Attributes
    ----------
    line : int
        Number of lines read so far, empty ones included.
    """

    def __init__(
        self,
        grasps: Sequence[int] | Index,
        names: Sequence[str],
        source: str = "input",
        gauges: Sequence[CustomSensor] = (),
        wrenches: Mapping[int, Wrench] = MappingProxyType({}),
        gripper_transforms: Sequence[Array | None] = (),
    ) -> None:
        self.grasps = list(grasps)
        self.gripper_transforms = list(gripper_transforms)
        self.names = list(names)
        self.source = source
        self.gauges = gauges
        self.wrenches = wrenches
        self.line = 0
        self._columns: list[str] | None = None

    @classmethod
    def from_model(
        cls, model: StreamingModel, problem: Problem, source: str = "input"
    ) -> FrameReader:
        """Return the reader of frames with the moving grasps, markers and sensors of a model.

        Parameters
        ----------
        model : StreamingModel
            Model of an experiment of the problem.
        problem : Problem
            Problem whose file states the poses of grippers, see `gripper_transforms`.
        source : str
            Name of the source for messages.
        """
        experiment = model.experiment
        return cls(
            model.moving_grasps + 1,
            experiment.markers.names,
            source=source,
            gauges=experiment.readings,
            wrenches=experiment.sensors_by_grasp,
            gripper_transforms=gripper_transforms(
                problem, experiment.name, grasps=model.moving_grasps
            ),
        )

    def read(self, text: str) -> Frame | None:
        """Return the frame of a line; None for an empty line, a comment (``#``) or the header.

        A line that begins with a brace is a JSON object, any other one belongs to the table, whose
        first line is the header; both may alternate.

        Raises
        ------
        InputError
            For an invalid line; the message contains its number.
        """
        self.line += 1
        text = text.strip()
        if not text or text.startswith("#"):
            return None
        try:
            if text.startswith("{"):
                return self._parse_object(_parse_json(text))
            return self._parse_row([cell.strip() for cell in text.split(",")])
        except InputError as error:
            where = f"{self.source}, line {self.line}"
            raise InputError(f"{where}: {error.message}") from error

    def _parse_object(self, json_object: Mapping[str, Any]) -> Frame:
        """Return the frame of a JSON object, with poses of the body."""
        if unknown := [key for key in json_object if key not in _KEYS]:
            raise InputError(
                f"found the key {reprlib.repr(unknown[0])}; expected some of {', '.join(_KEYS)}"
            )
        if "t_s" not in json_object:
            raise InputError("there is no t_s; expected the time in seconds")
        pose = self._pose_of_body(parse_pose(json_object.get("pose"), self.grasps))
        tracks = parse_markers(json_object.get("markers"), self.names)
        t_s = parse_time(json_object["t_s"])
        wrench = json_object.get("wrench")
        samples = parse_custom_readings(json_object.get("readings"), self.gauges, t_s=t_s)
        samples += parse_wrenches(
            wrench, self.wrenches, instruments_before=len(self.gauges), t_s=t_s
        )
        return Frame(
            t_s, pose, tracks_m=tracks, has_wrench=wrench is not None, instrument_samples=samples
        )

    def _pose_of_body(self, pose: tuple[Array, Array] | None) -> tuple[Array, Array] | None:
        """Return the pose of the undeformed body in each moving grasp from the pose in a line,
        which is that of the gripper if the grasp has a transform in `gripper_transforms`: both are
        multiplied. Grasps without a transform keep their pose.
        """
        if pose is None or not any(each is not None for each in self.gripper_transforms):
            return pose
        positions = pose[0].copy()
        quaternions = pose[1].copy()
        for k, transform in enumerate(self.gripper_transforms):
            if transform is not None:
                rotation = Rotation.from_quat(pose[1][k])
                positions[k] += rotation.apply(transform[:3, 3])
                body = rotation * Rotation.from_matrix(transform[:3, :3])
                quaternions[k] = body.as_quat()
        return positions, quaternions

    def _parse_row(self, cells: list[str]) -> Frame | None:
        """Return the frame of a row of a table, with poses of the body; None for the first row, the
        header, whose columns are stored.
        """
        if self._columns is None:
            self._columns = self._checked_header(cells)
            return None
        if len(cells) != len(self._columns):
            raise InputError(
                f"the line has {len(cells)} cells; expected {len(self._columns)}, as many as the "
                "header has columns"
            )
        by_name = dict(zip(self._columns, map(_parse_cell, cells), strict=True))
        poses = [[by_name[name] for name in self._pose_columns(k)] for k in self.grasps]
        each = [(values[:3], values[3:]) for values in poses]
        is_complete = not np.isnan(poses).any()
        pose = (
            self._pose_of_body(parse_pose(each[0] if len(each) == 1 else each, self.grasps))
            if is_complete
            else None
        )
        tracks = [[by_name.get(f"{m}_{a}", np.nan) for a in ("x", "y", "z")] for m in self.names]
        t_s = parse_time(by_name["t_s"])
        instrument_samples = list[InstrumentSample]()
        for number, columns in enumerate(self._list_instrument_columns(), 1):
            values = np.array([by_name.get(column, np.nan) for column in columns])
            if np.isfinite(values).any():
                instrument_samples.append((number, t_s, values))
        return Frame(
            t_s,
            pose,
            tracks_m=parse_markers(tracks or None, self.names),
            instrument_samples=tuple(instrument_samples),
        )

    def _pose_columns(self, number: int) -> list[str]:
        """Return the seven column names of the pose of a grasp, by its number from 1."""
        before = "" if len(self.grasps) == 1 else f"{number}."
        return [before + name for name in POSE]

    def _list_instrument_columns(self) -> list[Sequence[str]]:
        """Return the column names of each instrument: custom sensors, then the six of each sensor
        of a grasp, "fx_n" to "tz_nm"; the latter with the number of the grasp and a dot in front if
        there are several, and columns that several cameras have with the name of the camera.
        """
        before = ["" if len(self.wrenches) == 1 else f"{number}." for number in self.wrenches]
        of_wrenches = [[each + name for name in WRENCH_COLUMNS] for each in before]
        counts = Counter(column for gauge in self.gauges for column in gauge.columns)
        of_gauges = [
            [f"{gauge.name}.{c}" if counts[c] > 1 else c for c in gauge.columns]
            for gauge in self.gauges
        ]
        return [*of_gauges, *of_wrenches]

    def _checked_header(self, columns: list[str]) -> list[str]:
        """Return the columns of a header, as they are."""
        needed = ["t_s", *(name for k in self.grasps for name in self._pose_columns(k))]
        if missing := [name for name in needed if name not in columns]:
            raise InputError(
                f"the first line is neither a JSON object nor a header with the column {missing[0]!r}; "
                f"expected {', '.join(needed)} and the columns of the markers"
            )
        known = {*needed, *(f"{m}_{a}" for m in self.names for a in ("x", "y", "z"))}
        known |= {column for each in self._list_instrument_columns() for column in each}
        if unknown := [name for name in columns if name not in known]:
            raise InputError(
                f"found a column {reprlib.repr(unknown[0])}; expected some of "
                f"{', '.join(sorted(known))}"
            )
        return columns


def _parse_json(text: str) -> Mapping[str, Any]:
    """Return the JSON object of a line that begins with a brace, or raise an `InputError` if it is
    not valid JSON.
    """
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(
            f"this line is not valid JSON ({error.msg} at column {error.colno}); expected one JSON "
            "object per line"
        ) from error
    except (ValueError, RecursionError) as error:  # Python's limits of digits and of nesting
        raise InputError(
            "this line is not a frame: a number is too long, or brackets are nested too deeply; "
            f"expected one JSON object with {', '.join(_KEYS)}"
        ) from error


def parse_time(time: Any) -> float:
    """Return a time [s] as a float; raise an `InputError` if it is not a number (text, boolean,
    None, NaN) or beyond `LARGEST_NUMBER` in magnitude.
    """
    number = isinstance(time, (int, float, np.number)) and not isinstance(time, bool)
    if not number or not abs(time) <= LARGEST_NUMBER:
        expected = f"a finite number of seconds, up to {LARGEST_NUMBER:g}"
        raise InputError(f"t_s is {reprlib.repr(time)}; expected {expected}")
    return float(time)


def _parse_cell(text: str) -> float:
    """Return the number of a table cell; NaN for an empty cell or "nan"."""
    if text == "" or text.lower() == "nan":
        return float("nan")
    try:
        return number_from_text(text)
    except ValueError:
        raise InputError(f"found {reprlib.repr(text)}; expected a number") from None
