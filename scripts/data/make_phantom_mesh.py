"""Make the mesh of problems/phantom_compression/whole_stroke.toml: an eighth of a cylinder.

    python scripts make_phantom_mesh [FILE.vtu] [--section coarse]

Triangles of a radial section are rotated about the axis; between two angles each forms a wedge of
three tetrahedra. The triangles are smaller near the edge that rolls onto the platen, and a diagonal
ends there: otherwise one tetrahedron would have two faces at the edge, and it would become flat
when the side wall lies on the platen.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from script_arguments import make_parser

from collocation_sysid.fem.meshes.checks import orient_elements
from collocation_sysid.fem.meshes.mesh import TetMesh

FILE = Path(__file__).parents[2] / "problems" / "phantom_compression" / "eighth.vtu"
# Number of wedges over the quarter circle.
SECTORS = 2
# Radii of the nodes, and their heights above the mid-plane of the specimen, by name of the mesh.
SECTIONS_MM = {
    "coarse": ((0, 13, 20, 25), (0, 8.5, 15)),
    "shipped": ((0, 10, 17, 21.5, 25), (0, 6.5, 11.5, 15)),
    "fine": ((0, 9, 15.5, 19.5, 22.5, 25), (0, 5, 9, 12.3, 15)),
}


def section_triangles(radii: int, heights: int) -> list[tuple[int, int, int]]:
    """Return the triangles of a grid of nodes: two per cell, with the diagonal towards the outer
    edge.

    Node (i, j) of the grid, at radius i and height j, has the index i · heights + j.
    """
    cells = [(i * heights + j, heights) for i in range(radii - 1) for j in range(heights - 1)]
    return [
        triangle
        for low, height_count in cells
        for triangle in (
            (low, low + height_count, low + height_count + 1),
            (low, low + 1, low + height_count + 1),
        )
    ]


def quarter_revolution(radii_mm: tuple[float, ...], heights_mm: tuple[float, ...]) -> TetMesh:
    """Return the mesh of a section that is rotated by 90°, with the volume of the round cylinder.

    The radii are enlarged so that the polygon has the area of the circle.
    """
    radii_m = np.array(radii_mm) / 1e3
    heights_m = np.array(heights_mm) / 1e3
    angle = np.pi / 2 / SECTORS
    radii_m *= np.sqrt(angle / np.sin(angle))
    section_count = len(radii_m) * len(heights_m)
    section_m = np.stack(np.meshgrid(radii_m, heights_m, indexing="ij"), -1).reshape(-1, 2)
    points = []
    tetrahedra = []
    for k in range(SECTORS + 1):
        direction = np.round([np.cos(k * angle), np.sin(k * angle)], 15)
        points.append(np.column_stack([np.outer(section_m[:, 0], direction), section_m[:, 1]]))
    # The nodes on the axis, which come first, are common to all angles.
    node_numbers = np.arange((SECTORS + 1) * section_count).reshape(SECTORS + 1, section_count)
    node_numbers[:, : len(heights_m)] = node_numbers[0, : len(heights_m)]
    for k in range(SECTORS):
        # Wedges are divided alternately in both senses, so that the mesh has no twist.
        here, there = (
            (node_numbers[k], node_numbers[k + 1])
            if k % 2 == 0
            else (node_numbers[k + 1], node_numbers[k])
        )
        for a, b, c in section_triangles(len(radii_m), len(heights_m)):
            a0, b0, c0 = here[[a, b, c]]
            a1, b1, c1 = there[[a, b, c]]
            tetrahedra += [(a0, b0, c0, c1), (a0, b0, b1, c1), (a0, a1, b1, c1)]
    volumetric = np.array([four for four in tetrahedra if len(set(four)) == 4])
    used_nodes, tetrahedra = np.unique(volumetric, return_inverse=True)
    points_m = np.concatenate(points)[used_nodes]
    return TetMesh(points_m, orient_elements(points_m, tetrahedra.reshape(-1, 4))[0])


def main() -> None:
    """Write the mesh with the options of the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("file", type=Path, nargs="?", default=FILE)
    parser.add_argument(
        "--section", choices=sorted(SECTIONS_MM), default="shipped", help="size of the triangles"
    )
    options = parser.parse_args()
    mesh = quarter_revolution(*SECTIONS_MM[options.section])
    mesh.write(options.file)
    print(f"{options.file}: {len(mesh.points_m)} nodes, {len(mesh.tetrahedra)} tetrahedra")


if __name__ == "__main__":
    main()
