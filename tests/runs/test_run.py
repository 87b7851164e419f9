"""Complete runs: nuisance parameters, error bars, verdicts and files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import TRUTH, run_command, settings, write_problem

import collocation_sysid as cs
from collocation_sysid import Problem, pipeline, run
from collocation_sysid.common.serialisation import as_json, content, read
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.recording import read_markers, write_markers_csv
from collocation_sysid.runs.forward_simulation import ForwardSimulation
from collocation_sysid.runs.result_content import Result
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.profile_likelihood import profile_of_solution
from collocation_sysid.statistics.uncertainty import uncertainty_from_fit

NUISANCE = """
[experiment.nuisance]
camera_offsets = { prior_m = 0.003 }
marker_offsets = "none"
time_shift = "none"
gravity = "none"
hand_eye = "none"
"""
REDUCED = settings("solver.method=reduced-space")
OFFSET_M = np.array([0.002, -0.001, 0.0015])


def spoil(folder: Path, name: str, noise_m: float, offset_m=OFFSET_M, seed: int = 0) -> None:
    """Add noise to an experiment's tracks, and an offset to the first marker."""
    file = folder / f"{name}_markers.csv"
    table = read_markers(file)
    tracks = table.positions_m + noise_m * np.random.default_rng(seed).normal(
        size=table.positions_m.shape
    )
    tracks[:, 0] += offset_m
    write_markers_csv(file, table.t_s, table.names, tracks)


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fitted and a validation experiment, both with noise and a marker off its place."""
    folder = tmp_path_factory.mktemp("two")
    file = write_problem(folder, {"swing": 25, "turn": 15}, validation="turn")
    file.write_text(_with_nuisance(file.read_text()))
    for k, name in enumerate(("swing", "turn")):
        spoil(folder, name, 2e-4, seed=k)
    return folder


def _with_nuisance(text: str) -> str:
    """Offsets are estimated in both experiments."""
    head, *experiments = text.replace('nuisance = "none"\n', "").split("\n[[experiment]]\n")
    return "\n[[experiment]]\n".join([head, *(part + NUISANCE for part in experiments)])


@pytest.fixture(scope="module")
def finished(two: Path):
    overrides = [
        "solver.method=reduced-space",
        *(f"experiment.{name}.markers.sigma_m=2e-4" for name in ("swing", "turn")),
    ]
    return run(Problem.read(two / "problem.toml", overrides))


def test_nuisance_is_reported_with_unit_prior_and_error(finished):
    nuisance = finished.result.nuisance["swing"]
    first = [nuisance[f"camera offset of low, {axis} [m]"] for axis in "xyz"]
    for found, truth in zip(first, OFFSET_M, strict=True):
        assert found.prior == 0.003
        # With the effects of the budget, which are learnt beside the offsets.
        assert 0 < found.std_error < 2.5e-4
        assert abs(found.value - truth) < 4 * found.std_error


def test_a_validation_experiment_gets_its_nuisance_with_the_material_as_found(finished):
    rollout = finished.rollouts["turn"]
    assert isinstance(rollout, ForwardSimulation)
    assert rollout.rms_m < 5e-4  # the offset alone is 2.7 mm of one in three markers
    found = [rollout.nuisance[f"turn: camera offset of low, {axis} [m]"] for axis in "xyz"]
    np.testing.assert_allclose(found, OFFSET_M, atol=3e-4)


def test_the_material_is_found_within_its_error_bars(finished):
    for name, truth in TRUTH.items():
        estimate = finished.uncertainty.estimates[name]
        assert (
            abs(np.log(estimate.value / truth))
            < 4 * estimate.statistical_std_error / estimate.value
        )


def test_the_result_states_the_basis_of_its_uncertainties(finished):
    found = content(finished.result)["uncertainty"]
    assert (found["noise"], found["errors"]) == ("given", "independent")
    assert found["reduced_chi_squared"] == pytest.approx(1.0, abs=0.3)
    assert np.shape(found["correlation"]) == (4, 4)
    assert any("mu_pa" in sentence for sentence in found["verdicts"])


def test_a_written_result_is_read_back_unchanged(finished):
    written = finished.result
    text = as_json(written)
    assert as_json(read(Result, json.loads(text))) == text
    assert "NaN" not in text


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("fit",), [1]),
        (("converged",), "yes"),
        (("parameters", "mu_pa", "value"), "x"),
        (("parameters", "mu_pa", "statistical95"), [1.0]),
        (("trust", "concerns"), [{"code": "noise/larger", "grade": "fine", "data": {}}]),
        (("history",), [{"iteration": 1}]),
        (("iterations",), 1.5),
        (("iterations",), True),
    ],
)
def test_a_result_of_another_kind_is_not_read(finished, keys, value):
    stored = place = content(finished.result)
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    with pytest.raises((TypeError, KeyError, ValueError, AttributeError)):
        read(Result, stored)


def test_every_marker_is_diagnosed(finished):
    found = content(finished.result)["residuals"]
    assert [item["marker"] for item in found] == ["low", "mid", "side"]
    assert all(item["sentence"] for item in found)
    json.dumps(found)


def test_a_profile_agrees_with_the_error_bar_where_the_loss_is_round(finished):
    solution = finished.solution
    fit = linearise_fit(solution.collocation, solution.z)
    plain = uncertainty_from_fit(fit, solution.collocation.parameters, solution.q)
    profile = profile_of_solution(solution, fit, plain, "mu_pa")
    np.testing.assert_allclose(profile.interval, plain.estimates["mu_pa"].statistical95, rtol=0.01)
    best = profile.values[np.argmin(profile.rises)]
    assert best == pytest.approx(solution.parameters["mu_pa"])


@pytest.mark.long
def test_a_profile_counts_the_prior_of_its_parameter(finished):
    solution, uncertainty = finished.solution, finished.uncertainty
    held = Parameters(
        tuple(
            replace(item, prior=(solution.parameters["mu_pa"], 1e-3))
            if item.name == "mu_pa"
            else item
            for item in solution.collocation.parameters.items
        )
    )
    problem = replace(finished.problem, parameters=held)
    again = run(problem, seek_causes=False)
    fit = linearise_fit(again.solution.collocation, again.solution.z)
    profile = profile_of_solution(again.solution, fit, again.uncertainty, "mu_pa")
    lower, upper = profile.interval
    assert upper is not None
    assert lower is not None
    assert np.log(upper / lower) == pytest.approx(4 * 1e-3, rel=0.1)
    assert np.log(upper / lower) < np.log(
        uncertainty.estimates["mu_pa"].statistical95[1]
        / uncertainty.estimates["mu_pa"].statistical95[0]
    )


def test_the_terminal_shows_nuisance_verdicts_and_residuals(two, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "400")
    sigma = settings(*(f"experiment.{n}.markers.sigma_m=2e-4" for n in ("swing", "turn")))
    outcome = run_command(
        "solve", two / "problem.toml", *REDUCED, *sigma, "--out", tmp_path / "run", "--details"
    )
    assert outcome.code == 0
    assert "nuisance parameters of 'swing': " in outcome.out
    assert "mm (prior ±3 mm)" in outcome.out
    assert "noise alone leaves" in outcome.out
    assert "residuals: swing/" in outcome.out
    stored = json.loads((tmp_path / "run" / "result.json").read_text())
    assert stored["rollout"]["experiments"]["turn"]["nuisance"]


@pytest.mark.long
def test_noise_may_be_estimated_and_profiles_asked_for(two, tmp_path):
    text = (two / "problem.toml").read_text()
    asked = '\n[uncertainty]\nnoise = "estimated"\nprofile = ["mu_pa"]\n'
    (two / "asked.toml").write_text(text + asked)
    outcome = run_command(
        "solve", two / "asked.toml", *REDUCED, "--json", "--out", tmp_path / "run"
    )
    found = json.loads(outcome.out)["uncertainty"]
    assert found["noise"] == "estimated"
    assert found["reduced_chi_squared"] < 0.1  # sigma_m says 1 mm, the noise is 0.2 mm
    low, high = found["profiles"]["mu_pa"]["interval"]
    assert low < TRUTH["mu_pa"] < high
    assert np.log(high / low) < 0.1


def test_undetermined_parameters_have_no_interval(tmp_path):
    """In bending alone E and ν are one."""
    folder = tmp_path
    write_problem(folder, {"swing": 25})
    spoil(folder, "swing", 3e-3, 0 * OFFSET_M)
    file = folder / "problem.toml"
    text = file.read_text()
    elastic = text[text.index("lambda_pa") : text.index("gamma_r_s")]
    file.write_text(
        text.replace(
            elastic,
            "young_pa = { guess = 700.0, lower = 10.0, upper = 1e5 }\n"
            "poisson = { guess = 0.2, lower = 0.001, upper = 0.49 }\n",
        )
    )
    sigma = settings("experiment.swing.markers.sigma_m=3e-3")
    outcome = run_command("solve", file, *REDUCED, *sigma, "--json", "--out", folder / "run")
    found = json.loads(outcome.out)
    poisson = found["parameters"]["poisson"]
    assert poisson["statistical_std_error"] is None
    assert poisson["reason"]
    said = [sentence for sentence in found["uncertainty"]["verdicts"] if "poisson" in sentence]
    assert any("not identifiable" in s or "ended at its lower bound" in s for s in said)


def test_a_check_that_cannot_be_computed_keeps_the_fit(monkeypatch):
    strain = np.linspace(0.01, 0.2, 10)
    pull = cs.Specimen("uniaxial", strain, 2e4 * strain, 10.0)
    fixed = {"poisson": 0.3, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    unknown = {"young_pa": cs.Unknown()}

    def singular(*_, **__):
        raise cs.SimulationError("no equilibrium", 0.0)

    monkeypatch.setattr(pipeline, "profile_likelihoods", singular)
    answer = run(Problem([pull.experiment("linear")], unknown | fixed))
    assert answer.solution.status.converged
    assert "a check failed (no equilibrium" in answer.omitted_checks
    assert answer.result.trust.verdict == "doubtful"
