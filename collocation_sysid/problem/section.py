"""What the tables of the problem file are made of: checked numbers, and sections."""

from __future__ import annotations

import inspect
from dataclasses import fields
from typing import Any, Literal, get_type_hints

from pydantic import BaseModel, ConfigDict, Field, create_model

from ..checked import Boundless, Finite
from ..stated import documented

Vector = tuple[Finite, Finite, Finite]
Corner = tuple[Boundless, Boundless, Boundless]
Unit = Literal["m", "cm", "mm", "in"]


class Section(BaseModel):
    """A table of the problem file; messages quote the fields' descriptions as what is expected."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def section_of(kind: type) -> Any:
    """The table of a dataclass of options: its types, its defaults, what its docstring says."""
    types, said = get_type_hints(kind, include_extras=True), documented(kind)
    keys: dict[str, Any] = {
        each.name: (types[each.name], Field(each.default, description=said.get(each.name)))
        for each in fields(kind)
    }
    title = f"{kind.__name__.removesuffix('Options')}Section"
    return create_model(
        title,
        __base__=Section,
        __doc__=inspect.cleandoc(kind.__doc__ or "").partition("\n")[0],
        **keys,
    )


def given_keys(section: Section, *names: str) -> list[str]:
    """Those of the keys that the file gives."""
    return [name for name in names if getattr(section, name) is not None]


def require_one(section: Section, *names: str) -> None:
    """Refuse a section that gives none or several of the keys."""
    given = given_keys(section, *names)
    if len(given) != 1:
        found = " and ".join(given) or f"no {' or '.join(names)}"
        raise ValueError(f"found {found}; expected exactly one of {', '.join(names)}")
