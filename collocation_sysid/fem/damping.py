"""Damping laws: a potential or a stress of the rate of deformation, and the constants it needs.

Kelvin and Voigt's is objective and dissipates at any strain, with viscosities by the small-strain
Lamé constants. Rayleigh's is the same at small strain, but it also resists that a stretched body
turns, and feeds energy in where the stiffness is not positive.

Beside it the mass of a region is damped by γ_m, see `body`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import casadi as ca

from ..errors import InputError, hint_at
from .constants import GAMMA_R, Constant
from .kernel import mirrored
from .materials import lame_constants

Potential = Callable[..., ca.SX]
Stress = Callable[..., tuple[ca.SX, ca.SX]]
# Where the entries of Aᵀ stand in A, both stacked column after column.
TRANSPOSED = [0, 3, 6, 1, 4, 7, 2, 5, 8]


@dataclass(frozen=True, eq=False)
class Damping:
    """A damping law.

    Attributes
    ----------
    name : str
    constants : tuple of Constant
    potential : callable, optional
        ``potential(psi, F, rate, **constants)`` → a density ψ_d linear in the rate Ḟ, from the
        energy's as an expression in F. The first Piola–Kirchhoff stress of the damping is
        ∂ψ_d/∂F, and ∂²ψ_d/∂F∂Ḟ must be symmetric. F and Ḟ are stacked (9,); where an element
        averages the dilatation, its volume and the rate of that follow them.
    stress : callable, optional
        In its place, ``stress(psi, F, rate, **constants)`` → that stress P_v (9,), and ∂P_v/∂F
        (9, 9), which need not be symmetric. P_v must be linear in Ḟ, and ∂P_v/∂Ḟ symmetric.
    """

    name: str
    constants: tuple[Constant, ...]
    potential: Potential | None = field(default=None, repr=False)
    stress: Stress | None = field(default=None, repr=False)


def kelvin_voigt(psi: ca.SX, F: ca.SX, rate: ca.SX, gamma_r_s: ca.SX) -> tuple[ca.SX, ca.SX]:
    """P_v = F S_v, S_v = 2η C⁻¹ Ė C⁻¹ + ζ (C⁻¹:Ė) C⁻¹ with η = γ_r μ, ζ = γ_r λ.

    That is the Kirchhoff stress 2η d + ζ (tr d) 1 of the rate of deformation d, the symmetric part
    of L = Ḟ F⁻¹: what it dissipates, 2η d:d + ζ (tr d)², is positive whatever F.
    """
    stiffness, _ = ca.hessian(psi, F)
    # A linear material knows no difference between the shapes.
    if not ca.depends_on(stiffness, F):
        return gamma_r_s * mirrored(stiffness) @ rate, ca.SX(9, 9)
    lame, shear = ca.vertsplit(gamma_r_s * lame_constants(psi, F))
    one, inverse = ca.SX.eye(3), ca.inv_minor(ca.reshape(F, 3, 3))
    L = ca.reshape(rate, 3, 3) @ inverse
    P = (shear * (L + L.T) + lame * ca.trace(L) * one) @ inverse.T
    stress = ca.vec(P)
    # dF changes L as a rate −L dF would, and F⁻ᵀ by −F⁻ᵀ dFᵀ F⁻ᵀ.
    slope = -ca.jacobian(stress, rate) @ ca.kron(one, L) - ca.kron(inverse, P)[:, TRANSPOSED]
    return stress, slope


def rayleigh(psi: ca.SX, F: ca.SX, rate: ca.SX, gamma_r_s: ca.SX) -> ca.SX:
    """γ_r ∂ψ/∂F:Ḟ, which makes the damping force −γ_r K(x) v."""
    return gamma_r_s * ca.jtimes(psi, F, rate)


DAMPINGS: dict[str, Damping] = {
    "kelvin-voigt": Damping("kelvin-voigt", (GAMMA_R,), stress=kelvin_voigt),
    "rayleigh": Damping("rayleigh", (GAMMA_R,), rayleigh),
}


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
