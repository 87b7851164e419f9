"""Rigid transformations fitted to points."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from collocation_sysid.errors import InputError
from collocation_sysid.recording import MarkerTable, PoseSequence, align_to_template, fit_poses
from collocation_sysid.recording.rigid_fit import least_rigid_marker

CLUSTER_M = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.08, 0.0], [0.03, 0.03, 0.06]])


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def carried(reference_m, rotations, translations):
    return np.einsum("tij,bj->tbi", rotations.as_matrix(), reference_m) + translations[:, None]


def motion(rng, frames=20):
    return Rotation.random(frames, rng=rng), rng.normal(size=(frames, 3))


def assert_rotations(quaternions, rotations, atol=1e-7):
    turn = Rotation.from_quat(quaternions) * rotations.inv()
    np.testing.assert_allclose(turn.magnitude(), 0.0, atol=atol)


@pytest.mark.parametrize("markers", [3, 4])
def test_a_rigid_motion_is_recovered_exactly(rng, markers):
    rotations, translations = motion(rng)
    reference = CLUSTER_M[:markers]  # three lie in a plane: a reflection would fit as well
    fit = fit_poses(reference, carried(reference, rotations, translations))
    assert_rotations(fit.quaternions_xyzw, rotations)
    np.testing.assert_allclose(fit.positions_m, translations, atol=1e-12)
    np.testing.assert_allclose(fit.residual_m, 0.0, atol=1e-12)
    assert not fit.missing.any()


def test_the_fit_is_that_of_scipy(rng):
    rotations, translations = motion(rng)
    tracks = carried(CLUSTER_M, rotations, translations) + 0.002 * rng.normal(size=(20, 4, 3))
    weights = np.array([1.0, 2.0, 0.5, 3.0])
    fit = fit_poses(CLUSTER_M, tracks, weights)
    centre = weights @ CLUSTER_M / weights.sum()
    for k, points in enumerate(tracks):
        mean = weights @ points / weights.sum()
        best, root = Rotation.align_vectors(points - mean, CLUSTER_M - centre, weights)
        assert_rotations(fit.quaternions_xyzw[[k]], best)
        np.testing.assert_allclose(fit.residual_m[k], root / np.sqrt(weights.sum()), rtol=1e-6)


def test_a_weight_of_zero_leaves_a_marker_out(rng):
    rotations, translations = motion(rng)
    tracks = carried(CLUSTER_M, rotations, translations)
    tracks[:, 3] += 0.02
    fit = fit_poses(CLUSTER_M, tracks, [1, 1, 1, 0])
    assert_rotations(fit.quaternions_xyzw, rotations)
    np.testing.assert_allclose(fit.residual_m, 0.0, atol=1e-12)


def test_missing_markers_are_done_without(rng):
    rotations, translations = motion(rng)
    tracks = carried(CLUSTER_M, rotations, translations)
    tracks[::2, 1] = np.nan
    fit = fit_poses(CLUSTER_M, tracks)
    assert_rotations(fit.quaternions_xyzw, rotations)
    assert np.isfinite(fit.residual_m).all()


def test_frames_with_too_few_markers_are_interpolated():
    t = 0.1 * np.arange(11)
    turns = Rotation.from_rotvec(np.outer(t, [0.3, 0.0, 0.5]))
    tracks = carried(CLUSTER_M, turns, np.outer(t, [1.0, 2.0, 3.0]))
    tracks[:2, :2] = tracks[5, 1:3] = tracks[10, :] = np.nan
    fit = fit_poses(CLUSTER_M, tracks)
    assert np.flatnonzero(fit.missing).tolist() == [0, 1, 5, 10]
    poses = fit.poses(t)
    np.testing.assert_allclose(poses.t_s, t[2:10])
    np.testing.assert_allclose(poses.positions_m, np.outer(t[2:10], [1.0, 2.0, 3.0]), atol=1e-12)
    assert_rotations(poses.quaternions_xyzw, turns[2:10])


def test_markers_left_on_one_line_count_as_missing(rng):
    reference = np.array([[0.0, 0, 0], [0.05, 0, 0], [0.1, 0, 0], [0.0, 0.1, 0]])
    tracks = carried(reference, *motion(rng))
    tracks[4, 3] = np.nan
    fit = fit_poses(reference, tracks)
    assert np.flatnonzero(fit.missing).tolist() == [4]
    assert np.isnan(fit.quaternions_xyzw[4]).all()
    assert np.isnan(fit.residual_m[4])


def test_no_frame_with_three_markers_gives_no_poses():
    fit = fit_poses(CLUSTER_M, np.full((3, 4, 3), np.nan))
    with pytest.raises(InputError, match="no frame contains three markers"):
        fit.poses([0.0, 0.1, 0.2])


@pytest.mark.parametrize(
    "reference",
    [
        np.outer([0.0, 1.0, 2.0, 5.0], [0.1, 0.2, 0.3]),
        np.array([[0.0, 0.0, 0.0], [0.1, 0.0005, 0.0], [0.2, 0.0, 0.0]]),
        CLUSTER_M[:2],
        CLUSTER_M[[1, 1, 1]],
    ],
)
def test_markers_on_one_line_are_refused(reference):
    with pytest.raises(InputError, match="at least three that do not"):
        fit_poses(reference, np.zeros((5, len(reference), 3)))
    with pytest.raises(InputError, match="3 markers of a rigid fit lie on one line"):
        fit_poses([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]], np.zeros((5, 4, 3)), [1, 1, 1, 0])


def test_negative_weights_and_other_shapes_are_refused():
    with pytest.raises(InputError, match="a weight is -1"):
        fit_poses(CLUSTER_M, np.zeros((5, 4, 3)), [1, 1, 1, -1])
    with pytest.raises(InputError, match="tracks_m has the shape"):
        fit_poses(CLUSTER_M, np.zeros((5, 3, 3)))


@pytest.mark.parametrize("markers", [3, 4])
@pytest.mark.parametrize("moving", [0, 1, 2])
def test_a_marker_that_moves_in_the_template_is_found(rng, markers, moving):
    reference = CLUSTER_M[:markers]
    tracks = carried(reference, *motion(rng, 1))
    tracks[0, moving] += 0.1 * (tracks[0, moving] - tracks[0].mean(axis=0))
    assert least_rigid_marker(reference, tracks[0]) == moving
    assert fit_poses(reference, tracks).residual_m[0] > 1e-4


# Templates ----------------------------------------------------------------------------------------

NAMES = ("a", "b", "c", "d", "tip")


def camera_table(rng):
    """Five markers at rest until 0.5 s in another frame; the tip is no part of the template."""
    t = 0.01 * np.arange(100)
    places = np.vstack([CLUSTER_M, [[0.2, 0.1, 0.1]]])
    body = np.repeat(places[None], len(t), axis=0)
    body[t > 0.5] += 0.03
    turn = Rotation.random(rng=rng)
    return MarkerTable(t, NAMES, body @ turn.as_matrix().T + [1.0, 2.0, 3.0]), body


def test_tracks_are_moved_to_the_template(rng):
    table, body = camera_table(rng)
    template = dict(zip("abcd", CLUSTER_M.tolist(), strict=True))
    fit = align_to_template(table, template, (0.0, 0.5))
    rotation, translation, residual = fit
    np.testing.assert_allclose(table.positions_m @ rotation.T + translation, body, atol=1e-12)
    np.testing.assert_allclose(residual, 0.0, atol=1e-12)
    moved = fit.apply(table)
    assert moved.names == NAMES
    np.testing.assert_allclose(moved.positions_m, body, atol=1e-12)


def test_a_template_does_without_a_marker_that_is_not_seen(rng):
    table, body = camera_table(rng)
    tracks = table.positions_m.copy()
    tracks[:60, 1] = np.nan
    tracks[:30:2, 0] = np.nan
    gaps = MarkerTable(table.t_s, NAMES, tracks)
    fit = align_to_template(gaps, dict(zip("abcd", CLUSTER_M.tolist(), strict=True)), (0.0, 0.5))
    assert np.isnan(fit.residual_m).tolist() == [False, True, False, False]
    np.testing.assert_allclose(fit.apply(table).positions_m, body, atol=1e-12)


@pytest.mark.parametrize(
    ("names", "window_s", "words"),
    [
        ("abx", (0.0, 0.5), "no marker 'x' for the template"),
        (
            "abc",
            (5.0, 6.0),
            "contains no sample; expected a window within the times of the markers, from 0 s to 0.99 s",
        ),
        ("ab", (0.0, 0.5), "at least three"),
    ],
)
def test_a_template_that_cannot_be_fitted_is_refused(rng, names, window_s, words):
    table, _ = camera_table(rng)
    template = dict(zip(names, CLUSTER_M.tolist(), strict=False))
    with pytest.raises(InputError, match=words):
        align_to_template(table, template, window_s)


# Two points ---------------------------------------------------------------------------------------


def turned_across(rng, frames=30) -> tuple[Rotation, np.ndarray, np.ndarray]:
    """Small rotations from frame to frame about axes across the line of two points, from the pose of
    the undeformed body.
    """
    line = CLUSTER_M[1] - CLUSTER_M[0]
    rotations = [Rotation.identity()]
    for vector in rng.normal(scale=0.1, size=(frames - 1, 3)):
        now = rotations[-1].apply(line) / np.linalg.norm(line)
        rotations.append(Rotation.from_rotvec(vector - (vector @ now) * now) * rotations[-1])
    return Rotation.concatenate(rotations), rng.normal(size=(frames, 3)), CLUSTER_M[:2]


def test_a_motion_that_does_not_twist_follows_from_two_points(rng):
    rotations, shifts_m, points_m = turned_across(rng)
    t_s = np.arange(len(rotations)) / 100
    tracks = carried(points_m, rotations, shifts_m)
    poses = PoseSequence.from_two_points(t_s, tracks, points_m)
    assert_rotations(poses.quaternions_xyzw, rotations)
    np.testing.assert_allclose(poses.positions_m, shifts_m, atol=1e-12)


def test_the_rotation_between_two_points_does_not_twist(rng):
    """Whatever the body did about their line."""
    rotations, shifts_m = motion(rng, frames=9)
    tracks = carried(CLUSTER_M[:2], rotations, shifts_m)
    poses = PoseSequence.from_two_points(np.arange(9.0), tracks, CLUSTER_M[:2])
    np.testing.assert_allclose(
        poses.moved_positions(CLUSTER_M[:2], np.arange(9.0)), tracks, atol=1e-12
    )
    lines = np.diff(tracks, axis=1)[:, 0]
    found = Rotation.from_quat(poses.quaternions_xyzw)
    steps = (found[1:] * found[:-1].inv()).as_rotvec()
    assert np.abs(np.sum(steps * lines[:-1], axis=1)).max() < 1e-9


def test_samples_without_one_of_two_points_are_left_out(rng):
    rotations, shifts_m, points_m = turned_across(rng)
    t_s = np.arange(len(rotations)) / 100
    tracks = carried(points_m, rotations, shifts_m)
    tracks[[0, 7], [0, 1]] = np.nan
    poses = PoseSequence.from_two_points(t_s, tracks, points_m)
    np.testing.assert_array_equal(poses.t_s, np.delete(t_s, [0, 7]))
    with pytest.raises(InputError, match="no sample with both points"):
        PoseSequence.from_two_points(t_s, np.full_like(tracks, np.nan), points_m)


def test_a_line_that_points_the_other_way_is_turned_over():
    points_m = CLUSTER_M[:2]
    poses = PoseSequence.from_two_points([0.0], -points_m[None], points_m)
    np.testing.assert_allclose(poses.moved_positions(points_m, [0.0])[0], -points_m, atol=1e-12)


def test_two_points_whose_distance_changes_are_refused(rng):
    rotations, shifts_m, points_m = turned_across(rng)
    tracks = carried(points_m, rotations, shifts_m)
    noisy = tracks + rng.normal(scale=5e-4, size=tracks.shape)
    PoseSequence.from_two_points(np.arange(30.0), noisy, points_m)
    tracks[10:, 1] += 0.05
    with pytest.raises(InputError, match="expected the same distance"):
        PoseSequence.from_two_points(np.arange(30.0), tracks, points_m)
    with pytest.raises(InputError, match="at the same place"):
        PoseSequence.from_two_points(np.arange(30.0), tracks, points_m[[0, 0]])
