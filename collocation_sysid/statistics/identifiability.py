"""Identifiability: what the data determine and what they do not, as sentences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import listed
from ..fem.laws.constants import without_region
from ..fem.laws.moduli import ELASTIC
from .combinations import HOPELESS, PERCENT, Combination
from .estimates import Estimate
from .uncertainty import Uncertainty

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
