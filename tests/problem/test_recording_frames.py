"""Frames of logs: gravity, markers and wrenches that are stated in frames other than the poses'."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import run_command, write_problem
from kit.robot_log import CAMERAS, robot_problem

from collocation_sysid.errors import InputError
from collocation_sysid.problem import Problem

EARTH_M_S2 = np.array([0.0, 0.0, -9.81])


def with_key(file: Path, line: str) -> Path:
    """The problem with one more line in the table of its experiment."""
    name = 'name = "swing"\n'
    file.write_text(file.read_text().replace(name, f"{name}{line}\n"))
    return file


def gravity_notes(problem: Problem) -> list[str]:
    return [note for note in problem.notes if "gravity" in note]


def test_gravity_is_rotated_from_the_frame_of_the_robots_base(
    tmp_path: Path,
) -> None:
    problem = Problem.read(
        with_key(robot_problem(tmp_path), 'gravity_frame = "base_link"')
    )
    gravity = problem.experiments[0].gravity_m_s2
    np.testing.assert_allclose(
        gravity, CAMERAS.inv().apply(EARTH_M_S2), atol=1e-12
    )
    assert np.degrees(
        np.arccos(gravity @ EARTH_M_S2 / 9.81**2)
    ) == pytest.approx(4.0)
    assert not gravity_notes(problem)


def test_a_stated_gravity_is_rotated_too(tmp_path: Path) -> None:
    file = with_key(
        robot_problem(tmp_path),
        'gravity_frame = "base_link"\ngravity_m_s2 = [1.0, 2.0, 3.0]',
    )
    gravity = Problem.read(file).experiments[0].gravity_m_s2
    np.testing.assert_allclose(gravity, CAMERAS.inv().apply([1.0, 2.0, 3.0]))


def test_a_tilted_frame_of_the_recording_is_noted(tmp_path: Path) -> None:
    problem = Problem.read(robot_problem(tmp_path))
    np.testing.assert_array_equal(
        problem.experiments[0].gravity_m_s2, EARTH_M_S2
    )
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


@pytest.mark.parametrize(
    "line", ['gravity_frame = "mocap"', "gravity_m_s2 = [0.0, 0.0, -9.81]"]
)
def test_a_stated_direction_is_not_noted(tmp_path: Path, line: str) -> None:
    problem = Problem.read(with_key(robot_problem(tmp_path), line))
    np.testing.assert_allclose(problem.experiments[0].gravity_m_s2, EARTH_M_S2)
    assert not gravity_notes(problem)


def test_frames_that_are_not_level_by_their_names_are_not_noted(
    tmp_path: Path,
) -> None:
    problem = Problem.read(robot_problem(tmp_path, base="rig"))
    assert not gravity_notes(problem)


@pytest.mark.parametrize(
    ("frame", "parts"),
    [
        ("tool0", ["'tool0'", "moves relative to 'mocap'", "base_link"]),
        ("base_lnk", ["is not connected", "did you mean 'base_link'"]),
    ],
)
def test_a_frame_that_is_not_fixed_is_refused(
    tmp_path: Path, frame: str, parts: list[str]
) -> None:
    file = with_key(robot_problem(tmp_path), f'gravity_frame = "{frame}"')
    result = run_command("check", file)
    assert result.code == 2
    for part in ("experiment 'swing'", "gravity_frame", *parts):
        assert part in result.err


def test_a_frame_without_a_log_is_refused(tmp_path: Path) -> None:
    file = with_key(
        write_problem(tmp_path, {"swing": 12}), 'gravity_frame = "base_link"'
    )
    with pytest.raises(InputError, match="not topics of a log"):
        Problem.read(file)
