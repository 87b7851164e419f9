"""The volume behind faces of a body, as a function of its node positions.

The cone from the origin over a face y(ξ, η) = Σ N_i x_i has the volume ⅓ ∫ y · (y_ξ × y_η), which
is a cubic form of the nodes, Σ A_ijk det[x_i, x_j, x_k], with A antisymmetric: of a flat triangle
det[a, b, c] / 6. So its second derivatives H(x) are linear in x, and

    V = x · H(x) x / 6,   ∂V/∂x = H(x) x / 2,   Σ w_i ∂³V/∂x_i∂x² = H(w).
"""

from __future__ import annotations

from functools import cache, cached_property
from itertools import permutations

import numpy as np
import scipy.sparse as sp

from ..arrays import Array, Index
from .pattern import SymmetricPattern

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
