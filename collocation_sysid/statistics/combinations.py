"""Combinations of constants that are determined where a constant alone is not, and sentences about
what the data determine.

A covariance C of relative deviations (of logarithms) gives the standard deviation √(wᵀCw) of the
product Π v_k^(w_k) of powers of the constants v. In units of the standard deviations of the
constants, C is their correlation matrix: an eigenvalue ε ≪ 1 belongs to a product that is known √ε
times better than each constant alone. What remains undetermined is the eigenvector of C itself with
the largest eigenvalue: the product of powers with the widest interval.

To first order, a product of powers is also a sum: d ln Σ c_k v_k = Σ w_k d ln v_k / Σ w_k for
c_k = w_k / v_k. Where all weights have one sign and all constants one unit, the sum is stated,
because forces are linear in moduli and the sum then holds also far from the estimate.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from textwrap import shorten
from typing import Literal

import numpy as np

from ..common.array_types import Array, Index
from ..common.display import short
from ..errors import listed
from ..fem.laws.constants import is_density, is_modulus, symbol_of, unit_of, without_region
from ..fem.laws.moduli import ELASTIC
from .budget.combined_intervals import NORMAL_95
from .estimates import Estimate
from .uncertainty import Uncertainty

Form = Literal["sum", "product", "unstated"]

# Largest variance of a combination in units of the variances of its constants. At this value, two
# constants have a correlation of 0.9, and the combination is known three times better than each.
LARGEST_SHARE = 0.1
# Share of the largest weight from which on a constant belongs to a combination, in units of
# standard deviations; and smallest power that is written, relative to the largest one.
MEMBER = 0.2
SMALLEST_POWER = 0.05
# Half width of an interval, as a factor, from which on the interval is wider than the value, so that
# this is not determined (`ReportedEstimate.is_determined`): f − 1/f = 1.
WIDE = (1 + 5**0.5) / 2
# Half width, as a factor, from which on an interval is no information.
HOPELESS = 1e4
# Half width below which an interval is stated in percent, and one below which it is not stated:
# rounding of the covariance and effects that are not modelled decide there.
PERCENT = 1.5
EXACT = 1.0001
# Logarithm beyond which a factor is not representable.
LARGEST_LOGARITHM = 700.0
# Standard deviation of a constant that would be known, relative to its value.
KNOWN = 0.05
# Number of recordings whose effect is predicted, over those that were made.
REPETITIONS = 4
# Longest formula in a table or a picture, in characters; sentences have all of it.
LONGEST_FORMULA = 27
# A modulus replaces a combination if its interval is at most this many times as wide.
SAME = 1.5


def precision_text(factor: float) -> str:
    """Return the half width of an interval, as a factor of 1 or more, as text that follows
    "determine … ".
    """
    if factor < EXACT:
        return "to better than ±0.01 %"
    if factor < PERCENT:
        return f"to ±{100 * (factor - 1):.2g} %"
    return f"to within a factor of {short(factor)}" if factor < HOPELESS else "not at all"


@dataclass(frozen=True)
class Direction:
    """A product of powers, or a sum, of estimated constants, with its precision."""

    names: tuple[str, ...]  # constants, the one with the largest power first
    # Powers of the constants in a product, the first of them 1; or their factors in a sum.
    powers: tuple[float, ...]
    form: Form  # "unstated" if a value is not positive, so that powers of it do not exist
    factor: float  # half width of the 95 % interval, as a factor

    @classmethod
    def from_weights(
        cls,
        names: Sequence[str],
        values: Array,
        weights: Array,
        covariance: Array,
        smallest: float = SMALLEST_POWER,
    ) -> Direction:
        """Return the direction with weights (k,) of the logarithms of constants.

        Parameters
        ----------
        values : (k,) array
        weights : (k,) array
        covariance : (k, k) array
            Covariance of the relative deviations of the constants.
        smallest : float
            Smallest weight over the largest one that is stated; the interval contains all.
        """
        sizes = np.abs(weights)
        order = np.argsort(-sizes, kind="stable")
        kept = order[sizes[order] >= smallest * sizes.max()]
        w = weights[kept] / weights[kept[0]]
        own = tuple(names[int(k)] for k in kept)
        variance = max(0.0, weights @ covariance @ weights) / weights[kept[0]] ** 2
        form: Form = "product"
        if not (values[kept] > 0).all():
            form = "unstated"
        elif len(kept) > 1 and (w > 0).all() and len({unit_of(name) for name in own}) == 1:
            form = "sum"
            variance /= w.sum() ** 2
            w = w * values[kept[0]] / values[kept]
        factor = float(np.exp(min(NORMAL_95 * np.sqrt(variance), LARGEST_LOGARITHM)))
        return cls(own, tuple(w.tolist()), form, factor)

    @property
    def label(self) -> str:
        """The formula for a table or a picture, in which a long one ends with "…"."""
        return shorten(self.formula(), LONGEST_FORMULA, placeholder=" …")

    def formula(self) -> str:
        """Return the combination as text, such as "λ + 0.9 μ" or "E · ν^0.22"."""
        symbols = [symbol_of(name) for name in self.names]
        if self.form == "unstated" and len(symbols) > 1:
            return f"a combination of {', '.join(symbols)}"
        if self.form == "sum":
            terms = (
                symbol if f"{factor:.2g}" == "1" else f"{factor:.2g} {symbol}"
                for factor, symbol in zip(self.powers, symbols, strict=True)
            )
            return " + ".join(terms)
        text = symbols[0]
        for power, symbol in zip(self.powers[1:], symbols[1:], strict=True):
            exponent = f"{abs(power):.2g}"
            text += " · " if power > 0 else " / "
            text += symbol if exponent == "1" else f"{symbol}^{exponent}"
        return text


@dataclass(frozen=True)
class Fix:
    """What would determine the constants of a combination, with its predicted effect."""

    what: str  # the known value, sensor or recording, as a phrase
    name: str  # constant with the widest interval afterwards
    factor: float  # half width of that interval, as a factor

    def sentence(self) -> str:
        """Return the effect as a clause."""
        return f"{self.what} would determine {symbol_of(self.name)} {precision_text(self.factor)}"


@dataclass(frozen=True)
class Combination:
    """Constants of which only a combination is determined; or one that is not determined and not
    confounded with others either.
    """

    determined: Direction  # the combination with the narrowest interval
    loosest: Direction  # the combination of the same constants with the widest interval
    # Derived modulus that is known as well as `determined`, which it replaces in sentences.
    modulus: str | None = None
    fixes: tuple[Fix, ...] = ()  # ways to determine the constants, the most effective first

    @property
    def is_lone(self) -> bool:
        """Whether it is one constant alone."""
        return len(self.determined.names) == 1

    def precision(self) -> str:
        """Return how well the combination is determined, as text; empty if it has no formula."""
        if self.determined.form == "unstated":
            return ""
        return precision_text(self.determined.factor)

    def sentence(self) -> str:
        """Return what is determined and what is not, as a sentence without a full stop."""
        formula = self.determined.formula()
        if self.is_lone:
            loose = precision_text(self.loosest.factor)
            is_open = loose.startswith("not")
            return f"the data {'do not ' if is_open else ''}determine {formula}" + (
                "" if is_open else f" only {loose}"
            )
        if self.determined.form == "unstated":
            return f"the data determine {formula} better than each of them"
        if self.modulus is not None:
            formula = f"{symbol_of(self.modulus)} (about {formula})"
        loose = precision_text(self.loosest.factor)
        only = "" if loose.startswith("not") else "only "
        return (
            f"the data determine {formula} {self.precision()}, and "
            f"{self.loosest.formula()} {only}{loose}"
        )

    def statement(self, most: int | None = None) -> str:
        """Return `sentence` and what would determine the constants: at most so many ways, all by
        default.
        """
        fixes = "; ".join(fix.sentence() for fix in self.fixes[:most])
        return f"{self.sentence()}{'; ' if fixes else ''}{fixes}"

    def with_known_value(self, names: Sequence[str], covariance: Array) -> Combination:
        """Return the combination with the constant, among its `fixes`, of which a value known to
        `KNOWN` would determine the others best; unchanged if one of them would remain undetermined.
        For a constant alone, the known value is that of any other one.

        Parameters
        ----------
        names : sequence of k str
            Constants of the covariance.
        covariance : (k, k) array
            Covariance of their relative deviations.
        """
        members = self.determined.names
        fixes = []
        for known in (name for name in names if (name in members) != self.is_lone):
            k = names.index(known)
            gain = np.outer(covariance[:, k], covariance[:, k]) / (covariance[k, k] + KNOWN**2)
            others = [name for name in members if name != known]
            what = f"{symbol_of(known)} known to {KNOWN:.0%}"
            fixes.append(widest_after(names, others, covariance - gain, what))
        return self._with_fix(min(fixes, key=lambda fix: fix.factor, default=None))

    def with_repetitions(
        self, names: Sequence[str], covariance: Array, noise: Array
    ) -> Combination:
        """Return the combination with `REPETITIONS` times as many recordings among its `fixes`;
        unchanged if it is not one constant alone, or would remain undetermined.

        Parameters
        ----------
        covariance, noise : (k, k) arrays
            Covariance of relative deviations, and its part by noise, which repetitions reduce.
        """
        if not self.is_lone:
            return self
        reduced = covariance - (1 - 1 / REPETITIONS) * noise
        what = f"{REPETITIONS} times as many such recordings"
        return self._with_fix(widest_after(names, self.determined.names, reduced, what))

    def _with_fix(self, fix: Fix | None) -> Combination:
        if fix is None or fix.factor >= WIDE:
            return self
        return replace(self, fixes=(*self.fixes, fix))


def find_combinations(
    names: Sequence[str],
    values: Array,
    covariance: Array,
    undetermined: Collection[str],
    moduli: Mapping[str, Array] | None = None,
) -> tuple[Combination, ...]:
    """Return the combinations of moduli and densities that are determined although one of their
    constants alone is not, the best determined in units of its constants first.

    Parameters
    ----------
    values : (k,) array
        Their values.
    covariance : (k, k) array
        Finite covariance of their relative deviations, for normal distributions.
    undetermined : collection of str
        Constants that are not determined alone.
    moduli : mapping of str to (k,) array, optional
        Relative derivatives of derived moduli by the logarithms of the constants.
    """
    deviations = np.sqrt(np.diag(covariance))
    known = np.flatnonzero(np.isfinite(deviations) & (deviations > 0))
    if len(known) < 2:
        return ()
    scaled = covariance[np.ix_(known, known)] / np.outer(deviations[known], deviations[known])
    found: dict[tuple[int, ...], Combination] = {}
    for variance, vector in zip(*_eigenpairs(scaled), strict=True):
        if variance > LARGEST_SHARE:
            break
        inside = np.flatnonzero(np.abs(vector) > MEMBER * np.abs(vector).max())
        members = known[inside]
        own = [names[int(k)] for k in members]
        if len(own) < 2 or not set(own) & set(undetermined):
            continue
        if not all(is_modulus(name) or is_density(name) for name in own):
            continue  # of no use to an engineer
        within = covariance[np.ix_(members, members)]
        variances, vectors = _eigenpairs(scaled[np.ix_(inside, inside)])
        if variances[0] > LARGEST_SHARE:
            continue  # the constants left out belong to it
        weights = vectors[0] / deviations[members]
        best = Direction.from_weights(own, values[members], weights, within, smallest=0.0)
        loosest = Direction.from_weights(own, values[members], _eigenpairs(within)[1][-1], within)
        if best.factor >= min(HOPELESS, loosest.factor):
            continue
        modulus = _equal_modulus(best, members, covariance, moduli or {})
        found.setdefault(tuple(members.tolist()), Combination(best, loosest, modulus))
    return tuple(found.values())


def lone_constants(
    names: Sequence[str],
    values: Array,
    covariance: Array,
    noise: Array,
    undetermined: Collection[str],
    combinations: Sequence[Combination],
) -> tuple[Combination, ...]:
    """Return the undetermined constants with a positive value that belong to no combination, and
    would be determined without noise; arguments as of `find_combinations`. One that the covariance
    alone would determine has no precision to state.

    `noise` (k, k) is the part of the covariance by noise: what an assumption of the budget leaves
    undetermined, no measurement of another kind is sought for.
    """
    combined = {name for each in combinations for name in each.determined.names}
    combined |= undetermined_names(names, covariance - noise)
    lone = undetermined_names(names, covariance) & set(undetermined) - combined
    found = []
    for k, name in enumerate(names):
        if name in lone and values[k] > 0:
            alone = Direction.from_weights(names, values, np.eye(len(names))[k], covariance)
            found.append(Combination(alone, alone))
    return tuple(found)


def vague_constants(
    names: Sequence[str],
    values: Array,
    covariance: Array,
    noise: Array,
    undetermined: Collection[str],
    moduli: Mapping[str, Array],
    added: Mapping[frozenset[str], Fix] | None = None,
) -> tuple[Combination, ...]:
    """Return the combinations of `find_combinations` and the constants of `lone_constants`, each with
    repetitions and the known value that would determine its constants, after the effect of an
    added measurement on its constants; arguments as of these functions.
    """
    found = find_combinations(names, values, covariance, undetermined, moduli)
    lone = lone_constants(names, values, covariance, noise, undetermined, found)
    vague = []
    for each in (*found, *lone):
        fix = (added or {}).get(frozenset(each.determined.names))
        fixed = each if fix is None else replace(each, fixes=(fix,))
        fixed = fixed.with_repetitions(names, covariance, noise)
        vague.append(fixed.with_known_value(names, covariance))
    return tuple(vague)


def with_something_to_state(vague: Sequence[Combination]) -> tuple[Combination, ...]:
    """Return the combinations, and the constants that one of their `fixes` would determine."""
    return tuple(each for each in vague if each.fixes or not each.is_lone)


def principal_directions(
    names: Sequence[str], values: Array, covariance: Array
) -> tuple[Direction, ...]:
    """Return the independent combinations of k constants, the eigenvectors of a finite covariance
    (k, k) of their relative deviations, the best determined first.
    """
    _, vectors = _eigenpairs(covariance)
    found = (Direction.from_weights(names, values, vector, covariance) for vector in vectors)
    return tuple(sorted(found, key=lambda direction: direction.factor))


def undetermined_names(names: Sequence[str], covariance: Array) -> set[str]:
    """Return the constants whose interval is wider than their value, from the covariance (k, k) of
    their relative deviations.
    """
    widest = np.log(WIDE) / NORMAL_95
    return {
        name
        for name, variance in zip(names, np.diag(covariance), strict=True)
        if variance > widest**2
    }


def widest_after(
    names: Sequence[str], members: Collection[str], covariance: Array, what: str
) -> Fix:
    """Return the effect of a measurement on some constants: the widest of their intervals.

    Parameters
    ----------
    names : sequence of k str
        Constants of the covariance.
    members : collection of str
        Constants that count.
    covariance : (k, k) array
        Covariance of their relative deviations with the measurement.
    what : str
        The measurement, as a phrase.
    """
    variances = {
        name: max(0.0, covariance[k, k]) for k, name in enumerate(names) if name in members
    }
    widest = max(variances, key=lambda name: variances[name])
    reach = min(NORMAL_95 * np.sqrt(variances[widest]), LARGEST_LOGARITHM)
    return Fix(what, widest, float(np.exp(reach)))


def _eigenpairs(matrix: Array) -> tuple[Array, Array]:
    """Return the eigenvalues (k,) of a symmetric matrix, ascending, and its eigenvectors in rows."""
    values, vectors = np.linalg.eigh(matrix)
    return values, vectors.T


def _equal_modulus(
    best: Direction, members: Index, covariance: Array, moduli: Mapping[str, Array]
) -> str | None:
    """Return the derived modulus of these constants alone that is about as precise."""
    others = np.setdiff1d(np.arange(len(covariance)), members)
    variances, directions = _eigenpairs(covariance[np.ix_(members, members)])
    # Of what is not determined at all, first derivatives tell nothing further away.
    half_widths = np.minimum(NORMAL_95 * np.sqrt(np.maximum(0.0, variances)), np.log(HOPELESS))
    for name, slope in moduli.items():
        if not is_modulus(name):
            continue
        size = np.abs(slope[members]).max(initial=0.0)
        if not size or np.abs(slope[others]).max(initial=0.0) > SMALLEST_POWER * size:
            continue
        half_width = np.linalg.norm(half_widths * (directions @ slope[members]))
        if half_width <= SAME * np.log(best.factor):
            return name
    return None


# Interval as a factor up to which a parameter is well determined.
WELL_FIXED = 1.25


def identifiability_sentences(
    uncertainty: Uncertainty, combinations: Sequence[Combination] = ()
) -> tuple[str, ...]:
    """Return sentences about each parameter and about combinations of parameters, with 95 %
    intervals.

    Sentences on parameters at a bound or not identifiable are the same as in the notes.

    Parameters
    ----------
    combinations : sequence of Combination
        Combinations of parameters that are determined.

    Returns
    -------
    tuple of str
        First the determined parameters, then combinations, then the moduli of the other
        elastic convention (only if a combination or one of the following is reported), then the
        notes of `uncertainty` that begin with a parameter's name. Empty if nothing can be said.
    """
    open_ends = [note for note in uncertainty.notes if note.split()[0] in uncertainty.names]
    combined = [each.statement() for each in combinations]
    in_other_terms = _other_convention(uncertainty) if open_ends or combined else []
    return (*_single_sentences(uncertainty), *combined, *in_other_terms, *open_ends)


def _single_sentences(uncertainty: Uncertainty) -> list[str]:
    factors = {
        name: factor
        for name in uncertainty.names
        if name in uncertainty.estimates
        and (factor := _interval_factor(uncertainty.estimates[name])) is not None
    }
    well = [f"{name} {_precision_text(f)}" for name, f in factors.items() if f <= WELL_FIXED]
    badly = [f"{name} only {_precision_text(f)}" for name, f in factors.items() if f > WELL_FIXED]
    parts = [listed(part) for part in (well, badly) if part]
    if not parts:
        return []
    return [f"noise alone leaves {'; '.join(parts)} (95 %, statistical, no systematic effects)"]


def _other_convention(uncertainty: Uncertainty) -> list[str]:
    if not set(ELASTIC) & {without_region(name) for name in uncertainty.names}:
        return []
    parts = []
    for name, estimate in uncertainty.derived.items():
        factor = _interval_factor(estimate)
        if factor is not None:
            parts.append(
                f"{name} {'only ' if factor > WELL_FIXED else ''}{_precision_text(factor)}"
            )
    return (
        [
            f"expressed as other elastic constants, noise alone leaves {listed(parts)} "
            "(95 %, statistical)"
        ]
        if parts
        else []
    )


def _interval_factor(estimate: Estimate) -> float | None:
    """Return √(upper/lower) of the statistical interval; None without one, or if hopeless."""
    if estimate.statistical95 is None or not estimate.statistical95[0] > 0:
        return None
    factor = float(np.sqrt(estimate.statistical95[1] / estimate.statistical95[0]))
    return factor if factor < HOPELESS else None


def _precision_text(factor: float) -> str:
    """Return a half width, given as a factor, as text: in per cent below 1.5."""
    if factor < PERCENT:
        return f"±{100 * (factor - 1):.2g} %"
    return f"within a factor of {factor:.2g}" if factor < HOPELESS else "no useful range"
