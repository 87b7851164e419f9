"""Answers near incompressibility are also sought from another Poisson's ratio."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
from kit.problems import hung_cube

import collocation_sysid as cs
from collocation_sysid.runs import solving
from collocation_sysid.runs.second_start import NEARLY_INCOMPRESSIBLE, second_start
from collocation_sysid.runs.solving import best_of_second_start

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
    start = second_start(first)
    assert start is not None
    guesses = {item.name: item.guess for item in start.parameters.free}
    assert guesses["poisson"] == 0.3
    assert guesses["young_pa"] == pytest.approx(first.parameters["young_pa"])
    assert guesses["gamma_r_s"] == pytest.approx(first.parameters["gamma_r_s"])


def test_a_ratio_that_is_known_gives_no_second_start():
    assert second_start(answer("young_pa")) is None


def test_the_better_of_two_answers_counts():
    first = answer("young_pa", "poisson", "gamma_r_s")
    same = best_of_second_start(cs.ReducedSpace(), first, None)
    assert same is first
    worse = replace(first, history=(replace(first.history[-1], loss=first.history[-1].loss + 5),))
    better = best_of_second_start(cs.ReducedSpace(), worse, None)
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
    start = second_start(first)
    assert start is not None
    assert start.parameters.guesses["gamma_m_1_s"] == pytest.approx(5.0)


def rubber(largest_stretch: float, **stated: cs.Unknown) -> cs.Problem:
    """Three tests of rubber up to a stretch, for two terms of Ogden's law, without guesses but for
    the stated parameters.
    """
    experiments = cs.datasets.kawabata_1981(
        "ogden-2", tests=("uniaxial", "equibiaxial", "planar"), largest_stretch=largest_stretch
    )
    free = dict.fromkeys(("mu_1_pa", "alpha_1", "mu_2_pa", "alpha_2"), cs.Unknown())
    fixed = {"kappa_pa": 1e9, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    return cs.Problem(experiments, {**free, **stated, **fixed})


@pytest.mark.long
def test_two_exponents_of_one_sign_are_compared_with_opposite_ones(monkeypatch):
    problem = rubber(2.5)
    with monkeypatch.context() as patch:
        patch.setattr(solving, "second_start", lambda _: None)
        first = cs.solve(problem)
    assert first.parameters["alpha_2"] > 0
    start = second_start(first)
    assert start is not None
    before, after = (each.guesses for each in (first.collocation.parameters, start.parameters))
    assert after["alpha_2"] == -2.0
    assert after["mu_2_pa"] * after["alpha_2"] == pytest.approx(
        before["mu_2_pa"] * before["alpha_2"]
    )
    assert after["mu_1_pa"] == pytest.approx(before["mu_1_pa"])
    solution = cs.solve(problem)
    assert solution.parameters["alpha_2"] < 0
    assert solution.history[-1].loss < first.history[-1].loss - 10
    assert any("a second start, from -2, found" in n for n in solution.notes)
    assert second_start(solution) is None


@pytest.mark.long
def test_a_stated_negative_exponent_gives_no_second_start():
    stated = rubber(
        1.3,
        mu_1_pa=cs.Unknown(5e5),
        alpha_1=cs.Unknown(1.5),
        mu_2_pa=cs.Unknown(-5e4),
        alpha_2=cs.Unknown(-1.5),
    )
    solution = cs.solve(stated)
    assert second_start(solution) is None
