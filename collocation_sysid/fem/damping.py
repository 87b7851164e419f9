"""Damping laws: a potential of the rate of deformation, and the constants it needs.

Beside it the mass of a region is damped by γ_m, see `body`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import casadi as ca

from ..errors import InputError, hint_at
from .constants import GAMMA_R, Constant

Potential = Callable[..., ca.SX]


@dataclass(frozen=True, eq=False)
class Damping:
    """A damping law.

    Attributes
    ----------
    name : str
    potential : callable
        ``potential(psi, F, rate, **constants)`` → a density ψ_d linear in the rate Ḟ, from the
        energy's as an expression in F. The first Piola–Kirchhoff stress of the damping is
        ∂ψ_d/∂F, and ∂²ψ_d/∂F∂Ḟ must be symmetric. F and Ḟ are stacked (9,); where an element
        averages the dilatation, its volume and the rate of that follow them.
    constants : tuple of Constant
    """

    name: str
    potential: Potential = field(repr=False)
    constants: tuple[Constant, ...]


def rayleigh(psi: ca.SX, F: ca.SX, rate: ca.SX, gamma_r_s: ca.SX) -> ca.SX:
    """γ_r ∂ψ/∂F:Ḟ, which makes the damping force −γ_r K(x) v."""
    return gamma_r_s * ca.jtimes(psi, F, rate)


DAMPINGS: dict[str, Damping] = {"rayleigh": Damping("rayleigh", rayleigh, (GAMMA_R,))}


def as_damping(given: str | Damping) -> Damping:
    """A damping law from a name in `DAMPINGS`, or itself.

    Raises
    ------
    InputError
        If there is none of that name.
    """
    if isinstance(given, Damping):
        return given
    if given not in DAMPINGS:
        known = ", ".join(DAMPINGS)
        raise InputError(f"no damping {given!r}; available: {known}{hint_at(given, DAMPINGS)}")
    return DAMPINGS[given]
