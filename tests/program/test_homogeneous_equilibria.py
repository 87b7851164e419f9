"""Equilibria of homogeneous specimens, all samples at once, against those of one after another."""

from __future__ import annotations

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.program.forward import scheme_simulation
from collocation_sysid.recording.homogeneous_deformation import DEFORMATIONS

STRAIN = np.linspace(-0.3, 0.0, 12)
STILL = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
LAWS = {
    "neo-hookean": {"young_pa": 1e5, "poisson": 0.1},
    "yeoh": {"c10_pa": 1e4, "c20_pa": 3e3, "c30_pa": 500.0, "poisson": 0.499},
    "hyperfoam-1": {"mu_1_pa": 2e4, "alpha_1": 8.0, "beta_1": 0.1},
}


@pytest.mark.parametrize("test", DEFORMATIONS)
@pytest.mark.parametrize("law", LAWS)
def test_all_samples_at_once_are_those_of_one_after_another(monkeypatch, law, test):
    second = STRAIN / 2 if DEFORMATIONS[test].second else None
    specimen = cs.Specimen(test, STRAIN, 0 * STRAIN, 1.0, second_strain=second)
    experiment = specimen.experiment(law)
    at_once = cs.simulate(experiment, LAWS[law] | STILL).positions_m
    calls = []
    monkeypatch.setattr(
        scheme_simulation, "homogeneous_equilibria", lambda *_: calls.append(1) or None
    )
    in_turn = cs.simulate(experiment, LAWS[law] | STILL).positions_m
    assert calls
    np.testing.assert_allclose(at_once, in_turn, atol=1e-10)


def test_a_law_that_is_unstable_on_the_way_is_refused():
    """Two terms that cancel in tension: the specimen does not resist a change of its section."""
    constants = {"mu_1_pa": 111e3, "alpha_1": 3.2, "mu_2_pa": 2.3e3, "alpha_2": -10.4}
    strain = np.linspace(0.0, 1.2, 20)
    experiment = cs.Specimen("uniaxial", strain, 0 * strain, 1.0).experiment("ogden-2")
    with pytest.raises(cs.SimulationError):
        cs.simulate(experiment, constants | {"kappa_pa": 1e9} | STILL)
