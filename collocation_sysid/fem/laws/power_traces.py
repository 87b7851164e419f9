"""Traces of real powers of the isochoric right Cauchy–Green tensor C̄, without its eigenvalues.

Derivatives by principal stretches are undefined where stretches coincide. A trace tr C̄ˢ is a smooth
function of the invariants alone. With det C̄ = 1 and −1 < s < 1,

    tr C̄ˢ − 3 = (s sin πs / π) ∫ eˢᵘ ln z(u) du,   z = det(C̄ + t I) / (1 + t)³,   t = eᵘ,   u ∈ ℝ,

which follows from the integral of λˢ⁻¹ / (1 + λ) by parts. z is linear in Ī₁ − 3 and Ī₂ − 3:

    z = 1 + (t² (Ī₁ − 3) + t (Ī₂ − 3)) / (1 + t)³.

The trapezoidal rule with spacing h has the error exp(−2π²/h), because ln z is analytic for
|Im u| < π. It is applied to the whole line: beyond the nodes ln z is a power series in 1/t or t
with the coefficients tr C̄ᵏ and tr C̄⁻ᵏ (Newton's identities), and the sum over the nodes that are
left consists of geometric series. The nodes do not depend on s, which may be a variable.

Nodes are symmetric about u = 0. The sums for s and −s together are

    C = Σ cosh(su) (ln z(u) + ln z(−u)),   D = Σ sinh(su) (ln z(u) − ln z(−u)),   u > 0,

and their values, unlike their derivatives, are summed by parts, with d ln z/du in place of ln z:
rational functions of the invariants only. Exponents beyond ±1 follow by doubling from smaller ones,
tr C̄²ˢ = (tr C̄ˢ)² − 2 tr C̄⁻ˢ, which holds because det C̄ = 1.

For principal stretches λ̄ from 0.2 to 5 the relative error of a trace is below 10⁻¹⁰ for |α| = 2 |s|
up to 8, below 10⁻⁹ up to 25, and below 5·10⁻⁹ up to 45 (`tests/fem/test_power_traces.py`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Literal

import casadi as ca
import numpy as np

from ...common.array_types import Array
from ..chain_rule import PartialIndex

# The sum C is even in s, the sum D odd.
Parity = Literal["even", "odd"]
# Partial derivatives of a function of Ī₁ − 3, Ī₂ − 3 and α, by their indices; () for the function.
Partials = Callable[[PartialIndex], ca.SX]
# Index of α among these arguments.
EXPONENT = 2

# Nodes of the trapezoidal rule on either side of u = 0.
NODES = 12
# Spacing h of u. A smaller one moves the last nodes inwards, where the series beyond them converge
# more slowly; a larger one increases the error exp(−2π²/h) of the rule, 10⁻¹⁴ here. Summation by
# parts multiplies this error by 2π/(h s), which is 160 at α = 2.
SPACING = 0.62
# Terms of the series beyond the nodes; the next is below 10⁻¹⁰ for stretches up to 5.
TAIL_TERMS = 5
# Doublings of the exponent: s = α/64 at first, so |α| must be below 64, see
# `constants.LARGEST_EXPONENT`.
DOUBLINGS = 5
# Smallest |s| in quotients by s, which are finite at s = 0; smaller ones lose digits like 10⁻¹⁶/s.
SMALLEST_EXPONENT = 1e-6


class PowerTraces:
    """Functions of Ī₁ − 3 and Ī₂ − 3 that the traces of all powers share, and sums of them.

    Parameters
    ----------
    first_excess, second_excess : SX
        Symbols of Ī₁ − 3 and Ī₂ − 3.
    """

    def __init__(self, first_excess: ca.SX, second_excess: ca.SX) -> None:
        self.excesses = ca.vertcat(first_excess, second_excess)
        u = _nodes()
        t = np.exp(np.concatenate([u, -u]))
        self._slopes = (t**2 / (1 + t) ** 3, t / (1 + t) ** 3)
        growth = (2 - 3 * t / (1 + t), 1 - 3 * t / (1 + t))
        self._reciprocal = 1 / (1 + self._linear(*self._slopes))
        # d ln z/du at the nodes.
        self._rates = self._linear(*(g * s for g, s in zip(growth, self._slopes, strict=True)))
        self._rates *= self._reciprocal
        self._series = _integer_power_traces(first_excess, second_excess)
        self._opposite_series = _integer_power_traces(second_excess, first_excess)
        self.functions = cache(self._functions)

    def scaled_excess(self, alpha: ca.SX) -> Partials:
        """Return (tr C̄^(α/2) − 3) / α² with its partial derivatives by Ī₁ − 3, Ī₂ − 3 and α.

        The quotient is smooth in α, also at α = 0.

        Parameters
        ----------
        alpha : SX
            Exponent α of the stretches, below `constants.LARGEST_EXPONENT` in magnitude. It must be
            a symbol if derivatives are taken.
        """
        s = alpha / 2 ** (DOUBLINGS + 1)
        factor = _exponent_partials(SPACING * _sinc(np.pi * s), alpha)
        even = self._sum("even", alpha)
        odd = self._sum("odd", alpha)
        # (tr C̄ˢ − 3) / s², and the same for −s.
        excess = _product(factor, lambda index: even(index) + odd(index))
        opposite = _product(factor, lambda index: even(index) - odd(index))
        for doubling in range(DOUBLINGS):
            square = _exponent_partials(4**doubling * s**2, alpha)
            doubled_excess = _doubled(excess, opposite, square=square)
            opposite = _doubled(opposite, excess, square=square)
            excess = doubled_excess
        return cache(lambda index: excess(index) / 4)

    def _sum(self, parity: Parity, alpha: ca.SX) -> Partials:
        """Partial derivatives of C ("even") or D ("odd") by Ī₁ − 3, Ī₂ − 3 and α, cached."""
        value_weights = _exponent_partials(_value_weights(parity, alpha), alpha)
        weights = _exponent_partials(_weights(parity, alpha), alpha)

        def partial(index: PartialIndex) -> ca.SX:
            first = index.count(0)
            second = index.count(1)
            chosen = weights if first + second else value_weights
            by_exponent = tuple(argument for argument in index if argument == EXPONENT)
            return ca.dot(chosen(by_exponent), self.functions(parity, first, second_order=second))

        return cache(partial)

    def _functions(self, parity: Parity, first_order: int = 0, second_order: int = 0) -> ca.SX:
        """Return what a sum consists of, (NODES + TAIL_TERMS,), or partial derivatives."""
        sign = 1 if parity == "even" else -1
        order = first_order + second_order
        if order == 0:
            at_nodes = -self._rates[:NODES] + sign * self._rates[NODES:]
        else:
            first, second = self._slopes
            # ln z is differentiated by hand: z is linear in the excesses.
            factor = (-1) ** (order - 1) * math.factorial(order - 1)
            slopes = ca.DM(factor * first**first_order * second**second_order)
            logarithms = slopes * self._reciprocal**order
            at_nodes = logarithms[:NODES] + sign * logarithms[NODES:]
        beyond = self._series + sign * self._opposite_series
        for argument, count in enumerate((first_order, second_order)):
            for _ in range(count):
                beyond = ca.densify(ca.jacobian(beyond, self.excesses[argument]))
        return ca.vertcat(at_nodes, beyond)

    def _linear(self, by_first: Array, by_second: Array) -> ca.SX:
        """Return a linear combination of the excesses with coefficients (2 NODES,)."""
        return ca.DM(by_first) * self.excesses[0] + ca.DM(by_second) * self.excesses[1]


def _nodes() -> Array:
    """Return the nodes u > 0 (NODES,), ascending."""
    return np.asarray(SPACING * (np.arange(NODES) + 0.5), dtype=np.float64)


def _weights(parity: Parity, alpha: ca.SX) -> ca.SX:
    """Return weights (NODES + TAIL_TERMS,) of cosh(su) or sinh(su), s = α / 2^(DOUBLINGS + 1)."""
    # Values at the nodes, then those of the series beyond them, see `_exponentials`.
    growing, decaying = _exponentials(alpha)
    return (growing + decaying) / 2 if parity == "even" else (growing - decaying) / 2


def _value_weights(parity: Parity, alpha: ca.SX) -> ca.SX:
    """Return the weights after summation by parts: sinh(su)/s or (cosh(su) − 1)/s, s as above."""
    s = alpha / 2 ** (DOUBLINGS + 1)
    safe_alpha = ca.if_else(
        ca.fabs(s) < SMALLEST_EXPONENT, SMALLEST_EXPONENT * 2 ** (DOUBLINGS + 1), alpha
    )
    # By parts, a term of the series that decays like e^(−ku) has the factor k.
    factors = ca.DM([1.0] * NODES + list(range(1, TAIL_TERMS + 1)))
    if parity == "even":
        weights = _weights("odd", safe_alpha)
    else:
        weights = _weights("even", safe_alpha) - _weights("even", ca.SX(0))
    return factors * weights / (safe_alpha / 2 ** (DOUBLINGS + 1))


def _exponentials(alpha: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return e^(su) and e^(−su) for s = α / 2^(DOUBLINGS + 1), (NODES + TAIL_TERMS,) each."""
    ratio = ca.exp(SPACING / 2 ** (DOUBLINGS + 1) * alpha)
    powers = [ca.exp(SPACING / 2 ** (DOUBLINGS + 2) * alpha)]
    for _ in range(NODES):
        powers.append(powers[-1] * ratio)
    growing = list(powers[:NODES])
    decaying = [1 / power for power in growing]
    first_beyond = (NODES + 0.5) * SPACING
    for k in range(1, TAIL_TERMS + 1):
        decay = math.exp(-k * SPACING)
        scale = (-1) ** (k + 1) / k * math.exp(-k * first_beyond)
        growing.append(scale * powers[NODES] / (1 - decay * ratio))
        decaying.append(scale / (powers[NODES] * (1 - decay / ratio)))
    return ca.vertcat(*growing), ca.vertcat(*decaying)


def _integer_power_traces(first_excess: ca.SX, second_excess: ca.SX) -> ca.SX:
    """Return tr C̄ᵏ − 3, k = 1 … TAIL_TERMS, by Newton's identities with det C̄ = 1."""
    first = first_excess + 3
    second = second_excess + 3
    traces = [ca.SX(3), first, first**2 - 2 * second]
    while len(traces) <= TAIL_TERMS:
        traces.append(first * traces[-1] - second * traces[-2] + traces[-3])
    return ca.vertcat(*(trace - 3 for trace in traces[1 : TAIL_TERMS + 1]))


def _doubled(excess: Partials, opposite: Partials, square: Partials) -> Partials:
    """Return the partial derivatives of the scaled excess (tr C̄^(2s) − 3)/(2s)²."""
    product = _product(square, _product(excess, excess))
    return cache(lambda index: (6 * excess(index) + product(index) - 2 * opposite(index)) / 4)


def _product(first: Partials, second: Partials) -> Partials:
    """Return the partial derivatives of a product by the rule of Leibniz, cached."""

    def partial(index: PartialIndex) -> ca.SX:
        counts = [index.count(argument) for argument in range(EXPONENT + 1)]
        total = ca.SX(0)
        for orders in itertools.product(*(range(count + 1) for count in counts)):
            ways = math.prod(map(math.comb, counts, orders))
            rest = [count - order for count, order in zip(counts, orders, strict=True)]
            total += ways * first(_index(orders)) * second(_index(rest))
        return total

    return cache(partial)


def _index(orders: Sequence[int]) -> PartialIndex:
    """Return the index of a partial derivative from the order by each argument."""
    return tuple(argument for argument, order in enumerate(orders) for _ in range(order))


def _exponent_partials(expression: ca.SX, alpha: ca.SX) -> Partials:
    def partial(index: PartialIndex) -> ca.SX:
        """Return the partial derivative with an index; zero by the invariants."""
        if not index:
            return expression
        if index[0] != EXPONENT:
            return ca.SX(0)
        return ca.densify(ca.jacobian(derivative(index[1:]), alpha))

    derivative = cache(partial)
    return derivative


def _sinc(y: ca.SX) -> ca.SX:
    """Return sin(y)/y for |y| < π by its Taylor series; the quotient is undefined at y = 0."""
    value = ca.SX(1)
    # Exact to rounding for |y| < π.
    for k in range(16, 0, -1):
        value = 1 - y**2 / (2 * k * (2 * k + 1)) * value
    return value
