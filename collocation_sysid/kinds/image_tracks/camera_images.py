"""What measurements in the images of an ordinary camera have in common: the camera and its errors.

A camera states how uncertain it is. What it does not state is estimated if the recording's `Nuisance`
does so, and otherwise considered in the budget and tested, see the rows `IMAGE_…` of
`recording.nuisance`. Measurements of one experiment with the same `camera_name` share the errors.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array
from ...common.checked_arrays import read_only_floats, unconverted
from ...common.declarations import declaration, key
from ...common.validated_types import NotNegative
from ...errors import InputError
from ...program.association import SAMPLES_OFF
from ...program.correspondences import Correspondences
from ...program.custom_sensor_residual import CorrespondingSensorResidual
from ...program.measurement_residual import GROUP, RowStencil, lagrange_weights, neighbouring_times
from ...recording.camera import Camera
from ...recording.custom_sensor import CustomSensor
from ...recording.deviation import Deviation
from ...recording.experiment import Experiment
from ...recording.nuisance import (
    DEGREE,
    IMAGE_CENTRE,
    IMAGE_CLOCK_RATE,
    IMAGE_FOCAL,
    IMAGE_LINE_DELAY,
    IMAGE_SHIFT,
    IMAGE_TIME,
    IMAGE_TURN,
    cayley_rotation,
)
from ...recording.sample_times import TIME_TOLERANCE_S, first_unordered_time

# Row and axis of each error of a camera, by the name of its unknown.
CAMERA_UNKNOWNS: dict[str, tuple[Deviation, str]] = {
    **{f"turn_{axis}_rad": (IMAGE_TURN, axis) for axis in "xyz"},
    **{f"shift_{axis}_m": (IMAGE_SHIFT, axis) for axis in "xyz"},
    "focal_error": (IMAGE_FOCAL, ""),
    "centre_u_px": (IMAGE_CENTRE, "u"),
    "centre_v_px": (IMAGE_CENTRE, "v"),
    "delay_s": (IMAGE_TIME, ""),
    "clock_rate": (IMAGE_CLOCK_RATE, ""),
    "line_delay_error_s": (IMAGE_LINE_DELAY, ""),
}
POSE_UNKNOWNS = tuple(CAMERA_UNKNOWNS)[:6]
# Prior of the pose of a camera that is found from the body at rest [rad, m]: it is not a statement.
UNKNOWN_TURN_RAD = 20 * DEGREE
UNKNOWN_SHIFT_M = 0.2
# Depth at which points near or behind the camera are projected in trial motions [m].
LEAST_DEPTH_M = 1e-3


@declaration
class PoseSigma:
    """Uncertainty of the stated pose of a camera; zero for an exact one.

    Parameters
    ----------
    turn_deg : float
        Standard deviation of its rotation about each of its axes [degrees].
    shift_m : float
        Standard deviation of its position along each of its axes [m].
    """

    description_name: ClassVar[str] = "pose_sigma"

    turn_deg: float = key(NotNegative, default=1.0)
    shift_m: float = key(NotNegative, default=5e-3)


@declaration
class CameraImages(CustomSensor):
    """Images of one camera, of which something is measured: base class of `ImageTracks` and
    `Outlines`. Standard deviations of zero are not estimated.

    Parameters
    ----------
    name : str
        Name of the camera, in messages, error bars and files.
    camera : Camera
        Camera with a matrix.
    t_s : (S,) array
        Times of the images, ascending, at any rate.
    has_known_pose : bool
        Whether the pose of the camera is known.
    pose_sigma : PoseSigma
        Uncertainty of the pose.
    focal_sigma : float
        Standard deviation of the relative error of both focal lengths.
    centre_sigma_px : float
        Standard deviation of each coordinate of the principal point [pixels].
    clock_sigma_s : float
        Standard deviation of the delay of the images by the clock of the grasps [s].
    clock_rate_sigma : float
        Standard deviation of the relative error of the frame rate.
    line_delay_s, line_delay_sigma_s : float
        Time from one row of the image to the next one of a rolling shutter, and its standard
        deviation [s]. The time of an image is that of its first row.
    """

    description_name: ClassVar[str] = "camera"
    counts_pixels: ClassVar[bool] = True
    unit = "px"

    name: str
    camera: Camera
    t_s: Array = key(converter=unconverted)
    has_known_pose: bool = key(default=True, kw_only=True)
    pose_sigma: PoseSigma = key(default=PoseSigma(), kw_only=True)
    focal_sigma: float = key(NotNegative, default=5e-3, kw_only=True)
    centre_sigma_px: float = key(NotNegative, default=2.0, kw_only=True)
    clock_sigma_s: float = key(NotNegative, default=5e-3, kw_only=True)
    clock_rate_sigma: float = key(NotNegative, default=0.0, kw_only=True)
    line_delay_s: float = key(NotNegative, default=0.0, kw_only=True)
    line_delay_sigma_s: float = key(NotNegative, default=0.0, kw_only=True)

    def _checked_times(self, where: str) -> Array:
        if self.camera.matrix is None:
            raise InputError(
                f"the camera of {where} has no matrix; expected that of its calibration"
            )
        times = read_only_floats(self.t_s, (None,), name=f"t_s of {where}")
        if not len(times):
            raise InputError(f"t_s of {where} is empty; expected at least one time")
        if fault := first_unordered_time(times):
            raise InputError(f"{fault[1]} in t_s of {where}", where=f"row {fault[0] + 1}")
        return times

    def _stated_unknowns(self) -> dict[str, float]:
        """Return the stated standard deviations by name, without those that are zero."""
        pose = self.pose_sigma
        turn, shift = float(np.deg2rad(pose.turn_deg)), pose.shift_m
        if not self.has_known_pose:
            turn, shift = UNKNOWN_TURN_RAD, UNKNOWN_SHIFT_M
        sigmas = [
            *[turn] * 3,
            *[shift] * 3,
            self.focal_sigma,
            *[self.centre_sigma_px] * 2,
            self.clock_sigma_s,
            self.clock_rate_sigma,
            self.line_delay_sigma_s,
        ]
        return {k: float(s) for k, s in zip(CAMERA_UNKNOWNS, sigmas, strict=True) if s}

    def camera_unknowns(self, experiment: Experiment) -> dict[str, float]:
        """Return the prior standard deviations of the errors of the camera that are estimated, by
        name: as stated, else those of the experiment's `Nuisance`.
        """
        sigmas = {
            name: self.unknowns.get(name) or experiment.nuisance.sigma(row)
            for name, (row, _) in CAMERA_UNKNOWNS.items()
            if row.applies(experiment)
        }
        return {name: float(sigma) for name, sigma in sigmas.items() if sigma}

    @property
    def number_names(self) -> Sequence[str]:
        return self.columns

    @property
    def camera_name(self) -> str:
        """Name of the camera, which measurements in its images share with its errors."""
        return self.name

    def unknown_label(self, name: str) -> str:
        row, axis = CAMERA_UNKNOWNS[name]
        return f"{row.label.format(which=self.camera_name, axis=axis)} [{row.unit}]"

    def line_delay_in(self, experiment: Experiment) -> float:
        """Return the time from row to row [s]; zero in a static experiment, in which nothing moves."""
        return 0.0 if experiment.is_static else self.line_delay_s

    def exposed_s(
        self, experiment: Experiment, errors: Mapping[str, float], rows: Array | None = None
    ) -> Array:
        """Return when the middle row of each image (S,), or rows (S, P), were exposed [s], with errors
        of the camera.
        """
        line_s = self.line_delay_in(experiment) + errors.get("line_delay_error_s", 0.0)
        t_s = self.sample_times_s
        late_s = errors.get("delay_s", 0.0) + errors.get("clock_rate", 0.0) * (t_s - t_s[0])
        if rows is None:
            return t_s + late_s + line_s * self.camera.require_matrix()[1, 2]
        return (t_s + late_s)[:, None] + line_s * rows

    def camera_rows(
        self, experiment: Experiment, reach: float
    ) -> Iterator[tuple[Deviation, str, float]]:
        """Yield row, label and prior standard deviation of each error of the camera that is
        estimated, with another reach of the row.
        """
        for name, sigma in self.camera_unknowns(experiment).items():
            yield replace(CAMERA_UNKNOWNS[name][0], reach=reach), self.unknown_label(name), sigma


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageCorrespondences(Correspondences):
    """Correspondences in the images of one camera."""

    # Errors of the camera with which the grid times around each image were chosen: another delay
    # would extrapolate the motion.
    clock: Mapping[str, float] = field(default_factory=dict)


C = TypeVar("C", bound=ImageCorrespondences)


@dataclass(frozen=True, eq=False)
class CameraImagesResidual(CorrespondingSensorResidual):
    """Residual of points in the images of one camera."""

    sensor: CameraImages
    experiment: Experiment
    correspondences: ImageCorrespondences

    def exposed_s(self, errors: Mapping[str, float], rows: Array | None = None) -> Array:
        return self.sensor.exposed_s(self.experiment, errors, rows)

    @property
    def at_s(self) -> Array:
        return self.exposed_s(self.correspondences.clock)

    @property
    @abstractmethod
    def rows(self) -> Array:
        """Rows (S, P) of the images in which the points appear."""

    @cached_property
    def point_times(self) -> NDArray[np.int64]:
        """Indices (S, P, k) of the grid times around the exposure of each point's row."""
        at_s = self.exposed_s(self.correspondences.clock, self.rows)
        used = self._times.shape[1]
        times = neighbouring_times(self.observable_s, at_s.ravel() + TIME_TOLERANCE_S, count=used)
        return times.reshape(*at_s.shape, used)

    def stencil(self, phi: Array, known: int) -> RowStencil:
        last = np.maximum.accumulate(self.point_times[..., -1].max(axis=1))
        samples = int(np.count_nonzero(last < known))
        return RowStencil(self._stencil.indices[:samples], self._stencil.data[:, :samples])

    def errors_at(self, phi: Array) -> dict[str, float]:
        """Return the errors of the camera that are estimated at φ (k,), by name."""
        values = (phi * self.nuisance.scales)[self.own_parameters[0]].tolist()
        names = self.sensor.camera_unknowns(self.experiment)
        return dict(zip(names, values, strict=False))

    def with_clock(self, found: C, errors: dict[str, float]) -> C:
        """Return correspondences with other errors of the camera if the images have left the grid
        times around them.
        """
        off_s = np.abs(self.exposed_s(errors) - self.exposed_s(found.clock)).max()
        is_near = off_s <= SAMPLES_OFF * np.diff(self.observable_s).max(initial=0.0)
        return found if is_near else replace(found, clock=errors)

    def position_sigmas_m(self, points_m: Array, translations_m: Array, sigmas: Array) -> Array:
        """Return the standard deviations (3P,) of the positions of points (P, 3) as one pixel
        determines them, along any axis: σ [pixels] times the distance from the camera over the
        focal length.
        """
        away_m = np.linalg.norm(points_m - translations_m[0], axis=1)
        focal_px = self.sensor.camera.require_matrix()[0, 0]
        return np.repeat(sigmas * away_m / focal_px, GROUP)

    def camera_data(self, rotations: Array, translations: Array) -> Array:
        """Return the data (S, P, k + 14) of the points for `projected`: distances of the k
        neighbouring times from the image [s], the time since the first image over that of the last
        one, and the duration [s], the rotation (S, 3, 3) of the camera by rows, its translation [m].
        """
        first_s, last_s = self.sensor.sample_times_s[[0, -1]]
        since_s = self.t_s - first_s
        duration_s = max(float(last_s - first_s), 1e-12)
        common = np.column_stack(
            [
                since_s / duration_s,
                np.full(len(since_s), duration_s),
                rotations.reshape(-1, 9),
                translations,
            ]
        )
        offsets_s = self.observable_s[self.point_times] - self.t_s[:, None, None]
        of_points = np.broadcast_to(common[:, None], (*offsets_s.shape[:2], common.shape[1]))
        return np.concatenate([offsets_s, of_points], axis=2)

    def known_errors(self, own: ca.SX) -> Callable[..., ca.SX]:
        """Return a function from names of unknowns of the camera to their values; `own` are those
        that are estimated.
        """
        names = self.sensor.camera_unknowns(self.experiment)
        values = dict(zip(names, ca.vertsplit(own), strict=True)) if names else {}

        def known(*names: str) -> ca.SX:
            return ca.vertcat(*(values.get(name, ca.SX(0)) for name in names))

        return known

    def projected(
        self, known: Callable[..., ca.SX], values: ca.SX, data: Sequence[ca.SX], row: ca.SX
    ) -> ca.SX:
        """Return the pixel (2,) of a point.

        Parameters
        ----------
        known : callable
            See `known_errors`.
        values : (3, times) SX
            Positions of the point at the neighbouring grid times [m].
        data : sequence of SX
            Parts of `camera_data`: distances, share, duration, rotation, translation.
        row : SX
            Row of the image in which the point appears.
        """
        offsets, share, duration, rotation, translation = data
        line_s = self.sensor.line_delay_in(self.experiment) + known("line_delay_error_s")
        late = known("delay_s") + known("clock_rate") * share * duration + line_s * row
        weights = lagrange_weights(late, ca.vertsplit(offsets))
        # Stored by rows, so that this is the transpose: from the world to the camera.
        to_camera = ca.reshape(rotation, 3, 3)
        point = to_camera @ (values @ ca.vertcat(*weights) - translation)
        turn = known(*POSE_UNKNOWNS[:3])
        if not turn.is_zero():
            point = cayley_rotation(turn) @ point
        point = point + known(*POSE_UNKNOWNS[3:])
        point = ca.vertcat(point[:2], ca.fmax(point[2], LEAST_DEPTH_M))
        return self.sensor.camera.pixel_expression(
            point, known("focal_error"), known("centre_u_px", "centre_v_px")
        )
