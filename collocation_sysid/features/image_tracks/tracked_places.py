"""Places of tracked points on the body, poses of cameras, and which points are visible.

Places and poses that are not stated are found with a shape of the body at the first image: a pose
from the points with a stated place, a place from the ray of its pixel. Cameras share the places of
points with the same name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ...common.array_types import Array, Index
from ...errors import InputError
from ...fem.body import Body
from ...program.correspondences import Correspondences
from ...program.markers.marker_association import MarkerAssociation
from ...recording.experiment import Experiment
from ...recording.obstacle import Obstacle
from ...recording.placement import (
    LocatedBody,
    barycentric_in_triangles,
    nearest_points_of_triangles,
)
from .camera_images import POSE_UNKNOWNS
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
MOST_CREASES = 4
# Distance of a stated place from the body over its diagonal from which on it is a mistake.
FAR_OFF = 0.25
# Iterations that align a camera with the first image.
ALIGNMENT_EVALUATIONS = 60
# Share of the visible samples up to which changes are ignored.
SETTLED = 0.01
# Distance in mean edges in front of a point at which another part of the surface hides it.
OCCLUSION_EDGES = 0.3

# Distance in mean edges by which another face must be nearer to a place than its own.
SAME_FACE = 1e-3

ShapesAt = Callable[[Array], Array]


def find_places(
    experiment: Experiment, shapes_at: ShapesAt
) -> tuple[dict[str, Array], dict[str, float], dict[str, Array]]:
    """Return the poses of the cameras and the places of the points of an experiment.

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

    Raises
    ------
    InputError
        If the pose of a camera is unknown, and fewer than four points of it have a stated place; or
        if a stated place is far from the body.
    """
    cameras = [each for each in experiment.readings if isinstance(each, ImageTracks)]
    rest = LocatedBody(experiment.body.nodes_m, experiment.body)
    stated = {name: place for name, (place, _) in stated_places(experiment).items()}
    _require_on_body(stated, rest)
    poses, mirrored = {}, {}
    for tracks in cameras:
        poses[tracks.name] = tracks.camera.pose
        if not tracks.has_known_pose and tracks.pixels is not None:
            found = poses_of_tracks(tracks, stated, rest, shapes_at)
            poses[tracks.name] = found[0][0]
            mirrored[tracks.name] = found[1][1] / found[0][1] if len(found) > 1 else np.inf
    places = dict(stated)
    for tracks in cameras:
        _add_places(places, tracks, poses[tracks.name], experiment.body, shapes_at)
    return poses, mirrored, places


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


def _add_places(
    places: dict[str, Array], tracks: ImageTracks, pose: Array, body: Body, shapes_at: ShapesAt
) -> None:
    """Add the places of the points that have none and are seen by this camera, in place."""
    seen = tracks.is_seen
    if tracks.pixels is None:
        for name in tracks.names:
            places.setdefault(name, np.full(3, np.nan))
        return
    pixels = np.asarray(tracks.pixels)
    camera = replace(tracks.camera, pose=pose)
    tolerance = max(LEAST_MISS, MISSES * np.deg2rad(tracks.pose_sigma.turn_deg))
    firsts = seen.argmax(axis=0)
    for sample in np.unique(firsts):
        chosen = [
            k
            for k in np.flatnonzero((firsts == sample) & seen[sample]).tolist()
            if tracks.names[k] not in places or not np.isfinite(places[tracks.names[k]]).all()
        ]
        if not chosen:
            continue
        t_s = float(tracks.sample_times_s[sample])
        rotations, translations = camera.pose_at(t_s)
        rays = camera.points_at_unit_depth(pixels[sample, chosen])
        origins = np.tile(translations[0], (len(chosen), 1))
        nodes_m = shapes_at(np.array([t_s]))[0]
        faces, shares, missed = points_on_surface(
            origins, rays @ rotations[0].T, nodes_m, body.mesh.surface
        )
        at_m = np.einsum("pc,pci->pi", shares, body.nodes_m[body.mesh.surface[faces]])
        own_m = np.einsum("pc,pci->pi", shares, nodes_m[body.mesh.surface[faces]])
        distance = np.linalg.norm(own_m - origins, axis=1)
        allowed = tolerance + MISSES * tracks.pose_sigma.shift_m / np.maximum(distance, 1e-9)
        for k, place, miss, most in zip(chosen, at_m, missed, allowed, strict=True):
            places[tracks.names[k]] = place if miss <= most else np.full(3, np.nan)
    for name in tracks.names:
        places.setdefault(name, np.full(3, np.nan))


@dataclass(frozen=True, eq=False)
class TrackedPlaces(Correspondences):
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
    # (N, 2): indices in φ of the coordinates of the places; −1 for exact ones.
    coordinate_parameters: Index
    # (p,): indices in φ of the errors of the pose that are estimated, rotation first.
    pose_parameters: Index
    # Of a pose that was found: the error of the second best pose over that of the best one.
    mirror_ratio: float = np.inf
    # (p,): their values with which the first image fits best, in prior standard deviations.
    start_pose: Array = field(default_factory=lambda: np.zeros(0))
    obstacles: Sequence[Obstacle] = ()  # obstacles, which may hide points
    crossings: Index | int = 0  # (N,): how many creases each place has crossed

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
        poses, mirrored, places_m = find_places(experiment, shapes_at)
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
            start_pose=np.zeros(len(pose_parameters)),
            mirror_ratio=mirrored.get(tracks.name, np.inf),
            obstacles=experiment.obstacles,
        )
        unknowns = tracks.camera_unknowns(experiment)
        return correspondences.with_visibility(shapes)._aligned(shapes, unknowns)

    @property
    def measured(self) -> ImageTracks:
        """The tracks."""
        return self.tracks

    def with_start_values(self, phi: Array) -> Array:
        """Return a copy of φ with the coordinates of the places and the aligned pose."""
        started = self._with_places(phi)
        started[self.pose_parameters] = self.start_pose
        return started

    def continued(self, phi: Array, previous: Correspondences) -> Array:
        """Return φ with the coordinates of places that have left their elements."""
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
        """Return the coordinates (N, 2) of the places at φ (k,); zero for exact ones."""
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
        an obstacle is in front of it.
        """
        count = len(shapes_m)
        if not count:
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

    # Alignment --------------------------------------------------------------------------------

    def _aligned(self, shapes_m: Array, unknowns: Mapping[str, float]) -> TrackedPlaces:
        """Return the correspondences with the errors of the pose that fit the first image best,
        weighted by their priors; of a pose that is off by many pixels, every residual would be
        beyond the threshold of Huber's loss.
        """
        tracks, size = self.tracks, len(self.pose_parameters)
        used = self.is_visible & tracks.is_seen & self.is_placed
        if not size or tracks.pixels is None or not used.any():
            return self
        sample = int(used.any(axis=1).argmax())
        points = np.flatnonzero(used[sample])
        nodes, weights = self._corner_weights
        at_m = np.einsum("pc,pci->pi", weights[points], shapes_m[sample][nodes[points]])
        own_m = (at_m - self.translations[sample]) @ self.rotations[sample]
        pixels = np.asarray(tracks.pixels)[sample, points]
        names = [name for name in POSE_UNKNOWNS if name in unknowns]
        scales = np.array([unknowns[name] for name in names])
        places = [POSE_UNKNOWNS.index(name) for name in names]

        def differences(pose: Array) -> Array:
            errors = np.zeros(6)
            errors[places] = pose * scales
            moved = own_m @ Rotation.from_rotvec(errors[:3]).as_matrix().T + errors[3:]
            moved[:, 2] = np.maximum(moved[:, 2], 1e-3)
            off = tracks.camera.distorted_pixels(moved) - pixels
            return np.concatenate([off.ravel() / tracks.sigma_px, pose])

        fit = least_squares(
            differences, np.zeros(size), loss="soft_l1", max_nfev=ALIGNMENT_EVALUATIONS
        )
        return replace(self, start_pose=fit.x)

    @cached_property
    def _corner_weights(self) -> tuple[Index, Array]:
        """Corners (N, 3) of the faces of the places, and their weights (N, 3)."""
        return self.association.body.mesh.surface[self.faces], self._shares

    def followed(self, phi: Array, shapes_m: Array) -> TrackedPlaces:
        """Return the correspondences at other estimates φ (k,) with the first s shapes (s, n, 3)
        [m]; self if nothing has changed.
        """
        other = self._with_faces_of(self.places_m(phi))
        return other.with_visibility(shapes_m, is_settled=other is self)

    def _with_faces_of(self, points_m: Array) -> TrackedPlaces:
        """Return the correspondences with places at points (N, 3) [m] in the planes of their faces;
        self if each is on its face, or cannot leave it.
        """
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
                beside = self.enterable[m] & ~is_smooth & (crossings[m] < MOST_CREASES)
                beside &= np.linalg.norm(nearest - nearest[face], axis=1) < near_m
                if beside.any():
                    faces[m] = int(beside.argmax())
                    centres[m] = nearest[faces[m]]
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


def _enterable_faces(
    experiment: Experiment, names: Sequence[str], poses: Mapping[str, Array], shapes_at: ShapesAt
) -> NDArray[np.bool_]:
    """Return the faces (N, F) that look at every camera in its first image of each point; none for
    points with a stated place.
    """
    surface = experiment.body.mesh.surface
    stated = stated_places(experiment)
    faces = np.array([np.full(len(surface), name not in stated) for name in names])
    for tracks in experiment.readings:
        if not isinstance(tracks, ImageTracks) or tracks.pixels is None:
            continue
        camera = replace(tracks.camera, pose=poses[tracks.name])
        firsts = dict(zip(tracks.names, tracks.is_seen.argmax(axis=0).tolist(), strict=True))
        samples = sorted({firsts[name] for name in names if name in firsts})
        t_s = tracks.sample_times_s[samples]
        corners = shapes_at(t_s)[:, surface]
        eyes = camera.pose_at(t_s)[1]
        look = facing(corners, corners.mean(axis=2), eyes[:, None]) > 0
        for k, name in enumerate(names):
            if name in firsts:
                faces[k] &= look[samples.index(firsts[name])]
    return faces


def _nearest_faces(body: Body, places_m: Array, enterable: NDArray[np.bool_]) -> Index:
    """Return the surface triangle (N,) of each place (N, 3); of those that meet there, one that
    looks at the cameras.
    """
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
    """Return the association centred at places (N, 3) [m], with the planes and elements of the faces
    (N,) for the places with the indices `moved`.
    """
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
    (N,), with prior standard deviations (N,) [m], zero for exact ones.
    """
    located = LocatedBody(body.nodes_m, body)
    attached: Sequence[tuple[Index, Array]] = [
        located.weights_at_nearest_point(place) for place in places_m
    ]
    count = len(places_m)
    none = np.zeros(count, dtype=np.int64)
    association = MarkerAssociation(
        body,
        sigmas_m,
        prior_places_m=places_m,
        on_surface=True,
        nodes=np.array([nodes for nodes, _ in attached]),
        weights=np.array([weights for _, weights in attached]),
        cells=none,
        centre_places_m=places_m,
        axes=np.zeros((count, 3, 2)),
        crossed_edges=np.full((count, 2, 3), np.nan),
        crossing_counts=none,
    )
    on_faces = [
        nearest_points_of_triangles(place, body.nodes_m[body.mesh.surface[[face]]])[0]
        for place, face in zip(places_m, faces, strict=True)
    ]
    return _on_faces(association, np.array(on_faces), faces, association.estimated)
