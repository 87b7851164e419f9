"""Make the mesh of problems/phantom_compression/whole_stroke.toml: an eighth of a cylinder.

    python scripts/make_phantom_mesh.py [FILE.vtu] [coarse | fine]

Triangles of a radial section are turned about the axis, each into wedges of three tetrahedra. They
are finer towards the edge that rolls onto the platen, and a diagonal ends there: a tetrahedron that
spanned the edge alone would be flat when the side wall lies on the platen.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.mesh_checks import orient_elements

FILE = (
    Path(__file__).parents[1]
    / "problems"
    / "phantom_compression"
    / "eighth.vtu"
)
SECTORS = 2
# Radii and heights above the middle of the specimen's nodes.
SECTIONS_MM = {
    "coarse": ((0, 13, 20, 25), (0, 8.5, 15)),
    "shipped": ((0, 10, 17, 21.5, 25), (0, 6.5, 11.5, 15)),
    "fine": ((0, 9, 15.5, 19.5, 22.5, 25), (0, 5, 9, 12.3, 15)),
}


def section(radii: int, heights: int) -> list[tuple[int, int, int]]:
    """Triangles of a grid: two a cell, on either side of the diagonal towards the edge."""
    cells = [
        (i * heights + j, heights)
        for i in range(radii - 1)
        for j in range(heights - 1)
    ]
    return [
        triangle
        for low, up in cells
        for triangle in (
            (low, low + up, low + up + 1),
            (low, low + 1, low + up + 1),
        )
    ]


def turned(
    radii_mm: tuple[float, ...], heights_mm: tuple[float, ...]
) -> TetMesh:
    """A quarter turn of a section, of the cylinder's volume."""
    radii_m = np.array(radii_mm) / 1e3
    heights_m = np.array(heights_mm) / 1e3
    angle = np.pi / 2 / SECTORS
    radii_m *= np.sqrt(angle / np.sin(angle))
    whole = len(radii_m) * len(heights_m)
    plane = np.stack(
        np.meshgrid(radii_m, heights_m, indexing="ij"), -1
    ).reshape(-1, 2)
    points = []
    tetrahedra = []
    for k in range(SECTORS + 1):
        axis = np.round([np.cos(k * angle), np.sin(k * angle)], 15)
        points.append(
            np.column_stack([np.outer(plane[:, 0], axis), plane[:, 1]])
        )
    # All turns share the axis, whose nodes come first.
    number = np.arange((SECTORS + 1) * whole).reshape(SECTORS + 1, whole)
    number[:, : len(heights_m)] = number[0, : len(heights_m)]
    for k in range(SECTORS):
        # Every second wedge is cut the other way, so that the mesh is not twisted.
        here, there = (
            (number[k], number[k + 1])
            if k % 2 == 0
            else (number[k + 1], number[k])
        )
        for a, b, c in section(len(radii_m), len(heights_m)):
            A, B, C, a_, b_, c_ = *here[[a, b, c]], *there[[a, b, c]]
            tetrahedra += [(A, B, C, c_), (A, B, b_, c_), (A, a_, b_, c_)]
    kept = np.array([four for four in tetrahedra if len(set(four)) == 4])
    used, tetrahedra = np.unique(kept, return_inverse=True)
    points_m = np.concatenate(points)[used]
    return TetMesh(
        points_m, orient_elements(points_m, tetrahedra.reshape(-1, 4))[0]
    )


def main() -> None:
    file = Path(sys.argv[1]) if len(sys.argv) > 1 else FILE
    mesh = turned(*SECTIONS_MM[sys.argv[2] if len(sys.argv) > 2 else "shipped"])
    mesh.write(file)
    print(
        f"{file}: {len(mesh.points_m)} nodes, {len(mesh.tetrahedra)} tetrahedra"
    )


if __name__ == "__main__":
    main()
