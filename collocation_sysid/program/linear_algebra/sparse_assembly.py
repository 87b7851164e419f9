"""Assembly of additional entries into a sparse matrix in compressed columns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ...fem.pattern import unique_codes


class EntryBlock(NamedTuple):
    """Entries whose rows and columns are sums of arrays that broadcast."""

    rows: Sequence[Index | int]  # summands of the row indices
    columns: Sequence[Index | int]  # summands of the column indices

    @property
    def entry_count(self) -> int:
        """Number of entries: the size of the broadcast arrays."""
        return int(np.prod(np.broadcast_shapes(*map(np.shape, (*self.rows, *self.columns)))))

    def indices(self) -> tuple[Index, Index]:
        """Return row and column index of each entry, flat, in C order of the broadcast arrays."""
        rows, columns = np.broadcast_arrays(sum(self.rows), sum(self.columns))
        return rows.ravel(), columns.ravel()


@dataclass(frozen=True, eq=False)
class SparseAssembly:
    """Structure of a sparse matrix, and positions of the values of its contributions."""

    indptr: Index  # column pointers
    indices: Index  # row indices
    # Position of each value of the initial structure; None if they all come first, in their order.
    initial_positions: Index | None
    group_positions: tuple[Index, ...]  # positions of the entries of each group
    has_duplicates: tuple[bool, ...]  # whether several entries of a group have the same position

    @classmethod
    def from_groups(
        cls,
        structure: tuple[Index, Index],
        shape: tuple[int, int],
        groups: Iterable[tuple[Index, Index]],
    ) -> SparseAssembly:
        """Add groups of entries to a structure; entries may exist already, belong to several
        groups, or occur repeatedly in one.

        Parameters
        ----------
        structure : (array, array)
            Column pointers and ascending row indices of the first columns; the other columns are
            empty.
        shape : (int, int)
            Rows and columns of the complete matrix.
        groups : iterable of (array, array)
            Rows and columns of each group's entries.
        """
        indptr, indices = structure
        height, width = shape
        group_codes = [columns * height + rows for rows, columns in groups]
        codes = unique_codes(group_codes)
        before, absent = _locate(structure, height, codes=codes)
        own = before + np.cumsum(absent) - absent
        added = own[absent]
        columns = codes[absent] // height
        is_initial = np.ones(len(indices) + len(added), dtype=bool)
        is_initial[added] = False
        all_indices = np.empty(len(is_initial), dtype=np.int64)
        all_indices[is_initial] = indices
        all_indices[added] = codes[absent] - columns * height
        counts = np.bincount(columns, minlength=width)
        counts[: len(indptr) - 1] += np.diff(indptr)
        group_indices = [np.searchsorted(codes, each) for each in group_codes]
        return cls(
            np.concatenate([[0], np.cumsum(counts)]),
            all_indices,
            initial_positions=None
            if is_initial[: len(indices)].all()
            else np.flatnonzero(is_initial),
            group_positions=tuple(own[each] for each in group_indices),
            has_duplicates=tuple(
                bool(np.bincount(each, minlength=1).max() > 1) for each in group_indices
            ),
        )

    @property
    def structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of the complete matrix."""
        return self.indptr, self.indices

    def positions_of(self, positions: Index) -> Index:
        """Return the positions among all values of values of the initial structure, given by their
        positions there.
        """
        return positions if self.initial_positions is None else self.initial_positions[positions]

    def allocate(self, out: Array | None, count: int) -> tuple[Array, Array]:
        """Return arrays for all values, and for the `count` values of the initial structure;
        `assemble` completes them.

        The second array is a view of the first where the initial values come first in their order.
        Neither is initialised.

        Parameters
        ----------
        out : array or None
            Used for all values if given, and returned.
        count : int
            Number of values of the initial structure.
        """
        values = np.empty(len(self.indices)) if out is None else out
        return values, values[:count] if self.initial_positions is None else np.empty(count)

    def assemble(self, values: Array, initial: Array, groups: Sequence[Array]) -> None:
        """Compute all values in place.

        Parameters
        ----------
        values : array
            All values, overwritten. If `initial_positions` is None, the first of them must contain
            the initial values already and are kept, see `allocate`; the others are set to zero.
        initial : array
            Values of the initial structure; only their number is used if `initial_positions` is
            None.
        groups : sequence of arrays
            Values of each group; duplicates are added up.
        """
        if self.initial_positions is None:
            values[len(initial) :] = 0.0
        else:
            values[:] = 0.0
            values[self.initial_positions] = initial
        for places, repeats, more in zip(
            self.group_positions, self.has_duplicates, groups, strict=True
        ):
            if repeats:
                np.add.at(values, places, more)
            else:
                values[places] += more


def _locate(
    structure: tuple[Index, Index], height: int, codes: Index
) -> tuple[Index, NDArray[np.bool_]]:
    indptr, indices = structure
    if not len(codes) or codes[0] >= (len(indptr) - 1) * height:
        return np.full(len(codes), len(indices)), np.ones(len(codes), dtype=bool)
    own = np.repeat(np.arange(len(indptr) - 1) * height, np.diff(indptr))
    own += indices
    before = np.searchsorted(own, codes)
    absent = np.ones(len(codes), dtype=bool)
    is_among = before < len(own)
    absent[is_among] = own[before[is_among]] != codes[is_among]
    return before, absent
