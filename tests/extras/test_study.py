"""Studies: plans, supervision of worker processes, and summaries."""

from __future__ import annotations

import json
import os
import sys

import numpy as np
import pytest
from kit.problem_files import TRUTH

from collocation_sysid.errors import InputError
from collocation_sysid.extras.studies import (
    PlannedRun,
    RunOptions,
    Starts,
    plan_comparison,
    run_all,
    run_execution,
    run_worker,
)
from collocation_sysid.extras.studies.arguments import parse_methods, read_truth
from collocation_sysid.extras.studies.rows import SuccessCriterion, method_rows, run_row
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.problem import Problem

NAMES = tuple(TRUTH)
# Stands in for a run's process: it reads the run, and ends as its first argument says.
STAND_IN = """
import json, os, sys
behaviour, place, out = sys.argv[1:]
planned = json.loads(sys.stdin.readline())
with open(place, "a") as tries:
    tries.write("x")
if behaviour == "dies":
    sys.stderr.write("Bus error\\n")
    sys.stderr.flush()
    os._exit(3)
if behaviour == "hangs":
    sys.stdin.read()
with open(out, "w") as file:
    threads = os.environ["OMP_NUM_THREADS"], os.environ["COLLOCATION_SYSID_THREADS"]
    json.dump({"outcome": "finished", "message": "", "threads": threads}, file)
"""


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """``stand_in(behaviour)`` replaces the runs' processes; gives the number of processes."""
    script, place = tmp_path / "stand_in.py", tmp_path / "tries"
    script.write_text(STAND_IN)

    def behave(behaviour: str):
        command = (sys.executable, str(script), behaviour, str(place))
        monkeypatch.setattr(run_execution, "COMMAND", command)
        return lambda: len(place.read_text())

    return behave


def planned_runs(count: int) -> list[PlannedRun]:
    return [PlannedRun("problem.toml", "interior-point", k) for k in range(count)]


# The command line's words -------------------------------------------------------------------------


def test_methods_are_listed_once_and_misspelt_ones_recognised():
    assert parse_methods("reduced-space, interior-point,reduced-space") == (
        "reduced-space",
        "interior-point",
    )
    with pytest.raises(InputError, match="did you mean 'reduced-space'"):
        parse_methods("interior-point,reduced_space")
    with pytest.raises(InputError, match="found no name; expected some of"):
        parse_methods(" , ")


def test_the_truth_is_a_file_or_values(tmp_path):
    file = tmp_path / "truth.toml"
    file.write_text("[parameters]\nlambda_pa = 1\nmu_pa = 300.0\ngamma_r_s = 0.009\n")
    truth = read_truth([str(file), "lambda_pa=200,gamma_m_1_s=1.0"], NAMES, NAMES)
    assert truth == TRUTH
    assert read_truth([], NAMES, NAMES) == {}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("mu=3", "found 'mu'; expected one of .*; did you mean 'mu_pa'"),
        ("mu_pa=x", "found mu_pa = x; expected a positive number"),
        ("mu_pa=-1", "expected a positive number"),
        ("mu_pa=3", "lambda_pa, gamma_r_s, gamma_m_1_s missing"),
        ("nowhere.toml", "there is no such file"),
    ],
)
def test_a_truth_that_cannot_be_used_is_refused(given, message):
    with pytest.raises(InputError, match=message) as refused:
        read_truth([given], NAMES, NAMES)
    assert refused.value.where == "--truth"


# Plans --------------------------------------------------------------------------------------------


def test_every_method_has_the_same_starts(tiny):
    problem = Problem.read("problem.toml")
    planned = plan_comparison(problem, ["interior-point", "reduced-space"], (), Starts(3, seed=4))
    assert [run.label for run in planned] == [
        f"{method}, start {start}"
        for start in range(3)
        for method in ("interior-point initial=simulation", "reduced-space")
    ]
    for one, other in zip(planned[::2], planned[1::2], strict=True):
        assert one.guess == other.guess
    assert planned[0].guess == {item.name: item.guess for item in problem.parameters.free}


def test_options_of_a_method_are_overrides(tiny):
    problem = Problem.read("problem.toml")
    methods = parse_methods("penalty rho=1e4 inner=levenberg-marquardt,penalty")
    several, alone = plan_comparison(problem, methods)
    options = ["solver.penalty.rho=1e4", "solver.penalty.inner=levenberg-marquardt"]
    assert list(several.overrides) == [*alone.overrides, *options]
    assert several.label == "penalty rho=1e4 inner=levenberg-marquardt, start 0"
    solver = Problem.read("problem.toml", several.overrides).solver("penalty")
    assert (solver.rho, solver.inner) == (1e4, "levenberg-marquardt")


@pytest.mark.parametrize(
    ("stated", "compared", "initial"),
    [
        ("interior-point", "interior-point initial=simulation", "simulation"),
        ("interior-point warm_up=0", "interior-point warm_up=0 initial=simulation", "simulation"),
        ("interior-point initial=reduced-space", None, "reduced-space"),
    ],
)
def test_interior_point_does_not_start_at_the_answer_unless_stated(tiny, stated, compared, initial):
    (run,) = plan_comparison(Problem.read("problem.toml"), [stated])
    assert run.method == (compared or stated)
    assert Problem.read("problem.toml", run.overrides).solver("interior-point").initial == initial


def test_more_starts_are_further_ones(tiny):
    problem = Problem.read("problem.toml")
    few, many = (plan_comparison(problem, ["reduced-space"], (), Starts(n)) for n in (2, 5))
    assert many[:2] == few
    others = plan_comparison(problem, ["reduced-space"], (), Starts(2, seed=1))
    assert others[0] == few[0]
    assert others[1].guess != few[1].guess


def test_starts_lie_around_the_truth_within_the_bounds(tiny):
    problem = Problem.read("problem.toml", ["parameters.mu_pa.upper=310"])
    overrides = ["parameters.mu_pa.upper=310"]
    planned = plan_comparison(problem, ["reduced-space"], overrides, Starts(40, 2.0), TRUTH)
    guesses = np.array([list(run.guess.values()) for run in planned[1:]])
    ratios = guesses / np.array(list(TRUTH.values()))
    assert ratios.min() >= 0.5
    assert ratios.max() <= 2.0
    assert guesses[:, 1].max() == 310
    assert np.abs(np.log(ratios[:, 0]).mean()) < 0.2


def test_starts_lie_around_the_guess_where_the_truth_is_unknown(tiny):
    problem = Problem.read("problem.toml")
    start = plan_comparison(problem, ["reduced-space"], (), Starts(2, 1.0))[1]
    assert start.guess == pytest.approx({item.name: item.guess for item in problem.parameters.free})


def test_fixed_parameters_stay(tiny):
    fixed = ["parameters.mu_pa={fixed = 300}"]
    problem = Problem.read("problem.toml", fixed)
    start = plan_comparison(problem, ["reduced-space"], fixed, Starts(2))[1]
    assert list(start.guess) == ["lambda_pa", "gamma_r_s", "gamma_m_1_s"]
    assert not any("mu_pa.guess" in override for override in start.overrides)


@pytest.mark.parametrize(
    ("options", "where"),
    [({"starts": 0}, "starts"), ({"spread": 0.5}, "spread"), ({"seed": -1}, "seed")],
)
def test_starts_that_cannot_be_are_refused(options, where):
    with pytest.raises(InputError, match=f"^{where}: found"):
        Starts(**options)


# One run's process --------------------------------------------------------------------------------


def test_a_run_has_one_thread(stand_in):
    stand_in("answers")
    record = run_execution.execute(planned_runs(1)[0])
    assert record["outcome"] == "finished"
    assert record["threads"] == ["1", "1"]


def test_a_process_that_dies_is_a_record(stand_in):
    tries = stand_in("dies")
    record = run_execution.execute(planned_runs(1)[0])
    assert (record["outcome"], tries()) == ("crashed", 1)
    assert record["message"] == "the process ended with code 3: Bus error"


def test_a_late_run_is_killed(stand_in):
    tries = stand_in("hangs")
    record = run_execution.execute(planned_runs(1)[0], time_limit_s=0.5)
    assert (record["outcome"], tries()) == ("timeout", 1)
    assert record["message"] == "ended at the time limit of 0.5 s"


OBEDIENT = """
import json, pathlib, signal, sys
file, ready = map(pathlib.Path, (sys.argv[-1], sys.argv[-2]))
def end(*_, **__):
    file.write_text(json.dumps({"outcome": "finished", "fit": json.loads(sys.argv[1])}))
    sys.exit()
signal.signal(signal.SIGTERM, end)
ready.touch()
signal.pause()
"""


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_late_run_keeps_the_answer_that_it_had(tmp_path, monkeypatch):
    ready = tmp_path / "ready"
    found = json.dumps({"status": "interrupted", "converged": False, "parameters": {}})
    monkeypatch.setattr(
        run_execution, "COMMAND", (sys.executable, "-c", OBEDIENT, found, str(ready))
    )
    monkeypatch.setattr(run_execution.time, "monotonic", lambda: 100.0 if ready.exists() else 0.0)
    planned = planned_runs(1)[0]
    record = run_execution.execute(planned, time_limit_s=10.0)
    assert record["outcome"] == "timeout"
    assert record["fit"] == json.loads(found)
    assert run_row(planned, record, SuccessCriterion())["status"] == "timeout"


def test_a_stopped_study_ends_its_runs(stand_in):
    stand_in("hangs")
    record = run_execution.execute(planned_runs(1)[0], is_stopped=lambda: True)
    assert record["outcome"] == "stopped"


def test_errors_of_a_run_are_stored_in_its_record(tiny, monkeypatch):
    def __call__(self, *_):
        raise ZeroDivisionError("nothing to divide by")

    monkeypatch.setattr(ReducedSpace, "__call__", __call__)
    planned = plan_comparison(Problem.read("problem.toml"), ["reduced-space"])[0].as_dict()
    record = run_worker.record_of_run(planned)
    assert record["outcome"] == "error"
    assert record["message"] == "ZeroDivisionError: nothing to divide by"
    assert "in __call__" in record["traceback"]
    refused = run_worker.record_of_run({**planned, "overrides": ["parameters.mu_pa.guess=1e9"]})
    assert refused["outcome"] == "error"
    assert "mu_pa: guess = 1e+09" in refused["message"]


# Many runs ----------------------------------------------------------------------------------------


def test_all_runs_are_reported(stand_in):
    stand_in("answers")
    seen = []
    runs = planned_runs(4)
    run_all(runs, RunOptions(workers=3), lambda run, record: seen.append((run.start, record)))
    assert sorted(start for start, _ in seen) == [run.start for run in runs]
    assert {record["outcome"] for _, record in seen} == {"finished"}


def test_an_interrupted_study_ends_its_runs(stand_in):
    tries = stand_in("answers")
    seen = []

    def interrupt(run, record):
        seen.append(run)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_all(planned_runs(20), RunOptions(workers=1), interrupt)
    assert len(seen) == 1
    assert tries() < 20


@pytest.mark.parametrize(
    ("options", "where"), [({"workers": 0}, "workers"), ({"time_limit_s": 0.0}, "time_limit_s")]
)
def test_limits_that_cannot_be_are_refused(options, where):
    with pytest.raises(InputError, match=f"^{where}: "):
        RunOptions(**options)


# Numbers ------------------------------------------------------------------------------------------


def answer(run: PlannedRun, factor: float = 1.0, status: str = "converged") -> dict:
    """A record as a run's process writes it, off by a factor."""
    fit = {
        "status": status,
        "converged": status == "converged",
        "parameters": {name: factor * true for name, true in TRUTH.items()},
        "iterations": 7,
    }
    return {**run.as_dict(), "outcome": "finished", "fit": fit}


def test_success_needs_convergence_and_the_truth():
    runs = [PlannedRun("p", "a", k, guess=dict.fromkeys(TRUTH, 1.0)) for k in range(5)]
    records = [
        answer(runs[0], 1.005),
        answer(runs[1], 1.02),
        answer(runs[2], 1.0, "iteration-limit"),
        {**runs[3].as_dict(), "outcome": "timeout", "message": "killed"},
        None,
    ]
    rows = [run_row(r, c, SuccessCriterion(TRUTH)) for r, c in zip(runs, records, strict=True)]
    assert [row["success"] for row in rows] == [True, False, False, False, False]
    assert [row["status"] for row in rows[2:]] == ["iteration-limit", "timeout", "missing"]
    (summary,) = method_rows(rows)
    assert (summary["runs"], summary["converged"], summary["successes"]) == (4, 2, 1)
    assert summary["error_mu_pa"] == pytest.approx(0.005)
    assert summary["iterations"] == 7
    assert run_row(runs[1], records[1], SuccessCriterion(TRUTH, within=0.05))["success"]
    assert run_row(runs[1], records[1], SuccessCriterion())["success"]
