"""Smooth motions of a hand that begin and end at rest, in one pose.

Each of six coordinates, three of a shift d(t) and three of a rotation vector r(t), is a sum of
waves whose frequency changes linearly, under one window that rises and falls:

    c(t) = w(t) Σ a sin(2π (f₀ t + (f₁ − f₀) t² / 2T) + φ),   R(t) = exp(r(t)) R₀.

The window and its first two derivatives are zero at both ends, and so are shift, velocity and
acceleration. It may end before the motion's time does, so that the body swings freely.

Angular velocity and acceleration follow from the left Jacobian of the exponential map (Sola et
al., A micro Lie theory, 2018, eq. 145): with a = (1 − cos θ)/θ² and b = (θ − sin θ)/θ³,

    ω = ṙ + a r×ṙ + b r×(r×ṙ).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ...common.array_types import Array

# Smallest and largest share of the window in which it rises.
RISE = 0.15, 0.5
# Smallest and largest share of the motion for which the window is open.
ACTIVE = 0.6, 1.0
# Periods in the whole motion of the slowest wave.
FEWEST_PERIODS = 0.4
# Points of the grid in a period of the fastest wave on which peaks are sought.
POINTS_PER_PERIOD = 60
# Points of the grid besides these, for a window that opens and closes.
FEWEST_POINTS = 200
# Coefficients of the window: its rise and its share of the motion.
OWN = 2
# Coefficients of a wave in each of six directions: amplitude, two frequencies and phase.
PER_WAVE = 4


@dataclass(frozen=True, eq=False)
class HandMotion:
    """Translation and rotation vector of a hand over time, from rest to rest.

    Attributes
    ----------
    duration_s : float
        Duration of the motion [s].
    active_s, rise_s : float
        Durations of the window, and of its rise and fall [s].
    amplitude : (6, k) array
        Amplitudes of the k waves of x, y, z [m] and of the rotation vector's x, y, z [rad].
    first_hz, last_hz : (6, k) array
        Frequencies at the beginning and at the end of the window.
    phase_rad : (6, k) array
        Phases.
    """

    duration_s: float
    active_s: float
    rise_s: float
    amplitude: Array
    first_hz: Array
    last_hz: Array
    phase_rad: Array

    @classmethod
    def from_coefficients(
        cls,
        coefficients: Array,
        duration_s: float,
        highest_hz: float,
        reach: tuple[Array, Array, Array],
    ) -> HandMotion:
        """Return the motion for unbounded coefficients whose expected magnitude is one.

        Parameters
        ----------
        coefficients : (2 + 24 k,) array
            Coefficients.
        duration_s : float
            Duration of the motion [s].
        highest_hz : float
            Highest frequency of a wave.
        reach : tuple of three (2,) arrays
            Largest value, first and second derivative of translation [m] and rotation [rad]; each
            wave alone satisfies them.
        """
        rise, active = (
            low + (high - low) * _to_unit_interval(u)
            for (low, high), u in zip(
                (RISE, ACTIVE), coefficients[:OWN], strict=True
            )
        )
        share, first, last, phase = coefficients[OWN:].reshape(PER_WAVE, 6, -1)
        low, high = np.log(
            [min(FEWEST_PERIODS / duration_s, highest_hz), highest_hz]
        )
        first_hz, last_hz = (
            np.exp(low + (high - low) * _to_unit_interval(u))
            for u in (first, last)
        )
        angular = 2 * np.pi * np.maximum(first_hz, last_hz)
        size, rate, rate_of_rate = (
            np.repeat(each, 3)[:, None] for each in reach
        )
        largest_amplitude = np.minimum(
            size, np.minimum(rate / angular, rate_of_rate / angular**2)
        )
        active_s = float(active * duration_s)
        return cls(
            duration_s,
            active_s,
            float(rise * active_s),
            largest_amplitude * np.tanh(share),
            first_hz,
            last_hz,
            np.pi * phase,
        )

    @staticmethod
    def coefficient_count(waves: int) -> int:
        """Return the number of coefficients of a motion with `waves` waves per coordinate."""
        return OWN + PER_WAVE * 6 * waves

    def scaled(
        self, translation: float = 1.0, rotation: float = 1.0
    ) -> HandMotion:
        """Return the motion with all translations multiplied by `translation` and all rotation
        vectors by `rotation`.
        """
        factors = np.repeat([translation, rotation], 3)[:, None]
        return replace(self, amplitude=factors * self.amplitude)

    @cached_property
    def grid_s(self) -> Array:
        """Times [s] that resolve all peaks of the motion."""
        fastest = max(
            self.first_hz.max(), self.last_hz.max(), 0.5 / self.rise_s
        )
        points = FEWEST_POINTS + POINTS_PER_PERIOD * fastest * self.duration_s
        return np.linspace(0.0, self.duration_s, int(points))

    def derivatives(self, t_s: ArrayLike) -> tuple[Array, Array, Array]:
        """Return coordinates (T, 6) and their first and second derivatives at times from 0 [s]."""
        t = np.asarray(t_s, dtype=float)
        window, rate, curvature = self._window(t)
        t = t[:, None, None]
        change = (self.last_hz - self.first_hz) / self.active_s
        angle = (
            2 * np.pi * (self.first_hz * t + change * t**2 / 2) + self.phase_rad
        )
        angular = 2 * np.pi * (self.first_hz + change * t)
        growth = 2 * np.pi * change
        sine = np.sin(angle)
        cosine = np.cos(angle)
        first = angular * cosine
        second = growth * cosine - angular**2 * sine
        wave, wave_rate, wave_curvature = (
            (self.amplitude * each).sum(axis=-1)
            for each in (sine, first, second)
        )
        return (
            window * wave,
            rate * wave + window * wave_rate,
            curvature * wave + 2 * rate * wave_rate + window * wave_curvature,
        )

    def _window(self, t: Array) -> tuple[Array, Array, Array]:
        """Return the factor (T, 1) of the waves at times t (T,) [s], and its first two derivatives,
        so that the motion begins and ends at rest.

        With u from 0 to 1 it rises as 10 u³ − 15 u⁴ + 6 u⁵, and falls likewise.
        """
        rising = t <= self.active_s / 2
        u = np.clip(
            np.where(rising, t, self.active_s - t) / self.rise_s, 0.0, 1.0
        )
        slope = np.where(rising, 1.0, -1.0) / self.rise_s
        value = u**3 * (10 - 15 * u + 6 * u**2)
        first = 30 * u**2 * (1 - u) ** 2 * slope
        second = 60 * u * (1 - u) * (1 - 2 * u) * slope**2
        return value[:, None], first[:, None], second[:, None]


def angular_motion(
    r: Array, rate: Array, curvature: Array
) -> tuple[Array, Array]:
    """Return angular velocity [rad/s] and acceleration [rad/s²] (T, 3), in the fixed frame, of the
    rotation exp(r), from the rotation vector r (T, 3) and its first two derivatives.
    """
    angle = np.linalg.norm(r, axis=1)
    a, b, a_slope, b_slope = (
        each[:, None] for each in _jacobian_factors(angle)
    )
    projection = np.einsum("ti,ti->t", r, rate)[:, None]
    across = np.cross(r, rate)
    double_cross = np.cross(r, across)
    drive = np.cross(r, curvature)
    velocity = rate + a * across + b * double_cross
    acceleration = (
        curvature
        + a * drive
        + b * (np.cross(rate, across) + np.cross(r, drive))
    )
    return velocity, acceleration + projection * (
        a_slope * across + b_slope * double_cross
    )


def _jacobian_factors(angle: Array) -> tuple[Array, Array, Array, Array]:
    """Return the factors a = (1 − cos θ)/θ² and b = (θ − sin θ)/θ³ of the left Jacobian, and
    (da/dθ)/θ and (db/dθ)/θ, (T,) each, at angles θ (T,) [rad].

    Series are used near zero.
    """
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
    return tuple(
        np.where(small, s, e) for s, e in zip(series, exact, strict=True)
    )  # type: ignore[return-value]


def _to_unit_interval(u: Array | float) -> Array:
    """Return numbers between 0 and 1 from any numbers; nearly uniform for normal ones."""
    return 0.5 * (1 + np.tanh(0.8 * np.asarray(u)))
