"""The penalty method: merit function, inner solvers, schedules and remaining violation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.checks import assert_derivative
from kit.collocations import collocation_of
from kit.problems import (
    GUESS,
    SMALL_EXPERIMENTS,
    cube_with_nuisance,
    hung_cube,
    measured,
    noisy,
    relative_errors,
)

from collocation_sysid.errors import InputError
from collocation_sysid.methods.comparison.conjugate_gradients import minimise_conjugate_gradients
from collocation_sysid.methods.comparison.merit import MeritFunction, MeritPoint, PenaltyProblem
from collocation_sysid.methods.comparison.penalty import Penalty
from collocation_sysid.methods.solution import Iteration, Status
from collocation_sysid.methods.starts.initial_trajectories import initial_variables
from collocation_sysid.program.collocation import Collocation, convert_variables

NEWTON = Penalty(inner="levenberg-marquardt")


def starting(problem: PenaltyProblem, collocation: Collocation) -> np.ndarray:
    z, _ = initial_variables(collocation)
    return convert_variables(z, collocation, target=problem.nlp)


# The merit function


@pytest.mark.parametrize("name", SMALL_EXPERIMENTS)
def test_the_gradient_of_the_merit_is_that_of_differences(name: str, rng):
    collocation = collocation_of(name)
    problem = PenaltyProblem(collocation)
    merit = MeritFunction(problem, 30.0, rng.standard_normal(problem.nlp.constraint_count))
    z = starting(problem, collocation)
    z = z + np.where(problem.is_free, 0.01 * rng.standard_normal(len(z)), 0.0)
    gradient = MeritPoint.evaluate(merit, z).gradient
    assert not gradient[~problem.is_free].any()
    scale = 0.1 * problem.is_free
    assert_derivative(merit.value, lambda d: gradient @ d, z, rng, tolerance=1e-6, scale=scale)


def test_an_inverted_element_costs_infinitely_much():
    collocation = collocation_of("hung-cube")
    problem = PenaltyProblem(collocation)
    merit = MeritFunction(problem, 1.0, np.zeros(problem.nlp.constraint_count))
    z = starting(problem, collocation)
    q, (x,) = problem.nlp.unpack(z)
    inverted = problem.nlp.pack(q, [-x])
    assert np.isfinite(merit.value(z))
    assert merit.value(inverted) == np.inf


# The answer


@pytest.mark.long
@pytest.mark.parametrize("name", SMALL_EXPERIMENTS)
def test_newton_steps_at_large_rho_find_the_truth(name: str):
    solution = replace(NEWTON, rho=1e5, violation=1e-6)(collocation_of(name, steps=6))
    assert solution.status is Status.CONVERGED
    assert np.abs(relative_errors(solution)).max() < 1e-3
    assert solution.max_violation_relative < 1e-6
    assert solution.kkt_residual < 1e-4


@pytest.mark.long
def test_slack_and_bias_fall_as_one_over_rho():
    collocation = collocation_of("hung-cube", noise_m=1e-4)
    weights, slacks, thetas = [1e5, 1e6, 1e7, 1e8], [], []
    start = None
    for rho in weights:
        options = replace(NEWTON, schedule="constant", rho=rho, violation=1.0)
        solution = options(collocation, start=start)
        assert solution.status is Status.CONVERGED
        start = solution.z
        slacks.append(solution.max_violation_n)
        thetas.append(solution.q)
    slope = np.polyfit(np.log(weights[1:]), np.log(slacks[1:]), 1)[0]
    assert slope == pytest.approx(-1.0, abs=0.15)
    moves = np.abs(np.diff(thetas, axis=0)).max(axis=1)
    assert (np.diff(moves) < 0).all()


def test_conjugate_gradients_lower_the_merit_and_stay_upright():
    collocation = collocation_of("hung-cube", 0.0, 5)
    problem = PenaltyProblem(collocation)
    options = Penalty(schedule="constant", rho=1e3, max_iterations=120)
    lines: list[Iteration] = []
    solution = options(collocation, lines.append)
    merit = MeritFunction(problem, 1e3, np.zeros(problem.nlp.constraint_count))
    start, _ = initial_variables(collocation)
    assert merit.value(solution.z) < 1e-3 * merit.value(start)
    assert problem.has_valid_elements(solution.z)
    assert [line.number for line in lines] == sorted({line.number for line in lines})
    lower, upper = problem.lower, problem.upper
    assert ((solution.z >= lower) & (solution.z <= upper)).all()


def test_conjugate_gradients_lower_the_merit_in_every_step():
    collocation = collocation_of("hung-cube", 0.0, 5)
    problem = PenaltyProblem(collocation)
    merit = MeritFunction(problem, 1e3, np.zeros(problem.nlp.constraint_count))
    start, _ = initial_variables(collocation)
    values = []
    minimise_conjugate_gradients(
        merit, start, 1e-12, 150, lambda z, gradient: values.append(merit.value(z))
    )
    assert len(values) > 50
    assert (np.diff(values) < 0).all()


@pytest.mark.slow
def test_conjugate_gradients_find_the_truth_in_the_end():
    collocation = collocation_of("released-cube", 0.0, 6)
    solution = Penalty(rho=1e2, violation=1e-4, max_time_s=600)(collocation)
    assert solution.status is Status.CONVERGED
    assert np.abs(relative_errors(solution)[:2]).max() < 0.05


# Schedules, budgets, and what is said


def test_slack_left_is_not_convergence():
    collocation = collocation_of("hung-cube", noise_m=1e-3)
    solution = replace(NEWTON, schedule="constant", rho=1e3)(collocation)
    assert solution.status is Status.STALLED
    assert "raise rho_max" in solution.message
    assert "N (" in solution.message
    assert "of the largest force)." in solution.message


def test_a_rising_schedule_ends_within_the_violation():
    collocation = collocation_of("hung-cube", noise_m=1e-4)
    solution = replace(NEWTON, rho=1e4)(collocation)
    assert solution.status is Status.CONVERGED
    assert solution.max_violation_relative <= 1e-3
    assert solution.history[-1].violation_n == pytest.approx(solution.max_violation_n)


def test_limits_of_iterations_and_time_end_the_search():
    collocation = collocation_of("hung-cube")
    few = Penalty(max_iterations=7)(collocation)
    assert few.status is Status.ITERATION_LIMIT
    assert few.iterations == 7
    assert few.history[-1].number <= 7
    short = Penalty(max_time_s=1e-9)(collocation)
    assert short.status is Status.TIME_LIMIT
    stage = Penalty(schedule="constant", inner_iterations=5)(collocation)
    assert stage.status is Status.ITERATION_LIMIT
    assert "Raise inner_iterations" in stage.message


@pytest.mark.parametrize(("method", "last"), [(NEWTON, 3), (Penalty(), 60)])
def test_an_interruption_keeps_the_last_and_best_iterate(method: Penalty, last: int):
    collocation = collocation_of("hung-cube")

    def interrupt(line: Iteration) -> None:
        if line.number >= last:
            raise KeyboardInterrupt

    solution = method(collocation, interrupt)
    assert solution.status is Status.INTERRUPTED
    assert solution.history[-1].number == last
    last_loss = solution.history[-1].loss
    assert sum(part.loss for part in solution.parts) == pytest.approx(last_loss)
    assert solution.history[-1].misfit < 0.02 * solution.history[0].misfit


@pytest.mark.long
def test_both_layouts_of_grasps_give_the_same_answer_at_large_rho():
    made = noisy(hung_cube(), 1e-4)
    bounds, rows = (Collocation([made], GUESS, has_grasp_constraints=e) for e in (False, True))
    options = replace(NEWTON, rho=1e8)
    solution, explicit = options(bounds), options(rows)
    np.testing.assert_allclose(solution.z, explicit.z, atol=1e-6)
    assert len(solution.multipliers) == bounds.constraint_count
    assert len(explicit.multipliers) == rows.constraint_count
    low, high = bounds.bounds()
    assert ((solution.z >= low) & (solution.z <= high)).all()


def test_nuisance_parameters_may_be_estimated_by_gradients_alone():
    collocation = Collocation([measured(cube_with_nuisance(5))], GUESS)
    options = Penalty(schedule="constant", rho=1e3, max_iterations=60)
    solution = options(collocation)
    # Conjugate gradients end at the limit of 60 iterations, at 0.09.
    assert solution.history[-1].misfit < 0.1 * solution.history[0].misfit


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            {"inner": "simplex"},
            "inner: found 'simplex'; expected 'scipy-cg' or 'levenberg-marquardt'",
        ),
        ({"schedule": "slow"}, "schedule: found 'slow'; expected 'geometric' or 'constant'"),
        ({"rho": 0.0}, "rho: found 0.0; expected a number above 0"),
        ({"rho_factor": 1.0}, "rho_factor: found 1.0; expected a number above 1"),
        (
            {"rho": 1e9},
            r"rho_max: found 1e\+08, which is less than rho = 1e\+09; expected rho or more",
        ),
        ({"violation": -1.0}, "violation: found -1.0; expected a number above 0"),
    ],
)
def test_bad_options_are_refused(options: dict, said: str):
    with pytest.raises(InputError, match=said):
        Penalty(**options)


def test_a_constant_schedule_has_no_use_for_rho_max():
    assert Penalty(schedule="constant", rho=1e9).last_rho == 1e9


def test_a_start_with_inverted_elements_is_refused():
    collocation = collocation_of("hung-cube")
    z, _ = initial_variables(collocation)
    q, (x,) = collocation.unpack(z)
    with pytest.raises(InputError, match="elements are inverted at the initial point"):
        NEWTON(collocation, start=collocation.pack(q, [-x]))
