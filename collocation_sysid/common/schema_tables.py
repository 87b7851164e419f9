"""Building blocks of the tables of a problem file: vectors, alternatives, and sections."""

from __future__ import annotations

import inspect
from dataclasses import MISSING, dataclass, fields, is_dataclass
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    Self,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import pydantic
from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    GetCoreSchemaHandler,
    Tag,
    model_validator,
)

from ..errors import located
from .declarations import Key, keys_of
from .field_descriptions import attributes
from .validated_types import Boundless, Finite, Positive, Text

Vector = tuple[Finite, Finite, Finite]
Corner = tuple[Boundless, Boundless, Boundless]
Unit = Literal["m", "cm", "mm", "in"]


@dataclass(frozen=True)
class ByForm:
    """Attributes
    ----------
    first : type or tuple of types
        Python types of values that are validated as the first type of the annotated union; all
        other values are validated as the second.
    """

    first: type | tuple[type, ...]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> Any:
        first, second = get_args(source)
        forms = Union[  # noqa: UP007
            Annotated[first, Tag("<first>")], Annotated[second, Tag("<second>")]
        ]
        return handler.generate_schema(Annotated[forms, Discriminator(self._tag)])

    def _tag(self, value: Any) -> str:
        return "<first>" if isinstance(value, self.first) else "<second>"


# Standard deviation of all samples, or the name of the column that has that of each sample.
Noise = Annotated[Text | Positive, ByForm(str)]


@dataclass(frozen=True)
class Among:
    """Annotation of a key whose value is one of the given words."""

    words: tuple[str, ...]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> Any:
        return handler.generate_schema(Literal[self.words])


# Annotation of a key in the body of a table that has form, default and description of the class
# `Section.of`: it states the place of the key among the others.
Declared = Any


class Section(BaseModel):
    """Base class of the tables of a problem file.

    The class docstring and its Attributes become the descriptions in the schema and in messages.
    ``class GraspSection(Section, of=Grasp)`` is the table of a dataclass: it has the keys of that
    class (`keys_of`) with their forms, defaults and descriptions, and its summary unless the table
    has a docstring. Its body states only the keys of the file itself, and those that differ; they
    follow the keys that the body does not mention.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)
    # Class of which this is the table; `object` if there is none.
    of: ClassVar[type] = object

    def __init_subclass__(cls, *, of: type | None = None, **options: Any) -> None:
        super().__init_subclass__(**options)
        if of is None:
            return
        cls.of = of
        stated = dict(inspect.get_annotations(cls))
        declared: dict[str, Any] = {}
        texts = {name: text for name, (_, text) in attributes(of).items()}
        for name, key in _keys_by_name(cls).items():
            if stated.get(key.name, "Declared") == "Declared":
                (stated if key.name in stated else declared)[key.name] = key.form
                text = texts.get(name) if key.name == name else key.description
                field = pydantic.Field(_default(of, name, key), description=text)
                setattr(cls, key.name, field)
        cls.__annotations__ = declared | stated

    @classmethod
    def __pydantic_init_subclass__(cls, **options: Any) -> None:
        for name, (_, text) in attributes(cls).items():
            if name in cls.model_fields:
                cls.model_fields[name].description = text
        text = inspect.cleandoc(cls.__doc__ or cls.of.__doc__ or "")
        text = text.partition("\n\nAttributes\n")[0]
        summary, gap, details = text.partition("\n\n")
        summary = " ".join(summary.split("\n"))
        cls.__doc__ = summary + gap + details if cls.__doc__ else summary

    @model_validator(mode="after")
    def _require_file_or_constant(self) -> Self:
        for key in _keys_by_name(type(self)).values():
            if key.constant is not None:
                require_one(self, key.constant, key.name)
        return self


def _keys_by_name(section: type[Section]) -> dict[str, Key]:
    if not is_dataclass(section.of):
        return {}
    if keys := dict(keys_of(section.of)):
        return keys
    forms = get_type_hints(section.of, include_extras=True)
    return {each.name: Key(each.name, forms[each.name]) for each in fields(section.of)}


def _default(kind: type, name: str, key: Key) -> Any:
    """Return the default of a key in a file, from that of the field; ... if it must be stated."""
    field = kind.__dataclass_fields__[name]  # type: ignore[attr-defined]
    if type(None) in get_args(key.form):
        return None  # the class has the default
    if field.default_factory is not MISSING:
        return field.default_factory()
    if field.default is MISSING:
        return ...
    return [*field.default] if get_origin(key.form) is list else field.default


def declared_in(section: Section, where: str) -> dict[str, Any]:
    """Return the fields of the class of a table (`Section.of`) that the table states, by field
    name, converted by the `read` of their keys.

    Keys that the table does not state (None) are left out, and so are keys that name a file with a
    table (`Key.constant`).

    Parameters
    ----------
    where : str
        Location of the table, for messages.

    Raises
    ------
    InputError
        For an invalid value; the message names its key.
    """
    stated: dict[str, Any] = {}
    for name, key in _keys_by_name(type(section)).items():
        value = getattr(section, key.name)
        if value is not None and key.constant is None:
            with located(where=f"{where}.{key.name}"):
                stated[name] = key.read(value) if key.read else value
    return stated


def used_keys(section: Section, *names: str) -> list[str]:
    """Return those of `names` that the section states, in their order; a key is stated if its value
    is not None.
    """
    return [name for name in names if getattr(section, name) is not None]


def require_one(section: Section, *names: str) -> None:
    """Raise ValueError unless the section states exactly one of the keys `names`; a key is stated
    if its value is not None.
    """
    there = used_keys(section, *names)
    if len(there) != 1:
        which = " and ".join(there) or f"no {' or '.join(names)}"
        raise ValueError(f"found {which}; expected exactly one of {', '.join(names)}")
