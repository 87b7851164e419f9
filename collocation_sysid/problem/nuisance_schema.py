"""The nuisance keys of a recording, made from the table of what may be estimated.

A key has the priors of one row of the table, or of several.
"""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, Annotated, Any, Literal, Optional

from pydantic import Discriminator, Field, Tag, create_model, model_validator

from ..checked import Positive
from ..experiment import Nuisance
from ..experiment.nuisance import ROWS, NuisanceRow
from .section import Section, given_keys

KEYS = {key: list(rows) for key, rows in groupby(ROWS, key=lambda row: row.key)}


class Prior(Section):
    """How well something is known; what is left out of several is taken as exact."""

    @model_validator(mode="after")
    def _some(self) -> Prior:
        priors = list(type(self).model_fields)
        if not given_keys(self, *priors):
            raise ValueError(f"found neither {' nor '.join(priors)}; expected one or both")
        return self


def or_none(section: Any) -> Any:
    """The type of a key that is a table, or "none"."""
    return Annotated[
        Annotated[Literal["none"], Tag("<none>")] | Annotated[section, Tag("<table>")],
        Discriminator(_form),
    ]


def _form(value: Any) -> str:
    return "<none>" if isinstance(value, str) else "<table>"


def _prior(key: str, rows: list[NuisanceRow]) -> type[Section]:
    """The table of a key."""
    # One prior alone has to be there, and what another one goes with.
    either = len(rows) > 1 and all(row.beside is None for row in rows)
    fields: dict[str, Any] = {}
    for row in rows:
        known = row.beside or (None if either else ...)
        kind: Any = Optional[Positive] if either else Positive  # noqa: UP045
        said = f"Standard deviation [{row.unit}]."
        fields[row.prior] = (kind, Field(known, description=said))
    name = "".join(word.title() for word in key.split("_")) + "Prior"
    said = f"How well it is known: {rows[0].said}."
    return create_model(name, __base__=Prior, __doc__=said, **fields)


def _section() -> type[Section]:
    fields: dict[str, Any] = {}
    for key, rows in KEYS.items():
        said = " ".join(f"{row.said[0].upper()}{row.said[1:]}: {_said(row)}." for row in rows)
        fields[key] = (or_none(_prior(key, rows)) | None, Field(None, description=said))
    said = (
        "What is estimated of this recording alone, each with a prior around zero.\n\n"
        'What has a prior by default is estimated unless it is "none".'
    )
    return create_model("NuisanceSection", __base__=Section, __doc__=said, **fields)


def _said(row: NuisanceRow) -> str:
    return row.prior if row.sigma is None else f"{row.prior}, {row.usual} by default"


NuisanceSection = _section()
if TYPE_CHECKING:
    NuisanceOrNone = Section | Literal["none"]
else:
    NuisanceOrNone = or_none(NuisanceSection)


def nuisance_of(section: Section | Literal["none"]) -> Nuisance:
    """The defaults, with what the table says otherwise."""
    if section == "none":
        return Nuisance.none()
    found: dict[str, float | None] = {}
    for key, rows in KEYS.items():
        given = getattr(section, key)
        if given == "none":
            found |= {row.name: None for row in rows}
        elif given is not None:
            found |= {row.name: getattr(given, row.prior) for row in rows}
    return Nuisance(**found)
