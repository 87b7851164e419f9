"""Factorise symmetric matrices on the mesh graph, again and again with one pattern.

Reverse Cuthill–McKee makes the mesh graph a narrow band; a banded Cholesky factorisation then
also tells whether the matrix is positive definite. Indefinite matrices go to SuperLU, and so do
all where its fill-in is estimated to cost less than the band.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal, Protocol

import numpy as np
import scipy.sparse as sp
from scipy.linalg import get_lapack_funcs
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import SuperLU, splu

from ..arrays import Array, Index
from ..fem.batched import in_slices
from ..fem.pattern import SymmetricPattern
from .lapack import cholesky_in_place

Choice = Literal["auto", "band", "sparse"]

# LAPACK works on a band about this many times as fast as SuperLU on its columns (measured: 40
# against 4 GFlop/s on one core), and below this work there is nothing to choose.
BAND_SPEED = 10.0
LITTLE_WORK = 1e8

(_pbtrs,) = get_lapack_funcs(("pbtrs",), dtype=np.float64)


class Factor(Protocol):
    """A factorised matrix on the free degrees of freedom."""

    @property
    def positive_definite(self) -> bool:
        """Whether the matrix is positive definite."""
        ...

    def solve(self, right: Array) -> Array:
        """Solve for (k,) or (k, m) right-hand sides in the order of the free dofs."""
        ...


@dataclass(frozen=True, eq=False)
class _BandFactor:
    band: Array
    order: Index
    positive_definite: bool = True

    def solve(self, right: Array) -> Array:
        permuted = right[self.order]
        solved, _ = _pbtrs(self.band, permuted, lower=1)
        result = np.empty_like(right)
        result[self.order] = solved.reshape(right.shape)
        return result


@dataclass(frozen=True, eq=False)
class _SparseFactor:
    lu: SuperLU
    positive_definite: bool

    def solve(self, right: Array) -> Array:
        return self.lu.solve(right)


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
        strict = rows != columns
        self._full_rows = np.concatenate([rows, columns[strict]])
        self._full_columns = np.concatenate([columns, rows[strict]])
        self._full_source = np.concatenate([self._kept, self._kept[strict]])
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
        """Numbers that one factor holds."""
        if self.banded:
            return self._size * (self.half_bandwidth + 1)
        return 3 * int(self._column_counts.sum())  # L, U, and their row numbers at half the size

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

    def factorise(self, values: Array) -> Factor:
        """Factorise the matrix with (m,) lower-triangle values.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the matrix is singular or not finite.
        """
        if not np.isfinite(values).all():
            raise np.linalg.LinAlgError("the matrix has entries that are not finite")
        if not self.banded:
            return self._sparse(values)
        band = np.zeros((self.half_bandwidth + 1, self._size), order="F")
        band.T.reshape(-1)[self._band_places] = values[self._kept]
        if cholesky_in_place(band):
            return _BandFactor(band, self._order)
        return _SparseFactor(self._superlu(values, pivot_below=0.1), positive_definite=False)

    def factorise_each(
        self, matrix: Callable[[int], Array], count: int, threads: int
    ) -> list[Factor]:
        """Factorise `count` matrices, side by side on threads; matrix(k) gives values (m,).

        Raises
        ------
        numpy.linalg.LinAlgError
            If one is singular or not finite.
        """
        factors: dict[int, Factor] = {}

        def run(start: int, stop: int) -> None:
            for k in range(start, stop):
                factors[k] = self.factorise(matrix(k))

        in_slices(run, count, threads)
        return [factors[k] for k in range(count)]

    def _sparse(self, values: Array) -> Factor:
        lu = self._superlu(values, pivot_below=0.0)
        if (lu.perm_r == lu.perm_c).all() and (lu.U.diagonal() > 0).all():
            return _SparseFactor(lu, positive_definite=True)
        # Without pivoting the factor of an indefinite matrix can be arbitrarily wrong.
        return _SparseFactor(self._superlu(values, pivot_below=0.1), positive_definite=False)

    def _superlu(self, values: Array, pivot_below: float) -> SuperLU:
        matrix = sp.csc_array(
            (values[self._full_source], (self._full_rows, self._full_columns)),
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
