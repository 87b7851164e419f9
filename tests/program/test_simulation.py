"""Forward simulation: orders of schemes, options and messages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problems import (
    EDGE_M,
    GRAVITY_M_S2,
    GUESS,
    IDEAL,
    TRUTH,
    as_theta,
    box,
    cube_with_gaps,
    hung_cube,
    nodes_where,
    prescribed_positions,
    smooth_poses,
    times,
    vertex_markers,
    with_papers_damping,
)
from scipy.spatial.transform import Rotation

from collocation_sysid.errors import InputError, SimulationError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.schemes import SCHEMES
from collocation_sysid.model.dynamics import Dynamics
from collocation_sysid.model.forces import Forces
from collocation_sysid.program.forward.initial_equilibrium import equilibrium
from collocation_sysid.program.forward.newton_solver import NewtonOptions, NewtonSolver
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Force, Grasp, PoseSequence, prescribed_nodes

THETA = as_theta(TRUTH)
ABSURDLY_SOFT = np.array([0.02, 0.03, 0.009, 1.0])
INTEGRATORS = ("newmark", *SCHEMES)


def hanging_bar() -> Experiment:
    """A bar hung from its top end."""
    body, t_s = box((0.04, 0.04, 0.12), (2, 2, 6)), times(2)
    grasp = Grasp(nodes_where(body, 2, 0.12), PoseSequence.fixed())
    markers = vertex_markers(body, [0], t_s)
    return Experiment(body, t_s, [grasp], markers, name="bar")


def jerked_cube(sway_m: float, timestep_s: float, **changes) -> Experiment:
    """A cube moved by several of its edges within a step."""
    body, t_s = box(), times(4, timestep_s)
    poses = smooth_poses(t_s, (sway_m, sway_m, 0.0), (0.0, 0.0, 5 * sway_m))
    return replace(
        hung_cube(4),
        t_s=t_s,
        grasps=(Grasp(nodes_where(body, 2, EDGE_M), poses),),
        markers=vertex_markers(body, [0], t_s),
        **changes,
    )


# Rest state


@pytest.mark.parametrize("young_pa", [1e5, 1e6])
def test_a_hanging_bar_stretches_by_half_its_weight(young_pa: float):
    bar = hanging_bar()
    x = equilibrium(bar, np.array([0.0, young_pa / 2, 0.0, 0.0])).reshape(
        -1, 3
    )  # Poisson's ratio 0
    tip = nodes_where(bar.body, 2, 0.0)
    stretch = (bar.body.nodes_m - x)[tip, 2].mean()
    assert stretch == pytest.approx(30.0 * 9.81 * 0.12**2 / (2 * young_pa), rel=1e-3)


def assert_stable_equilibrium(experiment: Experiment, theta: np.ndarray, x: np.ndarray) -> None:
    """No net force on free nodes, and a positive definite stiffness there."""
    body, solver = experiment.body, NewtonSolver(experiment)
    still = np.zeros_like(x)
    load = Forces.from_experiment(experiment, experiment.t_s[:1]).weight.external_n[0]
    net = (body.force(x, still, theta)[0] + load)[solver.free]
    assert np.abs(net).max() < 1e-9 * np.abs(load).max()
    stiffness = -body.linearise(x, still, theta).by_position[0]
    assert solver.factoriser.factorise(stiffness).positive_definite


@pytest.mark.parametrize("softness", [1, 10, 100])
def test_the_rest_state_is_a_stable_equilibrium(softness: int):
    cube, theta = (hung_cube(), np.array([200 / softness, 300 / softness, 0.0, 0.0]))
    assert_stable_equilibrium(cube, theta, equilibrium(cube, theta))


def test_the_rest_state_leaves_held_nodes_with_the_grasp():
    cube = hung_cube()
    x = equilibrium(cube, THETA, time_s=0.05).reshape(-1, 3)
    np.testing.assert_allclose(
        x[prescribed_nodes(cube.grasps)],
        prescribed_positions(cube, [0.05])[0].reshape(-1, 3),
        rtol=1e-15,
    )


def test_where_newton_fails_the_load_is_applied_in_steps():
    cube, soft = hung_cube(), np.array([2.0, 3.0, 0.0, 0.0])
    direct = equilibrium(cube, soft)
    hurried = NewtonOptions(max_iterations=3)
    in_steps = equilibrium(cube, soft, solver=NewtonSolver(cube, hurried))
    np.testing.assert_allclose(in_steps, direct, atol=1e-9)
    with pytest.raises(
        SimulationError, match="initial equilibrium failed: Newton's method took more than 3"
    ):
        equilibrium(cube, soft, solver=NewtonSolver(cube, replace(hurried, max_halvings=0)))


def test_an_unloaded_body_rests_where_the_grasp_carries_the_mesh():
    cube = hung_cube(gravity_m_s2=np.zeros(3))
    x = equilibrium(cube, THETA, time_s=0.07)
    np.testing.assert_allclose(x, cube.rigid_positions([0.07]).ravel(), atol=1e-12)


def test_external_forces_deform_the_rest_state():
    weight = box().node_mass[:, None] * np.array(GRAVITY_M_S2)
    carried = hung_cube(forces=tuple(Force([k], -w) for k, w in enumerate(weight)))
    np.testing.assert_allclose(
        equilibrium(carried, THETA), carried.body.nodes_m.ravel(), atol=1e-12
    )


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_body_at_rest_stays_there(integrator: str):
    cube = hung_cube()
    still = replace(cube, grasps=(Grasp(prescribed_nodes(cube.grasps), PoseSequence.fixed()),))
    motion = simulate(still, TRUTH, integrator)
    expected = np.broadcast_to(motion.positions_m[0], motion.positions_m.shape)
    np.testing.assert_allclose(motion.positions_m, expected, atol=1e-9)
    np.testing.assert_allclose(motion.velocities_m_s, 0, atol=1e-7)


def bar_in_two_grasps(
    way_m: tuple[float, float, float], turn_rad: tuple[float, float, float], element: str = "tet4"
) -> Experiment:
    """A bar of small elements, one end held and the other moved and turned about its middle."""
    divisions = (12, 4, 4) if element == "tet4" else (6, 2, 2)
    body, t_s = box((0.15, 0.05, 0.05), divisions, element), times(2)
    middle, turn = (np.array([0.15, 0.025, 0.025]), Rotation.from_rotvec(turn_rad))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = (turn.as_matrix(), middle + way_m - turn.apply(middle))
    grasps = [
        Grasp(nodes_where(body, 0, 0.0), PoseSequence.fixed()),
        Grasp(nodes_where(body, 0, 0.15), np.tile(pose, (len(t_s), 1, 1))),
    ]
    return Experiment(body, t_s, grasps, vertex_markers(body, [0], t_s), nuisance=IDEAL)


STRAINED = {
    "stretched": ((0.045, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "compressed": ((-0.015, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "twisted": ((0.0, 0.0, 0.0), (0.5 * np.pi, 0.0, 0.0)),
    "twisted nearly half a turn": ((0.0, 0.0, 0.0), (3.0, 0.0, 0.0)),
    "bent": ((-0.01, 0.0, -0.05), (0.0, 1.2, 0.0)),
}


@pytest.mark.parametrize("way", STRAINED)
def test_two_grasps_may_strain_the_body_at_the_start(way: str):
    bar, theta = (bar_in_two_grasps(*STRAINED[way]), np.array([2e4, 3e4, 0.0, 0.0]))
    x = equilibrium(bar, theta)
    assert_stable_equilibrium(bar, theta, x)
    at = x.reshape(-1, 3)[prescribed_nodes(bar.grasps)]
    np.testing.assert_allclose(
        at, prescribed_positions(bar, [0.0])[0].reshape(-1, 3), rtol=1e-15, atol=1e-17
    )


def test_quadratic_elements_may_be_strained_at_the_start_too():
    bar = bar_in_two_grasps((0.06, 0.0, 0.0), (1.0, 0.0, 0.0), "tet10")
    theta = np.array([2e4, 3e4, 0.0, 0.0])
    assert_stable_equilibrium(bar, theta, equilibrium(bar, theta))


def test_a_stretched_bar_pulls_as_its_material_does():
    bar, young_pa, stretch = (bar_in_two_grasps((0.03, 0.0, 0.0), (0.0, 0.0, 0.0)), 6e4, 1.2)
    light = replace(bar, gravity_m_s2=np.zeros(3))
    theta = np.array([0.0, young_pa / 2, 0.0, 0.0])  # Poisson's ratio 0: no lateral strain
    x = equilibrium(light, theta)
    force = light.body.force(x, np.zeros_like(x), theta)[0].reshape(-1, 3)
    pull = force[nodes_where(light.body, 0, 0.15), 0].sum()
    # ψ = ½ μ (tr FᵀF − 3) − μ ln J: P = μ (s − 1/s) over the undeformed cross-section.
    nominal = young_pa / 2 * (stretch - 1 / stretch)
    assert -pull == pytest.approx(nominal * 0.05**2, rel=1e-3)


# Motion


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_body_thrown_along_with_its_grasp_stays_undeformed(integrator: str):
    cube, speed = hung_cube(), np.array([0.5, -0.2, 0.3])
    t_s = cube.t_s
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    poses = PoseSequence(t_s, np.outer(t_s, speed), upright)
    thrown = replace(
        cube,
        grasps=(Grasp(prescribed_nodes(cube.grasps), poses),),
        gravity_m_s2=np.zeros(3),
        start="given",
        start_positions_m=cube.body.nodes_m,
        start_velocities_m_s=np.broadcast_to(speed, cube.body.nodes_m.shape),
    )
    motion = simulate(thrown, {**TRUTH, "gamma_m_1_s": 0.0}, integrator)
    np.testing.assert_allclose(motion.positions_m, thrown.rigid_positions(t_s), atol=1e-10)
    np.testing.assert_allclose(
        motion.velocities_m_s, np.broadcast_to(speed, motion.velocities_m_s.shape), atol=1e-7
    )


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_thrown_body_starts_with_the_stated_velocity_and_spin(integrator: str):
    cube = replace(hung_cube(), grasps=(), start="undeformed", air_density_kg_m3="none")
    velocity, spin = np.array([0.5, -0.2, 3.0]), np.array([0.3, -0.4, 0.5])
    places_m, mass_kg = cube.body.nodes_m, cube.body.node_mass
    middle_m = mass_kg @ places_m / mass_kg.sum()
    thrown = replace(cube, start_velocity_m_s=velocity, start_spin_rad_s=spin)
    started = np.cross(spin, places_m - middle_m) + velocity
    initial_m_s = thrown.initial_velocities_m_s
    assert initial_m_s is not None
    np.testing.assert_allclose(initial_m_s, started, atol=1e-14)
    motion = simulate(thrown, {**TRUTH, "gamma_m_1_s": 0.0}, integrator, substeps=2)
    t_s = cube.t_s[:, None] - cube.t_s[0]
    flight_m = middle_m + velocity * t_s + thrown.gravity_m_s2 / 2 * t_s**2
    middles_m = mass_kg @ motion.positions_m / mass_kg.sum()
    damped = integrator in ("bdf2", "backward-euler")
    np.testing.assert_allclose(middles_m, flight_m, atol=5e-3 if damped else 1e-9)
    turned_m = Rotation.from_rotvec(spin * t_s[-1]).apply(places_m - middle_m)
    np.testing.assert_allclose(motion.positions_m[-1] - middles_m[-1], turned_m, atol=1e-3)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_held_nodes_follow_their_grasp(integrator: str):
    cube = hung_cube()
    motion = simulate(cube, TRUTH, integrator)
    np.testing.assert_allclose(
        motion.positions_m[:, prescribed_nodes(cube.grasps)],
        prescribed_positions(cube, cube.t_s).reshape(len(cube.t_s), -1, 3),
        atol=1e-15,
    )


def test_markers_are_observed_at_every_sample_also_where_none_was_measured():
    cube = cube_with_gaps()
    motion = simulate(cube, TRUTH, "midpoint", substeps=2)
    assert motion.markers_m.shape == cube.markers.positions_m.shape
    assert np.isfinite(motion.markers_m).all()
    np.testing.assert_array_equal(motion.t_s, cube.t_s)
    np.testing.assert_allclose(motion.markers_m, cube.markers.predict_positions(motion.positions_m))


def test_velocities_are_the_slopes_of_the_positions():
    cube = hung_cube(20)
    motion = simulate(cube, TRUTH, timestep_s=0.001)
    slopes = (motion.positions_m[2:] - motion.positions_m[:-2]) / (2 * cube.timestep_s)
    error = np.abs(motion.velocities_m_s[1:-1] - slopes).max()
    assert error < 0.1 * np.abs(slopes).max()


def test_parameters_may_be_guesses_names_or_numbers():
    cube = hung_cube(3)
    by_name = simulate(cube, TRUTH).positions_m
    np.testing.assert_array_equal(simulate(cube, THETA).positions_m, by_name)
    np.testing.assert_allclose(
        simulate(cube, GUESS.with_guess(TRUTH)).positions_m, by_name, atol=1e-13
    )


def test_progress_is_reported_up_to_one():
    for integrator in INTEGRATORS:
        shares: list[float] = []
        simulate(hung_cube(4), TRUTH, integrator, substeps=1, progress=shares.append)
        assert shares == pytest.approx([0.25, 0.5, 0.75, 1.0])


def test_progress_with_automatic_steps_never_decreases():
    shares: list[float] = []
    simulate(hung_cube(4), TRUTH, "newmark", progress=shares.append)
    assert len(shares) > 8  # more than one pass
    assert shares == sorted(shares)
    assert 0 < shares[0] < shares[-1] <= 1


# Large steps


def test_newmark_evaluates_loads_and_poses_of_all_steps_at_once(monkeypatch):
    made, posed = [], []
    from_experiment, at = Forces.from_experiment.__func__, PoseSequence.at

    def forces(*arguments, **by_name):
        made.append(arguments)
        return from_experiment(*arguments, **by_name)

    monkeypatch.setattr(Forces, "from_experiment", classmethod(forces))
    monkeypatch.setattr(PoseSequence, "at", lambda *given: posed.append(given) or at(*given))

    def counts(samples):
        made.clear()
        posed.clear()
        simulate(hung_cube(samples), TRUTH, "newmark", substeps=2)
        return len(made), len(posed)

    assert counts(8) == counts(4)


def test_newmark_halves_steps_that_are_too_large():
    cube = jerked_cube(0.35, timestep_s=0.04)
    motion = simulate(cube, TRUTH, timestep_s=0.04)
    assert cube.body.volume_ratios(motion.positions_m).min() > 0
    np.testing.assert_allclose(
        motion.positions_m[:, prescribed_nodes(cube.grasps)],
        prescribed_positions(cube, cube.t_s).reshape(len(cube.t_s), -1, 3),
        atol=1e-15,
    )
    with pytest.raises(SimulationError, match="an element is inverted before the first iter"):
        simulate(cube, TRUTH, timestep_s=0.04, options=NewtonOptions(max_halvings=0))


def test_a_scheme_moves_the_grasp_in_parts_where_a_step_is_too_large():
    cube = with_papers_damping(jerked_cube(0.45, timestep_s=0.02))
    dynamics = Dynamics.from_experiment(cube, "midpoint").with_theta(THETA)
    x = simulate_scheme(cube, dynamics)
    residual = dynamics.residual(x)[:, NewtonSolver(cube).free]
    assert np.abs(residual).max() < 1e-9 * np.abs(dynamics.forces.weight.external_n).max()
    with pytest.raises(SimulationError, match="time step 3 failed: an element is inverted"):
        simulate_scheme(cube, dynamics, NewtonOptions(max_halvings=0))


def test_a_thin_plate_of_steel_moves_although_its_steps_exceed_the_period_of_its_modes():
    size_m, timestep_s = (0.1, 0.01, 0.0005), 0.004
    body = Body(box_mesh(size_m, (4, 1, 1)), density_kg_m3=7850.0, element="tet10")
    t_s = times(12, timestep_s)
    plucked = PoseSequence([0.0, 1.0], [[0.0, 0.0, 0.004]] * 2, [[0.0, 0.0, 0.0, 1.0]] * 2)
    tip = np.flatnonzero((body.nodes_m[:, 0] > 0.0999) & (body.nodes_m[:, 2] < 1e-6))
    at_tip = Grasp(tip, plucked, axes="z", until_s=2.5 * timestep_s)
    clamped = Grasp(nodes_where(body, 0, 0.0), PoseSequence.fixed())
    markers = vertex_markers(body, [0], t_s)
    plate = Experiment(body, t_s, [clamped, at_tip], markers, gravity_m_s2=(0, 0, 0))
    moduli = {"mu_pa": 8e10, "lambda_pa": 1.2e11, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    dynamics = Dynamics.from_experiment(plate, "midpoint").with_theta(
        body.theta_from_values(moduli)
    )
    with pytest.raises(SimulationError, match="no step along the Newton"):
        simulate_scheme(plate, dynamics, NewtonOptions(max_halvings=0))
    x = simulate_scheme(plate, dynamics)
    residual = dynamics.residual(x)[5:, NewtonSolver(plate).free]
    assert np.abs(residual).max() < 1e-6  # N; the tip was held by 0.3 N


# Failures


@pytest.mark.long
def test_a_missing_rest_state_names_time_and_element():
    cube = hung_cube()
    with pytest.raises(SimulationError, match=r"loses its stability.*element") as caught:
        simulate(cube, ABSURDLY_SOFT)
    assert caught.value.time_s == 0.0
    assert 0 <= (caught.value.element or 0) < len(cube.body.cells)
    assert f"(t = 0 s, element {caught.value.element})" in str(caught.value)


@pytest.mark.parametrize(
    ("integrator", "message"),
    [
        ("newmark", "a time step of the Newmark method failed"),
        ("backward-euler", "time step . failed"),
    ],
)
def test_a_failed_step_names_time_and_element(integrator: str, message: str):
    violent = jerked_cube(2.0, timestep_s=0.04, start="undeformed")
    with pytest.raises(SimulationError, match=message) as caught:
        simulate(violent, ABSURDLY_SOFT, integrator, timestep_s=0.04, substeps=1)
    assert 0.0 <= caught.value.time_s <= violent.t_s[-1]
    assert caught.value.element is not None
    assert f"element {caught.value.element})" in str(caught.value)


def test_unknown_integrators_are_refused():
    with pytest.raises(InputError, match="no scheme 'rk4'"):
        simulate(hung_cube(), TRUTH, "rk4")


def test_other_tracks_must_have_the_markers_shape():
    cube = hung_cube(10)
    tracks = np.ones_like(cube.markers.positions_m)
    np.testing.assert_array_equal(with_markers(cube, tracks).markers.positions_m, tracks)
    with pytest.raises(InputError, match=r"shape \(10, 9, 3\); expected \(11, 9, 3\)"):
        with_markers(cube, tracks[1:])
