"""What rows of residuals say about parameters, as one small triangle.

Rows r + S (p − p₀) are kept as the triangle T of a QR factorisation of (S, r − S p₀), so that
‖T (p, 1)‖² is the sum of their squares at any p. More rows update it by another QR: their normal
equations are never formed, and what T says stays positive semidefinite to rounding (Bierman,
"Factorization methods for discrete sequential estimation", 1977).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs
from scipy.optimize import lsq_linear

from ..arrays import Array, Index

# Triangles are so small that NumPy's checks would take longer than the work.
_names = ("geqrf", "trtrs", "trtri", "trcon")
_geqrf, _trtrs, _trtri, _trcon = get_lapack_funcs(_names, dtype=np.float64)
# Eigenvalue of the information SᵀS, in units of its diagonal, that is zero up to rounding; and the
# share of a parameter in such a direction that does not matter.
SINGULAR, NEGLIGIBLE = 1e-12, 1e-3
# Triangles of a smaller reciprocal condition are not solved by substitution.
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """The triangle of some rows.

    Attributes
    ----------
    triangle : (at most P + 1, P + 1) slopes, and residuals where p is zero behind them
    rows : int
        How many it stands for.
    """

    triangle: Array
    rows: int = 0

    @classmethod
    def none(cls, size: int) -> LeastSquares:
        """Of no rows on p (P,)."""
        return cls(np.zeros((0, size + 1)))

    def add(self, residual: Array, slope: Array, at: Array | None = None) -> LeastSquares:
        """With rows whose residual is r (k,) at p (P,), by default zero; slopes (k, P)."""
        right = residual if at is None else residual - slope @ at
        return self._with(np.column_stack([slope, right]), len(residual))

    def joined(self, other: LeastSquares, places: Index | slice = slice(None)) -> LeastSquares:
        """With all the rows of another, whose parameters are at some places of these."""
        rows = np.zeros((len(other.triangle), self.triangle.shape[1]))
        rows[:, :-1][:, places] = other.slope
        rows[:, -1] = other.residual
        return self._with(rows, other.rows)

    def _with(self, rows: Array, count: int) -> LeastSquares:
        if not count:
            return self
        return LeastSquares(_rotated(np.concatenate([self.triangle, rows])), self.rows + count)

    @property
    def slope(self) -> Array:
        """S, as the triangle has it."""
        return self.triangle[:, :-1]

    @property
    def residual(self) -> Array:
        """The residuals where p is zero, as the triangle has them."""
        return self.triangle[:, -1]

    @property
    def information(self) -> Array:
        """(P, P) SᵀS."""
        return self.slope.T @ self.slope

    @property
    def score(self) -> Array:
        """(P,) Sᵀ r, half the gradient of the loss where p is zero."""
        return self.slope.T @ self.residual

    def loss(self, p: Array) -> float:
        """Sum of the squares at p."""
        left = self.triangle @ np.append(p, 1.0)
        return float(left @ left)

    def best(self, lower: Array, upper: Array) -> Array:
        """The p between bounds with the least squares; of several the shortest."""
        size = len(lower)
        square, right = self.slope[:size], -self.residual[:size]
        regular = len(square) == size > 0 and _trcon(square)[0] > ROUNDING
        p = _trtrs(square, right)[0] if regular else np.linalg.lstsq(square, right)[0]
        if ((lower <= p) & (p <= upper)).all():
            return np.asarray(p, dtype=np.float64)
        return np.clip(lsq_linear(square, right, (lower, upper), method="bvls").x, lower, upper)

    def marginal(self, first: int) -> LeastSquares:
        """What the rows say about the first parameters, where the others are as is best then."""
        size = self.triangle.shape[1]
        others = np.arange(first, size - 1)
        order = np.concatenate([others, np.arange(first), [size - 1]])
        triangle = _rotated(self.triangle[:, order])[len(others) :, len(others) :]
        return LeastSquares(triangle, self.rows)

    @cached_property
    def root(self) -> Array:
        """(P, r) L with SᵀS = (L Lᵀ)⁻¹ in the r directions that the rows determine."""
        return self._split[0]

    @cached_property
    def undetermined(self) -> NDArray[np.bool_]:
        """(P,) parameters in whose direction the loss is flat."""
        return self._split[1]

    @cached_property
    def _split(self) -> tuple[Array, NDArray[np.bool_]]:
        units = np.linalg.norm(self.slope, axis=0)
        units[units == 0] = 1.0
        square, size = (self.slope / units)[: len(units)], len(units)
        # So that no eigenvalue is zero up to rounding; much faster.
        if len(square) == size > 0 and _trcon(square)[0] > size * np.sqrt(SINGULAR):
            return _trtri(square)[0] / units[:, None], np.zeros(size, dtype=bool)
        _, found, vectors = np.linalg.svd(square)
        values = np.zeros(len(units))
        values[: len(found)] = found
        known = values**2 > SINGULAR
        root = vectors[known].T / values[known] / units[:, None]
        return root, np.asarray((np.abs(vectors[~known]) > NEGLIGIBLE).any(axis=0))

    def covariance(self, of_score: Array | None = None) -> Array:
        """(P, P) of p, infinite variance where that is undetermined.

        Parameters
        ----------
        of_score : (r, r) Lᵀ B L, optional
            Of errors whose score Sᵀe has the covariance B; by default those of errors that are
            independent and of size one.
        """
        root, lost = self.root, self.undetermined
        found = root @ root.T if of_score is None else root @ of_score @ root.T
        found[lost] = found[:, lost] = np.nan
        found[lost, lost] = np.inf
        return found

    @cached_property
    def errors(self) -> Array:
        """(P,) standard deviations of p, for independent rows whose errors are of size one."""
        return np.sqrt(np.diag(self.covariance()))


def _rotated(rows: Array) -> Array:
    size = rows.shape[1]
    factors, *_ = _geqrf(rows, lwork=64 * size)
    return np.triu(factors[:size])
