"""Likely mistakes in the description of outlines: masks that do not show the body."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...judge.source import Source
from ...recording.experiment import Experiment
from ...statistics.hypothesis import Hypothesis
from .outlines import Outlines, mask_of

# Share of the body carried rigidly, in the image, of which a mask must show any.
LEAST_COMMON = 0.05


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


OUTLINES = Source(described=hypotheses)
