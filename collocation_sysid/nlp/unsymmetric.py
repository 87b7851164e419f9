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


def signs_by_row(pattern: SymmetricPattern) -> Array:
    """The same where the entries are read as the transpose's, which are sorted by row."""
    return -signs_by_column(pattern)


def skew_values(pattern: SymmetricPattern, skew: Array) -> Array:
    """Entries (…, nnz) of the whole skew matrix in the order of `pattern.full`; none of none."""
    if not skew.size:
        return skew
    # Rows contiguous, which fancy indices would not leave so.
    return np.take(skew, pattern.full[2], axis=-1) * signs_by_column(pattern)


def both_triangles(lower: Array, skew: Array) -> Array:
    """(2m,) entries of the lower triangle of symmetric and skew parts, then of the upper one."""
    return np.concatenate([lower + skew, lower - skew])


def in_both_triangles(pattern: SymmetricPattern, source: Index, signs: Array) -> Index:
    """Where in `both_triangles` entries are that are at `source` in a lower triangle."""
    return source + np.where(signs < 0, pattern.entries, 0)


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
