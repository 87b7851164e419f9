"""Where entries go that are added, group by group, to a sparse matrix in compressed columns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index


class Outer(NamedTuple):
    """Entries whose rows and columns are sums of what broadcasts."""

    rows: Sequence[Index | int]
    columns: Sequence[Index | int]

    @property
    def count(self) -> int:
        """How many these are."""
        return int(np.prod(np.broadcast_shapes(*map(np.shape, (*self.rows, *self.columns)))))

    def laid_out(self) -> tuple[Index, Index]:
        """Row and column of each."""
        rows, columns = np.broadcast_arrays(sum(self.rows), sum(self.columns))
        return rows.ravel(), columns.ravel()


@dataclass(frozen=True, eq=False)
class OffBand:
    """Structure in compressed columns, and where the values go.

    Attributes
    ----------
    indptr, indices : column pointers and row indices
    kept : place of each value of the smaller matrix; None where they all come first
    places : of each group, the place of each of its entries
    repeats : of each group, whether several of its entries are at the same place
    """

    indptr: Index
    indices: Index
    kept: Index | None
    places: tuple[Index, ...]
    repeats: tuple[bool, ...]

    @classmethod
    def of(
        cls,
        structure: tuple[Index, Index],
        shape: tuple[int, int],
        groups: Iterable[tuple[Index, Index]],
    ) -> OffBand:
        """Add groups of entries, some of which may be there already or in other groups.

        Parameters
        ----------
        structure : column pointers and row indices, ascending, of the first columns
        shape : rows and columns of the whole
        groups : rows and columns of each group's entries
        """
        (indptr, indices), (height, width) = structure, shape
        wanted = [columns * height + rows for rows, columns in groups]
        codes = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *wanted]))
        before, absent = _found(structure, height, codes)
        own = before + np.cumsum(absent) - absent
        added, columns = own[absent], codes[absent] // height
        is_kept = np.ones(len(indices) + len(added), dtype=bool)
        is_kept[added] = False
        whole = np.empty(len(is_kept), dtype=np.int64)
        whole[is_kept], whole[added] = indices, codes[absent] - columns * height
        counts = np.bincount(columns, minlength=width)
        counts[: len(indptr) - 1] += np.diff(indptr)
        numbers = [np.searchsorted(codes, each) for each in wanted]
        return cls(
            np.concatenate([[0], np.cumsum(counts)]),
            whole,
            None if is_kept[: len(indices)].all() else np.flatnonzero(is_kept),
            tuple(own[each] for each in numbers),
            tuple(bool(np.bincount(each, minlength=1).max() > 1) for each in numbers),
        )

    @property
    def structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices."""
        return self.indptr, self.indices

    def places_of(self, positions: Index) -> Index:
        """Places of values of the smaller matrix, by their positions there."""
        return positions if self.kept is None else self.kept[positions]

    def values(self, out: Array | None, count: int) -> tuple[Array, Array]:
        """Room for all values, `out` where that is given, and for the `count` smaller ones."""
        values = np.empty(len(self.indices)) if out is None else out
        return values, values[:count] if self.kept is None else np.empty(count)

    def fill(self, values: Array, smaller: Array, groups: Sequence[Array]) -> None:
        """Complete the values from those of the smaller matrix and of the groups."""
        if self.kept is None:
            values[len(smaller) :] = 0.0
        else:
            values[:] = 0.0
            values[self.kept] = smaller
        for places, repeats, more in zip(self.places, self.repeats, groups, strict=True):
            if repeats:
                np.add.at(values, places, more)
            else:
                values[places] += more


def _found(
    structure: tuple[Index, Index], height: int, codes: Index
) -> tuple[Index, NDArray[np.bool_]]:
    """How many entries are before column · height + row of others, and whether those are absent."""
    indptr, indices = structure
    if not len(codes) or codes[0] >= (len(indptr) - 1) * height:
        return np.full(len(codes), len(indices)), np.ones(len(codes), dtype=bool)
    own = np.repeat(np.arange(len(indptr) - 1) * height, np.diff(indptr)) + indices
    before = np.searchsorted(own, codes)
    return before, np.append(own, -1)[before] != codes
