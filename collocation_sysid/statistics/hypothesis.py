"""A likely mistake in a description: its cause, its message, and how hypotheses are ranked.

All are ranked by the factor by which the misfit decreases without the mistake. An accepted
hypothesis becomes a concern of the topic "description". Package `judge` finds and tests them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from .concerns import Concern, Grade

# Note on tests of hypotheses without a result.
NO_CAUSE = "possible causes of the misfit were tested: none explains it"


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One possible mistake in the description of a problem."""

    code: str  # cause and how it shows, such as "specimen-kind/likelier"
    subject: str = ""  # what is described, as the beginning of the message; may be empty
    # mapping of str to value: values of the placeholders in the message.
    data: Mapping[str, Any] = field(default_factory=dict)
    # Description with the mistake corrected, of the type that its test expects; None if no test is
    # needed.
    corrected: Any = None
    # Factor by which the misfit decreases if the hypothesis is true; 0 until it is tested.
    strength: float = 0.0
    # Misfit that remains if the hypothesis is true, in the unit of its test; None if it is not
    # known.
    remaining: float | None = None
    doubt: Any = None  # row of which it is the mistake, whose name is the code
    size: Any = None  # size of that mistake along the axes of the row

    @property
    def cause(self) -> str:
        """Short name of the mistake, such as "poses-inverted": the code up to the first slash."""
        return self.code.partition("/")[0]

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


def rank(hypotheses: Iterable[Hypothesis]) -> tuple[Hypothesis, ...]:
    """Return for each cause its strongest hypothesis (the first of equal ones), strongest first."""
    strongest: dict[str, Hypothesis] = {}
    for each in sorted(hypotheses, key=lambda each: -each.strength):
        strongest.setdefault(each.cause, each)
    return tuple(strongest.values())
