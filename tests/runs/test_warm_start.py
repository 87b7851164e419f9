"""Starts of IPOPT from an earlier solution: its run, its folder, or positions and multipliers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from kit.problems import hung_cube, noisy

import collocation_sysid as cs

TRUE = {"gamma_m_1_s": 1.0}
IPOPT = cs.InteriorPoint(initial="simulation")


@cache
def problem(seed: int = 5) -> cs.Problem:
    guesses = {"lambda_pa": 400.0, "mu_pa": 160.0, "gamma_r_s": 0.02}
    unknowns = {name: cs.Unknown(value) for name, value in guesses.items()}
    options: dict[str, Any] = {"method": IPOPT, "substeps": 1}
    return cs.Problem([noisy(hung_cube(6, (1, 1, 1)), 1e-4, seed=seed)], unknowns | TRUE, **options)


@cache
def cold(seed: int = 5) -> cs.Solution:
    return cs.solve(problem(seed))


def started(start: Any, seed: int = 5) -> cs.Solution:
    solution = cs.solve(problem(seed), start=start)
    assert solution.status is cs.Status.CONVERGED
    np.testing.assert_allclose(solution.z, cold(seed).z, atol=1e-5)
    return solution


def test_a_solution_is_found_again_at_once():
    assert cold().iterations >= 5
    assert started(cold()).iterations <= 1


def test_a_similar_recording_takes_few_iterations():
    warm = started(cold(), seed=6)
    assert warm.iterations <= cold(6).iterations / 2
    # The start needs no reduced space, also where a cold start would begin with it.
    with_default = cs.solve(problem(6), cs.InteriorPoint(), start=cold())
    assert with_default.iterations == warm.iterations


def test_variables_and_multipliers_of_nlpsol_are_a_start():
    nlp = problem().collocation().casadi()
    quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    solve = ca.nlpsol("solver", "ipopt", nlp, quiet | nlp.derivatives("ipopt"))
    found = solve(**nlp.arguments)
    x, multipliers = found["x"].full(), found["lam_g"].full()
    assert started((x, multipliers)).iterations <= 2
    # Without multipliers those that belong to the positions.
    assert started(x).iterations <= 2


def test_a_run_and_its_folder_are_starts(tmp_path: Path):
    run = cs.run(problem())
    assert started(run).iterations <= 1
    folder = run.save(tmp_path / "run", frames=False, pictures=False)
    assert started(folder).iterations <= 2


def test_another_grid_starts_from_the_estimates():
    finer = replace(problem(), substeps=2)
    warm = cs.solve(finer, start=cold())
    assert warm.status is cs.Status.CONVERGED
    assert warm.iterations <= cs.solve(finer).iterations / 2


def test_limited_memory_has_the_same_answer_and_starts_warm():
    method = cs.InteriorPoint(initial="simulation", hessian="limited-memory")
    warm = cs.solve(problem(), method, start=cold())
    assert warm.status.converged
    np.testing.assert_allclose(warm.z, cold().z, atol=1e-4)


@pytest.mark.parametrize(
    ("start", "found"),
    [
        (np.zeros(12), "found 12 variables"),
        (lambda z: (z, np.zeros(3)), "found 171 variables and 3 multipliers"),
        ("text", "text"),
        (object(), "found a object"),
    ],
)
def test_other_starts_are_refused(start: Any, found: str, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if callable(start):
        start = start(cold().z)
    with pytest.raises(cs.InputError, match=found):
        cs.solve(problem(), start=start)
