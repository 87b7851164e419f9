"""Get the measured silicone bars of problems/silicone_depth from a folder that has their files.

They are public data (GPL-3) of Arnavaz, Kragballe Nielsen, Kry, Macklin and Erleben 2023,
"Differentiable Depth for Real2Sim Calibration of Soft Body Simulations", Computer Graphics Forum
42(1): repository diku-dk/DiffCal, commit 5f810dcf577e208b0225ee6bdfd91ad854df2bc8. The folder has,
of each image, NAME.npz (depth_counts, count_m) and NAME.json (camera and object). Written are the
images with their cameras in the frame of the hanging bars, and a mesh of the bar.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from collocation_sysid.fem.mesh import TetMesh
from collocation_sysid.fem.structured import box_mesh

FOLDER = Path(__file__).parents[1] / "problems" / "silicone_depth"
IMAGES = ("h_e_c", "h_m_c", "h_em_c", "t_em_c")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--from", dest="source", type=Path, required=True, help="the folder")
    source = parser.parse_args().source
    missing = [name for name in IMAGES if not (source / f"{name}.json").is_file()]
    if missing:
        sys.exit(f"{source} has no {missing[0]}.json")
    told = {name: json.loads((source / f"{name}.json").read_text()) for name in IMAGES}
    to_world = np.array(told[IMAGES[0]]["mesh_to_object"])
    for name, said in told.items():
        to_camera = np.array(said["object_to_camera"]) @ np.array(said["mesh_to_object"])
        seen = np.load(source / f"{name}.npz")
        np.savez_compressed(
            FOLDER / f"{name}.npz",
            depth_counts=seen["depth_counts"],
            count_m=seen["count_m"],
            camera_matrix=np.array(said["camera_matrix"]),
            camera_pose=to_world @ np.linalg.inv(to_camera),
        )
        print(FOLDER / f"{name}.npz")
    bar(to_world, 1).write(FOLDER / "bar_coarse.vtu")
    bar(to_world, 2).write(FOLDER / "bar.vtu")


def bar(motion: np.ndarray, fine: int = 2) -> TetMesh:
    """The bar in the frame of the object: 30 mm square between heads of 60 mm, one in the clamp."""
    bricks = 6 * fine, 4, fine
    grid = box_mesh((6.0, 2.0, 1.0), bricks)
    along, up, across = grid.points_m.T
    own = np.column_stack(
        [
            np.interp(along, [0, 1, 6], [-0.1, -0.07, 0.07]),
            0.03 * up - 0.03,
            0.03 * across - 0.015,
        ]
    )
    middles = own[grid.tetrahedra].mean(axis=1)
    cells = grid.tetrahedra[(middles[:, 0] < -0.07) | (np.abs(middles[:, 1]) < 0.015)]
    masks = {
        "clamped": own[:, 0] >= 0.07 - 1e-9,
        "turned": own[:, 0] <= -0.07 + 1e-9,
        "free": own[:, 0] >= -0.07 - 1e-9,
    }
    near = (own[cells].mean(axis=1)[:, 0] > 0).astype(np.int8)
    placed = own @ motion[:3, :3].T + motion[:3, 3]
    named = {name: mask.astype(np.int8) for name, mask in masks.items()}
    return TetMesh(placed, cells, named, {"near": near})


if __name__ == "__main__":
    main()
