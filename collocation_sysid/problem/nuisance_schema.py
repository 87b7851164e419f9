"""The nuisance keys of a recording, made from the table of what may be estimated.

A key has the priors of one row of the table, or of several.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import groupby
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Optional

from pydantic import AfterValidator, Field, create_model, model_validator

from ..checked import Positive, Text
from ..recording import Nuisance
from ..recording.nuisance import ROWS, SCOPE, SCOPES, NuisanceRow
from ..section import ByForm, Section, given_keys

KEYS = {key: list(rows) for key, rows in groupby(ROWS, key=lambda row: row.key)}


def _scope(word: str) -> str:
    if word != "recording" and not re.fullmatch(SCOPE, word):
        raise ValueError(f'found {word!r}; expected "recording", {SCOPES}')
    return word


class Scoped(Section):
    """Something of a recording, or of several.

    Attributes
    ----------
    scope : str
        Whose it is: that of each recording by itself, or the same in all that say "shared", or
        "shared" and a word for each of several groups.
    """

    scope: Annotated[str, AfterValidator(_scope)] = "recording"


class OwnRow(Scoped):
    """A nuisance parameter of the user's own: a NuisanceRow in a Python file.

    Attributes
    ----------
    file : str
        Python file; it is run, which needs --allow-code.
    row : str
        Name of the NuisanceRow in it.
    """

    file: Text
    row: Text


class Prior(Scoped):
    """How well something is known; what is left out of several is taken as exact."""

    usual: ClassVar[bool] = False

    @model_validator(mode="after")
    def _some(self) -> Prior:
        priors = [key for key in type(self).model_fields if key != "scope"]
        if not given_keys(self, *priors) and (self.scope == "recording" or not self.usual):
            expected = "one or both" if len(priors) > 1 else "it"
            raise ValueError(f"found no {' and no '.join(priors)}; expected {expected}")
        return self


def _prior(key: str, rows: list[NuisanceRow]) -> type[Section]:
    """The table of a key."""
    # What another prior goes with has to be there.
    needed = any(row.beside is not None for row in rows)
    fields: dict[str, Any] = {}
    for row in rows:
        known = row.beside or (... if needed else None)
        kind: Any = Positive if needed else Optional[Positive]  # noqa: UP045
        said = f"Standard deviation [{row.unit}]."
        fields[row.prior] = (kind, Field(known, description=said))
    name = "".join(word.title() for word in key.split("_")) + "Prior"
    said = f"How well it is known: {rows[0].said}."
    made = create_model(name, __base__=Prior, __doc__=said, **fields)
    made.usual = any(row.sigma is not None for row in rows)
    return made


def _section() -> type[Section]:
    fields: dict[str, Any] = {}
    for key, rows in KEYS.items():
        said = " ".join(f"{row.said[0].upper()}{row.said[1:]}: {_said(row)}." for row in rows)
        kind: Any = Annotated[Literal["none"] | _prior(key, rows), ByForm(str)]
        fields[key] = (kind | None, Field(None, description=said))
    said = "[[experiment.nuisance.own]] tables: what a Python file makes of markers' readings."
    fields["own"] = (list[OwnRow], Field(default_factory=list, description=said))
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
    NuisanceOrNone = Annotated[Literal["none"] | NuisanceSection, ByForm(str)]


def nuisance_of(
    section: Section | Literal["none"], row_of: Callable[[OwnRow], NuisanceRow]
) -> Nuisance:
    """The defaults, with what the table says otherwise, and rows of the user's own."""
    if section == "none":
        return Nuisance.none()
    deviations: dict[str, float | None] = {}
    scope: dict[str, str] = {}
    assert isinstance(section, NuisanceSection)
    for key, rows in KEYS.items():
        prior = getattr(section, key)
        if prior == "none":
            deviations |= {row.name: None for row in rows}
        elif prior is not None:
            known = {row.name: getattr(prior, row.prior) for row in rows}
            # A scope alone leaves the deviations as they are.
            deviations |= known if any(known.values()) else {}
            if prior.scope != "recording":
                scope |= {row.name: prior.scope for row in rows}
    tables: list[OwnRow] = vars(section)["own"]
    own = [row_of(each) for each in tables]
    said = {row.name: each.scope for row, each in zip(own, tables, strict=True)}
    scope |= {name: word for name, word in said.items() if word != "recording"}
    return Nuisance(**deviations, scope=scope, own=own)
