"""Kelvin–Voigt damping in material form: stress, potential and motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from kit.checks import directional_derivative, relative_error
from kit.materials import COMPILED, theta_for
from kit.problems import EDGE_M, IDEAL, box, nodes_where, uneven_box

import collocation_sysid as cs
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.elements import ELEMENTS
from collocation_sysid.fem.meshes.mesh import TetMesh

OBJECTIVE = [name for name in COMPILED if name != "linear"]
# Small-strain constants (λ, μ) of `materials_small` [Pa], and γ_r [s].
LAME_PA = 200.0
SHEAR_PA = 300.0
GAMMA_R_S = 0.009


def damped_body(
    material: str | Callable = "neo-hookean",
    element: str = "tet4",
    evaluator: str = "casadi",
    damping: str = "material",
    **changes,
) -> Body:
    """Six elements, no two alike."""
    return Body(
        uneven_box(1), material, 30.0, element, damping=damping, evaluator=evaluator, **changes
    )


def moving_state(body: Body, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Positions some way from rest and any velocities, (1, 3n) each."""
    x = body.nodes_m + rng.uniform(-0.004, 0.004, body.nodes_m.shape)
    return x.reshape(1, -1), rng.standard_normal((1, x.size))


def damping_force(body: Body, x: np.ndarray, v: np.ndarray, gamma_r_s: float = GAMMA_R_S):
    """The damping force (1, 3n) of γ_r alone."""
    theta = theta_for(body, gamma_r_s, 0.0)
    return body.force(x, v, theta) - body.force(x, np.zeros_like(v), theta)


def potential_w(body: Body, x: np.ndarray, v: np.ndarray) -> float:
    """D = ½ γ_r Σ V_q (λ (tr Ė)² + 2 μ Ė:Ė) of linear elements, by NumPy [W]."""
    found = 0.0
    nodes = body.nodes_m
    for cell, volume_m3 in zip(body.cells, body.mesh.volumes_m3, strict=True):
        edges = (nodes[cell[1:]] - nodes[cell[0]]).T
        F, rate = (
            (field[cell[1:]] - field[cell[0]]).T @ np.linalg.inv(edges)
            for field in (x.reshape(-1, 3), v.reshape(-1, 3))
        )
        strain_rate = (F.T @ rate + rate.T @ F) / 2
        density = LAME_PA * np.trace(strain_rate) ** 2 + 2 * SHEAR_PA * np.sum(strain_rate**2)
        found += GAMMA_R_S * volume_m3 * density / 2
    return found


# The force ----------------------------------------------------------------------------------------


def test_stress_is_viscous_in_the_rate_of_the_green_strain(rng):
    points = np.vstack([np.zeros(3), 0.1 * np.eye(3)])
    body = Body(TetMesh(points, np.array([[0, 1, 2, 3]])), density_kg_m3=30.0, damping="material")
    x, v = moving_state(body, rng)
    F, rate = ((f.reshape(4, 3)[1:] - f.reshape(4, 3)[0]).T / 0.1 for f in (x, v))
    E_rate = (F.T @ rate + rate.T @ F) / 2
    S = GAMMA_R_S * (LAME_PA * np.trace(E_rate) * np.eye(3) + 2 * SHEAR_PA * E_rate)
    at_nodes = -body.mesh.volumes_m3[0] * F @ S / 0.1  # ∇N_a of the last three are e_a / 0.1
    expected = np.vstack([-at_nodes.sum(axis=1), at_nodes.T])
    assert relative_error(damping_force(body, x, v)[0].reshape(4, 3), expected) < 1e-12


@pytest.mark.parametrize("material", OBJECTIVE)
def test_force_is_the_slope_of_the_potential_by_the_velocities(material, rng):
    body = damped_body(material)
    x, v = moving_state(body, rng)
    force = damping_force(body, x, v)
    for _ in range(2):
        direction = rng.standard_normal(v.shape)
        slope = directional_derivative(lambda v: potential_w(body, x, v), v, direction)
        assert relative_error(-np.sum(force * direction), slope) < 1e-9


def test_damping_of_st_venant_kirchhoff_is_the_rate_of_the_elastic_stress(rng):
    """P_v = F γ_r Ṡ: γ_r times the rate of the elastic force, but for that of F alone."""
    body = damped_body("st-venant-kirchhoff")
    points = np.vstack([np.zeros(3), 0.1 * np.eye(3)])
    body = Body(
        TetMesh(points, np.array([[0, 1, 2, 3]])), "st-venant-kirchhoff", 30.0, damping="material"
    )
    x, v = moving_state(body, rng)
    theta = theta_for(body, 0.0, 0.0)

    def second_piola(at: np.ndarray) -> np.ndarray:
        """S (3, 3) from the nodal forces."""
        F = (at.reshape(4, 3)[1:] - at.reshape(4, 3)[0]).T / 0.1
        force = body.force(at, np.zeros_like(at), theta).reshape(4, 3)[1:]
        return np.linalg.solve(F, -force.T * 0.1 / body.mesh.volumes_m3[0])

    F = (x.reshape(4, 3)[1:] - x.reshape(4, 3)[0]).T / 0.1
    rate = directional_derivative(second_piola, x, v, step=1e-4)
    expected = -body.mesh.volumes_m3[0] * F @ (GAMMA_R_S * rate) / 0.1
    assert relative_error(damping_force(body, x, v)[0].reshape(4, 3)[1:].T, expected) < 1e-7


@pytest.mark.parametrize("damping", ["material", "kelvin-voigt"])
@pytest.mark.parametrize("element", ELEMENTS)
def test_forces_balance_and_exert_no_torque(element, damping, rng):
    body = damped_body(element=element, damping=damping)
    x, v = moving_state(body, rng)
    force = damping_force(body, x, v).reshape(-1, 3)
    assert abs(force.sum(axis=0)).max() < 1e-12 * abs(force).sum()
    torque = np.cross(x.reshape(-1, 3), force)
    assert abs(torque.sum(axis=0)).max() < 1e-12 * abs(torque).sum()


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("material", ["neo-hookean", "yeoh", "linear"])
def test_material_damping_of_an_undeformed_body_is_kelvin_and_voigts(material, element, rng):
    bodies = [damped_body(material, element, damping=law) for law in ("material", "kelvin-voigt")]
    _, v = moving_state(bodies[0], rng)
    found, expected = (damping_force(body, body.nodes_m.reshape(1, -1), v) for body in bodies)
    assert relative_error(found, expected) < 1e-12


def test_without_gamma_r_material_damping_vanishes(rng):
    body = damped_body()
    x, v = moving_state(body, rng)
    assert not damping_force(body, x, v, gamma_r_s=0.0).any()
    at = body.linearise(x, v, theta_for(body, 0.0, 0.0))
    assert not at.by_velocity.any()
    assert not at.by_position_skew.any()
    assert at.by_theta[0, :, 2].any()  # the slope by γ_r stays


def test_material_and_kelvin_voigt_differ_at_large_strain(rng):
    """By the squares of the stretches: a bar at a stretch of 1.5 along its axis, moved along it."""
    forces = []
    for law in ("material", "kelvin-voigt"):
        body = damped_body(damping=law)
        x = (body.nodes_m * [1.5, 1.0, 1.0]).reshape(1, -1)
        v = (body.nodes_m * [1.0, 0.0, 0.0]).reshape(1, -1)
        force = damping_force(body, x, v).reshape(-1, 3)
        forces.append(force[nodes_where(body, 0, body.nodes_m[:, 0].max()), 0].sum())
    assert forces[0] / forces[1] == pytest.approx(1.5**4, rel=1e-9)


def test_a_memory_does_not_change_the_damping_force(rng):
    """The law acts on the long-term energy; branches of memory stand beside it."""
    plain = damped_body()
    with_memory = damped_body(prony=["prony_1"])
    x, v = moving_state(plain, rng)
    theta = plain.theta_from_values(
        {"lambda_pa": LAME_PA, "mu_pa": SHEAR_PA, "gamma_r_s": GAMMA_R_S, "gamma_m_1_s": 0.0}
    )
    values = dict(zip(plain.constants, theta, strict=True))
    full = with_memory.theta_from_values(values | {"prony_1.share": 0.5, "prony_1.tau_s": 0.1})
    still = np.zeros_like(v)
    found = with_memory.force(x, v, full) - with_memory.force(x, still, full)
    assert relative_error(found, damping_force(plain, x, v)) < 1e-12


# Motion -------------------------------------------------------------------------------------------


def test_a_bar_stretched_at_a_constant_rate_follows_the_closed_form():
    """St. Venant and Kirchhoff's material, free to contract: S₁₁ = E (E₁₁ + γ Ė₁₁), E₂₂ = −ν E₁₁.

    With the side free of stress, 2 (λ + μ) (E₂₂ + γ Ė₂₂) = −λ (E₁₁ + γ Ė₁₁), which
    E₂₂ = −ν E₁₁ satisfies at all times. The axial force over the undeformed area is F₁₁ S₁₁.
    """
    young_pa, poisson, rate_1_s = 20e3, 0.3, 2.0
    t_s = np.linspace(0.0, 0.2, 6)
    body = Body(box().mesh, "st-venant-kirchhoff", 1e-3, damping="material")
    fixed = cs.PoseSequence.fixed()
    stretching = cs.PoseSequence(
        t_s,
        np.outer(rate_1_s * t_s * EDGE_M, [0.0, 0.0, 1.0]),
        np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1)),
        "linear",
    )
    ends = [nodes_where(body, 2, height) for height in (0.0, EDGE_M)]
    grasps = [
        cs.Grasp(ends[0], fixed, axes="z"),
        cs.Grasp(ends[1], stretching, axes="z"),
        cs.Grasp(nodes_where(body, 0, 0.0), fixed, axes="x"),
        cs.Grasp(nodes_where(body, 1, 0.0), fixed, axes="y"),
    ]
    markers = cs.Markers(t_s, np.zeros((len(t_s), 1, 3)), 1e-3, places_m=body.nodes_m[-1:])
    experiment = cs.Experiment(
        body, t_s, grasps, markers, start="undeformed", gravity_m_s2=(0.0, 0.0, 0.0), nuisance=IDEAL
    )
    constants = {
        "young_pa": young_pa,
        "poisson": poisson,
        "gamma_r_s": GAMMA_R_S,
        "gamma_m_1_s": 0.0,
    }
    motion = cs.simulate(experiment, constants, "backward-euler", substeps=40)
    stretch = 1 + rate_1_s * t_s
    strain = (stretch**2 - 1) / 2
    across = np.sqrt(1 - 2 * poisson * strain)
    force_n = EDGE_M**2 * stretch * young_pa * (strain + GAMMA_R_S * stretch * rate_1_s)
    theta = body.theta_from_values(constants)
    for k in range(2, len(t_s)):  # after the start, where the velocity jumps
        x = motion.positions_m[k].reshape(1, -1)
        expected = body.nodes_m * [across[k], across[k], stretch[k]]
        np.testing.assert_allclose(x.reshape(-1, 3), expected, atol=3e-3 * EDGE_M)
        velocity = body.nodes_m * [
            -poisson * stretch[k] * rate_1_s / across[k],
            -poisson * stretch[k] * rate_1_s / across[k],
            rate_1_s,
        ]
        exact = body.force(expected.reshape(1, -1), velocity.reshape(1, -1), theta)
        pull_n = -exact.reshape(-1, 3)[ends[1], 2].sum()
        assert pull_n == pytest.approx(force_n[k], rel=1e-9)


def test_a_stretched_body_spins_on_and_loses_no_angular_momentum():
    """The midpoint rule keeps Σ x × p of a free bar that is stretched and spins at 8.8 rad/s."""
    step_s = 0.01
    t_s = np.arange(51) * step_s
    mesh = cs.box_mesh((0.06, 0.02, 0.02), (3, 1, 1))
    body = Body(mesh, density_kg_m3=30.0, damping="material")
    middle = body.node_mass @ body.nodes_m / body.mass_kg
    start = middle + 1.15 * (body.nodes_m - middle)
    experiment = cs.Experiment(
        body,
        t_s,
        [],
        cs.Markers(t_s, np.zeros((len(t_s), 1, 3)), 1e-3, places_m=body.nodes_m[:1]),
        start="given",
        start_positions_m=start,
        start_velocities_m_s=np.cross([0.0, 0.0, 8.8], start - middle),
        gravity_m_s2=(0.0, 0.0, 0.0),
        nuisance=IDEAL,
    )
    constants = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 5e-3, "gamma_m_1_s": 0.0}
    x = cs.simulate(experiment, constants, "midpoint", substeps=1).positions_m
    velocity = np.diff(x, axis=0) / step_s
    between = ((x[1:] + x[:-1]) / 2).reshape(len(velocity), -1)
    force = body.force(
        between, velocity.reshape(len(velocity), -1), body.theta_from_values(constants)
    )
    momentum = body.node_mass[:, None] * velocity + step_s / 2 * force.reshape(velocity.shape)
    kept = np.cross(x[1:], momentum).sum(axis=1)[:, 2]
    np.testing.assert_allclose(kept / kept[0], 1.0, rtol=1e-7)
