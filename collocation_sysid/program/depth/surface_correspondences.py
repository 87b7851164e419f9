"""Correspondences between the points of a depth camera and the surface of the body.

Points are not labelled: each belongs to the nearest point of the surface, for the current shape and
camera pose (iterative closest points). A `SurfaceCorrespondences` states these correspondences for
every image; it is renewed as estimates change, as associations of marker places are. In between,
residuals along the surface normals are smooth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...common.array_types import Array, Index
from ...fem.body import Body
from ...recording.depth_camera import Depth
from ...recording.nuisance import DEPTH_SHIFT, DEPTH_TURN
from ..correspondences import Correspondences
from ..custom_sensor_residual import is_within
from .camera_alignment import align_camera, thinned
from .camera_model import DepthCameraModel
from .outline import Outline
from .visible_surface import GRAZING, VisibleSurface

# Share of a point's distance that is perpendicular to the normal, above which it lies beyond an
# edge of the visible surface.
LARGEST_LATERAL_SHARE = 0.5
# Gate before anything is fitted, relative to the diagonal of the body.
WIDE = 0.25
# Later gate, relative to the median distance of the points.
SPREAD = 6.0
# The gate is narrowed only if it decreases by this factor.
NARROWER = 0.8
# Shapes that change by less than this share of σ keep their correspondences.
SAME = 0.2
# Largest alignment in standard deviations of its prior; more belongs to something else.
FARTHEST = 4.0
# Reasons for leaving points out, in the order in which they are tested.
EXCLUSION_REASONS = ("far", "grazing", "turned away", "not chosen", "hidden", "crease")
# Distance from a crease within which points are left out, in standard deviations of the noise.
CREASE_SIGMAS = 3.0
# Share of the spacing of points by which a part must be in front to hide another; shapes that
# change by less have converged.
FRONT = 0.5


def initial_gate_m(shape_m: Array) -> float:
    """Return the largest distance of points from a surface before anything is fitted [m]: the share
    `WIDE` of the diagonal of the bounding box of its nodes `shape_m` (n, 3) [m].
    """
    return WIDE * float(np.linalg.norm(np.ptp(shape_m, axis=0)))


@dataclass(frozen=True, eq=False)
class SurfaceCorrespondences(Correspondences):
    """Points of a camera and corresponding points of the surface, in S images of at most E points.

    Only points within the gate are contained; arrays of images with fewer points are padded with
    zeros, and the padding is not `is_compared`.
    """

    camera: DepthCameraModel
    body: Body
    surface: VisibleSurface  # surface of the body
    # (S, E, v): indices of the v surface nodes of each corresponding point's face, and their shape
    # functions.
    nodes: Index
    weights: Array
    # (S, E, 3): unit vectors in the world along which distances are measured: normals of the
    # surface, and for a point beyond an edge of the visible surface the direction to it.
    normals: Array
    # (S, E, 3): measured points [m], and directions of their depths, in the camera's frame.
    points: Array
    rays: Array
    places_m: Array  # (S, E, 3): corresponding points on the undeformed body [m]
    is_compared: NDArray[np.bool_]  # (S, E) of bool: points that are compared
    gate_m: float  # points farther from the surface are taken to belong to something else [m]
    # mapping of str to int: number of points that are not compared, by reason
    # (`EXCLUSION_REASONS`).
    excluded_counts: Mapping[str, int]
    shapes_m: Array  # (S, n, 3): surface nodes for which the correspondences were found [m]
    # mapping of str to float: the camera's nuisance parameters for which they were found, by label.
    start_values: Mapping[str, float]
    # Whether shapes had hardly changed since the correspondences before. Only then are points left
    # out that the body hides from the camera: with wrong shapes, too many would seem hidden.
    has_converged: bool
    # Outline of the body in these shapes and the edges in the images; without points if there are
    # no images.
    outline: Outline
    # Whether they are those after an alignment of the camera, see `from_alignment`.
    is_aligned: bool = False

    @property
    def measured(self) -> Depth:
        return self.camera.depth

    @property
    def taken_s(self) -> Array:
        """Times (S,) of the images [s] with the clock shift for which they were found; another shift
        would extrapolate the motion between the grid times around them.
        """
        view = self.camera
        late_s = view.clock_shift_s(view.parameters_from(self.start_values))
        return view.depth.sample_times_s + late_s

    def within(self, at_s: Array) -> SurfaceCorrespondences:
        """Return the correspondences without images beyond the times `at_s` of the motion."""
        inside = is_within(self.taken_s, at_s)[:, None]
        outline = replace(self.outline, is_compared=self.outline.is_compared & inside)
        return replace(self, is_compared=self.is_compared & inside, outline=outline)

    def with_start_values(self, phi: Array) -> Array:
        own = self.camera.parameter_indices
        updated = phi.copy()
        updated[own] = self.camera.parameters_from(self.start_values)[own]
        return updated

    @classmethod
    def from_shapes(
        cls,
        camera: DepthCameraModel,
        body: Body,
        shapes_m: Array,
        phi: Array,
        gate_m: float,
        settled: bool = False,
        surface: VisibleSurface | None = None,
    ) -> SurfaceCorrespondences:
        """Find the correspondences for given shapes.

        Parameters
        ----------
        shapes_m : (S, n, 3) array
            Surface nodes at all S images [m].
        phi : (k,) array
            Nuisance parameters, with the pose of the camera.
        gate_m : float
            Largest distance of points from the surface [m].
        settled : bool
            Whether to leave out points that the body hides; stored as `has_converged`.
        surface : VisibleSurface, optional
            Surface of the body, if it is known.
        """
        skin = surface or VisibleSurface.from_body(body, camera.depth)
        images = [
            _match_image(
                camera, skin, body=body, sample=k, x=x, phi=phi, gate_m=gate_m, settled=settled
            )
            for k, x in enumerate(shapes_m)
        ]
        most = max(1, *(len(each["is_compared"]) for each in images))
        arrays: dict[str, Any] = {
            name: np.stack(
                [
                    np.pad(s[name], [(0, most - len(s[name])), *[(0, 0)] * (s[name].ndim - 1)])
                    for s in images
                ]
            )
            for name in images[0]
            if name != "reasons"
        }
        total = np.sum([each["reasons"] for each in images], axis=0).tolist()
        own: dict[str, Any] = {"excluded_counts": dict(zip(EXCLUSION_REASONS, total, strict=True))}
        own |= {
            "start_values": camera.parameter_values(phi),
            "gate_m": gate_m,
            "shapes_m": shapes_m,
            "has_converged": settled,
        }
        own["outline"] = Outline.from_shapes(
            camera, skin, body=body, shapes_m=shapes_m, phi=phi, gate_m=gate_m
        )
        return cls(camera, body, surface=skin, **own, **arrays)

    @classmethod
    def from_alignment(
        cls, camera: DepthCameraModel, body: Body, shapes_m: Array, phi: Array
    ) -> SurfaceCorrespondences:
        """Align the camera with the shape of the first image that has points, then find the
        correspondences, also of hidden points, within a gate that suits their distances.

        The alignment is rejected if it differs from the stated pose by more than `FARTHEST` prior
        standard deviations.

        Parameters
        ----------
        shapes_m : (S, n, 3) array
            Surface nodes at all S images [m].
        phi : (k,) array
            Nuisance parameters, for those that the alignment does not estimate; not modified.
        """
        phi = _aligned_parameters(camera, body, shapes_m=shapes_m, phi=phi)
        gate_m = max(initial_gate_m(body.nodes_m), camera.depth.gate_m)
        clouds = tuple(map(thinned, camera.depth.clouds))
        thinned_view = replace(camera, depth=replace(camera.depth, clouds=clouds, images_m=()))
        gate_m = cls.from_shapes(
            thinned_view, body, shapes_m=shapes_m, phi=phi, gate_m=gate_m
        ).next_gate_m(shapes_m, phi)
        aligned = cls.from_shapes(camera, body, shapes_m=shapes_m, phi=phi, gate_m=gate_m)
        return replace(aligned, is_aligned=True)

    def with_aligned_pose(self, shapes_m: Array, phi: Array) -> SurfaceCorrespondences:
        """Return the same correspondences with the camera's parameters after an alignment with the
        shapes (S, n, 3) [m], see `from_alignment`, for comparisons that need the pose alone.
        """
        phi = _aligned_parameters(self.camera, self.body, shapes_m=shapes_m, phi=phi)
        return replace(self, start_values=self.camera.parameter_values(phi), is_aligned=False)

    def with_camera(self, camera: DepthCameraModel) -> SurfaceCorrespondences:
        """Return the same correspondences with another model of their camera, which uses the points
        for alignments of the present one if both have the same measured points.
        """
        camera.share_alignment_clouds(self.camera)
        return replace(self, camera=camera)

    def is_aligned_with(self, shapes_m: Array, phi: Array) -> bool:
        """Return whether these are the correspondences after an alignment of the camera with shapes
        (S, n, 3) [m] and with the errors of φ (k,) other than those of the pose, so that another
        alignment would give the same.
        """
        view = self.camera
        before = view.parameters_from(self.start_values)
        others = np.setdiff1d(
            view.parameter_indices,
            view.nuisance.indices_of_rows(DEPTH_TURN, DEPTH_SHIFT, component=view.camera_index),
        )
        moved_m = np.abs(shapes_m - self.shapes_m).max(initial=0.0)
        return (
            self.is_aligned
            and moved_m < SAME * view.depth.sigma_m
            and bool((before[others] == phi[others]).all())
        )

    def updated(
        self, shapes_m: Array, phi: Array, largest_shift_s: float
    ) -> SurfaceCorrespondences:
        """Return the correspondences of other shapes and camera poses.

        Parameters
        ----------
        shapes_m : (s, n, 3) array
            Surface nodes at the first s images [m]; later images keep their shapes.
        phi : (k,) array
            Nuisance parameters.
        largest_shift_s : float
            Largest change of the clock shift [s] that keeps the grid times around the images.

        Returns
        -------
        SurfaceCorrespondences
            The new correspondences; self if they have converged, the gate and the grid times are
            unchanged, and neither surface nor measured points have moved by more than the share
            `SAME` of σ.
        """
        known = len(shapes_m)
        all_shapes_m = np.concatenate([shapes_m, self.shapes_m[known:]])
        depth = self.camera.depth
        before = self.camera.parameters_from(self.start_values)
        moved_m = np.abs(shapes_m - self.shapes_m[:known]).max(initial=0.0)
        for k in range(known if moved_m < FRONT * depth.spacing_m else 0):
            way = self.camera.world_points(phi, k) - self.camera.world_points(before, k)
            moved_m = max(moved_m, np.abs(way).max(initial=0.0))
        gate_m = self.next_gate_m(all_shapes_m, phi)
        settled = moved_m < FRONT * depth.spacing_m
        shift_s = self.camera.clock_shift_s(phi) - self.camera.clock_shift_s(before)
        is_same = moved_m < SAME * depth.sigma_m and abs(shift_s) <= largest_shift_s
        if is_same and gate_m == self.gate_m and self.has_converged:
            return self
        return SurfaceCorrespondences.from_shapes(
            self.camera,
            self.body,
            shapes_m=all_shapes_m,
            phi=phi,
            gate_m=gate_m,
            settled=settled,
            surface=self.surface,
        )

    def with_depth(self, depth: Depth, shapes_m: Array, phi: Array) -> SurfaceCorrespondences:
        """Return the correspondences of other measured points of the same camera and images, such
        as all points in place of thinned ones, with the present gate.

        Parameters
        ----------
        depth : Depth
            The camera with its other points.
        shapes_m : (S, n, 3) array
            Surface nodes at all S images [m].
        phi : (k,) array
            Nuisance parameters.
        """
        return SurfaceCorrespondences.from_shapes(
            replace(self.camera, depth=depth),
            self.body,
            shapes_m=shapes_m,
            phi=phi,
            gate_m=self.gate_m,
            settled=self.has_converged,
        )

    def is_facing(self, x: Array, phi: Array, image: int) -> NDArray[np.bool_]:
        """Return which flat triangles (P,) of a shape x (n, 3) [m] the camera sees in an image at φ
        (k,), not at a grazing angle.
        """
        return self.surface.is_facing(x, self.camera.eye_m(phi, image), minimum_cosine=GRAZING)

    def distance_to_cloud_m(self, x: Array, phi: Array, image: int) -> Array:
        """Return the distances (P,) [m] of the middles of all flat triangles of a shape x (n, 3) [m]
        from the points of an image at φ (k,), limited to `initial_gate_m` of the body.
        """
        middles = x[self.surface.plane_triangles].mean(axis=1)
        distances_m, _ = KDTree(self.camera.world_points(phi, image)).query(middles)
        return np.minimum(distances_m, initial_gate_m(self.body.nodes_m))

    def next_gate_m(self, shapes_m: Array, phi: Array) -> float:
        """Return the gate for the next search [m]: six times the median distance of the compared
        points from the surfaces (S, n, 3) [m] at φ (k,), at least that of the problem, if this is
        smaller than the present one by the factor `NARROWER`; otherwise the present one.
        """
        gate_m = max(self._expected_distance_m(shapes_m, phi), self.camera.depth.gate_m)
        return gate_m if gate_m <= NARROWER * self.gate_m else self.gate_m

    def _expected_distance_m(self, shapes_m: Array, phi: Array) -> float:
        """Return `SPREAD` times the median distance, or infinity."""
        distances_m = self.signed_distances_m(shapes_m, phi)
        all_of_them = np.abs(distances_m[np.isfinite(distances_m)])
        return SPREAD * float(np.median(all_of_them)) if len(all_of_them) else np.inf

    def signed_distances_m(self, shapes_m: Array, phi: Array) -> Array:
        """Return how far points (S, E) are behind shapes (s, n, 3) of the first s ≤ S images, along
        `normals` [m], at φ (k,).

        NaN where a point is not compared, and for the other images.
        """
        distances_m = np.full(self.is_compared.shape, np.nan)
        for k, x in enumerate(shapes_m):
            surface = np.einsum("ea,eai->ei", self.weights[k], x[self.nodes[k]])
            measured = self.camera.to_world(phi, self.points[k], rays=self.rays[k], image=k)
            behind_m = np.sum(self.normals[k] * (surface - measured), axis=1)
            distances_m[k] = np.where(self.is_compared[k], behind_m, np.nan)
        return distances_m


def _aligned_parameters(camera: DepthCameraModel, body: Body, shapes_m: Array, phi: Array) -> Array:
    """Return φ (k,) with the camera aligned with its first image, unless beyond `FARTHEST`."""
    first = camera.depth.first_sample_with_points
    surface = VisibleSurface.from_body(body, camera.depth)
    turn, shift_m = align_camera(camera, surface, x=shapes_m[first], image=first)
    moved = camera.with_pose(phi, turn, shift_m=shift_m)
    errors = np.abs(moved[camera.parameter_indices])
    return phi if errors.max(initial=0.0) > FARTHEST else moved


def _match_image(
    camera: DepthCameraModel,
    surface: VisibleSurface,
    body: Body,
    sample: int,
    x: Array,
    phi: Array,
    gate_m: float,
    settled: bool,
) -> dict[str, NDArray]:
    depth = camera.depth
    cloud = camera.depth.clouds[sample]
    world = camera.world_points(phi, sample)
    eye_m = camera.eye_m(phi, sample)
    indices, faces, barycentric = _nearest_facing(world, surface, x=x, eye_m=eye_m, gate_m=gate_m)
    weights, feet, normals = surface.evaluate(x, faces, barycentric=barycentric)
    ways = normals if eye_m is None else eye_m - feet
    is_frontal = np.sum(normals * ways, axis=1) >= GRAZING * np.linalg.norm(ways, axis=1)
    offsets = world[indices] - feet
    distance = np.linalg.norm(offsets, axis=1)
    lateral = np.linalg.norm(offsets - np.sum(offsets * normals, axis=1)[:, None] * normals, axis=1)
    # The distance of a point beyond an edge of the visible surface is along the way to the edge.
    is_beyond_edge = lateral > LARGEST_LATERAL_SHARE * distance + depth.sigma_m
    normals[is_beyond_edge] = offsets[is_beyond_edge] / distance[is_beyond_edge, None]
    is_any = np.ones(len(indices), dtype=bool)
    has_similar_normal = is_visible = is_on_one_face = is_any
    if cloud.shape[1] == 6:
        measured = cloud[indices, 3:] @ camera.poses[0][sample].T
        has_similar_normal = np.sum(normals * measured, axis=1) >= GRAZING
    if settled:
        is_visible = ~surface.is_hidden(x, eye_m, points_m=feet, front_m=FRONT * depth.spacing_m)
        is_on_one_face = ~surface.is_near_crease(
            x, eye_m, points_m=world[indices], reach_m=CREASE_SIGMAS * depth.sigma_m
        )
    is_within_gate = distance <= gate_m
    remaining = np.cumprod(
        [
            is_any,
            is_within_gate,
            is_frontal,
            has_similar_normal,
            surface.is_selected[faces],
            is_visible,
            is_on_one_face,
        ],
        axis=0,
    )
    reasons = -np.diff(remaining.sum(axis=1))
    reasons[0] += len(cloud) - len(indices)
    rest_m = np.einsum("pa,pai->pi", weights, body.nodes_m[surface.nodes][surface.faces[faces]])
    of_points = {
        "nodes": surface.faces[faces],
        "weights": weights,
        "normals": normals,
        "points": cloud[indices, :3],
        "rays": camera.rays[sample][indices],
        "places_m": rest_m,
        "is_compared": remaining[-1].astype(bool),
    }
    return {name: each[is_within_gate] for name, each in of_points.items()} | {"reasons": reasons}


def _nearest_facing(
    world: Array, surface: VisibleSurface, x: Array, eye_m: Array | None, gate_m: float
) -> tuple[Index, Index, Array]:
    """Return points (k,) near a shape, their faces (k,) and barycentric coordinates (k, 3)."""
    low = x.min(axis=0) - gate_m
    high = x.max(axis=0) + gate_m
    in_box = np.flatnonzero(((world >= low) & (world <= high)).all(axis=1))
    facing = np.flatnonzero(surface.is_facing(x, eye_m))
    if not len(facing) or not len(in_box):
        return in_box[:0], in_box[:0], np.zeros((0, 3))
    return in_box, *surface.nearest_points(x, world[in_box], candidates=facing)
