"""Array fields of the immutable classes: copied, checked against a shape, and made read-only."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, Index
from ..errors import InputError


def read_only_floats(
    values: ArrayLike, shape: tuple[int | None, ...], name: str, finite: bool = True
) -> Array:
    """Return a read-only copy of `values`, whose shape must match `shape` (None: any length).

    Raises
    ------
    InputError
        If the values are not numbers, their shape differs, or one that must be finite is not.
    """
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must hold numbers: {error}") from error
    _require_shape(array.shape, shape, name)
    if finite and not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(f"{name}{list(index)} is {array[index]}; it must be a finite number")
    array.setflags(write=False)
    return array


def floats(
    shape: tuple[int | None, ...], name: str, finite: bool = True
) -> Callable[[ArrayLike], Array]:
    """`read_only_floats` of a field."""
    return lambda values: read_only_floats(values, shape, name, finite)


def read_only_tracks(values: ArrayLike, shape: tuple[int | None, ...], name: str) -> Array:
    """Return a read-only copy of marker positions (T, M, 3).

    A sample with a coordinate that is not finite is missing: all three become NaN.
    """
    tracks = read_only_floats(values, shape, name, finite=False)
    whole = np.isfinite(tracks).all(axis=2, keepdims=True)
    tracks = np.where(whole, tracks, np.nan)
    tracks.setflags(write=False)
    return tracks


def read_only_nodes(values: ArrayLike, shape: tuple[int | None, ...], name: str) -> Index:
    """Return a read-only int64 copy of node numbers, whose shape must match `shape`.

    Raises
    ------
    InputError
        If the values are not whole numbers from 0 upwards, or their shape differs.
    """
    numbers = np.asarray(values)
    if numbers.size and not np.issubdtype(numbers.dtype, np.integer):
        raise InputError(f"{name} must hold node numbers (integers), not {numbers.dtype}")
    _require_shape(numbers.shape, shape, name)
    nodes = numbers.astype(np.int64)
    if nodes.size and nodes.min() < 0:
        raise InputError(f"{name} must hold node numbers from 0 upwards, not {nodes.min()}")
    nodes.setflags(write=False)
    return nodes


def triple(point: ArrayLike) -> str:
    """A point (3,) in a message."""
    return f"({', '.join(f'{x:.4g}' for x in np.asarray(point))})"


def _require_shape(shape: tuple[int, ...], expected: tuple[int | None, ...], name: str) -> None:
    matches = len(shape) == len(expected) and all(
        want is None or have == want for have, want in zip(shape, expected, strict=True)
    )
    if not matches:
        wanted = ", ".join("any" if want is None else str(want) for want in expected)
        raise InputError(f"{name} has the shape {shape}; expected ({wanted})")
