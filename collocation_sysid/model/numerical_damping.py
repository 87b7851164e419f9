"""What a scheme does to an oscillation: the damping it adds and by how much it slows it down.

On x″ = −ω² x − 2 ζ ω x′ with step Δt, a scheme's row (see `model.schemes`) is a linear recurrence
whose solutions are powers zᵏ. With h = ωΔt and u = 1/z they are the roots of

    Σ_j w_j uʲ · (h² Σ_i p_i uⁱ + 2 ζ h Σ_i q_i uⁱ) + Σ_i s_i uⁱ = 0,

of which the largest, the principal one, stands for z = exp(h (−ζ + i √(1 − ζ²))) of the exact
solution (Hairer, Lubich & Wanner, Geometric Numerical Integration, 2006, ch. XV, do the same for
multistep methods). Its damping ratio is −ln|z| / |ln z|, its angular frequency arg(z) / Δt.
Without physical damping backward Euler damps by ωΔt / 2 to leading order, midpoint not at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from .schemes import Scheme, Stencil

# More substeps than this are no remedy.
MAX_SUBSTEPS = 4096
# Shift of the period that `substeps_needed` allows.
PERIOD_ERROR = 0.01


@dataclass(frozen=True)
class NumericalMode:
    """An oscillation as a scheme computes it.

    Attributes
    ----------
    damping_ratio : float
        What the scheme adds to the physical damping ratio.
    period_error : float
        Relative lengthening of the period.
    """

    damping_ratio: float
    period_error: float


def numerical_mode(
    scheme: Scheme, angular_frequency_rad_s: float, timestep_s: float, damping_ratio: float = 0.0
) -> NumericalMode:
    """Damping and period error of a scheme's regular rows.

    Parameters
    ----------
    scheme : Scheme
    angular_frequency_rad_s : float
        ω of the undamped oscillation.
    timestep_s : float
        Δt of the grid, substeps counted.
    damping_ratio : float
        Physical ζ, below 1.

    Raises
    ------
    InputError
        For a damping ratio of 1 and above: nothing oscillates.
    """
    if not 0 <= damping_ratio < 1:
        raise InputError(f"damping_ratio = {damping_ratio:g}, expected 0 <= damping_ratio < 1")
    h = angular_frequency_rad_s * timestep_s
    z = principal_root(scheme.regular, h, damping_ratio)
    rate, angle = -float(np.log(abs(z))), float(np.angle(z))
    exact = h * float(np.sqrt(1 - damping_ratio**2))
    period_error = float(exact / angle - 1) if angle > 0 else np.inf
    return NumericalMode(rate / float(np.hypot(rate, angle)) - float(damping_ratio), period_error)


def principal_root(stencil: Stencil, h: float, damping_ratio: float = 0.0) -> complex:
    """The root z of the characteristic polynomial that stands for the exact solution.

    Of all roots it decays least; the argument is not negative.
    """
    force = _sum(h**2 * np.array(stencil.p), 2 * damping_ratio * h * np.array(stencil.q))
    in_u = _sum(np.convolve(stencil.w, force), np.array(stencil.s))
    roots = np.roots(in_u)  # of z: the coefficient of u⁰ leads
    upper = roots[roots.imag >= -1e-12 * np.abs(roots)]
    return complex(upper[np.argmax(np.abs(upper))])


def substeps_needed(
    scheme: Scheme,
    angular_frequency_rad_s: float,
    timestep_s: float,
    limit: float,
    period_error: float = PERIOD_ERROR,
    damping_ratio: float = 0.0,
) -> int | None:
    """The fewest substeps with which a mode is damped and slowed down little.

    Parameters
    ----------
    scheme : Scheme
    angular_frequency_rad_s : float
    timestep_s : float
        Time between samples.
    limit : float
        Largest |numerical damping ratio|.
    period_error : float
        Largest |relative error| of the period without damping.
    damping_ratio : float
        Physical ζ, below 1.

    Returns
    -------
    int, or None where `MAX_SUBSTEPS` do not suffice
    """

    def suffices(substeps: int) -> bool:
        mode, damped = (
            numerical_mode(scheme, angular_frequency_rad_s, timestep_s / substeps, ratio)
            for ratio in (0.0, damping_ratio)
        )
        return abs(damped.damping_ratio) <= limit and abs(mode.period_error) <= period_error

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


def _sum(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Sum of two polynomials, lowest power first."""
    total = np.zeros(max(len(a), len(b)))
    total[: len(a)] += a
    total[: len(b)] += b
    return total
