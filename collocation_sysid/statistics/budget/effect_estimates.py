"""Posterior of single effects of the budget, and what is concluded from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...common.array_types import Array
from ...errors import listed
from ...recording.deviation import Deviation, in_readable_unit
from ..concerns import Concern
from ..distributions import largest_deviation
from ..thresholds import CHANCE, RARE
from .systematic_effects import DEVIATIONS, source_label

# Decrease of the loss by another effect, over that by the most surprising one, from which on both
# explain the residuals.
AS_WELL = 0.8
# Beginning of the name of an effect among those of parameters.
EFFECT = "effect: "
# Most effects that a message names besides the most surprising one.
MOST_NAMED = 3


@dataclass(frozen=True)
class EffectEstimate:
    """Posterior of one effect, in its unit."""

    name: str  # name with its component, and with a number if several recordings have it
    mean: float
    deviation: float  # that is expected; 0 if the budget does not contain the effect
    value: float
    std_error: float
    # Value less mean over the standard deviation that this difference has for a true description.
    surprise: float
    alike: tuple[str, ...] = ()  # other effects that look alike in these data
    suffices: bool = (
        False  # whether the residuals are noise with this effect, of one beyond the budget
    )
    # Estimate of the data alone: they hardly change the posterior of what they hardly show.
    needed: float = np.nan

    @property
    def is_possible(self) -> bool:
        """Whether what it describes can have the size that the data need."""
        row = effect_row(self.name)
        least = 0.0 if row.is_one_sided else -row.largest
        return not self.deviation or least <= self.needed <= row.largest

    @classmethod
    def beyond(cls, name: str, gain: float, suffices: bool) -> EffectEstimate:
        """Return an effect beyond the budget that decreases χ² by `gain`; its size is not known, because
        the answer without it may be far away.
        """
        return cls(name, 0.0, 0.0, np.nan, np.nan, float(np.sqrt(gain)), suffices=suffices)

    def describe(self) -> str:
        """Return name, size that the data need, and that of a true description as text; of an effect
        beyond the budget the name alone.
        """
        label = source_label(self.name)
        article = "an" if label[0] in "aeiou" else "a"
        if not self.deviation:
            return f"{article} {label}, of which the description has none"
        unit = effect_row(self.name).unit
        expected = (self.needed - self.mean) / self.surprise
        needed, mean, sigma = (
            float(f"{in_readable_unit(each, unit)[0]:.2g}")
            for each in (self.needed, self.mean, expected)
        )
        shown = in_readable_unit(1.0, unit)[1]
        return f"{article} {label} of {needed:+g}{shown}, where {mean:g} ± {sigma:g}{shown} is expected"


@dataclass(frozen=True, eq=False)
class JointPosterior:
    """Joint posterior of what acts on the body: parameters, nuisance parameters and effects.

    They refer to the body itself: a constant that an effect redefines is the one with the effect.
    """

    # (r,) parameters, nuisance parameters "experiment: label", and effects "effect: component".
    names: tuple[str, ...]
    # (r,): mean less the answer, in the solver's coordinates, in the unit of a label, and in standard
    # deviations of the prior of an effect.
    offset: Array
    covariance: Array  # (r, r)
    sources: tuple[str, ...]  # (s,): rows of all effects of the budget, once for each component
    # (r, s): changes if each is off by the standard deviation of its prior; part of the covariance.
    by_source: Array


def effect_row(name: str) -> Deviation:
    """Return the row of an effect, by its name with or without component."""
    return DEVIATIONS[name.partition(" ")[0]]


def effect_concerns(
    effects: Sequence[EffectEstimate], suspects: Sequence[EffectEstimate] = ()
) -> list[Concern]:
    """Return one concern, as a list, if the data need an effect that is not expected of a true
    description; else empty.

    It names the most surprising effect, or that of `suspects` beyond the budget which suffices and is
    more surprising, and others that look alike or explain the residuals as well (`AS_WELL`). What
    cannot be as large as the data need is named only as what the residuals look like. The probability
    that any of the effects is so surprising by chance (Bonferroni) is below `CHANCE`, or below `RARE`,
    which is doubtful.
    """
    named = [*effects, *(each for each in suspects if each.suffices)]
    if not named:
        return []
    worst = max(named, key=lambda each: abs(each.surprise))
    limit, gross = (largest_deviation(len(named), p) for p in (CHANCE, RARE))
    if abs(worst.surprise) <= limit:
        return []
    known = sorted((*suspects, *effects), key=lambda each: -abs(each.surprise))
    as_well = [each for each in known if each.surprise**2 > AS_WELL * worst.surprise**2]
    likely = [each for each in named if each in as_well or each in suspects]
    first = worst if worst.is_possible else next((e for e in likely if e.is_possible), worst)
    row = effect_row(first.name)
    instead = (each.name for each in as_well if each.is_possible)
    alike = [name for name in (*instead, *first.alike) if effect_row(name) is not row]
    others = [*dict.fromkeys(map(source_label, alike))][:MOST_NAMED]
    data = {
        "effect": first.describe(),
        "surprise": abs(first.surprise),
        "suffices": first.suffices,
        "alike": f"; {listed(others)} would look the same" if others else "",
        "remedy": row.remedy,
    }
    code = "effect/surprising" if first.is_possible else "effect/impossible"
    return [Concern(code, "doubtful" if abs(worst.surprise) > gross else "check", data)]
