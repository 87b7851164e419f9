"""Get the measured beam of problems/srl_beam: copy its recordings from a folder, or download them.

They are public data (MIT licence) of the Soft Robotics Lab, ETH Zurich: repository
srl-ethz/diffPD_sim2real on GitHub, folder python/realbeam_experiments/Measurement_data, from
Dubied et al. 2022, "Sim-to-Real for Soft Robots using Differentiable FEM: Recipes for Meshing,
Damping, and Actuation", arXiv 2201.12560. The problem files read the C3D files as they are, with
the extra: pip install 'collocation-sysid[c3d]'. The meshes are written here too.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from script_arguments import fetched_files

from collocation_sysid.fem.meshes.structured import box_mesh

FOLDER = Path(__file__).parents[2] / "problems" / "srl_beam"
COMMIT = "5010a6983e4e4baf82e810ed16ddc4013e0106cb"
SOURCE = (
    f"https://raw.githubusercontent.com/srl-ethz/diffPD_sim2real/{COMMIT}"
    "/python/realbeam_experiments/Measurement_data"
)
RECORDINGS = tuple(f"beam_{trial}_V2_a.c3d" for trial in ("gravity", "load52", "load101"))
# Edges of the beam and the corner with the smallest coordinates [m].
SIZE_M = (0.10, 0.03, 0.03)
ORIGIN_M = (-0.10, 0.0, 0.0)
MESHES = {"beam.vtu": (5, 2, 2), "beam_coarse.vtu": (3, 1, 1)}


def main() -> None:
    for file in fetched_files(__doc__, {name: f"{SOURCE}/{name}" for name in RECORDINGS}):
        print(shutil.copyfile(file, FOLDER / file.name))
    for name, divisions in MESHES.items():
        box_mesh(SIZE_M, divisions, ORIGIN_M).write(FOLDER / name)


if __name__ == "__main__":
    main()
