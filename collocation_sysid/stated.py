"""Classes that a user states, in Python or in a file: a field, what it takes and says, once each.

`stated` makes a frozen dataclass whose fields are converted as it is built; `key` gives a field its
conversion, and what a problem file may say in its place. A field without a conversion is checked
against that, wherever it comes from.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import MISSING, Field, dataclass, field, fields
from functools import cache, partial
from typing import Any, TypeVar, dataclass_transform, get_args

from pydantic import TypeAdapter, ValidationError

from .checked import expected
from .errors import InputError, located

T = TypeVar("T")
S = TypeVar("S")


@dataclass(frozen=True)
class Key:
    """What a problem file may say of a field; what it is stands in the docstring of the class.

    Attributes
    ----------
    name : str
    form : type of what the file says; where it may be None, that is the field's own default
    read : callable, optional
        From what the file says to the field; from a file's path to times and values of a table.
    constant : str, optional
        Where the key names a file with such a table: the field whose key is a constant instead.
    said : str, optional
        What it is, where that is not what the field is.
    default : what is meant where the file says nothing; it has to say something without
    """

    name: str
    form: Any
    read: Callable[[Any], Any] | None = None
    constant: str | None = None
    said: str | None = None
    default: Any = None


def key(
    form: Any = None,
    *,
    converter: Callable[[S], T] | None = None,
    read: Callable[[Any], Any] | None = None,
    **field_options: Any,
) -> Any:
    """A field that is converted as its class is built, and that a file may state.

    Parameters
    ----------
    form : type, or Key where it has another name in the file
        The field is no key where there is none.
    converter : callable, optional
        From what a program gives; None is left as it is.
    read : callable, optional
        From what the file says to the field.
    **field_options
        As of `dataclasses.field`.
    """
    return field(metadata={"converter": converter, "form": form, "read": read}, **field_options)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(key, field))
def stated(kind: type[T]) -> type[T]:
    """A frozen dataclass whose fields are converted before ``__post_init__`` checks them.

    Where its `place` says what one is called, messages of either begin with that.
    """
    check = kind.__dict__.get("__post_init__", lambda self: None)

    def convert(self: T) -> None:
        with located(where=getattr(self, "place", None)):
            for name, converter in converters.items():
                if (value := getattr(self, name)) is not None:
                    object.__setattr__(self, name, converter(value))
            check(self)

    setattr(kind, "__post_init__", convert)  # noqa: B010 (of a type of the user's)
    made: Any = dataclass(frozen=True, eq=False)(kind)
    converters = {
        each.name: each.metadata["converter"] or partial(_checked, made, each)
        for each in fields(made)
        if each.metadata.get("converter") or each.metadata.get("form")
    }
    return made


def _checked(kind: type, field: Field[Any], value: Any) -> Any:
    """A value of a field, which is to be the default or what a file may say."""
    if value == field.default:
        return value
    try:
        return _adapter(field.metadata["form"]).validate_python(value)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        word = re.sub("(?<!^)(?=[A-Z])", " ", kind.__name__).lower()
        of = field.name if hasattr(kind, "place") else f"{field.name} of a {word}"
        shown = f"{value:g}" if isinstance(value, float) else repr(value)
        choices = fault["type"] == "literal_error" and get_args(field.metadata["form"])
        wanted = f"one of {', '.join(choices)}" if choices else expected(fault)
        raise InputError(f"{of} is {shown}; expected {wanted}") from error


@cache
def _adapter(form: Any) -> TypeAdapter[Any]:
    return TypeAdapter(form)


def keys_of(kind: type) -> Iterator[tuple[str, Key]]:
    """The names of fields that a problem file may state, and their keys."""
    said = documented(kind)
    for each in fields(kind):
        form = each.metadata.get("form")
        if isinstance(form, Key):
            yield each.name, form
        elif form is not None:
            usual = ... if each.default is MISSING else each.default
            default = None if type(None) in get_args(form) else usual
            read, text = each.metadata["read"], said.get(each.name)
            yield each.name, Key(each.name, form, read, None, text, default)


def attributes(kind: type) -> dict[str, tuple[str, str]]:
    """What the docstrings of a class say of each field or option: its type, and what it is."""
    said: dict[str, tuple[str, str]] = {}
    for base in reversed(kind.__mro__):
        text = inspect.cleandoc(base.__doc__ or "")
        section = re.split("^(?:Attributes|Parameters)\n-+\n", text, maxsplit=1, flags=re.M)[-1]
        for names, form, text in re.findall(
            r"^(\w[\w, ]*) : (.*)\n((?: +.*(?:\n|$))+)", section, re.M
        ):
            said |= dict.fromkeys(names.split(", "), (form, " ".join(text.split())))
    return said


def documented(kind: type) -> dict[str, str]:
    """Descriptions of the fields of a class, or of the options of a method, by name."""
    said = attributes(kind)
    return {each.name: said[each.name][1] for each in fields(kind) if each.name in said}
