"""Quantiles and tails of normal, χ², Student's and Beta distribution.

`scipy.stats` has them as well, and takes as long to import as all else of scipy together.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike
from scipy.special import betaincc, chdtr, chdtrc, chdtri, ndtri, stdtrit


def normal_isf(tail: ArrayLike) -> Any:
    """What a standard normal number exceeds with probability `tail`."""
    return -ndtri(tail)


def chi2_cdf(value: ArrayLike, freedom: ArrayLike) -> Any:
    """Probability of a χ² up to `value`."""
    return chdtr(freedom, value)


def chi2_sf(value: ArrayLike, freedom: ArrayLike) -> Any:
    """Probability of a χ² beyond `value`."""
    return chdtrc(freedom, value)


def chi2_isf(tail: ArrayLike, freedom: ArrayLike) -> Any:
    """What a χ² exceeds with probability `tail`."""
    return chdtri(freedom, tail)


def student_ppf(share: ArrayLike, freedom: ArrayLike) -> Any:
    """What Student's t stays below with probability `share`."""
    return stdtrit(freedom, share)


def beta_sf(value: ArrayLike, a: ArrayLike, b: ArrayLike) -> Any:
    """Probability of a Beta variable with parameters a, b beyond `value`."""
    return betaincc(a, b, value)
