"""What the tables of the problem file are made of: checked numbers, and sections."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict

from ..checked import Boundless, Finite

Vector = tuple[Finite, Finite, Finite]
Corner = tuple[Boundless, Boundless, Boundless]
Unit = Literal["m", "cm", "mm", "in"]


class Section(BaseModel):
    """A table of the problem file; messages quote the fields' descriptions as what is expected."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def given_keys(section: Section, *names: str) -> list[str]:
    """Those of the keys that the file gives."""
    return [name for name in names if getattr(section, name) is not None]


def require_one(section: Section, *names: str) -> None:
    """Refuse a section that gives none or several of the keys."""
    given = given_keys(section, *names)
    if len(given) != 1:
        found = " and ".join(given) or f"no {' or '.join(names)}"
        raise ValueError(f"found {found}; expected exactly one of {', '.join(names)}")
