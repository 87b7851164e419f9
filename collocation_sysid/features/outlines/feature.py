"""Outlines in checks and runs: masks that do not show the body, and notes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...program.collocation import ExperimentIterate
from ...recording.experiment import Experiment
from ...statistics.misspecification.hypothesis import Hypothesis
from ..feature import Feature
from .outlines import Outlines, mask_of
from .residual import OutlinesResidual

# Share of the body carried rigidly, in the image, of which a mask must show any.
LEAST_COMMON = 0.05
MESSAGES = {
    "description/outlines": "the mask at {t_s:.4g} s shows {common:.0%} of where the body is "
    "({mask_px} pixels, the body {body_px}): check camera.pose (x to the right, y down, z forward, in "
    "metres), the calibration, and that the mask is one of the body"
}


def hypotheses(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield a hypothesis for each camera whose first mask is not where the body appears that its
    grasp carries rigidly.
    """
    for outlines in experiment.readings:
        if not isinstance(outlines, Outlines):
            continue
        present = [k for k, mask in enumerate(outlines.all_masks) if mask is not None]
        if not present:
            continue
        t_s = float(outlines.sample_times_s[present[0]])
        mask = np.asarray(outlines.all_masks[present[0]])
        at_s = np.clip([t_s], *experiment.t_s[[0, -1]])
        body = mask_of(outlines, experiment, experiment.rigid_positions(at_s)[0], t_s, mask.shape)
        common = float((mask & body).sum() / max(1, min(mask.sum(), body.sum())))
        if common < LEAST_COMMON:
            data = {
                "t_s": t_s,
                "common": common,
                "mask_px": int(mask.sum()),
                "body_px": int(body.sum()),
            }
            of = f"'{outlines.name}' of '{experiment.name}'"
            yield Hypothesis("outlines", of, data=data, strength=1.0)


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


OUTLINES = Feature(messages=MESSAGES, hypotheses=hypotheses, notes=notes)
