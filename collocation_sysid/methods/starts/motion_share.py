"""First parts of recordings, chosen by the motion in them.

A recording may begin and end at rest, where nothing depends on the stiffness. So a share of a
recording is measured by what its instruments see besides a rigid motion with the grasps: the squares
of the changes, in standard deviations, of the residuals of an undeformed body since the first sample.
"""

from __future__ import annotations

import numpy as np

from ...common.array_types import Array
from ...program.collocation import Collocation
from ...program.experiment_iterate import ExperimentIterate
from ..options import FEWEST


def motion_shares(collocation: Collocation) -> list[Array]:
    """Return for each experiment the share (N,), up to each grid time, of all motion that its
    instruments see; the share of the grid times where they see none. Every parameter must have a
    guess.
    """
    positions = [
        transcription.experiment.rigid_positions(transcription.dynamics.t_s)
        for transcription in collocation.transcriptions
    ]
    rigid = collocation.iterates_at(
        collocation.guess_p, [each.reshape(len(each), -1) for each in positions]
    )
    return [_motion_share(iterate) for iterate in rigid]


def rows_of_share(motion: Array, share: float) -> int:
    """Return the number of first rows of a grid with a share, from 0 to 1, of the motion, see
    `motion_shares`; at least `FEWEST`, at most all, which are those of the share one.
    """
    rows = len(motion) if share >= 1 else int(np.searchsorted(motion, share)) + 1
    return min(len(motion), max(FEWEST, rows))


def _motion_share(rigid: ExperimentIterate) -> Array:
    transcription = rigid.transcription
    t_s = transcription.dynamics.t_s
    squares = np.zeros(len(t_s))
    for kind, values in zip(transcription.residuals, rigid.observables, strict=True):
        residuals = kind.residuals(values, rigid.phi)
        is_compared = kind.compared_with(len(values))[: len(residuals)]
        first = np.take_along_axis(residuals, is_compared.argmax(axis=0)[None], axis=0)
        changes = np.where(is_compared, np.nan_to_num(residuals - first), 0.0)
        rows = np.searchsorted(t_s, kind.t_s[: len(residuals)]).clip(max=len(t_s) - 1)
        np.add.at(squares, rows, np.sum(changes**2, axis=(1, 2)))
    seen = np.cumsum(squares if squares.any() else np.ones(len(t_s)))
    return seen / seen[-1]
