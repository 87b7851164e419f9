"""Kelvin and Voigt's damping: objective, dissipative, and exact in every derivative."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import casadi as ca
import numpy as np
import pytest
from checks import assert_derivative, relative_error
from materials_small import COMPILED, rounding, theta_for
from problems_small import IDEAL, point_markers, uneven_box
from scipy.spatial.transform import Rotation

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.elements import ELEMENTS
from collocation_sysid.fem.mesh import TetMesh
from collocation_sysid.fem.structured import box_mesh
from collocation_sysid.model.schemes import SCHEMES
from collocation_sysid.program.block_band import full_matrix
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import Experiment

OBJECTIVE = [name for name in COMPILED if name != "linear"]
LENGTH_M = 0.03  # a large change of a position


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


def times(body: Body, lower: np.ndarray, skew: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Product with a matrix of one state, given by symmetric and skew part."""
    return (full_matrix(body.pattern, lower, skew) @ vector.ravel())[None]


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
@pytest.mark.parametrize("material", [*OBJECTIVE, of_a_user])
def test_a_superposed_rotation_turns_the_force_along_and_adds_none(material, element, rng):
    """x → Rx, v → R(v + ω × x): the force turns by R, however fast the body spins."""
    body = small_body(material, element, "casadi")
    x, v = (field.reshape(-1, 3) for field in state(body, rng))
    turn = Rotation.from_rotvec([0.5, -2.0, 1.0]).as_matrix()
    spinning = v + np.cross([30.0, -20.0, 10.0], x)
    found = damping_force(body, x @ turn.T, spinning @ turn.T).reshape(-1, 3)
    assert relative_error(found, damping_force(body, x, v).reshape(-1, 3) @ turn.T) < 1e-9


@pytest.mark.parametrize("element", ELEMENTS)
def test_forces_balance_and_exert_no_torque(element, rng):
    body = small_body(element=element)
    x, v = state(body, rng)
    force = damping_force(body, x, v).reshape(-1, 3)
    assert abs(force.sum(axis=0)).max() < 1e-12 * abs(force).sum()
    torque = np.cross(x.reshape(-1, 3), force)
    assert abs(torque.sum(axis=0)).max() < 1e-12 * abs(torque).sum()


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("material", [*COMPILED, of_a_user])
def test_undeformed_it_is_rayleighs(material, element, rng):
    """So that damping ratios of small oscillations are the same."""
    bodies = [small_body(material, element, "casadi", law) for law in ("kelvin-voigt", "rayleigh")]
    _, v = state(bodies[0], rng)
    found, expected = (damping_force(body, body.nodes_m.reshape(1, -1), v) for body in bodies)
    assert relative_error(found, expected) < rounding(material)


@pytest.mark.parametrize(
    ("material", "element"),
    [
        pytest.param(m, e, marks=[pytest.mark.long] * (e == "tet10-p0" and m != "neo-hookean"))
        for m in [*COMPILED, of_a_user]
        for e in ELEMENTS
    ],
)
def test_it_takes_energy_out_of_every_motion_at_any_strain(material, element, rng):
    """No eigenvalue of −∂f/∂v is negative, at stretches to 2.5 and any F."""
    body = small_body(material, element, "casadi")
    theta, rest = theta_for(body, 0.009, 0.0), body.nodes_m
    turn = Rotation.from_rotvec([0.5, -2.0, 1.0]).as_matrix()
    shapes = [rest @ np.diag([s, *across]) @ turn for s in (0.5, 1.2, 1.6, 2.5)
              for across in ([1.0, 1.0], [s**-0.5, s**-0.5])]  # fmt: skip
    shapes += [rest @ any_gradient(rng).T + rng.uniform(-2e-3, 2e-3, rest.shape) for _ in range(4)]
    for x in shapes:
        x = x.reshape(1, -1)
        lower = -body.linearise(x, np.zeros_like(x), theta).by_velocity[0]
        values = np.linalg.eigvalsh(body.pattern.matrix(lower).toarray())
        assert values[0] > -1e-11 * values[-1]
        assert (values < 1e-9 * values[-1]).sum() <= 6


def any_gradient(rng: np.random.Generator) -> np.ndarray:
    """A deformation gradient with det F > 0."""
    F = np.eye(3) + rng.uniform(-0.7, 0.7, (3, 3))
    return F if np.linalg.det(F) > 0.1 else any_gradient(rng)


def test_a_linear_body_stays_linear(rng):
    kelvin, rayleigh = (small_body("linear", damping=law) for law in ("kelvin-voigt", "rayleigh"))
    x, v = state(kelvin, rng)
    assert relative_error(damping_force(kelvin, x, v), damping_force(rayleigh, x, v)) < 1e-12


# Derivatives ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("material", "element", "evaluator"),
    [(material, "tet4", "casadi") for material in COMPILED]
    + [(of_a_user, element, "casadi") for element in ELEMENTS]
    + [("neo-hookean", element, "simd") for element in ELEMENTS],
)
def test_linearise_gives_the_slopes_of_the_force(material, element, evaluator, rng):
    body = small_body(material, element, evaluator)
    theta, (x, v) = theta_for(body), state(body, rng)
    at = body.linearise(x, v, theta)
    none = np.zeros(0)
    by_x, by_v = (at.by_position[0], at.by_position_skew[0]), (at.by_velocity[0], none)
    for point, slopes, scale, moved in (
        (x, by_x, LENGTH_M, lambda x: body.force(x, v, theta)),
        (v, by_v, 1.0, lambda v: body.force(x, v, theta)),
    ):
        assert_derivative(moved, lambda d, m=slopes: times(body, *m, d), point, rng, scale=scale)
    assert_derivative(
        lambda c: body.force(x, v, c), lambda d: at.by_theta @ d, theta, rng, scale=theta
    )


@pytest.mark.parametrize(
    ("element", "evaluator"),
    [
        ("tet4", "casadi"),
        *(pytest.param(e, "simd", marks=[pytest.mark.long] * (e == "tet10-p0")) for e in ELEMENTS),
    ],
)
def test_curvature_gives_the_slopes_of_the_weighted_slopes(element, evaluator, rng):
    body = small_body("neo-hookean", element, evaluator)
    theta, (x, v), (_, w) = theta_for(body), state(body, rng), state(body, rng)
    at = body.second_derivatives(x, v, w, theta)
    none = np.zeros(0)

    def by_position(x, v, theta):
        found = body.linearise(x, v, theta)
        return times(body, found.by_position[0], -found.by_position_skew[0], w)  # transposed

    def by_velocity(x, v, theta):
        return times(body, body.linearise(x, v, theta).by_velocity[0], none, w)

    xx, xv, skew = (
        m[0] for m in (at.position_position, at.position_velocity, at.position_velocity_skew)
    )
    cases: list[tuple] = [
        (x, LENGTH_M, lambda x: by_position(x, v, theta), lambda d: times(body, xx, none, d)),
        (v, 1.0, lambda v: by_position(x, v, theta), lambda d: times(body, xv, skew, d)),
        (x, LENGTH_M, lambda x: by_velocity(x, v, theta), lambda d: times(body, xv, -skew, d)),
        (theta, theta, lambda c: by_position(x, v, c), lambda d: at.position_theta @ d),
        (theta, theta, lambda c: by_velocity(x, v, c), lambda d: at.velocity_theta @ d),
    ]
    for point, scale, moved, slope in cases:
        assert_derivative(moved, slope, point, rng, tolerance=1e-7, scale=scale)
    np.testing.assert_allclose(
        at.theta, np.einsum("tik,ti->tk", body.linearise(x, v, theta).by_theta, w), rtol=1e-10
    )


def test_only_kelvin_voigt_pays_for_what_is_not_symmetric():
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
