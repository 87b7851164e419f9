"""Damping laws: a potential of the rate of deformation, and the constants it needs.

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

Potential = Callable[..., ca.SX]


@dataclass(frozen=True, eq=False)
class Damping:
    """A damping law.

    Attributes
    ----------
    name : str
    potential : callable
        ``potential(psi, F, rate, **constants)`` → a density ψ_d, from the energy's as an
        expression in F. F and Ḟ are stacked (9,).
    constants : tuple of Constant
    dissipation : bool
        Whether ψ_d is a dissipation function: quadratic in Ḟ, and the first Piola–Kirchhoff
        stress of the damping is ∂ψ_d/∂Ḟ. If not, it is linear in Ḟ, the stress is ∂ψ_d/∂F, and
        ∂²ψ_d/∂F∂Ḟ must be symmetric; where an element averages the dilatation, its volume and
        the rate of that then follow F and Ḟ.
    """

    name: str
    potential: Potential = field(repr=False)
    constants: tuple[Constant, ...]
    dissipation: bool = False


def kelvin_voigt(psi: ca.SX, F: ca.SX, rate: ca.SX, gamma_r_s: ca.SX) -> ca.SX:
    """½ γ_r Ė:4 ∂²ψ/∂C²:Ė = ½ γ_r (Ḟ:∂²ψ/∂F²:Ḟ − S:ḞᵀḞ).

    The second term takes away the geometric stiffness, so that a spin Ḟ = ωF dissipates nothing.
    """
    stress = ca.gradient(psi, F)
    along = ca.jtimes(stress, F, rate)
    power = ca.dot(rate, along)
    # A linear material knows no difference between the shapes; its stress does not turn along.
    if ca.depends_on(along, F):
        Fdot = ca.reshape(rate, 3, 3)
        spatial = Fdot @ ca.inv(ca.reshape(F, 3, 3))
        power -= ca.dot(ca.reshape(stress, 3, 3), spatial.T @ Fdot)
    return 0.5 * gamma_r_s * power


def rayleigh(psi: ca.SX, F: ca.SX, rate: ca.SX, gamma_r_s: ca.SX) -> ca.SX:
    """γ_r ∂ψ/∂F:Ḟ, which makes the damping force −γ_r K(x) v."""
    return gamma_r_s * ca.jtimes(psi, F, rate)


DAMPINGS: dict[str, Damping] = {
    "kelvin-voigt": Damping("kelvin-voigt", kelvin_voigt, (GAMMA_R,), dissipation=True),
    "rayleigh": Damping("rayleigh", rayleigh, (GAMMA_R,)),
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
