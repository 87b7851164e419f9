"""The inverse error function in elementary operations: the C library has none.

A rational first guess and two Newton steps, which are exact but for the rounding of x. CasADi's
own is up to 3·10⁻⁶ off, most of all around |x| = 0.7.
"""

from __future__ import annotations

import math

import casadi as ca

# Numerators and denominators, the highest power first.
CENTRE = (
    (-0.140543331, 0.914624893, -1.645349621, 0.886226899),
    (0.012229801, -0.329097515, 1.442710462, -2.118377725, 1.0),
)
TAIL = (
    (1.641345311, 3.429567803, -1.624906493, -1.970840454),
    (1.637067800, 3.543889200, 1.0),
)


def _erfinv(x: ca.SX) -> ca.SX:
    away_from_zero = _ratio(TAIL, ca.sqrt(-ca.log((1 - ca.fabs(x)) / 2)))
    y = ca.if_else(ca.fabs(x) < 0.7, x * _ratio(CENTRE, x**2), ca.copysign(away_from_zero, x))
    for _ in range(2):
        slope = 2 / math.sqrt(math.pi) * ca.exp(-(y**2))
        y -= (ca.erf(y) - x) / slope
    # At ±1 the slope is zero; beyond, the logarithm has made NaN of it.
    return ca.if_else(ca.fabs(x) == 1, x * math.inf, y)


def _ratio(coefficients: tuple[tuple[float, ...], ...], z: ca.SX) -> ca.SX:
    numerator, denominator = (ca.polyval(ca.SX(part), z) for part in coefficients)
    return numerator / denominator


_X = ca.SX.sym("x")
ERFINV = ca.Function("erfinv", [_X], [_erfinv(_X)])
