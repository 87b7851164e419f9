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
from scipy.linalg import get_lapack_funcs

from ..arrays import Array

# Triangles are so small that NumPy's checks would take longer than the work.
_geqrf, _trtrs, _trtri = get_lapack_funcs(("geqrf", "trtrs", "trtri"), dtype=np.float64)
# Changes of what is held at bounds, for each parameter, before the search for the best ends.
TURNS = 3


@dataclass(frozen=True, eq=False)
class Information:
    """The triangle of some rows.

    Attributes
    ----------
    triangle : (P + 1, P + 1)
    rows : int
        How many it stands for.
    """

    triangle: Array
    rows: int = 0

    @classmethod
    def none(cls, size: int) -> Information:
        """Of no rows on p (P,)."""
        return cls(np.zeros((size + 1, size + 1)))

    def with_rows(self, residual: Array, slope: Array, p: Array) -> Information:
        """With rows whose residual is r (k,) at p (P,), and their slopes (k, P)."""
        return self._with(np.column_stack([slope, residual - slope @ p]), len(residual))

    def joined(self, other: Information) -> Information:
        """With all the rows of another."""
        return self._with(other.triangle, other.rows)

    def _with(self, rows: Array, count: int) -> Information:
        if not count:
            return self
        size = len(self.triangle)
        factors, *_ = _geqrf(np.vstack([self.triangle, rows]), lwork=64 * size)
        return Information(np.triu(factors[:size]), self.rows + count)

    def loss(self, p: Array) -> float:
        """Sum of the squares at p."""
        left = self.triangle @ np.append(p, 1.0)
        return float(left @ left)

    def best(self, lower: Array, upper: Array) -> Array:
        """The p between bounds with the least squares.

        What the rows say must be definite. By active sets: what leaves its bounds is held there,
        and what would rather come back is let go.
        """
        size = len(lower)
        square, right = self.triangle[:size, :size], self.triangle[:size, size]
        p: Array = _trtrs(square, -right)[0]
        held = np.zeros(size, dtype=bool)
        for _ in range(TURNS * size):
            outside = ~held & ((p < lower) | (p > upper))
            p = np.clip(p, lower, upper)
            if outside.any():
                held |= outside
            else:
                pull = square.T @ (square @ p + right)
                back = np.where(p <= lower, -pull, np.where(p >= upper, pull, 0.0)) * held
                if back.max(initial=0.0) <= 1e-9 * np.abs(pull).max(initial=1.0):
                    break
                held[back.argmax()] = False
            free = np.flatnonzero(~held)
            q, r = np.linalg.qr(square[:, free])
            p[free] = np.linalg.solve(r, -q.T @ (right + square[:, held] @ p[held]))
        return np.clip(p, lower, upper)

    @cached_property
    def covariance(self) -> Array:
        """(P, P) of p, for rows whose errors are independent and of size one."""
        size = len(self.triangle) - 1
        root, _ = _trtri(self.triangle[:size, :size])
        return root @ root.T

    @cached_property
    def errors(self) -> Array:
        """(P,) standard deviations of p then."""
        return np.sqrt(np.diag(self.covariance))
