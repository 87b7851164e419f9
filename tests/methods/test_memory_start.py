"""Starts of the branches of a memory, from tables of moduli over frequency or time."""

from __future__ import annotations

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.methods.starts.stiffness_scan import start_problem

YOUNG_PA = 2e5
TAU_S = np.geomspace(1e-3, 1e2, 6)
SHARES = np.array([3.0, 0.5, 1.5, 0.8, 2.0, 0.3])
NAMES = tuple(f"b{k}" for k in range(len(TAU_S)))
STILL = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0, "poisson": 0.45}


def unknowns(**others):
    branches = {f"{name}.{key}": cs.Unknown() for name in NAMES for key in ("share", "tau_s")}
    return STILL | {"young_pa": cs.Unknown()} | branches | others


def harmonic(shift=1.0, name="", noise=None):
    frequency_hz = np.geomspace(1e-4, 1e4, 33)
    w = 2j * np.pi * frequency_hz[:, None] * TAU_S * shift
    modulus = YOUNG_PA * (1 + (SHARES * w / (1 + w)).sum(axis=1))
    if noise is not None:
        modulus += 0.01 * np.abs(modulus) * (noise.normal(size=(33, 2)) @ [1, 1j])
    specimen = cs.Specimen.harmonic(frequency_hz, modulus.real, modulus.imag, 0.01, shift=name)
    return specimen.experiment("linear", name or "reference", prony=NAMES)


def relaxation():
    t_s = np.geomspace(1e-4, 1e4, 60)
    modulus = YOUNG_PA * (1 + np.exp(-t_s[:, None] / TAU_S) @ SHARES)
    return cs.Specimen.relaxation(t_s, modulus, 1e3).experiment("linear", "relaxed", prony=NAMES)


def started(experiments, values):
    start = start_problem(cs.Problem(experiments, values).collocation())
    assert start.scan is None
    return start.collocation.parameters.guesses


def require_truth(found, tolerance):
    assert found["young_pa"] == pytest.approx(YOUNG_PA, rel=tolerance)
    order = np.argsort([found[f"{name}.tau_s"] for name in NAMES])
    for name, tau_s, share in zip(np.array(NAMES)[order], TAU_S, SHARES, strict=True):
        assert found[f"{name}.tau_s"] == pytest.approx(tau_s, rel=tolerance)
        assert found[f"{name}.share"] == pytest.approx(share, rel=tolerance)


@pytest.mark.parametrize("test", [harmonic, relaxation])
def test_six_branches_start_at_their_values_without_a_guess(test):
    require_truth(started([test()], unknowns()), 2e-3)


def test_branches_and_a_shift_start_at_their_values():
    values = unknowns(**{"warm.log10_shift": cs.Unknown()})
    found = started([harmonic(), harmonic(10**-1.7, "warm")], values)
    assert found["warm.log10_shift"] == pytest.approx(-1.7, abs=1e-3)
    require_truth(found, 2e-3)


def test_relaxation_times_ascend_as_their_guesses_do():
    guesses = {f"{n}.tau_s": cs.Unknown(t) for n, t in zip(NAMES, TAU_S[::-1], strict=True)}
    found = started([harmonic()], unknowns(**guesses))
    assert found["b0.tau_s"] > found["b5.tau_s"]


def test_values_that_are_stated_and_bounds_are_kept():
    stated = {
        "young_pa": cs.Unknown(upper=1.5e5),
        "b2.tau_s": 0.5,
        "b3.share": cs.Unknown(2.0, lower=1.9),
    }
    found = started([harmonic()], unknowns(**stated))
    assert found["young_pa"] <= 1.5e5
    assert found["b2.tau_s"] == 0.5
    assert found["b3.share"] >= 1.9


def test_guesses_that_fit_as_well_are_kept():
    values = {"young_pa": YOUNG_PA}
    for name, tau_s, share in zip(NAMES, TAU_S, SHARES, strict=True):
        values |= {f"{name}.share": share, f"{name}.tau_s": tau_s}
    values["b0.share"] = 3.001
    guessed = {name: cs.Unknown(value, prior=(value, 1e-6)) for name, value in values.items()}
    assert started([harmonic()], STILL | guessed) == pytest.approx(STILL | values, rel=1e-12)


@pytest.mark.long
def test_a_search_with_six_branches_converges_in_few_sweeps():
    experiment = harmonic(noise=np.random.default_rng(0))
    found = cs.solve(cs.Problem([experiment], unknowns()))
    assert found.status.converged
    assert len(found.history) < 15
    assert found.history[-1].loss < 1.5 * 66
    assert found.parameters["young_pa"] == pytest.approx(YOUNG_PA, rel=0.05)
