"""Check of the derivatives at the guess against differences, on the first samples of an
experiment.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from ..common.array_types import Array
from ..model.contact.force import contact_terms
from ..problem import Problem
from ..program.collocation import Collocation, convert_variables
from ..program.lifted.collocation import lifted_nonzeros, with_lifted_variables
from ..recording.measurement_selection import shortened_experiment

# First samples of a motion that contain all kinds of equations; more would not change derivatives.
SAMPLES = 12
# Number of first samples of a static experiment that contain all kinds of equations.
STATIC_SAMPLES = 3
# Step of the differences, which balances truncation and rounding of fourth-order differences.
STEP = 1e-5
# Largest step of differences, relative to the gap over which the pressure of an obstacle rises: it
# must stay within.
STEP_PER_WIDTH = 1e-3
# Huber threshold of the check [σ]: differences must not cross the kink of the second derivative.
LARGE_HUBER = 1e9
# Most nonzeros of lifted variables for which the whole program is laid out and checked.
MOST_LIFTED_NONZEROS = 5e6


def shortened_problem(problem: Problem, more: int = 0) -> Problem:
    """Return the problem with the first samples of every experiment, also of those for validation:
    at least `STATIC_SAMPLES` or `SAMPLES`, and `more`, or, if there are fewer, all, see
    `shortened_experiment`.
    """
    short = []
    for each in problem.experiments:
        count = (STATIC_SAMPLES if each.is_static else SAMPLES) + more
        short.append(shortened_experiment(each, count, shortens_sensors=True))
    return replace(problem, experiments=short)


def derivative_errors(collocation: Collocation, z: Array) -> tuple[float, float]:
    """Return the largest relative errors of the first and the second derivatives.

    Errors are relative to the largest entry of the exact derivative. Exact derivatives along a
    random direction are compared with fourth-order central differences at a disturbed start; the
    random numbers are the same in every call.

    Parameters
    ----------
    collocation : Collocation
        Program without lifted variables.
    z : (variables,) array
        Start; not modified.

    Returns
    -------
    first : float
        Error of the Jacobian and, if it exists, of the gradient of the eliminated form.
    second : float
        Error of the Hessian; 0 if the program with lifted variables is too large to be laid out.
    """
    if any(s.association.correspondences for s in collocation.transcriptions):
        collocation = replace(collocation, huber=LARGE_HUBER)
    rng = np.random.default_rng(0)
    of_slopes = 0.0
    step = _difference_step(collocation)
    plain, program = collocation, with_lifted_variables(collocation)
    if program is not collocation:  # gradients alone need no such variables
        of_slopes = _slope_error(plain.objective, plain.gradient, z=z, rng=rng, step=step)
        if plain.has_eliminated_histories:
            forces = rng.normal(size=plain.constraint_count)
            through = partial(plain.jacobian_vjp, multipliers=forces)
            pushed = lambda at: forces @ plain.constraint_values(at)  # noqa: E731
            slope = _slope_error(pushed, through, z=z, rng=rng, step=step)
            of_slopes = max(of_slopes, slope)
        if sum(lifted_nonzeros(program)) > MOST_LIFTED_NONZEROS:
            return of_slopes, 0.0
        collocation = program
        z = convert_variables(z, plain, target=program)
    point = z + 1e-3 * rng.normal(size=len(z))
    direction = rng.normal(size=len(z))
    multipliers = rng.normal(size=collocation.constraint_count)

    def lagrangian_gradient(at: Array) -> Array:
        return collocation.gradient(at) + collocation.jacobian(at).T @ multipliers

    hessian = collocation.hessian(point, 1.0, multipliers=multipliers)
    slope = collocation.jacobian(point) @ direction
    first = _deviation(
        collocation.constraint_values, slope, point=point, direction=direction, step=step
    )
    second = _deviation(
        lagrangian_gradient, hessian @ direction, point=point, direction=direction, step=step
    )
    return max(first, of_slopes), second


def _difference_step(collocation: Collocation) -> float:
    """Steps are in scaled z: `STEP`, or a share of the narrowest gap in which pressure rises."""
    widths_m = [
        term.law_of_contact.largest_width_m
        for transcription in collocation.transcriptions
        for term in contact_terms(transcription.experiment)
    ]
    return min([STEP, *(STEP_PER_WIDTH * width_m for width_m in widths_m)])


def _slope_error(function, gradient, z: Array, rng: np.random.Generator, step: float) -> float:
    """Return the relative error along a random direction near z, from central differences."""
    point = z + 1e-3 * rng.normal(size=len(z))
    direction = rng.normal(size=len(z))
    return _deviation(
        function, gradient(point) @ direction, point=point, direction=direction, step=step
    )


def _deviation(function, exact: Array, point: Array, direction: Array, step: float) -> float:
    """Return the largest deviation relative to `exact`, by fourth-order central differences."""
    after, before, two_after, two_before = (
        function(point + k * step * direction) for k in (1, -1, 2, -2)
    )
    differences = (8 * (after - before) - (two_after - two_before)) / (12 * step)
    largest = max(float(np.abs(exact).max()), np.finfo(float).tiny)
    return float(np.abs(differences - exact).max()) / largest
