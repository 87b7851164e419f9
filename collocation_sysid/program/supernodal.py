"""Supernodal Cholesky of wide sparse matrices, by PARDISO of the `mkl` wheel (extra `large`).

Nested dissection fills in less than a band, and columns alike are factorised together by dense
kernels. It is called through its C interface, without the interpreter lock.
"""

from __future__ import annotations

import ctypes
import sys
from ctypes.util import find_library
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..errors import InputError

POSITIVE_DEFINITE = 2
# Phases, and the error that tells that a pivot is not positive.
ANALYSE, FACTORISE, SOLVE, RELEASE = 11, 22, 33, -1
NOT_POSITIVE, NO_MEMORY = -4, -2
# Places in `iparm`.
COUNTED, FROM_ZERO = 17, 34
SEQUENTIAL, INTS_OF_32_BITS = 1, 0
MISSING = (
    'factorisation = "supernodal" needs the mkl package (Intel and AMD processors): '
    "pip install 'collocation-sysid[large]'; or take \"auto\""
)


@cache
def library() -> Any:
    """MKL, or None where it is not installed."""
    found = []
    try:
        files = metadata.files("mkl") or []
        found = [str(each.locate()) for each in files if "mkl_rt" in each.name]
    except metadata.PackageNotFoundError:
        found = [name for name in [find_library("mkl_rt")] if name]
    for path in sorted(found):
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
    """One factor's memory in PARDISO; what is factorised next takes its place.

    Parameters
    ----------
    starts, columns : rows of the upper triangle, columns ascending from the diagonal on

    Raises
    ------
    InputError
        Where MKL is not installed.
    """

    def __init__(self, starts: Index, columns: Index) -> None:
        if library() is None:
            raise InputError(MISSING)
        self.size = len(starts) - 1
        self._handle, self._options = np.zeros(64, np.int64), np.zeros(64, np.int32)
        self._starts, self._columns = starts.astype(np.int32), columns.astype(np.int32)
        self._values = np.zeros(len(columns))
        kind = ctypes.c_int(POSITIVE_DEFINITE)
        library().pardisoinit(_at(self._handle), ctypes.byref(kind), _at(self._options))
        self._options[FROM_ZERO], self._options[COUNTED] = 1, -1
        self._call(ANALYSE)
        self.numbers = int(self._options[COUNTED])

    def factorise(self, values: Array) -> bool:
        """Factorise values of the upper triangle; tell whether it is positive definite."""
        self._values = np.ascontiguousarray(values, dtype=float)
        return self._call(FACTORISE) != NOT_POSITIVE

    def solve(self, right: Array) -> Array:
        """Solve for (n,) or (n, m) right-hand sides."""
        columns = np.array(right, dtype=float, order="F")
        result = np.empty_like(columns)
        if columns.size:
            self._call(SOLVE, columns, result)
        return result

    def _call(self, phase: int, right: Array | None = None, result: Array | None = None) -> int:
        count = 1 if right is None else right.size // self.size
        numbers = (1, 1, POSITIVE_DEFINITE, phase, self.size)
        one, which, kind, stage, size = (ctypes.byref(ctypes.c_int(k)) for k in numbers)
        error, silent = ctypes.c_int(0), ctypes.byref(ctypes.c_int(0))
        matrix = _at(self._values), _at(self._starts), _at(self._columns), None
        columns = ctypes.byref(ctypes.c_int(count))
        library().pardiso(
            *(_at(self._handle), one, which, kind, stage, size, *matrix),
            *(columns, _at(self._options), silent, _at(right), _at(result), ctypes.byref(error)),
        )
        if error.value == NO_MEMORY:
            raise MemoryError("no memory for the factors of a timestep")
        if error.value not in (0, NOT_POSITIVE):
            raise np.linalg.LinAlgError(f"PARDISO failed with error {error.value}")
        return error.value

    def __del__(self) -> None:
        if hasattr(self, "_columns") and not sys.is_finalizing():
            self._call(RELEASE)


def _at(array: NDArray[Any] | None) -> ctypes.c_void_p | None:
    return None if array is None else ctypes.c_void_p(array.ctypes.data)


@dataclass(frozen=True, eq=False)
class SupernodalFactor:
    """A factor that gives its memory back to a pool."""

    pardiso: Pardiso
    pool: list[Pardiso]
    positive_definite: bool = True

    def solve(self, right: Array, transposed: bool = False) -> Array:
        """Solve for (k,) or (k, m) right-hand sides."""
        return self.pardiso.solve(right)

    def __del__(self) -> None:
        self.pool.append(self.pardiso)
