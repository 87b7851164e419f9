"""Depth cameras and scanners as measurements with correspondences."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ...recording.depth_camera import Depth
from ..association import Association
from ..correspondences import Correspondences
from ..measurement_model import CorrespondenceModel
from .camera_model import DepthCameraModel
from .outline_residual import OutlineResidual
from .residual import DepthResidual
from .surface_correspondences import SurfaceCorrespondences
from .visible_surface import VisibleSurface


class DepthModel(CorrespondenceModel):
    """Points of a depth camera, and the outlines in its images if it has images."""

    measurement: Depth

    @cached_property
    def camera(self) -> DepthCameraModel:
        """Model of the camera, which does not depend on the correspondences."""
        return DepthCameraModel.from_experiment(
            self.grid.experiment, self.number, nuisance=self.grid.nuisance
        )

    def first_correspondences(self) -> SurfaceCorrespondences:
        experiment = self.grid.experiment
        nodes = VisibleSurface.from_body(experiment.body, self.measurement).nodes
        shapes_m = experiment.rigid_positions(self.measurement.sample_times_s)
        phi = np.zeros(self.grid.nuisance.size)
        return SurfaceCorrespondences.from_alignment(
            self.camera, experiment.body, shapes_m=shapes_m[:, nodes], phi=phi
        )

    def residuals(
        self, association: Association, correspondences: Correspondences | None
    ) -> tuple[DepthResidual, ...]:
        """Return the residuals of the points and, if there are images, of the outlines."""
        assert isinstance(correspondences, SurfaceCorrespondences)
        points = DepthResidual.from_correspondences(
            correspondences.with_camera(self.camera),
            self.grid.t_s,
            nuisance=self.grid.nuisance,
            huber=self.grid.huber,
        )
        has_images = len(points.correspondences.camera.depth.images_m) > 0
        return (points, OutlineResidual.from_depth(points)) if has_images else (points,)
