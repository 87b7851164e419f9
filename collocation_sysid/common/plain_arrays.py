"""Conversion of arrays from files and callers into checked float arrays: used for depth archives and
the tables of benchmarks; `recording.checked_arrays` checks the arrays of recordings.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from .array_types import Array
from .validated_types import LARGEST

Shape = tuple[int | None, ...]


def float_array(
    values: ArrayLike, name: str, shapes: Shape | Sequence[Shape] = (), finite: bool = True
) -> Array:
    """Return a float copy of an array; tables and arrays of pandas, xarray and similar libraries are
    accepted.

    Masked entries become NaN. Numbers whose meaning would be lost are refused: complex numbers,
    truth values, texts, times, and quantities with a unit of their own.

    Parameters
    ----------
    values : array_like
    name : str
        What the array is, for messages.
    shapes : tuple of int or None, or several of these
        Possible shapes; None allows any length. Any shape by default.
    finite : bool
        Whether every value must be finite; otherwise NaN and ±inf are accepted.

    Raises
    ------
    InputError
        If the values are not such numbers, the shape differs, a value that must be finite is not,
        or one is above `LARGEST` in magnitude.
    """
    given = _as_array(values, name)
    if given.dtype.kind not in "iuf":
        raise InputError(f"{name} must hold numbers, not {_kind_of(given)}")
    array = np.array(given, dtype=np.float64)
    if isinstance(given, np.ma.MaskedArray):
        array[np.ma.getmaskarray(given)] = np.nan
    if shapes:
        require_shape(array.shape, shapes, name)
    if finite and not np.isfinite(array).all():
        raise InputError(f"{_first(array, ~np.isfinite(array), name)}; it must be a finite number")
    is_huge = np.isfinite(array) & (np.abs(array) > LARGEST)
    if is_huge.any():
        raise InputError(f"{_first(array, is_huge, name)}; expected a size up to {LARGEST:g}")
    return array


def require_shape(shape: tuple[int, ...], shapes: Shape | Sequence[Shape], name: str) -> None:
    """Raise an `InputError` about `name` unless a shape is one of `shapes`, see `float_array`."""
    possible: Any = [shapes] if not shapes or not isinstance(shapes[0], tuple) else shapes
    for expected in possible:
        if len(shape) == len(expected) and all(
            want is None or have == want for have, want in zip(shape, expected, strict=True)
        ):
            return
    texts = (", ".join("any" if n is None else str(n) for n in each) for each in possible)
    expected_text = " or ".join(f"({text})" for text in texts)
    raise InputError(f"{name} has the shape {shape}; expected {expected_text}")


def _as_array(values: ArrayLike, name: str) -> np.ndarray:
    """Return the values as an array of their own type, of numbers where a table has objects."""
    if hasattr(values, "magnitude") or (isinstance(values, np.ndarray) and hasattr(values, "unit")):
        raise InputError(f"{name} has a unit of its own; expected plain numbers in SI units")
    try:
        array = np.asanyarray(values)
        if array.dtype.kind == "O" and array.size and not _holds_truth_or_text(array):
            array = array.astype(np.float64)  # numbers and missing values of tables
        return array if array.size else np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must hold numbers: {error}") from error


def _holds_truth_or_text(array: np.ndarray) -> bool:
    return any(isinstance(each, bool | str | bytes | complex) for each in array.ravel())


def _kind_of(array: np.ndarray) -> str:
    names = {"b": "truth values", "c": "complex numbers", "U": "texts", "S": "texts"}
    names |= {"M": "dates", "m": "durations"}
    if array.dtype.kind in names:
        return names[array.dtype.kind]
    entry = array.ravel()[0] if array.size else array
    return f"objects such as {type(entry).__name__}"


def _first(array: Array, is_wrong: np.ndarray, name: str) -> str:
    """Return "name[i, j] is x" of the first wrong entry."""
    index = tuple(int(i) for i in np.argwhere(is_wrong)[0])
    return f"{name}{list(index) if index else ''} is {array[index]}"
