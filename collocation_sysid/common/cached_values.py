"""Cached values that copies of an object may share."""

from __future__ import annotations

from functools import cached_property
from typing import Any


def cached_values(instance: object, cls: type) -> dict[str, Any]:
    """Return the values of the cached properties that a class defines, as far as an instance has
    computed them, by name.

    A copy of the instance may share them if the class knows nothing of what differs in the copy:
    declare what depends on more than a base class in a subclass.

    Parameters
    ----------
    instance : object
        Instance of `cls` or of a subclass of it.
    cls : type
        Class whose own cached properties are returned; those of its subclasses and bases are not.
    """
    return {
        name: value
        for name, value in vars(instance).items()
        if isinstance(vars(cls).get(name), cached_property)
    }
