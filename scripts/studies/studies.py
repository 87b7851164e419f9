"""Markdown tables of the studies."""

from __future__ import annotations

from collections.abc import Sequence


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with the first column aligned left and the others right."""
    rule = ("---", *("---:" for _ in heads[1:]))
    return "\n".join("| " + " | ".join(line) + " |" for line in (heads, rule, *rows))


def number(value: float | None, scale: float = 1.0, digits: int = 3) -> str:
    """Return `scale` times a number for a table; a dash for None."""
    return "–" if value is None else f"{scale * value:.{digits}g}"
