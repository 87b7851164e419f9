"""Reading of a problem file: TOML syntax, overrides, and validation."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import ValidationError

from ..common.text_files import DEEPEST, HAND_WRITTEN_BYTES, beyond_limits, parse_toml, read_text
from ..errors import InputError, located
from .schema import ProblemFile
from .validation_messages import explain_validation_error


def read_problem_file(path: str | Path, overrides: Sequence[str] = ()) -> tuple[ProblemFile, str]:
    """Read and validate a problem file.

    Parameters
    ----------
    overrides : sequence of str
        Overrides "dotted.key=value", with values in TOML syntax. Words without quotes are strings.
        Items of a list are selected by index, counted from 0, and tables of a list also by name.

    Returns
    -------
    tuple of ProblemFile and str
        Validated content, and the text of the problem: that of the file, or, with overrides, the
        overridden content written as TOML, without comments.

    Raises
    ------
    InputError
        Names the file, the key or line, what was found and what was expected.
    """
    path = Path(path)
    text = read_text(path, "a problem file (TOML)", HAND_WRITTEN_BYTES)
    content = parse_toml(text, path)
    with located("--set"):
        for override in overrides:
            _apply_override(content, override)
    if overrides:
        text = tomli_w.dumps(content)
    try:
        return ProblemFile.model_validate(content), text
    except ValidationError as error:
        raise explain_validation_error(error, content, path=path) from error


# Overrides ----------------------------------------------------------------------------------------


def _apply_override(content: dict[str, Any], override: str) -> None:
    """An experiment gets a copy of a table of [experiment_defaults] of which a part is set."""
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
