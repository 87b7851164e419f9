"""Outlines in checks and runs: masks that do not show the body, and notes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...program.collocation import ExperimentIterate
from .residual import OutlinesResidual


def notes(part: ExperimentIterate) -> Iterator[str]:
    """Yield a note for each camera: how many points are compared, and how far they are off."""
    pairs = zip(part.transcription.residuals, part.observables, strict=True)
    for residual, values in pairs:
        if not isinstance(residual, OutlinesResidual):
            continue
        off = residual.predict(values, part.phi)[..., 0]
        compared = residual.is_compared[: len(off), :, 0]
        rms = float(np.sqrt(np.mean(off[compared] ** 2))) if compared.any() else np.nan
        yield (
            f"experiment '{part.transcription.experiment.name}': {compared.sum()} points of the "
            f"outline in {compared.any(axis=1).sum()} masks of '{residual.sensor.name}' are "
            f"{rms:.3g} pixels (RMS) from the edge"
        )
