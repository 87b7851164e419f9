"""Physics of contact: pressure, friction and rest."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from kit.contact import moved, quarter, sensor
from kit.problems import EDGE_M, IDEAL, TRUTH, as_theta, box, nodes_where, pressed_cube
from scipy.optimize import brentq, minimize
from study_contact import cylinder, sphere, sphere_on_half_space

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.model.contact.force import contact_terms
from collocation_sysid.model.contact.summary import friction_summaries
from collocation_sysid.model.dynamics import Dynamics
from collocation_sysid.model.force_term import States
from collocation_sysid.model.forces import Forces
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import (
    Capsule,
    Cuboid,
    Cylinder,
    Experiment,
    Grasp,
    Obstacle,
    Plane,
    PoseSequence,
    Sphere,
)

G_M_S2 = 9.81
UP = np.array([0.0, 0.0, 1.0])
ENDS = np.array([(0.05, 0.0, -0.1), (0.1, 0.1, 0.2)])
CORNERS = np.array([(-0.3, -0.2, -0.1), (0.3, 0.2, 0.4)])
SOLIDS = {
    "plane": Plane(np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3])),
    "sphere": Sphere(0.2, np.array([0.1, 0.0, 0.0])),
    "cylinder": Cylinder(0.15, ENDS),
    "rounded cylinder": Cylinder(0.15, ENDS, 0.05),
    "capsule": Capsule(0.15, ENDS),
    "box": Cuboid(CORNERS),
    "rounded box": Cuboid(CORNERS, 0.08),
}


# Solids --------------------------------------------------------------------------------------


def gaps(solid, points_m) -> tuple[np.ndarray, np.ndarray]:
    """Gaps (i,) of points (i, 3), and their slopes (3, i)."""
    point = ca.SX.sym("point", 3)
    gap = solid.signed_distance(point)
    both = ca.Function("both", [point], [gap, ca.gradient(gap, point)]).map(len(points_m))
    value, slope = both(points_m.T)
    return np.array(value)[0], np.array(slope)


@pytest.mark.parametrize("name", SOLIDS)
def test_a_gap_is_a_distance_from_the_surface(name):
    """Along its slope, which is of length one, lies the surface; and no nearer a point of it."""
    solid, rng = SOLIDS[name], np.random.default_rng(0)
    points = rng.uniform(-0.6, 0.6, (2000, 3))
    gap, slope = gaps(solid, points)
    np.testing.assert_allclose(np.linalg.norm(slope, axis=0), 1.0, atol=1e-9)
    foot = points - (gap * slope).T
    np.testing.assert_allclose(gaps(solid, foot)[0], 0.0, atol=1e-9)
    for point, distance in zip(points[:50], gap[:50], strict=True):
        assert np.linalg.norm(foot - point, axis=1).min() >= abs(distance) - 1e-9


@pytest.mark.parametrize("name", ["cylinder", "box"])
def test_rounding_takes_edges_away_and_leaves_sides(name):
    sharp, rounded = SOLIDS[name], SOLIDS[f"rounded {name}"]
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (2000, 3))
    more = gaps(rounded, points)[0] - gaps(sharp, points)[0]
    assert more.min() > -1e-9
    # At an edge of a box √2 − 1 roundings, at a corner √3 − 1.
    farthest = {"cylinder": np.sqrt(2) - 1, "box": np.sqrt(3) - 1}[name]
    assert more.max() <= farthest * rounded.rounding_m + 1e-9
    assert np.mean(np.abs(more) < 1e-9) > 0.1


# Force and energy ----------------------------------------------------------------------------


def pushed(friction: float = 0.0) -> tuple[Experiment, States]:
    """A cube into which a ball and a turned plate have come, and which moves against them."""
    experiment = pressed_cube(friction=friction)
    rng = np.random.default_rng(0)
    x = experiment.rigid_positions(experiment.t_s[-1:])
    own = len(experiment.body.nodes.points_m)
    x[:, :own] += rng.uniform(-0.002, 0.002, (own, 3))
    x[:, :own, 2] += 0.008
    nu = rng.normal(scale=0.1, size=(1, x.size))
    return experiment, States(x.reshape(1, -1), nu, as_theta(TRUTH))


def energy_j(term, x) -> float:
    """Ψ, by its formula and the solid's gap alone."""
    law, body = term.law_of_contact, term.law_of_contact.body
    from_origin = term.points.vectors(x[None])[:3, 0].T
    origin, *ends = x.reshape(-1, 3)[law.obstacle.nodes]
    axes = (np.array(ends) - origin) / (body.frame_nodes_m[1, 0] - body.frame_nodes_m[0, 0])
    gap, _ = gaps(law.obstacle.shape, from_origin @ axes.T + body.frame_nodes_m[0])
    kappa = law.obstacle.stiffness_pa_m
    if kappa is None:
        young_pa = TRUTH["mu_pa"] * (3 * 200 + 2 * 300) / (200 + 300)
        kappa = 100 * young_pa / law.edges_m
    return float((law.surface.area_m2 * kappa * cubed_m2(gap, law.widths_m)).sum())


def cubed_m2(gap, width_m):
    """Ψ over A κ."""
    return (np.maximum(width_m - gap, 0) ** 3 - np.maximum(-gap, 0) ** 3) / (3 * width_m)


@pytest.mark.parametrize("which", [0, 1])
def test_a_contact_force_is_the_slope_of_its_energy(which):
    experiment, states = pushed()
    term = contact_terms(experiment)[which]
    force, x = term.force(states)[0], states.xi[0]
    assert energy_j(term, x) > 0
    ways = np.random.default_rng(1).normal(size=(6, len(x)))
    step = 1e-7
    slopes = [
        (energy_j(term, x + step * w) - energy_j(term, x - step * w)) / (2 * step) for w in ways
    ]
    np.testing.assert_allclose(-ways @ force, slopes, rtol=1e-6)


@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_body_and_obstacle_exchange_equal_impulses(friction):
    experiment, states = pushed(friction)
    places = states.xi.reshape(-1, 3)
    for term in contact_terms(experiment):
        force = term.force(states).reshape(-1, 3)
        assert np.abs(force).max() > 1e-4
        np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-12)
        np.testing.assert_allclose(np.cross(places, force).sum(axis=0), 0.0, atol=1e-12)


def test_friction_dissipates_and_stays_within_its_cone():
    experiment, states = pushed(0.4)
    smooth, _ = pushed()
    rubbing, pressing = contact_terms(experiment)[0], contact_terms(smooth)[0]
    along = (rubbing.force(states) - pressing.force(states))[0]
    assert along @ states.nu[0] < 0
    own = slice(3 * len(experiment.body.nodes.points_m))
    most = 0.4 * np.linalg.norm(pressing.force(states)[0, own].reshape(-1, 3), axis=1).sum()
    assert np.linalg.norm(along[own].reshape(-1, 3).sum(axis=0)) <= most


@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_a_step_with_near_points_has_the_contact_force_of_all_points(friction):
    experiment, states = pushed(friction)
    forces = Forces.from_experiment(experiment, experiment.t_s[-1:], states.theta)
    rest = forces.without_local_forces()
    near = forces.local_forces()
    assert len(near.parts) == 2
    rates = (0.7, 30.0)
    force, *parts = near.linearise(states.xi, states.nu, rates)
    whole, other = (each.linearise(states.xi, states.nu) for each in (forces, rest))
    own = np.arange(states.xi.size) < 3 * len(experiment.body.nodes.points_m)
    between = own[forces.pattern.rows] & own[forces.pattern.columns]
    pairs = (("by_position", "by_velocity"), ("by_position_skew", "by_velocity_skew"))
    for part, names in zip(parts, pairs, strict=True):
        by = [(getattr(whole, name) - getattr(other, name))[0] for name in names]
        known = np.zeros(len(between))
        for rate, slope in zip(rates, by, strict=True):
            known += rate * (slope if slope.size else 0.0)
        shown = part[between] if part.size else np.zeros(between.sum())
        np.testing.assert_allclose(shown, known[between], atol=1e-12 * np.abs(parts[0]).max())
    expected = (whole.force - other.force)[0]
    np.testing.assert_allclose(force[own], expected[own], atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(near.force(states.xi, states.nu), force)


def test_a_sensor_of_an_obstacle_reads_the_sum_of_its_contact_forces():
    experiment = pressed_cube(friction=0.4)
    grasps = [replace(g, wrench=sensor(experiment.t_s)) for g in experiment.grasps]
    experiment = replace(experiment, grasps=grasps)
    seen = simulate(experiment, TRUTH, "backward-euler", substeps=1)
    x = seen.positions_m.reshape(len(seen.t_s), -1)
    nu = np.diff(x, axis=0, prepend=x[:1]) / experiment.timestep_s
    terms = contact_terms(experiment)
    own = slice(len(experiment.body.nodes.points_m))
    for term, read in zip(terms, seen.wrenches[1:], strict=True):
        force = term.force(States(x, nu, as_theta(TRUTH))).reshape(len(x), -1, 3)[:, own]
        total = force.sum(axis=1)
        torque = np.cross(seen.positions_m[:, own], force).sum(axis=1)
        assert np.abs(total[1:]).max() > 1e-3
        known: np.ndarray = np.all(np.isfinite(read), axis=1)
        assert known[2:].all()
        np.testing.assert_allclose(read[known], np.hstack([total, torque])[known], atol=1e-9)


# Platens -------------------------------------------------------------------------------------

PRESSED_M = np.array([0.0, 0.005, 0.01, 0.02])


def platens(body: Body, friction: float = 0.0, **changes) -> Experiment:
    """A quarter of a block between a plate at rest and one that comes down on it."""
    t_s = np.arange(len(PRESSED_M), dtype=float)
    settings = {"friction": friction, "wrench": sensor(t_s), "slip": 1e-7 if friction else None}
    below = Obstacle(shape=Plane(), name="below", **settings)
    down = moved(t_s, np.outer(PRESSED_M, [0.0, 0.0, -1.0]))
    above = Obstacle(poses=down, shape=Plane(-UP, EDGE_M * UP), name="above", **settings)
    return Experiment(
        body,
        t_s,
        [*quarter(body), below, above],
        kind="static",
        gravity_m_s2=(0.0, 0.0, 0.0),
        nuisance=IDEAL,
        **changes,
    )


def squeezed(gap_m: float) -> tuple[float, float, float]:
    """Stretches along and across, and pressure, of a block whose platens are that much nearer."""
    mu, lame, edge_m = TRUTH["mu_pa"], TRUTH["lambda_pa"], 0.1
    young_pa = mu * (3 * lame + 2 * mu) / (lame + mu)
    edges_m = np.array([1.0, 1.0, np.sqrt(2)]) * edge_m / 2
    kappa, delta = 100 * young_pa / edges_m.mean(), 0.0002 * edges_m.mean()

    def across(along: float) -> float:
        def stress(b: float) -> float:
            return mu * (b - 1 / b) + lame * np.log(along * b * b) / b

        return float(brentq(stress, 0.5, 2.0, xtol=1e-15))  # type: ignore[arg-type]

    def pressure(along: float) -> float:
        b = across(along)
        return -(mu * (along - 1 / along) + lame * np.log(along * b * b) / along)

    def unbalanced(along: float) -> float:
        gap = (edge_m - gap_m - along * edge_m) / 2
        return pressure(along) - kappa / delta * (max(delta - gap, 0) ** 2 - max(-gap, 0) ** 2)

    along = float(brentq(unbalanced, 0.5, 1.0, xtol=1e-15))  # type: ignore[arg-type]
    return along, across(along), pressure(along)


@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_a_block_between_smooth_platens_is_squeezed_evenly(element):
    """As the law of the material and that of the contact say, both of them known in closed form."""
    experiment = platens(box(element=element))
    seen = simulate(experiment, TRUTH)
    own = len(experiment.body.nodes.points_m)
    for k, gap_m in enumerate(PRESSED_M):
        along, across, pressure_pa = squeezed(gap_m)
        expected = experiment.body.nodes_m[:own] * [across, across, along]
        expected[:, 2] += (EDGE_M - gap_m - along * EDGE_M) / 2
        np.testing.assert_allclose(seen.positions_m[k, :own], expected, atol=1e-10)
        for read, sign in zip(seen.wrenches, (1, -1), strict=True):
            assert read[k, 2] == pytest.approx(sign * pressure_pa * EDGE_M**2, rel=1e-6)


def test_platens_that_rub_enough_stick():
    experiment = platens(box(), friction=2.0)
    ends = [nodes_where(experiment.body, 2, height) for height in (0.0, EDGE_M)]
    sides = [replace(g, nodes=np.setdiff1d(g.nodes, np.concatenate(ends))) for g in quarter(box())]
    poses = [PoseSequence.fixed(), experiment.obstacles[1].poses]
    glued = [Grasp(n, p, wrench=sensor(experiment.t_s)) for n, p in zip(ends, poses, strict=True)]
    held = Experiment(
        box(),
        experiment.t_s,
        [*glued, *sides],
        kind="static",
        gravity_m_s2=(0, 0, 0),
        nuisance=IDEAL,
    )
    (rubbed, stuck, smooth) = (
        simulate(each, TRUTH).wrenches[1][-1, 2] for each in (experiment, held, platens(box()))
    )
    assert rubbed == pytest.approx(stuck, rel=0.01)
    assert abs(smooth - stuck) > 0.02 * abs(stuck)


# An independent answer -----------------------------------------------------------------------


def test_stiffer_contact_converges_to_complementarity():
    """The least elastic energy of all shapes of which no point of contact is in the ball."""
    body, t_s = box(divisions=(2, 2, 1)), np.zeros(1)
    held = Grasp(nodes_where(body, 2, 0.0), PoseSequence.fixed())
    ball = Sphere(0.08, np.array([0.04, 0.05, EDGE_M + 0.07]))

    def pressed(stiffness_pa_m: float, width_m: float) -> Experiment:
        obstacle = Obstacle(
            shape=ball, stiffness_pa_m=stiffness_pa_m, width_m=width_m, wrench=sensor(t_s)
        )
        still = {"kind": "static", "gravity_m_s2": (0.0, 0.0, 0.0), "nuisance": IDEAL}
        return Experiment(body, t_s, [held, obstacle], **still)

    points = contact_terms(pressed(1.0, 1e-4))[0].points
    own = len(body.nodes_m)
    free = np.setdiff1d(np.arange(3 * own), held.prescribed_dofs)
    elastic = {name: TRUTH[name] for name in ("lambda_pa", "mu_pa")}
    start = np.append(body.nodes_m, np.zeros((4, 3)), axis=0).ravel()

    # In centimetres and 0.1 mJ, so that its numbers are near one.
    def whole(q_cm):
        x = start.copy()
        x[free] = q_cm / 100
        return x

    def nodes(q_cm):
        return whole(q_cm)[: 3 * own].reshape(-1, 3)

    def pull_n(q_cm):
        return -body.elastic_force(nodes(q_cm), **elastic)

    def outside(q_cm):
        return gaps(ball, points.vectors(whole(q_cm)[None])[:3, 0].T)

    rows = points.vectors(np.eye(len(start)))[:3]
    best = minimize(
        lambda q_cm: 1e4 * body.energy(nodes(q_cm), **elastic),
        100 * start[free],
        jac=lambda q_cm: 100 * pull_n(q_cm).ravel()[free],
        constraints={
            "type": "ineq",
            "fun": lambda q_cm: 100 * outside(q_cm)[0],
            "jac": lambda q_cm: np.einsum("ai,axi->ix", outside(q_cm)[1], rows)[:, free],
        },
        method="SLSQP",
        options={"ftol": 1e-12, "maxiter": 300},
    )
    assert best.success, best.message
    hard_n = pull_n(best.x)[np.setdiff1d(np.arange(own), held.nodes)].sum(axis=0)
    misses = []
    for law in ((1e6, 1e-4), (1e7, 3e-5), (1e8, 1e-5)):
        seen = simulate(pressed(*law), TRUTH)
        apart_m = np.abs(seen.positions_m[0, :own] - nodes(best.x)).max()
        misses.append((apart_m, np.linalg.norm(seen.wrenches[0][0, :3] - hard_n)))
    assert (np.diff(misses, axis=0) < 0).all()
    assert misses[-1][0] < 5e-5
    assert misses[-1][1] < 2e-3 * np.linalg.norm(hard_n)


# Bodies that are let go ----------------------------------------------------------------------

RUBBER = {"lambda_pa": 2e4, "mu_pa": 3e4, "gamma_r_s": 0.005, "gamma_m_1_s": 1e-6}
SPONGE = {"lambda_pa": 2e3, "mu_pa": 3e3, "gamma_r_s": 0.005, "gamma_m_1_s": 0.01}


def laid(
    body: Body, steps: int, above_m: float = 0.0, tilt_rad: float = 0.0, friction: float = 0.0
):
    """Let go above a table, which is tilted by tilting gravity instead."""
    t_s = 0.005 * np.arange(steps + 1)
    table = Obstacle(shape=Plane(UP, -above_m * UP), friction=friction, wrench=sensor(t_s))
    gravity = G_M_S2 * np.array([np.sin(tilt_rad), 0.0, -np.cos(tilt_rad)])
    return Experiment(body, t_s, [table], gravity_m_s2=gravity, start="undeformed", nuisance=IDEAL)


def energies_j(experiment: Experiment, positions_m: np.ndarray, scheme: str) -> np.ndarray:
    """All of it at each step: of motion, of height, of the body and of the contact."""
    body, law = experiment.body, contact_terms(experiment)[0]
    own, mass, step_s = (len(body.nodes.points_m), body.node_mass, experiment.timestep_s)
    elastic = {name: SPONGE[name] for name in ("lambda_pa", "mu_pa")}
    young_pa = 3e3 * (3 * 2e3 + 2 * 3e3) / (2e3 + 3e3)
    kappa, delta = (100 * young_pa / law.law_of_contact.edges_m, law.law_of_contact.widths_m)
    above_m = law.points.vectors(positions_m.reshape(len(positions_m), -1))[2]
    gap = above_m + body.frame_nodes_m[0, 2] + 0.005
    still = (law.law_of_contact.surface.area_m2 * kappa * cubed_m2(gap, delta)).sum(axis=1)
    still += G_M_S2 * (mass * positions_m[..., 2]).sum(axis=1)
    still += [box().energy(x[:own], **elastic) for x in positions_m]
    x = positions_m
    if scheme == "bdf2":
        v, still = (3 * x[2:] - 4 * x[1:-1] + x[:-2]) / (2 * step_s), still[2:]
    else:
        v = np.diff(x, axis=0) / step_s
        still = (still[1:] + still[:-1]) / 2 if scheme == "midpoint" else still[1:]
    return still + (mass[:, None] * v**2).sum(axis=(1, 2)) / 2


@pytest.mark.parametrize("scheme", ["backward-euler", "bdf2"])
def test_a_body_let_go_onto_a_table_comes_to_rest_under_its_weight(scheme):
    experiment = laid(box(), 200, above_m=0.005)
    seen = simulate(experiment, SPONGE, scheme, substeps=1)
    weight_n = experiment.body.mass_kg * G_M_S2
    force_n = seen.wrenches[0]
    assert np.nanmax(force_n[:, 2]) > 3 * weight_n
    known = force_n[np.isfinite(force_n[:, 2])]
    np.testing.assert_allclose(known[-10:, 2], weight_n, rtol=1e-6)
    np.testing.assert_allclose(known[-10:, :2], 0.0, atol=1e-6 * weight_n)
    energy_j = energies_j(experiment, seen.positions_m, scheme)
    fallen_j = weight_n * 0.005
    assert np.diff(energy_j).max() < 1e-6 * fallen_j
    assert energy_j[-1] < energy_j[0] - 0.9 * fallen_j


def mechanical_j(experiment: Experiment, seen, law) -> np.ndarray:
    """Energy of motion, of height and of the body at each sample: all but that of contact."""
    body = experiment.body
    own, mass = len(body.nodes.points_m), body.node_mass
    elastic = {name: law[name] for name in ("lambda_pa", "mu_pa")}
    energy_j = G_M_S2 * (mass * seen.positions_m[..., 2]).sum(axis=1)
    energy_j += [box().energy(x[:own], **elastic) for x in seen.positions_m]
    return energy_j + (mass[:, None] * seen.velocities_m_s**2).sum(axis=(1, 2)) / 2


@pytest.mark.long
@pytest.mark.parametrize("stiffer", [1.0, 10.0])
@pytest.mark.parametrize(
    ("integrator", "options"),
    [("newmark", {}), ("newmark", {"timestep_s": 0.005}), ("midpoint", {})],
)
def test_an_undamped_body_that_falls_on_a_table_never_gains_energy(integrator, options, stiffer):
    law = {"lambda_pa": 2e3 * stiffer, "mu_pa": 3e3 * stiffer, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    experiment = laid(box(), 60, above_m=0.02)
    seen = simulate(experiment, law, integrator, **options)
    energy_j = mechanical_j(experiment, seen, law)
    fallen_j = experiment.body.mass_kg * G_M_S2 * 0.02
    assert energy_j.max() < energy_j[0] + 0.02 * fallen_j
    if integrator == "newmark":
        # Its velocities are those at the samples: little is lost either.
        assert energy_j[-1] > energy_j[0] - 0.1 * fallen_j


@pytest.mark.long
def test_a_block_bounces_as_high_with_half_the_step():
    law = {"lambda_pa": 2e4, "mu_pa": 3e4, "gamma_r_s": 1e-3, "gamma_m_1_s": 0.0}
    experiment = laid(box(), 36, above_m=0.02)
    mass = experiment.body.node_mass
    rebounds = []
    for step_s in (0.005 / 8, 0.005 / 16):
        seen = simulate(experiment, law, timestep_s=step_s)
        height_m = seen.positions_m[..., 2] @ mass / mass.sum()
        impact = int(height_m.argmin())
        rebounds.append((height_m[impact:].max() - height_m[0] + 0.02) / 0.02)
    assert rebounds[1] == pytest.approx(0.062, abs=0.004)
    assert rebounds[0] == pytest.approx(rebounds[1], abs=0.005)


def test_a_pressure_averaged_over_a_step_does_the_work_of_its_energy():
    """Along any step, also one that begins or ends out of contact; obstacles at rest are planes."""
    plate = pressed_cube().obstacles[1]
    stiff = replace(plate, stiffness_pa_m=None, width_m=None)
    experiment = pressed_cube().with_obstacles([stiff])
    step_s, theta = 0.01, as_theta(TRUTH)
    (term,), (still,) = (contact_terms(experiment, step_s), contact_terms(experiment))
    rng = np.random.default_rng(0)
    x = experiment.rigid_positions(experiment.t_s[-1:])
    own = len(experiment.body.nodes.points_m)
    works, losses = [], []
    for height_m in np.linspace(-0.02, 0.02, 9):
        ends = np.repeat(x, 2, axis=0)
        ends[:, :own] += rng.uniform(-0.005, 0.005, (2, own, 3))
        ends[:, :own, 2] += height_m
        before, after = ends.reshape(2, -1)
        states = States((before + after)[None] / 2, (after - before)[None] / step_s, theta)
        works.append(float(term.force(states)[0] @ (after - before)))
        losses.append(energy_j(still, before) - energy_j(still, after))
    assert np.abs(losses).max() > 0
    np.testing.assert_allclose(works, losses, atol=1e-9 * np.abs(losses).max())


@pytest.mark.parametrize("scheme", ["backward-euler", "bdf2"])
@pytest.mark.parametrize("degrees", [20.0, 35.0])
def test_a_block_on_a_tilted_plane_slides_beyond_its_angle_of_friction(degrees, scheme):
    friction, tilt = 0.5, np.deg2rad(degrees)
    experiment = laid(box(divisions=(2, 2, 1)), 80, tilt_rad=tilt, friction=friction)
    seen = simulate(experiment, RUBBER, scheme, substeps=1)
    mass = experiment.body.node_mass
    speed = np.diff(mass @ seen.positions_m[..., 0].T / mass.sum()) / experiment.timestep_s
    gained = (speed[-1] - speed[-41]) / (40 * experiment.timestep_s)
    if np.tan(tilt) < friction:
        share = np.tan(tilt) / friction
        slip = contact_terms(experiment)[0].law_of_contact.slip
        assert gained == pytest.approx(0.0, abs=1e-6)
        assert speed[-1] == pytest.approx(slip * share / np.sqrt(1 - share**2), rel=1e-4)
    else:
        pulled = G_M_S2 * (np.sin(tilt) - friction * np.cos(tilt))
        assert gained == pytest.approx(pulled, rel=2e-3)
    across, normal = (np.linalg.norm(seen.wrenches[0][:, :2], axis=1), seen.wrenches[0][:, 2])
    known = np.isfinite(normal)
    assert (across[known] <= friction * normal[known] + 1e-9).all()
    dynamics = Dynamics.from_experiment(experiment, scheme).with_theta(
        experiment.body.theta_from_values(RUBBER)
    )
    x = seen.positions_m.reshape(len(seen.t_s), -1)
    (rubbed,) = friction_summaries(experiment, dynamics, x).values()
    path_m = speed.sum() * experiment.timestep_s
    braked_j = friction * mass.sum() * G_M_S2 * np.cos(tilt) * path_m
    assert rubbed.used <= 1
    if np.tan(tilt) < friction:
        assert rubbed.slipping < 0.05
        assert rubbed.dissipated_j < 2e-3 * mass.sum() * G_M_S2 * EDGE_M
    else:
        assert rubbed.slipping > 0.95
        assert rubbed.dissipated_j == pytest.approx(braked_j, rel=0.02)


def test_a_dragged_block_sticks_then_slips_and_the_other_way_again():
    """Static: the plate's way is 6 mm and back, the force between ±μ N."""
    body, friction = box(), 0.4
    way_m = np.concatenate([np.linspace(0.0, 0.006, 13), np.linspace(0.0055, -0.006, 24)])
    t_s = np.arange(len(way_m), dtype=float)
    sides = np.concatenate([nodes_where(body, 0, x) for x in (0.0, EDGE_M)])
    drag = Grasp(sides, moved(t_s, np.outer(way_m, [1.0, 0.0, 0.0])), axes="x")
    line = Grasp(nodes_where(body, 1, 0.0), PoseSequence.fixed(), axes="y")
    press = moved(t_s, np.tile([0.0, 0.0, -0.005], (len(t_s), 1)))
    table = Obstacle(shape=Plane(), friction=friction, name="table", wrench=sensor(t_s))
    plate = Obstacle(poses=press, shape=Plane(-UP, EDGE_M * UP), name="plate")
    experiment = Experiment(
        body,
        t_s,
        [drag, line, table, plate],
        kind="static",
        gravity_m_s2=(0.0, 0.0, 0.0),
        nuisance=IDEAL,
    )
    force_n = simulate(experiment, TRUTH).wrenches[0]
    share = force_n[:, 0] / (friction * force_n[:, 2])
    assert np.abs(share).max() <= 1 + 1e-9
    assert abs(share[1]) < 0.9
    np.testing.assert_allclose(share[8:13], -1.0, atol=0.02)
    assert -0.9 < share[13] < 0.9
    np.testing.assert_allclose(share[-8:], 1.0, atol=0.02)


def ring(sides: int, outer_m: float, inner_m: float, width_m: float) -> TetMesh:
    """A polygon with a hole that stands on a corner at z = -`outer_m`."""
    flat = box_mesh((1.0,) * 3, (sides, 1, 1))
    i, j, k = np.rint(flat.points_m * [sides, 1, 1]).astype(int).T
    number = ((i % sides) * 2 + j) * 2 + k
    angle, out, along = np.meshgrid(
        2 * np.pi * np.arange(sides) / sides, (0, 1), (0, 1), indexing="ij"
    )
    radius = inner_m + (outer_m - inner_m) * out
    places = np.stack([radius * np.sin(angle), width_m * along, -radius * np.cos(angle)], axis=-1)
    return TetMesh(places.reshape(-1, 3), number[flat.tetrahedra])


@pytest.mark.long
def test_a_stiff_ring_rolls_down_a_plane_without_slipping():
    radius_m, tilt = 0.05, np.deg2rad(15.0)
    body = Body(ring(40, radius_m, 0.025, 0.03), density_kg_m3=200.0)
    experiment = laid(body, 50, above_m=radius_m, tilt_rad=tilt, friction=0.8)
    stiff = {"lambda_pa": 2e6, "mu_pa": 2e6, "gamma_r_s": 0.002, "gamma_m_1_s": 1e-6}
    seen, mass = simulate(experiment, stiff, "bdf2", substeps=1), body.node_mass
    places = seen.positions_m[:, : len(mass)]
    middle = np.einsum("n,tnk->tk", mass, places) / mass.sum()
    spoke = places[:, 0] - middle
    turned = -np.unwrap(np.arctan2(spoke[:, 0], -spoke[:, 2]))
    rolled_m = middle[:, 0] - middle[0, 0]
    assert rolled_m[-1] > 3 * 2 * np.pi * radius_m / 40
    np.testing.assert_allclose(
        radius_m * (turned - turned[0])[10:], rolled_m[10:], rtol=0.02, atol=1e-5
    )
    arms_m = body.nodes_m - mass @ body.nodes_m / mass.sum()
    inertia = mass @ (arms_m[:, [0, 2]] ** 2).sum(axis=1)
    expected = G_M_S2 * np.sin(tilt) / (1 + inertia / (mass.sum() * radius_m**2))
    assert 2 * np.polyfit(experiment.t_s, rolled_m, 2)[0] == pytest.approx(expected, rel=0.05)


# Robustness ----------------------------------------------------------------------------------


def test_a_ball_is_pressed_in_by_large_steps_at_any_stiffness():
    """From out of reach to half an edge of the mesh deep in three; κ follows the stiffness."""
    t_s, height_m = np.arange(4.0), np.linspace(0.01, -0.025, 4)
    ball = Obstacle(
        poses=moved(t_s, np.outer(height_m, UP)),
        shape=Sphere(0.03, np.array([0.04, 0.05, EDGE_M + 0.03])),
        friction=0.5,
        wrench=sensor(t_s),
    )
    held = Grasp(nodes_where(box(), 2, 0.0), PoseSequence.fixed())
    still = {"kind": "static", "gravity_m_s2": np.zeros(3), "nuisance": IDEAL}
    experiment = Experiment(box(), t_s, [held, ball], **still)
    shares = []
    for times in (1 / 30, 1.0, 30.0):
        law = TRUTH | {name: times * TRUTH[name] for name in ("lambda_pa", "mu_pa")}
        shares.append(simulate(experiment, law).wrenches[0] / times)
    assert shares[0][-1, 2] < -0.5
    np.testing.assert_allclose(shares[0][0], 0.0, atol=1e-12)
    np.testing.assert_allclose(shares[1:], shares[:1] * 2, rtol=1e-5, atol=1e-8)


# Hertz ---------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_long_cylinder_presses_as_hertz_found():
    """Converging to the force for the half-width of the contact; see `study_contact`."""
    misses = [abs(cylinder(cells)[0] - 1) for cells in (1.0, 2.0, 4.0)]
    assert misses[-1] < 0.01
    assert misses[-1] < misses[0] / 2


@pytest.mark.slow
def test_two_elements_to_the_radius_suffice_for_the_force_of_hertz_by_default():
    """On a graded mesh, with stiffness, width and faces of the contact left open."""
    assert 0.98 < sphere_on_half_space(2) < 1.03


@pytest.mark.long
def test_a_sphere_presses_as_hertz_found():
    misses = [abs(sphere(cells)[0] - 1) for cells in (1.5, 3.0)]
    assert misses[-1] < 0.02
    assert misses[-1] < misses[0] / 3
