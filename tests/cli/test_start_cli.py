"""Commands on a problem without guesses, and solves that start from an earlier answer."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import (
    TRUTH,
    contents,
    pictures_drawn,
    run_command,
    settings,
    state_vacuum,
    write_problem,
)
from matplotlib.image import imread

import collocation_sysid as cs
from collocation_sysid.common.display import plain_text
from collocation_sysid.result.run_summary import run_summary
from collocation_sysid.runs.result_content import Result
from collocation_sysid.runs.warm_start import WarmStart

pytestmark = pytest.mark.long

UNGUESSED = settings(*(f"parameters.{name}={{}}" for name in TRUTH))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny problem, solved without a guess into "run"."""
    place = tmp_path_factory.mktemp("unguessed")
    file = state_vacuum(write_problem(place, {"swing": 30}))
    options = [*UNGUESSED, "--method", "reduced-space"]
    with pictures_drawn():
        outcome = run_command("solve", file, "--out", place / "run", *options)
    assert outcome.code == 0, outcome.err
    (place / "printed.txt").write_text(outcome.out)
    return place


def result_of(run: Path) -> dict:
    return json.loads((run / "result.json").read_text())


# Without a guess


def test_the_truth_is_found_without_a_guess(folder):
    found = result_of(folder / "run")["parameters"]
    for name, value in TRUTH.items():
        assert found[name]["optimum"] == pytest.approx(value, rel=1e-4)


def test_the_scan_is_reported(folder):
    result = result_of(folder / "run")
    scan = result["scan"]
    assert len(scan["young_pa"]) == len(scan["misfit"])
    assert scan["misfit"][scan["best"]] == min(m for m in scan["misfit"] if m is not None)
    assert scan["sentence"].startswith("no guess: started from E = ")
    assert scan["sentence"] in result["notes"]
    shear_pa = scan["young_pa"][scan["best"]] / 2.6
    assert result["parameters"]["mu_pa"]["guess"] == pytest.approx(shear_pa)
    assert scan["sentence"] not in (folder / "printed.txt").read_text()
    shown = plain_text(run_summary(Result.read(folder / "run"), details=True))
    assert f"note: {scan['sentence']}" in shown


def test_the_scan_is_drawn_in_the_run_folder_and_on_the_page(folder):
    image = imread(folder / "run" / "scan.png")
    assert image.shape[0] > 200
    assert image[..., :3].std() > 0.05
    page = folder / "page.html"
    assert run_command("report", folder / "run", "--to", page).code == 0
    assert "Scan of the stiffness for an initial guess" in page.read_text()
    assert run_command("plot", folder / "run", "--out", folder / "again").code == 0
    assert np.array_equal(imread(folder / "again" / "scan.png"), image)


def test_a_run_with_a_guess_has_no_scan(folder):
    run = folder / "guessed"
    assert run_command("solve", folder / "problem.toml", "--out", run).code == 0
    assert result_of(run)["scan"] is None
    assert not (run / "scan.png").exists()


def test_check_finds_a_start(folder):
    outcome = run_command("check", folder / "problem.toml", "--details", *UNGUESSED)
    assert outcome.code == 0
    assert "no guess: started from E = " in outcome.out


def test_simulate_asks_for_a_value(folder):
    keep = settings(*(f"parameters.{name}={{}}" for name in TRUTH if name != "lambda_pa"))
    outcome = run_command("simulate", folder / "problem.toml", "--out", folder / "x", *keep)
    assert outcome.code == 2
    assert "parameters.mu_pa" in outcome.err
    assert "expected --set parameters.mu_pa.guess=VALUE" in " ".join(outcome.err.split())
    assert not (folder / "x").exists()


def test_starts_need_something_to_spread_about(folder):
    command = ("compare-methods", folder / "problem.toml", "--methods", "reduced-space", *UNGUESSED)
    outcome = run_command(*command, "--starts", 2, "--dry-run")
    assert outcome.code == 2
    assert (
        "parameters.lambda_pa: this parameter has neither a guess nor a true value" in outcome.err
    )
    alone = run_command(*command, "--dry-run")
    assert (alone.code, "– – – –" in alone.out) == (0, True)


def test_a_comparison_without_a_guess_states_its_start(folder):
    out = folder / "compared"
    command = ("compare-methods", folder / "problem.toml", "--methods", "reduced-space", *UNGUESSED)
    truth = [word for name, value in TRUTH.items() for word in ("--truth", f"{name}={value}")]
    outcome = run_command(*command, *truth, "--out", out, "--json", "--workers", 1)
    assert outcome.code == 0, outcome.err
    (row,) = json.loads(outcome.out)["runs"]
    assert row["success"] is True
    expected = result_of(folder / "run")["parameters"]["mu_pa"]["guess"]
    assert row["guess_mu_pa"] == pytest.approx(expected)


# From an earlier answer


def test_an_earlier_answer_is_a_start(folder):
    run = folder / "again_from"
    outcome = run_command(
        "solve", folder / "problem.toml", "--out", run, "--start", folder / "run",
        "--method", "reduced-space", "--set", "transcription.substeps=2",
    )  # fmt: skip
    assert outcome.code == 0, outcome.err
    result, earlier = result_of(run), result_of(folder / "run")
    for name in TRUTH:
        guess = result["parameters"][name]["guess"]
        assert guess == pytest.approx(earlier["parameters"][name]["optimum"])
    assert result["scan"] is None


def test_other_names_of_the_moduli_match(folder):
    """The earlier run had λ and μ; E and ν follow from them."""
    given = {"young_pa": cs.Unknown(), "poisson": cs.Unknown(), "gamma_r_s": 0.01}
    problem = cs.Problem.read(folder / "problem.toml")
    other = cs.Problem(problem.experiments, {**given, "gamma_m_1_s": 1.0})
    guesses = WarmStart.read(folder / "run").apply_to_problem(other).parameters.guesses
    assert guesses["young_pa"] == pytest.approx(720.0, rel=1e-3)
    assert guesses["poisson"] == pytest.approx(0.2, rel=1e-3)
    assert guesses["gamma_r_s"] == 0.01


def test_nuisance_parameters_are_taken_over(folder):
    file, run = folder / "problem.toml", folder / "shifted"
    others = 'marker_offsets = "none", gravity = "none", hand_eye = "none"'
    nuisance = f"{{ time_shift = {{ prior_s = 0.01 }}, {others} }}"
    shift = settings(f"experiment.swing.nuisance={nuisance}")
    command = ("solve", file, "--method", "reduced-space", *shift)
    assert run_command(*command, "--out", run).code == 0
    nuisance = result_of(run)["nuisance"]["swing"]
    earlier = WarmStart.read(run)
    problem = earlier.apply_to_problem(cs.Problem.read(file, shift[1::2]))
    collocation = problem.collocation()
    z = earlier.start(collocation).variables
    assert z is not None
    (phi,) = collocation.parameters_from(z)[collocation.nq :] * 0.01
    assert phi == pytest.approx(next(iter(nuisance.values()))["value"])
    assert cs.solve(problem, "reduced-space", start=run).iterations < 4


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "is not the folder of an earlier run: it has no result.json"),
        ("{", "is damaged"),
        ("other-parameters", "found the parameters x_pa, "),
    ],
    ids=["no-run", "damaged", "other-parameters"],
)
def test_an_invalid_start_is_refused_before_the_solve(folder, tmp_path, content, said):
    if content == "other-parameters":
        result = result_of(folder / "run")
        result["parameters"] = {"x_pa": result["parameters"]["mu_pa"]}
        content = json.dumps(result)
    if content is not None:
        (tmp_path / "result.json").write_text(content)
    before = contents(folder)
    outcome = run_command(
        "solve", folder / "problem.toml", "--out", folder / "none", "--start", tmp_path
    )
    assert outcome.code == 2
    assert said in outcome.err
    assert contents(folder) == before
