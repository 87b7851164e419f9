"""Serialisation of results: dataclasses to JSON and back.

A dataclass becomes an object of its fields and of the properties listed in its class attribute
``SERIALISED_PROPERTIES``; arrays become lists. JSON has neither NaN nor infinity: null is written
in their place, and is read as NaN where a number is expected.
"""

from __future__ import annotations

import json
import types
from collections.abc import Mapping, Sequence
from dataclasses import Field, field, fields, is_dataclass
from enum import Enum
from functools import cache
from math import isfinite, nan
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

T = TypeVar("T")


def optional() -> Any:
    """Return a dataclass field with the default None that is omitted from JSON if it is None, as all
    fields of a class with ``OMITS_NONE``; all other fields are written, None as null.
    """
    return field(default=None, metadata={"optional": True})


def content(value: Any) -> Any:
    """Return a value as plain objects that `json` can write.

    Dataclasses and mappings become dictionaries (a dataclass with the properties in its
    ``SERIALISED_PROPERTIES``, without `optional` fields that are None), arrays, lists and tuples
    become lists, numpy scalars Python numbers, and enum members their values. NaN and infinity
    become None. All other values, also unknown objects, are returned as they are.
    """
    if is_dataclass(value) and not isinstance(value, type):
        own = {f.name: getattr(value, f.name) for f in fields(value)}
        own |= {name: getattr(value, name) for name in getattr(value, "SERIALISED_PROPERTIES", ())}
        omitted = {f.name for f in fields(value) if _is_optional(value, f) and own[f.name] is None}
        return {name: content(each) for name, each in own.items() if name not in omitted}
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
    """Return a result as JSON text with an indentation of one space, see `content`.

    Raises
    ------
    TypeError
        If the result contains an object that JSON cannot hold.
    """
    return json.dumps(content(value), indent=1, allow_nan=False)


def copy_fields(kind: type[T], of: Any, **others: Any) -> T:
    """Returns
    -------
    kind
        A new object; values are not copied but shared with `of`.

    Raises
    ------
    AttributeError
        If `of` lacks an attribute.
    """
    names = (f.name for f in fields(kind) if f.name not in others)  # type: ignore[arg-type]
    return kind(**{name: getattr(of, name) for name in names}, **others)


def read(kind: Any, content: Any) -> Any:
    """Return a value of a given type from parsed JSON, the inverse of `content`.

    Parameters
    ----------
    kind : type
        A dataclass, or the annotation of a field: float, int, bool, str, a Literal, a tuple, a
        Sequence (read as a list), a mapping, an array (of floats, null as NaN), or one of these "or
        None". Content for any other annotation is returned unchecked.
    content : object
        Output of `json.load`; None is NaN where a float is expected. Entries that the dataclass
        does not have are ignored; `optional` fields may be missing. Integers are accepted as
        floats, but neither truth values as numbers nor floats as integers; an infinite number is
        refused. Entries of arrays are only converted to floats: truth values and infinite ones
        pass.

    Raises
    ------
    TypeError, KeyError, ValueError
        If the content does not have that type, or a field is missing.
    """
    if is_dataclass(kind):
        hints = _hints(kind)
        there = (f for f in fields(kind) if not _is_optional(kind, f) or f.name in content)
        return kind(**{f.name: read(hints[f.name], content[f.name]) for f in there})  # type: ignore
    origin = get_origin(kind)
    inner = get_args(kind)
    if origin in (Union, types.UnionType):
        (some,) = (each for each in inner if each is not type(None))
        return None if content is None else read(some, content)
    if origin is np.ndarray:
        return np.array(content, dtype=float)
    if origin is tuple:
        kinds = [inner[0]] * len(content) if inner[-1] is ... else inner
        return tuple(read(one, each) for one, each in zip(kinds, content, strict=True))
    if origin in (dict, Mapping):
        return {key: read(inner[1], each) for key, each in content.items()}
    if origin is Sequence:
        return [read(inner[0], each) for each in content]
    wrong = origin is Literal and content not in inner
    wrong |= kind in (str, bool, int) and type(content) is not kind
    if kind is float:
        content = nan if content is None else content
        wrong = type(content) not in (int, float) or abs(content) == float("inf")
    if wrong:
        raise TypeError(f"found {str(content)[:40]!r}; expected {kind}")
    return float(content) if kind is float else content


def _is_optional(of: Any, field: Field[Any]) -> bool:
    return "optional" in field.metadata or hasattr(of, "OMITS_NONE")


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)
