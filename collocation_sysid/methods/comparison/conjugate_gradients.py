"""Nonlinear conjugate gradients of SciPy on a merit function, in scaled variables."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy

from ...common.array_types import Array
from ...common.limits import require_time
from .merit import MeritFunction, MeritPoint


def minimise_conjugate_gradients(
    merit: MeritFunction,
    z: Array,
    tolerance: float,
    max_iterations: int,
    report: Callable[[Array, float], None],
) -> bool:
    """Minimise a merit function within its bounds, see `minimise_levenberg_marquardt`.

    The variables are z + s_i / √d_i with d the diagonal of the Gauss–Newton Hessian at the start:
    columns of J for parameters are thousands of times as long as those for positions. A unit is at
    most as long as the interval between the bounds. Beyond a bound the merit function is that at
    the bound.
    """
    problem = merit.problem
    point = MeritPoint.evaluate(merit, z)
    report(z, point.gradient_norm)
    if point.gradient_norm <= tolerance:
        return True
    hessian = problem.nlp.hessian(z, 1.0, multipliers=np.zeros(len(point.rows)))
    diagonal = hessian.diagonal() + merit.rho * point.jacobian.power(2).sum(axis=0)
    least = 1e-12 * diagonal[problem.is_free].max()
    unit = problem.is_free / np.sqrt(np.maximum(diagonal, least))
    # A parameter that the loss hardly depends on would leap to a bound, where the derivative by its
    # logarithm is within the tolerance.
    unit = np.minimum(unit, problem.upper - problem.lower)
    height = abs(point.value)
    is_reached = False

    def value_and_gradient(s: Array) -> tuple[float, Array]:
        nonlocal point
        require_time()
        beyond = z + unit * s
        at = np.clip(beyond, problem.lower, problem.upper)
        if problem.has_valid_elements(at):
            point = MeritPoint.evaluate(merit, at)
            if np.isfinite(point.value):
                return point.value, np.where(at == beyond, unit * point.gradient, 0.0)
        # The line search interpolates values, so that one out of the domain must be a number.
        return 10.0 * height + 1e-300, np.zeros(len(s))

    def callback(intermediate_result: scipy.optimize.OptimizeResult) -> None:
        nonlocal height, is_reached
        at = np.clip(z + unit * intermediate_result.x, problem.lower, problem.upper)
        accepted = point if np.array_equal(point.z, at) else MeritPoint.evaluate(merit, at)
        height = abs(accepted.value)
        report(at, accepted.gradient_norm)
        if is_reached := accepted.gradient_norm <= tolerance:
            raise StopIteration

    scipy.optimize.minimize(
        value_and_gradient,
        np.zeros(len(z)),
        method="CG",
        jac=True,
        callback=callback,
        options={"gtol": 0.0, "maxiter": max_iterations},
    )
    return is_reached
