"""Hypotheses of what is described wrongly in a solved problem, from all features and from refits."""

from __future__ import annotations

from collections.abc import Sequence

from ..features.registry import FEATURES
from ..methods.solution import Solution
from ..statistics.misspecification.hypothesis import Hypothesis, rank
from ..statistics.misspecification.refits import measurements_miss, motion_misspecifications

# Note on tests of hypotheses without a result.
NO_CAUSE = "possible causes of the misfit were tested: none explains it"
# The same for tests on benches and for motions.
TESTED = {
    True: "hysteresis, layer of the grasp, sensors, the law of the material",
    False: "clock, slip in the grasp, gravity, layer of the grasp, sensors, the laws of the material",
}


def find_misspecifications(solution: Solution) -> tuple[Hypothesis, ...]:
    """Return hypotheses of what is described wrongly, likeliest first; empty where the residuals
    are noise.

    Hypotheses of the features are always tested; others only if a measurement of an experiment
    misses, see `motion_misspecifications`.

    Returns
    -------
    tuple of Hypothesis
        `strength` is the factor by which the misfit decreases without the mistake.
    """
    hypotheses = [
        hypothesis for feature in FEATURES for hypothesis in feature.fit_hypotheses(solution)
    ]
    hypotheses += motion_misspecifications(solution, hypotheses)
    return rank(hypotheses)


def cause_notes(solution: Solution, causes: Sequence[Hypothesis]) -> tuple[str, ...]:
    """Return notes on causes that the data do not show (`Hypothesis.is_open`), or else that refits
    found no cause of a misfit; empty if there is another cause, or if the measurements do not miss.
    """
    if causes:
        return tuple(each.message for each in causes if each.is_open)
    if not measurements_miss(solution):
        return ()
    is_static = all(each.experiment.is_static for each in solution.collocation.transcriptions)
    return (f"{NO_CAUSE} ({TESTED[is_static]})",)
