"""Second derivatives in the reduced space, and Huber's loss."""

from __future__ import annotations

import numpy as np
import pytest
from checks import directional_derivative
from problems_small import GUESS, TRUTH, hung_cube, measured

from collocation_sysid.errors import InputError
from collocation_sysid.methods.curvature import exact_curvature
from collocation_sysid.methods.horizon import Horizon, Point
from collocation_sysid.methods.reduced_space import ReducedSpaceOptions, solve
from collocation_sysid.methods.robust import huberised
from collocation_sysid.nlp.collocation import Collocation
from collocation_sysid.nlp.marching import march
from collocation_sysid.nlp.simulation import with_markers


def with_noise(noise_m: float) -> Collocation:
    experiment = measured(hung_cube())
    tracks = experiment.markers.positions_m
    noise = noise_m * np.random.default_rng(2).normal(size=tracks.shape)
    return Collocation([with_markers(experiment, tracks + noise)], GUESS)


def point_at(collocation: Collocation, q: np.ndarray) -> Point:
    segment = collocation.segments[0]
    x = march(segment.experiment, segment.dynamics, collocation.parameters.theta(q))
    return Horizon(collocation, [segment.grid_rows]).evaluate(q, [x])


def test_exact_curvature_completes_the_hessian_of_the_loss(rng):
    collocation = with_noise(5e-3)
    q = np.log(list(TRUTH.values())) + 0.05 * rng.normal(size=4)
    direction = rng.normal(size=4)
    point = point_at(collocation, q)
    hessian = point.slope.T @ point.slope + exact_curvature(collocation, point)

    def half_gradient(at: np.ndarray) -> np.ndarray:
        there = point_at(collocation, at)
        return there.slope.T @ there.residual

    differences = directional_derivative(half_gradient, q, direction, 1e-3)
    np.testing.assert_allclose(
        hessian @ direction, differences, atol=1e-6 * np.abs(differences).max()
    )
    gauss_newton = point.slope.T @ point.slope @ direction
    assert np.abs(gauss_newton - differences).max() > 1e-3 * np.abs(differences).max()


def test_the_exact_hessian_finds_the_same_optimum_of_a_large_residual():
    collocation = with_noise(5e-3)
    gauss_newton = solve(collocation)
    exact = solve(collocation, ReducedSpaceOptions(hessian="exact"))
    assert exact.status.converged
    np.testing.assert_allclose(exact.theta, gauss_newton.theta, rtol=1e-6)
    assert exact.kkt_residual < 1e-8


def test_huberised_residuals_square_to_hubers_loss_with_its_gradient(rng):
    residual = rng.normal(size=12) * np.repeat([0.3, 1.0, 5.0, 20.0], 3)
    slope, direction = rng.normal(size=(12, 2)), rng.normal(size=2)

    def loss(step: np.ndarray) -> np.ndarray:
        length = np.linalg.norm((residual + slope @ step).reshape(-1, 3), axis=1)
        return np.array([np.where(length > 2, 4 * length - 4, length**2).sum()])

    shrunk, weighted = huberised(residual, slope, 2.0)
    assert shrunk @ shrunk == pytest.approx(loss(np.zeros(2))[0])
    expected = directional_derivative(loss, np.zeros(2), direction, 1e-4)[0]
    assert 2 * shrunk @ weighted @ direction == pytest.approx(expected, rel=1e-6)


def test_hubers_loss_is_not_led_astray_by_swapped_markers():
    collocation = with_noise(5e-4)
    experiment = collocation.segments[0].experiment
    tracks = experiment.markers.positions_m.copy()
    tracks[4:7, [0, 1]] = tracks[4:7, [1, 0]]
    swapped = Collocation([with_markers(experiment, tracks)], GUESS)
    truth = np.log(list(TRUTH.values()))
    best = np.abs(solve(collocation).q - truth).max()
    squared = np.abs(solve(swapped).q - truth).max()
    huber = solve(swapped, ReducedSpaceOptions(huber=2.0))
    assert huber.status.converged
    assert any("Huber" in note for note in huber.notes)
    assert np.abs(huber.q - truth).max() < 0.5 * squared
    assert np.abs(huber.q - truth).max() < best + 0.3


@pytest.mark.parametrize("options", [{"hessian": "limited-memory"}, {"huber": 0.0}])
def test_options_that_mean_nothing_are_refused(options: dict):
    with pytest.raises(InputError, match=next(iter(options))):
        solve(with_noise(1e-3), ReducedSpaceOptions(**options))
