"""Combined intervals, their budget by source, and parameters that are not determined."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problem_files import pictures_drawn, run_command, write_problem
from kit.problems import GUESS, TRUTH, cube_with_nuisance, hung_cube, measured

from collocation_sysid import (
    Body,
    Experiment,
    Grasp,
    Markers,
    Nuisance,
    PoseSequence,
    Problem,
    RolloutOptions,
    Run,
    UncertaintyOptions,
    Unknown,
    box_mesh,
    run,
    simulate,
    solve,
    with_markers,
)
from collocation_sysid.common.display import plain_text
from collocation_sysid.errors import InputError
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.result.run_summary import run_summary
from collocation_sysid.runs.result_content import Result
from collocation_sysid.statistics.budget.combined_intervals import combine
from collocation_sysid.statistics.budget.consider_analysis import changes_of_nuisances
from collocation_sysid.statistics.budget.discretisation_error import estimate_changes
from collocation_sysid.statistics.budget.effect_estimates import EffectEstimate, effect_concerns
from collocation_sysid.statistics.budget.systematic_effects import (
    ASSUMPTIONS,
    CONSIDERED,
    Assumptions,
    source_label,
)
from collocation_sysid.statistics.concerns import REMEDIES, remedy_for
from collocation_sysid.statistics.estimates import Estimate
from collocation_sysid.statistics.linearised import linearise_fit

NOTHING = {name: "none" for name in Assumptions().collect_deviations()}


def problem(air_density_kg_m3: float = 0.0, **stated) -> Problem:
    options = UncertaintyOptions(assumptions=Assumptions(**stated))
    experiment = measured(hung_cube(20, air_density_kg_m3=air_density_kg_m3))
    return Problem([experiment], GUESS, substeps=1, uncertainty=options)


@pytest.fixture(scope="module")
def finished():
    return run(replace(problem(), substeps="auto"), seek_causes=False)


def test_the_shares_of_a_budget_sum_to_one_largest_first(finished):
    assert set(finished.budget) == set(finished.estimates)
    for line in finished.budget.values():
        shares = list(line.shares.values())
        assert sum(shares) == pytest.approx(1.0)
        assert shares == sorted(shares, reverse=True)


def test_the_combined_interval_contains_the_statistical_one(finished):
    for name, line in finished.budget.items():
        low, high = finished.estimates[name].statistical95
        assert line.combined95[0] < low < high < line.combined95[1]
        assert finished.estimates[name].combined95 == line.combined95


def test_without_systematic_effects_and_discretisation_error_both_intervals_agree():
    exact = run(replace(problem(**NOTHING), rollout=RolloutOptions("scheme")), seek_causes=False)
    for name, line in exact.budget.items():
        assert line.combined95 == pytest.approx(exact.estimates[name].statistical95)
        assert set(line.shares) <= {"noise", "nuisance parameters"}


def assumed_deviation(solved: Run, name: str) -> float:
    """Standard deviation of the systematic effects on the logarithm."""
    return solved.posterior.systematic(name)


def test_one_assumption_alone_has_its_own_variance(finished):
    heavy = run(problem(**NOTHING | {"mass": 0.05}), seek_causes=False)
    # Markers that swing tell moduli over density: E follows the mass.
    line = heavy.budget["mu_pa"]
    relative = line.combined_std_error / line.value
    assert relative * np.sqrt(line.shares["mass"]) == pytest.approx(0.05, rel=1e-3)
    assert next(iter(line.shares)) == "mass"


def test_a_large_systematic_effect_stays_on_the_logarithmic_scale_of_its_parameter():
    airy = run(problem(1.2, **NOTHING | {"air_drag": 20.0}), seek_causes=False)
    assert assumed_deviation(airy, "gamma_m_1_s") > 0.3
    low, high = airy.estimates["gamma_m_1_s"].combined95
    assert 0 < low < high


def test_a_parameter_with_an_interval_wider_than_its_value_is_not_determined():
    airy = run(problem(1.2, **NOTHING | {"air_drag": 60.0}), seek_causes=False)
    assert not airy.estimates["gamma_m_1_s"].is_determined
    assert airy.estimates["mu_pa"].is_determined
    limit = airy.result.limits["gamma_m_1_s"]
    source = next(iter(airy.budget["gamma_m_1_s"].shares))
    assert (limit.determined, limit.source) == (False, source)
    assert limit.remedy == REMEDIES[source]
    assert "not determined" in airy.table()
    assert limit.remedy in plain_text(run_summary(airy.result))
    # A wide interval contradicts nothing; the recording has no noise.
    assert {concern.code for concern in airy.trust.concerns} <= {"noise/smaller"}


def test_intervals_respect_the_bounds_of_their_parameter():
    estimate = Estimate(0.05, 0.1, (0.0, 0.25))
    combined = combine("x_friction", estimate, None, 0.1, linear=True, bounds=(0.0, 0.2))
    assert combined.statistical95 == (0.0, 0.2)
    assert combined.combined95 == (0.0, 0.2)
    ratio = combine("poisson", Estimate(0.4, 0.02, (0.36, 0.44)), None, 2.0, bounds=(0.001, 0.495))
    assert 0.001 < ratio.combined95[0] < 0.4 < ratio.combined95[1] <= 0.495


def test_every_assumption_has_a_remedy():
    assert {row.name for row in ASSUMPTIONS} <= set(REMEDIES)
    assert "measure gravity_rad" in remedy_for("gravity_rad")


def test_the_remedy_of_poissons_ratio_names_the_table_of_its_deviation():
    remedy = remedy_for("poisson")
    assert "state its deviation, poisson = …, in [uncertainty.assumptions]" in remedy


@pytest.mark.long
@pytest.mark.parametrize("huber", [None, 1.0])
def test_a_considered_nuisance_moves_estimates_as_a_recording_with_the_error(huber):
    experiment = measured(hung_cube(20))
    if huber:  # under which most samples count less than they are
        noise_m = 5e-3 * np.random.default_rng(1).standard_normal((21, 9, 3))
        experiment = with_markers(experiment, experiment.markers.positions_m + noise_m)
    described = Problem([experiment], GUESS, substeps=1, huber=huber)
    first = solve(described, ReducedSpace(tolerance=1e-9))
    collocation, off = first.collocation, 2e-4
    changes = changes_of_nuisances(collocation, first.z, {"calibration_scale": off})
    assert changes.names == ("calibration_scale", "calibration_distortion_1_m2", "clock_rate")
    told = -estimate_changes(linearise_fit(collocation, first.z), changes.blocks)[: len(first.q), 0]
    pivot = experiment.rigid_positions(experiment.t_s[:1])[0].mean(axis=0)
    tracks = pivot + (1 + off) * (experiment.markers.positions_m - pivot)
    moved = replace(described, experiments=[with_markers(experiment, tracks)])
    again = solve(moved, ReducedSpace(tolerance=1e-9))
    atol = (0.3 if huber else 0.03) * np.abs(told).max()  # weights follow residuals
    np.testing.assert_allclose(again.q - first.q, told, atol=atol)


def test_estimated_nuisance_parameters_are_not_considered():
    experiment = measured(cube_with_nuisance(8))
    wide = replace(experiment, nuisance=replace(experiment.nuisance, calibration_scale=0.01))
    solution = solve(Problem([wide], GUESS))
    names = changes_of_nuisances(
        solution.collocation, solution.z, Assumptions().collect_deviations()
    ).names
    assert "calibration_scale" not in names
    assert "clock_rate" in names


def test_every_assumption_has_a_key_a_default_and_words():
    assert set(Assumptions().collect_deviations()) == {row.name for row in CONSIDERED}
    assert all(row.description and source_label(row.name) for row in ASSUMPTIONS)
    assert source_label("grip_layer_m") == "grip layer"


def swings(*gamma_r_s: float) -> Problem:
    """Recordings of the same motion, of bodies that may be damped unlike each other."""
    rng, recordings = np.random.default_rng(5), []
    for k, damping in enumerate(gamma_r_s):
        swing = replace(hung_cube(25), name=f"swing {k}")
        markers = simulate(swing, TRUTH | {"gamma_r_s": damping}, "midpoint", substeps=1).markers_m
        noise_m = swing.markers.sigma_m[:, None] * rng.standard_normal(markers.shape)
        recordings.append(with_markers(swing, markers + noise_m))
    options = UncertaintyOptions(assumptions=Assumptions(**NOTHING), numerical=False)
    return Problem(recordings, GUESS, substeps=1, uncertainty=options)


@pytest.mark.long
def test_disagreement_of_recordings_widens_the_combined_interval():
    truths = (4e-3, 9e-3, 14e-3)
    unlike = run(swings(*truths), seek_causes=False)
    line = unlike.budget["gamma_r_s"]
    assert next(iter(line.shares)) == "between recordings"
    assert line.combined95[0] < truths[0]
    assert line.combined95[1] > truths[-1]


@pytest.mark.long
def test_recordings_that_agree_add_nothing():
    alike = run(swings(9e-3, 9e-3, 9e-3), seek_causes=False)
    for name, line in alike.budget.items():
        assert line.shares.get("between recordings", 0.0) < 0.4, name


@pytest.mark.long
def test_terminal_page_and_pictures_show_the_budget(finished, tmp_path):
    with pictures_drawn():
        folder = finished.save(tmp_path / "run", frames=False)
    assert (folder / "budget.png").exists()
    told = Result.read(folder)
    assert set(told.budget["mu_pa"]) == set(finished.budget["mu_pa"].shares)
    short, whole = (
        plain_text(run_summary(told, folder, details=True, budget=b)) for b in (False, True)
    )
    assert "± syst" in short
    assert "% of the variance" not in short
    assert "% of the variance" in whole
    assert run_command("report", folder).code == 0
    page = next(folder.glob("*.html")).read_text()
    assert "% of the variance" in page
    assert "Contributions to the variance of each estimate" in page


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("mass", "-0.1", "uncertainty.assumptions.mass: found -0.1; expected"),
        ("weight", "0.1", "uncertainty.assumptions.weight: unknown key"),
        ("air_drag", '"off"', "uncertainty.assumptions.air_drag: found 'off'; expected"),
    ],
)
def test_invalid_assumptions_are_one_message(tmp_path, key, value, said):
    file = write_problem(tmp_path, {"swing": 8})
    file.write_text(file.read_text() + f"\n[uncertainty.assumptions]\n{key} = {value}\n")
    outcome = run_command("check", file)
    assert outcome.code == 2
    assert said in " ".join(outcome.err.split())


# The law of damping


def fast_block(damping: str, sigma_m: float = 3e-4) -> Experiment:
    """A block of 400 kg/m³ that is swung 12 cm at 2 Hz, so that it is strained by some 10 %."""
    t_s = np.linspace(0.0, 0.5, 26)
    way_m = np.outer(0.06 * (1 - np.cos(4 * np.pi * t_s)), [1, 0, 0.5])
    body = Body(box_mesh((0.05, 0.05, 0.15), (1, 1, 3)), density_kg_m3=400.0, damping=damping)
    top = np.flatnonzero(body.nodes_m[:, 2] > 0.149)
    low = body.nodes_m[body.nodes_m[:, 2] < 0.06][::4]
    swing = PoseSequence(t_s, way_m, np.tile([0, 0, 0, 1.0], (len(t_s), 1)))
    markers = Markers(t_s, np.zeros((len(t_s), len(low), 3)), sigma_m, places_m=low)
    return Experiment(body, t_s, [Grasp(top, swing)], markers, nuisance=Nuisance.none())


BLOCK = {"young_pa": 20e3, "poisson": 0.3, "gamma_r_s": 6e-3, "gamma_m_1_s": 0.2}


def fitted_block(made_with: str, fitted_with: str, **stated):
    """The run of a twin made with one law of damping and fitted with another."""
    twin = simulate(fast_block(made_with), BLOCK, "midpoint").markers_m
    twin = twin + np.random.default_rng(0).normal(scale=3e-4, size=twin.shape)
    unknown = {"young_pa": Unknown(15e3), "gamma_r_s": Unknown(4e-3)}
    described = Problem(
        [with_markers(fast_block(fitted_with), twin)],
        BLOCK | unknown,
        uncertainty=UncertaintyOptions(assumptions=Assumptions(**(NOTHING | stated))),
    )
    return run(described, seek_causes=False)


@pytest.mark.parametrize(
    ("made_with", "fitted_with"),
    [
        ("material", "kelvin-voigt"),
        pytest.param("kelvin-voigt", "material", marks=pytest.mark.long),
        pytest.param("rayleigh", "kelvin-voigt", marks=pytest.mark.long),
    ],
)
def test_the_constant_is_that_of_the_stated_damping_law_and_moduli_have_a_wider_interval(
    made_with, fitted_with
):
    stated = {"damping_law": 1.0} if made_with != "rayleigh" else {"rayleigh_damping": 1.0}
    wrong = fitted_block(made_with, fitted_with, **stated)
    truth = BLOCK["gamma_r_s"]
    line = wrong.budget["gamma_r_s"]
    low, high = wrong.estimates["gamma_r_s"].statistical95
    assert not low < truth < high
    assert all(line.shares.get(name, 0.0) < 1e-9 for name in stated)
    assert set(stated) <= set(wrong.budget["young_pa"].shares)
    assert wrong.budget["young_pa"].combined95[0] < BLOCK["young_pa"]
    assert wrong.budget["young_pa"].combined95[1] > BLOCK["young_pa"]


@pytest.mark.long
def test_a_law_of_damping_that_is_known_is_no_source():
    """With the right law stated as known the statistical interval holds the truth."""
    right = fitted_block("material", "material")
    low, high = right.estimates["gamma_r_s"].statistical95
    assert low < BLOCK["gamma_r_s"] < high
    assert "damping_law" not in right.budget["gamma_r_s"].shares


def test_other_laws_of_damping_count_unless_the_law_is_known_and_rayleighs_only_if_stated():
    default = Assumptions().collect_deviations()
    assert default["damping_law"] == 1.0
    assert default["rayleigh_damping"] is None
    assert Assumptions(damping_law="none").collect_deviations()["damping_law"] is None


@pytest.mark.parametrize("stated", ["none", NOTHING])
def test_all_assumptions_are_exact_with_one_word(stated):
    options = UncertaintyOptions(assumptions=stated)
    assert options.assumptions == Assumptions.exact()


def test_a_problem_file_states_with_one_word_that_all_is_exact(tmp_path):
    file = write_problem(tmp_path, {"swing": 5})
    read = Problem.read(file, ['uncertainty.assumptions="none"'])
    assert read.uncertainty.assumptions == Assumptions.exact()
    with pytest.raises(InputError, match=r'found "exact"; expected a table, or "none"'):
        Problem.read(file, ['uncertainty.assumptions="exact"'])


def test_the_sentence_of_an_effect_has_the_size_that_the_data_need():
    """A clock is off by 3 ± 0.3 % in the data, and by 0 ± 0.01 % in the prior."""
    variance = 1 / (1e-4**-2 + 3e-3**-2)
    value, surprise = variance * 0.03 / 3e-3**2, 0.03 / np.hypot(1e-4, 3e-3)
    rate = EffectEstimate("clock_rate", 0.0, 1e-4, value, variance**0.5, surprise, needed=0.03)
    (concern,) = effect_concerns([rate])
    need = "the residuals need a clock rate of +3 %, where 0 ± 0.3 % is expected: 10.0 standard"
    assert concern.message.startswith(need)
