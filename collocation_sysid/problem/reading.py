"""From TOML text and overrides to a validated `ProblemFile`, with one clear message if not."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import BaseModel, ValidationError

from ..errors import InputError
from .schema import ProblemFile


def read_problem_file(
    path: str | Path, overrides: Sequence[str] = ()
) -> tuple[ProblemFile, str]:
    """Read and validate a problem file.

    Parameters
    ----------
    path : str or Path
    overrides : sequence of "dotted.key=value"
        Values in TOML syntax; bare words are strings; list items by number.

    Returns
    -------
    ProblemFile, and the text of the problem as run (with the overrides in it)

    Raises
    ------
    InputError
        Naming the file, the key or line, what was found and what was expected.
    """
    path = Path(path)
    text = _read_text(path)
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"not valid TOML: {error}", path) from error
    for override in overrides:
        _apply(content, override)
    if overrides:
        text = tomli_w.dumps(content)
    try:
        return ProblemFile.model_validate(content), text
    except ValidationError as error:
        raise _explain(error, path) from error


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError("there is no such file; expected a problem file (TOML)", path) from None
    except IsADirectoryError:
        raise InputError("this is a folder; expected a problem file (TOML)", path) from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read: {error}", path) from error


def _apply(content: dict[str, Any], override: str) -> None:
    key, equals, value = override.partition("=")
    if not equals or not key.strip():
        raise InputError(
            f"found {override!r}, expected key=value such as parameters.mu_pa.guess=200", "--set"
        )
    *parents, last = key.strip().split(".")
    place: Any = content
    for part in parents:
        place = _descend(place, part, key)
    if isinstance(place, list):
        place[_index(place, last, key)] = _value(value)
    elif isinstance(place, dict):
        place[last] = _value(value)
    else:
        raise InputError(f"{key!r} leads into a plain value, not a table", "--set")


def _descend(place: Any, part: str, key: str) -> Any:
    if isinstance(place, dict):
        return place.setdefault(part, {})
    if isinstance(place, list):
        return place[_index(place, part, key)]
    raise InputError(f"{key!r} leads into a plain value, not a table", "--set")


def _index(items: list[Any], part: str, key: str) -> int:
    if not part.isdecimal() or int(part) >= len(items):
        raise InputError(
            f"{part!r} in {key!r} is not an item; expected a number from 0 to {len(items) - 1}",
            "--set",
        )
    return int(part)


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _explain(error: ValidationError, path: Path) -> InputError:
    """The first of pydantic's complaints in this project's words."""
    faults = error.errors(include_url=False)
    # An unknown key explains the others around it.
    fault = next((f for f in faults if f["type"] == "extra_forbidden"), faults[0])
    parts = [part for part in fault["loc"] if not _is_union_tag(part)]
    where = ".".join(str(part) for part in parts)
    found = fault.get("input")
    if fault["type"] == "extra_forbidden":
        message = _unknown_key(parts)
    elif fault["type"] == "missing":
        message = "missing; this key is required"
    elif fault["type"] == "value_error":
        message = str(fault["ctx"]["error"])
    else:
        expectation = fault["msg"].replace("Input should be", "expected")
        message = f"found {_short(found)}; {expectation[0].lower()}{expectation[1:]}"
    if len(faults) > 1:
        message += f" (and {len(faults) - 1} more to mend)"
    return InputError(message, path, where or None)


def _is_union_tag(part: str | int) -> bool:
    return isinstance(part, str) and (part in ("float", "int", "str") or "[" in part)


def _unknown_key(parts: Sequence[str | int]) -> str:
    known = _keys_at(parts[:-1])
    close = difflib.get_close_matches(str(parts[-1]), known, n=1)
    hint = f"did you mean {close[0]}?" if close else f"expected one of {', '.join(known)}"
    return f"unknown key; {hint}"


def _keys_at(parts: Sequence[str | int]) -> list[str]:
    """The keys a table of the schema knows."""
    model: type[BaseModel] = ProblemFile
    for part in parts:
        if isinstance(part, int):
            continue
        inner = _model_in(model.model_fields[part].annotation)
        if inner is None:
            return []
        model = inner
    return list(model.model_fields)


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        found = _model_in(argument)
        if found is not None:
            return found
    return None


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
