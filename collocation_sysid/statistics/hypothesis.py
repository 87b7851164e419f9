"""Misspecification hypotheses: what may be described wrongly, how it is tested, and its message.

A hypothesis is tested by the misfit with the mistake corrected: by natural modes for many
stiffnesses (`modal`), by another fit, or by the wrench of a fit to the markers alone (`causes`).
Contradictions and jumps need no test (`plausible`). All are ranked by the factor by which the
misfit decreases. An accepted hypothesis becomes a concern of the topic "description".
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from .concern import Concern, Grade


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One possible mistake in the description of a problem.

    Attributes
    ----------
    code : str
        Cause and how it shows, such as "marker-slip/alone".
    of : str
        What is described, as the beginning of the message; may be empty.
    data : mapping of str to value
        Values of the placeholders in the message.
    without : Any
        Description with the mistake corrected, of the type that its test expects; None if no test
        is needed.
    handicap : float
        Factor by which a hypothesis with fitted numbers must fit better than one without.
    strength : float
        Factor by which the misfit decreases if the hypothesis is true; 0 until it is tested.
    """

    code: str
    of: str = ""
    data: Mapping[str, Any] = field(default_factory=dict)
    without: Any = None
    handicap: float = 1.0
    strength: float = 0.0

    @property
    def cause(self) -> str:
        """Short name of the mistake, such as "poses-inverted"."""
        return self.code.partition("/")[0]

    @property
    def sentence(self) -> str:
        """Message with the likely mistake and the remedy."""
        return self.concern().sentence

    def concern(self, grade: Grade = "check") -> Concern:
        """Return the hypothesis as a concern of a given grade."""
        tried = {} if self.without is None else {"nearer": self.strength}
        of = {"of": self.of} if self.of else {}
        return Concern(f"description/{self.code}", grade, {**of, **self.data, **tried})

    def as_dict(self) -> dict[str, Any]:
        """Return cause, message and strength for JSON and tables."""
        return {"cause": self.cause, "sentence": self.sentence, "strength": self.strength}


@dataclass(frozen=True, eq=False)
class Trial:
    """Test of hypotheses by the misfit that remains.

    Attributes
    ----------
    misfit : float
        Misfit of the description as stated.
    left : callable
        Returns the misfit of a corrected description; None if it is unknown.
    better : float
        Factor by which the misfit must decrease.
    least : float
        Smallest meaningful misfit; smaller ones count as this.
    noise : float
        If the misfit decreases from above this level to below it, any factor suffices.
    """

    misfit: float
    left: Callable[[Any], float | None]
    better: float
    least: float = 0.0
    noise: float = 0.0

    def of(self, hypotheses: Iterable[Hypothesis]) -> Iterator[Hypothesis]:
        """Iterate over the hypotheses that fit far better, with their strength."""
        for each in hypotheses:
            if (misfit := self.left(each.without)) is None:
                continue
            strength = self.misfit / max(self.least, misfit) / each.handicap
            if strength > self.better or misfit < self.noise < self.misfit:
                yield replace(each, strength=strength)


def clock(of: str, lag_s: float, without: Any, handicap: float = 1.0) -> Hypothesis:
    """Return the hypothesis that the markers' clock is late by `lag_s` [s] (negative:
    early) compared with the poses.
    """
    when, do = ("late", "add") if lag_s > 0 else ("early", "subtract")
    data = {"when": when, "by_ms": 1e3 * abs(lag_s), "do": do}
    return Hypothesis("clock", of, data, without, handicap)


def ranked(hypotheses: Iterable[Hypothesis]) -> tuple[Hypothesis, ...]:
    """Return each cause once, with its strongest hypothesis, strongest first."""
    strongest: dict[str, Hypothesis] = {}
    for each in sorted(hypotheses, key=lambda each: -each.strength):
        strongest.setdefault(each.cause, each)
    return tuple(strongest.values())
