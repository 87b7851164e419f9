"""Profile likelihood of one parameter: its 95 % interval from refits with the parameter fixed.

The loss, minimised over everything else, rises by 3.84 (the 95 % quantile of χ² with one degree of
freedom) at the ends of the interval. Unlike a standard error this follows a curved or one-sided
loss; where the loss never rises so far, the interval is open.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import root_scalar

from ...common.array_types import Array
from ...common.step_counting import search_activity
from ...errors import InputError, SimulationError
from ...methods.reduced_space import ReducedSpace
from ...methods.solution import Solution
from ...model.parameters import Parameter
from ..distributions import chi2_isf
from ..estimates import relative_derivatives
from ..linearised import LinearisedFit, least_squares_of_fit
from ..uncertainty import Uncertainty

SolveFixed = Callable[[str, float], float]

# Increase of the loss at the ends of a 95 % interval.
THRESHOLD = float(chi2_isf(0.05, 1))
# Relative precision of the ends, in the logarithm.
PRECISION = 0.02
# Largest number of doublings of the first step.
MOST_DOUBLINGS = 20
# Largest rise over the threshold; infinite losses count as this.
HIGHEST = 16.0


@dataclass(frozen=True, eq=False)
class Profile:
    """Loss as a function of one parameter, with everything else fitted.

    Attributes
    ----------
    parameter : str
        Name.
    values, losses : (n,) arrays
        Ascending values and the losses there; infinite where there is no solution.
    threshold : float
        Increase of the loss at which the interval ends.
    interval : (lower or None, upper or None)
        95 % interval; None where it is open, because the loss does not rise so far up to the last
        value.
    message : str
        Message for the user.
    """

    parameter: str
    values: Array
    losses: Array
    threshold: float
    interval: tuple[float | None, float | None]
    message: str


def compute_profile(
    solve_fixed: SolveFixed,
    parameter: str,
    best: tuple[float, float],
    bounds: tuple[float, float],
    deviation: float = 0.1,
    noise_scale: float = 1.0,
) -> Profile:
    """Search the two values at which the loss has risen by the threshold.

    Parameters
    ----------
    solve_fixed : callable (parameter, value) -> loss
        Returns Σ ((ŷ − h(x)) / σ)² with priors, minimised with the parameter fixed; a
        `SimulationError` counts as an infinite loss.
    parameter : str
        Name.
    best : (value, loss)
        The optimum.
    bounds : (lower, upper)
        Positive bounds of the parameter, which the search does not leave.
    deviation : float
        Expected standard deviation of the logarithm: the first step is two of them.
    noise_scale : float
        Variance of the residuals in units of σ², by which the threshold grows: the reduced χ² if
        the noise is estimated, more if errors are correlated.

    Returns
    -------
    Profile
        An open end of the interval is None. If a lower loss than at `best` is found, the message
        says so.

    Raises
    ------
    InputError
        If the best value is not within the bounds.

    Notes
    -----
    Ends are found to `PRECISION` in the logarithm. A deviation that is not positive and finite
    counts as 0.05. The optimum is not solved again.
    """
    value, loss = best
    if not 0 < bounds[0] <= value <= bounds[1]:
        raise InputError(
            f"best value {value:g} of {parameter} is not within its bounds "
            f"[{bounds[0]:g}, {bounds[1]:g}]"
        )
    losses_by_value = {value: loss}
    threshold = THRESHOLD * noise_scale

    def rise(way: float) -> float:
        """Return √(rise of the loss over the threshold), at most √`HIGHEST`, less one; nearly
        linear in `way`, the change of the logarithm of the parameter. Values within half of
        `PRECISION` are zero.
        """
        trial = float(np.clip(value * np.exp(way), *bounds))
        if trial not in losses_by_value:
            try:
                losses_by_value[trial] = solve_fixed(parameter, trial)
            except SimulationError:
                losses_by_value[trial] = np.inf
        above = (
            float(np.sqrt(np.clip((losses_by_value[trial] - loss) / threshold, 0.0, HIGHEST))) - 1.0
        )
        return above if abs(above) > PRECISION / 2 else 0.0

    step = 2 * deviation if np.isfinite(deviation) and deviation > 0 else 0.1
    lower, upper = (
        None
        if (way := _find_end(rise, side * step, bound=float(np.log(bound / value)))) is None
        else float(value * np.exp(way))
        for side, bound in zip((-1, 1), bounds, strict=True)
    )
    values = np.array(sorted(losses_by_value))
    losses = np.array([losses_by_value[at] for at in values.tolist()])
    message = _message(parameter, (lower, upper), bounds=bounds)
    if losses.min() < loss - 1e-3 * max(1.0, abs(loss)):
        better = values[int(np.argmin(losses))]
        message += (
            f"; at {better:.4g} the loss is lower than at the estimate: solve again with "
            "this value as the guess"
        )
    return Profile(
        parameter,
        values,
        losses=losses,
        threshold=threshold,
        interval=(lower, upper),
        message=message,
    )


def _find_end(rise: Callable[[float], float], step: float, bound: float) -> float | None:
    """Return the change of the logarithm of the parameter at which the loss has risen enough, on
    the side to which `step` points; None if it has not at the bound, or after `MOST_DOUBLINGS`
    doublings of the step.
    """
    inside = 0.0
    closest = min if step > 0 else max
    for _ in range(MOST_DOUBLINGS):
        if inside == bound:
            return None
        outside = closest(inside + step, bound)
        if rise(outside) >= 0:
            within = PRECISION * abs(outside)
            return root_scalar(rise, bracket=(inside, outside), xtol=within).root
        inside = outside
        step = 2 * step
    return None


def _message(
    parameter: str, interval: tuple[float | None, float | None], bounds: tuple[float, float]
) -> str:
    """Return the message for an interval of a parameter: two limits, one limit, or not
    identifiable.
    """
    lower, upper = interval
    how = "(95 %, profile likelihood)"
    if lower is not None and upper is not None:
        return f"{parameter} lies between {lower:.4g} and {upper:.4g} {how}"
    if lower is None and upper is None:
        return (
            f"{parameter} is not identifiable: the loss hardly changes between {bounds[0]:.4g} "
            f"and {bounds[1]:.4g}; fix it, give it a prior, or record other deformations"
        )
    least = lower is not None
    return (
        f"{parameter} is at {'least' if least else 'most'} {lower if least else upper:.4g} "
        f"{how}; the data give no {'upper' if least else 'lower'} limit within its bound "
        f"{bounds[least]:.4g}"
    )


def profile_of_solution(
    solution: Solution, fit: LinearisedFit, uncertainty: Uncertainty, name: str
) -> Profile:
    """Compute the profile likelihood of an estimated parameter of a solution.

    Parameters
    ----------
    solution : Solution
        Converged solution.
    fit : LinearisedFit
        The fit at its answer.
    uncertainty : Uncertainty
        Its error bars, which determine the first step and the threshold.
    name : str
        Name of an estimated parameter.

    Raises
    ------
    InputError
        If the parameter is not among those estimated.
    """
    parameters = solution.collocation.parameters
    free = [item.name for item in parameters.free]
    if name not in free:
        scalars = ", ".join(item.name for item in parameters.free_scalars)
        raise InputError(
            f"found {name!r}; expected one of the estimated parameters {scalars}",
            None,
            where="uncertainty.profile",
        )
    k = free.index(name)
    variance = float(uncertainty.covariance[k, k])
    item = parameters.free[k]

    numbers = itertools.count(1)

    def solve_fixed(_: str, value: float) -> float:
        """Return the loss with the parameter fixed at a value; the name is not used."""
        activity = f"profile likelihood of {name}, value {next(numbers)}"
        with search_activity(activity):
            return _loss_with_fixed(solution, item, value=value)

    return compute_profile(
        solve_fixed,
        name,
        best=(solution.parameters[name], _loss_of(solution)),
        bounds=(item.lower, item.upper),
        deviation=float(np.sqrt(variance)),
        noise_scale=_noise_scale(solution, fit, uncertainty=uncertainty, k=k),
    )


def _loss_of(solution: Solution) -> float:
    """Return the loss of a solution, Σ ((ŷ − h(x)) / σ)² (shortened by Huber's loss), with
    priors.
    """
    return solution.collocation.objective(solution.z) / solution.collocation.loss_scale


def _loss_with_fixed(solution: Solution, item: Parameter, value: float) -> float:
    """Return the smallest loss, with all priors, with one parameter fixed at a value, searched from
    the answer by reduced space; infinite if the solve does not converge.
    """
    before = solution.collocation
    started = before.parameters.with_estimates(solution.parameters)
    fixed = started.with_fixed({item.name: value})
    refit = ReducedSpace()(replace(before, parameters=fixed)).unless_interrupted()
    if not refit.status.converged:
        return float("inf")
    prior = 0.0
    if item.prior is not None:
        mean, deviation = item.prior
        deviation_from_prior = np.log(value / mean) if item.scale == "log" else value - mean
        prior = (deviation_from_prior / deviation) ** 2
    return _loss_of(refit) + float(prior)


def _noise_scale(solution: Solution, fit: LinearisedFit, uncertainty: Uncertainty, k: int) -> float:
    """Return the variance of the parameter with index k (from 0) over its variance for independent
    errors of the stated σ; 1 if that ratio is not finite.
    """
    size = relative_derivatives(solution.collocation.parameters, solution.q)[k]
    standard_error = size * least_squares_of_fit(fit).standard_errors[k]
    scale = float(uncertainty.covariance[k, k] / standard_error**2)
    return scale if np.isfinite(scale) else 1.0
