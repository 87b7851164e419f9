"""Descriptions of fields, from the section "Attributes" of the docstring of a class."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import TypeVar

T = TypeVar("T")
_HEADING = "Attributes\n----------\n"
_IN = 4 * " "


def attributes(kind: type) -> dict[str, tuple[str, str]]:
    """Return type and description of each documented field or parameter of a class, by name.

    They are read from the "Attributes" or "Parameters" section of its docstring and of those of its
    bases; the class itself prevails. Both are single lines of text.
    """
    descriptions: dict[str, tuple[str, str]] = {}
    for base in reversed(kind.__mro__):
        text = inspect.cleandoc(base.__doc__ or "")
        section = re.split("^(?:Attributes|Parameters)\n-+\n", text, maxsplit=1, flags=re.M)[-1]
        for names, form, text in re.findall(
            r"^(\w[\w, ]*) : (.*)\n((?: +.*(?:\n|$))+)", section, re.M
        ):
            descriptions |= dict.fromkeys(names.split(", "), (form, " ".join(text.split())))
    return descriptions


def documented(kind: type) -> dict[str, str]:
    """Return the descriptions of the fields of a dataclass, by name in their order; fields without
    a description are left out.
    """
    descriptions = attributes(kind)
    return {
        each.name: descriptions[each.name][1] for each in fields(kind) if each.name in descriptions
    }


def with_attributes(entries: Mapping[str, tuple[str, str]]) -> Callable[[type[T]], type[T]]:
    """Return a decorator that inserts entries at the beginning of the section "Attributes" of a
    class's docstring.

    Parameters
    ----------
    entries : mapping of name to (str, str)
        Type and description of each field.
    """

    def described(kind: type[T]) -> type[T]:
        summary, _, others = inspect.cleandoc(kind.__doc__ or "").partition(_HEADING)
        section = "".join(
            f"{name} : {form}\n{textwrap.fill(text, 96, initial_indent=_IN, subsequent_indent=_IN)}\n"
            for name, (form, text) in entries.items()
        )
        kind.__doc__ = f"{summary.rstrip()}\n\n{_HEADING}{section}{others}"
        return kind

    return described


def sentence(text: str) -> str:
    """Return a phrase as a sentence: with a capital letter and a full stop."""
    return f"{text[0].upper()}{text[1:]}."
