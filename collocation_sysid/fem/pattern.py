"""Sparsity patterns of matrices on the mesh graph: one lower triangle shared by all time steps."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..common.array_types import Array, Index


@dataclass(frozen=True, eq=False)
class SymmetricPattern:
    """Positions of the lower triangle of a symmetric (3n, 3n) matrix.

    Row and column 3i + j belong to coordinate j of node i. Entries are sorted by column, then row,
    and every diagonal entry is present.
    """

    size: int  # number 3n of rows
    # (m,): row and column of each entry, rows >= columns.
    rows: Index
    columns: Index

    @classmethod
    def from_cells(cls, cells: Index, nodes: int) -> SymmetricPattern:
        """Return the pattern of a stiffness matrix on cells (E, k) of a mesh with `nodes` nodes."""
        dofs = dofs_of(cells)
        row = np.repeat(dofs, dofs.shape[1], axis=1).ravel()
        column = np.tile(dofs, dofs.shape[1]).ravel()
        lower = row >= column
        return cls.from_entries(row[lower], column[lower], nodes=nodes)

    @classmethod
    def from_entries(cls, rows: Index, columns: Index, nodes: int) -> SymmetricPattern:
        """Return the pattern of size 3 · `nodes` with these entries of the lower triangle, rows ≥
        columns, and the diagonal; repetitions are merged.
        """
        size = 3 * nodes
        diagonal = np.arange(size) * (size + 1)
        codes = unique_codes([columns * size + rows, diagonal])
        return cls(size, codes % size, columns=codes // size)

    @property
    def entry_count(self) -> int:
        """Number m of entries in the lower triangle."""
        return len(self.rows)

    @cached_property
    def diagonal(self) -> Index:
        """Index among the entries of each diagonal entry, (3n,)."""
        return np.flatnonzero(self.rows == self.columns)

    def positions_of(self, row: Index, column: Index) -> Index:
        """Return the indices among the entries of (row, column) pairs given in either triangle, in
        the shape of `row`.

        Raises
        ------
        IndexError
            If an entry is not in the pattern.
        """
        low = np.minimum(row, column)
        high = np.maximum(row, column)
        codes = self.columns * self.size + self.rows
        requested_codes = low * self.size + high
        positions = np.searchsorted(codes, requested_codes)
        if (positions >= len(codes)).any() or (codes[positions] != requested_codes).any():
            raise IndexError("an entry lies outside the mesh graph")
        return positions

    @cached_property
    def full(self) -> tuple[Index, Index, Index]:
        """Rows and columns of the entries of both triangles, sorted by column, then row, and the
        entry of the lower triangle of each.
        """
        strict = self.rows != self.columns
        rows = np.concatenate([self.rows, self.columns[strict]])
        columns = np.concatenate([self.columns, self.rows[strict]])
        source = np.concatenate([np.arange(self.entry_count), np.flatnonzero(strict)])
        order = np.lexsort((rows, columns))
        return rows[order], columns[order], source[order]

    def matrix(self, values: NDArray[np.float64], skew: Array | None = None) -> sp.csc_array:
        """Return the full matrix, sparse (3n, 3n) with both triangles, with the lower triangles
        (m,) of its symmetric part and of its skew part, which is zero by default.
        """
        rows, columns, source = self.full
        entries = values[source]
        if skew is not None and skew.size:
            entries = entries + np.sign(rows - columns) * skew[source]
        return sp.csc_array((entries, *self._compressed), shape=(self.size, self.size))

    @cached_property
    def _compressed(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Row of each entry of `full`, first entry and length of each column, for all matrices."""
        rows, columns, _ = self.full
        starts = np.searchsorted(columns, np.arange(self.size + 1))
        indices, pointers = rows.astype(np.int32), starts.astype(np.int32)
        indices.flags.writeable = pointers.flags.writeable = False
        return indices, pointers

    def products(self, values: Array, vectors: Array) -> Array:
        """Return for each t the product of the symmetric matrix with lower-triangle values (T, m)
        and a vector (T, 3n); (T, 3n), for T ≥ 1.
        """
        pairs = zip(values, vectors, strict=True)
        return np.stack([self.matrix(value) @ vector for value, vector in pairs])


@dataclass(frozen=True, eq=False)
class JointPattern:
    """Union of several patterns."""

    pattern: SymmetricPattern  # union; the first pattern itself if it contains the others
    # tuple of (m,) int array: positions in the union of the entries of each pattern.
    places: tuple[Index, ...]

    @staticmethod
    @lru_cache(maxsize=16)
    def from_patterns(patterns: tuple[SymmetricPattern, ...]) -> JointPattern:
        """Return the union of patterns of one size, at least one; the latest 16 results are cached
        by the identity of the patterns.
        """
        rows = np.concatenate([pattern.rows for pattern in patterns])
        columns = np.concatenate([pattern.columns for pattern in patterns])
        union = SymmetricPattern.from_entries(rows, columns, nodes=patterns[0].size // 3)
        union = patterns[0] if union.entry_count == patterns[0].entry_count else union
        return JointPattern(union, tuple(union.positions_of(p.rows, p.columns) for p in patterns))

    def expand(self, values: Array) -> Array:
        """Return values (T, m) of the first pattern as values (T, M) of the union, with zeros
        elsewhere.

        The same array is returned if both patterns are equal, or if it is empty, (T, 0), as absent
        skew parts are.
        """
        if not values.size or values.shape[1] == self.pattern.entry_count:
            return values
        expanded = np.zeros((len(values), self.pattern.entry_count))
        expanded[:, self.places[0]] = values
        return expanded


def dofs_of(nodes: Index) -> Index:
    """Return the dofs 3i, 3i + 1, 3i + 2 of each node i of the last axis: (…, k) to (…, 3k)."""
    return (3 * nodes[..., None] + np.arange(3)).reshape(*nodes.shape[:-1], -1)


def element_destinations(pattern: SymmetricPattern, cells: Index) -> tuple[Index, Index]:
    """Return the positions of the vectors and lower triangles of elements in global arrays.

    Parameters
    ----------
    pattern : SymmetricPattern
        Pattern that contains all pairs of dofs of an element.
    cells : (E, nodes) int
        Nodes of each element, in any order.

    Returns
    -------
    vector : (E, 3·nodes) ndarray
        Global row of each local one.
    lower : (E, 3·nodes·(3·nodes + 1)/2) ndarray
        Position in `pattern` of each local lower-triangle entry, column after column.

    Raises
    ------
    IndexError
        If an entry is not in the pattern.
    """
    dofs = dofs_of(cells)
    size = dofs.shape[1]
    local_columns, local_rows = np.triu_indices(size)
    return dofs, pattern.positions_of(dofs[:, local_rows], dofs[:, local_columns])


def with_ascending_nodes(cells: Index, geometry: Array) -> tuple[Index, Array]:
    """Return elements (E, nodes) with ascending node indices, and their geometry
    (E, q, 3·nodes + 1) with shape gradients in the same order; the arguments are not changed.
    """
    if (np.diff(cells, axis=1) > 0).all():
        return cells, geometry
    order = np.argsort(cells, axis=1)
    gradients = geometry[..., :-1].reshape(*geometry.shape[:2], -1, 3)
    sorted_gradients = np.take_along_axis(gradients, order[:, None, :, None], axis=2)
    gradient_rows = sorted_gradients.reshape(*geometry.shape[:2], -1)
    return np.take_along_axis(cells, order, axis=1), np.append(
        gradient_rows, geometry[..., -1:], axis=2
    )


def unique_codes(groups: Iterable[Index]) -> Index:
    """Return all codes of some groups in ascending order, each once; empty without groups.

    Groups that consist of few ascending runs take linear time: they are merged. `numpy.unique`
    would insert every code into a hash table, which takes some hundred times as long for ten
    million codes.

    Parameters
    ----------
    groups : iterable of (n,) arrays of int
        Codes in any order; they are not modified.
    """
    codes = np.concatenate([np.zeros(0, dtype=np.int64), *groups])
    # The stable sort of integers finds ascending runs and merges them.
    codes.sort(kind="stable")
    is_first = np.ones(len(codes), dtype=bool)
    np.not_equal(codes[1:], codes[:-1], out=is_first[1:])
    return codes if is_first.all() else codes[is_first]
