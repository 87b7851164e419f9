"""How large the residuals are against σ, and how they hang together from sample to sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, stdtrit

from ..arrays import Array
from ..program.least_squares import LeastSquares

# Probability of taking noise of the σ given for larger, at each look.
RARE = 1e-3
# Autocorrelations that matter are larger than this, and than so many of their deviations.
PERSISTENT, DEVIATIONS = 0.1, 3.3
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
        matters = lag1 > max(PERSISTENT, DEVIATIONS / np.sqrt(count))
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
    if chdtrc(freedom, loss) < RARE:
        factor, quantile = loss / freedom, float(stdtrit(freedom, 0.975))
    return factor * (1 + scatter.lag1) / (1 - scatter.lag1), quantile
