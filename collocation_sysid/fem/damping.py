"""Damping laws: a potential or a stress of the rate of deformation, and the constants it needs.

Kelvin and Voigt's is objective: S_v = γ_r dS/dt, S = 2 ∂ψ/∂C, is a stress in the material frame
and dissipates γ_r Ė:4 ∂²ψ/∂C²:Ė. Rayleigh's is the same at small strain, but it also resists that
a stretched body turns.

Beside it the mass of a region is damped by γ_m, see `body`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import casadi as ca

from ..errors import InputError, hint_at
from .constants import GAMMA_R, Constant
from .kernel import mirrored

Potential = Callable[..., ca.SX]
Stress = Callable[..., tuple[ca.SX, ca.SX]]


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
    """P_v = γ_r F dS/dt = γ_r (dP/dt − Ḟ S), and γ_r (∂(dP/dt)/∂F − Ḟ ∂S/∂F).

    With S = F⁻¹ P, ∂S/∂F:A = F⁻¹ (∂P/∂F:A − A S).
    """
    stiffness, stress = ca.hessian(psi, F)
    change = ca.jtimes(stress, F, rate)
    slope = mirrored(ca.jacobian(change, F))
    # A linear material knows no difference between the shapes; its stress does not turn along.
    if not ca.depends_on(stiffness, F):
        return gamma_r_s * change, gamma_r_s * slope
    inverse, Fdot = ca.inv(ca.reshape(F, 3, 3)), ca.reshape(rate, 3, 3)
    S = mirrored(inverse @ ca.reshape(stress, 3, 3))
    change -= ca.vec(Fdot @ S)
    turning = mirrored(stiffness) - ca.kron(S, ca.SX.eye(3))
    slope -= ca.kron(ca.SX.eye(3), Fdot @ inverse) @ turning
    return gamma_r_s * change, gamma_r_s * slope


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
