"""Serialisation of results: dataclasses to JSON and back.

A dataclass becomes an object of its fields and of the properties listed in its class attribute
``SERIALISED_PROPERTIES``; arrays become lists. JSON has neither NaN nor infinity: null is written
in their place,
and is read as NaN where a number is expected.
"""

from __future__ import annotations

import json
import types
from collections.abc import Mapping, Sequence
from dataclasses import Field, field, fields, is_dataclass
from enum import Enum
from functools import cache
from math import isfinite, nan
from typing import (
    Any,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np

T = TypeVar("T")


def optional() -> Any:
    """Return a dataclass field that is omitted from JSON if it is None; all other fields are
    written.
    """
    return field(default=None, metadata={"optional": True})


def content(value: Any) -> Any:
    """Return a value as plain objects that `json` can write; NaN and infinity become None."""
    if is_dataclass(value) and not isinstance(value, type):
        own = {f.name: getattr(value, f.name) for f in fields(value)}
        own |= {
            name: getattr(value, name)
            for name in getattr(value, "SERIALISED_PROPERTIES", ())
        }
        omitted = {
            f.name
            for f in fields(value)
            if _is_optional(f) and own[f.name] is None
        }
        return {
            name: content(each)
            for name, each in own.items()
            if name not in omitted
        }
    if isinstance(value, Mapping):
        return {key: content(each) for key, each in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return content(value.tolist())
    if isinstance(value, (list, tuple)):
        return [content(each) for each in value]
    if isinstance(value, Enum):
        return content(value.value)
    return None if isinstance(value, float) and not isfinite(value) else value


def as_json(value: Any) -> str:
    """Return a result as JSON text, see `content`."""
    return json.dumps(content(value), indent=1, allow_nan=False)


def copy_fields(kind: type[T], of: Any, **others: Any) -> T:
    """Return an instance of a dataclass with attributes copied by name from another object.

    Parameters
    ----------
    kind : type
        Dataclass to be created.
    of : object
        Has an attribute for each field that is not in `others`.
    **others
        Fields that are not copied.
    """
    names = (f.name for f in fields(kind) if f.name not in others)  # type: ignore[arg-type]
    return kind(**{name: getattr(of, name) for name in names}, **others)


def read(kind: Any, content: Any) -> Any:
    """Return a value of a given type from parsed JSON.

    Parameters
    ----------
    kind : type
        A dataclass, or the annotation of a field: numbers, texts, tuples, mappings, arrays.
    content : object
        Output of `json.load_object`; None is NaN where a number is expected.

    Raises
    ------
    TypeError, KeyError, ValueError
        If the content does not have that type.
    """
    if is_dataclass(kind):
        hints = _hints(kind)
        there = (
            f for f in fields(kind) if not _is_optional(f) or f.name in content
        )
        return kind(
            **{f.name: read(hints[f.name], content[f.name]) for f in there}
        )  # type: ignore
    origin = get_origin(kind)
    inner = get_args(kind)
    if origin in (Union, types.UnionType):
        (some,) = (each for each in inner if each is not type(None))
        return None if content is None else read(some, content)
    if origin is np.ndarray:
        return np.array(content, dtype=float)
    if origin is tuple:
        kinds = [inner[0]] * len(content) if inner[-1] is ... else inner
        return tuple(
            read(one, each) for one, each in zip(kinds, content, strict=True)
        )
    if origin in (dict, Mapping):
        return {key: read(inner[1], each) for key, each in content.items()}
    if origin is Sequence:
        return [read(inner[0], each) for each in content]
    wrong = origin is Literal and content not in inner
    wrong |= kind in (str, bool, int) and type(content) is not kind
    if kind is float:
        content = nan if content is None else content
        wrong = type(content) not in (int, float) or abs(content) == float(
            "inf"
        )
    if wrong:
        raise TypeError(f"found {str(content)[:40]!r}; expected {kind}")
    return float(content) if kind is float else content


def _is_optional(field: Field[Any]) -> bool:
    return "optional" in field.metadata


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)
