"""Descriptions of the keys of the problem file, from its JSON schema."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from .schema import ProblemFile

# Words for the types of JSON values.
_TYPE_WORDS = {
    "array": "list",
    "boolean": "true or false",
    "integer": "whole number",
    "object": "table",
    "string": "text",
}
# Values of keywords of a schema that limit a number, with the sign that states them.
_LIMITS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
_REFERENCE = "#/$defs/"


@dataclass(frozen=True)
class KeyDescription:
    """A key of the problem file."""

    # Key with the tables that contain it, such as "experiment.markers.sigma_m"; names that a user
    # chooses are NAME.
    path: str
    form: str  # values that are allowed, in words; empty if the schema does not state them
    default: str  # default as JSON; empty for none, and for keys that must be stated
    description: str  # meaning; empty if the schema does not state it


def find_keys(name: str) -> list[KeyDescription]:
    """Return the keys of the problem file with a name or path, in the order of the schema; empty
    for none.

    Parameters
    ----------
    name : str
        Last name of the key, or several names with dots, such as "markers.sigma_m".
    """
    return [each for each in all_keys() if f".{each.path}".endswith(f".{name}")]


@cache
def all_keys() -> tuple[KeyDescription, ...]:
    """Return all keys of the problem file, each with the same path and description once; cached."""
    schema = ProblemFile.model_json_schema()
    keys = _keys_of(schema, schema["$defs"], path=(), seen=())
    return tuple(dict.fromkeys(keys))


def _keys_of(
    part: Mapping[str, Any],
    definitions: Mapping[str, Any],
    path: tuple[str, ...],
    seen: tuple[str, ...],
) -> Iterator[KeyDescription]:
    """Yield the keys of a part of a schema, and of all tables within."""
    if (reference := part.get("$ref")) and reference not in seen:
        target = definitions[reference.removeprefix(_REFERENCE)]
        yield from _keys_of(target, definitions, path, (*seen, reference))
    for kind in ("anyOf", "oneOf", "allOf"):
        for each in part.get(kind, ()):
            yield from _keys_of(each, definitions, path, seen)
    if isinstance(items := part.get("items"), Mapping):
        yield from _keys_of(items, definitions, path, seen)
    if isinstance(values := part.get("additionalProperties"), Mapping):
        yield from _keys_of(values, definitions, (*path, "NAME"), seen)
    for name, value in part.get("properties", {}).items():
        inner = (*path, name)
        default = value.get("default")
        yield KeyDescription(
            ".".join(inner),
            _form(value),
            "" if default is None else json.dumps(default, ensure_ascii=False),
            value.get("description", ""),
        )
        yield from _keys_of(value, definitions, inner, seen)


def _form(part: Mapping[str, Any]) -> str:
    """Return the values that a schema allows in words; empty if it states none."""
    if choices := part.get("enum") or ([part["const"]] if "const" in part else ()):
        return ", ".join(json.dumps(each) for each in choices)
    if "$ref" in part:
        return "table"
    parts = [*part.get("anyOf", ()), *part.get("oneOf", ())]
    if parts:
        forms = [_form(each) for each in parts if each.get("type") != "null"]
        return " or ".join(dict.fromkeys(each for each in forms if each))
    kind = str(part.get("type", ""))
    limits = [f"{sign} {part[word]:g}" for word, sign in _LIMITS.items() if word in part]
    return " ".join([_TYPE_WORDS.get(kind, kind), *limits])
