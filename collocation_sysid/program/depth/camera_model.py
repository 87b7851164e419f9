"""Model of a depth camera: pose, errors of pose and depth, and points in the world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ...common.array_types import Array, Index
from ...model.generated_functions import GeneratedFunction
from ...model.nuisance_map import NuisanceMap
from ...recording.depth_camera import Depth
from ...recording.deviation import Deviation
from ...recording.experiment import Experiment
from ...recording.nuisance import (
    DEPTH_BIAS,
    DEPTH_EDGE,
    DEPTH_SCALE,
    DEPTH_SHIFT,
    DEPTH_TIME,
    DEPTH_TURN,
    cayley_rotation,
)

# Kinds of nuisance parameters of a depth camera.
OF_CAMERA = (DEPTH_TURN, DEPTH_SHIFT, DEPTH_BIAS, DEPTH_SCALE, DEPTH_TIME, DEPTH_EDGE)
# One over the prior standard deviation of a pose error that is not estimated [1/rad, 1/m].
EXACT = 1e6


@dataclass(frozen=True, eq=False)
class DepthCameraModel:
    """Depth camera with its estimated errors."""

    depth: Depth  # the camera and its measured points
    camera_index: int  # index of the camera in the experiment
    # Nuisance parameters of the experiment, which include the camera's errors.
    nuisance: NuisanceMap
    # (3,): point about which the rotation error acts, the middle of the body, in the camera's frame
    # [m].
    pivot_m: Array
    size_m: float  # diagonal of the undeformed body [m]

    @classmethod
    def from_experiment(
        cls, experiment: Experiment, camera_index: int, nuisance: NuisanceMap
    ) -> DepthCameraModel:
        """Build the model of the camera with index `camera_index` of an experiment, with its
        nuisance parameters in `nuisance`.
        """
        depth = experiment.depths[camera_index]
        rotations, translations = depth.camera.pose_at(depth.sample_times_s[:1])
        pivot_m = (experiment.body.nodes_m.mean(axis=0) - translations[0]) @ rotations[0]
        size_m = float(np.linalg.norm(np.ptp(experiment.body.nodes_m, axis=0)))
        return cls(depth, camera_index, nuisance=nuisance, pivot_m=pivot_m, size_m=size_m)

    @cached_property
    def depth_expressions(self) -> dict[tuple[int, int], Any]:
        """Cache of the generated functions of its depth residuals, shared by all copies of the
        measurement model; empty at first.
        """
        return {}

    @cached_property
    def surface_observables(self) -> dict[int, Any]:
        """Cache of the surface's nodes as an observable, by the number of times; empty at first."""
        return {}

    @cached_property
    def alignment_clouds(self) -> dict[int, Any]:
        """Points of images for alignments, by index of the image; empty at first."""
        return {}

    @cached_property
    def outline_expressions(self) -> dict[tuple[int, int], Any]:
        """Cache of the generated functions of its outline residuals, shared by all copies of the
        measurement model; empty at first.
        """
        return {}

    @cached_property
    def parameter_indices(self) -> Index:
        """Indices in φ of the camera's nuisance parameters, of all kinds in `OF_CAMERA`; empty if
        none is estimated.
        """
        return self.nuisance.indices_of_rows(*OF_CAMERA, component=self.camera_index)

    @cached_property
    def poses(self) -> tuple[Array, Array]:
        """Stated rotations (S, 3, 3) and translations (S, 3) [m] from the camera's frame to the
        world, at each of S images, without estimated errors.
        """
        return self.depth.camera.pose_at(self.depth.sample_times_s)

    @cached_property
    def rays(self) -> list[Array]:
        """For each image, directions (P, 3) in the camera's frame in which points move per metre as
        their depth grows; zeros for point clouds without a camera matrix.
        """
        clouds = self.depth.points_m
        pinhole = self.depth.camera.matrix is not None
        return [p / p[:, 2:] if pinhole else np.zeros_like(p) for p in clouds]

    def share_alignment_clouds(self, other: DepthCameraModel) -> None:
        """Use the points for alignments of another model of the camera from now on, if both have
        the same measured points.
        """
        if self.depth is other.depth:
            vars(self)["alignment_clouds"] = other.alignment_clouds

    def corrected_expression(
        self, point: ca.SX, ray: ca.SX, values: Mapping[Deviation, ca.SX]
    ) -> ca.SX:
        """Return the expression (3,) of a point in the camera's stated frame [m], corrected by the
        estimated errors.

        Scale and bias of the depth are applied first, then the rotation about `pivot_m`, then the
        translation.

        Parameters
        ----------
        point : (3,) SX
            Measured point [m].
        ray : (3,) SX
            Direction of its depth.
        values : mapping of Deviation to SX
            Errors in physical units; missing ones are zero.
        """
        point = (1 + values.get(DEPTH_SCALE, 0)) * point + values.get(DEPTH_BIAS, 0) * ray
        if DEPTH_TURN in values:
            pivot = ca.DM(self.pivot_m)
            point = cayley_rotation(values[DEPTH_TURN]) @ (point - pivot) + pivot
        return point + values.get(DEPTH_SHIFT, 0)

    @cached_property
    def _correction(self) -> GeneratedFunction:
        """`corrected_expression` of φ; data are a point and its ray (6,)."""

        def expression(own: ca.SX, data: ca.SX) -> ca.SX:
            values = self.nuisance.values_by_row(own, self.parameter_indices)
            return self.corrected_expression(data[:3], data[3:], values=values)

        return GeneratedFunction(expression, len(self.parameter_indices), data_size=6)

    def world_points(self, phi: Array, image: int) -> Array:
        """Return the measured points (P, 3) of an image in the world [m], corrected at φ.

        Parameters
        ----------
        phi : (k,) array
            Nuisance parameters.
        image : int
            Index of the image.
        """
        return self.to_world(phi, self.depth.points_m[image], rays=self.rays[image], image=image)

    def to_world(self, phi: Array, points: Array, rays: Array, image: int) -> Array:
        """Return points (P, 3) of the camera's frame in the world [m], corrected at φ (k,).

        Parameters
        ----------
        phi : (k,) array
            Nuisance parameters.
        points : (P, 3) array
            Points in the camera's frame [m].
        rays : (P, 3) array
            Directions of their depths; zeros if no bias of the depth is to be applied.
        image : int
            Index of the image.
        """
        # The correction is affine: its values at seven points determine it for all.
        basis = np.eye(6, 7, k=1)
        origin, *axes = self._correction.evaluate(phi[self.parameter_indices], basis).T
        rotations, translations = self.poses
        turn = rotations[image].T
        slopes = (np.stack(axes) - origin) @ turn
        world = points @ slopes[:3]
        if rays.any():
            world += rays @ slopes[3:]
        world += origin @ turn + translations[image]
        return world

    def body_middle_m(self, sample: int) -> Array:
        """Return the middle (3,) of the undeformed body, carried by the first pose, in the camera's
        stated frame at the image with index `sample` [m].
        """
        rotations, translations = self.poses
        middle_m = rotations[0] @ self.pivot_m + translations[0]
        return (middle_m - translations[sample]) @ rotations[sample]

    def to_camera_m(self, phi: Array, points_m: Array, sample: int) -> Array:
        """Return points (P, 3) of the world [m] in the camera's frame at φ and the image with index
        `sample` [m]: the inverse of `to_world` without bias of the depth, but with its scale.
        """
        basis = np.vstack([np.zeros(3), np.eye(3)])
        corner, *axes = self.to_world(phi, basis, rays=np.zeros((4, 3)), image=sample)
        return np.linalg.solve((axes - corner).T, (points_m - corner).T).T

    def parameter_values(self, phi: Array) -> dict[str, float]:
        """Return the camera's nuisance parameters in physical units by label, from φ (k,)."""
        entries = self.nuisance.entries
        values = phi * self.nuisance.scales
        return {entries[k].label: float(values[k]) for k in self.parameter_indices}

    def parameters_from(self, physical_values: Mapping[str, float]) -> Array:
        """Return φ (k,) of the experiment with the given values in physical units by label; entries
        without a value are zero, and unknown labels are ignored.
        """
        values = [physical_values.get(entry.label, 0.0) for entry in self.nuisance.entries]
        return np.array(values) / self.nuisance.scales

    def eye_m(self, phi: Array, sample: int) -> Array | None:
        """Return the position (3,) of the camera in the world at φ (k,) and the image with index
        `sample` [m]; None for a point cloud without camera.
        """
        if self.depth.camera.matrix is None:
            return None
        return self.to_world(phi, np.zeros((1, 3)), rays=np.zeros((1, 3)), image=sample)[0]

    def prior_weights(self, row: Deviation) -> Array:
        """Return one over the prior standard deviations (3,) of the camera's rotation [1/rad] or
        translation [1/m], for `row` DEPTH_TURN or DEPTH_SHIFT; `EXACT` if it is not estimated.
        """
        places = self.nuisance.indices_of_rows(row, component=self.camera_index)
        return 1 / self.nuisance.scales[places] if len(places) else np.full(3, EXACT)

    def clock_shift_s(self, phi: Array) -> float:
        """Return by how much images are taken later than stated [s] at φ (k,); 0 if it is not
        estimated.
        """
        places = self.nuisance.indices_of_rows(DEPTH_TIME, component=self.camera_index)
        return float((phi * self.nuisance.scales)[places].sum())

    def with_pose(self, phi: Array, rotation_vector: Array, shift_m: Array) -> Array:
        """Return a copy of φ (k,) with another rotation error `rotation_vector` (3,) [rad] and
        translation error `shift_m` (3,) of the camera; an error that is not estimated is ignored.
        """
        updated = phi.copy()
        angle = np.linalg.norm(rotation_vector)
        cayley = rotation_vector * (2 * np.tan(angle / 2) / angle if angle else 1.0)
        for row, values in ((DEPTH_TURN, cayley), (DEPTH_SHIFT, shift_m)):
            places = self.nuisance.indices_of_rows(row, component=self.camera_index)
            updated[places] = values[: len(places)] / self.nuisance.scales[places]
        return updated
