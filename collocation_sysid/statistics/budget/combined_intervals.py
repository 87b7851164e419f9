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
from functools import partial

import numpy as np

from ...common.serialisation import optional
from ..estimates import Estimate, IntervalCoordinate
from .discretisation_error import DiscretisationError

# Half width of a normal distribution's 95 % interval, in standard deviations.
NORMAL_95 = 1.96

Interval = tuple[float, float]


@dataclass(frozen=True)
class ReportedEstimate(Estimate):
    """A parameter or derived modulus as it is reported; derived moduli have no `guess`.

    `value` is that of the posterior, or the one extrapolated by a refinement, and `statistical95`
    is centred on it.
    """

    # Standard uncertainty due to noise, discretisation and systematic effects; None if the quantity
    # was not estimated or is at a bound, or if systematic effects were not evaluated.
    combined_std_error: float | None = None
    # (lower, upper) or None: 95 % interval due to the same, the one to publish; None as above.
    combined95: tuple[float, float] | None = None
    # The optimum of the discretised problem, without the correction; None in a study's summary.
    optimum: float | None = None
    # Standard deviation of the systematic effects in the coordinate of the estimate, see
    # `statistics.budget.variance_sources`.
    systematic: float | None = None
    # Change of the value by the effects of the budget, in the same coordinate. `systematic` and
    # `known_effect` do not contain step and mesh, whose error a refinement measures.
    known_effect: float | None = optional()
    numerical_error: DiscretisationError | None = None  # measured by a refinement
    guess: float | None = optional()  # initial guess
    # Whether the parameter was not estimated, or followed another one.
    fixed: bool | None = optional()
    tied: bool | None = optional()

    def at_optimum(self, name: str, *, linear: bool) -> Estimate:
        """Return the estimate before the correction of the discretisation error: with the value
        `optimum`, and the statistical interval and standard error moved with it.

        Without an interval the standard error is unchanged, and without an `optimum` also the
        value.

        Parameters
        ----------
        name : str
            Name of the estimate, which decides its coordinate.
        linear : bool
            Whether the parameter is its own coordinate, see `IntervalCoordinate`.
        """
        optimum = self.value if self.optimum is None else self.optimum
        spread, ends = self.statistical_std_error, self.statistical95
        if ends is not None and optimum != self.value:
            at = IntervalCoordinate.for_estimate(name, (self.value, optimum, *ends), linear=linear)
            correction = at.from_value(self.value) - at.from_value(optimum)
            low, high = (at.to_value(at.from_value(end) - correction) for end in ends)
            ends = low, high
            if spread is not None:
                spread *= at.derivative(self.value) / at.derivative(optimum)
        return Estimate(optimum, spread, ends, at_bound=self.at_bound, reason=self.reason)

    @property
    def is_determined(self) -> bool:
        """Whether the combined interval exists and is not wider than the value, and no `reason`
        leaves this open: the rule of the table, of combinations and of remedies.
        """
        if self.combined95 is None or self.reason is not None:
            return False
        low, high = self.combined95
        return high - low <= abs(self.value)

    @property
    def systematic_std_error(self) -> float | None:
        """Part of the combined standard uncertainty that is not statistical, √(combined²
        − statistical²), at least 0; None if one of the two is unknown.
        """
        if self.combined_std_error is None or self.statistical_std_error is None:
            return None
        difference = self.combined_std_error**2 - self.statistical_std_error**2
        return max(0.0, difference) ** 0.5


def combine(
    name: str,
    estimate: Estimate,
    error: DiscretisationError | None,
    systematic: float | None,
    *,
    known_effect: float = 0.0,
    linear: bool = False,
    bounds: Interval = (-np.inf, np.inf),
) -> ReportedEstimate:
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
    ReportedEstimate
        Without a statistical interval of `estimate` there is no combined one.

    Notes
    -----
    The coordinate is linear as well if the estimate or an end of an interval is not positive, see
    `IntervalCoordinate.for_estimate`. Intervals are shifted with the value.
    """
    reported = partial(
        ReportedEstimate,
        at_bound=estimate.at_bound,
        reason=estimate.reason,
        optimum=estimate.value,
        systematic=systematic,
        known_effect=known_effect or None,
        numerical_error=error,
    )
    if estimate.at_bound:
        return reported(estimate.value)
    is_corrected = error is not None or known_effect != 0.0
    known = [estimate.value, *(estimate.statistical95 or ())]
    corrections = () if error is None else (error.extrapolated, *(error.interval95 or ()))
    at = IntervalCoordinate.for_estimate(name, (*known, *corrections), linear=linear)
    optimum = at.from_value(estimate.value)
    centre = optimum if error is None else at.from_value(error.extrapolated)
    centre += known_effect
    value = _clip(bounds, at.to_value(centre)) if is_corrected else estimate.value
    spread = estimate.statistical_std_error
    if spread is not None:
        spread *= at.derivative(estimate.value) / at.derivative(at.to_value(centre))
    if estimate.statistical95 is None:
        return reported(value, spread)
    low, high = (at.from_value(end) + centre - optimum for end in estimate.statistical95)
    statistical95 = _interval(at, low, high=high, bounds=bounds)
    if not is_corrected:
        least, most = estimate.statistical95
        statistical95 = _clip(bounds, least), _clip(bounds, most)
    if systematic is None:
        return reported(value, spread, statistical95)
    if error is not None and error.interval95 is not None:
        low, high = map(at.from_value, error.interval95)
        low = low + known_effect
        high = high + known_effect
    low, high = widened_interval((low, high), centre, deviation=systematic)
    combined95 = _interval(at, low, high=high, bounds=bounds)
    deviation = (high - low) / 2 / NORMAL_95 / at.derivative(at.to_value(centre))
    return reported(
        value, spread, statistical95, combined_std_error=deviation, combined95=combined95
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
