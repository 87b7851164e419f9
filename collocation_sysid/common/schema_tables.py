"""Building blocks of the tables of a problem file: vectors, alternatives, and sections."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args

from pydantic import BaseModel, ConfigDict, Discriminator, GetCoreSchemaHandler, Tag

from ..errors import located
from .declarations import keys_of
from .field_descriptions import attributes
from .validated_types import Boundless, Finite

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
        """Return the tag of the form that a value has."""
        return "<first>" if isinstance(value, self.first) else "<second>"


@dataclass(frozen=True)
class Among:
    """Annotation of a key whose value is one of the given words."""

    words: tuple[str, ...]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> Any:
        return handler.generate_schema(Literal[self.words])


class Section(BaseModel):
    """Base class of the tables of a problem file.

    The class docstring and its Attributes become the descriptions in the schema and in messages.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        for name, (_, description) in attributes(cls).items():
            if name in cls.model_fields:
                cls.model_fields[name].description = description
        text = inspect.cleandoc(cls.__doc__ or "").partition("\n\nAttributes\n")[0]
        summary, gap, details = text.partition("\n\n")
        cls.__doc__ = " ".join(summary.split("\n")) + gap + details


def declared_in(section: Section, kind: type, where: str) -> dict[str, Any]:
    """Return the fields of a class that a table states, by field name, converted by the `read` of
    their keys.

    Keys that the table does not state (None) are left out, and so are keys that name a file with a
    table (`Key.constant`).

    Parameters
    ----------
    section : Section
        Table of a problem file; it has an attribute for each key.
    kind : type
        Class decorated with `declaration`.
    where : str
        Location of the table, for messages.

    Raises
    ------
    InputError
        For an invalid value; the message names its key.
    """
    fields: dict[str, Any] = {}
    for name, key in keys_of(kind):
        value = getattr(section, key.name)
        if value is not None and key.constant is None:
            with located(where=f"{where}.{key.name}"):
                fields[name] = key.read(value) if key.read else value
    return fields


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
