"""What the tables of the problem file are made of: checked numbers, and sections."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import fields
from typing import Any, Literal, Optional, get_type_hints

from pydantic import BaseModel, ConfigDict, Field, create_model, model_validator

from .checked import Boundless, Finite
from .stated import attributes, documented, keys_of, optional_keys

Vector = tuple[Finite, Finite, Finite]
Corner = tuple[Boundless, Boundless, Boundless]
Unit = Literal["m", "cm", "mm", "in"]


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
    optional = optional_keys(kind)
    keys: dict[str, Any] = {
        key.name: (Optional[key.form], Field(None, description=key.said))  # noqa: UP045
        if key.name in optional
        else (key.form, Field(description=key.said))
        for key in stated
    }
    checks: dict[str, Any] = {
        f"_{key.name}_or": model_validator(mode="after")(_either(key.constant, key.name))
        for key in stated
        if key.constant is not None
    }
    doc = inspect.cleandoc(kind.__doc__ or "").partition("\n")[0]
    made = keys or _options(kind)
    return create_model(title, __base__=base, __doc__=doc, __validators__=checks, **made)


def _options(kind: Any) -> dict[str, Any]:
    types, said = get_type_hints(kind, include_extras=True), documented(kind)
    return {
        each.name: (types[each.name], Field(each.default, description=said.get(each.name)))
        for each in fields(kind)
    }


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
    given = given_keys(section, *names)
    if len(given) != 1:
        found = " and ".join(given) or f"no {' or '.join(names)}"
        raise ValueError(f"found {found}; expected exactly one of {', '.join(names)}")
