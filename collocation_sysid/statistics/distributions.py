"""Quantiles and tail probabilities of the normal, χ², Student's, Beta and F distributions.

`scipy.stats` has them too, but takes as long to import as all other parts of SciPy together.
Arguments may be arrays.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike
from scipy.special import betaincc, chdtr, chdtrc, chdtri, fdtrc, ndtri, stdtrit


def normal_isf(tail: ArrayLike) -> Any:
    """Return the value that a standard normal variable exceeds with probability `tail`; infinite
    for 0, NaN outside 0 to 1.
    """
    return -ndtri(tail)


def largest_deviation(count: int, chance: float) -> float:
    """Return the deviation, in standard deviations, that any of `count` normal variables exceeds with
    a probability (Bonferroni): with 1e-4, 3.9 for one, 4.6 for 20.
    """
    return float(normal_isf(chance / 2 / max(1, count)))


def chi2_cdf(value: ArrayLike, freedom: ArrayLike) -> Any:
    """Return the probability of a χ² up to `value` with `freedom` degrees of freedom."""
    return chdtr(freedom, value)


def chi2_sf(value: ArrayLike, freedom: ArrayLike) -> Any:
    """Return the probability of a χ² beyond `value` with `freedom` degrees of freedom."""
    return chdtrc(freedom, value)


def chi2_isf(tail: ArrayLike, freedom: ArrayLike) -> Any:
    """Return the value that a χ² with `freedom` degrees of freedom exceeds with probability
    `tail`.
    """
    return chdtri(freedom, tail)


def student_95(freedom: ArrayLike) -> Any:
    """Return the half width of the 95 % interval of Student's t with `freedom` degrees of freedom."""
    return stdtrit(freedom, 0.975)


def beta_sf(value: ArrayLike, a: ArrayLike, b: ArrayLike) -> Any:
    """Return the probability of a Beta variable with parameters a, b beyond `value`."""
    return betaincc(a, b, value)


def f_sf(value: ArrayLike, numerator_freedom: ArrayLike, freedom: ArrayLike) -> Any:
    """Return the probability that an F variable exceeds `value`, with `numerator_freedom` and
    `freedom` degrees of freedom of numerator and denominator.
    """
    return fdtrc(numerator_freedom, freedom, value)
