"""Traces of powers of C without eigenvalues, compared with sums over the stretches."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from collocation_sysid.fem.laws.constants import LARGEST_EXPONENT
from collocation_sysid.fem.laws.power_traces import PowerTraces

EXPONENTS = [
    -45.0,
    -25.0,
    -8.0,
    -3.7,
    -2.0,
    -1.0,
    0.3,
    1.0,
    1.3,
    2.0,
    4.0,
    5.0,
    8.0,
    16.0,
    25.0,
    45.0,
]


class Traces:
    """(tr C̄^(α/2) − 3)/α² as a function of the excesses of the invariants and α."""

    def __init__(self) -> None:
        self.arguments = [ca.SX.sym(name) for name in ("first", "second", "alpha")]
        self.partial = PowerTraces(*self.arguments[:2]).scaled_excess(self.arguments[2])

    def evaluate(self, index: tuple[int, ...], *values: float) -> float:
        """A partial derivative."""
        return float(ca.Function("partial", self.arguments, [self.partial(index)])(*values))


@pytest.fixture(scope="module")
def traces() -> Traces:
    return Traces()


def excesses(stretches: np.ndarray) -> tuple[float, float]:
    """Ī₁ − 3 and Ī₂ − 3 of stretches with the product 1."""
    return np.sum(stretches**2) - 3, np.sum(stretches**-2.0) - 3


def isochoric_stretches(smallest: float, largest: float, rng) -> np.ndarray:
    """Stretches (n, 3) with the product 1 within limits."""
    two = np.exp(rng.uniform(np.log(smallest), np.log(largest), (200, 2)))
    stretches = np.column_stack([two, 1 / two.prod(axis=1)])
    return stretches[(stretches >= smallest).all(axis=1) & (stretches <= largest).all(axis=1)]


@pytest.mark.parametrize("alpha", EXPONENTS)
def test_traces_are_sums_of_powers(traces, alpha, rng):
    limit = 1e-10 if abs(alpha) <= 8 else 1e-9 if abs(alpha) <= 25 else 5e-9
    function = ca.Function("trace", traces.arguments, [traces.partial(())])
    for stretches in isochoric_stretches(0.2, 5.0, rng):
        expected = np.sum(stretches**alpha)
        found = 3 + alpha**2 * float(function(*excesses(stretches), alpha))
        assert found == pytest.approx(expected, rel=limit)


@pytest.mark.parametrize("alpha", [-5.0, 1.3, 3.0])
def test_traces_at_stretches_of_ten_are_less_accurate_but_right(traces, alpha, rng):
    function = ca.Function("trace", traces.arguments, [traces.partial(())])
    for stretches in isochoric_stretches(0.1, 10.0, rng):
        found = 3 + alpha**2 * float(function(*excesses(stretches), alpha))
        assert found == pytest.approx(np.sum(stretches**alpha), rel=1e-5)


def test_the_largest_exponent_is_within_reach(traces):
    stretches = np.array([1.3, 0.9, 1 / 1.17])
    for alpha in (LARGEST_EXPONENT, -LARGEST_EXPONENT):
        found = 3 + alpha**2 * traces.evaluate((), *excesses(stretches), alpha)
        assert found == pytest.approx(np.sum(stretches**alpha), rel=1e-9)


def test_zero_exponent_is_the_limit(traces):
    """(Σ λ^α − 3)/α² tends to ½ Σ (ln λ)², and is continuous there."""
    stretches = np.array([1.3, 0.9, 1 / 1.17])
    limit = np.sum(np.log(stretches) ** 2) / 2
    assert traces.evaluate((), *excesses(stretches), 0.0) == pytest.approx(limit, rel=1e-5)
    assert traces.evaluate((), *excesses(stretches), 1e-3) == pytest.approx(limit, rel=1e-3)


@pytest.mark.parametrize(
    "index", [(0,), (1,), (2,), (0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)]
)
def test_partial_derivatives_agree_with_differences(traces, index):
    for alpha in (-2.0, 1.3, 6.0):
        values = np.array([*excesses(np.array([1.4, 0.8, 1 / 1.12])), alpha])
        step = np.zeros(3)
        step[index[-1]] = 1e-4
        ends = [traces.evaluate(index[:-1], *(values + sign * step)) for sign in (1, -1)]
        assert traces.evaluate(index, *values) == pytest.approx(
            (ends[0] - ends[1]) / 2e-4, rel=2e-6, abs=1e-9
        )


@pytest.mark.parametrize("index", [(0, 0, 0), (0, 0, 1), (0, 1, 2), (1, 2, 2)])
def test_third_derivatives_agree_with_differences(traces, index):
    values = np.array([*excesses(np.array([1.4, 0.8, 1 / 1.12])), 3.0])
    step = np.zeros(3)
    step[index[-1]] = 1e-4
    ends = [traces.evaluate(index[:-1], *(values + sign * step)) for sign in (1, -1)]
    assert traces.evaluate(index, *values) == pytest.approx(
        (ends[0] - ends[1]) / 2e-4, rel=1e-5, abs=1e-9
    )


def test_value_and_slope_belong_together_also_where_all_stretches_are_one(traces):
    """The value is summed by parts, derivatives are not: (Σλ^α − 3)/α² = (Ī₁ − 3)/4 at α = 2."""
    assert traces.evaluate((), 0.0, 0.0, 2.0) == pytest.approx(0.0, abs=1e-16)
    assert traces.evaluate((0,), 0.0, 0.0, 2.0) == pytest.approx(0.25, rel=1e-10)
    assert traces.evaluate((1,), 0.0, 0.0, 2.0) == pytest.approx(0.0, abs=1e-10)
    assert traces.evaluate((0, 1), 0.1, 0.1, 2.0) == pytest.approx(0.0, abs=1e-10)
