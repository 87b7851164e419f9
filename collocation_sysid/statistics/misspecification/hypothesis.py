"""Misspecification hypotheses: what may be described wrongly, how it is tested, and its message.

A hypothesis is tested by the misfit with the mistake corrected: by natural modes for many
stiffnesses (`modes`), by another fit, or by other measurements than those of a
fit to the markers alone. Contradictions and jumps need no test (`plausibility`). All are ranked by
the factor by which the misfit decreases. An accepted hypothesis becomes a concern of the topic
"description".
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...common.array_types import Array, Index
from ...common.step_counting import search_activity
from ...recording.deviation import Deviation
from ...recording.experiment import Experiment
from ..concerns import Concern, Grade

# Experiment without a mistake, and data of its message; None if the mistake is impossible.
Correction = tuple[Experiment, dict[str, object]] | None


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One possible mistake in the description of a problem."""

    code: str  # cause and how it shows, such as "marker-slip/alone"
    subject: str = ""  # what is described, as the beginning of the message; may be empty
    # mapping of str to value: values of the placeholders in the message.
    data: Mapping[str, Any] = field(default_factory=dict)
    # Description with the mistake corrected, of the type that its test expects; None if no test is
    # needed.
    corrected: Any = None
    # Factor by which a hypothesis with fitted numbers must fit better than one without.
    handicap: float = 1.0
    # Factor by which the misfit decreases if the hypothesis is true; 0 until it is tested.
    strength: float = 0.0
    # Misfit that remains if the hypothesis is true, in the unit of its test; None if it is not
    # known.
    remaining: float | None = None
    deviation: Deviation | None = None  # likely mistake of a table of such, whose name is the code

    @property
    def cause(self) -> str:
        """Short name of the mistake, such as "poses-inverted": the code up to the first slash."""
        return self.code.partition("/")[0]

    @property
    def is_open(self) -> bool:
        """Whether the data fit with the mistake as well as without, which contradicts nothing."""
        return self.code.endswith("/open")

    @property
    def message(self) -> str:
        """Message with the likely mistake and the remedy, that of `concern`."""
        return self.concern().message

    def concern(self, grade: Grade = "check") -> Concern:
        """Return the hypothesis as a concern of a given grade, with the code "description/" and
        that of the hypothesis.

        Its data contain the subject as "of" unless that is empty, and the strength as "nearer"
        unless `corrected` is None.
        """
        tried = {} if self.corrected is None else {"nearer": self.strength}
        of = {"of": self.subject} if self.subject else {}
        return Concern(f"description/{self.code}", grade, data={**of, **self.data, **tried})

    def as_dict(self) -> dict[str, Any]:
        """Return cause, message and strength under the keys "cause", "sentence" and "strength", for
        JSON and tables.
        """
        return {"cause": self.cause, "sentence": self.message, "strength": self.strength}


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


def corrected_hypothesis(
    row: Deviation, experiment: Experiment, amplitudes: Array | None = None
) -> Hypothesis | None:
    """Return the hypothesis of a likely mistake, with the experiment without it as `corrected`; None
    where it is impossible. `amplitudes` are those of its axes, see `Deviation.corrected`.
    """
    assert row.corrected is not None
    correction = row.corrected(experiment, np.ones(1) if amplitudes is None else amplitudes)
    if correction is None:
        return None
    other, data = correction
    return Hypothesis(row.name, f"'{experiment.name}'", data=data, corrected=other, deviation=row)


def corrected_hypotheses(rows: Iterable[Deviation], experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield the hypotheses of those likely mistakes that are possible, each as a whole."""
    found = (corrected_hypothesis(row, experiment) for row in rows)
    return (each for each in found if each is not None)


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


def rank(hypotheses: Iterable[Hypothesis]) -> tuple[Hypothesis, ...]:
    """Return for each cause its strongest hypothesis (the first of equal ones), strongest first."""
    strongest: dict[str, Hypothesis] = {}
    for each in sorted(hypotheses, key=lambda each: -each.strength):
        strongest.setdefault(each.cause, each)
    return tuple(strongest.values())
