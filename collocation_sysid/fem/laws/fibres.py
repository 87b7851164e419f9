"""Fibres that reinforce an isotropic material: one or two families with a mean direction.

The fibres add to the energy density of the matrix, for each family with the unit vector a,

    ψ_f = E_f / 8 · ⟨e⟩²                      ("quadratic")
    ψ_f = E_f / (8 k) · (exp(k ⟨e⟩²) − 1)     ("exponential", Holzapfel, Gasser & Ogden 2000)
    e = κ (I₁ − 3) + (1 − 3κ)(|F a|² − 1)     (dispersion κ, Gasser, Ogden & Holzapfel 2006)

with ⟨e⟩ = max(e, 0) for fibres that carry tension only. Without dispersion E_f (`fibre_pa`) is the
stiffness that a family adds along itself at small tension; Holzapfel's k₁ is E_f / 4. I₁ and |F a|
contain the change of volume, so that fibres resist only their own stretch.

`Fibres` states them for a part of a body, `FibreLaw` is the energy in axes of the fibres: a family
is along x, or turned from it about z by the constant `fibre_angle_rad`, two families by ± this angle.
The kernels of a part get shape gradients in the axes of the fibres of each cell, so that a field of
directions costs nothing; the matrix does not depend on the axes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Annotated, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ...common.array_types import Array, Index
from ...common.checked_arrays import float_array
from ...common.declarations import declaration, key
from ...common.schema_tables import ByForm, Vector
from ...common.validated_types import Flag, Text
from ...errors import InputError
from ..chain_rule import ChainRule
from ..meshes.mesh import TetMesh
from .constants import FIBRE_ANGLE, FIBRE_DISPERSION, FIBRE_EXPONENT, FIBRE_STIFFNESS, Constant
from .materials import Material

# Half width of the range of e in which fibres that carry tension only begin to carry it: the
# energy is smooth, and its second derivative at e = 0 is half of that in tension.
ENGAGED = 1e-3
Direction = Annotated[Text | Vector, ByForm(str)]


def _directions(value: str | ArrayLike) -> str | Array:
    """Return a name, or vectors (3,) or (E, 3)."""
    return value if isinstance(value, str) else float_array(value, "direction", ((3,), (None, 3)))


@declaration
class Fibres:
    """Fibres of a part of a body, beside its isotropic material.

    Parameters
    ----------
    direction : array or str, optional
        Direction of the fibres in the undeformed body: a vector, one vector (E, 3) for each cell of
        the mesh, or the name of such an array of the mesh. It need not have the length 1.
    axis : list, optional
        Instead of `direction`: axis of fibres that run around it, as hoops.
    axis_point_m : list
        A point on `axis`.
    normal : array or str, optional
        Vector, vectors or the name of an array like `direction`: the constant fibre_angle_rad turns
        the fibres about it. By default there is no such constant; with `axis` it is the radial
        direction, and the constant is the angle of helices from the hoops.
    helix : bool
        With `axis`: whether fibres are turned from the hoops by fibre_angle_rad.
    families : {1, 2}
        Two families are turned to both sides by fibre_angle_rad; they have the same constants.
    law : {"quadratic", "exponential"}
        "exponential" has the constant fibre_exponent, by which fibres become stiffer as they are
        stretched.
    dispersed : bool
        Whether directions scatter about the mean one, with the constant fibre_dispersion from 0
        (all parallel) to 1/3 (isotropic).
    tension_only : bool
        Whether fibres carry no compression.

    Raises
    ------
    InputError
        Unless exactly one of `direction` and `axis` is stated; for two families without `normal` or
        `helix`.
    """

    direction: str | Array | None = key(Direction | None, converter=_directions, default=None)
    axis: tuple[float, float, float] | None = key(Vector | None, default=None)
    axis_point_m: tuple[float, float, float] = key(Vector, default=(0.0, 0.0, 0.0))
    normal: str | Array | None = key(Direction | None, converter=_directions, default=None)
    helix: bool = key(Flag, default=False)
    families: Literal[1, 2] = key(Literal[1, 2], default=1)
    law: Literal["quadratic", "exponential"] = key(
        Literal["quadratic", "exponential"], default="quadratic"
    )
    dispersed: bool = key(Flag, default=False)
    tension_only: bool = key(Flag, default=True)

    def __post_init__(self) -> None:
        if (self.direction is None) == (self.axis is None):
            found = "both direction and axis" if self.axis is not None else "no direction"
            raise InputError(
                f"found {found}; expected either direction, or axis for fibres around it",
                None,
                where="direction",
            )
        if self.helix and self.axis is None:
            raise InputError("found helix without axis; expected axis", None, where="helix")
        if self.normal is not None and self.axis is not None:
            raise InputError(
                "found normal and axis; expected helix = true for fibres that are turned from the "
                "hoops around the axis",
                None,
                where="normal",
            )
        if self.families == 2 and not self.is_turned:
            remedy = "normal" if self.axis is None else "helix = true"
            raise InputError(
                f"found families = 2; expected {remedy}, too: the families are turned to both sides by "
                "the constant fibre_angle_rad",
                None,
                where="families",
            )

    @property
    def is_turned(self) -> bool:
        """Whether the constant `fibre_angle_rad` turns the fibres."""
        return self.helix or self.normal is not None

    @property
    def energy(self) -> FibreLaw:
        """Energy of the fibres in their axes."""
        return FibreLaw(
            self.families,
            is_turned=self.is_turned,
            is_exponential=self.law == "exponential",
            is_dispersed=self.dispersed,
            tension_only=self.tension_only,
        )

    def axes(self, mesh: TetMesh, cells: Index) -> Array:
        """Return the axes (k, 3, 3) of the fibres in cells (k,) of a mesh: columns x, y and z.

        Raises
        ------
        InputError
            For an unknown name, vectors of another number of cells, a direction of length zero, or
            one that is parallel to the normal.
        """
        if self.axis is not None:
            along = np.asarray(self.axis, dtype=float)
            radial = mesh.centres_m[cells] - np.asarray(self.axis_point_m)
            first = np.cross(along, radial)
            normal = np.cross(first, along)
            names = ("axis", "axis")
        else:
            first = _vectors(self.direction, mesh, "direction")[cells]
            third = None if self.normal is None else _vectors(self.normal, mesh, "normal")[cells]
            # Without a normal any perpendicular vector will do.
            normal = np.eye(3)[np.abs(first).argmin(axis=1)] if third is None else third
            names = ("direction", "normal")
        x = _normalised(first, names[0], cells)
        across = normal - np.sum(normal * x, axis=1, keepdims=True) * x
        sizes = [np.linalg.norm(each, axis=1, keepdims=True) for each in (across, normal)]
        z = _normalised(np.where(sizes[0] > 1e-6 * sizes[1], across, 0.0), names[1], cells)
        return np.stack([x, np.cross(z, x), z], axis=2)


def _vectors(given: str | Array | None, mesh: TetMesh, where: str) -> Array:
    """Return vectors (E, 3) of all cells."""
    count = len(mesh.tetrahedra)
    if isinstance(given, str):
        if given not in mesh.cell_arrays:
            raise InputError(
                f"the mesh has no cell array {given!r}; expected one of "
                f"{', '.join(mesh.cell_arrays) or '(none)'}",
                None,
                where=where,
            )
        given = np.asarray(mesh.cell_arrays[given], dtype=float)
    assert given is not None
    if given.shape not in ((3,), (count, 3)):
        raise InputError(
            f"found an array {given.shape}; expected one vector (3,), or one for each cell "
            f"({count}, 3)",
            None,
            where=where,
        )
    return np.broadcast_to(given, (count, 3))


def _normalised(vectors: Array, where: str, cells: Index) -> Array:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    if not (np.isfinite(lengths).all() and (lengths > 0).all()):
        cell = int(cells[np.flatnonzero(~(lengths[:, 0] > 0))[0]])
        raise InputError(
            f"the fibres of cell {cell} have no direction there: a vector is zero, not finite, or "
            "parallel to the other one; expected a direction, and a normal across it",
            None,
            where=where,
        )
    return vectors / lengths


@dataclass(frozen=True)
class FibreLaw:
    """Energy density of fibres in their axes; see `Fibres` for the attributes."""

    families: int = 1
    is_turned: bool = False
    is_exponential: bool = False
    is_dispersed: bool = False
    tension_only: bool = True

    @property
    def constants(self) -> tuple[Constant, ...]:
        """Constants of the fibres, the same for both families."""
        return (
            FIBRE_STIFFNESS,
            *((FIBRE_EXPONENT,) if self.is_exponential else ()),
            *((FIBRE_DISPERSION,) if self.is_dispersed else ()),
            *((FIBRE_ANGLE,) if self.is_turned else ()),
        )

    def psi(self, F: ca.SX, values: ca.SX) -> ca.SX:
        """Return the energy density (1, 1) at F (3, 3) by the axes of the fibres, from the constants
        (c,) in their order.
        """
        named = {c.name: values[k] for k, c in enumerate(self.constants)}
        stiffness = named[FIBRE_STIFFNESS.name] / 8
        angle = named.get(FIBRE_ANGLE.name, ca.SX(0))
        scatter = named.get(FIBRE_DISPERSION.name, ca.SX(0))
        energy = ca.SX(0)
        for side in (1, -1)[: self.families]:
            along = F @ ca.vertcat(ca.cos(angle), side * ca.sin(angle), 0)
            strain = (1 - 3 * scatter) * (ca.sumsqr(along) - 1)
            if self.is_dispersed:
                strain += scatter * (ca.sumsqr(F) - 3)
            square = strain**2
            if self.tension_only:
                square *= (1 + strain / ca.sqrt(square + ENGAGED**2)) / 2
            if self.is_exponential:
                exponent = named[FIBRE_EXPONENT.name]
                square = (ca.exp(exponent * square) - 1) / exponent
            energy += stiffness * square
        return energy


@dataclass(frozen=True)
class ReinforcedEnergy:
    """Energy density of an isotropic material with fibres, of F by the axes of the fibres."""

    matrix: Material
    fibres: FibreLaw

    def __call__(self, F: ca.SX, **constants: ca.SX) -> ca.SX:
        own = {c.name: constants[c.name] for c in self.matrix.constants}
        values = ca.vertcat(*(constants[c.name] for c in self.fibres.constants))
        return self.matrix.energy(F, **own) + self.fibres.psi(F, values)


@dataclass(frozen=True, eq=False)
class ReinforcedMaterial(Material):
    """Isotropic material with fibres; its constants are those of the matrix, then of the fibres."""

    energy: ReinforcedEnergy = field(repr=False)

    @property
    def matrix(self) -> Material:
        return self.energy.matrix

    @cached_property
    def lame(self) -> ca.Function:
        values = ca.SX.sym("values", len(self.constants))
        return ca.Function("lame", [values], [self.matrix.lame(self._of_matrix(values))])

    def chain_rule(self, F: ca.SX, values: ca.SX) -> ChainRule:
        return self.matrix.chain_rule(F, self._of_matrix(values))

    def psi_in(self, rule: ChainRule, F: ca.SX, values: ca.SX) -> ca.SX:
        own = values[len(self.matrix.constants) :]
        matrix = self.matrix.psi_in(rule, F, self._of_matrix(values))
        return matrix + self.energy.fibres.psi(F, own)

    def _of_matrix(self, values: ca.SX) -> ca.SX:
        return values[: len(self.matrix.constants)]


@lru_cache(256)
def reinforced(matrix: Material, fibres: FibreLaw) -> ReinforcedMaterial:
    """Return a material with fibres, the same object for the same arguments.

    Raises
    ------
    InputError
        If the matrix is not isotropic, or has a constant with the name of one of the fibres.
    """
    taken = {c.name for c in matrix.constants} & {c.name for c in fibres.constants}
    if taken:
        raise InputError(
            f"the material {matrix.name!r} has the constant {sorted(taken)[0]}, as the fibres have; "
            "expected another name for the constant of the material"
        )
    _require_isotropic(matrix)
    return ReinforcedMaterial(
        f"{matrix.name} with fibres",
        ReinforcedEnergy(matrix, fibres),
        constants=(*matrix.constants, *fibres.constants),
    )


def _require_isotropic(matrix: Material) -> None:
    F = np.array([[1.10, 0.05, -0.02], [0.03, 0.95, 0.04], [-0.01, 0.06, 1.02]])
    turn = np.array([[0.6, -0.8, 0.0], [0.48, 0.36, -0.8], [0.64, 0.48, 0.6]])
    values = ca.DM([c.plausible for c in matrix.constants])
    energies = [float(ca.DM(ca.evalf(matrix.psi(ca.SX(G), ca.SX(values))))) for G in (F, F @ turn)]
    if not abs(energies[1] - energies[0]) <= 1e-9 * abs(energies[0]):
        raise InputError(
            f"the material {matrix.name!r} is not isotropic: its energy density at a deformation "
            f"changes from {energies[0]:.6g} to {energies[1]:.6g} if the body is turned before; "
            "expected an isotropic material beside fibres"
        )
