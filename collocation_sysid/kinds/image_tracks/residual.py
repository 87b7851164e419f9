"""Pixels of tracked points, from node positions x and nuisance parameters φ:

    y = π(R(a) T(t)⁻¹ Σ_i ℓ_i(τ) h(x_i) + d) + b(t),

with the place h(x_i) of the point on the body at neighbouring grid times, Lagrange weights ℓ at the
time of the image row shifted by τ, the stated pose T of the camera, the rotation R(a) about its
centre and the translation d by which the pose is off, and the projection π with the errors of the
focal length and of the principal point. τ is the delay of the clock, the error of the frame rate,
and the line delay times the row in which the point appears. The drift b of the tracker is the sum
of the first terms of the Karhunen–Loève series of a random walk.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from ...common.array_types import Array, Index
from ...program.association import Association
from ...program.correspondences import Correspondences
from ...program.custom_sensor_residual import is_within
from ...program.measurement_model import CorrespondenceModel
from ...program.measurement_residual import GROUP, RowStencil
from ...program.observables import PointPositions
from ...recording.nuisance import cayley_rotation
from .camera_images import LEAST_DEPTH_M, POSE_UNKNOWNS, CameraImagesResidual
from .places import TrackedPlaces
from .tracks import WALK_TERMS, ImageTracks, place_labels


@dataclass(frozen=True, eq=False)
class ImageTrackResidual(CameraImagesResidual):
    """Residual of the tracks of one camera; its entities are the points, its observable their
    positions.
    """

    sensor: ImageTracks
    observable: PointPositions
    correspondences: TrackedPlaces

    sigma_key = "sigma_px"
    is_compiled = True
    errs_slowly = True

    @cached_property
    def _stencil(self) -> RowStencil:
        """Data are those of `camera_data`, and the row of the point in the image."""
        places = self.point_times * self.observable.vector_count
        places += np.arange(self.observable.vector_count)[:, None]
        found = self.correspondences
        data = self.camera_data(found.rotations, found.translations)
        return RowStencil(places, np.moveaxis(np.dstack([data, self.rows]), 2, 0))

    @property
    def rows(self) -> Array:
        return np.nan_to_num(self.measured[..., 1])

    def expression(self, values: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """Return the pixel (u, v) of one point, and zero."""
        count = values.shape[1]
        *camera, row = ca.vertsplit(data, np.cumsum([0, values.shape[1], 1, 1, 9, 3, 1]).tolist())
        own = phi * self.nuisance.scales[self.own_parameters[0]][:, None]
        count = len(self.sensor.camera_unknowns(self.experiment))
        pixel = self.projected(self.known_errors(own[:count]), values, camera, row)
        drift = own[count:]
        if drift.numel():
            pixel = pixel + self._walk(drift, *camera[1:3])
        return ca.vertcat(pixel, 0)

    @staticmethod
    def _walk(drift: ca.SX, share: ca.SX, duration: ca.SX) -> ca.SX:
        """Return the drift (2,) from its terms, u first."""
        angles = [(k + 0.5) * np.pi for k in range(WALK_TERMS)]
        terms = [np.sqrt(2) / angle * ca.sin(angle * share) for angle in angles]
        walk = ca.sqrt(duration) * ca.vertcat(*terms)
        return ca.vertcat(ca.dot(walk, drift[:WALK_TERMS]), ca.dot(walk, drift[WALK_TERMS:]))

    def numbers(self, predicted: Array) -> Array:
        """Return pixels (S, 2N); NaN where the point is hidden, lost or not on the body."""
        pixels = predicted[..., :2]
        if self.sensor.pixels is not None:
            is_hidden = np.isfinite(self.sensor.pixels) & ~self.is_compared[..., :2]
            pixels = np.where(is_hidden[: len(pixels)], np.nan, pixels)
        return pixels.reshape(len(pixels), -1)

    def estimated_pose(self, phi: Array) -> Array:
        """Return the pose (4, 4) of the camera in the frame that carries it at φ (k,)."""
        errors = np.zeros(6)
        names = list(self.sensor.camera_unknowns(self.experiment))
        places = self.correspondences.pose_parameters
        estimated = [POSE_UNKNOWNS.index(name) for name in names if name in POSE_UNKNOWNS]
        errors[estimated] = (phi * self.nuisance.scales)[places]
        turned = np.array(ca.DM(cayley_rotation(ca.SX(ca.DM(errors[:3])))))
        pose = self.correspondences.pose.copy()
        pose[:3, 3] -= pose[:3, :3] @ turned.T @ errors[3:]
        pose[:3, :3] = pose[:3, :3] @ turned.T
        return pose

    def contour_px(self, k: int, x: Array, phi: Array) -> Array:
        """Return the contour of the body in the image with index k, as pixels (P, 2) of pieces of
        lines with NaN after each, at rows x (rows, 3n) and φ (k,); hidden pieces are contained.
        """
        errors = self.errors_at(phi)
        at_s = self.exposed_s(errors)[k]
        times = self.observable_s[: len(x)]
        after = int(np.clip(np.searchsorted(times, at_s), 1, max(len(times) - 1, 1)))
        before, after = after - 1, min(after, len(times) - 1)
        step_s = max(float(times[after] - times[before]), 1e-12)
        share = float(np.clip((at_s - times[before]) / step_s, 0.0, 1.0))
        shape_m = ((1 - share) * x[before] + share * x[after]).reshape(-1, 3)
        turn, shift = (
            np.array([errors.get(name, 0.0) for name in part])
            for part in (POSE_UNKNOWNS[:3], POSE_UNKNOWNS[3:])
        )
        turned = np.array(ca.DM(cayley_rotation(ca.SX(ca.DM(turn)))))
        found = self.correspondences
        own = (shape_m - found.translations[k]) @ found.rotations[k] @ turned.T + shift
        triangles = self.experiment.body.mesh.surface
        corners = own[triangles]
        if (corners[..., 2] <= LEAST_DEPTH_M).any():
            return np.full((1, 2), np.nan)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        is_facing = np.einsum("fi,fi->f", normals, corners[:, 0]) < 0
        edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        ends, which = np.unique(edges, axis=0, return_inverse=True)
        facing = np.bincount(which.ravel(), np.repeat(is_facing, 3), minlength=len(ends))
        camera = self.sensor.camera
        matrix = camera.require_matrix().copy()
        matrix[:2, :2] *= 1 + errors.get("focal_error", 0.0)
        matrix[:2, 2] += [errors.get("centre_u_px", 0.0), errors.get("centre_v_px", 0.0)]
        pixels = replace(camera, matrix=matrix).distorted_pixels(own)[ends[facing == 1]]
        return np.pad(pixels, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 2)

    @property
    def observable_sigmas(self) -> Array:
        rest_m = self.observable.association.prior_places_m
        return self.position_sigmas_m(rest_m, self.correspondences.translations, self.sigmas)

    # Correspondences --------------------------------------------------------------------------

    def reassociated(self, x: Array, phi: Array) -> TrackedPlaces:
        found = self.correspondences.followed(phi, self._shapes(x))
        return self.with_clock(found, self.errors_at(phi))

    def aligned_correspondences(
        self, x: Array, phi: Array, only_pose: bool = False
    ) -> TrackedPlaces:
        places = self.correspondences
        tracks, experiment = self.sensor, self.experiment
        if only_pose:
            return places

        def shapes_at(t_s: Array) -> Array:
            last_s = self.observable_s[len(x) - 1]
            late = np.abs(self.observable_s[: len(x)] - t_s[:, None])
            shapes = x[late.argmin(axis=1)].reshape(len(t_s), -1, 3)
            if self.t_s[0] <= last_s and (t_s > last_s).any():
                shapes[t_s > last_s] = experiment.rigid_positions(t_s[t_s > last_s])
            return shapes

        return TrackedPlaces.from_shapes(
            experiment, tracks, shapes_at, places.coordinate_parameters, places.pose_parameters
        )

    def correspondences_of(self, measured: ImageTracks, x: Array, phi: Array) -> TrackedPlaces:
        return replace(self.correspondences, tracks=measured).followed(phi, self._shapes(x))


class ImageTracksModel(CorrespondenceModel):
    """Tracks of one camera, whose places on the body follow the estimates."""

    measurement: ImageTracks

    @cached_property
    def _coordinate_parameters(self) -> Index:
        """Indices in φ (N, k) of the coordinates of the places; −1 for exact ones."""
        tracks, nuisance = self.measurement, self.grid.nuisance
        body = self.grid.experiment.body
        labels = [place_labels(name, body) for name in tracks.names]
        indices = np.full((len(labels), len(labels[0])), -1)
        for k in np.flatnonzero(tracks.place_sigmas_m(self.grid.experiment)).tolist():
            indices[k] = nuisance.indices_of_labels(labels[k])
        return indices

    @cached_property
    def _pose_parameters(self) -> Index:
        """Indices in φ of the errors of the pose that are estimated, rotation first."""
        tracks = self.measurement
        unknowns = tracks.camera_unknowns(self.grid.experiment)
        names = [name for name in POSE_UNKNOWNS if name in unknowns]
        return self.grid.nuisance.indices_of_labels(map(tracks.unknown_label, names))

    @cached_property
    def _own_parameters(self) -> Index:
        """Indices in φ (N, f) on which the pixels of each point depend besides its place."""
        tracks, nuisance = self.measurement, self.grid.nuisance
        experiment = self.grid.experiment
        labels = [tracks.unknown_label(name) for name in tracks.camera_unknowns(experiment)]
        drifts = tracks.drift_px(experiment) > 0
        return np.array(
            [
                nuisance.indices_of_labels([*labels, *(tracks.drift_labels(p) if drifts else ())])
                for p in tracks.names
            ]
        ).reshape(len(tracks.names), -1)

    def first_correspondences(self) -> TrackedPlaces:
        experiment = self.grid.experiment

        def shapes_at(t_s: Array) -> Array:
            return experiment.rigid_positions(np.clip(t_s, *experiment.t_s[[0, -1]]))

        return TrackedPlaces.from_shapes(
            experiment,
            self.measurement,
            shapes_at,
            self._coordinate_parameters,
            self._pose_parameters,
        )

    def residuals(
        self, association: Association, correspondences: Correspondences | None
    ) -> tuple[ImageTrackResidual]:
        assert isinstance(correspondences, TrackedPlaces)
        tracks, grid = self.measurement, self.grid
        places = replace(
            correspondences,
            coordinate_parameters=self._coordinate_parameters,
            pose_parameters=self._pose_parameters,
        )
        count = len(tracks.names)
        measured = np.full((len(tracks.sample_times_s), count, GROUP), np.nan)
        if tracks.pixels is not None:
            measured[..., :2] = tracks.pixels
        seen = tracks.is_seen & places.is_visible & places.is_placed
        exposed_s = tracks.exposed_s(grid.experiment, places.clock, np.nan_to_num(measured[..., 1]))
        seen &= is_within(exposed_s.ravel(), grid.t_s).reshape(seen.shape)
        return self.image_residual(
            ImageTrackResidual,
            observable=PointPositions(
                np.arange(len(grid.t_s)), places.association, self._coordinate_parameters
            ),
            names=tuple(f"{name} in {tracks.name}" for name in tracks.names),
            sigmas=np.full(count, tracks.sigma_px),
            measured=measured,
            is_compared=np.isfinite(measured) & seen[..., None],
            own_parameters=self._own_parameters,
            correspondences=places,
        )
