"""Output about memory: instantaneous moduli, and branches that were not identified."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.memories import ONE, guesses, recorded, remembering
from kit.problem_files import replace_text, run_command, settings
from kit.problems import measured_with, with_markers

from collocation_sysid.errors import InputError
from collocation_sysid.fem.laws.constants import symbol_of
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.problem import Problem
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.lifted.collocation import (
    LiftedCollocation,
    lifted_count,
    with_lifted_variables,
)
from collocation_sysid.recording import Experiment
from collocation_sysid.runs.check import check_problem
from collocation_sysid.statistics.estimates import Estimate, memory_notes
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.uncertainty import Uncertainty, uncertainty_from_fit

NOISE_M = 2e-4


def found(experiment: Experiment) -> Uncertainty:
    """Estimates from noisy markers."""
    tracks = experiment.markers.positions_m
    noise = np.random.default_rng(3).normal(scale=NOISE_M, size=tracks.shape)
    noisy = with_markers(experiment, tracks + noise)
    noisy = replace(noisy, markers=replace(noisy.markers, sigma_m=NOISE_M))
    parameters = guesses(ONE, 1.2)
    collocation = Collocation([noisy], parameters)
    solution = ReducedSpace()(collocation)
    return uncertainty_from_fit(linearise_fit(collocation, solution.z), parameters, solution.q)


def test_the_instantaneous_modulus_has_an_error_bar():
    uncertainty = found(recorded("hung-cube", 40))
    young = uncertainty.derived["young_pa"]
    at_once = uncertainty.derived["instantaneous_young_pa"]
    share = uncertainty.estimates["prony_1.share"]
    assert at_once.value == pytest.approx(young.value * (1 + share.value), rel=1e-12)
    assert at_once.statistical95 is not None
    assert at_once.statistical95[0] < 720.0 * 1.4 < at_once.statistical95[1]
    assert share.statistical95 is not None
    assert share.statistical95[0] < 0.4 < share.statistical95[1]


def test_a_memory_that_is_not_there_is_not_found():
    forgetful = measured_with(remembering("hung-cube", 40), ONE | {"prony_1.share": 0.0})
    uncertainty = found(forgetful)
    assert any("no memory" in note for note in uncertainty.notes)
    share = uncertainty.estimates["prony_1.share"]
    assert share.value < 0.05
    assert share.statistical95 is None or share.statistical95[0] >= 0


def test_a_branch_slower_than_the_recordings_is_reported():
    slow = {"prony_1.share": Estimate(0.3, 0.01, (0.28, 0.32)), "prony_1.tau_s": Estimate(5.0)}
    (note,) = memory_notes(slow, 2.0)
    assert "slower than the longest recording of 2 s" in note
    assert not memory_notes(slow, 8.0)
    (note,) = memory_notes(slow | {"prony_1.share": Estimate(0.0, at_bound=True)}, 8.0)
    assert note.startswith("no memory was found: the share of prony_1 ended at 0")


def test_constants_of_a_branch_have_symbols():
    assert symbol_of("prony_1.share") == "g prony_1"
    assert symbol_of("core.prony_1.tau_s") == "τ core.prony_1"


# Problem files ----------------------------------------------------------------------------------

MEMORY = replace_text(
    "[parameters]",
    '[[object.prony]]\nname = "prony_1"\n\n[parameters]\nprony_1.share = 0.2\nprony_1.tau_s = {}',
)


def test_a_problem_file_describes_a_memory(tiny):
    MEMORY(tiny)
    replace_text('nuisance = "none"', 'nuisance = "none"\nloaded_since_s = 2.5')(tiny)
    problem = Problem.read(tiny / "problem.toml")
    (experiment,) = problem.experiments
    assert "prony_1.tau_s" in experiment.body.constants
    assert experiment.loaded_since_s == 2.5
    given = {item.name: item for item in problem.parameters.items}
    assert given["prony_1.share"].is_fixed
    assert given["prony_1.tau_s"].guess is None


GUESSED = "parameters.prony_1.tau_s.guess=0.1"


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('name = "prony_1"', 'name = "prony_1"\nregion = "core"', "belongs to the region 'core'"),
        ("prony_1.share = 0.2", "prony_1.share = -0.2", "expected a number >= 0"),
        ("prony_1.share = 0.2", "prony_1.share = { lower = -1.0 }", "expected 0 <= lower < upper"),
        ("prony_1.share = 0.2", "", "prony_1.share is missing"),
    ],
    ids=["region", "negative", "bound", "missing"],
)
def test_a_slip_in_the_memory_is_one_message(tiny, old: str, new: str, expected: str):
    MEMORY(tiny)
    replace_text(old, new)(tiny)
    with pytest.raises(InputError, match=expected):
        Problem.read(tiny / "problem.toml")


@pytest.mark.long
def test_check_counts_the_memory_variables_of_interior_point(tiny, monkeypatch):
    MEMORY(tiny)
    problem = Problem.read(tiny / "problem.toml", [GUESSED])
    findings = check_problem(problem)
    program = with_lifted_variables(problem.collocation())
    assert isinstance(program, LiftedCollocation)
    assert findings.overstresses == lifted_count(program, "memory")
    assert findings.variables + findings.overstresses == program.variable_count
    assert findings.constraints + findings.overstresses == program.constraint_count
    assert findings.jacobian_nonzeros == len(program.jacobian_structure[1])
    assert findings.hessian_nonzeros == len(program.hessian_structure[1])
    assert not findings.derivative_fault
    assert "second derivative of the loss" in findings.taylor_rates
    assert {cost.method for cost in findings.costs} == {"reduced-space", "interior-point"}
    monkeypatch.setattr("collocation_sysid.runs.derivatives.MOST_LIFTED_NONZEROS", 0)
    checked = run_command("check", tiny / "problem.toml", "--details", *settings(GUESSED))
    assert f"{findings.overstresses:,} additional variables and constraints" in checked.out
    assert "τ prony_1" in checked.out


@pytest.mark.long
def test_a_problem_with_memory_is_solved_from_the_command_line(tiny):
    MEMORY(tiny)
    path, method = tiny / "problem.toml", "solver.method=interior-point"
    solved = run_command(
        "solve", path, *settings(GUESSED, method), "--out", tiny / "run", "--details"
    )
    assert solved.code == 0, solved.err
    assert "instantaneous" in solved.out
