"""Rotation of grasps within a time step: its effect, warnings and remedies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kit.checks import observed_order
from kit.problems import TRUTH, hung_cube, measured, smooth_poses, times

from collocation_sysid.model.parameters import Unknown
from collocation_sysid.pipeline import run
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import Experiment, Grasp
from collocation_sysid.recording.poses import Interpolation
from collocation_sysid.runs.check import check_problem
from collocation_sysid.statistics.assessment import fastest_rotation, rotation_step_concerns

STEPS, FINEST = 8, 32


def swung(
    rate_rad_s: float = 8.0, interpolation: Interpolation = "smooth", samples: int = 1
) -> Experiment:
    """The hung cube, turned at most so fast, with so many poses a sample."""
    cube = hung_cube(STEPS)
    known = smooth_poses(times(STEPS * samples, 0.01 / samples), turn_rad=(0, 0, rate_rad_s / 20))
    poses = replace(known, interpolation=interpolation)
    return replace(cube, grasps=(replace(cube.grasps[0], poses=poses),))


def positions_m(experiment: Experiment, substeps: int) -> np.ndarray:
    return simulate(experiment, TRUTH, "midpoint", substeps=substeps).positions_m


@pytest.fixture(scope="module")
def exact_m() -> np.ndarray:
    """The motion with poses that are known at every step of the finest grid."""
    return positions_m(swung(samples=FINEST), FINEST)


def test_substeps_converge_at_the_schemes_order_where_poses_are_smooth_between_samples(exact_m):
    substeps = np.array([1, 2, 4, 8])
    errors = [np.abs(positions_m(swung(), int(n)) - exact_m).max() for n in substeps]
    assert observed_order(1 / substeps, errors) == pytest.approx(2, abs=0.15)


def test_no_step_removes_the_error_of_linear_poses(exact_m):
    smooth, linear = (
        np.abs(positions_m(swung(interpolation=kind), 8) - exact_m).max()
        for kind in ("smooth", "linear")
    )
    assert linear > 10 * smooth
    coarse, fine = (
        np.abs(positions_m(swung(interpolation="hold"), n) - exact_m).max() for n in (1, 4)
    )
    assert fine > 5 * coarse


@pytest.mark.parametrize("substeps", [1, 3])
def test_the_fastest_turn_is_the_angle_between_the_poses_of_two_grid_times(substeps: int):
    cube = swung(8.0)
    turn = fastest_rotation(cube, substeps)
    # 0.4 rad (1 − cos 20 t) is fastest at t = π / 40 = 0.0785 s, past the middle of the last step.
    step_s = 0.01 / substeps
    assert turn.time_s == pytest.approx(0.08 - step_s)
    expected = 0.4 * (np.cos(20 * (0.08 - step_s)) - np.cos(20 * 0.08))
    assert turn.angle_rad == pytest.approx(expected, rel=1e-3)
    assert (turn.angle_rad / turn.step_s) == pytest.approx(expected / step_s, rel=1e-3)


def test_a_warning_of_a_fast_turn_names_sufficient_substeps():
    cube = swung(8.0)
    (concern,) = rotation_step_concerns(cube, 1)
    warning = concern.message
    assert "turns by 0.08 rad within a step of 10 ms at t = 0.07 s (7.97 rad" in warning
    assert warning.endswith("set transcription.substeps = 2")
    assert rotation_step_concerns(cube, 2) == []
    assert rotation_step_concerns(swung(4.0), 1) == []


def test_substeps_are_no_remedy_for_poses_that_are_held():
    (concern,) = rotation_step_concerns(swung(8.0, "hold"), 4)
    assert 'set interpolation = "smooth"' in concern.message
    assert fastest_rotation(swung(8.0, "hold"), 4).angle_rad == pytest.approx(0.0797, abs=1e-3)


def test_only_while_a_grasp_holds_its_turns_count():
    cube = swung(8.0)
    let_go = replace(cube.grasps[0], until_s=0.02)
    still = Grasp(cube.grasps[0].nodes[:1], np.tile(np.eye(4), (STEPS + 1, 1, 1)), from_s=0.03)
    passing = replace(cube, grasps=(let_go, still), start="undeformed")
    assert fastest_rotation(passing, 1).time_s == pytest.approx(0.01)


def test_a_turn_too_fast_for_the_step_is_to_be_checked():
    unknown = TRUTH | {"mu_pa": Unknown(280.0)}
    slow, fast = (
        run(Problem([measured(swung(rate))], unknown, substeps=1), seek_causes=False)
        for rate in (4.0, 14.0)
    )
    assert not any("rad within a step" in said for said in (*slow.all_notes, *slow.trust.reasons))
    assert any("set transcription.substeps = 3" in note for note in fast.all_notes)
    assert any("rad within a step" in reason for reason in fast.trust.reasons)
    assert fast.trust.verdict != "good"


def test_check_warns_of_a_fast_turn(tiny: Path):
    findings = check_problem(Problem.read(tiny / "problem.toml"))
    (warning,) = (warning for warning in findings.warnings if "rad within a step" in warning)
    assert "'swing' turns by 0.078 rad within a step of 10 ms" in warning
