"""Dahl's friction of bending: loops in closed form, a chain of another program, identification."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.program_derivatives import require_derivatives
from kit.wires import Chain
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.kinds.rod.element import CrossSection, rod_mesh
from collocation_sysid.testing.property_check import PropertyCheck

LENGTH_M = 0.6
CONSTANTS = {"bending_n_m2": 0.02, "friction_n_m": 4e-3, "stick_n_m2": 0.03}
KNOWN = {"torsion_n_m2": 0.02, "axial_n": 2000.0, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
WEIGHT_N_M = 9.81 * 0.05
CLAMPS_RAD = np.radians([0, 20, 40, 60, 40, 20, 0, -20, -40, -20, 0, 20, 40])
PLACES_M = np.array([0.15, 0.3, 0.45, 0.6])


def dahl(curvatures: np.ndarray, friction: float = 4e-3, stick: float = 0.03) -> np.ndarray:
    """Moments of friction along curvatures, by Dahl's solution for each monotonic part."""
    moments = [0.0]
    for change in np.diff(curvatures):
        limit = np.sign(change) * friction
        moments.append(limit + (moments[-1] - limit) * np.exp(-stick * abs(change) / friction))
    return np.array(moments)


def test_moments_of_a_bent_cable_are_those_of_dahls_loop():
    curvatures = np.concatenate([np.linspace(0, 1.5, 7), np.linspace(1.5, -1.5, 9)[1:], [0.0, 1.5]])
    mesh = rod_mesh([[0, 0, 0], [0.3, 0, 0]], CrossSection.round(0.004), 21, (), [0, 1, 0])
    body = cs.Body(mesh, "cable", density_kg_m3=1000.0, forces=[cs.bending_friction()])
    # Both ends turn against each other, so that the curvature is the same everywhere.
    turns = np.outer(0.3 * curvatures, [0, 0, 1])
    radii = np.where(curvatures == 0, 1.0, curvatures)
    ends = np.where(
        curvatures[:, None] == 0,
        [[0.3, 0.0, 0.0]],
        np.stack([np.sin(0.3 * radii), 1 - np.cos(0.3 * radii), 0 * radii], axis=1)
        / radii[:, None],
    )
    rotations = Rotation.from_rotvec(turns)
    shifts = ends - rotations.apply([0.3, 0.0, 0.0])
    t_s = np.arange(float(len(curvatures)))
    held = [np.flatnonzero(np.isclose(mesh.arc_lengths_m, s_m)) for s_m in (0.0, 0.3)]
    grasps = [
        cs.Grasp(held[0], cs.PoseSequence.fixed()),
        cs.Grasp(held[1], cs.PoseSequence(t_s, shifts, rotations.as_quat())),
    ]
    middle = cs.Markers(t_s, np.zeros((len(t_s), 1, 3)), 1e-3, places_m=[mesh.place_m(0.15)])
    grasps[1] = replace(grasps[1], wrench=cs.Wrench(t_s, np.zeros((len(t_s), 6)), 1e-3, 1e-4))
    bench = cs.Experiment(
        body,
        t_s,
        grasps,
        middle,
        kind="static",
        gravity_m_s2=[0, 0, 0],
        nuisance=cs.Nuisance.none(),
    )
    soft = KNOWN | CONSTANTS | {"axial_n": 20.0}  # the chords of the arc are shorter
    wrench = cs.simulate(bench, soft).wrenches[0]
    expected = 0.02 * curvatures + dahl(curvatures)
    np.testing.assert_allclose(wrench[:, 5], expected, rtol=0.01, atol=2e-5)
    work = np.trapezoid(wrench[6:, 5], curvatures[6:])
    assert work > 0


def hung(with_weight: bool = False, samples: int = 13, sections: int = 16) -> cs.Experiment:
    """Equilibria of a cable whose clamp turns up and down, as the chain has them, with noise."""
    tip_n = 0.15 if with_weight else 0.0
    chain = Chain(LENGTH_M, 60, **CONSTANTS, weight_n_m=WEIGHT_N_M, tip_n=tip_n)
    clamps_rad = CLAMPS_RAD[:samples]
    places_m = chain.points_m(chain.equilibria(clamps_rad), PLACES_M)
    tracks_m = np.insert(places_m, 1, 0.0, axis=2)
    tracks_m += 3e-4 * np.random.default_rng(5).normal(size=tracks_m.shape)
    mesh = rod_mesh(
        [[0, 0, 0], [LENGTH_M, 0, 0]], CrossSection.round(0.006), sections, list(PLACES_M)
    )
    body = cs.Body(mesh, "cable", mass_kg=0.05 * LENGTH_M, forces=[cs.bending_friction()])
    t_s = np.arange(float(samples))
    turns = Rotation.from_rotvec(np.outer(-clamps_rad, [0, 1, 0])).as_quat()
    held = np.flatnonzero(mesh.arc_lengths_m == 0)
    tip = np.flatnonzero(np.isclose(mesh.arc_lengths_m, LENGTH_M))
    weights = (cs.Force(tip, [0.0, 0.0, -tip_n]),) if with_weight else ()
    markers = cs.Markers(t_s, tracks_m, 3e-4, places_m=[mesh.place_m(s) for s in PLACES_M])
    poses = cs.PoseSequence(t_s, np.zeros((len(t_s), 3)), turns)
    return cs.Experiment(
        body,
        t_s,
        [cs.Grasp(held, poses)],
        markers,
        name="weight" if with_weight else "alone",
        kind="static",
        forces=weights,
        nuisance=cs.Nuisance.none(),
        air_density_kg_m3="none",
    )


@pytest.mark.parametrize("with_weight", [False, True])
def test_a_chain_of_another_program_is_identified(with_weight: bool):
    experiment = hung(with_weight)
    unknown = {name: cs.Unknown(1.5 * value) for name, value in CONSTANTS.items()}
    run = cs.run(cs.Problem([experiment], KNOWN | unknown), seek_causes=False)
    for name, tolerance in (("bending_n_m2", 0.05), ("friction_n_m", 0.2)):
        low, high = run.interval(name)
        assert low < CONSTANTS[name] < high
        assert run.estimates[name].value == pytest.approx(CONSTANTS[name], rel=tolerance)
    assert run.trust.verdict == "good"


def test_the_linear_law_is_not_good_for_a_cable_with_friction():
    experiment = hung()
    given = experiment.body
    linear = cs.Body(given.mesh, "cable", mass_kg=given.mass_kg)
    grasp = experiment.grasps[0]
    elastic = cs.Experiment(
        linear,
        experiment.t_s,
        [grasp],
        experiment.markers,
        kind="static",
        nuisance=cs.Nuisance.none(),
        air_density_kg_m3="none",
    )
    known = {name: KNOWN[name] for name in ("torsion_n_m2", "axial_n")}
    known |= {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0, "bending_n_m2": cs.Unknown(0.02)}
    run = cs.run(cs.Problem([elastic], known), seek_causes=False)
    assert run.trust.verdict != "good"


def test_derivatives_of_programs_with_friction_are_right():
    experiment = hung(samples=4, sections=5)
    unknown = {name: cs.Unknown(value) for name, value in CONSTANTS.items()}
    for each in (experiment, replace(experiment, kind="dynamic")):
        program = cs.Problem([each], KNOWN | unknown).collocation()
        require_derivatives(PropertyCheck("friction"), program)


def test_constants_of_friction_follow_from_a_swing():
    t_s = 0.01 * np.arange(151)
    mesh = rod_mesh([[0, 0, 0], [0, 0, -0.4]], CrossSection.round(0.004), 9)
    places_m = [mesh.place_m(s_m) for s_m in (0.2, 0.3, 0.4)]
    body = cs.Body(mesh, "cable", density_kg_m3=1500.0, forces=[cs.bending_friction()])
    shift_m = np.outer(0.05 * np.sin(np.pi / 2 * np.clip(t_s / 0.2, 0, 1)) ** 2, [1.0, 0.5, 0.0])
    hand = cs.PoseSequence(t_s, shift_m, np.tile([0, 0, 0, 1.0], (len(t_s), 1)))
    held = np.flatnonzero(mesh.arc_lengths_m == 0)
    markers = cs.Markers(t_s, np.zeros((len(t_s), 3, 3)), 5e-4, places_m=places_m)
    swing = cs.Experiment(
        body,
        t_s,
        [cs.Grasp(held, hand)],
        markers,
        nuisance=cs.Nuisance.none(),
        air_density_kg_m3="none",
    )
    truth = {"bending_n_m2": 2e-3, "torsion_n_m2": 2e-3, "axial_n": 500.0, "gamma_m_1_s": 0.0}
    truth |= {"gamma_r_s": 3e-3, "friction_n_m": 5e-4, "stick_n_m2": 4e-3}
    exact_m = cs.simulate(swing, truth, "midpoint", substeps=4).markers_m
    tracks_m = exact_m + 5e-4 * np.random.default_rng(0).normal(size=exact_m.shape)
    sought = ("bending_n_m2", "gamma_r_s", "friction_n_m", "stick_n_m2")
    unknown = {name: cs.Unknown(1.5 * truth[name]) for name in sought}
    exact = cs.UncertaintyOptions(assumptions=cs.Assumptions.exact())
    problem = cs.Problem([cs.with_markers(swing, tracks_m)], truth | unknown, uncertainty=exact)
    run = cs.run(problem, seek_causes=False)
    for name in sought:
        low, high = run.interval(name)
        assert low < truth[name] < high
    assert run.trust.verdict == "good"


def test_a_solid_has_no_friction_of_bending():
    body = cs.Body(
        cs.box_mesh((0.1, 0.1, 0.1), (1, 1, 1)), mass_kg=1.0, forces=[cs.bending_friction()]
    )
    with pytest.raises(cs.InputError, match="expected a rod"):
        _ = body.placed_forces
