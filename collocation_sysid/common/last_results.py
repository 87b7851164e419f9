"""The last result of a function for each object, while the object exists."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TypeVar
from weakref import WeakKeyDictionary

from .array_types import Array

Owner = TypeVar("Owner")
Result = TypeVar("Result")


def known_at_last(function: Callable[[Owner, Array], Result]) -> Callable[[Owner, Array], Result]:
    """Return a function of an object and an array that computes its result again only for another
    array than the last one of this object: several checks of one answer need the same.

    The object must be compared by identity, and the result must not be changed.
    """
    known: WeakKeyDictionary[Owner, tuple[bytes, Result]] = WeakKeyDictionary()

    @wraps(function)
    def of(owner: Owner, at: Array) -> Result:
        key = at.tobytes()
        last = known.get(owner)
        if last is None or last[0] != key:
            last = known[owner] = key, function(owner, at)
        return last[1]

    return of
