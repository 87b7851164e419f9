"""Answers near incompressibility are also sought from another Poisson's ratio."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
from kit.problems import hung_cube

import collocation_sysid as cs
from collocation_sysid.runs.solving import (
    NEARLY_INCOMPRESSIBLE,
    best_of_second_start,
    second_start_parameters,
)

KNOWN = {"gamma_r_s": 0.01, "gamma_m_1_s": 1.0}
TRUTH = {"young_pa": 600.0, "poisson": 0.46, **KNOWN}


@cache
def answer(*free: str) -> cs.Solution:
    """That of a cube with a Poisson's ratio near one half, of which only some numbers are free."""
    swung = hung_cube()
    tracks_m = cs.simulate(swung, TRUTH, "midpoint", substeps=1).markers_m
    estimated = {name: cs.Unknown(TRUTH[name]) for name in free}
    return cs.solve(
        cs.Problem([cs.with_markers(swung, tracks_m)], {**TRUTH, **estimated})
    )


def test_the_second_start_has_the_usual_ratio_and_the_same_stiffness():
    first = answer("young_pa", "poisson", "gamma_r_s")
    assert first.parameters["poisson"] > NEARLY_INCOMPRESSIBLE
    start = second_start_parameters(first)
    assert start is not None
    guesses = {item.name: item.guess for item in start.free}
    assert guesses["poisson"] == 0.3
    assert guesses["young_pa"] == pytest.approx(first.parameters["young_pa"])
    assert guesses["gamma_r_s"] == pytest.approx(first.parameters["gamma_r_s"])


def test_a_ratio_that_is_known_gives_no_second_start():
    assert second_start_parameters(answer("young_pa")) is None


def test_the_better_of_two_answers_counts():
    first = answer("young_pa", "poisson", "gamma_r_s")
    same = best_of_second_start(cs.ReducedSpace(), first, None)
    assert same is first
    worse = replace(
        first,
        history=(replace(first.history[-1], loss=first.history[-1].loss + 5),),
    )
    better = best_of_second_start(cs.ReducedSpace(), worse, None)
    assert "χ² lower by 5" in better.notes[0]
    assert better.parameters["poisson"] == pytest.approx(
        first.parameters["poisson"], rel=1e-3
    )


def test_a_second_start_keeps_a_parameter_at_its_bound():
    """An estimate at a bound may be beyond it by rounding, as exp(ln 5) is below 5."""
    swung = hung_cube()
    tracks_m = cs.simulate(swung, TRUTH, "midpoint", substeps=1).markers_m
    estimated = {
        "young_pa": cs.Unknown(TRUTH["young_pa"]),
        "poisson": cs.Unknown(TRUTH["poisson"]),
        "gamma_m_1_s": cs.Unknown(6.0, lower=5.0, upper=100.0),
    }
    first = cs.solve(
        cs.Problem([cs.with_markers(swung, tracks_m)], {**TRUTH, **estimated})
    )
    assert first.parameters["gamma_m_1_s"] == pytest.approx(5.0)
    assert first.parameters["poisson"] > NEARLY_INCOMPRESSIBLE
    start = second_start_parameters(first)
    assert start is not None
    assert start.guesses["gamma_m_1_s"] == pytest.approx(5.0)
