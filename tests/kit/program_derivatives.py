"""Derivatives of a collocation program, as the methods use them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from collocation_sysid.common.array_types import Array
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.runs.derivatives import derivative_fault, taylor_rates
from collocation_sysid.testing.finite_differences import directional_derivative
from collocation_sysid.testing.property_check import (
    DIFFERENCES,
    PropertyCheck,
    closest,
    derivative_size,
)
from kit.problems import shaken_variables


def require_product(
    check: PropertyCheck,
    function: Callable[[Array], ArrayLike],
    product: ArrayLike,
    point: Array,
    direction: Array,
    *,
    statement: str,
    tolerance: float = DIFFERENCES,
) -> None:
    """Compare the product of a derivative with one direction with central differences.

    Parameters
    ----------
    function : callable
        Function of an array like `point`.
    product : array
        Derivative times `direction`.
    statement : str
        What it means if they differ.
    tolerance : float
        Largest difference, relative to the largest entry of the product.

    Raises
    ------
    AssertionError
        If they differ.

    Notes
    -----
    The largest entry is not taken below `ROUNDING` times the largest value of the function.
    `direction` is a large change of `point`; of the differences with the `STEPS`, the closest
    to the product count.
    """
    found = np.asarray(product, dtype=float)
    size = derivative_size(found, function(point))
    expected = closest(
        found,
        lambda step: directional_derivative(function, point, direction=direction, step=step),
        tolerance=tolerance * size,
    )
    check.require_equal(
        found,
        expected,
        statement=f"{statement}, by central differences",
        tolerance=tolerance,
        scale=size,
    )


def require_derivatives(check: PropertyCheck, collocation: Collocation) -> None:
    """Require a Taylor test of a program at one random point, which satisfies no equation.

    Raises
    ------
    AssertionError
        If a derivative is wrong.
    """
    z = shaken_variables(collocation, check.rng)
    if fault := derivative_fault(collocation, z, taylor_rates(collocation, z)):
        raise AssertionError(f"{check.subject}: {fault}")
