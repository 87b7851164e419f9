"""Derivatives of the motion of a hand with respect to time.

Angular velocity and acceleration follow from the left Jacobian of the exponential map (Sola et
al., A micro Lie theory, 2018, eq. 145): with a = (1 − cos θ)/θ² and b = (θ − sin θ)/θ³,

    ω = ṙ + a r×ṙ + b r×(r×ṙ).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.array_types import Array


class TimeDerivatives(NamedTuple):
    """A quantity, or a limit of it, with its first two derivatives with respect to time."""

    # The quantity; for the coordinates of a motion (T, 6): translation x, y, z [m] and rotation
    # vector x, y, z [rad].
    value: Array
    # Its first and second derivatives, of the same shape [per s, per s²].
    first: Array
    second: Array


def angular_motion(r: Array, rate: Array, curvature: Array) -> tuple[Array, Array]:
    """Return angular velocity [rad/s] and acceleration [rad/s²] (T, 3), in the fixed frame, of the
    rotation exp(r), from the rotation vector r (T, 3) [rad] and its first two derivatives `rate`
    and `curvature` with respect to time.
    """
    angle = np.linalg.norm(r, axis=1)
    a, b, a_slope, b_slope = _jacobian_factors(angle[:, None])
    projection = np.einsum("ti,ti->t", r, rate)[:, None]
    across = np.cross(r, rate)
    double_cross = np.cross(r, across)
    drive = np.cross(r, curvature)
    velocity = rate + a * across + b * double_cross
    acceleration = curvature + a * drive + b * (np.cross(rate, across) + np.cross(r, drive))
    return velocity, acceleration + projection * (a_slope * across + b_slope * double_cross)


def _jacobian_factors(angle: Array) -> tuple[Array, ...]:
    """Return a, b, (da/dθ)/θ and (db/dθ)/θ, each of the shape of the angles θ ≥ 0 [rad]."""
    small = angle < 1e-2
    x = np.where(small, 1.0, angle)
    sine = np.sin(x)
    cosine = np.cos(x)
    exact = (
        (1 - cosine) / x**2,
        (x - sine) / x**3,
        (x * sine - 2 * (1 - cosine)) / x**4,
        (3 * sine - 2 * x - x * cosine) / x**5,
    )
    square = angle**2
    series = (
        1 / 2 - square / 24,
        1 / 6 - square / 120,
        -1 / 12 + square / 180,
        -1 / 60 + square / 1260,
    )
    return tuple(np.where(small, s, e) for s, e in zip(series, exact, strict=True))
