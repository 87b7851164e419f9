"""Natural modes compared with dense algebra, beam and rod theory, and simulations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from kit.forces import forces_alone
from kit.oscillations import oscillation, released_in_a_mode
from kit.problems import box, nodes_where

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.pattern import dofs_of
from collocation_sysid.program.modes.modal_prediction import oscillator_responses
from collocation_sysid.program.modes.natural import Modes, natural_modes

ELASTIC = np.array([200.0, 300.0, 0.0, 0.0])
DENSITY = 30.0
# A bar along x with square section; no Poisson effect, as in rod and beam theory.
LENGTH_M, SIDE_M, YOUNG_PA = 0.2, 0.02, 600.0
THIN = np.array([0.0, YOUNG_PA / 2, 0.0, 0.0])


def bar(element: str = "tet4", divisions: tuple[int, ...] = (8, 1, 1)) -> Body:
    mesh = box_mesh((LENGTH_M, SIDE_M, SIDE_M), divisions)
    return Body(mesh, density_kg_m3=DENSITY, element=element)


def all_but(body: Body, held: np.ndarray) -> np.ndarray:
    """Free dofs."""
    return dofs_of(np.setdiff1d(np.arange(len(body.nodes_m)), held))


def clamped(body: Body, theta: np.ndarray = THIN, count: int = 6) -> Modes:
    """Modes of the undeformed body with its nodes at x = 0 held."""
    free = all_but(body, nodes_where(body, 0, 0.0))
    return natural_modes(forces_alone(body, theta), body.nodes_m, free, count)


def dense_frequencies(body: Body, x: np.ndarray, free: np.ndarray, theta: np.ndarray) -> np.ndarray:
    stiffness = body.stiffness(x, lambda_pa=theta[0], mu_pa=theta[1]).toarray()[np.ix_(free, free)]
    squares = scipy.linalg.eigh(stiffness, np.diag(body.dof_mass[free]), eigvals_only=True)
    return np.sqrt(np.maximum(squares, 0)) / (2 * np.pi)


def test_a_tetrahedron_on_three_held_corners_is_a_point_on_springs():
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    body = Body(TetMesh(corners, [[0, 1, 2, 3]]), density_kg_m3=DENSITY)
    modes = natural_modes(forces_alone(body, ELASTIC), corners, np.array([9, 10, 11]))
    # The free corner's gradient is e_z / h: it shears with μ, twice, and stretches with λ + 2μ.
    volume, height = 0.1**3 / 6, 0.1
    lambda_pa, mu_pa, *_ = ELASTIC
    moduli = np.array([mu_pa, mu_pa, lambda_pa + 2 * mu_pa])
    expected = np.sqrt(moduli * volume / height**2 / (DENSITY * volume / 4)) / (2 * np.pi)
    np.testing.assert_allclose(modes.frequencies_hz, expected, rtol=1e-9)


@pytest.mark.parametrize("divisions", [(2, 2, 2), (3, 4, 5)], ids=["dense", "lanczos"])
def test_modes_of_a_deformed_body_are_those_of_dense_algebra(divisions, rng):
    body = box((0.1, 0.12, 0.09), divisions)
    x = body.nodes_m @ np.diag([1.1, 0.97, 1.05]) + rng.normal(0, 5e-4, body.nodes_m.shape)
    free = all_but(body, nodes_where(body, 2, 0.09))
    modes = natural_modes(forces_alone(body, ELASTIC), x, free)
    expected = dense_frequencies(body, x, free, ELASTIC)
    np.testing.assert_allclose(modes.frequencies_hz, expected[:6], rtol=1e-7)
    flat = modes.shapes.reshape(6, -1)
    np.testing.assert_allclose((flat * body.dof_mass) @ flat.T, np.eye(6), atol=1e-7)
    assert not np.delete(flat, free, axis=1).any()


@pytest.mark.parametrize("divisions", [(1, 1, 1), (3, 4, 5)], ids=["dense", "lanczos"])
def test_rigid_motions_of_a_free_body_are_left_out(divisions):
    body = box((0.1, 0.12, 0.09), divisions)
    free = np.arange(3 * len(body.nodes_m))
    modes = natural_modes(forces_alone(body, ELASTIC), body.nodes_m, free)
    assert modes.omitted_count == 6
    expected = dense_frequencies(body, body.nodes_m, free, ELASTIC)
    np.testing.assert_allclose(modes.frequencies_hz, expected[6:12], rtol=1e-7)


def test_a_clamped_bar_bends_as_beam_theory_predicts():
    modes = clamped(bar("tet10"))
    # Cantilever: (1.8751 / L)² √(E I / ρ A), I / A = a² / 12; in both directions across.
    expected = 1.8751**2 / LENGTH_M**2 * np.sqrt(YOUNG_PA * SIDE_M**2 / 12 / DENSITY)
    np.testing.assert_allclose(modes.frequencies_hz[:2], expected / (2 * np.pi), rtol=0.03)


def test_a_clamped_bar_stretches_as_rod_theory_predicts():
    body = bar(divisions=(16, 1, 1))
    modes = clamped(body, count=10)
    along = np.einsum("kn,n->k", modes.shapes[:, :, 0] ** 2, body.node_mass)
    expected = np.sqrt(YOUNG_PA / DENSITY) / (4 * LENGTH_M)
    assert modes.frequencies_hz[along.argmax()] == pytest.approx(expected, rel=0.01)


def test_a_point_mass_slows_a_bar_down():
    body = bar("tet10")
    free = all_but(body, nodes_where(body, 0, 0.0))
    tip = nodes_where(body, 0, LENGTH_M)
    alone, tip_kg = forces_alone(body, THIN), 10 * body.mass_kg
    tied_kg = np.zeros((1, body.pattern.size))
    tied_kg[0, dofs_of(tip)] = tip_kg / len(tip)
    mass = replace(alone.mass, tied_kg=tied_kg)
    forces = replace(alone, weight=replace(alone.weight, mass=mass))
    modes = natural_modes(forces, body.nodes_m, free)
    # A massless cantilever's stiffness 3 E I / L³, with 33/140 of its own mass at the tip.
    spring = 3 * YOUNG_PA * SIDE_M**4 / 12 / LENGTH_M**3
    expected = np.sqrt(spring / (tip_kg + 33 / 140 * body.mass_kg)) / (2 * np.pi)
    assert modes.frequencies_hz[0] == pytest.approx(expected, rel=0.03)


@pytest.mark.long
@pytest.mark.parametrize("mode", [0, 2])
@pytest.mark.parametrize(("gamma_r_s", "gamma_m_1_s"), [(0.0, 0.0), (0.004, 0.0), (0.0, 2.0)])
def test_a_body_released_in_a_mode_oscillates_with_its_frequency_and_damping(
    mode: int, gamma_r_s: float, gamma_m_1_s: float
):
    theta = np.array([*ELASTIC[:2], gamma_r_s, gamma_m_1_s])
    released, modes = released_in_a_mode(theta, mode)
    omega, ratio = oscillation(released, modes, mode, theta, "newmark", timestep_s=2e-4)
    assert omega == pytest.approx(modes.angular_frequencies_rad_s[mode], rel=2e-3)
    assert ratio == pytest.approx(modes.damping_ratios[mode], rel=5e-3, abs=1e-4)


def test_fewer_modes_than_wanted_are_no_error():
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    body = Body(TetMesh(corners, [[0, 1, 2, 3]]), density_kg_m3=DENSITY)
    modes = natural_modes(forces_alone(body, ELASTIC), corners, np.arange(12), count=20)
    assert len(modes.frequencies_hz) == 6
    assert modes.shapes.shape == (6, 4, 3)


@pytest.mark.parametrize("from_rest", [True, False])
def test_oscillators_answer_loads_that_are_linear_between_samples(from_rest: bool, rng):
    """Against the state matrix q, q̇, load and its slope, by its exponential."""
    omega, ratio, step_s, loads = 30.0, 0.2, 0.01, rng.normal(size=20)
    chain = np.eye(4, k=1)
    chain[1, :2], chain[2, 3] = [-(omega**2), -2 * ratio * omega], 1 / step_s
    state, expected = (np.array([loads[0] / omega**2 if from_rest else 0.0, 0, 0, 0]), [])
    for now, then in zip(loads, [*loads[1:], 0.0], strict=True):
        expected.append(state[0])
        state = scipy.linalg.expm(chain * step_s) @ [*state[:2], now, then - now]
    found = oscillator_responses(np.array([[omega]]), ratio, loads[:, None], step_s, from_rest)
    np.testing.assert_allclose(found[0, :, 0], expected, rtol=1e-9, atol=1e-15)
