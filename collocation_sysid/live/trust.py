"""What speaks against a live estimate, each a sentence and how strong it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from ..statistics.estimates import Estimate
from ..statistics.trust import GROSS_MISFIT, HARDLY_TAME, MISFIT, PERSISTENT, WILD, Concern
from .statistics import Scatter

# Estimates this many standard errors from where all is linearised may still move.
UNSETTLED = 0.5


def data_concerns(scatter: Scatter, counts: Counter[str], samples: int) -> list[Concern]:
    """The residuals, and samples that were left out."""
    found: list[Concern] = []
    if scatter.rms > MISFIT:
        said = f"the residuals are {scatter.rms:.2g} times as large as sigma_m says"
        found.append((said, "doubtful" if scatter.rms > GROSS_MISFIT else "check"))
    if scatter.lag1 > PERSISTENT:
        said = "the residuals are not noise: they persist from sample to sample"
        found.append((f"{said} (autocorrelation {scatter.lag1:.2f})", "check"))
    wild = counts["wild"] / max(1, samples)
    if wild > WILD:
        said = f"{100 * wild:.0f} % of the markers' samples lie far from where they can be"
        found.append((said, "doubtful" if wild > HARDLY_TAME else "check"))
    if anew := counts["begun anew"]:
        times = "once" if anew == 1 else f"{anew} times"
        said = f"begun anew {times}, as if the body had been at rest there"
        found.append((said, "check"))
    return found


def estimate_concerns(estimates: Mapping[str, Estimate], moved: float) -> list[Concern]:
    """What the estimates say of themselves; `moved` is in standard errors."""
    found: list[Concern] = []
    if moved > UNSETTLED:
        said = "the estimate still moves: it is further than its error from where it was simulated"
        found.append((said, "check"))
    for name, estimate in estimates.items():
        if estimate.at_bound:
            found.append((f"{name} is at a bound", "check"))
        elif estimate.reason is not None:
            found.append((f"{name} is not known yet: {estimate.reason}", "check"))
    return found
