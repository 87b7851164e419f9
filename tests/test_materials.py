from __future__ import annotations

from itertools import product

import casadi as ca
import numpy as np
import pytest
from checks import assert_derivative, relative_error
from materials_small import LAME, elastic
from scipy.spatial.transform import Rotation

from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.materials import MATERIALS, material_named

ROTATION_INVARIANT = [name for name in MATERIALS if name != "linear"]


class Law:
    """Energy density, stress and tangent of a material, as numbers; F is stacked by columns."""

    def __init__(self, name: str) -> None:
        F = ca.SX.sym("F", 3, 3)
        psi = MATERIALS[name](F, ca.SX(LAME[0]), ca.SX(LAME[1]))
        tangent, stress = ca.hessian(psi, ca.vec(F))
        self._function = ca.Function("law", [F], [psi, stress, tangent])

    def at(self, F: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        psi, stress, tangent = self._function.call([F])
        return float(psi), stress.full().ravel(), tangent.full()


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


def test_undeformed_material_stores_no_energy_and_has_no_stress(law):
    psi, stress, _ = law.at(np.eye(3))
    assert psi == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(stress, 0.0, atol=1e-12)


def test_small_strain_limit_is_linear_elasticity_with_the_same_lame_parameters(law):
    np.testing.assert_allclose(law.at(np.eye(3))[2], linear_elasticity(), atol=1e-10)


def test_undeformed_material_resists_every_strain_and_only_strain(law):
    stiffness = np.linalg.eigvalsh(law.at(np.eye(3))[2])
    lam, mu = LAME
    turning, shear, bulk = [0.0] * 3, [2 * mu] * 5, [3 * lam + 2 * mu]
    np.testing.assert_allclose(stiffness, turning + shear + bulk, atol=1e-9)


def test_energy_is_positive_when_deformed(law, rng):
    assert all(law.at(F)[0] > 0 for F in deformations(rng))


@pytest.mark.parametrize("name", ROTATION_INVARIANT)
def test_rotation_changes_neither_energy_nor_stress_in_the_body_frame(name, rng):
    law = Law(name)
    rotations = Rotation.from_quat(rng.standard_normal((5, 4))).as_matrix()
    for F, R in zip(deformations(rng), rotations, strict=True):
        psi, stress, _ = law.at(F)
        turned_psi, turned_stress, _ = law.at(R @ F)
        assert turned_psi == pytest.approx(psi, rel=1e-12)
        # Columns of the first Piola–Kirchhoff stress turn along.
        expected = R @ stress.reshape(3, 3, order="F")
        assert relative_error(turned_stress.reshape(3, 3, order="F"), expected) < 1e-12


def test_neo_hookean_agrees_with_the_stress_written_by_hand(rng):
    lam, mu = LAME
    for F in deformations(rng):
        inverse_transposed = np.linalg.inv(F).T
        expected = mu * (F - inverse_transposed)
        expected += lam * np.log(np.linalg.det(F)) * inverse_transposed
        found = Law("neo-hookean").at(F)[1].reshape(3, 3, order="F")
        assert relative_error(found, expected) < 1e-12


def test_stable_neo_hookean_is_finite_where_an_element_is_inverted():
    psi, stress, tangent = Law("stable-neo-hookean").at(np.diag([-0.5, 1.0, 1.0]))
    assert psi > 0
    assert np.isfinite(stress).all()
    assert np.isfinite(tangent).all()


@pytest.mark.parametrize("evaluator", ["simd", "casadi"])
def test_energy_written_by_the_user_works(small_mesh, evaluator, rng):
    def stiffening(F, lambda_pa, mu_pa):
        log_j = ca.log(ca.det(F))
        strain = ca.sumsqr(F) - 3 - 2 * log_j
        return 0.5 * lambda_pa * log_j**2 + 0.25 * mu_pa * (ca.exp(2 * strain) - 1)

    body = Body(small_mesh, stiffening, density_kg_m3=30.0, evaluator=evaluator)
    x = small_mesh.points_m + rng.uniform(-0.003, 0.003, small_mesh.points_m.shape)
    assert_derivative(
        lambda x: body.energy(x, **elastic(body)),
        lambda dx: -np.sum(body.elastic_force(x, **elastic(body)) * dx),
        x,
        rng,
        scale=0.01,
    )
    # The same small-strain limit as the materials of the table.
    table = Body(small_mesh, "neo-hookean", density_kg_m3=30.0, evaluator=evaluator)
    stiffness, expected = (b.stiffness(small_mesh.points_m, **elastic(b)) for b in (body, table))
    assert relative_error(stiffness.toarray(), expected.toarray()) < 1e-12


def test_unknown_material_is_refused_with_the_names_there_are():
    with pytest.raises(InputError, match="no material 'rubber'; available: neo-hookean, "):
        material_named("rubber")
