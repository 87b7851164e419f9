"""The regions of a body: cells with a material, a damping law and a density of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Index
from ..errors import InputError
from .constants import GAMMA_M, Constant
from .damping import Damping, as_damping
from .materials import Energy, Material, as_material
from .mesh import TetMesh
from .selection import Selection


@dataclass(frozen=True, eq=False)
class Region:
    """A part of a body that differs from the rest.

    Parameters
    ----------
    name : str
        Stands before the names of its constants: ``core.mu_pa``.
    cells : selection of cells, or (E,) bool, or (k,) int array
    material, damping, density_kg_m3
        The body's where they are left out.
    """

    name: str
    cells: Selection | ArrayLike
    material: str | Energy | Material | None = None
    density_kg_m3: float | None = None
    damping: str | Damping | None = None

    def __post_init__(self) -> None:
        if not self.name or not self.name.replace("_", "").replace("-", "").isalnum():
            raise InputError(
                f"the region's name is {self.name!r}; expected letters, digits, - and _, which "
                "stand before the names of its parameters"
            )


@dataclass(frozen=True, eq=False)
class Part:
    """A region as the body evaluates it.

    Attributes
    ----------
    name : str
        "" for what no region claims.
    cells : (k,) cell numbers, ascending
    material : Material
    damping : Damping
    density_kg_m3 : float
    """

    name: str
    cells: Index
    material: Material
    damping: Damping
    density_kg_m3: float

    @cached_property
    def constants(self) -> tuple[Constant, ...]:
        """Of the material, the damping law, and the mass, as they follow one another in θ."""
        return (*self.material.constants, *self.damping.constants, GAMMA_M)

    @property
    def of_points(self) -> int:
        """How many of them the quadrature points need: all but the mass's."""
        return len(self.constants) - 1

    def full_name(self, own: str) -> str:
        """The name of a constant with the region in front."""
        return f"{self.name}.{own}" if self.name else own


def parts_of(
    mesh: TetMesh,
    material: str | Energy | Material,
    damping: str | Damping,
    density_kg_m3: float | None,
    mass_kg: float | None,
    regions: Sequence[Region],
) -> tuple[Part, ...]:
    """The parts of a body: what no region claims, where there is any, then the regions.

    Raises
    ------
    InputError
        If regions overlap, share a name, are empty, or leave no mass for the rest.
    """
    claimed = _claimed(mesh, regions)
    masses = (density_kg_m3 is None) + (mass_kg is None)
    if masses != 1:
        raise InputError("give exactly one of density_kg_m3 and mass_kg")
    own = [region.density_kg_m3 for region in regions]
    for region, density in zip(regions, own, strict=True):
        if density is not None and not density > 0:
            raise InputError("density_kg_m3 must be positive", None, f"region '{region.name}'")
    volumes = [float(mesh.volumes_m3[cells].sum()) for cells in claimed]
    if density_kg_m3 is None:
        known = [(d, v) for d, v in zip(own, volumes, strict=True) if d is not None]
        left_kg = float(mass_kg or 0.0) - sum(d * v for d, v in known)
        left_m3 = mesh.volume_m3 - sum(v for _, v in known)
        if left_m3 <= 1e-12 * mesh.volume_m3:
            raise InputError(
                "every cell is in a region with a density of its own, so mass_kg says nothing; "
                "leave one density out"
            )
        rest = left_kg / left_m3
        if not rest > 0:
            heavier = f"the regions' densities make up {float(mass_kg or 0) - left_kg:.4g} kg of it"
            raise InputError(f"mass_kg must be positive{'; ' + heavier if known else ''}")
    else:
        rest = density_kg_m3
        if not rest > 0:
            raise InputError("density_kg_m3 must be positive")
    free = np.ones(len(mesh.tetrahedra), dtype=bool)
    for cells in claimed:
        free[cells] = False
    body_material, body_damping = as_material(material), as_damping(damping)
    parts = []
    if free.any():
        parts.append(Part("", np.flatnonzero(free), body_material, body_damping, rest))
    for region, cells in zip(regions, claimed, strict=True):
        parts.append(
            Part(
                region.name,
                cells,
                body_material if region.material is None else as_material(region.material),
                body_damping if region.damping is None else as_damping(region.damping),
                rest if region.density_kg_m3 is None else region.density_kg_m3,
            )
        )
    return tuple(parts)


def _claimed(mesh: TetMesh, regions: Sequence[Region]) -> list[Index]:
    """The cells of each region, ascending."""
    owner = np.full(len(mesh.tetrahedra), -1)
    claimed: list[Index] = []
    for k, region in enumerate(regions):
        if region.name in [other.name for other in regions[:k]]:
            raise InputError(f"two regions are named {region.name!r}; names must differ")
        try:
            cells = _cells(mesh, region.cells)
        except InputError as error:
            raise error.located(None, f"region '{region.name}'") from error
        if (taken := cells[owner[cells] >= 0]).size:
            other = regions[int(owner[taken[0]])].name
            raise InputError(
                f"cell {taken[0]} is in the regions {other!r} and {region.name!r}; expected every "
                "cell in one at most"
            )
        owner[cells] = k
        claimed.append(cells)
    return claimed


def _cells(mesh: TetMesh, given: Selection | ArrayLike) -> Index:
    if isinstance(given, Selection):
        return given.resolve_cells(mesh)
    array = np.asarray(given)
    count = len(mesh.tetrahedra)
    if array.dtype == bool and array.shape == (count,):
        array = np.flatnonzero(array)
    if array.ndim != 1 or array.dtype.kind not in "iu" or not array.size:
        raise InputError(
            f"cells are an array {array.shape} of {array.dtype}; expected cell numbers, or a mask "
            f"({count},) that is true somewhere"
        )
    outside = array[(array < 0) | (array >= count)]
    if outside.size:
        raise InputError(f"cell {outside[0]} does not exist; the mesh has {count}, from 0 on")
    return np.unique(array).astype(np.int64)
