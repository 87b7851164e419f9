"""Descriptions of fields, from the section "Attributes" of the docstring of a class."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, NamedTuple, TypeVar

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


class FieldOfRow(NamedTuple):
    """Field of a class that has one for each row of a table."""

    annotation: Any
    default: Any
    form: str  # type in the documentation
    description: str  # description in the documentation


def with_fields(rows: Mapping[str, FieldOfRow]) -> Callable[[type[T]], type[T]]:
    """Return a decorator that adds fields, by name, before those of a class that is not yet a
    dataclass, and their descriptions to the section "Attributes" of its docstring.
    """

    def with_rows(kind: type[T]) -> type[T]:
        summary, _, others = inspect.cleandoc(kind.__doc__ or "").partition(_HEADING)
        section = "".join(
            f"{name} : {row.form}\n"
            f"{textwrap.fill(row.description, 96, initial_indent=_IN, subsequent_indent=_IN)}\n"
            for name, row in rows.items()
        )
        kind.__doc__ = f"{summary.rstrip()}\n\n{_HEADING}{section}{others}"
        annotations = {name: row.annotation for name, row in rows.items()}
        kind.__annotations__ = annotations | inspect.get_annotations(kind)
        for name, row in rows.items():
            setattr(kind, name, row.default)
        return kind

    return with_rows


def sentence(text: str) -> str:
    """Return a phrase as a sentence: with a capital letter and a full stop."""
    return f"{text[0].upper()}{text[1:]}."
