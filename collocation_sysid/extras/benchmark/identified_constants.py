"""Constants of the bodies with combined intervals, from the catalogue of identified materials."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from typing import Any

from ...common.pages import documentation_folder
from ...errors import InputError, require_among

CATALOGUE_FILE = "catalogue.json"


@dataclass(frozen=True)
class IdentifiedConstant:
    """One constant of a body, as an entry of the catalogue.

    Attributes
    ----------
    name : str
        Name in problem files, with its unit.
    unit : str
        Unit of the values; "1" for ratios.
    combined95 : (lower, upper) or None
        Combined 95 % interval; None if the constant was stated, or has no interval.
    is_stated : bool
        Whether the constant was stated in the problem, not estimated.
    is_derived : bool
        Whether the constant follows from the parameters, such as Young's modulus at small strain.
    reason : str or None
        Why an estimated constant has no interval.
    true_value : float or None
        Value with which a recording was simulated; None for measured data.
    """

    name: str
    unit: str
    value: float
    combined95: tuple[float, float] | None
    is_stated: bool
    is_derived: bool
    reason: str | None
    true_value: float | None


@dataclass(frozen=True)
class CatalogueEntry:
    """Entry of the catalogue.

    Attributes
    ----------
    specimen : str
        The recorded body and its test.
    source, licence : str
        Source and licence of the recordings.
    is_measured : bool
        Whether the recordings are measurements.
    law, damping : tuple of str
        Material laws and damping laws of the regions.
    fitted_recordings : tuple of str
        Recordings from which the constants were identified.
    """

    specimen: str
    source: str
    licence: str
    is_measured: bool
    law: tuple[str, ...]
    damping: tuple[str, ...]
    constants: tuple[IdentifiedConstant, ...]
    fitted_recordings: tuple[str, ...]


@cache
def _catalogue() -> dict[str, dict[str, Any]]:
    """Return the entries of the catalogue, as they are in its JSON file, by name.

    The result is cached and must not be modified.
    """
    file = documentation_folder() / CATALOGUE_FILE
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"the catalogue is not part of this installation ({error.strerror}); install the "
            "package again",
            file,
        ) from error
    return {entry["name"]: entry for entry in content["entries"]}


def catalogue_entry(name: str) -> CatalogueEntry:
    """Return the entry of the catalogue with this name.

    Raises
    ------
    InputError
        If the catalogue is not part of the installation, or has no such entry.
    """
    entries = _catalogue()
    require_among(name, entries, source=CATALOGUE_FILE)
    entry = entries[name]
    constants = tuple(
        IdentifiedConstant(
            **each | {"combined95": each["combined95"] and tuple(each["combined95"])}
        )
        for each in entry["constants"]
    )
    return CatalogueEntry(
        specimen=entry["specimen"],
        source=entry["source"],
        licence=entry["licence"],
        is_measured=entry["is_measured"],
        law=tuple(entry["law"]),
        damping=tuple(entry["damping"]),
        constants=constants,
        fitted_recordings=tuple(entry["recordings"]),
    )
