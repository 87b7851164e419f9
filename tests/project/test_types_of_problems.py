"""Types of what states a problem: no parameter or field accepts anything."""

from __future__ import annotations

import builtins
import inspect
import sys
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import numpy as np
import pytest

import collocation_sysid as cs

# Packages whose public classes and functions state a problem.
PACKAGES = ("fem", "recording", "model", "methods", "problem")
# Types that mention Any only inside NumPy's definition of them.
OF_NUMPY = ("ArrayLike", "NDArray")


class Opaque:
    """Stands for a type that only type checkers import."""

    def __class_getitem__(cls, item: object) -> type:
        return cls


class Names(dict[str, object]):
    """Names of a module; unknown ones and those of NumPy's types are opaque."""

    def __getitem__(self, name: str) -> object:
        if name in OF_NUMPY:
            return Opaque
        return super().__getitem__(name)

    def __missing__(self, name: str) -> object:
        return getattr(builtins, name, Opaque)


# Status is an enumeration, which nobody constructs.
PUBLIC = [
    name
    for name in cs.__all__
    if name != "Status"
    and f"{getattr(getattr(cs, name), '__module__', '')}.".startswith(
        tuple(f"collocation_sysid.{package}." for package in PACKAGES)
    )
]


def mentions_any(stated: object) -> bool:
    """Whether a type is Any, or one of its parts is."""
    if isinstance(stated, list | tuple):
        return any(mentions_any(each) for each in stated)
    if isinstance(stated, TypeVar) or get_origin(stated) is Literal:
        return False
    if get_origin(stated) is np.ndarray:
        return False
    if get_origin(stated) is Annotated:
        return mentions_any(get_args(stated)[0])
    return stated is Any or any(mentions_any(each) for each in get_args(stated))


def resolved(annotation: object, module: str) -> object:
    """Type that an annotation states; Any for a missing annotation."""
    if annotation is inspect.Parameter.empty:
        return Any
    if not isinstance(annotation, str):
        return annotation
    return eval(annotation, {}, Names(vars(sys.modules[module])))


def parameters(function: Callable[..., Any]) -> Iterator[tuple[str, object]]:
    """Names and types of the parameters of a function, class or method."""
    for each in inspect.signature(function).parameters.values():
        yield each.name, resolved(each.annotation, function.__module__)


def stated_types(public: Any) -> Iterator[tuple[str, object]]:
    """Names and types of all that a caller may state."""
    yield from parameters(public)
    if not inspect.isclass(public):
        return
    for name, each in inspect.getmembers(public, inspect.ismethod):
        if not name.startswith("_"):
            yield from ((f"{name}.{key}", t) for key, t in parameters(each))
    for field in fields(public) if is_dataclass(public) else ():
        converter = field.metadata.get("converter")
        if inspect.isfunction(converter):
            first, *_ = parameters(converter)
            yield f"converter of {field.name}", first[1]


@pytest.mark.parametrize("name", PUBLIC)
def test_no_constructor_of_a_problem_accepts_anything(name: str):
    stated = stated_types(getattr(cs, name))
    assert [key for key, each in stated if mentions_any(each)] == []


def test_the_types_that_are_found_include_those_of_parts():
    for stated in ("dict[str, Any]", "Callable[[Any], float]", "list[Any] | None"):
        assert mentions_any(resolved(stated, __name__))
    for stated in ("dict[str, object]", "Callable[..., float] | ArrayLike"):
        assert not mentions_any(resolved(stated, __name__))


def test_tables_of_the_problem_file_have_types():
    from collocation_sysid.problem.schema import ProblemFile
    from collocation_sysid.problem.validation_messages import table_models

    seen: set[type] = set()
    waiting: list[Any] = [ProblemFile]
    while waiting:
        table = waiting.pop()
        seen.add(table)
        for name, field in table.model_fields.items():
            assert not mentions_any(field.annotation), (table, name)
            waiting += set(table_models(field.annotation)) - seen
    assert len(seen) > 40
