"""The nonlinear program as a CasADi function, for solvers of CasADi that a user calls."""

from __future__ import annotations

from functools import cache
from typing import Any, Literal

import casadi as ca
import numpy as np
import pytest
from kit.memories import guesses, recorded, truth
from kit.problems import GUESS, hung_cube, noisy

import collocation_sysid as cs
from collocation_sysid.program.collocation import Collocation

# Solvers with their Hessian, options, and whether they get the derivatives directly.
SQP = {"qpsol": "piqp", "print_iteration": False, "print_header": False, "print_status": False}
SOLVERS: dict[str, tuple[str, Literal["exact", "gauss-newton"], dict[str, Any], bool]] = {
    "ipopt": ("ipopt", "exact", {"ipopt.print_level": 0}, True),
    "sqpmethod": ("sqpmethod", "gauss-newton", SQP | {"tol_du": 1e-8}, True),
    "sleqp": ("sleqp", "exact", {"print_level": 0}, True),
    "fatrop": ("fatrop", "exact", {"fatrop.print_level": 0}, False),
    "ipopt with derived derivatives": ("ipopt", "exact", {"ipopt.print_level": 0}, False),
}


@cache
def cube() -> Collocation:
    near = GUESS.with_guess({"mu_pa": 160.0})
    return Collocation([noisy(hung_cube(6, (1, 1, 1)), 1e-4, seed=5)], near)


@pytest.mark.parametrize("solver", SOLVERS)
def test_solvers_of_casadi_find_the_answer_of_the_package(solver: str):
    plugin, hessian, options, is_direct = SOLVERS[solver]
    nlp = cube().casadi(hessian)
    direct = nlp.derivatives(plugin) if is_direct else {}
    # Runs of sleqp differ, as on programs of expressions: one in thirty ends at a dead point.
    for _ in range(3 if plugin == "sleqp" else 1):
        solve = ca.nlpsol("solver", plugin, nlp, {"print_time": False, **options, **direct})
        found = solve(**nlp.arguments)
        if solve.stats()["return_status"] != "deadpoint":
            break
    reference = cs.ReducedSpace()(cube())
    # sleqp stops at 1e-6.
    near = 1e-3 if plugin == "sleqp" else 1e-5
    np.testing.assert_allclose(found["x"].full().ravel(), reference.z, atol=near)
    np.testing.assert_allclose(found["lam_g"].full().ravel(), reference.multipliers, atol=near)


def test_functions_are_those_of_the_program():
    program, nlp = cube(), cube().casadi()
    rng = np.random.default_rng(2)
    z = nlp.arguments["x0"] + 1e-2 * rng.normal(size=program.variable_count)
    multipliers = rng.normal(size=program.constraint_count)
    assert nlp.name_in() == ["x", "p"]
    assert nlp.name_out() == ["f", "g"]
    assert float(nlp.f(z, [])) == program.objective(z)
    np.testing.assert_array_equal(nlp.g(z, []).full().ravel(), program.constraint_values(z))
    np.testing.assert_array_equal(nlp.grad_f(z, []).full().ravel(), program.gradient(z))
    jacobian = nlp.jac_g(z, []).sparse()
    assert abs(jacobian - program.jacobian(z)).max() == 0
    upper = ca.triu2symm(nlp.hess_l(z, [], 2.0, multipliers)).sparse()
    assert abs(upper - program.hessian(z, 2.0, multipliers)).max() == 0
    gauss_newton = program.casadi("gauss-newton").hess_l(z, [], 2.0, multipliers)
    assert abs(ca.triu2symm(gauss_newton).sparse() - program.hessian(z, 2.0, None)).max() == 0
    lower, upper_bounds = program.bounds()
    np.testing.assert_array_equal(nlp.arguments["lbx"], lower)
    np.testing.assert_array_equal(nlp.arguments["ubx"], upper_bounds)


def test_casadi_derives_the_same_hessian():
    program, nlp = cube(), cube().casadi()
    x, y = ca.MX.sym("x", program.variable_count), ca.MX.sym("y", program.constraint_count)
    value, rows = nlp(x, ca.MX(0, 1))
    derived = ca.Function("h", [x, y], [ca.hessian(2.0 * value + ca.dot(y, rows), x)[0]])
    z = nlp.arguments["x0"]
    multipliers = np.random.default_rng(3).normal(size=program.constraint_count)
    own = program.hessian(z, 2.0, multipliers)
    assert abs(derived(z, multipliers).sparse() - own).max() < 1e-12 * abs(own).max()


def test_eliminated_variables_have_to_be_variables():
    experiment = recorded("hung-cube", 4)
    problem = cs.Problem([experiment], guesses(truth(1)))
    with pytest.raises(cs.InputError, match=r"expected problem.collocation\(lifted=True\)"):
        problem.collocation().casadi()
    program = problem.collocation(lifted=True)
    nlp = program.casadi()
    assert nlp.size1_in(0) == program.variable_count > problem.collocation().variable_count
    z = nlp.arguments["x0"]
    step = 1e-6 * np.random.default_rng(4).normal(size=len(z))
    change = (nlp.g(z + step, []) - nlp.g(z - step, [])).full().ravel() / 2
    slope = nlp.jac_g(z, []).sparse() @ step
    np.testing.assert_allclose(change, slope, atol=1e-5 * abs(slope).max())


def test_other_solvers_have_no_direct_derivatives():
    with pytest.raises(cs.InputError, match="'fatrop'; expected one of ipopt, sqpmethod, sleqp"):
        cube().casadi().derivatives("fatrop")


def test_a_program_has_no_other_hessians():
    with pytest.raises(cs.InputError, match="'bfgs'; expected one of"):
        cube().casadi("bfgs")  # pyright: ignore


def test_patterns_are_drawn():
    figure = cube().plot()
    jacobian, hessian = figure.axes
    assert jacobian.get_title().endswith(f"{len(cube().jacobian_structure[1])} entries")
    upper = ca.DM.ones(cube().casadi().hess_l.sparsity_out(0))
    assert hessian.get_title().endswith(f"{ca.triu2symm(upper).nnz()} entries")


def test_a_collocation_is_made_from_a_problem_by_its_method():
    with pytest.raises(TypeError, match=r"other constructors: problem.collocation\(\)"):
        cs.Collocation(cs.Problem(cube().experiments, GUESS))  # pyright: ignore
