"""Units of length: how files spell them, and what they are in metres."""

from __future__ import annotations

from pathlib import Path

from ...errors import InputError

METRES_PER_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}

_WORDS = {
    "m": ("m", "meter", "meters", "metre", "metres"),
    "cm": ("cm", "centimeter", "centimeters", "centimetre", "centimetres"),
    "mm": ("mm", "millimeter", "millimeters", "millimetre", "millimetres"),
    "in": ("in", "inch", "inches"),
}
_SPELLINGS = {word: unit for unit, words in _WORDS.items() for word in words}


def stated_unit(text: str, path: str | Path, where: str) -> str | None:
    """Return the unit that a file's own words mean; None where it leaves them blank.

    Raises
    ------
    InputError
        If the unit is not known.
    """
    word = text.strip().lower()
    if word and word not in _SPELLINGS:
        raise InputError(
            f"the unit of length is '{text.strip()}'; expected one of {', '.join(METRES_PER_UNIT)}",
            path,
            where,
        )
    return _SPELLINGS.get(word)


def refuse_unknown_unit(length_unit: str | None) -> None:
    """Raise an `InputError` if a given unit is not among `METRES_PER_UNIT`."""
    if length_unit is not None and length_unit not in METRES_PER_UNIT:
        raise InputError(
            f"length_unit is {length_unit!r}; expected one of {', '.join(METRES_PER_UNIT)}"
        )
