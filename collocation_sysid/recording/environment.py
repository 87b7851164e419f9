"""Density of the air around a body, as stated in a problem."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ..errors import InputError
from ..fem.air import AIR_KG_M3

VACUUM = "none"
# Density of the air around experiments that state none [kg/m³].
USUAL_KG_M3: float = AIR_KG_M3


def usual_air_density() -> float:
    """Return `USUAL_KG_M3`, the density of the air around experiments that state none [kg/m³], as
    it is at the time of the call.
    """
    return USUAL_KG_M3


def air_density(value: float | Literal["none"]) -> float:
    """Return a stated density of the air [kg/m³]; zero for "none", a vacuum.

    Raises
    ------
    InputError
        If it is neither "none" nor a finite number of at least zero; booleans and numbers as text
        are refused.
    """
    if isinstance(value, str) and value == VACUUM:
        return 0.0
    is_number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    density_kg_m3 = float(value) if is_number else np.nan
    if not 0 <= density_kg_m3 < np.inf:
        raise InputError(
            f"air_density_kg_m3 is {value!r}; expected a density in kg/m³ such as {AIR_KG_M3}, or "
            f'"{VACUUM}" for a vacuum or a recording simulated without air'
        )
    return density_kg_m3
