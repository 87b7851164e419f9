"""Coverage of error bars for fits with known errors."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from kit.fits import PARAMETERS, Problem, autoregressive, problem
from scipy.signal import lfilter
from scipy.stats import binom, kstest

from collocation_sysid.statistics.linearised import LinearisedFit, factorise_information
from collocation_sysid.statistics.residuals.autocorrelation import (
    analyse_dependence,
    error_processes,
)
from collocation_sysid.statistics.uncertainty import ErrorModel, Uncertainty, uncertainty_from_fit

DRAWS = 60
PROBLEMS = {
    "one marker, 40 samples": problem((40,), markers=1),
    "two experiments": problem((60, 45), markers=1),
    "gaps": problem((100,), markers=2, missing=0.2),
    "no offsets": problem((80,), markers=2, offsets=False),
}


def draws(of: Problem, phi: float, shared: float = 0.0, count: int = DRAWS):
    """Fits to random errors, with priors that are wrong by their deviation, and their errors."""
    rng = np.random.default_rng(3)
    deviation = np.divide(1, of.prior_slope, where=of.prior_slope > 0, out=0 * of.prior_slope)
    for _ in range(count):
        errors = [autoregressive(rng, *s.shape[:2], phi, shared) for s in of.present]
        yield of.fit(errors, deviation * rng.normal(size=len(of.names)))


def held(uncertainty: Uncertainty, wrong: np.ndarray) -> np.ndarray:
    """Which of the shared parameters the intervals hold, (4,)."""
    half = uncertainty.quantiles * np.sqrt(np.diag(uncertainty.covariance))
    return np.abs(wrong[:4]) < half


def coverage(of: Problem, phi: float, shared: float = 0.0, count: int = DRAWS, **options) -> float:
    hits = [
        held(uncertainty_from_fit(fit, PARAMETERS, wrong[:4], ErrorModel(**options)), wrong)
        for fit, wrong in draws(of, phi, shared, count)
    ]
    return float(np.mean(hits))


def assert_covers(share: float) -> None:
    """Within 91–98 %, and what chance does to it (as if one parameter were counted)."""
    low, high = (binom.ppf(0.001, DRAWS, 0.93) / DRAWS, binom.ppf(0.999, DRAWS, 0.965) / DRAWS)
    assert low <= share <= high


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "phi"), [*product(PROBLEMS, (0.0, 0.85)), ("one marker, 40 samples", 0.5)]
)
def test_intervals_contain_the_truth_at_their_nominal_rate(name, phi):
    assert_covers(coverage(PROBLEMS[name], phi, noise="estimated"))


@pytest.mark.parametrize("phi", [0.0, 0.5])
def test_intervals_hold_the_truth_with_the_sigma_given(phi):
    assert_covers(coverage(PROBLEMS["one marker, 40 samples"], phi, noise="given"))


@pytest.mark.long
@pytest.mark.parametrize("phi", [0.0, 0.85])
def test_intervals_allow_for_errors_that_markers_share(phi):
    of = problem((100,), markers=3)
    assert_covers(coverage(of, phi, shared=0.6, noise="estimated"))
    assert coverage(of, phi, shared=0.6, noise="estimated", errors="independent") < 0.85


@pytest.mark.long
def test_textbook_intervals_fail_where_errors_persist():
    count = 150
    for name in ("one marker, 40 samples", "no offsets"):
        textbook = {"noise": "estimated", "errors": "independent", "count": count}
        share = coverage(PROBLEMS[name], 0.85, **textbook)
        assert share < binom.ppf(0.001, count, 0.93) / count


def test_intervals_rarely_change_for_white_errors():
    of = PROBLEMS["one marker, 40 samples"]
    chosen = [
        uncertainty_from_fit(fit, PARAMETERS, wrong[:4], ErrorModel(noise="estimated")).errors
        for fit, wrong in draws(of, 0.0)
    ]
    assert np.mean([errors == "autocorrelated" for errors in chosen]) < 0.06  # 1 % of two tests


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_test_for_persistence_accounts_for_the_fit(name):
    scores = []
    for fit, _ in draws(PROBLEMS[name], 0.0):
        found = analyse_dependence(fit, factorise_information(fit))
        scores.append(found.lag1 / found.lag1_deviation)
    assert kstest(scores, "norm").pvalue > 1e-3


def test_a_sample_that_is_alone_among_its_times_follows_on_none():
    of = PROBLEMS["one marker, 40 samples"]
    ((fit, _),) = draws(of, 0.0, count=1)
    (block,) = fit.blocks
    alone = np.arange(len(block.t_s))[:, None] == 3
    kept = {
        "is_present": block.is_present & alone,
        "residual": np.where(alone[..., None], block.residual, 0.0),
        "jacobian": np.where(alone[..., None, None], block.jacobian, 0.0),
    }
    single = replace(fit, blocks=[replace(block, **kept)])
    with np.errstate(all="raise"):
        found = analyse_dependence(single, factorise_information(single))
    assert (found.lag1, found.lag1_deviation) == (0.0, np.inf)


def test_autocorrelation_is_that_of_the_errors_not_of_the_residuals():
    of = PROBLEMS["one marker, 40 samples"]
    corrected, raw = [], []
    for fit, _ in draws(of, 0.85):
        corrected.append(analyse_dependence(fit, factorise_information(fit)).lag1)
        residual = fit.blocks[0].channels[0]
        raw.append(np.sum(residual[1:] * residual[:-1]) / np.sum(residual**2))
    assert np.median(raw) < 0.75
    assert np.median(corrected) == pytest.approx(0.85, abs=0.05)


def test_processes_of_the_errors_are_found():
    rng = np.random.default_rng(0)
    of = problem((400, 300), markers=2)
    mix = np.eye(6) + 0.5
    resonance = [1, -2 * 0.9 * np.cos(0.5), 0.81]
    first = 0.1 * lfilter([1], resonance, rng.normal(size=(700, 6)), axis=0)[300:] @ mix
    fit, _ = of.fit([first.reshape(400, 2, 3), autoregressive(rng, 300, 2, 0.0)], np.zeros(18))
    resonant, white = error_processes(fit, factorise_information(fit))
    impulse = 0.1 * lfilter([1], resonance, np.eye(1, 500)[0])
    expected = np.correlate(impulse, impulse, "full")[499:]
    assert resonant.order >= 2
    np.testing.assert_allclose(
        resonant.autocorrelation[:10], expected[:10] / expected[0], atol=0.15
    )
    scale = np.trace(mix @ mix) * expected[0]
    np.testing.assert_allclose(
        resonant.channel_covariance / scale, mix @ mix * expected[0] / scale, atol=0.05
    )
    assert white.order == 0
    np.testing.assert_allclose(white.channel_covariance, np.eye(6), atol=0.3)


# NuisanceMap parameters


def sample(seed: int = 0, phi: float = 0.0, **options) -> tuple[LinearisedFit, np.ndarray]:
    of = problem(**({"samples": (50, 60), "markers": 2} | options))
    rng = np.random.default_rng(seed)
    errors = [autoregressive(rng, *s.shape[:2], phi) for s in of.present]
    return of.fit(errors, np.zeros(len(of.names)))


def plain_information(fit: LinearisedFit) -> np.ndarray:
    rows = np.concatenate([b.jacobian.reshape(-1, len(fit.names)) for b in fit.blocks])
    return rows.T @ rows + np.diag(fit.prior_jacobian**2)


def test_shared_covariance_is_the_inverse_of_the_schur_complement_over_local_parameters():
    fit, wrong = sample()
    full, k = plain_information(fit), fit.shared_count
    schur = full[:k, :k] - full[:k, k:] @ np.linalg.solve(full[k:, k:], full[k:, :k])
    found = uncertainty_from_fit(fit, PARAMETERS, wrong[:4], ErrorModel(errors="independent"))
    scale = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(
        found.covariance / np.outer(scale, scale),
        np.linalg.inv(schur) / np.outer(scale, scale),
        atol=1e-8,
    )
    ignored = np.linalg.inv(full[:k, :k])
    assert (np.diag(ignored) < 0.9 * np.diag(found.covariance)).any()
    assert (np.diag(ignored) <= np.diag(found.covariance)).all()


def test_local_parameters_have_standard_deviations():
    fit, wrong = sample()
    found = uncertainty_from_fit(fit, PARAMETERS, wrong[:4], ErrorModel(errors="independent"))
    assert tuple(found.nuisance) == fit.names[4:]
    expected = np.sqrt(np.diag(np.linalg.inv(plain_information(fit))))[4:]
    np.testing.assert_allclose(list(found.nuisance.values()), expected, rtol=1e-6)


@pytest.mark.parametrize("bounded", [1, 4])
def test_an_estimate_at_its_bound_has_no_interval_and_the_others_have_that_of_the_free_problem(
    bounded,
):
    fit, wrong = sample()
    at_bound = replace(fit, at_bound=np.arange(len(fit.names)) == bounded)
    found, free = (
        uncertainty_from_fit(each, PARAMETERS, wrong[:4], ErrorModel(errors="independent"))
        for each in (at_bound, fit)
    )
    shown = np.arange(4) != bounded
    both = np.ix_(shown, shown)
    np.testing.assert_allclose(found.covariance[both], free.covariance[both], rtol=1e-9)
    assert np.isnan([*found.nuisance.values()]).tolist() == [
        *(np.arange(4, len(fit.names)) == bounded)
    ]
    assert np.isnan(np.diag(found.covariance)).tolist() == [*~shown]


def test_a_parameter_that_a_prior_determines_costs_no_degree_of_freedom():
    fit, wrong = sample()
    tight = replace(fit, prior_jacobian=np.where(np.arange(len(fit.names)) < 4, 0.0, 1e6))
    found = uncertainty_from_fit(tight, PARAMETERS, wrong[:4])
    assert found.degrees_of_freedom == pytest.approx(fit.measurement_count - 4, abs=1e-3)


# What is said of the residuals


def test_errors_that_persist_are_reported_once():
    fit, wrong = sample(phi=0.9)
    found = uncertainty_from_fit(fit, PARAMETERS, wrong[:4])
    assert found.errors == "autocorrelated"
    (note,) = [note for note in found.notes if "between consecutive samples" in note]
    assert "0.8" in note or "0.9" in note
    forced = uncertainty_from_fit(fit, PARAMETERS, wrong[:4], ErrorModel(errors="independent"))
    assert forced.errors == "independent"
    assert any("too small" in note for note in forced.notes)


def test_persistent_errors_far_below_the_sigma_given_change_nothing():
    fit, wrong = sample(phi=0.9)
    small = replace(fit, blocks=tuple(replace(b, residual=0.01 * b.residual) for b in fit.blocks))
    found = uncertainty_from_fit(small, PARAMETERS, wrong[:4])
    assert found.errors == "independent"
    np.testing.assert_allclose(
        found.covariance, np.linalg.inv(plain_information(fit))[:4, :4], rtol=1e-6
    )


def test_error_bars_never_fall_below_those_of_the_sigma_given():
    fit, wrong = sample(phi=0.9)
    given = uncertainty_from_fit(fit, PARAMETERS, wrong[:4], ErrorModel(errors="autocorrelated"))
    independent = uncertainty_from_fit(fit, PARAMETERS, wrong[:4], ErrorModel(errors="independent"))
    assert (np.diag(given.covariance) >= 0.999999 * np.diag(independent.covariance)).all()


def test_error_bars_follow_the_units_of_the_residuals():
    fit, wrong = sample(phi=0.7)
    scaled = replace(
        fit,
        blocks=tuple(
            replace(b, residual=7 * b.residual, jacobian=7 * b.jacobian) for b in fit.blocks
        ),
        prior_jacobian=7 * fit.prior_jacobian,
    )
    for errors in ("independent", "autocorrelated"):
        before, after = (
            uncertainty_from_fit(
                f, PARAMETERS, wrong[:4], ErrorModel("estimated", errors)
            ).covariance
            for f in (
                replace(fit, prior_jacobian=0 * fit.prior_jacobian),
                replace(scaled, prior_jacobian=0 * fit.prior_jacobian),
            )
        )
        np.testing.assert_allclose(after, before, rtol=1e-6)


def test_a_record_of_two_samples_is_no_error():
    fit, wrong = sample(samples=(2, 3), markers=2, offsets=False)
    for errors in ("auto", "independent", "autocorrelated"):
        found = uncertainty_from_fit(fit, PARAMETERS, wrong[:4], ErrorModel(errors=errors))
        assert np.isfinite(found.degrees_of_freedom)
