"""Profile likelihood of one parameter: its 95 % interval from refits with the parameter fixed.

The loss, minimised over everything else, rises by 3.84 (the 95 % quantile of χ² with one degree of
freedom) at the ends of the interval. Unlike a standard error this follows a curved or one-sided
loss; where the loss never rises so far, the interval is open.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from ..common.array_types import Array
from ..common.step_counting import search_activity
from ..errors import InputError, SimulationError
from ..fem.laws.constants import Scale
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution
from ..model.parameters import Parameter, Parameters
from ..program.collocation import Collocation
from .distributions import chi2_isf
from .estimates import relative_derivatives
from .linearised import LinearisedFit, least_squares_of_fit
from .uncertainty import Uncertainty

SolveFixed = Callable[[str, float], float]

# Increase of the loss at the ends of a 95 % interval.
THRESHOLD = float(chi2_isf(0.05, 1))
# Precision of the ends, over their distance from the estimate.
PRECISION = 0.02
# Largest number of doublings of the first step.
MOST_DOUBLINGS = 20
# Largest rise over the threshold; infinite losses count as this.
HIGHEST = 16.0


@dataclass(frozen=True, eq=False)
class Profile:
    """Loss as a function of one parameter, with everything else fitted."""

    # (lower or None, upper or None): 95 % interval; None where it is open, because the loss does
    # not rise so far up to the last value.
    interval: tuple[float | None, float | None]
    # (n,): ascending values, and the losses there minus the least one; infinite where there is no
    # solution.
    values: Array
    rises: Array
    threshold: float  # increase of the loss at which the interval ends
    sentence: str  # message for the user


def compute_profile(
    solve_fixed: SolveFixed,
    parameter: str,
    best: tuple[float, float],
    bounds: tuple[float, float],
    deviation: float = 0.1,
    noise_scale: float = 1.0,
    scale: Scale = "log",
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
        Bounds of the parameter, which the search does not leave; positive for the scale "log".
    deviation : float
        Expected standard deviation of the logarithm, or of a linear parameter: the first step is
        two of them.
    noise_scale : float
        Variance of the residuals in units of σ², by which the threshold grows: the reduced χ² if
        the noise is estimated, more if errors are correlated.
    scale : {"log", "linear"}
        Whether the search follows the logarithm of the parameter or its value.

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
    Ends are found to `PRECISION` of their distance from the best value. A deviation that is not
    positive and finite counts as 0.05 (of a linear parameter: of its value). The optimum is not
    solved again.
    """
    value, loss = best
    is_log = scale == "log"
    if not bounds[0] <= value <= bounds[1] or (is_log and bounds[0] <= 0):
        raise InputError(
            f"best value {value:g} of {parameter} is not within its bounds "
            f"[{bounds[0]:g}, {bounds[1]:g}]"
        )
    losses_by_value = {value: loss}
    threshold = THRESHOLD * noise_scale

    def moved(way: float) -> float:
        return float(np.clip(value * np.exp(way) if is_log else value + way, *bounds))

    def rise(way: float) -> float:
        """Return √(rise / threshold) − 1, nearly linear; zero within half of `PRECISION`."""
        trial = moved(way)
        if trial not in losses_by_value:
            try:
                losses_by_value[trial] = solve_fixed(parameter, trial)
            except SimulationError:
                losses_by_value[trial] = np.inf
        above = (
            float(np.sqrt(np.clip((losses_by_value[trial] - loss) / threshold, 0.0, HIGHEST))) - 1.0
        )
        return above if abs(above) > PRECISION / 2 else 0.0

    usual = 0.05 if is_log else 0.05 * abs(value) or 0.05
    step = 2 * (deviation if np.isfinite(deviation) and deviation > 0 else usual)
    reaches = [float(np.log(end / value) if is_log else end - value) for end in bounds]
    ways = [_find_end(rise, step * side, end) for side, end in zip((-1, 1), reaches, strict=True)]
    lower, upper = (None if way is None else moved(way) for way in ways)
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
        interval=(lower, upper),
        values=values,
        rises=losses - losses.min(),
        threshold=threshold,
        sentence=message,
    )


def _find_end(rise: Callable[[float], float], step: float, bound: float) -> float | None:
    """Return the change on the side of `step` at which the loss has risen enough, or None."""
    inside = 0.0
    closest = min if step > 0 else max
    for _ in range(MOST_DOUBLINGS):
        if inside == bound:
            return None
        outside = closest(inside + step, bound)
        if rise(outside) >= 0:
            within = PRECISION * abs(outside)
            return scipy.optimize.root_scalar(rise, bracket=(inside, outside), xtol=within).root
        inside = outside
        step = 2 * step
    return None


def _message(
    parameter: str, interval: tuple[float | None, float | None], bounds: tuple[float, float]
) -> str:
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
    collocation, z = solution.collocation, solution.z
    item = collocation.parameters.free[k]
    refits = Refits(collocation, z, fit, k)
    value = item.from_coordinate(float(z[k]))
    deviation = float(np.sqrt(uncertainty.covariance[k, k]))
    return compute_profile(
        refits,
        item.name,
        best=(value, refits.loss),
        bounds=(item.lower, item.upper),
        deviation=deviation * (1.0 if item.scale == "log" else abs(value)),
        noise_scale=_noise_scale(collocation.parameters, z[: collocation.nq], fit, uncertainty, k),
        scale=item.scale,
    )


class Refits:
    """Refits with one estimated parameter fixed, for `compute_profile`. Each starts where the
    linearised fit expects its answer from that of the nearest refit so far.
    """

    def __init__(self, collocation: Collocation, z: Array, fit: LinearisedFit, k: int) -> None:
        self.item = collocation.parameters.free[k]
        self.loss = collocation.objective(z) / collocation.loss_scale  # at the optimum
        self._k = k
        covariance = least_squares_of_fit(fit).covariance()[:, k]
        # Change (p,) of each parameter with this one; zero if undetermined.
        changes = covariance / covariance[k]
        self._changes = np.where(np.isfinite(changes) & ~fit.at_bound, changes, 0.0)
        # Coordinate, program and variables of each refit, the last two without the parameter.
        at = float(z[k])
        self._known = [(at, self._fixed(collocation, at), np.delete(z, k))]

    def __call__(self, _: str, value: float) -> float:
        """Return the loss with the parameter fixed at a value, with its prior; infinite if the
        refit does not converge.
        """
        at = self.item.to_coordinate(value)
        before, near, z = self._nearest(at)
        fixed = self._fixed(near, at)
        p, positions = fixed.unpack(z)
        p = p + np.delete(self._changes, self._k) * (at - before)
        p = np.clip(p, *fixed.parameter_bounds)
        with search_activity(f"profile likelihood of {self.item.name}, value {len(self._known)}"):
            # Short parts of the recording are not fitted before: they would leave the minimum.
            refit = ReducedSpace(ladder=(1.0,))(fixed, start=fixed.pack(p, positions))
        if not refit.unless_interrupted().status.converged:
            return float("inf")
        self._known.append((at, refit.collocation, refit.z))
        loss = refit.collocation.objective(refit.z) / refit.collocation.loss_scale
        return loss + _prior_loss(self.item, value)

    def _nearest(self, at: float) -> tuple[float, Collocation, Array]:
        return min(self._known, key=lambda each: abs(each[0] - at))

    def _fixed(self, collocation: Collocation, at: float) -> Collocation:
        value = self.item.from_coordinate(at)
        return collocation.with_parameters(
            collocation.parameters.with_fixed({self.item.name: value})
        )


def _prior_loss(item: Parameter, value: float) -> float:
    if item.prior is None:
        return 0.0
    mean, deviation = item.prior
    departure = np.log(value / mean) if item.scale == "log" else value - mean
    return float((departure / deviation) ** 2)


def _noise_scale(
    parameters: Parameters, q: Array, fit: LinearisedFit, uncertainty: Uncertainty, k: int
) -> float:
    """Return parameter k's variance over that for independent errors of the stated σ."""
    standard_error = (
        relative_derivatives(parameters, q)[k] * least_squares_of_fit(fit).standard_errors[k]
    )
    scale = float(uncertainty.covariance[k, k] / standard_error**2)
    return scale if np.isfinite(scale) else 1.0
