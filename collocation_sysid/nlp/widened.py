"""A sparse matrix put into a larger one that has further entries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Index


@dataclass(frozen=True, eq=False)
class Widened:
    """Structure in compressed columns, and where the values go.

    Attributes
    ----------
    indptr, indices : column pointers and row indices
    kept, added : places of the values of the smaller matrix, and of the further entries
    """

    indptr: Index
    indices: Index
    kept: Index
    added: Index

    @classmethod
    def of(
        cls,
        structure: tuple[Index, Index],
        count: int,
        rows: Index,
        further: Index,
    ) -> Widened:
        """Add entries (rows, further), below those that a column has already.

        Parameters
        ----------
        structure : column pointers and row indices of the smaller matrix, the first columns
        count : columns of the larger one
        rows, further : (k,) rows and columns of the entries added
        """
        indptr, indices = structure
        before = np.zeros(count, dtype=np.int64)
        before[: len(indptr) - 1] = np.diff(indptr)
        more = np.bincount(further, minlength=count)
        starts = np.concatenate([[0], np.cumsum(before + more)])
        kept = np.arange(len(indices)) + np.repeat(
            starts[: len(indptr) - 1] - indptr[:-1], np.diff(indptr)
        )
        order = np.lexsort((rows, further))
        first = starts[:-1] + before - np.concatenate([[0], np.cumsum(more)[:-1]])
        added = np.empty(len(rows), dtype=np.int64)
        added[order] = first[further[order]] + np.arange(len(rows))
        whole = np.empty(len(indices) + len(rows), dtype=np.int64)
        whole[kept], whole[added] = indices, rows
        return cls(starts, whole, kept, added)

    def fill(self, values: Array, smaller: Array, further: Array) -> None:
        """Write the values of both."""
        values[self.kept], values[self.added] = smaller, further
