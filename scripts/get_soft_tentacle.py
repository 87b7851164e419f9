"""Get the measured tentacle of problems/soft_tentacle: its recordings from a folder, and its mesh.

They are public data (MIT licence) of TU Delft: repository tud-phi/soromox on GitHub, commit
4f03054aa9c04eaaa7415d3ea622aea31fc4011b, folder
paper_results/secVa_system_identification/data. Each recording is one equilibrium: its mean is
written as one row, in the frame of the clamped section, z upwards.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import cylinder_mesh

FOLDER = Path(__file__).parents[1] / "problems" / "soft_tentacle"
# The group of columns in each file that is the base marker, then M1 to M4.
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
BASE_TO_CENTRE_M = np.array([-0.030, -0.013, 0.0])
LENGTH_M = 0.360
LAYERS = 14
# Places along the axis, and radii there.
PLACES_M = (0.0, 0.305, 0.360)
RADII_M = (0.01541, 0.00642, 0.00480)
# A hexagon through the circle has 31 % less bending stiffness: the same second moment of area.
HEXAGON = (np.pi / 4 / (5 * np.sqrt(3) / 16)) ** 0.25


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--from",
        dest="source",
        type=Path,
        required=True,
        help="a folder of CSVs",
    )
    source = parser.parse_args().source
    tentacle().write(FOLDER / "tentacle.vtu")
    for name, groups in GROUPS.items():
        file = source / f"{name}.csv"
        if not file.is_file():
            sys.exit(f"{source} has no {file.name}")
        columns = [
            "t_s",
            *(f"M{k}_{axis}" for k in range(1, 5) for axis in "xyz"),
        ]
        row = [0.0, *markers_m(file, groups).ravel()]
        text = (
            ",".join(columns)
            + "\n"
            + ",".join(f"{value:.6f}" for value in row)
            + "\n"
        )
        (FOLDER / f"{name}_markers.csv").write_text(text)
        print(FOLDER / f"{name}_markers.csv")


def markers_m(file: Path, groups: tuple[int, ...]) -> np.ndarray:
    """(4, 3) mean places of M1 to M4 from the centre of the clamped section."""
    mean = (
        np.loadtxt(file, delimiter=",")[:, 2:]
        .mean(axis=0)
        .reshape(5, 3)[list(groups)]
    )
    x, y, z = (mean[1:] - mean[0] - BASE_TO_CENTRE_M).T
    return np.column_stack([x, z, -y])


def tentacle() -> TetMesh:
    """A hexagonal tentacle that hangs from z = 0, with layers as long as it is thick there."""
    mesh = cylinder_mesh(1.0, float(LAYERS), 1, LAYERS)
    s = np.linspace(0, LENGTH_M, 2001)
    thickness = np.interp(s, PLACES_M, RADII_M)
    layer = np.concatenate(
        [[0], np.cumsum(np.diff(s) / (thickness[1:] + thickness[:-1]))]
    )
    along = np.interp(mesh.points_m[:, 2] / LAYERS, layer / layer[-1], s)
    radius = HEXAGON * np.interp(along, PLACES_M, RADII_M)
    points = np.column_stack([mesh.points_m[:, :2] * radius[:, None], -along])
    return TetMesh(points, mesh.tetrahedra)


if __name__ == "__main__":
    main()
