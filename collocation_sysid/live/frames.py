"""Frames of a live recording: validation, and reading from JSON lines or rows of a table.

`FrameReader` reads text; `as_pose`, `as_tracks`, `as_readings` and `as_wrenches` validate values
given in Python.
"""

from __future__ import annotations

import json
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..arrays import Array, Index
from ..errors import InputError
from ..recording.formats.text import written_number
from ..recording.formats.topics import POSE
from ..recording.gauge import Gauge
from ..recording.poses import first_matrix_fault, first_pose_fault
from ..recording.tables import WRENCH_COLUMNS
from ..recording.wrench import Wrench

Pose = Any

_KEYS = ("t_s", "pose", "markers", "wrench", "readings")
_POSE_KEYS = ("position_m", "quaternion_xyzw")
_SAMPLE_KEYS = ("t_s", "values")
# Sample of an instrument: number of the instrument (from 1), time, and values (m,), NaN if missing.
# Instruments are the custom sensors, then the sensors of grasps.
Told = tuple[int, float, Array]
# Largest accepted number of metres or seconds; beyond it, doubles do not resolve micrometres or
# microseconds.
LARGEST = 1e10


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
        Marker positions; NaN where missing.
    has_wrench : bool
        Whether the frame contains a wrench, even if the problem has no sensor for it.
    told : tuple of Told
        Samples of instruments, at their own times.
    """

    t_s: float
    pose: tuple[Array, Array] | None
    tracks_m: Array
    has_wrench: bool = False
    told: tuple[Told, ...] = ()


def as_pose(given: Pose | None, numbers: Sequence[int] | Index) -> tuple[Array, Array] | None:
    """Return positions (G, 3) and quaternions (G, 4) of the moving grasps; None if one is missing.

    Parameters
    ----------
    given : Pose, mapping, sequence or None
        4×4 matrix, or (position, quaternion x y z w), or a mapping with these keys; for several
        grasps by number, or in the order of `numbers`.
    numbers : sequence of int
        Numbers of the grasps, counted from 1.

    Raises
    ------
    InputError
        If the value is not a pose.
    """
    if given is None:
        return None
    if isinstance(given, Mapping) and not set(given) & set(_POSE_KEYS):
        known = [str(number) for number in numbers]
        if unknown := [name for name in given if name not in known]:
            raise InputError(
                f"a pose of grasp {reprlib.repr(unknown[0])}; expected {', '.join(known)}"
            )
        each = [given.get(name) for name in known]
    elif len(numbers) == 1:
        each = [given]
    else:
        each = list(given) if isinstance(given, Sequence) else [given]
        if len(each) != len(numbers):
            raise InputError(f"{len(each)} poses; expected {len(numbers)}, one of each grasp")
    if any(one is None for one in each):
        return None
    parts = [_one_pose(one) for one in each]
    return np.array([part[0] for part in parts]), np.array([part[1] for part in parts])


def _one_pose(given: Pose) -> tuple[Array, Array]:
    """Return position (3,) and unit quaternion (4,) of one pose."""
    if isinstance(given, Mapping):
        if missing := [key for key in _POSE_KEYS if key not in given]:
            raise InputError(f"the pose has no {missing[0]}; expected {' and '.join(_POSE_KEYS)}")
        given = tuple(given[key] for key in _POSE_KEYS)
    if isinstance(given, tuple) and len(given) == 2:
        position = _numbers(given[0], (3,))
        quaternion = _numbers(given[1], (4,))
        fault = first_pose_fault(np.zeros(1), position[None], quaternion[None])
        if fault is not None:
            raise InputError(fault[1].replace(" at t_s = 0", ""))
        return position, quaternion / np.linalg.norm(quaternion)
    matrix = _numbers(given, (4, 4))
    fault = first_matrix_fault(np.zeros(1), matrix[None])
    if fault is not None:
        raise InputError(fault[1].replace(" at t_s = 0", ""))
    return matrix[:3, 3], Rotation.from_matrix(matrix[:3, :3]).as_quat()


def as_tracks(given: ArrayLike | Mapping[str, Any] | None, names: Sequence[str]) -> Array:
    """Return marker positions (M, 3), NaN where missing.

    Parameters
    ----------
    given : (M, 3) array, mapping of name to (3,), or None
    names : sequence of str
        Names of the markers.

    Raises
    ------
    InputError
        For unknown markers, or values that are not three numbers.
    """
    tracks = np.full((len(names), 3), np.nan)
    if given is None:
        return tracks
    if not isinstance(given, Mapping):
        tracks = _numbers(given, tracks.shape)
    else:
        for name, place in given.items():
            if name not in names:
                raise InputError(f"a marker {reprlib.repr(name)}; expected {', '.join(names)}")
            if place is not None:
                tracks[list(names).index(name)] = _numbers(place, (3,))
    return np.where(np.isfinite(tracks).all(axis=1, keepdims=True), tracks, np.nan)


def as_readings(
    given: Mapping[str, Any] | None, gauges: Sequence[Gauge], t_s: float
) -> tuple[Told, ...]:
    """Return samples of custom sensors; a sample without a time has the time of the frame.

    Parameters
    ----------
    given : mapping of name to samples, or None
    gauges : sequence of Gauge
        Custom sensors of the problem.
    t_s : float
        Time of the frame.

    Raises
    ------
    InputError
        For unknown sensors, or values of the wrong number.
    """
    if given is None:
        return ()
    if not isinstance(given, Mapping):
        raise InputError(f"readings are {reprlib.repr(given)}; expected samples by name")
    names = [gauge.name for gauge in gauges]
    collected = []
    for name, samples in given.items():
        if name not in names:
            known = ", ".join(names) or "none, as the problem has none"
            raise InputError(f"a reading {reprlib.repr(name)}; expected {known}")
        number = names.index(name)
        count = gauges[number].measured.shape[1]
        what = f"the reading '{name}'"
        collected += [(number + 1, *sample) for sample in _samples(samples, what, count, t_s)]
    return tuple(collected)


def as_wrenches(
    given: Any, wrenches: Mapping[int, Wrench], before: int, t_s: float
) -> tuple[Told, ...]:
    """Return samples of the sensors of grasps; a sample without a time has the time of the frame.

    Parameters
    ----------
    given : wrench, mapping of grasp number to wrench, or None
    wrenches : mapping of grasp number to Wrench
        Sensors of the problem.
    before : int
        Number of instruments that precede these sensors.
    t_s : float
        Time of the frame.

    Raises
    ------
    InputError
        For unknown sensors, or values that are not a wrench.
    """
    if given is None or not wrenches:
        return ()
    known = {str(number): k for k, number in enumerate(wrenches)}
    if not isinstance(given, Mapping) or set(given) & set(_SAMPLE_KEYS):
        if len(known) > 1:
            raise InputError(f"one wrench; expected those of the grasps {' and '.join(known)}")
        given = dict.fromkeys(known, given)
    if unknown := [name for name in given if name not in known]:
        expected = ", ".join(known)
        raise InputError(f"a wrench of grasp {reprlib.repr(unknown[0])}; expected {expected}")
    collected = []
    for name, samples in given.items():
        measured = wrenches[int(name)].measured
        what = f"the wrench of grasp {name}"
        for at_s, values in _samples(samples, what, len(measured), t_s, fewest=3):
            wrench_values = np.where(measured, np.pad(values, (0, 6 - len(values))), np.nan)
            wrench_values[len(values) :] = np.nan
            collected.append((before + known[name] + 1, at_s, wrench_values))
    return tuple(collected)


def _samples(
    given: Any, what: str, count: int, t_s: float, fewest: int = 0
) -> Iterator[tuple[float, Array]]:
    """Yield time and values of the samples of one instrument; missing samples are skipped.

    Parameters
    ----------
    given : samples
        Values, a mapping with ``t_s`` and ``values``, or a list of such mappings.
    what : str
        Name of the instrument for messages.
    count : int
        Number of values.
    t_s : float
        Time of samples without a time.
    fewest : int
        Second admissible number of values; 0 for none.
    """
    several = isinstance(given, Sequence) and any(isinstance(s, Mapping) for s in given)
    for sample in given if several else [given]:
        at_s = t_s
        values = sample
        if isinstance(sample, Mapping):
            if set(sample) != set(_SAMPLE_KEYS):
                keys = ", ".join(map(reprlib.repr, sample)) or "nothing"
                raise InputError(f"a sample of {what} has {keys}; expected t_s and values")
            at_s = as_time(sample["t_s"])
            values = sample["values"]
        one = isinstance(values, (int, float)) and not isinstance(values, bool)
        few = np.shape(values) == (fewest,)
        if values is not None:
            try:
                yield at_s, _numbers([values] if one else values, (fewest if few else count,))
            except InputError as error:
                raise InputError(f"{what}: {error.message}") from error


def _numbers(given: Any, shape: tuple[int, ...]) -> Array:
    """Return an array of floats of the given shape, or raise an `InputError`."""
    size = " × ".join(map(str, shape))
    try:
        values = np.array(given, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"found {reprlib.repr(given)}; expected {size} numbers") from None
    if values.shape != shape:
        sizes = " × ".join(map(str, values.shape)) or "single"
        raise InputError(f"found {sizes} numbers; expected {size} numbers")
    if (beyond := np.abs(values) > LARGEST).any():
        raise InputError(f"found {values[beyond][0]:g}; expected numbers up to {LARGEST:g}")
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
    gauges : sequence of Gauge
        Custom sensors of the problem; in a table their columns have the names that the sensors
        state.
    wrenches : mapping of grasp number to Wrench
        Sensors of grasps of the problem.
    """

    def __init__(
        self,
        grasps: Sequence[int] | Index,
        names: Sequence[str],
        source: str = "input",
        gauges: Sequence[Gauge] = (),
        wrenches: Mapping[int, Wrench] = MappingProxyType({}),
    ) -> None:
        self.grasps = list(grasps)
        self.names = list(names)
        self.source = source
        self.gauges = gauges
        self.wrenches = wrenches
        self.line = 0
        self._columns: list[str] | None = None

    def read(self, text: str) -> Frame | None:
        """Return the frame of a line; None for an empty line, a comment or the header.

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
                return self._of_object(_parsed(text))
            return self._of_row([cell.strip() for cell in text.split(",")])
        except InputError as error:
            where = f"{self.source}, line {self.line}"
            raise InputError(f"{where}: {error.message}") from error

    def _of_object(self, found: Mapping[str, Any]) -> Frame:
        """Return the frame of a JSON object."""
        if unknown := [key for key in found if key not in _KEYS]:
            raise InputError(
                f"found the key {reprlib.repr(unknown[0])}; expected {', '.join(_KEYS)}"
            )
        if "t_s" not in found:
            raise InputError("there is no t_s; expected the time in seconds")
        pose = as_pose(found.get("pose"), self.grasps)
        tracks = as_tracks(found.get("markers"), self.names)
        t_s = as_time(found["t_s"])
        wrench = found.get("wrench")
        samples = as_readings(found.get("readings"), self.gauges, t_s)
        samples += as_wrenches(wrench, self.wrenches, len(self.gauges), t_s)
        return Frame(t_s, pose, tracks, wrench is not None, samples)

    def _of_row(self, cells: list[str]) -> Frame | None:
        """Return the frame of a row of a table; None for the header, whose columns are stored."""
        if self._columns is None:
            self._columns = self._checked(cells)
            return None
        if len(cells) != len(self._columns):
            raise InputError(f"{len(cells)} cells; expected {len(self._columns)}")
        by_name = dict(zip(self._columns, map(_cell, cells), strict=True))
        poses = [[by_name[name] for name in self._pose_columns(k)] for k in self.grasps]
        each = [(values[:3], values[3:]) for values in poses]
        is_complete = not np.isnan(poses).any()
        pose = as_pose(each[0] if len(each) == 1 else each, self.grasps) if is_complete else None
        tracks = [[by_name.get(f"{m}_{a}", np.nan) for a in ("x", "y", "z")] for m in self.names]
        t_s = as_time(by_name["t_s"])
        instrument_samples = list[Told]()
        for number, columns in enumerate(self._told_columns, 1):
            values = np.array([by_name.get(column, np.nan) for column in columns])
            if np.isfinite(values).any():
                instrument_samples.append((number, t_s, values))
        return Frame(t_s, pose, as_tracks(tracks, self.names), told=tuple(instrument_samples))

    def _pose_columns(self, number: int) -> list[str]:
        """Return the column names of the pose of a grasp, by its number."""
        before = "" if len(self.grasps) == 1 else f"{number}."
        return [before + name for name in POSE]

    @property
    def _told_columns(self) -> list[Sequence[str]]:
        """Column names of each instrument."""
        before = ["" if len(self.wrenches) == 1 else f"{number}." for number in self.wrenches]
        of_wrenches = [[each + name for name in WRENCH_COLUMNS] for each in before]
        return [*(gauge.columns for gauge in self.gauges), *of_wrenches]

    def _checked(self, columns: list[str]) -> list[str]:
        """Return the columns of a header, or raise an `InputError` if one is missing or unknown."""
        needed = ["t_s", *(name for k in self.grasps for name in self._pose_columns(k))]
        if missing := [name for name in needed if name not in columns]:
            raise InputError(
                f"neither a JSON object nor a header with the column {missing[0]!r}; "
                f"expected {', '.join(needed)} and the markers' columns"
            )
        known = {*needed, *(f"{m}_{a}" for m in self.names for a in ("x", "y", "z"))}
        known |= {column for each in self._told_columns for column in each}
        if unknown := [name for name in columns if name not in known]:
            raise InputError(
                f"a column {reprlib.repr(unknown[0])}; expected {', '.join(sorted(known))}"
            )
        return columns


def _parsed(text: str) -> Mapping[str, Any]:
    """Return the JSON object of a line, or raise an `InputError`."""
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"no JSON: {error.msg} at column {error.colno}") from error
    except (ValueError, RecursionError) as error:  # Python's limits of digits and of depth
        raise InputError("no frame: a number is too long, or brackets too deep") from error


def as_time(given: Any) -> float:
    """Return a time [s] as a float, or raise an `InputError` if it is not a finite number."""
    number = isinstance(given, (int, float, np.number)) and not isinstance(given, bool)
    if not number or not abs(given) <= LARGEST:
        expected = f"a finite number of seconds, up to {LARGEST:g}"
        raise InputError(f"t_s is {reprlib.repr(given)}; expected {expected}")
    return float(given)


def _cell(text: str) -> float:
    """Return the number of a table cell; NaN for an empty cell."""
    if text == "" or text.lower() == "nan":
        return float("nan")
    try:
        return written_number(text)
    except ValueError:
        raise InputError(f"found {reprlib.repr(text)}; expected a number") from None
