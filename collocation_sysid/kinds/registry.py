"""The records of all rooms, in the order of their names."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from . import __path__ as _folders
from .kind import Kind

KINDS: tuple[Kind, ...] = tuple(
    import_module(f"{__package__}.{each.name}").KIND
    for each in sorted(iter_modules(_folders), key=lambda each: each.name)
    if each.ispkg
)
_BY_CLASS = {kind.declares: kind for kind in KINDS}


def kind_of(declared: object) -> Kind | None:
    """Return the kind of a measurement, an obstacle or a specimen, by its class or a base class."""
    names = (each.__name__ for each in type(declared).__mro__)
    return next((_BY_CLASS[name] for name in names if name in _BY_CLASS), None)
