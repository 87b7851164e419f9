"""What the tables of the problem file are made of: checked numbers, and sections."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

# TOML tells text, numbers and truth values apart, so a "30" or true for a number is a slip.
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
Boundless = Annotated[float, Field(strict=True)]
Whole = Annotated[int, Field(strict=True)]
Flag = Annotated[bool, Field(strict=True)]
Text = Annotated[str, Field(min_length=1)]
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
