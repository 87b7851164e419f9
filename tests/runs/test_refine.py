"""Numerical error of an answer: orders, extrapolation, intervals and output."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import run_command, settings, write_problem
from kit.problems import GUESS, TRUTH, hung_cube, measured

from collocation_sysid.common.display import plain_text
from collocation_sysid.common.step_counting import listen_to_activities
from collocation_sysid.errors import InputError
from collocation_sysid.methods.solution import Iteration, Status
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.pipeline import Run, run
from collocation_sysid.problem import Problem, RolloutOptions, UncertaintyOptions
from collocation_sysid.result.run_sections import refinement_table
from collocation_sysid.runs.numerical_error import refine
from collocation_sysid.statistics.assessment import numerical_concerns
from collocation_sysid.statistics.budget.discretisation_error import (
    Refinement,
    discretisation_error,
)
from collocation_sysid.statistics.budget.systematic_effects import Assumptions
from collocation_sysid.statistics.estimates import Estimate

FREE = ("mu_pa", "gamma_r_s")
# Lower bounds of `write_problem`.
LOWER = {"lambda_pa": 10.0, "mu_pa": 10.0, "gamma_r_s": 1e-5, "gamma_m_1_s": 1e-3}


def errors_of(x, order, levels=3, **options):
    """Errors of a quantity whose logarithm is x + h^order at h = 1."""
    values = [float(np.exp(x + 0.1 * 2.0 ** (-order * k))) for k in range(levels)]
    answer = Estimate(values[0], 1.0, (values[0] / 1.01, values[0] * 1.01))
    return discretisation_error("mu_pa", answer, values[1:], [], **options)


@pytest.mark.parametrize("order", [1.0, 1.5, 2.0])
def test_three_levels_tell_order_and_limit(order):
    found = errors_of(5.0, order)
    assert found.step_order == pytest.approx(order)
    assert found.extrapolated == pytest.approx(np.exp(5.0))
    assert found.mesh is None


def test_two_levels_hold_the_limit_of_any_order_from_one_upwards():
    for order in (1.05, 2.0, 4.0):
        low, high = errors_of(5.0, order, levels=2).interval95 or (0, 0)
        assert low < np.exp(5.0) < high
    assert errors_of(5.0, 2.0, levels=2).extrapolated == pytest.approx(np.exp(5.0))


def test_the_mesh_may_converge_more_slowly():
    for order in (0.55, 1.0, 2.0, 4.0):
        values = [float(np.exp(5.0 - 0.1 * 2.0 ** (-order * k))) for k in range(2)]
        answer = Estimate(values[0], 0.01, (values[0] * 0.9999, values[0] * 1.0001))
        low, high = discretisation_error("mu_pa", answer, [], values[1:]).interval95 or (0, 0)
        assert low < np.exp(5.0) < high


def test_without_numerical_error_the_interval_is_that_of_the_noise():
    answer = Estimate(0.3, 0.01, (0.27, 0.33))
    found = discretisation_error("poisson", answer, [0.3, 0.3], [0.3])
    assert found.interval95 is not None
    odds = [v / (0.5 - v) for v in (*found.interval95, *answer.statistical95)]  # type: ignore[misc]
    assert odds[1] / odds[0] == pytest.approx(odds[3] / odds[2])
    assert found.extrapolated == pytest.approx(0.3)


def test_changes_that_do_not_shrink_are_no_ground_to_extrapolate():
    found = discretisation_error("mu_pa", Estimate(100.0, 1.0, (98, 102)), [110.0, 121.0], [])
    assert found.step_order is None
    assert found.extrapolated == pytest.approx(121.0)
    low, high = found.interval95 or (0, 0)
    assert low < 110
    assert high > 132


@pytest.mark.parametrize(("value", "half_step"), [(-0.1, -0.11), (0.01, -0.01)])
def test_a_poisson_ratio_below_zero_has_an_interval(value, half_step):
    estimate = Estimate(value, 0.02, (value - 0.04, value + 0.04))
    low, high = discretisation_error("poisson", estimate, [half_step], []).interval95 or (0, 0)
    assert low < value + 4 / 3 * (half_step - value) < high
    assert high - low == pytest.approx(0.08, rel=0.1)


def test_an_estimate_without_an_interval_gets_none():
    assert discretisation_error("mu_pa", Estimate(100.0), [101.0], [99.0]).interval95 is None


# On problems


def coarse() -> Problem:
    """Data of a step four times finer, on the same mesh."""
    guess = GUESS.with_guess(TRUTH)
    items = [i if i.name in FREE else replace(i, is_fixed=True) for i in guess.items]
    experiment = measured(hung_cube(16, divisions=(1, 1, 2)), substeps=4)
    sigma_m = np.full(len(experiment.markers.names), 1e-5)
    seen = replace(experiment, markers=replace(experiment.markers, sigma_m=sigma_m))
    exact = UncertaintyOptions(assumptions=Assumptions.exact())
    return Problem([seen], Parameters(tuple(items)), substeps=1, uncertainty=exact)


@pytest.fixture(scope="module")
def answer() -> Run:
    return run(coarse(), seek_causes=False)


@pytest.fixture(scope="module")
def progress() -> list[str]:
    """Activities and numbers of iterations that `refined` reports."""
    return []


@pytest.fixture(scope="module")
def refined(answer, progress) -> Run:
    def watch(iteration: Iteration) -> None:
        progress.append(str(iteration.number))

    with listen_to_activities(progress.append):
        return refine(answer, levels=3, watch=watch)


def test_each_solve_reports_its_name_and_iterations(refined, progress):
    names = [each for each in progress if "halved" in each]
    assert names == [
        f"solving again: {kind} halved {level}×" for kind in ("step", "mesh") for level in (1, 2)
    ]
    first, second = (progress.index(name) for name in names[:2])
    assert "1" in progress[first:second]


@pytest.mark.long
def test_halving_the_step_leads_to_the_truth(refined):
    assert refined.refinement is not None
    for name in FREE:
        error = refined.refinement.errors[name]
        assert error.step_order == pytest.approx(2.0, abs=0.4)
        wrong = refined.parameters[name] - TRUTH[name]
        by_step = discretisation_error(
            name,
            refined.estimates[name],
            [level.values[name] for level in refined.refinement.levels[:2]],
            [],
        )
        assert abs(by_step.extrapolated - TRUTH[name]) < 0.15 * abs(wrong)


def test_finer_answers_start_from_the_coarser(refined):
    assert refined.refinement is not None
    halved = [(level.refined, level.halvings) for level in refined.refinement.levels]
    assert halved == [("step", 1), ("step", 2), ("mesh", 1), ("mesh", 2)]
    assert max(level.iterations for level in refined.refinement.levels) <= 6
    assert set(refined.refinement.errors) == {*FREE, "young_pa", "poisson"}


def test_the_value_is_corrected_for_the_step_from_the_roll_out(answer):
    assert answer.refinement is None
    for name in FREE:
        estimate = answer.estimates[name]
        assert abs(estimate.value - TRUTH[name]) < 0.3 * abs(estimate.optimum - TRUTH[name])


def test_roll_outs_that_are_no_finer_give_no_estimate():
    step_s = coarse().experiments[0].timestep_s
    problem = replace(coarse(), rollout=RolloutOptions(timestep_s=step_s))
    assert not run(problem, seek_causes=False).effects


def test_a_measured_error_that_is_larger_than_the_uncertainty_is_to_be_checked():
    optimum = {"mu_pa": Estimate(100.0, 1.0, (98, 102))}
    combined = {"mu_pa": 1.0}

    def concerns(half_step_pa: float) -> list:
        error = discretisation_error("mu_pa", optimum["mu_pa"], [half_step_pa], [])
        return numerical_concerns(optimum, combined, Refinement({"mu_pa": error}))

    assert concerns(101.4) == []
    assert numerical_concerns(optimum, combined, None) == []
    (found,) = concerns(97.77)
    assert (found.code, found.grade) == ("mesh/refined", "check")
    assert "corrected by -3 %, 3 standard uncertainties" in found.message
    (large,) = concerns(40.0)
    assert "corrected by more than half, " in large.message


def test_other_numbers_of_levels_are_refused(answer):
    with pytest.raises(InputError, match="levels = 1"):
        refine(answer, levels=1)


def test_refinement_without_an_estimated_parameter_is_refused(answer):
    fixed = Parameters(
        tuple(replace(each, is_fixed=True) for each in answer.problem.parameters.items)
    )
    alone = replace(answer, problem=replace(answer.problem, parameters=fixed))
    with pytest.raises(InputError, match="no parameter was estimated"):
        refine(alone)


def test_estimates_that_do_not_change_are_stated_instead_of_an_empty_table(answer):
    result = answer.result
    unchanged = replace(
        result,
        **{
            of: {
                name: replace(each, numerical_error=None)
                for name, each in getattr(result, of).items()
            }
            for of in ("parameters", "derived")
        },
    )
    text = plain_text([refinement_table(unchanged)])
    assert "No estimate changes with the step or the mesh" in text


def test_a_run_without_tests_of_causes_has_the_error_that_the_problem_asks_for():
    problem = coarse()
    asked = replace(problem.uncertainty, numerical=True)
    found = run(replace(problem, uncertainty=asked), seek_causes=False)
    assert found.refinement is not None
    assert found.refinement.levels


@pytest.mark.long
def test_the_command_writes_into_the_run_folder(tmp_path):
    problem = write_problem(tmp_path, {"swing": 8})
    folder = tmp_path / "run"
    precise = settings("experiment.swing.markers.sigma_m=2e-4", "rollout.integrator=newmark")
    ended = run_command("solve", problem, "--out", folder, "--method", "reduced-space", *precise)
    assert ended.code == 0, ended
    before = json.loads((folder / "result.json").read_text())
    assert before["problem"]["substeps"] == 2  # which the problem does not state
    ended = run_command("refine", folder)
    assert ended.code == 0, ended
    after = json.loads((folder / "result.json").read_text())
    kept = json.loads((folder / "refinement.json").read_text())
    for name, found in after["parameters"].items():
        assert found["optimum"] == before["parameters"][name]["optimum"]
        if not found["fixed"] and not found["at_bound"]:
            assert found["numerical_error"] == kept["errors"][name]
            # All bounds are positive, so that the coordinate is the logarithm.
            moved = np.exp(found.get("known_effect") or 0.0)
            corrected = max(moved * kept["errors"][name]["extrapolated"], LOWER[name])
            assert found["value"] == pytest.approx(corrected)
            low, high = found["combined95"]
            least, most = kept["errors"][name]["interval95"]
            least, most = moved * least, moved * most
            assert low <= max(least, LOWER[name]) <= found["value"] < most <= high
            assert sum(after["budget"][name].values()) == pytest.approx(1.0)
            assert found["numerical_error"]["mesh"] is not None
            assert before["parameters"][name]["numerical_error"] is None
    rows = {level["refined"]: level["timesteps"] for level in kept["levels"]}
    assert rows == {"step": 4 * 8 + 1, "mesh": 2 * 8 + 1}
    assert run_command("report", folder).code == 0
    assert "half the edges" in Path(folder / "report.html").read_text()


@pytest.mark.long
def test_an_interrupted_refinement_keeps_finished_levels(tmp_path, monkeypatch):
    problem = write_problem(tmp_path, {"swing": 8})
    folder = tmp_path / "run"
    assert run_command("solve", problem, "--out", folder, "--method", "reduced-space").code == 0
    from collocation_sysid.runs import numerical_error as refining

    solved, whole = [], refining.solve

    def interrupted_at_the_mesh(problem, *arguments, **options):
        solved.append(problem)
        found = whole(problem, *arguments, **options)
        return replace(found, status=Status.INTERRUPTED) if len(solved) == 2 else found

    monkeypatch.setattr(refining, "solve", interrupted_at_the_mesh)
    stopped = run_command("refine", folder)
    assert stopped.code == 130
    assert "kept" in stopped.err
    assert "collocation-sysid refine" in stopped.err
    kept = json.loads((folder / "refinement.json").read_text())
    assert [level["refined"] for level in kept["levels"]] == ["step"]
    part = json.loads((folder / "result.json").read_text())["parameters"]["mu_pa"]
    assert part["numerical_error"]["step"] is not None
    assert part["numerical_error"]["mesh"] is None
    assert run_command("refine", folder).code == 0
    assert len(solved) == 3
    both = json.loads((folder / "refinement.json").read_text())
    assert both["levels"][0] == kept["levels"][0]
    assert [level["refined"] for level in both["levels"]] == ["step", "mesh"]
    told = json.loads((folder / "result.json").read_text())["parameters"]["mu_pa"]
    assert told["numerical_error"]["mesh"] is not None


@pytest.mark.long
def test_a_problem_may_ask_for_refinement(tmp_path):
    problem = write_problem(tmp_path, {"swing": 8})
    folder = tmp_path / "run"
    numerical = ("--set", "uncertainty.numerical=true")
    asked = run_command("solve", problem, "--out", folder, "--details", *numerical)
    assert asked.code == 0
    assert "half the step" in asked.out
    assert json.loads((folder / "refinement.json").read_text())["levels"]
