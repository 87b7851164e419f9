"""Array fields of immutable classes: copies that are checked against a shape and made read-only."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from ..common.array_types import Array, Index
from ..errors import InputError


def read_only_floats(
    values: ArrayLike, shape: tuple[int | None, ...], name: str, finite: bool = True
) -> Array:
    """Return a read-only float copy of an array whose shape has been checked.

    Parameters
    ----------
    values : array
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
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must hold numbers: {error}") from error
    _require_shape(array.shape, shape, name=name)
    if finite and not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(f"{name}{list(index)} is {array[index]}; it must be a finite number")
    array.setflags(write=False)
    return array


def float_converter(
    shape: tuple[int | None, ...], name: str, finite: bool = True
) -> Callable[[ArrayLike], Array]:
    """Return a function that copies values to a read-only array; shape, name and finite are
    arguments of `read_only_floats`, whose errors the returned function raises.
    """

    def converted(values: ArrayLike) -> Array:
        """Return a read-only copy of the values."""
        return read_only_floats(values, shape, name=name, finite=finite)

    return converted


def unconverted(values: ArrayLike) -> Array:
    """Return the values unchanged; converter of array fields that ``__post_init__`` converts with
    more information.
    """
    return cast(Array, values)


def unconverted_or_none(values: ArrayLike | None) -> Array | None:
    """Return the values unchanged, like `unconverted`; None where the field may be None."""
    return cast("Array | None", values)


def read_only_coordinates(values: ArrayLike, shape: tuple[int | None, ...], name: str) -> Array:
    """Return a read-only copy of marker positions (T, M, 3), in which coordinates that are not
    finite are NaN.

    Raises
    ------
    InputError
        If the values are not numbers, or the shape differs.
    """
    values = read_only_floats(values, shape, name=name, finite=False)
    tracks = np.where(np.isfinite(values), values, np.nan)
    tracks.setflags(write=False)
    return tracks


def read_only_tracks(values: ArrayLike, shape: tuple[int | None, ...], name: str) -> Array:
    """Return a read-only copy of marker positions (T, M, 3).

    A sample with a coordinate that is not finite is missing: all three of its coordinates become
    NaN.

    Parameters
    ----------
    values : array_like
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
    indices = np.asarray(values)
    if indices.size and not np.issubdtype(indices.dtype, np.integer):
        raise InputError(
            f"{name} must hold node indices, whole numbers from 0, not {indices.dtype}"
        )
    _require_shape(indices.shape, shape, name=name)
    nodes = indices.astype(np.int64)
    if nodes.size and nodes.min() < 0:
        raise InputError(f"{name} must hold node indices from 0 upwards, not {nodes.min()}")
    nodes.setflags(write=False)
    return nodes


def point_text(point: ArrayLike) -> str:
    """Return a point (3,) as text with four digits, "(x, y, z)", for messages."""
    return f"({', '.join(f'{x:.4g}' for x in np.asarray(point))})"


def _require_shape(shape: tuple[int, ...], expected: tuple[int | None, ...], name: str) -> None:
    """Raise an `InputError` about `name` unless `shape` matches `expected`, in which None allows
    any length.
    """
    matches = len(shape) == len(expected) and all(
        want is None or have == want for have, want in zip(shape, expected, strict=True)
    )
    if not matches:
        expected_text = ", ".join("any" if want is None else str(want) for want in expected)
        raise InputError(f"{name} has the shape {shape}; expected ({expected_text})")
