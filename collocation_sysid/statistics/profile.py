"""Profile likelihood: how far one parameter can go before the loss notices.

The loss, minimised over everything else, rises by 3.84 (the 95 % quantile of χ² with one degree
of freedom) at the ends of the interval. Unlike a standard error this follows a bent or one-sided
loss; where it never rises so far, the interval is open.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..errors import InputError, SimulationError
from .distributions import chi2_isf

SolveFixed = Callable[[str, float], float]

THRESHOLD = float(chi2_isf(0.05, 1))
# The ends are found to this share of their distance from the best value, in the logarithm.
PRECISION = 0.02
MOST_SOLVES = 20


@dataclass(frozen=True, eq=False)
class Profile:
    """The loss along one parameter, everything else fitted.

    Attributes
    ----------
    parameter : str
    values, losses : (n,) ascending values and the losses there; infinite where it has no solution
    threshold : float
        Loss above the smallest at which the interval ends.
    interval : (lower or None, upper or None)
        95 % interval; None where it is open: the loss does not rise so far up to the last value.
    sentence : str
    """

    parameter: str
    values: Array
    losses: Array
    threshold: float
    interval: tuple[float | None, float | None]
    sentence: str


def profile(
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
        Σ ((ŷ − h(x)) / σ)² with priors, minimised with the parameter held at the value; a
        `SimulationError` counts as an infinite loss.
    parameter : str
    best : (value, loss) at the optimum
    bounds : (lower, upper) of the parameter
        The search does not leave them.
    deviation : float
        Expected standard deviation of the logarithm: the first step is two of them.
    noise_scale : float
        Variance of the residuals in units of σ², by which the threshold grows: the reduced χ² if
        the noise is estimated, more if errors are correlated.

    Raises
    ------
    InputError
        If the best value is not within the bounds.
    """
    value, loss = best
    if not 0 < bounds[0] <= value <= bounds[1]:
        raise InputError(
            f"best value {value:g} of {parameter} is not within its bounds "
            f"[{bounds[0]:g}, {bounds[1]:g}]"
        )
    known = {value: loss}

    def rise(logarithm: float) -> float:
        at = float(np.clip(np.exp(logarithm), *bounds))
        if at not in known:
            try:
                known[at] = solve_fixed(parameter, at)
            except SimulationError:
                known[at] = np.inf
        return known[at] - loss - THRESHOLD * noise_scale

    step = 2 * deviation if np.isfinite(deviation) and deviation > 0 else 0.1
    ends = [
        _end(rise, np.log(value), side * step, float(np.log(bound)))
        for side, bound in zip((-1, 1), bounds, strict=True)
    ]
    interval = (_exponential(ends[0]), _exponential(ends[1]))
    values = np.array(sorted(known))
    losses = np.array([known[at] for at in values.tolist()])
    return Profile(
        parameter,
        values,
        losses,
        THRESHOLD * noise_scale,
        interval,
        _sentence(parameter, values, losses, loss, interval, bounds),
    )


def _end(rise: Callable[[float], float], start: float, step: float, bound: float) -> float | None:
    """Where the loss has risen enough, on one side; None if it has not at the bound."""
    sign = np.sign(step)
    inside, outside, height = start, start, rise(start)
    heights = [height, height]
    for _ in range(MOST_SOLVES):
        if sign * (bound - outside) <= 0:
            return None
        inside, heights[0] = outside, heights[1]
        outside = start + step if sign * (bound - start - step) > 0 else bound
        heights[1] = rise(outside)
        if heights[1] >= 0:
            return _between(rise, start, (inside, outside), (heights[0], heights[1]))
        step *= 2
    return None


def _between(
    rise: Callable[[float], float],
    start: float,
    ends: tuple[float, float],
    heights: tuple[float, float],
) -> float:
    """Root of the rise, taken as quadratic in the distance from the best value."""
    inside, outside = ends
    low, high = heights
    base = rise(start)
    for _ in range(MOST_SOLVES):
        if abs(outside - inside) <= PRECISION * abs(outside - start):
            break
        # The square root of the loss is nearly straight, unless the loss is infinite or falls.
        near, far = np.sqrt(max(low - base, 0.0)), np.sqrt(max(high - base, 0.0))
        share = (np.sqrt(-base) - near) / (far - near) if np.isfinite(far) and far > near else 0.5
        middle = inside + float(np.clip(share, 0.02, 0.98)) * (outside - inside)
        height = rise(middle)
        if abs(height) <= PRECISION * abs(base):
            return middle
        if height < 0:
            inside, low = middle, height
        else:
            outside, high = middle, height
    return (inside + outside) / 2


def _exponential(logarithm: float | None) -> float | None:
    return None if logarithm is None else float(np.exp(logarithm))


def _sentence(
    parameter: str,
    values: Array,
    losses: Array,
    loss: float,
    interval: tuple[float | None, float | None],
    bounds: tuple[float, float],
) -> str:
    lower, upper = interval
    if lower is not None and upper is not None:
        said = f"{parameter} lies between {lower:.4g} and {upper:.4g} (95 %, profile likelihood)"
    elif upper is not None:
        said = (
            f"{parameter} is at most {upper:.4g} (95 %, profile likelihood); downwards the data "
            f"do not limit it within its bound {bounds[0]:.4g}"
        )
    elif lower is not None:
        said = (
            f"{parameter} is at least {lower:.4g} (95 %, profile likelihood); upwards the data "
            f"do not limit it within its bound {bounds[1]:.4g}"
        )
    else:
        said = (
            f"{parameter} is not identifiable: the loss hardly changes between {bounds[0]:.4g} "
            f"and {bounds[1]:.4g}; fix it, give it a prior, or move the body differently"
        )
    if losses.min() < loss - 1e-3 * max(1.0, abs(loss)):
        better = values[int(np.argmin(losses))]
        said += f"; at {better:.4g} the loss is lower than at the answer: solve again from there"
    return said
