"""Laws in powers of the stretches (Ogden, Hill's foam) in tests of homogeneous specimens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.program.simulation import with_readings
from collocation_sysid.recording.specimen_files import specimen_strains

# Treloar's rubber in the fit of Ogden (1972) [Pa, 1].
TERMS = ((0.63e6, 1.3), (1.2e3, 5.0), (-1e4, -2.0))
OGDEN = {
    **{f"mu_{k}_pa": mu for k, (mu, _) in enumerate(TERMS, start=1)},
    **{f"alpha_{k}": alpha for k, (_, alpha) in enumerate(TERMS, start=1)},
    "kappa_pa": 1e12,
}
FOAM = {"mu_1_pa": 2e4, "alpha_1": 6.0, "beta_1": 0.3}
EXACT = {"strain_zero": 0.0, "area_error": 0.0}


def simulated(material, values, test, strain, **measured):
    """Values (T,) of the sensors of a specimen by name."""
    strain = np.asarray(strain, dtype=float)
    twin = cs.Specimen(test, strain, np.zeros_like(strain), sigma_pa=10.0, **measured, **EXACT)
    experiment = twin.experiment(material, test)
    read = cs.simulate(experiment, values).custom_sensor_values
    pairs = zip(experiment.readings, read, strict=True)
    return {gauge.name: column[:, 0] for gauge, column in pairs}


def incompressible_pa(test, stretch, mu, alpha):
    """First and second nominal stress of one term of Ogden's law; NaN without a second one."""
    thickness = {"uniaxial": -alpha / 2, "equibiaxial": -2 * alpha, "planar": -alpha}[test]
    first = mu * (stretch ** (alpha - 1) - stretch ** (thickness - 1))
    second = mu * (1 - stretch**-alpha) if test == "planar" else np.nan * stretch
    return first, second


@pytest.mark.parametrize("test", ["uniaxial", "equibiaxial", "planar"])
def test_ogdens_stresses_are_those_of_the_closed_form(test):
    strain = np.array([-0.4, -0.1, 0.05, 0.6, 2.0, 2.5 if test == "equibiaxial" else 5.0])
    measured = {"second_stress_pa": 0 * strain} if test == "planar" else {}
    read = simulated("ogden-3", OGDEN, test, strain, **measured)
    terms = [incompressible_pa(test, 1 + strain, mu, alpha) for mu, alpha in TERMS]
    first_pa, second_pa = np.sum(terms, axis=0)
    np.testing.assert_allclose(read["stress"], first_pa, rtol=2e-5)
    if test == "planar":
        np.testing.assert_allclose(read["second stress"], second_pa, rtol=2e-5)


def test_hills_foam_has_the_stress_and_the_lateral_stretch_of_the_closed_form():
    strain = np.array([-0.6, -0.3, -0.05, 0.1, 0.5])
    read = simulated("hyperfoam-1", FOAM, "uniaxial", strain, lateral_stretch=1 + 0 * strain)
    stretch = 1 + strain
    beta, alpha = FOAM["beta_1"], FOAM["alpha_1"]
    across = stretch ** (-beta / (1 + 2 * beta))
    volume = stretch * across**2
    stress_pa = 2 * FOAM["mu_1_pa"] / alpha * (stretch**alpha - volume ** (-alpha * beta)) / stretch
    np.testing.assert_allclose(read["lateral stretch"], across, rtol=1e-8)
    np.testing.assert_allclose(read["stress"], stress_pa, rtol=1e-7)


def notes_of(material, free, tests, validation=(), **fixed):
    """Notes about one kind of test, of a fit of Kawabata's small stretches."""
    specimens = cs.datasets.kawabata_1981(material, tests=tests, largest_stretch=1.3)
    specimens = [replace(each, validation=each.name in validation) for each in specimens]
    values = {**dict.fromkeys(free, cs.Unknown()), **fixed, "kappa_pa": 1e9}
    run = cs.run(cs.Problem(specimens, values))
    return [note for note in run.notes if "intervals assume that the law" in note]


@pytest.mark.long
def test_one_kind_of_test_does_not_test_a_law_with_several_constants():
    mooney = ("c10_pa", "c01_pa")
    (note,) = notes_of("mooney-rivlin", mooney, ("uniaxial",))
    assert "all specimens are uniaxial tests" in note
    assert "the law mooney-rivlin" in note
    assert notes_of("mooney-rivlin", mooney, ("uniaxial", "planar")) == []
    assert notes_of("mooney-rivlin", mooney, ("uniaxial", "planar"), validation=["planar"]) == []
    assert notes_of("mooney-rivlin", mooney, ("biaxial",)) == []
    assert notes_of("yeoh", ("c10_pa",), ("uniaxial",), c20_pa=0.0, c30_pa=0.0) == []


def test_a_compression_test_with_lateral_stretch_determines_a_foam():
    rng = np.random.default_rng(5)
    strain = np.linspace(-0.02, -0.6, 25)
    twin = cs.Specimen(
        "uniaxial",
        strain,
        0 * strain,
        sigma_pa=20.0,
        lateral_stretch=1 + 0 * strain,
        lateral_sigma=1e-3,
        **EXACT,
    )
    experiment = twin.experiment("hyperfoam-1")
    read = cs.simulate(experiment, FOAM).custom_sensor_values
    noisy = [
        each + gauge.sigma * rng.normal(size=each.shape)
        for gauge, each in zip(experiment.readings, read, strict=True)
    ]
    free = dict.fromkeys(("mu_1_pa", "alpha_1", "beta_1"), cs.Unknown())
    run = cs.run(cs.Problem([with_readings(experiment, noisy)], {**free}))
    for name in free:
        low, high = run.estimates[name].statistical95
        assert low < FOAM[name] < high
        assert high - low < 0.1 * FOAM[name]


@pytest.mark.long
def test_three_terms_fit_kawabatas_data_like_a_linear_regression():
    """With fixed exponents the stresses of an incompressible solid are linear in mu_p."""
    exponents = (1.3, 5.0, -2.0)
    tests = cs.datasets.kawabata_1981("ogden-3")
    constants = {
        "mu_1_pa": cs.Unknown(),
        "mu_2_pa": cs.Unknown(guess=1e3),
        "mu_3_pa": cs.Unknown(guess=-1e4),
        **{f"alpha_{k}": alpha for k, alpha in enumerate(exponents, start=1)},
        "kappa_pa": 1e12,
    }
    run = cs.run(cs.Problem(tests, constants))
    rows, measured = [], []
    for test in tests:
        stretch = 1 + specimen_strains(test)[0]
        terms = [incompressible_pa(test.name, stretch, 1.0, alpha) for alpha in exponents]
        for k, gauge in enumerate(test.readings):
            rows.append(np.column_stack([term[k] for term in terms]))
            measured.append(gauge.measured_values[:, 0])
    exact = np.linalg.lstsq(np.vstack(rows), np.concatenate(measured), rcond=None)[0]
    optimum = [run.optimum[f"mu_{k}_pa"].value for k in (1, 2, 3)]
    assert optimum == pytest.approx(exact, rel=5e-3)


@pytest.mark.parametrize(
    ("test", "strain"), [("equibiaxial", 3.6), ("planar", 20.0), ("simple-shear", 21.0)]
)
def test_stretches_that_ogdens_law_does_not_reach_accurately_are_refused(test, strain):
    strains = np.linspace(0.0, strain, 5)
    with pytest.raises(cs.InputError, match=r"row 5 .*expected at least 0\.05"):
        simulated("ogden-1", OGDEN, test, strains)
    inside = cs.Specimen(test, strains[:4], strains[:4], sigma_pa=1.0)
    assert inside.experiment("ogden-1").t_s.tolist() == [0, 1, 2, 3]
    simulated("neo-hookean", {"mu_pa": 1e5, "lambda_pa": 1e7}, test, strains)


def test_a_prediction_without_a_stable_equilibrium_names_test_and_strain():
    values = {"mu_1_pa": 1e5, "alpha_1": 1.0, "mu_2_pa": 1e5, "alpha_2": -3.0, "kappa_pa": 1e8}
    with pytest.raises(cs.SimulationError, match=r"equibiaxial test at a strain of 1\.333"):
        simulated("ogden-2", {**values}, "equibiaxial", np.linspace(0.0, 1.5, 10))
