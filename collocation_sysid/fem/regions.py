"""Regions of a body with their own material, damping law and density, and the vector θ.

Use `Region` to declare a region. `ConstantsModel` maps parameters by the names that users know to
the constants θ of all parts of a body.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..common.array_types import Array, Index
from ..common.validated_classes import validated
from ..common.validated_types import FileName, Positive
from ..errors import InputError, hint_at
from .laws.constants import DENSITY, FIELD_COEFFICIENT, GAMMA_M, MASS, TAU, Constant
from .laws.damping_admissibility import require_admissible_damping
from .laws.fibres import Fibres, reinforced
from .laws.materials import (
    DAMPINGS,
    DampingLaw,
    Energy,
    Material,
    Prony,
    StrainMaterial,
    as_branches,
    as_damping,
    as_material,
)
from .laws.moduli import ConstantSource, elastic_names, find_source
from .laws.time_shift import TimeShift
from .meshes.mesh import TetMesh
from .meshes.selection import Selection
from .node_force import NodeForce
from .spatial_field import Field, FieldModes


@validated
@dataclass(frozen=True, eq=False)
class Region:
    """Part of a body with properties that differ from the rest.

    Parameters
    ----------
    name : str
        Prefix of the names of its constants: ``core.mu_pa``. Letters, digits, - and _.
    cells : Selection, (E,) bool or (k,) int array
        Selection, mask or indices of its cells; resolved and checked when a `Body` is built.
    material, damping, density_kg_m3, prony
        None: those of the body. An empty `prony` is a region without memory. The density
        [kg/m³] is that of the region alone.
    field : Field, optional
        Constant that varies in space within the region; None for none, also if the body has a
        field.
    fibres : Fibres, optional
        Fibres of the region beside its material; None for none, also if the body has fibres.

    Raises
    ------
    InputError
        If the name is empty or has other characters.
    """

    name: FileName
    cells: Selection | ArrayLike
    material: str | Energy | Material | None = None
    density_kg_m3: Positive | None = None
    damping: str | DampingLaw | None = None
    prony: Sequence[str | Prony] | None = None
    field: Field | None = None
    fibres: Fibres | None = None

    def __post_init__(self) -> None:
        if not self.name or not self.name.replace("_", "").replace("-", "").isalnum():
            raise InputError(
                f"the region's name is {self.name!r}; expected letters, digits, - and _, because "
                "it precedes the names of its parameters"
            )


@dataclass(frozen=True, eq=False)
class BodyPart:
    """Region of a body, or its remainder, with resolved laws."""

    name: str  # name of the region; "" for the cells outside all regions
    cells: Index  # (k,): cell indices, ascending
    material: Material
    damping: DampingLaw
    density_kg_m3: float  # stated density; not used where the density is free
    prony: tuple[Prony, ...] = ()  # branches of its memory
    per_mass_1_m3: float = 0.0  # density divided by the mass of the body
    has_own_density: bool = False  # whether the density is stated for this part, not for the body
    has_free_density: bool = False  # whether the density is an entry of θ
    field: FieldModes | None = None  # constant that varies in space within the part
    # (k, 3, 3) or None: axes of the fibres of each cell, as columns; None without fibres.
    axes: Array | None = None
    # Whether every time step is a quarter of the period of a steady oscillation, whose frequency
    # may change where the strain is zero, as in harmonic tests.
    oscillates: bool = False
    shift: TimeShift | None = None  # factor on the times of its memory; None for 1

    @cached_property
    def constants(self) -> tuple[Constant, ...]:
        """Constants of the part in the order of θ: of the material, of the damping law, of the
        Prony branches, γ_m (always), the density if it is a parameter, and those of the field.
        """
        memory = [constant for branch in self.prony for constant in branch.named_constants()]
        density = (DENSITY,) if self.has_free_density else ()
        return (
            *self.material.constants,
            *self.damping.constants,
            *memory,
            GAMMA_M,
            *density,
            *self.field_constants,
        )

    @property
    def field_constants(self) -> tuple[Constant, ...]:
        """Constants of the field, the last ones of the part; empty without a field."""
        return () if self.field is None else self.field.constants

    @property
    def law_constant_count(self) -> int:
        """Number of constants of the material and the damping law."""
        return len(self.material.constants) + len(self.damping.constants)

    @property
    def point_constant_count(self) -> int:
        """Number of constants that the kernel of a quadrature point reads: those of the material
        and the damping law, and one more, the stiffening by memory, if the part has branches.
        """
        return self.law_constant_count + bool(self.prony)

    @property
    def stress_field(self) -> FieldModes | None:
        """Field of a constant on which the stress depends; None without one, or for a density."""
        return self.field if self.field and self.field.scaled_indices else None

    @property
    def field_name(self) -> str:
        """Name of the constant that varies in space; "" without a field."""
        return self.full_name(self.field.field.parameter) if self.field else ""

    def full_name(self, own: str) -> str:
        """Return the name of a constant with the prefix of the region: ``core.mu_pa``; `own` itself
        outside all regions.
        """
        return f"{self.name}.{own}" if self.name else own


def parts_from_regions(
    mesh: TetMesh,
    material: str | Energy | Material,
    damping: str | DampingLaw,
    density_kg_m3: float | None,
    mass_kg: float | None,
    regions: Sequence[Region],
    prony: Sequence[str | Prony] = (),
    field: Field | None = None,
    fibres: Fibres | None = None,
) -> tuple[BodyPart, ...]:
    """Return the parts of a body: the cells outside all regions, if any, then the regions in their
    order.

    Parameters
    ----------
    material, damping, prony
        Laws of the cells outside all regions, and defaults of the regions.
    density_kg_m3, mass_kg : float or None
        Density outside regions with a density [kg/m³], or mass of the whole body [kg]; exactly one
        of them.
    field : Field, optional
        Field of the cells outside all regions; regions do not inherit it.
    fibres : Fibres, optional
        Fibres of the cells outside all regions; regions do not inherit them.

    Raises
    ------
    InputError
        If regions overlap, share a name, are empty, or leave no mass for the rest; if a law is
        unknown, a density is not positive, or a field is stated although every cell is in a region.
    """
    claimed = _cells_of_regions(mesh, regions)
    densities = _densities(
        mesh, regions, claimed=claimed, density_kg_m3=density_kg_m3, mass_kg=mass_kg
    )
    rest = np.setdiff1d(
        np.arange(len(mesh.tetrahedra)), np.concatenate([np.zeros(0, int), *claimed])
    )
    branches = as_branches(prony)
    remainder = BodyPart(
        "",
        rest,
        material=as_material(material),
        damping=as_damping(damping),
        density_kg_m3=densities[0],
        prony=branches,
    )
    _require_damping(remainder.damping, remainder.material)
    for given, name in ((field, "a field"), (fibres, "fibres")):
        if given is not None and not rest.size:
            raise InputError(
                f"found {name} for the part of the body outside all regions, but the regions contain "
                f"every cell; expected {name.replace('a ', 'the ')} as an entry of one of the regions"
            )
    parts = []
    if rest.size:
        parts = [_with_field(_with_fibres(remainder, fibres, mesh=mesh), field, mesh=mesh)]
    for region, cells, density in zip(regions, claimed, densities[1:], strict=True):
        try:
            law = remainder.material if region.material is None else as_material(region.material)
            region_damping = (
                remainder.damping if region.damping is None else as_damping(region.damping)
            )
            memory = branches if region.prony is None else as_branches(region.prony)
            _require_damping(region_damping, law)
            has_own = region.density_kg_m3 is not None
            part = BodyPart(
                region.name,
                cells,
                material=law,
                damping=region_damping,
                density_kg_m3=density,
                prony=memory,
                has_own_density=has_own,
            )
            part = _with_fibres(part, region.fibres, mesh=mesh)
            parts.append(_with_field(part, region.field, mesh=mesh))
        except InputError as error:
            raise error.located(None, f"region '{region.name}'") from error
    mass = sum(part.density_kg_m3 * float(mesh.volumes_m3[part.cells].sum()) for part in parts)
    return tuple(replace(part, per_mass_1_m3=part.density_kg_m3 / mass) for part in parts)


def _require_damping(damping: DampingLaw, material: Material) -> None:
    if not isinstance(material, StrainMaterial) and damping not in DAMPINGS.values():
        require_admissible_damping(damping, material)


def _with_fibres(part: BodyPart, fibres: Fibres | None, mesh: TetMesh) -> BodyPart:
    if fibres is None:
        return part
    try:
        material = reinforced(part.material, fibres.energy)
        return replace(part, material=material, axes=fibres.axes(mesh, part.cells))
    except InputError as error:
        raise error.located(None, "fibres") from error


def _with_field(part: BodyPart, field: Field | None, mesh: TetMesh) -> BodyPart:
    if field is None:
        return part
    law = (*part.material.constants, *part.damping.constants)
    return replace(part, field=FieldModes.from_field(field, mesh, cells=part.cells, law=law))


def _densities(
    mesh: TetMesh,
    regions: Sequence[Region],
    claimed: Sequence[Index],
    density_kg_m3: float | None,
    mass_kg: float | None,
) -> list[float]:
    """Return the density outside the regions, then that of each region [kg/m³]."""
    if (density_kg_m3 is None) == (mass_kg is None):
        raise InputError(
            f"found {'neither' if mass_kg is None else 'both'} of density_kg_m3 and mass_kg; "
            "expected exactly one of them"
        )
    if density_kg_m3 is None:
        volumes = [float(mesh.volumes_m3[cells].sum()) for cells in claimed]
        known = [(r.density_kg_m3, v) for r, v in zip(regions, volumes, strict=True)]
        known_kg = sum(density * v for density, v in known if density is not None)
        remaining_m3 = mesh.volume_m3 - sum(v for density, v in known if density is not None)
        if remaining_m3 <= 1e-12 * mesh.volume_m3:
            raise InputError(
                "every cell is in a region with a density of its own, so that mass_kg has no effect; "
                "omit mass_kg and give density_kg_m3 of the body, or omit the density of one region"
            )
        default_density = (float(mass_kg or 0.0) - known_kg) / remaining_m3
        key = "mass_kg"
        expected = (
            f"more than {known_kg:.4g} kg, the mass of the regions with a density of their own"
            if known_kg
            else "a positive number"
        )
    else:
        default_density = density_kg_m3
        key = "density_kg_m3"
        expected = "a positive number"
    if not default_density > 0:
        found = density_kg_m3 if mass_kg is None else mass_kg
        raise InputError(f"{key} is {found:g}; expected {expected}")
    region_densities = [
        default_density if region.density_kg_m3 is None else region.density_kg_m3
        for region in regions
    ]
    return [default_density, *region_densities]


def _cells_of_regions(mesh: TetMesh, regions: Sequence[Region]) -> list[Index]:
    region_of_cell = np.full(len(mesh.tetrahedra), -1)
    claimed: list[Index] = []
    for k, region in enumerate(regions):
        if region.name in [other.name for other in regions[:k]]:
            raise InputError(
                f"two regions are named {region.name!r}; expected a different name for each region"
            )
        try:
            cells = _resolve_cells(mesh, region.cells)
        except InputError as error:
            raise error.located(None, f"region '{region.name}'") from error
        if (overlap := cells[region_of_cell[cells] >= 0]).size:
            other = regions[int(region_of_cell[overlap[0]])].name
            raise InputError(
                f"cell {overlap[0]} is in the regions {other!r} and {region.name!r}; expected every "
                "cell in at most one region: make the selections of the two regions disjoint"
            )
        region_of_cell[cells] = k
        claimed.append(cells)
    return claimed


def _resolve_cells(mesh: TetMesh, cells: Selection | ArrayLike) -> Index:
    """Return cell indices, ascending and unique, from a selection, a mask (E,) or indices."""
    if isinstance(cells, Selection):
        return cells.resolve_cells(mesh)
    array = np.asarray(cells)
    count = len(mesh.tetrahedra)
    if array.dtype == bool and array.shape == (count,):
        array = np.flatnonzero(array)
    if array.ndim != 1 or array.dtype.kind not in "iu" or not array.size:
        raise InputError(
            f"cells are an array {array.shape} of {array.dtype}; expected indices of cells from 0, "
            f"or a boolean array ({count},) that is true somewhere"
        )
    outside = array[(array < 0) | (array >= count)]
    if outside.size:
        raise InputError(
            f"cell {outside[0]} does not exist; expected indices of the {count} cells of the mesh, "
            f"0 to {count - 1}"
        )
    return np.unique(array).astype(np.int64)


Theta = Sequence[float] | Array


class ConstantsModel:
    """Sum of terms, part by part, with the vector θ of their constants.

    Parameters
    ----------
    forces : tuple of NodeForce
        Custom forces.
    frictions : tuple of Constant
        Friction coefficients that are parameters.

    Attributes
    ----------
    constants : dict of name to Constant
        Definitions of the entries of θ, in their order: those of parts, of forces, and frictions.

    Raises
    ------
    InputError
        If two constants have the same name.
    """

    def __init__(
        self,
        parts: tuple[BodyPart, ...],
        forces: tuple[NodeForce, ...] = (),
        frictions: tuple[Constant, ...] = (),
    ) -> None:
        self.parts = parts
        self.forces = forces
        self.frictions = frictions
        self.constants: dict[str, Constant] = {
            part.full_name(c.name): c for part in parts for c in part.constants
        }
        for force in forces:
            for constant in force.constants:
                if constant.name in self.parameter_names:
                    raise InputError(
                        f"force {force.name!r} has the constant {constant.name!r}, but another "
                        "constant of the body has the same name; expected another name for the "
                        "constant of the force"
                    )
                self.constants[constant.name] = constant
        for constant in frictions:
            if constant.name in self.parameter_names:
                raise InputError(
                    f"the coefficient of friction {constant.name!r} has the name of another constant of "
                    "the body; expected another name of the obstacle, which the name of its friction "
                    "begins with"
                )
            self.constants[constant.name] = constant

    def constant_sources(self, known: Sequence[str]) -> list[ConstantSource]:
        """Return for each part the parameters that determine its constants, fields excepted.

        Parameters
        ----------
        known : sequence of str
            Names of the given parameters; names that no part uses are ignored.

        Raises
        ------
        InputError
            If a constant, or a parameter of a shift, is missing, or a constant is given twice.
        """
        for part in self.parts:
            if part.shift:
                part.shift.require_names(known)
        return [
            find_source(
                part.name,
                part.material,
                others=part.constants[
                    len(part.material.constants) : len(part.constants) - len(part.field_constants)
                ],
                known=known,
            )
            for part in self.parts
        ]

    def used_names(self, known: Sequence[str]) -> set[str]:
        """Return the names of all parameters and constants from which θ is assembled.

        Parameters
        ----------
        known : sequence of str
            Names of the stated parameters. They decide which of the alternatives (moduli, shared
            names, `mass_kg`) gives each constant of a part.

        Returns
        -------
        set of str
            The names among `known` that give constants of the parts, and always those of field
            coefficients, custom forces and coefficients of friction.
        """
        used = {name for source in self.constant_sources(known) for name in source.names.values()}
        used.update(self.field_coefficient_names)
        used.update(*(part.shift.constants for part in self.parts if part.shift))
        further = (force.constants for force in self.forces)
        return used.union(*({c.name for c in some} for some in (*further, self.frictions)))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """All names that a parameter may have, without repetitions: constants of each part,
        moduli in their place, both with and without the name of the region, those of a shift of
        the relaxation times, and `mass_kg`.
        """
        names = []
        for part in self.parts:
            part_names = [c.name for c in part.constants] + list(elastic_names(part.material))
            part_names.append(DENSITY.name)
            names += [part.full_name(part_name) for part_name in part_names] + part_names
            names += part.shift.constants if part.shift else ()
        return tuple(dict.fromkeys([*names, MASS.name, *self.constants]))

    def assemble_theta(self, values: Mapping[str, Any]) -> list[Any]:
        """Return θ as a list from parameters by name: numbers, or CasADi expressions.

        Parameters
        ----------
        values : mapping of str to number or expression
            Constants, or moduli and `mass_kg` in their place. Names that the body does not use are
            ignored. A coefficient of a field that is missing is 0, its usual value, so that the
            field equals its mean.

        Raises
        ------
        InputError
            If a constant of a part, force or friction is missing, or a constant is given twice.
        """
        theta = []
        for part, source in zip(self.parts, self.constant_sources(list(values)), strict=True):
            constants = source.evaluate(values)
            if source.names.get(DENSITY.name) == MASS.name:
                constants[DENSITY.name] *= part.per_mass_1_m3
            if part.shift:
                factor = part.shift.factor(values)
                for branch in part.prony:
                    constants[f"{branch.name}.{TAU.name}"] *= factor
            # A field that nothing is said of is as its mean everywhere.
            own_constants = part.constants[: len(part.constants) - len(part.field_constants)]
            theta += [constants[constant.name] for constant in own_constants]
            theta += [values.get(part.full_name(c.name), c.usual) for c in part.field_constants]
        for name in list(self.constants)[len(theta) :]:
            if name not in values:
                raise InputError(
                    "this constant of a force or friction has no value; expected a number in "
                    "[parameters], or {} to estimate it",
                    None,
                    where=name,
                )
            theta.append(values[name])
        return theta

    def theta_from_values(self, values: Mapping[str, float]) -> Array:
        """Return the constants θ (k,) from parameters by name, see `assemble_theta`.

        Names that the body does not use are ignored.

        Raises
        ------
        InputError
            If a constant is missing or given twice.
        """
        return np.array([float(value) for value in self.assemble_theta(values)])

    def lame(self, theta: Theta) -> dict[str, tuple[float, float]]:
        """Return the small-strain (λ, μ) [Pa] of each part at θ (k,), by the name of the part (""
        outside the regions). With memory they are the long-term moduli.
        """
        by_part = {}
        for part, part_constants in zip(
            self.parts, self.split_theta(np.asarray(theta, dtype=float)), strict=True
        ):
            values = (
                part.material.lame(part_constants[: len(part.material.constants)]).full().ravel()
            )
            by_part[part.name] = (float(values[0]), float(values[1]))
        return by_part

    def parts_with_free_density(self, names: Collection[str]) -> list[str]:
        """Return the names of the parts whose densities are given by parameters of these names.

        `mass_kg` among the names frees all densities; ``density_kg_m3`` those that are stated for
        the body, not for a region alone; ``core.density_kg_m3`` that of the region "core" in any
        case. "" is the part outside all regions.
        """
        return [
            part.name
            for part in self.parts
            if MASS.name in names
            or part.full_name(DENSITY.name) in names
            or (DENSITY.name in names and not part.has_own_density)
        ]

    def split_theta(self, theta: Any) -> list[Any]:
        """Return the slices of θ (numbers or a CasADi expression) of each part, in the order of
        `parts`; constants of custom forces and frictions are left out.
        """
        return [theta[a:b] for a, b in pairwise(self.starts)]

    @property
    def field_coefficient_names(self) -> tuple[str, ...]:
        """Names of all constants of fields that are coefficients of shapes, in the order
        of θ.
        """
        return tuple(name for names in self.group_field_coefficients().values() for name in names)

    def group_field_coefficients(self) -> dict[str, tuple[str, ...]]:
        """Return the names of the coefficients of each field in the order of θ, by the name of
        their vector: "field", or "core.field" for the field of the region "core".
        """
        return {
            part.full_name(FIELD_COEFFICIENT.name): tuple(
                part.full_name(constant.name) for constant in part.field_constants
            )
            for part in self.parts
            if part.field
        }

    @cached_property
    def field_slices(self) -> list[slice]:
        """Slice in θ of the coefficients of each part's field; of length zero for a part without
        one.
        """
        counts = (len(part.field_constants) for part in self.parts)
        ends = self.starts[1:]
        return [slice(end - count, end) for end, count in zip(ends, counts, strict=True)]

    @cached_property
    def starts(self) -> list[int]:
        """Index in θ of the first constant of each part, and that after the last part."""
        return [0, *np.cumsum([len(part.constants) for part in self.parts]).tolist()]

    def elastic_theta(self, constants: Mapping[str, float]) -> Array:
        """Return θ (k,) from elastic constants by name, with all other constants zero.

        Raises
        ------
        InputError
            For a name that the model does not have, or an elastic constant that is missing.
        """
        for name in constants:
            if name not in self.parameter_names:
                hint = hint_at(name, self.parameter_names)
                raise InputError(
                    f"found the constant {name!r}; expected one of {', '.join(self.constants)}{hint}"
                )
        stored = {p.full_name(c.name) for p in self.parts for c in p.material.constants}
        return self.theta_from_values(
            {**dict.fromkeys(set(self.constants) - stored, 0.0), **constants}
        )
