"""Rows of likely mistakes in a description, and their test by the misfit that remains."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..common.array_types import Array, Index
from ..statistics.budget.effect import Effect, ExperimentAtAnswer
from ..statistics.hypothesis import Hypothesis
from ..statistics.thresholds import LEAST_IMPROVEMENT

# Description without a mistake, and data of its message; None if the mistake is impossible.
Correction = tuple[Any, dict[str, object]] | None


@dataclass(frozen=True, eq=False)
class Doubt:
    """One likely mistake in a description: an experiment, or what a comparison needs of it."""

    name: str  # code of its concern, after "description/"
    unit: str  # of its size
    # ``correct(description, size)``: the description without the mistake of a size (axes,).
    correct: Callable[[Any, Array], Correction]
    # ``effect(at, axis)``: linear change of the equations of motion by one unit along an axis.
    effect: Callable[[ExperimentAtAnswer, int], Effect | None] | None = None
    # Or else changes of each block of the residuals by one unit, (…, axes) in σ.
    changes: Sequence[Array] | None = None
    axes: str = ""  # names of the components of the size, separated by blanks
    # Prior of the size in a linear step; without a deviation, the mistake happens as a whole.
    mean: float = 1.0
    wide: float = 0.0
    subject: str = ""  # what is described, as the beginning of the message
    # Factor by which the row must fit better than one without fitted numbers or variants.
    handicap: float = 1.0

    @classmethod
    def whole(
        cls, name: str, without: Any, subject: str = "", handicap: float = 1.0, **data: Any
    ) -> Doubt:
        """Return the row of a mistake of one size, from the description without it."""
        return cls(name, "1", lambda *_: (without, data), subject=subject, handicap=handicap)

    @property
    def key(self) -> tuple[str, str, str]:
        """What tells the row from others of the same fit, if its size is estimated."""
        return self.name, self.subject, self.axes

    @property
    def is_small(self) -> bool:
        """Whether the answer without the mistake is near the one with it."""
        return self.effect is not None or self.wide > 0

    def hypothesis(self, described: Any, size: Array | None = None) -> Hypothesis | None:
        """Return the hypothesis of this mistake, with the description without it as `corrected`;
        None where it is impossible.
        """
        size = np.full(max(1, len(self.axes.split())), self.mean) if size is None else size
        correction = self.correct(described, size)
        if correction is None:
            return None
        other, data = correction
        of = self.subject or f"'{described.name}'"
        return Hypothesis(self.name, of, data=data, corrected=other, doubt=self, size=size)


def accepted(
    rows: Iterable[Doubt], described: Any, misfit_of: Callable[[Any], float]
) -> Iterator[Hypothesis]:
    """Yield the mistakes whose correction decreases the misfit of a description by more than
    `LEAST_IMPROVEMENT`, with this decrease over the handicap as strength.
    """
    stated = misfit_of(described)
    for row in rows:
        if (found := row.hypothesis(described)) is not None:
            remaining = misfit_of(found.corrected)
            strength = stated / max(remaining, 1e-300) / row.handicap
            if strength > LEAST_IMPROVEMENT:
                yield replace(found, strength=strength, remaining=remaining)


def clock_data(lag_s: float) -> dict[str, Any]:
    """Return the data of the message that the markers' clock is late by `lag_s` [s] (negative:
    early) compared with the poses.
    """
    is_late = lag_s > 0
    return {
        "when": "late" if is_late else "early",
        "by_ms": 1e3 * abs(lag_s),
        "do": "add this to" if is_late else "subtract this from",
    }


def exchanged_names(names: Sequence[str], real: Index) -> str:
    """Return the names of markers with those that they really are, the indices `real` (M,), where
    these are others.
    """
    return ", ".join(
        f"{name} is {names[k]}" for name, k in zip(names, real, strict=True) if name != names[k]
    )
