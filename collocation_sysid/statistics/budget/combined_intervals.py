"""Combined 95 % intervals: noise, discretisation and systematic effects of each estimate.

The combined interval is the one to publish. It contains three independent contributions: the
statistical part (noise of the measurements, nuisance parameters), the discretisation error (time
step, and mesh where it was refined), and the systematic effects of the budget (type B evaluation,
JCGM 100:2008, 4.3). All three are added in quadrature in the coordinate in which the parameter is
estimated, its logarithm as a rule, see `IntervalCoordinate`. The known part of the discretisation
error is corrected, not only budgeted (ibid., 3.2.4): the reported value is the extrapolated one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..estimates import Estimate, IntervalCoordinate
from .discretisation_error import DiscretisationError

# Half width of a normal distribution's 95 % interval, in standard deviations.
NORMAL_95 = 1.96

Interval = tuple[float, float]


@dataclass(frozen=True)
class CombinedEstimate:
    """A corrected value with its statistical and its combined uncertainty."""

    # The estimate, corrected for the known discretisation error and effects of known size.
    value: float
    # Standard error due to noise and nuisance parameters; None if it has none.
    statistical_std_error: float | None
    # (lower, upper) or None: 95 % interval due to noise and nuisance parameters, about `value`;
    # None if unknown.
    statistical95: Interval | None
    # Standard uncertainty due to all contributions; None if unknown.
    combined_std_error: float | None = None
    # (lower, upper) or None: 95 % interval due to all contributions; None if unknown.
    combined95: Interval | None = None
    # Part of `value` that corrects for effects of known size, before bounds are applied; None if
    # there are none. The correction of the discretisation error is not contained.
    known_correction: float | None = None


def combine(
    name: str,
    estimate: Estimate,
    error: DiscretisationError | None,
    systematic: float | None,
    *,
    known_effect: float = 0.0,
    linear: bool = False,
    bounds: Interval = (-np.inf, np.inf),
) -> CombinedEstimate:
    """Correct an estimate and combine the contributions to its uncertainty.

    An estimate at a bound is not corrected and has no uncertainty.

    Parameters
    ----------
    name : str
        Name of a parameter or derived modulus.
    estimate : Estimate
        The optimum of the discretised problem with its statistical uncertainty.
    error : DiscretisationError or None
        Discretisation error; None if it is unknown or zero.
    systematic : float or None
        Standard deviation of all systematic effects together, in the coordinate of the estimate;
        None if they were not evaluated, which leaves the combined interval unknown.
    known_effect : float
        Correction for systematic effects of known size, in the coordinate of the estimate.
    linear : bool
        Whether the parameter itself is its coordinate, rather than its logarithm.
    bounds : (lower, upper)
        Bounds of the parameter, which value and intervals respect.

    Returns
    -------
    CombinedEstimate
        Without a statistical interval of `estimate` there is no combined one.

    Notes
    -----
    The coordinate is linear as well if the estimate or an end of an interval is not positive, see
    `IntervalCoordinate.for_estimate`. Intervals are shifted with the value.
    """
    if estimate.at_bound:
        return CombinedEstimate(estimate.value, None, statistical95=None)
    is_corrected = error is not None or known_effect != 0.0
    known = [estimate.value, *(estimate.statistical95 or ())]
    corrections = () if error is None else (error.extrapolated, *(error.interval95 or ()))
    at = IntervalCoordinate.for_estimate(name, (*known, *corrections), linear=linear)
    optimum = at.from_value(estimate.value)
    centre = optimum if error is None else at.from_value(error.extrapolated)
    centre += known_effect
    value = _clip(bounds, at.to_value(centre)) if is_corrected else estimate.value
    correction = at.to_value(centre) - at.to_value(centre - known_effect) if known_effect else None
    spread = estimate.statistical_std_error
    if spread is not None:
        spread *= at.derivative(estimate.value) / at.derivative(at.to_value(centre))
    if estimate.statistical95 is None:
        return CombinedEstimate(value, spread, statistical95=None, known_correction=correction)
    low, high = (at.from_value(end) + centre - optimum for end in estimate.statistical95)
    statistical95 = _interval(at, low, high=high, bounds=bounds)
    if not is_corrected:
        least, most = estimate.statistical95
        statistical95 = _clip(bounds, least), _clip(bounds, most)
    if systematic is None:
        return CombinedEstimate(
            value, spread, statistical95=statistical95, known_correction=correction
        )
    if error is not None and error.interval95 is not None:
        low, high = map(at.from_value, error.interval95)
        low = low + known_effect
        high = high + known_effect
    low, high = widened_interval((low, high), centre, deviation=systematic)
    combined95 = _interval(at, low, high=high, bounds=bounds)
    deviation = (high - low) / 2 / NORMAL_95 / at.derivative(at.to_value(centre))
    return CombinedEstimate(
        value,
        spread,
        statistical95=statistical95,
        combined_std_error=deviation,
        combined95=combined95,
        known_correction=correction,
    )


def widened_interval(ends: Interval, centre: float, deviation: float) -> Interval:
    """Return a 95 % interval with one more independent contribution, added in quadrature.

    Parameters
    ----------
    ends : (lower, upper)
        The interval, in the coordinate of the estimate.
    centre : float
        The estimate in that coordinate, from which either side is measured.
    deviation : float
        Standard deviation of the contribution in that coordinate.
    """
    low, high = ends
    below = float(np.hypot(centre - low, NORMAL_95 * deviation))
    above = float(np.hypot(high - centre, NORMAL_95 * deviation))
    return centre - below, centre + above


def _clip(bounds: Interval, value: float) -> float:
    low, high = bounds
    return float(min(max(value, low), high))


def _interval(at: IntervalCoordinate, low: float, high: float, bounds: Interval) -> Interval:
    return _clip(bounds, at.to_value(low)), _clip(bounds, at.to_value(high))
