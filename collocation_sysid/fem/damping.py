"""Damping laws: a stress from the rate of deformation, and the constants it needs.

Beside it the mass of a region is damped by γ_m, see `body`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import casadi as ca

from ..errors import InputError, hint_at
from .constants import GAMMA_R, Constant

Viscous = Callable[..., ca.SX]


@dataclass(frozen=True, eq=False)
class Damping:
    """A damping law.

    Attributes
    ----------
    name : str
    stress : callable
        ``stress(elastic, F, rate, **constants)`` → the first Piola–Kirchhoff stress of the
        damping, (9,) like all its arguments, columns stacked; linear in the rate Ḟ, and its
        derivatives by F and by Ḟ symmetric.
    constants : tuple of Constant
    """

    name: str
    stress: Viscous = field(repr=False)
    constants: tuple[Constant, ...]


def rayleigh(elastic: ca.SX, F: ca.SX, rate: ca.SX, gamma_r_s: ca.SX) -> ca.SX:
    """γ_r (∂²ψ/∂F²):Ḟ, which makes the damping force −γ_r K(x) v."""
    return gamma_r_s * ca.jtimes(elastic, F, rate)


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
