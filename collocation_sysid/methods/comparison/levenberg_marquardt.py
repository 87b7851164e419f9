"""Damped Newton steps on a merit function, by one banded Cholesky factorisation each.

The step solves (H + ρ JᵀJ + μ I) dz = −∇m, where H is the Hessian of the loss (Gauss–Newton, as
Levenberg and Marquardt have it), or of the Lagrangian with the multipliers y + ρ g (Newton), which
replaces it near the answer where that is positive definite. Timesteps couple to few neighbours,
so that the positions' part is a band; the parameters q and φ border it and take their step from
the Schur complement, a bounded least-squares problem in a few variables. μ follows the ratio of
actual to predicted decrease (H. B. Nielsen, "Damping parameter in Marquardt's method", 1999).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.linalg import cholesky, get_lapack_funcs, solve_triangular
from scipy.sparse.csgraph import reverse_cuthill_mckee

from ...arrays import Array, Index
from ...errors import InputError
from ...program.lapack import cholesky_in_place, one_blas_thread
from ...program.least_squares import LeastSquares
from .merit import Merit, Unconstrained

(_pbtrs,) = get_lapack_funcs(("pbtrs",), dtype=np.float64)

# The band and its factor may take this much memory [bytes].
MOST_MEMORY = 8e9
# First damping, its bounds, and the least share of a predicted decrease that is accepted.
DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-13, 1e12
ACCEPTED = 1e-3
# Longest step of a parameter (for φ, of its reach), and steps short enough for the full Hessian.
REACH, LOCAL = 1.0, 0.1
# Predicted decreases below this share of the merit's value are lost in its rounding.
ROUNDING = 1e-12


def minimise(
    merit: Merit,
    z: Array,
    tolerance: float,
    max_iterations: int,
    report: Callable[[Array, float, Array], None],
) -> bool:
    """Minimise a merit function within its bounds.

    Parameters
    ----------
    merit : Merit
    z : (variables,) ndarray
    tolerance : float
        Largest entry of the projected gradient at the end.
    max_iterations : int
        Accepted steps.
    report : callable
        Called with every iterate, its value and its projected gradient; may raise to end it.

    Returns
    -------
    bool
        Whether the tolerance was reached, as far as rounding lets one tell.
    """
    damping, growth, local, order = DAMPING, 2.0, False, []
    point = _Point.at(merit, z)
    for count in range(max_iterations + 1):
        report(point.z, point.value, point.projected)
        if point.steepness <= tolerance:
            return True
        if count == max_iterations:
            break
        system = _system(merit, point, local, order)
        while True:
            step = system.step(damping)
            if step is None and system.exact:
                system = _system(merit, point, False, order)
                continue
            if step is not None:
                predicted = system.predicted_decrease(step)
                trial = np.clip(point.z + step, merit.problem.lower, merit.problem.upper)
                if predicted <= ROUNDING * abs(point.value):
                    # Values cannot judge this step any more; gradients can.
                    after = _Point.at(merit, trial)
                    if not after.steepness <= point.steepness / 2:
                        return False
                    ratio = 1.0
                    break
                decrease = point.value - merit.value(trial)
                if decrease >= ACCEPTED * predicted:
                    after, ratio = _Point.at(merit, trial), decrease / predicted
                    break
            damping, growth = damping * growth, 2 * growth
            if damping > MOST_DAMPING:
                return False
        damping = max(damping * max(1 / 5, 1 - (2 * ratio - 1) ** 3), LEAST_DAMPING)
        local = float(np.abs(step[merit.problem.bounded]).max(initial=0.0)) <= LOCAL
        growth, point = 2.0, after
    return False


@dataclass(frozen=True, eq=False)
class _Point:
    """A merit function with its derivatives; the matrix is overwritten by the next point's."""

    z: Array
    value: float
    rows: Array
    jacobian: sp.csc_array
    gradient: Array
    projected: Array

    @classmethod
    def at(cls, merit: Merit, z: Array) -> _Point:
        rows, jacobian = merit.problem.constraints_and_jacobian(z)
        gradient = merit.gradient(z, rows, jacobian)
        projected = merit.problem.projected(z, gradient)
        return cls(z, merit.value_of(z, rows), rows, jacobian, gradient, projected)

    @property
    def steepness(self) -> float:
        """Largest entry of the projected gradient."""
        return float(np.abs(self.projected).max(initial=0.0))


def _system(merit: Merit, point: _Point, exact: bool, order: list[Index]) -> _System:
    weights = merit.estimate(point.rows) if exact else np.zeros_like(point.rows)
    with merit.problem.stopwatch.evaluating():
        hessian = merit.problem.nlp.hessian(point.z, 1.0, weights)
    return _System(
        merit.problem, point.z, merit.rho, point.jacobian, hessian, point.gradient, exact, order
    )


@dataclass(frozen=True, eq=False)
class _System:
    """The quadratic model of a merit function at z.

    `order` holds the order of the band's columns once one is found.
    """

    problem: Unconstrained
    z: Array
    rho: float
    jacobian: sp.csc_array
    hessian: sp.csc_array
    gradient: Array
    exact: bool
    order: list[Index]

    def predicted_decrease(self, step: Array) -> float:
        """Decrease of the undamped model."""
        along = self.jacobian @ step
        bend = float(step @ (self.hessian @ step)) + self.rho * float(along @ along)
        return -float(self.gradient @ step) - bend / 2

    def step(self, damping: float) -> Array | None:
        """Step of all variables, or None where the damped matrix is not positive definite."""
        with self.problem.stopwatch.solving(), one_blas_thread():
            return self._step(damping)

    def _step(self, damping: float) -> Array | None:
        positions, border, band = self._positions, self.problem.bounded, self._band.copy("F")
        band[0] += damping
        if not cholesky_in_place(band):
            return None
        right = np.column_stack([self._mixed, self.gradient[positions]])
        (order,) = self.order
        solved = np.empty_like(right)
        solved[order] = _pbtrs(band, right[order], lower=1)[0].reshape(right.shape)
        by_p, alone = solved[:, :-1], solved[:, -1]
        schur = self._corner - self._mixed.T @ by_p + damping * np.eye(len(border))
        step = np.zeros(len(self.z))
        if len(border):
            slope = self.gradient[border] - self._mixed.T @ alone
            of_p = self._bounded_step((schur + schur.T) / 2, slope)
            if of_p is None:
                return None
            step[border] = of_p
        step[positions] = -alone - by_p @ step[border]
        return step

    def _bounded_step(self, schur: Array, slope: Array) -> Array | None:
        """Minimise ½ dᵀ S d + sᵀ d over the parameters' steps d within bounds and reach."""
        try:
            factor = cholesky(schur, lower=True)
        except np.linalg.LinAlgError:
            return None
        border, problem = self.problem.bounded, self.problem
        reach = problem.nlp.reach_p
        places = np.where(border < problem.nlp.nq, border, border - len(self.z) + len(reach))
        reach = REACH * reach[places]
        # Rounding may leave a parameter on its bound by a hair.
        low = np.minimum(np.maximum(problem.lower[border] - self.z[border], -reach), 0) - 1e-15
        high = np.maximum(np.minimum(problem.upper[border] - self.z[border], reach), 0) + 1e-15
        right = solve_triangular(factor, slope, lower=True)
        return LeastSquares(np.column_stack([factor.T, right])).best(low, high)

    # The bordered matrix ----------------------------------------------------------------------

    @cached_property
    def _positions(self) -> Index:
        free = self.problem.free.copy()
        free[self.problem.bounded] = False
        return np.flatnonzero(free)

    @cached_property
    def _parts(self) -> tuple[sp.csc_array, Array]:
        """Columns of J by the positions, and by the parameters."""
        of_x = sp.csc_array(self.jacobian[:, self._positions])
        return of_x, self.jacobian[:, self.problem.bounded].toarray()

    @cached_property
    def _mixed(self) -> Array:
        of_x, of_p = self._parts
        rows = sp.csr_array(self.hessian)[self._positions]
        return self.rho * (of_x.T @ of_p) + rows[:, self.problem.bounded].toarray()

    @cached_property
    def _corner(self) -> Array:
        of_p, border = self._parts[1], self.problem.bounded
        return self.rho * of_p.T @ of_p + self.hessian[border][:, border].toarray()

    @cached_property
    def _square(self) -> sp.coo_array:
        of_x, positions = self._parts[0], self._positions
        curved = sp.csr_array(self.hessian)[positions][:, positions]
        return sp.coo_array(self.rho * (of_x.T @ of_x) + curved)

    @cached_property
    def _band(self) -> Array:
        """(half-bandwidth + 1, n) lower band of the positions' part."""
        with self.problem.stopwatch.solving():
            square = self._square
            if not len(self.order):
                self.order.append(_narrow_order(square))
            (order,) = self.order
            place = np.empty_like(order)
            place[order] = np.arange(len(place))
            rows, columns = (place[i] for i in square.coords)
            lower = rows >= columns
            rows, columns = rows[lower], columns[lower]
            width = int((rows - columns).max(initial=0)) + 1
            if (needed := 16.0 * width * len(place)) > MOST_MEMORY:
                raise InputError(
                    f"inner = 'levenberg-marquardt' would take {needed / 1e9:.0f} GB for "
                    f"{len(place)} variables; expected at most {MOST_MEMORY / 1e9:.0f} GB. "
                    "Choose inner = 'l-bfgs-b', or the method 'reduced-space'",
                    None,
                    "solver",
                )
            band = np.zeros((width, len(place)), order="F")
            band[rows - columns, columns] = square.data[lower]
            return band


def _narrow_order(square: sp.coo_array) -> Index:
    """Order of the positions that makes a narrow band."""
    order = reverse_cuthill_mckee(sp.csr_array(square), symmetric_mode=True).astype(np.int64)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    rows, columns = square.coords
    narrower = np.abs(place[rows] - place[columns]).max() < np.abs(rows - columns).max()
    return order if narrower else np.arange(len(order))
