"""Square-root information: sums of squares, steps and errors of all rows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from collocation_sysid.program.least_squares import SquareRootInformation


def test_an_update_of_the_triangle_is_the_sum_of_the_normal_equations(rng):
    p, parts = (rng.normal(size=3), [(rng.normal(size=5), rng.normal(size=(5, 3))) for _ in "ab"])
    separate = [SquareRootInformation.empty(3).with_rows(r, s, p) for r, s in parts]
    joined = separate[0].with_problem(separate[1])
    expected = sum(each.triangle.T @ each.triangle for each in separate)
    np.testing.assert_allclose(joined.triangle.T @ joined.triangle, expected, atol=1e-12)
    residual = np.concatenate([r for r, _ in parts])
    assert joined.loss(p) == pytest.approx(residual @ residual)
    assert joined.row_count == 10
    slope = np.vstack([s for _, s in parts])
    best = p - np.linalg.lstsq(slope, residual, rcond=None)[0]
    wide = np.full(3, 1e3)
    np.testing.assert_allclose(joined.minimiser(-wide, wide), best, atol=1e-10)
    np.testing.assert_allclose(joined.covariance(), np.linalg.inv(slope.T @ slope), atol=1e-10)


def test_rows_of_some_parameters_join_those_of_all(rng):
    residual, slope, places = (rng.normal(size=6), rng.normal(size=(6, 2)), np.array([0, 3]))
    whole = np.zeros((6, 4))
    whole[:, places] = slope
    found = SquareRootInformation.empty(4).with_problem(
        SquareRootInformation.empty(2).with_rows(residual, slope), places
    )
    np.testing.assert_allclose(found.information, whole.T @ whole, atol=1e-12)
    np.testing.assert_allclose(found.score, whole.T @ residual, atol=1e-12)


def test_the_best_between_bounds_is_that_of_bounded_least_squares(rng):
    for _ in range(20):
        slope, residual = rng.normal(size=(9, 6)), rng.normal(size=9)
        known = SquareRootInformation.empty(6).with_rows(residual, slope)
        lower, upper = -rng.uniform(0.01, 0.3, 6), rng.uniform(0.01, 0.3, 6)
        expected = lsq_linear(slope, -residual, (lower, upper), method="bvls", tol=1e-14).x
        np.testing.assert_allclose(known.minimiser(lower, upper), expected, atol=1e-7)


@pytest.mark.parametrize("rows", [0, 2, 9])
def test_the_shortest_of_several_minimisers_is_found(rng, rows):
    slope, residual = rng.normal(size=(rows, 4)), rng.normal(size=rows)
    slope[:, 3] = slope[:, 1]
    found = (
        SquareRootInformation.empty(4)
        .with_rows(residual, slope)
        .minimiser(np.full(4, -9.0), np.full(4, 9.0))
    )
    np.testing.assert_allclose(found, np.linalg.lstsq(slope, -residual)[0], atol=1e-10)


def test_directions_that_no_row_is_in_have_infinite_variance(rng):
    slope = rng.normal(size=(9, 4)) * [1.0, 1e4, 1.0, 1.0]
    slope[:, 2] = 3 * slope[:, 0]
    found = SquareRootInformation.empty(4).with_rows(np.zeros(9), slope)
    np.testing.assert_array_equal(found.is_undetermined, [True, False, True, False])
    np.testing.assert_array_equal(np.isinf(np.diag(found.covariance())), found.is_undetermined)
    alone = SquareRootInformation.empty(3).with_rows(
        np.zeros(9), slope[:, :3] + np.eye(9, 3) @ np.diag([0, 0, 1])
    )
    assert not alone.is_undetermined.any()
    with_scores = found.root.T @ slope.T @ slope @ found.root
    np.testing.assert_allclose(with_scores, np.eye(3), atol=1e-10)


def test_errors_of_another_size_scale_the_covariance(rng):
    found = SquareRootInformation.empty(3).with_rows(rng.normal(size=9), rng.normal(size=(9, 3)))
    np.testing.assert_allclose(found.covariance(4 * np.eye(3)), 4 * found.covariance())
    np.testing.assert_allclose(found.standard_errors**2, np.diag(found.covariance()))


def test_the_reduced_information_is_the_inverse_of_the_marginal_covariance(rng):
    found = SquareRootInformation.empty(5).with_rows(rng.normal(size=9), rng.normal(size=(9, 5)))
    share = found.marginal(2)
    np.testing.assert_allclose(share.covariance(), found.covariance()[:2, :2], atol=1e-10)
    wide = np.full(5, 1e3)
    np.testing.assert_allclose(
        share.minimiser(-wide[:2], wide[:2]), found.minimiser(-wide, wide)[:2], atol=1e-10
    )


@pytest.mark.filterwarnings("error")
def test_the_loss_of_a_divergent_trial_step_is_infinite_without_a_warning(rng):
    information = SquareRootInformation.empty(2).with_rows(
        rng.normal(size=4), rng.normal(size=(4, 2)), np.zeros(2)
    )
    assert information.loss(np.full(2, 1e200)) == np.inf


@pytest.mark.filterwarnings("error")
def test_the_best_between_bounds_does_not_depend_on_the_size_of_the_residuals(rng):
    slope, residual = rng.normal(size=(9, 3)), rng.normal(size=9)
    bounds = np.full(3, -0.1), np.full(3, 0.1)
    usual, huge = (
        SquareRootInformation(
            size * SquareRootInformation.empty(3).with_rows(residual, slope).triangle
        )
        for size in (1.0, 1e180)
    )
    expected = usual.minimiser(*bounds)
    assert np.abs(expected).max() == 0.1
    np.testing.assert_allclose(huge.minimiser(*bounds), expected, atol=1e-12)
