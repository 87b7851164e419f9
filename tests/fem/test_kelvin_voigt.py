"""Kelvin–Voigt damping: stress, limits and motions; see also `test_testing_damping`."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import casadi as ca
import numpy as np
import pytest
from kit.checks import relative_error
from kit.materials import COMPILED, rounding, theta_for
from kit.problems import IDEAL, point_markers, uneven_box

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.elements import ELEMENTS
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.schemes import SCHEMES
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import Experiment


def of_a_user(F, lambda_pa, mu_pa):
    """Stiffer than Neo-Hooke's when sheared."""
    log_j, stretch = ca.log(ca.det(F)), ca.sumsqr(F) - 3
    return 0.5 * lambda_pa * log_j**2 - mu_pa * log_j + mu_pa * (stretch / 2 + stretch**2 / 20)


@cache
def small_body(
    material: str | Callable = "neo-hookean",
    element: str = "tet4",
    evaluator: str = "auto",
    damping: str = "kelvin-voigt",
) -> Body:
    """Six elements, no two alike."""
    return Body(uneven_box(1), material, 30.0, element, damping=damping, evaluator=evaluator)


def state(body: Body, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Positions some way from rest and any velocities, (1, 3n) each."""
    x = body.nodes_m + rng.uniform(-0.004, 0.004, body.nodes_m.shape)
    return x.reshape(1, -1), rng.standard_normal((1, x.size))


def damping_force(body: Body, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """That of γ_r = 9 ms alone, (T, 3n)."""
    theta = theta_for(body, 0.009, 0.0)
    return body.force(x, v, theta) - body.force(x, np.zeros_like(v), theta)


# What the force is -----------------------------------------------------------------------------


def test_stress_is_viscous_in_the_rate_of_deformation(rng):
    """S = 2η C⁻¹ Ė C⁻¹ + ζ (C⁻¹:Ė) C⁻¹ in the material frame, η = γ_r μ and ζ = γ_r λ."""
    points = np.vstack([np.zeros(3), 0.1 * np.eye(3)])
    body = Body(TetMesh(points, np.array([[0, 1, 2, 3]])), density_kg_m3=30.0)
    x, v = state(body, rng)
    F, rate = ((f.reshape(4, 3)[1:] - f.reshape(4, 3)[0]).T / 0.1 for f in (x, v))
    eta, zeta = 0.009 * 300.0, 0.009 * 200.0
    C_inverse, E_rate = np.linalg.inv(F.T @ F), (F.T @ rate + rate.T @ F) / 2
    S = 2 * eta * C_inverse @ E_rate @ C_inverse
    S += zeta * np.trace(C_inverse @ E_rate) * C_inverse
    at_nodes = -body.mesh.volumes_m3[0] * F @ S / 0.1  # ∇N_a of the last three are e_a / 0.1
    expected = np.vstack([-at_nodes.sum(axis=1), at_nodes.T])
    assert relative_error(damping_force(body, x, v)[0].reshape(4, 3), expected) < 1e-12


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("material", [*COMPILED, of_a_user])
def test_kelvin_voigt_damping_of_an_undeformed_body_is_rayleighs(material, element, rng):
    """So that damping ratios of small oscillations are the same."""
    bodies = [small_body(material, element, "casadi", law) for law in ("kelvin-voigt", "rayleigh")]
    _, v = state(bodies[0], rng)
    found, expected = (damping_force(body, body.nodes_m.reshape(1, -1), v) for body in bodies)
    assert relative_error(found, expected) < rounding(material)


def test_a_linear_body_stays_linear(rng):
    kelvin, rayleigh = (small_body("linear", damping=law) for law in ("kelvin-voigt", "rayleigh"))
    x, v = state(kelvin, rng)
    assert relative_error(damping_force(kelvin, x, v), damping_force(rayleigh, x, v)) < 1e-12


def test_only_kelvin_voigt_has_unsymmetric_matrices():
    at = small_body(damping="rayleigh").linearise(*np.zeros((2, 1, 24)), [1.0, 1.0, 1.0, 1.0])
    assert at.by_position_skew.shape == (1, 0)


# Motion -----------------------------------------------------------------------------------------


def bar(damping: str) -> Body:
    return Body(box_mesh((0.06, 0.02, 0.02), (3, 1, 1)), density_kg_m3=30.0, damping=damping)


CONSTANTS = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_m_1_s": 0.0}


def spun(
    damping: str, step_s: float, time_s: float, scheme: str = "midpoint", stretch: float = 1.15
) -> np.ndarray:
    """Positions (T, n, 3) of a free bar, stretched at first, that spins at 8.8 rad/s."""
    body, t_s = bar(damping), np.arange(round(time_s / step_s) + 1) * step_s
    middle = body.node_mass @ body.nodes_m / body.mass_kg
    start = middle + stretch * (body.nodes_m - middle)
    velocity = np.cross([0.0, 0.0, 8.8], start - middle)
    experiment = Experiment(
        body,
        t_s,
        [],
        point_markers(body, body.nodes_m[:1], t_s),
        start="given",
        start_positions_m=start,
        start_velocities_m_s=velocity,
        gravity_m_s2=(0.0, 0.0, 0.0),
        nuisance=IDEAL,
    )
    truth = CONSTANTS | {"gamma_r_s": 5e-3}
    return simulate(experiment, truth, scheme, substeps=1).positions_m.reshape(len(t_s), -1, 3)


def momenta(body: Body, x: np.ndarray, step_s: float) -> np.ndarray:
    """(T − 1, n, 3) p_t = M v + ½ Δt F at the end of each step of the midpoint rule.

    Marsden & West 2001, sec. 2.6: Σ x_t × p_t is what it keeps where no torque acts.
    """
    v, middle = np.diff(x, axis=0) / step_s, (x[1:] + x[:-1]) / 2
    force = body.force(middle, v, body.theta_from_values(CONSTANTS | {"gamma_r_s": 5e-3}))
    return body.node_mass[:, None] * v + step_s / 2 * force.reshape(v.shape)


def test_a_stretched_body_spins_on():
    """Rayleigh's law takes more than a tenth of the angular momentum in a second."""
    kept = {}
    for law in ("kelvin-voigt", "rayleigh"):
        x = spun(law, 0.01, 1.0)
        of_steps = np.cross(x[1:], momenta(bar(law), x, 0.01)).sum(axis=1)[:, 2]
        kept[law] = of_steps / of_steps[0]
    assert kept["rayleigh"][-1] < 0.9
    np.testing.assert_allclose(kept["kelvin-voigt"], 1.0, rtol=1e-7)


@pytest.mark.parametrize("scheme", ["backward-euler", "bdf2"])
def test_other_schemes_keep_angular_momentum_to_their_order(scheme: str):
    steps, lost = np.array([4e-3, 2e-3, 1e-3]), []
    for step_s in steps:
        x = spun("kelvin-voigt", step_s, 0.1, scheme=scheme, stretch=1.0)
        v = np.gradient(x, step_s, axis=0, edge_order=2)[-1]
        momentum = np.cross(x[-1], bar("kelvin-voigt").node_mass[:, None] * v).sum(axis=0)[2]
        lost.append(momentum)
    first, second = np.diff(lost)
    assert np.log2(first / second) > SCHEMES[scheme].order - 0.3


def test_energy_never_grows_in_an_undriven_swing():
    """Elastic and kinetic energy of the spun and stretched bar, by the midpoint rule."""
    body, step_s = bar("kelvin-voigt"), 1e-3
    x = spun("kelvin-voigt", step_s, 0.2)
    p = momenta(body, x, step_s)
    kinetic = (p**2 / body.node_mass[:, None]).sum(axis=(1, 2)) / 2
    elastic = [body.energy(row, lambda_pa=200.0, mu_pa=300.0) for row in x[1:]]
    total = kinetic + elastic
    assert total[-1] < 0.9 * total[0]
    assert np.diff(total).max() < 1e-4 * total[0]
