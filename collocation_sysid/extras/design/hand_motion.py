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
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...common.array_types import Array

# Smallest and largest duration of the window's rise, over that of the window.
RISE = 0.15, 0.5
# Smallest and largest duration of the window, over that of the motion.
ACTIVE = 0.6, 1.0
# Number of periods of the slowest wave during the motion.
FEWEST_PERIODS = 0.4
# Grid points per period of the fastest wave, for the search for peaks.
POINTS_PER_PERIOD = 60
# Grid points in addition to these, which resolve the window.
FEWEST_POINTS = 200
# Number of coefficients of the window: its rise and its share of the motion.
OWN = 2
# Number of coefficients of a wave in each of six directions: amplitude, two frequencies and phase.
PER_WAVE = 4


class TimeDerivatives(NamedTuple):
    """A quantity, or a limit of it, with its first two derivatives with respect to time."""

    # The quantity; for the coordinates of a motion (T, 6): translation x, y, z [m] and rotation
    # vector x, y, z [rad].
    value: Array
    # Its first and second derivatives, of the same shape [per s, per s²].
    first: Array
    second: Array

    def scaled(self, factor: float) -> TimeDerivatives:
        """Return a copy with value and both derivatives multiplied by `factor`."""
        return TimeDerivatives(
            factor * self.value, factor * self.first, second=factor * self.second
        )


@dataclass(frozen=True, eq=False)
class HandMotion:
    """Translation and rotation vector of a hand over time, from rest to rest."""

    duration_s: float
    # Durations of the window, and of its rise and fall [s].
    active_s: float
    rise_s: float
    # (6, k): amplitudes of the k waves of x, y, z [m] and of the rotation vector's x, y, z [rad].
    amplitude: Array
    # (6, k): frequencies at the beginning and at the end of the window.
    first_hz: Array
    last_hz: Array
    phase_rad: Array  # (6, k): phases

    @classmethod
    def from_coefficients(
        cls, coefficients: Array, duration_s: float, highest_hz: float, reach: TimeDerivatives
    ) -> HandMotion:
        """Return the motion for unbounded coefficients whose expected magnitude is one.

        The sum of the waves may exceed `reach`; `HandBounds.scale_to_limits` reduces it.

        Parameters
        ----------
        coefficients : (2 + 24 k,) array
            Rise and share of the window, then amplitudes, first and last frequencies, and phases of
            the k waves of each of six coordinates.
        duration_s : float
            Duration of the motion [s].
        highest_hz : float
            Highest frequency of a wave.
        reach : TimeDerivatives of (2,) arrays
            Largest value, first and second derivative of translation [m] and rotation [rad]; each
            wave alone, without the window, satisfies them.
        """
        rise, active = (
            low + (high - low) * _to_unit_interval(u)
            for (low, high), u in zip((RISE, ACTIVE), coefficients[:OWN], strict=True)
        )
        share, first, last, phase = coefficients[OWN:].reshape(PER_WAVE, 6, -1)
        low, high = np.log([min(FEWEST_PERIODS / duration_s, highest_hz), highest_hz])
        first_hz, last_hz = (
            np.exp(low + (high - low) * _to_unit_interval(u)) for u in (first, last)
        )
        angular = 2 * np.pi * np.maximum(first_hz, last_hz)
        size, rate, rate_of_rate = (np.repeat(each, 3)[:, None] for each in reach)
        largest_amplitude = np.minimum(size, np.minimum(rate / angular, rate_of_rate / angular**2))
        active_s = float(active * duration_s)
        return cls(
            duration_s,
            active_s,
            rise_s=float(rise * active_s),
            amplitude=largest_amplitude * np.tanh(share),
            first_hz=first_hz,
            last_hz=last_hz,
            phase_rad=np.pi * phase,
        )

    @staticmethod
    def coefficient_count(waves: int) -> int:
        """Return the number of coefficients of a motion with `waves` waves per coordinate."""
        return OWN + PER_WAVE * 6 * waves

    def scaled(self, translation: float = 1.0, rotation: float = 1.0) -> HandMotion:
        """Return a copy of the motion with all translations multiplied by `translation` and all
        rotation vectors by `rotation`, at all times.
        """
        factors = np.repeat([translation, rotation], 3)[:, None]
        return replace(self, amplitude=factors * self.amplitude)

    @property
    def grid_s(self) -> Array:
        """Times (T,) from 0 to the duration [s], evenly spaced, that resolve all peaks of the
        motion.
        """
        fastest = max(self.first_hz.max(), self.last_hz.max(), 0.5 / self.rise_s)
        points = FEWEST_POINTS + POINTS_PER_PERIOD * fastest * self.duration_s
        return np.linspace(0.0, self.duration_s, int(points))

    def derivatives(self, t_s: ArrayLike) -> TimeDerivatives:
        """Return the coordinates (T, 6) and their first and second derivatives.

        They are zero at the start, and from the end of the window on.

        Parameters
        ----------
        t_s : (T,) array
            Times since the start of the motion [s].
        """
        t = np.asarray(t_s, dtype=float)
        window, rate, curvature = self._window(t)
        t = t[:, None, None]
        change = (self.last_hz - self.first_hz) / self.active_s
        angle = 2 * np.pi * (self.first_hz * t + change * t**2 / 2) + self.phase_rad
        angular = 2 * np.pi * (self.first_hz + change * t)
        growth = 2 * np.pi * change
        sine = np.sin(angle)
        cosine = np.cos(angle)
        first = angular * cosine
        second = growth * cosine - angular**2 * sine
        wave, wave_rate, wave_curvature = (
            (self.amplitude * each).sum(axis=-1) for each in (sine, first, second)
        )
        return TimeDerivatives(
            window * wave,
            rate * wave + window * wave_rate,
            second=curvature * wave + 2 * rate * wave_rate + window * wave_curvature,
        )

    def _window(self, t: Array) -> TimeDerivatives:
        """Return the window w (T, 1) at times [s] and two derivatives."""
        rising = t <= self.active_s / 2
        u = np.clip(np.where(rising, t, self.active_s - t) / self.rise_s, 0.0, 1.0)
        slope = np.where(rising, 1.0, -1.0) / self.rise_s
        value = u**3 * (10 - 15 * u + 6 * u**2)
        first = 30 * u**2 * (1 - u) ** 2 * slope
        second = 60 * u * (1 - u) * (1 - 2 * u) * slope**2
        return TimeDerivatives(value[:, None], first[:, None], second=second[:, None])


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


def _to_unit_interval(u: Array | float) -> Array:
    """Return numbers in (0, 1), nearly uniform for standard normal ones."""
    return 0.5 * (1 + np.tanh(0.8 * np.asarray(u)))
