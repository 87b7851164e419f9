"""Horizon continuation: shortened experiments, warm starts and complete solutions."""

from __future__ import annotations

import os
import re
import signal
from dataclasses import replace

import numpy as np
import pytest
from kit.problem_files import write_problem
from kit.problems import (
    GUESS,
    SMALL_EXPERIMENTS,
    TRUTH,
    bar_let_go,
    hung_cube,
    measured,
    relative_errors,
)

from collocation_sysid.errors import InputError
from collocation_sysid.methods.horizon import motion_shares, rows_of_share
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.methods.solution import Iteration, Solution, Status
from collocation_sysid.methods.starts.continuation import Continuation, first_samples, first_share
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.pipeline import solve
from collocation_sysid.problem import Problem
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.simulation import with_markers
from collocation_sysid.recording import Experiment

SHARES = (0.5, 1.0)


def continued(collocation: Collocation, watch=None, shares=SHARES, **stage) -> Solution:
    return Continuation(shares, stage)(collocation, watch)


def cube(steps: int = 19) -> Collocation:
    return Collocation([measured(hung_cube(steps))], GUESS)


def blind(experiment: Experiment, samples: int) -> Experiment:
    """No marker is seen at first."""
    tracks = experiment.markers.positions_m.copy()
    tracks[:samples] = np.nan
    return with_markers(experiment, tracks)


# Cutting


def test_the_first_samples_keep_everything_but_later_measurements():
    whole = measured(bar_let_go())
    cut = first_samples(whole, 6)
    np.testing.assert_array_equal(cut.t_s, whole.t_s[:6])
    np.testing.assert_array_equal(cut.markers.t_s, whole.t_s[:6])
    np.testing.assert_array_equal(cut.markers.positions_m, whole.markers.positions_m[:6])
    for name in ("name", "body", "grasps", "masses", "forces", "nuisance", "start"):
        assert getattr(cut, name) == getattr(whole, name)
    assert len(first_samples(whole, 99).t_s) == len(whole.t_s)


def test_samples_are_added_until_a_marker_is_seen():
    assert len(first_samples(blind(measured(hung_cube()), 7), 3).t_s) == 8


def test_a_part_has_the_layout_of_the_whole():
    whole = Collocation(
        [measured(hung_cube(19)), measured(bar_let_go(30))],
        GUESS,
        "bdf2",
        substeps=2,
        has_grasp_constraints=True,
        huber=3.0,
    )
    part = first_share(whole, 0.5)
    for each, motion in zip(part.transcriptions, motion_shares(whole), strict=True):
        assert each.grid_times == 1 + 2 * ((rows_of_share(motion, 0.5) - 1) // 2)
    assert (part.scheme, part.substeps, part.huber) == ("bdf2", 2, 3.0)
    assert all(transcription.has_grasp_constraints for transcription in part.transcriptions)


# The answer


@pytest.mark.parametrize(
    ("experiment", "method"),
    [
        ("hung-cube", "shooting"),
        ("bar-let-go", "reduced-space"),
        ("bar-with-nuisance", "shooting"),
        ("driven-bar", "reduced-space"),
    ],
)
def test_the_true_parameters_are_recovered(experiment: str, method: str):
    made = measured(SMALL_EXPERIMENTS[experiment](14))
    collocation = Collocation([made], GUESS)
    solution = continued(collocation, method=method)
    assert solution.status is Status.CONVERGED
    assert solution.collocation is collocation
    assert np.abs(relative_errors(solution)).max() < 1e-6
    assert solution.rms_m < 1e-9
    assert solution.kkt_residual < 3e-8


@pytest.mark.long
def test_interior_point_goes_on_from_the_positions_of_the_stage_before():
    collocation = cube()
    alone = {"initial": "simulation"}
    solution = Continuation(stage=alone)(collocation)
    assert solution.status.converged
    assert np.abs(relative_errors(solution)).max() < 1e-4
    assert solution.max_violation_relative < 1e-6
    cold = InteriorPoint(**alone)(collocation)
    (note,) = [note for note in solution.notes if note.startswith("100 % of the samples by")]
    assert note.startswith("100 % of the samples by interior-point: converged")
    last_stage = int(note.split("after ")[1].split()[0])
    assert last_stage < cold.iterations


def test_a_parameter_at_its_bound_stays_there_from_stage_to_stage():
    items = [replace(item, upper=250.0) if item.name == "mu_pa" else item for item in GUESS.items]
    bounded = Collocation([measured(hung_cube(19))], Parameters(tuple(items)))
    solution = continued(bounded, method="reduced-space")
    assert solution.status.converged
    assert solution.parameters["mu_pa"] == pytest.approx(250.0, rel=1e-9)


def test_the_history_continues_over_stages_that_the_notes_list():
    seen: list[Iteration] = []
    solution = continued(cube(), seen.append, (0.4, 0.7, 1.0), method="reduced-space")
    assert list(solution.history) == seen
    numbers = [line.number for line in seen]
    assert numbers == sorted(numbers)
    assert numbers[-1] <= solution.iterations
    times = [line.time_s for line in seen]
    assert times == sorted(times)
    assert [note.split(":")[0] for note in solution.notes[:3]] == [
        f"{share} % of the samples by reduced-space" for share in (40, 70, 100)
    ]
    assert "mu_pa = 300" in solution.notes[2]
    timing = solution.timing
    assert timing.evaluations + timing.linear_algebra + timing.build <= timing.total


def test_reduced_space_starts_from_given_variables():
    collocation = cube()
    answer = ReducedSpace()(collocation)
    solution = Continuation(SHARES, {"method": "shooting"})(collocation, start=answer.z)
    assert solution.iterations < 4


# Other ends


def test_an_interruption_of_a_short_stage_is_an_answer_of_the_whole():
    def interrupt(iteration: Iteration) -> None:
        if iteration.number >= 2:
            os.kill(os.getpid(), signal.SIGINT)

    collocation = cube()
    solution = continued(collocation, interrupt, method="shooting")
    assert solution.status is Status.INTERRUPTED
    assert solution.collocation is collocation
    assert len(solution.notes) == 1
    assert len(solution.positions_m[0]) == 20
    assert solution.parameters == solution.history[-1].parameters


def test_an_unreached_stage_is_reported_by_the_last_one():
    solution = continued(cube(), method="reduced-space", max_iterations=2)
    assert solution.status is Status.ITERATION_LIMIT


@pytest.mark.parametrize(
    ("shares", "stage", "message"),
    [
        ((0.5, 0.25, 1.0), {}, r"shares: found \[0.5, 0.25, 1.0\]; expected numbers above 0 that"),
        ((0.5,), {}, "ascend to 1"),
        ((), {}, "ascend to 1"),
        (SHARES, {"method": "shoting"}, "stage.method: found 'shoting'; expected one of"),
        (SHARES, {"method": "continuation"}, "found 'continuation'; expected one of"),
        (
            SHARES,
            {"hessia": "exact"},
            "'interior-point' has no option 'hessia'; expected one of hessian,",
        ),
    ],
)
def test_invalid_stages_are_refused(shares, stage, message):
    with pytest.raises(InputError, match=message):
        continued(cube(9), shares=shares, **stage)


# From a problem file


@pytest.mark.long
def test_stages_are_chosen_in_a_problem_file(tmp_path):
    file = write_problem(tmp_path, {"swing": 16})
    chosen = [
        "solver.method=continuation",
        "solver.continuation.shares=[0.5, 1.0]",
        "solver.continuation.stage.method=shooting",
        "solver.continuation.stage.gradient=adjoint",
        "solver.continuation.stage.tolerance=1e-9",
    ]
    solution = solve(Problem.read(file, chosen))
    assert solution.status.converged
    assert solution.method == "continuation"
    assert [note.split(":")[0] for note in solution.notes[:2]] == [
        f"{share} % of the samples by shooting" for share in (50, 100)
    ]
    assert solution.parameters["mu_pa"] == pytest.approx(TRUTH["mu_pa"], rel=1e-4)


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ("stage.metod=shooting", "'interior-point' has no option 'metod'"),
        ("stage.method=shoting", "stage.method: found 'shoting'; expected one of"),
        ("stage.gradient=forward", "'interior-point' has no option 'gradient'"),
        ("shares=[1.0, 0.5]", "expected numbers above 0 that ascend to 1"),
    ],
)
def test_wrong_stages_of_a_problem_file_are_refused(tmp_path, chosen: str, message: str):
    file = write_problem(tmp_path, {"swing": 8})
    with pytest.raises(InputError, match=re.escape(message)):
        solve(Problem.read(file, ["solver.method=continuation", f"solver.continuation.{chosen}"]))
