"""Declaration of classes that users state in Python or in a problem file.

`declaration` makes a frozen dataclass whose fields are converted and checked on construction; `key`
declares the conversion of a field and the form that it has in a problem file. A field without a
converter is checked against that form.
"""

from __future__ import annotations

import inspect
import re
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields
from functools import wraps
from typing import Annotated, Any, TypeVar, cast, dataclass_transform, get_args, get_origin

import numpy as np
from pydantic import PlainValidator, ValidatorFunctionWrapHandler, WrapValidator

from ..errors import InputError
from .validated_classes import form_of, refused, validate_arguments
from .validated_types import Finite

T = TypeVar("T")
S = TypeVar("S")


@dataclass(frozen=True)
class Key:
    """Form of a field in a problem file."""

    name: str
    # Type of the value in the file; a form that allows None uses the default of the field.
    form: Any
    # Conversion from the value in the file to the field; None: the value itself. For a key that
    # names a file, from its path to times and values of a table.
    read: Callable[..., Any] | None = None
    # For a key that names a file with a table: the field whose key states a constant instead; None
    # for all other keys.
    constant: str | None = None
    description: str = ""  # meaning of a key whose name differs from the field's; "" for all others


def identity(value: T) -> T:
    """Return the value unchanged; converter, for type checkers alone, of fields that are converted
    later, with more information. Their values are validated against their annotation.
    """
    return value


def identity_or_none(value: Any) -> Any:
    """Return the value unchanged, like `identity`; of fields that may be None until they are set
    with more information.
    """
    return value


UNCHANGED = (identity, identity_or_none)


def key(
    form: Any = None,
    *,
    converter: Callable[[S], T] | None = None,
    read: Callable[..., Any] | None = None,
    accepted: Any = None,
    metadata: Mapping[str, Any] | None = None,
    **field_options: Any,
) -> Any:
    """Return a dataclass field with a converter, which a problem file may state.

    Parameters
    ----------
    form : type or Key, optional
        Form in the file; a `Key` if its name differs from the field's. None: not a key of the file.
    converter : callable, optional
        Applied on construction to values other than None. None: the value is validated against
        `form` if there is one, and otherwise kept as it is.
    read : callable, optional
        Conversion from the value in the file to the field; a `Key` as `form` has its own instead.
    accepted : type, optional
        Form of the value in Python, where it differs from `form`; a converter is then one for type
        checkers alone.
    metadata : mapping, optional
        Further metadata of the field, such as `time_dependence.over_time()`.
    **field_options
        See `dataclasses.field`.
    """
    own = {"converter": converter, "form": form, "read": read, "accepted": accepted}
    return field(metadata={**own, **(metadata or {})}, **field_options)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(key, field))
def declaration(kind: type[T]) -> type[T]:
    """Return the class as a frozen dataclass, compared by identity, whose fields are converted and
    validated before ``__post_init__``.

    On construction, each field other than None is replaced by its converted or validated value (see
    `key`), then the class's own ``__post_init__`` is called. The location of `InputError`s is the
    `description` of the instance if it has one; otherwise messages name its `description_name` or,
    by default, the class.

    Raises
    ------
    InputError
        On construction of an instance, if a value does not have the form of its field.
    """
    made: Any = dataclass(frozen=True, eq=False)(kind)
    assign = made.__init__

    @wraps(assign)
    def construct(self: Any, *arguments: Any, **by_name: Any) -> None:
        try:
            assign(self, *arguments, **by_name)
        except InputError as error:
            raise error.located(where=getattr(self, "description", None)) from error.__cause__

    made.__init__ = construct
    return validate_arguments(made, lambda: _forms(made), _refusal)


def _forms(kind: type) -> dict[str, Any]:
    """Return the forms of all fields; their annotations are texts in the classes' modules."""
    owners = {n: base for base in reversed(kind.__mro__) for n in inspect.get_annotations(base)}
    modules = {name: vars(sys.modules[owner.__module__]) for name, owner in owners.items()}
    return {each.name: _form(each, modules[each.name]) for each in fields(kind)}


def _form(field: Field[Any], names: Mapping[str, Any]) -> Any:
    """Return the form of a field, see `key`, else of its annotation; the default is accepted."""
    # The converters ``tuple[X, ...]`` and ``dict[K, V]`` stand for that form of their annotation;
    # type checkers then accept all iterables or mappings.
    is_optional = field.default is None or str(field.type).endswith("| None")
    if (converter := _converter(field)) is not None:
        return Annotated[
            Any,
            PlainValidator(
                lambda value: value if value is None and is_optional else converter(value)
            ),
        ]
    form = field.metadata.get("accepted") or field.metadata.get("form")
    if form is None or isinstance(form, Key) or field.metadata.get("converter") in UNCHANGED:
        form = form_of(field.type, names)
        is_number = field.type in ("float", "float | None") and field.default is not MISSING
        if is_number and np.isfinite(cast(Any, field.default) or 0.0):
            form = Finite
    if form is None:
        return None

    def unless_default(value: Any, validated: ValidatorFunctionWrapHandler) -> Any:
        if value is None and not is_optional and types.NoneType in get_args(form):
            return field.default  # as for a key that is not stated
        is_default = type(value) is type(field.default)
        if (value is None and is_optional) or (is_default and value == field.default):
            return value
        return validated(value)

    return Annotated[form, WrapValidator(unless_default)]


def _converter(field: Field[Any]) -> Callable[[Any], Any] | None:
    converter, accepted = (field.metadata.get(name) for name in ("converter", "accepted"))
    is_form = accepted or get_origin(converter) in (tuple, dict) or converter in UNCHANGED
    return None if is_form else converter


def _refusal(
    arguments: Mapping[str, Any], name: str, part: str, found: Any, faults: Any
) -> Exception:
    """Return the error of a converter, or one that names the object and the invalid field."""
    instance = arguments["self"]
    vars(instance).update({n: value for n, value in arguments.items() if n != "self"})
    if _converter(type(instance).__dataclass_fields__[name]):
        error = faults[0]["ctx"]["error"]
    else:
        called = re.sub("(?<!^)(?=[A-Z])", " ", type(instance).__name__).lower()
        word = getattr(instance, "description_name", called)
        whose = f"the {word} {instance.name!r}" if hasattr(instance, "name") else f"a {word}"
        of = "" if hasattr(instance, "description") else f" of {whose}"
        error = refused(f"{name}{part}{of} is", found, faults)
    where = getattr(instance, "description", None)
    return error.located(where=where) if where and isinstance(error, InputError) else error


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
