"""Material laws in CasADi SX, each with its constants: energies, damping laws and Prony branches.

A `Material` is a function ``energy(F, **constants) -> ψ`` [J/m³] of the 3 × 3 deformation gradient
with ψ(I) = 0 and no stress at F = I. Its constants are the arguments of the function. To use a
custom energy, call `Material.from_energy(function)` or pass the function to `Body`.

Energies in (λ, μ) have the small-strain stiffness of linear elasticity with these constants.
Energies in the isochoric invariants Ī₁ = J^(−2/3) I₁, Ī₂ = J^(−4/3) I₂ have the volumetric term ½ κ
(J − 1)². Laws in powers of the principal stretches are in `ogden`; kernels differentiate their
energies by the chain rule through the invariants, see `Material.chain_rule`.

A `DampingLaw` law is a potential or a stress that depends on the rate of deformation.
"kelvin-voigt" and "material" are objective and dissipate at any strain, with viscosities
proportional to the small-strain Lamé constants: the former is a viscous fluid in the current shape,
the latter is viscous in the rate of the Green strain. Rayleigh's law agrees with both at small
strain, but it also damps the rotation of a stretched body, and adds energy where the stiffness is
not positive definite.

Mass-proportional damping γ_m is part of `body`, the evolution of Prony branches part of `memory`,
and fibres beside an isotropic material part of `fibres`.
"""

from __future__ import annotations

import inspect
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import casadi as ca
import numpy as np

from ...common.files import reason
from ...common.validated_classes import validated
from ...common.validated_types import Text
from ...errors import InputError, hint_at
from ..chain_rule import ChainRule
from ..kernel import from_lower_triangle
from .constants import GAMMA_R, SHARE, TAU, Constant, constant_named
from .invariants import isochoric_invariants
from .ogden import HYPERFOAM, OGDEN, PowerLawEnergy

T = TypeVar("T")
Energy = Callable[..., ca.SX]


@validated
@dataclass(frozen=True, eq=False)
class Material:
    """Strain-energy density with its constants.

    Attributes
    ----------
    name : str
    energy : callable
        ``energy(F, **constants) -> ψ``.
    constants : tuple of Constant
        Constants in the order of θ.
    """

    name: Text
    energy: Energy = field(repr=False)
    constants: tuple[Constant, ...]

    @classmethod
    @validated
    def from_energy(cls, energy: Energy, name: str = "", *constants: Constant) -> Material:
        """Return a material from an energy function; its arguments after F are the constants.

        Parameters
        ----------
        energy : callable
            ``energy(F, mu_pa, …) -> ψ`` in CasADi operations.
        name : str, optional
            Name of the material; that of the function by default.
        *constants : Constant
            Definitions of constants whose bounds, symbols or scales do not follow from the names.

        Raises
        ------
        InputError
            If the function has no constants, cannot be evaluated, or the undeformed material has
            energy or stress; if a definition is of no argument.
        """
        name = name or getattr(energy, "__name__", "energy").replace("_", "-")
        definitions = {constant.name: constant for constant in constants}
        arguments = _arguments(energy)
        if not arguments:
            raise InputError(
                f"material {name!r} has no constants; expected a function of the deformation "
                "gradient and named constants, such as energy(F, lambda_pa, mu_pa)"
            )
        if unused := sorted(set(definitions) - set(arguments)):
            raise InputError(
                f"material {name!r}: the function has no argument for the given constant "
                f"{unused[0]!r}; expected its name among the arguments "
                f"{', '.join(arguments)}{hint_at(unused[0], arguments)}"
            )
        material = cls(
            name,
            energy,
            constants=tuple(definitions.get(a) or constant_named(a) for a in arguments),
        )
        material._check_at_rest()
        return material

    @property
    def matrix(self) -> Material:
        """Isotropic material that fibres reinforce; the material itself without any."""
        return self

    def psi(self, F: ca.SX, values: ca.SX) -> ca.SX:
        """Return the energy density (1, 1) [J/m³] as an expression, from F (3, 3) and the constants
        (c,) in their order.
        """
        return ca.SX(self.energy(F, **self._named(values)))

    def chain_rule(self, F: ca.SX, values: ca.SX) -> ChainRule:
        """Return the chain rule for derivatives of `psi_in`; without functions for all materials
        but those in powers of the stretches.

        Parameters
        ----------
        F : (3, 3) SX
            Deformation gradient.
        values : (c,) SX
            Constants in their order.
        """
        if not isinstance(self.energy, PowerLawEnergy):
            return ChainRule()
        return ChainRule((self.energy.symbolic(F, values),))

    def psi_in(self, rule: ChainRule, F: ca.SX, values: ca.SX) -> ca.SX:
        """Return the energy density as the symbol of a rule from `chain_rule` for the same F (3, 3)
        and constants (c,), if it has one, else as an expression in them.
        """
        return rule.functions[0].symbol() if rule.functions else self.psi(F, values)

    def _named(self, values: ca.SX) -> dict[str, ca.SX]:
        """Return the constants by name, from a vector in their order."""
        return {c.name: values[k] for k, c in enumerate(self.constants)}

    @cached_property
    def lame(self) -> ca.Function:
        """Function from the constants to the small-strain (λ, μ): C₁₁₂₂ and C₁₂₁₂ at F = I."""
        F = ca.SX.sym("F", 9)
        values = ca.SX.sym("values", len(self.constants))
        gradient = ca.reshape(F, 3, 3)
        rule = self.chain_rule(gradient, values)
        psi = self.psi_in(rule, gradient, values=values)
        return ca.Function("lame", [values], [lame_constants(psi, F, rule=rule)])

    def _check_at_rest(self) -> None:
        """Raise an `InputError` unless energy and stress vanish at F = I, up to rounding."""
        F = ca.SX.sym("F", 9)
        values = ca.SX.sym("values", len(self.constants))
        try:
            psi = self.psi(ca.reshape(F, 3, 3), values)
            tangent, stress = ca.hessian(psi, F)
        except (Exception, SystemExit) as error:
            raise InputError(
                f"material {self.name!r} cannot be evaluated ({reason(error)}); expected a "
                "function of CasADi operations that returns one energy density"
            ) from error
        law = ca.Function("law", [F, values], [psi, stress, tangent])
        sample_values = [
            float(np.sqrt(max(c.bounds[0], 1e-3) * c.bounds[1])) for c in self.constants
        ]
        energy, force, stiffness = (o.full() for o in law(np.eye(3).ravel(), sample_values))
        scale = np.abs(stiffness).max()
        for what, unit, residual, remedy in (
            ("energy", "J/m³", energy, "subtract this value"),
            ("stress", "Pa", force, "correct the energy, such as by a term −μ ln J"),
        ):
            worst = np.abs(residual).max()
            if not worst <= 1e-9 * scale:
                raise InputError(
                    f"material {self.name!r} has the {what} {worst:.3g} {unit} in the undeformed state, "
                    f"with {self._describe_values(sample_values)}; expected zero at F = I: {remedy}"
                )

    def _describe_values(self, values: list[float]) -> str:
        """Return the constants with given values as text."""
        return ", ".join(f"{c.name} = {v:.3g}" for c, v in zip(self.constants, values, strict=True))


class StrainMaterial(Material):
    """Law of strains of its own, which an element has in place of the deformation gradient."""

    @abstractmethod
    def viscous_stress(
        self, F: ca.SX, rate: ca.SX, values: ca.SX, gamma_r_s: ca.SX
    ) -> tuple[ca.SX, ca.SX]:
        """Return the viscous stress (g,) at a stacked gradient (g,) and its rate, and its derivative
        (g, g) by the gradient.
        """

    @abstractmethod
    def resultants(
        self, F: ca.SX, rate: ca.SX, values: ca.SX, gamma_r_s: ca.SX
    ) -> tuple[ca.SX, ca.SX]:
        """Return the strains (s,), and the stresses per volume (s,) that are conjugate to them."""


def lame_constants(psi: ca.SX, F: ca.SX, rule: ChainRule | None = None) -> ca.SX:
    """Return the small-strain (λ, μ), C₁₁₂₂ and C₁₂₁₂ at F = I, of an energy density of F stacked
    (9,).

    Parameters
    ----------
    psi : SX
        Energy density; may contain the symbols of `rule`.
    F : (9,) SX
    rule : ChainRule, optional
        Chain rule for `psi`, which then gives fewer operations; CasADi's derivatives by default.
    """
    if rule is not None and rule.functions:
        tangent = rule.jacobian(rule.gradient(psi, F), F)
        (tangent,) = rule.eliminate([tangent])
    else:
        tangent, _ = ca.hessian(psi, F)
    entries = ca.vertcat(tangent[0, 4], tangent[1, 1])
    return ca.simplify(ca.substitute(entries, F, ca.SX(ca.DM(np.eye(3).ravel()))))


def neo_hookean(F: ca.SX, lambda_pa: ca.SX, mu_pa: ca.SX) -> ca.SX:
    """Return the neo-Hookean energy ψ = ½ λ (ln J)² − μ ln J + ½ μ (tr C − 3) at F (3, 3) (Bonet &
    Wood 2008, eq. 6.27); NaN for J < 0.
    """
    log_j = ca.log(ca.det(F))
    return 0.5 * lambda_pa * log_j**2 - mu_pa * log_j + 0.5 * mu_pa * (ca.sumsqr(F) - 3)


def stable_neo_hookean(F: ca.SX, lambda_pa: ca.SX, mu_pa: ca.SX) -> ca.SX:
    """Return the stable neo-Hookean energy ψ = ½ μ (tr C − 3) − μ (J − 1) + ½ (λ + μ)(J − 1)² at F
    (3, 3).

    It is finite for inverted elements, too (Smith, de Goes & Kim 2018, eq. 13, with λ + μ in place
    of λ, so that the small-strain limit is linear elasticity with (λ, μ)).
    """
    j = ca.det(F)
    return (
        0.5 * mu_pa * (ca.sumsqr(F) - 3)
        - mu_pa * (j - 1)
        + 0.5 * (lambda_pa + mu_pa) * (j - 1) ** 2
    )


def st_venant_kirchhoff(F: ca.SX, lambda_pa: ca.SX, mu_pa: ca.SX) -> ca.SX:
    """Return the St. Venant–Kirchhoff energy ψ = ½ λ (tr E)² + μ E:E at F (3, 3), with the Green
    strain E = ½ (C − I).

    It softens in compression, and is finite for inverted elements.
    """
    strain = 0.5 * (F.T @ F - ca.SX.eye(3))
    return 0.5 * lambda_pa * ca.trace(strain) ** 2 + mu_pa * ca.sumsqr(strain)


def linear_elastic(F: ca.SX, lambda_pa: ca.SX, mu_pa: ca.SX) -> ca.SX:
    """Return the linear elastic energy ψ = ½ λ (tr ε)² + μ ε:ε at F (3, 3), with ε = sym F − I.

    For small rotations only, because it resists rotation.
    """
    strain = 0.5 * (F + F.T) - ca.SX.eye(3)
    return 0.5 * lambda_pa * ca.trace(strain) ** 2 + mu_pa * ca.sumsqr(strain)


def mooney_rivlin(F: ca.SX, c10_pa: ca.SX, c01_pa: ca.SX, kappa_pa: ca.SX) -> ca.SX:
    """Return the Mooney–Rivlin energy ψ = C₁₀ (Ī₁ − 3) + C₀₁ (Ī₂ − 3) + U at F (3, 3), with U = ½ κ
    (J − 1)²; the shear modulus is μ = 2 (C₁₀ + C₀₁).

    See Bonet & Wood 2008, sec. 6.5.
    """
    first, second = isochoric_invariants(F)
    return c10_pa * (first - 3) + c01_pa * (second - 3) + _volumetric(F, kappa_pa)


def yeoh(F: ca.SX, c10_pa: ca.SX, c20_pa: ca.SX, c30_pa: ca.SX, kappa_pa: ca.SX) -> ca.SX:
    """Return Yeoh's energy ψ = Σ_i C_i0 (Ī₁ − 3)^i + U, i = 1 … 3, at F (3, 3), with U = ½ κ (J −
    1)²; the shear modulus is μ = 2 C₁₀ (Yeoh 1993).
    """
    excess = isochoric_invariants(F)[0] - 3
    return excess * (c10_pa + excess * (c20_pa + excess * c30_pa)) + _volumetric(F, kappa_pa)


def gent(F: ca.SX, mu_pa: ca.SX, gent_limit: ca.SX, kappa_pa: ca.SX) -> ca.SX:
    """Return Gent's energy ψ = −½ μ J_m ln(1 − (Ī₁ − 3)/J_m) + U at F (3, 3), with J_m =
    `gent_limit` and U = ½ κ (J − 1)².

    Ī₁ < 3 + J_m for every stretch (Gent 1996); energy and derivatives are NaN beyond.
    """
    remaining = 1 - (isochoric_invariants(F)[0] - 3) / gent_limit
    # The square root makes the derivatives NaN beyond the limit, too; otherwise a solver that
    # evaluates forces alone could converge there.
    return -mu_pa * gent_limit * ca.log(ca.sqrt(remaining)) + _volumetric(F, kappa_pa)


def arruda_boyce(F: ca.SX, mu_pa: ca.SX, chain_stretch: ca.SX, kappa_pa: ca.SX) -> ca.SX:
    """Return the Arruda–Boyce energy ψ = C Σ_i α_i λ_m^(2−2i) (Ī₁^i − 3^i) + U at F (3, 3), with
    λ_m = `chain_stretch` and U = ½ κ (J − 1)².

    Five terms of the inverse Langevin function; C is such that μ is the shear modulus at small
    strain (Arruda & Boyce 1993, eq. 22).
    """
    first = isochoric_invariants(F)[0]
    series = ca.SX(0)
    slope = ca.SX(0)
    for i, coefficient in enumerate((1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750), start=1):
        weight = coefficient / chain_stretch ** (2 * i - 2)
        series += weight * (first**i - 3**i)
        slope += 2 * weight * i * 3 ** (i - 1)
    return mu_pa * series / slope + _volumetric(F, kappa_pa)


def _volumetric(F: ca.SX, kappa_pa: ca.SX) -> ca.SX:
    """Return the volumetric energy U = ½ κ (J − 1)²."""
    return 0.5 * kappa_pa * (ca.det(F) - 1) ** 2


def _arguments(energy: Energy) -> list[str]:
    """Return the names of the constants of an energy function: its arguments after F."""
    return list(inspect.signature(energy).parameters)[1:]


# Built without `Material.from_energy`, whose check would slow down every start; the tests check
# them.
MATERIALS: dict[str, Material] = {
    name: Material(name, energy, constants=tuple(map(constant_named, _arguments(energy))))
    for name, energy in {
        "neo-hookean": neo_hookean,
        "stable-neo-hookean": stable_neo_hookean,
        "st-venant-kirchhoff": st_venant_kirchhoff,
        "mooney-rivlin": mooney_rivlin,
        "yeoh": yeoh,
        "gent": gent,
        "arruda-boyce": arruda_boyce,
        "linear": linear_elastic,
    }.items()
}
MATERIALS |= {
    name: Material(name, energy, constants=tuple(map(constant_named, energy.names)))
    for name, energy in (OGDEN | HYPERFOAM).items()
}


def as_material(material: str | Energy | Material) -> Material:
    """Return a material from its name in `MATERIALS`, from an energy function, or the given
    material itself.

    Raises
    ------
    InputError
        If there is no material of that name; for a function see `Material.from_energy`.
    """
    if isinstance(material, Material):
        return material
    if not isinstance(material, str) and not callable(material):
        raise InputError(
            f"material is {material!r}; expected one of {', '.join(MATERIALS)}, a Material, or an "
            "energy function"
        )
    return (
        _look_up("material", material, table=MATERIALS)
        if isinstance(material, str)
        else Material.from_energy(material)
    )


def _look_up(kind: str, name: str, table: Mapping[str, T]) -> T:
    """Return the entry of a table by name, or raise an `InputError` that lists the known names."""
    if not isinstance(name, str) or name not in table:
        hint = hint_at(str(name), table)
        raise InputError(f"no {kind} {name!r}; available: {', '.join(table)}{hint}")
    return table[name]


Potential = Callable[..., ca.SX]
Stress = Callable[..., tuple[ca.SX, ca.SX]]
# Indices in A of the entries of Aᵀ, both stacked column after column.
TRANSPOSED = [0, 3, 6, 1, 4, 7, 2, 5, 8]


@validated
@dataclass(frozen=True, eq=False)
class DampingLaw:
    """Damping law: a potential, or a stress.

    Attributes
    ----------
    name : str
    constants : tuple of Constant
    potential : callable, optional
        ``potential(psi, F, rate, **constants)`` → a density ψ_d linear in the rate Ḟ, from the
        energy density psi as an expression in F. The first Piola–Kirchhoff stress of the damping is
        ∂ψ_d/∂F, and ∂²ψ_d/∂F∂Ḟ must be symmetric. F and Ḟ are stacked (9,); if an element averages
        the dilatation, m and its rate follow them.
    stress : callable, optional
        Instead of a potential: ``stress(psi, F, rate, **constants)`` → the stress P_v (9,) and
        ∂P_v/∂F (9, 9), which need not be symmetric. P_v must be linear in Ḟ, and ∂P_v/∂Ḟ symmetric.
    accepts_symbols : bool
        Whether the potential only differentiates psi along (F, Ḟ) as a whole, so that further
        symbols of psi and their rates may follow those of F; false by default.

    Raises
    ------
    InputError
        If it has neither a potential nor a stress, or `constants` is not a tuple of `Constant`.

    Notes
    -----
    A `Body` refuses a law that cannot be evaluated or is not linear in Ḟ, see
    `damping_admissibility`.
    """

    name: Text
    constants: tuple[Constant, ...]
    potential: Potential | None = field(default=None, repr=False)
    stress: Stress | None = field(default=None, repr=False)
    accepts_symbols: bool = False

    def __post_init__(self) -> None:
        if self.potential is None and self.stress is None:
            raise InputError(
                f"the damping law {self.name!r} has neither a stress nor a potential; expected "
                "stress=function or potential=function"
            )


def damped_psi(damping: DampingLaw, material: Material, F: ca.SX, values: ca.SX) -> ca.SX:
    """Return the energy density that a damping law gets, at F (3, 3), from the constants (c,) of the
    material: without fibres for a stress, whose viscosities are those of the matrix.
    """
    viscous = material if damping.stress is None else material.matrix
    return viscous.psi(F, values[: len(viscous.constants)])


def kelvin_voigt(psi: ca.SX, F: ca.SX, rate: ca.SX, gamma_r_s: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the stress P_v (9,) of Kelvin–Voigt damping and ∂P_v/∂F (9, 9).

    P_v = F S_v with S_v = 2η C⁻¹ Ė C⁻¹ + ζ (C⁻¹:Ė) C⁻¹ and the viscosities η = γ_r μ and ζ = γ_r λ.
    This is the Kirchhoff stress 2η d + ζ (tr d) 1 of the rate of deformation d, the symmetric part
    of L = Ḟ F⁻¹; its dissipation 2η d:d + ζ (tr d)² is positive for any F.

    Parameters
    ----------
    psi : SX
        Energy density as an expression in `F`; its small-strain λ and μ are used, and for a linear
        material, whose stiffness does not depend on F, P_v is γ_r times the rate of its stress.
    F, rate : (9,) SX
        Symbols of the deformation gradient and its rate Ḟ, stacked column after column.
    gamma_r_s : SX
        γ_r [s].
    """
    stiffness, _ = ca.hessian(psi, F)
    # A linear material does not distinguish the deformed from the undeformed shape.
    if not ca.depends_on(stiffness, F):
        return gamma_r_s * from_lower_triangle(stiffness) @ rate, ca.SX(9, 9)
    lame, shear = ca.vertsplit(gamma_r_s * lame_constants(psi, F))
    one = ca.SX.eye(3)
    inverse = ca.inv_minor(ca.reshape(F, 3, 3))
    L = ca.reshape(rate, 3, 3) @ inverse
    P = (shear * (L + L.T) + lame * ca.trace(L) * one) @ inverse.T
    stress = ca.vec(P)
    # dF changes L as a rate −L dF would, and F⁻ᵀ by −F⁻ᵀ dFᵀ F⁻ᵀ.
    slope = -ca.jacobian(stress, rate) @ ca.kron(one, L) - ca.kron(inverse, P)[:, TRANSPOSED]
    return stress, slope


def material_form(psi: ca.SX, F: ca.SX, rate: ca.SX, gamma_r_s: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the stress P_v (9,) of damping in material form and ∂P_v/∂F (9, 9).

    P_v = F S_v with S_v = γ_r (λ tr(Ė) I + 2μ Ė) and the rate Ė of the Green strain. S_v : Ė = γ_r
    (λ (tr Ė)² + 2μ Ė:Ė) is positive for any F; half of it is the potential D of the stress, P_v =
    ∂D/∂Ḟ. For a St. Venant–Kirchhoff material S_v is γ_r times the rate of the elastic second
    Piola–Kirchhoff stress. See `kelvin_voigt` for the arguments and for linear materials.
    """
    stiffness, _ = ca.hessian(psi, F)
    if not ca.depends_on(stiffness, F):  # a linear material does not distinguish the shapes
        return gamma_r_s * from_lower_triangle(stiffness) @ rate, ca.SX(9, 9)
    lame, shear = ca.vertsplit(gamma_r_s * lame_constants(psi, F))
    deformation = ca.reshape(F, 3, 3)
    product = deformation.T @ ca.reshape(rate, 3, 3)
    strain_rate = (product + product.T) / 2
    second_piola = lame * ca.trace(strain_rate) * ca.SX.eye(3) + 2 * shear * strain_rate
    stress = ca.vec(deformation @ second_piola)
    return stress, ca.jacobian(stress, F)


def rayleigh(psi: ca.SX, F: ca.SX, rate: ca.SX, gamma_r_s: ca.SX) -> ca.SX:
    """Return Rayleigh damping as the potential γ_r ∂ψ/∂F:Ḟ, which gives the damping force −γ_r K(x)
    v.

    Parameters
    ----------
    psi : SX
        Energy density as an expression in `F`.
    F, rate : SX
        Symbols on which `psi` depends, and their rates.
    gamma_r_s : SX
        γ_r [s].
    """
    return gamma_r_s * ca.jtimes(psi, F, rate)


DAMPINGS: dict[str, DampingLaw] = {
    "kelvin-voigt": DampingLaw("kelvin-voigt", (GAMMA_R,), stress=kelvin_voigt),
    "material": DampingLaw("material", (GAMMA_R,), stress=material_form),
    "rayleigh": DampingLaw("rayleigh", (GAMMA_R,), potential=rayleigh, accepts_symbols=True),
}


def as_damping(damping: str | DampingLaw) -> DampingLaw:
    """Return a damping law from its name in `DAMPINGS`, or the given law.

    Raises
    ------
    InputError
        If there is no damping law of that name.
    """
    if isinstance(damping, DampingLaw):
        return damping
    return _look_up("damping", damping, table=DAMPINGS)


@validated
@dataclass(frozen=True)
class Prony:
    """Branch of the memory: a spring of `share` times the stiffness in series with a dashpot.

    Attributes
    ----------
    name : str
        Prefix of the names of its constants: ``prony_1.share``, ``prony_1.tau_s``.
    """

    name: Text

    def __post_init__(self) -> None:
        if not self.name or not self.name.replace("_", "").replace("-", "").isalnum():
            raise InputError(
                f"the branch's name is {self.name!r}; expected letters, digits, - and _, which "
                "stand before the names of its parameters"
            )

    def named_constants(self) -> tuple[Constant, Constant]:
        """Return the constants of the branch: its share g and its relaxation time τ."""
        share, tau = (replace(c, name=f"{self.name}.{c.name}") for c in (SHARE, TAU))
        return share, tau


def as_branches(branches_or_names: Sequence[str | Prony]) -> tuple[Prony, ...]:
    """Return Prony branches from a sequence of names or branches; branches are returned as they
    are.

    Raises
    ------
    InputError
        For a string in place of a sequence, an invalid name, or a name that occurs twice.
    """
    if isinstance(branches_or_names, str):
        raise InputError(
            f"prony is {branches_or_names!r}; expected a list of names of branches, such as "
            f"[{branches_or_names!r}]"
        )
    branches = tuple(b if isinstance(b, Prony) else Prony(b) for b in branches_or_names)
    names = [branch.name for branch in branches]
    for name in names:
        if names.count(name) > 1:
            raise InputError(
                f"two Prony branches of the same part of the body are named {name!r}; expected a "
                "different name for each"
            )
    return branches
