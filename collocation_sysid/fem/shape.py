"""Scalars of a body's shape as functions of its node positions: a length, and a volume.

The length of a polyline through points of a body: point k is at y_k = Σ_a N_a x_a, so that the ends
of a segment differ by d = B x, and its length l = |d| has, with e = d / l and P = 1 − e eᵀ, the
derivatives

    ∂l/∂d = e,   ∂²l/∂d² = P / l,   δ · ∂³l/∂d³ = −(P (e·δ) + P δ eᵀ + e δᵀ P) / l².

The volume behind faces: the cone from the origin over a face y(ξ, η) = Σ N_i x_i has the volume
⅓ ∫ y · (y_ξ × y_η), which is a cubic form of the nodes, Σ A_ijk det[x_i, x_j, x_k], with A
antisymmetric: of a flat triangle det[a, b, c] / 6. So its second derivatives H(x) are linear in x,
and

    V = x · H(x) x / 6,   ∂V/∂x = H(x) x / 2,   Σ w_i ∂³V/∂x_i∂x² = H(w).
"""

from __future__ import annotations

from functools import cache, cached_property
from itertools import permutations

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


_PERMUTATIONS = [
    (p, float(np.linalg.det(np.eye(3)[list(p)]).round())) for p in permutations(range(3))
]


class Volume:
    """V(x) [m³] of the cones from a point over faces; of a closed surface, what it encloses.

    Parameters
    ----------
    faces : (F, 3) or (F, 6) node numbers
        Corners counter-clockwise seen from outside the volume; of quadratic ones then the nodes on
        the edges ab, bc, ca.
    node_count : int
    apex_m : (3,)
        It matters where the surface is open only.
    """

    def __init__(self, faces: Index, node_count: int, apex_m: Array | None = None) -> None:
        self.faces, self.node_count = faces, node_count
        self.apex_m = np.zeros(3) if apex_m is None else apex_m
        self._apex = np.tile(self.apex_m, node_count)

    def from_apex(self, apex_m: Array) -> Volume:
        """The same of cones from another point."""
        same = (apex_m == self.apex_m).all()
        return self if same else Volume(self.faces, self.node_count, apex_m)

    @cached_property
    def _terms(self) -> tuple[Index, Index, Index, Array]:
        """Rows and columns (lower triangle) of H, the dof that each is linear in, and its slope."""
        form = _form(self.faces.shape[1])
        i, j, k = np.nonzero(np.abs(form) > 1e-14)
        found = []
        for (a, b, c), sign in _PERMUTATIONS:
            row, column, by = (3 * self.faces[:, n] + axis for n, axis in ((i, a), (j, b), (k, c)))
            found.append((row, column, by, np.broadcast_to(6 * sign * form[i, j, k], row.shape)))
        rows, columns, by, factor = (
            np.concatenate([part.ravel() for part in parts]) for parts in zip(*found, strict=True)
        )
        lower = rows >= columns
        return rows[lower], columns[lower], by[lower], factor[lower]

    @cached_property
    def couplings(self) -> SymmetricPattern:
        """The dofs whose second derivatives are not zero, and the diagonal."""
        rows, columns, *_ = self._terms
        return SymmetricPattern.of_entries(rows, columns, self.node_count)

    @cached_property
    def _slopes(self) -> sp.csr_array:
        """(3n, entries) of H by x."""
        rows, columns, by, factor = self._terms
        entries = self.couplings.position(rows, columns)
        shape = (self.couplings.size, self.couplings.entries)
        return sp.csr_array((factor, (by, entries)), shape=shape)

    @cached_property
    def rim(self) -> Index:
        """(k, 2) or (k, 3) nodes of edges with a face on one side only; none where it is closed."""
        corners = self.faces[:, :3]
        edges = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2)
        codes = np.sort(edges, axis=1) @ [self.node_count, 1]
        _, which = np.unique(codes, return_inverse=True)
        # Neighbours go along their edge in opposite directions.
        left = np.bincount(which, np.sign(edges[:, 1] - edges[:, 0]))
        alone = left[which] != 0
        mid = self.faces[:, 3:].reshape(len(edges), -1)
        return np.hstack([edges, mid])[alone]

    def value(self, x: Array) -> Array:
        """V (T,) at positions (T, 3n)."""
        away = x - self._apex
        return (self._pulled(away) * away).sum(axis=1) / 3

    def gradient(self, x: Array) -> Array:
        """∂V/∂x (T, 3n)."""
        return self._pulled(x - self._apex)

    def hessian(self, x: Array) -> Array:
        """∂²V/∂x² (T, entries) on `couplings`."""
        return np.asarray((x - self._apex) @ self._slopes)

    def hessian_along(self, x: Array, w: Array) -> Array:
        """Σ w_i ∂³V/∂x_i∂x² (T, entries) for w (T, 3n)."""
        return np.asarray(w @ self._slopes)

    def _pulled(self, away: Array) -> Array:
        """H x / 2 = 3 Σ A_ijk x_j × x_k of every node i, for x (T, 3n) from the apex."""
        corners = away.reshape(len(away), -1, 3)[:, self.faces]  # (T, F, k, 3)
        turned = np.einsum("ijk,tfkc->tfijc", 3 * _form(self.faces.shape[1]), corners)
        of_faces = np.cross(corners[:, :, None], turned).sum(axis=3)
        found = np.zeros((self.node_count, len(away), 3))
        np.add.at(found, self.faces, of_faces.transpose(1, 2, 0, 3))
        return found.transpose(1, 0, 2).reshape(len(away), -1)


@cache
def _form(nodes: int) -> Array:
    """(k, k, k) A of a triangle with 3 or 6 nodes."""
    points, weights = _triangle_rule()
    values, slopes = _shape(points, nodes)
    form = np.einsum("q,qi,qj,qk->ijk", weights / 3, values, slopes[..., 0], slopes[..., 1])
    turned = [sign * form.transpose(p) for p, sign in _PERMUTATIONS]
    return np.asarray(np.mean(turned, axis=0))


def _triangle_rule() -> tuple[Array, Array]:
    """Points (q, 2) and weights (q,) that integrate polynomials of degree four."""
    nodes, weights = np.polynomial.legendre.leggauss(3)
    u, v = np.meshgrid((nodes + 1) / 2, (nodes + 1) / 2, indexing="ij")
    area = np.outer(weights, weights) / 4 * (1 - u)
    return np.column_stack([u.ravel(), ((1 - u) * v).ravel()]), area.ravel()


def _shape(points: Array, nodes: int) -> tuple[Array, Array]:
    """Shape functions (q, k) of a triangle, and their derivatives (q, k, 2)."""
    xi, eta = points.T
    of_corners = np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
    L = np.column_stack([1 - xi - eta, xi, eta])
    if nodes == 3:
        return L, np.broadcast_to(of_corners, (len(points), 3, 2))
    following = np.roll(L, -1, axis=1)
    values = np.hstack([L * (2 * L - 1), 4 * L * following])
    corner = (4 * L - 1)[..., None] * of_corners
    mid = following[..., None] * of_corners + L[..., None] * np.roll(of_corners, -1, axis=0)
    return values, np.concatenate([corner, 4 * mid], axis=1)
