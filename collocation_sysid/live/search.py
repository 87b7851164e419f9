"""A start where there is no guess, or one that leads nowhere: a scan within frames' budgets."""

from __future__ import annotations

import numpy as np

from ..arrays import Array
from ..methods.scan import STIFFEST_PA, usual_parameters, without_guesses
from .model import Model
from .track import Track

# So many samples tell which stiffness to start from; trials whose squares are so many times the
# least are lost.
SEEN, WORSE = 20, 9.0
TRIED_PA = STIFFEST_PA * 10.0 ** (-0.5 * np.arange(11))


class Search:
    """Where to start, among stiffnesses from stiff to soft.

    Parameters
    ----------
    model : Model
    phi : (k,) nuisance parameters of every trial

    Attributes
    ----------
    rows : int
        That every trial passes.
    """

    def __init__(self, model: Model, phi: Array) -> None:
        self.rows = (SEEN - 1) * model.substeps + 1
        forgotten = without_guesses(model.collocation).parameters
        self._waiting = [usual_parameters(forgotten, young).guess_q for young in TRIED_PA]
        self._phi = phi
        self._tried: list[tuple[float, Array]] = []

    @property
    def done(self) -> bool:
        """Whether there is nothing left to try."""
        return not self._waiting

    def next(self) -> Array | None:
        """The next p to try."""
        return np.concatenate([self._waiting[0], self._phi]) if self._waiting else None

    def compare(self, track: Track) -> None:
        """Note what a trial gave; two in a row that are lost end it."""
        self._waiting.pop(0)
        self._tried.append((np.inf if track.failed else track.loss, track.p))
        least = min(loss for loss, _ in self._tried)
        worse = [not loss <= WORSE * least for loss, _ in self._tried]
        if np.isfinite(least) and all(worse[-2:]) and len(worse) > 2:
            self._waiting.clear()

    @property
    def best(self) -> Array | None:
        """Where the sum of squares was least."""
        loss, p = min(self._tried, key=lambda each: each[0])
        return p if np.isfinite(loss) else None
