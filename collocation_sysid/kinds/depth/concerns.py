"""Depth cameras in checks and runs: points and outlines compared with the surface of a motion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ...common.array_types import Array
from ...features.measurements import PredictionErrors
from ...methods.solution import Solution
from ...program.collocation import ExperimentIterate
from ...program.depth.comparison import depth_residuals, outline_distances_px
from ...recording.nuisance import DEPTH_SHIFT, DEPTH_TURN
from ...statistics.concerns import Concern, concern_if
from ...statistics.hypothesis import Hypothesis
from .poses import camera_hypotheses

# Messages of concerns about a fit or a prediction, by code.
MESSAGES = {
    "residuals/outline": "{percent:.0f} % of the model's outline are more than {pixels:.0f} pixels "
    "away from the edge of the body in the images of {camera}: the body may be grasped "
    "at another place, be partly hidden, or have another stiffness; if depths are "
    'missing on the body itself, state background = "unknown"',
    "nuisance/camera": "{name} is {deviations:.1f} standard deviations of its prior away from the "
    "stated pose: another stiffness may fit equally well with another pose of the "
    "camera; measure the pose, or state how well it is known (nuisance.depth_pose)",
    "prediction/unseen": "none of the {seen} points of {camera} is near the predicted surface of "
    "'{experiment}': check camera.pose and the unit of the depth",
}
# Pose of a depth camera in standard deviations of its prior: "check", because it compensates wrong
# shapes.
LARGEST_CAMERA_OFFSET = 2.0
# Distance of outline points from the edge [pixels] that needs an explanation: edges of pixels
# scatter by 0.3, lenses and wrong depths at edges by one.
LARGEST_OUTLINE_DISTANCE_PX = 3.0
# Share of outline points that may be farther.
OUTLINE_SHARE = 0.1
# Excluded points in notes, by the reason for which they are not compared.
EXCLUSION_WORDS = {
    "far": "farther from the body than gate_m",
    "grazing": "on faces seen at a grazing angle",
    "turned away": "on faces turned away from the camera",
    "not chosen": "on faces that are not selected",
    "hidden": "on hidden faces",
    "crease": "near a crease",
}


def concerns(parts: Sequence[ExperimentIterate]) -> Iterator[Concern]:
    """Yield concerns about the estimated poses of the cameras, and about outlines."""
    for part in parts:
        yield from _part_concerns(part)


def _part_concerns(part: ExperimentIterate) -> Iterator[Concern]:
    experiment = part.transcription.experiment
    nuisance = part.transcription.nuisance
    for camera in range(len(experiment.depths)):
        pose = nuisance.indices_of_rows(DEPTH_TURN, DEPTH_SHIFT, component=camera)
        yield from camera_pose_concerns([nuisance.names[k] for k in pose], part.phi[pose].tolist())
    for residual, distance_px in outline_distances_px(part):
        name = residual.correspondences.camera.depth.name
        yield from outline_concerns(f"'{name}' of '{experiment.name}'", distance_px)


def camera_pose_concerns(names: Sequence[str], deviations: Sequence[float]) -> list[Concern]:
    """Return one concern, as a list, if a component of a depth camera's pose error exceeds
    `LARGEST_CAMERA_OFFSET` standard deviations, about the largest component; else empty, also
    without components.

    A wrong shape of the body often fits with a camera that is rotated and translated to match.

    Parameters
    ----------
    names : (k,) sequence of str
        Labels of the rotation and translation errors of one camera.
    deviations : (k,) sequence of float
        Their values in standard deviations of their priors.
    """
    if not len(names):
        return []
    worst = int(np.argmax(np.abs(deviations)))
    deviation = abs(float(deviations[worst]))
    return concern_if(
        deviation > LARGEST_CAMERA_OFFSET,
        False,
        code="nuisance/camera",
        name=names[worst],
        deviations=deviation,
    )


def outline_concerns(camera: str, distances_px: Array) -> list[Concern]:
    """Return one concern, as a list, if more than `OUTLINE_SHARE` of the outline points are farther
    than `LARGEST_OUTLINE_DISTANCE_PX` from the edges in a camera's images; else empty, also
    without points.

    Parameters
    ----------
    camera : str
        Name of the depth camera and of its experiment, for the message.
    distances_px : (n,) array
        Distances of outline points from the edges in the images, of either sign [pixels].
    """
    share = (
        float(np.mean(np.abs(distances_px) > LARGEST_OUTLINE_DISTANCE_PX))
        if len(distances_px)
        else 0.0
    )
    return concern_if(
        share > OUTLINE_SHARE,
        False,
        code="residuals/outline",
        camera=camera,
        pixels=LARGEST_OUTLINE_DISTANCE_PX,
        percent=100 * share,
    )


def simulation_concerns(name: str, error: PredictionErrors) -> Iterator[Concern]:
    """Yield a concern for each camera of the experiment `name` without a point within its gate of
    the simulated surface.
    """
    for camera, distances in (error.depth or {}).items():
        if not distances.points:
            data = {"experiment": name, "camera": camera, "seen": distances.compared_points}
            yield Concern("prediction/unseen", "doubtful", data=data)


def notes(part: ExperimentIterate) -> Iterator[str]:
    """Yield notes on the distances of points and outlines from the fitted surface, per camera;
    first on all points, then on all outlines.
    """
    name = part.transcription.experiment.name
    for residual, observation in depth_residuals(part):
        distance_m = residual.signed_distances_m(observation, part.phi)
        correspondences = residual.correspondences
        excluded = ", ".join(
            f"{count} {EXCLUSION_WORDS[why]}"
            for why, count in correspondences.excluded_counts.items()
            if count
        )
        distances = "are compared, because no point is near enough to the body"
        if correspondences.is_compared.any():
            distances = (
                f"deviate from the surface by {1e3 * np.sqrt(np.nanmean(distance_m**2)):.3g} "
                f"mm (RMS; median {1e3 * np.nanmedian(np.abs(distance_m)):.3g} mm)"
            )
        yield (
            f"experiment '{name}': {correspondences.is_compared.sum()} "
            f"points of '{correspondences.camera.depth.name}' {distances}; excluded: "
            f"{excluded or 'none'}"
        )
    for outline, distance_px in outline_distances_px(part):
        if len(distance_px):
            yield (
                f"experiment '{name}': {len(distance_px)} points of "
                "the model's outline deviate from the edges in "
                f"'{outline.correspondences.camera.depth.name}' by "
                f"{np.sqrt(np.mean(distance_px**2)):.2g} pixels (RMS)"
            )


def fit_hypotheses(solution: Solution) -> Iterator[Hypothesis]:
    """Yield likely mistakes of the cameras of a fit."""
    for part in solution.parts:
        yield from camera_hypotheses(part.transcription.experiment)
