"""Inner solvers: minimise a merit function for one ρ, by gradients or by Newton steps.

First-order methods use scaled variables s, z_i = z_i(s_i / √d_i) with d the diagonal of the
Gauss–Newton Hessian at the start: columns of J for parameters are thousands of times as long as
those for positions. Conjugate gradients do not support bounds; variables with two bounds are mapped
smoothly, z = middle + half · sin(s).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from scipy.optimize import Bounds, OptimizeResult
from scipy.optimize import minimize as scipy_minimise

from ...common.array_types import Array
from .cg_descent import CgDescentOptions
from .cg_descent import minimise_cg_descent as cg_descent
from .levenberg_marquardt import minimise_levenberg_marquardt as levenberg_marquardt
from .merit import MeritFunction

Report = Callable[[Array, float, Array], None]

Inner = Literal["cg-descent", "scipy-cg", "l-bfgs-b", "levenberg-marquardt"]
FIRST_ORDER = ("cg-descent", "scipy-cg", "l-bfgs-b")

# Open bounds of a parameter are this many e-folds away where a smooth map needs two.
LARGEST_OPEN_DISTANCE = 50.0
# SciPy's line searches interpolate values, so that one out of the domain must be a number: this
# many times the value so far.
STEEP = 10.0


def minimise_merit(
    inner: Inner,
    merit: MeritFunction,
    z: Array,
    tolerance: float,
    max_iterations: int,
    report: Report,
) -> bool:
    """Minimise a merit function within its bounds.

    Parameters
    ----------
    inner : str
        Name of the solver.
    z : (variables,) array
        Initial variables, within their bounds; not modified.
    tolerance : float
        Largest entry of the projected gradient ∂m/∂z at the end.
    max_iterations : int
        Largest number of iterations.
    report : callable
        Function that is called with every iterate z, its value and its projected gradient; an
        exception ends the minimisation and is not caught. The last iterate is the result.

    Returns
    -------
    bool
        Whether the tolerance was reached.

    Raises
    ------
    InputError
        If the factor of "levenberg-marquardt" needs too much memory.
    SimulationError
        If the body has no stress-free shape at the parameters of a trial.
    """
    if inner == "levenberg-marquardt":
        return levenberg_marquardt(
            merit, z, tolerance=tolerance, max_iterations=max_iterations, report=report
        )
    scaled = _ScaledMerit(merit, z, smooth=inner != "l-bfgs-b")
    follow = _ConvergenceCheck(scaled, tolerance, report=report)
    follow(scaled.start)
    if follow.converged:
        return True
    if inner == "cg-descent":
        options = CgDescentOptions(tolerance=0.0, max_iterations=max_iterations)
        cg_descent(
            scaled.value_and_gradient,
            scaled.start,
            options=options,
            callback=lambda state: state.iteration > 0 and follow(state.x),
            value=scaled.value,
        )
        return follow.converged

    def callback(intermediate_result: OptimizeResult) -> None:
        """Stop SciPy's solver once the tolerance is reached."""
        if follow(intermediate_result.x):
            raise StopIteration

    method = "CG" if inner == "scipy-cg" else "L-BFGS-B"
    settings = {"gtol": 0.0, "maxiter": max_iterations}
    if inner == "l-bfgs-b":
        settings |= {"ftol": 0.0, "maxfun": 20 * max_iterations, "maxcor": 20}
    scipy_minimise(
        scaled.finite_value_and_gradient,
        scaled.start,
        jac=True,
        method=method,
        bounds=scaled.bounds if inner == "l-bfgs-b" else None,
        callback=callback,
        options=settings,
    )
    return follow.converged


class _ConvergenceCheck:
    """Callback that reports iterates of the scaled problem and checks convergence.

    Parameters
    ----------
    scaled : _ScaledMerit
    tolerance : float
        Largest entry of the projected gradient ∂m/∂z.
    report : callable
        Receives z, value and projected gradient of each iterate.

    Attributes
    ----------
    converged : bool
        Whether the last iterate was within the tolerance.
    """

    def __init__(self, scaled: _ScaledMerit, tolerance: float, report: Report) -> None:
        self.scaled = scaled
        self.tolerance = tolerance
        self.report = report
        self.converged = False

    def __call__(self, s: Array) -> bool:
        """Report s (free,); return whether its gradient is within tolerance."""
        z, value, gradient = self.scaled.evaluate_at(s)
        self.scaled.replacement_value = STEEP * abs(value) + 1e-300
        projected = self.scaled.project_gradient(s, z, gradient=gradient)
        self.report(z, value, projected)
        self.converged = bool(np.abs(projected).max(initial=0.0) <= self.tolerance)
        return self.converged


class _ScaledMerit:
    """Merit function of the scaled free variables s, without bounds if they are mapped smoothly.

    Parameters
    ----------
    merit : MeritFunction
    z : (variables,) array
        Initial variables, s = 0.
    smooth : bool
        Whether variables with a bound are mapped smoothly, z = middle + half · sin(angle);
        otherwise `bounds` apply.

    Attributes
    ----------
    free : (free,) int array
        Indices of the free variables in z.
    unit : (free,) array
        Change of each variable for a unit of s.
    mapped : int array
        Indices, among the free variables, of those that are mapped.
    middle, half, angle : arrays
        Constants of the map of each mapped variable; the angle is that of the start, which is moved
        slightly inside its bounds.
    start : (free,) array
        Initial s, zeros.
    bounds : Bounds
        Bounds of s.
    replacement_value : float
        Value that replaces an infinite merit, for solvers that interpolate values.
    """

    def __init__(self, merit: MeritFunction, z: Array, smooth: bool) -> None:
        self.merit = merit
        self.z = z.copy()
        problem = merit.problem
        self.free = np.flatnonzero(problem.is_free)
        _, jacobian = problem.constraints_and_jacobian(z)
        loss = problem.nlp.hessian(
            z, 1.0, multipliers=np.zeros(problem.nlp.constraint_count)
        ).diagonal()
        diagonal = loss + merit.rho * (jacobian.power(2).sum(axis=0))
        diagonal = diagonal[self.free]
        self.unit = 1 / np.sqrt(np.maximum(diagonal, 1e-12 * diagonal.max()))
        lower = problem.lower[self.free]
        upper = problem.upper[self.free]
        self.bounds = Bounds((lower - z[self.free]) / self.unit, (upper - z[self.free]) / self.unit)
        self.mapped = np.flatnonzero(np.isfinite(lower) | np.isfinite(upper)) if smooth else []
        at = z[self.free][self.mapped]
        low = np.maximum(lower[self.mapped], at - LARGEST_OPEN_DISTANCE)
        high = np.minimum(upper[self.mapped], at + LARGEST_OPEN_DISTANCE)
        self.middle = (low + high) / 2
        self.half = (high - low) / 2
        # At a bound the slope is zero: nothing would ever leave it.
        share = np.clip((at - self.middle) / self.half, -0.999, 0.999)
        self.angle = np.arcsin(share)
        self.start = np.zeros(len(self.free))
        self.replacement_value = np.inf
        self._last: tuple[Array, tuple[Array, float, Array]] | None = None

    def to_variables(self, s: Array) -> Array:
        """Return all variables from s (free,); constant ones stay."""
        z = self.z.copy()
        free_values = z[self.free] + self.unit * s
        free_values[self.mapped] = self.middle + self.half * np.sin(self._angles(s))
        z[self.free] = free_values
        return z

    def _angles(self, s: Array) -> Array:
        """Return the angles of the sine map of the mapped variables at s (free,)."""
        return self.angle + (self.unit * s)[self.mapped] / (self.half * np.cos(self.angle))

    def _slopes(self, s: Array) -> Array:
        """Return ∂z/∂(unit · s) (free,): of the sine map, 1 for others."""
        slopes = np.ones(len(s))
        slopes[self.mapped] = np.cos(self._angles(s)) / np.cos(self.angle)
        return slopes

    def evaluate_at(self, s: Array) -> tuple[Array, float, Array]:
        """Return z, m and ∂m/∂z at s (free,), cached for the last s."""
        if self._last is None or not np.array_equal(self._last[0], s):
            z = self.to_variables(s)
            value, gradient = self.merit.value_and_gradient(z)
            self._last = s.copy(), (z, value, gradient)
        return self._last[1]

    def value(self, s: Array) -> float:
        """Return m at s (free,); infinite if an element is inverted."""
        return self.merit.value(self.to_variables(s))

    def value_and_gradient(self, s: Array) -> tuple[float, Array]:
        """Return m and ∂m/∂s; infinite and NaN if inverted."""
        _, value, gradient = self.evaluate_at(s)
        scale = self.unit * self._slopes(s)
        return value, gradient[self.free] * scale

    def finite_value_and_gradient(self, s: Array) -> tuple[float, Array]:
        """Return m and ∂m/∂s; `replacement_value` and zeros if infinite."""
        value, gradient = self.value_and_gradient(s)
        return (
            (value, gradient) if np.isfinite(value) else (self.replacement_value, np.zeros(len(s)))
        )

    def project_gradient(self, s: Array, z: Array, gradient: Array) -> Array:
        """Return ∂m/∂z (variables,) at s (free,) and its z, from the `gradient` there, with zeros
        at active bounds; derivatives by mapped variables are multiplied by the slope of the map, at
        most 1, so that they decrease towards the bounds.
        """
        projected = self.merit.problem.project_gradient(z, gradient)
        projected[self.free] *= np.minimum(np.abs(self._slopes(s)), 1.0)
        return projected
