"""Matrices on the mesh graph that are not symmetric: a symmetric part and a skew one.

Both are given by lower triangles, (m,) each; the skew part's is empty where there is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.sparse as sp

from ..arrays import Array, Index
from ..fem.pattern import SymmetricPattern
from .block_band import Block, BlockBand, Term


def signs_by_column(pattern: SymmetricPattern) -> Array:
    """(nnz,) signs of a skew matrix's lower triangle in the entries of `pattern.full`."""
    rows, columns, _ = pattern.full
    return np.sign(rows - columns).astype(float)


def skew_values(pattern: SymmetricPattern, skew: Array) -> Array:
    """Entries (…, nnz) of the whole skew matrix in the order of `pattern.full`; none of none."""
    if not skew.size:
        return skew
    # Rows contiguous, which fancy indices would not leave so.
    return np.take(skew, pattern.full[2], axis=-1) * signs_by_column(pattern)


class Submatrix:
    """Some rows and columns of matrices that are given so.

    Parameters
    ----------
    pattern : SymmetricPattern
    rows : (k,) ascending dofs
    columns : (c,) ascending dofs, by default all
    """

    def __init__(
        self, pattern: SymmetricPattern, rows: Index, columns: Index | None = None
    ) -> None:
        # Entries are sorted by column, so that those of the transpose are sorted by row.
        across, along, source = pattern.full
        count = pattern.size if columns is None else len(columns)
        place, number = np.full((2, pattern.size), -1)
        place[rows] = np.arange(len(rows))
        number[slice(None) if columns is None else columns] = np.arange(count)
        kept = (place[along] >= 0) & (number[across] >= 0)
        self._source = source[kept]
        self._in_both = source[kept] + np.where((along > across)[kept], 0, pattern.entries)
        ends = np.cumsum(np.bincount(place[along[kept]], minlength=len(rows)))
        parts = np.zeros(kept.sum()), number[across[kept]], np.concatenate([[0], ends])
        self._matrix = sp.csr_array(parts, shape=(len(rows), count))

    def of(self, lower: Array, skew: Array) -> sp.csr_array:
        """The matrix (k, c); valid until the next call."""
        if skew.size:
            both = np.concatenate([lower + skew, lower - skew])
            self._matrix.data = np.take(both, self._in_both)
        else:
            self._matrix.data = np.take(lower, self._source)
        return self._matrix


def whole(pattern: SymmetricPattern, lower: Array, skew: Array) -> sp.csc_array:
    """The matrix (3n, 3n) of symmetric part `lower` (m,) and skew part `skew`, (m,) or (0,)."""
    matrix = pattern.matrix(lower)
    if skew.size:
        matrix.data += skew_values(pattern, skew)
    return matrix


def adding_skew(
    columns: int, row_starts: Index, blocks: Sequence[Block], top: int = 0
) -> BlockBand:
    """What adds skew parts, as `skew_values` has them, where these blocks have symmetric ones."""
    # The slope by the velocity has none.
    own = [
        replace(
            block,
            source=block.whole,
            terms=[Term(term.shift, term.a, np.zeros(len(term.b))) for term in block.terms],
        )
        for block in blocks
    ]
    return BlockBand(columns, row_starts, own, top, adds=True)
