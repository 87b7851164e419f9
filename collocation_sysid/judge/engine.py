"""Likely mistakes of a fit that its data contradict: a linear step of each row, the best corrected and
fitted again, and named only if their correction brings the residuals to the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..common.step_counting import search_activity
from ..errors import InputError, SimulationError
from ..features.registry import present
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution, Status
from ..methods.starts.initial_trajectories import associated_at_guess
from ..methods.starts.stiffness_scan import start_problem, without_guesses
from ..recording.experiment import Experiment
from ..recording.measurement_selection import first_samples, measured_count
from ..statistics.hypothesis import NO_CAUSE, Hypothesis, rank
from ..statistics.thresholds import BETTER, CERTAIN, INDISTINGUISHABLE, PARTIAL
from .fit import Corrected, TestedFit, discrepancy, has_trend, least_loss, thinned, with_corrected
from .modes import find_misspecifications_by_modes
from .motion import motion_candidates, motion_rows
from .tracks import exchanged_places, filtered_tracks, same_tracks

# Largest number of samples of a refit.
MOST_SAMPLES = 100
# The same of each specimen.
MOST_OF_SPECIMEN = 60
# Smallest discrepancy that counts in the strength of a hypothesis.
LEAST_MISFIT = 0.8
# Most mistakes that are corrected and fitted again.
MOST_REFITS = 3
# Fewest sweeps of one refit; else as many as the fit took iterations, less those of other refits. All
# together take about as long as the fit.
FEWEST_SWEEPS = 15
# Length of the last step of a parameter's logarithm.
TOLERANCE = 1e-2
# The same of specimens, whose constants of large strain the first samples determine least.
SPECIMEN_TOLERANCE = 1e-3
# Predicted relative decrease of the loss by a change of one logarithm by 1 that ends a refit: far
# below that of a correction that counts.
LEAST_DECREASE = 1e-2
# Loss of a part of the samples over that of all samples without a correction, above which a
# correction is refuted: more samples have no smaller loss.
REFUTED = 10.0
# What is tested on benches and of motions.
TESTED = {
    True: "layer of the grasp, sensors, the law of the material",
    False: "clock, gravity, layer of the grasp, sensors, the law of the material",
}


def find_misspecifications(
    solution: Solution,
    is_consistent: bool = False,
    deviations: Mapping[str, float | None] | None = None,
) -> tuple[Hypothesis, ...]:
    """Return likely mistakes in the description of a solved problem, likeliest first, with the factor
    by which the misfit decreases without them as `strength`.

    Parameters
    ----------
    is_consistent : bool
        Whether the posterior is as expected of a true description: then only what such a fit does
        not exclude is tested.
    deviations : mapping of str to float or None, optional
        Standard deviations of effects of the budget by name; by default the usual ones.

    Notes
    -----
    What the data show by themselves comes first: nothing is fitted again if it is nearly certain
    (`CERTAIN`), or if the residuals are noise.
    """
    deviations = deviations or {}
    kinds = present([part.transcription.experiment for part in solution.parts])
    if is_consistent:
        return rank(e for kind in kinds for e in kind.consistent(solution, deviations))
    found = [each for kind in kinds for each in kind.fitted(solution)]
    misfits = [discrepancy(part) for part in solution.parts]
    worst = int(np.argmax(misfits))
    if _certainty(found) < CERTAIN:
        found += _shown_by_modes(solution, worst)
    # Tracks in a wrong unit look like a single point, or filtered.
    if _certainty(found) < CERTAIN:
        for part, fitted_m in zip(solution.parts, solution.readings_m, strict=True):
            experiment = part.transcription.experiment
            found += [*same_tracks(experiment), *filtered_tracks(experiment, fitted_m)]
            found += exchanged_places(part)
    if misfits[worst] > 1.0 and _certainty(found) < CERTAIN:
        found += _tested(solution, solution.parts[worst].transcription.experiment, deviations)
    return rank(found)


def _certainty(found: Sequence[Hypothesis]) -> float:
    return max((each.strength for each in found), default=0.0)


def cause_notes(solution: Solution, causes: Sequence[Hypothesis]) -> tuple[str, ...]:
    """Return a note that no cause of a misfit was found; empty if there is one, or no misfit."""
    if causes or not solution.history or max(map(discrepancy, solution.parts)) <= 1.0:
        return ()
    is_static = all(each.experiment.is_static for each in solution.collocation.transcriptions)
    return (f"{NO_CAUSE} ({TESTED[is_static]})",)


def _shown_by_modes(solution: Solution, number: int) -> Iterator[Hypothesis]:
    """The fit moved the body, not only its natural modes: what leaves more than the fit is refuted."""
    experiment = solution.parts[number].transcription.experiment
    rms_m = solution.rms_by_experiment_m.get(experiment.name, np.inf)
    for each in find_misspecifications_by_modes(experiment, solution.parameters):
        if each.remaining is None or each.remaining < rms_m:
            yield each


def _tested(
    solution: Solution, experiment: Experiment, deviations: Mapping[str, float | None]
) -> list[Hypothesis]:
    """Return the mistake without which the first samples of an experiment, or all specimens, fit as
    well as noise allows; several as one hypothesis if the fits do not tell them apart, or if none
    suffices.
    """
    is_specimen = experiment.specimen is not None
    is_lost = not solution.history  # not even the first values could be simulated
    if is_lost or (is_specimen and not solution.status.converged):
        return []
    refits = _Refits(solution, _fitted_again(solution, experiment), deviations)
    stated = refits.fit(None)
    if stated is None:
        return []
    fit = TestedFit(solution, stated)
    kinds = present([each.experiment for each in solution.collocation.transcriptions])
    candidates = [each for kind in kinds for each in kind.candidates(fit)]
    if not is_specimen:
        candidates += [*fit.screened(motion_rows(fit)), *motion_candidates(fit)]
    candidates.sort(key=lambda each: each[0])
    best = [each for _, each in candidates[:MOST_REFITS]]
    tested = []
    for count, each in enumerate(best, start=1):
        with search_activity(f"testing hypothesis {count}"):
            accepted = refits.accepted(each)
            tested += [] if accepted is None else [accepted]
    # Laws and toes also decrease the misfit of many corrections, as a longer search does.
    if is_specimen or not solution.status.converged:
        tested = [each for each in tested if (each.remaining or 0.0) <= 1.0]
    if is_specimen and tested:  # nothing is wrong if an effect of the budget explains it as well
        least = min(refits.loss(each.corrected) for each in tested)
        tested = tested if refits.loss(None) > least + INDISTINGUISHABLE else []
    return _named_alone_or_together(tested, refits.loss)


def _fitted_again(solution: Solution, experiment: Experiment) -> list[Experiment]:
    if experiment.specimen is None:
        # The first samples of a test bench may end before it unloads.
        is_static = experiment.is_static
        return [experiment if is_static else first_samples(experiment, MOST_SAMPLES)]
    fitted = [each.experiment for each in solution.collocation.transcriptions]
    return [thinned(each, MOST_OF_SPECIMEN) for each in fitted if each.specimen is not None]


def _named_alone_or_together(
    tested: Sequence[Hypothesis], loss_of: Callable[[Any], float]
) -> list[Hypothesis]:
    """Return the hypothesis that brings the residuals to the noise; as one of several if others do
    so with a loss that is larger by at most `INDISTINGUISHABLE`; if none does, those that reduce
    them most, as one hypothesis.
    """
    sufficient = [each for each in tested if each.remaining is not None and each.remaining <= 1.0]
    if not sufficient:
        least = PARTIAL * max((each.strength for each in tested), default=0.0)
        partial = sorted(tested, key=lambda each: -each.strength)
        return _together("insufficient", [each for each in partial if each.strength > least])
    losses = [loss_of(each.corrected) for each in sufficient]
    likely = [
        each
        for each, loss in zip(sufficient, losses, strict=True)
        if loss <= min(losses) + INDISTINGUISHABLE
    ]
    likely = rank(likely)
    return [*likely] if len(likely) == 1 else _together("several", likely)


def _together(code: str, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    if not hypotheses:
        return []
    texts = (replace(each, subject="", corrected=None).message for each in hypotheses)
    data = {"causes": "; or ".join(texts)}
    return [replace(rank(hypotheses)[0], code=code, data=data)]


class _Refits:
    """Fits of some experiments, one or several of them corrected, with a limited number of sweeps;
    from the problem's guess, or from the answer and its motion.
    """

    def __init__(
        self,
        solution: Solution,
        stated: Sequence[Experiment],
        deviations: Mapping[str, float | None],
    ) -> None:
        self.whole = solution
        self.stated = stated
        self.deviations = deviations
        fitted = [each.experiment for each in solution.collocation.transcriptions]
        samples = sum(len(each.t_s) for each in fitted)
        own = sum(len(each.t_s) for each in stated)
        self.each = max(FEWEST_SWEEPS, solution.iterations)
        # Sweeps that are left for all fits together.
        self.sweeps = max(MOST_REFITS * FEWEST_SWEEPS, solution.iterations * samples // own)
        parameters = solution.collocation.parameters
        values = parameters.values(solution.q)
        self.answer = {item.name: values[item.name] for item in parameters.free}
        self.known: dict[Corrected | None, Solution | None] = {}
        if len(fitted) == len(stated) and samples == own:
            self.known[None] = solution

    def fit(self, corrected: Corrected | None, is_near: bool = True) -> Solution | None:
        """Return the fit with corrected experiments, or as stated; None if it fails. One that
        reaches its limit counts.
        """
        if corrected not in self.known:
            self.known[corrected] = self._fit(corrected, is_near)
        return self.known[corrected]

    def accepted(self, tested: Hypothesis) -> Hypothesis | None:
        """Return the hypothesis with its strength and what remains, if it decreases the discrepancy
        by `BETTER`; None else. A size is estimated again at each refit.
        """
        stated = self.fit(None)
        remaining = self._remaining(tested)
        if stated is None or remaining is None:
            return None
        misfit = max(map(discrepancy, stated.parts))
        row = tested.doubt
        while row and row.wide > 0 and self.sweeps > 0 and 1.0 < remaining < misfit:
            if (refit := self.known[tested.corrected]) is None:
                break
            again = TestedFit(self.whole, refit)
            same = [each for each in motion_rows(again) if each.key == row.key]
            steps = [step for _, step in again.linear_steps(same[:1])]
            other = row.hypothesis(self.stated[0], tested.size + steps[0]) if steps else None
            left = other and self._remaining(other)
            if other is None or left is None or left >= remaining:
                break
            tested, remaining = other, left
        strength = misfit / max(remaining, LEAST_MISFIT)
        if strength > BETTER:
            return replace(tested, strength=strength, remaining=remaining)
        return None

    def _remaining(self, tested: Hypothesis) -> float | None:
        """Return the discrepancy with a correction; None without a fit, or if its residuals follow
        the strain.
        """
        refit = self.fit(tested.corrected, is_near=bool(tested.doubt and tested.doubt.is_small))
        if refit is None or any(map(has_trend, refit.parts)):
            return None
        return max(map(discrepancy, refit.parts))

    def loss(self, corrected: Corrected | None) -> float:
        """Return the loss, of specimens that with the effects of the budget, with that expected of
        measurements left out; infinite without a fit.
        """
        refit = self.fit(corrected)
        if refit is None:
            return np.inf
        fitted = with_corrected(self.stated, corrected)
        left_out = sum(map(measured_count, self.stated)) - sum(map(measured_count, fitted))
        if self.stated[0].specimen:
            return least_loss(refit, self.deviations) + left_out
        return refit.history[-1].loss + left_out

    def _fit(self, corrected: Corrected | None, is_near: bool) -> Solution | None:
        stated = None if self.stated[0].specimen else self.known.get(None)
        method = ReducedSpace(
            max_iterations=max(FEWEST_SWEEPS, min(self.each, self.sweeps)),
            tolerance=TOLERANCE if self.stated[0].specimen is None else SPECIMEN_TOLERANCE,
            least_decrease=LEAST_DECREASE,
        )
        if stated is not None:
            largest_loss = REFUTED * max(1.0, stated.history[-1].loss)
            method = replace(method, largest_loss=largest_loss)
        collocation = self.whole.collocation
        experiments = with_corrected(self.stated, corrected)
        try:
            changed = replace(collocation, experiments=experiments)
            if is_near:
                changed = changed.with_parameters(changed.parameters.with_estimates(self.answer))
            else:  # a large mistake makes all constants wrong: begin as a solve without guesses does
                changed = start_problem(without_guesses(changed)).collocation
            solution = method(associated_at_guess(changed))
        except (InputError, SimulationError):
            return None
        self.sweeps -= solution.iterations
        solution.unless_interrupted()
        ended = solution.status.converged or solution.status is Status.ITERATION_LIMIT
        return solution if ended else None
