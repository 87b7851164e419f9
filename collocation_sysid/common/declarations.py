"""Declaration of classes that users state in Python or in a problem file.

`declaration` makes a frozen dataclass whose fields are converted and checked on construction; `key`
declares the conversion of a field and the form that it has in a problem file. A field without a
converter is checked against that form.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import Field, dataclass, field, fields
from functools import cache, partial
from typing import Any, TypeVar, dataclass_transform, get_args

from pydantic import TypeAdapter, ValidationError

from ..errors import InputError, located
from .validated_types import expected, faulty_entry

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
        Conversion from the value in the file to the field; None: the value itself. For a key that
        names a file, from its path to times and values of a table.
    constant : str, optional
        For a key that names a file with a table: the field whose key states a constant instead;
        None for all other keys.
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
    metadata: Mapping[str, Any] | None = None,
    **field_options: Any,
) -> Any:
    """Return a dataclass field with a converter, which a problem file may state.

    Parameters
    ----------
    form : type or Key, optional
        Form in the file; a `Key` if its name differs from the field's. None: not a key of the file.
    converter : callable, optional
        Applied on construction to values other than None. None: the value is checked against `form`
        if there is one, and otherwise kept as it is.
    read : callable, optional
        Conversion from the value in the file to the field; a `Key` as `form` has its own instead.
    metadata : mapping, optional
        Further metadata of the field, such as `time_dependence.over_time()`.
    **field_options
        See `dataclasses.field`.
    """
    own = {"converter": converter, "form": form, "read": read}
    return field(metadata={**own, **(metadata or {})}, **field_options)


@dataclass_transform(
    frozen_default=True, eq_default=False, field_specifiers=(key, field)
)
def declaration(kind: type[T]) -> type[T]:
    """Return the class as a frozen dataclass, compared by identity, that converts its fields before
    ``__post_init__``.

    On construction, each field other than None is replaced by its converted value (see `key`), then
    the class's own ``__post_init__`` is called. The location of `InputError`s is the `description`
    of the instance if it has one; otherwise messages name its `description_name` or, by default,
    the class.

    Raises
    ------
    InputError
        On construction of an instance, if a value does not have the form of its field.
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
    """Return the value of a field by its converter; without one, the value if it equals the default
    or, validated, if it has the field's form.

    Raises
    ------
    InputError
        If it does not have the form; converters raise their own errors.
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
        word = getattr(instance, "description_name", called)
        what, value = faulty_entry(field.name, value, fault=fault)
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
    """Return the validator of a form, cached."""
    return TypeAdapter(form)


def keys_of(kind: type) -> Iterator[tuple[str, Key]]:
    """Yield the name of each field that a problem file may state with its key, in the order of the
    fields.
    """
    for each in fields(kind):
        form = each.metadata.get("form")
        if isinstance(form, Key):
            yield each.name, form
        elif form is not None:
            yield each.name, Key(each.name, form, read=each.metadata["read"])
