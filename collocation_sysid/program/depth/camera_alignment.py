"""Initial pose of a depth camera by alignment of its points with a shape (iterative closest
points).

Points of the surface are associated with the nearest points of the cloud, within a gate that
narrows, and a Gauss–Newton step aligns them along the normals, with the prior of the pose (Chen &
Medioni 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ...common.array_types import Array, Index
from ...recording.nuisance import DEPTH_SHIFT, DEPTH_TURN
from .camera_model import DepthCameraModel
from .visible_surface import GRAZING, VisibleSurface

# Number of random points of the surface that are associated with the cloud.
SAMPLES = 250
# Iterations, with a gate that narrows geometrically.
ITERATIONS = 25
# Initial gate, relative to the diagonal of the body.
REACH = 0.35
# Cells along the first gate of the grid that stands for the cloud with the wider half of the gates.
CELLS_OF_REACH = 12
# Largest number of its cells; larger grids take longer than exact searches.
MOST_CELLS = 300_000
# Number of nearest points of each point of the cloud, itself included, among which that grid
# searches.
NEIGHBOURS = 8
# Weight of the complete distance relative to that along the normal: points may slide.
SLIDING = 0.2
# Number of independent points that the points count as, relative to the prior.
INDEPENDENT = 10000
# Rotations from which the search starts, about each axis in both directions [rad].
TURNED = 0.2
# Number of starts that are iterated further after the wider half of the gates.
CONTINUED_STARTS = 2
# Number of times, during the wider half of the gates, that starts close to each other are merged.
CHOICES = 5
# Largest displacement between two poses that count as one, relative to the gate: both would go on
# to the same minimum.
SAME_POSE = 0.1
# Largest number of points of a cloud that are used, approximately; more only cost time.
ENOUGH = 2000


class AlignedPose(NamedTuple):
    """Error of a camera's pose after some iterations of the alignment."""

    rotation: Rotation  # rotation about the camera's pivot, in its stated frame
    translation_m: Array  # (3,): translation in its stated frame [m]
    # Mean squared distance of the surface's points from the cloud over that of the gate, at most
    # one per point; one before the first iteration, or if no point faces the camera.
    mismatch: float = 1.0


class NearestPoints(Protocol):
    """Search of the nearest points of a cloud."""

    points_m: Array

    def nearest(self, places: Array) -> Index:
        """Return the indices (…) of the points nearest to places (…, 3) [m]."""
        ...


class ExactCloud:
    """Cloud with exact nearest points.

    Parameters
    ----------
    points_m : (P, 3) array
        Points [m].
    """

    def __init__(self, points_m: Array) -> None:
        self.points_m = points_m
        self._tree = KDTree(points_m)

    def nearest(self, places: Array) -> Index:
        """Return the indices (…) of the points nearest to places (…, 3) [m]."""
        return np.asarray(self._tree.query(places)[1])


class GriddedCloud:
    """Cloud with nearly nearest points: for each cell of a grid a point nearby is stored, and the
    nearest of this point and its neighbours in the cloud is used.

    It may be farther away than the nearest one by about the diagonal of a cell; places beyond the
    grid have the points of its nearest cell.

    Parameters
    ----------
    points_m : (P, 3) array
        Points, P ≥ 1 [m].
    cell_m : float
        Edge of a cell [m].
    margin_m : float
        Distance by which the grid extends beyond the points [m].
    """

    def __init__(self, points_m: Array, cell_m: float, margin_m: float) -> None:
        self.points_m = points_m
        self._cell_m = cell_m
        self._corner_m = points_m.min(axis=0) - margin_m
        cells = self._cells(points_m)
        self._last = cells.max(axis=0) + int(np.ceil(margin_m / cell_m))
        point = np.full(self._last + 1, -1)
        point[tuple(cells.T)] = np.arange(len(points_m))
        occupied = np.asarray(
            scipy.ndimage.distance_transform_edt(
                point < 0, return_distances=False, return_indices=True
            )
        )
        self._nearest = point[tuple(occupied)]
        count = min(NEIGHBOURS, len(points_m))
        _, neighbours = KDTree(points_m).query(points_m, count)
        self._neighbours = np.reshape(neighbours, (len(points_m), count))

    @classmethod
    def is_possible(cls, points_m: Array, cell_m: float, margin_m: float) -> bool:
        """Return whether the grid has at most `MOST_CELLS` cells; arguments as for the class."""
        sides_m = np.ptp(points_m, axis=0) + 2 * margin_m
        return bool(np.prod(sides_m / cell_m + 2) <= MOST_CELLS)

    def _cells(self, places: Array) -> Index:
        """Return the indices (…, 3) of the cells of places (…, 3) [m], also beyond the grid."""
        return np.floor((places - self._corner_m) / self._cell_m).astype(int)

    def nearest(self, places: Array) -> Index:
        """Return the indices (…) of points nearly nearest to places (…, 3) [m]."""
        cells = np.clip(self._cells(places), 0, self._last)
        nearest = self._nearest[tuple(np.moveaxis(cells, -1, 0))]
        candidates = self._neighbours[nearest]
        ways = self.points_m[candidates] - places[..., None, :]
        best = np.einsum("...ci,...ci->...c", ways, ways).argmin(axis=-1)
        return np.take_along_axis(candidates, best[..., None], axis=-1)[..., 0]


class AlignmentClouds(NamedTuple):
    """Points of an image for the two halves of an alignment."""

    wide: NearestPoints  # with the wider half of the gates
    narrow: ExactCloud  # with the narrower half

    @classmethod
    def from_points(cls, points_m: Array, reach_m: float) -> AlignmentClouds:
        """Return the clouds of points (P, 3) [m]. The grid of the wide one extends by the first
        gate `reach_m` [m] beyond them; if it has too many cells, for example with a background
        far away, the wide cloud is the narrow one.
        """
        exact = ExactCloud(points_m)
        grid = {"cell_m": reach_m / CELLS_OF_REACH, "margin_m": reach_m}
        if GriddedCloud.is_possible(points_m, **grid):
            return cls(GriddedCloud(points_m, **grid), exact)
        return cls(exact, exact)


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
    Of starts that come close to each other the one with the smallest mismatch is continued. Points
    of other things should be far away compared with the gate. Random points are the same in each
    call.

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
    corners = ((x - translations[image]) @ rotations[image])[surface.plane_triangles]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(sides, axis=1)
    selected_area = area * np.repeat(surface.is_selected, len(area) // len(surface.faces))
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(area), SAMPLES, p=selected_area / selected_area.sum())
    places = np.einsum("pc,pci->pi", rng.dirichlet(np.ones(3), SAMPLES), corners[chosen])
    normals = sides[chosen] / area[chosen, None]
    size_m = float(np.linalg.norm(np.ptp(x, axis=0)))
    if image not in camera.alignment_clouds:
        camera.alignment_clouds[image] = AlignmentClouds.from_points(
            thinned(camera.depth.points_m[image]), reach_m=REACH * size_m
        )
    clouds = camera.alignment_clouds[image]
    gates = np.geomspace(REACH * size_m, camera.depth.gate_m, ITERATIONS)
    wide_gates, narrow_gates = np.array_split(gates, 2)
    iterate = partial(iterate_alignments, camera, places=places, normals=normals)
    candidates = _first_candidates(clouds.narrow.points_m, places, gate_m=float(gates[0]))
    for some_gates in np.array_split(wide_gates, CHOICES):
        candidates = distinct_poses(
            iterate(cloud=clouds.wide, gates=some_gates, starts=candidates),
            size_m=size_m,
            same_m=SAME_POSE * some_gates[-1],
        )
    best = min(
        iterate(cloud=clouds.narrow, gates=narrow_gates, starts=candidates[:CONTINUED_STARTS]),
        key=lambda each: each.mismatch,
    )
    return best.rotation.as_rotvec(), best.translation_m


def _first_candidates(cloud_m: Array, places: Array, gate_m: float) -> list[AlignedPose]:
    """Return the stated and the centred pose, each also rotated both ways about each axis."""
    rotation_vectors = np.vstack([np.zeros(3), TURNED * np.eye(3), -TURNED * np.eye(3)])
    is_near = KDTree(places).query(cloud_m)[0] < gate_m
    shifts = [np.zeros(3), np.zeros(3)]
    if is_near.any():
        shifts[1] = places.mean(axis=0) - cloud_m[is_near].mean(axis=0)
    return [
        AlignedPose(Rotation.from_rotvec(turn), shift)
        for turn in rotation_vectors
        for shift in shifts
    ]


def distinct_poses(poses: Sequence[AlignedPose], size_m: float, same_m: float) -> list[AlignedPose]:
    """Return the poses in ascending order of their mismatch, without those that hardly differ from
    an earlier one.

    Parameters
    ----------
    poses : sequence of AlignedPose
        Poses of one iteration.
    size_m : float
        Length by which differences of rotation vectors [rad] become displacements [m].
    same_m : float
        Poses whose rotations and translations together move a point by less than this are the same
        [m].
    """
    ranked = sorted(poses, key=lambda each: each.mismatch)
    rotations = np.array([each.rotation.as_rotvec() for each in ranked])
    translations_m = np.array([each.translation_m for each in ranked])
    kept: list[int] = []
    for k in range(len(ranked)):
        apart_m = size_m * np.linalg.norm(rotations[kept] - rotations[k], axis=1) + np.linalg.norm(
            translations_m[kept] - translations_m[k], axis=1
        )
        if not len(kept) or apart_m.min() >= same_m:
            kept.append(k)
    return [ranked[k] for k in kept]


def iterate_alignments(
    camera: DepthCameraModel,
    cloud: NearestPoints,
    places: Array,
    normals: Array,
    gates: Array,
    starts: Sequence[AlignedPose],
) -> list[AlignedPose]:
    """Iterate the alignment from several starts, independently of each other.

    Parameters
    ----------
    cloud : NearestPoints
        Points of the cloud in the camera's frame.
    places, normals : (P, 3) arrays
        Points of the surface with their normals, in the camera's stated frame.
    gates : array
        Gate of each iteration [m].
    starts : sequence of AlignedPose
        Initial rotations and translations.

    Returns
    -------
    list of AlignedPose
        Poses after the last step, in the order of the starts, with the mismatch before it.
    """
    rotations = Rotation.concatenate([each.rotation for each in starts])
    translations_m = np.array([each.translation_m for each in starts])
    prior = np.concatenate([camera.prior_weights(row) for row in (DEPTH_TURN, DEPTH_SHIFT)])
    mismatches = np.ones(len(starts))
    for gate in gates:
        arms_m, distances_m, is_facing = _match_surface(
            camera,
            cloud,
            places=places,
            normals=normals,
            rotations=rotations,
            translations_m=translations_m,
        )
        squares = np.sum(distances_m**2, axis=2)
        counts = is_facing.sum(axis=1)
        limited = np.minimum(squares / gate**2, 1.0) * is_facing
        mismatches = np.where(counts > 0, limited.sum(axis=1) / np.maximum(counts, 1), 1.0)
        weights = np.sqrt(INDEPENDENT / np.maximum(counts, 1))[:, None]
        weights = weights * is_facing / gate
        weights /= 1 + squares / (gate / 2) ** 2
        errors = np.hstack([rotations.as_rotvec(), translations_m])
        steps = _alignment_steps(arms_m, distances_m, normals, weights, prior, errors)
        rotations = Rotation.from_rotvec(steps[:, :3]) * rotations
        translations_m = translations_m + steps[:, 3:]
    return [
        AlignedPose(rotations[k], translations_m[k], mismatch=float(mismatch))
        for k, mismatch in enumerate(mismatches)
    ]


def _match_surface(
    camera: DepthCameraModel,
    cloud: NearestPoints,
    places: Array,
    normals: Array,
    rotations: Rotation,
    translations_m: Array,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return arms from the pivot and distances (B, P, 3) [m] of cloud points, and what is seen."""
    pivot = camera.pivot_m
    turns = rotations.as_matrix()
    moved = translations_m[:, None] + pivot
    # Cloud points p are at R (p − c) + c + d: the surface looks for them in their own frame.
    nearest = cloud.nearest((places - moved) @ turns + pivot)
    arms_m = (cloud.points_m[nearest] - pivot) @ turns.swapaxes(1, 2)
    is_facing = np.ones(nearest.shape, dtype=bool)
    if camera.depth.camera.matrix is not None:
        ways = (moved - (turns @ pivot)[:, None]) - places
        cosines = np.sum(normals * ways, axis=2)
        is_facing = cosines > GRAZING * np.linalg.norm(ways, axis=2)
    return arms_m, arms_m + moved - places, is_facing


def _alignment_steps(
    arms_m: Array, distances_m: Array, normals: Array, weights: Array, prior: Array, errors: Array
) -> Array:
    """Return the Gauss–Newton steps (B, 6) of rotation vectors [rad] and translations [m].

    They minimise Σ w² ((n · e)² + `SLIDING`² |e|²) over the distances e after the step, and the
    squares of the errors over the prior. The 6 × 6 normal equations are solved for all B at once,
    scaled by their diagonals.
    """
    along = np.concatenate(
        [np.cross(arms_m, normals), np.broadcast_to(normals, arms_m.shape)], axis=2
    )
    along *= weights[..., None]
    offsets = weights * np.sum(normals * distances_m, axis=2)
    matrices = along.swapaxes(1, 2) @ along
    slopes = np.einsum("bpk,bp->bk", along, offsets)
    # By a rotation vector ω a point moves by ω × r: the same sums of all three components.
    factors = (SLIDING * weights) ** 2
    total = factors.sum(axis=1)
    weighted = factors[..., None] * arms_m
    products = weighted.swapaxes(1, 2) @ arms_m
    traces = np.trace(products, axis1=1, axis2=2)
    matrices[:, :3, :3] += traces[:, None, None] * np.eye(3) - products
    crossed = _cross_product_matrices(weighted.sum(axis=1))
    matrices[:, :3, 3:] += crossed
    matrices[:, 3:, :3] += crossed.swapaxes(1, 2)
    matrices[:, 3:, 3:] += total[:, None, None] * np.eye(3)
    slopes[:, :3] += np.cross(weighted, distances_m).sum(axis=1)
    slopes[:, 3:] += np.einsum("bp,bpi->bi", factors, distances_m)
    matrices += np.diag(prior**2)
    slopes += prior**2 * errors
    scales = np.sqrt(np.einsum("bii->bi", matrices))
    scaled = matrices / (scales[:, :, None] * scales[:, None])
    return -np.linalg.solve(scaled, (slopes / scales)[..., None])[..., 0] / scales


def _cross_product_matrices(vectors: Array) -> Array:
    """Return the skew matrices (P, 3, 3) with M w = v × w for vectors v (P, 3)."""
    x, y, z = vectors.T
    none = np.zeros_like(x)
    return np.stack([[none, -z, y], [z, none, -x], [-y, x, none]]).transpose(2, 0, 1)
