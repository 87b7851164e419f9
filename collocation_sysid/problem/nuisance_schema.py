"""Keys of [experiment.nuisance], generated from the table of nuisance parameters.

A key contains the priors of one or more nuisance parameters.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import groupby
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Optional

from pydantic import AfterValidator, Field, create_model, model_validator

from ..recording import Nuisance
from ..recording.nuisance import KINDS, SCOPE, SCOPE_TEXT, NuisanceRow
from ..schema_tables import ByForm, Section, used_keys
from ..validated_types import Positive, Text

KEYS = {key: list(rows) for key, rows in groupby(KINDS, key=lambda row: row.key)}


def _require_scope(word: str) -> str:
    """Return a scope unchanged if it is "recording" or matches `SCOPE`; raise `ValueError`
    otherwise.
    """
    if word != "recording" and not re.fullmatch(SCOPE, word):
        raise ValueError(f'found {word!r}; expected "recording", {SCOPE_TEXT}')
    return word


class Scoped(Section):
    """Something of a recording, or of several.

    Attributes
    ----------
    scope : str
        Which recordings have the same value: "recording" for a value of each recording, "shared"
        for one value of all recordings that say "shared", or "shared" and a word for each of
        several groups.
    """

    scope: Annotated[str, AfterValidator(_require_scope)] = "recording"


class CustomNuisanceSection(Scoped):
    """A custom nuisance parameter: a NuisanceRow in a Python file.

    Attributes
    ----------
    file : str
        Python file; it is run, which needs --allow-code.
    row : str
        Name of the NuisanceRow in the file.
    """

    file: Text
    row: Text


class NuisancePriorSection(Scoped):
    """Standard deviations of nuisance parameters; of several, those that are missing mean
    exact values.
    """

    usual: ClassVar[bool] = False

    @model_validator(mode="after")
    def _require_one_prior(self) -> NuisancePriorSection:
        """Raise `ValueError` if no prior is given and the scope alone is not sufficient."""
        priors = [key for key in type(self).model_fields if key != "scope"]
        if not used_keys(self, *priors) and (self.scope == "recording" or not self.usual):
            expected = "one or both" if len(priors) > 1 else "it"
            raise ValueError(f"found no {' and no '.join(priors)}; expected {expected}")
        return self


def _prior_section(key: str, rows: list[NuisanceRow]) -> type[Section]:
    """Return the pydantic class of the table [experiment.nuisance.KEY], with a field for the prior
    standard deviation of each nuisance parameter in `rows`.

    A row that refers to another prior makes all priors of the table mandatory.
    """
    # What another prior goes with has to be there.
    needed = any(row.reference is not None for row in rows)
    fields: dict[str, Any] = {}
    for row in rows:
        known = row.reference or (... if needed else None)
        kind: Any = Positive if needed else Optional[Positive]  # noqa: UP045
        description = f"Standard deviation [{row.unit}]."
        fields[row.prior] = (kind, Field(known, description=description))
    name = "".join(word.title() for word in key.split("_")) + "Prior"
    description = f"Prior of a nuisance parameter: {rows[0].description}."
    section = create_model(name, __base__=NuisancePriorSection, __doc__=description, **fields)
    section.usual = any(row.sigma is not None for row in rows)
    return section


def _nuisance_section() -> type[Section]:
    """Return the pydantic class of the table [experiment.nuisance], with one table, or "none", for
    each kind of nuisance parameter.
    """
    fields: dict[str, Any] = {}
    for key, rows in KEYS.items():
        description = " ".join(
            f"{row.description[0].upper()}{row.description[1:]}: {_described_prior(row)}."
            for row in rows
        )
        kind: Any = Annotated[Literal["none"] | _prior_section(key, rows), ByForm(str)]
        fields[key] = (kind | None, Field(None, description=description))
    description = (
        "[[experiment.nuisance.own]] tables: custom nuisance parameters, defined in Python files."
    )
    fields["own"] = (
        list[CustomNuisanceSection],
        Field(default_factory=list, description=description),
    )
    description = (
        "Nuisance parameters of this recording, each with a prior whose mean is zero.\n\nA "
        'parameter that has a default prior is estimated unless it is "none".'
    )
    return create_model("NuisanceSection", __base__=Section, __doc__=description, **fields)


def _described_prior(row: NuisanceRow) -> str:
    """Return the name of a prior, followed by its default if it has one."""
    return row.prior if row.sigma is None else f"{row.prior}, {row.usual} by default"


NuisanceSection = _nuisance_section()
if TYPE_CHECKING:
    NuisanceOrNone = Section | Literal["none"]
else:
    NuisanceOrNone = Annotated[Literal["none"] | NuisanceSection, ByForm(str)]


def nuisance_from_section(
    section: Section | Literal["none"], row_of: Callable[[CustomNuisanceSection], NuisanceRow]
) -> Nuisance:
    """Return the nuisance parameters of a recording: the defaults with the changes of the table.

    Parameters
    ----------
    section : Section or "none"
        Table; "none" means no nuisance parameters.
    row_of : callable
        Function that returns the custom nuisance parameter of a table.
    """
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
    tables: list[CustomNuisanceSection] = vars(section)["own"]
    custom_rows = [row_of(each) for each in tables]
    scopes_by_name = {row.name: each.scope for row, each in zip(custom_rows, tables, strict=True)}
    scope |= {name: word for name, word in scopes_by_name.items() if word != "recording"}
    return Nuisance(**deviations, scope=scope, own=custom_rows)
