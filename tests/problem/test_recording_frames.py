"""Frames of logs: gravity, markers and wrenches that are stated in frames other than the poses'."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import TRUTH, run_command, write_problem
from kit.robot_log import CAMERAS, CAMERAS_M, GRIPPER_M, SENSOR, SENSOR_M, robot_problem
from scipy.spatial.transform import Rotation

from collocation_sysid.errors import InputError
from collocation_sysid.judge.modes import FRAME_CAUSES, find_misspecifications_by_modes
from collocation_sysid.problem import Problem
from collocation_sysid.recording import read_markers, write_markers_csv

EARTH_M_S2 = np.array([0.0, 0.0, -9.81])


def with_key(file: Path, line: str) -> Path:
    """The problem with one more line in the table of its experiment."""
    name = 'name = "swing"\n'
    file.write_text(file.read_text().replace(name, f"{name}{line}\n"))
    return file


def gravity_notes(problem: Problem) -> list[str]:
    return [note for note in problem.notes if "gravity" in note]


def test_gravity_is_rotated_from_the_frame_of_the_robots_base(tmp_path: Path) -> None:
    problem = Problem.read(with_key(robot_problem(tmp_path), 'gravity_frame = "base_link"'))
    gravity = problem.experiments[0].gravity_m_s2
    np.testing.assert_allclose(gravity, CAMERAS.inv().apply(EARTH_M_S2), atol=1e-12)
    assert np.degrees(np.arccos(gravity @ EARTH_M_S2 / 9.81**2)) == pytest.approx(4.0)
    assert not gravity_notes(problem)


def test_a_stated_gravity_is_rotated_too(tmp_path: Path) -> None:
    file = with_key(
        robot_problem(tmp_path), 'gravity_frame = "base_link"\ngravity_m_s2 = [1.0, 2.0, 3.0]'
    )
    gravity = Problem.read(file).experiments[0].gravity_m_s2
    np.testing.assert_allclose(gravity, CAMERAS.inv().apply([1.0, 2.0, 3.0]))


def test_a_tilted_frame_of_the_recording_is_noted(tmp_path: Path) -> None:
    problem = Problem.read(robot_problem(tmp_path))
    np.testing.assert_array_equal(problem.experiments[0].gravity_m_s2, EARTH_M_S2)
    (note,) = gravity_notes(problem)
    expected = CAMERAS.inv().apply(EARTH_M_S2)
    for part in (
        "'swing'",
        "along −z of 'mocap'",
        "4°",
        'gravity_frame = "base_link"',
        f"{expected[1]:.4g}",
    ):
        assert part in note


@pytest.mark.parametrize("line", ['gravity_frame = "mocap"', "gravity_m_s2 = [0.0, 0.0, -9.81]"])
def test_a_stated_direction_is_not_noted(tmp_path: Path, line: str) -> None:
    problem = Problem.read(with_key(robot_problem(tmp_path), line))
    np.testing.assert_allclose(problem.experiments[0].gravity_m_s2, EARTH_M_S2)
    assert not gravity_notes(problem)


def test_frames_that_are_not_level_by_their_names_are_not_noted(tmp_path: Path) -> None:
    problem = Problem.read(robot_problem(tmp_path, base="rig"))
    assert not gravity_notes(problem)


@pytest.mark.parametrize(
    ("frame", "parts"),
    [
        ("tool0", ["'tool0'", "moves relative to 'mocap'", "base_link"]),
        ("base_lnk", ["is not connected", "did you mean 'base_link'"]),
    ],
)
def test_a_frame_that_is_not_fixed_is_refused(tmp_path: Path, frame: str, parts: list[str]) -> None:
    file = with_key(robot_problem(tmp_path), f'gravity_frame = "{frame}"')
    result = run_command("check", file)
    assert result.code == 2
    for part in ("experiment 'swing'", "gravity_frame", *parts):
        assert part in result.err


def test_a_frame_without_a_log_is_refused(tmp_path: Path) -> None:
    file = with_key(write_problem(tmp_path, {"swing": 12}), 'gravity_frame = "base_link"')
    with pytest.raises(InputError, match="not topics of a log"):
        Problem.read(file)


# Markers ------------------------------------------------------------------------------------------


def test_poses_in_another_frame_than_the_markers_are_named_first(tmp_path: Path) -> None:
    file = robot_problem(tmp_path)
    file.write_text(file.read_text().replace("mocap>", "base_link>"))
    result = run_command("check", file)
    assert result.code == 2
    for part in (
        "trial#/tf#base_link>gripper are in the frame 'base_link'",
        "trial#/markers in 'mocap'",
        'set poses = "trial#/tf#mocap>gripper"',
    ):
        assert part in result.err
    assert result.err.index("set poses") < result.err.index("measured at")
    assert "likely" not in result.err
    text = file.read_text().replace("base_link>", "mocap>")
    file.write_text(text)  # as the message says
    assert not markers_notes(Problem.read(file))


def test_frames_of_other_names_are_noted(tmp_path: Path) -> None:
    problem = Problem.read(robot_problem(tmp_path, markers_frame="optitrack"))
    (note,) = markers_notes(problem)
    assert "in 'optitrack'" in note
    assert "convert the poses or the markers" in note


def test_stated_frames_replace_guesses_about_frames(tmp_path: Path) -> None:
    file = write_problem(tmp_path, {"swing": 24})
    table = read_markers(tmp_path / "swing_markers.csv")
    turned = Rotation.from_euler("z", 25.0, degrees=True)
    shift_m = np.array([0.02, 0.0, 0.01])
    places_m = turned.apply(table.positions_m.reshape(-1, 3).copy()) + shift_m
    write_markers_csv(
        tmp_path / "swing_markers.csv",
        table.t_s,
        names=table.names,
        positions_m=places_m.reshape(table.positions_m.shape),
    )
    (experiment,) = Problem.read(file).experiments
    guesses = find_misspecifications_by_modes(experiment, TRUTH)
    assert "camera-frame" in [each.code for each in guesses]
    fault = 'expected one frame: set poses = "trial#/tf#mocap>gripper"'
    stated = replace(experiment, frames_fault=fault)
    (cause, *others) = find_misspecifications_by_modes(stated, TRUTH)
    assert cause.code == "frames"
    assert fault in cause.message
    assert "template_m" not in cause.message
    assert not {each.code for each in others} & {*FRAME_CAUSES}


def test_frames_are_no_cause_of_tracks_that_fit(tmp_path: Path) -> None:
    problem = Problem.read(robot_problem(tmp_path, markers_frame="optitrack"))
    (experiment,) = problem.experiments
    assert "in 'optitrack'" in experiment.frames_fault
    causes = find_misspecifications_by_modes(experiment, TRUTH)
    assert "frames" not in [each.code for each in causes]


def markers_notes(problem: Problem) -> list[str]:
    return [note for note in problem.notes if "the markers trial" in note]


# Wrenches -----------------------------------------------------------------------------------------

WRENCHES = np.random.default_rng(4).normal(size=(13, 6))
SIGMAS = "sigma_n = 0.01, sigma_nm = 0.001"


def with_wrench(file: Path, keys: str = "", grasp: str = "") -> Path:
    """The problem with the wrench of the log, more keys of it, and more keys of its grasp."""
    table = f'wrench = {{ file = "trial#/wrench", {SIGMAS}{keys} }}{grasp}'
    file.write_text(file.read_text().replace("poses =", f"{table}, poses =", 1))
    return file


def wrench_notes(problem: Problem) -> list[str]:
    return [note for note in problem.notes if "axes" in note]


@pytest.mark.parametrize("sign", [1, -1])
def test_a_wrench_is_expressed_in_the_body_by_the_transforms_of_the_log(
    tmp_path: Path, sign: int
) -> None:
    body = Rotation.from_euler("z", 30, degrees=True)
    quaternion = body.as_quat().tolist()
    file = with_wrench(
        robot_problem(tmp_path, wrenches=WRENCHES),
        f", sign = {sign}" if sign < 0 else "",
        f", gripper_to_body = {{ position_m = [0, 0, 0.01], quaternion_xyzw = {quaternion} }}",
    )
    problem = Problem.read(file)
    wrench = problem.experiments[0].grasps[0].wrench
    assert wrench is not None
    assert wrench.frame == "grasp"
    rotation = body.inv() * SENSOR
    for columns in (slice(0, 3), slice(3, 6)):
        np.testing.assert_allclose(
            wrench.values[:, columns],
            sign * rotation.apply(WRENCHES[: len(wrench.t_s), columns]),
            atol=1e-12,
        )
    expected_m = body.inv().apply(SENSOR_M - GRIPPER_M - [0, 0, 0.01])
    np.testing.assert_allclose(wrench.point_m, expected_m, atol=1e-12)
    (note,) = wrench_notes(problem)
    angle_deg = np.degrees(rotation.magnitude())
    for part in ("'sensor'", f"{angle_deg:.3g}°", "trial#/wrench"):
        assert part in note


def test_a_sensor_that_is_fixed_in_the_world_measures_in_its_axes(tmp_path: Path) -> None:
    file = with_wrench(robot_problem(tmp_path, wrenches=WRENCHES), ', sensor_frame = "base_link"')
    wrench = Problem.read(file).experiments[0].grasps[0].wrench
    assert wrench is not None
    assert wrench.frame == "world"
    np.testing.assert_allclose(
        wrench.values[:, :3], CAMERAS.inv().apply(WRENCHES[: len(wrench.t_s), :3])
    )
    np.testing.assert_allclose(wrench.point_m, -CAMERAS.inv().apply(CAMERAS_M), atol=1e-12)


def test_stated_axes_are_kept_and_a_contradiction_of_the_log_is_noted(tmp_path: Path) -> None:
    file = with_wrench(robot_problem(tmp_path, wrenches=WRENCHES), ', frame = "grasp"')
    problem = Problem.read(file)
    wrench = problem.experiments[0].grasps[0].wrench
    assert wrench is not None
    np.testing.assert_array_equal(wrench.values, WRENCHES[: len(wrench.t_s)].astype(float))
    (note,) = wrench_notes(problem)
    assert "is rotated by 180° against these axes" in note
    assert "omit frame and point_m" in note


def test_axes_that_agree_with_the_log_are_not_noted(tmp_path: Path) -> None:
    file = with_wrench(
        robot_problem(tmp_path, wrenches=WRENCHES, sensor="gripper"), ', frame = "grasp"'
    )
    assert not wrench_notes(Problem.read(file))


def test_a_sensor_without_transforms_is_noted(tmp_path: Path) -> None:
    file = with_wrench(robot_problem(tmp_path, wrenches=WRENCHES, sensor="netft"))
    problem = Problem.read(file)
    wrench = problem.experiments[0].grasps[0].wrench
    assert wrench is not None
    assert wrench.frame == "world"
    (note,) = wrench_notes(problem)
    assert "'netft', which no static transform" in note
    assert "sensor_frame" in note


@pytest.mark.parametrize(
    ("keys", "parts"),
    [
        (', sensor_frame = "sensr"', ["did you mean 'sensor'", "sensor_frame"]),
        (
            ', sensor_frame = "sensor", frame = "grasp"',
            ["sensor_frame together with frame or point_m"],
        ),
    ],
)
def test_a_wrong_frame_of_a_sensor_is_refused(tmp_path: Path, keys: str, parts: list[str]) -> None:
    file = with_wrench(robot_problem(tmp_path, wrenches=WRENCHES), keys)
    result = run_command("check", file)
    assert result.code == 2
    for part in ("swing", "wrench", *parts):
        assert part in result.err
