"""Factorise symmetric matrices on the mesh graph, again and again with one pattern.

Reverse Cuthill–McKee makes the mesh graph a narrow band; a banded Cholesky factorisation then
also tells whether the matrix is positive definite. Wide bands and indefinite matrices go to
SuperLU.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import SuperLU, splu

from ..fem.batched import in_slices
from ..fem.pattern import SymmetricPattern
from .lapack import cholesky_in_place

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Above this share of the matrix size SuperLU's fill-in is cheaper than the band's.
WIDE_BAND = 0.4

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
    """

    def __init__(self, pattern: SymmetricPattern, free: Index) -> None:
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

    @property
    def banded(self) -> bool:
        """Whether the band is narrow enough for banded Cholesky."""
        return self.half_bandwidth <= WIDE_BAND * self._size or self._size < 200

    def factorise(self, values: Array) -> Factor:
        """Factorise the matrix with (m,) lower-triangle values.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the matrix is singular or not finite.
        """
        return self.factorise_all(values[None], threads=1)[0]

    def factorise_all(self, values: Array, threads: int) -> list[Factor]:
        """Factorise K matrices with lower-triangle values (K, m), side by side on threads.

        Raises
        ------
        numpy.linalg.LinAlgError
            If one is singular or not finite.
        """
        factors: list[Factor | None] = [None] * len(values)

        def run(start: int, stop: int) -> None:
            for k in range(start, stop):
                factors[k] = self._factorise(values[k])

        in_slices(run, len(values), threads)
        return [factor for factor in factors if factor is not None]

    def _factorise(self, values: Array) -> Factor:
        if not np.isfinite(values).all():
            raise np.linalg.LinAlgError("the matrix has entries that are not finite")
        if not self.banded:
            return self._sparse(values)
        band = np.zeros((self.half_bandwidth + 1, self._size), order="F")
        band.T.reshape(-1)[self._band_places] = values[self._kept]
        if cholesky_in_place(band):
            return _BandFactor(band, self._order)
        return self._sparse(values, known_indefinite=True)

    def _sparse(self, values: Array, known_indefinite: bool = False) -> Factor:
        matrix = sp.csc_array(
            (values[self._full_source], (self._full_rows, self._full_columns)),
            shape=(self._size, self._size),
        )
        try:
            lu = splu(
                matrix,
                permc_spec="MMD_AT_PLUS_A",
                options={"SymmetricMode": True},
                diag_pivot_thresh=0.0 if not known_indefinite else 0.1,
            )
        except RuntimeError as error:
            raise np.linalg.LinAlgError(str(error)) from error
        if known_indefinite:
            return _SparseFactor(lu, positive_definite=False)
        if (lu.perm_r == lu.perm_c).all() and (lu.U.diagonal() > 0).all():
            return _SparseFactor(lu, positive_definite=True)
        # Without pivoting the factor of an indefinite matrix can be arbitrarily wrong.
        return self._sparse(values, known_indefinite=True)
