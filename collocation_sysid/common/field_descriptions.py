"""Descriptions of fields, from the section "Attributes" of the docstring of a class."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields


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
