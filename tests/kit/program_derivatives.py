"""Derivatives of a collocation program, as the methods use them, against central differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from collocation_sysid.common.array_types import Array
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.lifted.collocation import with_lifted_variables
from collocation_sysid.testing.finite_differences import directional_derivative
from collocation_sysid.testing.property_check import (
    DIFFERENCES,
    PropertyCheck,
    closest,
    derivative_size,
)
from kit.problems import shaken_variables

# Weight of the loss in the Lagrangian; not 1, so that a missing weight is noticed.
LOSS_WEIGHT = 1.3
# Size of a large change of the scaled variables.
CHANGE = 0.05


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


def check_program(check: PropertyCheck, collocation: Collocation) -> None:
    """Compare gradient, Jacobian and exact Hessian of a program with central differences.

    The program is the one with lifted variables, whose matrices contain the derivatives of every
    term.

    Parameters
    ----------
    check : PropertyCheck
        Subject of the sentences.
    collocation : Collocation
        Program with the extension.

    Raises
    ------
    AssertionError
        If a derivative differs.

    Notes
    -----
    Each is compared at one random point, which satisfies no equation, along one random direction
    for the parameters, the positions, the nuisance parameters and the lifted variables; blocks
    without variables are skipped. The collocation is not modified.
    """
    program = with_lifted_variables(collocation)
    z = shaken_variables(program, check.rng)
    multipliers = check.rng.normal(size=program.constraint_count)

    def lagrangian_gradient(at: Array) -> Array:
        """Return the gradient of the Lagrangian by z: `LOSS_WEIGHT` times that of the loss and Jᵀ
        times the multipliers.
        """
        return LOSS_WEIGHT * program.gradient(at) + program.jacobian(at).T @ multipliers

    jacobian = program.jacobian(z)
    hessian = program.hessian(z, LOSS_WEIGHT, multipliers)
    gradient = program.gradient(z)
    for columns, meaning in _blocks(program):
        direction = np.zeros(len(z))
        direction[columns] = CHANGE * check.rng.standard_normal(len(direction[columns]))
        if not direction.any():
            continue
        require_product(
            check,
            lambda at: np.atleast_1d(program.objective(at)),
            np.atleast_1d(gradient @ direction),
            point=z,
            direction=direction,
            statement=f"the gradient of the loss by {meaning} is wrong in a small program",
        )
        require_product(
            check,
            program.constraint_values,
            jacobian @ direction,
            point=z,
            direction=direction,
            statement=f"the Jacobian of the equations of motion by {meaning} is wrong "
            "in a small program",
        )
        require_product(
            check,
            lagrangian_gradient,
            hessian @ direction,
            point=z,
            direction=direction,
            statement=f"the Hessian of the Lagrangian by {meaning} is wrong in a small program",
        )


def _blocks(program: Collocation) -> list[tuple[slice, str]]:
    """Return the slices of z, each with its meaning; a slice may be empty."""
    return [
        (slice(program.nq), "the parameters"),
        (slice(program.nq, program.phi_columns.start), "the positions"),
        (program.phi_columns, "the nuisance parameters"),
        (slice(program.phi_columns.stop, None), "the lifted variables"),
    ]
