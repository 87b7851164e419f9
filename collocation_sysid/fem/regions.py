"""The regions of a body: cells with a material, a damping law and a density of their own.

θ holds the constants that the parts of a body declare, and names that a user knows give them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, Index
from ..errors import InputError, hint_at
from .constants import CONTRAST, DENSITY, GAMMA_M, MASS, Constant, is_mode
from .field import TWO_PHASE, Field, FieldModes
from .materials import Damping, Energy, Material, Prony, as_branches, as_damping, as_material
from .mesh import TetMesh
from .moduli import Source, elastic_names, source_of
from .node_force import NodeForce
from .selection import Selection
from .two_phase import TwoPhaseModes


@dataclass(frozen=True, eq=False)
class Region:
    """A part of a body that differs from the rest.

    Parameters
    ----------
    name : str
        Stands before the names of its constants: ``core.mu_pa``.
    cells : selection of cells, or (E,) bool, or (k,) int array
    material, damping, density_kg_m3, prony
        The body's where they are left out.
    field : Field, optional
        A constant that differs from place to place within the region.
    """

    name: str
    cells: Selection | ArrayLike
    material: str | Energy | Material | None = None
    density_kg_m3: float | None = None
    damping: str | Damping | None = None
    prony: Sequence[str | Prony] | None = None
    field: Field | None = None

    def __post_init__(self) -> None:
        if not self.name or not self.name.replace("_", "").replace("-", "").isalnum():
            raise InputError(
                f"the region's name is {self.name!r}; expected letters, digits, - and _, which "
                "stand before the names of its parameters"
            )


@dataclass(frozen=True, eq=False)
class BodyPart:
    """A region as the body evaluates it.

    Attributes
    ----------
    name : str
        "" for what no region claims.
    cells : (k,) cell numbers, ascending
    material : Material
    damping : Damping
    density_kg_m3 : float
        As stated; θ tells where it is free.
    prony : tuple of Prony
        The branches of its memory.
    per_mass_1_m3 : float
        The density over the mass of the body.
    own_density : bool
        Whether it is stated for this part, not for the body.
    free_density : bool
        Whether the density is one of its constants.
    field : FieldModes or None
        What differs from place to place within it.
    """

    name: str
    cells: Index
    material: Material
    damping: Damping
    density_kg_m3: float
    prony: tuple[Prony, ...] = ()
    per_mass_1_m3: float = 0.0
    own_density: bool = False
    free_density: bool = False
    field: FieldModes | None = None

    @cached_property
    def constants(self) -> tuple[Constant, ...]:
        """Of material, damping law, memory, mass and field, as they follow one another in θ."""
        of_memory = [constant for branch in self.prony for constant in branch.constants]
        law = (*self.material.constants, *self.damping.constants, *of_memory, GAMMA_M)
        law = (*law, DENSITY) if self.free_density else law
        return (*law, *self.field_constants)

    @property
    def field_constants(self) -> tuple[Constant, ...]:
        """Constants of the field, the last ones of the part; none without a field."""
        return () if self.field is None else self.field.constants

    @property
    def of_law(self) -> int:
        """How many of them are the material's and the damping law's."""
        return len(self.material.constants) + len(self.damping.constants)

    @property
    def of_gamma_m(self) -> int:
        """Where γ_m is among them; the density follows where it is free."""
        return self.of_law + 2 * len(self.prony)

    @property
    def of_points(self) -> int:
        """How many numbers the quadrature points need: those, and the stiffening by memory."""
        return self.of_law + bool(self.prony)

    @property
    def stress_field(self) -> FieldModes | None:
        """The field, where stress depends on it: not that of a density."""
        return self.field if self.field and self.field.scaled else None

    @property
    def field_name(self) -> str:
        """The constant that differs from place to place."""
        return self.full_name(self.field.field.parameter) if self.field else ""

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
    prony: Sequence[str | Prony] = (),
    field: Field | None = None,
) -> tuple[BodyPart, ...]:
    """The parts of a body: what no region claims, where there is any, then the regions.

    Raises
    ------
    InputError
        If regions overlap, share a name, are empty, or leave no mass for the rest.
    """
    claimed = _claimed(mesh, regions)
    own = _densities(mesh, regions, claimed, density_kg_m3, mass_kg)
    rest = np.setdiff1d(
        np.arange(len(mesh.tetrahedra)), np.concatenate([np.zeros(0, int), *claimed])
    )
    branches = as_branches(prony)
    whole = BodyPart("", rest, as_material(material), as_damping(damping), own[0], branches)
    if field is not None and not rest.size:
        raise InputError(
            "the field is of what no region claims, and all is claimed; expected it of a region"
        )
    parts = [_with_field(whole, field, mesh)] if rest.size else []
    for region, cells, density in zip(regions, claimed, own[1:], strict=True):
        try:
            law = whole.material if region.material is None else as_material(region.material)
            drag = whole.damping if region.damping is None else as_damping(region.damping)
            memory = branches if region.prony is None else as_branches(region.prony)
            has_own = region.density_kg_m3 is not None
            part = BodyPart(region.name, cells, law, drag, density, memory, own_density=has_own)
            parts.append(_with_field(part, region.field, mesh))
        except InputError as error:
            raise error.located(None, f"region '{region.name}'") from error
    mass = sum(part.density_kg_m3 * float(mesh.volumes_m3[part.cells].sum()) for part in parts)
    return tuple(replace(part, per_mass_1_m3=part.density_kg_m3 / mass) for part in parts)


def _with_field(part: BodyPart, field: Field | None, mesh: TetMesh) -> BodyPart:
    if field is None:
        return part
    law = (*part.material.constants, *part.damping.constants)
    kind = TwoPhaseModes if field.prior == TWO_PHASE else FieldModes
    return replace(part, field=kind.of(field, mesh, part.cells, law))


def _densities(
    mesh: TetMesh,
    regions: Sequence[Region],
    claimed: Sequence[Index],
    density_kg_m3: float | None,
    mass_kg: float | None,
) -> list[float]:
    """Densities of what no region claims, and of the regions."""
    if (density_kg_m3 is None) == (mass_kg is None):
        raise InputError("give exactly one of density_kg_m3 and mass_kg")
    for region in regions:
        if region.density_kg_m3 is not None and not region.density_kg_m3 > 0:
            raise InputError("density_kg_m3 must be positive", None, f"region '{region.name}'")
    if density_kg_m3 is None:
        volumes = [float(mesh.volumes_m3[cells].sum()) for cells in claimed]
        known = [(r.density_kg_m3, v) for r, v in zip(regions, volumes, strict=True)]
        known_kg = sum(density * v for density, v in known if density is not None)
        left_m3 = mesh.volume_m3 - sum(v for density, v in known if density is not None)
        if left_m3 <= 1e-12 * mesh.volume_m3:
            raise InputError(
                "every cell is in a region with a density of its own, so mass_kg says nothing; "
                "leave one density out"
            )
        rest, name = (float(mass_kg or 0.0) - known_kg) / left_m3, "mass_kg"
    else:
        rest, name, known_kg = density_kg_m3, "density_kg_m3", 0.0
    if not rest > 0:
        heavy = f"; the regions' densities make up {known_kg:.4g} kg of it" if known_kg else ""
        raise InputError(f"{name} must be positive{heavy}")
    own = [rest if region.density_kg_m3 is None else region.density_kg_m3 for region in regions]
    return [rest, *own]


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


Theta = Sequence[float] | Array


class Model:
    """A sum of terms, part by part.

    Parameters
    ----------
    parts : tuple of BodyPart
    forces : tuple of NodeForce
        Of users.
    frictions : tuple of Constant
        Coefficients of friction that are parameters.

    Attributes
    ----------
    constants : dict of name to Constant
        What θ holds, in its order: those of the parts, of the forces, and frictions.

    Raises
    ------
    InputError
        If two constants have one name.
    """

    def __init__(
        self,
        parts: tuple[BodyPart, ...],
        forces: tuple[NodeForce, ...] = (),
        frictions: tuple[Constant, ...] = (),
    ) -> None:
        self.parts, self.forces, self.frictions = parts, forces, frictions
        self.constants: dict[str, Constant] = {
            part.full_name(c.name): c for part in parts for c in part.constants
        }
        for force in forces:
            for constant in force.constants:
                if constant.name in self.parameter_names:
                    raise InputError(
                        f"force {force.name!r} has the constant {constant.name!r}, which another "
                        "part of the body has; expected a name of its own"
                    )
                self.constants[constant.name] = constant
        for constant in frictions:
            if constant.name in self.parameter_names:
                raise InputError(
                    f"a friction is called {constant.name!r}, as another constant of the body; "
                    "expected a name of its own"
                )
            self.constants[constant.name] = constant

    def sources(self, known: Sequence[str]) -> list[Source]:
        """For each part, which of the names that are known give its constants.

        Raises
        ------
        InputError
            If a constant is missing or given twice.
        """
        return [
            source_of(
                part.name,
                part.material,
                part.constants[
                    len(part.material.constants) : len(part.constants) - len(part.field_constants)
                ],
                known,
            )
            for part in self.parts
        ]

    def used_names(self, known: Sequence[str]) -> set[str]:
        """Those of the names that are known which give its constants."""
        own = {name for source in self.sources(known) for name in source.names.values()}
        own.update(self.mode_names, self.contrasts)
        further = (force.constants for force in self.forces)
        return own.union(*({c.name for c in some} for some in (*further, self.frictions)))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names that a parameter may have: constants, what may stand for them, and shared ones."""
        names = []
        for part in self.parts:
            owns = [c.name for c in part.constants] + list(elastic_names(part.material))
            owns.append(DENSITY.name)
            names += [part.full_name(own) for own in owns] + owns
        return tuple(dict.fromkeys([*names, MASS.name, *self.constants]))

    def assembled(self, values: Mapping[str, Any]) -> list[Any]:
        """θ from values by the user's names: numbers, or CasADi expressions.

        Raises
        ------
        InputError
            If a constant is missing or given twice.
        """
        theta = []
        for part, source in zip(self.parts, self.sources(list(values)), strict=True):
            found = source.constants(values)
            if source.names.get(DENSITY.name) == MASS.name:
                found[DENSITY.name] *= part.per_mass_1_m3
            # A field that nothing is said of is as its mean everywhere.
            own = part.constants[: len(part.constants) - len(part.field_constants)]
            theta += [found[constant.name] for constant in own]
            theta += [values.get(part.full_name(c.name), c.usual) for c in part.field_constants]
        for name in list(self.constants)[len(theta) :]:
            if name not in values:
                raise InputError(
                    "no value is given of this constant of a force or friction", None, name
                )
            theta.append(values[name])
        return theta

    def theta(self, values: Mapping[str, float]) -> Array:
        """(k,) constants from values by the user's names; values of other bodies do not matter.

        Raises
        ------
        InputError
            If one is missing or given twice.
        """
        return np.array([float(value) for value in self.assembled(values)])

    def lame(self, theta: Theta) -> dict[str, tuple[float, float]]:
        """Small-strain (λ, μ) [Pa] of each part by its name."""
        found = {}
        for part, mine in zip(self.parts, self.split(np.asarray(theta, dtype=float)), strict=True):
            values = part.material.lame(mine[: len(part.material.constants)]).full().ravel()
            found[part.name] = (float(values[0]), float(values[1]))
        return found

    def weighed_by(self, names: Collection[str]) -> list[str]:
        """Parts whose densities parameters of these names give.

        A density that is stated for a region alone stays, unless ``core.density_kg_m3`` or
        ``mass_kg`` is among them.
        """
        return [
            part.name
            for part in self.parts
            if MASS.name in names
            or part.full_name(DENSITY.name) in names
            or (DENSITY.name in names and not part.own_density)
        ]

    def split(self, theta: Any) -> list[Any]:
        """θ, numbers or a CasADi expression, part by part."""
        return [theta[a:b] for a, b in pairwise(self.starts)]

    @property
    def mode_names(self) -> tuple[str, ...]:
        """Of the shares of shapes of fields."""
        return tuple(name for name in self.constants if is_mode(name))

    @property
    def contrasts(self) -> dict[str, float]:
        """Prior deviations of the logarithms of the contrasts of two-phase fields, by name."""
        return {
            part.full_name(CONTRAST.name): part.field.field.deviation
            for part in self.parts
            if part.field and part.field.field.prior == TWO_PHASE
        }

    @cached_property
    def mode_places(self) -> list[slice]:
        """Where in θ those of each part are."""
        counts = (len(part.field_constants) for part in self.parts)
        ends = self.starts[1:]
        return [slice(end - count, end) for end, count in zip(ends, counts, strict=True)]

    @cached_property
    def starts(self) -> list[int]:
        """Where the constants of each part begin in θ, and where the last end."""
        return [0, *np.cumsum([len(part.constants) for part in self.parts]).tolist()]

    def elastic(self, constants: Mapping[str, float]) -> Array:
        """θ without damping.

        Raises
        ------
        InputError
            For a name that the model does not know, or one that is missing.
        """
        for name in constants:
            if name not in self.parameter_names:
                hint = hint_at(name, self.parameter_names)
                raise InputError(
                    f"no constant {name!r}; expected {', '.join(self.constants)}{hint}"
                )
        stored = {p.full_name(c.name) for p in self.parts for c in p.material.constants}
        return self.theta({**dict.fromkeys(set(self.constants) - stored, 0.0), **constants})
