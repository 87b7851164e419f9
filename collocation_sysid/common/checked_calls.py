"""Validation of the arguments of public functions and classes against their annotations: `checked`.

`form_of` makes the validated form of an annotation; declared fields without a form of their own use
it, too (`declarations`).
"""

from __future__ import annotations

import inspect
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, reduce, wraps
from operator import or_
from typing import Annotated, Any, Literal, TypeVar, Union, cast, get_args, get_origin

import numpy as np
from pydantic import BeforeValidator, InstanceOf, Strict, TypeAdapter, ValidationError

from ..errors import InputError
from .validated_types import Flag, Number, StrictInteger, expectation

C = TypeVar("C", bound=Callable[..., Any])
_PLAIN = {float: Number, int: StrictInteger, bool: Flag, str: Annotated[str, Strict()]}


def checked(called: C) -> C:
    """Return a function, or a dataclass, whose arguments are validated against their annotations.

    Arguments that equal their default, and those whose annotation has no form (see `form_of`), such
    as arrays, are passed as they are.

    Raises
    ------
    InputError
        In a call, for the first argument that does not have its form.
    """
    is_class = isinstance(called, type)
    function: Any = called.__init__ if is_class else called
    signature = inspect.signature(function)
    title = called.__qualname__.removesuffix(".__init__")

    @cache
    def validators() -> dict[str, TypeAdapter[Any]]:
        names = vars(sys.modules[called.__module__])
        stated = {
            n: p.annotation for n, p in signature.parameters.items() if p.annotation is not p.empty
        }
        forms = {name: form_of(annotation, names) for name, annotation in stated.items()}
        return {name: TypeAdapter(form) for name, form in forms.items() if form is not None}

    @wraps(function)
    def call(*arguments: Any, **by_name: Any) -> Any:
        try:
            bound = signature.bind(*arguments, **by_name)
        except TypeError as error:
            raise TypeError(f"{title}: {error}") from None
        own_name = bound.arguments.get("name")
        who = f"{title} {own_name!r}" if own_name and isinstance(own_name, str) else title
        for name, validator in validators().items():
            value = bound.arguments.get(name, signature.parameters[name].default)
            if value is not signature.parameters[name].default:
                bound.arguments[name] = _converted(value, validator, f"{who}: {name}")
        return function(*bound.args, **bound.kwargs)

    if is_class:
        called.__init__ = call  # pyright: ignore[reportAttributeAccessIssue]
    return called if is_class else call  # pyright: ignore[reportReturnType]


def form_of(annotation: Any, names: Mapping[str, Any]) -> Any:
    """Return the form, for pydantic, of values with an annotation; None if all values are accepted.

    Numbers are finite or infinite, classes accept their instances, and sequences a single object
    in place of a list of one. Protocols, arrays and names that are known only to type checkers have
    no form, nor has a union that contains one of these.

    Parameters
    ----------
    annotation : str or type
        If it is a text, it is evaluated.
    names : mapping
        Names that may occur in the text.
    """
    if isinstance(annotation, str):
        try:
            annotation = eval(annotation, dict(names))
        except (NameError, TypeError):
            return None
    if isinstance(annotation, TypeVar):
        return form_of(annotation.__bound__, names)
    origin, parts = get_origin(annotation), get_args(annotation)
    if annotation is None or annotation is types.NoneType or origin in (Annotated, Literal):
        return annotation
    if origin in (Union, types.UnionType):
        forms = [form_of(part, names) for part in parts if part is not types.NoneType]
        if any(form is None for form in forms):
            return None
        return reduce(or_, forms + [None] * (len(forms) < len(parts)))
    if origin is Callable:
        return annotation
    if origin in (tuple, Sequence):
        entries = [part if part is ... else form_of(part, names) for part in parts]
        if any(entry is None for entry in entries):
            return None
        entries += [...] * (origin is Sequence)
        return Annotated[tuple[*entries], BeforeValidator(_listed)]
    if not isinstance(annotation, type) or origin or getattr(annotation, "_is_protocol", False):
        return None
    return _PLAIN.get(annotation, InstanceOf[annotation])


def _listed(value: Any) -> Any:
    """Return a single object as a list of one, and other containers than tables as a tuple."""
    if isinstance(value, str) or not isinstance(value, Iterable):
        return (value,)
    is_list = not isinstance(value, Mapping | bytes) and np.ndim(cast(Any, value)) == 1
    return tuple(value) if is_list else value


def validate_as(annotation: Any, value: Any, name: str) -> Any:
    """Return a value as validated against an annotation that has a form, see `form_of`; raise an
    `InputError` about `name` if it is refused.
    """
    return _converted(value, _validator(annotation), name)


@cache
def _validator(annotation: Any) -> TypeAdapter[Any]:
    return TypeAdapter(form_of(annotation, {}))


def _converted(value: Any, validator: TypeAdapter[Any], name: str) -> Any:
    try:
        return validator.validate_python(value)
    except ValidationError as error:
        faults = error.errors(include_url=False)
    what = name + "".join(f"[{k}]" for k in faults[0]["loc"] if isinstance(k, int))
    raise refused(what, faults[0]["input"], faults)


def refused(what: str, found: Any, faults: Sequence[Mapping[str, Any]]) -> InputError:
    """Return the error about a value, `what`, that was `found`, from entries of pydantic's
    `ValidationError.errors()`, one for each form that would be accepted.
    """
    shown = f"{found:g}" if isinstance(found, float) else repr(found)
    shown = shown if len(shown) < 80 else f"a {type(found).__name__}"
    return InputError(f"{what} is {shown}; {expectation(faults, found)}")
