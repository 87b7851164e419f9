"""Keys of [experiment.nuisance], each for the priors of one or more nuisance parameters.

The tables of the priors are made from `recording.nuisance.KINDS`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field, create_model, model_validator

from ..common.field_descriptions import sentence
from ..common.schema_tables import ByForm, Section, used_keys
from ..common.validated_types import Positive, Text
from ..recording import Nuisance
from ..recording.deviation import Deviation
from ..recording.nuisance import KINDS, SCOPE, SCOPE_TEXT

KEYS = {key: list(rows) for key, rows in groupby(KINDS, key=lambda row: row.key)}


def _require_scope(word: str) -> str:
    if word != "recording" and not re.fullmatch(SCOPE, word):
        raise ValueError(f'found {word!r}; expected "recording", {SCOPE_TEXT}')
    return word


class Scoped(Section):
    """Something of a recording, or of several.

    Attributes
    ----------
    scope : str
        Which recordings have the same value. "recording": each recording has its own value.
        "shared": all recordings with "shared" have one value. "shared" and a word: all recordings
        with the same word have one value.
    """

    scope: Annotated[str, AfterValidator(_require_scope)] = "recording"


class CustomNuisanceSection(Scoped):
    """A custom nuisance parameter: a Deviation in a Python file.

    Attributes
    ----------
    file : str
        Python file; it is executed, for which commands need the option --allow-code.
    row : str
        Name of the Deviation in the file.
    """

    file: Text
    row: Text


class NuisancePriorSection(Scoped):
    """Standard deviations of nuisance parameters; of several, those that are missing mean
    exact values.
    """

    # Whether the parameter has a default prior, so that a scope alone is sufficient.
    has_default: ClassVar[bool] = False

    @model_validator(mode="after")
    def _require_one_prior(self) -> NuisancePriorSection:
        """A parameter with a default and another scope than "recording" needs no deviation."""
        priors = [key for key in type(self).model_fields if key != "scope"]
        if not used_keys(self, *priors) and (self.scope == "recording" or not self.has_default):
            expected = "one or both" if len(priors) > 1 else "it"
            raise ValueError(f"found no {' and no '.join(priors)}; expected {expected}")
        return self


def _prior_section(key: str, rows: Sequence[Deviation]) -> type[NuisancePriorSection]:
    # A prior that refers to another one needs it.
    missing = ... if any(row.reference is not None for row in rows) else None
    form: Any = Positive
    priors: dict[str, Any] = {
        row.prior_key(): (
            form if missing is ... else form | None,
            Field(row.reference or missing, description=f"Standard deviation [{row.unit}]."),
        )
        for row in rows
    }
    made = create_model(
        f"{key.title().replace('_', '')}Prior",
        __base__=NuisancePriorSection,
        __module__=__name__,
        __doc__=f"Prior of a nuisance parameter: {rows[0].description}.",
        **priors,
    )
    made.has_default = any(row.sigma is not None for row in rows)
    return made


def _prior_key(key: str, rows: Sequence[Deviation]) -> tuple[Any, Any]:
    """Return annotation and default of a key of [experiment.nuisance]."""
    form: Any = Annotated[Literal["none"] | _prior_section(key, rows), ByForm(str)]
    defaults = ["" if row.sigma is None else f", {row.usual} by default" for row in rows]
    sentences = [
        sentence(f"{row.description}: {row.prior_key()}{default}")
        for row, default in zip(rows, defaults, strict=True)
    ]
    return form | None, Field(None, description=" ".join(sentences))


_PRIORS: dict[str, Any] = {key: _prior_key(key, rows) for key, rows in KEYS.items()}
_PriorTables = create_model("_PriorTables", __base__=Section, __module__=__name__, **_PRIORS)


class NuisanceSection(_PriorTables):
    """Nuisance parameters of this recording, each with a prior whose mean is zero.

    A parameter that has a default prior is estimated unless it is "none".

    Attributes
    ----------
    own : list of CustomNuisanceSection
        [[experiment.nuisance.own]] tables: custom nuisance parameters, defined in Python files.
    """

    own: list[CustomNuisanceSection] = Field(default_factory=list)


NuisanceOrNone = Annotated[Literal["none"] | NuisanceSection, ByForm(str)]


def nuisance_from_section(
    section: NuisanceSection | Literal["none"], row_of: Callable[[CustomNuisanceSection], Deviation]
) -> Nuisance:
    """Return the nuisance parameters of a recording: the defaults with the changes of the table.

    Parameters
    ----------
    section : NuisanceSection or "none"
        Table; "none" means no nuisance parameters.
    row_of : callable
        Function that returns the custom nuisance parameter of a table; what it raises is raised.

    Notes
    -----
    A key without a table leaves its parameters at their defaults; "none" removes all of them. Of a
    table that states a deviation, those that it does not state are removed (exact values); a table
    with a scope alone leaves the deviations as they are.
    """
    if section == "none":
        return Nuisance.none()
    deviations: dict[str, float | None] = {}
    scope: dict[str, str] = {}
    for key, rows in KEYS.items():
        prior = getattr(section, key)
        if prior == "none":
            deviations |= {row.name: None for row in rows}
        elif prior is not None:
            known = {row.name: getattr(prior, row.prior_key()) for row in rows}
            # A scope alone leaves the deviations as they are.
            deviations |= known if any(known.values()) else {}
            if prior.scope != "recording":
                scope |= {row.name: prior.scope for row in rows}
    custom_rows = [row_of(each) for each in section.own]
    scopes_by_name = {
        row.name: each.scope for row, each in zip(custom_rows, section.own, strict=True)
    }
    scope |= {name: word for name, word in scopes_by_name.items() if word != "recording"}
    return Nuisance(**deviations, scope=scope, own=custom_rows)
