"""Sizes and densities that soft objects can have: a unit mistaken shows here first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..errors import InputError
from .body import Body
from .moduli import engineering

DENSITIES_KG_M3 = (10.0, 25_000.0)
SIZES_M = (1e-4, 10.0)
# What is as dense as this is metal or full of it, and no metal is softer than this.
METAL_KG_M3, SOFTEST_METAL_PA = 5e3, 1e9
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


def odd_material(body: Body, theta: Array) -> str | None:
    """Why no material is as dense and as soft as a body with constants θ; None where one may be.

    Tracks and poses tell the stiffness over the density, so a wrong density leaves no other trace.
    """
    density_kg_m3 = float(body.mass_of_dofs(theta).sum()) / 3 / body.mesh.volume_m3
    young_pa = max(float(engineering(*lame)[0]) for lame in body.lame(theta).values())
    if density_kg_m3 < METAL_KG_M3 or young_pa > SOFTEST_METAL_PA:
        return None
    return (
        f"the body is as dense as metal, {density_kg_m3:.4g} kg/m³, and as soft as rubber, "
        f"E = {young_pa:.3g} Pa: a thousandth of both, if the mass was in g; check "
        "object.density_kg_m3 or mass_kg"
    )


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
