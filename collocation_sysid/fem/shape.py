"""Length and volume of a deformed body as functions of its node positions, with derivatives.

Length of a polyline through points of a body, for tendons: point k is at y_k = Σ_a N_a x_a, so that
the ends of a segment differ by d = B x. With e = d / l and P = 1 − e eᵀ, its length l = |d| has the
derivatives

    ∂l/∂d = e,   ∂²l/∂d² = P / l,   δ · ∂³l/∂d³ = −(P (e·δ) + P δ eᵀ + e δᵀ P) / l².

Volume enclosed by faces, for pressures: the cone from the origin over a face y(ξ, η) = Σ N_i x_i
has the volume ⅓ ∫ y · (y_ξ × y_η). This is a cubic form of the nodes, Σ A_ijk det[x_i, x_j, x_k]
with antisymmetric A; for a flat triangle it is det[a, b, c] / 6. Its second derivatives H(x) are
therefore linear in x, and

    V = x · H(x) x / 6,   ∂V/∂x = H(x) x / 2,   Σ w_i ∂³V/∂x_i∂x² = H(w).
"""

from __future__ import annotations

from functools import cache, cached_property
from itertools import permutations

import numpy as np
import scipy.sparse as sp

from ..common.array_types import Array, Index
from .pattern import SymmetricPattern

# The lower triangle of a symmetric (3, 3), column after column.
_ROWS = np.array([0, 1, 2, 1, 2, 2])
_COLUMNS = np.array([0, 0, 0, 1, 1, 2])
_PLACE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


class PolylineLength:
    """Length L(x) [m] of the polyline through points with fixed weights of nodes.

    Derivatives are NaN where two consecutive points coincide.

    Parameters
    ----------
    nodes : (P, npe)
        Node indices of each point, P > 1.
    weights : (P, npe)
        Weights of these nodes.
    """

    def __init__(self, nodes: Index, weights: Array, node_count: int) -> None:
        self.node_count = node_count
        self._segments = len(nodes) - 1
        points = np.repeat(np.arange(len(nodes)), nodes.shape[1])
        shape = (len(nodes), node_count)
        placed = sp.csr_array((weights.ravel(), (points, nodes.ravel())), shape=shape)
        self._differences = sp.csr_array(placed[1:] - placed[:-1])  # (J, n)
        self._differences.eliminate_zeros()

    @cached_property
    def couplings(self) -> SymmetricPattern:
        """Pairs of dofs with a nonzero second derivative, and the diagonal."""
        rows, columns, *_ = self._pairs
        return SymmetricPattern.from_entries(rows, columns, nodes=self.node_count)

    @cached_property
    def _pairs(self) -> tuple[Index, Index, Array, Index]:
        """Second derivatives of all segments: rows, columns, weights, entries by d."""
        segment_parts = []
        for j in range(self._segments):
            segment = self._differences[[j]].tocoo()
            dofs = (3 * segment.coords[1][:, None] + np.arange(3)).ravel()
            axes = np.tile(np.arange(3), segment.nnz)
            weights = np.repeat(segment.data, 3)
            a, b = np.nonzero(dofs[:, None] >= dofs)
            place = 6 * j + _PLACE[axes[a], axes[b]]
            segment_parts.append((dofs[a], dofs[b], weights[a] * weights[b], place))
        rows, columns, weights, places = map(np.concatenate, zip(*segment_parts, strict=True))
        return rows, columns, weights, places

    @cached_property
    def _assembly_matrix(self) -> sp.csr_array:
        """Matrix (6 J, entries) from second derivatives by d to those by x."""
        rows, columns, weights, places = self._pairs
        entries = self.couplings.positions_of(rows, columns)
        shape = (6 * self._segments, self.couplings.entry_count)
        return sp.csr_array((weights, (places, entries)), shape=shape)

    def evaluate(self, x: Array) -> Array:
        """Return the lengths L (T,) at positions (T, 3n)."""
        return np.linalg.norm(self._vectors(x), axis=2).sum(axis=1)

    def gradient(self, x: Array) -> Array:
        """Return ∂L/∂x (T, 3n) at positions (T, 3n)."""
        directions = _directions_and_lengths(self._vectors(x))[0].transpose(1, 0, 2)  # (J, T, 3)
        nodal = self._differences.T @ directions.reshape(len(directions), -1)
        return nodal.reshape(-1, len(x), 3).transpose(1, 0, 2).reshape(len(x), -1)

    def hessian(self, x: Array) -> Array:
        """Return ∂²L/∂x² [1/m] at positions (T, 3n), as values (T, entries) on the pattern
        `couplings`.
        """
        e, length = _directions_and_lengths(self._vectors(x))
        across = np.eye(3) - e[..., :, None] * e[..., None, :]
        return self._assemble(across / length[..., None])

    def hessian_derivative(self, x: Array, w: Array) -> Array:
        """Return Σ w_i ∂³L/∂x_i∂x² (T, entries) at positions x, in the directions w, (T, 3n)
        each.
        """
        e, length = _directions_and_lengths(self._vectors(x))
        delta = self._vectors(w)
        projection = (e * delta).sum(axis=2, keepdims=True)
        mixed = (delta - projection * e)[..., :, None] * e[..., None, :]
        across = np.eye(3) - e[..., :, None] * e[..., None, :]
        derivative = projection[..., None] * across + mixed + np.swapaxes(mixed, 2, 3)
        return self._assemble(-derivative / length[..., None] ** 2)

    def _vectors(self, x: Array) -> Array:
        """Return the vectors (T, J, 3) from each point to the next."""
        by_node = x.reshape(len(x), -1, 3).transpose(1, 0, 2)
        differences = self._differences @ by_node.reshape(len(by_node), -1)
        return differences.reshape(-1, len(x), 3).transpose(1, 0, 2)

    def _assemble(self, by_vector: Array) -> Array:
        """Return values (T, entries) on `couplings` from second derivatives by d (T, J, 3, 3)."""
        lower = by_vector[..., _ROWS, _COLUMNS]
        return np.asarray(lower.reshape(len(lower), -1) @ self._assembly_matrix)


def _directions_and_lengths(vectors: Array) -> tuple[Array, Array]:
    """Return directions (T, J, 3), NaN where zero, and lengths (T, J, 1) of vectors."""
    length = np.linalg.norm(vectors, axis=2, keepdims=True)
    return vectors / length, length


_PERMUTATIONS = [
    (p, float(np.linalg.det(np.eye(3)[list(p)]).round())) for p in permutations(range(3))
]


class EnclosedVolume:
    """Volume V(x) [m³] of the cones from an apex over faces.

    For a closed surface the enclosed volume.

    Parameters
    ----------
    faces : (F, 3) or (F, 6)
        Node indices: corners counter-clockwise as seen from outside the volume; for quadratic faces
        then the nodes on the edges ab, bc, ca.
    apex_m : (3,), optional
        Apex of the cones; the origin by default. It matters only if the surface is open.
    """

    def __init__(self, faces: Index, node_count: int, apex_m: Array | None = None) -> None:
        self.faces = faces
        self.node_count = node_count
        self.apex_m = np.zeros(3) if apex_m is None else apex_m
        self._apex = np.tile(self.apex_m, node_count)

    def with_apex(self, apex_m: Array) -> EnclosedVolume:
        """Return this volume with cones from another apex (3,) [m]; self if it is the same."""
        is_same = (apex_m == self.apex_m).all()
        return self if is_same else EnclosedVolume(self.faces, self.node_count, apex_m=apex_m)

    @cached_property
    def _terms(self) -> tuple[Index, Index, Index, Array]:
        """Rows, columns, dofs and factors (M,) of factor · x[dof] in the lower triangle of H."""
        form = _cubic_form(self.faces.shape[1])
        i, j, k = np.nonzero(np.abs(form) > 1e-14)
        term_parts = []
        for (a, b, c), sign in _PERMUTATIONS:
            row, column, by = (3 * self.faces[:, n] + axis for n, axis in ((i, a), (j, b), (k, c)))
            term_parts.append(
                (row, column, by, np.broadcast_to(6 * sign * form[i, j, k], row.shape))
            )
        rows, columns, by, factor = (
            np.concatenate([part.ravel() for part in parts])
            for parts in zip(*term_parts, strict=True)
        )
        lower = rows >= columns
        return rows[lower], columns[lower], by[lower], factor[lower]

    @cached_property
    def couplings(self) -> SymmetricPattern:
        """Pairs of dofs with a nonzero second derivative, and the diagonal."""
        rows, columns, *_ = self._terms
        return SymmetricPattern.from_entries(rows, columns, nodes=self.node_count)

    @cached_property
    def _hessian_matrix(self) -> sp.csr_array:
        """Matrix (3n, entries) from x to H."""
        rows, columns, dofs, factors = self._terms
        entries = self.couplings.positions_of(rows, columns)
        shape = (self.couplings.size, self.couplings.entry_count)
        return sp.csr_array((factors, (dofs, entries)), shape=shape)

    @cached_property
    def rim(self) -> Index:
        """Nodes (k, 2), or (k, 3) with the mid node last, of edges with a face on one side only.

        Empty for a closed surface.
        """
        corners = self.faces[:, :3]
        edges = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2)
        codes = np.sort(edges, axis=1) @ [self.node_count, 1]
        _, edge_index = np.unique(codes, return_inverse=True)
        # Neighbours go along their edge in opposite directions.
        orientation_sum = np.bincount(edge_index, np.sign(edges[:, 1] - edges[:, 0]))
        is_rim = orientation_sum[edge_index] != 0
        mid = self.faces[:, 3:].reshape(len(edges), -1)
        return np.hstack([edges, mid])[is_rim]

    def evaluate(self, x: Array) -> Array:
        """Return the volumes V (T,) at positions (T, 3n)."""
        relative = x - self._apex
        return (self._gradient_from_apex(relative) * relative).sum(axis=1) / 3

    def gradient(self, x: Array) -> Array:
        """Return ∂V/∂x (T, 3n) at positions (T, 3n)."""
        return self._gradient_from_apex(x - self._apex)

    def hessian(self, x: Array) -> Array:
        """Return ∂²V/∂x² (T, entries) on `couplings`, at positions (T, 3n)."""
        return np.asarray((x - self._apex) @ self._hessian_matrix)

    def hessian_derivative(self, x: Array, w: Array) -> Array:
        """Return Σ w_i ∂³V/∂x_i∂x² (T, entries) on `couplings` in the directions w (T, 3n); it does
        not depend on the positions x (T, 3n).
        """
        return np.asarray(w @ self._hessian_matrix)

    def _gradient_from_apex(self, away: Array) -> Array:
        """Return 3 Σ A_ijk x_j × x_k of every node, from positions (T, 3n)."""
        corners = away.reshape(len(away), -1, 3)[:, self.faces]  # (T, F, k, 3)
        weighted = np.einsum("ijk,tfkc->tfijc", 3 * _cubic_form(self.faces.shape[1]), corners)
        of_faces = np.cross(corners[:, :, None], weighted).sum(axis=3)
        nodal = np.zeros((self.node_count, len(away), 3))
        np.add.at(nodal, self.faces, of_faces.transpose(1, 2, 0, 3))
        return nodal.transpose(1, 0, 2).reshape(len(away), -1)


@cache
def _cubic_form(nodes: int) -> Array:
    """Return A (k, k, k) of a triangle with 3 or 6 nodes."""
    points, weights = _triangle_rule()
    values, slopes = _triangle_shape_functions(points, nodes)
    form = np.einsum("q,qi,qj,qk->ijk", weights / 3, values, slopes[..., 0], slopes[..., 1])
    permuted = [sign * form.transpose(p) for p, sign in _PERMUTATIONS]
    return np.asarray(np.mean(permuted, axis=0))


def _triangle_rule() -> tuple[Array, Array]:
    """Return points (q, 2) and weights (q,), exact for polynomials of degree four."""
    nodes, weights = np.polynomial.legendre.leggauss(3)
    u, v = np.meshgrid((nodes + 1) / 2, (nodes + 1) / 2, indexing="ij")
    area = np.outer(weights, weights) / 4 * (1 - u)
    return np.column_stack([u.ravel(), ((1 - u) * v).ravel()]), area.ravel()


def _triangle_shape_functions(points: Array, nodes: int) -> tuple[Array, Array]:
    """Return shape functions (q, k) of a triangle and their derivatives (q, k, 2) by ξ and η."""
    xi, eta = points.T
    corner_slopes = np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
    L = np.column_stack([1 - xi - eta, xi, eta])
    if nodes == 3:
        return L, np.broadcast_to(corner_slopes, (len(points), 3, 2))
    next_coordinate = np.roll(L, -1, axis=1)
    values = np.hstack([L * (2 * L - 1), 4 * L * next_coordinate])
    corner = (4 * L - 1)[..., None] * corner_slopes
    mid = next_coordinate[..., None] * corner_slopes + L[..., None] * np.roll(
        corner_slopes, -1, axis=0
    )
    return values, np.concatenate([corner, 4 * mid], axis=1)
