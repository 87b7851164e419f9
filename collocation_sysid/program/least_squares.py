"""Information of least-squares rows about parameters, in square-root form.

Rows r + S (p − p₀) are stored as the triangle T of a QR factorisation of (S, r − S p₀), so that ‖T
(p, 1)‖² is their sum of squares at any p. Further rows update it by another QR. The normal
equations are never formed, and the information stays positive semidefinite to rounding (Bierman,
"Factorization methods for discrete sequential estimation", 1977).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs

from ..common.array_types import Array, Index

# Triangles are so small that NumPy's checks would take longer than the work.
_names = ("geqrf", "trtrs", "trtri", "trcon")
_geqrf, _trtrs, _trtri, _trcon = get_lapack_funcs(_names, dtype=np.float64)
# Eigenvalue of the information SᵀS, in units of its diagonal, that is zero up to rounding.
SINGULAR = 1e-12
# Share of a parameter in a direction without information that does not matter.
NEGLIGIBLE = 1e-3
# Triangles with a smaller reciprocal condition number are not solved by substitution, whose error
# would exceed that of the orthogonal methods used instead.
ROUNDING = 1e-12
# Size of the entries of a triangle above which their squares may overflow.
SQUARED = 1e140


@dataclass(frozen=True, eq=False)
class SquareRootInformation:
    """Triangle of a linear least-squares problem in P parameters.

    Attributes
    ----------
    triangle : (at most P + 1, P + 1) array
        Derivatives by p, and in the last column residuals at p = 0.
    row_count : int
        Number of rows that it represents.
    """

    triangle: Array
    row_count: int = 0

    @classmethod
    def empty(cls, size: int) -> SquareRootInformation:
        """Return the problem in P = `size` parameters without rows."""
        return cls(np.zeros((0, size + 1)))

    def with_rows(
        self, residual: Array, jacobian: Array, parameters: Array | None = None
    ) -> SquareRootInformation:
        """Return the problem with further rows; without any, self.

        Parameters
        ----------
        residual : (k,) array
            Residuals at `parameters`, in standard deviations.
        jacobian : (k, P) array
            Derivatives by p.
        parameters : (P,) array, optional
            Parameters of the residuals; zero by default.
        """
        right = residual if parameters is None else residual - jacobian @ parameters
        return self._with_augmented_rows(np.column_stack([jacobian, right]), len(residual))

    def with_problem(
        self, other: SquareRootInformation, indices: Index | slice = slice(None)
    ) -> SquareRootInformation:
        """Return the problem with all rows of another one in some of these parameters.

        Parameters
        ----------
        other : SquareRootInformation
            Problem whose rows are added; if it represents none, self is returned.
        indices : (P',) array of int or slice
            Indices of its parameters among those of self; the same by default.
        """
        rows = np.zeros((len(other.triangle), self.triangle.shape[1]))
        rows[:, :-1][:, indices] = other.jacobian
        rows[:, -1] = other.residual
        return self._with_augmented_rows(rows, other.row_count)

    def _with_augmented_rows(self, rows: Array, count: int) -> SquareRootInformation:
        """Return the problem with rows (k, P + 1) of derivatives and residuals at p = 0, which
        count as `count` rows; self if `count` is 0.
        """
        if not count:
            return self
        return SquareRootInformation(
            _triangularise(np.concatenate([self.triangle, rows])), self.row_count + count
        )

    @property
    def jacobian(self) -> Array:
        """Derivatives S (k, P) by p, as the triangle represents them, k ≤ P + 1."""
        return self.triangle[:, :-1]

    @property
    def residual(self) -> Array:
        """Residuals r (k,) at p = 0, as the triangle represents them, k ≤ P + 1."""
        return self.triangle[:, -1]

    @property
    def information(self) -> Array:
        """Information matrix (P, P), SᵀS."""
        return self.jacobian.T @ self.jacobian

    @property
    def score(self) -> Array:
        """Score (P,), Sᵀ r with r at p = 0: half the gradient of the sum of squares
        there.
        """
        return self.jacobian.T @ self.residual

    def loss(self, p: Array) -> float:
        """Return the sum of squares ‖S p + r‖² at p (P,); infinite for a trial step whose motion
        diverges.
        """
        with np.errstate(over="ignore"):
            residual = self.triangle @ np.append(p, 1.0)
            return float(residual @ residual)

    def minimiser(self, lower: Array, upper: Array) -> Array:
        """Return the p (P,) with the least sum of squares between bounds.

        Where the minimum without bounds is within them, it is returned; of several, the shortest
        one.

        Parameters
        ----------
        lower, upper : (P,) arrays
            Bounds of p, infinite where there is none.
        """
        size = len(lower)
        square = self.jacobian[:size]
        right = -self.residual[:size]
        regular = len(square) == size > 0 and _trcon(square)[0] > ROUNDING
        p = _trtrs(square, right)[0] if regular else np.linalg.lstsq(square, right)[0]
        if ((lower <= p) & (p <= upper)).all():
            return np.asarray(p, dtype=np.float64)
        # The residuals of a motion that diverges are so large that their squares overflow.
        if (largest := np.abs(self.triangle).max()) > SQUARED:
            square, right = square / largest, right / largest
        return np.clip(
            scipy.optimize.lsq_linear(square, right, (lower, upper), method="bvls").x, lower, upper
        )

    def marginal(self, count: int) -> SquareRootInformation:
        """Return the problem in the first `count` parameters alone, with the others eliminated at
        their optimum; residuals that the others can reduce to zero do not count.
        """
        size = self.triangle.shape[1]
        others = np.arange(count, size - 1)
        order = np.concatenate([others, np.arange(count), [size - 1]])
        triangle = _triangularise(self.triangle[:, order])[len(others) :, len(others) :]
        return SquareRootInformation(triangle, self.row_count)

    @cached_property
    def root(self) -> Array:
        """Matrix L (P, r) with L Lᵀ = (SᵀS)⁻¹ in the r directions that the rows determine; r = P if
        these determine all parameters.
        """
        return self._root_and_null_space[0]

    @cached_property
    def is_undetermined(self) -> NDArray[np.bool_]:
        """Mask (P,) of the parameters with a share above `NEGLIGIBLE` in a direction without
        information; an eigenvalue below `SINGULAR` counts as zero.
        """
        shares = np.abs(self._root_and_null_space[1][1])
        return np.asarray((shares > NEGLIGIBLE).any(axis=0))

    @cached_property
    def null_space(self) -> Array:
        """Matrix (P, P − r) of the directions of p without information, in columns of length 1; an
        eigenvalue below `SINGULAR` counts as zero.
        """
        units, directions = self._root_and_null_space[1]
        ways = (directions / units).T
        return ways / np.linalg.norm(ways, axis=0)

    @cached_property
    def _root_and_null_space(self) -> tuple[Array, tuple[Array, Array]]:
        """Matrix of `root`, and units (P,) with the directions (P − r, P) without information in
        these units, computed together.
        """
        units = np.linalg.norm(self.jacobian, axis=0)
        units[units == 0] = 1.0
        square = (self.jacobian / units)[: len(units)]
        size = len(units)
        # So that no eigenvalue is zero up to rounding; much faster.
        if len(square) == size > 0 and _trcon(square)[0] > size * np.sqrt(SINGULAR):
            return _trtri(square)[0] / units[:, None], (units, np.zeros((0, size)))
        _, singular_values, vectors = np.linalg.svd(square)
        values = np.zeros(len(units))
        values[: len(singular_values)] = singular_values
        is_determined = values**2 > SINGULAR
        root = vectors[is_determined].T / values[is_determined] / units[:, None]
        return root, (units, vectors[~is_determined])

    def covariance(self, score_covariance: Array | None = None) -> Array:
        """Return the covariance (P, P) of p.

        Undetermined parameters have infinite variance, and NaN covariances with all others.

        Parameters
        ----------
        score_covariance : (r, r) array, optional
            Lᵀ B L for errors e whose score Sᵀe has the covariance B, with L = `root`; by default
            errors are independent with unit variance.
        """
        root = self.root
        is_undetermined = self.is_undetermined
        matrix = root @ root.T if score_covariance is None else root @ score_covariance @ root.T
        matrix[is_undetermined] = matrix[:, is_undetermined] = np.nan
        matrix[is_undetermined, is_undetermined] = np.inf
        return matrix

    @cached_property
    def standard_errors(self) -> Array:
        """Standard deviations (P,) of p for independent errors of unit variance; infinite
        where undetermined.
        """
        return np.sqrt(np.diag(self.covariance()))


def _triangularise(rows: Array) -> Array:
    """Return the triangle (min(k, P + 1), P + 1) of a QR factorisation of rows (k, P + 1)."""
    size = rows.shape[1]
    factors, *_ = _geqrf(rows, lwork=64 * size)
    return np.triu(factors[:size])
