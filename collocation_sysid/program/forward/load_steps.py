"""Way of a body from its shape without loads to its equilibrium under them.

The loads grow in steps that are limited by the gradient of the displacement increment. Each step is
one of Newton's method towards the equilibrium under the larger loads, so that it also corrects the
error of the step before: there are no iterations between the steps. The derivative has the mean
stresses that the step before predicts, not those of the volumes after it (see
`newton_linearisation`): a slender, nearly incompressible body, whose first linear steps are several
times as long as the body itself, then follows its stable path with some ten factorisations.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...common.array_types import Array
from ...common.limits import require_time
from ...model.forces import Forces
from ..linear_algebra.factorisation import Factor
from .newton_linearisation import LaggedStress
from .newton_solver import Linearise, NewtonFailure, NewtonSolver, Residual

# Largest gradient of an increment (Frobenius norm): a rotation by some 30°.
LARGEST_GRADIENT = 0.7
# Gradient of the last increment, from which Newton's method converges in two or three iterations.
LAST_GRADIENT = 0.02
# Largest number of steps, and of steps that are shortened because the stiffness after them is not
# positive definite.
MOST_STEPS = 30
MOST_SHORTENED = 4


def follow_loads(
    solver: NewtonSolver,
    forces: Forces,
    x: Array,
    equations: Callable[[float], tuple[Residual, Linearise]],
) -> Array | None:
    """Return a state (3n,) [m] near the equilibrium under the complete loads, or None if the way
    could not be followed.

    Parameters
    ----------
    solver : NewtonSolver
        Newton's method; its factor of the last step is the one it begins with afterwards.
    forces : Forces
        Forces at one time, without obstacles.
    x : (3n,) array
        Shape without loads [m], with the prescribed dofs in place; not modified.
    equations : callable
        Equations of the equilibrium under a share of the loads.
    """
    rest = np.zeros((1, x.size))
    unloaded, _ = equations(0.0)
    complete, _ = equations(1.0)
    stress = LaggedStress(forces, lambda state: (state[None], rest))
    expected_pa: Array | None = None
    last = x
    increment = np.zeros_like(x)
    share = growth = 0.0
    longest = np.inf
    shortened = 0
    for _ in range(MOST_STEPS):
        require_time()
        trial = solver.retraction(last, increment)
        _, linearise = equations(share + growth)
        try:
            factor, force_n = _factorised(solver, linearise, trial, stress, expected_pa)
        except NewtonFailure:
            shortened += 1
            if shortened > MOST_SHORTENED or not increment.any():
                return None
            increment = increment / 4
            longest = growth = growth / 4
            expected_pa = stress.after(last, increment)
            continue
        last = trial
        share = min(1.0, share + growth)
        longest *= 2
        load_n = complete(last) - unloaded(last)
        correction = np.zeros_like(x)
        by_load = np.zeros_like(x)
        correction[solver.free] = solver.step(factor, force_n)
        by_load[solver.free] = solver.step(factor, load_n)
        gradient, gradient_by_load = (
            solver.retraction.relative_gradient(last, each) for each in (correction, by_load)
        )
        part, growth = _step_length(gradient, gradient_by_load, most=min(1.0 - share, longest))
        increment = part * correction + growth * by_load
        if growth == 1.0 - share:
            remaining = np.linalg.norm(part * gradient + growth * gradient_by_load, axis=(1, 2))
            if remaining.max() <= LAST_GRADIENT:
                solver.definite_factor = factor
                return solver.retraction(last, increment)
        expected_pa = stress.after(last, increment)
    return None


def _factorised(
    solver: NewtonSolver,
    linearise: Linearise,
    x: Array,
    stress: LaggedStress,
    expected_pa: Array | None,
) -> tuple[Factor, Array]:
    """Return the positive definite factor at x (3n,) [m] and the forces (3n,) [N] there."""
    if not solver.has_no_inverted_element(x):
        raise NewtonFailure(x, "an element is inverted")
    with solver.stopwatch.evaluating():
        at = linearise(x)
        if expected_pa is not None:
            at = stress.replace_stress(at, x, expected_pa)
    return solver.factorise(at, x, keep_definite=True), at.residual


def _step_length(correction: Array, by_load: Array, most: float) -> tuple[float, float]:
    """Return shares of correction and load whose gradients stay in `LARGEST_GRADIENT`."""
    c = (correction**2).sum(axis=(1, 2)) - LARGEST_GRADIENT**2
    if c.max() >= 0:
        return LARGEST_GRADIENT / float(np.linalg.norm(correction, axis=(1, 2)).max()), 0.0
    a = np.maximum((by_load**2).sum(axis=(1, 2)), 1e-300)
    b = (correction * by_load).sum(axis=(1, 2))
    # Root of a s² + 2 b s + c = 0 for the growth s.
    return 1.0, min(most, float(((-b + np.sqrt(b**2 - a * c)) / a).min()))
