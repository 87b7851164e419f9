"""The commands run in this process: output, exit codes and files."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from types import SimpleNamespace

import meshio
import numpy as np
import pytest
from kit.problem_files import (
    AT_TRUTH,
    TRUTH,
    contents,
    pictures_drawn,
    remove,
    replace_text,
    run_command,
    settings,
    write_problem,
)
from matplotlib.image import imread
from rich.console import Console

import collocation_sysid as cs
from collocation_sysid import cli, pipeline
from collocation_sysid.cli import COMMAND_GROUPS, command_options, command_sources, common
from collocation_sysid.common.display import PlainConsole
from collocation_sysid.judge import engine
from collocation_sysid.methods import reduced_search
from collocation_sysid.methods.solution import Iteration, Status
from collocation_sysid.methods.starts import stiffness_scan
from collocation_sysid.methods.starts.start import Start
from collocation_sysid.problem.loading import read_problem_file
from collocation_sysid.problem.schema import AssumptionsSection, ProblemFile
from collocation_sysid.recording import read_markers, read_poses
from collocation_sysid.recording.experiment import usual_air_density
from collocation_sysid.result import run_record
from collocation_sysid.result import solve_progress as progress_shown
from collocation_sysid.result.solve_progress import Heartbeat
from collocation_sysid.runs import forward_simulation, several_starts, solving
from collocation_sysid.runs.derivatives import ORDERS

RESULT_KEYS = {
    "schema": set(),
    "status": set(),
    "message": set(),
    "method": set(),
    "parameters": {"lambda_pa", "mu_pa", "gamma_r_s", "gamma_m_1_s"},
    "fit": {"rms_m", "experiments"},
    "dynamics": {"max_violation_n", "max_violation_relative"},
    "rollout": {"rms_m", "max_m"},
    "iterations": set(),
    "timing_s": {"build", "evaluations", "linear_algebra", "total"},
    "elapsed_s": {"search", "checks", "pictures"},
    "problem": {"nodes", "elements", "timesteps", "variables", "constraints"},
    "provenance": {"version", "casadi", "problem_sha256", "platform"},
}


def result_in(folder: Path) -> dict:
    return json.loads((folder / "result.json").read_text())


def frames_in(listing: Path) -> list[Path]:
    sets = ElementTree.parse(listing).getroot().iter("DataSet")
    return [listing.parent / item.attrib["file"] for item in sets]


# A whole run: two recordings of different length and one to validate ------------------------------


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    folder = tmp_path_factory.mktemp("three")
    file = write_problem(folder, {"swing": 8, "nod": 12, "twist": 6}, validation="twist")
    began_s = time.perf_counter()
    with pictures_drawn():
        outcome = run_command("solve", file, "--out", folder / "run")
    run, took_s = folder / "run", time.perf_counter() - began_s
    with np.load(run / "trajectory.npz") as stored:
        arrays = dict(stored)
    return SimpleNamespace(
        file=file, outcome=outcome, run=run, result=result_in(run), arrays=arrays, took_s=took_s
    )


@pytest.mark.long
def test_the_answer_is_on_stdout_alone(solved):
    assert solved.outcome.code == 0
    assert solved.outcome.err == ""
    for words in ("Verdict: ", "λ Pa", "swing ", "twist ", "validation"):
        assert words in solved.outcome.out
    (row,) = [line for line in solved.outcome.out.splitlines() if line.startswith("μ Pa ")]
    value = solved.result["parameters"]["mu_pa"]["value"]
    assert float(row.split()[2]) == pytest.approx(value, rel=0.05)  # rounded to its uncertainty
    assert f"written to {solved.run}\n" in solved.outcome.out


def test_exact_data_give_the_exact_parameters(solved):
    found = {name: item["optimum"] for name, item in solved.result["parameters"].items()}
    assert found == pytest.approx(TRUTH, rel=1e-5)
    assert solved.result["fit"]["rms_m"] < 1e-8
    assert solved.result["dynamics"]["max_violation_relative"] < 1e-6


ESTIMATE_KEYS = {
    "value",
    "guess",
    "combined_std_error",
    "combined95",
    "statistical_std_error",
    "statistical95",
    "at_bound",
}


def test_the_result_has_every_promised_key(solved):
    assert solved.result["schema"] == 6
    assert solved.result["status"] == "converged"
    for key, inner in RESULT_KEYS.items():
        assert key in solved.result
        assert inner <= set(solved.result[key] if inner else ())
    for item in solved.result["parameters"].values():
        assert set(item) >= ESTIMATE_KEYS
        low, high = item["combined95"]
        assert low < item["value"] < high
    assert solved.result["parameters"]["mu_pa"]["guess"] == 200.0


def test_every_experiment_is_reported(solved):
    fitted = solved.result["fit"]["experiments"]
    assert {name: item["samples"] for name, item in fitted.items()} == {"swing": 27, "nod": 39}
    predicted = solved.result["rollout"]["experiments"]
    assert {n: item["fitted"] for n, item in predicted.items()} == {
        "swing": True, "nod": True, "twist": False,
    }  # fmt: skip
    assert max(item["rms_m"] for item in predicted.values()) < 1e-6


def test_the_trajectory_holds_every_fitted_experiment(solved):
    for name, rows in (("swing", 9), ("nod", 13)):
        shapes = {
            "t_s": (rows,),
            "positions_m": (rows, 36, 3),
            "markers_m": (rows, 3, 3),
            "measured_m": (rows, 3, 3),
            "residuals_m": (rows, 3, 3),
        }
        for key, shape in shapes.items():
            assert solved.arrays[f"{name}/{key}"].shape == shape
        difference = solved.arrays[f"{name}/markers_m"] - solved.arrays[f"{name}/measured_m"]
        np.testing.assert_array_equal(solved.arrays[f"{name}/residuals_m"], difference)
    of_validation = {key for key in solved.arrays if key.startswith("twist/")}
    assert "twist/rolled_out_m" in of_validation
    assert not {"twist/positions_m", "twist/markers_m", "twist/residuals_m"} & of_validation


def test_frames_open_with_the_fitted_positions(solved):
    for name, rows in (("swing", 9), ("nod", 13)):
        frames = frames_in(solved.run / name / "trajectory.pvd")
        assert len(frames) == rows
        last = meshio.read(frames[-1])
        np.testing.assert_array_equal(last.points, solved.arrays[f"{name}/positions_m"][-1])
        assert len(last.cells_dict["tetra"]) == 72


def test_plots_are_pictures(solved):
    names = {file.stem for file in solved.run.glob("*.png")}
    assert {"convergence", "tracks_swing", "tracks_nod", "error_swing", "error_nod"} <= names
    for file in solved.run.glob("*.png"):
        assert imread(file).std() > 0.01


def test_search_checks_and_pictures_are_timed_separately(solved):
    elapsed_s = solved.result["elapsed_s"]
    assert elapsed_s["search"] >= solved.result["timing_s"]["total"] > 0
    assert min(elapsed_s["checks"], elapsed_s["pictures"]) > 0
    assert sum(elapsed_s.values()) < solved.took_s
    assert run_command("report", solved.run, "--to", solved.run / "a.md").code == 0
    told = "search {search:.1f} s, checks {checks:.1f} s, pictures {pictures:.1f} s"
    assert told.format(**elapsed_s) in (solved.run / "a.md").read_text()


def test_the_problem_as_run_is_kept(solved):
    assert (solved.run / "problem.toml").read_text() == solved.file.read_text()


@pytest.mark.long
def test_plots_are_drawn_again_from_the_files(solved, tmp_path):
    outcome = run_command("plot", solved.run, "--out", tmp_path / "again")
    assert outcome.code == 0
    drawn = {Path(line).name for line in outcome.out.splitlines()}
    assert drawn == {file.name for file in (tmp_path / "again").iterdir()}
    assert {"convergence.png", "tracks_nod.png", "error_swing.png"} <= drawn


# Solve --------------------------------------------------------------------------------------------


def test_a_lone_experiment_needs_no_folder_of_its_own(tiny):
    outcome = run_command("solve", "problem.toml", "--json")
    assert (outcome.code, outcome.err) == (0, "")
    run = tiny / "runs" / "tiny"  # named after the problem's folder
    assert json.loads(outcome.out) == result_in(run)
    assert len(frames_in(run / "trajectory.pvd")) == 9
    with np.load(run / "trajectory.npz") as stored:
        assert stored["positions_m"].shape == (9, 36, 3)
        assert stored["marker_names"].tolist() == ["low", "mid", "side"]


def test_settings_change_the_run(tiny):
    fixed = settings("parameters.gamma_m_1_s={ fixed = 0.5 }", "title=Other")
    outcome = run_command("solve", "problem.toml", "--json", "--out", "run", *fixed)
    result = json.loads(outcome.out)
    assert result["parameters"]["gamma_m_1_s"]["value"] == 0.5
    assert result["parameters"]["gamma_m_1_s"]["statistical_std_error"] is None
    assert result["parameters"]["gamma_r_s"]["value"] != pytest.approx(TRUTH["gamma_r_s"], rel=1e-3)
    assert 'title = "Other"' in (tiny / "run" / "problem.toml").read_text()
    assert json.loads(outcome.out)["title"] == "Other"


@pytest.mark.long
def test_a_run_that_does_not_converge_is_marked_and_takes_the_place_of_an_earlier_one(tiny):
    with pictures_drawn():
        assert run_command("solve", "problem.toml", "--out", "run").code == 0
    assert (tiny / "run" / "budget.png").exists()
    short = settings(
        "solver.interior-point.max_iterations=2", "solver.interior-point.initial=simulation"
    )
    with pictures_drawn():
        outcome = run_command("solve", "problem.toml", "--out", "run", "--verbose", *short)
    assert outcome.code == 1
    assert "iteration limit" in outcome.out
    assert "Largest violations" in outcome.out
    assert len(outcome.err.splitlines()) >= 3
    assert re.search(r"^drawing picture 2 of \d+: \w+\.png$", outcome.err, re.MULTILINE)
    result = result_in(tiny / "run")
    assert (result["status"], result["converged"]) == ("iteration-limit", False)
    assert result["parameters"]["mu_pa"]["statistical_std_error"] is None
    written = set(contents(tiny / "run"))
    assert {"trajectory.npz", "trajectory.pvd", "convergence.png", "problem.toml"} <= written
    assert "budget.png" not in written


def test_pictures_may_be_left_out(tiny):
    with pictures_drawn():
        outcome = run_command("solve", "problem.toml", "--out", "run", "--no-pictures")
    assert outcome.code == 0
    assert "pictures drawn" not in outcome.out
    assert not [*(tiny / "run").glob("*.png")]
    assert result_in(tiny / "run")["elapsed_s"]["pictures"] is None
    assert len(frames_in(tiny / "run" / "trajectory.pvd")) == 9


def test_the_time_of_checks_is_none_of_the_search(tiny, monkeypatch):
    wait_s = 1.5
    monkeypatch.setattr(engine, "find_misspecifications", lambda *_: time.sleep(wait_s) or ())
    began_s = time.perf_counter()
    assert run_command("solve", "problem.toml", "--out", "run").code == 0
    took_s = time.perf_counter() - began_s
    elapsed_s = result_in(tiny / "run")["elapsed_s"]
    assert elapsed_s["checks"] > wait_s
    assert elapsed_s["search"] < took_s - wait_s


@pytest.mark.long
def test_the_answer_is_shown_and_kept_before_pictures_are_drawn(tiny, monkeypatch):
    shown = []

    def interrupt(*_: object, **__: object) -> None:
        shown.append((sys.stdout.getvalue(), result_in(tiny / "run")))
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(run_record, "write_pictures", interrupt)
    outcome = run_command("solve", "problem.toml", "--out", "run")
    ((out, result),) = shown
    assert "Verdict: check" in out
    assert "written to run" in out
    kept = result_in(tiny / "run")
    kept["elapsed_s"]["pictures"] = None  # the time until the interrupt
    assert result == kept
    assert outcome.code == 130
    assert "the result is kept in run" in outcome.err
    assert "collocation-sysid plot run" in outcome.err
    assert json.loads(run_command("solve", "problem.toml", "--json").out)["elapsed_s"]["checks"] > 0


def test_the_answer_is_shown_even_if_its_folder_cannot_be_written(tiny, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device", "run")

    monkeypatch.setattr(run_record, "write_all_frames", fail)
    outcome = run_command("solve", "problem.toml", "--out", "run")
    assert outcome.code == 2
    assert "Verdict: check" in outcome.out
    assert "written to" not in outcome.out
    assert "No space left on device" in outcome.err
    assert not (tiny / "run").exists()


def test_an_interrupt_while_the_folder_is_written_loses_nothing(tiny, monkeypatch):
    monkeypatch.setattr(
        run_record, "write_all_frames", lambda *_, **__: signal.raise_signal(signal.SIGTERM)
    )
    monkeypatch.setattr(run_record, "write_pictures", lambda *_, **__: time.sleep(60))
    outcome = run_command("solve", "problem.toml", "--out", "run")
    assert outcome.code == 143
    assert "Verdict: check" in outcome.out
    assert "the result is kept in run" in outcome.err
    assert result_in(tiny / "run")["status"] == "converged"


def test_another_result_in_the_folder_is_left_alone_when_the_pictures_are_drawn(tiny, monkeypatch):
    file = tiny / "run" / "result.json"
    monkeypatch.setattr(
        run_record, "write_pictures", lambda *_, **__: file.write_text('{"another": 1}')
    )
    outcome = run_command("solve", "problem.toml", "--out", "run")
    assert outcome.code == 2
    assert "result.json was changed while the pictures were drawn" in outcome.err
    assert file.read_text() == '{"another": 1}'


def test_an_interrupted_run_writes_its_best_iterate(tiny, monkeypatch):
    def interrupt(self: progress_shown.SolveProgress, line: Iteration) -> None:
        if line.number == 1:
            signal.raise_signal(signal.SIGINT)
            time.sleep(0.5)  # until it is heard, on the main thread

    monkeypatch.setattr(progress_shown.SolveProgress, "iteration", interrupt)
    monkeypatch.setattr(
        engine, "find_misspecifications", lambda _: pytest.fail("nobody waits for this")
    )
    outcome = run_command("solve", "problem.toml", "--out", "run")
    assert outcome.code == 130
    assert "Interrupted" in outcome.out
    result = result_in(tiny / "run")
    assert result["status"] == "interrupted"
    assert 0 < len(result["history"]) < 4
    assert (tiny / "run" / "trajectory.npz").is_file()


def test_an_interruption_before_the_first_iterate_writes_nothing(tiny, monkeypatch):
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("collocation_sysid.problem.Problem.read", interrupt)
    before = contents(tiny)
    assert run_command("solve", "problem.toml", "--out", "run").code == 130
    assert contents(tiny) == before


def test_an_interruption_of_the_scan_is_reported(tiny, monkeypatch):
    def interrupt(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(solving, "start_problem", interrupt)
    before = contents(tiny)
    outcome = run_command("solve", "problem.toml", "--out", "run")
    assert outcome.code == 143
    assert "interrupted: no result could be kept; nothing was written to run" in outcome.err
    assert contents(tiny) == before


@pytest.mark.parametrize("count", [1, 3])
def test_an_interrupted_scan_keeps_its_best_stiffness(tiny, monkeypatch, count):
    simulated = {}
    evaluate_at = stiffness_scan.TrialSimulation.evaluate_at

    def evaluated(self, young_pa, guess):
        misfit, positions = evaluate_at(self, young_pa, guess)
        simulated[young_pa] = misfit
        if len(simulated) == count:
            signal.raise_signal(signal.SIGTERM)
        return misfit, positions

    monkeypatch.setattr(stiffness_scan.TrialSimulation, "evaluate_at", evaluated)
    unguessed = settings("parameters.mu_pa={}", "parameters.lambda_pa={}")
    outcome = run_command("solve", "problem.toml", *unguessed, "--out", "run")
    assert outcome.code == 143, outcome.err
    result = result_in(tiny / "run")
    assert result["status"] == "interrupted"
    assert [each["code"] for each in result["trust"]["concerns"]] == ["solve/interrupted"]
    best = min(simulated, key=lambda young: simulated[young])
    assert result["parameters"]["mu_pa"]["value"] == pytest.approx(best / 2.6, rel=1e-6)
    assert run_command("report", "run").code == 0


def test_an_interrupted_first_rung_keeps_its_iterate(tiny, monkeypatch):
    shown = []

    def interrupt(self: progress_shown.SolveProgress, line: Iteration) -> None:
        shown.append(line)
        if line.number >= 2:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(progress_shown.SolveProgress, "iteration", interrupt)
    policy = reduced_search.SearchPolicy(longest_rung=1.0)
    monkeypatch.setattr(reduced_search, "POLICY", policy)
    assert run_command("solve", "problem.toml", "--out", "run").code == 130
    result = result_in(tiny / "run")
    assert result["status"] == "interrupted"
    assert shown[-1].share < 1
    assert result["parameters"]["mu_pa"]["value"] == shown[-1].parameters["mu_pa"]


def test_a_failed_search_survives_an_interrupt_of_the_scan_that_follows(tiny, monkeypatch):
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(several_starts, "rescue", interrupt)
    monkeypatch.setattr(several_starts, "FAILED_STATUSES", {*Status})
    outcome = run_command("solve", "problem.toml", "--out", "run")
    assert outcome.code == 130
    assert "Interrupted" in outcome.out
    result = result_in(tiny / "run")
    assert result["status"] == "interrupted"
    assert result["history"]


def test_a_search_at_its_limit_says_where_it_ended_and_what_it_does_not_explain(tiny):
    far = settings("solver.reduced-space.max_iterations=2", "parameters.mu_pa.guess=5000")
    method = settings("solver.method=reduced-space")
    outcome = run_command("solve", "problem.toml", *method, *far, "--out", "run")
    assert outcome.code == 1
    ended = r"It ended at λ = \S+ Pa, μ = \S+ Pa, γ_r = \S+ s, γ_m = \S+ 1/s, where it does not explain "
    measurements = r"the markers \(\S+ standard deviations\)\."
    assert re.search(ended + measurements, result_in(tiny / "run")["message"])
    assert re.search(ended, " ".join(outcome.out.split()))


def test_an_answer_survives_an_interrupted_roll_out(tiny, monkeypatch):
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(forward_simulation, "simulate", interrupt)
    outcome = run_command("solve", "problem.toml", "--out", "run")
    assert outcome.code == 130
    assert "Verdict: doubtful\n  interrupted: the result has no error bars" in outcome.out
    result = result_in(tiny / "run")
    assert result["status"] == "converged"
    assert result["rollout"]["rms_m"] is None
    assert "no error bars" in result["missing"]


@pytest.mark.parametrize(
    ("module", "late"), [(engine, "find_misspecifications"), (pipeline, "profile_likelihoods")]
)
def test_error_bars_survive_a_later_interrupt(tiny, monkeypatch, module, late):
    def interrupt(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(module, late, interrupt)
    outcome = run_command("solve", "problem.toml", "--out", "run")
    assert outcome.code == 130
    assert "interrupted: the steps after the error bars were skipped" in outcome.out
    result = result_in(tiny / "run")
    assert result["trust"]["verdict"] == "doubtful"
    assert result["rollout"]["rms_m"] is not None
    assert run_command("report", "run").code == 0


def test_an_interrupt_of_a_second_start_keeps_the_first_answer(tiny, monkeypatch):
    found = []

    def again(first):
        found.append(first)
        estimates = first.collocation.parameters.with_estimates(
            {"mu_pa": first.parameters["mu_pa"]}
        )
        return Start(first.collocation.with_parameters(estimates), note="again")

    def interrupt(self: progress_shown.SolveProgress, line: Iteration) -> None:
        if found:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(solving, "SECOND_STARTS", (again,))
    monkeypatch.setattr(progress_shown.SolveProgress, "iteration", interrupt)
    method = settings("solver.method=reduced-space")
    assert run_command("solve", "problem.toml", *method, "--out", "run").code == 130
    result = result_in(tiny / "run")
    assert result["status"] == "interrupted"
    assert result["parameters"]["mu_pa"]["value"] == found[0].parameters["mu_pa"]


@pytest.mark.long
def test_a_real_process_keeps_its_streams_apart(tiny):
    program = [sys.executable, "-c", "from collocation_sysid.cli import main; main()"]
    done = subprocess.run(
        [*program, "check", "problem.toml", "--json", "--quiet"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["taylor_rates"]


def test_the_module_is_the_command_line():
    program = [sys.executable, "-m", "collocation_sysid", "--version"]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip() == cs.__version__


# Progress -----------------------------------------------------------------------------------------


def test_a_terminal_shows_each_iteration(tiny):
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=100)
    with progress_shown.SolveProgress(console, cs.Problem.read("problem.toml")) as progress:
        progress.iteration(Iteration(3, 1.0, 2.5, 1e-4, TRUTH, 0.5))
        progress.say("checking")
    assert "misfit σ" in screen.getvalue()
    assert " 2.5 " in screen.getvalue()
    assert "checking" in screen.getvalue()


def test_elsewhere_long_work_leaves_a_line_now_and_then(monkeypatch):
    monkeypatch.setattr("collocation_sysid.result.solve_progress.FIRST_LINE_S", 0.01)
    told, lines = threading.Event(), []

    class Log(io.StringIO):
        def write(self, text: str) -> int:
            lines.append(text)
            told.set()
            return len(text)

    with progress_shown.SolveProgress(Console(file=Log())) as progress:
        progress.say("simulating the first samples")
        progress.iteration(Iteration(3, 1.0, 2.5, 1e-4, {"young_pa": 3e4}, 0.5, share=0.25))
        told.clear()
        assert told.wait(30.0)
    said = "solving, iteration 3: misfit 2.5 σ of the first 25%, E = 3e+04 Pa ("
    assert any(said in line and "s so far)" in line for line in lines)
    with progress_shown.SolveProgress(Console(file=Log()), quiet=True) as progress:
        assert progress._heartbeat is None
    assert not any(thread.name == Heartbeat.NAME for thread in threading.enumerate())


@pytest.mark.parametrize(("options", "shown"), [([], True), (["--quiet"], False)])
def test_notes_on_the_data_go_to_stderr(tiny, options, shown):
    resampled = settings("experiment.0.resample_hz=200")
    outcome = run_command("simulate", "problem.toml", "--out", "s", *resampled, *options)
    assert ("note: experiment 'swing': resample_hz" in outcome.err) == shown


# Simulate -----------------------------------------------------------------------------------------


def test_simulation_writes_the_files_of_a_laboratory(tiny):
    remove("swing_markers.csv")(tiny)
    expected = cs.simulate(
        cs.Problem.read("problem.toml", AT_TRUTH, simulation=True).experiments[0], TRUTH
    )
    outcome = run_command(
        "simulate", "problem.toml", "--out", "data", "--frames", *settings(*AT_TRUTH)
    )
    assert (outcome.code, outcome.err) == (0, "")
    files = ["data/swing_markers.csv", "data/swing_poses.csv", "data/swing/trajectory.pvd"]
    assert outcome.out.split() == files
    table = read_markers(tiny / files[0])
    assert table.names == ("low", "mid", "side")
    np.testing.assert_allclose(table.positions_m, expected.markers_m, atol=1e-11)
    poses, given = (read_poses(tiny / files[1]), read_poses(tiny / "swing_motion.csv"))
    np.testing.assert_allclose(poses.quaternions_xyzw, given.quaternions_xyzw, atol=1e-10)
    assert len(frames_in(tiny / files[2])) == 9


@pytest.mark.parametrize("name", ["chapter.tex", "swing_markers.csv", "deep/chapter.tex"])
def test_a_simulation_adds_nothing_to_a_foreign_folder(tiny: Path, name: str):
    (tiny / "data" / name).parent.mkdir(parents=True)
    (tiny / "data" / name).write_text("precious")
    before = contents(tiny)
    outcome = run_command("simulate", "problem.toml", "--out", "data", *settings(*AT_TRUTH))
    assert outcome.code == 2
    assert name in outcome.err
    assert "this program" in outcome.err
    assert contents(tiny) == before


@pytest.mark.skipif(os.name != "posix", reason="links of POSIX")
def test_a_simulation_is_not_written_through_a_link(tiny: Path):
    (tiny / "theirs").mkdir()
    (tiny / "data").symlink_to("theirs")
    outcome = run_command("simulate", "problem.toml", "--out", "data", *settings(*AT_TRUTH))
    assert outcome.code == 2
    assert "data: this is a link to theirs" in outcome.err
    assert not list((tiny / "theirs").iterdir())


def test_a_simulation_replaces_an_earlier_one(tiny: Path):
    simulate = ["simulate", "problem.toml", "--out", "data", "--frames"]
    for young_pa in (300, 400):
        changed = settings(*AT_TRUTH, f"parameters.mu_pa.guess={young_pa}")
        assert run_command(*simulate, *changed).code == 0
    (tiny / "data" / "swing" / "notes.txt").write_text("precious")
    refusal = run_command(*simulate, *settings(*AT_TRUTH))
    assert refusal.code == 2
    assert "notes.txt" in refusal.err


def test_a_simulation_beside_the_problem_keeps_other_files(tiny: Path):
    recording = tiny / "swing_markers.csv"
    recording.rename("recorded.csv")
    replace_text('"swing_markers.csv"', '"recorded.csv"')(tiny)
    simulate = ["simulate", "problem.toml", "--out", ".", *settings(*AT_TRUTH)]
    for _ in range(2):
        assert run_command(*simulate).code == 0
    recording.write_text("precious")
    refusal = run_command(*simulate)
    assert refusal.code == 2
    assert "swing_markers.csv: this file exists and was not written by this program" in refusal.err
    assert recording.read_text() == "precious"


@pytest.mark.long
def test_noise_follows_the_seed(tiny):
    def tracks(name: str, *options: str) -> np.ndarray:
        outcome = run_command("simulate", "problem.toml", "--out", name, "--json", *options)
        file, _ = json.loads(outcome.out)
        return read_markers(file).positions_m

    exact = tracks("exact")
    noisy = tracks("a", "--noise-m", "0.001", "--seed", "3")
    assert 0.5e-3 < (noisy - exact).std() < 2e-3
    np.testing.assert_array_equal(noisy, tracks("b", "--noise-m", "0.001", "--seed", "3"))
    assert not np.allclose(noisy, tracks("c", "--noise-m", "0.001", "--seed", "4"), atol=1e-5)


def test_the_integrator_is_chosen(tiny):
    options = ["--quiet", *settings(*AT_TRUTH, "transcription.substeps=1")]
    run_command("simulate", "problem.toml", "--out", "a", "--integrator", "midpoint", *options)
    run_command("simulate", "problem.toml", "--out", "b", "--timestep-s", "0.0005", *options)
    measured = read_markers(tiny / "swing_markers.csv").positions_m
    exact = read_markers(tiny / "a" / "swing_markers.csv").positions_m
    other = read_markers(tiny / "b" / "swing_markers.csv").positions_m
    np.testing.assert_allclose(exact, measured, atol=1e-10)
    assert 1e-6 < np.abs(other - measured).max() < 5e-3


@pytest.mark.long
def test_a_simulation_that_breaks_down_says_when_and_where(tiny):
    soft = settings(
        "parameters.lambda_pa={ fixed = 1e-3 }", "parameters.mu_pa={ fixed = 1e-3 }",
        "object.density_kg_m3=1e5",
    )  # fmt: skip
    before = contents(tiny)
    outcome = run_command("simulate", "problem.toml", "--out", "s", *soft)
    assert outcome.code == 1
    assert outcome.out == ""
    assert "simulation failed: " in outcome.err
    assert "t = " in outcome.err
    assert "element" in outcome.err
    after = contents(tiny)
    assert set(after) - set(before) <= {"s", "s/instability.png"}
    assert {name: after[name] for name in before} == before


# Check, schema, new, and help ---------------------------------------------------------------------


def test_check_reports_sizes_and_derivatives(tiny):
    before = contents(tiny)
    outcome = run_command("check", "problem.toml", "--json")
    found = json.loads(outcome.out)
    assert outcome.code == 0
    (body,) = found["bodies"]
    assert (body["nodes"], body["elements"], found["samples"]) == (36, 72, 27)
    rates = found["taylor_rates"]
    assert rates.pop("second derivative of the loss") is None  # the loss of markers is quadratic
    assert all(rate > ORDERS[name] - 0.1 for name, rate in rates.items())
    assert "derivatives pass a Taylor test" in run_command("check", "problem.toml").out
    assert contents(tiny) == before


def test_check_fails_where_derivatives_do_not_agree(tiny, monkeypatch):
    monkeypatch.setattr("collocation_sysid.runs.derivatives.RATE_TOLERANCE", -5.0)
    outcome = run_command("check", "problem.toml")
    assert outcome.code == 1
    assert "is wrong in the" in outcome.out


def test_the_schema_describes_the_problem_file():
    outcome = run_command("schema")
    schema = json.loads(outcome.out)
    assert outcome.code == 0
    assert set(schema["properties"]) == set(ProblemFile.model_fields)
    assert schema["additionalProperties"] is False


@pytest.mark.parametrize("name", ["my_object", 'deep/the "soft" one'])
def test_a_new_problem_file_is_valid(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    outcome = run_command("new", name)
    assert outcome.code == 0
    written, schema = outcome.out.splitlines()
    assert Path(schema).name == "schema.json"
    file, _ = read_problem_file(written)
    assert file.title == Path(name).name
    assert file.experiment[0].grasp_list[0].poses == "poses.csv"


def test_a_new_problem_without_a_recording_has_no_settings_of_a_simulated_one(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    run_command("new", "mine")
    run_command("new", "example", "--kind", "swing")
    mine, example = (
        read_problem_file(Path(name) / "problem.toml")[0] for name in ("mine", "example")
    )
    assert example.environment.air_density_kg_m3 == "none"
    assert mine.environment.air_density_kg_m3 == usual_air_density()
    assert example.uncertainty.assumptions.anisotropy == "none"
    assert mine.uncertainty.assumptions == AssumptionsSection()
    assert mine.transcription == example.transcription
    assert "simulated" not in Path("mine/problem.toml").read_text()


def test_the_template_has_a_wrench_that_can_be_uncommented(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_command("new", "mine", "--kind", "swing")
    file = tmp_path / "mine" / "problem.toml"
    text = file.read_text()
    assert "# wrench = { file" in text
    file.write_text(text.replace("# wrench = { file", "wrench = { file"))
    (grasp,) = read_problem_file(file)[0].experiment[0].grasp_list
    assert grasp.wrench.file == "wrench.csv"
    assert grasp.wrench.sigma_nm == 0.005


def test_a_new_problem_leaves_the_data_that_are_there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    own = tmp_path / "mine" / "markers.csv"
    own.write_text("measured")
    outcome = run_command("new", "mine", "--kind", "swing")
    assert outcome.code == 2
    assert "markers.csv: this file exists already" in outcome.err
    assert [*own.parent.iterdir()] == [own]
    assert own.read_text() == "measured"


def test_the_template_names_only_existing_keys(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_command("new", "mine")
    text = (tmp_path / "mine" / "problem.toml").read_text()
    lines = text.splitlines()
    commented = [
        line for line in lines if line.startswith("# ") and (" = " in line or "# [" in line)
    ]
    assert len(commented) >= 25
    whole = [line.removeprefix("# ") if line in commented else line for line in lines]
    # A surface takes the place of a mesh, a gripper's markers that of its poses or displacement; a
    # motion that of equilibria.
    left_out = ("mesh =", "poses =", "displacement =", "gripper_to_body =", "kind =")
    text = "\n".join(line for line in whole if not line.startswith(left_out))
    (tmp_path / "all.toml").write_text(text)
    file, _ = read_problem_file(tmp_path / "all.toml")
    assert file.object.surface == "scan.stl"
    assert file.rollout.timestep_s == 0.002
    assert file.experiment[0].mass[0].mass_kg == 0.05


def test_help_imports_nothing_that_solves():
    code = (
        "import sys; from collocation_sysid.cli import main; sys.argv[1:] = ['--help']\n"
        "try: main()\n"
        "finally: assert not sys.modules.keys() & {'casadi', 'scipy', 'matplotlib'}"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert re.search(r"^  report +Write a report of a run", done.stdout, re.MULTILINE)


def test_every_command_is_in_exactly_one_group_of_the_help():
    names = [name for group in COMMAND_GROUPS.values() for name in group]
    assert sorted(names) == sorted(command_sources())
    words = [title.split()[0] for title in COMMAND_GROUPS]
    assert words == ["Identify", "Inspect", "Extend", "Exchange", "Reference"]
    sections = re.split(r"^(\w.*):$", run_command("--help").out, flags=re.MULTILINE)
    listed = dict(zip(sections[1::2], sections[2::2], strict=True))
    for title, group in COMMAND_GROUPS.items():
        assert tuple(re.findall(r"^  ([a-z-]+)  ", listed[title], re.MULTILINE)) == group
        sentences = re.split(r"^  (?=[a-z])", listed[title].rstrip(), flags=re.MULTILINE)[1:]
        assert all(sentence.rstrip().endswith(".") for sentence in sentences)


def test_version_and_help():
    assert run_command("--version").out == f"{cs.__version__}\n"
    listed = run_command("--help")
    assert listed.code == 0
    for command in ("solve", "simulate", "check", "plot", "schema", "new"):
        assert command in listed.out
        assert run_command(command, "--help").code == 0


def test_an_output_that_cannot_be_written_is_explained(tiny, monkeypatch):
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device", "run/trajectory.npz")

    spare = tiny / "spare"
    spare.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(spare))
    monkeypatch.setattr(np, "savez_compressed", full)
    outcome = run_command("solve", "problem.toml", "--out", "run")
    (kept,) = spare.iterdir()
    assert outcome.code == 2
    assert outcome.err == (
        f"error: {tiny / 'run'}: this cannot be written: No space left on device; its result.json "
        f"alone is kept in {kept}: move it to another place\n"
    )
    assert not (tiny / "run").exists()
    assert not list(tiny.glob(".run*"))


# Python -------------------------------------------------------------------------------------------


def test_the_same_from_python(tiny):
    problem = cs.Problem.read("problem.toml")
    solution = cs.solve(problem, cs.InteriorPoint(tolerance=1e-10))
    assert solution.status.converged
    assert solution.parameters == pytest.approx(TRUTH, rel=1e-5)
    trajectory = cs.simulate(problem.experiments[0], solution.parameters, "midpoint", substeps=1)
    measured = problem.experiments[0].markers.positions_m
    np.testing.assert_allclose(trajectory.markers_m, measured, atol=1e-8)


def test_a_method_is_given_with_its_options(tiny):
    problem = cs.Problem.read("problem.toml")
    seen: list[Iteration] = []
    solution = cs.solve(
        problem, cs.InteriorPoint(max_iterations=1, initial="simulation"), seen.append
    )
    assert solution.status is cs.Status.ITERATION_LIMIT
    assert len(seen) == len(solution.history) == 2
    with pytest.raises(cs.InputError, match=r"found 'newton'.*interior-point"):
        cs.solve(problem, "newton")


def test_reduced_space_is_the_method_unless_another_is_named(tiny):
    text = Path("problem.toml").read_text()
    Path("problem.toml").write_text(text.replace('method = "interior-point"', ""))
    named = cs.solve(cs.Problem.read("problem.toml"), cs.InteriorPoint(tolerance=1e-10))
    default = cs.solve(cs.Problem.read("problem.toml"))
    assert default.method == "reduced-space"
    np.testing.assert_allclose(default.theta, named.theta, rtol=1e-5)


def test_each_method_has_the_options_of_its_own_table(tiny):
    tables = ["solver.interior-point.hessian=limited-memory", "solver.reduced-space.ladder=[1.0]"]
    problem = cs.Problem.read("problem.toml", tables)
    solution = cs.solve(problem, "reduced-space")
    assert solution.status.converged
    assert problem.methods["interior-point"].hessian == "limited-memory"
    assert problem.methods["reduced-space"].hessian == "gauss-newton"


def test_a_body_of_arrays_has_forces_and_stiffness(tiny_problem, rng):
    read = cs.TetMesh.read(tiny_problem / "body.vtu")
    mesh = cs.TetMesh(read.points_m, read.tetrahedra)
    body = cs.Body(mesh, material="neo-hookean", density_kg_m3=30.0, element="tet4")
    x = mesh.points_m + 1e-3 * rng.normal(size=mesh.points_m.shape)
    moduli = {"lambda_pa": 200.0, "mu_pa": 300.0}
    force = body.elastic_force(x, **moduli)
    stiffness = body.stiffness(x, **moduli)
    assert force.shape == (36, 3)
    assert stiffness.shape == (108, 108)
    assert body.energy(x, **moduli) > 0
    assert body.node_mass.sum() == pytest.approx(30.0 * 0.06**2 * 0.09)


def test_a_run_from_python_is_written_like_any_other(tiny):
    finished = cs.run(cs.Problem.read("problem.toml"))
    folder = finished.save(tiny / "mine", frames=False)
    assert result_in(folder)["status"] == "converged"
    assert not (folder / "frames").exists()


def test_a_terminal_shows_the_current_phase_before_heavy_imports(monkeypatch, tiny):
    screen = io.StringIO()
    terminal = PlainConsole(file=screen, force_terminal=True, width=100)
    for module in (cli, common):
        monkeypatch.setattr(module, "error_console", terminal)
    assert cli.LazyCommands().get_command(None, "check") is not None
    assert "starting" in screen.getvalue()
    command_options.ProblemOptions(problem=Path("problem.toml")).read_problem()
    assert "reading" in screen.getvalue()


def test_a_terminal_gets_lines_that_break_between_words(monkeypatch):
    words = " ".join(["misfit"] * 20)
    for live, lines in ((True, 4), (False, 1)):
        file = io.StringIO()
        shown = Console(file=file, force_terminal=live, width=40, color_system=None)
        monkeypatch.setattr(common, "PlainConsole", lambda shown=shown, **_: shown)
        common.print_result(words)
        found = file.getvalue().splitlines()
        assert len(found) == lines
        assert {word for line in found for word in line.split()} == {"misfit"}


def test_commands_on_runs_show_their_help_without_a_solver():
    code = "import sys, collocation_sysid.cli.run_commands; sys.exit('casadi' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
