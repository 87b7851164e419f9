"""Diagnostics of the residuals of each marker."""

from __future__ import annotations

import numpy as np
import pytest

from collocation_sysid.statistics.linearised import LinearisedFit, ResidualBlock
from collocation_sysid.statistics.residuals.diagnostics import MarkerDiagnosis, diagnose_markers

T_S = 0.01 * np.arange(160)
SIGMA_M = 2e-4
MOTION = np.exp(-3 * T_S) * np.cos(2 * np.pi * 7.7 * T_S)


def noise(seed: int = 0, level: float = 1.0) -> np.ndarray:
    return level * np.random.default_rng(seed).normal(size=(len(T_S), 3))


def diagnosis(residual: np.ndarray, missing: float = 0.0) -> MarkerDiagnosis:
    """Of one marker's residuals (T, 3) in units of σ, beside one that was never seen."""
    seen = np.zeros((len(T_S), 2), dtype=bool)
    seen[:, 1] = np.random.default_rng(1).random(len(T_S)) >= missing
    both = np.zeros((len(T_S), 2, 3))
    both[:, 1] = np.where(seen[:, 1:], residual, 0.0)
    slope = np.zeros((len(T_S), 2, 3, 2))
    slope[:, 1, 2, 0] = np.where(seen[:, 1], 50 * MOTION, 0.0)  # of a shared parameter
    slope[:, 1, 0, 1] = seen[:, 1]  # of an offset
    block = ResidualBlock("gravity", T_S, ("Base", "Tip2"), seen, both, slope, np.full(2, SIGMA_M))
    names = ("mu_pa", "gravity: offset of Tip2, x [m]")
    fit = LinearisedFit((block,), names, 1, np.zeros(2), np.zeros(2), np.zeros(2, dtype=bool))
    (found,) = diagnose_markers(fit)
    assert (found.experiment, found.marker) == ("gravity", "Tip2")
    assert found.sentence.startswith("gravity/Tip2: ")
    return found


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_white_residuals_are_consistent_with_noise(missing):
    said = [diagnosis(noise(seed), missing) for seed in range(20)]
    assert sum("uncorrelated, consistent with noise" in d.sentence for d in said) >= 18
    assert np.mean([d.rms_m for d in said]) == pytest.approx(np.sqrt(3) * SIGMA_M, rel=0.03)
    assert np.mean([d.early_share for d in said]) == pytest.approx(0.1, abs=0.03)


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_a_constant_part_is_a_marker_off_its_place(missing):
    found = diagnosis(noise() + np.array([6.0, 0.0, 0.0]), missing)
    assert found.constant_share == pytest.approx(36 / 39, abs=0.03)
    np.testing.assert_allclose(found.offset_m, [6 * SIGMA_M, 0, 0], atol=0.2 * SIGMA_M)
    assert "is a constant part: its position on the body is wrong by 1.2 mm" in found.sentence
    assert "marker_offsets" in found.sentence


@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_residuals_that_oscillate_with_the_motion_indicate_the_model(missing):
    swing = np.zeros((len(T_S), 3))
    swing[:, 2] = 20 * np.exp(-2 * T_S) * np.sin(2 * np.pi * 7.7 * T_S)
    found = diagnosis(noise() + swing, missing)
    assert found.frequency_hz == pytest.approx(7.7, abs=0.4)
    assert found.oscillating_share > 0.5
    assert found.lag1 > 0.5
    assert "Hz, the frequency of the motion" in found.sentence
    assert "stiffness" in found.sentence


def test_an_oscillation_of_its_own_is_a_vibration():
    swing = np.zeros((len(T_S), 3))
    swing[:, 1] = 10 * np.sin(2 * np.pi * 31.0 * T_S)
    found = diagnosis(noise() + swing)
    assert found.frequency_hz == pytest.approx(31.0, abs=0.4)
    assert "not a frequency of the motion" in found.sentence


def test_residuals_at_the_start_indicate_the_release():
    start = np.zeros((len(T_S), 3))
    start[:10, 2] = 30 * np.linspace(1, 0, 10)
    found = diagnosis(noise() + start)
    assert found.early_share > 0.5
    assert "in the first 0.16 s" in found.sentence
    assert "time_shift" in found.sentence


def test_a_drift_is_not_called_an_oscillation():
    drift = np.zeros((len(T_S), 3))
    drift[:, 2] = np.linspace(-10, 10, len(T_S))
    assert "slow drift: the model lacks creep" in diagnosis(noise() + drift).sentence


def test_a_slow_walk_without_a_peak_is_named_too():
    walk = np.zeros((len(T_S), 3))
    for seed in range(3):
        walk[:, seed] = np.cumsum(noise(seed)[:, 0])
    assert "creep" in diagnosis(walk - walk.mean(axis=0)).sentence


def test_an_exact_fit_needs_no_words():
    found = diagnosis(np.zeros((len(T_S), 3)))
    assert found.rms_m == 0
    assert found.sentence == "gravity/Tip2: residuals are at the level of rounding errors"
    assert np.isfinite([found.lag1, found.constant_share, found.oscillating_share]).all()
