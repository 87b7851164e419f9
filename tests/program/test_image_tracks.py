"""Tracks of points in images of ordinary cameras: predictions, derivatives, places and poses."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from kit.depth import looking
from kit.filmed import (
    EXACT,
    EYES_M,
    MATRIX,
    NAMES,
    NOISE_PX,
    PLACES_M,
    T_S,
    TRUTH,
    bar,
    filming,
    motion_m,
    projected,
    swung,
    tracks_of,
    unknown_young,
)
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.kinds.image_tracks.notes import notes
from collocation_sysid.kinds.image_tracks.rays import (
    is_behind,
    is_occluded,
    points_on_surface,
    poses_from_points,
)
from collocation_sysid.kinds.image_tracks.residual import ImageTrackResidual
from collocation_sysid.methods.solution import Solution, Status
from collocation_sysid.program.observables import ObservableDerivatives

# Every deviation is estimated.
FREE: dict[str, Any] = {
    "clock_rate_sigma": 1e-3,
    "line_delay_s": 2e-5,
    "line_delay_sigma_s": 5e-6,
    "drift_sigma_px": 1.0,
}


def residual_of(*tracks: cs.ImageTracks) -> ImageTrackResidual:
    program = cs.Problem([swung(tracks)], parameters=unknown_young()).collocation()
    return program.transcriptions[0].residuals_of(ImageTrackResidual)[-1]


def simulated_m() -> np.ndarray:
    """Positions of all nodes, flat."""
    motion = cs.simulate(swung(), TRUTH, "midpoint", substeps=1)
    return motion.positions_m.reshape(len(T_S), -1)


def test_predicted_pixels_are_the_projections_of_the_markers() -> None:
    tracks = tracks_of(**EXACT)
    simulated = cs.simulate(swung([tracks]), TRUTH, "midpoint", substeps=1)
    pixels = simulated.custom_sensor_values[0].reshape(len(T_S), -1, 2)
    expected = projected(filming("front"), motion_m())
    is_hidden = np.isnan(pixels).all(axis=2)
    assert is_hidden.any(axis=0).sum() == 1  # one point is on a face that looks away
    np.testing.assert_allclose(pixels[~is_hidden], expected[~is_hidden], atol=1e-9)


def test_images_between_the_samples_are_interpolated() -> None:
    at_s = T_S[:-1:2] + 0.004
    tracks = tracks_of(**EXACT).with_samples(at_s, np.zeros((len(at_s), 2 * len(NAMES))))
    fine = cs.simulate(swung([tracks]), TRUTH, "midpoint", substeps=1)
    around = cs.simulate(swung([tracks_of(**EXACT)]), TRUTH, "midpoint", substeps=1)
    for k, t_s in enumerate(at_s[2:-2], start=2):
        first = 2 * k - 2
        places, values = T_S[first : first + 5], around.custom_sensor_values[0][first : first + 5]
        expected = np.polyval(np.polyfit(places - t_s, values[:, 0], 4), 0.0)
        # The projection of interpolated positions differs from interpolated projections slightly.
        assert abs(fine.custom_sensor_values[0][k, 0] - expected) < 0.02


@pytest.mark.parametrize("changes", [{}, FREE, {"known": False} | FREE])
def test_derivatives_of_residuals_agree_with_differences(changes: dict) -> None:
    residual = residual_of(tracks_of(**changes))
    x = simulated_m()
    rng = np.random.default_rng(3)
    start = residual.correspondences.with_start_values(np.zeros(residual.nuisance.size))
    phi = start + 0.01 * rng.normal(size=residual.nuisance.size)
    direction = rng.normal(size=x.shape) * 1e-3

    def at(step: float, step_phi: np.ndarray) -> np.ndarray:
        values = residual.observable.evaluate_positions(x + step * direction, phi + step_phi)
        return residual.residuals(values, phi + step_phi)

    still = np.zeros_like(phi)
    points = residual.observable
    shape = points.shape_functions(phi)
    by_x = (points.operator(phi) @ direction.T).T[..., None]
    slopes: ObservableDerivatives = points.derivatives_from(x, shape, np.array([0]), by_x)
    values = points.evaluate_positions(x, phi)
    found, by = residual.linearise(values, slopes, phi, 1 + len(phi))
    np.testing.assert_allclose(found, at(0.0, still), atol=1e-10)
    step = 1e-5
    differences = (at(step, still) - at(-step, still)) / (2 * step)
    np.testing.assert_allclose(by[..., 0], differences, rtol=1e-5, atol=1e-5)
    for k in range(len(phi)):
        unit = np.where(np.arange(len(phi)) == k, step, 0.0)
        differences = (at(0.0, unit) - at(0.0, -unit)) / (2 * step)
        np.testing.assert_allclose(by[..., 1 + k], differences, rtol=1e-4, atol=1e-4)


def solved(*tracks: cs.ImageTracks, **changes: Any) -> Solution:
    problem = cs.Problem([swung(tracks, **changes)], parameters=unknown_young())
    return cs.solve(problem)


@pytest.mark.long
@pytest.mark.parametrize("known", [True, False])
def test_youngs_modulus_is_found_from_one_camera(known: bool) -> None:
    solution = solved(tracks_of(rng=np.random.default_rng(1), known=known))
    assert abs(solution.parameters["young_pa"] / TRUTH["young_pa"] - 1) < 0.01


@pytest.mark.long
def test_a_wrong_pose_is_estimated() -> None:
    rng = np.random.default_rng(2)
    off = np.array(filming("front").pose)
    off[:3, :3] = off[:3, :3] @ Rotation.from_rotvec([0.02, -0.03, 0.02]).as_matrix()
    off[:3, 3] += [0.006, -0.012, 0.008]
    loose = cs.PoseSigma(turn_deg=3.0, shift_m=0.02)
    tracks = tracks_of(rng=rng, camera=filming("front", pose=off), pose_sigma=loose)
    solution = solved(tracks)
    assert abs(solution.parameters["young_pa"] / TRUTH["young_pa"] - 1) < 0.01
    trusted = solved(
        tracks_of(rng=np.random.default_rng(2), camera=filming("front", pose=off), **EXACT)
    )
    assert abs(trusted.parameters["young_pa"] / TRUTH["young_pa"] - 1) > 0.02


@pytest.mark.long
def test_an_unknown_pose_is_found_from_the_body_at_rest() -> None:
    camera = filming("front", pose=np.eye(4))
    tracks = tracks_of(rng=np.random.default_rng(4), camera=camera, has_known_pose=False)
    solution = solved(tracks)
    assert abs(solution.parameters["young_pa"] / TRUTH["young_pa"] - 1) < 0.02
    places = solution.parts[0].transcription.residuals_of(ImageTrackResidual)[0].correspondences
    true = filming("front").pose
    away_m = np.linalg.norm(places.translations[0] - true[:3, 3])
    assert away_m < 0.02  # 4 % of the distance of the camera
    residual = solution.parts[0].transcription.residuals_of(ImageTrackResidual)[0]
    pose = residual.estimated_pose(solution.parts[0].phi)
    off = (
        Rotation.from_matrix(pose[:3, :3]).inv() * Rotation.from_matrix(true[:3, :3])
    ).magnitude()
    assert np.linalg.norm(pose[:3, 3] - true[:3, 3]) < 0.01
    assert np.rad2deg(off) < 1.0
    assert any("pose of 'front' as found: pose = [[" in note for note in notes(solution.parts[0]))


def test_the_estimated_pose_shows_points_at_their_predictions() -> None:
    residual = residual_of(tracks_of())
    phi = 0.5 * np.random.default_rng(6).normal(size=residual.nuisance.size)
    phi[residual.nuisance.indices_of_labels([residual.sensor.unknown_label("delay_s")])] = 0.0
    for name in ("focal_error", "centre_u_px", "centre_v_px"):
        phi[residual.nuisance.indices_of_labels([residual.sensor.unknown_label(name)])] = 0.0
    values = residual.observable.evaluate_positions(simulated_m(), phi)
    seen = projected(filming("front", pose=residual.estimated_pose(phi)), values)
    np.testing.assert_allclose(residual.predict(values, phi)[..., :2], seen, atol=1e-6)


@pytest.mark.long
def test_a_late_clock_is_estimated() -> None:
    pixels = projected(filming("front"), motion_m())
    # The images of a camera that is 6 ms late show the motion 6 ms later.
    late = CubicSpline(T_S, pixels)(T_S + 0.006)
    rng = np.random.default_rng(5)
    late = late + NOISE_PX * rng.normal(size=late.shape)
    tracks = tracks_of().with_samples(T_S[:-1], late[:-1].reshape(len(T_S) - 1, -1))
    solution = solved(tracks)
    assert abs(solution.nuisance("delay_s") - 0.006) < 5e-4
    assert abs(solution.parameters["young_pa"] / TRUTH["young_pa"] - 1) < 0.01


def test_a_delay_does_not_extrapolate_between_fine_time_steps() -> None:
    delay_s = 0.02
    tracks = replace(tracks_of(**EXACT), clock_sigma_s=delay_s)
    program = cs.Problem([swung([tracks])], parameters=unknown_young(), substeps=8).collocation()
    fine_s = np.linspace(T_S[0], T_S[-1], 8 * (len(T_S) - 1) + 1)
    nodes_m = CubicSpline(T_S, simulated_m())(fine_s)
    nodes_m += 1e-5 * np.random.default_rng(4).normal(size=nodes_m.shape)
    p = program.guess_p
    p[program.parameter_names.index("swing: delay of front [s]")] = 1.0
    program, p = program.follow_estimates(p, [nodes_m])
    part = program.transcriptions[0]
    (residual,) = part.residuals_of(ImageTrackResidual)
    phi = p[part.nuisance_indices.indices]
    values = residual.observable.evaluate_positions(nodes_m, phi)
    predicted = residual.numbers(residual.predict(values, phi)).reshape(-1, len(NAMES), 2)
    expected = CubicSpline(T_S, projected(filming("front"), motion_m()))(T_S + delay_s)
    within = T_S + delay_s <= T_S[-1]
    assert np.isnan(predicted[~within]).all()
    assert np.nanmax(np.abs(predicted - expected)[within]) < 0.1


def test_a_rolling_shutter_does_not_extrapolate_between_fine_time_steps() -> None:
    line_s, still_px = 2e-4, projected(filming("front"), motion_m())
    in_time, pixels = CubicSpline(T_S, still_px), still_px
    for _ in range(8):
        exposed_s = T_S[:, None] + line_s * pixels[..., 1]
        shown = in_time(exposed_s)
        pixels = np.stack([shown[:, k, k] for k in range(len(NAMES))], axis=1)
    tracks = replace(tracks_of(**EXACT), line_delay_s=line_s, pixels=pixels)
    program = cs.Problem([swung([tracks])], parameters=unknown_young(), substeps=8).collocation()
    fine_s = np.linspace(T_S[0], T_S[-1], 8 * (len(T_S) - 1) + 1)
    nodes_m = CubicSpline(T_S, simulated_m())(fine_s)
    nodes_m += 1e-5 * np.random.default_rng(4).normal(size=nodes_m.shape)
    program, p = program.follow_estimates(program.guess_p, [nodes_m])
    part = program.transcriptions[0]
    (residual,) = part.residuals_of(ImageTrackResidual)
    phi = p[part.nuisance_indices.indices]
    values = residual.observable.evaluate_positions(nodes_m, phi)
    predicted = residual.numbers(residual.predict(values, phi)).reshape(-1, len(NAMES), 2)
    within = exposed_s <= T_S[-1]
    assert np.isnan(predicted[~within]).all()
    assert np.nanmax(np.abs(predicted - pixels)[within]) < 0.1


def test_a_rolling_shutter_changes_nothing_where_nothing_moves() -> None:
    held = cs.Grasp(np.flatnonzero(bar().nodes_m[:, 0] < 1e-9), cs.PoseSequence.fixed())
    pixels = projected(filming("front"), motion_m())[:1]
    tracks = replace(tracks_of(**EXACT), t_s=T_S[:1], pixels=pixels)
    found = []
    for line_s in (0.0, 2e-5):
        readings = [replace(tracks, line_delay_s=line_s)]
        still = cs.Experiment(bar(), [0.0], [held], kind="static", readings=readings)
        part = cs.Problem([still], parameters=unknown_young()).collocation().transcriptions[0]
        (residual,) = part.residuals_of(ImageTrackResidual)
        values = residual.observable.evaluate_positions(simulated_m()[:1], part.guess_phi)
        found.append(residual.residuals(values, part.guess_phi)[residual.is_compared])
    assert len(found[0])
    np.testing.assert_array_equal(*found)


def test_a_clock_of_markers_needs_no_markers() -> None:
    experiment = swung([tracks_of()], nuisance=cs.Nuisance())
    program = cs.Problem([experiment], parameters=unknown_young()).collocation()
    markers = program.transcriptions[0].markers
    slopes = ObservableDerivatives.without_own(np.array([0]), np.zeros((len(T_S), 0, 3, 1)))
    phi = np.zeros(markers.nuisance.size)
    residual, by = markers.linearise(np.zeros((len(T_S), 0, 3)), slopes, phi, 1 + len(phi))
    assert residual.shape[1] == by.shape[1] == 0


def test_cameras_share_the_places_of_points_with_the_same_name() -> None:
    residual = residual_of(tracks_of("front", known=False), tracks_of("top", known=False))
    labels = [entry.label for entry in residual.nuisance.entries]
    assert len(labels) == len(set(labels))
    assert sum(label.startswith("place of tip_top on") for label in labels) == 2
    assert sum(label.startswith("delay of") for label in labels) == 2
    one, two = swung([tracks_of("front")]), swung([tracks_of("front"), tracks_of("top")])
    count = [cs.Problem([e], unknown_young()).collocation().transcriptions[0] for e in (one, two)]
    assert count[1].nuisance.size - count[0].nuisance.size == 10  # of the second camera alone


def test_a_place_stated_for_one_camera_is_known_to_all() -> None:
    places = residual_of(tracks_of("front"), tracks_of("top", known=False)).correspondences
    np.testing.assert_allclose(
        places.association.prior_places_m, list(PLACES_M.values()), atol=1e-12
    )
    np.testing.assert_allclose(places.association.sigma_m, 1e-3)


def test_unknown_places_are_where_the_first_rays_meet_the_surface() -> None:
    residual = residual_of(tracks_of(known=False))
    still = np.zeros(residual.nuisance.size)
    found = residual.aligned_correspondences(simulated_m(), still)
    at = dict(zip(NAMES, found.places_m(found.with_start_values(still)), strict=True))
    for name in set(NAMES) - {"tip_end"}:  # which the camera does not see
        np.testing.assert_allclose(at[name], PLACES_M[name], atol=1e-5)


def test_hidden_points_are_not_compared() -> None:
    residual = residual_of(tracks_of("front"))
    seen = np.asarray(residual.is_compared[..., :2].all(axis=(0, 2)))
    compared = dict(zip(NAMES, seen.tolist(), strict=True))
    assert not compared["tip_end"]  # its face looks away from the camera
    assert compared["tip_front"]
    assert compared["near_top"]
    # Two shapes: a roof above the first point, and one that touches it.
    eyes = np.tile([0.0, 0.0, 1.0], (2, 1))
    roof = np.array([[[-1.0, -1.0, 0.5], [1.0, -1.0, 0.5], [0.0, 1.0, 0.5]]])
    roofs = np.array([roof, roof - [0, 0, 0.495]])
    points = np.tile([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]], (2, 1, 1))
    assert is_occluded(points, eyes, roofs, 0.01).tolist() == [[True, False], [False, False]]


def test_points_behind_an_obstacle_are_not_compared() -> None:
    # A ball between the camera and the middle of the bar, and a wall behind the bar.
    eye, middle = np.array(EYES_M["front"]), np.array(PLACES_M["middle_front"])
    ball = cs.Obstacle(shape=cs.Sphere(0.004, 0.6 * middle + 0.4 * eye), name="ball")
    wall = cs.Obstacle(shape=cs.Plane([0.0, -1.0, 0.0], [0.0, 0.1, 0.0]), name="wall")
    tracks = tracks_of("front", **EXACT)
    compared = {}
    for name, obstacles in (("free", [wall]), ("hidden", [wall, ball])):
        experiment = swung([tracks])
        experiment = replace(experiment, grasps=[*experiment.grasps, *obstacles])
        program = cs.Problem([experiment], parameters=unknown_young()).collocation()
        (residual,) = program.transcriptions[0].residuals_of(ImageTrackResidual)
        compared[name] = dict(zip(NAMES, residual.is_compared[0, :, 0].tolist(), strict=True))
    assert compared["free"]["middle_front"]
    assert not compared["hidden"]["middle_front"]
    others = [name for name in NAMES if name != "middle_front"]
    assert [compared["hidden"][n] for n in others] == [compared["free"][n] for n in others]


def test_a_solid_hides_points_behind_and_not_points_in_touch() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.0, 0.21], [0.0, 0.0, 0.8]])
    eyes = np.tile([0.0, 0.0, 2.0], (4, 1))

    def ball(points_m: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points_m - [0.0, 0.0, 0.5], axis=1) - 0.1

    assert is_behind(points, eyes, ball, 0.01).tolist() == [True, False, True, False]
    floor = np.array([[0.0, 0.0, -1e-4]])
    assert not is_behind(floor, eyes[:1], lambda points_m: points_m[:, 2], 0.01).any()


def test_unknown_places_cross_creases_to_faces_that_the_camera_sees() -> None:
    found = residual_of(tracks_of(known=False)).correspondences
    at = found.association.centre_places_m.copy()
    front, top, end = map(NAMES.index, ("middle_front", "middle_top", "tip_front"))
    at[front, 2] = 0.021  # beyond the upper edge of the front
    at[top, 1] = -0.001  # beyond the front edge of the top
    at[end, 0] = 0.121  # towards the end, which looks away from the camera
    shapes = np.tile(bar().nodes_m, (1, 1, 1))
    moved = found._with_faces_of(at, shapes)
    places = moved.association.centre_places_m
    axes = moved.association.axes
    normals = np.cross(axes[..., 0], axes[..., 1])
    # They appear where they did: on the line from the camera through the point beyond the edge.
    eye = np.array(EYES_M["front"])
    for point, plane, height in ((front, 2, 0.02), (top, 1, 0.0)):
        way = at[point] - eye
        there = eye + way * (height - eye[plane]) / way[plane]
        np.testing.assert_allclose(places[point], there, atol=1e-12)
    np.testing.assert_allclose(abs(normals[front]), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(abs(normals[top]), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(places[end], at[end], atol=1e-12)
    np.testing.assert_allclose(abs(normals[end]), [0, 1, 0], atol=1e-12)
    # Places that are stated stay on their side.
    stated = residual_of(tracks_of()).correspondences
    assert not np.any(stated._with_faces_of(at, shapes).crossings)
    # Places that cameras share cross at the edge: cameras must not disagree about them.
    both = residual_of(tracks_of(known=False), tracks_of("side", known=False)).correspondences
    shared = both._with_faces_of(at, shapes).association.centre_places_m
    np.testing.assert_allclose(shared[front], [at[front, 0], 0.0, 0.02], atol=1e-12)


def test_places_are_found_where_a_stated_pose_lets_all_rays_miss_the_body() -> None:
    off = np.eye(4)
    off[:3, :3] = Rotation.from_euler("x", 3, degrees=True).as_matrix()
    tracks = tracks_of(known=False, camera=filming("front", pose=filming("front").pose @ off))
    pixels = np.array(tracks.pixels)
    pixels[:, NAMES.index("tip_end")] = np.nan  # which the camera does not see
    residual = residual_of(tracks.with_samples(T_S, pixels.reshape(len(T_S), -1)))
    found = residual.correspondences
    nodes_m = bar().nodes_m
    eye = found.translations[0]
    rays = tracks.camera.points_at_unit_depth(pixels[0, [0, 2]]) @ found.rotations[0].T
    missed = points_on_surface(np.tile(eye, (2, 1)), rays, nodes_m, bar().mesh.surface)[2]
    assert (missed > 0).all()
    # Only the pose is turned, by about its error, and no two points are at the same corner.
    assert abs(found.start_pose[0]) == pytest.approx(3.0, abs=1.0)
    assert abs(found.start_pose[1:]).max() < 2.0
    phi = found.with_start_values(np.zeros(residual.nuisance.size))
    places = np.delete(found.places_m(phi), NAMES.index("tip_end"), axis=0)
    np.testing.assert_allclose(places, np.delete(list(PLACES_M.values()), 1, axis=0), atol=0.03)
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    assert (apart[np.triu_indices(len(places), 1)] > 1e-3).all()


@pytest.mark.long
def test_unknown_places_that_the_guess_puts_on_the_wrong_side_do_not_bias() -> None:
    # With a third of the stiffness the bar hangs lower, so that the first rays meet other faces.
    near_edges = dict(PLACES_M) | {
        "tip_top": (0.108, 0.004, 0.02),
        "middle_top": (0.09, 0.003, 0.02),
    }
    places = np.array(list(near_edges.values()))
    markers = cs.Markers(T_S, np.zeros((41, 7, 3)), 1e-3, names=NAMES, places_m=places)
    true_m = cs.simulate(replace(swung(), markers=markers), TRUTH, "midpoint", substeps=1).markers_m
    tracks = tracks_of(known=False)
    pixels = projected(filming("front"), true_m)
    pixels += NOISE_PX * np.random.default_rng(3).normal(size=pixels.shape)
    tracks = tracks.with_samples(T_S, pixels.reshape(41, -1))
    problem = cs.Problem([swung([tracks])], parameters=unknown_young(5e4))
    solution = cs.solve(problem)
    assert solution.status is Status.CONVERGED
    assert solution.parameters["young_pa"] == pytest.approx(TRUTH["young_pa"], rel=0.03)
    (residual,) = solution.collocation.transcriptions[0].residuals_of(ImageTrackResidual)
    found = residual.correspondences.places_m(solution.parts[0].phi)
    for name in ("tip_top", "middle_top"):
        np.testing.assert_allclose(found[NAMES.index(name)], near_edges[name], atol=3e-3)


def test_points_off_the_body_are_excluded() -> None:
    tracks = tracks_of(known=False)
    assert tracks.pixels is not None
    pixels = np.array(tracks.pixels)
    pixels[:, 0] = [40.0, 40.0]  # the background
    residual = residual_of(tracks.with_samples(T_S, pixels.reshape(len(T_S), -1)))
    assert residual.correspondences.is_placed.tolist() == [False] + [True] * (len(NAMES) - 1)
    assert not residual.is_compared[:, 0].any()


def test_poses_from_inexact_points_near_a_line_are_found():
    """The steps of the search decrease slowly, because depth and turn nearly compensate."""
    x_m, z_m = [6.6, 14.5, 5.4, 6.6, 10.8], [85.9, 1.6, 22.9, 3.3, 104.0]
    points_m = 1e-3 * np.stack([x_m, np.zeros(5), z_m], axis=1)
    u, v = [-0.0227, 0.005, -0.0315, -0.0237, -0.0037], [-0.1353, 0.1882, 0.1119, 0.1817, -0.196]
    (pose, error), *_ = poses_from_points(points_m, np.stack([u, v, np.ones(5)], axis=1))
    own_m = (points_m - pose[:3, 3]) @ pose[:3, :3]
    assert own_m[:, 2].min() > 0.1
    off = own_m[:, :2] / own_m[:, 2:] - np.stack([u, v], axis=1)
    assert np.sqrt(np.mean(off**2)) == pytest.approx(error)
    assert error < 0.0025


@pytest.mark.parametrize("flat", [True, False])
def test_poses_are_found_from_points(flat: bool) -> None:
    rng = np.random.default_rng(6)
    points = rng.uniform(-0.05, 0.05, (8, 3)) * ([1, 1, 0] if flat else [1, 1, 1])
    true = looking(np.array(EYES_M["front"]), np.zeros(3))
    rays = (points - true[:3, 3]) @ true[:3, :3]
    rays /= rays[:, 2:]
    rays[:, :2] += 1e-4 * rng.normal(size=(8, 2))
    poses = poses_from_points(points, rays)
    (best, error), *others = poses
    assert error < 2e-4
    assert np.linalg.norm(best[:3, 3] - true[:3, 3]) < 0.02
    if flat:  # the mirror image fits second best
        assert others
        assert error <= others[0][1]


def test_rays_find_the_nearest_of_several_triangles() -> None:
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0], [-1, -1, 1], [1, -1, 1], [0, 1, 1]])
    surface = np.array([[0, 1, 2], [3, 4, 5]])
    up, down = np.array([[0.0, 0, -1]]), np.array([[0.0, 0, 3]])
    assert points_on_surface(up, np.array([[0.0, 0, 1]]), corners, surface)[0][0] == 0
    faces, shares, missed = points_on_surface(down, np.array([[0.0, 0, -1]]), corners, surface)
    assert (faces[0], missed[0]) == (1, 0.0)
    np.testing.assert_allclose(shares[0] @ corners[surface[1]], [0, 0, 1], atol=1e-12)
    assert points_on_surface(down, np.array([[1.0, 1, -1]]), corners, surface)[2][0] > 0.1
    # A miss is next to an edge, also far from its ends.
    ahead = np.array([[0.0, -0.6, -1.0]])
    faces, shares, missed = points_on_surface(down, ahead, corners, surface)
    np.testing.assert_allclose(shares[0] @ corners[surface[faces[0]]], [0, -1, 1], atol=1e-12)
    assert np.arcsin(missed[0]) == pytest.approx(np.arctan(0.6) - np.arctan(0.5), rel=1e-9)


def test_tracks_can_be_pickled_and_shortened() -> None:
    tracks = pickle.loads(pickle.dumps(tracks_of()))
    assert tracks.columns[:2] == ("tip_front_u", "tip_front_v")
    half = tracks.without_later_values(0.2)
    assert np.isnan(half.measured_values[21:]).all()
    assert np.isfinite(half.measured_values[:21]).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera": cs.Camera()}, "has no matrix"),
        ({"names": ("a",) * 7}, "expected different names"),
        ({"t_s": T_S[::-1]}, "t_s of the image tracks 'front'"),
        ({"pixels": np.zeros((3, 7, 2))}, "pixels of the image tracks 'front'"),
        ({"pixels": np.full((41, 7, 2), np.nan)}, "all pixels of .* are missing"),
        ({"places_m": np.zeros((2, 3))}, "places_m of the image tracks 'front'"),
        ({"sigma_px": 0.0}, "sigma_px"),
    ],
)
def test_impossible_tracks_are_refused(changes: dict, message: str) -> None:
    arguments: dict[str, Any] = {
        "camera": cs.Camera(MATRIX),
        "t_s": T_S,
        "pixels": np.zeros((41, 7, 2)),
        "names": NAMES,
    }
    with pytest.raises(cs.InputError, match=message):
        cs.ImageTracks("front", **arguments | changes)


def test_an_unknown_pose_needs_four_known_places() -> None:
    places = np.array(list(PLACES_M.values()))
    places[3:] = np.nan
    tracks = tracks_of(places_m=places, has_known_pose=False, known=False)
    with pytest.raises(cs.InputError, match=r"3 of its points .* expected at least 4"):
        residual_of(tracks)
