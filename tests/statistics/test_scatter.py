"""Differences between recordings that share parameters, beyond their noise."""

from __future__ import annotations

import numpy as np
import pytest
from kit.fits import PARAMETERS, problem
from scipy.stats import binom, chi2, t

from collocation_sysid.statistics.assessment import fit_concerns
from collocation_sysid.statistics.linearised import LinearisedFit
from collocation_sysid.statistics.residuals.recording_scatter import (
    RecordingComparison,
    half_width_of_mean,
    single_fits,
)
from collocation_sysid.statistics.uncertainty import ErrorModel, Uncertainty, uncertainty_from_fit

MADE = problem((80, 80, 80, 80), 3, offsets=False)
RECORDINGS = len(MADE.slopes)
# Of the second parameter's logarithm among recordings: some of their error bars.
SPREAD = 0.01
SEEDS = 30


def fitted(seed: int, spread: float = 0.0) -> tuple[LinearisedFit, np.ndarray]:
    """A fit, and its error; each recording has a second parameter of its own, by the spread."""
    rng = np.random.default_rng(seed)
    local = rng.normal(size=len(MADE.names)) / np.maximum(MADE.prior_slope, 1e-300)
    truth = np.where(MADE.prior_slope > 0, local, 0.0)
    errors = []
    for slope in MADE.slopes:
        of_noise = rng.normal(size=slope.shape[:3])
        errors.append(of_noise + spread * rng.normal() * slope[..., 1])
    return MADE.fit(errors, -truth)


def judged(seed: int, spread: float = 0.0) -> Uncertainty:
    fit, wrong = fitted(seed, spread)
    return uncertainty_from_fit(fit, PARAMETERS, wrong[:4], ErrorModel(errors="independent"))


def scatter(found: Uncertainty) -> RecordingComparison:
    assert found.scatter is not None
    return found.scatter


def test_a_step_from_the_joint_answer_is_the_fit_to_one_recording():
    fit, wrong = fitted(3)
    rng = np.random.default_rng(3)
    local = rng.normal(size=len(MADE.names)) / np.maximum(MADE.prior_slope, 1e-300)
    truth = np.where(MADE.prior_slope > 0, local, 0.0)
    for k, ((alone, step), slope) in enumerate(zip(single_fits(fit), MADE.slopes, strict=True)):
        errors = rng.normal(size=slope.shape[:3])
        rng.normal()
        columns = [0, 1, 2, 3, 4 + k]
        prior = MADE.prior_slope[columns]
        rows = np.concatenate([slope[..., columns].reshape(-1, 5), np.diag(prior)])
        expected = np.linalg.lstsq(rows, np.concatenate([errors.ravel(), prior * truth[columns]]))[
            0
        ]
        np.testing.assert_allclose(wrong[:4] + step[:4], expected[:4], atol=1e-8)
        assert alone.names == tuple(MADE.names[c] for c in columns)


def test_recordings_that_agree_have_the_chi_squared_of_chance():
    found = [scatter(judged(seed)) for seed in range(SEEDS)]
    values = np.array([each.chi_squared for each in found]) / (RECORDINGS - 1)
    assert all((each.degrees_of_freedom == RECORDINGS - 1).all() for each in found)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], SEEDS * (RECORDINGS - 1)) / SEEDS / (RECORDINGS - 1)
    assert (low < values.mean(axis=0)).all()
    assert (values.mean(axis=0) < high).all()
    assert sum(each.find_disagreements().any() for each in found) <= 3
    same = np.array([4.0, 3.0, 2.0, 1.0])
    np.testing.assert_array_equal(found[0].widen(same), same)


def test_disagreeing_recordings_widen_the_interval_of_the_parameter_concerned():
    calm, found = judged(1), judged(1, spread=SPREAD)
    assert scatter(found).find_disagreements().tolist() == [False, True, False, False]
    ratio = np.sqrt(np.diag(found.covariance) / np.diag(calm.covariance))
    birge = np.sqrt(scatter(found).chi_squared[1] / scatter(found).degrees_of_freedom[1])
    # A flat prior of the spread has one degree of freedom less than Student's interval.
    student = t.ppf(0.975, RECORDINGS - 2) / t.ppf(0.975, np.inf)
    assert 0.7 * birge < ratio[1] < 1.3 * birge * student
    assert (ratio[[0, 2, 3]] < 1.3).all()
    (note,) = [note for note in found.notes if "disagree on mu_pa" in note]
    assert "model errors exceed the noise" in note
    assert any("disagree on mu_pa" in each.message for each in fit_concerns(found))
    assert not any("disagree" in note for note in calm.notes)


@pytest.mark.parametrize(("count", "spread"), [(2, 0.1), (2, 0.3), (3, 0.2), (8, 0.1)])
def test_the_interval_of_a_mean_holds_although_few_recordings_show_their_spread(count, spread):
    """Also for spreads around the scale of the prior; all are far above the error bars of 0.02."""
    rng = np.random.default_rng(0)
    errors = spread * rng.normal(size=(400, count)) + 0.02 * rng.normal(size=(400, count))
    deviations = np.full(count, 0.02)
    means = errors.mean(axis=1)
    widths = [half_width_of_mean(e - m, deviations) for e, m in zip(errors, means, strict=True)]
    held = np.mean(np.abs(means) < widths)
    assert held > 0.8
    # Student's interval of two recordings is 12.7 times their deviation.
    student = t.ppf(0.975, count - 1) * errors.std(axis=1, ddof=1) / np.sqrt(count)
    ratio = np.quantile(widths, 0.9) / np.quantile(student, 0.9)
    assert ratio < (0.3 if count == 2 else 1.1)


def test_widened_intervals_contain_the_truth_at_their_nominal_rate():
    held = []
    for seed in range(SEEDS):
        found = judged(seed, spread=SPREAD)
        low, high = found.estimates["mu_pa"].statistical95 or (0, 0)
        held.append(low < 1.0 < high)
    assert np.sum(held) >= binom.ppf(1e-3, SEEDS, 0.95)


def test_one_recording_cannot_disagree():
    fit, wrong = problem((80,), 3).fit([np.zeros((80, 3, 3))], np.zeros(14))
    assert uncertainty_from_fit(fit, PARAMETERS, wrong[:4]).scatter is None
