"""Units: their spellings in files, and their factors to SI."""

from __future__ import annotations

import math
import re

from ...errors import InputError

METRES_PER_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}

# Factors from units to SI, by dimension. A unit may be written in lower case, as in fz_kn, unless
# that is another unit.
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "sec": 1.0, "seconds": 1.0, "second": 1.0, "ms": 1e-3, "min": 60.0}
    | {"µs": 1e-6, "us": 1e-6, "ns": 1e-9, "h": 3600.0}
    | {"msec": 1e-3, "minutes": 60.0, "hours": 3600.0},
    "length": {
        **{**METRES_PER_UNIT, "µm": 1e-6, "um": 1e-6, "nm": 1e-9, '"': 0.0254},
        **{"dm": 0.1, "mil": 25.4e-6, "thou": 25.4e-6, "ft": 0.3048},
    },
    "force": {
        **{"n": 1.0, "mn": 1e-3, "MN": 1e6, "kn": 1e3, "µn": 1e-6, "un": 1e-6, "nn": 1e-9},
        **{"kgf": 9.80665, "kp": 9.80665, "gf": 9.80665e-3, "lbf": 4.4482216152605},
        **{"cn": 1e-2, "dan": 10.0, "dyn": 1e-5, "ozf": 0.27801385095378},
    },
    "torque": {
        **{"nm": 1.0, "nmm": 1e-3, "mnm": 1e-3, "ncm": 1e-2, "µnm": 1e-6},
        **{"n-m": 1.0, "n-mm": 1e-3, "n-cm": 1e-2, "mn-m": 1e-3},
        **{"lbfin": 0.1129848290276167, "lbf-in": 0.1129848290276167, "in-lbf": 0.1129848290276167},
    },
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "°": math.pi / 180}
    | {"rev": 2 * math.pi, "degree": math.pi / 180, "degrees": math.pi / 180},
    "pressure": {
        **{"pa": 1.0, "mPa": 1e-3, "hpa": 1e2, "kpa": 1e3, "mpa": 1e6, "gpa": 1e9},
        **{"n/m²": 1.0, "n/cm²": 1e4, "n/mm²": 1e6, "kn/m²": 1e3, "MN/m²": 1e6, "mn/m²": 1e-3},
        **{"kgf/cm²": 98066.5, "kp/cm²": 98066.5, "kg/cm²": 98066.5, "kgf/mm²": 9806650.0},
        **{"bar": 1e5, "mbar": 1e2, "atm": 101325.0, "psi": 6894.757293, "ksi": 6894757.293},
        **{"mmhg": 133.322387, "torr": 133.322368, "cmh2o": 98.0665, "cmh₂o": 98.0665},
        **{"inhg": 3386.388, "inh2o": 249.08891, "dyn/cm²": 0.1, "gf/cm²": 98.0665},
        **{"lbf/in²": 6894.757293, "lb/in²": 6894.757293},
    },
    "frequency": {"hz": 1.0, "khz": 1e3, "mHz": 1e-3, "rad/s": 0.5 / math.pi},
    "ratio": {
        **{"-": 1.0, "1": 1.0, "mm/mm": 1.0, "m/m": 1.0, "in/in": 1.0, "%": 1e-2, "‰": 1e-3},
        **{"percent": 1e-2, "pct": 1e-2, "permille": 1e-3, "µm/m": 1e-6, "um/m": 1e-6},
        **{"µε": 1e-6, "ue": 1e-6, "ustrain": 1e-6, "µstrain": 1e-6, "microstrain": 1e-6},
    },
}
# Units as they are written, by their spelling in lower case; others are written as in `UNITS`.
_WRITTEN = {
    **{"n": "N", "mn": "mN", "kn": "kN", "µn": "µN", "nn": "nN", "nm": "nm", "pa": "Pa"},
    **{"hpa": "hPa", "kpa": "kPa", "mpa": "MPa", "gpa": "GPa", "n/m²": "N/m²", "n/cm²": "N/cm²"},
    **{"n/mm²": "N/mm²", "kn/m²": "kN/m²", "mn/m²": "mN/m²", "mmhg": "mmHg", "cmh₂o": "cmH₂O"},
    **{"hz": "Hz", "khz": "kHz", "cn": "cN", "dan": "daN", "inhg": "inHg", "inh2o": "inH2O"},
}
_TORQUES = {"nm": "N m", "nmm": "N mm", "mnm": "mN m", "ncm": "N cm", "µnm": "µN m"}
# A negative exponent, as in N mm^-2 or N·m⁻².
_PER_AREA = re.compile(r"[ ·*.]+(m|cm|mm)(?:\^?[-−]2|⁻²)$")
# Second spellings, which messages leave out.
_UNWRITTEN = (
    *("um", "un", "us", "cmh2o", "seconds", "second", "msec", "minutes", "hours", "lb/in²"),
    *("n-m", "n-mm", "n-cm", "mn-m", "lbf-in", "in-lbf", "degree", "degrees"),
    *("percent", "pct", "permille", "um/m", "ue", "ustrain", "µstrain", "microstrain"),
)
# What people write where a force is meant.
_MASSES = ("g", "kg", "lb", "lbs")

_WORDS = {
    "m": ("m", "meter", "meters", "metre", "metres"),
    "cm": ("cm", "centimeter", "centimeters", "centimetre", "centimetres"),
    "mm": ("mm", "millimeter", "millimeters", "millimetre", "millimetres"),
    "in": ("in", "inch", "inches"),
}
_SPELLINGS = {word: unit for unit, words in _WORDS.items() for word in words}


def si_factor(unit_text: str, dimension: str) -> float | None:
    """Return the factor from a unit to SI; None if it is no unit of that dimension, a key of
    `UNITS`.

    Blanks, "·" and "*" in the unit are ignored; N mm^-2 is N/mm². Capitals matter only where they
    distinguish two units, such as "MN" and "mn" or "mPa" and "mpa".
    """
    bare = _PER_AREA.sub(r"/\1²", unit_text.strip())
    bare = bare.replace("·", "").replace("*", "").replace(" ", "").replace("μ", "µ")
    bare = bare.replace("^2", "²")
    bare = bare[:-1] + "²" if bare.endswith(("/m2", "/cm2", "/mm2", "/in2")) else bare
    known = UNITS[dimension]
    if bare not in known and dimension == "length":
        bare = _SPELLINGS.get(bare.lower(), bare)
    return known.get(bare, known.get(bare.lower()))


def written_unit(unit: str, dimension: str) -> str:
    """Return a unit of a dimension as people write it, such as "N" for "n"."""
    return (_TORQUES if dimension == "torque" else _WRITTEN).get(unit, unit)


def expected_units(unit: str, dimension: str) -> str:
    """Return the expected units of a dimension as text, for messages about another unit; where a
    force is meant and `unit` is one of mass, the text says so.
    """
    mass = dimension == "force" and unit.lower() in _MASSES
    units = [written_unit(each, dimension) for each in UNITS[dimension] if each not in _UNWRITTEN]
    return f"{'a unit of force, ' if mass else ''}one of {', '.join(units)}"


def length_unit_of_spelling(text: str) -> str | None:
    """Return the key of `METRES_PER_UNIT` that a unit such as "Millimeter" means; None if none."""
    return _SPELLINGS.get(text.strip().lower())


def length_unit_of_text(text: str, where: str) -> str | None:
    """Return the unit of length ("m", "cm", "mm", "in") that a file's text names; None if it is
    blank.

    Parameters
    ----------
    where : str
        Place in the file, for messages.

    Raises
    ------
    InputError
        If the unit is not known.
    """
    word = text.strip().lower()
    if word and word not in _SPELLINGS:
        expected = ", ".join(METRES_PER_UNIT)
        message = f"the unit of length is '{text.strip()}'; expected one of {expected}"
        raise InputError(message, where=where)
    return _SPELLINGS.get(word)


def require_length_unit(length_unit: str | None) -> None:
    """Raise an `InputError` if a unit of length is neither None nor a key of `METRES_PER_UNIT`."""
    if length_unit is not None and length_unit not in METRES_PER_UNIT:
        raise InputError(
            f"length_unit is {length_unit!r}; expected one of {', '.join(METRES_PER_UNIT)}"
        )
