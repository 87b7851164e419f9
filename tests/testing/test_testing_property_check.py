"""Comparisons of the checks: which of them fail, and the sentences that name them."""

from __future__ import annotations

import numpy as np
import pytest
from kit.program_derivatives import require_product

from collocation_sysid.testing.property_check import PropertyCheck

CHECK = PropertyCheck("gel 'a'")
POINT = np.array([0.3, -0.7])


def cubes(x: np.ndarray) -> np.ndarray:
    return x**3


def test_equal_values_pass_and_the_worst_entry_is_named():
    CHECK.require_equal([[1.0, 2.0]], [[1.0, 2.0 + 1e-12]], statement="it is off")
    with pytest.raises(AssertionError, match=r"gel 'a': it is off, entry \(0, 1\); found 2, e"):
        CHECK.require_equal([[1.0, 2.0]], [[1.01, 2.1]], statement="it is off")
    with pytest.raises(AssertionError, match=r"it is off, entry \(0,\); found nan, expected 1"):
        CHECK.require_equal([np.nan], [1.0], statement="it is off")
    with pytest.raises(
        AssertionError, match=r"it is off \(shapes\); found \(2,\), expected \(1,\)"
    ):
        CHECK.require_equal([1.0, 1.0], [1.0], statement="it is off")


def test_a_derivative_with_a_wrong_sign_entry_or_missing_fails():
    right = np.diag(3 * POINT**2)
    CHECK.require_derivative(cubes, right, POINT, statement="the slope is wrong")
    small = np.array([[0, 1e-4], [0, 0]])
    for wrong in (-right, right + small, np.zeros((2, 2))):
        with pytest.raises(AssertionError, match="the slope is wrong, by central diff"):
            CHECK.require_derivative(cubes, wrong, POINT, statement="the slope is wrong")


def test_a_product_with_a_wrong_sign_fails():
    direction = np.array([1.0, 2.0])
    product = 3 * POINT**2 * direction
    require_product(CHECK, cubes, product, POINT, direction, statement="the slope is wrong")
    with pytest.raises(AssertionError, match="the slope is wrong, by central differences, entry"):
        require_product(CHECK, cubes, -product, POINT, direction, statement="the slope is wrong")
