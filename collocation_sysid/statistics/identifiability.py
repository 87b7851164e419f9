"""Identifiability: what the data determine and what they do not, as sentences.

Directions are those of the marginal covariance of the parameters' logarithms, scaled to unit
variances (correlation matrix). An eigenvalue ε ≪ 1 belongs to a combination Σ w_k q_k, a product of
powers of the parameters, which is known √ε times better than each of them alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..errors import listed
from ..fem.laws.constants import without_region
from ..fem.laws.moduli import ELASTIC
from .estimates import CONFOUNDED, Estimate
from .uncertainty import Uncertainty

# Interval as a factor up to which a parameter is well determined.
WELL_FIXED = 1.25
# Share of the largest component from which on a parameter belongs to a combination.
MEMBER = 0.2
# Interval as a factor above which it is useless.
HOPELESS = 1e4


def identifiability_sentences(uncertainty: Uncertainty) -> tuple[str, ...]:
    """Return sentences about each parameter and about combinations of parameters, with 95 %
    intervals.

    Sentences on parameters at a bound or not identifiable are the same as in the notes.

    Returns
    -------
    tuple of str
        First the determined parameters, then confounded combinations, then the moduli of the other
        elastic convention (only if a combination or one of the following is reported), then the
        notes of `uncertainty` that begin with a parameter's name. Empty if nothing can be said.
    """
    open_ends = [note for note in uncertainty.notes if note.split()[0] in uncertainty.names]
    combined = _combination_sentences(uncertainty)
    in_other_terms = _other_convention(uncertainty) if open_ends or combined else []
    return (*_single_sentences(uncertainty), *combined, *in_other_terms, *open_ends)


def _single_sentences(uncertainty: Uncertainty) -> list[str]:
    """Return one sentence, as a list, about the parameters with a useful interval and its half
    width, well determined ones (up to `WELL_FIXED`) first; empty if there are none.
    """
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


def _combination_sentences(uncertainty: Uncertainty) -> list[str]:
    """Return sentences about confounded parameters, one for each eigenvector of their correlations
    with an eigenvalue up to 1 − `CONFOUNDED`.

    Coefficients of fields and parameters without a finite, positive variance are left out, and
    combinations of three or more parameters that are all well determined.
    """
    deviations = np.sqrt(np.diag(uncertainty.covariance))
    is_scalar = np.array([name in uncertainty.estimates for name in uncertainty.names], dtype=bool)
    known = np.flatnonzero(np.isfinite(deviations) & (deviations > 0) & is_scalar)
    if len(known) < 2:
        return []
    correlation = uncertainty.correlation[np.ix_(known, known)]
    values, vectors = np.linalg.eigh(correlation)
    sentences = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value > 1 - CONFOUNDED:
            break
        members = np.flatnonzero(np.abs(vector) > MEMBER * np.abs(vector).max())
        # Three or more that are well known each need no word about their company.
        widths = (uncertainty.quantiles * deviations)[known[members]]
        if len(members) == 2 or (len(members) > 2 and widths.max() > np.log(WELL_FIXED)):
            sentences.append(
                _combination_sentence(
                    uncertainty, known[members], eigenvalue=max(value, 0.0), vector=vector[members]
                )
            )
    return sentences


def _combination_sentence(
    uncertainty: Uncertainty, members: NDArray[np.intp], eigenvalue: float, vector: Array
) -> str:
    """Return the sentence about one combination of confounded parameters, from a small eigenvalue
    of their correlations.

    It states the combination as a product of powers, the largest of them 1, and the factor of its
    95 % interval; of two parameters also their correlation, unless a note of `uncertainty` states
    that they are confounded. If the value of a parameter is not above 0, it only states that one
    combination is determined.
    """
    names = [uncertainty.names[k] for k in members]
    deviations = np.sqrt(np.diag(uncertainty.covariance))[members]
    quantiles = uncertainty.quantiles[members]
    weights = vector / deviations
    largest = int(np.argmax(np.abs(weights)))
    fixed = np.exp(quantiles.max() * np.sqrt(eigenvalue) / abs(weights[largest]))
    how = ""
    if len(members) == 2:
        how = f" (correlation {uncertainty.correlation[members[0], members[1]]:.3f})"
    has_powers = all(uncertainty.estimates[name].value > 0 for name in names)
    if has_powers and _is_confounding_noted(uncertainty, names):
        return (
            f"of {listed(names)} only the combination "
            f"{_product_text(names, weights / weights[largest])} is determined, to "
            f"{_precision_text(float(fixed))} (95 %, statistical)"
        )
    if not has_powers:
        return (
            f"{listed(names)} are confounded{how}: these data determine only one combination "
            "of them"
        )
    return (
        f"{listed(names)} are confounded{how}: only their combination "
        f"{_product_text(names, weights / weights[largest])} is determined, to "
        f"{_precision_text(float(fixed))} (95 %, statistical)"
    )


def _is_confounding_noted(uncertainty: Uncertainty, names: Sequence[str]) -> bool:
    """Return whether two parameters are those of a note on confounded parameters, which the reason
    of the estimate of one of them is; false for another number of parameters.
    """
    if len(names) != 2:
        return False
    return any(
        (uncertainty.estimates[name].reason or "").startswith(f"confounded with {other} ")
        for name, other in (names, names[::-1])
    )


def _other_convention(uncertainty: Uncertainty) -> list[str]:
    """Return one sentence, as a list, about the moduli of the other elastic convention with a
    useful interval; empty if there are none, or if no elastic constant is estimated.
    """
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
    """Return √(upper/lower) of the statistical interval of an estimate; None without one, if its
    lower end is not positive, or if the factor is `HOPELESS` or more.
    """
    if estimate.statistical95 is None or not estimate.statistical95[0] > 0:
        return None
    factor = float(np.sqrt(estimate.statistical95[1] / estimate.statistical95[0]))
    return factor if factor < HOPELESS else None


def _precision_text(factor: float) -> str:
    """Return an interval's half width, given as a factor of 1 or more, as text: in per cent below
    1.5, "no useful range" from `HOPELESS` on.
    """
    if factor < 1.5:
        return f"±{100 * (factor - 1):.2g} %"
    return f"within a factor of {factor:.2g}" if factor < HOPELESS else "no useful range"


def _product_text(names: Sequence[str], powers: Array) -> str:
    """Return a product of powers (k,) of parameters as text, such as "a · b^0.5"; a power of 1 is
    left out.
    """
    parts = []
    for name, power in zip(names, powers, strict=True):
        parts.append(name if abs(power - 1) < 5e-3 else f"{name}^{power:.2g}")
    return " · ".join(parts)
