"""Sizes and densities that soft objects can have: a unit mistaken shows here first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from .body import Body

DENSITIES_KG_M3 = (10.0, 25_000.0)
SIZES_M = (1e-4, 10.0)
# So many times outside these ranges nothing can be meant.
IMPOSSIBLE = 100.0


@dataclass(frozen=True)
class Oddity:
    """A size or a density that is hardly meant.

    Attributes
    ----------
    cause : {"length-unit", "density"}
    sentence : str
        What was found, what is expected, and the remedy.
    factor : float
        How many times it is outside what there is.
    """

    cause: str
    sentence: str
    factor: float


def oddities(body: Body) -> tuple[Oddity, ...]:
    """What is odd about a body's size and density; mostly nothing.

    Raises
    ------
    InputError
        If one of them is more than a hundred times outside what there is.
    """
    size_m = float(np.linalg.norm(np.ptp(body.mesh.bounds_m, axis=0)))
    density_kg_m3 = body.mass_kg / body.mesh.volume_m3
    found = []
    if (factor := _outside(size_m, SIZES_M)) > 1:
        found.append(Oddity("length-unit", _about_size(size_m), factor))
    if (factor := _outside(density_kg_m3, DENSITIES_KG_M3)) > 1:
        found.append(Oddity("density", _about_density(density_kg_m3), factor))
    impossible = [oddity.sentence for oddity in found if oddity.factor > IMPOSSIBLE]
    if impossible:
        raise InputError(impossible[0], None, "object")
    return tuple(found)


def _outside(value: float, limits: tuple[float, float]) -> float:
    return max(limits[0] / value, value / limits[1])


def _about_size(size_m: float) -> str:
    large = size_m > SIZES_M[1]
    likely = 'likely "mm"' if large else "the mesh may be in metres already"
    return (
        f"the body is {size_m:.3g} m large; expected {SIZES_M[0]:g} to {SIZES_M[1]:g} m: check "
        f"object.length_unit, {likely}"
    )


def _about_density(density_kg_m3: float) -> str:
    least, largest = DENSITIES_KG_M3
    likely = (
        f"1000 times as much, {1e3 * density_kg_m3:.4g}, if it was in g/cm³"
        if density_kg_m3 < least
        else f"a thousandth, {density_kg_m3 / 1e3:.4g}, if the mass was in g"
    )
    return (
        f"the body's density is {density_kg_m3:.4g} kg/m³; expected {least:g} to {largest:g}: set "
        f"object.density_kg_m3 or mass_kg, {likely}, and check object.length_unit"
    )
