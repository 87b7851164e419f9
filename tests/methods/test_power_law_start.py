"""Starts of laws in powers of the stretches, from closed forms of specimens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.methods.starts.power_law import power_law_start

RUBBER = {"mu_1_pa": 3.2e5, "alpha_1": 2.0, "mu_2_pa": -4e4, "alpha_2": -2.0, "kappa_pa": 1e9}
FOAM = {
    "mu_1_pa": 20e3,
    "alpha_1": 8.0,
    "beta_1": 0.1,
    "mu_2_pa": 5e3,
    "alpha_2": -2.0,
    "beta_2": 0.1,
}
STILL = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
RUBBER_TESTS = (
    ("uniaxial", np.linspace(0.02, 2.0, 20)),
    ("equibiaxial", np.linspace(0.02, 1.0, 20)),
    ("planar", np.linspace(0.02, 1.5, 20)),
)
FOAM_TESTS = (
    ("uniaxial", np.linspace(0.0, -0.4, 20)),
    ("uniaxial", np.linspace(0.0, 0.3, 20)),
    ("simple-shear", np.linspace(0.0, 0.15, 10)),
)


def measured(
    law: str, truth: dict[str, float], tests, sigma_pa: float, seed: int = 0
) -> list[cs.Specimen]:
    """Simulated tests with noise, with the lateral stretch of the second one if it is free."""
    random = np.random.default_rng(seed)
    specimens = []
    for number, (test, strain) in enumerate(tests):
        lateral = np.ones_like(strain) if number == 1 else None
        exact = {"strain_zero": 0.0, "area_error": 0.0}
        blank = cs.Specimen(test, strain, 0 * strain, sigma_pa, lateral_stretch=lateral, **exact)
        values = cs.simulate(blank.experiment(law), truth | STILL).custom_sensor_values
        noise_pa = sigma_pa * random.standard_normal(len(strain))
        specimen = replace(blank, stress_pa=values[0].ravel() + noise_pa)
        if lateral is not None:
            noise = 5e-3 * random.standard_normal(len(strain))
            specimen = replace(specimen, lateral_stretch=values[1].ravel() + noise)
        specimens.append(specimen)
    return specimens


def without_guess(law: str, specimens: list[cs.Specimen], **stated) -> cs.Problem:
    experiments = [each.experiment(law, f"test {k}") for k, each in enumerate(specimens)]
    keys = [
        f"{key}_{p}{unit}"
        for p in range(1, 1 + int(law[-1]))
        for key, unit in (("mu", "_pa"), ("alpha", ""), ("beta", ""))
        if key != "beta" or law.startswith("hyperfoam")
    ]
    fixed = {} if law.startswith("hyperfoam") else {"kappa_pa": 1e9}
    return cs.Problem(experiments, dict.fromkeys(keys, cs.Unknown()) | fixed | STILL | stated)


def start_of(problem: cs.Problem):
    start = power_law_start(problem.collocation())
    assert start is not None
    return start, {item.name: item for item in start.collocation.parameters.components}


@pytest.mark.long
def test_two_terms_of_rubber_are_found_with_both_signs():
    problem = without_guess("ogden-2", measured("ogden-2", RUBBER, RUBBER_TESTS, 2e3))
    start, items = start_of(problem)
    assert start.note == ""
    for name, tolerance in (("mu_1_pa", 0.1), ("alpha_1", 0.1), ("mu_2_pa", 0.3), ("alpha_2", 0.1)):
        assert items[name].guess == pytest.approx(RUBBER[name], rel=tolerance)
    assert start.loss / 80 == pytest.approx(1.0, abs=0.4)


@pytest.mark.long
def test_terms_that_the_data_do_not_need_are_left_out():
    problem = without_guess("ogden-3", measured("ogden-2", RUBBER, RUBBER_TESTS, 2e3))
    start, items = start_of(problem)
    assert "2 of 3 terms" in start.note
    assert "μ₃ = 0" in start.note
    assert items["mu_3_pa"].is_fixed
    assert items["mu_3_pa"].guess == 0.0
    assert items["alpha_3"].is_fixed
    assert not items["mu_2_pa"].is_fixed


def test_a_stated_guess_asks_for_all_terms():
    specimens = measured("ogden-2", RUBBER, RUBBER_TESTS, 2e3)
    problem = without_guess("ogden-3", specimens, alpha_3=cs.Unknown(5.0))
    start, items = start_of(problem)
    assert start.note == ""
    assert not items["mu_3_pa"].is_fixed


@pytest.mark.long
def test_terms_of_a_foam_are_found_with_one_ratio_of_compressibility():
    specimens = measured("hyperfoam-2", FOAM, FOAM_TESTS, 100.0)
    start, items = start_of(without_guess("hyperfoam-2", specimens))
    assert "one β only" in start.note
    assert items["beta_2"].tied == cs.Tied("beta_1")
    assert items["mu_1_pa"].guess == pytest.approx(20e3, rel=0.1)
    assert items["alpha_1"].guess == pytest.approx(8.0, rel=0.05)
    assert items["alpha_2"].guess == pytest.approx(-2.0, abs=0.8)
    assert items["beta_1"].guess == pytest.approx(0.1, abs=0.03)


@pytest.mark.long
def test_intervals_of_two_terms_of_a_foam_contain_the_truth():
    held = []
    for seed in range(4):
        tests = measured("hyperfoam-2", FOAM, FOAM_TESTS, 100.0, seed)
        answer = cs.run(without_guess("hyperfoam-2", tests))
        assert answer.trust.verdict == "good"
        assert answer.uncertainty is not None
        assert answer.uncertainty.level.pooled == pytest.approx(1.0, abs=0.4)
        for name, truth in FOAM.items():
            low, high = answer.interval(name)
            held.append(low < truth < high)
            assert high - low < max(abs(truth), 1.0)
    assert np.mean(held) > 0.85  # of intervals of 95 %


def test_different_determined_ratios_of_compressibility_are_found():
    truth = FOAM | {"mu_2_pa": 2e4, "beta_1": 0.05, "beta_2": 1.5}
    tests = (*FOAM_TESTS, ("confined", np.linspace(0.0, -0.3, 15)))
    start, items = start_of(without_guess("hyperfoam-2", measured("hyperfoam-2", truth, tests, 20)))
    assert start.note == ""
    found = {items[f"alpha_{p}"].guess: items[f"beta_{p}"].guess for p in (1, 2)}
    assert found[max(found)] == pytest.approx(0.05, abs=0.1)
    assert found[min(found)] == pytest.approx(1.5, rel=0.2)


def test_a_single_term_may_have_a_negative_exponent():
    """As that of brain tissue; the factor is then negative too, so that both are a stiffness."""
    truth = {"mu_1_pa": -60.0, "alpha_1": -23.0, "kappa_pa": 1e6}
    strain = np.linspace(-0.09, 0.09, 19)
    stretch = 1 + strain
    stress_pa = -60.0 * (stretch**-23.0 - stretch**11.5) / stretch
    specimen = cs.Specimen("uniaxial", strain, stress_pa, 5.0)
    start, items = start_of(without_guess("ogden-1", [specimen], kappa_pa=1e6))
    assert items["alpha_1"].guess == pytest.approx(truth["alpha_1"], rel=0.02)
    assert items["mu_1_pa"].guess == pytest.approx(truth["mu_1_pa"], rel=0.1)
    assert items["mu_1_pa"].scale == "linear"
    assert start.young_pa == pytest.approx(3 * 690, rel=0.03)


@pytest.mark.parametrize("largest", [0.5, 0.6, 0.7, 0.8])
def test_of_two_signs_that_fit_alike_the_positive_one_counts(largest):
    """Of α and −α no planar test shows which, because the width keeps its stretch of one."""
    stretch = 1 + np.linspace(0.02, largest, 30)
    noise_pa = 1e3 * np.random.default_rng(0).normal(size=30)
    stress_pa = 1e5 * (stretch**2.3 - stretch**-4.3) + noise_pa
    specimen = cs.Specimen("planar", stretch - 1, stress_pa, 1e3)
    _, items = start_of(without_guess("ogden-1", [specimen], kappa_pa=1e9))
    assert items["alpha_1"].guess == pytest.approx(3.3, rel=0.05)
    assert items["mu_1_pa"].guess == pytest.approx(1e5, rel=0.1)


def test_terms_that_run_together_are_held_apart():
    """Large factors of opposite signs, whose exponents differ by a tenth."""
    tests = []
    for test, largest in (("uniaxial", 2.0), ("equibiaxial", 1.0), ("planar", 1.5)):
        strain = np.linspace(0.05, largest, 30)
        stretch = 1 + strain
        free = {"uniaxial": stretch**-0.5, "equibiaxial": stretch**-2, "planar": 1 / stretch}[test]
        stress_pa = 0.0
        for mu_pa, alpha in ((-29e3, 4.0), (30e3, 4.1)):
            stress_pa = stress_pa + mu_pa * (stretch**alpha - free**alpha) / stretch
        tests.append(cs.Specimen(test, strain, stress_pa, 300.0, strain_zero=0.0, area_error=0.0))
    start, items = start_of(without_guess("ogden-2", tests))
    assert "run together" in start.note
    assert not items["alpha_1"].is_fixed
    assert items["alpha_2"].is_fixed
    distance = items["alpha_1"].guess - items["alpha_2"].guess
    assert abs(distance) == pytest.approx(0.5, abs=0.01)


def test_terms_that_run_together_and_explain_little_are_left_out():
    """A ripple that no term explains is larger than what the second term explains."""
    tests = []
    for test, largest in (("uniaxial", 2.0), ("equibiaxial", 1.0), ("planar", 1.5)):
        strain = np.linspace(0.05, largest, 200)
        stretch = 1 + strain
        free = {"uniaxial": stretch**-0.5, "equibiaxial": stretch**-2, "planar": 1 / stretch}[test]
        stress_pa = 3e3 * np.sin(40 * strain)
        for mu_pa, alpha in ((-29e3, 4.0), (30e3, 4.1)):
            stress_pa = stress_pa + mu_pa * (stretch**alpha - free**alpha) / stretch
        tests.append(cs.Specimen(test, strain, stress_pa, 300.0, strain_zero=0.0, area_error=0.0))
    start, items = start_of(without_guess("ogden-2", tests))
    assert "1 of 2 terms" in start.note
    assert items["mu_2_pa"].is_fixed
    assert items["mu_2_pa"].guess == 0.0


def pull_of(stress_of, sigma_pa=500.0):
    """Uniaxial test whose stress is a function of the stretch."""
    strain = np.linspace(0.04, 1.95, 43)
    return cs.Specimen("uniaxial", strain, stress_of(1 + strain), sigma_pa)


@pytest.mark.parametrize("stated", [{}, {"alpha_1": cs.Unknown(2.0), "alpha_2": cs.Unknown(-2.0)}])
def test_a_law_that_fits_but_is_unstable_has_one_term_less(stated):
    """A term with μ α < 0 and a large exponent: the specimen does not resist a change of its section."""

    def stress_pa(stretch):
        terms = ((110e3, 3.2), (2.3e3, -10.4))
        return sum(mu * (stretch**a - stretch ** (-a / 2)) / stretch for mu, a in terms)

    problem = without_guess("ogden-2", [pull_of(stress_pa)], **stated)
    start, items = start_of(problem)
    assert "1 of 2 terms" in start.note
    assert "unstable" in start.note
    assert items["mu_2_pa"].is_fixed
    assert items["mu_2_pa"].guess == 0.0
    assert not items["alpha_1"].is_fixed


@pytest.mark.long
def test_a_law_whose_second_term_is_unstable_converges_with_one():
    def stress_pa(stretch):
        terms = ((110e3, 3.2), (2.3e3, -10.4))
        return sum(mu * (stretch**a - stretch ** (-a / 2)) / stretch for mu, a in terms)

    answer = cs.run(without_guess("ogden-2", [pull_of(stress_pa)]))
    assert answer.solution.status.converged
    assert answer.parameters["mu_2_pa"] == 0.0
    assert answer.trust.verdict == "doubtful"
    assert answer.trust.concerns[0].code == "specimen/law"


@pytest.mark.parametrize("has_guess", [False, True])
def test_two_terms_of_a_foam_that_run_together_without_fitting_are_one(has_guess):
    """A plateau and densification that no term has, in compression and tension."""
    random = np.random.default_rng(1)
    tests = []
    for strain in (np.linspace(-0.02, -0.6, 60), np.linspace(0.02, 0.6, 60)):
        size = np.abs(strain)
        dense = np.maximum(-strain - 0.25, 0.0) ** 2
        stress_pa = 6e4 * np.tanh(size / 0.04) + 5e5 * size + 5e6 * dense
        noise_pa = 2e3 * random.standard_normal(len(strain))
        tests.append(cs.Specimen("uniaxial", strain, np.sign(strain) * stress_pa + noise_pa, 5e3))
    stated = {"alpha_1": cs.Unknown(4.0)} if has_guess else {}
    _, items = start_of(without_guess("hyperfoam-2", tests, **stated))
    terms = {p: (items[f"mu_{p}_pa"].guess, items[f"alpha_{p}"].guess) for p in (1, 2)}
    assert terms[2][0] == 0.0 or abs(terms[1][1] - terms[2][1]) > 1.0


def test_specimens_of_other_laws_have_no_closed_start():
    strain = np.linspace(0.0, 0.5, 10)
    specimen = cs.Specimen("uniaxial", strain, 1e5 * strain, 100.0)
    parameters = {"young_pa": cs.Unknown(), "poisson": 0.499} | STILL
    problem = cs.Problem([specimen.experiment("neo-hookean")], parameters)
    assert power_law_start(problem.collocation()) is None


@pytest.mark.long
def test_a_law_with_too_many_terms_converges_without_a_guess():
    solution = cs.solve(without_guess("ogden-3", measured("ogden-2", RUBBER, RUBBER_TESTS, 2e3)))
    assert solution.status.converged
    assert solution.parameters["alpha_1"] == pytest.approx(2.0, abs=0.1)
    assert solution.parameters["mu_3_pa"] == 0.0
    assert any("2 of 3 terms" in note for note in solution.notes)


def test_a_recording_for_validation_does_not_change_the_start():
    rubber = measured("ogden-2", RUBBER, RUBBER_TESTS[:2], 2e3)
    alone, _ = start_of(without_guess("ogden-1", rubber[:1]))
    problem = without_guess("ogden-1", rubber)
    tested = replace(problem.experiments[1], validation=True)
    beside, _ = start_of(replace(problem, experiments=[problem.experiments[0], tested]))
    assert beside.loss == alone.loss
    assert beside.collocation.parameters.guesses == alone.collocation.parameters.guesses


@pytest.mark.long
def test_three_terms_of_treloars_rubber_leave_little_in_tension():
    """The start ended at a worse minimum where only the first exponent had wider bounds."""
    keys = [f"{key}_{p}{unit}" for p in (1, 2, 3) for key, unit in (("mu", "_pa"), ("alpha", ""))]
    unknown = dict.fromkeys(keys, cs.Unknown()) | {"kappa_pa": 1e9} | STILL
    solution = cs.solve(cs.Problem(cs.datasets.treloar_1944("ogden-3"), unknown))
    assert solution.status.converged
    assert solution.history[-1].loss < 105
