"""Statistical intervals that follow a curved loss.

The interval of a linearised fit is right where the loss is quadratic in the coordinate of a
parameter over the interval. Towards incompressibility it is not: the stiffness of a body changes
ever more with Poisson's ratio ν, whose effect below is nearly that of E. The standard error at an
estimate that is too high by chance is then a third of that at the true value, and its interval
misses the truth more often than it should. Where the compressibility is estimated and changes
enough within its interval, the profile likelihood replaces the interval, and those of all other
estimates follow: the share of their variance that belongs to this parameter is replaced by their
change along the profile, the rest is added in quadrature.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..common.array_types import Array
from ..errors import InputError
from ..fem.laws.constants import without_region
from ..program.collocation import Collocation
from .distributions import normal_isf
from .estimates import Estimate, IntervalCoordinate, relative_derivatives
from .linearised import LinearisedFit, linearise_fit, parameter_values
from .pose_noise import with_pose_noise
from .probes.profile_likelihood import profile_and_refits
from .uncertainty import AUTO, ErrorModel, Uncertainty, uncertainty_from_fit

# Parameters of the compressibility, and the factor by which λ/μ has to change within the interval.
COMPRESSIBILITIES = ("poisson", "lambda_pa", "kappa_pa")
LEAST_CHANGE = 1.25
# Least share of an estimate's combined standard uncertainty that is statistical: 0.7 is half of the
# variance. Below it refits, which cost as much as several solves, hardly change what is published.
LARGER_PART = 0.7
# An end of the profile's interval that is closer than this to the linear one, over its distance
# from the estimate, changes nothing.
ALIKE = 0.15
# A loss that is lower than at the estimate by more than this share of the rise at an end shows that
# the estimate is no minimum, about which no interval can be followed.
LOWER = 0.02


def with_curved_intervals(
    uncertainty: Uncertainty,
    fit: LinearisedFit,
    collocation: Collocation,
    z: Array,
    combined: Mapping[str, float | None] | None = None,
) -> Uncertainty:
    """Return the uncertainty of a fit at z with statistical intervals that follow the loss along
    the compressibility; the same where this is not estimated, not determined, or the loss nearly
    quadratic, or where most of the `combined` standard uncertainty, by name, is not statistical.
    Covariances are not changed.
    """
    for k, item in enumerate(collocation.parameters.free):
        whole = (combined or {}).get(item.name)
        own = uncertainty.estimates.get(item.name)
        if own is not None and _may_be_curved(item.name, own, whole):
            uncertainty = _along_profile(uncertainty, fit, collocation, z, k)
    return uncertainty


def _may_be_curved(name: str, estimate: Estimate, whole: float | None) -> bool:
    statistical = estimate.statistical_std_error
    if (
        without_region(name) not in COMPRESSIBILITIES
        or estimate.statistical95 is None
        or statistical is None
        or (whole is not None and statistical < LARGER_PART * whole)
    ):
        return False
    low, high = estimate.statistical95
    if without_region(name) == "poisson":
        low, high = (each / (1 - 2 * each) if each < 0.5 else np.inf for each in (low, high))
    return low > 0 and high > LEAST_CHANGE * low


def _along_profile(
    uncertainty: Uncertainty, fit: LinearisedFit, collocation: Collocation, z: Array, k: int
) -> Uncertainty:
    parameters, q = collocation.parameters, z[: collocation.nq]
    item, quantile = parameters.free[k], float(uncertainty.quantiles[k])
    widening = (quantile / normal_isf(0.025)) ** 2
    try:
        profile, refits = profile_and_refits(
            collocation, z, fit, uncertainty, k, first_step=quantile, widening=widening
        )
    except InputError:  # the estimate is beyond a bound by rounding
        return uncertainty
    at = np.searchsorted(profile.values, item.from_coordinate(float(z[k])))
    if profile.rises[at] > LOWER * profile.threshold:
        return uncertainty
    ends, bounds = profile.interval, (item.lower, item.upper)
    closed = [bound if end is None else end for end, bound in zip(ends, bounds, strict=True)]
    refitted = [refits.values_near(end) | {item.name: end} for end in closed]
    sizes = relative_derivatives(parameters, q)
    of_q = uncertainty.covariance / np.outer(sizes, sizes)
    values = parameter_values(collocation, q)
    slopes = {
        other.name: np.eye(len(q))[j] * other.value_derivative(values[other.name])
        for j, other in enumerate(parameters.free)
        if j in parameters.scalar_coordinates
    } | dict(fit.derived.derivatives)

    def follow(name: str, estimate: Estimate) -> Estimate:
        is_other = name != item.name and without_region(name) in COMPRESSIBILITIES
        if name not in slopes or estimate.statistical95 is None or is_other:
            return estimate
        used = np.flatnonzero(slopes[name])
        by_q = slopes[name][used]
        covariance = by_q @ of_q[used, k]
        rest = by_q @ of_q[np.ix_(used, used)] @ by_q - covariance**2 / of_q[k, k]
        moved = [each[name] for each in refitted]
        return _with_ends(name, estimate, moved, quantile * np.sqrt(max(0.0, float(rest))))

    own = uncertainty.estimates[item.name]
    if _are_alike(own, follow(item.name, own)):
        return uncertainty
    return replace(
        uncertainty,
        estimates={name: follow(name, each) for name, each in uncertainty.estimates.items()},
        derived={name: follow(name, each) for name, each in uncertainty.derived.items()},
    )


def _with_ends(name: str, estimate: Estimate, moved: list[float], rest: float) -> Estimate:
    """Return the interval of ends in either order, widened in quadrature by `rest`."""
    assert estimate.statistical95 is not None
    values = (estimate.value, *estimate.statistical95, *moved)
    at = IntervalCoordinate.for_estimate(name, values, linear=min(values) <= 0)
    centre = at.from_value(estimate.value)
    ways = [at.from_value(each) - centre for each in moved]
    if not np.isfinite([rest, *ways]).all():
        return estimate
    rest *= at.derivative(estimate.value)
    low = at.to_value(centre - np.hypot(max(0.0, -min(ways)), rest))
    high = at.to_value(centre + np.hypot(max(0.0, *ways), rest))
    error = estimate.statistical_std_error
    if error is not None:
        error *= (high - low) / (estimate.statistical95[1] - estimate.statistical95[0])
    return replace(estimate, statistical_std_error=error, statistical95=(low, high))


def _are_alike(before: Estimate, after: Estimate) -> bool:
    assert before.statistical95 is not None
    assert after.statistical95 is not None
    old, new = (np.abs(np.array(each.statistical95) - before.value) for each in (before, after))
    return bool((np.abs(new - old) <= ALIKE * old).all())


def uncertainty_at(
    collocation: Collocation, z: Array, error_model: ErrorModel = AUTO
) -> Uncertainty:
    """Return the uncertainty of the parameters at the optimum z (variables,), with noise of the
    poses and curved intervals.

    Raises
    ------
    InputError
        If the noise is to be estimated from fewer measurements than parameters.
    SimulationError
        If the equations of motion are singular.
    """
    fit, _ = with_pose_noise(linearise_fit(collocation, z), collocation, z=z)
    uncertainty = uncertainty_from_fit(
        fit, collocation.parameters, q=z[: collocation.nq], error_model=error_model
    )
    return with_curved_intervals(uncertainty, fit, collocation, z)
