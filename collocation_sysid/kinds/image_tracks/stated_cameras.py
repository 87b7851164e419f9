"""What a check says about cameras whose tracks contradict the description, before a solve.

The tracks are compared with the body carried by its grasp in two ways, with the stated description
and with common mistakes corrected: by the distance of the tracks from the body, which may sag, and
by the motion of those points that are so near the grasp that they move as it does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from ...common.array_types import Array, Index
from ...judge.doubt import Doubt
from ...judge.sensors import measurement_mistake
from ...recording.camera import Camera
from ...recording.experiment import Experiment
from ...recording.measurement import Measurement
from ...recording.placement import LocatedBody, nearest_points_of_triangles
from ...statistics.hypothesis import Hypothesis
from .places import SIMILAR_POSES, poses_of_tracks
from .rays import facing, points_on_surface
from .tracks import ImageTracks, stated_places

# Images in which places, and in which motions are compared.
MOST_IMAGES = 6
MOST_IN_MOTION = 60
# Distance [pixels] of a point that cannot be projected, and of a ray that meets no part of the body.
FAR_PX = 1e4
# Share of the points with known places that may be on sides of the body that are not seen, with a
# cosine between normal and view below the second number throughout.
HIDDEN = 0.5
TURNED_AWAY = -0.2
# Factor by which a correction must decrease the median distance.
NEARER = 3.0
# Share of the size of the body in the image below which distances are those of its deformation.
OF_DEFORMATION = 0.1
# Standard deviations of the stated pose up to which distances are those of the pose.
OF_POSE = 3.0
# Distance as a share of that size at which a camera does not show the body, whatever is corrected.
NOT_SHOWN = 0.5
# Sags of the end of the body that are tried, over the length from the grasp.
SAGS = (0.0, 0.1, 0.25, 0.5)
# Distance from the grasp over that length within which points move as the grasp, and most of them.
NEAR = 0.25
MOST_NEAR = 4
# Motion of these points [standard deviations of a pixel] from which on it is compared; deviation from
# it, over the motion itself, that is suspicious; the factor by which a correction decreases it, and
# what it leaves at most; both also for a pose that is found from few points, which is less accurate.
MOVING = 5.0
UNLIKE = 0.6
ALIKE, ALIKE_FOUND = 2.0, 2.5
WELL_ALIKE, WELL_ALIKE_FOUND = 0.25, 0.4
# Factor between corrections that explain the tracks equally well, deviation of the motion below which
# they do, and how many are named.
SIMILAR = 1.3
ALIKE_ENOUGH = 0.1
MOST_NAMED = 2
# Share of the images in which a correction of the times must show the motion, and of the samples that
# must be seen for images in reverse order.
COVERED = 0.6
MOSTLY_SEEN = 0.9
# Sizes of images over those of the calibration that are tried.
SCALES = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)
# Frame rates over the stated ones that are tried: films of other standards, and slow motion.
RATES = (1 / 8, 1 / 4, 1 / 2, 24 / 30, 25 / 30, 50 / 60, 60 / 50, 30 / 25, 30 / 24, 2.0, 4.0, 8.0)
# Delays of the images that are tried [s].
DELAYS_S = 0.02 * np.concatenate([-np.arange(25, 0, -1), np.arange(1, 26)])
# Frames of cameras in other programs, in columns, and the words for them.
FRAMES = {
    "x to the right, y up, z backwards (OpenGL, Blender)": np.diag([1.0, -1.0, -1.0]),
    "x forward, y to the left, z up (ROS body frame)": np.array(
        [[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    ),
}
# Transform of a world whose y axis points upwards to one whose z axis does.
FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


# Measure of the tracks without a mistake, these tracks, and the clause that states the mistake.
_Tried = tuple[float, ImageTracks, str]


def hypotheses(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield a hypothesis for each camera whose tracks are not where the body appears, or near the
    grasp do not move as the grasp does; an unknown pose is that which fits one image best.
    """
    for tracks in experiment.readings:
        if isinstance(tracks, ImageTracks) and tracks.pixels is not None:
            yield from _camera_hypotheses(experiment, tracks)


def _camera_hypotheses(experiment: Experiment, tracks: ImageTracks) -> Iterator[Hypothesis]:
    trial = _Trial(experiment, tracks)
    if not len(trial.samples):
        return
    stated = trial.tracks = trial.with_fitted_pose(tracks)
    of = f"'{tracks.name}' of '{experiment.name}'"
    stated_px, size_px = trial.distance_px(stated), trial.size_px(stated.camera)
    usual_px = max(OF_DEFORMATION * size_px, OF_POSE * trial.pose_px)
    if stated_px > OF_DEFORMATION * size_px or stated_px >= FAR_PX:
        rows = [*trial.mistakes(), *trial.reversed_order()]
        if stated_px > usual_px and tracks.has_known_pose:
            rows += trial.wrong_pixels()
        tried = trial.without(rows, trial.distance_px)
        best_px = tried[0][0]
        near = [each for each in tried if each[0] <= SIMILAR * best_px + tracks.sigma_px]
        # Mirror images of a body may be as near as the body itself, but move otherwise.
        likely = [each for each in near if not trial.unlike(each[1]) > UNLIKE]
        mistake = _alternatives(likely or near)
        data = {"distance_px": stated_px, "size_px": size_px}
        if best_px * NEARER < stated_px:
            ratio = stated_px / max(best_px, 1.0)
            data |= {"mistake": mistake, "nearer": ratio}
            yield Hypothesis("image-tracks/likely", of, data=data, strength=ratio)
            return
        if stated_px > max(NOT_SHOWN * min(size_px, FAR_PX), OF_POSE * trial.pose_px):
            strength = stated_px / min(size_px, FAR_PX)
            yield Hypothesis("image-tracks", of, data=data, strength=strength)
            return
    hidden = trial.hidden_count(stated.camera)
    if hidden > HIDDEN * len(trial.known):
        remedy = ": check the axes of places_m and camera.pose"
        if not tracks.has_known_pose:
            # A pose that is found shows mirrored images of the body from behind.
            tried = trial.without(trial.mistakes(), trial.distance_px)
            most = HIDDEN * len(trial.known)
            seen = [each for each in tried if trial.hidden_count(each[1].camera) <= most]
            remedy = f", but sees them if {_alternatives(seen)}" if seen else remedy
        data = {"hidden": hidden, "count": len(trial.known), "remedy": remedy}
        strength = hidden / (HIDDEN * len(trial.known))
        yield Hypothesis("image-tracks/hidden", of, data=data, strength=strength)
        return
    unlike = trial.unlike(stated)
    if experiment.is_static or not unlike > UNLIKE:
        return
    tried = trial.without([*trial.mistakes(), *trial.wrong_times()], trial.unlike)
    most = min(unlike / ALIKE, WELL_ALIKE)
    if not trial.declared.has_known_pose:
        most = min(unlike / ALIKE_FOUND, WELL_ALIKE_FOUND)
    alike = [each for each in tried if each[0] < most]
    possible = [
        each
        for each in alike[:MOST_NEAR]
        if trial.distance_px(each[1]) <= max(2 * stated_px, usual_px)
    ]
    if possible:
        least = possible[0][0]
        similar = [each for each in possible if each[0] <= SIMILAR * least + ALIKE_ENOUGH]
        # A correction that leaves images outside of the experiment explains less.
        similar.sort(key=lambda each: -trial.image_count(each[1]))
        # Neighbouring delays are no alternatives.
        moved = [each for each in similar if (each[1].t_s != stated.t_s).any()]
        similar = [each for each in similar if each not in moved[1:]]
        ratio = unlike / max(least, ALIKE_ENOUGH)
        named = {"unlike": unlike, "mistake": _alternatives(similar), "nearer": ratio}
        yield Hypothesis("image-tracks/motion", of, data=named, strength=ratio)


def _alternatives(likely: Sequence[_Tried]) -> str:
    return ", or if ".join(mistake for _, _, mistake in likely[:MOST_NAMED])


class _Trial:
    """Comparison of the tracks of one camera with the body carried by its grasp."""

    def __init__(self, experiment: Experiment, tracks: ImageTracks) -> None:
        self.experiment, self.declared, self.body = experiment, tracks, experiment.body
        self.tracks = tracks
        self.is_seen = tracks.is_seen
        self.within = self._within(tracks.sample_times_s)
        self.samples = _spread(self.within, MOST_IMAGES)
        self.stated = {name: place for name, (place, _) in stated_places(experiment).items()}
        self.rest = LocatedBody(self.body.nodes_m, self.body)
        self.known = {
            k: self.rest.weights_at_nearest_point(self.stated[name])
            for k, name in enumerate(tracks.names)
            if name in self.stated
        }
        held = [grasp.nodes for grasp in experiment.grasps]
        self.reach_m = np.zeros(len(self.body.nodes_m))
        if held:
            nodes_m = self.body.nodes_m
            self.reach_m = KDTree(nodes_m[np.concatenate(held)]).query(nodes_m)[0]
        self.length_m = max(float(self.reach_m.max()), 1e-12)

    def _within(self, t_s: Array) -> Index:
        first_s, last_s = self.experiment.t_s[[0, -1]]
        is_within = (t_s >= first_s - 1e-9) & (t_s <= last_s + 1e-9)
        return np.flatnonzero(is_within & self.is_seen.any(axis=1))

    @cached_property
    def _carried_m(self) -> Array:
        """Nodes (s, n, 3) of the rigid body in the compared images."""
        return self._rigid_m(self.tracks.sample_times_s[self.samples])

    def _rigid_m(self, t_s: Array) -> Array:
        return self.experiment.rigid_positions(np.clip(t_s, *self.experiment.t_s[[0, -1]]))

    def _sagging_m(self, sag: float) -> Array:
        """Nodes (s, n, 3) of the body whose end sags by a share of its length from the grasp."""
        down = -self.experiment.upward_direction
        shape = sag * self.reach_m**2 / self.length_m
        return self._carried_m + shape[:, None] * down

    def size_px(self, camera: Camera) -> float:
        """Return the size in the first image; infinite if a part is not in front of the camera."""
        own = _in_camera(camera, self.tracks.sample_times_s[self.samples[:1]], self._carried_m[:1])
        if (own[..., 2] <= 0).any():
            return np.inf
        return float(np.linalg.norm(np.ptp(camera.undistorted_pixels(own[0]), axis=0)))

    @property
    def pose_px(self) -> float:
        """Distance of the tracks by a standard deviation of the pose of the camera [pixels]."""
        sigma, camera = self.tracks.pose_sigma, self.tracks.camera
        at = self.tracks.sample_times_s[self.samples[:1]]
        away_m = _in_camera(camera, at, self._carried_m[:1])[0, :, 2].mean()
        turn_rad = np.deg2rad(sigma.turn_deg)
        shift_rad = sigma.shift_m / max(away_m, self.length_m)
        # Both coordinates of a pixel.
        return float(np.sqrt(2) * camera.require_matrix()[0, 0] * np.hypot(turn_rad, shift_rad))

    # Places -----------------------------------------------------------------------------------

    def _attached(
        self, described: ImageTracks, sample: int, shape_m: Array
    ) -> dict[int, tuple[Index, Array, float]]:
        """Return nodes, weights and the angle of the miss of each point whose pixel has a ray."""
        camera, surface = described.camera, self.body.mesh.surface
        found: dict[int, tuple[Index, Array, float]] = {
            k: (*self.known[k], 0.0)
            for k in np.flatnonzero(self.is_seen[sample]).tolist()
            if k in self.known
        }
        free = [k for k in np.flatnonzero(self.is_seen[sample]).tolist() if k not in found]
        if not free:
            return found
        try:
            rays = camera.points_at_unit_depth(np.asarray(described.pixels)[sample, free])
        except ValueError:
            return found
        rotations, translations = camera.pose_at(described.sample_times_s[[sample]])
        origins = np.tile(translations[0], (len(free), 1))
        faces, shares, missed = points_on_surface(origins, rays @ rotations[0].T, shape_m, surface)
        attached = zip(surface[faces], shares, missed.tolist(), strict=True)
        return found | dict(zip(free, attached, strict=True))

    def distance_px(self, described: ImageTracks) -> float:
        """Return the median distance of the tracks from the body, with the best sag."""
        return min(self._distance_px(described, self._sagging_m(sag)) for sag in SAGS)

    def _distance_px(self, described: ImageTracks, shapes_m: Array) -> float:
        camera, seen = described.camera, self.is_seen[self.samples]
        pixels = np.asarray(described.pixels)[self.samples]
        focal_px = camera.require_matrix()[0, 0]
        places: dict[int, tuple[Index, Array, float]] = {}
        for k, sample in enumerate(self.samples.tolist()):
            if set(np.flatnonzero(seen[k]).tolist()) - places.keys():
                new = self._attached(described, sample, shapes_m[k])
                places = new | places
        t_s = self.tracks.sample_times_s[self.samples]
        distances = []
        for k in np.flatnonzero(seen.any(axis=0)).tolist():
            off = np.full(len(seen), FAR_PX)
            if k in places:
                nodes, weights, missed = places[k]
                points = np.einsum("c,sci->si", weights, shapes_m[:, nodes])
                shown = _projected(camera, t_s, points[:, None])[:, 0]
                off = np.linalg.norm(shown - pixels[:, k], axis=1) + focal_px * missed
                off = np.where(np.isfinite(off), np.minimum(off, FAR_PX), FAR_PX)
            distances.append(off[seen[:, k]])
        return float(np.median(np.concatenate(distances)))

    def hidden_count(self, camera: Camera) -> int:
        """Count points with known places on faces that look away in all compared images."""
        surface = self.body.mesh.surface
        corners = self.body.nodes_m[surface]
        t_s = self.tracks.sample_times_s[self.samples]
        eyes_m = camera.pose_at(t_s)[1]
        count = 0
        for nodes, weights in self.known.values():
            place = weights @ self.body.nodes_m[nodes]
            away = np.linalg.norm(nearest_points_of_triangles(place, corners) - place, axis=1)
            # All faces at an edge or corner.
            faces = np.flatnonzero(away <= away.min() + 1e-6 * self.length_m)
            at = self._carried_m[:, surface[faces]]
            count += bool((facing(at, at.mean(axis=2), eyes_m[:, None]) < TURNED_AWAY).all())
        return count

    # Motion -----------------------------------------------------------------------------------

    def unlike(self, described: ImageTracks) -> float:
        """Return the relative deviation of motions near the grasp from its own; NaN without any."""
        within = self._within(described.sample_times_s)
        if len(within) < COVERED * len(self.within):
            return np.nan
        samples = _spread(within, MOST_IN_MOTION)
        t_s = described.sample_times_s[samples]
        first = int(samples[0])
        places = self._attached(described, first, self._rigid_m(t_s[:1])[0])
        reach = {k: float(w @ self.reach_m[n]) / self.length_m for k, (n, w, _) in places.items()}
        near = sorted((k for k in reach if reach[k] <= NEAR), key=lambda k: reach[k])[:MOST_NEAR]
        if not near:
            return np.nan
        nodes_m = self._rigid_m(t_s)
        points = np.stack(
            [np.einsum("c,sci->si", places[k][1], nodes_m[:, places[k][0]]) for k in near], axis=1
        )
        shown = _projected(described.camera, t_s, points)
        measured = np.asarray(described.pixels)[samples][:, near]
        is_used = np.isfinite(shown + measured).all(axis=2, keepdims=True)
        if not is_used.any(axis=0).all():
            return np.nan
        shown, measured = (np.where(is_used, values, np.nan) for values in (shown, measured))
        moved = shown - np.nanmean(shown, axis=0)
        off = measured - np.nanmean(measured, axis=0) - moved
        motion_px = float(np.sqrt(np.nanmean(moved**2)))
        if motion_px < MOVING * self.tracks.sigma_px:
            return np.nan
        return float(np.sqrt(np.median(np.nanmean(off**2, axis=(0, 2))))) / motion_px

    # Corrections ------------------------------------------------------------------------------

    def without(
        self, rows: Iterable[Doubt], measure: Callable[[ImageTracks], float]
    ) -> list[_Tried]:
        """Return measure, tracks and clause without each mistake, the least measure first."""
        place = self.experiment.readings.index(self.declared)
        found = [each for row in rows if (each := row.hypothesis(self.experiment))]
        others = [(each.corrected.readings[place], each.data["mistake"]) for each in found]
        tried = [(measure(other), other, mistake) for other, mistake in others]
        return sorted(tried, key=lambda each: np.nan_to_num(each[0], nan=np.inf))

    def mistakes(self) -> Iterator[Doubt]:
        """Yield mistakes of images and, if it is stated, of the pose."""
        yield from self._wrong_images()
        if self.declared.has_known_pose:
            yield from self._wrong_poses()

    def _mistake(self, mistake: str, has_pose: bool = True, **changes: Any) -> Doubt:
        """Without a pose, the pose is fitted again."""

        def without(_: Measurement) -> ImageTracks:
            other = replace(self.tracks, **changes)
            return other if has_pose else self.with_fitted_pose(other)

        return measurement_mistake("image-tracks", self.declared, without, mistake=mistake)

    def with_fitted_pose(self, described: ImageTracks) -> ImageTracks:
        if described.has_known_pose:
            return described
        found = poses_of_tracks(described, self.stated, self.rest, self._rigid_m)
        fitted = [
            replace(described, camera=replace(described.camera, pose=pose))
            for pose, error in found
            if error <= SIMILAR_POSES * found[0][1]
        ]
        if len(fitted) == 1:
            return fitted[0]
        return min(fitted, key=lambda each: float(np.nan_to_num(self.unlike(each), nan=np.inf)))

    def _wrong_images(self) -> Iterator[Doubt]:
        stated = self.tracks
        matrix = stated.camera.require_matrix()
        width, height = stated.camera.size_px or (2 * matrix[0, 2] + 1, 2 * matrix[1, 2] + 1)
        u, v = np.moveaxis(np.asarray(stated.pixels), -1, 0)
        flips = (
            (v, u, "u and v are exchanged (row, column): exchange the columns"),
            (u, height - 1 - v, f"v points upwards: use {height - 1:g} - v"),
            (width - 1 - u, v, f"u points to the left (a mirrored video): use {width - 1:g} - u"),
            (
                width - 1 - u,
                height - 1 - v,
                "the video is turned by 180 degrees: turn it, or the pose",
            ),
            (v, height - 1 - u, "the video is turned by 90 degrees clockwise: turn it back"),
            (width - 1 - v, u, "the video is turned by 90 degrees anticlockwise: turn it back"),
        )
        for new_u, new_v, mistake in flips:
            yield self._mistake(mistake, has_pose=False, pixels=np.stack([new_u, new_v], axis=-1))

    def wrong_pixels(self) -> Iterator[Doubt]:
        """Errors of the pose resemble pixels that are scaled, shifted or of another unit."""
        camera, stated = self.tracks.camera, np.asarray(self.tracks.pixels)
        matrix = camera.require_matrix()
        for scale in SCALES:
            mistake = (
                f"the images have {scale:.3g} times the resolution of the calibration: multiply the "
                "first two rows of the matrix by this"
            )
            yield self._mistake(mistake, pixels=stated / scale)
        if camera.size_px is not None:
            mistake = "the pixels are shares of the image: multiply them by its size"
            yield self._mistake(mistake, pixels=stated * camera.size_px)
        pixels = stated * np.diag(matrix)[:2] + matrix[:2, 2]
        mistake = "they are divided by the focal length: state pixels of the original images"
        yield self._mistake(mistake, pixels=pixels)
        exchanged = matrix.copy()
        exchanged[[0, 1], 2] = matrix[[1, 0], 2]
        mistake = "the coordinates cx and cy of the principal point are exchanged"
        yield self._mistake(mistake, camera=replace(camera, matrix=exchanged))
        by_px = self._shift_px()
        if np.isfinite(by_px).all():
            mistake = (
                f"all pixels are shifted by ({by_px[0]:.0f}, {by_px[1]:.0f}): the video is cropped, "
                "or the camera is turned"
            )
            yield self._mistake(mistake, pixels=stated + by_px)

    def _shift_px(self) -> Array:
        """Return the shift (2,) that puts the middle of the tracks on that of the body, or NaN."""
        sample = int(self.samples[0])
        known = [k for k in self.known if self.is_seen[sample, k]]
        shape_m = self._carried_m[0]
        points = shape_m
        if known:
            points = np.array([self.known[k][1] @ shape_m[self.known[k][0]] for k in known])
        t_s = self.tracks.sample_times_s[[sample]]
        shown = _projected(self.tracks.camera, t_s, points[None])[0]
        tracked = np.asarray(self.tracks.pixels)[sample, known or self.is_seen[sample]]
        return np.asarray(_middle(shown) - _middle(tracked))

    def reversed_order(self) -> Iterator[Doubt]:
        """Yield images in reverse order, if nearly all points are seen."""
        within = self.within
        if self.is_seen[within].mean() >= MOSTLY_SEEN:
            pixels = np.array(self.tracks.pixels)
            pixels[within] = pixels[within[::-1]]
            mistake = "the images are in reverse order: sort them by time"
            yield self._mistake(mistake, pixels=pixels)

    def image_count(self, described: ImageTracks) -> int:
        return len(self._within(described.sample_times_s))

    def wrong_times(self) -> Iterator[Doubt]:
        t_s = self.tracks.sample_times_s
        yield from self.reversed_order()
        for rate in RATES:
            mistake = f"their rate is {rate:.3g} times the stated one: correct frame_rate_hz or t_s"
            other_s = t_s[0] + (t_s - t_s[0]) / rate
            yield self._mistake(mistake, t_s=other_s)
        for delay_s in DELAYS_S.tolist():
            mistake = (
                f"they were taken about {1e3 * abs(delay_s):.0f} ms "
                f"{'earlier' if delay_s < 0 else 'later'} than stated: correct start_s or t_s"
            )
            yield self._mistake(mistake, t_s=t_s + delay_s)

    def _wrong_poses(self) -> Iterator[Doubt]:
        pose = self.tracks.camera.pose

        def other(rotation: Array, position: Array, mistake: str) -> Doubt:
            changed = np.eye(4)
            changed[:3, :3], changed[:3, 3] = rotation, position
            return self._mistake(mistake, camera=replace(self.tracks.camera, pose=changed))

        turn, position = pose[:3, :3], pose[:3, 3]
        mistake = "the pose is from the world to the camera: invert it"
        yield other(turn.T, -turn.T @ position, mistake)
        yield other(turn.T, position, "its rotation is transposed")
        mistake = "the position is the translation of the inverse: use -R t"
        yield other(turn, -turn @ position, mistake)
        for words, frame in FRAMES.items():
            mistake = f"the pose is that of a frame with {words}"
            yield other(turn @ frame, position, mistake)
        mistake = "the pose is in a world whose y axis points upwards, that of the grasp is not"
        yield other(FROM_Y_UP @ turn, FROM_Y_UP @ position, mistake)
        for factor, unit in ((1e-3, "millimetres"), (1e-2, "centimetres")):
            mistake = f"the position of the camera is in {unit}: state it in metres"
            yield other(turn, factor * position, mistake)


def _spread(samples: Index, most: int) -> Index:
    if not len(samples):
        return samples
    return samples[np.unique(np.linspace(0, len(samples) - 1, most).astype(int))]


def _middle(pixels: Array) -> Array:
    """Return the middle (2,) of the extent of some pixels (P, 2)."""
    return np.asarray(0.5 * (pixels.min(axis=0) + pixels.max(axis=0)))


def _in_camera(camera: Camera, t_s: Array, points_m: Array) -> Array:
    """Return points (s, P, 3) [m] in the frame of the camera at times (s,)."""
    rotations, translations = camera.pose_at(t_s)
    return np.einsum("sji,spj->spi", rotations, points_m - translations[:, None])


def _projected(camera: Camera, t_s: Array, points_m: Array) -> Array:
    """Return pixels (s, P, 2); NaN for points that are not in front of the camera."""
    own = _in_camera(camera, t_s, points_m)
    pixels = np.full((*own.shape[:2], 2), np.nan)
    front = own[..., 2] > 0
    if front.any():
        pixels[front] = camera.distorted_pixels(own[front])
    return pixels
