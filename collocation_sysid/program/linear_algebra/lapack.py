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
from numpy.typing import NDArray
from scipy import LowLevelCallable
from threadpoolctl import ThreadpoolController


def _routine(name: str, arguments: int) -> Any:
    """Return a LAPACK routine of SciPy's Cython interface as a ctypes function of `arguments`
    pointers.
    """
    module = import_module("scipy.linalg.cython_lapack")
    capsule = LowLevelCallable.from_cython(module, name).function
    api = ctypes.pythonapi
    api.PyCapsule_GetName.restype = ctypes.c_char_p
    api.PyCapsule_GetName.argtypes = [ctypes.py_object]
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    address = api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule))
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)(address)


_DPBTRF = _routine("dpbtrf", 6)


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


def cholesky_in_place(band: NDArray[np.float64]) -> bool:
    """Factorise a symmetric band matrix in place and return whether it is positive definite.

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
    _DPBTRF(
        ctypes.addressof(lower),
        ctypes.addressof(size),
        ctypes.addressof(width),
        band.ctypes.data,
        ctypes.addressof(leading),
        ctypes.addressof(failed_at),
    )
    return failed_at.value == 0
