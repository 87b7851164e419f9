"""Factorise matrices on the mesh graph, again and again with one pattern.

Reverse Cuthill–McKee makes the mesh graph a narrow band; a banded Cholesky factorisation then
also tells whether the matrix is positive definite. Indefinite matrices go to SuperLU, and so do
all where its fill-in is estimated to cost less than the band. What has a skew part besides, see
`unsymmetric`, takes LU in the same band: where the symmetric part is positive definite and the
skew one does not outweigh it, rows need no exchange, and it costs half as much again (measured).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal, Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import SuperLU, splu

from ..arrays import Array, Index
from ..fem.batched import in_slices
from ..fem.pattern import SymmetricPattern
from .lapack import cholesky_in_place, lu_in_place

Choice = Literal["auto", "band", "sparse"]

# LAPACK works on a band about this many times as fast as SuperLU on its columns (measured: 40
# against 4 GFlop/s on one core), and below this work there is nothing to choose.
BAND_SPEED = 10.0
LITTLE_WORK = 1e8

_pbtrs, _gbtrs, _tbtrs = get_lapack_funcs(("pbtrs", "gbtrs", "tbtrs"), dtype=np.float64)
NONE = np.zeros(0)


class Factor(Protocol):
    """A factorised matrix on the free degrees of freedom."""

    @property
    def positive_definite(self) -> bool:
        """Whether the matrix, or its symmetric part, is positive definite."""
        ...

    def solve(self, right: Array, transposed: bool = False) -> Array:
        """Solve for (k,) or (k, m) right-hand sides in the order of the free dofs."""
        ...


@dataclass(frozen=True, eq=False)
class _BandFactor:
    band: Array
    order: Index
    positive_definite: bool = True

    def solve(self, right: Array, transposed: bool = False) -> Array:
        permuted = right[self.order]
        solved, _ = _pbtrs(self.band, permuted, lower=1)
        result = np.empty_like(right)
        result[self.order] = solved.reshape(right.shape)
        return result


@dataclass(frozen=True, eq=False)
class _BandLU:
    """L, with a diagonal of ones that are not read, and U, as bands of their own."""

    lower: Array
    upper: Array
    order: Index
    positive_definite: bool

    def solve(self, right: Array, transposed: bool = False) -> Array:
        if not right.size:
            return right.copy()  # SciPy's tbtrs writes beyond an array without columns
        solved = right[self.order].reshape(len(right), -1)
        for triangle in "UL" if transposed else "LU":
            band, ones = (self.upper, "N") if triangle == "U" else (self.lower, "U")
            solved, _ = _tbtrs(band, solved, uplo=triangle, trans="NT"[transposed], diag=ones)
        result = np.empty_like(right)
        result[self.order] = solved.reshape(right.shape)
        return result


@dataclass(frozen=True, eq=False)
class _ExchangedBandLU:
    """The same where rows were exchanged, in one band that has room for what that fills."""

    band: Array
    exchanges: NDArray[np.int32]
    order: Index
    positive_definite: bool

    def solve(self, right: Array, transposed: bool = False) -> Array:
        width = (len(self.band) - 1) // 3
        permuted = right[self.order]
        solved, _ = _gbtrs(self.band, width, width, permuted, self.exchanges, trans=transposed)
        result = np.empty_like(right)
        result[self.order] = solved.reshape(right.shape)
        return result


@dataclass(frozen=True, eq=False)
class _SparseFactor:
    lu: SuperLU
    positive_definite: bool

    def solve(self, right: Array, transposed: bool = False) -> Array:
        return self.lu.solve(right, "T" if transposed else "N")


@dataclass(frozen=True, eq=False)
class Room:
    """Memory for a banded LU: fetching it anew costs as much as half a factorisation."""

    work: Array
    lower: Array
    upper: Array


class Factoriser:
    """Symbolic analysis of a symmetric pattern restricted to free degrees of freedom.

    Parameters
    ----------
    pattern : SymmetricPattern
    free : (k,) sorted degrees of freedom kept
    choice : {"auto", "band", "sparse"}
        Banded Cholesky, SuperLU, or whichever is estimated to cost less.
    """

    def __init__(self, pattern: SymmetricPattern, free: Index, choice: Choice = "auto") -> None:
        self.choice: Choice = choice
        position = np.full(pattern.size, -1)
        position[free] = np.arange(len(free))
        rows, columns = position[pattern.rows], position[pattern.columns]
        self._kept = np.flatnonzero((rows >= 0) & (columns >= 0))
        rows, columns = rows[self._kept], columns[self._kept]
        self._size = len(free)
        ones = np.ones(len(rows))
        graph = sp.csr_array((ones, (rows, columns)), shape=(self._size, self._size))
        self._order = reverse_cuthill_mckee(graph + graph.T, symmetric_mode=True).astype(np.int64)
        rank = np.empty(self._size, dtype=np.int64)
        rank[self._order] = np.arange(self._size)
        low, high = np.minimum(rank[rows], rank[columns]), np.maximum(rank[rows], rank[columns])
        self.half_bandwidth = int((high - low).max(initial=0))
        self._band_places = low * (self.half_bandwidth + 1) + high - low
        self._ranks = rank[rows], rank[columns]
        strict = rows != columns
        self._full_rows = np.concatenate([rows, columns[strict]])
        self._full_columns = np.concatenate([columns, rows[strict]])
        self._full_source = np.concatenate([self._kept, self._kept[strict]])
        # Whether an entry has the skew part's own sign; none on the diagonal.
        self._signs = np.concatenate([strict.astype(float), -np.ones(strict.sum())])
        self._entries = pattern.entries

    @classmethod
    def of(cls, pattern: SymmetricPattern, free: Index, choice: Choice = "auto") -> Factoriser:
        """The analysis of a pattern; that of the last few is kept."""
        return _analysed(pattern, free.tobytes(), choice)

    @cached_property
    def banded(self) -> bool:
        """Whether banded Cholesky is chosen."""
        if self.choice != "auto":
            return self.choice == "band"
        band_work = self._size * self.half_bandwidth**2
        return band_work <= LITTLE_WORK or band_work <= BAND_SPEED * self._sparse_work

    @property
    def numbers(self) -> int:
        """Numbers that one factor of a symmetric matrix holds."""
        if self.banded:
            return self._size * (self.half_bandwidth + 1)
        return 3 * int(self._column_counts.sum())  # L, U, and their row numbers at half the size

    @property
    def unsymmetric_numbers(self) -> int:
        """Numbers that one factor of another matrix holds."""
        return 2 * self.numbers if self.banded else self.numbers

    @property
    def _sparse_work(self) -> float:
        return float(np.sum(self._column_counts.astype(float) ** 2))

    @cached_property
    def _column_counts(self) -> Index:
        """Entries of each column of SuperLU's L, from a matrix that needs no pivoting."""
        values = np.full(self._entries, -1.0)
        degree = np.bincount(self._full_rows, minlength=self._size)
        values[self._full_source[self._full_rows == self._full_columns]] = degree
        return np.diff(self._superlu(values, pivot_below=0.0).L.indptr)

    def factorise(self, values: Array, skew: Array = NONE, room: Room | None = None) -> Factor:
        """Factorise the matrix with (m,) lower-triangle values, and those of a skew part.

        Of a factor in a room that was given, nothing is left when another is put there.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the matrix is singular or not finite.
        """
        if not (np.isfinite(values).all() and np.isfinite(skew).all()):
            raise np.linalg.LinAlgError("the matrix has entries that are not finite")
        if not self.banded:
            return self._sparse(values, skew)
        if skew.any():
            return self._band_lu(values, skew, room or self.room())
        band = np.zeros((self.half_bandwidth + 1, self._size), order="F")
        band.T.reshape(-1)[self._band_places] = values[self._kept]
        if cholesky_in_place(band):
            return _BandFactor(band, self._order)
        return _SparseFactor(self._superlu(values, pivot_below=0.1), positive_definite=False)

    def room(self) -> Room:
        """Room for a banded LU."""
        width, size = self.half_bandwidth, self._size
        work = np.empty((3 * width + 1, size), order="F")
        lower, upper = (np.empty((width + 1, size), order="F") for _ in range(2))
        return Room(work, lower, upper)

    def _band_lu(self, values: Array, skew: Array, room: Room) -> Factor:
        band = room.work
        width = self.half_bandwidth
        band.fill(0)
        entries = band.T.reshape(-1)
        lower, upper = self._lu_places
        symmetric, other = values[self._kept], skew[self._kept]
        entries[upper] = symmetric - other
        entries[lower] = symmetric + other
        exchanges = lu_in_place(band)
        if exchanges is None:
            raise np.linalg.LinAlgError("the matrix is singular")
        if (exchanges == np.arange(1, self._size + 1)).all():
            definite = bool((band[2 * width] > 0).all())
            room.upper[:], room.lower[:] = band[width : 2 * width + 1], band[2 * width :]
            return _BandLU(room.lower, room.upper, self._order, definite)
        definite = self.factorise(values).positive_definite
        return _ExchangedBandLU(band.copy("F"), exchanges - 1, self._order, definite)

    @cached_property
    def _lu_places(self) -> tuple[Index, Index]:
        """Where an entry of the lower triangle and its mirror image are in the band of LU."""
        (i, j), width = self._ranks, self.half_bandwidth
        return j * (3 * width + 1) + 2 * width + i - j, i * (3 * width + 1) + 2 * width + j - i

    def factorise_each(
        self,
        matrix: Callable[[int], tuple[Array, Array]],
        count: int,
        threads: int,
        rooms: Sequence[Room] = (),
    ) -> list[Factor]:
        """Factorise `count` matrices, side by side on threads; matrix(k) gives both parts' values.

        Raises
        ------
        numpy.linalg.LinAlgError
            If one is singular or not finite.
        """
        factors: dict[int, Factor] = {}

        def run(start: int, stop: int) -> None:
            for k in range(start, stop):
                # Of those that one thread fills in turn, one work space stays in its cache.
                room = replace(rooms[k], work=rooms[start].work) if rooms else None
                factors[k] = self.factorise(*matrix(k), room)

        in_slices(run, count, threads)
        return [factors[k] for k in range(count)]

    def _sparse(self, values: Array, skew: Array) -> Factor:
        lu = self._superlu(values, pivot_below=0.0, skew=skew)
        if (lu.perm_r == lu.perm_c).all() and (lu.U.diagonal() > 0).all():
            return _SparseFactor(lu, positive_definite=True)
        # Without pivoting the factor of an indefinite matrix can be arbitrarily wrong.
        lu = self._superlu(values, pivot_below=0.1, skew=skew)
        return _SparseFactor(lu, positive_definite=False)

    def _superlu(self, values: Array, pivot_below: float, skew: Array = NONE) -> SuperLU:
        entries = values[self._full_source]
        if skew.size:
            entries += self._signs * skew[self._full_source]
        matrix = sp.csc_array(
            (entries, (self._full_rows, self._full_columns)),
            shape=(self._size, self._size),
        )
        try:
            return splu(
                matrix,
                permc_spec="MMD_AT_PLUS_A",
                options={"SymmetricMode": True},
                diag_pivot_thresh=pivot_below,
            )
        except RuntimeError as error:
            raise np.linalg.LinAlgError(str(error)) from error


@lru_cache(maxsize=8)
def _analysed(pattern: SymmetricPattern, free: bytes, choice: Choice) -> Factoriser:
    return Factoriser(pattern, np.frombuffer(free, dtype=np.int64), choice)
