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

import json
import sys
from pathlib import Path

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter
from script_arguments import make_parser

from collocation_sysid.common.array_types import Array
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import box_mesh

FOLDER = Path(__file__).parents[2] / "problems" / "silicone_depth"
IMAGES = ("h_e_c", "h_m_c", "h_em_c", "t_em_c")
# Edge of the clamp on the bar [m].
CLAMP_M = np.array([0.07, 0.0, 0.0])
# Planes are fitted to squares of 2 · 6 + 1 pixels, at every second pixel. A square is on one face
# if its depths differ by less than the first length, and its points are closer to the plane than
# the second one (root mean square).
HALF_WIDTH_PX = 6
STEP_PX = 2
FACE_DEPTH_RANGE_M = 0.02
FACE_ROUGHNESS_M = 0.002
# Largest angles of a normal from an axis in successive iterations [degrees].
ANGLE_LIMITS_DEG = (15, 12, 10, 8, 6, 5, 4, 3, 3, 3, 3, 3)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--from", dest="source", type=Path, required=True, help="the folder")
    source = parser.parse_args().source
    missing = [name for name in IMAGES if not (source / f"{name}.json").is_file()]
    if missing:
        sys.exit(f"{source} has no {missing[0]}.json")
    descriptions = {name: json.loads((source / f"{name}.json").read_text()) for name in IMAGES}
    to_world = np.array(descriptions[IMAGES[0]]["mesh_to_object"])
    for name, description in descriptions.items():
        stated_pose = np.array(description["object_to_camera"]) @ np.array(
            description["mesh_to_object"]
        )
        image_data = np.load(source / f"{name}.npz")
        matrix = np.array(description["camera_matrix"])
        to_camera = np.eye(4)
        depth_m = image_data["depth_counts"] * float(image_data["count_m"])
        rotation = aligned_rotation(face_normals(depth_m, matrix), stated_pose[:3, :3])
        to_camera[:3, :3] = rotation
        to_camera[:3, 3] = (stated_pose[:3, :3] - rotation) @ CLAMP_M + stated_pose[:3, 3]
        np.savez_compressed(
            FOLDER / f"{name}.npz",
            depth_counts=image_data["depth_counts"],
            count_m=image_data["count_m"],
            camera_matrix=matrix,
            camera_pose=to_world @ np.linalg.inv(to_camera),
        )
        print(FOLDER / f"{name}.npz")
    bar(to_world, 1).write(FOLDER / "bar_coarse.vtu")
    bar(to_world, 2).write(FOLDER / "bar.vtu")


def face_normals(depth_m: Array, matrix: Array) -> Array:
    """Return the normals (P, 3) of flat faces in an image, in the frame of the camera, of either
    sign.
    """
    v, u = np.indices(depth_m.shape)
    rays = np.linalg.solve(matrix, np.stack([u, v, np.ones_like(u)]).reshape(3, -1)).T
    points = rays.reshape(*depth_m.shape, 3) * depth_m[..., None]
    size = 2 * HALF_WIDTH_PX + 1
    smallest_depth, largest_depth = (
        each(depth_m, size) for each in (minimum_filter, maximum_filter)
    )
    is_tested = np.zeros(depth_m.shape, dtype=bool)
    is_tested[HALF_WIDTH_PX:-HALF_WIDTH_PX:STEP_PX, HALF_WIDTH_PX:-HALF_WIDTH_PX:STEP_PX] = True
    fitted_pixels = np.nonzero(
        is_tested & (smallest_depth > 0) & (largest_depth - smallest_depth < FACE_DEPTH_RANGE_M)
    )
    mean = [uniform_filter(points[..., i], size)[fitted_pixels] for i in range(3)]
    covariance = [
        [
            uniform_filter(points[..., i] * points[..., j], size)[fitted_pixels] - mean[i] * mean[j]
            for j in range(3)
        ]
        for i in range(3)
    ]
    values, vectors = np.linalg.eigh(np.moveaxis(np.array(covariance), 2, 0))
    return vectors[np.sqrt(np.maximum(values[:, 0], 0)) < FACE_ROUGHNESS_M, :, 0]


def aligned_rotation(normals: Array, rotation: Array) -> Array:
    """Return the rotation (3, 3), close to a given one, whose axes are parallel to most face
    normals.
    """
    for degrees in ANGLE_LIMITS_DEG:
        cosines = normals @ rotation
        nearest = np.abs(cosines).argmax(axis=1)
        cosine = np.take_along_axis(cosines, nearest[:, None], axis=1)
        is_aligned = np.abs(cosine[:, 0]) > np.cos(np.radians(degrees))
        columns = []
        for axis in range(3):
            is_of_axis = is_aligned & (nearest == axis)
            mean = (normals * np.sign(cosine))[is_of_axis].sum(axis=0)
            columns.append(mean / np.sqrt(max(is_of_axis.sum(), 1)))
        u, _, vt = np.linalg.svd(np.column_stack(columns))
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return rotation


def bar(motion: np.ndarray, refinement: int = 2) -> TetMesh:
    """Return the mesh of the bar: 30 mm square between heads of 60 mm, of which one is in the
    clamp.
    """
    bricks = 6 * refinement, 4, refinement
    grid = box_mesh((6.0, 2.0, 1.0), bricks)
    axial, up, across = grid.points_m.T
    points_m = np.column_stack(
        [np.interp(axial, [0, 1, 6], [-0.1, -0.07, 0.07]), 0.03 * up - 0.03, 0.03 * across - 0.015]
    )
    centres_m = points_m[grid.tetrahedra].mean(axis=1)
    cells = grid.tetrahedra[(centres_m[:, 0] < -0.07) | (np.abs(centres_m[:, 1]) < 0.015)]
    masks = {
        "clamped": points_m[:, 0] >= 0.07 - 1e-9,
        "turned": points_m[:, 0] <= -0.07 + 1e-9,
        "free": points_m[:, 0] >= -0.07 - 1e-9,
    }
    is_near_half = (points_m[cells].mean(axis=1)[:, 0] > 0).astype(np.int8)
    world_points_m = points_m @ motion[:3, :3].T + motion[:3, 3]
    point_arrays = {name: mask.astype(np.int8) for name, mask in masks.items()}
    return TetMesh(world_points_m, cells, point_arrays, {"near": is_near_half})


if __name__ == "__main__":
    main()
