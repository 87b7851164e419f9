"""Verdicts: correct answers are good, and hidden faults are found."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from kit.fits import PARAMETERS, autoregressive, problem
from kit.problem_files import run_command, settings, write_problem
from scipy.stats import chi2
from twins import BODIES, NOISE_M, SOFT, twin
from wrong_twins import FAULTS

import collocation_sysid as cs
from collocation_sysid import Run, UncertaintyOptions, run
from collocation_sysid.common.display import plain_text
from collocation_sysid.common.serialisation import as_json, content, read
from collocation_sysid.methods.solution import Status
from collocation_sysid.problem import Problem
from collocation_sysid.recording.nuisance import GRASP_TURN, IMAGE_TIME
from collocation_sysid.result.run_sections import remedy_command
from collocation_sysid.result.run_summary import run_summary
from collocation_sysid.statistics.assessment import (
    GROSS_MISFIT,
    MISFIT,
    Assessment,
    InstrumentMisfit,
    fit_concerns,
    forward_simulation_concerns,
    nuisance_concerns,
    parameter_concerns,
    rms_expected_from_noise_m,
    scheme_concerns,
    validation_concerns,
)
from collocation_sysid.statistics.budget.systematic_effects import Assumptions
from collocation_sysid.statistics.concerns import TOPICS, Concern, topics_of
from collocation_sysid.statistics.estimates import correlation_notes
from collocation_sysid.statistics.hypothesis import Hypothesis
from collocation_sysid.statistics.residuals.autocorrelation import Dependence
from collocation_sysid.statistics.uncertainty import uncertainty_from_fit

RNG = np.random.default_rng
PACKAGE = Path(__file__).parents[2] / "collocation_sysid"
TRUST_PAGE = Path(__file__).parents[2] / "docs" / "howto" / "trust.md"
FOAM_CYLINDER = Path(__file__).parents[2] / "problems" / "foam_cylinder" / "problem.toml"
# Of λ = 800 Pa and μ = 600 Pa, with which its tracks were made.
EXACT = UncertaintyOptions(assumptions=Assumptions.exact())
FOAM_YOUNG_PA = 600 * (3 * 800 + 2 * 600) / (800 + 600)
OF = problem((80,), markers=3)


def slow(*values):
    """A whole run of which a like one is done every time."""
    return pytest.param(*values, marks=pytest.mark.slow)


def verdict_of_fit(errors: np.ndarray) -> Assessment:
    fit, wrong = OF.fit([errors], np.zeros(len(OF.names)))
    found = uncertainty_from_fit(fit, PARAMETERS, wrong[:4])
    return Assessment.from_concerns(fit_concerns(found) + parameter_concerns(found))


# The verdict of single findings


def test_the_gravest_concern_gives_the_verdict():
    light, grave = (Concern("solve/acceptable"), Concern("solve/no-error-bars", "doubtful"))
    assert Assessment.from_concerns([]).verdict == "good"
    assert Assessment.from_concerns([light, light]) == Assessment((light,))
    assert Assessment.from_concerns([light, grave]) == Assessment((grave, light))
    assert (Assessment((light,)).verdict, Assessment((grave, light)).verdict) == (
        "check",
        "doubtful",
    )


def test_a_concern_keeps_its_code_and_its_numbers_in_files():
    found = Assessment.from_concerns(nuisance_concerns(["time"], [4.0], [-9.0], [9.0]))
    stored = json.loads(as_json(found))
    (reason,) = stored["reasons"]
    assert reason.startswith(
        "time is 4.0 standard deviations of its prior away from zero: check mesh, places"
    )
    (concern,) = stored["concerns"]
    assert concern["code"] == "nuisance/far"
    assert concern["data"] == {"name": "time", "deviations": 4.0}
    assert read(Assessment, stored) == found


def test_every_code_that_gives_concern_has_a_sentence_and_a_remedy():
    sources = "".join(file.read_text() for file in PACKAGE.rglob("*.py"))
    codes = re.findall(rf'"((?:{"|".join(TOPICS)})/[a-z/-]+)"', sources)
    assert len(codes) > 30
    for code in codes:
        topic, _, rest = code.partition("/")
        assert rest in TOPICS[topic].messages, code
        assert TOPICS[topic].remedy


def test_white_residuals_of_the_stated_size_are_good():
    found = [verdict_of_fit(RNG(seed).normal(size=(80, 3, 3))).verdict for seed in range(80)]
    assert found.count("good") >= 79


@pytest.mark.parametrize(
    ("factors", "words"),
    [
        ([2.5, 2.5, 2.5], "times as large as expected from sigma_m"),
        ([0.3, 0.3, 0.3], "times too large"),
        ([4.0, 1.0, 1.0], "the residuals of swing 0/m0 are"),
    ],
)
def test_a_wrong_sigma_is_to_be_checked(factors, words):
    for seed in range(5):
        errors = np.array(factors)[:, None] * RNG(seed).normal(size=(80, 3, 3))
        found = verdict_of_fit(errors)
        assert found.verdict == "check"
        assert any(words in reason for reason in found.reasons)


@pytest.mark.parametrize(("samples", "offsets"), [((1, 1), True), ((2,), False)])
@pytest.mark.parametrize(("share", "verdict"), [(0.9, "good"), (1.1, "check")])
def test_chi_squared_beyond_its_99_percent_limit_is_to_be_checked(samples, offsets, share, verdict):
    """Also of hardly more measurements than parameters."""
    few = problem(samples, markers=1, offsets=offsets)
    rng = RNG(1)
    errors = [rng.normal(size=(count, 1, 3)) for count in samples]

    def found(size):
        fit, _ = few.fit([size * each for each in errors], np.zeros(len(few.names)))
        return uncertainty_from_fit(fit, PARAMETERS, np.zeros(4))

    freedom = max(1.0, found(1.0).degrees_of_freedom)
    limit = chi2.isf(0.01, freedom) / freedom
    size = np.sqrt(share * limit / found(1.0).reduced_chi_squared)
    judged = Assessment.from_concerns(fit_concerns(found(size)))
    assert judged.verdict == verdict


def test_persistent_residuals_are_to_be_checked_and_gross_ones_doubtful():
    for seed in range(5):
        errors = autoregressive(RNG(seed), 80, 3, 0.8)
        found = verdict_of_fit(1.2 * errors)
        assert found.verdict == "check"
        assert "consecutive samples are correlated" in found.reasons[0]
        assert verdict_of_fit(5 * errors).verdict == "doubtful"
        assert verdict_of_fit(0.02 * errors).verdict != "doubtful"


def test_the_page_states_the_threshold_of_doubtful_residuals_that_the_code_uses():
    words = re.sub(r"\s+", " ", TRUST_PAGE.read_text(encoding="utf-8"))
    (check, doubtful) = re.findall(r"more than ([\d.]+) times `sigma_m`", words)
    assert (float(check), float(doubtful)) == (MISFIT, GROSS_MISFIT)
    for seed in range(3):
        errors = autoregressive(RNG(seed), 80, 3, 0.97)
        (larger,) = (c for c in verdict_of_fit(20 * errors).concerns if c.code == "noise/larger")
        unit = float(doubtful) / (larger.data["factor"] / 20)
        below, above = (verdict_of_fit(f * unit * errors) for f in (0.9, 1.1))
        assert (below.verdict, above.verdict) == ("check", "doubtful")
        (persistent,) = (c for c in below.concerns if c.code == "residuals/persist")
        assert persistent.data["autocorrelation"] > 0.9


def test_gross_residuals_of_single_samples_are_doubtful():
    """Nothing tells whether they are noise."""
    singles = problem((1,) * 8, markers=4, offsets=False)
    for size, verdict in ((1.0, "good"), (50.0, "doubtful")):
        errors = [size * RNG(k).normal(size=(1, 4, 3)) for k in range(8)]
        fit, _ = singles.fit(errors, np.zeros(len(singles.names)))
        found = uncertainty_from_fit(fit, PARAMETERS, np.zeros(4))
        assert np.isfinite(found.dependence.lag1)
        assert Assessment.from_concerns(fit_concerns(found)).verdict == verdict


@pytest.mark.parametrize(("lag1", "grade"), [(0.95, "doubtful"), (0.5, "check"), (-0.2, "check")])
def test_gross_residuals_of_few_samples_are_doubtful_if_clearly_correlated(lag1, grade):
    """A test at the level of the others cannot find a correlation of so few samples."""
    fit, _ = OF.fit([6 * RNG(0).normal(size=(80, 3, 3))], np.zeros(len(OF.names)))
    found = uncertainty_from_fit(fit, PARAMETERS, np.zeros(4))
    few_samples = Dependence(lag1, lag1_deviation=0.4, shared_p=1.0)
    (larger,) = (
        each
        for each in fit_concerns(replace(found, dependence=few_samples, unexplained=few_samples))
        if each.code == "noise/larger"
    )
    assert larger.grade == grade


def test_the_note_on_a_slight_correlation_does_not_contradict_a_good_verdict():
    slight, strong = (Dependence(lag1, lag1_deviation=0.01, shared_p=1.0) for lag1 in (0.08, 0.4))
    (note,) = correlation_notes("auto", "autocorrelated", slight, unexplained=slight)
    assert "slightly correlated" in note
    assert "may lack a small effect" in note
    (note,) = correlation_notes("auto", "autocorrelated", strong, unexplained=strong)
    assert "lacks an effect" in note
    fit, _ = OF.fit([RNG(0).normal(size=(80, 3, 3))], np.zeros(len(OF.names)))
    found = uncertainty_from_fit(fit, PARAMETERS, np.zeros(4))
    assert not fit_concerns(replace(found, dependence=slight, unexplained=slight))


def test_the_remedy_of_an_unknown_of_a_specimen_is_on_the_page_of_specimens():
    (found,) = nuisance_concerns(["offset of the strain"], [3.0], [-9.0], [9.0], is_specimen=True)
    assert (found.code, found.grade) == ("specimen/far", "check")
    (topic,) = topics_of([found]).values()
    assert topic.page == "specimen"
    assert "strain_zero" in topic.remedy


def test_a_specimen_whose_strain_is_off_is_explained_on_its_page():
    stretch = np.linspace(1.02, 1.5, 25)
    stress_pa = 1e5 * (stretch - stretch**-2)
    pull = cs.Specimen("uniaxial", stretch - 1 + 0.02, stress_pa, sigma_pa=200.0).experiment(
        "neo-hookean", "pull"
    )
    known = {"kappa_pa": 1e9, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    found = cs.run(cs.Problem([pull], {"mu_pa": cs.Unknown(1e5), **known}), seek_causes=False)
    assert found.trust.verdict != "good"
    assert "explain specimen" in plain_text(remedy_command(found.trust.concerns))


def test_nuisance_parameters_far_from_their_prior():
    many = [f"n{k}" for k in range(100)]
    nowhere, infinite = np.zeros(100), np.full(100, np.inf)
    assert not nuisance_concerns(many, nowhere, -infinite, infinite)
    # The limit is 3.9 for a hundred parameters and 2.6 for one; of "doubtful" 4.9 and 3.9.
    assert not nuisance_concerns(many, nowhere + 3.5, -infinite, infinite)
    assert not nuisance_concerns(["time"], [2.5], [-9.0], [9.0])
    for phi in (2.7, 3.8):
        (found,) = nuisance_concerns(["time"], [phi], [-9.0], [9.0])
        assert (found.code, found.grade) == ("nuisance/far", "check")
    for phi, low, high in ((-4.0, -9.0, 9.0), (2.0, -2.0, 2.0), (2.0, 2.0, 6.0)):
        (found,) = nuisance_concerns(["time"], [phi], [low], [high])
        assert found.grade == "doubtful"


def test_a_parameter_that_the_data_hardly_see_is_compared_with_what_they_leave_of_its_prior():
    """A tilt of three and a half deviations, of which the data see half of the variance."""
    walls = [-np.inf], [np.inf]
    assert nuisance_concerns(["tilt"], [3.5], *walls)[0].grade == "check"
    assert nuisance_concerns(["tilt"], [3.5], *walls, expected=[0.7])[0].grade == "doubtful"
    assert not nuisance_concerns(["tilt"], [2.5], *walls, expected=[0.7])


def off(sigmas: float, count: int = 1000) -> InstrumentMisfit:
    return InstrumentMisfit("stress", "its sigma", sigmas, sigmas, count)


def test_a_turn_that_no_grasp_has_is_no_reason_to_widen_its_prior():
    names = [f"turn in the grasp, {axis} [rad]" for axis in "xyz"]
    walls = [-np.inf] * 3, [np.inf] * 3
    given = {"rows": [GRASP_TURN] * 3, "scales": [GRASP_TURN.sigma] * 3}
    (found,) = nuisance_concerns(names, [8.0, 21.4, 7.0], *walls, **given)
    assert found.code == "nuisance/large"
    assert "y [rad]" in found.message
    assert "(11°)" in found.message
    assert "compare-models" in found.message
    assert "do not widen" in found.message
    (found,) = nuisance_concerns(names, [0.0, 5.0, 0.0], *walls, **given)
    assert found.code == "nuisance/sized"
    assert found.message.index("compare laws") < found.message.index("widen")


def test_the_prior_of_a_late_camera_is_widened_where_it_is_stated():
    given = {"rows": [IMAGE_TIME], "scales": [5e-3]}
    (found,) = nuisance_concerns(["delay of front [s]"], [4.0], [-np.inf], [np.inf], **given)
    assert "clock_sigma_s" in found.message
    assert "[experiment.nuisance]" not in found.message


def test_a_roll_out_is_measured_by_the_fit_and_the_noise():
    assert not forward_simulation_concerns("a", off(1.05), off(1.0))
    assert not forward_simulation_concerns("a", off(0.1), off(0.001))  # far below the noise
    found = [forward_simulation_concerns("a", off(sigmas), off(1.0))[0] for sigmas in (1.5, 4.0)]
    assert [each.grade for each in found] == ["check", "doubtful"]
    assert "from stress by 1.5 times its sigma" in found[0].message


def test_a_validation_is_measured_by_the_fits_and_the_noise():
    assert not validation_concerns("a", off(2.0), level=0.1, deviations={})
    assert not validation_concerns("a", off(8.0), level=4.0, deviations={})
    assert not validation_concerns("a", off(3.5, count=1), level=1.0, deviations={})  # chance
    deviations = {"area": -66.0, "zero": 1.0}
    found = [
        validation_concerns("a", off(s), level=1.0, deviations=deviations)[0] for s in (4.0, 20.0)
    ]
    assert [each.grade for each in found] == ["check", "doubtful"]
    assert "'area' would take -66 standard deviations" in found[0].message
    (plain,) = validation_concerns("a", off(4.0), level=1.0, deviations={"area": -1.0})
    assert "area" not in plain.message


def test_a_scheme_that_damps_or_slows_is_a_concern():
    assert not scheme_concerns("a", 0.05, 0.0, 0.01)
    (damped,) = scheme_concerns("a", 0.05, 0.02, 0.0)
    assert damped.grade == "check"
    assert "0.02 to the 0.05" in damped.message
    assert scheme_concerns("a", 0.05, 0.06, 0.0)[0].grade == "doubtful"
    assert scheme_concerns("a", 0.05, 0.0, -0.05)[0].grade == "check"


def test_expected_residuals_of_noise_alone():
    assert rms_expected_from_noise_m(
        np.array([1e-3]), np.array([100.0]), np.array([300.0]), 0
    ) == pytest.approx(1e-3 * np.sqrt(3))
    fewer = rms_expected_from_noise_m(
        np.array([1e-3, 2e-3]), np.array([50.0, 50.0]), np.array([150.0, 150.0]), 30.0
    )
    assert fewer == pytest.approx(1e-3 * np.sqrt(3 * 2.5 * 0.9))


# Whole runs


@cache
def judged(fault: str, seed: int = 100) -> Run:
    problem = twin(list(BODIES)[seed % len(BODIES)], SOFT, seed)
    if fault != "none":
        problem = FAULTS[fault](problem, RNG(seed))
    # With one step a sample the scheme itself is a reason to check.
    problem = replace(problem, substeps=2, uncertainty=EXACT)
    return run(problem, "reduced-space")


@pytest.mark.long
@pytest.mark.parametrize("seed", [100, slow(101)])
def test_faultless_twins_are_good(seed):
    found = judged("none", seed)
    assert found.trust == Assessment(())
    assert found.noise_rms_m == pytest.approx(found.solution.rms_m, rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize("fault", ["gravity", slow("clock 100 ms late"), "markers exchanged"])
def test_faults_that_spoil_the_answer_are_doubtful(fault):
    found = judged(fault)
    assert found.trust.verdict == "doubtful"
    assert found.causes[0].cause in FAULTS[fault].causes


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["clock 30 ms late", "grasp one layer deeper"])
def test_no_hidden_fault_is_good(fault):
    assert judged(fault).trust.verdict != "good"


@pytest.mark.long
@pytest.mark.parametrize(("factor", "words"), [slow(0.3, "as large as"), (3.0, "too large")])
def test_a_wrong_sigma_of_a_whole_run_is_to_be_checked(factor, words):
    problem = twin("block", SOFT, 100)
    (experiment,) = problem.experiments
    claimed = replace(experiment.markers, sigma_m=factor * experiment.markers.sigma_m)
    stated = replace(experiment, markers=claimed)
    stated = replace(problem, experiments=[stated], substeps=2)
    found = run(stated, "reduced-space")
    assert found.trust.verdict == "check"
    assert words in found.trust.reasons[0]
    assert found.uncertainty is not None
    assert found.uncertainty.noise == "estimated"
    said = [diagnosis.sentence for diagnosis in found.diagnoses]
    assert not any("consistent with noise" in sentence for sentence in said)


@pytest.mark.parametrize(("substeps", "verdict"), [(1, "check"), slow(2, "good")])
def test_a_step_that_dominates_the_error_bars_is_corrected_and_to_be_checked(substeps, verdict):
    problem = replace(Problem.read(FOAM_CYLINDER), substeps=substeps, uncertainty=EXACT)
    found = run(problem, "reduced-space")
    low, high = found.interval("young_pa")
    assert low < FOAM_YOUNG_PA < high
    off = abs(found.estimates["young_pa"].value - FOAM_YOUNG_PA)
    assert off < 0.5 * abs(found.estimates["young_pa"].optimum - FOAM_YOUNG_PA)
    assert found.trust.verdict == verdict


@pytest.mark.long
def test_the_verdict_is_shown_stored_and_fed():
    found = judged("none")
    assert ", good: " in repr(found)
    assert content(found.result)["trust"] == {"verdict": "good", "reasons": [], "concerns": []}
    assert plain_text(run_summary(found.result, Path("runs"))).startswith("Verdict: good\n")
    lines = plain_text(run_summary(found.result, Path("runs"), details=True)).splitlines()
    assert "γ_r refers to the damping law rayleigh, which also damps rigid rotation" in lines
    (markers,) = [line for line in lines if line.startswith("markers: ")]
    assert "mm expected from noise alone" in markers
    noise_mm = float(markers.partition("RMS, ")[2].partition(" mm")[0])
    assert noise_mm == pytest.approx(1e3 * np.sqrt(3) * NOISE_M, rel=0.1)
    caused = replace(found, causes=(Hypothesis("sensor-sign", "the wrench", strength=9.0),))
    assert caused.trust.verdict == "doubtful"
    assert caused.trust.reasons[0].startswith(
        "likely: the wrench: its values fit with the opposite sign"
    )


def test_an_answer_that_did_not_converge_is_doubtful():
    found = judged("none")
    lost = replace(found, solution=replace(found.solution, status=Status.STALLED))
    assert lost.trust.verdict == "doubtful"
    assert "did not converge" in lost.trust.reasons[0]


@pytest.mark.long
def test_strict_fails_where_the_verdict_is_doubtful(tmp_path):
    file = write_problem(tmp_path, {"swing": 25})
    precise = "experiment.swing.markers.sigma_m=2e-4"
    method = settings("solver.method=reduced-space", "transcription.scheme=midpoint", precise)
    wrong = settings("experiment.swing.gravity_m_s2=[0.0, -9.81, 0.0]")
    out = ("--out", tmp_path / "run")
    assert run_command("solve", file, *method, "--strict", *out).code == 0
    lax = run_command("solve", file, *method, *wrong, *out)
    strict = run_command("solve", file, *method, *wrong, "--strict", *out)
    assert "Verdict: doubtful" in lax.out
    assert (lax.code, strict.code) == (0, 1)
    assert run_command("report", tmp_path / "run").code == 0
    page = (tmp_path / "run" / "report.html").read_text()
    assert '<div class="verdict doubtful">' in page
    stored = json.loads((tmp_path / "run" / "result.json").read_text())
    assert stored["trust"]["reasons"]
