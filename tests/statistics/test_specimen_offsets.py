"""Notes on constant offsets of the stresses of material tests."""

from __future__ import annotations

import numpy as np
import pytest

import collocation_sysid as cs

SIGMA_PA = 500.0
STRETCH = np.linspace(1.0, 2.0, 40)


def notes(offset_pa, scale=1.0, **keys):
    """Notes on offsets of a fit of a rubber whose load cell has an offset, and noise `scale` times
    as large as stated.
    """
    rng = np.random.default_rng(2)
    noise_pa = scale * SIGMA_PA * rng.normal(size=len(STRETCH))
    stress_pa = 1e5 * (STRETCH - STRETCH**-2) + noise_pa + offset_pa
    specimen = cs.Specimen(
        "uniaxial", STRETCH - 1, stress_pa, sigma_pa=SIGMA_PA, strain_zero=0.0, **keys
    )
    problem = cs.Problem(
        [specimen.experiment("neo-hookean", "pull")],
        {"mu_pa": cs.Unknown(8e4), "kappa_pa": 1e9, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0},
    )
    answer = cs.run(problem, seek_causes=False)
    return [each for each in answer.notes if "constant offset" in each]


def test_an_offset_that_explains_the_residuals_is_suggested():
    (note,) = notes(-1500.0)
    offset_pa = float(note.split("residuals: ")[1].split(" ±")[0])
    assert offset_pa == pytest.approx(-1500.0, abs=600.0)
    assert "in 'pull'" in note
    assert "stress_zero_pa = " in note


@pytest.mark.parametrize(
    ("offset_pa", "keys"),
    [
        pytest.param(0.0, {}, id="no offset"),
        pytest.param(0.0, {"scale": 1.5}, id="more noise"),
        pytest.param(-1500.0, {"stress_zero_pa": 1e3}, id="estimated"),
        pytest.param(-2e4, {}, id="gross misfit"),
    ],
)
def test_no_offset_is_suggested_without_a_cause(offset_pa, keys):
    assert notes(offset_pa, **keys) == []
