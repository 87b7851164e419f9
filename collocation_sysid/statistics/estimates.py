"""Values with error bars, in the user's parameters and in the other elastic convention.

The logarithm of a positive parameter is taken as normal (or Student's t), for Poisson's ratio
ln ν/(½ − ν) = ln λ/μ is: intervals stay within what is physically possible. A parameter that may
be negative is taken as normal itself. A number after ± is
given only where it tells something; else the estimate has a reason instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..fem.constants import bare, constant_named
from ..model.parameters import Parameter, Parameters
from .linearised import Derived

Mask = NDArray[np.bool_]

# Deviation of a logarithm beyond which the data do not determine the parameter.
UNDETERMINED = 100.0
# An interval wider than this factor, or this share of Poisson's (0, ½), identifies nothing.
WIDE_FACTOR = 10.0
WIDE_POISSON = 0.4
# A correlation beyond this, for a deviation beyond that, leaves only a combination identified.
CONFOUNDED = 0.98
CONFOUNDED_DEVIATION = 0.1


@dataclass(frozen=True)
class Estimate:
    """One value with its error bar.

    Attributes
    ----------
    value : float
    std_error : float or None
        None for what was not estimated, is at a bound, or is not identified by the data.
    ci95 : (lower, upper) or None
        95 % confidence interval; within what is physically possible. An interval may be there,
        and wide, where there is no `std_error`.
    at_bound : bool
        The value, or one it follows from, ended at a bound.
    reason : str or None
        Why something that was estimated has no `std_error`.
    """

    value: float
    std_error: float | None = None
    ci95: tuple[float, float] | None = None
    at_bound: bool = False
    reason: str | None = None


def correlation_of(covariance: Array) -> Array:
    """Correlations; NaN where a variance is not finite."""
    deviation = np.sqrt(np.diag(covariance))
    deviation[~np.isfinite(deviation) | (deviation == 0)] = np.nan
    return covariance / np.outer(deviation, deviation)


def user_estimates(
    parameters: Parameters, q: Array, of_q: Array, bounded: Mask, quantiles: Array
) -> dict[str, Estimate]:
    """Estimates of the user's parameters, by name.

    Parameters
    ----------
    of_q : (nq, nq) covariance of q
    bounded : (nq,) which of q are at a bound
    quantiles : (nq,) half widths of the 95 % intervals, in deviations
    """
    found = {name: Estimate(value) for name, value in parameters.values(q).items()}
    partners = np.abs(np.nan_to_num(correlation_of(of_q)))
    np.fill_diagonal(partners, 0.0)
    for k, item in enumerate(parameters.free):
        value = item.value(float(q[k]))
        if bounded[k]:
            found[item.name] = _at_bound(value)
            continue
        deviation = float(np.sqrt(of_q[k, k]))
        estimate = _of_parameter(item, value, deviation, float(quantiles[k]))
        other = int(np.argmax(partners[k]))
        relative = deviation * item.per_value(value) / max(abs(value), 1e-300)
        if estimate.std_error is None or estimate.ci95 is None:
            pass
        elif estimate.ci95[0] <= item.lower and estimate.ci95[1] >= item.upper:
            reason = "its 95 % interval covers the whole range between its bounds"
            estimate = Estimate(value, None, estimate.ci95, reason=reason)
        elif partners[k, other] > CONFOUNDED and relative > CONFOUNDED_DEVIATION:
            reason = (
                f"confounded with {parameters.free[other].name} "
                f"(correlation {correlation_of(of_q)[k, other]:.3f})"
            )
            estimate = Estimate(value, None, estimate.ci95, reason=reason)
        found[item.name] = estimate
    for item in parameters.items:
        if item.tied is not None:
            found[item.name] = _multiplied(found[item.tied.to], item.tied.ratio)
    return found


def relative_slopes(parameters: Parameters, q: Array) -> Array:
    """(nq,) derivative of each parameter by its q over its size: one for a logarithm."""
    slopes = []
    for item, coordinate in zip(parameters.free, q, strict=True):
        value = item.value(float(coordinate))
        slopes.append(item.per_value(value) / max(abs(value), 1e-300))
    return np.array(slopes)


def derived_estimates(
    derived: Derived, of_q: Array, bounded: Mask, quantiles: Array
) -> dict[str, Estimate]:
    """Estimates of the moduli that follow from the parameters, by the delta method."""
    found = {}
    for name, value in derived.values.items():
        gradient = derived.by_q[name]
        used = np.flatnonzero(gradient)
        if bounded[used].any():
            found[name] = _at_bound(value)
        elif not len(used) or not value > 0:
            found[name] = Estimate(value)
        else:
            variance = gradient[used] @ of_q[np.ix_(used, used)] @ gradient[used]
            deviation = float(np.sqrt(variance)) / value
            found[name] = _estimate(name, value, deviation, float(quantiles[used].max()))
    return found


def _of_parameter(item: Parameter, value: float, deviation: float, quantile: float) -> Estimate:
    """An estimate whose q has this standard deviation."""
    if item.scale == "log":
        return _estimate(item.name, value, deviation, quantile)
    if bare(item.name) == "poisson" and value > 0:
        return _estimate(item.name, value, deviation * item.unit / value, quantile)
    if not deviation <= UNDETERMINED:
        return Estimate(value, reason="the data do not determine it")
    spread = deviation * item.unit
    least = constant_named(item.name).at_least
    return Estimate(
        value, spread, (max(least, value - quantile * spread), value + quantile * spread)
    )


def _multiplied(estimate: Estimate, ratio: float) -> Estimate:
    """The estimate of a multiple."""
    ends = estimate.ci95 and sorted((ratio * estimate.ci95[0], ratio * estimate.ci95[1]))
    return Estimate(
        ratio * estimate.value,
        None if estimate.std_error is None else abs(ratio) * estimate.std_error,
        None if not ends else (ends[0], ends[1]),
        estimate.at_bound,
        estimate.reason,
    )


def _at_bound(value: float) -> Estimate:
    return Estimate(
        value, at_bound=True, reason="it ended at a bound, or follows from one that did"
    )


def _estimate(name: str, value: float, deviation: float, quantile: float) -> Estimate:
    """An estimate whose logarithm has this standard deviation."""
    if not deviation <= UNDETERMINED:  # or NaN
        return Estimate(value, reason="the data do not determine it")
    if bare(name) == "poisson":
        odds = value / (0.5 - value)
        low, high = _around(odds, deviation * 0.5 / (0.5 - value), quantile)
        low, high = 0.5 - 0.5 / (1 + low), 0.5 - 0.5 / (1 + high)
        wide, reason = high - low > WIDE_POISSON, "its 95 % interval covers nearly all of (0, 0.5)"
    else:
        low, high = _around(value, deviation, quantile)
        wide = high > WIDE_FACTOR * low
        reason = f"its 95 % interval spans more than a factor of {WIDE_FACTOR:g}"
    if wide:
        return Estimate(value, None, (low, high), reason=reason)
    return Estimate(value, value * deviation, (low, high))


def _around(value: float, deviation: float, quantile: float) -> tuple[float, float]:
    spread = float(np.exp(min(quantile * deviation, UNDETERMINED)))
    return value / spread, value * spread
