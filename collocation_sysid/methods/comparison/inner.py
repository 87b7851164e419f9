"""Inner solvers: minimise a merit function for one ρ, by gradients alone or by Newton steps.

The methods of first order work in scaled variables s, z_i = z_i(s_i / √d_i) with d the diagonal of
the Gauss–Newton Hessian at the start: columns of J by the parameters are thousands of times as
long as those by a position. Conjugate gradients know no bounds; where there are two,
z = middle + half · sin(s) keeps within them smoothly.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from scipy.optimize import Bounds, OptimizeResult
from scipy.optimize import minimize as scipy_minimise

from ...arrays import Array
from .cg_descent import CgDescentOptions
from .cg_descent import minimise as cg_descent
from .levenberg_marquardt import minimise as levenberg_marquardt
from .merit import Merit

Report = Callable[[Array, float, Array], None]

Inner = Literal["cg-descent", "scipy-cg", "l-bfgs-b", "levenberg-marquardt"]
FIRST_ORDER = ("cg-descent", "scipy-cg", "l-bfgs-b")

# Open bounds of a parameter are this many e-folds away where a smooth map needs two.
FAR = 50.0
# SciPy's line searches interpolate values, so that one out of the domain must be a number: this
# many times the value so far.
STEEP = 10.0


def minimise(
    inner: Inner,
    merit: Merit,
    z: Array,
    tolerance: float,
    max_iterations: int,
    report: Report,
) -> bool:
    """Minimise a merit function within its bounds.

    Parameters
    ----------
    inner : name of the solver
    merit : Merit
    z : (variables,) ndarray
    tolerance : float
        Largest entry of the projected gradient ∂m/∂z at the end.
    max_iterations : int
    report : callable
        Called with every iterate z, its value and its projected gradient; may raise to end it.

    Returns
    -------
    bool
        Whether the tolerance was reached.
    """
    if inner == "levenberg-marquardt":
        return levenberg_marquardt(merit, z, tolerance, max_iterations, report)
    scaled = _Scaled(merit, z, smooth=inner != "l-bfgs-b")
    follow = _Follower(scaled, tolerance, report)
    follow(scaled.start)
    if follow.converged:
        return True
    if inner == "cg-descent":
        options = CgDescentOptions(tolerance=0.0, max_iterations=max_iterations)
        cg_descent(
            scaled.value_and_gradient,
            scaled.start,
            options,
            lambda state: state.iteration > 0 and follow(state.x),
            scaled.value,
        )
        return follow.converged

    def each(intermediate_result: OptimizeResult) -> None:
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
        callback=each,
        options=settings,
    )
    return follow.converged


class _Follower:
    """Reports iterates of the scaled problem, and tells when the gradient is small."""

    def __init__(self, scaled: _Scaled, tolerance: float, report: Report) -> None:
        self.scaled, self.tolerance, self.report = scaled, tolerance, report
        self.converged = False

    def __call__(self, s: Array) -> bool:
        z, value, gradient = self.scaled.at(s)
        self.scaled.ceiling = STEEP * abs(value) + 1e-300
        projected = self.scaled.projected(s, z, gradient)
        self.report(z, value, projected)
        self.converged = bool(np.abs(projected).max(initial=0.0) <= self.tolerance)
        return self.converged


class _Scaled:
    """A merit function of the free variables, scaled and, for a smooth map, without bounds."""

    def __init__(self, merit: Merit, z: Array, smooth: bool) -> None:
        self.merit, self.z = merit, z.copy()
        problem = merit.problem
        self.free = np.flatnonzero(problem.free)
        _, jacobian = problem.constraints_and_jacobian(z)
        loss = problem.nlp.hessian(z, 1.0, np.zeros(problem.nlp.constraints)).diagonal()
        diagonal = loss + merit.rho * (jacobian.power(2).sum(axis=0))
        diagonal = diagonal[self.free]
        self.unit = 1 / np.sqrt(np.maximum(diagonal, 1e-12 * diagonal.max()))
        lower, upper = problem.lower[self.free], problem.upper[self.free]
        self.bounds = Bounds((lower - z[self.free]) / self.unit, (upper - z[self.free]) / self.unit)
        self.mapped = np.flatnonzero(np.isfinite(lower) | np.isfinite(upper)) if smooth else []
        at = z[self.free][self.mapped]
        low = np.maximum(lower[self.mapped], at - FAR)
        high = np.minimum(upper[self.mapped], at + FAR)
        self.middle, self.half = (low + high) / 2, (high - low) / 2
        # At a bound the slope is zero: nothing would ever leave it.
        share = np.clip((at - self.middle) / self.half, -0.999, 0.999)
        self.angle = np.arcsin(share)
        self.start = np.zeros(len(self.free))
        self.ceiling = np.inf
        self._last: tuple[Array, Array, float, Array] | None = None

    def z_of(self, s: Array) -> Array:
        """All variables."""
        z = self.z.copy()
        moved = z[self.free] + self.unit * s
        moved[self.mapped] = self.middle + self.half * np.sin(self._angles(s))
        z[self.free] = moved
        return z

    def _angles(self, s: Array) -> Array:
        return self.angle + (self.unit * s)[self.mapped] / (self.half * np.cos(self.angle))

    def _slopes(self, s: Array) -> Array:
        """Slopes dz / (unit ds)."""
        slopes = np.ones(len(s))
        slopes[self.mapped] = np.cos(self._angles(s)) / np.cos(self.angle)
        return slopes

    def at(self, s: Array) -> tuple[Array, float, Array]:
        """The point z, m and ∇m; the last point is remembered."""
        if self._last is None or not np.array_equal(self._last[0], s):
            z = self.z_of(s)
            self._last = (s.copy(), z, *self.merit.value_and_gradient(z))
        return self._last[1:]

    def value(self, s: Array) -> float:
        """The value m."""
        return self.merit.value(self.z_of(s))

    def value_and_gradient(self, s: Array) -> tuple[float, Array]:
        """The value m and ∂m/∂s."""
        _, value, gradient = self.at(s)
        return value, gradient[self.free] * self.unit * self._slopes(s)

    def finite_value_and_gradient(self, s: Array) -> tuple[float, Array]:
        """The same, high and flat where the merit is infinite."""
        value, gradient = self.value_and_gradient(s)
        return (value, gradient) if np.isfinite(value) else (self.ceiling, np.zeros(len(s)))

    def projected(self, s: Array, z: Array, gradient: Array) -> Array:
        """The gradient by z without pushes against a bound."""
        projected = self.merit.problem.projected(z, gradient)
        projected[self.free] *= np.minimum(np.abs(self._slopes(s)), 1.0)
        return projected
