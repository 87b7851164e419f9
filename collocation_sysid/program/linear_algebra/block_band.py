"""Sparse matrices made of mesh-graph blocks along the time axis, refilled at every iterate.

Column block t holds the columns of x_t; row blocks have fixed offsets from it. A block is a linear
combination of lower triangles on the mesh graph,

    block(t, offset) = Σ_terms a[t] A[t + shift] + b[t] B[t + shift] + constant,

so that positions and coefficients are computed once and `BlockBand.fill` only copies numbers. A and
B are (K, m) arrays of lower-triangle values, see `fem.pattern`.

An unsymmetric matrix on the mesh graph consists of a symmetric and a skew part, each given by its
lower triangle (m,); the skew part is an empty array for a symmetric matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ...fem.kernels import make_combiner, run_in_slices
from ...fem.pattern import SymmetricPattern


@dataclass(frozen=True, eq=False)
class BlockTerm:
    """Term a[t] A[t + shift] + b[t] B[t + shift] of a block."""

    shift: int  # offset of the index into A and B
    # (N,): coefficients, by column time t.
    a: Array
    b: Array


@dataclass(frozen=True, eq=False)
class BandBlock:
    """Blocks at one row offset: their entries, and the terms that fill them."""

    offset: int  # row block minus column block
    # (e,): entries within the block.
    rows: Index
    columns: Index
    # (e,): position of each entry in the lower triangle; −1 where only constants are stored.
    lower_positions: Index
    terms: Sequence[BlockTerm]  # terms whose sum is the block
    full_positions: Index  # (e,): position of each entry in both triangles, see `pattern.full`


class BlockBand:
    """Structure of the matrix in compressed columns, and the plan to fill it.

    Attributes
    ----------
    indptr, indices : arrays
        Compressed-column structure, rows ascending in each column.
    nnz : int
        Number of entries.
    starts : (N + 1,) array
        Position of the first value of each column block, and the number of values.
    top_positions : (N · columns, top_rows) array
        Positions of the top rows' values.

    Parameters
    ----------
    columns : int
        Columns per block.
    row_starts : (N,) array
        First row of each row block, −1 where the block does not exist.
    top_rows : int
        Number of rows above all blocks, in which every column has an entry (0 … `top_rows` − 1).
    adds : bool
        If true, `fill` adds to the values instead of overwriting them.
    """

    def __init__(
        self,
        columns: int,
        row_starts: Index,
        blocks: Sequence[BandBlock],
        top_rows: int = 0,
        adds: bool = False,
    ) -> None:
        count = len(row_starts)
        blocks = sorted(blocks, key=lambda block: block.offset)
        exists = np.array(
            [
                [0 <= t + b.offset < count and row_starts[t + b.offset] >= 0 for b in blocks]
                for t in range(count)
            ]
        )
        self._slabs: dict[tuple[bool, ...], _ColumnBlock] = {}
        for present in map(tuple, np.unique(exists, axis=0)):
            chosen = [b for b, here in zip(blocks, present, strict=True) if here]
            self._slabs[present] = _ColumnBlock.from_blocks(columns, chosen, top=top_rows)
        kinds = [self._slabs[tuple(present)] for present in exists]
        starts = np.concatenate([[0], np.cumsum([slab.entry_count for slab in kinds])])
        self.starts = starts
        self.nnz = int(starts[-1])
        self.indptr = np.concatenate(
            [[0], *(slab.column_ends + starts[t] for t, slab in enumerate(kinds))]
        )
        self.indices = np.concatenate(
            [slab.row_indices(row_starts, t) for t, slab in enumerate(kinds)]
        )
        self.top_positions = np.concatenate(
            [slab.top_positions + starts[t] for t, slab in enumerate(kinds)]
        )
        self._kinds = kinds
        self._fill = make_combiner(_make_plan(kinds, starts[:-1], count=count, adds=adds))

    def positions(self, times: Index, offset: int, rows: Index, columns: Index) -> Index:
        """Return the positions (len(times), len(rows)) in the values of entries of the blocks (t +
        offset, t).

        Parameters
        ----------
        times : (T,) array
            Column times t.
        offset : int
            Row block minus column block.
        rows, columns : (e,) arrays
            Entries within the block, the same at all times.

        Raises
        ------
        IndexError
            If an entry is not in the block.
        ValueError
            If there are no blocks at this offset at one of the times.
        """
        result = np.empty((len(times), len(rows)), dtype=np.int64)
        for slab in self._slabs.values():
            here = np.array([self._kinds[t] is slab for t in times], dtype=bool)
            if here.any():
                places = slab.locate(offset, rows, columns=columns)
                result[here] = self.starts[times[here], None] + places
        return result

    def fill(self, values: Array, a: Array, b: Array, threads: int) -> None:
        """Write all block entries into `values`, in place; entries without terms become zero. With
        `adds`, add to the values instead.

        Parameters
        ----------
        values : (nnz,) array
            Values; the top rows are left unchanged.
        a, b : (K, m) arrays
            Lower-triangle values A and B, rows contiguous, with the same row stride.
        threads : int
            Largest number of threads; one is used for few blocks.
        """
        run_in_slices(
            self._fill,
            len(self._kinds),
            threads=threads if len(self._kinds) > 4 * threads else 1,
            arguments=(a, b, values),
        )


@dataclass(frozen=True, eq=False)
class _ColumnBlock:
    """Structure of one column block: entries sorted by column, then row."""

    columns: int
    top: int  # rows above all blocks
    blocks: Sequence[BandBlock]  # blocks that exist in it
    entry_count: int  # number of entries
    column_ends: Index  # (columns,): end of each column
    top_positions: Index  # (columns, top): positions of the top rows' entries
    # (entries,): sorted position of each entry, blocks stacked after the top rows.
    sorted_positions: Index
    block_indices: Index  # (entries,): index of the block of each stacked entry, −1 for top rows
    rows: Index  # (entries,): row of each stacked entry within its block

    @classmethod
    def from_blocks(cls, columns: int, blocks: Sequence[BandBlock], top: int) -> _ColumnBlock:
        """Return the structure of a column block: `top` dense rows, then the blocks."""
        top_rows = np.tile(np.arange(top), columns)
        top_columns = np.repeat(np.arange(columns), top)
        rows = np.concatenate([top_rows, *(b.rows for b in blocks)])
        cols = np.concatenate([top_columns, *(b.columns for b in blocks)])
        level = np.concatenate(
            [np.full(len(top_rows), -1), *(np.full(len(b.rows), k) for k, b in enumerate(blocks))]
        )
        order = np.lexsort((rows, level, cols))
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        ends = np.cumsum(np.bincount(cols, minlength=columns))
        return cls(
            columns,
            top,
            blocks=blocks,
            entry_count=len(order),
            column_ends=ends,
            top_positions=place[: top * columns].reshape(columns, top),
            sorted_positions=place,
            block_indices=level,
            rows=rows,
        )

    def row_indices(self, row_starts: Index, t: int) -> Index:
        """Return the row in the matrix of every entry (entries,) of column block t."""
        base = np.array([row_starts[t + b.offset] for b in self.blocks] + [0])
        result = np.empty(self.entry_count, dtype=np.int64)
        result[self.sorted_positions] = base[self.block_indices] + self.rows
        return result

    def positions_of_block(self, block: int) -> Index:
        """Return the position in the column block of each entry of block number `block`."""
        first = self.top * self.columns + sum(len(b.rows) for b in self.blocks[:block])
        return self.sorted_positions[first : first + len(self.blocks[block].rows)]

    def locate(self, offset: int, rows: Index, columns: Index) -> Index:
        """Return the positions of entries of the block at a row offset."""
        k = [b.offset for b in self.blocks].index(offset)
        block = self.blocks[k]
        width = int(max(block.rows.max(), np.max(rows, initial=0))) + 1
        codes = block.columns * width + block.rows
        sorter = np.argsort(codes)
        requested = np.asarray(columns) * width + rows
        entries = sorter[
            np.minimum(np.searchsorted(codes, requested, sorter=sorter), len(codes) - 1)
        ]
        if (codes[entries] != requested).any():
            raise IndexError("an entry lies outside the block")
        return self.positions_of_block(k)[entries]


@dataclass(frozen=True, eq=False)
class CombinePlan:
    """Tasks of all column blocks, in their order, for the compiled combiner.

    A task is value[out + target[i]] (+)= a A[row, source[i]] + b B[row, source[i]] for all i of a
    map.
    """

    first_task: Index  # (N + 1,): tasks of column block t are first_task[t] … first_task[t + 1] − 1
    # (tasks, 5): out, start of the map, length of the map, row, and 1 to add or 0 to overwrite.
    tasks: Index
    coefficients: Array  # (tasks, 2): a and b
    # Concatenated maps.
    targets: NDArray[np.int32]
    sources: NDArray[np.int32]


def _make_plan(kinds: Sequence[_ColumnBlock], starts: Index, count: int, adds: bool) -> CombinePlan:
    """Return the tasks that fill the column blocks."""
    targets = []
    sources = []
    maps = {}
    used = 0
    tasks = []
    coefficients = []
    first_task = [0]
    for t, slab in enumerate(kinds):
        for k, block in enumerate(slab.blocks):
            if (id(slab), k) not in maps:
                # Sorted by target, so that the writes run through memory.
                places = slab.positions_of_block(k)
                order = np.argsort(places)
                maps[id(slab), k] = (used, len(places))
                targets.append(places[order])
                sources.append(np.maximum(block.lower_positions[order], 0))
                used += len(places)
            start, length = maps[id(slab), k]
            active = [m for m in block.terms if m.a[t] != 0 or m.b[t] != 0]
            terms = [(m.a[t], m.b[t], t + m.shift) for m in active] or [(0.0, 0.0, 0)]
            for number, (a, b, row) in enumerate(terms):
                tasks.append((starts[t], start, length, row, int(adds or number > 0)))
                coefficients.append((a, b))
        first_task.append(len(tasks))
    return CombinePlan(
        np.array(first_task, dtype=np.int64),
        np.array(tasks, dtype=np.int64).reshape(-1, 5),
        coefficients=np.array(coefficients, dtype=float).reshape(-1, 2),
        targets=np.concatenate(targets).astype(np.int32),
        sources=np.concatenate(sources).astype(np.int32),
    )


def skew_signs(pattern: SymmetricPattern) -> Array:
    """Return the signs (nnz,) by which the entries of `pattern.full` of a skew matrix follow from
    its lower triangle: 1 below the diagonal, −1 above, 0 on it.
    """
    rows, columns, _ = pattern.full
    return np.sign(rows - columns).astype(float)


def full_skew_values(pattern: SymmetricPattern, skew: Array) -> Array:
    """Return the entries (…, nnz) of the complete skew matrix in the order of `pattern.full` from
    its lower triangle (…, m); an empty array is returned as it is.
    """
    if not skew.size:
        return skew
    # Rows contiguous, which fancy indices would not leave so.
    return np.take(skew, pattern.full[2], axis=-1) * skew_signs(pattern)


class Submatrix:
    """Some rows and columns of matrices given by lower triangles.

    Parameters
    ----------
    pattern : SymmetricPattern
        Pattern of the complete matrix.
    rows : (k,) array
        Ascending dofs.
    columns : (c,) array, optional
        Ascending dofs; all by default.
    """

    def __init__(
        self, pattern: SymmetricPattern, rows: Index, columns: Index | None = None
    ) -> None:
        # Entries are sorted by column, so that those of the transpose are sorted by row.
        across, row_of_entry, source = pattern.full
        count = pattern.size if columns is None else len(columns)
        place, number = np.full((2, pattern.size), -1)
        place[rows] = np.arange(len(rows))
        number[slice(None) if columns is None else columns] = np.arange(count)
        is_selected = (place[row_of_entry] >= 0) & (number[across] >= 0)
        self._source = source[is_selected]
        self._in_both = source[is_selected] + np.where(
            (row_of_entry > across)[is_selected], 0, pattern.entry_count
        )
        ends = np.cumsum(np.bincount(place[row_of_entry[is_selected]], minlength=len(rows)))
        parts = (
            np.zeros(is_selected.sum()),
            number[across[is_selected]],
            np.concatenate([[0], ends]),
        )
        self._shape = len(rows), count
        self._matrix = sp.csr_array(parts, shape=self._shape)

    def extract(self, lower: Array, skew: Array) -> sp.csr_array:
        """Return the submatrix (k, c). The returned object is shared: its values are overwritten by
        the next call.

        Parameters
        ----------
        lower : (m,) array
            Lower triangle of the symmetric part of the complete matrix.
        skew : (m,) or (0,) array
            Lower triangle of the skew part; empty for none.
        """
        self._matrix.data = self._values(lower, skew)
        return self._matrix

    def products(self, lower: Array, skew: Array, vectors: Array) -> Array:
        """Return the products (T, k, d) of the submatrices of T matrices with vectors (T, c, d).

        Parameters
        ----------
        lower, skew : (T, m) or (T, 0) array
            See `extract`.
        """
        values = self._values(lower, skew)
        count = len(lower)
        number = np.arange(count)[:, None]
        rows, columns = self._shape
        places = self._matrix.indices + columns * number
        starts = np.append(self._matrix.indptr[:-1] + len(self._source) * number, values.size)
        blocks = sp.csr_array(
            (values.ravel(), places.ravel(), starts), shape=(count * rows, count * columns)
        )
        return (blocks @ vectors.reshape(count * columns, -1)).reshape(count, rows, -1)

    def _values(self, lower: Array, skew: Array) -> Array:
        """Return the entries (…, any) from lower triangles (…, m)."""
        if not skew.size:
            return lower.take(self._source, axis=-1)
        both = np.concatenate([lower + skew, lower - skew], axis=-1)
        return both.take(self._in_both, axis=-1)


def skew_block_band(
    columns: int,
    row_starts: Index,
    blocks: Sequence[BandBlock],
    top_rows: int = 0,
    by_velocity: bool = False,
) -> BlockBand:
    """Return the structure that adds skew parts to the entries of blocks of symmetric parts.

    Fill it with values in the order of `full_skew_values`. Other arguments as in `BlockBand`.

    Parameters
    ----------
    by_velocity : bool
        Whether the derivative by the velocity has a skew part too; if not, its terms are zero.

    Returns
    -------
    BlockBand
        Structure with the same positions as that of the symmetric parts; its `fill` adds.
    """
    own = [
        replace(
            block,
            lower_positions=block.full_positions,
            terms=[
                BlockTerm(t.shift, t.a, b=t.b if by_velocity else 0.0 * t.b) for t in block.terms
            ],
        )
        for block in blocks
    ]
    return BlockBand(columns, row_starts, blocks=own, top_rows=top_rows, adds=True)
