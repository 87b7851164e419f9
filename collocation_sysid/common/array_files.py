"""Arrays of .npy and .npz files, whose stated sizes are checked before memory is taken."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ..errors import InputError
from .limits import machine_memory_mb

# Arrays below this are read in any case [bytes].
SMALL_BYTES = 50_000_000
# Arrays compressed more than this are no measurement: noise of the last bits alone takes more. Zlib
# makes zeros about 1000 times smaller.
LARGEST_COMPRESSION = 250
# Part of the memory that one array may take; what is made of it takes several times as much.
MEMORY_SHARE = 0.25

_HEADERS: dict[tuple[int, int], Callable[[Any], tuple[tuple[int, ...], bool, np.dtype]]] = {
    (1, 0): npy.read_array_header_1_0,
    (2, 0): npy.read_array_header_2_0,
}


def load_arrays(path: str | Path) -> dict[str, NDArray[Any]]:
    """Read all arrays of a .npz by name; arrays of Python objects are refused.

    The size that each header states is checked before memory is allocated, see `_require_size`.

    Raises
    ------
    InputError
        If an array is larger than its file or this machine allows. The path is not named.
    ValueError, OSError, zipfile.BadZipFile
        If the file is no archive of arrays, or holds objects.
    """
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            if member.filename.endswith(".npy"):
                with archive.open(member) as content:
                    name = member.filename.removesuffix(".npy")
                    _require_size(
                        content, member.file_size, compressed=member.compress_size, name=name
                    )
    with np.load(path, allow_pickle=False) as stored:
        return {name: np.asarray(stored[name]) for name in stored.files}


def load_array(path: str | Path) -> NDArray[Any]:
    """Read the array of a .npy file; an array of Python objects is refused.

    Raises
    ------
    InputError
        If the array is larger than its file or this machine allows. The path is not named.
    ValueError, OSError
        If the file holds no array, or holds objects.
    """
    size = Path(path).stat().st_size
    with Path(path).open("rb") as content:
        _require_size(content, size, compressed=size, name="")
    return np.load(path, allow_pickle=False)


def _require_size(content: IO[bytes], size: int, compressed: int, name: str) -> None:
    """Refuse an array if its header states more than is plausible."""
    # An array in version 3 of the format is not checked.
    version = npy.read_magic(content)
    if version not in _HEADERS:  # for names of columns that are not Latin
        return
    shape, _, dtype = _HEADERS[version](content)
    stored_bytes = math.prod(shape) * dtype.itemsize
    array = _array_text(name, shape, stored_bytes)
    if stored_bytes > size:
        raise InputError(
            f"{array} according to its header, but the file has only {size:,} bytes of it; "
            "expected a complete file: it may be truncated"
        )
    require_plausible_size(name, shape, stored_bytes, compressed)


def _array_text(name: str, shape: tuple[int, ...], stored_bytes: int) -> str:
    return f"the array {name or 'in it'} {shape} takes {stored_bytes / 1e9:.3g} GB"


def require_plausible_size(
    name: str, shape: tuple[int, ...], stored_bytes: int, compressed: int
) -> None:
    """Refuse an array above `SMALL_BYTES` that is compressed more than `LARGEST_COMPRESSION`-fold,
    to `compressed` bytes, or takes more than `MEMORY_SHARE` of this machine's memory (if known).
    """
    if stored_bytes <= SMALL_BYTES:
        return
    array = _array_text(name, shape, stored_bytes)
    if stored_bytes > LARGEST_COMPRESSION * compressed:
        raise InputError(
            f"{array} and is compressed {stored_bytes / max(compressed, 1):.0f}-fold, "
            "as no measurement is; "
            "expected an array with data"
        )
    memory_mb = machine_memory_mb()
    if memory_mb is not None and stored_bytes > MEMORY_SHARE * 1e6 * memory_mb:
        raise InputError(
            f"{array}, and this machine has {memory_mb / 1e3:.3g} GB of memory; expected at most "
            f"{MEMORY_SHARE:.0%} of that: cut or thin the recording"
        )
