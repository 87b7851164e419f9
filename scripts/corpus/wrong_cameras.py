"""Errors in the description of a depth camera or in its images.

Each entry of `DEPTH_FAULTS` takes a problem with one depth camera whose images are stored, and
returns the problem with one error in its description. `MOVING_FAULTS` need
several images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from wrong_twins import ExperimentChange, Fault, Rng

from collocation_sysid.common.array_types import Array
from collocation_sysid.recording import Depth, DepthCamera, Experiment

# A camera frame with x to the right, y up and z backwards, as in OpenGL.
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
# A camera frame with x forward, y to the left and z up, as of robots, in the columns.
FORWARD_LEFT_UP = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
# Factor of depths in millimetres that are stated as metres.
MILLIMETRES_PER_METRE = 1e3
# Distance of a wall behind the bar from the camera [m]: less than the gate behind its far end.
WALL_M = 0.50
# Delay of the camera's clock [s]: two intervals between the images of `depth_twins.swinging_twin`.
LATE_S = 0.1


def described(
    depth: Depth,
    images_m: Array | None = None,
    matrix: Array | None = None,
    pose: Array | None = None,
) -> Depth:
    """Return the depth camera with other images (S, rows, columns) [m], another matrix (3, 3) or
    another pose (4, 4); None leaves them unchanged.
    """
    camera = depth.camera
    return Depth.of_images(
        depth.name,
        np.array(depth.images_m) if images_m is None else images_m,
        DepthCamera(
            camera.matrix if matrix is None else matrix, pose=camera.pose if pose is None else pose
        ),
        depth.sigma_m,
        depth.sample_times_s,
        spacing_m=depth.spacing_m,
        background=depth.background,
    )


def depths(change: Callable[[Depth], Depth]) -> ExperimentChange:
    """Return the change of every depth camera of an experiment."""

    def changed(experiment: Experiment, rng: Rng) -> Experiment:
        return replace(experiment, depths=[change(each) for each in experiment.depths])

    return changed


def images(change: Callable[[Array], Array]) -> ExperimentChange:
    """Return the change of the images (S, rows, columns) of every depth camera."""
    return depths(
        lambda depth: described(depth, images_m=change(np.array(depth.images_m, dtype=float)))
    )


def poses(change: Callable[[Array], Array]) -> ExperimentChange:
    """Return the change of the stated pose (4, 4) of every depth camera."""
    return depths(lambda depth: described(depth, pose=change(depth.camera.pose)))


def with_focal_lengths_times(factor: float) -> ExperimentChange:
    """Return the change of both focal lengths, as of an image that was scaled after calibration."""
    scale = np.array([[factor, 1.0, 1.0], [1.0, factor, 1.0], [1.0, 1.0, 1.0]])
    return depths(lambda depth: described(depth, matrix=scale * depth.camera.matrix))


def with_mirrored_principal_point(depth: Depth) -> Depth:
    """Return the camera with its principal point counted from the opposite corner of the image."""
    rows, columns = np.shape(depth.images_m[0])  # type: ignore[arg-type]
    matrix = np.array(depth.camera.matrix)
    matrix[:2, 2] = [columns - 1, rows - 1] - matrix[:2, 2]
    return described(depth, matrix=matrix)


def with_ray_lengths(depth: Depth) -> Depth:
    """Return the camera with distances along the rays in place of depths along the optical axis."""
    rows, columns = np.shape(depth.images_m[0])  # type: ignore[arg-type]
    v, u = np.mgrid[:rows, :columns]
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    rays = depth.camera.points_at_unit_depth(pixels)
    lengths = np.linalg.norm(rays, axis=1).reshape(rows, columns)
    return described(depth, images_m=lengths * np.array(depth.images_m))


def with_wall(images_m: Array) -> Array:
    """Return the images with a wall behind the body, which was not removed."""
    return np.where(np.isfinite(images_m), images_m, WALL_M)


def with_inverse_pose(pose: Array) -> Array:
    """Return the inverse of a pose, from the world to the camera."""
    inverse: Array = np.asarray(np.linalg.inv(pose), dtype=np.float64)
    return inverse


def with_axes_of_robot(pose: Array) -> Array:
    """Return the pose of a frame with x forward, y to the left and z up."""
    return pose @ FORWARD_LEFT_UP


def with_transposed_rotation(pose: Array) -> Array:
    """Return the pose with its rotation transposed, as of a matrix read column by column."""
    transposed = pose.copy()
    transposed[:3, :3] = pose[:3, :3].T
    return transposed


def with_turned_camera(pose: Array) -> Array:
    """Return the pose of a camera that was bumped: turned by 15 degrees about its optical axis."""
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec([0, 0, np.radians(15)]).as_matrix()
    return turned


def in_millimetres(pose: Array) -> Array:
    """Return the pose with its position in millimetres."""
    scaled = pose.copy()
    scaled[:3, 3] *= MILLIMETRES_PER_METRE
    return scaled


def beside(pose: Array) -> Array:
    """Return the pose of a camera that was moved by half a metre along its horizontal axis."""
    moved = pose.copy()
    moved[:3, 3] += 0.5 * pose[:3, 0]
    return moved


def late(experiment: Experiment, rng: Rng) -> Experiment:
    """Return the experiment with a camera whose times are late; images after the end are left
    out.
    """

    def delayed(depth: Depth) -> Depth:
        times_s = depth.sample_times_s + LATE_S
        is_recorded = times_s <= experiment.t_s[-1] + 1e-9
        images_m = np.array(depth.images_m, dtype=float)[is_recorded]
        return Depth.of_images(
            depth.name,
            images_m,
            depth.camera,
            depth.sigma_m,
            times_s[is_recorded],
            spacing_m=depth.spacing_m,
        )

    return depths(delayed)(experiment, rng)


DEPTH_FAULTS = {
    "depth: millimetres as metres": Fault(
        images(lambda each: MILLIMETRES_PER_METRE * each), ("camera",)
    ),
    "depth: focal length doubled": Fault(with_focal_lengths_times(2.0), ()),
    "depth: principal point mirrored": Fault(depths(with_mirrored_principal_point), ("camera",)),
    "depth: image rows flipped": Fault(images(lambda each: each[:, ::-1]), ()),
    "depth: image mirrored left to right": Fault(images(lambda each: each[:, :, ::-1]), ()),
    "depth: pose inverted": Fault(poses(with_inverse_pose), ("camera",)),
    "depth: pose of an OpenGL frame": Fault(poses(lambda pose: pose @ OPENGL), ("camera",)),
    "depth: pose of a frame with x forward": Fault(poses(with_axes_of_robot), ("camera",)),
    "depth: rotation transposed": Fault(poses(with_transposed_rotation), ("camera",)),
    "depth: camera turned by 15 deg": Fault(poses(with_turned_camera), ()),
    "depth: distance along the ray": Fault(depths(with_ray_lengths), ()),
    "depth: pose in mm": Fault(poses(in_millimetres), ("camera",)),
    "depth: camera beside the body": Fault(poses(beside), ("camera",)),
    "depth: background not removed": Fault(images(with_wall), ()),
}
MOVING_FAULTS = {
    "depth: camera 0.1 s late": Fault(late, ()),
    "depth: images in reverse order": Fault(images(lambda each: each[::-1]), ()),
    "depth: image of the start throughout": Fault(
        images(lambda each: np.repeat(each[:1], len(each), axis=0)), ()
    ),
}
