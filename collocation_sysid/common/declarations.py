"""Declaration of classes that users state in Python or in a problem file.

`declaration` makes a frozen dataclass whose fields are converted and checked on construction;
`legend_handles` declares the conversion of a field and the form that it has in a problem file. A
field without a converter is checked against that form.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import Field, dataclass, field, fields
from functools import cache, partial
from typing import Any, TypeVar, dataclass_transform, get_args

from pydantic import TypeAdapter, ValidationError

from ..errors import InputError, located
from .validated_types import expected

T = TypeVar("T")
S = TypeVar("S")


@dataclass(frozen=True)
class Key:
    """Form of a field in a problem file.

    Attributes
    ----------
    name : str
        Name of the key.
    form : type
        Type of the value in the file; a form that allows None uses the default of the field.
    read : callable, optional
        Conversion from the value in the file to the field; for a file, from its path to times and
        values of a table.
    constant : str, optional
        For a key that names a file with a table: the field whose key states a constant instead.
    """

    name: str
    form: Any
    read: Callable[[Any], Any] | None = None
    constant: str | None = None


def identity(value: Any) -> Any:
    """Return the value unchanged; converter of fields that are converted later, with more
    information.
    """
    return value


def key(
    form: Any = None,
    *,
    converter: Callable[[S], T] | None = None,
    read: Callable[[Any], Any] | None = None,
    **field_options: Any,
) -> Any:
    """Return a dataclass field with a converter, which a problem file may state.

    Parameters
    ----------
    form : type or Key, optional
        Form in the file; a `Key` if its name differs from the field's. None: not a key of the file.
    converter : callable, optional
        Applied to values other than None.
    read : callable, optional
        Conversion from the value in the file to the field.
    **field_options
        See `dataclasses.field`.
    """
    return field(
        metadata={"converter": converter, "form": form, "read": read},
        **field_options,
    )


@dataclass_transform(
    frozen_default=True, eq_default=False, field_specifiers=(key, field)
)
def declaration(kind: type[T]) -> type[T]:
    """Return the class as a frozen dataclass that converts its fields before ``__post_init__``.

    Messages begin with the `description` of an instance if it has one; otherwise they contain its
    `description_name`,
    or the name of the class.
    """
    check = getattr(kind, "__post_init__", lambda self: None)

    def convert(self: T) -> None:
        with located(where=getattr(self, "description", None)):
            for name, converted in conversions.items():
                if (value := getattr(self, name)) is not None:
                    object.__setattr__(self, name, converted(self, value))
            check(self)

    setattr(kind, "__post_init__", convert)  # noqa: B010 (of a type of the user's)
    made: Any = dataclass(frozen=True, eq=False)(kind)
    conversions = {
        each.name: partial(_converted, each)
        for each in fields(made)
        if each.metadata.get("converter") or each.metadata.get("form")
    }
    return made


def _converted(field: Field[Any], instance: Any, value: Any) -> Any:
    """Return the converted value of a field; without a converter, the default or a value of its
    form.
    """
    if (converter := field.metadata["converter"]) is not None:
        return converter(value)
    if value == field.default:
        return value
    try:
        return _adapter(field.metadata["form"]).validate_python(value)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        called = re.sub("(?<!^)(?=[A-Z])", " ", type(instance).__name__).lower()
        what = field.name
        word = getattr(instance, "description_name", called)
        for part in fault["loc"]:
            if isinstance(value, Mapping) and part in value:
                what = f"{what}.{part}"
                value = value[part]
        whose = (
            f"the {word} {instance.name!r}"
            if hasattr(instance, "name")
            else f"a {word}"
        )
        of = what if hasattr(instance, "description") else f"{what} of {whose}"
        shown = f"{value:g}" if isinstance(value, float) else repr(value)
        choices = fault["type"] == "literal_error" and get_args(
            field.metadata["form"]
        )
        expectation = (
            f"one of {', '.join(choices)}" if choices else expected(fault)
        )
        raise InputError(f"{of} is {shown}; expected {expectation}") from error


@cache
def _adapter(form: Any) -> TypeAdapter[Any]:
    return TypeAdapter(form)


def keys_of(kind: type) -> Iterator[tuple[str, Key]]:
    """Yield the name of each field that a problem file may state, with its key."""
    for each in fields(kind):
        form = each.metadata.get("form")
        if isinstance(form, Key):
            yield each.name, form
        elif form is not None:
            yield each.name, Key(each.name, form, read=each.metadata["read"])


def attributes(kind: type) -> dict[str, tuple[str, str]]:
    """Return type and description of each documented field or option of a class, by name."""
    descriptions: dict[str, tuple[str, str]] = {}
    for base in reversed(kind.__mro__):
        text = inspect.cleandoc(base.__doc__ or "")
        section = re.split(
            "^(?:Attributes|Parameters)\n-+\n", text, maxsplit=1, flags=re.M
        )[-1]
        for names, form, text in re.findall(
            r"^(\w[\w, ]*) : (.*)\n((?: +.*(?:\n|$))+)", section, re.M
        ):
            descriptions |= dict.fromkeys(
                names.split(", "), (form, " ".join(text.split()))
            )
    return descriptions


def documented(kind: type) -> dict[str, str]:
    """Return the descriptions of the fields of a class, or of the options of a method, by name."""
    descriptions = attributes(kind)
    return {
        each.name: descriptions[each.name][1]
        for each in fields(kind)
        if each.name in descriptions
    }
