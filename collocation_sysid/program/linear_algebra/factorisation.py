"""Factorisation of matrices on the mesh graph, repeated with one sparsity pattern.

Reverse Cuthill–McKee ordering makes the mesh graph a narrow band. A factorisation without row
exchanges, within the skyline or, for wide bands, Cholesky's, then also decides whether the matrix
is positive definite. Wide bands use LAPACK, or a supernodal method where it is installed.
Indefinite matrices use SuperLU, and so do all where its fill-in is estimated to cost less than the
band. A matrix with a skew part (see `block_band`) needs no row exchanges either where the symmetric
part is positive definite and the skew part is small compared with it: within a skyline it is
factorised directly, otherwise by its symmetric part and iterative refinement. SuperLU takes the
rest.

Wide bands and supernodal factors take half the time and memory in single precision. Iterative
refinement with the matrix in double precision then gives solutions of the same accuracy, if the
matrix is well conditioned, as the masses make it in time steps of motions.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache, partial
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import SuperLU, splu

from ...common.array_types import Array, Index
from ...fem.kernels import make_skyline, run_in_slices
from ...fem.pattern import SymmetricPattern
from .lapack import Band, cholesky_in_place, solve_band_in_blocks
from .supernodal import Pardiso, SupernodalFactor, load_mkl

if TYPE_CHECKING:
    from ...fem.kernels.skyline import FactorMemory, SkylineFactorisation

Choice = Literal["auto", "band", "sparse", "supernodal"]

# Speed of LAPACK on a band over that of SuperLU on its columns (measured on one core with 3,500 to
# 10,500 rows: 18 to 35).
BAND_SPEED = 20.0
# Work of a band below which it is always used.
LITTLE_WORK = 1e8
# Work of a band from which on supernodal sweeps are faster: some 1,000 nodes of a stout body.
MUCH_WORK = 3e8

# Half bandwidth up to which the skyline is faster than LAPACK (measured: 17 GFlop/s at 200,
# LAPACK's Cholesky 21 at 300).
NARROW = 250
# Number of right-hand sides from which a band is solved in blocks.
MANY_COLUMNS = 4
# Largest growth of a diagonal entry without row exchanges; definite matrices have none.
GROWTH = 10.0
# Relative size of the last correction of a refined solution, far below the accuracy of a Newton or
# Gauss–Newton step.
ACCURACY = 1e-10
# Factor by which each correction must be smaller; otherwise another factorisation is cheaper.
CONTRACTION = 0.2
# Number of analyses that are cached: a problem may have a dozen recordings with obstacles, each of
# which has a pattern of its own, and an analysis costs as much as several factorisations.
LARGEST_CACHED_ANALYSIS_COUNT = 16
# Smallest size of a correction, against division by zero.
TINY = 1e-300

# Skew part of a symmetric matrix.
NONE = np.zeros(0)

# State of a thread that computes factors for another one: SciPy frees a factor of SuperLU only on the
# thread that made it, otherwise its memory is lost.
_helping = threading.local()


class _NotOnThisThreadError(Exception):
    """A factor of SuperLU is needed on a thread that computes factors for another one."""


class Factor(Protocol):
    """Factorised matrix on the k free degrees of freedom."""

    @property
    def positive_definite(self) -> bool:
        """Whether the matrix, or the symmetric part of an unsymmetric one, is positive definite; of
        an unsymmetric matrix whose symmetric part is not, whether all pivots are positive.
        """
        ...

    def solve(self, right: Array, transposed: bool = False) -> Array:
        """Return the solution for right-hand sides (k,) or (k, m) in the order of the free dofs, in
        the same shape; `right` is not modified.

        If `transposed`, solve with the transposed matrix.
        """
        ...


@dataclass(frozen=True, eq=False)
class _BandFactor:
    """Cholesky factor of a symmetric band."""

    band: Band  # (half-bandwidth + 1, k): lower band of the factor, in double or single precision
    order: Index  # (k,): free dof of each row of the band
    positive_definite: bool = field(default=True, init=False)

    def solve(self, right: Array, transposed: bool = False) -> Array:
        """`transposed` has no effect on a symmetric matrix."""
        permuted = right[self.order].astype(self.band.dtype)
        if right.ndim > 1 and right.shape[1] >= MANY_COLUMNS:
            solved = solve_band_in_blocks(self.band, permuted)
        else:
            (pbtrs,) = get_lapack_funcs(("pbtrs",), dtype=self.band.dtype)
            solved, _ = pbtrs(self.band, permuted, lower=1)
        result = np.empty(right.shape, self.band.dtype)
        result[self.order] = solved.reshape(right.shape)
        return result


@dataclass(frozen=True, eq=False)
class _SkylineFactor:
    """Factors L, D and U within a skyline, see `fem.kernels.skyline`."""

    skyline: SkylineFactorisation  # structure and kernels
    sides: Array  # L and U; one of them for a symmetric matrix
    pivots: Array  # D
    # (k,): permutation to the skyline and its inverse.
    order: Index
    rank: Index
    positive_definite: bool = field(default=True, init=False)

    def solve(self, right: Array, transposed: bool = False) -> Array:
        first = self.sides[-transposed]
        second = self.sides[transposed - 1]
        rows = np.atleast_2d(right.take(self.order, axis=0).T)
        solved = self.skyline.solve(first, self.pivots, second=second, right=rows)
        return solved.T.take(self.rank, axis=0).reshape(right.shape)


@dataclass(frozen=True, eq=False)
class _RefinedFactor:
    """Iterative refinement with a factor of the symmetric part, or of rounded numbers."""

    approximate: Factor  # factor of a matrix near `matrix`; symmetric
    matrix: sp.csr_array  # (k, k) sparse: the matrix
    # Returns a better factor, which is used if the refinement does not converge.
    factorise_complete: Callable[[], Factor]
    accuracy: float  # relative size of the last correction
    # dict of int to float: rate at which the corrections of the last matrix became smaller, with
    # the key 0; updated in place. Above `ACCURACY` it replaces a first correction, whose only
    # purpose would be to measure that rate. It is shared by the symmetric matrices of one analysis,
    # whose rates are those of rounding. The rate of a matrix with a skew part is that of this
    # matrix alone: under friction it is tiny in one time step, and large in the next one.
    last_rates: dict[int, float]
    positive_definite: bool = field(default=True, init=False)
    # Not empty after the refinement has failed once.
    divergence_flags: list[bool] = field(default_factory=list)

    def solve(self, right: Array, transposed: bool = False) -> Array:
        """If the corrections do not shrink, the better factor is computed, also for later calls."""
        if self.divergence_flags:
            return self.factorise_complete().solve(right, transposed)
        matrix = self.matrix.T if transposed else self.matrix
        solution = np.ascontiguousarray(self.approximate.solve(right), dtype=float)
        size = last = np.abs(solution).max(axis=0, initial=0.0)
        shrinks = 1.0
        if self.accuracy > ACCURACY:
            shrinks = self.last_rates.get(0, 1.0)
        # The next correction would be about `shrinks` times the last.
        while (shrinks * last > self.accuracy * size).any():
            # In single precision the sizes of small corrections would become zero.
            correction = np.asarray(self.approximate.solve(right - matrix @ solution), dtype=float)
            length = np.abs(correction).max(axis=0, initial=0.0)
            shrinks = float((length / np.maximum(last, TINY)).max(initial=0.0))
            self.last_rates[0] = shrinks
            if not shrinks <= CONTRACTION:
                self.divergence_flags.append(True)
                return self.factorise_complete().solve(right, transposed)
            solution += correction
            last = length
        return solution


class _OrderedColumns(NamedTuple):
    """Both triangles in compressed columns, in the order in which SuperLU fills in little."""

    order: Index  # (k,): free dof of each row and column
    rank: Index  # (k,): row and column of each free dof
    # (k + 1,) of int32: index of the first entry of each column, and the number of entries.
    column_starts: NDArray[np.int32]
    rows: NDArray[np.int32]  # (e,) of int32: row of each entry, ascending in each column
    entries: Index  # (e,): position of each entry among those of both triangles
    counts: Index  # (k,): number of entries of each column of L without row exchanges


@dataclass(frozen=True, eq=False)
class _SparseFactor:
    """Complete LU factorisation of a sparse matrix by SuperLU."""

    lu: SuperLU  # the factorisation of the matrix in another order
    # (k,): free dof of each row of that matrix, and row of each free dof.
    order: Index
    rank: Index
    positive_definite: bool  # see `Factor.positive_definite`

    def solve(self, right: Array, transposed: bool = False) -> Array:
        ordered = right.take(self.order, axis=0)
        solved = self.lu.solve(ordered, "T" if transposed else "N")
        return solved.take(self.rank, axis=0)


class Factoriser:
    """Symbolic analysis of a symmetric pattern restricted to k free degrees of freedom.

    Attributes
    ----------
    half_bandwidth : int
        Number of subdiagonals of the reordered band.
    size : int
        Number of free degrees of freedom.

    Parameters
    ----------
    pattern : SymmetricPattern
        Pattern of the complete matrix.
    free : (k,) array
        Sorted free degrees of freedom.
    choice : {"auto", "band", "sparse", "supernodal"}
        Banded Cholesky ("band"), SuperLU ("sparse"), supernodal Cholesky, or the one with the least
        estimated cost.

    Raises
    ------
    InputError
        If a supernodal method is asked for and not installed.
    """

    def __init__(self, pattern: SymmetricPattern, free: Index, choice: Choice = "auto") -> None:
        self.choice: Choice = choice
        position = np.full(pattern.size, -1)
        position[free] = np.arange(len(free))
        rows = position[pattern.rows]
        columns = position[pattern.columns]
        self._free_entries = np.flatnonzero((rows >= 0) & (columns >= 0))
        rows = rows[self._free_entries]
        columns = columns[self._free_entries]
        self.size = len(free)
        ones = np.ones(len(rows))
        graph = sp.csr_array((ones, (rows, columns)), shape=(self.size, self.size))
        self._order = reverse_cuthill_mckee(graph + graph.T, symmetric_mode=True).astype(np.int64)
        self._rank = rank = np.empty(self.size, dtype=np.int64)
        rank[self._order] = np.arange(self.size)
        low = np.minimum(rank[rows], rank[columns])
        high = np.maximum(rank[rows], rank[columns])
        self.half_bandwidth = int((high - low).max(initial=0))
        self._band_places = low * (self.half_bandwidth + 1) + high - low
        self._ranks = rank[rows], rank[columns]
        strict = rows != columns
        self._full_rows = np.concatenate([rows, columns[strict]])
        self._full_columns = np.concatenate([columns, rows[strict]])
        self._full_source = np.concatenate([self._free_entries, self._free_entries[strict]])
        # Whether an entry has the skew part's own sign; none on the diagonal.
        self._signs = np.concatenate([strict.astype(float), -np.ones(strict.sum())])
        self._entries = pattern.entry_count
        # Memory of factors of double and of single precision that is not in use.
        self._pools: dict[bool, list[Pardiso]] = {False: [], True: []}
        # Of symmetric matrices in single precision, see `_RefinedFactor`.
        self._last_rates: dict[int, float] = {}
        if choice == "supernodal":
            self._pools[False].append(self._pardiso(is_single=False))

    @classmethod
    def cached(
        cls, pattern: SymmetricPattern, free: Index, choice: Choice = "auto", bodies: int = 1
    ) -> Factoriser:
        """Return the analysis of a pattern; the last `LARGEST_CACHED_ANALYSIS_COUNT` are cached.
        Arguments as in `Factoriser`; the matrix of several bodies is block-diagonal, with entries and
        dofs one body after another.
        """
        return _cached_analysis(pattern, free.tobytes(), choice=choice, bodies=bodies)

    @cached_property
    def is_banded(self) -> bool:
        """Whether banded Cholesky is chosen; "auto" does so if it is estimated to be faster than a
        sparse factorisation.
        """
        if self.choice != "auto":
            return self.choice == "band"
        if self.is_supernodal:
            return False
        return self._estimate_band_work() <= max(
            LITTLE_WORK, BAND_SPEED * self._estimate_sparse_work()
        )

    @cached_property
    def is_supernodal(self) -> bool:
        """Whether supernodal Cholesky is chosen; "auto" does so for a wide band with much work if
        MKL is installed.
        """
        if self.choice != "auto":
            return self.choice == "supernodal"
        wide = self.half_bandwidth > NARROW and self._estimate_band_work() > MUCH_WORK
        return wide and load_mkl() is not None

    def _estimate_band_work(self) -> int:
        return self.size * self.half_bandwidth**2

    def estimate_factor_size(self) -> int:
        """Return the number of floating-point numbers in the factor of a symmetric matrix; the
        matrix is analysed if necessary.
        """
        if self.is_banded:
            width = self.skyline.shape[1] if self.skyline else self.half_bandwidth + 1
            return self.size * width
        if self.is_supernodal:
            return self._supernodal_size
        return 3 * int(
            self._ordered_columns.counts.sum()
        )  # L, U, and their row numbers at half the size

    @property
    def memory_ratio(self) -> float:
        """Memory of a factor over that of its numbers: SciPy copies L and U of SuperLU, whose pivots tell
        whether the matrix is definite, and SuperLU allocates more than it uses (measured).
        """
        return 1.0 if self.is_banded or self.is_supernodal else 8 / 3

    def estimate_unsymmetric_factor_size(self) -> int:
        """Return the number of floating-point numbers in the factor of an unsymmetric matrix: twice
        that of a symmetric one within a skyline, otherwise the same.
        """
        return (2 if self.skyline else 1) * self.estimate_factor_size()

    @property
    def has_single_precision(self) -> bool:
        """Whether factors of well-conditioned matrices have single precision: those of wide bands
        and supernodal ones.
        """
        return self.is_supernodal or (self.is_banded and not self.skyline)

    @cached_property
    def skyline(self) -> SkylineFactorisation | None:
        """Skyline factorisation for bands up to `NARROW` wide; None for wider ones, other methods,
        and without native code.
        """
        if not self.is_banded or self.half_bandwidth > NARROW:
            return None
        return make_skyline(self.size, *self._ranks, self._free_entries)

    def _estimate_sparse_work(self) -> float:
        return float(np.sum(self._ordered_columns.counts.astype(float) ** 2))

    def factorise(
        self,
        values: Array,
        skew: Array = NONE,
        buffer: FactorMemory | None = None,
        is_single: bool = False,
        accuracy: float = ACCURACY,
    ) -> Factor:
        """Factorise a matrix on the free dofs.

        Parameters
        ----------
        values : (m,) array
            Lower triangle of the symmetric part of the complete matrix; not modified.
        skew : (m,) or (0,) array
            Lower triangle of the skew part; empty if the matrix is symmetric.
        buffer : FactorMemory, optional
            Memory for a factor within the skyline; the factor is valid until it is used again.
            Other methods ignore it.
        is_single : bool
            Whether the matrix is well conditioned, so that factors of wide bands and supernodal
            ones may have single precision. Solutions are refined; where that fails, a factor of
            double precision is computed.
        accuracy : float
            Relative accuracy of solutions that are refined; others have that of the arithmetic.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the matrix is singular or not finite.
        MemoryError
            If there is no memory for a supernodal factor.
        """
        skew = skew if skew.any() else NONE
        skyline_factor = self._factorise_in_skyline(values, skew, buffer=buffer)
        if skyline_factor:
            return skyline_factor
        if not (np.isfinite(values).all() and np.isfinite(skew).all()):
            raise np.linalg.LinAlgError("the matrix has entries that are not finite")
        if is_single and self.has_single_precision:
            rounded = self._factorise_definite(values, is_single=True)
            if rounded is not None:
                return _RefinedFactor(
                    rounded,
                    self.complete_matrix(values, skew),
                    factorise_complete=cache(partial(self.factorise, values, skew)),
                    accuracy=accuracy,
                    last_rates={} if skew.size else self._last_rates,
                )
        definite = (
            self._factorise_in_skyline(values, NONE, buffer=buffer) if skew.size else None
        ) or self._factorise_definite(values)
        if not skew.size:
            # Without pivoting the factor of an indefinite matrix can be arbitrarily wrong.
            return definite or self._sparse_factor(
                self._superlu(values, pivot_below=0.1), is_definite=False
            )
        if not definite:
            # Under friction the symmetric part is never definite: the pivots of the complete matrix
            # decide.
            lu = self._superlu(values, pivot_below=0.1, skew=skew)
            return self._sparse_factor(lu, is_definite=_has_positive_pivots(lu))

        @cache
        def complete_factor() -> Factor:
            return self._sparse_factor(
                self._superlu(values, pivot_below=1.0, skew=skew), is_definite=True
            )

        return _RefinedFactor(
            definite,
            self.complete_matrix(values, skew),
            factorise_complete=complete_factor,
            accuracy=accuracy,
            last_rates={},
        )

    def factorise_definite(self, values: Array) -> Factor | None:
        """Return the factor of a symmetric matrix, lower triangle (m,) of the complete matrix, or
        None if it is not positive definite or not finite.

        Raises
        ------
        MemoryError
            If there is no memory for a supernodal factor.
        """
        if not np.isfinite(values).all():
            return None
        return self._factorise_in_skyline(values, NONE, buffer=None) or self._factorise_definite(
            values
        )

    def factorise_rounded(self, values: Array) -> Factor | None:
        """Return the factor in single precision of a symmetric matrix, lower triangle (m,) of the
        complete matrix, or None if it is not positive definite or not finite. Solutions have the
        precision of the factor. Only with `has_single_precision`.

        Raises
        ------
        MemoryError
            If there is no memory for a supernodal factor.
        """
        if not np.isfinite(values).all():
            return None
        return self._factorise_definite(values, is_single=True)

    def _factorise_definite(self, values: Array, is_single: bool = False) -> Factor | None:
        """None if not positive definite, or if `_factorise_in_skyline` has tried already."""
        # With `is_single`, values, factor and solutions are rounded, except by SuperLU.
        if self.is_supernodal:
            pool = self._pools[is_single]
            try:
                pardiso = pool.pop()
            except IndexError:  # not asked for beforehand: other threads take from it too
                pardiso = self._pardiso(is_single)
            factor = SupernodalFactor(pardiso, pool)
            upper_values = values[self._upper[2]]
            return factor if pardiso.factorise(upper_values) else None
        if not self.is_banded:
            lu = self._superlu(values, pivot_below=0.0)
            return self._sparse_factor(lu, is_definite=True) if _has_positive_pivots(lu) else None
        if self.skyline:
            return None
        band = np.zeros(
            (self.half_bandwidth + 1, self.size),
            dtype=np.float32 if is_single else np.float64,
            order="F",
        )
        band.T.reshape(-1)[self._band_places] = values[self._free_entries]
        return _BandFactor(band, self._order) if cholesky_in_place(band) else None

    def _pardiso(self, is_single: bool) -> Pardiso:
        row_starts, columns, _ = self._upper
        return Pardiso(row_starts, columns, is_single=is_single)

    @cached_property
    def _supernodal_size(self) -> int:
        """Numbers in a supernodal factor; its solver joins the pool that sweeps use."""
        pool = self._pools[True]
        if not pool:
            pool.append(self._pardiso(is_single=True))
        return pool[-1].factor_size

    @cached_property
    def _rows(self) -> tuple[NDArray[np.int32], NDArray[np.int32], Index, Array]:
        """Both triangles row by row, as `_upper`, and the sign of each entry of a skew matrix."""
        order = np.lexsort((self._full_columns, self._full_rows))
        starts = np.searchsorted(self._full_rows[order], np.arange(self.size + 1))
        # SciPy would convert longer integers with every matrix.
        columns = self._full_columns[order].astype(np.int32)
        return starts.astype(np.int32), columns, self._full_source[order], self._signs[order]

    def complete_matrix(self, values: Array, skew: Array) -> sp.csr_array:
        """Return the matrix (k, k) of lower triangles `values` (m,) of the symmetric and `skew`
        (m,) or (0,) of the skew part.
        """
        starts, columns, lower_positions, skew_signs = self._rows
        entries = values[lower_positions]
        if skew.size:
            entries += skew_signs * skew[lower_positions]
        return sp.csr_array((entries, columns, starts), shape=(self.size, self.size))

    @cached_property
    def _upper(self) -> tuple[Index, Index, Index]:
        """Row starts and lengths, columns, and places of the values among the lower triangle."""
        here = self._full_rows <= self._full_columns
        rows = self._full_rows[here]
        columns = self._full_columns[here]
        order = np.lexsort((columns, rows))
        starts = np.searchsorted(rows[order], np.arange(self.size + 1))
        return starts, columns[order], self._full_source[here][order]

    def allocate(self, sides: int) -> FactorMemory | None:
        """Return memory for a factor within the skyline, or None if other methods are used.

        Parameters
        ----------
        sides : int
            2 for unsymmetric matrices, else 1.
        """
        return self.skyline.allocate(sides) if self.skyline else None

    def _factorise_in_skyline(
        self, values: Array, skew: Array, buffer: FactorMemory | None
    ) -> Factor | None:
        """None without a skyline, or if the matrix needs row exchanges; written to `buffer`."""
        skyline = self.skyline
        if skyline is None:
            return None
        count = 2 if skew.size else 1
        buffer = buffer or skyline.allocate(count)
        pivots, growth = skyline.factorise(buffer, values, skew=skew)
        # An entry of the matrix that is not finite makes a pivot infinite or NaN.
        if not (pivots.min() > 0 and pivots.max() < np.inf and growth.max() < GROWTH):
            return None
        return _SkylineFactor(
            skyline, buffer.sides[:count], pivots=pivots, order=self._order, rank=self._rank
        )

    def factorise_each(
        self,
        matrix: Callable[[int], tuple[Array, Array]],
        count: int,
        threads: int,
        buffers: Sequence[FactorMemory | None] = (),
        is_single: bool = False,
    ) -> list[Factor]:
        """Return the factors of several matrices, in their order, computed in parallel.

        Parameters
        ----------
        matrix : callable
            Returns lower triangles of both parts of matrix k, see `factorise`.
        buffers : sequence of FactorMemory or None
            Memory for each factor; empty to allocate. It may be longer than `count`.
        is_single : bool
            Whether the matrices are well conditioned, see `factorise`.

        Raises
        ------
        numpy.linalg.LinAlgError
            If a matrix is singular or not finite.
        """
        factors: dict[int, Factor] = {}
        caller = threading.get_ident()

        def run(start: int, stop: int) -> None:
            _helping.is_helping = threading.get_ident() != caller
            for k in range(start, stop):
                if k in factors:
                    continue
                with suppress(_NotOnThisThreadError):
                    values, skew = matrix(k)
                    buffer = buffers[k] if buffers else None
                    factors[k] = self.factorise(values, skew, buffer=buffer, is_single=is_single)

        run_in_slices(run, count, threads=threads if self.is_banded or self.is_supernodal else 1)
        run(0, count)  # those that other threads left
        return [factors[k] for k in range(count)]

    @cached_property
    def _ordered_columns(self) -> _OrderedColumns:
        """The ordering is computed once: it takes a quarter of the time of a factorisation."""
        # Entries of a matrix that needs no row exchanges.
        values = np.full(self._entries, -1.0)
        degree = np.bincount(self._full_rows, minlength=self.size)
        values[self._full_source[self._full_rows == self._full_columns]] = degree
        lu = splu(
            sp.csc_array(
                (values[self._full_source], (self._full_rows, self._full_columns)),
                shape=(self.size, self.size),
            ),
            permc_spec="MMD_AT_PLUS_A",
            options={"SymmetricMode": True},
            diag_pivot_thresh=0.0,
        )
        rank = lu.perm_c.astype(np.int64)
        rows = rank[self._full_rows]
        columns = rank[self._full_columns]
        entries = np.lexsort((rows, columns))
        starts = np.searchsorted(columns[entries], np.arange(self.size + 1))
        return _OrderedColumns(
            np.argsort(rank),
            rank,
            column_starts=starts.astype(np.int32),
            rows=rows[entries].astype(np.int32),
            entries=entries,
            counts=np.diff(lu.L.indptr),
        )

    def _sparse_factor(self, lu: SuperLU, is_definite: bool) -> _SparseFactor:
        columns = self._ordered_columns
        return _SparseFactor(lu, columns.order, columns.rank, positive_definite=is_definite)

    def _superlu(self, values: Array, pivot_below: float, skew: Array = NONE) -> SuperLU:
        if getattr(_helping, "is_helping", False):
            raise _NotOnThisThreadError
        entries = values[self._full_source]
        if skew.size:
            entries += self._signs * skew[self._full_source]
        columns = self._ordered_columns
        matrix = sp.csc_array(
            (entries[columns.entries], columns.rows, columns.column_starts),
            shape=(self.size, self.size),
        )
        try:
            return splu(
                matrix,
                permc_spec="NATURAL",
                options={"SymmetricMode": True},
                diag_pivot_thresh=pivot_below,
            )
        except RuntimeError as error:
            raise np.linalg.LinAlgError(str(error)) from error


def _has_positive_pivots(lu: SuperLU) -> bool:
    """Return whether SuperLU took the pivots in their order, and all are positive."""
    return bool((lu.perm_r == lu.perm_c).all() and (lu.U.diagonal() > 0).all())


@lru_cache(maxsize=LARGEST_CACHED_ANALYSIS_COUNT)
def _cached_analysis(
    pattern: SymmetricPattern, free: bytes, choice: Choice, bodies: int
) -> Factoriser:
    """The last analyses are cached; `free` are the bytes of an array of int64."""
    size = pattern.size
    dofs = pattern.rows, pattern.columns, np.frombuffer(free, dtype=np.int64)
    rows, columns, all_free = (np.add.outer(size * np.arange(bodies), d).ravel() for d in dofs)
    return Factoriser(SymmetricPattern(bodies * size, rows, columns), all_free, choice=choice)
