"""What may be described wrongly: the description without a mistake, how it is tried, what is said.

A hypothesis is tried by what is left of the misfit if it holds: by the modes of bodies of many
stiffnesses (`modal`), by another fit, or by the wrench that a fit to the markers alone has
(`causes`). What jumps or contradicts itself needs no trial (`plausible`). All are ranked by the
factor by which the misfit falls. One that is believed gives concern: its code begins with the
cause, and the sentence is looked up by it among those of descriptions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from .concern import Concern, Grade


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One thing of a description that may be wrong.

    Attributes
    ----------
    code : str
        The cause and how it shows, such as "marker-slip/alone".
    of : str
        What is described, as sentences begin with it; may be empty.
    data : mapping
        What its sentence holds.
    without : optional
        The description without the mistake, of whatever kind its trial takes; None where what is
        given tells it.
    handicap : float
        What has numbers to fit has to fit so many times better than what has none.
    strength : float
        Factor by which the misfit falls if this is assumed, zero until it is tried.
    """

    code: str
    of: str = ""
    data: Mapping[str, Any] = field(default_factory=dict)
    without: Any = None
    handicap: float = 1.0
    strength: float = 0.0

    @property
    def cause(self) -> str:
        """Short name of what is wrong, such as "poses-inverted"."""
        return self.code.partition("/")[0]

    @property
    def sentence(self) -> str:
        """What is likely wrong, and the remedy."""
        return self.concern().sentence

    def concern(self, grade: Grade = "check") -> Concern:
        """The same with its numbers, as what gives concern."""
        tried = {} if self.without is None else {"nearer": self.strength}
        of = {"of": self.of} if self.of else {}
        return Concern(f"description/{self.code}", grade, {**of, **self.data, **tried})

    def as_dict(self) -> dict[str, Any]:
        """For JSON and tables."""
        return {"cause": self.cause, "sentence": self.sentence, "strength": self.strength}


@dataclass(frozen=True, eq=False)
class Trial:
    """A way to try hypotheses.

    Attributes
    ----------
    misfit : float
        Of the description as given.
    left : callable
        What is left of it with another description; None where that cannot be told.
    better : float
        The factor by which the misfit has to fall.
    least : float
        A smaller misfit tells nothing.
    noise : float
        From a misfit above this to one below any factor will do.
    """

    misfit: float
    left: Callable[[Any], float | None]
    better: float
    least: float = 0.0
    noise: float = 0.0

    def of(self, hypotheses: Iterable[Hypothesis]) -> Iterator[Hypothesis]:
        """Those that fit far better, with their strength."""
        for each in hypotheses:
            if (left := self.left(each.without)) is None:
                continue
            strength = self.misfit / max(self.least, left) / each.handicap
            if strength > self.better or left < self.noise < self.misfit:
                yield replace(each, strength=strength)


def clock(of: str, lag_s: float, without: Any, handicap: float = 1.0) -> Hypothesis:
    """That the markers' clock is late by `lag_s` against the poses'."""
    when, do = ("late", "add") if lag_s > 0 else ("early", "subtract")
    data = {"when": when, "by_ms": 1e3 * abs(lag_s), "do": do}
    return Hypothesis("clock", of, data, without, handicap)


def ranked(hypotheses: Iterable[Hypothesis]) -> tuple[Hypothesis, ...]:
    """Each cause once, likeliest first."""
    strongest: dict[str, Hypothesis] = {}
    for each in sorted(hypotheses, key=lambda each: -each.strength):
        strongest.setdefault(each.cause, each)
    return tuple(strongest.values())
