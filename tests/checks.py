"""What the tests measure by: derivatives against central differences, and orders of convergence."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def directional_derivative(
    function: Callable[[Array], ArrayLike], point: ArrayLike, direction: Array, step: float = 1e-3
) -> Array:
    """d/ds function(point + s direction) at s = 0, by fourth-order central differences."""

    def at(steps: int) -> Array:
        return np.asarray(function(np.asarray(point) + steps * step * direction))

    return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step)


def assert_derivative(
    function: Callable[[Array], ArrayLike],
    jacobian_times: Callable[[Array], ArrayLike],
    point: ArrayLike,
    rng: np.random.Generator,
    tolerance: float = 1e-8,
    scale: ArrayLike = 1.0,
    directions: int = 2,
) -> None:
    """Compare `jacobian_times` with differences of `function` in random directions.

    Parameters
    ----------
    function, jacobian_times : of an array like `point`; both may return any one shape
    tolerance : of the error's norm, relative to the norm of the difference quotient
    scale : size of a large change of `point`; a thousandth of it is stepped
    """
    for _ in range(directions):
        direction = np.asarray(scale) * rng.standard_normal(np.shape(point))
        expected = directional_derivative(function, point, direction)
        found = np.asarray(jacobian_times(direction))
        assert found.shape == expected.shape
        error = np.linalg.norm(found - expected)
        size = np.linalg.norm(expected)
        assert error <= tolerance * size, f"off by {error:.3g}, the derivative's norm is {size:.3g}"


def relative_error(found: ArrayLike, expected: ArrayLike) -> float:
    """Return the largest error of an entry, relative to the largest expected entry."""
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.shape == expected.shape
    return float(np.abs(found - expected).max() / np.abs(expected).max()) if expected.size else 0.0


def observed_order(steps: ArrayLike, errors: ArrayLike) -> float:
    """Slope of log(error) over log(step): the order of convergence."""
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])
