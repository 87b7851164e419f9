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
    # Or else changes of each block of the residuals by one unit, (…, axes) in σ.
    changes: Sequence[Array] | None = None
    axes: str = ""  # names of the components of the size, separated by blanks
    # Prior of the size in a linear step; without a deviation, the mistake happens as a whole.
    mean: float = 1.0
    wide: float = 0.0
    subject: str = ""  # what is described, as the beginning of the message

    @property
    def key(self) -> tuple[str, str, str]:
        """What tells the row from others of the same fit, if its size is estimated."""
        return self.name, self.subject, self.axes

    @property
    def is_small(self) -> bool:
        """Whether the answer without the mistake is near the one with it."""
        return self.effect is not None or self.wide > 0

    def hypothesis(self, experiment: Experiment, size: Array | None = None) -> Hypothesis | None:
        """Return the hypothesis of this mistake, with the experiment without it as `corrected`;
        None where it is impossible.
        """
        size = np.full(max(1, len(self.axes.split())), self.mean) if size is None else size
        correction = self.correct(experiment, size)
        if correction is None:
            return None
        other, data = correction
        of = self.subject or f"'{experiment.name}'"
        return Hypothesis(self.name, of, data=data, corrected=other, doubt=self, size=size)


@dataclass(frozen=True, eq=False)
class HypothesisTest:
    """Test of hypotheses by the misfit that remains."""

    misfit: float  # misfit of the description as stated
    # Returns the misfit of a corrected description; None if it is unknown.
    misfit_of: Callable[[Any], float | None]
    required_factor: float  # factor by which the misfit must decrease
    smallest_misfit: float = 0.0  # smallest meaningful misfit; smaller ones count as this

    def accepted(self, hypotheses: Iterable[Hypothesis]) -> Iterator[Hypothesis]:
        """Yield copies of those hypotheses, with their strength, whose correction decreases the
        misfit by more than the required factor.

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
            if strength > self.required_factor:
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
