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
