"""Marker files in a problem: gripper markers, camera frame, labels and weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import GRASP, replace_text
from kit.problems import prescribed_positions
from scipy.spatial.transform import Rotation

from collocation_sysid.errors import InputError
from collocation_sysid.problem import Problem
from collocation_sysid.recording import read_markers, read_poses, write_markers_csv

MARKERS, POSES = "swing_markers.csv", "swing_motion.csv"
BASE_M = {
    "base1": [-0.01, 0.0, 0.09],
    "base2": [0.07, 0.0, 0.09],
    "base3": [0.07, 0.06, 0.1],
    "base4": [0.0, 0.07, 0.12],
}
DRIVEN = "{ nodes = { box_m = [[-1, -1, 0.089], [1, 1, 1]] }, markers = { %s }%s }"


def places(names=BASE_M) -> str:
    return ", ".join(f"{name} = {BASE_M[name]}" for name in names)


def load(folder: Path, *overrides: str, **options):
    return Problem.read(folder / "problem.toml", overrides, **options)


def driven_by_markers(folder: Path, further: str = "", names=BASE_M) -> None:
    replace_text(GRASP, DRIVEN % (places(names), further))(folder)


def change_tracks(folder: Path, change) -> None:
    """Write the marker file anew with changed positions (T, M, 3)."""
    table = read_markers(folder / MARKERS)
    tracks = change(table.positions_m.copy())
    write_markers_csv(folder / MARKERS, table.t_s, table.names, tracks)


@pytest.fixture
def tracked(tiny):
    """The tiny problem with four more markers, tied to the gripper."""
    poses, table = read_poses(tiny / POSES), read_markers(tiny / MARKERS)
    base = poses.moved_positions(list(BASE_M.values()), table.t_s)
    tracks = np.concatenate([base, table.positions_m], axis=1)
    write_markers_csv(tiny / MARKERS, table.t_s, (*BASE_M, *table.names), tracks)
    return tiny


def assert_same_motion(found, expected):
    np.testing.assert_allclose(found.t_s, expected.t_s)
    np.testing.assert_allclose(
        prescribed_positions(found, found.t_s),
        prescribed_positions(expected, expected.t_s),
        atol=1e-8,
    )
    assert found.markers.names == expected.markers.names
    np.testing.assert_allclose(found.markers.positions_m, expected.markers.positions_m, atol=1e-8)


# The gripper's markers ----------------------------------------------------------------------------


def test_markers_on_the_gripper_give_its_poses_and_are_not_fitted(tracked):
    names = "experiment.0.markers.names=['low', 'mid', 'side']"
    expected = load(tracked, names).experiments[0]
    driven_by_markers(tracked)
    problem = load(tracked)
    assert_same_motion(problem.experiments[0], expected)
    assert_same_motion(load(tracked, names).experiments[0], expected)
    (note,) = problem.notes
    assert (
        "experiment 'swing': grasp.markers: the markers base1, base2, base3, base4 fit a rigid"
        in note
    )


def driven_by_two(folder: Path, text: str, further: str = "") -> None:
    driven = DRIVEN.replace("markers", "two_points") % (text, further)
    replace_text(GRASP, driven)(folder)


def test_two_markers_on_the_gripper_are_where_they_were_measured(tracked):
    names = list(BASE_M)[:2]
    table = read_markers(tracked / MARKERS)
    tracks = table.positions_m[:, [table.names.index(name) for name in names]]
    driven_by_two(tracked, places(names))
    (experiment,) = load(tracked).experiments
    reference_m = [BASE_M[name] for name in names]
    found_m = experiment.grasps[0].poses.moved_positions(reference_m, table.t_s)
    np.testing.assert_allclose(found_m, tracks, atol=1e-8)
    assert not set(names) & set(experiment.markers.names)


@pytest.mark.parametrize(
    ("text", "further", "words"),
    [
        (places(list(BASE_M)[:3]), "", ["found 3 in two_points", "expected two"]),
        (
            places(list(BASE_M)[:2]),
            ', poses = "swing_motion.csv"',
            ["found poses and two_points", "expected one of them"],
        ),
        ("base1 = [0, 0, 0.1], base2 = [0, 0, 0.1]", "", ["grasp.two_points", "at the same place"]),
        (
            "base1 = [0, 0, 0.1], base2 = [0, 0, 0.3]",
            "",
            ["grasp.two_points", "0.08 to 0.08 m apart", "0.2 m on the undeformed body"],
        ),
        ("base1 = [0, 0, 0.1], bas2 = [0, 0, 0.3]", "", ["'bas2'", "did you mean 'base2'?"]),
    ],
)
def test_two_points_that_are_no_gripper_are_refused(tracked, text, further, words):
    driven_by_two(tracked, text, further)
    with pytest.raises(InputError) as caught:
        load(tracked)
    assert all(word in str(caught.value) for word in words), caught.value


def test_a_named_marker_of_the_gripper_is_fitted(tracked):
    driven_by_markers(tracked)
    experiment = load(
        tracked,
        "experiment.0.markers.names=['low', 'base1']",
        "experiment.0.markers.reference_m={ low = [0.0, 0.0, 0.0], base1 = [0.0, 0.0, 0.09] }",
    ).experiments[0]
    assert experiment.markers.names == ("low", "base1")


def test_a_marker_that_moves_on_the_gripper_is_reported_with_its_frame(tracked):
    expected = load(tracked).experiments[0].t_s

    def loosen(tracks):
        tracks[5, 1] += [0.004, 0.0, 0.0]
        return tracks

    change_tracks(tracked, loosen)
    driven_by_markers(tracked)
    (note,) = load(tracked).notes
    assert "1 frame is above" in note
    assert (
        f"at t = {expected[5]:.6g} s (frame 6), where 'base2' moves relative to the others" in note
    )
    outside = f"experiment.0.window_s=[0, {expected[4]}]"
    assert "moves relative to" not in " ".join(load(tracked, outside).notes)


def test_weights_of_the_gripper_leave_a_loose_marker_out(tracked):
    expected = load(tracked, "experiment.0.markers.names=['low', 'mid', 'side']").experiments[0]
    change_tracks(tracked, lambda tracks: tracks + 0.01 * (np.arange(7) == 1)[:, None])
    driven_by_markers(tracked, ", weights = { base2 = 0.0 }")
    assert_same_motion(load(tracked).experiments[0], expected)


def test_frames_without_three_of_the_grippers_markers_are_counted(tracked):
    def hide(tracks):
        tracks[4, :2] = np.nan
        return tracks

    change_tracks(tracked, hide)
    driven_by_markers(tracked)
    notes = " ".join(load(tracked).notes)
    assert "base1 and base2: each 1 of 9 samples missing (1 blank)" in notes
    assert (
        "1 of 9 frames contain fewer than three of the markers base1, base2, base3, base4" in notes
    )


@pytest.mark.parametrize(
    ("further", "words"),
    [
        (', poses = "swing_motion.csv"', ["found poses and markers", "expected one of them"]),
        (', quaternion = "xyzw"', ["found quaternion without poses"]),
        (", weights = { bas1 = 2.0 }", ["'bas1' in weights", "among base1"]),
        (", weights = { base1 = -2.0 }", ["grasp.weights.base1", "at least 0"]),
    ],
)
def test_keys_of_a_grasp_that_do_not_go_together_are_refused(tracked, further, words):
    driven_by_markers(tracked, further)
    with pytest.raises(InputError) as caught:
        load(tracked)
    assert all(word in str(caught.value) for word in words), caught.value


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("base1 =", "bas1 ="), ["grasp.markers", "'bas1'", "did you mean 'base1'?"]),
        ((places(), places(list(BASE_M)[:2])), ["found 2 in markers", "at least three"]),
        (
            (places(), "base1 = [0, 0, 0.0], base2 = [0, 0, 0.1], base3 = [0, 0, 0.2]"),
            ["grasp.markers", "lie on one line"],
        ),
    ],
)
def test_markers_that_cannot_drive_a_grasp_are_refused(tracked, change, words):
    driven_by_markers(tracked)
    replace_text(*change)(tracked)
    with pytest.raises(InputError) as caught:
        load(tracked)
    assert all(word in str(caught.value) for word in words), caught.value


def test_a_simulation_without_tracks_needs_poses(tracked):
    driven_by_markers(tracked)
    (tracked / MARKERS).unlink()
    with pytest.raises(InputError, match=r"grasp\.markers: .*there are no marker tracks"):
        load(tracked, simulation=True)


def test_poses_may_be_numbered_and_in_another_unit(tiny):
    expected = load(tiny).experiments[0]
    poses = read_poses(tiny / POSES)
    rows = np.column_stack([poses.t_s, 1e3 * poses.positions_m, poses.quaternions_xyzw])
    head = "t_s,x,y,z,q0,q1,q2,q3"
    np.savetxt(tiny / POSES, rows, delimiter=",", header=head, comments="", fmt="%.15g")
    options = ['experiment.0.grasp.quaternion="xyzw"', 'experiment.0.grasp.length_unit="mm"']
    assert_same_motion(load(tiny, *options).experiments[0], expected)
    with pytest.raises(InputError, match="length_unit"):
        load(tiny)


# Labels and the camera's frame --------------------------------------------------------------------


@pytest.fixture
def filmed(tracked):
    """The same as a camera sees it: in a frame of its own, in millimetres, under other labels."""
    poses = read_poses(tracked / POSES)
    table = read_markers(tracked / MARKERS)
    turn, shift = (Rotation.from_rotvec([0.5, -1.0, 2.0]).as_matrix(), [1.0, 2.0, 3.0])
    seen_mm = 1e3 * (table.positions_m @ turn.T + shift)
    labels = [f"Cam {name}" for name in table.names]
    expected = load(tracked, "experiment.0.markers.names=['low', 'mid', 'side']").experiments[0]
    write_markers_csv(tracked / MARKERS, table.t_s, labels, seen_mm)
    start = poses.moved_positions(list(BASE_M.values()), [0.0])[0].tolist()
    driven_by_markers(tracked)
    markers = {
        "labels": {f"Cam {name}": name for name in table.names},
        "length_unit": "mm",
        "template_m": dict(zip(BASE_M, start, strict=True)),
        "template_window_s": [0.0, 0.0],
    }
    return tracked, markers, expected


def settings(markers: dict) -> list[str]:
    def toml(value):
        if isinstance(value, dict):
            return "{ " + ", ".join(f"{k!r} = {toml(v)}" for k, v in value.items()) + " }"
        return repr(value)

    return [f"experiment.0.markers.{key}={toml(value)}" for key, value in markers.items()]


def test_a_template_brings_the_cameras_frame_to_the_bodys(filmed):
    folder, markers, expected = filmed
    problem = load(folder, *settings(markers))
    assert_same_motion(problem.experiments[0], expected)
    assert "moved rigidly to the template; remaining distances: base1 " in problem.notes[0]


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"template_window_s": None}, ["template_m and template_window_s, both or neither"]),
        ({"template_window_s": [3.0, 4.0]}, ["markers.template_m", "contains no sample"]),
        ({"template_window_s": [1.0, 0.0]}, ["template_window_s = [1.0, 0.0]", "start <= end"]),
        ({"template_m": {"base1": [0.0, 0.0, 0.0]}}, ["found 1 in template_m"]),
        ({"labels": {"Cam bas1": "base1"}}, ["no label 'Cam bas1'", "did you mean 'Cam base1'?"]),
        ({"rate_hz": 77.0}, ["rate_hz is 77"]),
        ({"weights": {"lw": 1.0}}, ["markers.weights", "'lw'", "did you mean 'low'?"]),
    ],
)
def test_keys_of_markers_that_cannot_be_are_refused(filmed, changed, words):
    folder, markers, _ = filmed
    given = {key: value for key, value in {**markers, **changed}.items() if value is not None}
    with pytest.raises(InputError) as caught:
        load(folder, *settings(given))
    assert all(word in str(caught.value) for word in words), caught.value


# Weights ------------------------------------------------------------------------------------------


def test_a_weight_divides_the_variance(tiny):
    markers = (
        load(tiny, "experiment.0.markers.weights={ mid = 4.0, side = 0.25 }").experiments[0].markers
    )
    np.testing.assert_allclose(markers.sigma_m, [1e-3, 0.5e-3, 2e-3])
    by_marker = "experiment.0.markers.sigma_m={ low = 1e-3, mid = 2e-3, side = 3e-3 }"
    markers = load(tiny, by_marker, "experiment.0.markers.weights.mid=4.0").experiments[0].markers
    np.testing.assert_allclose(markers.sigma_m, [1e-3, 1e-3, 3e-3])


def test_a_weight_of_zero_leaves_a_marker_out(tiny):
    problem = load(tiny, "experiment.0.markers.weights.mid=0.0")
    assert problem.experiments[0].markers.names == ("low", "side")
    assert problem.notes == ("experiment 'swing': markers excluded by a weight of 0: mid",)
    with pytest.raises(InputError, match="no marker remains of low, mid, side"):
        load(tiny, "experiment.0.markers.weights={ low = 0.0, mid = 0.0, side = 0.0 }")


def test_missing_samples_are_noted(tiny):
    def hide(tracks):
        tracks[3, 1] = np.nan
        return tracks

    change_tracks(tiny, hide)
    assert load(tiny).notes == (
        "experiment 'swing': swing_markers.csv: mid: 1 of 9 samples missing (1 blank)",
    )
