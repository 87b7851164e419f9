"""Residuals that deviations within the uncertainty budget explain, and those that they do not."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from assumed_twins import with_wrong_assumptions
from kit.problems import hung_cube

from collocation_sysid import Body, Problem, Run, UncertaintyOptions, Unknown, run
from collocation_sysid.pipeline import _changes, _solved_fit
from collocation_sysid.statistics.assessment import WITHIN_BUDGET, fit_concerns
from collocation_sysid.statistics.budget.systematic_effects import Assumptions
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.probes.budgeted_residuals import (
    is_significant_beside_budget,
    with_budget,
)
from collocation_sysid.statistics.probes.routine import is_alarming

pytestmark = pytest.mark.long

TRUTH = {"young_pa": 8e3, "poisson": 0.3, "gamma_r_s": 6e-3, "gamma_m_1_s": 1.0}
NOISE_M = 1e-5
# Alone in the budget.
DEVIATION = 0.05
EFFECT = "stiffness_gradient"


@cache
def solved(size: float, deviation: float | str = DEVIATION, effect: str = f"{EFFECT} z") -> Run:
    """A swung cube whose stiffness changes along its height, or another effect."""
    hung = hung_cube(40)
    hung = replace(hung, body=Body(hung.body.mesh, density_kg_m3=60.0))
    errors = {effect: size} if size else {}
    tracks = with_wrong_assumptions(hung, TRUTH, errors).markers.positions_m
    tracks = tracks + NOISE_M * np.random.default_rng(0).standard_normal(tracks.shape)
    sigma_m = np.full(tracks.shape[1], NOISE_M)
    seen = replace(hung.markers, positions_m=tracks, sigma_m=sigma_m)
    exact: dict[str, Any] = dict.fromkeys(Assumptions().collect_deviations(), "none")
    exact[effect.partition(" ")[0]] = deviation
    options = UncertaintyOptions(assumptions=Assumptions(**exact))
    unknown = {name: Unknown(value) for name, value in TRUTH.items()}
    problem = Problem([replace(hung, markers=seen)], unknown, substeps=1, uncertainty=options)
    return run(problem, "reduced-space", seek_causes=False)


def residual_codes(finished: Run, *budgeted) -> set[str]:
    assert finished.uncertainty is not None
    concerns = fit_concerns(finished.uncertainty, *budgeted)
    return {each.code for each in concerns} & {*WITHIN_BUDGET}


def test_residuals_of_a_deviation_within_the_budget_are_no_reason():
    found = solved(0.1)
    assert residual_codes(found)
    assert found.budgeted is not None
    assert found.budgeted.largest == f"{EFFECT} z"
    assert found.budgeted.deviations == pytest.approx(0.1 / DEVIATION, rel=0.2)
    assert not {each.code for each in found.trust.concerns} & {*WITHIN_BUDGET}
    assert not any(is_alarming(probe) for probe in found.probes)
    (note,) = (each for each in found.notes if "uncertainty budget grants" in each)
    assert "stiffness gradient z: +2" in note


def test_a_deviation_that_the_budget_does_not_grant_is_a_reason():
    for found in (solved(0.4), solved(0.1, "none")):
        assert found.budgeted is None
        assert {each.code for each in found.trust.concerns} >= residual_codes(found) != set()


def test_residuals_that_are_noise_are_not_examined_again():
    found = solved(0.0)
    assert not residual_codes(found)
    assert found.budgeted is None
    assert not {each.code for each in found.trust.concerns} & {*WITHIN_BUDGET}


def test_a_probe_that_absorbs_a_deviation_is_not_significant_beside_the_budget():
    found = solved(0.1)
    fit = linearise_fit(found.solution.collocation, found.solution.z)
    solved_fit = _solved_fit(found, fit, _changes(found, lambda _: None))
    memory = "memory_share τ=0.1s"

    def remains(budgeted: dict[str, float | None], name: str) -> bool:
        relaxed = with_budget(solved_fit, budgeted)
        return is_significant_beside_budget(solved_fit, budgeted, relaxed, name)

    assert remains({}, memory)
    assert not remains({EFFECT: DEVIATION}, memory)
    # The effect itself is two standard deviations of the budget.
    assert not remains({EFFECT: DEVIATION}, f"{EFFECT} z")


@pytest.mark.parametrize(("size", "is_granted"), [(0.05, True), (0.2, False)])
def test_a_drift_of_the_stiffness_counts_beyond_the_budget(size, is_granted):
    found = solved(size, 0.02, "stiffness_drift")
    (drift,) = (probe for probe in found.probes if probe.name == "stiffness_drift")
    assert drift.size == pytest.approx(size, rel=0.3)
    assert is_alarming(drift) is not is_granted
    codes = {each.code for each in found.trust.concerns if each.code == "assumption/contradicted"}
    assert bool(codes) is not is_granted
