"""Homogeneous deformations of standard material tests, and the cell of elements that undergoes
them.

A linear tetrahedron represents a homogeneous deformation gradient F exactly. Its first node stays
at the origin; the others, at the distance `CELL_SIZE_M` along the axes x, y and z, are the columns
of F. Components of F that a test prescribes are prescribed displacements of these nodes; components
that it leaves free follow from equilibrium, which is the condition that the corresponding stresses
vanish. The nominal stress P is proportional to the forces on the nodes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from ..common.array_types import Array
from ..fem.meshes.mesh import TetMesh
from .grasp import Axes

# Distance of the nodes from the origin [m]: answers do not depend on it.
CELL_SIZE_M = 0.01
# Nominal stress P over the force on a node [1/m²]: a node has the force V P ∇N with V = size³ / 6
# and ∇N = 1 / size.
STRESS_PER_FORCE = 6.0 / CELL_SIZE_M**2
AXES = "xyz"


@dataclass(frozen=True)
class HomogeneousDeformation:
    """Deformation of one kind of material test, F = I + H + s (e₁ D₁ + e₂ D₂), apart from its free
    components.
    """

    test: str
    # Components of D₁ that are 1, such as ("zz",): displacement direction, then node.
    first: tuple[str, ...]
    # Components of D₂ that are 1, or −1 with a "-" in front; empty if the test has one strain.
    second: tuple[str, ...] = ()
    scale: float = 1.0  # factor s of the strains
    # tuple of (str, float): components of the constant H with their values, such as those of a
    # pre-stretch.
    held: tuple[tuple[str, float], ...] = ()
    free: str = ""  # axes along which the normal stress vanishes and the stretch is free
    # Other components of F that are free, because their stress vanishes.
    free_shear: tuple[str, ...] = ()
    # Component of the nominal stress that belongs to e₁: its direction, then the normal.
    first_stress: str = "zz"
    second_stress: str = ""  # component of a second nominal stress; empty if there is none
    lateral: str = ""  # axis of the free stretch that may be measured; empty if there is none
    # Initial slope of stress over strain, of an incompressible material, over Young's modulus; NaN
    # if it is not determined by Young's modulus.
    young_ratio: float = 1.0
    # Undeformed area over undeformed length [m] of a specimen whose strain e₁ is the displacement
    # of a test bench over that length, so that the compliance of the bench adds to it; 0 if the
    # strain was measured on the specimen.
    area_over_length_m: float = 0.0
    # Loaded area over the lateral surface of a round specimen, see `shape_factor`; 0 if unknown.
    shape_factor: float = 0.0
    # Quantities of the columns of its file, such as "displacement" and "lateral_strain"; empty
    # without a file.
    columns: tuple[str, ...] = ()

    @property
    def is_displacement(self) -> bool:
        """Whether the strain is the displacement of grips over a length."""
        return bool(self.area_over_length_m) or "displacement" in self.columns

    def per_strain(self) -> Array:
        """Return the derivatives (2, 3, 3) of F by e₁ and by e₂."""
        derivatives = np.zeros((2, 3, 3))
        for k, components in enumerate((self.first, self.second)):
            for component in components:
                derivatives[(k, *_indices(component))] = (
                    -self.scale if "-" in component else self.scale
                )
        return derivatives

    def held_gradient(self) -> Array:
        """Return I + H (3, 3)."""
        gradient = np.eye(3)
        for component, value in self.held:
            gradient[_indices(component)] += value
        return gradient

    def gradients(self, strain: Array, second_strain: Array | None) -> Array:
        """Return F (T, 3, 3) at strains (T,), with 1 in place of free components."""
        second = np.zeros_like(strain) if second_strain is None else second_strain
        strains = np.column_stack([strain, second])
        return self.held_gradient() + np.tensordot(strains, self.per_strain(), axes=1)

    def displaced_nodes(self) -> dict[int, tuple[Array, Array]]:
        """Return for each node of the cell that moves with the strains, by its index from 0, the
        displacement by a unit strain e₁ and by a unit strain e₂, each (3,) [m].
        """
        first, second = CELL_SIZE_M * self.per_strain()
        moving = np.flatnonzero(np.abs(first).max(axis=0) + np.abs(second).max(axis=0))
        return {1 + int(axis): (first[:, axis], second[:, axis]) for axis in moving}

    def pre_stretched(self, axial: float, transverse: float | None) -> HomogeneousDeformation:
        """Return the deformation of a simple-shear test at a constant stretch along the normal of
        the planes that slide, F = (I + γ e_x⊗e_z) diag(t, t, a), with the stretch `transverse` to
        it, that of an incompressible specimen by default.
        """
        across = transverse_stretch(axial, transverse)
        held = (("xx", across - 1), ("yy", across - 1), ("zz", axial - 1))
        return replace(self, scale=axial, held=held, young_ratio=axial * self.young_ratio)

    def prescribed_axes(self, node: int) -> Axes:
        """Return the axes along which a node of the cell is prescribed, by its index from 0: all
        but the own axis of a node on an axis of `free`, and those of `free_shear`.
        """
        own = AXES[node - 1] if node else ""
        free = {axis + axis for axis in self.free} | {*self.free_shear}
        return cast(Axes, "".join(axis for axis in AXES if axis + own not in free))


def _indices(component: str) -> tuple[int, int]:
    """Return the indices of a component of F, such as (0, 2) of "xz" and of "-xz"."""
    direction, node = component.removeprefix("-")
    return AXES.index(direction), AXES.index(node)


def shape_factor(length_m: float, area_m2: float) -> float:
    """Return the area over the lateral surface of a round specimen of this length and area."""
    return float(np.sqrt(area_m2 / np.pi)) / (2 * length_m)


def transverse_stretch(axial: float, transverse: float | None) -> float:
    """Return the stretch across a pre-stretch: 1/√axial, of an incompressible specimen, for None."""
    return axial**-0.5 if transverse is None else transverse


DEFORMATIONS = {
    each.test: each
    for each in (
        HomogeneousDeformation("uniaxial", first=("zz",), free="xy", lateral="x"),
        HomogeneousDeformation(
            "equibiaxial", first=("zz", "xx"), free="y", lateral="y", young_ratio=2.0
        ),
        HomogeneousDeformation(
            "biaxial",
            first=("zz",),
            second=("xx",),
            free="y",
            second_stress="xx",
            lateral="y",
            young_ratio=np.nan,
        ),
        # In axes at 45° to the stretches, so that the force on one node has the shares of both.
        HomogeneousDeformation(
            "biaxial-difference",
            first=("zz", "xx", "xz", "zx"),
            second=("zz", "xx", "-xz", "-zx"),
            scale=0.5,
            free="y",
            lateral="y",
            young_ratio=np.nan,
        ),
        HomogeneousDeformation(
            "planar",
            first=("zz",),
            free="y",
            second_stress="xx",
            lateral="y",
            young_ratio=4.0 / 3.0,
        ),
        HomogeneousDeformation(
            "simple-shear", first=("xz",), first_stress="xz", young_ratio=1.0 / 3.0
        ),
        HomogeneousDeformation("confined", first=("zz",), young_ratio=np.nan),
        HomogeneousDeformation("volumetric", first=("xx", "yy", "zz"), young_ratio=np.nan),
    )
}
TESTS = tuple(DEFORMATIONS)


def cell_mesh(*, with_inner_node: bool) -> TetMesh:
    """Return the cell: one tetrahedron of 4 nodes, or, `with_inner_node`, four tetrahedra that
    share a fifth node at its centre.

    The additional node follows the homogeneous deformation and does not change the forces on the
    others.
    """
    points_m = CELL_SIZE_M * np.vstack([np.zeros(3), np.eye(3)])
    tetrahedra = np.array([[0, 1, 2, 3]])
    if with_inner_node:
        points_m = np.vstack([points_m, points_m.mean(axis=0)])
        tetrahedra = np.array([[4, 1, 2, 3], [0, 4, 2, 3], [0, 1, 4, 3], [0, 1, 2, 4]])
    return TetMesh(points_m, tetrahedra)
