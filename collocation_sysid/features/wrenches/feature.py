"""Likely errors in the description of wrenches of grasps and obstacles."""

from __future__ import annotations

from collections.abc import Sequence

from ...methods.solution import Solution
from ...statistics.misspecification.hypothesis import Hypothesis, rank
from ...statistics.misspecification.plausibility import load_sign_hypotheses
from ..feature import Feature, SimulatedCheck
from .at_guess import MESSAGE_OF_OFFSET, wrench_deviations
from .mistakes import CHECKED_SAMPLES, MESSAGES, wrench_causes, wrench_mistakes

# Longest fit of the first samples to the markers that needs no request [s].
LONGEST_FIT_S = 10.0


def simulated_hypotheses(check: SimulatedCheck) -> tuple[Sequence[Hypothesis], Sequence[str]]:
    """Return likely errors of wrenches, and notes with the deviation of each from the simulation.

    The first samples are fitted to the markers, unless another error is likely or the fit takes
    long, which a note says. Wrenches that no such fit predicts are compared with the simulation at
    the guess instead. Nothing is compared if the simulation failed.
    """
    deviations = wrench_deviations(check.parts) if check.is_simulated else []
    notes = [deviation.note() for deviation in deviations]
    if check.causes:
        return (), notes
    unpredicted = {each.experiment for each in deviations}
    hypotheses: list[Hypothesis] = []
    has_both = any(
        each.wrenches and each.markers.sample_count for each in check.problem.experiments
    )
    fit_s = check.fit_s(CHECKED_SAMPLES) if has_both else 0.0
    if has_both and not check.is_full and fit_s > LONGEST_FIT_S:
        notes.append(
            "the wrenches were not compared with the prediction from the markers, which would "
            f"take about {fit_s:.2g} s; check --full does it"
        )
    elif has_both:
        check.report_progress("comparing the wrenches with the prediction from the markers")
        hypotheses, predicted = wrench_mistakes(check.collocation)
        unpredicted -= set(predicted)
        notes += [
            f"no fit explains the markers of '{name}', so that its wrench was compared with the "
            "simulation at the guess alone"
            for name in sorted(unpredicted)
        ]
    for deviation in deviations:
        if deviation.experiment in unpredicted:
            hypotheses += deviation.hypotheses()
    return rank(hypotheses), notes


def fit_hypotheses(solution: Solution) -> list[Hypothesis]:
    """Return likely errors of wrenches, by the residuals of a fit and by the signs of loads."""
    return [
        *wrench_causes(solution),
        *(
            hypothesis
            for transcription in solution.collocation.transcriptions
            for hypothesis in load_sign_hypotheses(transcription.experiment)
        ),
    ]


WRENCH = Feature(
    messages={**MESSAGES, **MESSAGE_OF_OFFSET},
    simulated_hypotheses=simulated_hypotheses,
    fit_hypotheses=fit_hypotheses,
)
