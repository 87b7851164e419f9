"""Options of a method: built from what a user gave, and described by their docstring."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from ..errors import InputError, hint_at

T = TypeVar("T")


def built(kind: type[T], given: Mapping[str, Any], where: str) -> T:
    """Options by name as their dataclass; where is the key under which they were given."""
    known = [field.name for field in fields(kind)]  # pyright: ignore[reportArgumentType]
    for name in given:
        if name not in known:
            has = f"it has {', '.join(known)}{hint_at(name, known)}"
            raise InputError(f"there is no option {name!r}; {has}", None, where)
    try:
        return TypeAdapter(kind).validate_python(dict(given))
    except ValidationError as error:
        fault = error.errors()[0]
        place = ".".join([where, *map(str, fault["loc"])])
        raise InputError(f"found {fault['input']!r}; {fault['msg']}", None, place) from error


def documented(kind: type) -> dict[str, str]:
    """Descriptions of the options by name, from "Attributes" in the docstring."""
    _, _, section = inspect.cleandoc(kind.__doc__ or "").partition("Attributes\n----------\n")
    found = re.findall(r"^(\w+) : .*\n((?: +.*(?:\n|$))*)", section, re.MULTILINE)
    told = {name: " ".join(text.split()) for name, text in found}
    return {field.name: told.get(field.name, "") for field in fields(kind)}
