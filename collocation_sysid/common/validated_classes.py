"""Declaration of classes whose values are validated: `validated`.

A validated class is a frozen dataclass with one annotation for each field, from which pydantic
makes the validator of the class, the JSON schema, and the validators of classes that contain it. A
value is validated once, where the instance is made: in Python, or from the table of a file.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cache, wraps
from types import MappingProxyType
from typing import Any, TypeVar, dataclass_transform, overload

from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic_core import ArgsKwargs

from ..errors import InputError
from .field_descriptions import attributes
from .validated_types import expectation, faulty_entry

T = TypeVar("T")

# Function that returns the error for invalid arguments of a constructor: of the instance with these
# arguments, and of the first entry of pydantic's `ValidationError.errors()`. Its location begins
# with the name of a field; it is empty for an error of `__post_init__`, which the entry contains.
Refusal = Callable[[Any, Mapping[str, Any]], Exception]
_CONFIGURATION = ConfigDict(extra="forbid", arbitrary_types_allowed=True, validate_default=True)


@overload
def validated(kind: type[T], /) -> type[T]: ...
@overload
def validated(*, kw_only: bool = False) -> Callable[[type[T]], type[T]]: ...
@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def validated(
    kind: type[T] | None = None, /, *, kw_only: bool = False
) -> type[T] | Callable[[type[T]], type[T]]:
    """Return the class as a frozen dataclass with validated fields, or without a class the
    decorator that does so.

    On construction, in Python or from a table of a file, every value is validated against the
    annotation of its field, and replaced by the validated value. Then the class's own
    ``__post_init__`` is called, which raises an `InputError` for values that exclude each other.
    Unknown names are refused. The section "Attributes" of the docstring describes the fields in the
    JSON schema.

    Parameters
    ----------
    kind : type, optional
        Class with annotated fields.
    kw_only : bool
        Whether all fields are keyword arguments.

    Raises
    ------
    InputError
        On construction in Python, if a value does not have the type of its field; its location is
        the name of the field.
    """

    def declared(kind: type[T]) -> type[T]:
        """Return the class as a frozen dataclass with validated fields."""
        made: Any = dataclass(frozen=True, kw_only=kw_only)(kind)
        _describe_fields(made)
        validate_arguments(made, _key_refusal)
        return made

    return declared if kind is None else declared(kind)


def _describe_fields(kind: Any) -> None:
    """Add the descriptions of the fields of a dataclass to their metadata, in place, from which
    pydantic takes them.
    """
    descriptions = attributes(kind)
    for each in fields(kind):
        if each.name in descriptions:
            _, text = descriptions[each.name]
            each.metadata = MappingProxyType({**each.metadata, "description": text})


def validate_arguments(kind: Any, refusal: Refusal) -> None:
    """Replace the constructor of a dataclass, in place, by one that validates the arguments.

    Each argument is validated against the `type` of its field, then ``__post_init__`` is called.

    Parameters
    ----------
    kind : type
        Dataclass.
    refusal : callable
        Function that returns the error for an invalid argument or an error of ``__post_init__``,
        see `Refusal`.
    """
    assign = kind.__init__

    @wraps(assign)
    def construct(self: Any, *arguments: Any, **by_name: Any) -> None:
        """Validate the arguments, assign them, and call ``__post_init__``."""
        try:
            _validator(kind).validate_python(ArgsKwargs(arguments, by_name), self_instance=self)
            return
        except ValidationError as error:
            fault = error.errors(include_url=False)[0]
        # Outside of the handler, so that the error is shown alone.
        bound = _bind_arguments(kind, arguments, by_name)
        vars(self).update(bound | vars(self))
        if fault["loc"] and isinstance(fault["loc"][0], int):
            names = [*bound][fault["loc"][0]], *fault["loc"][1:]
            fault["loc"] = names
        raise refusal(self, fault)

    kind.__pydantic_config__ = _CONFIGURATION
    kind.__init__ = construct


def _bind_arguments(
    kind: Any, arguments: tuple[Any, ...], by_name: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the arguments of the constructor of a class by the names of its fields."""
    try:
        return inspect.signature(kind).bind(*arguments, **by_name).arguments
    except TypeError as error:
        message = str(error)
    others = [
        f"{kind.__name__}.{name}"
        for name in dir(kind)
        if name.startswith("from_") and isinstance(inspect.getattr_static(kind, name), classmethod)
    ]
    hint = f"; other constructors: {', '.join(others)}" if others else ""
    raise TypeError(f"{kind.__name__}: {message}{hint}")


@cache
def _validator(kind: type) -> Any:
    """Return pydantic's validator of a class, cached."""
    return TypeAdapter(kind).validator


def _key_refusal(instance: Any, fault: Mapping[str, Any]) -> Exception:
    """Return the error of ``__post_init__``; or an `InputError` whose location is the name of the
    invalid field, and of the entry if the value is a table. See `Refusal` for the arguments.
    """
    if not fault["loc"]:
        return fault["ctx"]["error"]
    where, value = faulty_entry(instance, fault)
    if fault["type"] == "value_error":
        return InputError(str(fault["ctx"]["error"]), None, where=where)
    return InputError(f"found {value!r}; {expectation([fault], value)}", None, where=where)
