"""Coordinate frames of an experiment whose files are topics of logs.

The world of an experiment is the frame of its poses. The log's static transforms relate it to the
frames of gravity, of the markers and of force sensors.

Marker files of an experiment give tracks in the body's frame, and poses of the gripper.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..common.array_types import Array
from ..common.checked_arrays import point_text
from ..errors import InputError, hint_at, located
from ..recording import MarkerTable, PoseSequence, align_to_template, fit_poses, read_markers
from ..recording.experiment import EARTH_M_S2
from ..recording.poses import Frame
from ..recording.rigid_fit import least_rigid_marker
from ..recording.sources.log_frames import LogFrames, TopicFrames
from ..recording.sources.logs import TopicAddress
from .recording_schema import ExperimentSection, ForceSensorSection, MarkersSection, MovedSection

# Names of frames that are level by convention, or their endings; the first are more reliable.
LEVEL_FRAMES = ("world", "map", "odom", "base_link", "base", "base_footprint")
# Rotation of a sensor [degrees], and distance of its point [m], that contradict the stated ones.
LARGEST_ROTATION_DEG = 1.0
LARGEST_OFFSET_M = 0.005
# Tilt of a frame against a level one from which on it is reported [degrees]: the prior of gravity.
SMALLEST_TILT_DEG = 1.0


@dataclass(frozen=True)
class SensorMounting:
    """Pose of a force sensor, from the transforms of a log."""

    sensor: str  # name of the sensor's frame
    # Frame in which the sensor is fixed: that of the undeformed body as the grasp carries it, or
    # the world.
    frame: Frame
    pose: Array  # (4, 4): pose of the sensor in that frame

    @property
    def point_m(self) -> Array:
        """Origin (3,) of the sensor in `frame` [m]."""
        return self.pose[:3, 3]

    @property
    def angle_deg(self) -> float:
        """Angle between the axes of the sensor and those of `frame` [degrees]."""
        rotation = Rotation.from_matrix(self.pose[:3, :3])
        return float(np.degrees(rotation.magnitude()))

    def rotate(self, values: Array) -> Array:
        """Return forces and torques (S, 6) in the sensor's axes, expressed in the axes of `frame`;
        NaN if any component of the force, or of the torque, is missing.
        """
        rows = values.reshape(-1, 2, 3) @ self.pose[:3, :3].T
        return rows.reshape(-1, 6)

    def describe(self) -> str:
        """Return a sentence about what was done with the measured forces."""
        owner = "the body" if self.frame == "grasp" else "the world"
        return (
            f"the force is measured in {self.sensor!r}: by the static transforms of the log its "
            f"components are rotated by {self.angle_deg:.3g}° to the axes of {owner}, and its "
            f"torques are about the point {point_text(self.point_m)} m "
            f"{'of the undeformed body' if self.frame == 'grasp' else 'in the world'}; other "
            "axes are stated by frame and point_m"
        )

    def contradicts(self, section: ForceSensorSection) -> bool:
        """Whether a table states the same frame, but other axes or another point, see
        `LARGEST_ROTATION_DEG` and `LARGEST_OFFSET_M`.
        """
        offset_m = np.linalg.norm(self.point_m - np.array(section.point_m))
        return section.frame == self.frame and bool(
            self.angle_deg > LARGEST_ROTATION_DEG or offset_m > LARGEST_OFFSET_M
        )


@dataclass
class RecordingFrames:
    """Frames in which the recordings of one experiment are stated, as far as logs name them."""

    section: ExperimentSection  # table of the experiment
    folder: Path  # folder that contains the files

    def _frames_of(self, file: str | None) -> TopicFrames:
        address = self._topic_of(file)
        return TopicFrames() if address is None else TopicFrames.read(address)

    def _topic_of(self, file: str | None) -> TopicAddress | None:
        return TopicAddress.from_path(self.folder / file) if file else None

    @cached_property
    def poses(self) -> list[TopicFrames]:
        """Frames of the poses of each grasp, then of each obstacle."""
        return [self._frames_of(each.poses) for each in self.section.moved_sections]

    @cached_property
    def markers(self) -> str:
        """Name of the frame of the markers; empty if no log states it, and if a template moves them
        to another frame.
        """
        markers = self.section.markers
        return "" if markers.template_m is not None else self._frames_of(markers.file).parent

    @cached_property
    def world(self) -> str:
        """Name of the frame of the first poses from a log, else of the markers; empty if no log
        states it.
        """
        return next((each.parent for each in self.poses if each.parent), "") or self.markers

    @cached_property
    def transforms(self) -> LogFrames:
        """Transforms of the log of the first poses, else of the markers or of a force sensor; none
        if all are files.
        """
        section = self.section
        names = [
            *(each.poses for each in section.moved_sections),
            section.markers.file,
            *(section.file_of(each.sensor) for each in section.moved_sections),
        ]
        for name in names:
            with located(name):
                if (address := self._topic_of(name)) is not None:
                    return LogFrames.read(address)
        return LogFrames()

    # Gravity --------------------------------------------------------------------------------------

    def gravity_m_s2(self) -> Array:
        """Return gravity (3,) [m/s²] in the axes of the world: as stated, or rotated from
        `gravity_frame` by the log's static transforms.

        Raises
        ------
        InputError
            At "gravity_frame", if it is not connected with the world by static transforms.
        """
        gravity = np.array(self.section.gravity_m_s2, dtype=float)
        if (frame := self.section.gravity_frame) is None:
            return gravity
        with located(where="gravity_frame"):
            rotation = self._require_static_transform(self.world, frame)[:3, :3]
        rotated: Array = rotation @ gravity
        return rotated

    def _require_static_transform(self, parent: str, child: str) -> Array:
        """Return the pose (4, 4) of a frame in another one from the log's static transforms."""
        if not self.transforms.name:
            raise InputError(
                f"found {child!r}, but poses and markers are not topics of a log, from which the "
                "frames would be known; expected no such key: omit it, and state the values in the "
                "axes of the poses"
            )
        if not parent:
            raise InputError(
                f"found {child!r}, but the log {self.transforms.name} does not state the frame of "
                "poses or markers; expected no such key: omit it, and state the values in the axes of "
                "the poses"
            )
        matrix = self.transforms.static_transform(parent, child)
        if matrix is not None:
            return matrix
        names = self.transforms.static_neighbours(parent)
        if self.transforms.is_connected(parent, child):
            fault = f"moves relative to {parent!r}"
        else:
            fault = f"is not connected by the log's transforms with {parent!r}"
        known = ", ".join([parent, *names])
        raise InputError(
            f"found {child!r}, which {fault}; expected a frame that is fixed in it: {known}"
            f"{hint_at(child, names)}"
        )

    def gravity_notes(self) -> list[str]:
        """Return a note if gravity is along −z of the world by default, but the log tilts that
        frame against one that is level by its name (`LEVEL_FRAMES`); else an empty list.
        """
        states_gravity = {"gravity_m_s2", "gravity_frame"} & (self.section.model_fields_set)
        if states_gravity or not self.world:
            return []
        names = [self.world, *self.transforms.static_neighbours(self.world)]
        name = min(names, key=_level_rank)
        matrix = self.transforms.static_transform(self.world, name)
        assert matrix is not None
        tilt_deg = float(np.degrees(np.arccos(np.clip(matrix[2, 2], -1, 1))))
        if tilt_deg <= SMALLEST_TILT_DEG:
            return []
        gravity = matrix[:3, :3] @ np.array(EARTH_M_S2)
        vector = ", ".join(f"{value:.4g}" for value in gravity)
        return [
            f"gravity is along −z of {self.world!r}, the frame of the recording, but the log tilts "
            f"this frame by {tilt_deg:.2g}° against {name!r}: if {name!r} is level, state "
            f'gravity_frame = "{name}", or gravity_m_s2 = [{vector}]; if {self.world!r} is level, '
            f'state gravity_frame = "{self.world}"'
        ]

    # Markers --------------------------------------------------------------------------------------

    def markers_fault(self) -> str:
        """Return a sentence about markers and poses in different frames, with the address of the
        poses that resolves it; "" if logs state the same frame, or not both.

        Frames that coincide by the log's static transforms are the same.
        """
        for moved, frames in zip(self.section.moved_sections, self.poses, strict=True):
            if not self.markers or frames.parent in ("", self.markers):
                continue
            name = moved.poses
            file = self.section.markers.file
            fault = (
                f"the poses {name} are in the frame {frames.parent!r}, the markers {file} in "
                f"{self.markers!r}; expected one frame"
            )
            pose = self.transforms.static_transform(frames.parent, self.markers)
            if pose is not None and np.allclose(pose, np.eye(4)):
                continue
            chain = f"{frames.parent}>{frames.child}"
            is_readable = str(name).endswith(chain) and (
                self.transforms.is_connected(self.markers, frames.child)
            )
            if not is_readable:
                return f"{fault}: convert the poses or the markers"
            address = str(name).removesuffix(chain)
            return f'{fault}: set poses = "{address}{self.markers}>{frames.child}"'
        return ""

    # Force sensors --------------------------------------------------------------------------------

    def sensor_mounting(
        self, section: ForceSensorSection, key: str, k: int
    ) -> SensorMounting | None:
        """Return the pose of the force sensor of a grasp in the body, else in the world.

        The sensor's frame is `sensor_frame`, else that of the log's messages. None if no frame is
        known, or if none is stated and static transforms connect it neither with the frame whose
        poses are recorded nor with the world.

        Parameters
        ----------
        key : str
            Dotted key of the section, for messages.
        k : int
            Index of the grasp, or of the obstacle after the grasps.

        Raises
        ------
        InputError
            If `sensor_frame` is stated, and is not connected with either.
        """
        if not (sensor := self._sensor_frame(section)):
            return None
        frames = self.poses[k]
        if frames.child:
            pose = self.transforms.static_transform(frames.child, sensor)
            if pose is not None:
                transform = self.section.moved_sections[k].gripper_to_body
                if transform is not None:
                    pose = np.linalg.inv(transform.to_matrix()) @ pose
                return SensorMounting(sensor, "grasp", pose)
        pose = self.transforms.static_transform(self.world, sensor) if self.world else None
        if pose is not None:
            return SensorMounting(sensor, "world", pose)
        if section.sensor_frame is not None:
            with located(where=f"{key}.sensor_frame"):
                self._require_static_transform(frames.child or self.world, sensor)
        return None

    def _sensor_frame(self, section: ForceSensorSection) -> str:
        """Return the name of the frame of a sensor, stated or of its messages; empty if unknown."""
        if section.sensor_frame is not None:
            return section.sensor_frame
        return self._frames_of(self.section.file_of(section)).parent

    def sensor_note(self, section: ForceSensorSection, mounting: SensorMounting | None) -> str:
        """Return a note on the axes of a force sensor: those that the log gives, or that the stated
        ones contradict the log, or that the frame of the messages is not connected; else "".
        """
        file = self.section.file_of(section)
        if mounting is None:
            sensor = self._sensor_frame(section)
            if not sensor or section.states_axes or sensor == self.world:
                return ""
            return (
                f"{file}: the force is measured in {sensor!r}, which no static transform of the "
                "log connects with the gripper or the poses: its components are taken along the "
                "axes of the world; state sensor_frame, or frame and point_m"
            )
        if not section.states_axes:
            moves = mounting.angle_deg or mounting.point_m.any()
            is_usual = mounting.frame == "world" and not moves
            return "" if is_usual else f"{file}: {mounting.describe()}"
        if mounting.contradicts(section):
            return (
                f'{file}: frame = "{section.frame}" and point_m state axes and point, but by the '
                f"static transforms of the log the sensor's frame {mounting.sensor!r} is rotated "
                f"by {mounting.angle_deg:.3g}° against these axes, with its origin at "
                f"{point_text(mounting.point_m)} m; omit frame and point_m to use the transforms"
            )
        return ""


def _level_rank(name: str) -> int:
    """Return the place in `LEVEL_FRAMES` of a name without namespace and prefix."""
    bare = name.rpartition("/")[2].lower()
    return next(
        (
            rank
            for rank, level in enumerate(LEVEL_FRAMES)
            if bare == level or bare.endswith(f"_{level}")
        ),
        len(LEVEL_FRAMES),
    )


# A frame is reported if its residual exceeds the median by this factor.
UNUSUAL = 3.0
# Residual over the markers' span that is due to rounding.
ROUNDING = 1e-6


def gripper_markers(section: ExperimentSection) -> set[str]:
    """Return the names of the markers from which poses of grasps and obstacles are computed; empty
    if there are none.
    """
    return {name for moved in section.moved_sections for name in moved.cluster}


def read_marker_tracks(section: ExperimentSection, file: Path) -> MarkerTable:
    """Return the tracks of the markers that an experiment uses, in the file's frame.

    They are the named markers first, then those of template, grippers and obstacles; all of the
    file if the problem names none. Labels, unit and frame rate of the section are applied.

    Raises
    ------
    InputError
        If the file is unusable or lacks a marker.
    """
    markers = section.markers
    names = None
    if markers.names is not None:
        other_names = [*(markers.template_m or ()), *sorted(gripper_markers(section))]
        names = [*markers.names, *(n for n in dict.fromkeys(other_names) if n not in markers.names)]
    return read_markers(
        file,
        names=names,
        labels=markers.labels,
        length_unit=markers.length_unit,
        rate_hz=markers.rate_hz,
    )


def transform_to_body_frame(
    markers: MarkersSection, table: MarkerTable
) -> tuple[MarkerTable, list[str]]:
    """Return the tracks moved rigidly so that the template fits, and notes on the residuals.

    The fit compares the template with the mean positions of its markers within
    `template_window_s`, and the same motion is applied to all tracks at all times. Without template
    the tracks are returned as they are, without notes.

    Parameters
    ----------
    table : MarkerTable
        Tracks in the camera's frame; not changed.

    Raises
    ------
    InputError
        If the fit fails.
    """
    if markers.template_m is None or markers.template_window_s is None:
        return table, []
    fit = align_to_template(table, markers.template_m, window_s=markers.template_window_s)
    names = list(markers.template_m)
    residuals_m = fit.residual_m
    residual_list = ", ".join(
        f"{name} {_mm(off)}"
        for name, off in zip(names, residuals_m, strict=True)
        if np.isfinite(off)
    )
    return fit.apply(table), [
        f"the markers were moved rigidly to the template; remaining distances: {residual_list}"
    ]


def poses_from_markers(
    grasp: MovedSection, table: MarkerTable, window_s: tuple[float, float] | None
) -> tuple[PoseSequence, list[str]]:
    """Return poses fitted to the tracks of a grasp's markers, and notes on residuals and missing
    frames.

    Parameters
    ----------
    grasp : MovedSection
        Grasp or obstacle with markers.
    table : MarkerTable
        Tracks in the body's frame.
    window_s : tuple of two floats or None
        First and last time that the notes refer to [s]; None for all.

    Returns
    -------
    (PoseSequence, list of str)
        Poses at all times of the table, with the interpolation of the grasp.

    Raises
    ------
    InputError
        If the fit is not possible.
    """
    names = list(grasp.cluster)
    reference_m = np.array([*grasp.cluster.values()])
    tracks = table.positions_m[:, [table.names.index(name) for name in names]]
    if grasp.two_points:
        known = PoseSequence.from_two_points(table.t_s, tracks, reference_m, grasp.interpolation)
        return known, []
    fit = fit_poses(reference_m, tracks, weights=[grasp.weights.get(name, 1.0) for name in names])
    poses = replace(fit.poses(table.t_s), interpolation=grasp.interpolation)
    first_s, last_s = window_s or (-np.inf, np.inf)
    is_in_window = (table.t_s >= first_s) & (table.t_s <= last_s)
    notes = []
    if incomplete_frames := int((fit.missing & is_in_window).sum()):
        notes.append(
            f"{incomplete_frames} of {is_in_window.sum()} frames contain fewer than three of the "
            f"markers {', '.join(names)}; the poses of these frames are interpolated"
        )
    residual_m = np.where(is_in_window, fit.residual_m, np.nan)
    if np.isfinite(residual_m).any():
        notes.append(_rigidity_note(names, reference_m, tracks, table.t_s, residual_m))
    return poses, notes


def _rigidity_note(
    names: list[str], reference_m: Array, tracks: Array, t_s: Array, residual_m: Array
) -> str:
    """Return a note on the residuals of the rigid fit, with the worst marker if a frame is unusual."""
    median_m = float(np.nanmedian(residual_m))
    worst = int(np.nanargmax(residual_m))
    size_m = float(np.linalg.norm(np.ptp(reference_m, axis=0)))
    limit_m = max(UNUSUAL * median_m, ROUNDING * size_m)
    fit_sentence = (
        f"the markers {', '.join(names)} fit a rigid motion to {_mm(median_m)} (median over "
        "the frames)"
    )
    count = int((residual_m > limit_m).sum())
    if not count:
        return f"{fit_sentence}, at worst {_mm(residual_m[worst])}"
    worst_marker = names[least_rigid_marker(reference_m, tracks[worst])]
    frames = "1 frame is" if count == 1 else f"{count} frames are"
    return (
        f"{fit_sentence}, but {frames} above {_mm(limit_m)}, the worst with "
        f"{_mm(residual_m[worst])} at t = {t_s[worst]:.6g} s (frame {worst + 1}), where "
        f"{worst_marker!r} moves relative to the others"
    )


def _mm(length_m: float) -> str:
    return f"{1e3 * length_m:.3g} mm"
