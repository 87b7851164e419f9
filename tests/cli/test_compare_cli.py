"""`compare-methods` from the command line: runs, output and files."""

from __future__ import annotations

import io
import json
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from kit.problem_files import TRUTH, Outcome, run_command, state_vacuum, write_problem
from matplotlib.image import imread
from rich.console import Console

from collocation_sysid.cli import study_commands
from collocation_sysid.extras.studies import progress as display
from collocation_sysid.extras.studies import run_execution

KNOWN = [word for name, value in TRUTH.items() for word in ("--truth", f"{name}={value}")]
METHODS = ("interior-point initial=simulation", "reduced-space")
# Answers with the guess, as a run that did not move; the second start never ends.
STAND_IN = """
import json, os, sys
planned, out = json.loads(sys.stdin.readline()), sys.argv[-1]
if planned["start"] == 1:
    with open(os.path.join(os.path.dirname(out), "iteration.json"), "w") as file:
        json.dump({"number": 12, "loss": 345.0, "violation_n": 0.067}, file)
    sys.stdin.read()
record = {
    "outcome": "finished",
    "message": "Converged.",
    "fit": json.loads(sys.argv[1]) | {"parameters": planned["guess"]},
}
with open(out, "w") as file:
    json.dump(record, file)
"""
FIT = {
    "status": "converged",
    "converged": True,
    "loss": 2.0,
    "violation_n": 1e-3,
    "iterations": 7,
    "total_s": 1.5,
    "violation": ([0.0, 0.1], [0.0, 1e-3]),
}


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """Replaces the runs' processes."""
    script = tmp_path / "stand_in.py"
    script.write_text(STAND_IN)
    monkeypatch.setattr(run_execution, "COMMAND", (sys.executable, str(script), json.dumps(FIT)))


def drawn(folder: Path) -> set[str]:
    files = list(folder.glob("*.png"))
    assert all(imread(file).size for file in files)
    return {file.stem for file in files}


# A real comparison --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """Two methods from two starts, as tables and as JSON."""
    folder = tmp_path_factory.mktemp("compared")
    file = state_vacuum(write_problem(folder, {"swing": 6}))
    out = folder / "study"
    command = [
        "compare-methods",
        file,
        "--methods",
        ",".join(METHODS),
        "--starts",
        2,
        "--spread",
        2,
    ]
    command += ["--workers", 2, "--out", out, *KNOWN]
    return SimpleNamespace(
        out=out, first=run_command(*command), again=run_command(*command, "--json")
    )


@pytest.mark.long
def test_every_method_runs_from_every_start(compared):
    assert compared.first.code == 0, compared.first.err
    rows = json.loads(compared.again.out)["runs"]
    assert [(row["method"], row["start"]) for row in rows] == [
        (method, start) for start in range(2) for method in METHODS
    ]
    assert {row["status"] for row in rows} == {"converged"}
    assert {row["success"] for row in rows} == {True}
    for row in rows:
        for name, value in TRUTH.items():
            assert row[f"value_{name}"] == pytest.approx(value, rel=1e-4)
            assert row[f"error_{name}"] < 1e-4


@pytest.mark.long
def test_the_summary_has_a_row_for_each_method(compared):
    rows = json.loads(compared.again.out)["methods"]
    assert [row["method"] for row in rows] == list(METHODS)
    for row in rows:
        assert (row["runs"], row["successes"]) == (2, 2)
        numbers = ("loss", "violation_n", "forward", "iterations", "total_s")
        assert all(row[name] >= 0 for name in numbers)
        assert all(row[f"error_{name}"] < 1e-4 for name in TRUTH)


@pytest.mark.long
def test_the_table_fits_a_terminal_and_the_picture_is_drawn(compared):
    lines = compared.first.out.splitlines()
    assert lines[0] == "Methods"
    assert max(len(line) for line in lines if "written to" not in line) <= 90
    assert drawn(compared.out) == {"methods"}
    text = (compared.out / "summary.md").read_text()
    assert "| interior-point initial=simulation | 2/2 |" in text
    assert "within 1 % of the truth" in text


# Late, interrupted and missing runs ---------------------------------------------------------------


def compare(*more: object) -> Outcome:
    return run_command(
        "compare-methods", "problem.toml", "--methods", "reduced-space", "--out", "out", *more
    )


@pytest.mark.long
def test_a_late_run_is_a_row(tiny, stand_in):
    words = ("--starts", 3, "--time-limit", 3, "--workers", 3, *KNOWN)
    outcome = compare(*words)
    assert outcome.code == 0
    late = "reduced-space, start 1: timeout: ended at the time limit of 3 s"
    assert late in outcome.out
    assert late in (tiny / "out" / "summary.md").read_text()
    content = json.loads(compare(*words, "--json").out)
    assert [row["status"] for row in content["runs"]] == ["converged", "timeout", "converged"]
    (summary,) = content["methods"]
    assert (summary["runs"], summary["converged"], summary["loss"]) == (3, 2, 2.0)
    late_row = content["runs"][1]
    assert (late_row["loss"], late_row["violation_n"]) == (345.0, 0.067)


def test_progress_has_the_last_iteration_of_a_running_run(tiny, stand_in):
    outcome = compare("--starts", 2, "--time-limit", 1, "--workers", 1)
    assert "start 0 converged" in outcome.err
    assert "start 1 timeout in" in outcome.err
    assert ": loss 345, violation 0.067 N\n" in outcome.err


def test_an_interrupted_study_keeps_the_finished_rows(tiny, stand_in, monkeypatch):
    done = display.StudyProgress.count_run

    def interrupt(self, run, record):
        done(self, run, record)
        raise KeyboardInterrupt

    monkeypatch.setattr(display.StudyProgress, "count_run", interrupt)
    outcome = compare("--starts", 2, "--workers", 2)
    assert outcome.code == 130
    assert outcome.out == ""
    assert outcome.err.endswith("interrupted: the tables of 1 of 2 runs are in out\n")
    assert "1 of 2 runs remain to be done." in (tiny / "out" / "summary.md").read_text()


def test_a_study_without_a_finished_run_keeps_nothing(tiny, stand_in, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(study_commands, "run_all", interrupt)
    outcome = compare()
    assert (outcome.code, outcome.out) == (130, "")
    assert outcome.err.endswith("interrupted: no run has ended\n")
    assert not (tiny / "out").exists()


@pytest.mark.long
def test_progress_is_one_line_on_a_terminal(tiny, stand_in, monkeypatch):
    shown = io.StringIO()
    monkeypatch.setattr(
        study_commands, "error_console", Console(force_terminal=True, width=80, file=shown)
    )
    monkeypatch.setenv("TERM", "xterm")
    assert compare().code == 0
    assert "0/1 runs" in shown.getvalue()


def test_a_long_run_shows_its_elapsed_time(monkeypatch):
    now_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    console = Console(file=io.StringIO())
    with display.StudyProgress(console, total=3, quiet=True) as shown:
        now_s = 160.0
        assert shown._activity_with_time() == "0/3 runs (60 s so far)"


# Plans only ---------------------------------------------------------------------------------------


def test_a_dry_run_only_lists_the_runs(tiny):
    outcome = compare("--starts", 2, "--dry-run")
    assert outcome.code == 0
    assert "reduced-space, start 1" in outcome.out
    assert not (tiny / "out").exists()
    listed = json.loads(compare("--starts", 2, "--dry-run", "--json").out)
    assert [run["start"] for run in listed] == [0, 1]
    assert len(listed[1]["overrides"]) == 5
    assert {run["overrides"][0] for run in listed} == {"transcription.substeps=1"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["compare-methods", "problem.toml", "--methods", "interior"],
            "did you mean 'interior-point'?",
        ),
        (
            ["compare-methods", "problem.toml", "--methods", "reduced-space penalty"],
            "found 'penalty' after reduced-space; expected options KEY=VALUE, and a comma before",
        ),
        (["compare-methods", "problem.toml", "--methods", "penalty ro=1"], "did you mean 'rho'?"),
        (
            ["compare-methods", "nowhere.toml", "--methods", "reduced-space"],
            "there is no such file",
        ),
    ],
)
def test_bad_input_is_refused_before_anything_runs(tiny, arguments, message):
    outcome = run_command(*arguments, "--out", "out")
    assert (outcome.code, outcome.out) == (2, "")
    assert message in outcome.err
    assert not (tiny / "out").exists()


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (("compare", "problem.toml", "--materials", "yeoh"), ("compare-methods", "compare-models")),
        (("topics", "trial.mcap"), ("log LOG",)),
    ],
)
def test_an_old_name_ends_with_the_new_names(tiny, words, names):
    outcome = run_command(*words)
    assert (outcome.code, outcome.out) == (2, "")
    assert f"No such command '{words[0]}': it was" in outcome.err
    assert all(name in outcome.err for name in names)
