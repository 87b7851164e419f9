"""Predictions of all measurements of an experiment by a fit or a simulated motion, in the order of
`Experiment.measurements`.
"""

from __future__ import annotations

from collections.abc import Iterator

from ..common.array_types import Array
from .depth.surface_comparison import SurfaceComparison
from .experiment_iterate import ExperimentIterate
from .measurement_residual import SampledMotion
from .observables import ObservedMotion
from .reactions.resultant import ReactionGrid
from .simulation import Trajectory
from .transcription import Transcription

# Predicted numbers (S, m) of a measurement, NaN where a sample is not predicted; of a depth camera
# the comparison of its points with the surface.
Predicted = Array | SurfaceComparison


def fitted_values(part: ExperimentIterate) -> tuple[Predicted, ...]:
    """Return the predictions of the measurements of an experiment by its fit."""
    return tuple(
        model.fitted(part.motion_for(model.observable), part.phi)
        for model in part.transcription.main_residuals
    )


def simulated_values(
    transcription: Transcription, trajectory: Trajectory, phi: Array
) -> tuple[Predicted, ...]:
    """Return the predictions of the measurements of an experiment by a simulated motion, at φ."""
    return tuple(model.simulated(trajectory.sampled, phi) for model in transcription.main_residuals)


def residual_changes(
    part: ExperimentIterate, trajectory: Trajectory, share: float
) -> Iterator[Array]:
    """Yield the changes (S, M, 3) of the residuals of an experiment for `share` times the
    difference between a simulated motion and the fit, in the order of `Transcription.residuals`;
    zero where not predicted. Those of surface points are of first order, at the correspondences of
    the fit.
    """
    transcription = part.transcription
    rows = transcription.sample_rows
    fitted = SampledMotion(
        transcription.experiment.t_s,
        ReactionGrid.from_dynamics(transcription.dynamics),
        ObservedMotion(part.x[rows], part.reactions),
    )
    for model, values in zip(transcription.residuals, part.observables, strict=True):
        yield model.changes(values, fitted, trajectory.sampled, phi=part.phi, share=share)
