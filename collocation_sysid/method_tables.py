"""The methods, and the options of one of them, as tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .display import Shown, Table
from .methods import METHODS
from .methods.described import options_schema, summary
from .problem.solver_schema import heading

KINDS = {"number": "number", "integer": "whole number", "string": "text", "object": "table"}


def methods_table() -> Table:
    """The methods by name, with a line on each."""
    return Table("", ("method", ""), tuple((name, summary(name)) for name in METHODS), texts=1)


def options_table(method: str) -> list[Shown]:
    """A method's options: defaults, what they can be, and what they do."""
    rows = []
    for name, option in options_schema(method)["properties"].items():
        rows.append((name, _default(option), f"{_values(option)}\n{option['description']}"))
    table = Table("", ("option", "default", ""), tuple(rows), names=2, texts=1)
    return [summary(method), "", f"In the problem file, under {heading(method)}:", "", table]


def _default(option: Mapping[str, Any]) -> str:
    default = option["default"]
    items = default if isinstance(default, tuple) else [default]
    text = ", ".join(f"{item:g}" if isinstance(item, float) else str(item) for item in items)
    return f"[{text}]" if isinstance(default, tuple) else text


def _values(option: Mapping[str, Any]) -> str:
    """What an option can be, from its JSON schema."""
    if "enum" in option:
        return ", ".join(option["enum"])
    if option["type"] == "array":
        return f"list, each a {_values(option['items'])}"
    limits = {"exclusiveMinimum": "above", "minimum": "of at least"}
    ranges = [f" {word} {option[key]:g}" for key, word in limits.items() if key in option]
    return KINDS[option["type"]] + "".join(ranges)
