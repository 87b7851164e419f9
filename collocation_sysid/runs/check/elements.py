"""What the elements do to the answer: flat ones, locking near ν = 0.5, locking in bending."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...arrays import Array
from ...fem.body import Body
from ...fem.mesh import TetMesh
from ...fem.mesh_checks import edge_lengths, mean_ratios
from ...fem.moduli import engineering

# Mean-ratio quality below which an element's shape functions are poor.
FLAT = 0.1
# Too stiff from this Poisson's ratio on: linear tetrahedra cannot keep their volume and bend;
# with quadratic ones a beam's stiffness is found 6 % too low at 0.45, and 12 % at 0.49.
LOCKING_POISSON = {"tet4": 0.4, "tet10": 0.45}
# 0.45 by way of E, λ and μ may be a little less.
ROUND_OFF = 1e-9
# A body this many times as long as thick bends. Linear elements need this many across it, and where
# the dilatation is averaged one across sags by half too much, two by 4 to 8 %.
SLENDER, CELLS_ACROSS = 2.5, {"tet4": 4.0, "tet10-p0": 2.0}
LINEAR = "tet4"
FOR_BENDING, FOR_VOLUME = 'set object.element = "tet10"', 'set object.element = "tet10-p0"'

_FACES = ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))


@dataclass(frozen=True)
class ElementShape:
    """How far an element is from the regular tetrahedron.

    Attributes
    ----------
    element : int
        Its number, counted from 0.
    quality : float
        Mean ratio: 1 for the regular tetrahedron, towards 0 the flatter it is.
    aspect_ratio : float
        Longest edge over smallest height: 1.22 for the regular tetrahedron.
    longest_edge_m : float
    """

    element: int
    quality: float
    aspect_ratio: float
    longest_edge_m: float


@dataclass(frozen=True)
class Slenderness:
    """How slender a body is, and how many elements share its thickness.

    Attributes
    ----------
    length_m, thickness_m : float
    cells_across : float
        Thickness over the size of a cell of six tetrahedra.
    """

    length_m: float
    thickness_m: float
    cells_across: float


def worst_elements(mesh: TetMesh, count: int = 3) -> tuple[ElementShape, ...]:
    """The elements of lowest quality, worst first."""
    corners = mesh.points_m[mesh.tetrahedra]
    areas = [_areas(corners[:, face]) for face in _FACES]
    heights = 3 * mesh.volumes_m3 / np.max(areas, axis=0)
    quality = mean_ratios(mesh.points_m, mesh.tetrahedra)
    longest = edge_lengths(mesh.points_m, mesh.tetrahedra).max(axis=1)
    return tuple(
        ElementShape(int(e), float(quality[e]), float(longest[e] / heights[e]), float(longest[e]))
        for e in np.argsort(quality, kind="stable")[:count]
    )


def slenderness(mesh: TetMesh) -> Slenderness:
    """Length and thickness of a body, and elements across."""
    # Edges of the box with the same second moments, however it is turned.
    edges = np.sqrt(12 * np.linalg.eigvalsh(_covariance(mesh)))
    # A bent or hollow body is thinner than its extents: six times volume over surface is a cube's
    # edge, and more than the thickness of beams and plates.
    area = float(_areas(mesh.points_m[mesh.surface]).sum())
    thickness = min(float(edges[0]), 6 * mesh.volume_m3 / area)
    cell = float(np.cbrt(6 * np.median(mesh.volumes_m3)))
    return Slenderness(float(edges[-1]), thickness, thickness / cell)


def element_warnings(
    body: Body, theta: Array, shape: Slenderness, worst: ElementShape
) -> list[str]:
    """What the elements will do to the answer, one sentence each."""
    warnings = []
    if worst.quality < FLAT:
        warnings.append(
            f"element {worst.element} is nearly flat (mean-ratio quality {worst.quality:.2g}, "
            f"aspect ratio {worst.aspect_ratio:.0f}), which makes the body stiffer and Newton's "
            "steps short: improve the mesh there"
        )
    name = body.element.name
    poisson = max(engineering(*lame)[1] for lame in body.lame(theta).values())
    if name in LOCKING_POISSON and poisson >= LOCKING_POISSON[name] - ROUND_OFF:
        warnings.append(
            f"Poisson's ratio is {poisson:.3g} at the guess and {name} elements lock from "
            f"{LOCKING_POISSON[name]:g} on, so that the stiffness found will be too low: "
            f"{FOR_VOLUME}"
        )
    needed = CELLS_ACROSS.get(name, 0.0)
    if shape.length_m > SLENDER * shape.thickness_m and shape.cells_across < needed - ROUND_OFF:
        off, found = ("stiff", "low") if name == LINEAR else ("soft", "high")
        instead = f"{FOR_BENDING}, or refine" if name == LINEAR else "refine"
        warnings.append(
            f"only about {shape.cells_across:.1f} {name} elements lie across the body's "
            f"{1e3 * shape.thickness_m:.3g} mm, too {off} in bending, so that the stiffness found "
            f"of a real body will be too {found} (not of data simulated with these elements, which "
            f"are as {off}): {instead} the mesh to {needed:.0f} or more"
        )
    return warnings


def _covariance(mesh: TetMesh) -> Array:
    """Mean of (x − x̄)(x − x̄)ᵀ over the volume, (3, 3) [m²]."""
    shares = mesh.volumes_m3 / mesh.volume_m3
    corners = mesh.points_m[mesh.tetrahedra]
    corners = corners - shares @ corners.mean(axis=1)
    # Over a tetrahedron the mean of x xᵀ is (Σ xᵢ xᵢᵀ + Σ xᵢ Σ xᵢᵀ) / 20.
    sums = corners.sum(axis=1)
    squares = np.einsum("e,eci,ecj->ij", shares, corners, corners)
    return (squares + np.einsum("e,ei,ej->ij", shares, sums, sums)) / 20


def _areas(triangles: Array) -> Array:
    """Areas of triangles (k, 3, 3)."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return np.linalg.norm(normals, axis=1) / 2
