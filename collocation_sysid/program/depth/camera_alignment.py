"""Initial pose of a depth camera by alignment of its points with a shape (iterative closest
points).

Points of the surface are associated with the nearest points of the cloud, within a gate that
narrows, and a Gauss–Newton step aligns them along the normals, with the prior of the pose (Chen &
Medioni 1992).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ...common.array_types import Array
from ...recording.nuisance import DEPTH_SHIFT, DEPTH_TURN
from .depth_camera_model import DepthCameraModel
from .visible_surface import GRAZING, VisibleSurface

# Number of random points of the surface that are associated with the cloud.
SAMPLES = 250
# Iterations, with a gate that narrows geometrically.
ITERATIONS = 25
# Initial gate, relative to the diagonal of the body.
REACH = 0.35
# Weight of the complete distance relative to that along the normal: points may slide.
SLIDING = 0.2
# Number of independent points that the points count as, relative to the prior.
INDEPENDENT = 10000
# Rotations from which the search starts, about each axis in both directions [rad].
TURNED = 0.2
# Number of starts that are iterated further after each half of the gates.
CONTINUED_STARTS = 2
# Largest number of points of a cloud that are used, approximately; more only cost time.
ENOUGH = 2000


class AlignedPose(NamedTuple):
    """Error of a camera's pose after some iterations of the alignment.

    Attributes
    ----------
    rotation : Rotation
        Rotation about the camera's pivot, in its stated frame.
    translation_m : (3,) array
        Translation in its stated frame [m].
    mismatch : float
        Mean squared distance of the surface's points from the cloud over that of the gate, at most
        one per point; one before the first iteration, or if no point faces the camera.
    """

    rotation: Rotation
    translation_m: Array
    mismatch: float = 1.0


def thinned(cloud: Array) -> Array:
    """Return every k-th point of a cloud (P, c), evenly spread over its order, so that at most
    `ENOUGH` remain; the complete cloud (k = 1) if it has fewer.
    """
    return cloud[:: 1 + len(cloud) // ENOUGH]


def align_camera(
    camera: DepthCameraModel, surface: VisibleSurface, x: Array, image: int
) -> tuple[Array, Array]:
    """Return the rotation vector (3,) [rad] and translation (3,) [m] of the camera error that align
    the points of an image with a shape, see `DepthCameraModel.with_pose`.

    The search starts from the stated pose, and from the pose that puts the cloud at the middle of
    the shape, each also rotated in both directions about each axis; the best result is returned.
    Points of other things should be far away compared with the gate. Random points are the same in
    each call.

    Parameters
    ----------
    camera : DepthCameraModel
        Model of the camera; its points, stated poses and priors are used.
    surface : VisibleSurface
        Surface of the body.
    x : (n, 3) array
        Surface nodes [m].
    image : int
        Index of the image, which must have points.
    """
    rotations, translations = camera.poses
    corners = ((x - translations[image]) @ rotations[image])[
        surface.plane_triangles
    ]
    sides = np.cross(
        corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    )
    area = np.linalg.norm(sides, axis=1)
    selected_area = area * np.repeat(
        surface.is_selected, len(area) // len(surface.faces)
    )
    rng = np.random.default_rng(0)
    chosen = rng.choice(
        len(area), SAMPLES, p=selected_area / selected_area.sum()
    )
    places = np.einsum(
        "pc,pci->pi", rng.dirichlet(np.ones(3), SAMPLES), corners[chosen]
    )
    normals = sides[chosen] / area[chosen, None]
    size_m = float(np.linalg.norm(np.ptp(x, axis=0)))
    tree = KDTree(thinned(camera.depth.points_m[image]))
    gates = np.geomspace(REACH * size_m, camera.depth.gate_m, ITERATIONS)
    rotation_vectors = np.vstack(
        [np.zeros(3), TURNED * np.eye(3), -TURNED * np.eye(3)]
    )
    cropped_cloud = np.asarray(tree.data)[
        KDTree(places).query(tree.data)[0] < gates[0]
    ]
    shifts = [
        np.zeros(3),
        places.mean(axis=0) - cropped_cloud.mean(axis=0)
        if len(cropped_cloud)
        else np.zeros(3),
    ]
    candidates = [
        AlignedPose(Rotation.from_rotvec(turn), shift)
        for turn in rotation_vectors
        for shift in shifts
    ]
    for half in np.array_split(gates, 2):
        candidates = [
            iterate_alignment(
                camera,
                tree,
                places=places,
                normals=normals,
                gates=half,
                start=start,
            )
            for start in candidates
        ]
        candidates.sort(key=lambda each: each.mismatch)
        candidates = candidates[:CONTINUED_STARTS]
    best = candidates[0]
    return best.rotation.as_rotvec(), best.translation_m


def iterate_alignment(
    camera: DepthCameraModel,
    tree: KDTree,
    places: Array,
    normals: Array,
    gates: Array,
    start: AlignedPose,
) -> AlignedPose:
    """Iterate the alignment from one start.

    Parameters
    ----------
    camera : DepthCameraModel
        Model of the camera.
    tree : KDTree
        Points of the cloud in the camera's frame.
    places, normals : (P, 3) arrays
        Points of the surface with their normals, in the camera's stated frame.
    gates : array
        Gate of each iteration [m].
    start : AlignedPose
        Initial rotation and translation.

    Returns
    -------
    AlignedPose
        Pose after the last step, with the mismatch before it.
    """
    rotation = start.rotation
    translation_m = start.translation_m
    pivot = camera.pivot_m
    prior = np.concatenate(
        [camera.prior_weights(row) for row in (DEPTH_TURN, DEPTH_SHIFT)]
    )
    mismatch = 1.0
    for gate in gates:
        # Cloud points p are at R (p − c) + c + d: the surface looks for them in their own frame.
        _, nearest = tree.query(
            rotation.inv().apply(places - pivot - translation_m) + pivot
        )
        aligned = (
            rotation.apply(np.asarray(tree.data)[nearest] - pivot)
            + pivot
            + translation_m
        )
        distances = aligned - places
        is_facing = np.ones(len(places), dtype=bool)
        if camera.depth.camera.matrix is not None:
            ways = rotation.apply(-pivot) + pivot + translation_m - places
            is_facing = np.sum(
                normals * ways, axis=1
            ) > GRAZING * np.linalg.norm(ways, axis=1)
        squares = np.sum(distances**2, axis=1)
        mismatch = (
            float(np.minimum(squares / gate**2, 1.0)[is_facing].mean())
            if is_facing.any()
            else 1.0
        )
        weight = (
            np.sqrt(INDEPENDENT / max(is_facing.sum(), 1)) * is_facing / gate
        )
        weight /= 1 + squares / (gate / 2) ** 2
        by = np.concatenate(
            [
                -_cross_product_matrices(aligned - pivot - translation_m),
                np.tile(np.eye(3), (len(places), 1, 1)),
            ],
            axis=2,
        )
        projected = (
            np.einsum("pi,pij->pj", normals, by),
            np.sum(normals * distances, axis=1),
        )
        rows = [
            projected[0] * weight[:, None],
            *(SLIDING * by * weight[:, None, None]).swapaxes(0, 1),
        ]
        right = [
            projected[1] * weight,
            *(SLIDING * distances * weight[:, None]).T,
        ]
        prior_residual = prior * np.concatenate(
            [rotation.as_rotvec(), translation_m]
        )
        step = np.linalg.lstsq(
            np.concatenate([*rows, np.diag(prior)]),
            -np.concatenate([*right, prior_residual]),
        )[0]
        rotation = Rotation.from_rotvec(step[:3]) * rotation
        translation_m = translation_m + step[3:]
    return AlignedPose(rotation, translation_m, mismatch=mismatch)


def _cross_product_matrices(vectors: Array) -> Array:
    """Return the skew matrices (P, 3, 3) with M w = v × w for vectors v (P, 3)."""
    x, y, z = vectors.T
    none = np.zeros_like(x)
    return np.stack([[none, -z, y], [z, none, -x], [-y, x, none]]).transpose(
        2, 0, 1
    )
