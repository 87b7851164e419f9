"""Likely mistakes in the description of image tracks: cameras (`stated_cameras`), and single tracks,
which are compared with their predictions after a fit.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...common.array_types import Array
from ...methods.solution import Solution
from ...statistics.hypothesis import Hypothesis
from .residual import ImageTrackResidual

# Standard deviations of residuals from which a track is suspicious, if those of the others are below
# it, and over those of the others.
SUSPICIOUS = 5.0
EXPLAINED = 3.0


def fit_hypotheses(solution: Solution) -> Iterator[Hypothesis]:
    """Yield lost tracks."""
    for part in solution.parts:
        name = part.transcription.experiment.name
        pairs = zip(part.transcription.residuals, part.observables, strict=True)
        for residual, values in pairs:
            if isinstance(residual, ImageTrackResidual):
                predicted = residual.predict(values, part.phi)[..., :2]
                of = f"'{residual.sensor.name}' of '{name}'"
                yield from track_hypotheses(residual, predicted, of)


def track_hypotheses(
    residual: ImageTrackResidual, predicted: Array, of: str
) -> Iterator[Hypothesis]:
    """Yield the tracks of one camera that deviate far more than the others, which are explained.

    Parameters
    ----------
    predicted : (s, N, 2) array
        Predicted pixels of the first s images.
    of : str
        Camera and experiment, for messages.
    """
    compared = np.asarray(residual.is_compared[: len(predicted), :, :2].all(axis=2))
    measured = np.where(compared[..., None], residual.measured[: len(predicted), :, :2], np.nan)
    off = (measured - predicted) / residual.sensor.sigma_px
    used = np.flatnonzero(compared.any(axis=0)).tolist()
    rms = {k: float(np.sqrt(np.nanmean(off[:, k] ** 2))) for k in used}
    usual = float(np.median([*rms.values()])) if rms else 0.0
    # Where the others are not explained either, something else is wrong.
    for k in used if usual < SUSPICIOUS else ():
        if rms[k] >= SUSPICIOUS and rms[k] >= EXPLAINED * usual:
            data = {"point": residual.sensor.names[k], "sigmas": rms[k], "others": usual}
            strength = rms[k] / max(usual, 1.0)
            yield Hypothesis("image-track", of, data=data, strength=strength)
