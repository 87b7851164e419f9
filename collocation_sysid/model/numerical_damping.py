"""Numerical damping and period error of a time-stepping scheme for one vibration mode.

Use this module to choose the number of substeps. For x″ = −ω² x − 2 ζ ω x′ with step Δt, a row of a
scheme (see `model.schemes`) is a linear recurrence whose solutions are powers zᵏ. With h = ωΔt and
u = 1/z they are the roots of

    Σ_j w_j uʲ · (h² Σ_i p_i uⁱ + 2 ζ h Σ_i q_i uⁱ) + Σ_i s_i uⁱ = 0.

The largest root, the principal one, corresponds to z = exp(h (−ζ + i √(1 − ζ²))) of the exact
solution (Hairer, Lubich & Wanner, Geometric Numerical Integration, 2006, ch. XV, do the same for
multistep methods). Its damping ratio is −ln|z| / |ln z|, its angular frequency arg(z) / Δt.
Without physical damping backward Euler damps by ωΔt / 2 to leading order, midpoint not at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..fem.schemes import Scheme, Stencil

# Largest number of substeps tried by `substeps_needed`; more would be too slow to be useful.
MAX_SUBSTEPS = 4096
# Largest absolute relative error of the period in `substeps_needed`.
PERIOD_ERROR = 0.01


@dataclass(frozen=True)
class NumericalMode:
    """Numerical damping and period error of one mode."""

    # Damping ratio of the computed oscillation minus the physical damping ratio.
    damping_ratio: float
    # Relative lengthening of the period; infinite where the computed mode does not oscillate.
    period_error: float


def numerical_mode(
    scheme: Scheme, angular_frequency_rad_s: float, timestep_s: float, damping_ratio: float = 0.0
) -> NumericalMode:
    """Return damping and period error of the regular rows of a scheme.

    Parameters
    ----------
    angular_frequency_rad_s : float
        Angular frequency ω of the undamped oscillation, positive.
    timestep_s : float
        Time step Δt of the grid, i.e. the time between samples divided by the number of substeps.
    damping_ratio : float
        Physical damping ratio ζ, 0 ≤ ζ < 1. The period error is relative to the damped period.

    Raises
    ------
    InputError
        For a damping ratio outside [0, 1): a critically damped mode does not oscillate.
    """
    if not 0 <= damping_ratio < 1:
        raise InputError(f"damping_ratio = {damping_ratio:g}, expected 0 <= damping_ratio < 1")
    h = angular_frequency_rad_s * timestep_s
    z = principal_root(scheme.regular, h, damping_ratio=damping_ratio)
    rate = -float(np.log(abs(z)))
    angle = float(np.angle(z))
    exact = h * float(np.sqrt(1 - damping_ratio**2))
    period_error = float(exact / angle - 1) if angle > 0 else np.inf
    return NumericalMode(rate / float(np.hypot(rate, angle)) - float(damping_ratio), period_error)


def principal_root(stencil: Stencil, h: float, damping_ratio: float = 0.0) -> complex:
    """Return the root z of the characteristic polynomial that corresponds to the exact solution.

    The principal root has the largest modulus of all roots with a non-negative imaginary part.

    Parameters
    ----------
    stencil : Stencil
        Regular stencil of a scheme.
    h : float
        Dimensionless time step ωΔt, positive.
    damping_ratio : float
        Physical damping ratio ζ.
    """
    force = _polynomial_sum(h**2 * np.array(stencil.p), 2 * damping_ratio * h * np.array(stencil.q))
    in_u = _polynomial_sum(np.convolve(stencil.w, force), np.array(stencil.s))
    roots = np.roots(in_u)  # of z: the coefficient of u⁰ leads
    upper = roots[roots.imag >= -1e-12 * np.abs(roots)]
    return complex(upper[np.argmax(np.abs(upper))])


def substeps_needed(
    scheme: Scheme,
    angular_frequency_rad_s: float,
    timestep_s: float,
    damping_limit: float,
    damping_ratio: float = 0.0,
) -> int | None:
    """Return the fewest substeps that keep numerical damping and period error within limits, by
    bisection: both are assumed to decrease with the step. The period error is at most
    `PERIOD_ERROR`, evaluated without physical damping.

    Parameters
    ----------
    angular_frequency_rad_s : float
        Angular frequency ω of the undamped mode, positive.
    timestep_s : float
        Time between samples.
    damping_limit : float
        Largest absolute numerical damping ratio.
    damping_ratio : float
        Physical damping ratio ζ, below 1.

    Returns
    -------
    int or None
        None where `MAX_SUBSTEPS` substeps do not suffice.

    Raises
    ------
    InputError
        For a damping ratio outside [0, 1).
    """

    def suffices(substeps: int) -> bool:
        mode, damped = (
            numerical_mode(
                scheme,
                angular_frequency_rad_s,
                timestep_s=timestep_s / substeps,
                damping_ratio=ratio,
            )
            for ratio in (0.0, damping_ratio)
        )
        return abs(damped.damping_ratio) <= damping_limit and abs(mode.period_error) <= PERIOD_ERROR

    high = 1
    while not suffices(high):
        high *= 2
        if high > MAX_SUBSTEPS:
            return None
    low = high // 2  # does not suffice, or is zero
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if suffices(middle) else (middle, high)
    return high


def _polynomial_sum(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the sum of two polynomials, given by their coefficients from the lowest power on."""
    total = np.zeros(max(len(a), len(b)))
    total[: len(a)] += a
    total[: len(b)] += b
    return total
