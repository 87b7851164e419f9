"""Classes that a user states, in Python or in a file: a field, what it takes and says, once each.

`stated` makes a frozen dataclass whose fields are converted as it is built; `key` gives a field its
conversion, and what a problem file may say in its place.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, TypeVar, dataclass_transform

T = TypeVar("T")
S = TypeVar("S")


@dataclass(frozen=True)
class Key:
    """What a problem file may say of a field; what it is stands in the docstring of the class.

    Attributes
    ----------
    name : str
    form : type of what the file says; None of it is the field's own default
    read : callable, optional
        From what the file says to the field; from a file's path to times and values of a table.
    constant : str, optional
        Where the key names a file with such a table: the field whose key is a constant instead.
    said : str, optional
        What it is, where that is not what the field is.
    """

    name: str
    form: Any
    read: Callable[[Any], Any] | None = None
    constant: str | None = None
    said: str | None = None


def key(
    form: Any = None,
    *,
    converter: Callable[[S], T] | None = None,
    read: Callable[[Any], Any] | None = None,
    **given: Any,
) -> Any:
    """A field that is converted as its class is built, and that a file may state.

    Parameters
    ----------
    form : type, or Key where it has another name in the file
        The field is no key where there is none.
    converter : callable, optional
        From what a program gives; None is left as it is.
    read : callable, optional
        From what the file says to the field.
    **given
        As of `dataclasses.field`.
    """
    return field(metadata={"converter": converter, "form": form, "read": read}, **given)


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


def keys_of(kind: type) -> Iterator[tuple[str, Key]]:
    """The names of fields that a problem file may state, and their keys."""
    said = documented(kind)
    for each in fields(kind):
        form = each.metadata.get("form")
        if isinstance(form, Key):
            yield each.name, form
        elif form is not None:
            yield each.name, Key(each.name, form, each.metadata["read"], None, said.get(each.name))


def optional_keys(kind: type) -> set[str]:
    """Keys that may be left out: the field has a default, or a table stands in its place."""
    keys = dict(keys_of(kind))
    defaults = {each.name for each in fields(kind) if each.default is not MISSING}
    return {key.name for name, key in keys.items() if name in defaults} | {
        key.constant for key in keys.values() if key.constant is not None
    }


def attributes(kind: type) -> dict[str, tuple[str, str]]:
    """What the docstrings of a class say of each field or option: its type, and what it is."""
    said: dict[str, tuple[str, str]] = {}
    for base in reversed(kind.__mro__):
        text = inspect.cleandoc(base.__doc__ or "")
        section = re.split("^(?:Attributes|Parameters)\n-+\n", text, maxsplit=1, flags=re.M)[-1]
        for names, form, text in re.findall(
            r"^(\w[\w, ]*) : (.*)\n((?: +.*(?:\n|$))+)", section, re.M
        ):
            said |= dict.fromkeys(names.split(", "), (form, " ".join(text.split())))
    return said


def documented(kind: type) -> dict[str, str]:
    """Descriptions of the fields of a class, or of the options of a method, by name."""
    said = attributes(kind)
    return {each.name: said[each.name][1] for each in fields(kind) if each.name in said}
