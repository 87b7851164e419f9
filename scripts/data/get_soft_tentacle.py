"""Get the measured tentacle of problems/soft_tentacle: its recordings from a folder, and its mesh.

They are public data (MIT licence) of TU Delft: repository tud-phi/soromox on GitHub, commit
4f03054aa9c04eaaa7415d3ea622aea31fc4011b, folder
paper_results/secVa_system_identification/data. Each recording is one equilibrium: its mean is
written as one row, in the frame of the clamped section, z upwards.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from script_arguments import make_parser

from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import cylinder_mesh

FOLDER = Path(__file__).parents[2] / "problems" / "soft_tentacle"
# Indices of the groups of columns in each file: of the base marker, then of M1 to M4.
GROUPS = {
    "m1_u01": (4, 0, 3, 1, 2),
    "m1_u015": (3, 2, 4, 1, 0),
    "m1_u02": (3, 2, 4, 1, 0),
    "m1_u025": (4, 3, 0, 2, 1),
    "m2_u01": (2, 0, 4, 3, 1),
    "m2_u015": (3, 2, 4, 1, 0),
    "m2_u02": (3, 2, 4, 1, 0),
    "m2_u025": (2, 1, 3, 0, 4),
}
# Centre of the clamped section, from the base marker [m].
BASE_TO_CENTRE_M = np.array([-0.030, -0.013, 0.0])
# Length of the tentacle [m], and layers of elements.
LENGTH_M = 0.360
LAYERS = 14
# Positions along the axis and radii there [m].
PLACES_M = (0.0, 0.305, 0.360)
RADII_M = (0.01541, 0.00642, 0.00480)
# Factor on the radius of the hexagon for the second moment of area of the circle; a hexagon with
# its corners on the circle has 31 % less bending stiffness.
HEXAGON_FACTOR = (np.pi / 4 / (5 * np.sqrt(3) / 16)) ** 0.25


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--from", dest="source", type=Path, required=True, help="a folder of CSVs")
    source = parser.parse_args().source
    tentacle().write(FOLDER / "tentacle.vtu")
    for name, groups in GROUPS.items():
        file = source / f"{name}.csv"
        if not file.is_file():
            sys.exit(f"{source} has no {file.name}")
        columns = ["t_s", *(f"M{k}_{axis}" for k in range(1, 5) for axis in "xyz")]
        row = [0.0, *markers_m(file, groups).ravel()]
        text = ",".join(columns) + "\n" + ",".join(f"{value:.6f}" for value in row) + "\n"
        (FOLDER / f"{name}_markers.csv").write_text(text)
        print(FOLDER / f"{name}_markers.csv")


def markers_m(file: Path, groups: tuple[int, ...]) -> np.ndarray:
    """Return the mean positions (4, 3) of M1 to M4 from the centre of the clamped section [m].

    `groups` are the indices of the column groups of the base marker and of M1 to M4.
    """
    means_m = np.loadtxt(file, delimiter=",")[:, 2:].mean(axis=0).reshape(5, 3)[list(groups)]
    x, y, z = (means_m[1:] - means_m[0] - BASE_TO_CENTRE_M).T
    return np.column_stack([x, z, -y])


def tentacle() -> TetMesh:
    """Return a hexagonal tentacle that hangs from z = 0, with layers as long as their diameter
    there.
    """
    mesh = cylinder_mesh(1.0, float(LAYERS), 1, LAYERS)
    axial_grid_m = np.linspace(0, LENGTH_M, 2001)
    radius_grid_m = np.interp(axial_grid_m, PLACES_M, RADII_M)
    layer_number = np.concatenate(
        [[0], np.cumsum(np.diff(axial_grid_m) / (radius_grid_m[1:] + radius_grid_m[:-1]))]
    )
    axial_m = np.interp(mesh.points_m[:, 2] / LAYERS, layer_number / layer_number[-1], axial_grid_m)
    radii_m = HEXAGON_FACTOR * np.interp(axial_m, PLACES_M, RADII_M)
    points = np.column_stack([mesh.points_m[:, :2] * radii_m[:, None], -axial_m])
    return TetMesh(points, mesh.tetrahedra)


if __name__ == "__main__":
    main()
