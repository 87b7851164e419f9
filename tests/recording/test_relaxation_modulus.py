"""Tables of the relaxation modulus E(t) and G(t)."""

from __future__ import annotations

import numpy as np
import pytest

import collocation_sysid as cs

T_S = np.geomspace(0.01, 30.0, 25)
LONG_TERM, SHARE, TAU_S = 2e5, 0.5, 1.5


@pytest.mark.long
@pytest.mark.parametrize(("test", "modulus"), [("uniaxial", "young_pa"), ("simple-shear", "mu_pa")])
def test_a_relaxation_modulus_determines_the_constants_of_the_memory(test, modulus):
    sigma_pa = 100.0
    exact_pa = LONG_TERM * (1 + SHARE * np.exp(-T_S / TAU_S))
    noise_pa = sigma_pa * np.random.default_rng(0).normal(size=len(T_S))
    specimen = cs.Specimen.relaxation(T_S, exact_pa + noise_pa, sigma_pa, test)
    problem = cs.Problem(
        [specimen.experiment("neo-hookean", "held", prony=("b",))],
        {
            modulus: cs.Unknown(),
            "poisson": 0.4999,
            "b.share": cs.Unknown(),
            "b.tau_s": cs.Unknown(),
        },
    )
    found = cs.solve(problem)
    assert found.status.converged
    assert found.parameters[modulus] == pytest.approx(LONG_TERM, rel=2e-3)
    assert found.parameters["b.share"] == pytest.approx(SHARE, rel=5e-3)
    assert found.parameters["b.tau_s"] == pytest.approx(TAU_S, rel=5e-3)
    assert found.history[-1].loss < 2 * len(T_S)


@pytest.mark.parametrize(
    ("t_s", "test", "found"),
    [
        ([0.0, 1.0], "uniaxial", "positive"),
        ([2.0, 1.0], "uniaxial", "increase"),
        ([1.0, 2.0], "planar", "planar"),
    ],
)
def test_other_times_and_tests_are_refused(t_s, test, found):
    with pytest.raises(cs.InputError, match=found):
        cs.Specimen.relaxation(t_s, [2.0, 1.0], 0.1, test)
