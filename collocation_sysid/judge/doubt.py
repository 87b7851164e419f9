"""Rows of likely mistakes in the description of an experiment, and the test of hypotheses by the
misfit that remains.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..common.array_types import Array, Index
from ..common.step_counting import search_activity
from ..recording.experiment import Experiment
from ..statistics.budget.systematic_effects import Effect, ExperimentAtAnswer
from ..statistics.hypothesis import Hypothesis

# Experiment without a mistake, and data of its message; None if the mistake is impossible.
Correction = tuple[Experiment, dict[str, object]] | None


@dataclass(frozen=True, eq=False)
class Doubt:
    """One likely mistake in the description of an experiment."""

    name: str  # code of its concern, after "description/"
    unit: str  # of its size
    # ``correct(experiment, size)``: the experiment without the mistake of a size (axes,).
    correct: Callable[[Experiment, Array], Correction]
    # ``effect(at, axis)``: linear change of the equations of motion by one unit along an axis.
    effect: Callable[[ExperimentAtAnswer, int], Effect | None] | None = None
    axes: str = ""  # names of the components of the size, separated by blanks
    is_whole: bool = False  # whether the size is one, as of another law, and not estimated

    def hypothesis(self, experiment: Experiment, size: Array | None = None) -> Hypothesis | None:
        """Return the hypothesis of this mistake, with the experiment without it as `corrected`;
        None where it is impossible.
        """
        correction = self.correct(experiment, np.ones(1) if size is None else size)
        if correction is None:
            return None
        other, data = correction
        of = f"'{experiment.name}'"
        return Hypothesis(self.name, of, data=data, corrected=other, doubt=self)


def corrected_hypotheses(rows: Iterable[Doubt], experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield the hypotheses of those likely mistakes that are possible, each as a whole."""
    found = (row.hypothesis(experiment) for row in rows)
    return (each for each in found if each is not None)


@dataclass(frozen=True, eq=False)
class HypothesisTest:
    """Test of hypotheses by the misfit that remains."""

    misfit: float  # misfit of the description as stated
    # Returns the misfit of a corrected description; None if it is unknown.
    misfit_of: Callable[[Any], float | None]
    required_factor: float  # factor by which the misfit must decrease
    smallest_misfit: float = 0.0  # smallest meaningful misfit; smaller ones count as this
    # If the misfit decreases from above this level to below it, any factor suffices.
    noise_level: float = 0.0

    def accepted(self, hypotheses: Iterable[Hypothesis]) -> Iterator[Hypothesis]:
        """Yield copies of those hypotheses, with their strength, whose correction decreases the
        misfit by more than the required factor, or from above the noise to below it.

        The strength is the factor by which the misfit decreases, divided by the handicap. A
        hypothesis whose misfit cannot be computed (None) is omitted. The misfits are computed one
        after the other, as the iterator advances.
        """
        for number, each in enumerate(hypotheses, start=1):
            with search_activity(f"testing hypothesis {number}"):
                misfit = self.misfit_of(each.corrected)
            if misfit is None:
                continue
            strength = self.misfit / max(self.smallest_misfit, misfit) / each.handicap
            if strength > self.required_factor or misfit < self.noise_level < self.misfit:
                yield replace(each, strength=strength, remaining=misfit)


def clock_hypothesis(
    subject: str, lag_s: float, corrected: Any, handicap: float = 1.0
) -> Hypothesis:
    """Return the hypothesis that the markers' clock is late by `lag_s` [s] (negative: early)
    compared with the poses.

    Parameters
    ----------
    subject : str
        Beginning of the message.
    lag_s : float
        Lag [s]; its sign selects the words of the message.
    corrected : object
        Description with the mistake corrected.
    handicap : float
        Divisor of the hypothesis' strength.
    """
    is_late = lag_s > 0
    data = {
        "when": "late" if is_late else "early",
        "by_ms": 1e3 * abs(lag_s),
        "do": "add this to" if is_late else "subtract this from",
    }
    return Hypothesis("clock", subject, data=data, corrected=corrected, handicap=handicap)


def exchanged_names(names: Sequence[str], real: Index) -> str:
    """Return the names of markers with those that they really are, the indices `real` (M,), where
    these are others.
    """
    return ", ".join(
        f"{name} is {names[k]}" for name, k in zip(names, real, strict=True) if name != names[k]
    )
