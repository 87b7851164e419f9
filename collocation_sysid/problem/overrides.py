"""Overrides of a problem file: values of keys, stated beside the file."""

from __future__ import annotations

import tomllib
from copy import deepcopy
from typing import Any

from ..common.text_files import DEEPEST, beyond_limits
from ..errors import InputError


def apply_override(content: dict[str, Any], override: str) -> None:
    """Set the value of an override "dotted.key=value" in the content of a problem file.

    An experiment gets a copy of a table of [experiment_defaults] of which a part is set.
    """
    key, equals, value = override.partition("=")
    key = key.strip()
    parts = key.split(".")
    if len(parts) > DEEPEST:
        raise InputError(
            f"found a key of {len(parts)} parts; expected one such as parameters.mu_pa.guess, of "
            f"at most {DEEPEST}"
        )
    if not equals or not all(parts):
        expected = "expected key=value such as parameters.mu_pa.guess=200"
        raise InputError(f"found {override!r}, {expected}")
    table: Any = content
    shared: Any = content.get("experiment_defaults")
    *leading, last = _join_dotted_names(content, parts)
    for level, part in enumerate(leading):
        item: Any = _item_key(table, part, key=key)
        if isinstance(table, dict):
            # An experiment gets a default of its own, a part of which is to be overridden.
            has_default = level == 2 and leading[0] == "experiment" and isinstance(shared, dict)
            table.setdefault(item, deepcopy(shared[item]) if has_default and item in shared else {})
        table = table[item]
    item = _item_key(table, last, key=key)
    table[item] = _parse_value(value, key)


def _join_dotted_names(content: Any, parts: list[str]) -> list[str]:
    """Join parts of a key that are one key of the content, such as "core.mu_pa"."""
    names = []
    table = content
    while parts:
        count = 1
        if isinstance(table, dict):
            several = range(len(parts), 1, -1)
            count = next((n for n in several if ".".join(parts[:n]) in table), 1)
        names.append(".".join(parts[:count]))
        parts = parts[count:]
        table = table.get(names[-1]) if isinstance(table, dict) else None
    return names


def _item_key(place: Any, part: str, key: str) -> str | int:
    """Return the key in a table, or the index in a list."""
    if isinstance(place, dict):
        return part
    if not isinstance(place, list):
        raise InputError(
            f"{key} goes beyond the value {place!r}, which is not a table; expected "
            "a key of a table"
        )
    names = [item.get("name") if isinstance(item, dict) else None for item in place]
    if part in names:
        return names.index(part)
    if part.isascii() and part.isdecimal() and int(part) < len(place):
        return int(part)
    expected = f"its number, from 0 to {len(place) - 1}"
    expected += "".join(f", or its name {name}" for name in names if name)
    raise InputError(f"found {part!r} for a table of the list in {key}; expected {expected}")


def _parse_value(text: str, key: str) -> Any:
    """Return a value in TOML syntax; words without quotes are strings."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        if text.strip().startswith(("[", "{", '"', "'")):
            example = 'such as 0.5, [0, 0, -9.81], {guess = 0.5} or "text"'
            message = f"found {text.strip()} for {key}; expected a value as in a TOML file"
            raise InputError(f"{message}, {example}") from None
        return text.strip()
    except (RecursionError, ValueError) as error:
        raise InputError(beyond_limits(error), where=key) from error
