"""Comparison of derivatives with central differences, and orders of convergence."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from collocation_sysid.common.array_types import Array
from collocation_sysid.testing.finite_differences import (
    directional_derivative as directional_derivative,
)


def assert_derivative(
    function: Callable[[Array], ArrayLike],
    jacobian_times: Callable[[Array], ArrayLike],
    point: ArrayLike,
    rng: np.random.Generator,
    tolerance: float = 1e-8,
    scale: ArrayLike = 1.0,
    directions: int = 2,
) -> None:
    """Compare a derivative with central differences of the function in random normal directions.

    Parameters
    ----------
    function : callable
        Function of an array like `point`.
    jacobian_times : callable
        Product of its derivative at `point` with a direction, of the same shape as the function.
    tolerance : float
        Largest norm of the error, relative to the norm of the difference quotient.
    scale : array or float
        Size of a large change of `point`; a thousandth of it is one step.

    Raises
    ------
    AssertionError
        If the error exceeds the tolerance, or shapes differ.
    """
    for _ in range(directions):
        direction = np.asarray(scale) * rng.standard_normal(np.shape(point))
        expected = directional_derivative(function, point, direction=direction)
        product = np.asarray(jacobian_times(direction))
        assert product.shape == expected.shape
        error = np.linalg.norm(product - expected)
        size = np.linalg.norm(expected)
        assert error <= tolerance * size, f"off by {error:.3g}, the derivative's norm is {size:.3g}"


def relative_error(found: ArrayLike, expected: ArrayLike) -> float:
    """Return the largest absolute error of an entry, divided by the largest absolute expected
    entry.

    0 for empty arrays; infinite or NaN if all expected entries are zero.

    Raises
    ------
    AssertionError
        If the shapes differ.
    """
    values = np.asarray(found)
    references = np.asarray(expected)
    assert values.shape == references.shape
    if not references.size:
        return 0.0
    return float(np.abs(values - references).max() / np.abs(references).max())


def observed_order(steps: ArrayLike, errors: ArrayLike) -> float:
    """Return the slope of log(error) over log(step), fitted to all points: the order of
    convergence.

    Parameters
    ----------
    steps, errors : (k,) array
        Step sizes and the errors with them, all positive; k ≥ 2.
    """
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])
