"""Damped Newton steps on a merit function, by one banded Cholesky factorisation each.

The step solves (H + ρ JᵀJ + μ I) dz = −∇m, where H is the Hessian of the loss (Gauss–Newton, as in
the method of Levenberg and Marquardt), or of the Lagrangian with the multipliers y + ρ g (Newton),
which replaces it near the solution where it is positive definite. Time steps are coupled to few
neighbours, so that the block of the positions is banded; the parameters q and φ border it, and
their step follows from the Schur complement, a bounded least-squares problem in a few variables. μ
follows the ratio of actual to predicted decrease (H. B. Nielsen, "Damping parameter in Marquardt's
method", 1999).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.linalg import cholesky, get_lapack_funcs, solve_triangular
from scipy.sparse.csgraph import reverse_cuthill_mckee

from ...common.array_types import Array, Index
from ...errors import InputError
from ...program.least_squares import SquareRootInformation
from ...program.linear_algebra.lapack import cholesky_in_place, one_blas_thread
from .merit import MeritFunction, MeritPoint, PenaltyProblem

(_pbtrs,) = get_lapack_funcs(("pbtrs",), dtype=np.float64)

# The band and its factor may take this much memory [bytes].
MOST_MEMORY = 8e9
# Longest step of a parameter after which the full Hessian is used.
LOCAL = 0.1
# Predicted decreases below this share of the merit's value are lost in its rounding.
ROUNDING = 1e-12


def minimise_levenberg_marquardt(
    merit: MeritFunction,
    z: Array,
    tolerance: float,
    max_iterations: int,
    report: Callable[[Array, float], None],
) -> bool:
    """Minimise a merit function within its bounds.

    Parameters
    ----------
    z : (variables,) array
        Initial variables, at which no element is inverted; not modified.
    tolerance : float
        Largest entry of the projected gradient at the end.
    max_iterations : int
        Largest number of accepted steps.
    report : callable
        Function that is called with every iterate and the largest entry of its projected gradient;
        an exception ends the minimisation and is not caught. The last iterate is the result.

    Returns
    -------
    bool
        Whether the tolerance was reached; false after `max_iterations` steps, if rounding prevents
        it, or if no step decreases the merit.

    Raises
    ------
    InputError
        If the factor needs more memory than `MOST_MEMORY`.
    SimulationError
        If the body has no stress-free shape at the parameters of a trial.
    """
    damping = 1e-3
    growth = 2.0
    is_local = False
    order = []
    point = MeritPoint.evaluate(merit, z)
    for count in range(max_iterations + 1):
        report(point.z, point.gradient_norm)
        if point.gradient_norm <= tolerance:
            return True
        if count == max_iterations:
            break
        system = _quadratic_model(merit, point, exact=is_local, order=order)
        while True:
            step = system.step(damping)
            if step is None and system.exact:
                system = _quadratic_model(merit, point, exact=False, order=order)
                continue
            if step is not None:
                predicted = system.predicted_decrease(step)
                trial = np.clip(point.z + step, merit.problem.lower, merit.problem.upper)
                if predicted <= ROUNDING * abs(point.value):
                    # Values cannot judge this step any more; gradients can.
                    after = MeritPoint.evaluate(merit, trial)
                    if not after.gradient_norm <= point.gradient_norm / 2:
                        return False
                    ratio = 1.0
                    break
                decrease = point.value - merit.value(trial)
                if decrease > 0:
                    after = MeritPoint.evaluate(merit, trial)
                    ratio = decrease / predicted
                    break
            damping = damping * growth
            growth = 2 * growth
            if not np.isfinite(damping):
                return False
        damping *= max(1 / 5, 1 - (2 * ratio - 1) ** 3)
        is_local = float(np.abs(step[merit.problem.parameter_indices]).max(initial=0.0)) <= LOCAL
        growth = 2.0
        point = after
    return False


def _quadratic_model(
    merit: MeritFunction, point: MeritPoint, exact: bool, order: list[Index]
) -> _QuadraticModel:
    """Return the quadratic model at a point."""
    weights = merit.multiplier_estimate(point.rows) if exact else np.zeros_like(point.rows)
    with merit.problem.stopwatch.evaluating():
        hessian = merit.problem.nlp.hessian(point.z, 1.0, multipliers=weights)
    return _QuadraticModel(
        merit.problem,
        point.z,
        rho=merit.rho,
        jacobian=point.jacobian,
        hessian=hessian,
        gradient=point.gradient,
        exact=exact,
        order=order,
    )


@dataclass(frozen=True, eq=False)
class _QuadraticModel:
    """Quadratic model of a merit function at z.

    Its matrix is H + ρ JᵀJ with J = ∂g/∂z, without damping. The parameters and the positions that
    are not constant have blocks of it.
    """

    problem: PenaltyProblem
    z: Array  # (variables,)
    rho: float  # penalty parameter ρ
    jacobian: sp.csc_array  # sparse (constraints, variables): ∂g/∂z
    # sparse (variables, variables): Hessian H of the loss or of the Lagrangian.
    hessian: sp.csc_array
    gradient: Array  # (variables,): ∂m/∂z
    exact: bool  # whether H is that of the Lagrangian
    # Order of the band's columns, shared by all models: empty until the first model computes and
    # appends it.
    order: list[Index]

    def predicted_decrease(self, step: Array) -> float:
        """Return the decrease by a step, without damping."""
        constraint_change = self.jacobian @ step
        curvature = float(step @ (self.hessian @ step)) + self.rho * float(
            constraint_change @ constraint_change
        )
        return -float(self.gradient @ step) - curvature / 2

    def step(self, damping: float) -> Array | None:
        """Return the damped step (variables,), within bounds and reach of the parameters, see
        `_bounded_step`, and zero for constant variables; None if the damped matrix is not positive
        definite.

        `damping` is added to the diagonal of the matrix. Bounds of positions are not regarded. The
        time is added to the stopwatch.

        Raises
        ------
        InputError
            If the factor needs more memory than `MOST_MEMORY`.
        """
        with self.problem.stopwatch.solving(), one_blas_thread():
            return self._step(damping)

    def _step(self, damping: float) -> Array | None:
        """Return the step with damping; None if not positive definite."""
        positions = self._positions
        border = self.problem.parameter_indices
        band = self._band.copy("F")
        band[0] += damping
        if not cholesky_in_place(band):
            return None
        right = np.column_stack([self._mixed_block, self.gradient[positions]])
        (order,) = self.order
        solved = np.empty_like(right)
        solved[order] = _pbtrs(band, right[order], lower=1)[0].reshape(right.shape)
        by_p = solved[:, :-1]
        position_step = solved[:, -1]
        schur = self._parameter_block - self._mixed_block.T @ by_p + damping * np.eye(len(border))
        step = np.zeros(len(self.z))
        if len(border):
            reduced_gradient = self.gradient[border] - self._mixed_block.T @ position_step
            of_p = self._bounded_step((schur + schur.T) / 2, reduced_gradient)
            if of_p is None:
                return None
            step[border] = of_p
        step[positions] = -position_step - by_p @ step[border]
        return step

    def _bounded_step(self, schur: Array, slope: Array) -> Array | None:
        """Return the steps d of the parameters that minimise ½ dᵀ S d + sᵀ d; None if S is not
        positive definite.

        Each step stays within the bounds of its parameter, and is at most its entry of `reach_p`.
        """
        try:
            factor = cholesky(schur, lower=True)
        except np.linalg.LinAlgError:
            return None
        border = self.problem.parameter_indices
        problem = self.problem
        # Rounding may leave a parameter on its bound by a hair.
        reach = problem.reach_p
        low = np.minimum(np.maximum(problem.lower[border] - self.z[border], -reach), 0) - 1e-15
        high = np.maximum(np.minimum(problem.upper[border] - self.z[border], reach), 0) + 1e-15
        right = solve_triangular(factor, slope, lower=True)
        return SquareRootInformation(np.column_stack([factor.T, right])).minimiser(low, high)

    # The bordered matrix ----------------------------------------------------------------------

    @cached_property
    def _positions(self) -> Index:
        """Indices of the free positions in z."""
        free = self.problem.is_free.copy()
        free[self.problem.parameter_indices] = False
        return np.flatnonzero(free)

    @cached_property
    def _jacobian_blocks(self) -> tuple[sp.csc_array, Array]:
        """Columns of J for the positions (sparse) and for the parameters (dense)."""
        of_x = sp.csc_array(self.jacobian[:, self._positions])
        return of_x, self.jacobian[:, self.problem.parameter_indices].toarray()

    @cached_property
    def _mixed_block(self) -> Array:
        """Dense block (free positions, parameters) of the matrix, without damping."""
        of_x, of_p = self._jacobian_blocks
        rows = sp.csr_array(self.hessian)[self._positions]
        return self.rho * (of_x.T @ of_p) + rows[:, self.problem.parameter_indices].toarray()

    @cached_property
    def _parameter_block(self) -> Array:
        """Dense block (parameters, parameters) of the matrix, without damping."""
        of_p = self._jacobian_blocks[1]
        border = self.problem.parameter_indices
        return self.rho * of_p.T @ of_p + self.hessian[border][:, border].toarray()

    @cached_property
    def _position_block(self) -> sp.coo_array:
        """Block of the free positions, both triangles, without damping."""
        of_x = self._jacobian_blocks[0]
        positions = self._positions
        position_hessian = sp.csr_array(self.hessian)[positions][:, positions]
        return sp.coo_array(self.rho * (of_x.T @ of_x) + position_hessian)

    @cached_property
    def _band(self) -> Array:
        """Lower band (half-bandwidth + 1, n) of the positions' block, with the n free positions in
        the order that is the entry of `order`.

        The order is computed and appended to `order` if that is empty.
        """
        with self.problem.stopwatch.solving():
            square = self._position_block
            if not len(self.order):
                self.order.append(_narrow_order(square))
            (order,) = self.order
            place = np.empty_like(order)
            place[order] = np.arange(len(place))
            rows, columns = (place[i] for i in square.coords)
            lower = rows >= columns
            rows = rows[lower]
            columns = columns[lower]
            width = int((rows - columns).max(initial=0)) + 1
            if (needed := 16.0 * width * len(place)) > MOST_MEMORY:
                raise InputError(
                    f"inner = 'levenberg-marquardt' would take {needed / 1e9:.0f} GB for "
                    f"{len(place)} variables; expected at most {MOST_MEMORY / 1e9:.0f} GB. "
                    "Choose inner = 'scipy-cg', or the method 'reduced-space'",
                    None,
                    where="solver",
                )
            band = np.zeros((width, len(place)), order="F")
            band[rows - columns, columns] = square.data[lower]
            return band


def _narrow_order(square: sp.coo_array) -> Index:
    """Return an order (n,) that narrows the band of a symmetric matrix, or the identity."""
    order = reverse_cuthill_mckee(sp.csr_array(square), symmetric_mode=True).astype(np.int64)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    rows, columns = square.coords
    narrower = np.abs(place[rows] - place[columns]).max() < np.abs(rows - columns).max()
    return order if narrower else np.arange(len(order))
