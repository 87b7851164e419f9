"""Fields of dataclasses that depend on time: selection of times, interpolation, scaling of loads.

Mark the fields of a class by their metadata, `over_time()`, `LOAD` or `PARTS_OVER_TIME`;
`at_times`, `interpolate_in_time`, `scale_loads` and `values_over_time` then work for its instances.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")
Rows = slice | NDArray[np.intp] | NDArray[np.bool_]

# Key of the mark in the metadata of a field.
MARK = "time dependence"


@dataclass(frozen=True)
class TimeDependence:
    """Mark of a field."""

    # Axis of the array along which time runs; None for a value that is the same at all times.
    axis: int | None = None
    is_load: bool = False  # whether the value is a load, or the factor of one
    has_parts: bool = False  # whether the value is an object with marked fields, or a tuple of them


def over_time(axis: int = 0, *, is_load: bool = False) -> Mapping[str, TimeDependence]:
    """Return the metadata of a field whose value is an array with one entry for each time along an
    axis, or None.

    Parameters
    ----------
    is_load : bool
        Whether `scale_loads` multiplies it.
    """
    return {MARK: TimeDependence(axis, is_load)}


# Metadata of a field of a load, or the factor of one, that is the same at all times.
LOAD = {MARK: TimeDependence(is_load=True)}
# Metadata of a field of an object with marked fields, or of a tuple of such objects.
PARTS_OVER_TIME = {MARK: TimeDependence(has_parts=True)}


def at_times(instance: T, rows: Rows) -> T:
    """Return an object at some of its times; itself if nothing depends on time.

    Parameters
    ----------
    instance : dataclass with marked fields
        Not modified; the result has views of its arrays if the rows are a slice.
    rows : slice, or array of int or bool
        Times to keep.
    """

    def select(value: Any, mark: TimeDependence) -> Any:
        if mark.has_parts:
            return _map_parts(lambda part: at_times(part, rows), value)
        if mark.axis is None:
            return value
        return np.asarray(value)[(slice(None),) * mark.axis + (rows,)]

    return _changed(instance, select)


def scale_loads(instance: T, factor: float) -> T:
    """Return an object with its loads, and those of its parts, multiplied by a factor; itself if it
    has none.
    """

    def scale(value: Any, mark: TimeDependence) -> Any:
        if mark.has_parts:
            return _map_parts(lambda part: scale_loads(part, factor), value)
        return factor * value if mark.is_load else value

    return _changed(instance, scale)


def interpolate_in_time(before: T, after: T, share: float) -> T:
    """Return an object with the arrays over time interpolated linearly between two others.

    Everything else is that of `after`; itself if nothing depends on time.

    Parameters
    ----------
    before, after : dataclasses of one type with marked fields
        The object at two series of times of equal length; not modified.
    share : float
        Fraction of the way: 0 for the times of `before`, 1 for those of `after`.
    """

    def interpolate(value: Any, start: Any, mark: TimeDependence) -> Any:
        if mark.has_parts:
            return _map_parts(
                lambda part, first: interpolate_in_time(first, part, share), value, start
            )
        if mark.axis is None:
            return value
        return start + share * (value - start)

    return _changed(after, interpolate, before)


def values_over_time(instance: Any) -> dict[str, Any]:
    """Return the arrays over time of an object by the names of their fields; None stays None."""
    return {
        name: getattr(instance, name)
        for name, mark in _marks(type(instance)).items()
        if mark.axis is not None
    }


def _changed(instance: T, function: Callable[..., Any], *others: T) -> T:
    """Return an object with its marked fields changed; itself if no value changes."""
    changes = {}
    for name, mark in _marks(type(instance)).items():
        value, *rest = (getattr(each, name) for each in (instance, *others))
        if value is None:
            continue
        if (changed := function(value, *rest, mark)) is not value:
            changes[name] = changed
    return replace(instance, **changes) if changes else instance  # type: ignore[type-var]


def _map_parts(function: Callable[..., Any], value: Any, *others: Any) -> Any:
    """Return the function of an object or of those in a tuple; the value itself if unchanged."""
    if not isinstance(value, tuple):
        return function(value, *others)
    parts = tuple(function(*each) for each in zip(value, *others, strict=True))
    is_same = all(a is b for a, b in zip(parts, value, strict=True))
    return value if is_same else parts


@cache
def _marks(kind: type) -> dict[str, TimeDependence]:
    return {each.name: each.metadata[MARK] for each in fields(kind) if MARK in each.metadata}
