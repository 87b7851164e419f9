"""Single shooting: gradients, optimum, and messages when a simulation fails."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.problems import (
    GUESS,
    SMALL_EXPERIMENTS,
    TRUTH,
    as_theta,
    bar_in_two_hands,
    bar_let_go,
    hung_cube,
    measured,
    noisy,
    relative_errors,
)

from collocation_sysid.errors import InputError, SimulationError
from collocation_sysid.methods.comparison import shooting
from collocation_sysid.methods.comparison.shooting import (
    Shooting,
    adjoint_gradient,
    simulate_variables,
)
from collocation_sysid.methods.loss_curvature import sensitivities
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.methods.solution import Iteration, Status
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.recording import Experiment

GRADIENTS = ("forward", "adjoint")


def with_noise(experiment: Experiment, noise_m: float = 1e-3, **changes) -> Collocation:
    return Collocation([noisy(experiment, noise_m)], GUESS, **changes)


def some_parameters(collocation: Collocation) -> np.ndarray:
    rng = np.random.default_rng(3)
    p = np.concatenate([np.log(list(TRUTH.values())), np.zeros(collocation.nphi)])
    return p + 0.1 * rng.normal(size=len(p))


def softened(factor: float) -> Parameters:
    """Moduli so low that no rest state is found."""
    soft = [replace(item, guess=item.guess / factor, lower=1e-4) for item in GUESS.items[:2]]
    return Parameters((*soft, *GUESS.items[2:]))


@cache
def cube() -> Collocation:
    return Collocation([measured(hung_cube(6))], GUESS)


# Gradients


def test_the_adjoint_gradient_is_the_sensitivities_share_of_the_loss():
    collocation = with_noise(bar_let_go())
    z = simulate_variables(collocation, some_parameters(collocation))
    (by_p,) = sensitivities(collocation, z)
    _, (by_x,) = collocation.unpack(collocation.gradient(z))
    by_x = by_x / collocation.transcriptions[0].length_m ** 2  # a slope, not a length
    expected = np.einsum("td,tdm->m", by_x, by_p)
    np.testing.assert_allclose(adjoint_gradient(collocation, z), expected, rtol=1e-8)


# The answer


@pytest.mark.parametrize(
    "experiment", ["hung-cube", "released-cube", "quadratic-bar", "bar-with-nuisance", "driven-bar"]
)
def test_the_true_parameters_are_recovered(experiment: str):
    solution = Shooting()(Collocation([measured(SMALL_EXPERIMENTS[experiment]())], GUESS))
    assert solution.status is Status.CONVERGED
    assert np.abs(relative_errors(solution)).max() < 1e-8
    assert solution.rms_m < 1e-9
    assert solution.max_violation_relative < 1e-9
    assert solution.kkt_residual < 1e-9


@pytest.mark.parametrize("gradient", GRADIENTS)
@pytest.mark.parametrize("make", [bar_in_two_hands, bar_let_go])
def test_the_answer_with_noise_is_that_of_the_reduced_space(make, gradient):
    collocation = with_noise(make())
    solution = Shooting(gradient)(collocation)
    reference = ReducedSpace(tolerance=1e-12)(collocation)
    assert solution.status.converged
    np.testing.assert_allclose(solution.q, reference.q, atol=1e-6)
    np.testing.assert_allclose(solution.positions_m[0], reference.positions_m[0], atol=1e-8)
    np.testing.assert_allclose(solution.multipliers, reference.multipliers, atol=1e-6)
    assert solution.kkt_residual < 1e-7


@pytest.mark.parametrize("gradient", GRADIENTS)
def test_hubers_loss_and_nuisance_parameters_have_the_same_optimum(gradient):
    collocation = with_noise(bar_let_go(), 2e-3, huber=2.0)
    solution, reference = (
        Shooting(gradient)(collocation),
        ReducedSpace(tolerance=1e-12)(collocation),
    )
    np.testing.assert_allclose(solution.q, reference.q, atol=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("gradient", GRADIENTS)
def test_experiments_are_fitted_together_up_to_a_bound(gradient):
    items = [replace(item, upper=250.0) if item.name == "mu_pa" else item for item in GUESS.items]
    made = [measured(hung_cube(8)), measured(bar_in_two_hands(10))]
    collocation = Collocation(made, Parameters(tuple(items)))
    solution, reference = (Shooting(gradient)(collocation), ReducedSpace()(collocation))
    assert solution.status.converged
    assert solution.parameters["mu_pa"] == pytest.approx(250.0, rel=1e-12)
    np.testing.assert_allclose(solution.q, reference.q, atol=1e-5)


def test_shooting_starts_from_given_parameters():
    seen: list[Iteration] = []
    start = cube().pack(np.log(list(TRUTH.values())), [np.zeros((7, 81))])
    solution = Shooting()(cube(), watch=seen.append, start=start)
    assert solution.iterations < 4
    np.testing.assert_allclose([*seen[0].parameters.values()], list(TRUTH.values()))


# Simulations that fail


@pytest.mark.long
@pytest.mark.parametrize("gradient", GRADIENTS)
def test_a_guess_that_cannot_be_simulated_is_a_status(gradient):
    collocation = Collocation([measured(hung_cube())], softened(1000))
    solution = Shooting(gradient)(collocation)
    assert solution.status is Status.NOT_SIMULABLE
    for part in (
        "the values where the search began",
        "if one is given",
        "interior-point",
        "t = 0 s",
    ):
        assert part in solution.message
    assert solution.iterations == 1
    assert np.isfinite(solution.z).all()
    np.testing.assert_allclose(solution.theta, as_theta(softened(1000)))


@pytest.mark.parametrize("gradient", [pytest.param("forward", marks=pytest.mark.long), "adjoint"])
def test_trials_that_cannot_be_simulated_are_stepped_back_from(gradient, monkeypatch):
    def short(collocation, p, stopwatch=None):
        if np.abs(p - GUESS.guess_q).max() > 0.2 and not short.failed:
            short.failed = True
            raise SimulationError("it fails", 0.1)
        return simulate_variables(collocation, p, stopwatch)

    short.failed = False
    monkeypatch.setattr(shooting, "simulate_variables", short)
    solution = Shooting(gradient)(cube())
    assert solution.status is Status.CONVERGED
    *errors, of_mass_damping = np.abs(relative_errors(solution))
    assert max(errors) < 1e-6
    assert of_mass_damping < 1e-5  # it hardly shows: the loss is down to rounding
    assert solution.notes[0].startswith("1 of ")


@pytest.mark.parametrize("gradient", GRADIENTS)
def test_a_search_without_a_simulable_step_stalls_at_the_guess(gradient, monkeypatch):
    def only_the_guess(collocation, p, stopwatch=None):
        if not np.array_equal(p, GUESS.guess_q):
            raise SimulationError("it fails", 0.1)
        return simulate_variables(collocation, p, stopwatch)

    monkeypatch.setattr(shooting, "simulate_variables", only_the_guess)
    solution = Shooting(gradient)(cube())
    assert solution.status is Status.STALLED
    np.testing.assert_allclose(solution.theta, as_theta(GUESS))


# Other ends


@pytest.mark.parametrize(
    ("gradient", "limit", "status"),
    [
        ("forward", {"max_iterations": 3}, Status.ITERATION_LIMIT),
        ("adjoint", {"max_time_s": 1e-9}, Status.TIME_LIMIT),
    ],
)
def test_limits_keep_the_best_simulation(gradient, limit: dict, status: Status):
    solution = Shooting(gradient, **limit)(cube())
    assert solution.status is status
    assert solution.iterations <= 3
    assert solution.parameters == solution.history[-1].parameters
    assert solution.max_violation_relative < 1e-9


@pytest.mark.parametrize("gradient", ["forward", pytest.param("adjoint", marks=pytest.mark.long)])
def test_an_interruption_keeps_the_best_simulation(gradient):
    def interrupt(iteration: Iteration) -> None:
        if iteration.number >= 3:
            os.kill(os.getpid(), signal.SIGINT)

    solution = Shooting(gradient)(cube(), interrupt)
    assert solution.status is Status.INTERRUPTED
    assert solution.parameters == solution.history[-1].parameters


@pytest.mark.parametrize("gradient", GRADIENTS)
def test_the_history_contains_the_observed_iterations_and_its_loss_falls(gradient):
    seen: list[Iteration] = []
    solution = Shooting(gradient)(cube(), seen.append)
    assert list(solution.history) == seen
    losses = [iteration.loss for iteration in seen]
    assert losses == sorted(losses, reverse=True)
    assert seen[-1].loss == pytest.approx(cube().objective(solution.z) * cube().measurement_count)
    timing = solution.timing
    assert min(timing.evaluations, timing.linear_algebra) > 0
    assert timing.evaluations + timing.linear_algebra + timing.build <= timing.total


def test_an_unknown_gradient_is_refused():
    with pytest.raises(InputError, match="gradient: found 'finite'; expected 'forward' or"):
        Shooting("finite")  # pyright: ignore[reportArgumentType]
