"""The conjugate gradient method on standard functions, compared with SciPy."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import check_grad, rosen, rosen_der
from scipy.optimize import minimize as scipy_minimise

from collocation_sysid.methods.comparison.cg_descent import (
    CgDescentOptions,
    CgResult,
    CgState,
    minimise_cg_descent,
)

OPTIONS = CgDescentOptions(tolerance=1e-6, max_iterations=20_000)


def rosenbrock(x):
    return rosen(x), rosen_der(x)


def powell_singular(x):
    a, b, c, d = x
    r = np.array([a + 10 * b, np.sqrt(5) * (c - d), (b - 2 * c) ** 2, np.sqrt(10) * (a - d) ** 2])
    bend, pull = 2 * (b - 2 * c), 2 * np.sqrt(10) * (a - d)
    jacobian = np.array(
        [
            [1, 10, 0, 0],
            [0, 0, np.sqrt(5), -np.sqrt(5)],
            [0, bend, -2 * bend, 0],
            [pull, 0, 0, -pull],
        ]
    )
    return r @ r, 2 * jacobian.T @ r


def beale(x):
    a, b = x
    powers = np.array([1, 2, 3])
    r = np.array([1.5, 2.25, 2.625]) - a * (1 - b**powers)
    jacobian = np.column_stack([b**powers - 1, a * powers * b ** (powers - 1)])
    return r @ r, 2 * jacobian.T @ r


def ill_conditioned(x):
    weights = np.logspace(0, 4, len(x))
    return 0.5 * weights @ x**2, weights * x


def dixon_price(x):
    count = np.arange(2, len(x) + 1)
    r = 2 * x[1:] ** 2 - x[:-1]
    slope = np.zeros_like(x)
    slope[0] = 2 * (x[0] - 1)
    slope[1:] += 8 * count * r * x[1:]
    slope[:-1] -= 2 * count * r
    return (x[0] - 1) ** 2 + count @ r**2, slope


def wood(x):
    a, b, c, d = x
    value = 100 * (b - a**2) ** 2 + (1 - a) ** 2 + 90 * (d - c**2) ** 2 + (1 - c) ** 2
    value += 10 * (b + d - 2) ** 2 + 0.1 * (b - d) ** 2
    both, apart = 20 * (b + d - 2), 0.2 * (b - d)
    slope = [
        -400 * a * (b - a**2) - 2 * (1 - a),
        200 * (b - a**2) + both + apart,
        -360 * c * (d - c**2) - 2 * (1 - c),
        180 * (d - c**2) + both - apart,
    ]
    return value, np.array(slope)


FUNCTIONS = {
    "rosenbrock in 2": (rosenbrock, np.array([-1.2, 1.0])),
    "rosenbrock in 100": (rosenbrock, np.tile([-1.2, 1.0], 50)),
    "powell singular": (powell_singular, np.array([3.0, -1.0, 0.0, 1.0])),
    "beale": (beale, np.array([1.0, 1.0])),
    "quadratic of condition 1e4": (ill_conditioned, np.ones(30)),
    "dixon-price in 10": (dixon_price, np.ones(10)),
    "wood": (wood, np.array([-3.0, -1.0, -3.0, -1.0])),
}


def followed(name: str, options: CgDescentOptions = OPTIONS) -> tuple[CgResult, list[CgState]]:
    function, start = FUNCTIONS[name]
    states: list[CgState] = []
    return minimise_cg_descent(function, start, options, states.append), states


@pytest.mark.parametrize("name", FUNCTIONS)
def test_gradients_of_the_functions_are_right(name: str, rng):
    function, start = FUNCTIONS[name]
    point = start + 0.1 * rng.standard_normal(len(start))
    scale = np.linalg.norm(function(point)[1])
    assert check_grad(lambda x: function(x)[0], lambda x: function(x)[1], point) < 1e-5 * scale


@pytest.mark.parametrize("name", FUNCTIONS)
def test_cg_descent_finds_the_minimum_of_scipy(name: str):
    function, start = FUNCTIONS[name]
    result, _ = followed(name)
    settings = {"gtol": 1e-6, "maxiter": 20_000}
    reference = scipy_minimise(function, start, jac=True, method="CG", options=settings)
    assert result.ending == "converged"
    assert np.abs(result.gradient).max() <= 1e-6
    assert result.value == pytest.approx(reference.fun, abs=1e-6)
    assert result.evaluations < 5 * reference.nfev + 50


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_direction_descends_as_the_theory_guarantees(name: str):
    _, states = followed(name)
    for before, after in itertools.pairwise(states):
        steepness = before.gradient @ before.gradient
        assert after.slope == pytest.approx(after.direction @ before.gradient)
        assert after.slope <= -7 / 8 * steepness * (1 - 1e-9)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_step_satisfies_a_form_of_the_wolfe_conditions(name: str):
    _, states = followed(name)
    for before, after in itertools.pairwise(states):
        slope = after.gradient @ after.direction
        assert slope >= 0.9 * after.slope * (1 + 1e-9)
        largest = max(abs(state.value) for state in states)
        flat = slope <= (2 * 0.1 - 1) * after.slope and after.value <= before.value + 1e-6 * largest
        fallen = after.value - before.value <= 0.1 * after.step * after.slope
        assert flat or fallen


def test_a_point_out_of_the_domain_is_stepped_back_from():
    def barrier(x):
        inside = (x < 1).all()
        value = -np.log(1 - x).sum() - 5 * x.sum() if inside else np.inf
        return value, 1 / (1 - x) - 5 if inside else np.full_like(x, np.nan)

    states: list[CgState] = []
    result = minimise_cg_descent(barrier, np.array([-50.0, 0.5]), OPTIONS, states.append)
    assert result.ending == "converged"
    np.testing.assert_allclose(result.x, 0.8, atol=1e-6)
    assert all((state.x < 1).all() for state in states)


def test_the_value_alone_is_asked_where_that_is_enough():
    asked = []

    def value(x):
        asked.append(x)
        return rosen(x)

    _, start = FUNCTIONS["rosenbrock in 2"]
    alone = minimise_cg_descent(rosenbrock, start, OPTIONS, value=value)
    assert asked
    assert alone.evaluations < minimise_cg_descent(rosenbrock, start, OPTIONS).evaluations


def test_cg_descent_states_why_it_ended():
    _, start = FUNCTIONS["rosenbrock in 2"]
    few = replace(OPTIONS, max_iterations=3)
    assert minimise_cg_descent(rosenbrock, start, few).ending == "iteration-limit"
    assert minimise_cg_descent(rosenbrock, start, OPTIONS, lambda state: True).ending == "stopped"
    assert minimise_cg_descent(rosenbrock, np.ones(2), OPTIONS).ending == "converged"
    nowhere = minimise_cg_descent(lambda x: (np.inf, x), np.ones(2), OPTIONS)
    assert nowhere.ending == "not-finite"
    wrong = minimise_cg_descent(lambda x: (float(x @ x), -2 * x), np.ones(2), OPTIONS)
    assert wrong.ending == "line-search"
