"""Changes of residuals by systematic effects, compared with simulations of other bodies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from assumed_twins import with_wrong_assumptions
from kit.problems import EDGE_M, box, hung_cube
from kit.rods import CABLE, UNDAMPED, bent, clamped
from kit.rods import cable as cable_of
from kit.static import PRESSED_M, TIMES, block

from collocation_sysid import (
    Assumptions,
    Body,
    Collocation,
    Experiment,
    Force,
    Grasp,
    Markers,
    Nuisance,
    Obstacle,
    Plane,
    PointMass,
    PoseSequence,
    Problem,
    Specimen,
    Tied,
    Unknown,
    box_mesh,
    run,
    simulate,
)
from collocation_sysid.fem.laws.constants import GAMMA_R
from collocation_sysid.fem.laws.materials import DAMPINGS, DampingLaw
from collocation_sysid.fem.node_force import AIR_KG_M3
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.program.simulation import Trajectory
from collocation_sysid.statistics.budget.consider_analysis import changed_residuals
from collocation_sysid.statistics.budget.effect import ExperimentAtAnswer
from collocation_sysid.statistics.budget.systematic_effects import ASSUMPTIONS

VALUES = {"young_pa": 8e3, "poisson": 0.3, "gamma_r_s": 6e-3, "gamma_m_1_s": 0.0}
BY_NAME = {row.name: row for row in ASSUMPTIONS}
# How far off what is assumed is, so that markers follow it linearly.
OFF = {
    "body_scale": 1e-3,
    "mass": 1e-3,
    "density_gradient x": 1e-3,
    "density_gradient z": 1e-3,
    "stiffness_gradient x": 1e-3,
    "stiffness_gradient z": 1e-3,
    "anisotropy x": 1e-3,
    "anisotropy z": 1e-3,
    "stiffness_drift": 1e-3,
    "time_scale": 1e-3,
    "poisson": 1e-3,
    "damping_law material": 0.1,
    "rayleigh_damping": 0.01,
    "buoyancy": 0.3,
    "added_mass": 0.03,
    "air_drag": 0.03,
    "grip_layer_m": 1e-5,
    "grasp_edge_m": 1e-5,
}


# Drift is piecewise constant in the twins, and a longer body has more mass there.
INEXACT = {"stiffness_drift": 0.05, "grip_layer_m": 0.2, "grasp_edge_m": 0.2}
OF_AIR = ("buoyancy", "added_mass", "air_drag")


def swung(air_density_kg_m3: float = 0.0) -> Experiment:
    """A cube hung from its top face, swayed and turned from rest, and its markers as simulated."""
    experiment = hung_cube(24, air_density_kg_m3=air_density_kg_m3)
    body = Body(experiment.body.mesh, density_kg_m3=60.0)
    return with_wrong_assumptions(replace(experiment, body=body), VALUES, {})


def parameters(**stated: float | Unknown | Tied) -> Parameters:
    return Parameters.from_mapping(
        VALUES | {"young_pa": Unknown(VALUES["young_pa"], 10.0, 1e6)} | stated
    )


def changed(experiment: Experiment, name: str, scheme: str = "midpoint") -> np.ndarray:
    """Markers (T, M, 3) where an assumption is off by one of its unit, to first order [m]."""
    row = name.partition(" ")[0]
    collocation = Collocation([experiment], parameters(), scheme)
    positions = simulate(experiment, VALUES, scheme, substeps=1).positions_m
    z = collocation.pack(collocation.guess_p, [positions.reshape(len(positions), -1)])
    names, found = changed_residuals(collocation, z, [(BY_NAME[row], 1.0)])
    return found[0][..., names.index(name)] * experiment.markers.sigma_m[:, None]


@pytest.mark.parametrize("name", OFF)
def test_markers_change_as_where_the_body_is_as_the_assumption_fears(name):
    experiment, off = swung(AIR_KG_M3 * (name in OF_AIR)), OFF[name]
    tracks = [
        with_wrong_assumptions(experiment, VALUES, {name: way}).markers.positions_m
        for way in (off, 0.0)
    ]
    simulated = (tracks[0] - tracks[1]) / off
    largest = np.abs(simulated).max()
    assert largest > 0
    atol = INEXACT.get(name, 0.01) * largest
    np.testing.assert_allclose(changed(experiment, name), simulated, atol=atol)


def test_a_stated_torsional_stiffness_of_a_bent_cable_may_be_another():
    experiment = clamped(cable_of(bent()), 0.0, 0.0, -0.1, kind="static")
    values = CABLE | UNDAMPED

    def motion(**changes: float) -> Trajectory:
        return simulate(experiment, values | changes, substeps=1)

    known = motion()
    markers = replace(experiment.markers, positions_m=known.markers_m, sigma_m=1e-3)
    guess = Unknown(CABLE["bending_n_m2"], 1e-4, 1.0)
    parameters = Parameters.from_mapping(values | {"bending_n_m2": guess})
    collocation = Collocation([replace(experiment, markers=markers)], parameters)
    x = known.positions_m
    z = collocation.pack(collocation.guess_p, [x.reshape(len(x), -1)])
    _, found = changed_residuals(collocation, z, [(BY_NAME["torsion"], 1.0)])
    more, less = (
        motion(torsion_n_m2=CABLE["torsion_n_m2"] * (1 + way)).markers_m for way in (1e-3, -1e-3)
    )
    expected = (more - less) / 2e-3
    assert np.abs(expected).max() > 1e-4
    np.testing.assert_allclose(1e-3 * found[0][..., 0], expected, atol=1e-6)


@pytest.mark.parametrize("has_stated_places", [True, False])
def test_markers_with_a_mass_are_point_masses(has_stated_places):
    mass_kg = 1e-6
    experiment = swung()
    placement = experiment.markers.placement
    loaded = replace(
        experiment,
        masses=[
            PointMass([int(node)], mass_kg * weight)
            for nodes, weights in zip(placement.nodes, placement.weights, strict=True)
            for node, weight in zip(nodes, weights, strict=True)
            if weight > 0
        ],
    )
    tracks = [
        simulate(each, VALUES, "midpoint", substeps=1).markers_m for each in (loaded, experiment)
    ]
    simulated = (tracks[0] - tracks[1]) / mass_kg
    described = experiment
    if not has_stated_places:
        places_m = experiment.markers.predict_positions(experiment.body.nodes_m)
        markers = replace(
            experiment.markers, placement=None, places_m=places_m, places_sigma_m=1e-3, located=None
        ).on_body(experiment.body)
        described = replace(experiment, markers=markers)
    np.testing.assert_allclose(
        changed(described, "marker_mass_kg"), simulated, atol=0.01 * np.abs(simulated).max()
    )


def hanging_bar(layers: int) -> Experiment:
    """A bar of layers of 5 mm that hangs from its top at rest, with a marker at its lower end."""
    height_m = 0.005 * layers
    mesh = box_mesh((0.01, 0.01, height_m), (2, 2, layers))
    body = Body(mesh, density_kg_m3=60.0)
    top = np.flatnonzero(body.nodes_m[:, 2] > height_m - 1e-9)
    markers = Markers(
        np.zeros(1), np.zeros((1, 1, 3)), 1e-3, places_m=[[0.005, 0.005, 0.0]]
    ).on_body(body)
    grasp = Grasp(top, PoseSequence.fixed())
    return Experiment(
        body,
        [0.0],
        [grasp],
        markers,
        kind="static",
        nuisance=Nuisance.none(),
        air_density_kg_m3=0.0,
    )


def test_a_gripper_that_holds_less_of_the_body_leaves_a_longer_bar():
    sag_m = [simulate(hanging_bar(layers), VALUES).markers_m[0, 0, 2] for layers in (16, 17)]
    # The additional layer at the top carries the weight of the bar below it.
    simulated = (sag_m[1] - sag_m[0]) / 0.005
    (expected,) = changed(hanging_bar(16), "grasp_edge_m")[:, 0, 2]
    assert expected == pytest.approx(simulated, rel=0.2)


def test_the_edge_of_a_gripper_around_a_part_of_the_body_is_its_end():
    short, long = hanging_bar(15), hanging_bar(16)
    held = np.flatnonzero(long.body.nodes_m[:, 2] > 0.075 - 1e-9)
    surrounded = replace(long, grasps=[Grasp(held, PoseSequence.fixed())])
    np.testing.assert_allclose(
        changed(surrounded, "grasp_edge_m"), changed(short, "grasp_edge_m"), rtol=1e-6, atol=1e-9
    )


def test_the_effect_of_an_edge_does_not_jump_where_the_gripper_lets_go():
    held = swung()
    (grasp,) = held.grasps
    released = replace(held, grasps=[replace(grasp, until_s=float(held.t_s[16]))])
    after = np.abs(changed(released, "grasp_edge_m"))[17:].max()
    assert 0 < after < np.abs(changed(held, "grasp_edge_m")).max()


def test_the_edge_of_a_platen_is_the_face_of_the_specimen():
    assert changed(block("xyz"), "grip_layer_m").any()
    assert not changed(block("xyz"), "grasp_edge_m").any()


def platen_forces_n(experiment: Experiment, platen: int) -> np.ndarray:
    """(T, k, 3) what a platen gives each node that it holds, which is what the body gives it."""
    x = simulate(experiment, VALUES).positions_m.reshape(len(experiment.t_s), -1)
    inside = experiment.body.force(x, np.zeros_like(x), experiment.body.theta_from_values(VALUES))
    return -inside.reshape(len(x), -1, 3)[:, experiment.grasps[platen].nodes]


def test_a_bench_that_gives_way_presses_less():
    compliance_m_n, pressed_m = 1e-6, PRESSED_M
    for _ in range(5):  # what it gives way follows the force, and that what is pressed
        force_n = platen_forces_n(block("xyz", z_m=pressed_m), 1)[..., 2].sum(axis=1)
        pressed_m = PRESSED_M - compliance_m_n * force_n
    tracks = [simulate(block("xyz", z_m=z_m), VALUES).markers_m for z_m in (pressed_m, PRESSED_M)]
    simulated = (tracks[0] - tracks[1]) / compliance_m_n
    expected = changed(block("xyz"), "machine_compliance_m_n")
    np.testing.assert_allclose(expected, simulated, atol=0.01 * np.abs(simulated).max())
    assert simulated[-1, :, 2].max() > 0


def test_friction_opposes_sliding_on_platens():
    friction, sliding, tracks = 1e-3, block(), []
    x, start = simulate(sliding, VALUES).positions_m, sliding.body.nodes_m
    for k in range(1, len(PRESSED_M)):
        forces = []
        for platen in range(2):
            nodes = sliding.grasps[platen].nodes
            press = friction * np.abs(platen_forces_n(sliding, platen)[k, :, 2:])
            way = (x[k] - start)[nodes] * [1, 1, 0]
            pull = -press * way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
            forces += [Force([n], f) for n, f in zip(nodes, pull, strict=True) if f.any()]
        held_back = block(t_s=TIMES[:2], z_m=PRESSED_M[[k, k]], forces=forces)
        tracks.append(simulate(held_back, VALUES).markers_m[-1])
    simulated = (tracks - sliding.markers.predict_positions(x)[1:]) / friction
    expected = changed(sliding, "platen_friction")[1:]
    np.testing.assert_allclose(expected, simulated, atol=0.01 * np.abs(simulated).max())


def test_planes_of_symmetry_have_no_friction_and_are_no_grip():
    sliding, sticking = (changed(block(), "grip_layer_m"), changed(block("xyz"), "platen_friction"))
    assert not sliding.any()
    assert not sticking.any()


@pytest.mark.parametrize("name", OF_AIR)
def test_in_a_vacuum_nothing_is_assumed_of_the_air(name):
    collocation = Collocation([swung()], parameters(), "midpoint")
    x = np.tile(collocation.experiments[0].body.nodes_m.ravel(), (25, 1))
    (part,) = collocation.iterates(collocation.pack(collocation.guess_p, [x]))
    assert BY_NAME[name].effect(ExperimentAtAnswer(part, collocation.parameters), 0) is None


def test_the_drag_of_air_is_that_of_a_quarter_of_the_surface():
    experiment = swung(AIR_KG_M3)
    collocation = Collocation([experiment], parameters(), "midpoint")
    x = experiment.body.nodes_m.ravel()
    z = collocation.pack(collocation.guess_p, [np.tile(x, (len(experiment.t_s), 1))])
    at = ExperimentAtAnswer(collocation.iterates(z)[0], collocation.parameters)
    count = len(experiment.t_s)
    sideways = np.tile([0.0, 2.0, 0.0], len(x) // 3)
    vars(at)["states"] = (np.tile(x, (count, 1)), np.tile(sideways, (count, 1)))
    force = BY_NAME["air_drag"].effect(at, 0).force_n[0].reshape(-1, 3).sum(axis=0)
    np.testing.assert_allclose(force, [0, -0.5 * AIR_KG_M3 * 1.5 * EDGE_M**2 * 4.0, 0], atol=1e-9)


def test_a_ratio_tied_to_one_that_is_estimated_is_not_stated():
    estimated = parameters(**{"poisson": Unknown(0.3, 0.1, 0.49), "core.poisson": Tied("poisson")})
    experiment = swung()
    collocation = Collocation([experiment], parameters(), "midpoint")
    x = np.tile(experiment.body.nodes_m.ravel(), (len(experiment.t_s), 1))
    (part,) = collocation.iterates(collocation.pack(collocation.guess_p, [x]))
    assert BY_NAME["poisson"].effect(ExperimentAtAnswer(part, estimated), 0) is None
    assert BY_NAME["poisson"].effect(ExperimentAtAnswer(part, parameters()), 0) is not None


@pytest.mark.parametrize("law", ["material", "kelvin-voigt"])
def test_the_stated_law_of_damping_is_no_alternative_to_itself(law):
    experiment = swung()
    body = Body(experiment.body.mesh, density_kg_m3=60.0, damping=law)
    described = replace(experiment, body=body)
    assert not changed(described, f"damping_law {law}").any()
    (other,) = {"material", "kelvin-voigt"} - {law}
    assert changed(described, f"damping_law {other}").any()


@pytest.mark.parametrize("changes", [{"gamma_r_s": 0.0}, {"kind": "static"}])
def test_without_damping_its_law_is_no_matter(changes):
    experiment = swung()
    values = VALUES
    if "kind" in changes:
        experiment = replace(experiment, kind="static", nuisance=Nuisance.none())
    else:
        values = VALUES | changes
    collocation = Collocation([experiment], Parameters.from_mapping(values), "midpoint")
    rows = len(experiment.t_s)
    rest = np.tile(experiment.body.nodes_m.ravel(), (rows, 1))
    z = collocation.pack(collocation.guess_p, [rest])
    at = ExperimentAtAnswer(next(iter(collocation.iterates(z))), collocation.parameters)
    for name in ("damping_law", "rayleigh_damping"):
        row = BY_NAME[name]
        assert all(row.effect(at, axis) is None for axis in range(len(row.components)))


def test_a_law_of_a_user_is_not_changed():
    def stress(psi, F, rate, gamma_r_s):
        return DAMPINGS["material"].stress(psi, F, rate, gamma_r_s)

    experiment = swung()
    own = DampingLaw("own", (GAMMA_R,), stress=stress)
    body = Body(experiment.body.mesh, density_kg_m3=60.0, damping=own)
    assert not changed(replace(experiment, body=body), "damping_law kelvin-voigt").any()


@pytest.mark.parametrize(("poisson", "limited"), [(0.3, 0.0191), (0.49, 0.0110), (0.4999, 5.3e-4)])
def test_the_deviation_of_a_stated_poisson_ratio_ends_before_the_incompressible_body(
    poisson, limited
):
    deviation = Assumptions().collect_deviations((), parameters(poisson=poisson))["poisson"]
    assert deviation == pytest.approx(limited, rel=0.01)
    stated = Assumptions(poisson=1e-6)
    considered = stated.collect_deviations((), parameters(poisson=poisson))
    assert considered["poisson"] == pytest.approx(1e-6, rel=0.01)
    exact = Assumptions(poisson="none")
    assert exact.collect_deviations((), parameters(poisson=poisson))["poisson"] is None


def test_the_largest_of_several_stated_poisson_ratios_limits_their_deviation():
    several = parameters(
        **{"poisson": 0.3, "core.poisson": Tied("rim.poisson"), "rim.poisson": 0.499}
    )
    deviation = Assumptions().collect_deviations((), several)["poisson"]
    assert deviation == pytest.approx(1e-3 * np.log(21.0), rel=1e-6)


@pytest.mark.long
def test_a_tension_test_of_rubber_determines_its_stiffness_at_a_stated_poisson_ratio():
    stretch = np.linspace(1.1, 3.0, 12)
    stress_pa = 2e5 * (stretch - stretch**-2.0)
    test = Specimen("uniaxial", stretch - 1, stress_pa, sigma_pa=2e3)
    unknown = {"c10_pa": Unknown(), "c01_pa": 0.0, "poisson": 0.4999}
    answer = run(Problem([test.experiment("mooney-rivlin", "pull")], unknown))
    low, high = answer.interval("young_pa")
    assert low < 6e5 < high
    assert high < 1.5 * low


def test_a_larger_body_that_falls_is_released_without_strain():
    """Compressed to its old size it would swing; it only is larger, and falls alike."""
    body = Body(box().mesh, density_kg_m3=60.0)
    t_s = 0.01 * np.arange(13)
    floor = Obstacle(shape=Plane((0.0, 0.0, 1.0), (0.0, 0.0, -0.5)), friction=0.0)
    markers = Markers(t_s, np.zeros((13, len(body.nodes_m), 3)), 1e-3, places_m=body.nodes_m)
    falling = Experiment(
        body,
        t_s,
        [floor],
        markers,
        start="undeformed",
        air_density_kg_m3="none",
        nuisance=Nuisance.none(),
    )
    change_m = changed(falling, "body_scale", "bdf2")
    # About a point of the lowest face, which touches the floor first.
    point_m = body.nodes_m[0] - change_m[0, 0]
    assert point_m[2] == pytest.approx(0.0, abs=1e-9)
    expected_m = np.broadcast_to(body.nodes_m - point_m, change_m.shape)
    np.testing.assert_allclose(change_m, expected_m, atol=1e-6 * EDGE_M)
