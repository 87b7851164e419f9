"""Unlabelled points in one experiment: models of the sensors that measure them, the first
correspondences with the body, and the measurement models.

This is the list of such sensors for the rest of the program: depth cameras and scanners. Their
implementation is in the package `depth`, their interface in `correspondences`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..common.array_types import Array
from ..model.nuisance_map import NuisanceMap
from ..recording.experiment import Experiment
from .correspondences import CorrespondenceResidual, Correspondences
from .depth.depth_camera_model import DepthCameraModel
from .depth.depth_residual import DepthResidual
from .depth.outline_residual import OutlineResidual
from .depth.surface_correspondences import SurfaceCorrespondences
from .depth.visible_surface import VisibleSurface

# Models of the sensors, in the order of their correspondences.
SensorModels = tuple[DepthCameraModel, ...]


def sensor_models(experiment: Experiment, nuisance: NuisanceMap) -> SensorModels:
    """Return the models of all sensors that measure unlabelled points, in the order of their
    correspondences; they do not depend on these.

    Parameters
    ----------
    experiment : Experiment
    nuisance : NuisanceMap
        Nuisance parameters of the experiment.
    """
    return tuple(
        DepthCameraModel.from_experiment(experiment, k, nuisance=nuisance)
        for k in range(len(experiment.depths))
    )


def declared_points(experiment: Experiment) -> list[object]:
    """Return the unlabelled measurements of an experiment, in the order of their
    correspondences.
    """
    return [*experiment.depths]


def initial_correspondences(experiment: Experiment) -> tuple[Correspondences, ...]:
    """Return the correspondences of each sensor with the undeformed body in its grasps, after an
    alignment of the sensor; empty without unlabelled measurements.
    """
    if not experiment.depths:
        return ()
    nuisance = NuisanceMap.from_experiment(experiment)
    correspondences = []
    for camera in sensor_models(experiment, nuisance):
        nodes = VisibleSurface.from_body(experiment.body, camera.depth).nodes
        shapes_m = experiment.rigid_positions(camera.depth.sample_times_s)
        correspondences.append(
            SurfaceCorrespondences.from_alignment(
                camera, experiment.body, shapes_m=shapes_m[:, nodes], phi=np.zeros(nuisance.size)
            )
        )
    return tuple(correspondences)


def residuals_of_points(
    correspondences: Sequence[Correspondences],
    models: SensorModels,
    at_s: Array,
    nuisance: NuisanceMap,
    huber: float | None,
) -> tuple[CorrespondenceResidual, ...]:
    """Return the measurement models at given correspondences: one for each of them, in their
    order, then those of outlines in the images of the same sensors.

    Parameters
    ----------
    correspondences : sequence of Correspondences
        Correspondences of all sensors.
    models : tuple of DepthCameraModel
        Models of the sensors in the same order, see `sensor_models`.
    at_s : (n,) array
        Times at which positions are known [s].
    nuisance : NuisanceMap
        Nuisance parameters of the experiment.
    huber : float or None
        Threshold of Huber's loss in standard deviations; None for the default of each sensor.
    """
    points = []
    for each, camera in zip(correspondences, models, strict=True):
        assert isinstance(each, SurfaceCorrespondences)
        points.append(
            DepthResidual.from_correspondences(
                each.with_camera(camera), at_s, nuisance=nuisance, huber=huber
            )
        )
    outlines = [
        OutlineResidual.from_depth(each)
        for each in points
        if len(each.correspondences.camera.depth.images_m)
    ]
    return (*points, *outlines)
