"""Undriven bodies: decay of energy by damping, and warnings about unstable ones."""

from __future__ import annotations

from functools import partial

import casadi as ca
import numpy as np
import pytest
import scipy.sparse as sp
from kit.forces import forces_alone
from kit.problems import IDEAL, nodes_where, point_markers
from scipy.sparse.linalg import ArpackNoConvergence, eigsh

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.kernel import from_lower_triangle
from collocation_sysid.fem.laws.constants import GAMMA_R
from collocation_sysid.fem.laws.materials import DampingLaw
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.model.forces import Forces
from collocation_sysid.model.parameters import Parameter, Parameters
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.modes import stability
from collocation_sysid.program.modes.stability import find_instabilities, growth_rate_1_s
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import Experiment, Grasp, PoseSequence
from collocation_sysid.statistics.assessment import stability_concerns

SIZE_M, STRETCH = (0.03, 0.03, 0.09), 1.6
YOUNG_PA, POISSON = 1e5, 0.45
CONSTANTS = {
    "lambda_pa": YOUNG_PA * POISSON / (1 + POISSON) / (1 - 2 * POISSON),
    "mu_pa": YOUNG_PA / 2 / (1 + POISSON),
    "gamma_r_s": 5e-3,
    "gamma_m_1_s": 0.0,
}


def rate_of_stress(psi, F, rate, gamma_r_s):
    """P_v = γ_r F dS/dt: a law that feeds energy into a nearly incompressible body."""
    stiffness, stress = ca.hessian(psi, F)
    change, slope = ca.jtimes(stress, F, rate), ca.SX(0)
    slope = from_lower_triangle(ca.jacobian(change, F))
    inverse, Fdot = ca.inv(ca.reshape(F, 3, 3)), ca.reshape(rate, 3, 3)
    S = from_lower_triangle(inverse @ ca.reshape(stress, 3, 3))
    change -= ca.vec(Fdot @ S)
    turning = from_lower_triangle(stiffness) - ca.kron(S, ca.SX.eye(3))
    slope -= ca.kron(ca.SX.eye(3), Fdot @ inverse) @ turning
    return gamma_r_s * change, gamma_r_s * slope


RATE_OF_STRESS = DampingLaw("rate-of-stress", (GAMMA_R,), stress=rate_of_stress)
LAWS = ("kelvin-voigt", RATE_OF_STRESS)


def bar(damping: str | DampingLaw = "kelvin-voigt", across: int = 1) -> Body:
    mesh = box_mesh(SIZE_M, (across, across, 3))
    return Body(mesh, "stable-neo-hookean", 1000.0, damping=damping)


def held(body: Body) -> np.ndarray:
    return np.union1d(nodes_where(body, 2, 0.0), nodes_where(body, 2, SIZE_M[2]))


def held_at_both_ends(body: Body, disturbed_m: float = 0.0, samples: int = 101) -> Experiment:
    """The bar between its ends at a stretch of 1.6, let go near its equilibrium."""
    ends, t_s = held(body), 2e-3 * np.arange(samples)
    start = equilibrium(body, ends)
    free = np.setdiff1d(np.arange(len(start)), ends)
    start[free] += disturbed_m * np.random.default_rng(1).uniform(-1, 1, (len(free), 3))
    bottom, top = (nodes_where(body, 2, z) for z in (0.0, SIZE_M[2]))
    up = PoseSequence.fixed().with_shift((0, 0, (STRETCH - 1) * SIZE_M[2]))
    stretched = [Grasp(bottom, PoseSequence.fixed()), Grasp(top, up)]
    return Experiment(
        body,
        t_s,
        stretched,
        point_markers(body, body.nodes_m[free[:1]], t_s),
        name="bar",
        start="given",
        start_positions_m=start,
        gravity_m_s2=(0.0, 0.0, 0.0),
        nuisance=IDEAL,
    )


def equilibrium(body: Body, ends: np.ndarray) -> np.ndarray:
    """Positions (n, 3) of the bar stretched between its ends, by Newton's method."""
    x, forces = (body.nodes_m * [1, 1, STRETCH], forces_alone(body, theta_of(body)))
    free = free_dofs(body, ends)
    for _ in range(40):
        at = forces.linearise(x.reshape(1, -1), np.zeros((1, x.size)))
        stiffness = -forces.pattern.matrix(at.by_position[0]).toarray()[np.ix_(free, free)]
        step = np.linalg.solve(stiffness, at.force[0][free])
        x.ravel()[free] += step * min(1.0, 2e-3 / np.abs(step).max())
    return x


def theta_of(body: Body) -> np.ndarray:
    return body.theta_from_values(CONSTANTS)


def free_dofs(body: Body, held: np.ndarray) -> np.ndarray:
    return np.flatnonzero(~np.repeat(np.isin(np.arange(len(body.nodes_m)), held), 3))


def fastest(forces: Forces, x: np.ndarray, free: np.ndarray) -> float:
    """Largest Re(s) of M s² + D s + K by dense algebra."""
    at = forces.linearise(x.reshape(1, -1), np.zeros((1, x.size)))
    mass = forces.mass.inertia_kg[0, free]
    K, D = (
        -forces.pattern.matrix(lower).toarray()[np.ix_(free, free)] / mass[:, None]
        for lower in (at.by_position[0], at.by_velocity[0])
    )
    one = np.eye(len(free))
    return np.linalg.eigvals(np.block([[0 * one, one], [-K, -D]])).real.max()


def energy_j(body: Body, x: np.ndarray, step_s: float) -> np.ndarray:
    """Elastic and kinetic energy at the ends of the midpoint rule's steps of a body let go."""
    v = [np.zeros_like(x[0])]
    for moved in np.diff(x, axis=0) / step_s:
        v.append(2 * moved - v[-1])
    elastic = [
        body.energy(row, lambda_pa=CONSTANTS["lambda_pa"], mu_pa=CONSTANTS["mu_pa"]) for row in x
    ]
    return np.array(elastic) + (body.node_mass[:, None] * np.array(v) ** 2).sum(axis=(1, 2)) / 2


@pytest.mark.parametrize(("law", "grows"), [(LAWS[0], False), (LAWS[1], True)])
def test_only_a_law_that_is_not_dissipative_feeds_energy_into_a_stretched_bar(law, grows):
    body = bar(law, across=2)
    experiment = held_at_both_ends(body, disturbed_m=1e-5)
    x = simulate(experiment, CONSTANTS, "midpoint", substeps=1).positions_m
    energy = energy_j(body, x, experiment.timestep_s)
    disturbed = energy[0] - energy_j(body, equilibrium(body, held(body))[None], 1.0)[0]
    if grows:
        assert energy[-1] > energy[0] + 100 * disturbed
    else:
        assert np.diff(energy).max() < 1e-6 * disturbed
        assert energy[-1] < energy[0] - 0.5 * disturbed


@pytest.mark.parametrize("dense", [True, False])
@pytest.mark.parametrize("law", LAWS)
def test_growth_is_the_eigenvalue_of_dense_algebra(law, dense, monkeypatch):
    monkeypatch.setattr(stability, "DENSE", 10**6 if dense else 0)
    body = bar(law, across=2)
    x, free, theta = (equilibrium(body, held(body)), free_dofs(body, held(body)), theta_of(body))
    expected = fastest(forces_alone(body, theta), x, free)
    found = growth_rate_1_s(forces_alone(body, theta), x.ravel(), free)
    assert (expected > 0) == (law is RATE_OF_STRESS)
    assert found == pytest.approx(max(expected, 0.0), rel=1e-6)


@pytest.mark.parametrize("law", ["kelvin-voigt", "rayleigh"])
def test_a_bar_pressed_beyond_buckling_is_not_stable(law, monkeypatch):
    monkeypatch.setattr(stability, "DENSE", 0)
    body = Body(box_mesh((0.01, 0.01, 0.1), (1, 1, 6)), "stable-neo-hookean", 1000.0, damping=law)
    held = np.union1d(nodes_where(body, 2, 0.0), nodes_where(body, 2, 0.1))
    free, theta, found = free_dofs(body, held), theta_of(body), []
    for squeezed in (0.999, 0.7):
        x = body.nodes_m * [1, 1, squeezed]
        found.append(growth_rate_1_s(forces_alone(body, theta), x.ravel(), free))
        expected = fastest(forces_alone(body, theta), x, free)
        assert found[-1] == pytest.approx(max(expected, 0.0), rel=1e-6)
    assert found[0] == 0 < found[1]


def test_growth_is_found_where_the_search_for_directions_ends_early(monkeypatch):
    def ended(matrix, *_, **__):
        raise ArpackNoConvergence("ended", np.zeros(0), np.zeros((matrix.shape[0], 0)))

    monkeypatch.setattr(stability, "DENSE", 0)
    monkeypatch.setattr(stability, "eigsh", ended)
    body = bar(RATE_OF_STRESS, across=2)
    x, free, theta = (equilibrium(body, held(body)), free_dofs(body, held(body)), theta_of(body))
    expected = fastest(forces_alone(body, theta), x, free)
    assert growth_rate_1_s(forces_alone(body, theta), x.ravel(), free) == pytest.approx(expected)


def test_negative_directions_are_found_in_few_iterations_beside_a_bulk_modulus(monkeypatch):
    values = np.concatenate([[-3.0, -2.0, -1.0], np.logspace(0, 10, 297)])
    monkeypatch.setattr(stability, "eigsh", partial(eigsh, maxiter=5))
    vectors = stability._lowest_eigenvectors(sp.csc_array(sp.diags_array(values)))
    np.testing.assert_allclose(np.linalg.norm(vectors[:3], axis=1), 1.0, atol=1e-2)


def test_a_body_that_nobody_holds_is_stable():
    body = bar()
    free = np.arange(3 * len(body.nodes_m))
    assert growth_rate_1_s(forces_alone(body, theta_of(body)), body.nodes_m.ravel(), free) == 0


@pytest.mark.parametrize(("law", "told"), [(LAWS[0], False), (LAWS[1], True)])
def test_growing_modes_are_reported_with_their_rate(law, told):
    experiment = held_at_both_ends(bar(law, across=2))
    given = {name: value for name, value in CONSTANTS.items() if value}
    items = [Parameter(name, value, 0.5 * value, 2 * value) for name, value in given.items()]
    parameters = Parameters((*items, Parameter("gamma_m_1_s", 0.0, is_fixed=True)))
    collocation = Collocation([experiment], parameters)
    start = experiment.start_positions_m
    assert start is not None
    resting = np.tile(start.ravel(), (len(experiment.t_s), 1))
    z = collocation.pack(collocation.guess_p, [resting])
    concerns = stability_concerns(find_instabilities(collocation, z))
    assert bool(concerns) == told
    if told:
        (concern,) = concerns
        sentence = concern.message
        assert "the motion of 'bar' is unstable" in sentence
        assert "disturbances grow at a rate of" in sentence


def test_a_body_without_damping_is_stable():
    body = bar()
    theta = body.theta_from_values(CONSTANTS | {"gamma_r_s": 0.0})
    free = free_dofs(body, held(body))
    assert (
        growth_rate_1_s(forces_alone(body, theta), equilibrium(body, held(body)).ravel(), free) == 0
    )
