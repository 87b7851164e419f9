"""Get the compressed cylinders of problems/phantom_compression, from a folder or by downloading.

They are public data (CC BY 4.0): repository abubakardawood/tissue-phantom-material-database on
GitHub, Dawood et al. 2026, "Hyperelastic Characterisation of Silicone Tissue Phantoms: A Parametric
Database with Model Selection and Inverse Design Framework". Of each run the crosshead and the load
are written every half millimetre of the stroke, as the model needs them: downwards, and a quarter
of the load, since the model is a quarter of the cylinder. The mesh is written here too.
"""

from __future__ import annotations

import argparse
import sys
import urllib.request
from pathlib import Path

import numpy as np

from collocation_sysid.fem.mesh import TetMesh
from collocation_sysid.fem.structured import cylinder_mesh

FOLDER = Path(__file__).parents[1] / "problems" / "phantom_compression"
COMMIT = "52b1271f0f8a966c168e5ddc0886190f12c6551f"
SOURCE = (
    f"https://raw.githubusercontent.com/abubakardawood/tissue-phantom-material-database/{COMMIT}"
    "/data"
)
MATERIALS = ("EF10_0T", "EF30_0T", "EF50_0T")
RUNS = tuple(f"A{k}" for k in range(1, 6))
HEADER_LINES = 8
RADIUS_M, HEIGHT_M = 0.025, 0.030
RINGS, LAYERS, SECTORS = 2, 3, 8
# Of the stroke: one sample every half millimetre, the mean of those within a fortieth of it.
EVERY_MM, WITHIN_MM, LAST_MM = 0.5, 0.0375, 12.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--from", dest="source", type=Path, help="a folder that has the files")
    source = parser.parse_args().source
    quarter_cylinder().write(FOLDER / "quarter.vtu")
    for material in MATERIALS:
        for run in RUNS:
            file = f"{material}_{run}.csv"
            if source is None:
                address = f"{SOURCE}/{material}/{file}"
                text = urllib.request.urlopen(address).read().decode("utf-8")
            elif (source / file).is_file():
                text = (source / file).read_text(encoding="utf-8")
            else:
                sys.exit(f"{source} has no {file}")
            write_run(text, f"{material}_{run}")
            print(FOLDER / f"{material}_{run}_force.csv")


def quarter_cylinder() -> TetMesh:
    """The quarter x, y ≥ 0, as thick as the cylinder: the polygon has the area of the circle."""
    corners = SECTORS * RINGS
    radius_m = RADIUS_M * np.sqrt(2 * np.pi / corners / np.sin(2 * np.pi / corners))
    whole = cylinder_mesh(radius_m, HEIGHT_M, RINGS, LAYERS, SECTORS)
    points_m = np.where(np.abs(whole.points_m) < 1e-12, 0.0, whole.points_m)
    kept = (points_m[whole.tetrahedra][..., :2] >= 0).all(axis=(1, 2))
    return TetMesh(points_m, whole.tetrahedra[kept])


def write_run(text: str, name: str) -> None:
    """Write the crosshead and the load of a run as the problem reads them."""
    t_s, down_mm, load_n = np.loadtxt(
        text.splitlines()[HEADER_LINES:], delimiter=",", usecols=(0, 1, 2)
    ).T
    rows = []
    for wanted in np.arange(EVERY_MM, LAST_MM + WITHIN_MM, EVERY_MM):
        near = np.abs(down_mm - wanted) < WITHIN_MM
        rows.append([t_s[near].mean(), -1e-3 * down_mm[near].mean(), -load_n[near].mean() / 4])
    t, z, f = np.array(rows).T
    for what, column, values in (("crosshead", "z_m", z), ("force", "fz_n", f)):
        np.savetxt(
            FOLDER / f"{name}_{what}.csv",
            np.column_stack([t, values]),
            fmt=("%.4f", "%.7g"),
            delimiter=",",
            header=f"t_s,{column}",
            comments="",
        )


if __name__ == "__main__":
    main()
