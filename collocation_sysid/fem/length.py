"""The length of a polyline through points of a body, as a function of its node positions.

Point k is at y_k = Σ_a N_a x_a, so that the ends of a segment differ by d = B x, and its length
l = |d| has, with e = d / l and P = 1 − e eᵀ, the derivatives

    ∂l/∂d = e,   ∂²l/∂d² = P / l,   δ · ∂³l/∂d³ = −(P (e·δ) + P δ eᵀ + e δᵀ P) / l².
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ..arrays import Array, Index
from .pattern import SymmetricPattern

# The lower triangle of a symmetric (3, 3), column after column.
_ROWS, _COLUMNS = np.array([0, 1, 2, 1, 2, 2]), np.array([0, 0, 0, 1, 1, 2])
_PLACE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


class Length:
    """L(x) [m] of the polyline through points with fixed weights on nodes.

    Parameters
    ----------
    nodes : (P, npe) node numbers of each point, P > 1
    weights : (P, npe)
    node_count : int
    """

    def __init__(self, nodes: Index, weights: Array, node_count: int) -> None:
        self.node_count, self._segments = node_count, len(nodes) - 1
        points = np.repeat(np.arange(len(nodes)), nodes.shape[1])
        shape = (len(nodes), node_count)
        placed = sp.csr_array((weights.ravel(), (points, nodes.ravel())), shape=shape)
        self._differences = sp.csr_array(placed[1:] - placed[:-1])  # (J, n)
        self._differences.eliminate_zeros()

    @cached_property
    def couplings(self) -> SymmetricPattern:
        """The dofs whose second derivatives are not zero, and the diagonal."""
        rows, columns, *_ = self._pairs
        return SymmetricPattern.of_entries(rows, columns, self.node_count)

    @cached_property
    def _pairs(self) -> tuple[Index, Index, Array, Index]:
        """Lower-triangle dofs, weight, and place in (6 J) of what each pair of nodes adds."""
        found = []
        for j in range(self._segments):
            one = self._differences[[j]].tocoo()
            dofs = (3 * one.coords[1][:, None] + np.arange(3)).ravel()
            axes, weights = np.tile(np.arange(3), one.nnz), np.repeat(one.data, 3)
            a, b = np.nonzero(dofs[:, None] >= dofs)
            place = 6 * j + _PLACE[axes[a], axes[b]]
            found.append((dofs[a], dofs[b], weights[a] * weights[b], place))
        rows, columns, weights, places = (
            np.concatenate(parts) for parts in zip(*found, strict=True)
        )
        return rows, columns, weights, places

    @cached_property
    def _spread(self) -> sp.csr_array:
        """(6 J, entries) from second derivatives by d to those by x."""
        rows, columns, weights, places = self._pairs
        entries = self.couplings.position(rows, columns)
        shape = (6 * self._segments, self.couplings.entries)
        return sp.csr_array((weights, (places, entries)), shape=shape)

    def value(self, x: Array) -> Array:
        """L (T,) at positions (T, 3n)."""
        return np.linalg.norm(self._vectors(x), axis=2).sum(axis=1)

    def gradient(self, x: Array) -> Array:
        """∂L/∂x (T, 3n)."""
        along = _unit(self._vectors(x))[0].transpose(1, 0, 2)  # (J, T, 3)
        spread = self._differences.T @ along.reshape(len(along), -1)
        return spread.reshape(-1, len(x), 3).transpose(1, 0, 2).reshape(len(x), -1)

    def hessian(self, x: Array) -> Array:
        """∂²L/∂x² (T, entries) on `couplings`."""
        e, length = _unit(self._vectors(x))
        across = np.eye(3) - e[..., :, None] * e[..., None, :]
        return self._assembled(across / length[..., None])

    def hessian_along(self, x: Array, w: Array) -> Array:
        """Σ w_i ∂³L/∂x_i∂x² (T, entries) for w (T, 3n)."""
        e, length = _unit(self._vectors(x))
        delta = self._vectors(w)
        along = (e * delta).sum(axis=2, keepdims=True)
        aside = (delta - along * e)[..., :, None] * e[..., None, :]
        across = np.eye(3) - e[..., :, None] * e[..., None, :]
        bent = along[..., None] * across + aside + np.swapaxes(aside, 2, 3)
        return self._assembled(-bent / length[..., None] ** 2)

    def _vectors(self, x: Array) -> Array:
        """(T, J, 3) from each point to the next."""
        by_node = x.reshape(len(x), -1, 3).transpose(1, 0, 2)
        found = self._differences @ by_node.reshape(len(by_node), -1)
        return found.reshape(-1, len(x), 3).transpose(1, 0, 2)

    def _assembled(self, by_vector: Array) -> Array:
        """(T, entries) from (T, J, 3, 3)."""
        lower = by_vector[..., _ROWS, _COLUMNS]
        return np.asarray(lower.reshape(len(lower), -1) @ self._spread)


def _unit(vectors: Array) -> tuple[Array, Array]:
    """Directions (T, J, 3) and lengths (T, J, 1)."""
    length = np.linalg.norm(vectors, axis=2, keepdims=True)
    return vectors / length, length
