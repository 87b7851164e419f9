"""Get the measured beam of problems/srl_beam: copy it from a folder, or download it.

The recordings are public data (MIT licence) of the Soft Robotics Lab, ETH Zurich: repository
srl-ethz/diffPD_sim2real on GitHub, folder python/realbeam_experiments/Measurement_data, from
Dubied et al. 2022, "Sim-to-Real for Soft Robots using Differentiable FEM: Recipes for Meshing,
Damping, and Actuation", arXiv 2201.12560. They are raw C3D files; this script turns them into
the world frame of the problem by a rigid fit of the frames before release to where the markers
were glued. Reading C3D needs the extra: pip install 'collocation-sysid[c3d]'.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import urllib.request
from pathlib import Path

from collocation_sysid.errors import InputError
from collocation_sysid.experiment import align_to_template, read_markers, write_markers_csv
from collocation_sysid.fem.structured import box_mesh

FOLDER = Path(__file__).parents[1] / "problems" / "srl_beam"
COMMIT = "5010a6983e4e4baf82e810ed16ddc4013e0106cb"
SOURCE = (
    f"https://raw.githubusercontent.com/srl-ethz/diffPD_sim2real/{COMMIT}"
    "/python/realbeam_experiments/Measurement_data"
)
# First frame that moves, counted from 0.
RELEASE = {"gravity": 71, "load52": 44, "load101": 51}
# World frame: beam x in [-0.10, 0], y and z in [0, 0.03]; ball centres 6 mm off the surface.
TEMPLATE_M = {
    "Tip1": (0.0, 0.015, 0.036),
    "Tip2": (0.0, -0.006, 0.024),
    "Tip3": (0.0, 0.036, 0.006),
    "Base1": (-0.094, -0.01, -0.001),
    "Base2": (-0.094, 0.04, 0.0275),
    "Base3": (-0.094, 0.04, 0.0),
}
LABELS = {
    f"{part} - {number}": f"{part}{number}" for part in ("Tip", "Base") for number in (1, 2, 3)
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--from", dest="source", type=Path, help="a folder that has the files")
    arguments = parser.parse_args()
    box_mesh((0.10, 0.03, 0.03), (6, 2, 2), origin_m=(-0.10, 0.0, 0.0)).write(FOLDER / "beam.vtu")
    for trial, release in RELEASE.items():
        target = FOLDER / f"{trial}_markers.csv"
        name = f"beam_{trial}_V2_a"
        if arguments.source is None:
            with tempfile.TemporaryDirectory() as folder:
                recording = Path(folder) / f"{name}.c3d"
                urllib.request.urlretrieve(f"{SOURCE}/{name}.c3d", recording)
                convert(recording, release, target)
        elif (arguments.source / f"{name}_world_m.csv").is_file():
            target.write_bytes((arguments.source / f"{name}_world_m.csv").read_bytes())
        elif (arguments.source / f"{name}.c3d").is_file():
            convert(arguments.source / f"{name}.c3d", release, target)
        else:
            sys.exit(f"{arguments.source} has neither {name}_world_m.csv nor {name}.c3d")
        print(target)


def convert(recording: Path, release: int, target: Path) -> None:
    """Write a C3D recording as CSV in the world frame."""
    try:
        raw = read_markers(recording, labels=LABELS)
    except InputError as error:
        sys.exit(str(error))
    before_s = (0.0, raw.t_s[release - 1])
    table = align_to_template(raw, TEMPLATE_M, before_s).apply(raw)
    write_markers_csv(target, table.t_s, table.names, table.positions_m)


if __name__ == "__main__":
    main()
