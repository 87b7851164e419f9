"""Banded Cholesky factorisation of LAPACK without the interpreter lock, for use in threads.

SciPy's wrappers hold the lock while they factorise; its Cython interface provides the address of
the same routine.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray
from scipy.linalg import get_blas_funcs
from threadpoolctl import ThreadpoolController

# Matrix of double or single precision.
Band = NDArray[Any]


def _routine(name: str) -> Any:
    """Return a LAPACK routine of SciPy's Cython interface as a ctypes function of six pointers."""
    capsule = import_module("scipy.linalg.cython_lapack").__pyx_capi__[name]
    api = ctypes.pythonapi
    api.PyCapsule_GetName.restype = ctypes.c_char_p
    api.PyCapsule_GetName.argtypes = [ctypes.py_object]
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    address = api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule))
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 6)(address)


# Banded Cholesky factorisation by the type of the numbers.
_PBTRF = {np.dtype(np.float64): _routine("dpbtrf"), np.dtype(np.float32): _routine("spbtrf")}


@cache
def _controller() -> ThreadpoolController:
    """Return the controller of BLAS threads, cached because its creation is slow."""
    return ThreadpoolController()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread within the block, or within a function that this decorates: on
    narrow bands several gain nothing and wait for each other.
    """
    with _controller().limit(limits=1, user_api="blas"):
        yield


def cholesky_in_place(band: Band) -> bool:
    """Factorise a symmetric band matrix of double or single precision in place, and return whether
    it is positive definite.

    Parameters
    ----------
    band : (half-bandwidth + 1, n) Fortran-ordered array
        Lower band, diagonal first; overwritten by the factor, or by meaningless values if the
        matrix is not positive definite.
    """
    rows, columns = band.shape
    lower = ctypes.c_char(b"L")
    size = ctypes.c_int(columns)
    width = ctypes.c_int(rows - 1)
    leading = ctypes.c_int(rows)
    failed_at = ctypes.c_int(0)
    _PBTRF[band.dtype](
        ctypes.addressof(lower),
        ctypes.addressof(size),
        ctypes.addressof(width),
        band.ctypes.data,
        ctypes.addressof(leading),
        ctypes.addressof(failed_at),
    )
    return failed_at.value == 0


# Rows of the blocks in which a band is solved: larger ones need more operations, smaller ones more
# calls.
BLOCK_ROWS = 64


def solve_band_in_blocks(band: Band, right: Band) -> Band:
    """Return the solution of L Lᵀ x = b for many right-hand sides b, all in the same precision.

    LAPACK's pbtrs reads the complete factor for every column; products of blocks read it once.

    Parameters
    ----------
    band : (half-bandwidth + 1, n) Fortran-ordered array
        Lower band of the factor L, diagonal first.
    right : (n, m) array
        Right-hand sides; not modified.
    """
    height, size = band.shape
    reach = height - 1
    step = min(BLOCK_ROWS, max(reach, 1))
    stride = band.itemsize
    # L as a matrix: next rows are adjacent in memory, the next column is `reach` entries further.
    # Only entries within the band may be used.
    factor = as_strided(band, (size, size), (stride, reach * stride), writeable=False)
    solution = np.array(right, order="C")
    (trsm,) = get_blas_funcs(("trsm",), dtype=band.dtype)
    starts = range(0, size, step)
    for start in starts:
        stop = min(start + step, size)
        solution[start:stop] = trsm(
            1.0, factor[start:stop, start:stop], solution[start:stop], lower=1
        )
        for rows, block in _blocks_below(factor, start, stop=stop, reach=reach):
            solution[rows] -= block @ solution[start:stop]
    for start in reversed(starts):
        stop = min(start + step, size)
        for rows, block in _blocks_below(factor, start, stop=stop, reach=reach):
            solution[start:stop] -= block.T @ solution[rows]
        solution[start:stop] = trsm(
            1.0, factor[start:stop, start:stop], solution[start:stop], lower=1, trans_a=1
        )
    return solution


def _blocks_below(factor: Band, start: int, stop: int, reach: int) -> Iterator[tuple[slice, Band]]:
    """Yield the rows and entries of the blocks of a band below its diagonal block."""
    size = len(factor)
    full = slice(stop, min(start + reach + 1, size))
    if full.start < full.stop:
        yield full, factor[full, start:stop]
    # Rows that only the later columns reach.
    rest = slice(max(full.stop, stop), min(stop + reach, size))
    if rest.start < rest.stop:
        columns = slice(start, stop)
        offset = start + reach - rest.start
        yield rest, np.triu(factor[rest, columns], -offset)
