"""How far a live estimate is to be trusted: what residuals and estimates say against it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..program.least_squares import LeastSquares
from ..statistics.concern import Concern, concerned
from ..statistics.distributions import chi2_sf, student_ppf
from ..statistics.estimates import Estimate
from ..statistics.trust import GROSS_MISFIT, HARDLY_TAME, MISFIT, PERSISTENT, WILD

# Estimates this many standard errors from where all is linearised may still move.
UNSETTLED = 0.5
# Probability of taking noise of the σ given for larger, at each look.
RARE = 1e-3
# Autocorrelations that matter are larger than this, and than so many of their deviations.
CORRELATED, DEVIATIONS = 0.1, 3.3
MOST = 0.98
# Fewer samples say nothing about that.
FEWEST = 10


@dataclass(frozen=True)
class Scatter:
    """The size of residuals.

    Attributes
    ----------
    rms : float
        In standard deviations.
    lag1 : float
        Autocorrelation from sample to sample; zero where it does not matter.
    """

    rms: float = 0.0
    lag1: float = 0.0

    @classmethod
    def of(cls, residuals: Sequence[Array]) -> Scatter:
        """Of residuals (M, 3) of samples in turn, NaN where missing."""
        if not residuals:
            return cls()
        found = np.array(residuals)
        square = np.nanmean(found**2) if np.isfinite(found).any() else 0.0
        both = found[1:] * found[:-1]
        count = int(np.isfinite(both).sum())
        if len(found) < FEWEST or not count or not square:
            return cls(float(np.sqrt(square)))
        lag1 = float(np.nanmean(both) / square)
        matters = lag1 > max(CORRELATED, DEVIATIONS / np.sqrt(count))
        return cls(float(np.sqrt(square)), min(lag1, MOST) if matters else 0.0)


def widened(known: LeastSquares, p: Array, fitted: float, scatter: Scatter) -> tuple[float, float]:
    """By what variances are multiplied, and the half width of 95 % intervals in deviations.

    Parameters
    ----------
    known : LeastSquares
        With the priors.
    p : (P,) the estimate
    fitted : float
        Rows that are spent on it.
    """
    freedom = max(1.0, known.rows - fitted)
    loss = known.loss(p)
    factor, quantile = 1.0, 1.96
    if chi2_sf(loss, freedom) < RARE:
        factor, quantile = loss / freedom, float(student_ppf(0.975, freedom))
    return factor * (1 + scatter.lag1) / (1 - scatter.lag1), quantile


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
