"""Sizes and densities that soft objects can have: a unit mistaken shows here first."""

from __future__ import annotations

import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..fem.body import Body
from ..fem.moduli import engineering
from .hypothesis import Hypothesis

DENSITIES_KG_M3 = (10.0, 25_000.0)
SIZES_M = (1e-4, 10.0)
# What is as dense as this is metal or full of it, and no metal is softer than this.
METAL_KG_M3, SOFTEST_METAL_PA = 5e3, 1e9
# So many times outside these ranges nothing can be meant.
IMPOSSIBLE = 100.0


def oddities(body: Body) -> tuple[Hypothesis, ...]:
    """What is odd about a body's size and density; mostly nothing.

    Their strength is how many times they are outside what there is.

    Raises
    ------
    InputError
        If one of them is more than a hundred times outside what there is.
    """
    size_m = float(np.linalg.norm(np.ptp(body.mesh.bounds_m, axis=0)))
    density_kg_m3 = body.mass_kg / body.mesh.volume_m3
    (little_m, much_m), (thin, dense) = SIZES_M, DENSITIES_KG_M3
    size = {
        "size_m": size_m,
        "least": little_m,
        "most": much_m,
        "likely": 'likely "mm"' if size_m > much_m else "the mesh may be in metres already",
    }
    density = {
        "density_kg_m3": density_kg_m3,
        "least": thin,
        "most": dense,
        "likely": f"1000 times as much, {1e3 * density_kg_m3:.4g}, if it was in g/cm³"
        if density_kg_m3 < thin
        else f"a thousandth, {density_kg_m3 / 1e3:.4g}, if the mass was in g",
    }
    tried = (
        Hypothesis("length-unit/size", data=size, strength=_outside(size_m, SIZES_M)),
        Hypothesis("density", data=density, strength=_outside(density_kg_m3, DENSITIES_KG_M3)),
    )
    for each in tried:
        if each.strength > IMPOSSIBLE:
            raise InputError(each.sentence, None, "object")
    return tuple(each for each in tried if each.strength > 1)


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
