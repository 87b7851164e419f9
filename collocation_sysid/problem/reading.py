"""Reading of a problem file: TOML syntax, overrides, and validation."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import ValidationError

from ..common.files import require_regular, require_size
from ..errors import InputError, excerpt, located
from .schema import ProblemFile
from .validation_messages import explain_validation_error

# Levels of tables and lists that a problem file may have: it needs seven.
DEEPEST = 20
# A dotted key of more parts, 100 at least; no part is looked at twice.
_ENDLESS_KEY = re.compile(
    r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){100}"""
)
# What the TOML parser says where people see something simpler.
_PLAINER = {
    "Cannot overwrite a value": "this key is given twice",
    "Illegal character '\\n'": "a text lacks its closing quote",
}


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
    text = read_text(path)
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


def parse_toml(text: str, path: Path) -> dict[str, Any]:
    """Return the content of a TOML text; `path` is only for messages.

    Raises
    ------
    InputError
        For invalid syntax, with the line if it is known, for more than `DEEPEST` nested levels,
        keys of 100 or more parts, and integers with too many digits.
    """
    try:
        if _ENDLESS_KEY.search(text) is not None:  # on which the parser would spend minutes
            raise RecursionError
        content = tomllib.loads(text)
        if _nesting_level_count(content) > DEEPEST:
            raise RecursionError
        return content
    except tomllib.TOMLDecodeError as error:
        raise _bad_syntax(str(error), text, path=path) from error
    except (RecursionError, ValueError) as error:  # Python's limits of nesting and of digits
        raise InputError(_beyond_limits(error), path) from error


def _nesting_level_count(content: Any) -> int:
    """Return the nested levels, itself included, up to `DEEPEST` + 1."""
    level = [content]
    level_count = 0
    while level and level_count <= DEEPEST:
        tables = [each.values() if isinstance(each, dict) else each for each in level]
        level = [each for table in tables for each in table if isinstance(each, (dict, list))]
        level_count += 1
    return level_count


def _beyond_limits(error: Exception) -> str:
    """Return the message for a file beyond the limits of its parser."""
    if isinstance(error, RecursionError):
        return f"tables or lists are nested too deeply; expected at most {DEEPEST} levels"
    return "an integer has too many digits; expected fewer than 4,300"


# Largest file that is written by hand [bytes].
LARGEST_BYTES = 10_000_000


def read_text(path: Path, what: str = "a problem file (TOML)") -> str:
    """Return the text of a file (UTF-8), without a byte order mark.

    Parameters
    ----------
    what : str
        Kind of file that is expected, for messages.

    Raises
    ------
    InputError
        If the file does not exist or is not a text file.
    """
    require_regular(path)
    require_size(path, LARGEST_BYTES)
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"there is no such file; expected {what}", path) from None
    except IsADirectoryError:
        raise InputError(f"this is a folder; expected {what}", path) from None
    except UnicodeDecodeError:
        raise InputError(f"this is not a text file; expected {what}", path) from None
    except OSError as error:
        raise InputError(f"the file cannot be read: {error.strerror}", path) from error


def _bad_syntax(complaint: str, text: str, path: Path) -> InputError:
    reason, _, place = complaint.rpartition(" (at ")
    reason = _PLAINER.get(reason, reason)
    matched = re.match(r"line (\d+)", place)
    if matched is None:
        return InputError(
            f"the file is not valid TOML: {reason or complaint}, at the end of the file", path
        )
    number = int(matched[1])
    line = excerpt(text.splitlines()[number - 1].strip())
    return InputError(
        f"the file is not valid TOML: {reason} in: {line}", path, where=f"line {number}"
    )


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
        raise InputError(_beyond_limits(error), where=key) from error
