"""Places of tracked points on the body, poses of cameras, and which points are visible.

Places and poses that are not stated are found with a shape of the body at the first image: a pose
from the points with a stated place, a place from the ray of its pixel. Cameras share the places of
points with the same name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...common.array_types import Array, Index
from ...errors import InputError, listed
from ...fem.body import Body
from ...program.correspondences import Correspondences
from ...program.markers.association import MarkerAssociation
from ...recording.experiment import Experiment
from ...recording.obstacle import Obstacle
from ...recording.placement import (
    LocatedBody,
    barycentric_in_triangles,
    nearest_points_of_triangles,
)
from .camera_images import POSE_UNKNOWNS, ImageCorrespondences
from .rays import (
    FEWEST_POINTS,
    cross,
    facing,
    is_behind,
    is_occluded,
    points_on_surface,
    poses_from_points,
)
from .tracks import ImageTracks, stated_places

# Factor between the errors of two poses that may both be right.
SIMILAR_POSES = 2.0
# Sine of the angle by which a ray may miss the body if the pose of the camera is exact, and in
# standard deviations of the pose.
LEAST_MISS = 5e-3
MISSES = 3.0
# Cosine between normal and view below which a point that was hidden becomes visible, and below which
# a visible one becomes hidden: trackers follow points at grazing angles.
TURNS_VISIBLE = 0.05
TURNS_HIDDEN = -0.1
# Cosine of the angle between two faces up to which a place may move freely from one to the other:
# beyond it, the edge is a crease.
SMOOTH = 0.7
# Creases that an unknown place may cross: its first ray may meet the wrong side of an edge, because
# the first shape is that of the guess.
MOST_CREASES = 10
# Distance of a stated place from the body over its diagonal from which on it is a mistake.
FAR_OFF = 0.25
# Iterations that align a camera with the first image.
ALIGNMENT_EVALUATIONS = 60
# Step of the errors of a pose in standard deviations, for differences.
POSE_STEP = 1e-6
# Share of the visible samples up to which changes are ignored.
SETTLED = 0.01
# Distance in mean edges in front of a point at which another part of the surface hides it.
OCCLUSION_EDGES = 0.3

# Distance in mean edges by which another face must be nearer to a place than its own.
SAME_FACE = 1e-3

ShapesAt = Callable[[Array], Array]


def find_places(
    experiment: Experiment, shapes_at: ShapesAt
) -> tuple[dict[str, Array], dict[str, float], dict[str, Array], dict[str, Array]]:
    """Return the poses of the cameras and the places of the points of an experiment.

    Where rays of the first images miss the body, or points with a stated place appear elsewhere, the
    pose is off: places are found with the errors of the pose that explain these images best.

    Parameters
    ----------
    shapes_at : callable
        ``shapes_at(t_s)``, nodes (k, n, 3) of the body at times (k,) [m].

    Returns
    -------
    poses : mapping of str to (4, 4) array
        Pose of each camera by its name, in the frame that carries it.
    mirrored : mapping of str to float
        Of cameras whose pose was found: the RMS of the second best pose over that of the best one.
    places_m : mapping of str to (3,) array
        Place of each point on the undeformed body; NaN if no ray meets the body.
    errors : mapping of str to (6,) array
        Errors of the pose of each camera, with which its points are placed [rad, m].

    Raises
    ------
    InputError
        If the pose of a camera is unknown, and fewer than four points of it have a stated place; if a
        stated place is far from the body; or if a place on a rod is not stated.
    """
    cameras = [each for each in experiment.readings if isinstance(each, ImageTracks)]
    rest = LocatedBody(experiment.body.nodes_m, experiment.body)
    stated = {name: place for name, (place, _) in stated_places(experiment).items()}
    _require_on_body(stated, rest)
    if not experiment.body.is_solid:
        _require_stated(cameras, stated)
    poses, mirrored = {}, {}
    for tracks in cameras:
        poses[tracks.name] = tracks.camera.pose
        if not tracks.has_known_pose and tracks.pixels is not None:
            found = poses_of_tracks(tracks, stated, rest, shapes_at)
            poses[tracks.name] = found[0][0]
            mirrored[tracks.name] = found[1][1] / found[0][1] if len(found) > 1 else np.inf
    places = dict(stated)
    errors = {}
    for tracks in cameras:
        errors[tracks.name] = np.zeros(6)
        if tracks.is_seen.any() and tracks.pixels is not None:
            images = _FirstImages(experiment, tracks, poses[tracks.name], shapes_at, places)
            errors[tracks.name] = images.pose_errors()
            places |= images.places_m(errors[tracks.name])
        for name in tracks.names:
            places.setdefault(name, np.full(3, np.nan))
    return poses, mirrored, places, errors


def _require_stated(cameras: Sequence[ImageTracks], stated: Mapping[str, Array]) -> None:
    """A ray hardly ever meets the centreline of a rod."""
    for tracks in cameras:
        unknown = [name for name in tracks.names if name not in stated]
        if unknown:
            raise InputError(
                f"no place is stated of {listed(unknown)} in '{tracks.name}'; expected s_m or places_m "
                "of all points on a rod, and their error along it, place_sigma_m"
            )


def _require_on_body(places: Mapping[str, Array], rest: LocatedBody) -> None:
    low_m, high_m = rest.body.nodes_m.min(axis=0), rest.body.nodes_m.max(axis=0)
    size_m = float(np.linalg.norm(high_m - low_m))
    for name, place in places.items():
        away_m = rest.weights_at_point(place)[2]
        if away_m > FAR_OFF * size_m:
            raise InputError(
                f"the place of '{name}' is {away_m:.3g} m from the undeformed body, which extends "
                f"from {np.round(low_m, 4).tolist()} to {np.round(high_m, 4).tolist()}; expected "
                "places_m on the undeformed body, in metres"
            )


def poses_of_tracks(
    tracks: ImageTracks, stated: Mapping[str, Array], rest: LocatedBody, shapes_at: ShapesAt
) -> list[tuple[Array, float]]:
    """Return the possible poses of a camera in the first image with the most known points, best
    first, and their errors at unit depth.
    """
    known = np.array([name in stated for name in tracks.names])
    counts = (tracks.is_seen & known).sum(axis=1)
    sample = int(counts.argmax())
    if counts[sample] < FEWEST_POINTS:
        raise InputError(
            f"the pose of the camera '{tracks.name}' is unknown, and {counts[sample]} of its points "
            f"have a stated place in one image; expected at least {FEWEST_POINTS} points with "
            "places_m, or the pose"
        )
    assert tracks.pixels is not None
    used = np.flatnonzero(tracks.is_seen[sample] & known)
    nodes_m = shapes_at(tracks.sample_times_s[[sample]])[0]
    points = [_moved(stated[tracks.names[k]], rest, nodes_m) for k in used.tolist()]
    rays = tracks.camera.points_at_unit_depth(np.asarray(tracks.pixels)[sample, used])
    found = poses_from_points(np.array(points), rays)
    if not found:
        raise InputError(
            f"no pose of the camera '{tracks.name}' shows the points with places_m where they "
            "appear; expected their places on the undeformed body, and pixels of this camera"
        )
    if tracks.camera.poses is None:
        return found
    rotations, translations = tracks.camera.poses.at(tracks.sample_times_s[[sample]])
    carrier = np.eye(4)
    carrier[:3, :3], carrier[:3, 3] = rotations[0], translations[0]
    return [(np.linalg.inv(carrier) @ pose, error) for pose, error in found]


def _moved(place_m: Array, rest: LocatedBody, nodes_m: Array) -> Array:
    """Return where a place (3,) of the undeformed body is in a shape (n, 3) [m]."""
    nodes, weights = rest.weights_at_nearest_point(place_m)
    return np.asarray(weights @ nodes_m[nodes])


class _FirstImages:
    """The first image of each point of a camera: its ray, and the shape of the body in it."""

    def __init__(
        self,
        experiment: Experiment,
        tracks: ImageTracks,
        pose: Array,
        shapes_at: ShapesAt,
        places_m: Mapping[str, Array],
    ) -> None:
        self.tracks, self.body = tracks, experiment.body
        self.points = np.flatnonzero(tracks.is_seen.any(axis=0))
        firsts = tracks.is_seen.argmax(axis=0)[self.points]
        samples, self.shape_of = np.unique(firsts, return_inverse=True)
        t_s = tracks.sample_times_s[samples]
        self.shapes_m = shapes_at(t_s)
        camera = replace(tracks.camera, pose=pose)
        poses = camera.pose_at(t_s)
        self.rotations, self.translations = (each[self.shape_of] for each in poses)
        self.pixels = np.asarray(tracks.pixels)[firsts, self.points]
        unknowns = tracks.camera_unknowns(experiment)
        self.sigmas = np.array([unknowns.get(name, 0.0) for name in POSE_UNKNOWNS])
        rest = LocatedBody(self.body.nodes_m, self.body)
        # Where the points are whose places are known, NaN for the others.
        self.known_m = np.full((len(self.points), 3), np.nan)
        for k, point in enumerate(self.points.tolist()):
            place = places_m.get(tracks.names[point])
            if place is not None and np.isfinite(place).all():
                self.known_m[k] = _moved(place, rest, self.shapes_m[self.shape_of[k]])
        self.is_free = np.isnan(self.known_m[:, 0])
        self.rays = np.zeros((len(self.points), 3))
        if self.is_free.any():
            self.rays[self.is_free] = camera.points_at_unit_depth(self.pixels[self.is_free])
        self.is_left_out = np.zeros(len(self.points), dtype=bool)
        # Rays that miss the body by more than the pose of the camera may be off.
        _, at_m, missed = self._on_surface(np.zeros(6))
        away_m = np.linalg.norm(at_m - self.translations, axis=1)
        sigma = tracks.pose_sigma
        allowed = max(LEAST_MISS, MISSES * np.deg2rad(sigma.turn_deg))
        allowed = allowed + MISSES * sigma.shift_m / np.maximum(away_m, 1e-9)
        self.is_left_out = self.is_free & (missed > allowed)

    def _on_surface(self, errors: Array) -> tuple[Array, Array, Array]:
        """Return where the rays of the points without a place meet the body, on the undeformed body
        and in their images (P, 3) [m], and by which sines (P,) they miss it.
        """
        at_m, missed = self.known_m.copy(), np.zeros(len(self.points))
        places_m = np.full_like(at_m, np.nan)
        surface = self.body.mesh.surface
        turn = Rotation.from_rotvec(errors[:3]).as_matrix()
        rotations = self.rotations @ turn.T
        origins = self.translations - rotations @ errors[3:]
        directions = np.einsum("pij,pj->pi", rotations, self.rays)
        for k, nodes_m in enumerate(self.shapes_m):
            used = np.flatnonzero(self.is_free & ~self.is_left_out & (self.shape_of == k))
            if len(used):
                faces, shares, missed[used] = points_on_surface(
                    origins[used], directions[used], nodes_m, surface
                )
                for points, nodes in ((at_m, nodes_m), (places_m, self.body.nodes_m)):
                    points[used] = np.einsum("pc,pci->pi", shares, nodes[surface[faces]])
        return places_m, at_m, missed

    def places_m(self, errors: Array) -> dict[str, Array]:
        """Return the places that were not known, with errors (6,) of the pose."""
        places_m = self._on_surface(errors)[0]
        names = [str(self.tracks.names[k]) for k in self.points.tolist()]
        return {names[k]: places_m[k] for k in np.flatnonzero(self.is_free).tolist()}

    def pose_errors(self) -> Array:
        """Huber's loss is no help: a pose that is off by many pixels is beyond its threshold."""
        estimated = np.flatnonzero(self.sigmas)
        errors = np.zeros(6)
        used = ~self.is_left_out
        is_exact = self.is_free.all() and not self._on_surface(errors)[2].any()
        if not len(estimated) or is_exact or not used.any():
            return errors

        def errors_of(pose: Array) -> Array:
            errors[estimated] = pose * self.sigmas[estimated]
            return errors

        def off(at_m: Array, pose: Array) -> Array:
            turn, shift = np.split(errors_of(pose), 2)
            own = np.einsum(
                "pji,pj->pi", self.rotations[used], at_m[used] - self.translations[used]
            )
            own = own @ Rotation.from_rotvec(turn).as_matrix().T + shift
            own[:, 2] = np.maximum(own[:, 2], 1e-3)
            shown = self.tracks.camera.distorted_pixels(own)
            return (shown - self.pixels[used]) / self.tracks.sigma_px

        def differences(pose: Array) -> Array:
            _, at_m, missed = self._on_surface(errors_of(pose))
            is_met = (self.is_free & (missed == 0))[used]
            return np.concatenate([np.where(is_met[:, None], 0, off(at_m, pose)).ravel(), pose])

        def slopes(pose: Array) -> Array:
            _, at_m, missed = self._on_surface(errors_of(pose))
            stated = off(at_m, pose)
            steps = POSE_STEP * np.eye(len(pose))
            by_pose = [(off(at_m, pose + step) - stated) / POSE_STEP for step in steps]
            changes = np.stack(by_pose, axis=-1)
            # The nearest point of an outline moves along it.
            away = stated / np.maximum(np.linalg.norm(stated, axis=1, keepdims=True), 1e-30)
            free = self.is_free[used]
            across = np.einsum("pa,pb,pbk->pak", away[free], away[free], changes[free])
            changes[free] = across * (missed[used][free] > 0)[:, None, None]
            return np.concatenate([changes.reshape(-1, len(pose)), np.eye(len(pose))])

        fit = scipy.optimize.least_squares(
            differences,
            np.zeros(len(estimated)),
            cast(Any, slopes),
            loss="soft_l1",
            max_nfev=ALIGNMENT_EVALUATIONS,
        )
        return errors_of(fit.x).copy()


@dataclass(frozen=True, eq=False)
class TrackedPlaces(ImageCorrespondences):
    """Places of the points of one camera, its pose, and which points are compared."""

    is_labelled = True

    tracks: ImageTracks
    association: MarkerAssociation  # places of the points, which move on the surface
    faces: Index  # (N,): surface triangles of the places
    # (N, F): faces that an unknown place may enter across a crease, those that look at the cameras in
    # the first images of the point; none for stated places.
    enterable: NDArray[np.bool_]
    pose: Array  # (4, 4): pose of the camera in the frame that carries it
    # (S, 3, 3) and (S, 3): pose of the camera at each image, from its frame to the world.
    rotations: Array
    translations: Array
    is_placed: NDArray[np.bool_]  # (N,) of bool: points that are on the body
    is_visible: NDArray[np.bool_]  # (S, N) of bool: points that are not hidden
    # (N, k): indices in φ of the coordinates of the places; −1 for exact ones.
    coordinate_parameters: Index
    # (p,): indices in φ of the errors of the pose that are estimated, rotation first.
    pose_parameters: Index
    # Of a pose that was found: the error of the second best pose over that of the best one.
    mirror_ratio: float = np.inf
    # (p,): their values with which the first image fits best, in prior standard deviations.
    start_pose: Array = field(default_factory=lambda: np.zeros(0))
    obstacles: Sequence[Obstacle] = ()  # obstacles, which may hide points
    crossings: Index | int = 0  # (N,): how many creases each place has crossed
    # (N,): whether other cameras have the same place
    is_shared: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))

    @classmethod
    def from_shapes(
        cls,
        experiment: Experiment,
        tracks: ImageTracks,
        shapes_at: ShapesAt,
        coordinate_parameters: Index,
        pose_parameters: Index,
    ) -> TrackedPlaces:
        """Find places and pose with the shapes of the body, see `find_places`."""
        poses, mirrored, places_m, errors = find_places(experiment, shapes_at)
        body = experiment.body
        places = np.array([places_m[name] for name in tracks.names])
        is_placed = np.asarray(np.isfinite(places).all(axis=1))
        places[~is_placed] = body.nodes_m[body.mesh.surface[0, 0]]
        sigmas = np.where(is_placed, tracks.place_sigmas_m(experiment), 0.0)
        camera = replace(tracks.camera, pose=poses[tracks.name])
        rotations, translations = camera.pose_at(tracks.sample_times_s)
        shapes = shapes_at(tracks.sample_times_s)
        enterable = _enterable_faces(experiment, tracks.names, poses, shapes_at)
        faces = _nearest_faces(body, places, enterable)
        unknowns = tracks.camera_unknowns(experiment)
        found = dict(zip(POSE_UNKNOWNS, errors[tracks.name], strict=True))
        start_pose = np.array([found[n] / unknowns[n] for n in POSE_UNKNOWNS if n in unknowns])
        correspondences = cls(
            tracks,
            surface_association(body, places, sigmas, faces),
            faces,
            enterable,
            camera.pose,
            rotations,
            translations,
            is_placed,
            is_visible=np.ones(tracks.is_seen.shape, dtype=bool),
            coordinate_parameters=coordinate_parameters,
            pose_parameters=pose_parameters,
            start_pose=start_pose,
            mirror_ratio=mirrored.get(tracks.name, np.inf),
            obstacles=experiment.obstacles,
            is_shared=_are_shared(experiment, tracks),
        )
        return correspondences.with_visibility(shapes)

    @property
    def measured(self) -> ImageTracks:
        return self.tracks

    def with_start_values(self, phi: Array) -> Array:
        started = self._with_places(phi)
        started[self.pose_parameters] = self.start_pose
        return started

    def continued(self, phi: Array, previous: Correspondences) -> Array:
        assert isinstance(previous, TrackedPlaces)
        return phi if self.association is previous.association else self._with_places(phi)

    def _with_places(self, phi: Array) -> Array:
        changed = phi.copy()
        estimated = self.association.estimated
        changed[self.coordinate_parameters[estimated]] = self.association.centre_coordinates[
            estimated
        ]
        return changed

    def coordinates(self, phi: Array) -> Array:
        """Return the coordinates (N, k) of the places at φ (k,); zero for exact ones."""
        return np.append(phi, 0.0)[self.coordinate_parameters]

    def places_m(self, phi: Array) -> Array:
        """Return the places (N, 3) on the undeformed body at φ (k,) [m]."""
        return self.association.places_m(self.coordinates(phi))

    # Visibility -------------------------------------------------------------------------------

    @cached_property
    def _shares(self) -> Array:
        """Barycentric coordinates (N, 3) in the faces of the places at the centre of the association."""
        corners = self._corners[self.faces]
        shares = barycentric_in_triangles(self.association.centre_places_m, corners).clip(0.0)
        return shares / shares.sum(axis=1, keepdims=True)

    @cached_property
    def _corners(self) -> Array:
        """Corners (F, 3, 3) of the surface triangles of the undeformed body [m]."""
        body = self.association.body
        return body.nodes_m[body.mesh.surface]

    def with_visibility(self, shapes_m: Array, *, is_settled: bool = True) -> TrackedPlaces:
        """Return the correspondences with the points that are visible in the first s shapes (s, n,
        3) [m]; self if `is_settled` and hardly any sample changes, so that the loss does not jump
        for ever.

        A point is hidden if its face looks away from the camera, or if another part of the body or
        an obstacle is in front of it; no point of a rod is.
        """
        count = len(shapes_m)
        if not (count and self.association.body.is_solid):
            return self
        before, seen = self.is_visible[:count], self.tracks.is_seen[:count]
        visible = self.visible_points(shapes_m, self.translations[:count], before, seen)
        changes = np.sum(visible != before)
        if is_settled and changes <= SETTLED * np.sum(before & seen):
            return self
        return replace(self, is_visible=np.concatenate([visible, self.is_visible[count:]]))

    def visible_points(
        self, shapes_m: Array, eyes_m: Array, before: NDArray[np.bool_], seen: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Return which points (s, N) are visible in shapes (s, n, 3) [m] from cameras at (s, 3) [m]
        if those of `before` were; points without pixels in `seen` may be hidden by others.
        """
        body = self.association.body
        triangles = shapes_m[:, body.mesh.surface]
        corners = triangles[:, self.faces]
        points = np.einsum("nc,snci->sni", self._shares, corners)
        cosines = facing(corners, points, eyes_m[:, None])
        visible = np.where(before, cosines > TURNS_HIDDEN, cosines > TURNS_VISIBLE)
        margin_m = OCCLUSION_EDGES * self._mean_edge_m
        used = np.flatnonzero((visible & seen).any(axis=0) & self.is_placed)
        hidden = is_occluded(points[:, used], eyes_m, triangles, margin_m)
        for k in range(len(shapes_m) if self.obstacles else 0):
            eye = np.tile(eyes_m[k], (len(used), 1))
            for obstacle in self.obstacles:
                distance = obstacle_distance(obstacle, body, shapes_m[k])
                hidden[k] |= is_behind(points[k, used], eye, distance, margin_m)
        visible[:, used] &= ~hidden
        return visible

    @cached_property
    def _mean_edge_m(self) -> float:
        return float(self.association.body.mesh.quality().edge_mean_m)

    # Following --------------------------------------------------------------------------------

    def followed(self, phi: Array, shapes_m: Array) -> TrackedPlaces:
        """Return the correspondences at other estimates φ (k,) with the first s shapes (s, n, 3)
        [m]; self if nothing has changed.
        """
        if not self.association.body.is_solid:
            moved, _ = self.association.follow_estimates(self.coordinates(phi))
            return self if moved is self.association else replace(self, association=moved)
        other = self._with_faces_of(self.places_m(phi), shapes_m)
        return other.with_visibility(shapes_m, is_settled=other is self)

    def _with_faces_of(self, points_m: Array, shapes_m: Array) -> TrackedPlaces:
        """Return self if each place is on its face, or cannot leave it."""
        association = self.association
        corners = self._corners
        least = barycentric_in_triangles(points_m, corners[self.faces]).min(axis=1)
        estimated = np.isin(np.arange(len(points_m)), association.estimated)
        normals = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        centres = np.where(estimated[:, None], points_m, association.centre_places_m)
        faces = self.faces.copy()
        crossings = np.broadcast_to(self.crossings, faces.shape).copy()
        near_m = SAME_FACE * self._mean_edge_m
        for m in np.flatnonzero(estimated & (least < 0)).tolist():
            point, own = points_m[m], int(faces[m])
            nearest = nearest_points_of_triangles(point, corners)
            away = np.linalg.norm(nearest - point, axis=1)
            is_smooth = normals @ normals[own] > SMOOTH
            face = int(np.where(is_smooth, away, np.inf).argmin())
            if away[face] > near_m:
                may_enter = self.enterable[m] & ~is_smooth & (crossings[m] < MOST_CREASES)
                beside = may_enter & (np.linalg.norm(nearest - nearest[face], axis=1) < near_m)
                entered, place = self._seen_at(m, point, shapes_m)
                if entered >= 0 and may_enter[entered]:
                    faces[m], centres[m] = entered, place
                elif beside.any():
                    faces[m] = int(beside.argmax())
                    centres[m] = nearest[faces[m]]
                if faces[m] != own:
                    crossings[m] += 1
                    continue
            if away[own] > away[face] + near_m:
                faces[m] = face
                off = nearest[face] - point
                # Beyond the end of the smooth part, the place stays in the plane of its last face.
                along = off - normals[face] * (off @ normals[face])
                centres[m] = nearest[face] - along
        if (faces == self.faces).all():
            return self
        moved = _on_faces(association, centres, faces, np.flatnonzero(faces != self.faces))
        return replace(self, association=moved, faces=faces, crossings=crossings)

    def _seen_at(self, m: int, point_m: Array, shapes_m: Array) -> tuple[int, Array]:
        """Return the face and place of the undeformed body (3,) that the camera sees where a point
        (3,) [m] in the plane of the face of place m appears in its first image, so that a place does
        not appear elsewhere when it crosses a crease; −1 if it sees no part of the body there, or
        other cameras have the same place.
        """
        first = int(self.tracks.is_seen[:, m].argmax())
        if self.is_shared[m] or first >= len(shapes_m):
            return -1, point_m
        surface = self.association.body.mesh.surface
        corners = self._corners[self.faces[m]]
        # Barycentric coordinates of points outside of the triangle, too.
        b, c = np.linalg.lstsq((corners[1:] - corners[0]).T, point_m - corners[0])[0]
        at_m = np.array([1 - b - c, b, c]) @ shapes_m[first][surface[self.faces[m]]]
        eye_m = self.translations[first]
        faces, shares, missed = points_on_surface(
            eye_m[None], (at_m - eye_m)[None], shapes_m[first], surface
        )
        if missed[0]:
            return -1, point_m
        return int(faces[0]), shares[0] @ self._corners[faces[0]]


def _enterable_faces(
    experiment: Experiment, names: Sequence[str], poses: Mapping[str, Array], shapes_at: ShapesAt
) -> NDArray[np.bool_]:
    """Return the faces (N, F) that look at every camera; none for points with a stated place."""
    surface = experiment.body.mesh.surface
    stated = stated_places(experiment)
    faces = np.array([np.full(len(surface), name not in stated) for name in names])
    for tracks in experiment.readings:
        if not isinstance(tracks, ImageTracks) or tracks.pixels is None:
            continue
        camera = replace(tracks.camera, pose=poses[tracks.name])
        firsts = dict(zip(tracks.names, tracks.is_seen.argmax(axis=0).tolist(), strict=True))
        samples = sorted({firsts[name] for name in names if name in firsts})
        if not samples:  # another camera may have other points
            continue
        t_s = tracks.sample_times_s[samples]
        corners = shapes_at(t_s)[:, surface]
        eyes = camera.pose_at(t_s)[1]
        look = facing(corners, corners.mean(axis=2), eyes[:, None]) > 0
        for k, name in enumerate(names):
            if name in firsts:
                faces[k] &= look[samples.index(firsts[name])]
    return faces


def _are_shared(experiment: Experiment, tracks: ImageTracks) -> NDArray[np.bool_]:
    """Return which points (N,) other cameras have, too."""
    others = {
        name
        for other in experiment.readings
        if isinstance(other, ImageTracks) and other.name != tracks.name
        for name in other.names
    }
    return np.array([name in others for name in tracks.names])


def _nearest_faces(body: Body, places_m: Array, enterable: NDArray[np.bool_]) -> Index:
    """Return the triangle (N,) of each place; where several meet, one that looks at the cameras."""
    corners = body.nodes_m[body.mesh.surface]
    near_m = SAME_FACE * float(body.mesh.quality().edge_mean_m)
    faces = []
    for place, may_enter in zip(places_m, enterable, strict=True):
        away = np.linalg.norm(nearest_points_of_triangles(place, corners) - place, axis=1)
        is_near = away <= away.min() + near_m
        faces.append(
            int((is_near & may_enter if (is_near & may_enter).any() else is_near).argmax())
        )
    return np.array(faces, dtype=np.int64)


def _on_faces(
    association: MarkerAssociation, centres_m: Array, faces: Index, moved: Index
) -> MarkerAssociation:
    """Centre the association at places (N, 3) [m], with the faces (N,) of those `moved`."""
    mesh = association.body.mesh
    corners = association.body.nodes_m[mesh.surface[faces]]
    axes, cells = association.axes.copy(), association.cells.copy()
    for m in moved:
        axes[m] = np.linalg.qr((corners[m, 1:] - corners[m, 0]).T)[0]
        cells[m] = mesh.surface_cells[faces[m]]
    return replace(association, centre_places_m=centres_m, axes=axes, cells=cells)


def obstacle_distance(obstacle: Obstacle, body: Body, nodes_m: Array) -> Callable[[Array], Array]:
    """Return the signed distance (P,) [m] from an obstacle, as a function of points (P, 3) [m]; its
    frame is where its nodes are among `nodes_m` (n, 3) [m].
    """
    origin, *ends = nodes_m[obstacle.nodes]
    size_m = body.frame_nodes_m[1, 0] - body.frame_nodes_m[0, 0]
    axes = (np.array(ends) - origin).T / size_m
    distances_m = obstacle.shape.signed_distances_m
    return lambda points_m: distances_m((points_m - origin) @ axes + body.frame_nodes_m[0])


def surface_association(
    body: Body, places_m: Array, sigmas_m: Array, faces: Index
) -> MarkerAssociation:
    """Return the association of points whose places (N, 3) [m] move on the surface, from their faces
    (N,), or along the centreline of a rod, with prior standard deviations (N,) [m], zero for exact
    ones.
    """
    located = LocatedBody(body.nodes_m, body)
    attached: Sequence[tuple[Index, Array]] = [
        located.weights_at_nearest_point(place) for place in places_m
    ]
    count = len(places_m)
    none = np.zeros(count, dtype=np.int64)
    association = body.kind.association(
        body,
        sigmas_m,
        prior_places_m=places_m,
        on_surface=True,
        nodes=np.array([nodes for nodes, _ in attached]),
        weights=np.array([weights for _, weights in attached]),
        cells=none,
        centre_places_m=places_m,
        axes=np.zeros((count, 3, len(body.kind.places_in_images))),
        crossed_edges=np.full((count, 2, 3), np.nan),
        crossing_counts=none,
    )
    if not body.is_solid:
        return association.centred_at(places_m)
    on_faces = [
        nearest_points_of_triangles(place, body.nodes_m[body.mesh.surface[[face]]])[0]
        for place, face in zip(places_m, faces, strict=True)
    ]
    return _on_faces(association, np.array(on_faces), faces, association.estimated)
