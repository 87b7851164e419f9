"""Autocovariances of errors, estimated from residuals that contain only a part of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.fits import Problem, autoregressive, problem
from scipy.linalg import block_diag, toeplitz

from collocation_sysid.statistics.linearised import LinearisedFit, factorise_information
from collocation_sysid.statistics.residuals.autocorrelation import error_processes, lagged_products

LAG = 2
PROBLEMS = {
    "one": problem((30,), markers=1),
    "two": problem((30, 20), markers=1),
    "gaps": problem((30,), markers=2, missing=0.2),
}


def some_fit(of: Problem, phi: float = 0.9, seed: int = 0) -> LinearisedFit:
    rng = np.random.default_rng(seed)
    errors = [autoregressive(rng, *present.shape, phi) for present in of.present]
    return of.fit(errors, np.zeros(len(of.names)))[0]


def dense(of: Problem, by_experiment: list[np.ndarray]) -> np.ndarray:
    """Matrix of all measurements, from one of the times (T, T) of each experiment."""
    blocks = []
    for matrix, present in zip(by_experiment, of.present, strict=True):
        seen = np.repeat(present, 3, axis=1).ravel()
        blocks.append(np.kron(matrix, np.eye(3 * present.shape[1])) * np.outer(seen, seen))
    return block_diag(*blocks)


@pytest.mark.parametrize("name", PROBLEMS)
def test_lags_explain_the_expected_products_of_residuals(name):
    of = PROBLEMS[name]
    fit = some_fit(of)
    factored = factorise_information(fit)
    lengths = [len(present) for present in of.present]
    found = lagged_products(fit, factored, [LAG] * len(lengths))
    true = [0.7**k * 0.9 ** np.arange(length) for k, length in enumerate(lengths)]
    tails = [np.where(np.arange(len(gamma)) > LAG, gamma, 0.0) for gamma in true]
    explained = found.expected @ np.concatenate([gamma[: LAG + 1] for gamma in true])
    explained += found.long_lag_products(fit, factored, tails)

    slopes = np.concatenate(
        [slope.reshape(-1, slope.shape[2]) for slope in factored.scaled_jacobians]
    )
    maker = np.eye(len(slopes)) - slopes @ slopes.T
    of_residuals = maker @ dense(of, [toeplitz(gamma) for gamma in true]) @ maker
    expected = []
    for k, length in enumerate(lengths):
        for lag in range(LAG + 1):
            diagonals = [np.zeros((other, other)) for other in lengths]
            diagonals[k] = toeplitz(np.arange(length) == lag).astype(float)
            expected.append(np.sum(dense(of, diagonals) * of_residuals))
    np.testing.assert_allclose(explained, expected, rtol=1e-9)


@pytest.mark.parametrize("name", PROBLEMS)
def test_products_are_those_of_residuals_so_many_samples_apart(name):
    of = PROBLEMS[name]
    fit, lengths = some_fit(of), [len(present) for present in of.present]
    expected = []
    for block, length in zip(fit.blocks, lengths, strict=True):
        residual, distance = block.channels[0], np.arange(length)
        for lag in range(LAG + 1):
            apart = toeplitz(distance == lag).astype(float)
            expected.append(np.einsum("tc,ts,sc->", residual, apart, residual))
    found = lagged_products(fit, factorise_information(fit), [LAG] * len(lengths))
    np.testing.assert_allclose(found.products, expected, rtol=1e-9)


def test_experiments_have_lags_of_their_own():
    of, lags = PROBLEMS["two"], (1, 3)
    fit = some_fit(of)
    found = lagged_products(fit, factorise_information(fit), lags)
    first, second = found.autocovariances()
    assert (len(first), len(second)) == (2, 4)
    np.testing.assert_allclose(found.expected @ [*first, *second], found.products, atol=1e-9)
    np.testing.assert_array_equal(np.concatenate(found.split(np.arange(6.0))), np.arange(6))
    three = replace(found, lags=(0, 2, 1)).split(np.arange(6.0))
    assert [part.tolist() for part in three] == [[0.0], [1.0, 2.0, 3.0], [4.0, 5.0]]
    beyond = np.arange(6.0)
    less = np.concatenate(found.autocovariances(beyond))
    np.testing.assert_allclose(found.expected @ less, found.products - beyond, atol=1e-9)


def test_the_size_of_errors_is_found_where_offsets_hide_their_mean():
    of, variances, lag1 = problem((60,), markers=4), [], []
    for seed in range(60):
        fit = some_fit(of, 0.85, seed)
        (process,) = error_processes(fit, factorise_information(fit))
        variances.append(np.diag(process.channel_covariance).mean())
        lag1.append(process.autocorrelation[1])
    assert np.mean(variances) == pytest.approx(1.0, abs=4 * np.std(variances) / np.sqrt(60))
    assert np.mean(lag1) == pytest.approx(0.85, abs=4 * np.std(lag1) / np.sqrt(60))
    assert np.std(variances) < 0.2


def test_error_bars_stay_sane_where_errors_hardly_forget():
    of = problem((60,), markers=4)
    for seed in range(20):
        fit = some_fit(of, 0.98, seed)
        (process,) = error_processes(fit, factorise_information(fit))
        assert process.degrees_of_freedom > 5


def test_rounding_is_no_process():
    fit = some_fit(PROBLEMS["one"])
    silent = tuple(replace(block, residual=0 * block.residual) for block in fit.blocks)
    (process,) = error_processes(replace(fit, blocks=silent), factorise_information(fit))
    assert process.order == 0
    np.testing.assert_array_equal(process.channel_covariance, 0.0)
