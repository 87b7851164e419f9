"""`check_damping`: every damping law passes, and each fault is one sentence."""

from __future__ import annotations

import casadi as ca
import pytest
from kit.internal_force_check import check_compiled_forces, check_internal_forces
from kit.materials import CONSTANTS, ELASTIC

from collocation_sysid.fem.laws.constants import GAMMA_R, Constant
from collocation_sysid.fem.laws.materials import DAMPINGS, MATERIALS, DampingLaw, material_form
from collocation_sysid.testing import check_damping
from collocation_sysid.testing.property_check import PropertyCheck

# Every law with linear and averaging elements, and with a linear material, which does not
# distinguish the shapes. Rayleigh's law contains more of the energy than its stiffness at rest;
# `check_material` combines the default law with every material.
CASES = [(law, "neo-hookean", element) for law in DAMPINGS for element in ("tet4", "tet10-p0")]
CASES += [("kelvin-voigt", "neo-hookean", "tet10")]
CASES += [(law, "linear", "tet4") for law in DAMPINGS]
CASES += [("rayleigh", name, "tet4") for name in ("gent", "yeoh", "st-venant-kirchhoff")]
# Energies that are differentiated by the chain rule.
CASES += [(law, name, "tet4") for law in DAMPINGS for name in ("ogden-2", "hyperfoam-1")]
AVERAGED = [(law, "ogden-2", "tet10-p0") for law in ("kelvin-voigt", "rayleigh")]
CASES += [pytest.param(*each, marks=pytest.mark.long) for each in AVERAGED]


@pytest.mark.long
@pytest.mark.parametrize(("law", "material", "element"), CASES)
def test_every_law_passes(law: str, material: str, element: str):
    properties = {
        "constants": CONSTANTS.get(material, ELASTIC),
        "is_objective": law != "rayleigh" and material != "linear",
        "is_dissipative": law != "rayleigh",
    }
    largest_strain = 0.2 if law == "rayleigh" else 0.5
    check_damping(law, material=material, largest_strain=largest_strain, **properties)
    check_compiled_forces(material, element, law, **properties)


@pytest.mark.parametrize("law", ["kelvin-voigt", "material"])
def test_objective_laws_take_energy_out_at_large_strain(law: str):
    check_damping(law, largest_strain=1.5)


def test_rayleighs_law_is_neither_objective_nor_dissipative():
    with pytest.raises(AssertionError, match="'rayleigh': a spinning rotation changes the stress"):
        check_damping("rayleigh", is_dissipative=False)
    with pytest.raises(AssertionError, match=r"'rayleigh': it adds energy .*expected at least 0 W"):
        check_damping("rayleigh", is_objective=False)


def wrong_sign(psi, F, rate, gamma_r_s):
    stress, slope = material_form(psi, F, rate, gamma_r_s)
    return stress, -slope


def negative(psi, F, rate, gamma_r_s):
    stress, slope = material_form(psi, F, rate, gamma_r_s)
    return -stress, -slope


def quadratic(psi, F, rate, gamma_r_s):
    stress, slope = material_form(psi, F, rate, gamma_r_s)
    size = 1 + ca.sumsqr(rate)
    return size * stress, size * slope


def gyroscopic(psi, F, rate, gamma_r_s):
    spin = ca.kron(ca.SX.eye(3), ca.skew(ca.SX([1.0, 2.0, 3.0])))
    return gamma_r_s * spin @ rate, ca.SX(9, 9)


def curved_potential(psi, F, rate, gamma_r_s):
    return gamma_r_s * ca.jtimes(psi, F, rate) ** 2


@pytest.mark.parametrize(
    ("law", "sentence"),
    [
        ({"stress": wrong_sign}, r"the stated ∂P_v/∂F is not the automatic derivative .* entry \("),
        ({"stress": negative}, r"it adds energy at random deformation 0 .*; found -.*, expected"),
        ({"stress": quadratic}, "P_v is not linear in the rate|∂P_v/∂Ḟ is not symmetric"),
        ({"stress": gyroscopic}, "∂P_v/∂Ḟ is not symmetric at random deformation 0"),
        ({"potential": curved_potential}, "P_v is not linear in the rate|∂P_v/∂Ḟ is not symmetric"),
        (
            {"stress": negative, "potential": curved_potential},
            "it has both a stress and a potential",
        ),
        (
            {"stress": lambda psi, F, rate, gamma_r_s: gamma_r_s * rate},
            "the stress of .* returns 1 expressions .* expected two",
        ),
        (
            {"stress": lambda psi, F, rate, gamma: (rate, ca.SX(9, 9))},
            "the stress of .* cannot be evaluated .*'gamma_r_s'",
        ),
    ],
)
def test_a_fault_is_one_sentence(law: dict, sentence: str):
    with pytest.raises(AssertionError, match=f"damping law 'mine': ({sentence})"):
        check_damping(DampingLaw("mine", (GAMMA_R,), **law))


def test_compiled_forces_that_differ_from_the_plain_formula_fail():
    law = DampingLaw("mine", (GAMMA_R,), stress=wrong_sign)
    check = PropertyCheck("damping law 'mine'")
    sentence = "compiled first derivative of the force of tet4 elements differs from the plain"
    with pytest.raises(AssertionError, match=sentence):
        check_internal_forces(check, MATERIALS["stable-neo-hookean"], law, {}, "tet4")


def test_constants_of_an_own_law_have_stated_values():
    """A law with a viscosity of its own, which no stiffness scales."""
    viscosity = Constant("viscosity_pa_s", "η")

    def newtonian(psi, F, rate, viscosity_pa_s):
        inverse = ca.inv_minor(ca.reshape(F, 3, 3))
        L = ca.reshape(rate, 3, 3) @ inverse
        stress = ca.vec(viscosity_pa_s * (L + L.T) @ inverse.T)
        return stress, ca.jacobian(stress, F)

    law = DampingLaw("newtonian", (viscosity,), stress=newtonian)
    check_damping(law, constants={"viscosity_pa_s": 2.0})
