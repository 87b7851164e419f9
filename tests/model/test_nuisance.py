"""Nuisance parameters of experiments, and their identification beside the material."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from kit.nuisances import alone, readings, seen_with
from kit.problems import (
    GUESS,
    IDEAL,
    TRUTH,
    bar_with_nuisance,
    cube_with_gaps,
    cube_with_nuisance,
    hung_cube,
    measured,
    noisy,
    point_markers,
    released_cube,
    vertex_markers,
)
from scipy.spatial.transform import Rotation

from collocation_sysid.errors import InputError
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.nuisance_map import NuisanceMap
from collocation_sysid.pipeline import run, solve
from collocation_sysid.problem import Problem
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.markers.association import MarkerAssociation
from collocation_sysid.program.measurement_models import first_association
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp, Markers, Nuisance, PoseSequence
from collocation_sysid.statistics.pose_noise import uncertainty_at

ONE_OF_EACH = {
    "place": Nuisance.none(marker_offset_m=0.003),
    "offset": Nuisance.none(camera_offset_m=0.003),
    "time": Nuisance.none(time_shift_s=0.004),
    "turn": Nuisance.none(pose_turn_rad=0.03),
    "shift": Nuisance.none(pose_shift_m=0.003),
    "tilt": Nuisance.none(gravity_rad=0.05),
    "grasp-turn": Nuisance.none(hand_eye_rad=0.03),
    "grasp-shift": Nuisance.none(hand_eye_m=0.003),
    "clamp-turn": Nuisance.none(clamp_turn_rad=0.03),
}


# What they do


def test_markers_without_nuisance_read_their_positions():
    cube = hung_cube()
    plain = simulate(cube, TRUTH, "midpoint", substeps=1).markers_m
    np.testing.assert_allclose(readings(cube, np.zeros(0)), plain, atol=1e-15)
    everything = cube_with_nuisance()
    zero = np.zeros(NuisanceMap.from_experiment(everything).size)
    np.testing.assert_allclose(readings(everything, zero), plain, atol=1e-12)


def test_an_error_of_a_place_turns_with_the_body():
    cube = replace(cube_with_gaps(), nuisance=ONE_OF_EACH["place"])
    phi = np.random.default_rng(1).uniform(-2, 2, NuisanceMap.from_experiment(cube).size)
    places = cube.markers.predict_positions(cube.body.nodes_m) + 0.003 * phi.reshape(-1, 3)
    really = replace(cube, markers=point_markers(cube.body, places, cube.t_s), nuisance=IDEAL)
    expected = simulate(really, TRUTH, "midpoint", substeps=1).markers_m
    assert np.ptp(expected - readings(cube, 0 * phi), axis=0).max() > 1e-3
    np.testing.assert_allclose(readings(cube, phi), expected, atol=1e-12)


def test_a_motion_in_the_grasp_is_a_body_held_elsewhere():
    """The reading with φ is that of a body that is really off in its grasp."""
    plain = hung_cube()
    cube = replace(plain, nuisance=Nuisance.none(hand_eye_m=0.003, hand_eye_rad=0.05))
    phi = np.array([1.0, -0.6, 0.8, 0.5, -1.0, 0.3])
    (grasp,) = plain.grasps
    moved = Grasp(
        grasp.nodes, grasp.poses.after(NuisanceMap.from_experiment(cube).grasp_motion_matrix(phi))
    )
    expected = simulate(replace(plain, grasps=(moved,)), TRUTH, "midpoint", substeps=1).markers_m
    assert np.abs(expected - readings(cube, 0 * phi)).max() > 3e-3
    np.testing.assert_allclose(readings(cube, phi), expected, atol=1e-9)


def test_each_clamp_turns_about_its_own_middle():
    """The body of the estimate is that of grasps which are really turned, one about y, one about x."""
    plain = bar_with_nuisance()
    bar = replace(plain, nuisance=Nuisance.none(clamp_turn_rad=0.05))
    turns = np.array([[0.0, 0.05, 0.0], [-0.1, 0.0, 0.0]])
    nuisance = NuisanceMap.from_experiment(bar)
    phi = np.zeros(nuisance.size)
    phi[nuisance.grasp_indices] = np.ravel(turns) / nuisance.scales[nuisance.grasp_indices]
    found = nuisance.with_grasps(bar.grasps, phi)
    for grasp, moved, turn in zip(bar.grasps, found, turns, strict=True):
        held_m = bar.body.nodes_m[grasp.nodes]
        middle_m = held_m.mean(axis=0)
        half = np.linalg.norm(turn) / 2  # Cayley: the tangent of half the angle
        rotation = Rotation.from_rotvec(turn / (2 * half) * 2 * np.arctan(half))
        expected_m = bar.body.nodes_m.copy()
        expected_m[grasp.nodes] = middle_m + rotation.apply(held_m - middle_m)
        np.testing.assert_allclose(
            moved.positions_at(bar.body.nodes_m, bar.t_s),
            grasp.positions_at(expected_m, bar.t_s),
            atol=1e-12,
        )


@pytest.mark.parametrize(("body", "turned"), [(hung_cube, 0), (bar_with_nuisance, 2)])
def test_each_of_several_clamps_turns_by_default(body, turned):
    """The turn of a single clamp is that of the body in its grasp."""
    nuisance = NuisanceMap.from_experiment(replace(body(), nuisance=Nuisance()))
    assert len([entry for entry in nuisance.entries if entry.row.key == "clamp_turn"]) == 3 * turned


def test_a_stated_turn_of_a_single_clamp_is_estimated():
    stated = replace(hung_cube(), nuisance=Nuisance.none(clamp_turn_rad=0.5))
    assert NuisanceMap.from_experiment(stated).scales.tolist() == [0.5] * 3


def test_the_equations_have_the_derivatives_of_turned_clamps(rng):
    bar = replace(
        bar_with_nuisance(), nuisance=Nuisance.none(clamp_turn_rad=0.05, hand_eye_rad=0.02)
    )
    (transcription,) = alone(bar).transcriptions
    constraint = transcription.prescribed_motion
    phi = rng.uniform(-1, 1, transcription.nuisance.size)
    slopes = constraint.evaluate_at(phi).by_phi
    for column, k in enumerate(transcription.nuisance.motion_indices):
        step = 1e-5 * np.eye(len(phi))[k]
        up, down = (
            np.nan_to_num(constraint.evaluate_at(phi + s).positions_m) for s in (step, -step)
        )
        np.testing.assert_allclose(slopes[:, :, column], (up - down) / 2e-5, atol=1e-8)


def test_a_given_start_contains_the_place_in_the_grasp():
    cube = replace(released_cube(), nuisance=Nuisance.none(hand_eye_m=0.003, hand_eye_rad=0.05))
    assert NuisanceMap.from_experiment(cube).size == 0


@pytest.mark.parametrize("share", [pytest.param(-0.6, marks=pytest.mark.long), 0.3])
def test_a_time_shift_reads_the_motion_at_another_time(share: float):
    cube = replace(hung_cube(20), nuisance=Nuisance.none(time_shift_s=0.01))
    (transcription,) = alone(cube, substeps=10).transcriptions
    grid = simulate(cube, TRUTH, "midpoint", substeps=10)
    found = transcription.markers.predict_samples(grid.sampled, np.array([share]))
    dense = replace(cube, t_s=np.linspace(0, 0.2, 201), markers=_on(cube, np.linspace(0, 0.2, 201)))
    expected = simulate(dense, TRUTH, "midpoint", substeps=1).markers_m
    moved = np.abs(expected - expected[0]).max()
    inside = np.arange(3, 18)
    wanted = expected[inside * 10 + round(10 * share)]
    assert np.abs(found[inside] - wanted).max() < 2e-3 * moved


def test_before_the_start_a_body_at_rest_reads_its_start():
    cube = replace(released_cube(), nuisance=Nuisance.none(time_shift_s=0.01))
    late = readings(cube, np.array([-1.0]))
    start = cube.markers.predict_positions(cube.body.nodes_m)
    np.testing.assert_allclose(late[:2], [start, start], atol=1e-12)


def test_a_corrected_pose_is_another_grasp_under_the_same_gravity():
    """The reading with φ is that of the experiment whose grasp really is turned and shifted."""
    plain = hung_cube()
    nuisance = Nuisance.none(pose_turn_rad=0.1, pose_shift_m=0.01)
    cube = replace(measured(plain), nuisance=nuisance)
    phi = np.array([1.0, -0.6, 0.8, 0.5, -1.0, 0.3])
    pivot = plain.rigid_positions(plain.t_s[:1])[0].mean(axis=0)
    half = 0.1 * phi[:3] / 2  # Cayley's parameters: tan(angle / 2) along the axis
    length = np.linalg.norm(half)
    turn = Rotation.from_rotvec(2 * np.arctan(length) * half / length)
    poses = plain.grasps[0].poses
    rotations, positions = poses.at(plain.t_s)
    moved = PoseSequence(
        plain.t_s,
        turn.apply(positions - pivot) + pivot + 0.01 * phi[3:],
        (turn * Rotation.from_matrix(rotations)).as_quat(),
    )
    really = replace(plain, grasps=(Grasp(plain.grasps[0].nodes, moved),))
    expected = simulate(really, TRUTH, "midpoint", substeps=1).markers_m
    np.testing.assert_allclose(readings(cube, phi), expected, atol=1e-9)


def test_a_tilt_turns_gravity_and_keeps_its_size():
    nuisance = NuisanceMap.from_experiment(replace(hung_cube(), nuisance=ONE_OF_EACH["tilt"]))
    gravity = nuisance.gravity(np.array([1.0, -2.0]))
    assert np.linalg.norm(gravity) == pytest.approx(9.81)
    angle = np.arccos(gravity @ nuisance.gravity_m_s2 / 9.81**2)
    assert angle == pytest.approx(np.arctan(0.05 * np.sqrt(5)), rel=1e-9)


@pytest.mark.parametrize("angles", [*product((1.0, -1.0), repeat=2)])
@pytest.mark.parametrize("down", [(0, 0, -1), (0, -1, 0), (1, 0, 0), (0, -1, -1), (1, 1, 1)])
def test_a_tilt_acts_alike_in_the_recording_and_about_its_tilted_gravity(down, angles):
    """A motion that is planned with the identified gravity deviates by the tilt of the recording."""
    stated = hung_cube(gravity_m_s2=9.81 * np.array(down) / np.linalg.norm(down))
    nuisance = NuisanceMap.from_experiment(replace(stated, nuisance=ONE_OF_EACH["tilt"]))
    tilted = replace(nuisance, gravity_m_s2=nuisance.gravity(np.array(angles)))
    for phi in np.eye(2):
        changes = [each.gravity(phi) - each.gravity_m_s2 for each in (nuisance, tilted)]
        assert np.linalg.norm(changes[0] - changes[1]) < 0.1 * np.linalg.norm(changes[0])


def test_a_body_without_gravity_has_no_tilt():
    floating = hung_cube(start="undeformed", gravity_m_s2=np.zeros(3))
    nuisance = NuisanceMap.from_experiment(replace(floating, nuisance=ONE_OF_EACH["tilt"]))
    assert nuisance.size == 0
    np.testing.assert_array_equal(nuisance.gravity(np.zeros(0)), np.zeros(3))


def test_deviations_must_be_positive():
    with pytest.raises(InputError, match=r"'time_shift_s' is 0; expected a value above 0"):
        Nuisance(time_shift_s=0.0)


# Finding them


# Every kind by one method; by the others one that moves the body, by one of them what is read too.
FOUND_BY = [
    *product(ONE_OF_EACH, ("reduced-space",)),
    *product(("tilt",), ("interior-point", "shooting", "augmented-lagrangian")),
    ("offset", "interior-point"),
]


@pytest.mark.long
@pytest.mark.parametrize(("kind", "method"), FOUND_BY)
def test_nuisance_is_found_beside_the_material(kind: str, method: str, rng):
    cube = replace(cube_with_gaps(14), nuisance=ONE_OF_EACH[kind])
    precise = replace(cube.markers, sigma_m=np.full(len(cube.markers.names), 1e-7))
    cube = replace(cube, markers=precise)
    phi = rng.uniform(-1, 1, NuisanceMap.from_experiment(cube).size)
    solution = solve(Problem([seen_with(cube, phi)], GUESS), method)
    assert solution.status.converged
    (part,) = solution.collocation.iterates(solution.z)
    np.testing.assert_allclose(part.phi, phi, atol=1e-3)
    np.testing.assert_allclose(solution.theta, list(TRUTH.values()), rtol=1e-3)


def test_a_prior_keeps_undetermined_parameters():
    """With one marker the offset and the pose's shift are the same: the priors share it."""
    cube = hung_cube()
    one = replace(cube, markers=_only_first(cube))
    nuisance = Nuisance.none(camera_offset_m=0.002, pose_shift_m=0.001)
    tracks = measured(one).markers.positions_m + np.array([0.005, 0.0, 0.0])
    both = replace(with_markers(one, tracks), nuisance=nuisance)
    solution = ReducedSpace()(alone(both))
    (part,) = solution.collocation.iterates(solution.z)
    offset, shift = 0.002 * part.phi[0], 0.001 * part.phi[3]
    assert offset / shift == pytest.approx(4.0, rel=0.05)  # as their variances
    assert offset + shift == pytest.approx(0.005, rel=0.05)


@pytest.mark.parametrize(
    ("about", "low", "high"), [(0, -2, 2), (5, 3, 7), (-5, -7, -3), (9, 7, 10), (-10, -10, -8)]
)
def test_the_clock_is_limited_to_samples_read_and_a_quarter_of_the_recording(about, low, high):
    cube = replace(hung_cube(40), nuisance=Nuisance.none(time_shift_s=0.02))
    limits = np.concatenate(NuisanceMap.from_experiment(cube).bounds(about))
    np.testing.assert_allclose(limits, np.array([low, high]) * cube.timestep_s / 0.02)


@pytest.mark.parametrize("samples", [-5, pytest.param(5, marks=pytest.mark.long)])
def test_a_shift_of_several_samples_is_found(samples: int):
    cube = replace(hung_cube(40), nuisance=Nuisance.none(time_shift_s=0.03))
    phi = np.array([samples * cube.timestep_s / 0.03])
    solution = solve(Problem([seen_with(cube, phi)], GUESS), "reduced-space")
    assert solution.status.converged
    (part,) = solution.collocation.iterates(solution.z)
    assert part.transcription.association.clock_samples == samples
    # The prior pulls towards no shift.
    np.testing.assert_allclose(part.phi, phi, atol=1e-2)
    np.testing.assert_allclose(solution.theta, list(TRUTH.values()), rtol=0.02)


def test_a_clock_at_its_limit_is_reported():
    cube = replace(hung_cube(32), nuisance=Nuisance.none(time_shift_s=0.2))
    tracks = measured(cube).markers.positions_m
    late = 12  # samples, of which the quarter of the recording allows 8
    still = np.repeat(tracks[:1], late, axis=0)
    late_by = with_markers(cube, np.concatenate([still, tracks[:-late]]))
    found = run(Problem([late_by], GUESS), seek_causes=False)
    assert found.trust.verdict == "doubtful"
    assert any(
        "time shift [s] ended at the largest value allowed" in reason
        for reason in found.trust.reasons
    )


# Places -------------------------------------------------------------------------------------------


def foam_without_references() -> tuple[Experiment, np.ndarray]:
    """A swung block seen by markers of which nobody knows where they sit, and where they do."""
    cube = hung_cube(25)
    places = np.random.default_rng(8).uniform(0.01, 0.09, size=(6, 3)) * [1, 1, 0.6]
    seen = noisy(replace(cube, markers=point_markers(cube.body, places, cube.t_s)), 2e-4)
    tracks = seen.markers.positions_m
    return replace(cube, markers=Markers(cube.t_s, tracks, 2e-4)), places


def test_unknown_places_are_found_from_any_guess():
    experiment, places = foam_without_references()
    found, values = [], []
    for factor in (0.3, 3.0):
        guess = GUESS.with_guess({name: factor * value for name, value in TRUTH.items()})
        solution = solve(Problem([experiment], guess), "reduced-space")
        assert solution.status.converged
        (part,) = solution.collocation.iterates(solution.z)
        found.append(part.transcription.marker_places_m(part.phi))
        values.append(solution.theta)
    np.testing.assert_allclose(values[0], values[1], rtol=1e-4)
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)
    bars = uncertainty_at(solution.collocation, solution.z)
    deviations_m = np.array(list(bars.nuisance.values())) * part.transcription.nuisance.scales
    assert deviations_m.max() < 0.01
    assert np.abs((found[0] - places) / deviations_m.reshape(-1, 3)).max() < 3.5
    errors = np.log(values[0] / list(TRUTH.values())) / np.sqrt(np.diag(bars.covariance))
    assert np.abs(errors).max() < 3.0


def test_places_on_the_surface_stay_there():
    cube = hung_cube(20)
    below, beside = [0.04, 0.03, 0.0], [0.0, 0.06, 0.03]
    shifts = np.array([[0.006, 0.012, 0.0], [0.0, -0.004, 0.007]])
    given = np.array([below, beside])
    seen = noisy(replace(cube, markers=point_markers(cube.body, given + shifts, cube.t_s)), 2e-4)
    # Seen off the surface, as balls are whose middle is not where they are glued.
    tracks = seen.markers.positions_m + np.array([[0, 0, -0.003], [-0.003, 0, 0]])
    off_m = []
    for on_surface in (False, True):
        markers = Markers(
            cube.t_s, tracks, 2e-4, None, given, places_sigma_m=0.01, on_surface=on_surface
        )
        collocation = alone(replace(cube, markers=markers))
        assert collocation.nphi == (4 if on_surface else 6)
        solution = ReducedSpace()(collocation)
        assert solution.status.converged
        (part,) = solution.collocation.iterates(solution.z)
        places = part.transcription.marker_places_m(part.phi)
        off_m.append(np.abs([places[0, 2], places[1, 0]]).max())
    assert off_m[0] > 1e-3
    assert off_m[1] < 1e-12


def test_a_place_beyond_an_edge_of_the_surface_settles():
    """The planes of the faces of a ball that stands off a corner lead away from each other."""
    cube = hung_cube(3)
    given, ball = (np.array([[0.097, 1e-4, 0.1]]), np.array([0.1247, 1e-4, 0.107]))
    markers = Markers(
        cube.t_s,
        np.zeros((len(cube.t_s), 1, 3)),
        2e-4,
        None,
        given,
        places_sigma_m=0.01,
        on_surface=True,
    )
    association, found = (MarkerAssociation.from_experiment(replace(cube, markers=markers)), [])
    for _ in range(8):
        nearest = (
            association.axes[0].T @ (ball - association.centre_places_m[0]) / association.sigma_m[0]
        )
        before, (association, phi) = (
            association,
            association.follow_estimates(association.centre_coordinates + nearest),
        )
        found.append(association.places_m(phi)[0])
    assert association is before
    np.testing.assert_allclose(found[-1], found[-2])
    # As near as the plane of one of the three faces comes.
    distance_m = np.linalg.norm(ball - found[-1])
    assert np.isclose(distance_m, [1e-4, 0.007, 0.0247], atol=1e-9).any()


def test_other_places_do_not_keep_the_earlier_charts():
    cube = replace(hung_cube(4), nuisance=ONE_OF_EACH["place"])
    charted = Collocation([cube], GUESS, associations={cube.name: first_association(cube)})
    exact = replace(charted, experiments=[replace(cube, nuisance=IDEAL)])
    assert len(exact.guess_p) == exact.nq
    assert (
        replace(charted, substeps=2).transcriptions[0].association
        is charted.associations[cube.name]
    )


def test_nuisance_parameters_widen_the_error_bars_of_the_material():
    plain = measured(hung_cube(20))
    known = ReducedSpace()(alone(plain))
    unknown = ReducedSpace()(alone(replace(plain, nuisance=cube_with_nuisance().nuisance)))
    narrow, wide = (
        np.sqrt(np.diag(uncertainty_at(s.collocation, s.z).covariance)) for s in (known, unknown)
    )
    assert (wide > 1.05 * narrow).all()


def test_experiments_keep_their_nuisance_to_themselves(rng):
    first, second = (replace(hung_cube(n), nuisance=ONE_OF_EACH["time"]) for n in (12, 16))
    second = replace(second, name="second")
    both = [seen_with(first, np.array([0.7])), seen_with(second, np.array([-0.4]))]
    exact = [
        replace(e, markers=replace(e.markers, sigma_m=np.full(len(e.markers.names), 1e-7)))
        for e in both
    ]
    solution = ReducedSpace()(Collocation(exact, GUESS))
    found = solution.collocation.parameters_from(solution.z)[4:]
    np.testing.assert_allclose(found, [0.7, -0.4], atol=1e-3)
    assert solution.collocation.parameter_names[4:] == (
        "hung cube: time shift [s]",
        "second: time shift [s]",
    )


def _on(cube: Experiment, t_s: np.ndarray):
    markers = cube.markers
    return replace(
        markers, t_s=t_s, positions_m=np.zeros((len(t_s), *markers.positions_m.shape[1:]))
    )


def _only_first(cube: Experiment):
    return vertex_markers(cube.body, cube.markers.placement.nodes[0][[0]], cube.t_s)
