"""Noise levels estimated from residuals, and intervals that follow them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from coverage_twins import CASES, reference, truth, twin
from kit.fits import PARAMETERS, Problem, problem
from scipy.stats import binom, kstest

from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.statistics.linearised import factorise_information, linearise_fit
from collocation_sysid.statistics.residuals.noise_level import estimate_noise_level
from collocation_sysid.statistics.uncertainty import ErrorModel, Uncertainty, uncertainty_from_fit

DRAWS = 100
# What chance makes of a right share in 998 of 1000 such counts.
LEAST, MOST = binom.ppf([1e-3, 1 - 1e-3], DRAWS, 0.95) / DRAWS
PROBLEMS = {
    "three markers": problem((60,), markers=3, offsets=False),
    "gaps": problem((100,), markers=3, missing=0.2),
}
# Deviations of the markers' errors in units of σ as stated.
ERRORS = {
    "faultless": (1.0,),
    "stated 0.3 of the truth": (1 / 0.3,),
    "stated 3 times the truth": (1 / 3,),
    "one marker three times as noisy": (3.0, 1.0, 1.0),
}


def draws(of: Problem, deviations: tuple[float, ...], count: int = DRAWS):
    """Fits to white errors, with priors that are wrong by their deviation, and their errors."""
    rng = np.random.default_rng(5)
    prior = np.divide(1, of.prior_slope, where=of.prior_slope > 0, out=0 * of.prior_slope)
    for _ in range(count):
        errors = [
            np.resize(deviations, s.shape[1])[:, None] * rng.normal(size=(*s.shape, 3))
            for s in of.present
        ]
        yield of.fit(errors, prior * rng.normal(size=len(of.names)))


@cache
def found(name: str, errors: str) -> list[tuple[Uncertainty, np.ndarray]]:
    fits = draws(PROBLEMS[name], ERRORS[errors])
    return [(uncertainty_from_fit(fit, PARAMETERS, wrong[:4]), wrong[:4]) for fit, wrong in fits]


def test_degrees_of_freedom_do_not_depend_on_the_unit_of_a_parameter():
    fit, _ = next(draws(PROBLEMS["three markers"], (1.0,)))
    level = estimate_noise_level(fit, factorise_information(fit))
    of_one = np.zeros((3, 1, 1))
    of_one[0] = 7.0
    level = replace(
        level,
        freedoms=np.array([10.0, 1e3, 1e4]),
        shares=of_one,
        known_score_covariance=np.zeros((1, 1)),
    )
    for unit in (1e-6, 1.0, 1e6):
        told = SimpleNamespace(prior=np.zeros((1, 1)), fit=SimpleNamespace(root=unit * np.eye(1)))
        _, freedom = level.score_covariance("by-marker", told, 1)
        assert freedom == pytest.approx(10.0)


@pytest.mark.parametrize("errors", ERRORS)
@pytest.mark.parametrize("name", PROBLEMS)
def test_intervals_contain_the_truth_for_any_stated_sigma(name, errors):
    held = [
        np.abs(wrong) < each.quantiles * np.sqrt(np.diag(each.covariance))
        for each, wrong in found(name, errors)
    ]
    assert LEAST <= np.mean(held) <= MOST
    assert (np.mean(held, axis=0) >= LEAST).all()


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_kind_of_error_bars_follows_the_residuals(name):
    share = {
        errors: np.mean([each.noise == kind for each, _ in found(name, errors)])
        for errors, kind in zip(
            ERRORS, ("given", "estimated", "estimated", "by-marker"), strict=True
        )
    }
    assert share["faultless"] > 0.9  # tests of 5, 1 and 1 %
    assert min(share.values()) > 0.9
    assert share["one marker three times as noisy"] == 1.0


@pytest.mark.parametrize("name", PROBLEMS)
def test_p_values_are_uniform_without_a_fault(name):
    levels = [each.level for each, _ in found(name, "faultless")]
    for values in ([x.larger_p for x in levels], [x.unequal_p for x in levels]):
        assert kstest(values, "uniform").pvalue > 1e-3


def test_variances_of_the_markers_are_found_without_bias():
    for name in PROBLEMS:
        levels = [each.level for each, _ in found(name, "one marker three times as noisy")]
        mean = np.mean([level.variances for level in levels], axis=0)
        truth = [9.0 if name.endswith("m0") else 1.0 for name in levels[0].names]
        np.testing.assert_allclose(mean, truth, rtol=0.08)
        spread = np.std([level.variances for level in levels], axis=0) / truth
        np.testing.assert_allclose(spread, np.sqrt(2 / levels[0].freedoms), rtol=0.3)


@pytest.mark.long
def test_markers_of_different_noise_need_their_own_variance():
    """Parameters that a noisy marker alone tells."""
    of = problem((60,), markers=2, offsets=False)
    slopes = of.slopes[0].copy()
    slopes[:, 1, :, 0], slopes[:, 0, :, 1:] = 0.0, 0.0
    split = replace(of, slopes=(slopes,))
    held = {"auto": [], "estimated": []}
    for fit, wrong in draws(split, (3.0, 0.5), 200):
        for noise, hits in held.items():
            each = uncertainty_from_fit(fit, PARAMETERS, wrong[:4], ErrorModel(noise))  # type: ignore[arg-type]
            half = each.quantiles * np.sqrt(np.diag(each.covariance))
            hits.append((np.abs(wrong[:4]) < half)[0])
    assert np.mean(held["estimated"]) < 0.9 < np.mean(held["auto"])


def test_expected_model_errors_are_no_noise():
    of = PROBLEMS["three markers"]
    rng = np.random.default_rng(0)
    variance = np.zeros((60, 3, 3))
    variance[:, 1] = 8.0
    extra = np.sqrt(variance) * rng.normal(size=(400, *variance.shape))
    errors = np.sqrt(1 + variance) * rng.normal(size=variance.shape)
    fit, wrong = of.fit([errors], np.zeros(len(of.names)))
    factored = factorise_information(fit)
    assert estimate_noise_level(fit, factored).suggest_noise() == "by-marker"
    known = estimate_noise_level(fit.with_disturbances([extra]), factored)
    assert known.suggest_noise() == "given"
    assert known.pooled == pytest.approx(1.0, abs=1.0)  # a deviation of 0.32
    without, widened = (
        uncertainty_from_fit(
            each, PARAMETERS, wrong[:4], ErrorModel("given", "independent")
        ).covariance
        for each in (fit, fit.with_disturbances([extra]))
    )
    assert (np.diag(widened) > 1.5 * np.diag(without)).any()
    rows = fit.blocks[0].jacobian.reshape(-1, len(of.names))
    prior = np.diag(fit.prior_jacobian**2)
    inverse = np.linalg.inv(rows.T @ rows + prior)
    more = rows.T @ ((1 + variance).reshape(-1, 1) * rows) + prior
    expected = np.sqrt(np.diag(inverse @ more @ inverse)[:4])
    found = np.sqrt(np.diag(widened))
    # Of 400 draws a deviation is known to 1 / sqrt(800).
    np.testing.assert_allclose(found, expected, rtol=4 / np.sqrt(800))


@pytest.mark.parametrize("noise", ["auto", "estimated"])
def test_uncertainties_of_correlated_errors_contain_expected_model_errors(noise):
    """A marker that sways slowly, which an autoregression of all markers misses."""
    of, rng = PROBLEMS["three markers"], np.random.default_rng(0)
    samples = np.zeros((201, *of.present[0].shape, 3))
    steps = rng.normal(size=(201, 64, 3))
    samples[:, :, 1] = 1.3 * sum(steps[:, k : k + 60] for k in range(5))
    fit, wrong = of.fit([samples[0] + rng.normal(size=samples[0].shape)], np.zeros(len(of.names)))
    fit = fit.with_disturbances([samples[1:]])
    correlated, independent = (
        np.diag(
            uncertainty_from_fit(fit, PARAMETERS, wrong[:4], ErrorModel(noise, errors)).covariance
        )
        for errors in ("autocorrelated", "independent")
    )
    assert (correlated > 0.999999 * independent).all()


# Words


def notes(deviations: tuple[float, ...], **options) -> tuple[str, ...]:
    fit, wrong = next(draws(PROBLEMS["three markers"], deviations, 1))
    return uncertainty_from_fit(fit, PARAMETERS, wrong[:4], ErrorModel(**options)).notes


def test_a_wrong_sigma_is_reported_with_how_much():
    assert notes((1.0,)) == ()
    (large,) = notes((2.5,))
    assert (
        "times as large as expected from sigma_m; the error bars are computed from the residuals"
    ) in large
    assert any(f"{factor:.2g} times" in large for factor in np.arange(2.2, 2.9, 0.1))
    (small,) = notes((1 / 3,))
    assert "only 0.3" in small
    assert "times too large" in small
    (uneven,) = notes((3.0, 1.0, 1.0))
    assert "(swing 0/m0) times as large" in uneven
    (trusted,) = notes((2.5,), noise="given")
    assert "too small by about that much" in trusted


# A whole identification


@pytest.mark.parametrize("claimed", [0.3, 3.0, "uneven"])
def test_intervals_of_a_whole_identification_follow_the_residuals(claimed):
    sigma_m, held = 1e-3, []
    experiment, x = reference(sigma_m)
    deviations = np.ones(len(experiment.markers.names))
    if claimed == "uneven":
        deviations[0] = 3.0
    else:
        deviations[:] = 1 / claimed
    stated = replace(experiment, markers=replace(experiment.markers, sigma_m=sigma_m / deviations))
    for seed in range(2):
        collocation = twin(stated, x, CASES[0], sigma_m, np.random.default_rng(seed))
        solution = ReducedSpace(tolerance=1e-6, ladder=(1.0,))(collocation)
        fit = linearise_fit(collocation, solution.z)
        each = uncertainty_from_fit(fit, collocation.parameters, solution.q)
        assert each.noise == ("by-marker" if claimed == "uneven" else "estimated")
        for name, value in truth().items():
            low, high = {**each.estimates, **each.derived}[name].statistical95 or (0.0, np.inf)
            held.append(low <= value <= high)
    assert np.mean(held) >= 0.75  # of two twins, whose quantities are related
