"""Validation of the arguments of public functions and of constructors: `validated`.

Each argument is validated by itself, in the order of the signature, against a form: a type for
pydantic. `form_of` makes the form of a plain annotation; the fields of a `declaration` have forms of
their own.
"""

from __future__ import annotations

import inspect
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import cache, reduce, wraps
from operator import or_
from types import MappingProxyType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    cast,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
    overload,
)

import numpy as np
from numpy.typing import ArrayLike
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    GetPydanticSchema,
    Strict,
    TypeAdapter,
    ValidationError,
)
from pydantic_core import core_schema

from ..errors import InputError
from .array_types import Index
from .checked_arrays import require_indices, require_numbers
from .field_descriptions import attributes
from .validated_types import Flag, Number, StrictInteger, expectation

C = TypeVar("C", bound=Callable[..., Any])
# Error about an invalid value: from all arguments, the name of the invalid one, the place in it
# (".key" of a table, "[index]" of a list, or ""), the value there, and the faults, which are entries
# of pydantic's `ValidationError.errors()`, one for each form that would be accepted.
Refusal = Callable[[Mapping[str, Any], str, str, Any, Sequence[Mapping[str, Any]]], Exception]
# Characters of a value that a representation shows.
LONGEST_VALUE = 60
_CONFIGURATION = ConfigDict(extra="forbid", arbitrary_types_allowed=True, validate_default=True)
_PLAIN = {float: Number, int: StrictInteger, bool: Flag, str: Annotated[str, Strict()]}
_ARRAY = Annotated[Any, AfterValidator(require_numbers)]
_INDICES = Annotated[Any, AfterValidator(require_indices)]
# Unlike `pydantic.InstanceOf`, it asks for no schema of the class.
_INSTANCE = GetPydanticSchema(lambda kind, _: core_schema.is_instance_schema(kind))


@overload
def validated(called: C, /) -> C: ...
@overload
def validated(*, kw_only: bool = False) -> Callable[[C], C]: ...
@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def validated(called: Any = None, /, *, kw_only: bool = False) -> Any:
    """Return a function or class whose arguments are validated against their annotations; without
    arguments other than `kw_only`, the decorator that does so.

    A class without constructor becomes a frozen dataclass of options: values, also the defaults, are
    replaced by the validated ones, the section "Attributes" of the docstring describes the fields in
    the JSON schema, tables of a file can be validated as the class, and errors are located at the
    name of the field. A function, or a class that has a constructor, accepts its defaults as they
    are, and values whose annotation has no form (see `form_of`), such as protocols.

    Parameters
    ----------
    called : callable
        Function, dataclass, or class with annotated fields.
    kw_only : bool
        Whether all fields of options are keyword arguments.

    Raises
    ------
    InputError
        In a call, for the first argument that does not have its form.
    """
    if called is None:
        return lambda kind: _options(kind, kw_only)
    if isinstance(called, type) and "__init__" not in vars(called):
        return _options(called, kw_only)

    def forms() -> dict[str, Any]:
        names = vars(sys.modules[called.__module__])
        function = called.__init__ if isinstance(called, type) else called
        stated = inspect.get_annotations(inspect.unwrap(function))
        return {name: form_of(annotation, names) for name, annotation in stated.items()}

    def refusal(arguments: Any, name: str, part: str, found: Any, faults: Any) -> InputError:
        own = arguments.get("name")
        who = f"{title} {own!r}" if isinstance(own, str) and own else title
        return refused(f"{who}: {name}{part} is", found, faults)

    title = _title(called)
    return validate_arguments(called, forms, refusal, accepts_defaults=True)


def _options(kind: Any, kw_only: bool) -> Any:
    made: Any = dataclass(frozen=True, kw_only=kw_only)(kind)
    made.__pydantic_config__ = _CONFIGURATION
    descriptions = attributes(made)
    for each in fields(made):
        if each.name in descriptions:  # pydantic takes it from the metadata
            _, text = descriptions[each.name]
            each.metadata = MappingProxyType({**each.metadata, "description": text})

    def refusal(_: Any, name: str, part: str, found: Any, faults: Any) -> InputError:
        where = name + part.partition("[")[0]
        if faults[0]["type"] == "value_error":
            return InputError(str(faults[0]["ctx"]["error"]), where=where)
        return InputError(f"found {found!r}; {expectation(faults, found)}", where=where)

    return validate_arguments(made, lambda: get_type_hints(made, include_extras=True), refusal)


def validate_arguments(
    called: Any, forms: Callable[[], Mapping[str, Any]], refusal: Refusal, accepts_defaults=False
) -> Any:
    """Return a function, or a dataclass with a constructor, that validates its arguments.

    Parameters
    ----------
    called : callable
        Function or dataclass; the constructor of a dataclass is replaced.
    forms : callable
        Function that returns the forms of the arguments by name in the first call; arguments without
        a form, or with None, are not validated.
    refusal : Refusal
        Error about an invalid argument.
    accepts_defaults : bool
        Whether values that are the default of their argument are passed as they are; a default of
        None always is.
    """
    is_class = isinstance(called, type)
    function: Any = called.__init__ if is_class else called
    signature = inspect.signature(function)
    stated_fields = fields(called) if is_dataclass(called) else ()
    made = {each.name for each in stated_fields if each.default_factory is not MISSING}

    def made_forms() -> list[tuple[str, Any, Any]]:
        stated = {n: f for n, f in forms().items() if n in signature.parameters and f is not None}
        return [
            (n, signature.parameters[n].default, _of_all(f, signature.parameters[n]))
            for n, f in stated.items()
        ]

    kept_forms = _Kept(made_forms)

    @wraps(function)
    def call(*arguments: Any, **by_name: Any) -> Any:
        try:
            bound = signature.bind(*arguments, **by_name)
        except TypeError as error:
            raise TypeError(f"{_title(called)}: {error}{_other_constructors(called)}") from None
        stated = bound.arguments
        for name, default, form in kept_forms():
            value = stated.get(name, default)
            is_accepted = value is default and (accepts_defaults or default is None)
            if is_accepted or (name in made and name not in stated):
                continue
            try:
                stated[name] = _validator(form).validate_python(value)
                continue
            except ValidationError as error:
                faults = error.errors(include_url=False)
            # Outside of the handler, so that the error is shown alone.
            raise refusal(stated, name, *_deepest(value, faults))
        return function(*bound.args, **bound.kwargs)

    if is_class:
        called.__init__ = call
        if stated_fields and hasattr(called.__repr__, "__wrapped__"):  # that of `dataclass`
            called.__repr__ = _one_line  # type: ignore[method-assign]
    return called if is_class else call


def _one_line(self: Any) -> str:
    """Return a class with its fields that differ from their defaults, arrays by their shapes."""
    shown = []
    for each in fields(self):
        value = getattr(self, each.name)
        default = each.default
        if default is MISSING and each.default_factory is not MISSING:
            default = each.default_factory()
        if isinstance(value, np.ndarray):
            text = f"array of shape {value.shape}"
        elif not each.repr or value is default or repr(value) == repr(default):
            continue
        else:
            text = " ".join(repr(value).split())
        shown.append(
            f"{each.name}={text if len(text) <= LONGEST_VALUE else text[:LONGEST_VALUE] + '…'}"
        )
    return f"{type(self).__name__}({', '.join(shown)})"


def _of_all(form: Any, parameter: inspect.Parameter) -> Any:
    """Return the form of all arguments of a parameter, of ``*name`` and ``**name`` several."""
    several = {parameter.VAR_POSITIONAL: tuple[form, ...], parameter.VAR_KEYWORD: dict[str, form]}
    return several.get(parameter.kind, form)


class _Kept:
    """Function that keeps its value, made anew in another process: classes of a user's script."""

    def __init__(self, compute: Callable[[], Any]) -> None:
        self._compute = compute
        self._value: Any = None

    def __call__(self) -> Any:
        if self._value is None:
            self._value = self._compute()
        return self._value

    def __reduce__(self) -> Any:
        return _Kept, (self._compute,)


def _title(called: Any) -> str:
    return called.__qualname__.removesuffix(".__init__")


def _other_constructors(called: Any) -> str:
    others = [*getattr(called, "OTHER_CONSTRUCTORS", ())]
    others += [
        f"{called.__name__}.{name}"
        for name in dir(called)
        if name.startswith("from_")
        and isinstance(inspect.getattr_static(called, name), classmethod)
    ]
    return f"; other constructors: {', '.join(others)}" if others else ""


def form_of(annotation: Any, names: Mapping[str, Any]) -> Any:
    """Return the form, for pydantic, of values with an annotation; None if all values are accepted.

    Numbers are finite or infinite, classes accept their instances, arrays all numbers, and
    sequences a single object in place of a list of one. Protocols and names that are known only to
    type checkers have no form, nor has a union that contains one of these.

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
    if annotation is ArrayLike:
        return _ARRAY
    if origin is np.ndarray:
        return _INDICES if annotation == Index else _ARRAY
    if origin in (Union, types.UnionType):
        stated = [part for part in parts if part is not types.NoneType]
        of_arrays = {*get_args(ArrayLike)} if {*get_args(ArrayLike)} <= {*stated} else set()
        others = [e for e in stated if e not in of_arrays and get_origin(e) is not np.ndarray]
        arrays = [e for e in stated if e not in others]
        array = _INDICES if arrays == [Index] else _ARRAY
        has_array = bool(arrays)
        # A sequence of numbers is an array, too.
        stated = [e for e in others if not (has_array and e == Sequence[float])]
        forms = [form_of(part, names) for part in stated] + [array] * has_array
        if any(form is None for form in forms):
            return None
        return reduce(or_, forms + [None] * (types.NoneType in parts))
    if origin is Mapping:
        key, value = (form_of(part, names) or Any for part in parts)
        return dict[key, value]
    if origin is Callable:
        return annotation
    if origin in (tuple, Sequence):
        entries = [part if part is ... else form_of(part, names) for part in parts]
        if any(entry is None for entry in entries):
            return None
        entries += [...] * (origin is Sequence)
        return Annotated[tuple[*entries], BeforeValidator(_listed)]
    if getattr(annotation, "_is_protocol", False) and "__call__" in vars(annotation):
        return Callable[..., Any]
    if not isinstance(annotation, type) or origin or getattr(annotation, "_is_protocol", False):
        return None
    return _PLAIN.get(annotation, Annotated[annotation, _INSTANCE])


def _listed(value: Any) -> Any:
    """Return a single object as a list of one, and other containers than tables as a tuple."""
    if _is_single(value):
        return (value,)
    if isinstance(value, list | tuple):
        return tuple(value)
    is_list = not isinstance(value, Mapping | bytes) and np.ndim(cast(Any, value)) == 1
    return tuple(value) if is_list else value


def _is_single(value: Any) -> bool:
    return isinstance(value, str) or not isinstance(value, Iterable)


def validate_as(annotation: Any, value: Any, name: str) -> Any:
    """Return a value as validated against an annotation that has a form, see `form_of`; raise an
    `InputError` about `name` if it is refused.
    """
    try:
        return _validator_of(annotation).validate_python(value)
    except ValidationError as error:
        faults = error.errors(include_url=False)
    part, found, faults = _deepest(value, faults)
    raise refused(f"{name}{part} is", found, faults)


@cache
def _validator(form: Any) -> TypeAdapter[Any]:
    return TypeAdapter(form)


@cache  # forms that are made of the same annotation differ
def _validator_of(annotation: Any) -> TypeAdapter[Any]:
    return _validator(form_of(annotation, {}))


def _deepest(value: Any, faults: Sequence[Any]) -> tuple[str, Any, Sequence[Any]]:
    """Return the deepest place at fault in a value, what was found there, and its faults."""
    parts = [_part_at_fault(value, fault) for fault in faults]
    part, found = max(parts, key=lambda each: len(each[0]))
    return part, found, [f for f, each in zip(faults, parts, strict=True) if each[0] == part]


def _part_at_fault(value: Any, fault: Mapping[str, Any]) -> tuple[str, Any]:
    """Return the place in a value that is at fault, see `Refusal`, and what was found there."""
    part = ""
    for each in fault["loc"]:
        if isinstance(value, Mapping) and each in value:
            part += f".{each}"
            value = value[each]
        elif isinstance(each, int) and not _is_single(value):
            part += f"[{each}]"
    return part, fault["input"]


def refused(what: str, found: Any, faults: Sequence[Mapping[str, Any]]) -> InputError:
    """Return the error about a value: "what found; expected …", see `Refusal` for the arguments."""
    shown = f"{found:g}" if isinstance(found, float) else repr(found)
    shown = shown if len(shown) < 80 else f"a {type(found).__name__}"
    return InputError(f"{what} {shown}; {expectation(faults, found)}")
