"""Taylor test of the derivatives of a problem: `check_program`."""

from __future__ import annotations

from dataclasses import replace

from ..common.validated_classes import validated
from ..methods.starts.initial_trajectories import initial_variables
from ..methods.starts.stiffness_scan import SOFT_PA, typical_parameters
from ..problem import Problem
from ..runs.derivatives import derivative_fault, shortened_problem, taylor_rates


@validated
def check_program(problem: Problem) -> dict[str, float]:
    """Check the derivatives of the nonlinear program of a problem by a Taylor test.

    Near the simulation of the first samples at the guess, or at usual values without one, the
    remainders of Taylor's formula decrease with the step to the power 1, 2 and 3: values, first and
    second derivatives of the loss, and of the constraints times random multipliers, along a random
    direction.

    Returns
    -------
    dict of str to float
        Measured powers; infinite where a remainder is only rounding.

    Raises
    ------
    AssertionError
        For the first derivative that is wrong: in which term, such as a damping law or a sensor,
        and the power found and expected.
    """
    guessed = replace(problem, parameters=typical_parameters(problem.parameters, SOFT_PA))
    collocation = shortened_problem(guessed).collocation()
    z, _ = initial_variables(collocation)
    rates = taylor_rates(collocation, z)
    if fault := derivative_fault(collocation, z, rates):
        raise AssertionError(fault)
    return rates
