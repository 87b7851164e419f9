"""Tracks of points in the images of one camera, see `ImageTracks`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ...common.array_types import Array
from ...common.checked_arrays import float_array, read_only_floats, unconverted_or_none
from ...common.declarations import declaration, identity, key
from ...common.validated_types import NotNegative, Positive
from ...errors import InputError
from ...fem.body import Body
from ...recording.deviation import Deviation
from ...recording.experiment import Experiment
from ...recording.lost_points import followed_samples
from ...recording.nuisance import IMAGE_DRIFT, IMAGE_REACH, SURFACE_PLACE
from .camera_images import CameraImages
from .camera_images import PoseSigma as PoseSigma

# Directions in which a place may move on the surface.
# Terms of the series of a random walk: three contain 93 % of its variance.
WALK_TERMS = 3
# Places of another camera that a check compares: words, axis of the camera about which it is turned
# around the body, and angle [degrees].
VIEWS = (
    ("turned by 90° to the right around the body", 1, -90.0),
    ("turned by 90° to the left around the body", 1, 90.0),
    ("turned by 60° upwards around the body", 0, -60.0),
)
# Cosine between the normal of a face and the view, above which it is tracked.
FACING = 0.3
# Reach of errors of a camera without a stated pose and known places [σ]: larger steps take more time.
CAREFUL_REACH = 1.0


@declaration
class ImageTracks(CameraImages):
    """Pixels of points of the body in the images of one camera, as trackers of videos write them.

    A point lies on the surface of the body, or on the centreline of a rod. Where its place is
    unknown, it is found from the ray of its first image and then estimated; on a rod a rough place
    must be stated. Points with the same name in several cameras have one place.

    Parameters
    ----------
    name, camera, t_s, has_known_pose, pose_sigma, focal_sigma, centre_sigma_px, clock_sigma_s
        See `CameraImages`. A pose that is not known is found from the known places of at least four
        points with the body at rest, and then estimated.
    clock_rate_sigma, line_delay_s, line_delay_sigma_s
        See `CameraImages`.
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
        Standard deviation of the known places along the surface, or along a rod; zero for exact
        ones.
    drift_sigma_px : float
        Drift of the tracker: standard deviation of a random walk of each track after one second
        [pixels].

    Raises
    ------
    InputError
        If shapes disagree, time does not increase, names repeat, the camera has no matrix, or
        nothing is measured.
    """

    measurement_text: ClassVar[str] = "image tracks"
    other_text: ClassVar[str] = "image tracks"
    noise_key: ClassVar[str] = "sigma_px of image_tracks"
    sigma_text: ClassVar[str] = "its sigma_px"
    precedence: ClassVar[int] = 2

    pixels: Array | None = key(converter=unconverted_or_none)
    names: Sequence[str] = key(converter=identity)
    places_m: Array | None = key(converter=unconverted_or_none, default=None)
    sigma_px: float = key(Positive, default=1.0)
    place_sigma_m: float = key(NotNegative, default=1e-3)
    drift_sigma_px: float = key(NotNegative, default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        where = f"the image tracks '{self.name}'"
        names = tuple(self.names)
        count = len(names)
        if not names or len(set(names)) < count:
            raise InputError(f"names of {where} are {list(names)}; expected different names")
        times = self._checked_times(where)
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
            unknowns=self._stated_unknowns(),
            _value_count=2 * count,
        )

    def __repr__(self) -> str:
        return f"ImageTracks({self.name!r}: {len(self.t_s)} images of {len(self.names)} points)"

    @property
    def title(self) -> str:
        return f"the tracks of {self.name}"

    @property
    def samples_text(self) -> str:
        return f"the image tracks '{self.name}'"

    @property
    def instrument_text(self) -> str:
        return f"{len(self.names)} points in images of '{self.name}'"

    @property
    def identity(self) -> Any:
        return self.name, self.names

    def vectors(self, values: Array) -> Array:
        return values.reshape(len(values), -1, 2)

    def with_samples(self, t_s: ArrayLike, values: ArrayLike | None) -> Self:
        count = len(self.names)
        pixels = None if values is None else np.asarray(values, dtype=float).reshape(-1, count, 2)
        return replace(self, t_s=t_s, pixels=pixels)

    def with_zeros_at(self, t_s: ArrayLike) -> Self:
        """Return a copy without pixels: zeros would be rays of places."""
        return self.with_samples(t_s, None)

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
        """Mask (S, N) of the images in which each point has both coordinates and is followed; all
        true before pixels are simulated.
        """
        if self.pixels is None:
            return np.ones((len(self.t_s), len(self.names)), dtype=bool)
        return np.asarray(np.isfinite(self.pixels).all(axis=2) & self.is_followed)

    @cached_property
    def is_followed(self) -> NDArray[np.bool_]:
        """Mask (S, N) of the images in which the tracker has not lost the point, see
        `followed_samples`; all true before pixels are simulated.
        """
        if self.pixels is None:
            return np.ones((len(self.t_s), len(self.names)), dtype=bool)
        return followed_samples(self.pixels, self.sigma_px)

    # Nuisance parameters ----------------------------------------------------------------------

    def place_sigmas_m(self, experiment: Experiment) -> Array:
        """Return the prior standard deviation (N,) of each place along the surface [m]: the stated
        one, and the diagonal of the body where the place is unknown; zero for exact places.
        """
        body_m = float(np.linalg.norm(np.ptp(experiment.body.nodes_m, axis=0)))
        stated = stated_places(experiment)
        return np.array([stated[name][1] if name in stated else body_m for name in self.names])

    def unknown_rows(self, experiment: Experiment) -> Iterator[tuple[Deviation, str, float]]:
        is_stated = self.has_known_pose and self.is_place_known.all()
        yield from self.camera_rows(experiment, IMAGE_REACH if is_stated else CAREFUL_REACH)
        if drift_px := self.drift_px(experiment):
            for label in (each for point in self.names for each in self.drift_labels(point)):
                yield IMAGE_DRIFT, label, drift_px
        for point, sigma in zip(self.names, self.place_sigmas_m(experiment), strict=True):
            if sigma:
                for label in place_labels(point, experiment.body):
                    yield SURFACE_PLACE, label, float(sigma)

    def other_views(self, experiment: Experiment) -> Iterator[tuple[str, Self]]:
        """Use `VIEWS` of visible points without places; none for a camera that moves."""
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

    def drift_px(self, experiment: Experiment) -> float:
        """Return the prior standard deviation of the drift of a track after one second [pixels], as
        stated, else that of the experiment's `Nuisance`; zero if it is not estimated.
        """
        if not IMAGE_DRIFT.applies(experiment):
            return 0.0
        return self.drift_sigma_px or experiment.nuisance.sigma(IMAGE_DRIFT) or 0.0

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
    sigmas_m = experiment.place_sigma_m
    for k in np.flatnonzero(markers.located).tolist():
        places.setdefault(markers.names[k], (points_m[k], float(sigmas_m[k])))
    return places


def place_labels(point: str, body: Body) -> list[str]:
    """Return the labels of the coordinates of a place on a body that images show."""
    return [f"place of {point} {each} [m]" for each in body.kind.places_in_images]
