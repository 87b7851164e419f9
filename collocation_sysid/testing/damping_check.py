"""Check of a damping law: `check_damping`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from ..common.array_types import Array
from ..common.validated_classes import validated
from ..common.validated_types import Positive
from ..errors import InputError
from ..fem.laws.damping_admissibility import viscous_stress
from ..fem.laws.materials import DampingLaw, Energy, Material, as_damping, as_material, damped_psi
from .material_check import deformation_gradients, random_rotation
from .property_check import PropertyCheck
from .small_problems import usual_constants

# Number of random deformations, and the largest entries of F − I: damping laws are used at large
# strains, too.
DEFORMATIONS = 6
LARGEST_STRAIN = 0.5
# Most negative power, relative to the largest one at the same deformation, that counts as rounding.
ROUNDING = 1e-10


@validated
def check_damping(
    law: str | DampingLaw,
    *,
    material: str | Energy | Material = "neo-hookean",
    constants: Mapping[str, float] | None = None,
    is_objective: bool = True,
    is_dissipative: bool = True,
    largest_strain: Positive = LARGEST_STRAIN,
) -> None:
    """Check a damping law: derivatives, dissipation and objectivity.

    The stress or potential can be evaluated, and its result has the right shape. At random
    deformations the stress P_v is linear in the rate Ḟ, ∂P_v/∂Ḟ is symmetric, and a stated ∂P_v/∂F
    is the derivative of P_v by CasADi's automatic derivative and by central differences. The power
    P_v:Ḟ is not negative for any Ḟ, and a superposed spinning rotation only rotates P_v.

    Parameters
    ----------
    material : str, Material or callable
        Material whose energy density the law gets.
    constants : mapping of name to float, optional
        Values of constants of the law and the material, as in `check_material`.
    is_objective : bool
        Whether rotation is not damped; false for Rayleigh's law.
    is_dissipative : bool
        Whether the power never increases the energy at any strain; false for Rayleigh's law.
    largest_strain : float
        Largest entry of F − I of the random deformations.

    Raises
    ------
    AssertionError
        For the first property that fails: which one, where, found and expected value.

    Notes
    -----
    Values of `constants` that neither law nor material declares are ignored; a constant without a
    value has that of `usual_constants`.
    """
    made = as_damping(law)
    known = as_material(material)
    check = PropertyCheck(f"damping law {made.name!r}")
    if made.stress is not None and made.potential is not None:
        check.fail("it has both a stress and a potential", made, expected="only one of them")
    _check_evaluation(check, made, known)
    values = usual_constants((*known.constants, *made.constants), constants)
    stress = DampingStress(made, known, values=np.array([*values.values()]))
    for number, F in enumerate(
        deformation_gradients(check.rng, DEFORMATIONS, largest_strain=largest_strain)
    ):
        where = f"at random deformation {number} (strains up to {largest_strain:g})"
        rate = check.rng.standard_normal(9)
        _check_derivatives(check, stress, F=F, rate=rate, where=where)
        if is_dissipative:
            _check_dissipation(check, stress, F=F, where=where)
        if is_objective:
            _check_objectivity(check, stress, F=F, rate=rate, where=where)


def damping_stress(
    law: DampingLaw, material: Material, symbols: list[ca.SX]
) -> tuple[ca.SX, ca.SX | None]:
    """Return the stress P_v (9,) of a damping law, and the stated ∂P_v/∂F (9, 9).

    Parameters
    ----------
    symbols : list of SX
        F (9,), its rate (9,), the constants of the material and those of the law.

    Returns
    -------
    tuple
        The second entry is None if the law has a potential, whose derivatives are all generated.

    Raises
    ------
    AssertionError
        If the law has neither stress nor potential.
    """
    F, rate, material_values, law_values = symbols
    psi = damped_psi(law, material, ca.reshape(F, 3, 3), material_values)
    named = {c.name: law_values[k] for k, c in enumerate(law.constants)}
    if law.stress is not None:
        stress, slope = law.stress(psi, F, rate, **named)
        return ca.SX(stress), ca.SX(slope)
    assert law.potential is not None
    return ca.gradient(law.potential(psi, F, rate, **named), F), None


@dataclass(frozen=True, eq=False)
class DampingState:
    """Stress of a damping law at one F and Ḟ, with derivatives; tensors stacked column by column."""

    stress: Array  # (9,): first Piola–Kirchhoff stress P_v [Pa]
    # (9, 9): ∂P_v/∂F as the law states it; the automatic derivative if the law has a potential.
    stated_by_F: Array
    by_F: Array  # (9, 9): ∂P_v/∂F by automatic differentiation
    by_rate: Array  # (9, 9): ∂P_v/∂Ḟ by automatic differentiation


@dataclass(frozen=True, eq=False)
class DampingStress:
    """Stress of a damping law and its derivatives as numbers."""

    law: DampingLaw
    material: Material
    values: Array  # (k,): values of the constants of the material, then of the law

    @cached_property
    def _function(self) -> ca.Function:
        """Function of F (9,) and Ḟ (9,) at the values of the constants: P_v, the stated ∂P_v/∂F
        (the automatic one if the law states none), and the automatic ∂P_v/∂F and ∂P_v/∂Ḟ.
        """
        F = ca.SX.sym("F", 9)
        rate = ca.SX.sym("rate", 9)
        count = len(self.material.constants)
        constants = [ca.SX(ca.DM(each)) for each in np.split(self.values, [count])]
        stress, stated = damping_stress(self.law, self.material, symbols=[F, rate, *constants])
        by_F = ca.jacobian(stress, F)
        by_rate = ca.jacobian(stress, rate)
        outputs = [stress, by_F if stated is None else stated, by_F, by_rate]
        return ca.Function("damping", [F, rate], [ca.densify(each) for each in outputs])

    def evaluate(self, F: Array, rate: Array) -> DampingState:
        """Return stress and derivatives at F (9,) and its rate Ḟ (9,) [1/s], column after
        column.
        """
        outputs = [o.full() for o in self._function.call([F, rate])]
        return DampingState(
            stress=outputs[0].ravel(), stated_by_F=outputs[1], by_F=outputs[2], by_rate=outputs[3]
        )


def _check_evaluation(check: PropertyCheck, law: DampingLaw, material: Material) -> None:
    """Require that the functions of the law can be evaluated, with results of the right shapes."""
    constants = (*material.constants, *law.constants)
    try:
        viscous_stress(
            law,
            material,
            F=ca.SX.sym("F", 9),
            rate=ca.SX.sym("rate", 9),
            theta=ca.SX.sym("theta", len(constants)),
        )
    except InputError as error:
        raise AssertionError(f"{check.subject}: {error}") from error


def _check_derivatives(
    check: PropertyCheck, stress: DampingStress, F: Array, rate: Array, where: str
) -> None:
    """Require at one deformation a P_v that is linear in the rate, a symmetric ∂P_v/∂Ḟ, and a
    stated ∂P_v/∂F that agrees with the automatic one and with central differences.
    """
    state = stress.evaluate(F, rate)
    by_rate = state.by_rate
    check.require_equal(by_rate, by_rate.T, statement=f"∂P_v/∂Ḟ is not symmetric {where}")
    check.require_equal(
        state.stress, by_rate @ rate, statement=f"P_v is not linear in the rate Ḟ {where}"
    )
    check.require_equal(
        stress.evaluate(F, -2.5 * rate).stress,
        -2.5 * state.stress,
        statement=f"P_v is not linear in the rate Ḟ {where}",
    )
    check.require_equal(
        state.stated_by_F,
        state.by_F,
        statement=f"the stated ∂P_v/∂F is not the automatic derivative of P_v {where}",
    )
    check.require_derivative(
        lambda at: stress.evaluate(at, rate).stress,
        state.stated_by_F,
        point=F,
        statement=f"∂P_v/∂F is wrong {where}",
        scale=0.1,
    )


def _check_dissipation(check: PropertyCheck, stress: DampingStress, F: Array, where: str) -> None:
    """Require ∂P_v/∂Ḟ at F (9,) without negative eigenvalue, up to rounding."""
    by_rate = stress.evaluate(F, np.zeros(9)).by_rate
    powers = np.linalg.eigvalsh((by_rate + by_rate.T) / 2)
    if not powers[0] >= -ROUNDING * np.abs(powers).max():
        check.fail(
            f"it adds energy {where}: the smallest dissipated power P_v:Ḟ of a rate with "
            "‖Ḟ‖ = 1/s is negative",
            powers[0],
            expected="at least 0 W/m³",
        )


def _check_objectivity(
    check: PropertyCheck, stress: DampingStress, F: Array, rate: Array, where: str
) -> None:
    """Require P_v(QF, Q(Ḟ + ΩF)) = Q P_v(F, Ḟ) for a random Q and Ω."""
    value = stress.evaluate(F, rate).stress
    Q = random_rotation(check.rng)
    spin = np.asarray(ca.skew(3 * check.rng.standard_normal(3)), dtype=float)
    gradient, gradient_rate = (each.reshape(3, 3, order="F") for each in (F, rate))
    spinning = Q @ (gradient_rate + spin @ gradient)
    rotated = stress.evaluate((Q @ gradient).ravel(order="F"), spinning.ravel(order="F")).stress
    check.require_equal(
        rotated.reshape(3, 3, order="F"),
        Q @ value.reshape(3, 3, order="F"),
        statement=f"a spinning rotation changes the stress in the body's axes {where}",
        tolerance=1e-8,
    )
