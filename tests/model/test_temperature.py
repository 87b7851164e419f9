"""Deviations that change the stiffness over time: estimated, considered and tested by one row."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.nuisance_check import check_nuisance
from kit.problems import IDEAL, hung_cube

import collocation_sysid as cs
from collocation_sysid.recording.nuisance import TEMPERATURE
from collocation_sysid.statistics.budget.consider_analysis import changes_of_assumptions
from collocation_sysid.statistics.budget.discretisation_error import estimate_changes
from collocation_sysid.statistics.budget.systematic_effects import Assumptions
from collocation_sysid.statistics.linearised import linearise_fit

TRUTH = {"young_pa": 8e3, "poisson": 0.3, "gamma_r_s": 6e-3, "gamma_m_1_s": 1.0}
NAME = TEMPERATURE.name
PER_KELVIN = -0.01


def cube(warmer_k: object, name: str = "cube", **known: float) -> cs.Experiment:
    hung = hung_cube(20)
    body = cs.Body(hung.body.mesh, density_kg_m3=60.0)
    return replace(
        hung, body=body, name=name, temperature_difference_k=warmer_k, known_deviations=known
    )


def seen(experiment: cs.Experiment) -> cs.Experiment:
    """The experiment with its simulated markers, described without the known deviation."""
    markers_m = cs.simulate(experiment, TRUTH, "midpoint", substeps=1).markers_m
    return replace(cs.with_markers(experiment, markers_m), known_deviations={})


@pytest.mark.parametrize("warmer_k", [7.0, [[0.0, -5.0], [0.2, 10.0]]])
def test_values_and_derivatives_of_programs_agree(warmer_k):
    check_nuisance(TEMPERATURE, experiment=cube(warmer_k))


def test_a_static_program_has_the_derivatives_too():
    strain = np.linspace(0.0, 0.2, 5)
    pull = cs.Specimen("uniaxial", strain, 1e3 * strain, 10.0).experiment(name="pull")
    still = replace(pull, nuisance=IDEAL, temperature_difference_k=[[0.0, 0.0], [4.0, 8.0]])
    check_nuisance(TEMPERATURE, experiment=still)


def test_a_constant_difference_is_a_softer_body():
    warm = cs.simulate(cube(20.0, stiffness_per_kelvin=PER_KELVIN), TRUTH, "midpoint", substeps=1)
    soft = TRUTH | {"young_pa": 0.8 * TRUTH["young_pa"]}
    expected = cs.simulate(cube(0.0), soft, "midpoint", substeps=1)
    cold = cs.simulate(cube(0.0), TRUTH, "midpoint", substeps=1)
    assert np.abs(warm.markers_m - expected.markers_m).max() < 1e-9
    assert np.abs(cold.markers_m - expected.markers_m).max() > 5e-4


@cache
def recordings(*warmer_k: float) -> list[cs.Experiment]:
    return [seen(cube(k, f"at {k:g}", stiffness_per_kelvin=PER_KELVIN)) for k in warmer_k]


def problem(experiments: list[cs.Experiment], sigma: float | None) -> cs.Problem:
    nuisance = cs.Nuisance.none(stiffness_per_kelvin=sigma, scope={NAME: "shared"} if sigma else {})
    experiments = [replace(each, nuisance=nuisance) for each in experiments]
    return cs.Problem(experiments, TRUTH | {"young_pa": cs.Unknown(6e3)}, substeps=1)


def test_recordings_at_two_temperatures_determine_the_coefficient():
    solution = cs.solve(problem(recordings(0.0, 20.0), 1.0))
    assert abs(solution.nuisance(NAME) - PER_KELVIN) < 1e-5
    assert abs(solution.parameters["young_pa"] / TRUTH["young_pa"] - 1) < 1e-4


def test_the_budget_considers_what_is_not_estimated():
    solution = cs.solve(problem(recordings(20.0), None))
    only = dict.fromkeys(Assumptions().collect_deviations()) | {NAME: 0.005}
    changes = changes_of_assumptions(solution.collocation, solution.z, only)
    assert changes.names == (NAME,)
    (change,) = estimate_changes(linearise_fit(solution.collocation, solution.z), changes.blocks)
    assert abs(change[0] + 20 * 0.005) < 1e-3  # of ln E: E (1 + 20 α) is what was measured


@pytest.mark.long
def test_every_solve_estimates_a_coefficient_that_is_not_stated():
    (experiment,) = recordings(20.0)
    t_s = experiment.t_s
    rising = cube([[t_s[0], 0.0], [t_s[-1], 20.0]], stiffness_per_kelvin=PER_KELVIN)
    only = dict.fromkeys(Assumptions().collect_deviations(), "none") | {NAME: 0.005}
    exact = cs.UncertaintyOptions(assumptions=Assumptions(**only))
    tracks_m = seen(rising).markers.positions_m
    noisy_m = tracks_m + 3e-5 * np.random.default_rng(0).standard_normal(tracks_m.shape)
    recorded = cs.with_markers(replace(rising, known_deviations={}), noisy_m)
    markers = replace(recorded.markers, sigma_m=np.full(tracks_m.shape[1], 3e-5))
    described = problem([replace(recorded, markers=markers)], None)
    found = cs.run(replace(described, uncertainty=exact), seek_causes=False)
    (own,) = (each for each in found.effects if each.name == NAME)
    assert abs(own.value - PER_KELVIN) < 3e-3  # one linear step
    low, high = found.interval("young_pa")
    assert low < TRUTH["young_pa"] < high


def test_a_custom_change_of_the_stiffness_needs_no_code_elsewhere():
    ageing = cs.Deviation("ageing", "1", 0.05, stiffness=lambda e, t_s: t_s / e.t_s[-1])
    check_nuisance(ageing, experiment=cube(None))


def test_known_values_of_deviations_without_effect_are_refused():
    with pytest.raises(cs.InputError, match="known_deviations: found a value of 'ageing'"):
        replace(cube(5.0), known_deviations={"ageing": 0.1})
    with pytest.raises(cs.InputError, match="beside temperature_difference_k"):
        replace(cube(None), known_deviations={NAME: 0.1})


def test_a_custom_change_of_the_stiffness_of_a_body_with_memory_is_refused():
    ageing = cs.Deviation("ageing", "1", 0.05, stiffness=lambda e, t_s: t_s / e.t_s[-1])
    described = cube(None)
    viscous = cs.Body(described.body.mesh, density_kg_m3=60.0, prony=["prony_1"])
    with pytest.raises(cs.InputError, match="the body has memory"):
        replace(described, body=viscous, nuisance=cs.Nuisance.none(own=[ageing]))
