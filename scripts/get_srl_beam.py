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

import numpy as np
from scipy.spatial.transform import Rotation

from collocation_sysid.experiment import write_markers_csv
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
        import ezc3d
    except ImportError:
        sys.exit("reading C3D needs ezc3d: pip install 'collocation-sysid[c3d]'")
    data = ezc3d.c3d(str(recording))
    labels = [
        str(label).replace(" - ", "") for label in data["parameters"]["POINT"]["LABELS"]["value"]
    ]
    rate_hz = float(data["parameters"]["POINT"]["RATE"]["value"][0])
    tracks = np.moveaxis(data["data"]["points"][:3], 0, -1).swapaxes(0, 1)  # frame, marker, xyz
    template = np.array([TEMPLATE_M[label] for label in labels])
    before = tracks[:release].mean(axis=0)
    fit = Rotation.align_vectors(template - template.mean(0), before - before.mean(0))
    world = (tracks - before.mean(axis=0)) @ fit[0].as_matrix().T + template.mean(axis=0)
    write_markers_csv(target, np.arange(len(world)) / rate_hz, labels, world)


if __name__ == "__main__":
    main()
