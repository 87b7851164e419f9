"""The augmented Lagrangian reaches the constrained optimum at moderate penalty weights."""

from __future__ import annotations

import numpy as np
import pytest
from kit.collocations import collocation_of
from kit.problems import GUESS, TRUTH, hung_cube, noisy

from collocation_sysid.errors import InputError
from collocation_sysid.methods.comparison.penalty import AugmentedLagrangian, Penalty
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.methods.solution import Iteration, Status
from collocation_sysid.program.collocation import Collocation

# Their bands are wide; a penalty of the same steps finds the truth of these every time.
LONG = ("bar-in-two-hands", "cube-with-gaps")
DEAR = ("quadratic-bar", "cube-with-nuisance", "bar-with-nuisance", "driven-bar")


@pytest.mark.parametrize(
    "name",
    [
        *("hung-cube", "released-cube", "bar-let-go"),
        *(pytest.param(name, marks=pytest.mark.long) for name in LONG),
        *(pytest.param(name, marks=pytest.mark.slow) for name in DEAR),
    ],
)
def test_the_true_parameters_are_recovered(name: str):
    # A cube that is let go tells little of γ_m: the last digits of the loss tell it.
    solution = AugmentedLagrangian(tolerance=1e-7)(collocation_of(name, steps=6))
    assert solution.status is Status.CONVERGED
    found = [solution.parameters[key] for key in TRUTH]
    np.testing.assert_allclose(found, list(TRUTH.values()), rtol=2e-3)


@pytest.mark.long
@pytest.mark.parametrize("name", ["hung-cube", "bar-let-go"])
def test_the_answer_with_noise_is_that_of_the_reduced_space(name: str):
    collocation = collocation_of(name, noise_m=1e-3, steps=12)
    solution, reference = (AugmentedLagrangian()(collocation), ReducedSpace()(collocation))
    assert solution.status is Status.CONVERGED
    np.testing.assert_allclose(solution.theta, reference.theta, rtol=1e-4)
    np.testing.assert_allclose(solution.multipliers, reference.multipliers, atol=1e-2)
    assert solution.kkt_residual < 2e-6
    assert solution.max_violation_relative < 1e-7


@pytest.mark.long
def test_explicit_grasps_have_multipliers_too():
    made = noisy(hung_cube(6))
    collocation = Collocation([made], GUESS, has_grasp_constraints=True)
    solution = AugmentedLagrangian()(collocation)
    assert solution.status is Status.CONVERGED
    assert solution.kkt_residual < 2e-6


@pytest.mark.long
def test_the_augmented_lagrangian_leaves_less_slack_than_a_penalty_of_the_same_weight():
    collocation = collocation_of("hung-cube", noise_m=1e-3, steps=6)
    paid = Penalty("levenberg-marquardt", schedule="constant", rho=1e6, violation=1.0)(collocation)
    multiplied = AugmentedLagrangian(rho_max=1e6)(collocation)
    assert multiplied.max_violation_n < 1e-3 * paid.max_violation_n


@pytest.mark.long
def test_gradients_alone_get_near_with_multipliers():
    collocation = collocation_of("released-cube", 0.0, 5)
    options = AugmentedLagrangian("scipy-cg", rho=1e2, max_iterations=400)
    solution = options(collocation)
    assert solution.history[-1].misfit < 0.05 * solution.history[0].misfit


@pytest.mark.long
def test_a_rho_max_too_small_is_reported():
    collocation = collocation_of("hung-cube", noise_m=1e-3, steps=6)
    options = AugmentedLagrangian(rho=1e1, rho_max=1e1, max_iterations=40)
    solution = options(collocation)
    assert solution.status in (Status.STALLED, Status.ITERATION_LIMIT)
    assert "Remaining violation of the equations of motion" in solution.message
    assert "of the largest force)" in solution.message


def test_an_interruption_keeps_the_last_iterate():
    def interrupt(line: Iteration) -> None:
        if line.number >= 2:
            raise KeyboardInterrupt

    solution = AugmentedLagrangian()(collocation_of("hung-cube"), watch=interrupt)
    assert solution.status is Status.INTERRUPTED
    assert solution.history[-1].misfit < solution.history[0].misfit


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"inner": "simplex"}, "inner: found 'simplex'; expected 'scipy-cg'"),
        ({"rho": -1.0}, "rho: found -1.0; expected a number above 0"),
        ({"rho_factor": 0.5}, "rho_factor: found 0.5; expected a number above 1"),
        (
            {"rho_max": 1.0},
            r"rho_max: found 1, which is less than rho = 100000; expected rho or more",
        ),
    ],
)
def test_bad_options_are_refused(options: dict, said: str):
    with pytest.raises(InputError, match=said):
        AugmentedLagrangian(**options)
