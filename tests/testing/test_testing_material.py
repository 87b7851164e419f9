"""`check_material`: every material passes, and each fault is one sentence."""

from __future__ import annotations

import casadi as ca
import pytest
from kit.internal_force_check import check_compiled_forces
from kit.materials import COMPILED, CONSTANTS, ELASTIC
from kit.problems import uneven_box
from kit.program_derivatives import require_derivatives

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.elements import ELEMENTS
from collocation_sysid.fem.laws.materials import MATERIALS, Material
from collocation_sysid.testing import check_material
from collocation_sysid.testing.property_check import PropertyCheck
from collocation_sysid.testing.small_problems import DENSITY_KG_M3, program_of, swung_experiment

# Materials with elements: each kind of energy with linear elements, each element with one material.
CASES = [(name, "tet4") for name in COMPILED] + [("neo-hookean", name) for name in ELEMENTS]
CASES += [("gent", "tet10-p0"), ("yeoh", "tet10")]
# Laws with other numbers of terms: the compiled forces contain no more than their energy.
OTHERS = [name for name in MATERIALS if name not in COMPILED]
# Exponents of which a term vanishes. The energy of foam with α = 0 is exact to 1e-6 without the
# chain rule; `test_ogden` compares the chain rule with its closed form.
LIMITS = [("ogden-2", {"alpha_2": 0.0}), ("hyperfoam-1", {"beta_1": 0.0})]


@pytest.mark.parametrize(("name", "element"), dict.fromkeys(CASES))
def test_every_material_passes(name: str, element: str):
    constants = CONSTANTS.get(name, ELASTIC)
    check_material(name, constants=constants, is_objective=name != "linear")
    check_compiled_forces(name, element, constants=constants, is_objective=name != "linear")


@pytest.mark.parametrize("name", OTHERS)
def test_every_number_of_terms_passes(name: str):
    check_material(name, constants=CONSTANTS[name])


@pytest.mark.parametrize(("name", "limit"), LIMITS)
def test_limits_of_exponents_pass(name: str, limit: dict):
    check_material(name, constants=CONSTANTS[name] | limit)


@pytest.mark.parametrize(
    "name",
    ["neo-hookean", *(pytest.param(n, marks=pytest.mark.long) for n in ("ogden-1", "hyperfoam-1"))],
)
def test_programs_of_a_material_with_memory_pass(name: str):
    constants = CONSTANTS.get(name, ELASTIC)
    body = Body(uneven_box(1), name, density_kg_m3=DENSITY_KG_M3, prony=["prony_1"])
    require_derivatives(PropertyCheck(name), program_of(swung_experiment(body), constants))


def test_the_message_of_a_principal_stretch_that_is_not_smooth():
    """The difference of two stretches has a kink where they coincide."""

    def kinked(F, mu_pa):
        strain = (F.T @ F - ca.SX.eye(3)) / 2
        difference = F[0, 0] ** 2 - F[1, 1] ** 2
        return mu_pa * (ca.sumsqr(strain) + ca.trace(strain) ** 2 * (1 + ca.fabs(difference)))

    with pytest.raises(AssertionError, match=r"∂P/∂F is wrong at a uniaxial stretch of 1\.2, by"):
        check_material(Material.from_energy(kinked), is_objective=False)


def resists_rotation(F, mu_pa):
    return mu_pa * (ca.sumsqr((F + F.T) / 2 - ca.SX.eye(3)))


def falls_under_shear(F, lambda_pa, mu_pa):
    strain = (F.T @ F - ca.SX.eye(3)) / 2
    return lambda_pa / 2 * ca.trace(strain) ** 2 - mu_pa * ca.sumsqr(strain) / 10


def limited(F, mu_pa, limit):
    strain = (F.T @ F - ca.SX.eye(3)) / 2
    return -mu_pa * limit * ca.log(ca.sqrt(1 - ca.sumsqr(strain) / limit))


class Stiffened(Material):
    """A material that programs evaluate with another energy than its function."""

    def psi(self, F, values):
        return 1.01 * super().psi(F, values)


@pytest.mark.parametrize(
    ("energy", "options", "sentence"),
    [
        (resists_rotation, {}, r"'resists-rotation': a rotation changes the energy at random def"),
        (falls_under_shear, {}, r"does not resist every strain; found -.*, expected above 0 Pa"),
        (limited, {"constants": {"limit": 0.01}}, r"the energy is not finite .* smaller largest_"),
    ],
)
def test_a_fault_is_one_sentence(energy, options: dict, sentence: str):
    with pytest.raises(AssertionError, match=sentence):
        check_material(Material.from_energy(energy), **options)


def test_another_energy_in_programs_than_in_the_function_fails():
    with pytest.raises(AssertionError, match="'rubber': the energy differs from its function at r"):
        check_material(Stiffened.from_energy(rubber))


def test_a_limit_that_is_not_reached_is_no_fault():
    check_material(limited, constants={"limit": 5.0})


def rubber(F, mu_pa):
    strain = (F.T @ F - ca.SX.eye(3)) / 2
    return mu_pa * (ca.sumsqr(strain) + ca.trace(strain) ** 2)
