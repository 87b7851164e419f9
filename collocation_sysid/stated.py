"""Classes that a user states, in Python or in a file: a field, what it takes and says, once each.

`stated` makes a frozen dataclass whose fields are converted as it is built; `key` gives a field its
conversion, and what a problem file may say in its place.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import Field, dataclass, field, fields
from typing import Any, TypeVar, dataclass_transform

T = TypeVar("T")
S = TypeVar("S")


@dataclass(frozen=True)
class Key:
    """What a problem file may say of a field.

    Attributes
    ----------
    name : str
    form : type that the file gives
    said : str
        What it is, for the schema and for messages.
    default : of the file; missing where it must be given
    read : callable, optional
        From what the file gives to the field; from a file's path to times and values where the key
        names a table that stands in place of a constant.
    """

    name: str
    form: Any
    said: str | None = None
    default: Any = None
    read: Callable[[Any], Any] | None = None


def key(*, converter: Callable[[S], T] | None = None, file: Key | None = None, **given: Any) -> Any:
    """A field that is converted as its class is built, and its key in a problem file.

    Parameters
    ----------
    converter : callable, optional
        From what a program gives; None is left as it is.
    file : Key, optional
        The field is no key where there is none.
    **given
        As of `dataclasses.field`.
    """
    return field(metadata={"converter": converter, "key": file}, **given)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(key, field))
def stated(kind: type[T]) -> type[T]:
    """A frozen dataclass whose fields are converted before ``__post_init__`` checks them."""
    check = kind.__dict__.get("__post_init__")

    def convert(self: T) -> None:
        for each, converter in converters:
            if (given := getattr(self, each)) is not None:
                object.__setattr__(self, each, converter(given))
        if check is not None:
            check(self)

    setattr(kind, "__post_init__", convert)  # noqa: B010 (of a type of the user's)
    made: Any = dataclass(frozen=True, eq=False)(kind)
    found = ((each.name, each.metadata.get("converter")) for each in fields(made))
    converters = [(name, converter) for name, converter in found if converter is not None]
    return made


def keys_of(kind: type) -> Iterator[tuple[Field[Any], Key]]:
    """The fields of a class that a problem file may state, and their keys."""
    for each in fields(kind):
        if (found := each.metadata.get("key")) is not None:
            yield each, found


def documented(kind: type) -> dict[str, str]:
    """Descriptions of fields by name, from "Attributes" in the docstrings of a class."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        _, _, section = inspect.cleandoc(base.__doc__ or "").partition("Attributes\n----------\n")
        for names, text in re.findall(r"^(\w[\w, ]*) : .*\n((?: +.*(?:\n|$))+)", section, re.M):
            found |= dict.fromkeys(names.split(", "), " ".join(text.split()))
    return {each.name: found[each.name] for each in fields(kind) if each.name in found}
