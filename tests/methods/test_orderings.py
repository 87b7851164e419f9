"""The benchmark of orderings reads what MUMPS states about its factorisations."""

from __future__ import annotations

import subprocess
import sys

import pytest
from benchmark_orderings import SETTINGS, Factorisations, run_in_own_process

SIZE = 12
# A quadratic program with a dense Hessian: its factor has n (n + 1) / 2 entries.
DENSE = """
import casadi as ca
x = ca.MX.sym("x", {size})
options = {{"ipopt.mumps_print_level": 2, "ipopt.mumps_pivot_order": {order}}}
f = ca.sumsqr(x - 1) + ca.sum1(x) ** 2
ca.nlpsol("solver", "ipopt", {{"x": x, "f": f}}, options)()
"""


def output(order: int) -> str:
    """What MUMPS prints with an ordering."""
    program = DENSE.format(size=SIZE, order=order)
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_statistics_are_those_of_a_dense_matrix() -> None:
    found = Factorisations.from_output(output(order=0))
    assert found is not None
    assert found.ordering == "AMD"
    # One step to the minimum of a quadratic function, which IPOPT finds at once.
    assert found.count == 1
    assert found.entries == SIZE * (SIZE + 1) // 2
    # IPOPT adds its shifts of the diagonal as further entries.
    assert found.nonzeros == found.entries + SIZE
    assert found.fill == found.entries / found.nonzeros
    assert found.operations > SIZE**3 / 3
    assert found.delayed_pivots == 0


def test_the_ordering_is_the_one_that_mumps_used() -> None:
    """SCOTCH is not in CasADi's wheel, and MUMPS takes another ordering."""
    found = Factorisations.from_output(output(order=3))
    assert found is not None
    assert found.ordering != "SCOTCH"


def test_output_without_a_factorisation_gives_none() -> None:
    complete = output(order=0)
    begun = complete[: complete.index("FACTORIZATION STEP")]
    assert Factorisations.from_output(begun) is None
    assert Factorisations.from_output("") is None


@pytest.mark.long
def test_a_setting_is_measured_in_a_process_of_its_own() -> None:
    assert SETTINGS["amd"].ipopt == {"mumps_pivot_order": 0}
    times, factors = run_in_own_process("foam_cylinder", "amd", iterations=1)
    assert times is not None
    assert factors is not None
    assert factors.ordering == "AMD"
    assert times.iterations == 1
    assert 0 < times.linear_algebra_share < 1
    assert times.processor_s > 0
    assert factors.fill > 1


@pytest.mark.long
def test_a_failed_process_gives_none() -> None:
    assert run_in_own_process("no_such_problem", "amd", iterations=1) == (None, None)
