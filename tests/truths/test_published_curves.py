"""Published material tests that are not part of this repository, where a copy of them is present."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import collocation_sysid as cs

ROOT = Path(__file__).parents[2]
CURVES = Path("shared/data/hyperelastic_curves")
FOLDER = next((p / CURVES for p in ROOT.parents if (p / CURVES).is_dir()), None)
EXACT = {"strain_zero": 0.0, "area_error": 0.0}
SIGMA_PA = 20.0


def curve(name: str) -> np.ndarray:
    """Rows of a curve of the corona radiata (Budday et al. 2017)."""
    assert FOLDER is not None
    return np.loadtxt(FOLDER / f"Budday_2017_{name}.csv", delimiter=",", skiprows=1)


@pytest.mark.long
@pytest.mark.skipif(FOLDER is None, reason="the curves are not present")
def test_a_law_fitted_to_three_tests_of_brain_is_doubtful_where_it_predicts_the_fourth_badly():
    """One term of Ogden's law predicts about 20 kPa for γ = 0.2 at a stretch of 0.75; measured is
    0.3 kPa.
    """
    pulls = [curve(f"UT_{side}_corona_radiata") for side in "TC"]
    sheared = curve("SS_corona_radiata")
    pressed = curve("CSS_corona_radiata_lambda_0d75")
    tests = [
        cs.Specimen("uniaxial", rows[:, 0] - 1, 1e3 * rows[:, 1], SIGMA_PA, **EXACT)
        for rows in pulls
    ]
    tests.append(cs.Specimen("simple-shear", sheared[:, 0], 1e3 * sheared[:, 1], SIGMA_PA, **EXACT))
    fitted = [each.experiment("ogden-1", f"test {k}") for k, each in enumerate(tests)]
    stress_pa = 1e3 * pressed[:, 3]
    unseen = cs.Specimen(
        "simple-shear", pressed[:, 1], stress_pa, SIGMA_PA, axial_stretch=0.75, **EXACT
    ).experiment("ogden-1", "pressed shear", validation=True)
    unknown = {"mu_1_pa": cs.Unknown(), "alpha_1": cs.Unknown(), "kappa_pa": 1e6}
    run = cs.run(cs.Problem([*fitted, unseen], unknown))
    shear_pa = run.parameters["mu_1_pa"] * run.parameters["alpha_1"] / 2
    assert shear_pa == pytest.approx(710, rel=0.03)
    assert run.parameters["alpha_1"] == pytest.approx(-23.3, abs=0.3)
    predicted = cs.simulate(unseen, run.parameters).custom_sensor_values[0][:, 0]
    assert np.abs(predicted).max() > 30 * np.abs(stress_pa).max()
    assert run.trust.verdict == "doubtful"
    assert any("pressed shear" in each.message for each in run.trust.concerns)


@pytest.mark.long
@pytest.mark.skipif(FOLDER is None, reason="the curves are not present")
def test_silicone_fitted_in_tension_is_doubtful_where_it_predicts_other_tests_badly():
    """Two terms of Ogden's law; docs/studies/specimens.md has the errors of other laws, too."""
    assert FOLDER is not None
    rows = {
        kind: np.loadtxt(FOLDER / f"Meunier_2008_{kind}.csv", delimiter=",", skiprows=1)[:, :2]
        for kind in ("UT", "PS", "ET")
    }
    tests = [
        cs.Specimen(test, rows[kind][:, 0] - 1, 1e6 * rows[kind][:, 1], 1e4, **EXACT).experiment(
            "ogden-2", test, validation=test != "uniaxial"
        )
        for test, kind in (("uniaxial", "UT"), ("planar", "PS"), ("equibiaxial", "ET"))
    ]
    unknown = dict.fromkeys(["mu_1_pa", "alpha_1", "mu_2_pa", "alpha_2"], cs.Unknown())
    run = cs.run(cs.Problem(tests, unknown | {"kappa_pa": 1e9}))
    errors_pa = []
    for test in tests:
        (gauge,) = test.readings
        (predicted,) = cs.simulate(test, run.parameters).custom_sensor_values
        errors_pa.append(np.sqrt(np.mean((predicted - gauge.measured_values) ** 2)))
    np.testing.assert_allclose(errors_pa, [7.1e3, 33.0e3, 137.8e3], rtol=0.05)
    assert run.trust.verdict == "doubtful"
    messages = [each.message for each in run.trust.concerns]
    for name in ("planar", "equibiaxial"):
        assert any(name in message for message in messages)
