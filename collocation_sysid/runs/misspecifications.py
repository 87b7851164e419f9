"""Hypotheses of what is described wrongly in a solved problem, from all features and from refits."""

from __future__ import annotations

from ..features.registry import FEATURES
from ..methods.solution import Solution
from ..statistics.misspecification.fit_misspecifications import motion_misspecifications
from ..statistics.misspecification.misspecification_hypothesis import Hypothesis, rank
from ..statistics.misspecification.specimen_misspecifications import find_specimen_misspecifications


def find_misspecifications(solution: Solution, budget: int | None = None) -> tuple[Hypothesis, ...]:
    """Return hypotheses of what is described wrongly, likeliest first; empty where the residuals
    are noise.

    Hypotheses of the features and about specimens are always tested; others only if the markers of
    an experiment miss, see `motion_misspecifications`.

    Parameters
    ----------
    solution : Solution
        The fit.
    budget : int, optional
        Largest number of sweeps over the first samples for all refits together; by default three
        times the work of the fit, at most 150.

    Returns
    -------
    tuple of Hypothesis
        `strength` is the factor by which the misfit decreases without the mistake.
    """
    hypotheses = [
        hypothesis for feature in FEATURES for hypothesis in feature.fit_hypotheses(solution)
    ]
    hypotheses += find_specimen_misspecifications(solution)
    hypotheses += motion_misspecifications(solution, hypotheses, budget=budget)
    return rank(hypotheses)
