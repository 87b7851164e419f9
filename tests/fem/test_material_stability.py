"""Drucker's criterion: known limits of stability, and warnings."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from kit.materials import CONSTANTS, ELASTIC
from kit.problems import hung_cube

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.materials import MATERIALS, Material, as_material, neo_hookean
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.statistics.stability_concerns import (
    is_examined,
    principal_stretches,
    rest_stability_concerns,
    stability_margins,
    strain_stability_concerns,
)

EXAMINED = [name for name, material in MATERIALS.items() if is_examined(material)]


def margin(name: str, constants: dict[str, float], *stretches: float) -> float:
    material = MATERIALS[name]
    values = np.array([constants[c.name] for c in material.constants])
    return float(stability_margins(material, values, np.array([stretches]))[0])


@pytest.mark.parametrize("name", EXAMINED)
def test_at_rest_the_margin_is_the_smaller_of_both_moduli(name):
    """The eigenvalues of ∂²ψ/∂ε∂ε are 2μ, twice, and 3κ."""
    constants = CONSTANTS.get(name, ELASTIC)
    assert margin(name, constants, 1.0, 1.0, 1.0) == pytest.approx(600.0, rel=1e-9)


def test_st_venant_kirchhoff_softens_below_a_stretch_of_one_over_root_two():
    """With λ = 0 the Kirchhoff stress of a stretch s is μ s² (s² − 1), least at s² = ½."""
    stretch = np.sqrt(0.5)
    constants = {"lambda_pa": 0.0, "mu_pa": 300.0}
    assert margin("st-venant-kirchhoff", constants, stretch + 1e-6, 1.0, 1.0) > 0
    assert margin("st-venant-kirchhoff", constants, stretch - 1e-6, 1.0, 1.0) < 0


def test_foam_of_blatz_and_ko_softens_in_tension():
    """With β = 0 the Kirchhoff stress −2μ/2 (s^−2 − 1) of α = −2 never softens, but a term of α = 8
    and negative μ does: 2μ s^α α adds up to zero.
    """
    stable = {"mu_1_pa": 300.0, "alpha_1": -2.0, "beta_1": 0.0}
    assert margin("hyperfoam-1", stable, 3.0, 1.0, 1.0) > 0
    terms = {"mu_1_pa": 300.0, "alpha_1": 2.0, "beta_1": 0.0}
    terms |= {"mu_2_pa": -50.0, "alpha_2": 8.0, "beta_2": 0.0}
    # ∂τ/∂ε = 2 (300 s² − 50 s⁸) is zero at s⁶ = 6.
    limit = 6 ** (1 / 6)
    assert margin("hyperfoam-2", terms, limit * 0.999, 1.0, 1.0) > 0
    assert margin("hyperfoam-2", terms, limit * 1.001, 1.0, 1.0) < 0


def test_energies_without_a_value_give_nan():
    gent = {"mu_pa": 300.0, "gent_limit": 1.0, "kappa_pa": 400.0}
    assert np.isnan(margin("gent", gent, 3.0, 0.6, 0.6))


def test_linear_and_users_materials_are_not_examined():
    assert not is_examined(MATERIALS["linear"])
    assert not is_examined(Material.from_energy(neo_hookean, "mine"))
    assert is_examined(as_material("ogden-3"))


@pytest.mark.parametrize("element", ["tet4", "tet10", "tet10-p0"])
def test_stretches_of_a_homogeneous_deformation(element):
    body = Body(box_mesh((0.1, 0.1, 0.1), (1, 1, 1)), "ogden-1", 30.0, element)
    F = np.array([[1.2, 0.3, 0.0], [0.0, 0.9, 0.1], [0.0, 0.0, 1.1]])
    x = (body.nodes_m @ F.T).reshape(1, -1)
    theta = np.array([200.0, 3.0, 400.0, 0.0, 0.0])
    found = principal_stretches(body, x, theta)
    expected = np.sort(np.linalg.svd(F, compute_uv=False))
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=1e-12)


def stretched_cube(values: dict[str, float], stretch: float) -> SimpleNamespace:
    """A cube of two Ogden terms at an iterate in which it is stretched at half of the samples."""
    hung = hung_cube(10)
    body = Body(hung.body.mesh, "ogden-2", 30.0)
    experiment = replace(hung, body=body)
    collocation = Collocation([experiment], Parameters.from_mapping(values))
    (transcription,) = collocation.transcriptions
    count = int(transcription.markers.observable.rows.max()) + 1
    across = stretch**-0.5
    shapes = np.where(
        np.arange(count)[:, None, None] > count / 2,
        body.nodes_m * [stretch, across, across],
        body.nodes_m,
    )
    return SimpleNamespace(
        transcription=transcription,
        x=shapes.reshape(count, -1),
        equations=SimpleNamespace(dynamics=SimpleNamespace(theta=body.theta_from_values(values))),
    )


# The second term takes over in tension: 2 ∂τ/∂ε is 3 · 200 s³ − 0.1 · 12 s¹² for the axis.
UNSTABLE = {
    "mu_1_pa": 200.0,
    "alpha_1": 3.0,
    "mu_2_pa": -0.1,
    "alpha_2": 12.0,
    "kappa_pa": 400.0,
    "gamma_r_s": 0.009,
    "gamma_m_1_s": 1.0,
}


def test_an_unstable_material_is_named_with_time_and_stretches():
    (concern,) = strain_stability_concerns([stretched_cube(UNSTABLE, 2.2)])
    assert concern.code == "stability/material"
    assert concern.grade == "check"
    assert "ogden-2 is unstable at strains of" in concern.message
    assert "stretches 2.2, 0.674, 0.674" in concern.message
    assert concern.data["time_s"] > 0


@pytest.mark.parametrize(
    ("changes", "stretch"), [({}, 1.3), ({"mu_2_pa": 0.1}, 2.2), ({"mu_2_pa": 0.0}, 2.2)]
)
def test_a_stable_material_gives_no_concern(changes, stretch):
    assert not list(strain_stability_concerns([stretched_cube({**UNSTABLE, **changes}, stretch)]))


@pytest.mark.parametrize(("alpha", "codes"), [(-3.0, ["stability/rest"]), (3.0, [])])
def test_a_negative_shear_modulus_is_named(alpha, codes):
    body = Body(box_mesh((0.1, 0.1, 0.1), (1, 1, 1)), "ogden-1", 30.0)
    values = {"mu_1_pa": 200.0, "alpha_1": alpha, "kappa_pa": 400.0}
    theta = body.theta_from_values({**values, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0})
    concerns = list(rest_stability_concerns(body, theta))
    assert [each.code for each in concerns] == codes
    for each in concerns:
        assert "its shear modulus is -300 Pa" in each.message
