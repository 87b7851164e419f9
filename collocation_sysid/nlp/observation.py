"""The loss of one experiment: squared marker residuals in units of their standard deviation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..experiment.markers import Markers
from ..fem.pattern import SymmetricPattern

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Observation:
    """L(x) = Σ ‖(ŷ_t − h(x_t)) / σ‖² over present samples of the tracks.

    Attributes
    ----------
    markers : Markers
    grid_rows : (T,) row of the collocation grid at each sample
    """

    markers: Markers
    grid_rows: Index

    @property
    def count(self) -> int:
        """Number of scalar measurements present."""
        return 3 * self.markers.samples

    @cached_property
    def weights(self) -> Array:
        """(T, 3M) of 1/σ, zero where a sample is missing."""
        weights = self.markers.present / self.markers.sigma_m
        return np.repeat(weights, 3, axis=1)

    @cached_property
    def _measured(self) -> Array:
        tracks = self.markers.positions_m
        return np.nan_to_num(tracks).reshape(len(tracks), -1)

    def residuals(self, x: Array) -> Array:
        """(T, 3M) of (h(x_t) − ŷ_t) / σ at grid positions x (N, 3n); zero where missing."""
        predicted = (self.markers.operator @ x[self.grid_rows].T).T
        return (predicted - self._measured) * self.weights

    def linearised(self, x: Array, step: Array, by_q: Array) -> tuple[Array, Array]:
        """Residuals after a step of the positions, and their derivative by q.

        Only samples within the rows given count.

        Parameters
        ----------
        x, step : (rows, 3n), the first grid rows
        by_q : (rows, 3n, nq)

        Returns
        -------
        residual : (t · 3M,) ndarray, slope : (t · 3M, nq) ndarray
        """
        rows = self.grid_rows[self.grid_rows < len(x)]
        count, operator = len(rows), self.markers.operator
        weights = self.weights[:count]
        predicted = (operator @ (x[rows] + step[rows]).T).T
        residual = (predicted - self._measured[:count]) * weights
        _, dofs, nq = by_q.shape
        columns = by_q[rows].transpose(1, 0, 2).reshape(dofs, count * nq)
        slope = (operator @ columns).reshape(self.weights.shape[1], count, nq).transpose(1, 0, 2)
        return residual.ravel(), (slope * weights[..., None]).reshape(residual.size, nq)

    def squared_distances_m2(self, x: Array) -> Array:
        """Squared distances of present samples within the first grid rows x (rows, 3n)."""
        rows = self.grid_rows[self.grid_rows < len(x)]
        predicted = self.markers.observe(x[rows].reshape(len(rows), -1, 3))
        squares = np.sum((predicted - self.markers.positions_m[: len(rows)]) ** 2, axis=2)
        return squares[self.markers.present[: len(rows)]]

    def loss(self, x: Array) -> float:
        """L(x)."""
        return float(np.sum(self.residuals(x) ** 2))

    def gradient(self, x: Array) -> Array:
        """∂L/∂x, (N, 3n)."""
        gradient = np.zeros_like(x)
        weighted = 2 * self.residuals(x) * self.weights
        gradient[self.grid_rows] = (self.markers.operator.T @ weighted.T).T
        return gradient

    def hessian(self, pattern: SymmetricPattern) -> tuple[Index, Array]:
        """∂²L/∂x_t², constant, as lower-triangle positions (k,) and values (T, k)."""
        operator = sp.coo_array(self.markers.operator)
        row_of, dof_of = (np.asarray(index, dtype=np.int64) for index in operator.coords)
        count = 3 * len(self.markers.names)
        per_row = []
        for row in range(count):
            here = row_of == row
            dofs, values = dof_of[here], operator.data[here]
            a, b = np.triu_indices(len(dofs))
            per_row.append(
                (np.full(len(a), row), pattern.position(dofs[a], dofs[b]), values[a] * values[b])
            )
        rows, positions, products = (np.concatenate(part) for part in zip(*per_row, strict=True))
        places, index = np.unique(positions, return_inverse=True)
        spread = sp.csr_array((products, (index, rows)), shape=(len(places), count))
        return places, 2 * (spread @ (self.weights**2).T).T
