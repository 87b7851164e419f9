"""Derivatives by central differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ..common.array_types import Array

# Default step of a difference, relative to the direction: its truncation error, of fourth order,
# and its rounding error are then both about 1e-12 of a smooth function.
STEP = 1e-3


def directional_derivative(
    function: Callable[[Array], ArrayLike], point: ArrayLike, direction: Array, step: float = STEP
) -> Array:
    """Return d/ds function(point + s direction) at s = 0, by fourth-order central differences.

    Parameters
    ----------
    function : callable
        Function of an array like `point` that returns an array of any shape.
    direction : array like `point`
        Size of a large change of `point`.
    step : float
        Step of s.

    Returns
    -------
    array
        Shape of the values of `function`, which is called four times, at ± one and ± two steps.
    """

    def evaluate_at(steps: int) -> Array:
        """Return the function at `point` plus a number of steps along `direction`, which may be
        negative.
        """
        return np.asarray(function(np.asarray(point) + steps * step * direction))

    return (8 * (evaluate_at(1) - evaluate_at(-1)) - (evaluate_at(2) - evaluate_at(-2))) / (
        12 * step
    )
