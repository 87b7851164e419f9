"""Supernodal Cholesky factorisation of large sparse matrices by PARDISO of the `mkl` wheel (extra
`large`).

Nested dissection fills in less than a band, and columns of equal structure are factorised together
by dense kernels. PARDISO is called through its C interface, without the interpreter lock.
"""

from __future__ import annotations

import ctypes
import sys
from ctypes.util import find_library
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ...errors import InputError

# Type of a real symmetric positive definite matrix in PARDISO.
POSITIVE_DEFINITE = 2
# Phase of PARDISO: symbolic analysis.
ANALYSE = 11
# Numerical factorisation.
FACTORISE = 22
# Forward and backward substitution.
SOLVE = 33
# Release of all memory.
RELEASE = -1
# Error of a zero or negative pivot.
NOT_POSITIVE = -4
# Error of missing memory.
NO_MEMORY = -2
# Place in the options `iparm` of the number of entries of the factor.
COUNTED = 17
# Place of the flag for numbers of single precision.
IN_SINGLE = 27
# Place of the flag for indices that count from zero.
FROM_ZERO = 34
# Threading layer of MKL without threads of its own.
SEQUENTIAL = 1
# Interface layer of MKL with 32-bit integers.
INTS_OF_32_BITS = 0
MISSING = (
    'factorisation = "supernodal" needs the mkl package (Intel and AMD processors): pip '
    "install 'collocation-sysid[large]'; or use factorisation = \"auto\""
)


@cache
def load_mkl() -> Any:
    """Return the MKL library, set to 32-bit integers and one thread, or None if it is not
    installed; the result is cached.
    """
    paths = []
    try:
        files = metadata.files("mkl") or []
        paths = [str(each.locate()) for each in files if "mkl_rt" in each.name]
    except metadata.PackageNotFoundError:
        paths = [name for name in [find_library("mkl_rt")] if name]
    for path in sorted(paths):
        try:
            mkl = ctypes.CDLL(path)
        except OSError:
            continue
        # Timesteps side by side share the cores; threads inside each would be too many.
        mkl.MKL_Set_Interface_Layer(INTS_OF_32_BITS)
        mkl.MKL_Set_Threading_Layer(SEQUENTIAL)
        return mkl
    return None


class Pardiso:
    """Memory of one factor in PARDISO; each factorisation replaces the one before. It is released
    when the object is deleted.

    Attributes
    ----------
    size : int
        Number of rows.
    factor_size : int
        Number of floating-point numbers in a factor.

    Parameters
    ----------
    starts, columns : arrays
        Starts of the rows of the upper triangle, and their columns, ascending from the diagonal.
    is_single : bool
        Whether matrices, factors and solutions have single precision instead of double.

    Raises
    ------
    InputError
        If MKL is not installed.
    """

    def __init__(self, starts: Index, columns: Index, is_single: bool = False) -> None:
        if load_mkl() is None:
            raise InputError(MISSING)
        self._dtype: np.dtype[Any] = np.dtype(np.float32 if is_single else np.float64)
        self.size = len(starts) - 1
        self._handle = np.zeros(64, np.int64)
        self._options = np.zeros(64, np.int32)
        self._starts = starts.astype(np.int32)
        self._columns = columns.astype(np.int32)
        self._values = np.zeros(len(columns), self._dtype)
        kind = ctypes.c_int(POSITIVE_DEFINITE)
        load_mkl().pardisoinit(_pointer(self._handle), ctypes.byref(kind), _pointer(self._options))
        self._options[FROM_ZERO] = 1
        self._options[IN_SINGLE] = is_single
        self._options[COUNTED] = -1
        self._call(ANALYSE)
        self.factor_size = int(self._options[COUNTED])

    def factorise(self, values: Array) -> bool:
        """Factorise the values of the upper triangle, row by row, and return whether the matrix is
        positive definite (of values rounded to the precision of the factor).

        Raises
        ------
        MemoryError
            If there is no memory for the factor.
        numpy.linalg.LinAlgError
            If PARDISO fails for another reason.
        """
        self._values = np.ascontiguousarray(values, dtype=self._dtype)
        return self._call(FACTORISE) != NOT_POSITIVE

    def solve(self, right: Array) -> NDArray[Any]:
        """Return the solution for right-hand sides (n,) or (n, m) by the last factorisation, which
        must have succeeded, in the precision of the factor.
        """
        columns: NDArray[Any] = np.array(right, dtype=self._dtype, order="F")
        result = np.empty_like(columns)
        if columns.size:
            self._call(SOLVE, columns, result=result)
        return result

    def _call(
        self, phase: int, right: NDArray[Any] | None = None, result: NDArray[Any] | None = None
    ) -> int:
        """Call one phase of PARDISO and return its error code, 0 or `NOT_POSITIVE`."""
        count = 1 if right is None else right.size // self.size
        settings = (1, 1, POSITIVE_DEFINITE, phase, self.size)
        one, which, kind, stage, size = (ctypes.byref(ctypes.c_int(k)) for k in settings)
        error = ctypes.c_int(0)
        silent = ctypes.byref(ctypes.c_int(0))
        columns = ctypes.byref(ctypes.c_int(count))
        load_mkl().pardiso(
            _pointer(self._handle),
            one,
            which,
            kind,
            stage,
            size,
            _pointer(self._values),
            _pointer(self._starts),
            _pointer(self._columns),
            None,
            columns,
            _pointer(self._options),
            silent,
            _pointer(right),
            _pointer(result),
            ctypes.byref(error),
        )
        if error.value == NO_MEMORY:
            raise MemoryError("no memory for the factors of a timestep")
        if error.value not in (0, NOT_POSITIVE):
            raise np.linalg.LinAlgError(f"PARDISO failed with error {error.value}")
        return error.value

    def __del__(self) -> None:
        if hasattr(self, "_columns") and not sys.is_finalizing():
            self._call(RELEASE)


def _pointer(array: NDArray[Any] | None) -> ctypes.c_void_p | None:
    """Return a pointer to the data of an array, which must be kept alive by the caller."""
    return None if array is None else ctypes.c_void_p(array.ctypes.data)


@dataclass(frozen=True, eq=False)
class SupernodalFactor:
    """Supernodal factor that returns its memory to a pool when it is deleted."""

    pardiso: Pardiso  # memory of the factor
    pool: list[Pardiso]  # pool of memory that is not in use
    positive_definite: bool = field(default=True, init=False)

    def solve(self, right: Array, transposed: bool = False) -> Array:
        """Return the solution for right-hand sides (n,) or (n, m); the matrix is symmetric, so
        `transposed` has no effect.
        """
        return self.pardiso.solve(right)

    def __del__(self) -> None:
        self.pool.append(self.pardiso)
