"""What speaks against a live estimate."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from ..statistics.estimates import Estimate
from ..statistics.trust import (
    GROSS_MISFIT,
    HARDLY_TAME,
    MISFIT,
    PERSISTENT,
    WILD,
    Concern,
    concerned,
)
from .statistics import Scatter

# Estimates this many standard errors from where all is linearised may still move.
UNSETTLED = 0.5


def data_concerns(scatter: Scatter, counts: Counter[str], samples: int) -> list[Concern]:
    """The residuals, and samples that were left out."""
    wild, anew = counts["wild"] / max(1, samples), counts["begun anew"]
    size = {"factor": scatter.rms, "stated": "sigma_m"}
    times = "once" if anew == 1 else f"{anew} times"
    return [
        *concerned(scatter.rms > MISFIT, scatter.rms > GROSS_MISFIT, "noise/larger", **size),
        *concerned(
            scatter.lag1 > PERSISTENT, False, "residuals/persist", autocorrelation=scatter.lag1
        ),
        *concerned(wild > WILD, wild > HARDLY_TAME, "residuals/far", percent=100 * wild),
        *concerned(anew > 0, False, "solve/anew", times=times),
    ]


def estimate_concerns(estimates: Mapping[str, Estimate], moved: float) -> list[Concern]:
    """What the estimates say of themselves; `moved` is in standard errors."""
    found = concerned(moved > UNSETTLED, False, "solve/moves")
    for name, estimate in estimates.items():
        if estimate.at_bound:
            found += concerned(True, False, "information/at-bound", name=name)
        elif estimate.reason is not None:
            reason = estimate.reason
            found += concerned(True, False, "information/not-yet", name=name, reason=reason)
    return found
