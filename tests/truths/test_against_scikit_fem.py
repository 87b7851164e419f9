"""Forces and stiffness compared with scikit-fem, with stresses written by hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import skfem
from kit.checks import relative_error
from kit.materials import COMPILED, ELASTIC, LAME, elastic, rounding
from kit.scikit_fem import Library
from skfem.models.elasticity import linear_elasticity

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.mesh import TetMesh

LAMBDA_PA, MU_PA = LAME


# Neo-Hookean: ψ = ½ λ (ln J)² − μ ln J + ½ μ (tr C − 3), tensors first, points last.


def kinematics(w):
    """F, F⁻ᵀ and ln J of a displacement."""
    F = np.eye(3)[:, :, None, None] + w["u"].grad
    last = np.moveaxis(F, (0, 1), (-2, -1))
    inverse_transposed = np.moveaxis(np.linalg.inv(last), (-1, -2), (0, 1))
    return F, inverse_transposed, np.log(np.linalg.det(last))


def energy_density(w):
    F, _, log_j = kinematics(w)
    return 0.5 * LAMBDA_PA * log_j**2 - MU_PA * log_j + 0.5 * MU_PA * ((F**2).sum((0, 1)) - 3)


def virtual_work(v, w):
    """P : ∇v with P = μ (F − F⁻ᵀ) + λ ln J F⁻ᵀ."""
    F, inverse_transposed, log_j = kinematics(w)
    stress = MU_PA * (F - inverse_transposed) + LAMBDA_PA * log_j * inverse_transposed
    return (stress * v.grad).sum((0, 1))


def tangent_work(u, v, w):
    """dP : ∇v with dP = μ dF + (μ − λ ln J) F⁻ᵀ dFᵀ F⁻ᵀ + λ (F⁻ᵀ : dF) F⁻ᵀ, dF = ∇u."""
    _, G, log_j = kinematics(w)
    turned = np.einsum("ij...,kj...,kl...->il...", G, u.grad, G)
    volumetric = (G * u.grad).sum((0, 1)) * G
    rate = MU_PA * u.grad + (MU_PA - LAMBDA_PA * log_j) * turned + LAMBDA_PA * volumetric
    return (rate * v.grad).sum((0, 1))


@pytest.fixture
def library(small_mesh) -> Library:
    return Library(small_mesh)


@pytest.fixture
def quadratic(small_mesh) -> tuple[Library, Callable[..., Body]]:
    """The library and bodies with a node on every edge."""
    # The order at which the library uses the same four points.
    library = Library(small_mesh, skfem.ElementTetP2(), intorder=2)

    def make_body(material: str) -> Body:
        return Body(small_mesh, material, density_kg_m3=30.0, element="tet10")

    return library, make_body


@pytest.fixture
def positions(small_mesh, rng) -> np.ndarray:
    return small_mesh.points_m + rng.uniform(-0.006, 0.006, small_mesh.points_m.shape)


def test_neo_hookean_energy(make_body, library, positions):
    expected = library.scalar(energy_density, positions)
    found = make_body("neo-hookean").energy(positions, **ELASTIC)
    assert found == pytest.approx(expected, rel=1e-12)


def test_neo_hookean_force(make_body, library, positions):
    expected = -library.vector(virtual_work, positions)
    found = make_body("neo-hookean").elastic_force(positions, **ELASTIC)
    assert relative_error(found, expected) < 1e-12


def test_neo_hookean_stiffness(make_body, library, positions):
    expected = library.matrix(tangent_work, positions)
    found = make_body("neo-hookean").stiffness(positions, **ELASTIC)
    assert relative_error(found.toarray(), expected) < 1e-12


def test_neo_hookean_damping(make_body, library, positions, rng):
    velocity = rng.standard_normal(positions.size)
    expected = -0.009 * library.matrix(tangent_work, positions) @ velocity
    body = make_body("neo-hookean")
    damped, free = (
        body.force(positions, velocity, [LAMBDA_PA, MU_PA, gamma_r, 0.0])[0]
        for gamma_r in (0.009, 0.0)
    )
    assert relative_error(damped - free, expected) < 1e-12


@pytest.mark.parametrize("material", COMPILED)
def test_stiffness_at_rest_is_linear_elasticity(make_body, library, material):
    expected = library.matrix(linear_elasticity(LAMBDA_PA, MU_PA).form, library.points_m)
    body = make_body(material)
    found = body.stiffness(library.points_m, **elastic(body))
    assert relative_error(found.toarray(), expected) < rounding(material)


# Quadratic elements


def test_quadratic_neo_hookean_energy_force_and_stiffness(quadratic, rng):
    library, make_body = quadratic
    body = make_body("neo-hookean")
    np.testing.assert_allclose(body.nodes_m, library.points_m)
    x = body.nodes_m + rng.uniform(-0.002, 0.002, body.nodes_m.shape)
    energy = library.scalar(energy_density, x)
    assert body.energy(x, **ELASTIC) == pytest.approx(energy, rel=1e-10)
    force = -library.vector(virtual_work, x)
    assert relative_error(body.elastic_force(x, **ELASTIC), force) < 1e-10
    stiffness = library.matrix(tangent_work, x)
    assert relative_error(body.stiffness(x, **ELASTIC).toarray(), stiffness) < 1e-10


@pytest.mark.parametrize("intorder", [2, 6])
def test_quadratic_stiffness_at_rest_is_exact(quadratic, small_mesh, intorder):
    library = Library(small_mesh, skfem.ElementTetP2(), intorder)
    body = quadratic[1]("linear")
    expected = library.matrix(linear_elasticity(LAMBDA_PA, MU_PA).form, library.points_m)
    found = body.stiffness(library.points_m, **ELASTIC)
    assert relative_error(found.toarray(), expected) < 1e-10


def test_quadratic_consistent_mass_has_the_lumped_ones_proportions(quadratic, small_mesh):
    """Of a single element; of many, each is scaled to its own mass."""
    one = TetMesh(small_mesh.points_m, small_mesh.tetrahedra[:1])
    library = Library(one, skfem.ElementTetP2(), intorder=4)
    consistent = library.matrix(lambda u, v, w: 30.0 * (u * v).sum(0), library.points_m)
    body = Body(one, density_kg_m3=30.0, element="tet10")
    diagonal = np.diag(consistent)
    expected = 3 * body.mass_kg * diagonal / diagonal.sum()
    np.testing.assert_allclose(body.dof_mass, expected, rtol=1e-10)
