"""Energies and stresses of materials: derivatives, limits and closed forms."""

from __future__ import annotations

from itertools import product

import casadi as ca
import numpy as np
import pytest
from kit.checks import relative_error
from kit.internal_force_check import check_compiled_forces
from kit.materials import CONSTANTS, ELASTIC, ISOCHORIC, KAPPA_PA, LAME, elastic
from scipy.spatial.transform import Rotation

from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.constants import Constant
from collocation_sysid.fem.laws.materials import (
    MATERIALS,
    Material,
    as_material,
    linear_elastic,
    neo_hookean,
)
from collocation_sysid.testing import check_material

# Laws in λ and μ.
ELASTIC_LAWS = [name for name in MATERIALS if name not in CONSTANTS]
ROTATION_INVARIANT = [name for name in MATERIALS if name != "linear"]


class Law:
    """Energy density, stress and tangent of a material, as numbers; F is stacked by columns."""

    def __init__(self, name: str, **changes: float) -> None:
        self.constants = {**CONSTANTS.get(name, ELASTIC), **changes}
        F = ca.SX.sym("F", 3, 3)
        psi = MATERIALS[name].psi(F, ca.SX(ca.DM([*self.constants.values()])))
        tangent, stress = ca.hessian(psi, ca.vec(F))
        self._function = ca.Function("law", [F], [psi, stress, tangent])

    def at(self, F: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        psi, stress, tangent = self._function.call([F])
        return float(psi), stress.full().ravel(), tangent.full()

    def cauchy_stress(self, F: np.ndarray) -> np.ndarray:
        """P Fᵀ / J."""
        return self.at(F)[1].reshape(3, 3, order="F") @ F.T / np.linalg.det(F)


@pytest.fixture(params=MATERIALS)
def law(request) -> Law:
    return Law(request.param)


def linear_elasticity() -> np.ndarray:
    """C_ijkl = λ δ_ij δ_kl + μ (δ_ik δ_jl + δ_il δ_jk), (9, 9) with columns stacked."""
    one, (lam, mu) = np.eye(3), LAME
    C = np.zeros((3, 3, 3, 3))
    for i, j, k, l in product(range(3), repeat=4):
        C[i, j, k, l] = lam * one[i, j] * one[k, l]
        C[i, j, k, l] += mu * (one[i, k] * one[j, l] + one[i, l] * one[j, k])
    return C.transpose(1, 0, 3, 2).reshape(9, 9)


def deformations(rng: np.random.Generator, count: int = 5) -> np.ndarray:
    return np.eye(3) + rng.uniform(-0.2, 0.2, (count, 3, 3))


# Every material -------------------------------------------------------------------------------


def test_small_strain_limit_is_linear_elasticity_with_the_same_lame_parameters(law):
    np.testing.assert_allclose(law.at(np.eye(3))[2], linear_elasticity(), atol=1e-10)


@pytest.mark.parametrize("name", MATERIALS)
def test_lame_parameters_follow_from_the_constants(name):
    constants = CONSTANTS.get(name, ELASTIC)
    found = MATERIALS[name].lame([*constants.values()])
    # Powers of the stretches are sums over nodes, with an error of the order of 1e-12.
    tolerance = 1e-13 if name in (*ISOCHORIC, *ELASTIC_LAWS) else 1e-11
    np.testing.assert_allclose(found.full().ravel(), LAME, rtol=tolerance)


def test_undeformed_material_resists_every_strain_and_only_strain(law):
    stiffness = np.linalg.eigvalsh(law.at(np.eye(3))[2])
    lam, mu = LAME
    turning, shear, bulk = [0.0] * 3, [2 * mu] * 5, [3 * lam + 2 * mu]
    np.testing.assert_allclose(stiffness, turning + shear + bulk, atol=1e-9)


def test_energy_is_positive_when_deformed(law, rng):
    assert all(law.at(F)[0] > 0 for F in deformations(rng))


@pytest.mark.parametrize("name", ROTATION_INVARIANT)
def test_every_material_is_isotropic(name, rng):
    law = Law(name)
    rotations = Rotation.from_quat(rng.standard_normal((5, 4))).as_matrix()
    for F, R in zip(deformations(rng), rotations, strict=True):
        assert law.at(F @ R)[0] == pytest.approx(law.at(F)[0], rel=1e-11)


# Against stresses written by hand ---------------------------------------------------------------


def test_neo_hookean_agrees_with_the_stress_written_by_hand(rng):
    lam, mu = LAME
    for F in deformations(rng):
        inverse_transposed = np.linalg.inv(F).T
        expected = mu * (F - inverse_transposed)
        expected += lam * np.log(np.linalg.det(F)) * inverse_transposed
        found = Law("neo-hookean").at(F)[1].reshape(3, 3, order="F")
        assert relative_error(found, expected) < 1e-12


def slopes_by_invariants(name: str, first: float) -> tuple[float, float]:
    """∂ψ/∂Ī₁ and ∂ψ/∂Ī₂ as the literature has them."""
    c = CONSTANTS[name]
    past = first - 3
    if name == "mooney-rivlin":
        return c["c10_pa"], c["c01_pa"]
    if name == "yeoh":
        return c["c10_pa"] + 2 * c["c20_pa"] * past + 3 * c["c30_pa"] * past**2, 0.0
    if name == "gent":
        return 0.5 * c["mu_pa"] * c["gent_limit"] / (c["gent_limit"] - past), 0.0
    # Arruda & Boyce: C Σ i α_i Ī₁^(i−1) / λ_m^(2i−2), and 2 ∂ψ/∂Ī₁ at rest is μ.
    n = c["chain_stretch"] ** 2

    def series(i1: float) -> float:
        return (
            1 / 2
            + i1 / (10 * n)
            + 11 * i1**2 / (350 * n**2)
            + 19 * i1**3 / (1750 * n**3)
            + 519 * i1**4 / (134750 * n**4)
        )

    return 0.5 * c["mu_pa"] * series(first) / series(3.0), 0.0


@pytest.mark.parametrize("stretch", [0.7, 1.2, 1.6])
@pytest.mark.parametrize("name", ISOCHORIC)
def test_uniaxial_stretch_at_constant_volume(name, stretch):
    """σ₁₁ − σ₂₂ = 2 (λ² − 1/λ) (ψ₁ + ψ₂ / λ), whatever the pressure."""
    first = stretch**2 + 2 / stretch
    by_first, by_second = slopes_by_invariants(name, first)
    expected = 2 * (stretch**2 - 1 / stretch) * (by_first + by_second / stretch)
    stress = Law(name).cauchy_stress(np.diag([stretch, stretch**-0.5, stretch**-0.5]))
    assert stress[0, 0] - stress[1, 1] == pytest.approx(expected, rel=1e-12)
    assert np.trace(stress) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("shear", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("name", ISOCHORIC)
def test_simple_shear(name, shear):
    """σ₁₂ = 2 (ψ₁ + ψ₂) γ, and the normal stresses differ by 2 ψ₁ γ² and 2 ψ₂ γ²."""
    F = np.eye(3)
    F[0, 1] = shear
    by_first, by_second = slopes_by_invariants(name, 3 + shear**2)
    stress = Law(name).cauchy_stress(F)
    assert stress[0, 1] == pytest.approx(2 * (by_first + by_second) * shear, rel=1e-12)
    assert stress[0, 0] - stress[2, 2] == pytest.approx(2 * by_first * shear**2, rel=1e-12)
    found = stress[2, 2] - stress[1, 1]
    assert found == pytest.approx(2 * by_second * shear**2, rel=1e-12, abs=1e-10)


@pytest.mark.parametrize("name", ISOCHORIC)
def test_a_change_of_volume_alone_meets_the_bulk_modulus(name):
    stress = Law(name).cauchy_stress(1.1 * np.eye(3))
    np.testing.assert_allclose(stress, KAPPA_PA * (1.1**3 - 1) * np.eye(3), atol=1e-9)


def test_chains_of_any_length_tend_to_neo_hookean():
    F = np.diag([1.5, 1.5**-0.5, 1.5**-0.5])
    expected = Law("mooney-rivlin", c10_pa=150.0, c01_pa=0.0).at(F)[1]
    assert relative_error(Law("gent", gent_limit=1e9).at(F)[1], expected) < 1e-8
    assert relative_error(Law("arruda-boyce", chain_stretch=1e5).at(F)[1], expected) < 1e-8
    assert relative_error(Law("yeoh", c20_pa=0.0, c30_pa=0.0).at(F)[1], expected) < 1e-12


def test_gents_material_stiffens_towards_its_limit():
    gent = Law("gent", gent_limit=1.0)
    stretches = np.array([1.2, 1.5, 1.65])  # Ī₁ − 3 is 1 at a stretch of 1.675
    stresses = [gent.cauchy_stress(np.diag([s, s**-0.5, s**-0.5]))[0, 0] for s in stretches]
    stiffening = stresses / (stretches**2 - 1 / stretches)
    assert stiffening[2] > 5 * stiffening[1] > 5 * stiffening[0]


def test_stable_neo_hookean_is_finite_where_an_element_is_inverted():
    psi, stress, tangent = Law("stable-neo-hookean").at(np.diag([-0.5, 1.0, 1.0]))
    assert psi > 0
    assert np.isfinite(stress).all()
    assert np.isfinite(tangent).all()


# Materials of the user --------------------------------------------------------------------------


def stiffening(F, lambda_pa, mu_pa):
    log_j = ca.log(ca.det(F))
    strain = ca.sumsqr(F) - 3 - 2 * log_j
    return 0.5 * lambda_pa * log_j**2 + 0.25 * mu_pa * (ca.exp(2 * strain) - 1)


@pytest.mark.long
def test_energy_written_by_the_user_passes_the_checks():
    check_material(stiffening)
    for element in ("tet4", "tet10-p0"):
        check_compiled_forces(stiffening, element)


@pytest.mark.parametrize("evaluator", ["simd", "casadi"])
def test_energy_written_by_the_user_has_the_small_strain_limit_of_the_table(small_mesh, evaluator):
    body = Body(small_mesh, stiffening, density_kg_m3=30.0, evaluator=evaluator)
    constants = elastic(body)
    table = Body(small_mesh, "neo-hookean", density_kg_m3=30.0, evaluator=evaluator)
    stiffness, expected = (b.stiffness(small_mesh.points_m, **constants) for b in (body, table))
    assert relative_error(stiffness.toarray(), expected.toarray()) < 1e-12


def test_constants_of_a_users_material_are_the_functions_arguments(small_mesh):
    def fung(F, mu_pa, growth, kappa_pa):
        J = ca.det(F)
        strain = ca.sumsqr(F) * J ** (-2 / 3) - 3
        return 0.5 * mu_pa / growth * (ca.exp(growth * strain) - 1) + 0.5 * kappa_pa * (J - 1) ** 2

    growth = Constant("growth", "b", bounds=(0.01, 10.0))
    material = Material.from_energy(fung, "", growth)
    assert material.name == "fung"
    assert [c.name for c in material.constants] == ["mu_pa", "growth", "kappa_pa"]
    assert [c.symbol for c in material.constants] == ["μ", "b", "κ"]
    assert material.constants[1] is growth
    body = Body(small_mesh, material, density_kg_m3=30.0)
    assert [*body.constants] == ["mu_pa", "growth", "kappa_pa", "gamma_r_s", "gamma_m_1_s"]
    np.testing.assert_allclose(material.lame([300.0, 2.0, KAPPA_PA]).full().ravel(), LAME)


def test_a_name_is_given_or_that_of_the_function():
    assert Material.from_energy(linear_elastic).name == "linear-elastic"
    assert Material.from_energy(neo_hookean, "gel").name == "gel"


def with_energy_at_rest(F, mu_pa):
    return 0.5 * mu_pa * ca.sumsqr(F)


def with_stress_at_rest(F, mu_pa):
    return 0.5 * mu_pa * (ca.sumsqr(F) - 3)


def without_constants(F):
    return ca.sumsqr(F.T @ F - ca.SX.eye(3))


def not_finite_at_rest(F, mu_pa):
    return mu_pa * ca.log(ca.det(F) - 1)


def not_casadi(F, mu_pa):
    return mu_pa * np.linalg.det(np.asarray(F, dtype=float))


@pytest.mark.parametrize(
    ("energy", "message"),
    [
        (
            with_energy_at_rest,
            "'with-energy-at-rest' has the energy .* J/m³ in the undeformed state, .*mu_pa =",
        ),
        (with_stress_at_rest, "'with-stress-at-rest' has the stress .* Pa in the undeformed state"),
        (without_constants, "'without-constants' has no constants; expected a function"),
        (not_finite_at_rest, "'not-finite-at-rest' has the energy .* in the undeformed state"),
        (not_casadi, "'not-casadi' cannot be evaluated"),
    ],
)
def test_unusable_energies_are_refused(energy, message):
    with pytest.raises(InputError, match=message):
        as_material(energy)


def test_a_constant_told_but_not_used_is_refused_with_the_nearest():
    with pytest.raises(InputError, match=r"constant 'mu_p'; .*; did you mean 'mu_pa'"):
        Material.from_energy(stiffening, "stiffening", Constant("mu_p"))


def test_a_material_is_itself_and_names_are_looked_up():
    assert as_material(MATERIALS["gent"]) is MATERIALS["gent"]
    assert as_material("gent") is MATERIALS["gent"]


def test_unknown_material_is_refused_with_the_known_names():
    with pytest.raises(InputError, match="no material 'rubber'; available: neo-hookean, "):
        as_material("rubber")
    with pytest.raises(InputError, match="did you mean 'mooney-rivlin'"):
        as_material("moony-rivlin")


def test_beyond_its_limit_gents_material_has_neither_energy_nor_stress():
    F = ca.SX.sym("F", 3, 3)
    psi = MATERIALS["gent"].psi(F, ca.SX([300.0, 8.0, 400.0]))
    law = ca.Function("law", [F], [psi, ca.gradient(psi, ca.vec(F))])
    inside, outside = (law(np.diag([s, s**-0.5, s**-0.5])) for s in (2.5, 3.5))
    assert all(np.isfinite(value.full()).all() for value in inside)
    assert all(np.isnan(value.full()).any() for value in outside)
