"""What the tables of the problem file are made of: checked numbers, and sections."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_type_hints

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    GetCoreSchemaHandler,
    Tag,
    create_model,
    model_validator,
)

from .checked import Boundless, Finite
from .errors import located
from .stated import Key, attributes, documented, keys_of

Vector = tuple[Finite, Finite, Finite]
Corner = tuple[Boundless, Boundless, Boundless]
Unit = Literal["m", "cm", "mm", "in"]


@dataclass(frozen=True)
class ByForm:
    """Which of its two forms a key takes: a value of these types is of the first.

    A tag in <> tells them apart; messages leave it out.
    """

    first: type | tuple[type, ...]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> Any:
        first, second = get_args(source)
        forms = Union[Annotated[first, Tag("<first>")], Annotated[second, Tag("<second>")]]  # noqa: UP007
        return handler.generate_schema(Annotated[forms, Discriminator(self._tag)])

    def _tag(self, value: Any) -> str:
        return "<first>" if isinstance(value, self.first) else "<second>"


@dataclass(frozen=True)
class Among:
    """A word of a table of the package."""

    words: tuple[str, ...]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> Any:
        return handler.generate_schema(Literal[self.words])


class Section(BaseModel):
    """A table of the problem file.

    The docstring says what it and its keys are; messages quote that as what is expected.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        for name, (_, said) in attributes(cls).items():
            if name in cls.model_fields:
                cls.model_fields[name].description = said
        cls.__doc__ = inspect.cleandoc(cls.__doc__ or "").partition("\n\nAttributes\n")[0]


def section_of(kind: type, title: str, base: type[Section] = Section) -> Any:
    """The table of a class: the keys of its fields; all are keys of a dataclass of options.

    Parameters
    ----------
    kind : type
        A class that is `stated`, or of options, whose docstring says what they are.
    title : str
    base : type
        The table with what else a file may say.
    """
    stated = [key for _, key in keys_of(kind)]
    keys: dict[str, Any] = {
        key.name: (key.form, Field(key.default, description=key.said)) for key in stated
    }
    checks: dict[str, Any] = {
        f"_{key.name}_or": model_validator(mode="after")(_either(key.constant, key.name))
        for key in stated
        if key.constant is not None
    }
    doc = inspect.cleandoc(kind.__doc__ or "").partition("\n")[0]
    made = keys or _options(kind)
    return create_model(title, __base__=base, __doc__=doc, __validators__=checks, **made)


def tables(name: str, kind: type) -> Key:
    """The key of [[tables]], each of which states one of a class."""
    form = list[section_of(kind, f"{kind.__name__}Section")]
    return Key(name, form, default=[], tables=kind)


def _options(kind: Any) -> dict[str, Any]:
    types, said = get_type_hints(kind, include_extras=True), documented(kind)
    keys: dict[str, Any] = {}
    for each in fields(kind):
        form, default = types[each.name], each.default
        if isinstance(form, type) and is_dataclass(form):
            form = section_of(form, f"{form.__name__}Section")
            default = form()
        keys[each.name] = (form, Field(default, description=said.get(each.name)))
    return keys


def stated_in(section: Section, kind: type, where: str) -> dict[str, Any]:
    """The fields of a class by what a table says of them; those of files are to be read yet.

    Raises
    ------
    InputError
        For a value that cannot be, naming its key in the table that is `where`.
    """
    fields: dict[str, Any] = {}
    for name, key in keys_of(kind):
        value = getattr(section, key.name)
        if value is not None and key.constant is None and key.tables is None:
            with located(where=f"{where}.{key.name}"):
                fields[name] = key.read(value) if key.read else value
    return fields


def _either(*names: str) -> Callable[[Any], Any]:
    def check(section: Any) -> Any:
        require_one(section, *names)
        return section

    return check


def given_keys(section: Section, *names: str) -> list[str]:
    """Those of the keys that the file gives."""
    return [name for name in names if getattr(section, name) is not None]


def require_one(section: Section, *names: str) -> None:
    """Refuse a section that gives none or several of the keys."""
    there = given_keys(section, *names)
    if len(there) != 1:
        which = " and ".join(there) or f"no {' or '.join(names)}"
        raise ValueError(f"found {which}; expected exactly one of {', '.join(names)}")
