"""Mistakes in the description of specimens are named only where the correction explains the data.

The cases without a mistake are those in which a correction decreases the misfit although the cause
is another: a law that is too simple, a toe region, and an unloading branch. That mistakes are found
is tested in tests/recording/test_specimen.py.
"""

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.kinds.specimen.concerns import as_specimen_concerns
from collocation_sysid.kinds.specimen.doubts import likely_mistakes
from collocation_sysid.methods.solution import Status
from collocation_sysid.recording.specimen_checks import order_warnings
from collocation_sysid.statistics.concerns import Concern

FIXED = {"kappa_pa": 1e9, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
LAWS = {
    "neo-hookean": ("mu_pa",),
    "mooney-rivlin": ("c10_pa", "c01_pa"),
    "yeoh": ("c10_pa", "c20_pa", "c30_pa"),
}
SIGMA_PA = 500.0
STRAIN = np.linspace(0.02, 0.5, 25)
# Stretch and engineering stress [MPa] of rubber in uniaxial tension, every second row (Treloar
# 1944).
TRELOAR = np.array(
    [
        (1.1267, 0.126771),
        (1.3946, 0.312342),
        (1.8861, 0.500561),
        (2.4165, 0.665391),
        (3.5696, 1.04205),
        (4.7573, 1.58522),
        (5.7558, 2.29225),
        (6.4093, 3.0246),
        (6.8789, 3.75201),
        (7.1765, 4.46749),
        (7.4509, 5.2134),
        (7.629, 6.30148),
    ]
)


def neo_hookean_pa(strain):
    """Engineering stress of an incompressible neo-Hookean solid with a shear modulus of 100 kPa."""
    stretch = 1 + strain
    return 1e5 * (stretch - stretch**-2)


def causes_of(strain, stress_pa, sigma_pa, law):
    """Run of a uniaxial test with one law, and the codes of its causes."""
    test = cs.Specimen("uniaxial", strain, stress_pa, sigma_pa)
    unknown = {name: cs.Unknown() for name in LAWS[law]}
    run = cs.run(cs.Problem([test.experiment(law, "pull")], unknown | FIXED))
    return run, [each.cause for each in run.causes]


def test_likely_mistakes_of_a_specimen_correct_the_data():
    pull = cs.Specimen("uniaxial", 10 * STRAIN, neo_hookean_pa(STRAIN), SIGMA_PA).experiment()
    rows = {row.name: row for row in likely_mistakes(pull, ())}
    corrected = {name: row.correct(pull, np.ones(1)) for name, row in rows.items()}
    ratios, data = corrected["specimen-percent"]
    assert data == {}
    for other, stated in zip(ratios.grasps, pull.grasps, strict=True):
        np.testing.assert_allclose(other.poses.positions_m, 0.01 * stated.poses.positions_m)
    assert corrected["specimen-compression"] is None


@pytest.mark.parametrize("law", ["neo-hookean", pytest.param("yeoh", marks=pytest.mark.long)])
def test_a_law_that_is_too_simple_is_no_mistake_of_the_description(law):
    run, causes = causes_of(TRELOAR[:, 0] - 1, 1e6 * TRELOAR[:, 1], sigma_pa=1e4, law=law)
    assert run.solution.status is Status.CONVERGED
    assert causes == []


@pytest.mark.long
@pytest.mark.parametrize("law", ["mooney-rivlin", "yeoh"])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_toe_region_is_no_mistake_of_the_description(law, seed):
    noise_pa = SIGMA_PA * np.random.default_rng((seed, 3)).normal(size=25)
    straightened = STRAIN - 0.03 * (1 - np.exp(-STRAIN / 0.03))
    stress_pa = neo_hookean_pa(straightened) + noise_pa
    assert causes_of(STRAIN, stress_pa, sigma_pa=SIGMA_PA, law=law)[1] == []


@pytest.mark.parametrize("law", ["mooney-rivlin", pytest.param("yeoh", marks=pytest.mark.long)])
def test_unloading_is_no_mistake_of_the_description(law):
    noise_pa = SIGMA_PA * np.random.default_rng((1, 3)).normal(size=25)
    strain = STRAIN[::-1]
    stress_pa = neo_hookean_pa(strain) * (0.6 + 0.8 * strain) + noise_pa
    assert causes_of(strain, stress_pa, sigma_pa=SIGMA_PA, law=law)[1] == []
    test = cs.Specimen("uniaxial", strain, stress_pa, SIGMA_PA)
    assert "only unloading" in "".join(order_warnings(test))


def test_the_noise_of_a_stress_is_corrected_with_it():
    """Else a correction to smaller stresses fits better than the truth."""
    pull = cs.Specimen("planar", STRAIN, neo_hookean_pa(STRAIN), SIGMA_PA).experiment()
    rows = {row.name: row for row in likely_mistakes(pull, ())}
    corrected, _ = rows["specimen-true-stress"].correct(pull, np.ones(1))
    ratios = [
        each.readings[0].measured_values / each.readings[0].sample_sigmas
        for each in (corrected, pull)
    ]
    np.testing.assert_allclose(*ratios)


def test_nothing_is_named_after_a_search_that_did_not_converge():
    test = cs.Specimen("uniaxial", STRAIN, neo_hookean_pa(STRAIN) * (1 + STRAIN), SIGMA_PA)
    problem = cs.Problem(
        [test.experiment("neo-hookean", "pull")],
        {"mu_pa": cs.Unknown(3e4)} | FIXED,
        method=cs.ReducedSpace(max_iterations=1),
    )
    run = cs.run(problem)
    assert not run.solution.status.converged
    assert not run.causes


@pytest.mark.parametrize(
    ("largest", "young_pa", "sigma_pa"), [(0.3, 3e5, 1.0), (0.4, 3e5, 3.0), (0.5, 3e5, 10.0)]
)
def test_a_search_with_positive_signs_of_compression_ends(largest, young_pa, sigma_pa):
    """A stiff material, and hardly an area, fit less badly than rubber does."""
    strain = np.linspace(0.05, 1, 20) * largest
    stress_pa = -young_pa / 3 * (1 - strain - (1 - strain) ** -2)
    noise_pa = sigma_pa * np.random.default_rng(0).normal(size=20)
    press = cs.Specimen("uniaxial", strain, stress_pa + noise_pa, sigma_pa).experiment(name="press")
    solution = cs.solve(cs.Problem([press], {"mu_pa": cs.Unknown()} | FIXED))
    assert solution.status.converged
    assert solution.history[-1].number < 100


# Kinds of test, zeros, and all data ---------------------------------------------------------------


def causes_of_test(test, unknown, **measured):
    """Causes of a fit of one test with a neo-Hookean law."""
    keys = {"lateral_sigma": 5e-4} if "lateral_stretch" in measured else {}
    specimen = cs.Specimen(test, STRAIN, sigma_pa=SIGMA_PA, **measured, **keys)
    return cs.run(cs.Problem([specimen.experiment(name="pull")], unknown)).causes


@pytest.mark.long
@pytest.mark.parametrize(
    ("declared", "true", "stress_pa"),
    [
        ("planar", "simple-shear", 1e5 * STRAIN),
        ("uniaxial", "equibiaxial", 1e5 * (1 + STRAIN - (1 + STRAIN) ** -5)),
        ("simple-shear", "planar", 1e5 * (1 + STRAIN - (1 + STRAIN) ** -3)),
    ],
)
def test_another_kind_of_test_is_named(declared, true, stress_pa):
    noise_pa = SIGMA_PA * np.random.default_rng(5).normal(size=25)
    unknown = {"mu_pa": cs.Unknown()} | FIXED
    causes = causes_of_test(declared, unknown, stress_pa=stress_pa + noise_pa)
    # A true stress explains the curve of simple shear too.
    (cause,) = causes
    assert cause.code == ("several" if true == "simple-shear" else "specimen-kind")
    assert f"that of a {true} test" in cause.message


@pytest.mark.long
def test_a_hypothesis_keeps_contradicting_lateral_stretches():
    """An auxetic foam in tension, with a stated positive Poisson's ratio, is no compression test."""
    rng = np.random.default_rng(5)
    young_pa, poisson = 1e5, -0.4
    strain = np.linspace(0.01, 0.1, 25)
    lateral = 1 - poisson * strain + 5e-4 * rng.normal(size=25)
    specimen = cs.Specimen(
        "uniaxial",
        strain,
        young_pa * strain + 50 * rng.normal(size=25),
        50.0,
        lateral_stretch=lateral,
        lateral_sigma=5e-4,
    )
    fixed = {"poisson": 0.3, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    problem = cs.Problem(
        [specimen.experiment("neo-hookean", "pull")], {"young_pa": cs.Unknown()} | fixed
    )
    causes = [each.cause for each in cs.run(problem).causes]
    assert "specimen-compression" not in causes


@pytest.mark.long
@pytest.mark.parametrize(
    ("test", "power", "measured", "quantity"),
    [
        ("uniaxial", 2, {"lateral_stretch": 1 + 0 * STRAIN}, "lateral strain"),
        ("planar", 3, {"second_stress_pa": 0 * STRAIN}, "second stress"),
    ],
)
def test_a_column_of_zeros_is_named_as_a_placeholder(test, power, measured, quantity):
    noise_pa = SIGMA_PA * np.random.default_rng(5).normal(size=25)
    stress_pa = 1e5 * (1 + STRAIN - (1 + STRAIN) ** -power) + noise_pa
    unknown = {"mu_pa": cs.Unknown()} | FIXED
    causes = causes_of_test(test, unknown, stress_pa=stress_pa, **measured)
    assert causes[0].cause == "specimen-placeholder"
    assert f"its {quantity} is zero in all rows" in causes[0].message


# Words --------------------------------------------------------------------------------------------


def test_residuals_of_a_simple_law_name_the_law_first():
    run, _ = causes_of(TRELOAR[:, 0] - 1, 1e6 * TRELOAR[:, 1], sigma_pa=1e4, law="neo-hookean")
    first = run.trust.concerns[0]
    assert first.code == "specimen/law"
    assert "the law neo-hookean may be too simple" in first.message
    assert "stretches of 1.13 to 7.63" in first.message
    assert "compare-models FILE --materials neo-hookean," in first.message
    text = str(run)
    for word in ("reference_m", "motion", "move the body", "marker"):
        assert not any(word in reason for reason in run.trust.reasons), word
    assert "move the body" not in text


def test_residuals_of_a_law_with_memory_name_the_number_of_branches_first():
    larger = [Concern("noise/larger", data={"factor": 9.0, "stated": "sigma"})]
    test = cs.Specimen("uniaxial", STRAIN, neo_hookean_pa(STRAIN), SIGMA_PA)
    (concern,) = as_specimen_concerns(larger, [test.experiment(prony=("a",))], False)
    assert "compare-models FILE --prony 1,2 and then --materials neo-hookean," in concern.message


def test_a_curve_that_returns_names_unloading_in_place_of_the_law():
    larger = [Concern("noise/larger", data={"factor": 9.0, "stated": "sigma"})]
    up_and_down = np.concatenate([STRAIN, STRAIN[-2::-1]])
    named = {}
    for name, strain in {
        "loading": STRAIN,
        "returns": up_and_down,
        "both signs": np.concatenate([-STRAIN[::-1] / 2, STRAIN]),
    }.items():
        test = cs.Specimen("uniaxial", strain, neo_hookean_pa(strain), SIGMA_PA)
        (concern,) = as_specimen_concerns(larger, [test.experiment(name="pull")], False)
        named[name] = 'branch = "loading"' in concern.message
    assert named == {"loading": False, "returns": True, "both signs": False}


def test_concerns_of_specimens_name_no_markers():
    test = cs.Specimen("planar", STRAIN, 1e5 * STRAIN, SIGMA_PA)
    data = {"marker": "planar/second stress", "factor": 4.0, "count": 2}
    general = [
        Concern("information/none", data={"names": ["c10_pa"]}),
        Concern("noise/sensor", data=data),
        Concern("noise/sensors", data=data),
        Concern("noise/larger", data={"factor": 2.0, "stated": "sigma"}),
        Concern("noise/smaller", data={"factor": 2.0, "stated": "sigma"}),
        Concern("residuals/persist", data={"autocorrelation": 0.9}),
    ]
    concerns = as_specimen_concerns(general, [test.experiment(name="pull")], False)
    assert concerns[0].code == "specimen/law"
    text = " ".join(each.message for each in concerns)
    assert "sigma_pa seems 2 times too large" in text
    for word in ("marker", "reference_m", "sigma_m", "motion", "over time"):
        assert word not in text


# Curves that fit with several kinds of test ---------------------------------------------------------


def sheared_pa(gamma):
    """Shear stress of Ogden's law with one term, 30 kPa and the exponent 5: E is 225 kPa."""
    larger = 0.5 * gamma + np.hypot(0.5 * gamma, 1)
    return 3e4 * (larger**5 - larger**-5) / (larger + 1 / larger)


def run_of_curve(test, strain, stress_pa, seed, law="yeoh", sigma_pa=SIGMA_PA):
    noise_pa = sigma_pa * np.random.default_rng(seed).normal(size=len(strain))
    specimen = cs.Specimen(test, strain, stress_pa + noise_pa, sigma_pa)
    unknown = {name: cs.Unknown() for name in LAWS[law]}
    return cs.run(cs.Problem([specimen.experiment(law, "one")], unknown | FIXED))


@pytest.mark.long
def test_a_kind_of_test_that_a_flexible_law_fits_is_not_good_in_silence():
    strain = np.linspace(0.1, 1.3, 24)
    run = run_of_curve("planar", strain, sheared_pa(strain), seed=2)
    (cause,) = run.causes
    assert cause.code == "specimen-kind/likelier"
    assert "simple-shear (E = 22" in cause.message
    assert run.trust.verdict == "check"


@pytest.mark.long
def test_true_stresses_are_named_beside_a_kind_of_test_that_fits_alike():
    strain = np.linspace(0.1, 3.0, 30) / 30
    stress_pa = (1 + strain) * neo_hookean_pa(strain)
    run = run_of_curve("uniaxial", strain, stress_pa, seed=1, law="neo-hookean", sigma_pa=280.0)
    (cause,) = run.causes
    assert cause.code == "specimen-kind/likelier"
    assert "as true stress (E = 29" in cause.message
    assert "and simple-shear (E = " in cause.message


@pytest.mark.long
def test_percent_that_a_flexible_law_fits_are_not_good_in_silence():
    strain = np.linspace(0.05, 2.0, 40) / 100
    noisy_pa = dict(seed=1, sigma_pa=0.01 * neo_hookean_pa(strain)[-1])
    run = run_of_curve("uniaxial", 100 * strain, neo_hookean_pa(strain), **noisy_pa)
    (cause,) = run.causes
    assert cause.code == "specimen-kind/likelier"
    assert "as percent (E = 2" in cause.message
    assert run.trust.verdict == "check"


@pytest.mark.long
def test_nothing_is_said_where_a_curve_of_small_strains_does_not_show_the_kind_of_test():
    strain = np.linspace(0.01, 0.1, 12)
    run = run_of_curve("uniaxial", strain, neo_hookean_pa(strain), seed=2, law="neo-hookean")
    assert not run.causes
    assert run.trust.verdict == "good"


@pytest.mark.long
def test_a_kind_that_the_curve_shows_is_not_in_doubt():
    strain = np.linspace(0.05, 1.5, 24)
    run = run_of_curve("uniaxial", strain, neo_hookean_pa(strain), seed=3, law="neo-hookean")
    assert not run.causes
    assert not any("kind of test" in note for note in run.notes)
