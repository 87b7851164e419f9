"""The augmented Lagrangian finds the constrained optimum at moderate ρ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from problems_small import GUESS, SMALL_EXPERIMENTS, TRUTH, hung_cube, measured
from test_penalty import collocation_of, noisy

from collocation_sysid.errors import InputError
from collocation_sysid.methods.augmented_lagrangian import AugmentedLagrangianOptions, solve
from collocation_sysid.methods.penalty import PenaltyOptions
from collocation_sysid.methods.penalty import solve as penalty
from collocation_sysid.methods.reduced_space import solve as reduced_space
from collocation_sysid.methods.solution import Iteration, Status
from collocation_sysid.nlp.collocation import Collocation

QUICK = sorted(set(SMALL_EXPERIMENTS) - {"quadratic-bar", "cube-with-unknowns", "released-cube"})


@pytest.mark.parametrize("name", SMALL_EXPERIMENTS)
def test_the_true_parameters_are_recovered(name: str):
    solution = solve(collocation_of(name))
    assert solution.status is Status.CONVERGED
    found = [solution.parameters[key] for key in TRUTH]
    np.testing.assert_allclose(found, list(TRUTH.values()), rtol=2e-3)


@pytest.mark.parametrize("name", QUICK)
def test_with_noise_it_is_the_optimum_of_the_reduced_space(name: str):
    collocation = collocation_of(name, noise_m=1e-3, steps=12)
    solution, reference = solve(collocation), reduced_space(collocation)
    assert solution.status is Status.CONVERGED
    np.testing.assert_allclose(solution.theta, reference.theta, rtol=1e-4)
    np.testing.assert_allclose(solution.multipliers, reference.multipliers, atol=1e-2)
    assert solution.kkt_residual < 2e-6
    assert solution.max_violation_relative < 1e-7


def test_explicit_grasps_have_multipliers_too():
    made = noisy(measured(hung_cube()), 1e-3)
    collocation = Collocation([made], GUESS, explicit_grasps=True)
    solution = solve(collocation)
    assert solution.status is Status.CONVERGED
    assert solution.kkt_residual < 2e-6


def test_it_leaves_far_less_slack_than_a_penalty_of_the_same_weight():
    collocation = collocation_of("hung-cube", noise_m=1e-3)
    paid = penalty(
        collocation, PenaltyOptions("levenberg-marquardt", "constant", rho=1e6, violation=1.0)
    )
    multiplied = solve(collocation, AugmentedLagrangianOptions(rho_max=1e6))
    assert multiplied.max_violation_n < 1e-3 * paid.max_violation_n


def test_gradients_alone_get_near_with_multipliers():
    collocation = collocation_of("released-cube", 0.0, 5)
    options = AugmentedLagrangianOptions("cg-descent", rho=1e2, max_iterations=400)
    solution = solve(collocation, options)
    assert solution.rms_m < 0.05 * solution.history[0].rms_m


def test_a_rho_max_too_small_is_told():
    collocation = collocation_of("hung-cube", noise_m=1e-3)
    options = AugmentedLagrangianOptions(rho=1e1, rho_max=1e1, max_iterations=40)
    solution = solve(collocation, options)
    assert solution.status in (Status.STALLED, Status.ITERATION_LIMIT)
    assert "of the largest force) is left" in solution.message


def test_an_interruption_keeps_the_last_iterate():
    def interrupt(line: Iteration) -> None:
        if line.number >= 2:
            raise KeyboardInterrupt

    solution = solve(collocation_of("hung-cube"), watch=interrupt)
    assert solution.status is Status.INTERRUPTED
    assert solution.rms_m < solution.history[0].rms_m


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"inner": "simplex"}, "inner = 'simplex'; expected one of cg-descent"),
        ({"rho": -1.0}, "rho = -1; expected a positive number"),
        ({"rho_factor": 0.5}, "rho_factor = 0.5; expected above 1"),
        ({"rho_max": 1.0}, r"rho_max = 1 with rho = 100000; expected rho_max to be no less"),
    ],
)
def test_bad_options_are_refused(options: dict, said: str):
    with pytest.raises(InputError, match=said):
        solve(collocation_of("hung-cube"), replace(AugmentedLagrangianOptions(), **options))
