"""Arrays from callers and files: each is converted and checked here for its type, shape and values.

Fields of immutable classes are read-only copies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from .array_types import Array, Index
from .validated_types import LARGEST

Shape = tuple[int | None, ...]


def float_array(
    values: ArrayLike, name: str, shapes: Shape | Sequence[Shape] = (), finite: bool = True
) -> Array:
    """Return a float copy of an array; tables and arrays of pandas, xarray and similar libraries
    are accepted.

    Masked entries become NaN. Numbers whose meaning would be lost are refused: complex numbers,
    truth values, texts, times, and quantities with a unit of their own.

    Parameters
    ----------
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


def require_numbers(values: Any) -> Any:
    """Return values unchanged if `float_array` accepts their type."""
    try:
        is_numeric = values is not None and _as_array(values, "it").dtype.kind in "iufb"
    except InputError:
        is_numeric = False
    if not is_numeric:
        raise ValueError("expected an array of numbers")
    return values


def require_indices(values: Any) -> Any:
    """Return values unchanged if they are an array of whole numbers, or an empty one."""
    try:
        array = _as_array(values, "it")
    except InputError:
        array = np.array(np.nan)
    if not array.ndim or (array.size and array.dtype.kind not in "iu"):
        raise ValueError("expected an array of whole numbers")
    return values


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


def read_only_floats(
    values: ArrayLike, shape: tuple[int | None, ...], name: str, finite: bool = True
) -> Array:
    """Return a read-only float copy of an array whose shape has been checked.

    Parameters
    ----------
    shape : tuple of int or None
        Expected shape; None allows any length.
    name : str
        What the array is, for messages.
    finite : bool
        Whether every value must be finite; otherwise NaN and ±inf are accepted.

    Raises
    ------
    InputError
        If the values are not numbers, the shape differs, or a value that must be finite is not.
    """
    array = float_array(values, name, shape, finite=finite)
    array.setflags(write=False)
    return array


def float_converter(
    shape: tuple[int | None, ...], name: str, finite: bool = True
) -> Callable[[ArrayLike], Array]:
    """Return a function that copies values to a read-only array; shape, name and finite are
    arguments of `read_only_floats`, whose errors the returned function raises.
    """

    def converted(values: ArrayLike) -> Array:
        return read_only_floats(values, shape, name=name, finite=finite)

    return converted


def as_array(values: ArrayLike, name: str = "an array") -> Array:
    """Return the values as an array of their own type, whose mask is kept; converter of fields that
    ``__post_init__`` checks.
    """
    try:
        return np.asanyarray(values)
    except ValueError as error:
        raise InputError(f"{name} must hold numbers in rows of equal length") from error


def as_array_or_none(values: ArrayLike | None) -> Array | None:
    """Return the values like `as_array`; None where the field may be None."""
    return None if values is None else as_array(values)


def unconverted(values: ArrayLike) -> Any:
    """Return the values unchanged; converter of array fields that ``__post_init__`` converts with
    more information.
    """
    return values


def unconverted_or_none(values: ArrayLike | None) -> Any:
    """Return the values unchanged, like `unconverted`; None where the field may be None."""
    return values


def unconverted_sigma(sigma: ArrayLike) -> Any:
    """Return the value unchanged; converter of a σ that ``__post_init__`` splits into median and
    ratios of samples.
    """
    return sigma


def unconverted_sigma_or_none(sigma: ArrayLike | None) -> Any:
    """Return the value unchanged, like `unconverted_sigma`; None where the field may be None."""
    return sigma


def read_only_coordinates(values: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """Return a read-only copy of marker positions (T, M, 3), in which coordinates that are not
    finite are NaN.

    Raises
    ------
    InputError
        If the values are not numbers, or the shape differs.
    """
    values = read_only_floats(values, shape, name="marker positions", finite=False)
    tracks = np.where(np.isfinite(values), values, np.nan)
    tracks.setflags(write=False)
    return tracks


def read_only_tracks(values: ArrayLike, shape: tuple[int | None, ...], name: str) -> Array:
    """Return a read-only copy of marker positions (T, M, 3).

    A sample with a coordinate that is not finite is missing: all three of its coordinates become
    NaN.

    Parameters
    ----------
    shape : tuple of int or None
        Expected shape, of three axes; None allows any length.
    name : str
        Name of the positions, for messages.

    Raises
    ------
    InputError
        If the values are not numbers, or the shape differs.
    """
    tracks = read_only_floats(values, shape, name=name, finite=False)
    is_complete = np.isfinite(tracks).all(axis=2, keepdims=True)
    tracks = np.where(is_complete, tracks, np.nan)
    tracks.setflags(write=False)
    return tracks


def read_only_nodes(values: ArrayLike, shape: tuple[int | None, ...], name: str) -> Index:
    """Return a read-only int64 copy of node indices, whose shape must match `shape` (None: any
    length). Order and repeats are kept, and an empty array of any type is accepted.

    Raises
    ------
    InputError
        If the values are not whole numbers (of an integer type) from 0 upwards, or the shape
        differs; `name` is what the indices are, for the message.
    """
    indices = as_array(values, name)
    if indices.size and not np.issubdtype(indices.dtype, np.integer):
        raise InputError(
            f"{name} must hold node indices, whole numbers from 0, not {indices.dtype}"
        )
    require_shape(indices.shape, shape, name)
    nodes = indices.astype(np.int64)
    if nodes.size and nodes.min() < 0:
        raise InputError(f"{name} must hold node indices from 0 upwards, not {nodes.min()}")
    nodes.setflags(write=False)
    return nodes


def point_text(point: ArrayLike) -> str:
    """Return a point (3,) as text with four digits, "(x, y, z)", for messages."""
    return f"({', '.join(f'{x:.4g}' for x in np.asarray(point))})"


def _as_array(values: ArrayLike, name: str) -> np.ndarray:
    """Return the values as an array of their own type, of numbers where a table has objects."""
    if hasattr(values, "magnitude") or (isinstance(values, np.ndarray) and hasattr(values, "unit")):
        raise InputError(f"{name} has a unit of its own; expected plain numbers in SI units")
    try:
        array = as_array(values, name)
        if array.dtype.kind == "O" and array.size and not _holds_truth_or_text(array):
            array = array.astype(np.float64)  # numbers and missing values of tables
        return array if array.size else np.asarray(array, dtype=np.float64)
    except InputError:
        raise
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
