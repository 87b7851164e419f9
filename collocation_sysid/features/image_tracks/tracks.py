"""Tracks of points in the images of one camera, see `ImageTracks`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ...common.array_types import Array, root_mean
from ...common.checked_arrays import float_array, read_only_floats, unconverted, unconverted_or_none
from ...common.declarations import declaration, identity, key
from ...common.validated_types import NotNegative, Positive
from ...errors import InputError
from ...recording.camera import Camera
from ...recording.custom_sensor import CustomSensor
from ...recording.deviation import Deviation
from ...recording.experiment import Experiment
from ...recording.nuisance import DEGREE, GAUGE, SURFACE_PLACE, UNLIMITED_REACH
from ...recording.sample_times import first_unordered_time

# Directions in which a place may move on the surface.
DIRECTIONS = ("first", "second")
# Terms of the series of a random walk: three contain 93 % of its variance.
WALK_TERMS = 3
# Texts and units of what is uncertain about a camera, by the names of the unknowns.
UNKNOWN_TEXTS = {
    **{f"turn_{axis}_rad": (f"turn, {axis},", "rad") for axis in "xyz"},
    **{f"shift_{axis}_m": (f"shift, {axis},", "m") for axis in "xyz"},
    "focal_error": ("error of the focal length", "1"),
    "centre_u_px": ("error of the principal point, u,", "px"),
    "centre_v_px": ("error of the principal point, v,", "px"),
    "delay_s": ("delay", "s"),
    "clock_rate": ("error of the frame rate", "1"),
    "line_delay_error_s": ("error of the line delay", "s"),
}
POSE_UNKNOWNS = tuple(UNKNOWN_TEXTS)[:6]
OF_TIME = ("delay_s", "clock_rate", "line_delay_error_s")
# A term of the drift of a track; predictions are linear in it.
TRACK_DRIFT = Deviation(
    "track_drift", "", sigma=None, of="gauge", changes=(), reach=UNLIMITED_REACH
)
# Places of another camera that a check compares: words, axis of the camera about which it is turned
# around the body, and angle [degrees].
VIEWS = (
    ("turned by 90° to the right around the body", 1, -90.0),
    ("turned by 90° to the left around the body", 1, 90.0),
    ("turned by 60° upwards around the body", 0, -60.0),
)
# Cosine between the normal of a face and the view, above which it is tracked.
FACING = 0.3
# An unknown of a camera with a stated pose and known places: steps of three standard deviations save
# a quarter of the iterations. With unknown places they take more time.
STATED_CAMERA = Deviation("reading", "", sigma=None, of="gauge", changes=(), reach=3.0)
# Prior of the pose of a camera that is found from the body at rest [rad, m]: it is not a statement.
UNKNOWN_TURN_RAD = 20 * DEGREE
UNKNOWN_SHIFT_M = 0.2


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
class ImageTracks(CustomSensor):
    """Pixels of points of the body in the images of one camera, as trackers of videos write them.

    A point lies on the surface of the body. Where its place is unknown, it is found from the ray of
    its first image and then estimated. Points with the same name in several cameras have one place.

    Parameters
    ----------
    name : str
        Name of the camera, in messages, error bars and files.
    camera : Camera
        Camera with a matrix.
    t_s : (S,) array
        Times of the images, ascending, at any rate.
    pixels : (S, N, 2) array, or None
        Pixels u (to the right) and v (downwards); NaN where missing. None before they are simulated.
    names : sequence of str
        Names (N,) of the points.
    places_m : (N, 3) array, optional
        Places [x, y, z] of the points on the undeformed body; NaN where unknown. All unknown by
        default.
    sigma_px : float
        Standard deviation of the noise of each pixel coordinate.
    place_sigma_m : float
        Standard deviation of the known places along the surface; zero for exact ones.
    has_known_pose : bool
        Whether the pose of the camera is known. If not, it is found from the known places of at
        least four points with the body at rest, and then estimated.
    pose_sigma : PoseSigma
        Uncertainty of the pose.
    focal_sigma : float
        Standard deviation of the relative error of both focal lengths; zero for exact ones.
    centre_sigma_px : float
        Standard deviation of each coordinate of the principal point [pixels].
    clock_sigma_s : float
        Standard deviation of the delay of the images by the clock of the grasps [s].
    clock_rate_sigma : float
        Standard deviation of the relative error of the frame rate.
    line_delay_s, line_delay_sigma_s : float
        Time from one row of the image to the next one of a rolling shutter, and its standard
        deviation [s]. The time of an image is that of its first row.
    drift_sigma_px : float
        Drift of the tracker: standard deviation of a random walk of each track after one second
        [pixels].

    Raises
    ------
    InputError
        If shapes disagree, time does not increase, names repeat, the camera has no matrix, or
        nothing is measured.
    """

    description_name: ClassVar[str] = "camera"
    measurement_text: ClassVar[str] = "image tracks"
    other_text: ClassVar[str] = "image tracks"
    noise_key: ClassVar[str] = "sigma_px of image_tracks"
    sigma_text: ClassVar[str] = "its sigma_px"
    precedence: ClassVar[int] = 2
    counts_pixels: ClassVar[bool] = True
    unit = "px"

    name: str
    camera: Camera
    t_s: Array = key(converter=unconverted)
    pixels: Array | None = key(converter=unconverted_or_none)
    names: Sequence[str] = key(converter=identity)
    places_m: Array | None = key(converter=unconverted_or_none, default=None)
    sigma_px: float = key(Positive, default=1.0)
    place_sigma_m: float = key(NotNegative, default=1e-3)
    has_known_pose: bool = key(default=True)
    pose_sigma: PoseSigma = key(default=PoseSigma())
    focal_sigma: float = key(NotNegative, default=5e-3)
    centre_sigma_px: float = key(NotNegative, default=2.0)
    clock_sigma_s: float = key(NotNegative, default=5e-3)
    clock_rate_sigma: float = key(NotNegative, default=0.0)
    line_delay_s: float = key(NotNegative, default=0.0)
    line_delay_sigma_s: float = key(NotNegative, default=0.0)
    drift_sigma_px: float = key(NotNegative, default=0.0)

    def __post_init__(self) -> None:
        """Check the tracks, and complete what every custom sensor has, in place."""
        where = f"the image tracks '{self.name}'"
        names = tuple(self.names)
        count = len(names)
        if not names or len(set(names)) < count:
            raise InputError(f"names of {where} are {list(names)}; expected different names")
        if self.camera.matrix is None:
            raise InputError(
                f"the camera of {where} has no matrix; expected that of its calibration"
            )
        times = read_only_floats(self.t_s, (None,), name=f"t_s of {where}")
        if not len(times):
            raise InputError(f"t_s of {where} is empty; expected at least one time")
        if fault := first_unordered_time(times):
            raise InputError(f"{fault[1]} in t_s of {where}", where=f"row {fault[0] + 1}")
        shape = (len(times), count, 2)
        pixels = None
        if self.pixels is not None:
            pixels = read_only_floats(self.pixels, shape, name=f"pixels of {where}", finite=False)
            if not np.isfinite(pixels).any():
                raise InputError(f"all pixels of {where} are missing; check its file")
        places = np.full((count, 3), np.nan)
        if self.places_m is not None:
            places = float_array(self.places_m, f"places_m of {where}", (count, 3), finite=False)
        places.setflags(write=False)
        vars(self).update(
            names=names,
            t_s=times,
            pixels=pixels,
            places_m=places,
            values=None if pixels is None else pixels.reshape(len(times), -1),
            sigma=self.sigma_px,
            points_m=places[np.isfinite(places).all(axis=1)],
            columns=tuple(f"{name}_{axis}" for name in names for axis in "uv"),
            unknowns=self._camera_unknowns(),
            _value_count=2 * count,
        )

    def __repr__(self) -> str:
        return f"ImageTracks({self.name!r}: {len(self.t_s)} images of {len(self.names)} points)"

    @property
    def title(self) -> str:
        """Tracks and name of the camera."""
        return f"the tracks of {self.name}"

    @property
    def samples_text(self) -> str:
        """Tracks and name of the camera."""
        return f"the image tracks '{self.name}'"

    @property
    def instrument_text(self) -> str:
        """Number of points and name of the camera."""
        return f"{len(self.names)} points in images of '{self.name}'"

    @property
    def number_names(self) -> Sequence[str]:
        """Names of the columns."""
        return self.columns

    @property
    def identity(self) -> Any:
        """Name of the camera and of the points."""
        return self.name, self.names

    def vectors(self, values: Array) -> Array:
        """Return numbers (S, 2N) as pixels (S, N, 2)."""
        return values.reshape(len(values), -1, 2)

    def rms_text(self, difference: Array) -> str:
        """Return the RMS of a coordinate in pixels."""
        known = difference[np.isfinite(difference)]
        return f"{root_mean(known**2):.3g} px RMS" if known.size else ""

    def with_samples(self, t_s: ArrayLike, values: ArrayLike | None) -> Self:
        """Return a copy with other pixels (S, 2N) at the times `t_s` (S,) [s]."""
        count = len(self.names)
        pixels = None if values is None else np.asarray(values, dtype=float).reshape(-1, count, 2)
        return replace(self, t_s=t_s, pixels=pixels)

    @property
    def known_places_m(self) -> Array:
        """Places (N, 3) on the undeformed body as stated [m]; NaN where unknown."""
        return np.asarray(self.places_m)

    @property
    def is_place_known(self) -> NDArray[np.bool_]:
        """Mask (N,) of the points with a stated place."""
        return np.asarray(np.isfinite(self.known_places_m).all(axis=1))

    @property
    def is_seen(self) -> NDArray[np.bool_]:
        """Mask (S, N) of the images in which each point has both coordinates; all true before
        pixels are simulated.
        """
        if self.pixels is None:
            return np.ones((len(self.t_s), len(self.names)), dtype=bool)
        return np.asarray(np.isfinite(self.pixels).all(axis=2))

    # Nuisance parameters ----------------------------------------------------------------------

    def _camera_unknowns(self) -> dict[str, float]:
        """Return the prior standard deviations of what is uncertain about the camera, by name; what
        is exact is left out.
        """
        pose = self.pose_sigma
        turn, shift = np.deg2rad(pose.turn_deg), pose.shift_m
        if not self.has_known_pose:
            turn, shift = UNKNOWN_TURN_RAD, UNKNOWN_SHIFT_M
        sigmas = {f"turn_{axis}_rad": turn for axis in "xyz"}
        sigmas |= {f"shift_{axis}_m": shift for axis in "xyz"}
        sigmas |= {
            "focal_error": self.focal_sigma,
            "centre_u_px": self.centre_sigma_px,
            "centre_v_px": self.centre_sigma_px,
            "delay_s": self.clock_sigma_s,
            "clock_rate": self.clock_rate_sigma,
            "line_delay_error_s": self.line_delay_sigma_s,
        }
        return {name: float(sigma) for name, sigma in sigmas.items() if sigma}

    def camera_unknowns(self, is_static: bool) -> list[str]:
        """Return the names of `unknowns`, without those of times if the experiment is static."""
        return [name for name in self.unknowns if not (is_static and name in OF_TIME)]

    def unknown_label(self, name: str) -> str:
        """Return the label of an unknown of the camera, with its unit."""
        text, unit = UNKNOWN_TEXTS[name]
        return f"{text} of {self.name} [{unit}]"

    def place_sigmas_m(self, experiment: Experiment) -> Array:
        """Return the prior standard deviation (N,) of each place along the surface [m]: the stated
        one, and the diagonal of the body where the place is unknown; zero for exact places.
        """
        body_m = float(np.linalg.norm(np.ptp(experiment.body.nodes_m, axis=0)))
        stated = stated_places(experiment)
        return np.array([stated[name][1] if name in stated else body_m for name in self.names])

    def unknown_rows(self, experiment: Experiment) -> Iterator[tuple[Deviation, str, float]]:
        """Yield row, label and prior standard deviation of each unknown: of the camera, of the
        drift of the tracks, and of the places, which cameras share by the names of the points.
        """
        for name in self.camera_unknowns(experiment.is_static):
            is_stated = self.has_known_pose and self.is_place_known.all()
            row = STATED_CAMERA if is_stated else GAUGE
            yield row, self.unknown_label(name), self.unknowns[name]
        if self.drift_sigma_px and not experiment.is_static:
            for label in (each for point in self.names for each in self.drift_labels(point)):
                yield TRACK_DRIFT, label, self.drift_sigma_px
        for point, sigma in zip(self.names, self.place_sigmas_m(experiment), strict=True):
            if sigma:
                for label in place_labels(point):
                    yield SURFACE_PLACE, label, float(sigma)

    def other_views(self, experiment: Experiment) -> Iterator[tuple[str, Self]]:
        """Yield the camera at each of `VIEWS`, of which it sees as many points of the body, spread
        over the visible surface, whose places are unknown; none for a camera that moves.
        """
        if self.camera.poses is not None or not self.has_known_pose:
            return
        body = experiment.body
        nodes_m = experiment.rigid_positions(experiment.t_s[:1])[0]
        middle_m = nodes_m.mean(axis=0)
        corners = nodes_m[body.mesh.surface]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        pose = self.camera.pose
        for words, axis, angle_deg in VIEWS:
            turn = Rotation.from_rotvec(np.deg2rad(angle_deg) * pose[:3, axis]).as_matrix()
            moved = pose.copy()
            moved[:3, :3] = turn @ pose[:3, :3]
            moved[:3, 3] = middle_m + turn @ (pose[:3, 3] - middle_m)
            away = moved[:3, 3] - corners.mean(axis=1)
            facing = np.einsum("fi,fi->f", normals, away) / np.linalg.norm(away, axis=1)
            faces = np.flatnonzero(facing > FACING)
            if not len(faces):
                continue
            rest_m = body.nodes_m[body.mesh.surface[faces]].mean(axis=1)
            chosen = [0]
            while len(chosen) < min(len(self.names), len(faces)):
                gaps = np.linalg.norm(rest_m[:, None] - rest_m[chosen], axis=2)
                chosen.append(int(gaps.min(axis=1).argmax()))
            names = [f"{words} {k + 1}" for k in range(len(chosen))]
            seen = replace(
                self,
                name=words,
                camera=replace(self.camera, pose=moved),
                pixels=np.zeros((len(self.t_s), len(chosen), 2)),
                names=names,
                places_m=rest_m[chosen],
                place_sigma_m=float(np.linalg.norm(np.ptp(body.nodes_m, axis=0))),
            )
            yield f"another such camera {words}", seen

    def drift_labels(self, point: str) -> list[str]:
        """Return the labels of the terms of the drift of a track, u first."""
        return [
            f"drift of {point} in {self.name}, {axis}{k + 1} [px]"
            for axis in "uv"
            for k in range(WALK_TERMS)
        ]


def stated_places(experiment: Experiment) -> dict[str, tuple[Array, float]]:
    """Return the stated places (3,) on the undeformed body and their standard deviations along the
    surface [m], by the names of the points: of the first camera that states the place, else of a
    marker with the same name.
    """
    places: dict[str, tuple[Array, float]] = {}
    for tracks in experiment.readings:
        if isinstance(tracks, ImageTracks):
            for k in np.flatnonzero(tracks.is_place_known).tolist():
                stated = tracks.known_places_m[k], tracks.place_sigma_m
                places.setdefault(tracks.names[k], stated)
    markers = experiment.markers
    if not markers.names:
        return places
    points_m = markers.predict_positions(experiment.body.nodes_m)
    sigmas_m = experiment.compute_place_sigma_m()
    for k in np.flatnonzero(markers.located).tolist():
        places.setdefault(markers.names[k], (points_m[k], float(sigmas_m[k])))
    return places


def place_labels(point: str) -> list[str]:
    """Return the labels of the coordinates of a place on the surface."""
    return [f"place of {point} on the surface, {direction} [m]" for direction in DIRECTIONS]
