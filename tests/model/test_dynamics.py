"""Equations of motion: residuals and derivatives of all schemes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from kit.checks import directional_derivative
from kit.problems import (
    GRAVITY_M_S2,
    GUESS,
    TRUTH,
    as_theta,
    box,
    hung_cube,
    nodes_where,
    times,
    vertex_markers,
    with_papers_damping,
)

from collocation_sysid.fem.body import Body
from collocation_sysid.model.dynamics import Dynamics
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.recording import Experiment, Force, Grasp, PoseSequence

THETA = as_theta(TRUTH)
ELASTIC = {"lambda_pa": TRUTH["lambda_pa"], "mu_pa": TRUTH["mu_pa"]}


# The printed equations of backward Euler


@pytest.fixture(scope="module")
def backward_euler() -> tuple[Collocation, np.ndarray]:
    """Collocation of a cube of eight nodes, and positions (N, 3n) that satisfy nothing."""
    cube = hung_cube(steps=5, divisions=(1, 1, 1), start="undeformed")
    experiment = with_papers_damping(cube)
    collocation = Collocation([experiment], GUESS, "backward-euler")
    rng = np.random.default_rng(2)
    x = experiment.rigid_positions(experiment.t_s).reshape(len(experiment.t_s), -1)
    return collocation, x + 2e-3 * rng.normal(size=x.shape)


def stiffness(body: Body, x: np.ndarray) -> np.ndarray:
    return body.stiffness(x.reshape(-1, 3), **ELASTIC).toarray()


def test_residual_is_the_printed_equation_of_motion(backward_euler):
    collocation, x = backward_euler
    dynamics = collocation.transcriptions[0].dynamics.with_theta(THETA)
    body, step = dynamics.body, dynamics.step_s
    residual = dynamics.residual(x)
    for t in range(2, len(x)):
        v = (x[t] - x[t - 1]) / step
        a = (x[t] - 2 * x[t - 1] + x[t - 2]) / step**2
        elastic = body.elastic_force(x[t].reshape(-1, 3), **ELASTIC).ravel()
        damping = -TRUTH["gamma_r_s"] * stiffness(body, x[t]) @ v
        damping -= TRUTH["gamma_m_1_s"] * body.dof_mass * v
        weight = np.outer(body.node_mass, GRAVITY_M_S2).ravel()
        expected = elastic + damping + weight - body.dof_mass * a
        np.testing.assert_allclose(residual[t], expected, atol=1e-12 * np.abs(expected).max())


def test_first_step_takes_its_inertia_from_the_start_velocity(backward_euler):
    collocation, x = backward_euler
    dynamics = collocation.transcriptions[0].dynamics.with_theta(THETA)
    body, step = dynamics.body, dynamics.step_s
    force = body.force(x[1], (x[1] - x[0]) / step, THETA)[0] + dynamics.forces.weight.external_n[1]
    expected = force - body.dof_mass * (x[1] - x[0]) / step**2
    np.testing.assert_allclose(dynamics.residual(x)[1], expected, rtol=1e-12)


@pytest.mark.parametrize("lag", [0, 1, 2])
def test_jacobian_blocks_are_those_of_the_paper(backward_euler, lag: int):
    collocation, x = backward_euler
    transcription = collocation.transcriptions[0]
    body, step, free = transcription.body, transcription.dynamics.step_s, transcription.free_dofs
    z = collocation.pack(np.log(THETA), [x])
    jacobian = collocation.jacobian(z).toarray() * transcription.force_n / transcription.length_m
    t, mass = 4, np.diag(body.dof_mass)
    v = (x[t] - x[t - 1]) / step
    along_v = directional_derivative(lambda y: stiffness(body, y), x[t], v, step=1e-4)
    k, (_, _, gamma_r, gamma_m) = stiffness(body, x[t]), THETA
    inertia = mass / step**2
    expected = [
        -(1 + gamma_r / step) * k - gamma_r * along_v - gamma_m / step * mass - inertia,
        (gamma_r * k + gamma_m * mass) / step + 2 * inertia,
        -inertia,
    ][lag]
    rows = (t - transcription.dynamics.first_row) * transcription.constraints_per_time
    columns = collocation.nq + (t - lag) * transcription.dof_count
    block = jacobian[
        rows : rows + transcription.constraints_per_time,
        columns : columns + transcription.dof_count,
    ]
    np.testing.assert_allclose(block, expected[free], atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(block[:, free], block[:, free].T, atol=1e-12 * np.abs(block).max())


def test_residual_depends_on_nothing_older_than_two_steps_or_newer(backward_euler):
    collocation, x = backward_euler
    dynamics = collocation.transcriptions[0].dynamics.with_theta(THETA)
    before = dynamics.residual(x)
    moved = x.copy()
    moved[2] += 1e-3
    changed = np.abs(dynamics.residual(moved) - before).max(axis=1) > 0
    np.testing.assert_array_equal(changed, [False, False, True, True, True, False])


def test_constant_forces_add_to_gravity():
    push, nodes = np.array([1.0, -2.0, 0.5]), np.array([3, 7])
    plain, pushed = (
        Dynamics.from_experiment(hung_cube(forces=forces), "midpoint")
        for forces in ((), (Force(nodes, push),))
    )
    expected = np.zeros((27, 3))
    expected[nodes] = push / 2
    difference = pushed.forces.weight.external_n - plain.forces.weight.external_n
    np.testing.assert_allclose(difference, [expected.ravel()] * pushed.row_count, atol=1e-15)


# Conservation

FREE = np.array([200.0, 300.0, 0.0, 0.0])


def thrown_box(steps: int = 40, gravity_m_s2: Sequence[float] = GRAVITY_M_S2) -> Experiment:
    """A box in free flight, stretched and spinning at first."""
    body, t_s = box((0.04, 0.04, 0.12), (1, 1, 3)), times(steps, 0.004)
    arm = body.nodes_m - body.nodes_m.mean(axis=0)
    velocity = np.array([0.3, 0.2, 1.0]) + np.cross([2.0, -3.0, 1.0], arm)
    return Experiment(
        body,
        t_s,
        [],
        vertex_markers(body, [0], t_s),
        gravity_m_s2,
        start="given",
        start_positions_m=body.nodes_m + arm * [0.0, 0.0, 0.05],
        start_velocities_m_s=velocity,
    )


@pytest.mark.parametrize("scheme", ["backward-euler", "midpoint", "bdf2"])
def test_only_gravity_changes_the_momentum_of_a_body_in_flight(scheme: str):
    experiment = thrown_box()
    dynamics = Dynamics.from_experiment(experiment, scheme).with_theta([200.0, 300.0, 0.009, 0.0])
    x = simulate_scheme(experiment, dynamics)
    mass = experiment.body.node_mass
    centre = np.einsum("i,tij->tj", mass, x.reshape(len(x), -1, 3)) / mass.sum()
    acceleration = np.diff(centre, 2, axis=0) / dynamics.step_s**2
    settled = acceleration[20:]  # each step divides what BDF2 keeps of its start by three
    np.testing.assert_allclose(settled - GRAVITY_M_S2, 0, atol=1e-7)


def test_midpoint_keeps_the_angular_momentum_of_a_body_in_flight():
    experiment = thrown_box(gravity_m_s2=(0.0, 0.0, 0.0))
    dynamics = Dynamics.from_experiment(experiment, "midpoint").with_theta(FREE)
    x = simulate_scheme(experiment, dynamics)
    momentum = node_momenta(dynamics, x, FREE)
    angular = np.cross(x[1:].reshape(len(momentum), -1, 3), momentum).sum(axis=1)
    spread = np.ptp(angular, axis=0).max()
    assert spread < 1e-9 * np.linalg.norm(angular[0])


def node_momenta(dynamics: Dynamics, x: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """(N − 1, n, 3) momenta at the nodes of the midpoint rule's grid from t = 1."""
    v = np.diff(x, axis=0) / dynamics.step_s
    middle = (x[1:] + x[:-1]) / 2
    force = dynamics.body.force(middle, v, theta) + dynamics.forces.weight.external_n[1:]
    momentum = dynamics.body.dof_mass * v + force * dynamics.step_s / 2
    return momentum.reshape(len(v), -1, 3)


# Energy


def plucked_bar(steps: int = 60) -> Experiment:
    """A bar held still at one end, without gravity, started with a velocity."""
    body, t_s = box((0.04, 0.04, 0.12), (1, 1, 3)), times(steps, 0.005)
    velocity = np.outer(body.nodes_m[:, 2] / 0.12, [0.4, 0.1, -0.2])
    return Experiment(
        body,
        t_s,
        [Grasp(nodes_where(body, 2, 0.0), PoseSequence.fixed())],
        vertex_markers(body, nodes_where(body, 2, 0.12), t_s),
        np.zeros(3),
        start="given",
        start_positions_m=body.nodes_m,
        start_velocities_m_s=velocity,
    )


def energies(scheme: str, theta: np.ndarray) -> np.ndarray:
    """Kinetic plus elastic energy of the plucked bar at every grid time [J]."""
    experiment = plucked_bar()
    dynamics = Dynamics.from_experiment(experiment, scheme).with_theta(theta)
    x = simulate_scheme(experiment, dynamics)
    step, v0 = dynamics.step_s, dynamics.start_velocity_m_s
    if scheme == "midpoint":
        momenta = node_momenta(dynamics, x, theta).reshape(len(x) - 1, -1)
        held = np.setdiff1d(np.arange(x.shape[1]), experiment.free_dofs)
        momenta[:, held] = 0.0
        v = np.vstack([v0, momenta / dynamics.body.dof_mass])
    else:
        v = np.vstack([v0, np.diff(x, axis=0) / step])
        if scheme == "bdf2":
            v[2:] = (3 * x[2:] - 4 * x[1:-1] + x[:-2]) / (2 * step)
    kinetic = 0.5 * (v**2 @ dynamics.body.dof_mass)
    body = experiment.body
    elastic = [body.energy(state, lambda_pa=theta[0], mu_pa=theta[1]) for state in x]
    return kinetic + np.array(elastic)


@pytest.mark.parametrize("damping", [(0.0, 0.0), (0.002, 0.0), (0.0, 5.0), (0.002, 5.0)])
@pytest.mark.parametrize("scheme", ["backward-euler", "bdf2"])
def test_a_body_left_alone_never_gains_energy(scheme: str, damping: tuple[float, float]):
    energy = energies(scheme, np.array([200.0, 300.0, *damping]))
    assert np.diff(energy).max() <= 0


def test_midpoint_keeps_the_energy_of_an_undamped_body():
    energy = energies("midpoint", FREE)
    assert np.ptp(energy) < 1e-3 * energy[0]


def test_damping_with_the_papers_sign_feeds_energy_in():
    # The paper defines K = ∂f_e/∂x = −∂²Ψ/∂x² and damps with −γ_r K v.
    as_printed = energies("midpoint", np.array([200.0, 300.0, -2e-4, 0.0]))
    assert as_printed[-1] > 1.1 * as_printed[0]
    corrected = energies("midpoint", np.array([200.0, 300.0, 2e-4, 0.0]))
    assert corrected[-1] < 0.9 * corrected[0]


def test_damping_takes_power_out_at_any_velocity():
    body = box()
    rng = np.random.default_rng(3)
    x = body.nodes_m + 1e-3 * rng.normal(size=body.nodes_m.shape)
    v = rng.normal(size=(20, body.pattern.size))
    states = np.broadcast_to(x.ravel(), v.shape)
    for theta in (np.array([200.0, 300.0, 0.009, 0.0]), np.array([200.0, 300.0, 0.0, 1.0])):
        elastic = body.force(x, np.zeros_like(x), theta)[0]
        power = np.einsum("ti,ti->t", v, body.force(states, v, theta) - elastic)
        assert power.max() < 0
