"""Second derivatives in the reduced space, and Huber's loss."""

from __future__ import annotations

import numpy as np
import pytest
from kit.checks import directional_derivative
from kit.memories import guesses, recorded, truth
from kit.problems import GUESS, TRUTH, bar_let_go, cube_with_nuisance, hung_cube, noisy

from collocation_sysid.errors import InputError
from collocation_sysid.methods.horizon import Horizon, Iterate
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.loss_curvature import exact_curvature
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.measurement_residual import huber_as_least_squares
from collocation_sysid.program.simulation import with_markers
from collocation_sysid.recording import Experiment


def with_noise(noise_m: float, experiment: Experiment | None = None, **changes) -> Collocation:
    return Collocation([noisy(experiment or hung_cube(), noise_m, seed=2)], GUESS, **changes)


def point_at(collocation: Collocation, p: np.ndarray) -> Iterate:
    (transcription,) = collocation.transcriptions
    q, phi = np.split(p, [collocation.nq])
    setting = transcription.equations_at(q, phi)
    x = simulate_scheme(transcription.experiment, setting.dynamics)
    return Horizon(collocation, [transcription.grid_times]).evaluate(p, [x])


@pytest.mark.parametrize("huber", [None, 4.0])
@pytest.mark.parametrize("experiment", [hung_cube(), bar_let_go(), cube_with_nuisance()])
def test_exact_curvature_completes_the_hessian_of_the_loss(experiment, huber, rng):
    collocation = with_noise(5e-3, experiment, huber=huber)
    count = 4 + collocation.nphi
    p = np.concatenate([np.log(list(TRUTH.values())), np.zeros(collocation.nphi)])
    p += 0.05 * rng.normal(size=count)
    direction = rng.normal(size=count)
    point = point_at(collocation, p)
    hessian = point.fit.information + exact_curvature(collocation, point)

    def half_gradient(at: np.ndarray) -> np.ndarray:
        there = point_at(collocation, at)
        return there.fit.score

    differences = directional_derivative(half_gradient, p, direction, 1e-4)
    np.testing.assert_allclose(
        hessian @ direction, differences, atol=1e-6 * np.abs(differences).max()
    )
    gauss_newton = point.fit.information @ direction
    assert np.abs(gauss_newton - differences).max() > 1e-3 * np.abs(differences).max()


@pytest.mark.long
@pytest.mark.parametrize(
    ("experiment", "huber"), [(bar_let_go(), 2.0), (cube_with_nuisance(), None)]
)
def test_both_methods_find_the_same_optimum_of_all_parameters(experiment, huber):
    collocation = with_noise(1e-3, experiment, huber=huber)
    reduced = ReducedSpace(tolerance=1e-11)(collocation)
    alone = InteriorPoint(initial="simulation", tolerance=1e-10)
    interior = alone(reduced.collocation)  # read in the same elements
    assert reduced.status.converged
    assert interior.status.converged
    assert reduced.kkt_residual < 1e-7
    found, expected = (collocation.parameters_from(s.z) for s in (reduced, interior))
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_the_exact_hessian_finds_the_same_optimum_of_a_large_residual():
    collocation = with_noise(5e-3)
    gauss_newton = ReducedSpace(tolerance=1e-12)(collocation)
    exact = ReducedSpace(hessian="exact", tolerance=1e-12)(collocation)
    assert exact.status.converged
    np.testing.assert_allclose(exact.theta, gauss_newton.theta, rtol=1e-6)
    assert exact.kkt_residual < 1e-8


def test_huberised_residuals_square_to_hubers_loss_with_its_gradient(rng):
    residual = rng.normal(size=(4, 3)) * [[0.3], [1.0], [5.0], [20.0]]
    slope, direction = rng.normal(size=(4, 3, 2)), rng.normal(size=2)

    def loss(step: np.ndarray) -> np.ndarray:
        length = np.linalg.norm(residual + slope @ step, axis=1)
        return np.array([np.where(length > 2, 4 * length - 4, length**2).sum()])

    shrunk, weighted = huber_as_least_squares(residual, slope, 2.0)
    assert np.sum(shrunk**2) == pytest.approx(loss(np.zeros(2))[0])
    expected = directional_derivative(loss, np.zeros(2), direction, 1e-4)[0]
    assert 2 * np.sum(shrunk * (weighted @ direction)) == pytest.approx(expected, rel=1e-6)


def test_hubers_loss_is_not_led_astray_by_swapped_markers():
    collocation = with_noise(5e-4)
    experiment = collocation.transcriptions[0].experiment
    tracks = experiment.markers.positions_m.copy()
    tracks[4:7, [0, 1]] = tracks[4:7, [1, 0]]
    mistaken = with_markers(experiment, tracks)
    truth = np.log(list(TRUTH.values()))
    best = np.abs(ReducedSpace()(collocation).q - truth).max()
    squared = np.abs(ReducedSpace()(Collocation([mistaken], GUESS)).q - truth).max()
    huber = ReducedSpace()(Collocation([mistaken], GUESS, huber=2.0))
    assert huber.status.converged
    assert np.abs(huber.q - truth).max() < 0.5 * squared
    assert np.abs(huber.q - truth).max() < best + 0.3


def test_options_that_mean_nothing_are_refused():
    with pytest.raises(InputError, match="hessian: found 'limited-memory'"):
        ReducedSpace(hessian="limited-memory")  # type: ignore
    with pytest.raises(InputError, match="huber"):
        with_noise(1e-3, huber=0.0)


def test_an_exact_hessian_is_refused_where_there_is_none_before_anything_is_solved():
    def watch(_: object) -> None:
        raise AssertionError("a sweep was made")

    remembers = Collocation([recorded("hung-cube", 4)], guesses(truth(1)))
    with pytest.raises(InputError, match=r"materials with memory .*expected 'gauss-newton'"):
        ReducedSpace(hessian="exact")(remembers, watch)
