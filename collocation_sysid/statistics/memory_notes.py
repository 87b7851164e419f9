"""What the estimates of a material's memory do not tell, in sentences."""

from __future__ import annotations

from collections.abc import Mapping

from ..fem.constants import SHARE, TAU, bare
from .estimates import Estimate

# A relaxation time beyond so many recordings is not seen to end.
LONG = 1.0


def memory_notes(estimates: Mapping[str, Estimate], longest_s: float) -> list[str]:
    """Branches that were not found, and those slower than the longest recording."""
    notes = []
    for name, share in estimates.items():
        if bare(name) != SHARE.name:
            continue
        branch = name.removesuffix(f".{SHARE.name}")
        estimated = share.at_bound or share.ci95 is not None
        if not estimated:
            continue
        if share.at_bound and share.value < 1e-6:
            notes.append(
                f"no memory found: the share of {branch} ended at 0, and its relaxation time "
                "means nothing; leave that branch out"
            )
        elif share.ci95 is not None and share.ci95[0] <= 0:
            notes.append(
                f"no memory is told from none: the share of {branch} may be 0, and is at most "
                f"{share.ci95[1]:.2g} (95 %)"
            )
        elif (tau := estimates.get(f"{branch}.{TAU.name}")) and tau.value > LONG * longest_s:
            notes.append(
                f"{branch} relaxes within {tau.value:.2g} s, slower than the longest recording of "
                f"{longest_s:.2g} s: its share and long-term moduli rest on how it begins; record "
                "for longer"
            )
    return notes
