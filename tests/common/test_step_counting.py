"""Completed shares of phases, and the remaining time that displays derive from them."""

from __future__ import annotations

import io
import re
import time

import numpy as np
import pytest
from kit.problem_files import write_problem
from kit.problems import TRUTH, as_theta, hung_cube
from rich.console import Console

import collocation_sysid as cs
from collocation_sysid.common.step_counting import (
    StepUnit,
    complete_steps,
    counted_phase,
    listen_to_activities,
    listen_to_shares,
    listen_to_states,
    report_state,
    search_activity,
)
from collocation_sysid.fem.kernels import map_experiments
from collocation_sysid.program.forward.initial_equilibrium import equilibrium
from collocation_sysid.program.forward.newton_solver import NewtonOptions, NewtonSolver
from collocation_sysid.result import solve_progress


def test_a_phase_reports_its_share_from_zero_to_its_end():
    shares = []
    with listen_to_shares(shares.append), counted_phase(StepUnit.PICTURE, 4):
        for _ in range(5):
            complete_steps(StepUnit.PICTURE)
        complete_steps(StepUnit.TIME_STEP, 100)  # another unit does not count
    assert shares == [0.0, 0.25, 0.5, 0.75, 1.0, 1.0, None]


def test_a_nested_phase_belongs_to_the_outer_one():
    shares = []
    with listen_to_shares(shares.append), counted_phase(StepUnit.TIME_STEP, 2):
        with counted_phase(StepUnit.TIME_STEP, 100):
            complete_steps(StepUnit.TIME_STEP)
        complete_steps(StepUnit.TIME_STEP)
    assert shares == [0.0, 0.5, 1.0, None]


def test_no_progress_is_reported_outside_a_phase():
    shares = []
    with listen_to_shares(shares.append):
        complete_steps(StepUnit.TIME_STEP)
    with counted_phase(StepUnit.TIME_STEP, 2):
        complete_steps(StepUnit.TIME_STEP)
    assert shares == []


def test_threads_of_experiments_count_in_the_same_phase():
    shares = []
    with listen_to_shares(shares.append), counted_phase(StepUnit.SIMULATION, 2):
        map_experiments(lambda _: complete_steps(StepUnit.SIMULATION), ["a", "b"], threads=2)
    assert shares[0] == 0.0
    assert max(shares[1:-1]) == 1.0
    assert shares[-1] is None


def test_every_long_phase_of_a_run_has_a_share(tmp_path):
    problem = cs.Problem.read(write_problem(tmp_path, {"swing": 8, "nod": 12}))
    phases: list[list[float]] = []
    said: list[str] = []

    def listen(share: float | None) -> None:
        if share == 0:
            phases.append([])
        if share is not None:
            phases[-1].append(share)

    with listen_to_shares(listen):
        cs.run(problem, log=said.append)
    # The forward simulation, the error bars, the noise of the poses, the mesh, the systematic
    # effects, and those beyond the budget, because the residuals are smaller than noise.
    assert len(phases) == 6
    simulation, error_bars, _, mesh, effects, _ = phases
    for shares in (simulation, error_bars, mesh, effects):
        assert shares == sorted(shares)
        assert shares[-1] == pytest.approx(1.0)
        assert len(shares) > 4


def test_a_scan_has_a_share(tmp_path):
    file = write_problem(tmp_path, {"swing": 8})
    text = file.read_text()
    problem = cs.Problem.read(file)
    problem = cs.Problem.read(file, [f"parameters.{n}={{}}" for n in problem.parameters.names])
    assert text == file.read_text()
    shares: list[float | None] = []
    with listen_to_shares(shares.append):
        cs.solve(problem)
    assert shares[0] == 0.0
    assert shares[1] == pytest.approx(1 / 15)
    assert shares[-1] is None


def test_the_remaining_time_follows_from_the_share(monkeypatch):
    now_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    progress = solve_progress.SolveProgress(Console(file=io.StringIO()), quiet=True)
    with progress:
        progress.say("finding the error bars")
        progress.share(0.0)
        now_s = 100.5
        progress.share(0.01)
        assert progress._activity_with_iterations() == "finding the error bars: 1%"
        now_s = 104.0
        progress.share(0.25)
        shown = progress._activity_with_iterations()
        assert shown == "finding the error bars: 25%, about 12 s left"
        now_s = 110.0
        progress.share(0.02)  # the next phase: its time begins here
        assert progress._activity_with_iterations() == "finding the error bars: 2%"
        now_s = 120.0
        progress.share(0.04)
        shown = progress._activity_with_iterations()
        assert shown == "finding the error bars: 4%, about 4 min left"
        progress.share(None)
        assert progress._activity_with_iterations() == "finding the error bars"


def test_a_terminal_shows_the_remaining_time(monkeypatch):
    monkeypatch.setattr(solve_progress, "FIRST_REMAINING_S", 0.0)
    monkeypatch.setattr(solve_progress, "SHARE_INTERVAL_S", 0.0)
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=100)
    with solve_progress.SolveProgress(console) as progress:
        progress.say("drawing the pictures")
        with counted_phase(StepUnit.PICTURE, 4):
            time.sleep(0.01)
            complete_steps(StepUnit.PICTURE)
            progress._live.refresh()
    assert "drawing the pictures: 25%, about 0 s left" in screen.getvalue()


def test_a_terminal_shows_the_elapsed_time_of_a_phase_without_a_share(monkeypatch):
    now_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    progress = solve_progress.SolveProgress(Console(file=io.StringIO()), quiet=True)
    progress.say("looking for causes of the misfit")
    now_s = 101.0
    assert progress._activity_with_time() == "looking for causes of the misfit"
    now_s = 104.0
    assert progress._activity_with_time() == "looking for causes of the misfit (4 s so far)"
    progress.say("looking for causes of the misfit")  # the same activity goes on
    now_s = 105.0
    assert progress._activity_with_time() == "looking for causes of the misfit (5 s so far)"
    progress.say("finding the error bars")
    assert progress._activity_with_time() == "finding the error bars"
    progress.share(0.5)
    now_s = 109.0
    assert progress._activity_with_time() == "finding the error bars: 50%, about 5 s left"


def test_a_terminal_shows_the_state_of_a_long_iteration(monkeypatch):
    now_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    console = Console(file=io.StringIO())
    with solve_progress.SolveProgress(console, quiet=True) as progress:
        progress.say("simulating")
        report_state(lambda: "residual 1 N")
        assert progress._activity_with_time() == "simulating"
        now_s = 103.0
        shown = progress._activity_with_time()
        assert shown == "simulating, residual 1 N (3 s so far)"
        progress.say("finding the error bars")
        report_state(lambda: "residual 2 N")
        assert "residual" not in progress._activity_with_time()


def test_an_equilibrium_reports_its_load_steps_and_residuals():
    states = []
    bar = hung_cube()
    solver = NewtonSolver(bar, NewtonOptions(max_iterations=3))
    theta = as_theta(TRUTH)
    with listen_to_states(lambda describe: states.append(describe())):
        equilibrium(bar, theta, solver=solver)
    number = r"(\S+)"
    form = rf"equilibrium at {number}% of the load, residual {number} N"
    loads, residuals = zip(
        *(map(float, re.fullmatch(form, state).groups()) for state in states[:-1]), strict=True
    )
    assert states[-1] == ""  # the search has ended
    assert loads[-1] == 100.0
    assert residuals[-1] < 1e-6 * max(residuals)


def test_a_live_display_is_refreshed_without_a_new_message(monkeypatch):
    monkeypatch.setattr(solve_progress, "FIRST_ELAPSED_S", 0.0)
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=100)
    with solve_progress.SolveProgress(console) as progress:
        progress.say("looking for causes of the misfit")
        progress._activity_began_s -= 7
        progress._live.refresh()
    assert "looking for causes of the misfit (7 s so far)" in screen.getvalue()


def test_the_first_activity_is_shown_at_once():
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=100)
    with solve_progress.SolveProgress(console, activity="simulating") as shown:
        shown._live.refresh()
    assert "simulating" in screen.getvalue()


def test_after_a_part_the_whole_is_shown_again():
    with solve_progress.SolveProgress(Console(file=io.StringIO()), quiet=True) as progress:
        with search_activity("coarse start"):
            assert progress._activity_with_time() == "coarse start"
        assert progress._activity_with_time() == "solving"
        progress.say("testing the description")
        with search_activity("testing hypothesis 1"):
            assert progress._activity_with_time() == "testing hypothesis 1"
        assert progress._activity_with_time() == "testing the description"


def test_reading_a_problem_counts_its_recordings(tmp_path):
    file = write_problem(tmp_path, {"swing": 8, "nod": 12})
    shares = []
    with listen_to_shares(shares.append):
        cs.Problem.read(file)
    assert shares == [0.0, 0.5, 1.0, None]


@pytest.mark.long
def test_all_phases_of_a_run_are_announced_and_those_of_known_length_counted(tmp_path):
    file = write_problem(tmp_path, {"swing": 8})
    changes = [
        'solver.method="reduced-space"',
        'uncertainty.profile=["mu_pa"]',
        "uncertainty.numerical=true",
    ]
    problem = cs.Problem.read(file, changes)
    phases: dict[str, list[float | None]] = {"": []}

    def begin(name: str) -> None:
        phases.setdefault(name, [])

    def count(share: float | None) -> None:
        list(phases.values())[-1].append(share)

    with listen_to_shares(count), listen_to_activities(begin):
        cs.run(problem, log=begin)
    for name in (
        "checking the result by a forward simulation",
        "computing the error bars",
        "computing the effects of assumptions",
    ):
        assert phases[name][0] == 0.0
        assert 1.0 in phases[name]
    assert "profile likelihood of mu_pa, value 2" in phases
    assert "testing possible causes of the misfit" not in phases  # the fit is consistent
    assert "solving again: mesh halved 1×" in phases


def test_the_share_of_a_long_phase_is_reported_often_enough():
    shares = []
    with listen_to_shares(shares.append), counted_phase(StepUnit.TIME_STEP, 10):
        complete_steps(StepUnit.TIME_STEP, 2.5)
    assert np.diff(shares[:2]) == pytest.approx(0.25)
