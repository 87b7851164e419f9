"""Element fields compared with values computed by hand."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.result.element_fields import FIELD_NAMES, ElementFields

LAMBDA_PA, MU_PA = 200.0, 300.0
BOTH = pytest.mark.parametrize("element", ["tet4", "tet10"])
TURN = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()


@cache
def bar(element: str = "tet4", material: str = "neo-hookean", evaluator: str = "auto") -> Body:
    mesh = box_mesh((0.2, 0.1, 0.1), (2, 1, 1))
    return Body(mesh, material, density_kg_m3=30.0, element=element, evaluator=evaluator)


@cache
def fields_of(body: Body) -> ElementFields:
    return ElementFields.from_body(body, np.array([LAMBDA_PA, MU_PA, 0.0, 0.0]))


def deformed(body: Body, gradient) -> dict[str, np.ndarray]:
    """Fields, (E,) each, of a body whose deformation gradient is the same everywhere."""
    found = fields_of(body).evaluate_at(body.nodes_m @ np.transpose(gradient))
    assert tuple(found) == FIELD_NAMES
    return {name: values[0] for name, values in found.items()}


@BOTH
@pytest.mark.parametrize("material", ["neo-hookean", "mooney-rivlin", "st-venant-kirchhoff"])
def test_rigid_motion_is_not_felt(element, material):
    found = deformed(bar(element, material), TURN)
    np.testing.assert_allclose(found["det_f"], 1.0)
    np.testing.assert_allclose(found["energy_density_j_m3"], 0.0, atol=1e-12 * MU_PA)
    np.testing.assert_allclose(found["von_mises_pa"], 0.0, atol=1e-7 * MU_PA)


@BOTH
@pytest.mark.parametrize("stretch", [0.8, 1.3])
def test_uniform_stretch_of_a_neo_hookean_body(element, stretch):
    """F = diag(s, 1, 1): σ = [μ (F Fᵀ − I) + λ ln J · I] / J, so von Mises is μ |s² − 1| / s."""
    found = deformed(bar(element), TURN @ np.diag([stretch, 1.0, 1.0]))
    log_j = np.log(stretch)
    energy = 0.5 * LAMBDA_PA * log_j**2 - MU_PA * log_j + 0.5 * MU_PA * (stretch**2 - 1)
    np.testing.assert_allclose(found["det_f"], stretch)
    np.testing.assert_allclose(found["energy_density_j_m3"], energy)
    np.testing.assert_allclose(found["von_mises_pa"], MU_PA * abs(stretch**2 - 1) / stretch)


@BOTH
def test_swelling_has_energy_but_no_von_mises_stress(element):
    found = deformed(bar(element), 1.1 * TURN)
    np.testing.assert_allclose(found["von_mises_pa"], 0.0, atol=1e-7 * MU_PA)
    assert (found["energy_density_j_m3"] > 1.0).all()


def test_small_shear_has_the_stress_of_linear_elasticity():
    shear = 1e-5
    found = deformed(bar(material="linear"), [[1.0, shear, 0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_allclose(found["von_mises_pa"], np.sqrt(3) * MU_PA * shear, rtol=1e-4)
    np.testing.assert_allclose(found["energy_density_j_m3"], 0.5 * MU_PA * shear**2, rtol=1e-4)


@BOTH
def test_energy_densities_add_up_to_the_energy(element):
    body = bar(element)
    bent = body.nodes_m + 0.5 * body.nodes_m[:, :1] ** 2 * [0.0, 0.0, 1.0]
    densities = fields_of(body).evaluate_at(bent)["energy_density_j_m3"][0]
    total = body.energy(bent, lambda_pa=LAMBDA_PA, mu_pa=MU_PA)
    assert densities @ body.mesh.volumes_m3 == pytest.approx(total)


@BOTH
def test_both_evaluators_agree_over_several_states(element, rng):
    simd, casadi = bar(element), bar(element, evaluator="casadi")
    states = simd.nodes_m + 0.004 * rng.normal(size=(3, *simd.nodes_m.shape))
    found = [fields_of(body).evaluate_at(states) for body in (simd, casadi)]
    for name in FIELD_NAMES:
        assert found[0][name].shape == (3, len(simd.cells))
        np.testing.assert_allclose(found[0][name], found[1][name], rtol=1e-9)


def test_inverted_elements_have_a_negative_volume_and_no_energy():
    found = deformed(bar(), np.diag([-0.5, 1.0, 1.0]))
    np.testing.assert_allclose(found["det_f"], -0.5)
    assert np.isnan(found["energy_density_j_m3"]).all()
