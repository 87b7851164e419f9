"""Factorise matrices on the mesh graph, again and again with one pattern.

Reverse Cuthill–McKee makes the mesh graph a narrow band; a factorisation without exchanges of rows,
within its skyline or, if it is wide, LAPACK's Cholesky, then also tells whether the matrix is
positive definite. Indefinite matrices go to SuperLU, and so do all where its fill-in is estimated
to cost less than the band. What has a skew part besides, see `unsymmetric`, needs no exchanges
either where the symmetric part is positive definite and the skew one does not outweigh it; else,
and in wide bands, LAPACK's LU takes it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import SuperLU, splu

from ..arrays import Array, Index
from ..fem.batched import in_slices, make_skyline
from ..fem.pattern import SymmetricPattern
from .lapack import cholesky_in_place, lu_in_place

if TYPE_CHECKING:
    from ..fem.batched.skyline import Skyline

Choice = Literal["auto", "band", "sparse"]

# LAPACK works on a band about this many times as fast as SuperLU on its columns (measured: 40
# against 4 GFlop/s on one core), and below this work there is nothing to choose.
BAND_SPEED = 10.0
LITTLE_WORK = 1e8

# In wider bands LAPACK is faster (measured: 17 GFlop/s at 200, its Cholesky 21 at 300).
NARROW = 250
# Without exchanges a diagonal entry may grow so many times; of definite matrices it never does.
GROWTH = 10.0

_pbtrs, _gbtrs = get_lapack_funcs(("pbtrs", "gbtrs"), dtype=np.float64)
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
class _SkylineFactor:
    """L, D and U, see `fem.batched.skyline`; of a symmetric matrix both sides are one."""

    skyline: Skyline
    sides: Array
    pivots: Array
    order: Index
    positive_definite: bool = True

    def solve(self, right: Array, transposed: bool = False) -> Array:
        first, second = self.sides[-transposed], self.sides[transposed - 1]
        rows = np.atleast_2d(right[self.order].T)
        result = np.empty_like(right)
        solved = self.skyline.solve(first, self.pivots, second, rows)
        result[self.order] = solved.T.reshape(right.shape)
        return result


@dataclass(frozen=True, eq=False)
class _BandLU:
    """Where rows may have been exchanged, in one band that has room for what that fills."""

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
            width = self.skyline.shape[1] if self.skyline else self.half_bandwidth + 1
            return self._size * width
        return 3 * int(self._column_counts.sum())  # L, U, and their row numbers at half the size

    @property
    def unsymmetric_numbers(self) -> int:
        """Numbers that one factor of another matrix holds."""
        if self.banded:
            return (2 if self.skyline else 3) * self.numbers
        return self.numbers

    @cached_property
    def skyline(self) -> Skyline | None:
        """What factorises narrow bands."""
        if not self.banded or self.half_bandwidth > NARROW:
            return None
        return make_skyline(self._size, *self._ranks, self._kept)

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

    def factorise(self, values: Array, skew: Array = NONE, room: Array | None = None) -> Factor:
        """Factorise the matrix with (m,) lower-triangle values, and those of a skew part.

        Of a factor in a room that was given, nothing is left when another is put there.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the matrix is singular or not finite.
        """
        skew = skew if skew.any() else NONE
        if self.skyline:
            factor = self._within(self.skyline, values, skew, room)
            if factor:
                return factor
        if not (np.isfinite(values).all() and np.isfinite(skew).all()):
            raise np.linalg.LinAlgError("the matrix has entries that are not finite")
        if not self.banded:
            return self._sparse(values, skew)
        if skew.size:
            return self._band_lu(values, skew)
        if not self.skyline:
            band = np.zeros((self.half_bandwidth + 1, self._size), order="F")
            band.T.reshape(-1)[self._band_places] = values[self._kept]
            if cholesky_in_place(band):
                return _BandFactor(band, self._order)
        return _SparseFactor(self._superlu(values, pivot_below=0.1), positive_definite=False)

    def room(self, sides: int) -> Array | None:
        """Room for a factor, of two sides where the matrix is not symmetric, if it can be given."""
        return self.skyline.room(sides) if self.skyline else None

    def _within(
        self, skyline: Skyline, values: Array, skew: Array, room: Array | None
    ) -> Factor | None:
        """The factor within the skyline, unless the matrix needs exchanges of rows."""
        count = 2 if skew.size else 1
        sides = skyline.room(count) if room is None else room[:count]
        pivots, growth = skyline.factorise(sides, values, skew)
        # What is not finite in the matrix is not in its pivots.
        if not ((pivots > 0) & (pivots < np.inf) & (growth < GROWTH)).all():
            return None
        return _SkylineFactor(skyline, sides, pivots, self._order)

    def _band_lu(self, values: Array, skew: Array) -> Factor:
        width = self.half_bandwidth
        band = np.zeros((3 * width + 1, self._size), order="F")
        entries = band.T.reshape(-1)
        lower, upper = self._lu_places
        symmetric, other = values[self._kept], skew[self._kept]
        entries[upper] = symmetric - other
        entries[lower] = symmetric + other
        exchanges = lu_in_place(band)
        if exchanges is None:
            raise np.linalg.LinAlgError("the matrix is singular")
        definite = bool((band[2 * width] > 0).all())
        if (exchanges != np.arange(1, self._size + 1)).any():
            definite = self.factorise(values).positive_definite
        return _BandLU(band, exchanges - 1, self._order, definite)

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
        rooms: Sequence[Array | None] = (),
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
                factors[k] = self.factorise(*matrix(k), rooms[k] if rooms else None)

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
