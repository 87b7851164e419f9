"""Get the measured silicone bars of problems/silicone_depth from a folder that has their files.

They are public data (GPL-3) of Arnavaz, Kragballe Nielsen, Kry, Macklin and Erleben 2023,
"Differentiable Depth for Real2Sim Calibration of Soft Body Simulations", Computer Graphics Forum
42(1): repository diku-dk/DiffCal, commit 5f810dcf577e208b0225ee6bdfd91ad854df2bc8. The folder has,
of each image, NAME.npz (depth_counts, count_m) and NAME.json (camera and object). Written are the
images with their cameras in the frame of the hanging bars, and a mesh of the bar. A camera is
turned as the frame around the bar says, whose faces are upright, level, and along the bar in each
image; the cameras that come with the images are some degrees off it.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from collocation_sysid.common.array_types import Array
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import box_mesh

FOLDER = Path(__file__).parents[1] / "problems" / "silicone_depth"
IMAGES = ("h_e_c", "h_m_c", "h_em_c", "t_em_c")
# Where the clamp begins on the bar.
CLAMP_M = np.array([0.07, 0.0, 0.0])
# Planes are fitted to so many pixels either way, every few of them; they are those of one face
# where depth differs by less and leaves less beside the plane.
HALF = 6
EVERY = 2
DEEP_M = 0.02
ROUGH_M = 0.002
# Normals count that are within these angles [degrees] of an axis, in turn.
WITHIN = (15, 12, 10, 8, 6, 5, 4, 3, 3, 3, 3, 3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--from", dest="source", type=Path, required=True, help="the folder"
    )
    source = parser.parse_args().source
    missing = [
        name for name in IMAGES if not (source / f"{name}.json").is_file()
    ]
    if missing:
        sys.exit(f"{source} has no {missing[0]}.json")
    told = {
        name: json.loads((source / f"{name}.json").read_text())
        for name in IMAGES
    }
    to_world = np.array(told[IMAGES[0]]["mesh_to_object"])
    for name, said in told.items():
        stated = np.array(said["object_to_camera"]) @ np.array(
            said["mesh_to_object"]
        )
        seen = np.load(source / f"{name}.npz")
        matrix = np.array(said["camera_matrix"])
        to_camera = np.eye(4)
        depth_m = seen["depth_counts"] * float(seen["count_m"])
        turned = upright(face_normals(depth_m, matrix), stated[:3, :3])
        to_camera[:3, :3] = turned
        to_camera[:3, 3] = (stated[:3, :3] - turned) @ CLAMP_M + stated[:3, 3]
        np.savez_compressed(
            FOLDER / f"{name}.npz",
            depth_counts=seen["depth_counts"],
            count_m=seen["count_m"],
            camera_matrix=matrix,
            camera_pose=to_world @ np.linalg.inv(to_camera),
        )
        print(FOLDER / f"{name}.npz")
    bar(to_world, 1).write(FOLDER / "bar_coarse.vtu")
    bar(to_world, 2).write(FOLDER / "bar.vtu")


def face_normals(depth_m: Array, matrix: Array) -> Array:
    """Normals (P, 3) of the flat faces in an image, in the camera's frame, of either sign."""
    v, u = np.indices(depth_m.shape)
    rays = np.linalg.solve(
        matrix, np.stack([u, v, np.ones_like(u)]).reshape(3, -1)
    ).T
    points = rays.reshape(*depth_m.shape, 3) * depth_m[..., None]
    size = 2 * HALF + 1
    near, far = (
        each(depth_m, size) for each in (minimum_filter, maximum_filter)
    )
    inside = np.zeros(depth_m.shape, dtype=bool)
    inside[HALF:-HALF:EVERY, HALF:-HALF:EVERY] = True
    here = np.nonzero(inside & (near > 0) & (far - near < DEEP_M))
    mean = [uniform_filter(points[..., i], size)[here] for i in range(3)]
    spread = [
        [
            uniform_filter(points[..., i] * points[..., j], size)[here]
            - mean[i] * mean[j]
            for j in range(3)
        ]
        for i in range(3)
    ]
    values, vectors = np.linalg.eigh(np.moveaxis(np.array(spread), 2, 0))
    return vectors[np.sqrt(np.maximum(values[:, 0], 0)) < ROUGH_M, :, 0]


def upright(normals: Array, rotation: Array) -> Array:
    """The rotation near one given whose axes most faces are across."""
    for degrees in WITHIN:
        cosines = normals @ rotation
        nearest = np.abs(cosines).argmax(axis=1)
        along = np.take_along_axis(cosines, nearest[:, None], axis=1)
        near = np.abs(along[:, 0]) > np.cos(np.radians(degrees))
        columns = []
        for axis in range(3):
            own = near & (nearest == axis)
            mean = (normals * np.sign(along))[own].sum(axis=0)
            columns.append(mean / np.sqrt(max(own.sum(), 1)))
        left, _, right = np.linalg.svd(np.column_stack(columns))
        rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    return rotation


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
    cells = grid.tetrahedra[
        (middles[:, 0] < -0.07) | (np.abs(middles[:, 1]) < 0.015)
    ]
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
