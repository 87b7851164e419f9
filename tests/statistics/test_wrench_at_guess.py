"""Wrenches compared with the simulation at the guess."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from kit.problems import GUESS
from kit.wrench_fits import UNKNOWN, swung

from collocation_sysid.features.wrenches.at_guess import (
    WrenchDeviation,
    has_inertial_wrenches,
    wrench_deviations,
)
from collocation_sysid.methods.starts.initial_trajectories import initial_variables
from collocation_sysid.problem import Problem
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.recording import Experiment, Wrench
from collocation_sysid.runs.check import check_problem
from collocation_sysid.statistics.hypothesis import Hypothesis

OFFSET_N = 0.8


def changed(change: Callable[[Wrench], Wrench]) -> Experiment:
    experiment = swung()
    (grasp,) = experiment.grasps
    assert grasp.wrench is not None
    wrong = replace(grasp, wrench=change(grasp.wrench))
    return replace(experiment, grasps=[wrong])


def deviation(change: Callable[[Wrench], Wrench]) -> WrenchDeviation:
    """Deviation at a guess of the material that is far from the truth."""
    collocation = Collocation([changed(change)], GUESS)
    variables, notes = initial_variables(collocation)
    assert not notes
    (found,) = wrench_deviations(collocation.iterates(variables))
    return found


def codes(hypotheses: list[Hypothesis]) -> list[str]:
    return [each.code for each in hypotheses]


def exchange(wrench: Wrench) -> Wrench:
    return replace(wrench, values=wrench.values[:, [2, 1, 0, 5, 4, 3]])


def shift(wrench: Wrench) -> Wrench:
    return replace(wrench, values=wrench.values + OFFSET_N * np.eye(6)[1])


def reverse(wrench: Wrench) -> Wrench:
    return replace(wrench, values=-wrench.values)


def test_a_right_wrench_is_not_doubted() -> None:
    assert not deviation(lambda wrench: wrench).hypotheses()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (reverse, ["wrench-sign"]),
        (exchange, ["wrench-axes"]),
        (shift, ["wrench-offset"]),
        (lambda w: shift(reverse(w)), ["wrench-sign", "wrench-offset"]),
    ],
)
def test_a_mistake_is_named_without_a_fit(
    change: Callable[[Wrench], Wrench], expected: list[str]
) -> None:
    assert codes(deviation(change).hypotheses()) == expected


def test_nothing_is_concluded_from_a_body_that_a_second_grasp_deforms() -> None:
    wrong = deviation(lambda wrench: shift(reverse(wrench)))
    assert not replace(wrong, is_inertial=False).hypotheses()
    experiment = swung()
    (grasp,) = experiment.grasps
    assert has_inertial_wrenches(experiment)
    free = np.setdiff1d(np.arange(len(experiment.body.nodes_m)), grasp.nodes)
    second = replace(grasp, nodes=free[-3:], wrench=None)
    pressed = replace(experiment, grasps=[grasp, second], markers=None)
    assert not has_inertial_wrenches(pressed)


def test_the_deviation_has_the_offset_of_the_sensor() -> None:
    right = deviation(lambda wrench: wrench)
    wrong = deviation(shift)
    np.testing.assert_allclose((wrong.offset - right.offset)[:3], [0, OFFSET_N, 0], atol=1e-12)
    assert wrong.rms_n > right.rms_n
    assert f"fy {wrong.offset[1]:+.3g} N" in wrong.note()
    (hypothesis,) = wrong.hypotheses()
    assert f"fy {wrong.offset[1]:+.3g} N" in hypothesis.message
    assert "nuisance.tare" in hypothesis.message


def test_check_compares_a_wrench_whose_markers_no_fit_explains() -> None:
    experiment = changed(reverse)
    shaken = experiment.markers.positions_m + np.random.default_rng(0).normal(
        scale=0.01, size=experiment.markers.positions_m.shape
    )
    markers = replace(experiment.markers, positions_m=shaken)
    # Complete, since a short check omits the fit on a machine that is busy.
    findings = check_problem(Problem([replace(experiment, markers=markers)], UNKNOWN), full=True)
    assert any("set sign = -1" in warning for warning in findings.warnings)
    assert any("no fit explains the markers" in each for each in findings.notes)
    assert any("the wrench of" in each and "N RMS" in each for each in findings.notes)
