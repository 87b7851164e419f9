"""Answers near incompressibility are also sought from another Poisson's ratio."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.problems import hung_cube

import collocation_sysid as cs
from collocation_sysid.runs import solving
from collocation_sysid.runs.searches import Searches
from collocation_sysid.runs.several_starts import (
    NEARLY_INCOMPRESSIBLE,
    SECOND_STARTS,
    other_exponents,
    usual_poisson_start,
)

KNOWN = {"gamma_r_s": 0.01, "gamma_m_1_s": 1.0}
TRUTH = {"young_pa": 600.0, "poisson": 0.46, **KNOWN}


@cache
def answer(*free: str) -> cs.Solution:
    """That of a cube with a Poisson's ratio near one half, of which only some numbers are free."""
    swung = hung_cube()
    tracks_m = cs.simulate(swung, TRUTH, "midpoint", substeps=1).markers_m
    estimated = {name: cs.Unknown(TRUTH[name]) for name in free}
    return cs.solve(cs.Problem([cs.with_markers(swung, tracks_m)], {**TRUTH, **estimated}))


def test_the_second_start_has_the_usual_ratio_and_the_same_stiffness():
    first = answer("young_pa", "poisson", "gamma_r_s")
    assert first.parameters["poisson"] > NEARLY_INCOMPRESSIBLE
    start = usual_poisson_start(first)
    assert start is not None
    guesses = {item.name: item.guess for item in start.collocation.parameters.free}
    assert guesses["poisson"] == 0.3
    assert guesses["young_pa"] == pytest.approx(first.parameters["young_pa"])
    assert guesses["gamma_r_s"] == pytest.approx(first.parameters["gamma_r_s"])


def test_a_ratio_that_is_known_gives_no_second_start():
    assert usual_poisson_start(answer("young_pa")) is None


def test_the_better_of_two_answers_counts():
    first = answer("young_pa", "poisson", "gamma_r_s")
    searches = Searches(cs.ReducedSpace())
    same = searches.continued(first, SECOND_STARTS)
    assert same.z is first.z
    assert not same.notes
    worse = replace(first, history=(replace(first.history[-1], loss=first.history[-1].loss + 5),))
    better = searches.continued(worse, SECOND_STARTS)
    assert "χ² lower by 5" in better.notes[0]
    assert better.parameters["poisson"] == pytest.approx(first.parameters["poisson"], rel=1e-3)


def test_a_second_start_keeps_a_parameter_at_its_bound():
    """An estimate at a bound may be beyond it by rounding, as exp(ln 5) is below 5."""
    swung = hung_cube()
    tracks_m = cs.simulate(swung, TRUTH, "midpoint", substeps=1).markers_m
    estimated = {
        "young_pa": cs.Unknown(TRUTH["young_pa"]),
        "poisson": cs.Unknown(TRUTH["poisson"]),
        "gamma_m_1_s": cs.Unknown(6.0, lower=5.0, upper=100.0),
    }
    first = cs.solve(cs.Problem([cs.with_markers(swung, tracks_m)], {**TRUTH, **estimated}))
    assert first.parameters["gamma_m_1_s"] == pytest.approx(5.0)
    assert first.parameters["poisson"] > NEARLY_INCOMPRESSIBLE
    start = usual_poisson_start(first)
    assert start is not None
    assert start.collocation.parameters.guesses["gamma_m_1_s"] == pytest.approx(5.0)


@pytest.mark.long
def test_a_better_optimum_of_the_closed_forms_is_sought_from_bad_guesses(monkeypatch):
    """From the stated exponents the search ends in another optimum, converged or not."""
    truth = {"mu_1_pa": 3.2e5, "alpha_1": 2.0, "mu_2_pa": -4e4, "alpha_2": -2.0, "kappa_pa": 1e9}
    problem = cs.Problem(
        rubber_tests(truth),
        {
            "mu_1_pa": cs.Unknown(3e5),
            "alpha_1": cs.Unknown(0.2),
            "mu_2_pa": cs.Unknown(1e5),
            "alpha_2": cs.Unknown(3.0),
            "kappa_pa": 1e9,
            "gamma_r_s": 0.0,
            "gamma_m_1_s": 0.0,
        },
        methods={"reduced-space": cs.ReducedSpace(max_iterations=40)},
    )
    with monkeypatch.context() as patch:
        patch.setattr(solving, "SECOND_STARTS", ())
        first = cs.solve(problem)
    assert not first.status.converged or first.parameters["alpha_2"] > 0
    solution = cs.solve(problem)
    assert solution.status.converged
    assert solution.parameters["alpha_1"] == pytest.approx(2.0, abs=0.1)
    assert solution.parameters["alpha_2"] == pytest.approx(-2.0, abs=0.3)
    assert any("of the closed forms" in note for note in solution.notes)
    assert other_exponents(solution) is None


def rubber_tests(truth: dict[str, float]) -> list[cs.Experiment]:
    """Uniaxial and equibiaxial tests of rubber with two terms, with a noise of 2 kPa."""
    random = np.random.default_rng(3)
    experiments = []
    for test, largest in (("uniaxial", 2.0), ("equibiaxial", 1.0)):
        strain = np.linspace(0.02, largest, 15)
        stretch = 1 + strain
        free = stretch**-0.5 if test == "uniaxial" else stretch**-2
        stress_pa = sum(
            truth[f"mu_{p}_pa"] * (stretch ** truth[f"alpha_{p}"] - free ** truth[f"alpha_{p}"])
            for p in (1, 2)
        )
        noisy_pa = stress_pa / stretch + 2e3 * random.standard_normal(len(strain))
        experiments.append(cs.Specimen(test, strain, noisy_pa, 2e3).experiment("ogden-2", test))
    return experiments
