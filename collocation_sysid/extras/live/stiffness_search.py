"""Search for initial values over a range of stiffness, within the computing time of frames.

It is used if there is no guess, or if the estimation does not converge from the guess.
"""

from __future__ import annotations

import numpy as np

from ...common.array_types import Array
from ...methods.starts.stiffness_scan import STIFFEST_PA, typical_parameters, without_guesses
from ...program.streaming import StreamingModel
from .window_pass import WindowPass

# Number of samples that decide which stiffness to start from.
TRIAL_SAMPLES = 20
# Ratio of a trial's sum of squares to the smallest one above which the trial has failed.
FAILURE_RATIO = 9.0
# Stiffnesses of the trials [Pa], two per decade.
TRIED_PA = STIFFEST_PA * 10.0 ** (-0.5 * np.arange(11))


class StiffnessSearch:
    """Search for initial values with one trial per stiffness of `TRIED_PA`, from stiff to soft.

    The parameters of a trial are typical ones of a body with that Young's modulus. The search
    runs no simulation itself: the caller computes a pass at `next_trial` and hands it to
    `record_trial`, until `is_done`.

    Parameters
    ----------
    model : StreamingModel
        Model whose guesses are replaced.
    phi : (k,)
        Nuisance parameters of every trial.

    Attributes
    ----------
    rows : int
        Number of rows of every trial.
    """

    def __init__(self, model: StreamingModel, phi: Array) -> None:
        self.rows = (TRIAL_SAMPLES - 1) * model.collocation.substeps + 1
        forgotten = without_guesses(model.collocation).parameters
        self._waiting = [typical_parameters(forgotten, young).guess_q for young in TRIED_PA]
        self._phi = phi
        self._tried: list[tuple[float, Array]] = []

    @property
    def is_done(self) -> bool:
        """Whether no trial is left."""
        return not self._waiting

    def next_trial(self) -> Array | None:
        """Return the parameters p (P,) of the next trial, material parameters followed by nuisance
        parameters in the solver's coordinates; None if no trial is left. Repeated calls return the
        same, until `record_trial` advances to the trial after it.
        """
        return np.concatenate([self._waiting[0], self._phi]) if self._waiting else None

    def record_trial(self, trial: WindowPass) -> None:
        """Record the loss of the pass `trial` as the result of the next trial; a failed pass has an
        infinite loss.

        After at least one success and at least three trials, the search ends if each of the last
        two losses exceeds `FAILURE_RATIO` times the smallest one.

        Raises
        ------
        IndexError
            If no trial is left.
        """
        self._waiting.pop(0)
        self._tried.append((np.inf if trial.has_failed else trial.compute_loss(), trial.sweep.p))
        least = min(loss for loss, _ in self._tried)
        worse = [not loss <= FAILURE_RATIO * least for loss, _ in self._tried]
        if np.isfinite(least) and all(worse[-2:]) and len(worse) > 2:
            self._waiting.clear()

    def find_best(self) -> Array | None:
        """Return the parameters p (P,) of the pass with the smallest loss, in the solver's
        coordinates: its linearisation point at its end. None if every trial failed. At least one
        trial must be recorded (otherwise `ValueError`).
        """
        loss, p = min(self._tried, key=lambda each: each[0])
        return p if np.isfinite(loss) else None
