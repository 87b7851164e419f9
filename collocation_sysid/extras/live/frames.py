"""Frames of a live recording, from Python values or lines of JSON."""

from __future__ import annotations

import reprlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ...common.array_types import Array
from ...common.text_files import parse_json
from ...common.validated_classes import validated
from ...errors import InputError
from ...kinds.image_tracks.tracks import ImageTracks
from ...problem import Problem
from ...problem.gripper_transforms import gripper_transforms
from ...recording.experiment import Experiment
from ...recording.poses import first_matrix_fault, first_pose_fault

KEYS = ("t_s", "pose", "markers", "wrench", "readings")
POSE_KEYS = ("position_m", "quaternion_xyzw")
SAMPLE_KEYS = {"t_s", "values"}
# Largest accepted number of metres or seconds; beyond it, doubles do not resolve micrometres or
# microseconds.
LARGEST_NUMBER = 1e10


@dataclass(frozen=True, eq=False)
class Frame:
    """Measurements of one time."""

    t_s: float
    # Poses (4, 4) of the body in the moving grasps, by the number of the grasp from 1; without
    # those that are missing.
    poses: Mapping[int, Array]
    tracks_m: Array  # (M, 3): marker positions [m]; NaN where missing
    # Name of a custom sensor, or number of the grasp of a wrench; time and values (m,), NaN where
    # missing.
    samples: tuple[tuple[str | int, float, Array], ...]


class FrameReader:
    """Reader of the frames of an experiment of a problem; lines come from `source`."""

    @validated
    def __init__(self, experiment: Experiment, problem: Problem, source: str = "input") -> None:
        self._experiment = experiment
        self._source = source
        self._line = 0
        numbers = moving_grasps(experiment)
        transforms = gripper_transforms(problem, experiment.name, [k - 1 for k in numbers])
        self._transforms = {
            number: np.eye(4) if each is None else each
            for number, each in zip(numbers, transforms, strict=True)
        }

    def frame(self, stated: Mapping[str, Any]) -> Frame:
        """Return the frame of the arguments of `LiveEstimator.add`, or raise an `InputError`."""
        pose, markers, wrench, readings = (stated.get(key) for key in KEYS[1:])
        at_s = _time(stated["t_s"])
        if readings is not None and not isinstance(readings, Mapping):
            raise InputError(f"readings are {reprlib.repr(readings)}; expected samples by name")
        samples = []
        for gauge in self._experiment.readings:
            points = gauge.names if isinstance(gauge, ImageTracks) else ()
            each = _samples((readings or {}).get(gauge.name), at_s, points)
            size = gauge.measured_values.shape[1]
            samples += [(gauge.name, time_s, _array(v, (size,))) for time_s, v in each]
        names = [gauge.name for gauge in self._experiment.readings]
        _require_known(readings or {}, names, "a reading")
        wrenches = self._experiment.sensors_by_grasp
        if wrench is not None and wrenches:  # without a load cell, wrenches are ignored
            for number, values in _by_number(wrench, [*wrenches], SAMPLE_KEYS, "a wrench").items():
                measured = wrenches[number].measured_components
                for time_s, v in _samples(values, at_s):
                    is_force = isinstance(v, Sequence | np.ndarray) and len(v) == 3
                    known = _array(v, (3,) if is_force else (6,))
                    known = np.pad(known, (0, 6 - len(known)), constant_values=np.nan)
                    samples.append((number, time_s, np.where(measured, known, np.nan)))
        poses = _by_number(pose, [*self._transforms], {*POSE_KEYS}, "a pose")
        return Frame(
            at_s,
            {number: _matrix(each) for number, each in poses.items() if each is not None},
            _points(markers, self._experiment.markers.names, size=3, what="a marker"),
            tuple(samples),
        )

    def read(self, line: bytes | str) -> Frame | None:
        """Return the frame of a line with a JSON object, whose poses are those of grippers where
        the problem states `gripper_to_body`; None for an empty line.

        Raises
        ------
        InputError
            For an invalid line; the message contains its number.
        """
        self._line += 1
        text = line if isinstance(line, str) else line.decode(errors="replace")
        if not text.strip():
            return None
        try:
            frame = self.frame(_json_object(text))
        except InputError as error:
            raise InputError(f"{self._source}, line {self._line}: {error.message}") from error
        poses = {number: pose @ self._transforms[number] for number, pose in frame.poses.items()}
        return replace(frame, poses=poses)


def moving_grasps(experiment: Experiment) -> list[int]:
    """Return the numbers, from 1, of the grasps and obstacles whose poses come with the frames."""
    return [k for k, grasp in enumerate(experiment.grasps, 1) if len(grasp.poses.t_s) > 1]


def _require_known(found: Mapping[str, Any], names: Sequence[str], what: str) -> None:
    if unknown := [name for name in found if name not in names]:
        expected = f"one of {', '.join(names)}" if names else "none"
        raise InputError(f"found {what} {reprlib.repr(unknown[0])}; expected {expected}")


def _by_number(
    stated: Any, numbers: Sequence[int], own_keys: set[str], what: str
) -> dict[int, Any]:
    """Return values by the number of their grasp; a value without a number, which may be a mapping
    with `own_keys`, belongs to the only grasp.
    """
    known = {str(number): number for number in numbers}
    if stated is None:
        return {}
    if not isinstance(stated, Mapping) or own_keys & set(stated):
        if len(numbers) > 1:
            expected = ", ".join(known)
            raise InputError(f"found {what}; expected those of the grasps {expected}, by number")
        return dict.fromkeys(numbers, stated)
    _require_known(stated, [*known], f"{what} of grasp")
    return {known[name]: each for name, each in stated.items()}


def _matrix(pose: Any) -> Array:
    """Return the pose (4, 4) of a mapping, of a tuple (position, quaternion) or of a matrix."""
    if isinstance(pose, Mapping):
        if missing := [key for key in POSE_KEYS if key not in pose]:
            raise InputError(f"the pose has no {missing[0]}; expected {' and '.join(POSE_KEYS)}")
        pose = tuple(pose[key] for key in POSE_KEYS)
    if isinstance(pose, tuple) and len(pose) == 2:
        position, quaternion = _array(pose[0], (3,)), _array(pose[1], (4,))
        fault = first_pose_fault(np.zeros(1), position[None], quaternions_xyzw=quaternion[None])
        matrix = np.eye(4)
        if fault is None:
            matrix[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
            matrix[:3, 3] = position
    else:
        matrix = _array(pose, (4, 4))
        fault = first_matrix_fault(np.zeros(1), matrix[None])
    if fault is not None:
        raise InputError(fault[1].replace(" at t_s = 0", ""))
    return matrix


def _points(points: Any, names: Sequence[str], size: int, what: str) -> Array:
    """Return the coordinates (M, size) of points given by name or in the order of `names`, NaN
    where missing; a point of which one coordinate is missing is missing as a whole.
    """
    coordinates = np.full((len(names), size), np.nan)
    if isinstance(points, Mapping):
        _require_known(points, names, what)
        for name, place in points.items():
            if place is not None:
                coordinates[list(names).index(name)] = _array(place, (size,))
    elif points is not None:
        coordinates = _array(points, coordinates.shape)
    return np.where(np.isfinite(coordinates).all(axis=1, keepdims=True), coordinates, np.nan)


def _samples(samples: Any, t_s: float, points: Sequence[str] = ()) -> Iterator[tuple[float, Any]]:
    """Yield time [s] and values of the samples of one sensor, or pixels (2N,) of `points`."""
    several = isinstance(samples, Sequence) and any(isinstance(s, Mapping) for s in samples)
    for sample in samples if several else [samples]:
        at_s, values = t_s, sample
        if isinstance(sample, Mapping) and not (points and SAMPLE_KEYS.isdisjoint(sample)):
            if set(sample) != SAMPLE_KEYS:
                keys = ", ".join(map(reprlib.repr, sample)) or "nothing"
                raise InputError(f"a sample has the keys {keys}; expected t_s and values")
            at_s, values = _time(sample["t_s"]), sample["values"]
        if values is not None and points:
            yield at_s, _points(values, points, size=2, what="a point").ravel()
        elif values is not None:
            yield at_s, [values] if isinstance(values, (int, float)) else values


def _array(raw_values: Any, shape: tuple[int, ...]) -> Array:
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


def _json_object(text: str) -> Mapping[str, Any]:
    """Return the JSON object of a line, which has a time and known keys."""
    try:
        stated = parse_json(text)
    except ValueError as error:  # also Python's limits of digits and of nesting
        reason = getattr(error, "msg", "a number is too long, or brackets are nested too deeply")
        raise InputError(
            f"this line is not valid JSON ({reason}); expected one JSON object per line"
        ) from error
    if not isinstance(stated, Mapping):
        raise InputError(f"found {reprlib.repr(stated)}; expected one JSON object per line")
    _require_known(stated, KEYS, "the key")
    if "t_s" not in stated:
        raise InputError("there is no t_s; expected the time in seconds")
    return stated


def _time(time: Any) -> float:
    """Return a time [s]; an `InputError` if it is no number or too large."""
    number = isinstance(time, (int, float, np.number)) and not isinstance(time, bool)
    if not number or not abs(time) <= LARGEST_NUMBER:
        expected = f"a finite number of seconds, up to {LARGEST_NUMBER:g}"
        raise InputError(f"t_s is {reprlib.repr(time)}; expected {expected}")
    return float(time)
