"""The methods, and the options of one of them, as tables for a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from .methods import METHODS
from .methods.described import options_schema, summary
from .problem.solver_schema import heading

KINDS = {"number": "number", "integer": "whole number", "string": "text", "object": "table"}


def methods_table() -> RenderableType:
    """The methods by name, with a line on each."""
    table = _table("method", "")
    for name in METHODS:
        table.add_row(name, Text(summary(name)))
    return table


def options_table(method: str) -> RenderableType:
    """A method's options: defaults, what they can be, and what they do."""
    table = _table("option", "default", "")
    for name, option in options_schema(method)["properties"].items():
        told = Text(_values(option), style="dim").append(f"\n{option['description']}", "not dim")
        table.add_row(name, Text(_default(option)), told)
    where = f"In the problem file, under {heading(method)}:"
    return Group(Text(summary(method)), Text(""), Text(where), Text(""), table)


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


def _table(*heads: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for place, head in enumerate(heads):
        table.add_column(head, no_wrap=place == 0)
    return table
