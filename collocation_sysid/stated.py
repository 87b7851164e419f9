"""Classes that a user states, in Python or in a file: a field, what it takes and says, once each.

`stated` makes a frozen dataclass whose fields are converted as it is built; `key` gives a field its
conversion, and what a problem file may say in its place. A field without a conversion is checked
against that, wherever it comes from.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, replace
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
    tables : type, optional
        Where the file has [[tables]] of the key: the class that each of them states.
    """

    name: str
    form: Any
    read: Callable[[Any], Any] | None = None
    constant: str | None = None
    said: str | None = None
    default: Any = None
    tables: type | None = None


def as_given(value: Any) -> Any:
    """Where a field is converted as soon as more is known."""
    return value


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

    Where its `place` says what one is called, messages of either begin with that; else they name it
    by its `called`, or by the class.
    """
    check = getattr(kind, "__post_init__", lambda self: None)

    def convert(self: T) -> None:
        with located(where=getattr(self, "place", None)):
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


def _converted(field: Field[Any], owner: Any, value: Any) -> Any:
    """A value of a field; without a converter it is to be the default or what a file may say."""
    if (converter := field.metadata["converter"]) is not None:
        return converter(value)
    if value == field.default:
        return value
    try:
        return _adapter(field.metadata["form"]).validate_python(value)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        called = re.sub("(?<!^)(?=[A-Z])", " ", type(owner).__name__).lower()
        what, word = field.name, getattr(owner, "called", called)
        for part in fault["loc"]:
            if isinstance(value, Mapping) and part in value:
                what, value = f"{what}.{part}", value[part]
        whose = f"the {word} {owner.name!r}" if hasattr(owner, "name") else f"a {word}"
        of = what if hasattr(owner, "place") else f"{what} of {whose}"
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
            text = form.said or said.get(each.name, "")
            if form.tables is not None:
                word = f"{kind.__name__.lower()}.{form.name}"
                text = f"[[{word}]] tables: {text[:1].lower()}{text[1:]}"
            yield each.name, replace(form, said=text)
        elif form is not None:
            usual = ... if each.default is MISSING else each.default
            usual = usual if each.default_factory is MISSING else each.default_factory()
            default = None if type(None) in get_args(form) else usual
            read, text = each.metadata["read"], said.get(each.name)
            yield each.name, Key(each.name, form, read, None, text, default)


def tables_of(kind: type) -> Iterator[tuple[str, str, type]]:
    """The fields that [[tables]] of a problem file state: field, key, and class of a table."""
    for name, key in keys_of(kind):
        if key.tables is not None:
            yield name, key.name, key.tables


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
