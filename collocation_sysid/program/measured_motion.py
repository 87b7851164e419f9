"""Predictions of all measurements of an experiment by a fit or a simulated motion, in the order of
`Experiment.measurements`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..common.array_types import Array
from .depth.depth_comparison import SurfaceComparison, surface_residuals
from .depth.depth_residual import DepthResidual
from .experiment_iterate import ExperimentIterate
from .measurement_residual import MeasurementResidual
from .observables import ObservedMotion
from .reactions.reaction_resultant import ReactionGrid
from .simulation import Trajectory
from .transcription import Transcription

# Predicted numbers (S, m) of a measurement, NaN where a sample is not predicted; of a depth camera
# the comparison of its points with the surface.
Predicted = Array | SurfaceComparison


def fitted_values(part: ExperimentIterate) -> tuple[Predicted, ...]:
    """Return the predictions of the measurements of an experiment by its fit."""
    transcription = part.transcription
    pairs = zip(transcription.residuals, part.observables, strict=True)
    observed = {id(model): values for model, values in pairs}
    return tuple(
        SurfaceComparison.from_fit(model, part.x, values=observed[id(model)], phi=part.phi)
        if isinstance(model, DepthResidual)
        else model.numbers(model.predict_motion(part.motion_for(model.observable), part.phi))
        for model in transcription.measurement_models
    )


def predict_trajectory(model: MeasurementResidual, trajectory: Trajectory, phi: Array) -> Array:
    """Return the predictions (S, G, g) of one measurement by a simulated motion, at φ (k,)."""
    at_samples = model.at_samples(trajectory.t_s, trajectory.reactions[0])
    return at_samples.predict_motion(trajectory.observed, phi)


def simulated_values(
    transcription: Transcription, trajectory: Trajectory, phi: Array
) -> tuple[Predicted, ...]:
    """Return the predictions of the measurements of an experiment by a simulated motion, at φ."""
    return tuple(
        SurfaceComparison.from_motion(model, trajectory, phi)
        if isinstance(model, DepthResidual)
        else model.numbers(predict_trajectory(model, trajectory, phi))
        for model in transcription.measurement_models
    )


def residual_changes(
    part: ExperimentIterate, trajectory: Trajectory, share: float
) -> Iterator[Array]:
    """Yield the changes (S, M, 3) of the residuals of an experiment for `share` times the
    difference between a simulated motion and the fit, in the order of `Transcription.residuals`;
    zero where not predicted. Those of surface points are of first order, at the correspondences of
    the fit.
    """
    transcription = part.transcription
    t_s = transcription.experiment.t_s
    fitted = ObservedMotion(part.x[transcription.markers.observable.rows], part.reactions)
    grid = ReactionGrid.from_dynamics(transcription.dynamics)
    for model in transcription.residuals:
        if not isinstance(model, DepthResidual):
            of_fit = model.at_samples(t_s, grid).predict_motion(fitted, part.phi)
            of_simulation = predict_trajectory(model, trajectory, part.phi)
            yield share * np.nan_to_num((of_simulation - of_fit) / model.sigmas[:, None])
    if not (surfaces := surface_residuals(part)):
        return
    rows_s = transcription.dynamics.t_s
    way_m = [
        np.interp(rows_s, t_s, each) for each in (share * (trajectory.observed.x - fitted.x)).T
    ]
    displacements_m = np.transpose(way_m).reshape(len(rows_s), -1, 3, 1)
    for model, values in surfaces:
        nodes = model.correspondences.surface.nodes
        yield model.residual_changes(values, displacements_m[:, nodes], phi=part.phi)[..., 0]
