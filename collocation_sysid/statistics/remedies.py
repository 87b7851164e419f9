"""Remedies: what to measure in order to reduce a source of the uncertainty budget."""

from __future__ import annotations

from collections.abc import Mapping

from .budget.systematic_effects import DEVIATIONS

# One remedy per source of the budget, as an imperative phrase that ends a sentence.
REMEDIES: Mapping[str, str] = {
    **{name: row.remedy for name, row in DEVIATIONS.items() if row.remedy},
    "noise": "record longer, more often, or a motion or test that depends more on this parameter",
    "nuisance parameters": "measure clocks, marker positions and the grip, or the area and "
    "unloaded length of a specimen, and state tighter priors",
    "step and mesh": "raise transcription.substeps, or run refine",
    "between recordings": "find out what differs between the recordings, such as temperature or clamping",
}


def remedy_for(source: str) -> str:
    """Return what to measure in order to reduce a source of the budget, as an imperative phrase
    without a full stop.

    Any other source, such as a nuisance parameter that is budgeted instead of estimated, gets a
    phrase with its name.
    """
    fallback = f"measure {source}, or estimate it with its prior in [experiment.nuisance]"
    return REMEDIES.get(source, fallback)
