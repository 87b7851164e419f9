"""Distances of a body's outline from the edges of masks, from node positions x and nuisance
parameters φ:

    r = (n · (y − e) − w) / σ,

with the pixel y of a point where the body ends in the view of the camera, predicted as that of a
track (`image_tracks.residual`), the point e on the edge of the mask that belongs to it, the normal n of the
outline in the image, and the distance w by which masks end inside of the outline. Points and edges
are found as in depth images (`depth.outline`), and follow the estimates.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...common.array_types import Array, Index
from ...program.association import Association
from ...program.correspondences import Correspondences
from ...program.custom_sensor_residual import is_within
from ...program.depth.outline import BODY, EMPTY, UNKNOWN, OutlineView, image_edges, outline_points
from ...program.depth.visible_surface import VisibleSurface
from ...program.following_sensor import all_nodes
from ...program.measurement_model import CorrespondenceModel
from ...program.measurement_residual import RowStencil, SampledMotion
from ...program.observables import PointPositions
from ...recording.experiment import Experiment
from ..image_tracks.camera_images import POSE_UNKNOWNS, CameraImagesResidual, ImageCorrespondences
from ..image_tracks.places import obstacle_distance
from ..image_tracks.rays import is_behind
from .outlines import EDGE, Outlines

# Distance to either side of the outline within which the edge of a mask is searched [pixels]: it
# contains nothing but the body, so that the first edge is that of the body.
SEARCH_PX = 60.0
# Movement of the surface in the image up to which its outline is not searched again [pixels].
SETTLED_PX = 0.05
# Distance in mean edges of the mesh in front of a point at which an obstacle hides it.
OCCLUSION_EDGES = 0.3


@dataclass(frozen=True, eq=False)
class OutlinePairs(ImageCorrespondences):
    """Points of the body's outline in S images, E each at most, and edges of the masks."""

    outlines: Outlines
    experiment: Experiment
    surface: VisibleSurface
    # (S, 3, 3) and (S, 3): stated pose of the camera at each image, from its frame to the world.
    rotations: Array
    translations: Array
    # (S, E, v): nodes of the body at the face of each point, and their shape functions.
    nodes: Index
    weights: Array
    # (S, E, 2): points on the edges of the masks, and normals of the outline, away from the body
    # [pixels].
    edges: Array
    outwards: Array
    is_compared: NDArray[np.bool_]  # (S, E) of bool: points that have an edge
    seen_px: Array  # (S, n, 2): pixels of the nodes of the surface for which the points were found

    @classmethod
    def from_shapes(
        cls, experiment: Experiment, outlines: Outlines, shapes_m: Array
    ) -> OutlinePairs:
        """Find the outlines of shapes (S, n, 3) [m] with a camera without errors."""
        surface = VisibleSurface.from_body(experiment.body)
        samples, count = outlines.measured_values.shape
        corners = surface.faces.shape[1]
        empty = cls(
            outlines,
            experiment,
            surface,
            *outlines.camera.pose_at(outlines.sample_times_s),
            nodes=np.zeros((samples, count, corners), dtype=np.int64),
            weights=np.zeros((samples, count, corners)),
            edges=np.zeros((samples, count, 2)),
            outwards=np.zeros((samples, count, 2)),
            is_compared=np.zeros((samples, count), dtype=bool),
            seen_px=np.full((samples, len(surface.nodes), 2), np.inf),
        )
        return empty.in_shapes(shapes_m, {})

    @property
    def measured(self) -> Outlines:
        return self.outlines

    def with_start_values(self, phi: Array) -> Array:
        return phi.copy()

    def in_shapes(self, shapes_m: Array, errors: Mapping[str, float]) -> OutlinePairs:
        """Return the pairs with the first s images in shapes (s, n, 3) [m]; self if nothing has
        moved.

        Parameters
        ----------
        shapes_m : (s, n, 3) array
        errors : mapping
            Errors of the camera by the names of its unknowns; zero for others.
        """
        views = [self._view(k, errors) for k in range(len(shapes_m))]
        seen = []
        for view, shape_m in zip(views, shapes_m, strict=True):
            own = view.to_camera_m(shape_m[self.surface.nodes])
            is_in_front = (own[:, 2] > 0).all()
            seen.append(
                view.camera.distorted_pixels(own) if is_in_front else self.seen_px[0] + np.inf
            )
        if not seen:
            return self
        with np.errstate(invalid="ignore"):
            moved_px = np.abs(np.array(seen) - self.seen_px[: len(seen)])
        if (moved_px <= SETTLED_PX).all():
            return self
        names = ("nodes", "weights", "edges", "outwards", "is_compared", "seen_px")
        changed = {name: getattr(self, name).copy() for name in names}
        for k, (view, shape_m) in enumerate(zip(views, shapes_m, strict=True)):
            changed["seen_px"][k] = seen[k]
            changed["is_compared"][k] = False
            mask = self.outlines.all_masks[k] if self.outlines.all_masks else None
            if mask is None or not np.isfinite(seen[k]).all():
                continue
            self._pair(k, mask, view, shape_m, changed)
        return replace(self, **changed)

    def _pair(
        self, k: int, mask: NDArray[np.bool_], view: OutlineView, shape_m: Array, into: dict
    ) -> None:
        points = outline_points(view, self.surface, shape_m[self.surface.nodes])
        if points is None:
            return

        def shown_at(pixels: Array) -> NDArray[np.int64]:
            column, row = np.moveaxis(np.round(pixels).astype(np.int64), -1, 0)
            inside = (column >= 0) & (column < mask.shape[1]) & (row >= 0) & (row < mask.shape[0])
            shown = np.where(
                mask[np.where(inside, row, 0), np.where(inside, column, 0)], BODY, EMPTY
            )
            return np.where(inside, shown, UNKNOWN)

        edges, outwards, has_edge = image_edges(points, shown_at, lambda: ~mask, SEARCH_PX)
        nodes = self.surface.nodes[self.surface.faces[points.faces]]
        at_m = np.einsum("pa,pai->pi", points.weights, shape_m[nodes])
        eyes = np.tile(view.eye_m, (len(at_m), 1))
        body = self.experiment.body
        margin_m = OCCLUSION_EDGES * float(body.mesh.quality().edge_mean_m)
        for obstacle in self.experiment.obstacles:
            distance = obstacle_distance(obstacle, body, shape_m)
            has_edge = has_edge & ~is_behind(at_m, eyes, distance, margin_m)
        most = into["nodes"].shape[1]
        used = np.arange(len(at_m))
        if len(used) > most:
            used = used[np.linspace(0, len(used) - 1, most).astype(int)]
        place = slice(0, len(used))
        into["weights"][k] = 0.0
        into["nodes"][k, place] = nodes[used]
        into["weights"][k, place] = points.weights[used]
        into["edges"][k, place] = edges[used]
        into["outwards"][k, place] = outwards[used]
        into["is_compared"][k, place] = has_edge[used]

    def _view(self, k: int, errors: Mapping[str, float]) -> OutlineView:
        camera = self.outlines.camera
        matrix = camera.require_matrix().copy()
        matrix[:2, :2] *= 1 + errors.get("focal_error", 0.0)
        matrix[:2, 2] += [errors.get("centre_u_px", 0.0), errors.get("centre_v_px", 0.0)]
        turn, shift = (
            np.array([errors.get(name, 0.0) for name in names])
            for names in (POSE_UNKNOWNS[:3], POSE_UNKNOWNS[3:])
        )
        turned = Rotation.from_rotvec(turn).as_matrix()
        rotation, translation = self.rotations[k], self.translations[k]

        def to_camera_m(points_m: Array) -> Array:
            return (points_m - translation) @ rotation @ turned.T + shift

        eye_m = translation - rotation @ turned.T @ shift
        middle = to_camera_m(self.experiment.body.nodes_m.mean(axis=0))
        focal_px = matrix[0, 0]
        spacing_m = self.outlines.spacing_px * max(float(middle[2]), 1e-3) / focal_px
        return OutlineView(replace(camera, matrix=matrix), eye_m, to_camera_m, spacing_m)


@dataclass(frozen=True, eq=False)
class OutlinesResidual(CameraImagesResidual):
    """Residual of the outlines in the images of one camera; its entities are their points, its
    observable all nodes.
    """

    sensor: Outlines
    observable: PointPositions
    correspondences: OutlinePairs

    sigma_key = "sigma_px of outlines"
    has_noise_floor = True

    @cached_property
    def _stencil(self) -> RowStencil:
        """Nodes at neighbouring times; data of the camera, shape functions, normal and edge."""
        pairs, times = self.correspondences, self.point_times
        samples, points = pairs.is_compared.shape
        places = times[..., None] * self.observable.vector_count + pairs.nodes[:, :, None]
        parts = [
            self.camera_data(pairs.rotations, pairs.translations),
            pairs.weights,
            pairs.outwards,
            pairs.edges,
        ]
        return RowStencil(
            places.reshape(samples, points, -1), np.moveaxis(np.concatenate(parts, axis=2), 2, 0)
        )

    @property
    def rows(self) -> Array:
        return self.correspondences.edges[..., 1]

    def expression(self, values: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """Return how far the point is outside of the edge [pixels], and two zeros."""
        corners = self.correspondences.nodes.shape[2]
        times = values.shape[1] // corners
        sizes = [0, times, 1, 1, 9, 3, corners, 2, 2]
        *camera, weights, outward, edge = ca.vertsplit(data, np.cumsum(sizes).tolist())
        own = phi * self.nuisance.scales[self.own_parameters[0]][:, None]
        count = len(self.sensor.camera_unknowns(self.experiment))
        at = ca.horzcat(*(part @ weights for part in ca.horzsplit(values, corners)))
        pixel = self.projected(self.known_errors(own[:count]), at, camera, edge[1])
        return ca.vertcat(ca.dot(outward, pixel - edge) - ca.sum1(own[count:]), 0, 0)

    @property
    def observable_sigmas(self) -> Array:
        nodes_m = self.experiment.body.nodes_m
        sigmas = np.full(len(nodes_m), self.sensor.sigma_px)
        return self.position_sigmas_m(nodes_m, self.correspondences.translations, sigmas)

    def numbers(self, predicted: Array) -> Array:
        compared = self.is_compared[: len(predicted), :, 0]
        return np.where(compared, predicted[..., 0], np.nan)

    def simulated(self, motion: SampledMotion, phi: Array) -> Array:
        other = self.at_samples(motion.t_s, motion.reaction_grid)
        pairs = other.reassociated(motion.observed.x, phi)
        followed = replace(
            other, correspondences=pairs, is_compared=compared(pairs, other.observable_s)
        )
        return followed.numbers(followed.predict_motion(motion.observed, phi))

    # Correspondences --------------------------------------------------------------------------

    def contours_px(self, x: Array, phi: Array) -> list[Array]:
        """Return the compared points of the contour (P, 2) [pixels] in each image that rows x (rows,
        3n) reach, at φ (k,).
        """
        pairs, errors = self.correspondences, self.errors_at(phi)
        contours = []
        for k, shape_m in enumerate(self._shapes(x, self.exposed_s(errors))):
            used, view = pairs.is_compared[k], pairs._view(k, errors)
            at_m = np.einsum("pa,pai->pi", pairs.weights[k, used], shape_m[pairs.nodes[k, used]])
            contours.append(view.camera.distorted_pixels(view.to_camera_m(at_m)))
        return contours

    def reassociated(self, x: Array, phi: Array) -> OutlinePairs:
        errors = self.errors_at(phi)
        shapes_m = self._shapes(x, self.exposed_s(errors))
        return self.with_clock(self.correspondences.in_shapes(shapes_m, errors), errors)

    def aligned_correspondences(
        self, x: Array, phi: Array, only_pose: bool = False
    ) -> OutlinePairs:
        """Use the last row if the first reach none; the present pairs with `only_pose`."""
        if only_pose:
            return self.correspondences
        errors = self.errors_at(phi)
        shapes_m = self._shapes(x, self.exposed_s(errors))
        if not len(shapes_m):
            shapes_m = x[-1:].reshape(1, -1, 3)
        return self.correspondences.in_shapes(shapes_m, errors)

    def correspondences_of(self, measured: Outlines, x: Array, phi: Array) -> OutlinePairs:
        errors = self.errors_at(phi)
        own = replace(self.correspondences, outlines=measured)
        return own.in_shapes(self._shapes(x, self.exposed_s(errors)), errors)


def compared(pairs: OutlinePairs, at_s: Array) -> NDArray[np.bool_]:
    """Return the mask (S, E, 3) of the distances from an edge, which are the first of three numbers,
    in images within the times `at_s`.
    """
    exposed_s = pairs.outlines.exposed_s(pairs.experiment, pairs.clock, pairs.edges[..., 1])
    within = is_within(exposed_s.ravel(), at_s).reshape(exposed_s.shape)
    is_used = pairs.is_compared & within
    return np.stack([is_used, *[np.zeros_like(is_used)] * 2], axis=2)


class OutlinesModel(CorrespondenceModel):
    """Outlines in the images of one camera, whose points follow the estimates."""

    measurement: Outlines

    @cached_property
    def _observable(self) -> PointPositions:
        return all_nodes(self.grid.experiment.body, len(self.grid.t_s))

    def first_correspondences(self) -> OutlinePairs:
        experiment = self.grid.experiment
        at_s = np.clip(self.measurement.sample_times_s, *experiment.t_s[[0, -1]])
        shapes_m = experiment.rigid_positions(at_s)
        return OutlinePairs.from_shapes(experiment, self.measurement, shapes_m)

    def residuals(
        self, association: Association, correspondences: Correspondences | None
    ) -> tuple[OutlinesResidual]:
        assert isinstance(correspondences, OutlinePairs)
        outlines, grid = self.measurement, self.grid
        samples, points = correspondences.is_compared.shape
        names = [
            *outlines.camera_unknowns(grid.experiment),
            *([EDGE] * (EDGE in outlines.unknowns)),
        ]
        own = grid.nuisance.indices_of_labels(map(outlines.unknown_label, names))
        return self.image_residual(
            OutlinesResidual,
            observable=self._observable,
            names=(f"outline of {outlines.name}",) * points,
            sigmas=np.full(points, outlines.sigma_px),
            measured=np.tile([0.0, np.nan, np.nan], (samples, points, 1)),
            is_compared=compared(correspondences, grid.t_s),
            own_parameters=np.tile(own, (points, 1)),
            correspondences=correspondences,
        )
