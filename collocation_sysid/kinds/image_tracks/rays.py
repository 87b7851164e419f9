"""Rays of pixels on a surface of triangles, and the pose of a camera from known points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...common.array_types import Array, Index

# Barycentric coordinate below zero at which a ray still hits a triangle: no gaps at the edges.
EDGE_TOLERANCE = 1e-9
# Most pairs of a ray and a triangle at a time, for the memory.
MOST_PAIRS = 2_000_000
# Steps towards a camera within which a solid is met, and the least one over the length of the way.
MOST_STEPS = 1000
LEAST_STEP = 1e-3
# Fewest points that determine the pose of a camera.
FEWEST_POINTS = 4
# Iterations within which a pose is fitted, the change [rad, of depths] that ends them, and the
# relative change of the squared errors by the last of them with which the best pose counts as found.
MOST_ITERATIONS = 100
LEAST_POSE_STEP = 1e-7
LEAST_GAIN = 1e-4
# Difference of rotations [rad] below which two poses are the same.
SAME_TURN_RAD = 1e-3


def cross(a: Array, b: Array) -> Array:
    """Return the cross products (..., 3) of vectors (..., 3); for few vectors several times faster
    than that of NumPy.
    """
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def ray_hits(
    origins: Array, directions: Array, triangles: Array
) -> tuple[NDArray[np.bool_], Array, Array]:
    """Intersect P rays with F triangles, also for several shapes at once.

    Parameters
    ----------
    origins, directions : (..., P, 3) arrays
    triangles : (..., F, 3, 3) array
        Corners.

    Returns
    -------
    (..., P, F) bool, (..., P, F) array, (..., P, F, 3) array
        Whether a ray hits a triangle in front of its origin, the distance in lengths of the
        direction, and the barycentric coordinates of the hit.
    """
    first = triangles[..., 0, :]
    ab, ac = triangles[..., 1, :] - first, triangles[..., 2, :] - first
    across = cross(directions[..., None, :], ac[..., None, :, :])
    determinant = np.einsum("...pfi,...fi->...pf", across, ab)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / determinant
        away = origins[..., None, :] - first[..., None, :, :]
        in_b = np.einsum("...pfi,...pfi->...pf", away, across) * inverse
        other = cross(away, ab[..., None, :, :])
        in_c = np.einsum("...pi,...pfi->...pf", directions, other) * inverse
        distance = np.einsum("...fi,...pfi->...pf", ac, other) * inverse
        least = np.minimum(np.minimum(in_b, in_c), 1 - in_b - in_c)
        is_hit = (least >= -EDGE_TOLERANCE) & (distance > 0) & np.isfinite(inverse)
        return is_hit, distance, np.stack([1 - in_b - in_c, in_b, in_c], axis=-1)


def facing(corners: Array, points_m: Array, eyes_m: Array) -> Array:
    """Return the cosines (...) between the normals of triangles (..., 3, 3) and the directions from
    points (..., 3) on them to eyes (..., 3).
    """
    first = corners[..., 0, :]
    normals = cross(corners[..., 1, :] - first, corners[..., 2, :] - first)
    to_eye = eyes_m - points_m
    lengths = np.linalg.norm(normals, axis=-1) * np.linalg.norm(to_eye, axis=-1)
    return np.einsum("...i,...i->...", normals, to_eye) / np.maximum(lengths, 1e-30)


def points_on_surface(
    origins: Array, directions: Array, nodes_m: Array, surface: Index
) -> tuple[Index, Array, Array]:
    """Return where rays first meet a surface.

    Parameters
    ----------
    origins, directions : (P, 3) arrays
    nodes_m : (n, 3) array
        Nodes in the shape that the rays meet.
    surface : (F, 3) array
        Corners of its triangles.

    Returns
    -------
    (P,) array of int, (P, 3) array, (P,) array
        Triangle, barycentric coordinates in it, and sine of the angle by which the ray misses the
        surface: zero for a hit; of a miss, triangle and coordinates of the point on the outline
        that is nearest in view.
    """
    triangles = nodes_m[surface]
    is_hit, distance, shares = ray_hits(origins, directions, triangles)
    faces = np.where(is_hit, distance, np.inf).argmin(axis=1)
    coordinates = np.clip(shares[np.arange(len(faces)), faces], 0.0, 1.0)
    missed = np.zeros(len(faces))
    for k in np.flatnonzero(~is_hit.any(axis=1)):
        faces[k], coordinates[k], missed[k] = _nearest_in_view(origins[k], directions[k], triangles)
    coordinates[~np.isfinite(coordinates).all(axis=1)] = 1 / 3
    coordinates /= coordinates.sum(axis=1, keepdims=True)
    return faces, coordinates, missed


def _nearest_in_view(origin: Array, direction: Array, triangles: Array) -> tuple[int, Array, float]:
    """Only triangles that look at the origin count, because the others are behind them."""
    ahead = direction / np.linalg.norm(direction)
    # Two axes across the ray, in which edges are straight at depth one.
    across = np.linalg.svd(ahead[None])[2][1:]
    away = triangles - origin
    depth = away @ ahead
    is_seen = (depth > 0).all(axis=1)
    looks = facing(triangles, triangles.mean(axis=1), origin) > 0
    chosen = np.flatnonzero(is_seen & looks if (is_seen & looks).any() else is_seen)
    if not len(chosen):
        return 0, np.full(3, 1 / 3), 1.0
    at = np.einsum("ki,fci->fck", across, away[chosen]) / depth[chosen, :, None]
    begins, ends = at, np.roll(at, -1, axis=1)
    way = ends - begins
    length2 = np.maximum(np.einsum("fck,fck->fc", way, way), 1e-300)
    share = np.clip(-np.einsum("fck,fck->fc", begins, way) / length2, 0.0, 1.0)
    nearest = np.linalg.norm(begins + share[..., None] * way, axis=2)
    face, edge = divmod(int(nearest.argmin()), 3)
    # Shares of an edge at depth one are those of the inverse depths.
    inverse = np.array([1 - share[face, edge], share[face, edge]])
    inverse /= depth[chosen[face], [edge, (edge + 1) % 3]]
    coordinates = np.zeros(3)
    coordinates[[edge, (edge + 1) % 3]] = inverse / inverse.sum()
    return int(chosen[face]), coordinates, float(np.sin(np.arctan(nearest[face, edge])))


def is_occluded(
    points_m: Array, eyes_m: Array, triangles: Array, margin_m: float
) -> NDArray[np.bool_]:
    """Return which points (S, P, 3) on surfaces are hidden from eyes (S, 3) by the triangles (S, F,
    3, 3) of the same shape that are at least `margin_m` in front of them.
    """
    shapes, count = points_m.shape[:2]
    hidden = np.zeros((shapes, count), dtype=bool)
    batch = max(1, MOST_PAIRS // max(1, triangles.shape[1] * count))
    for first in range(0, shapes, batch):
        part = slice(first, first + batch)
        to_eye = eyes_m[part, None] - points_m[part]
        length = np.linalg.norm(to_eye, axis=2)
        is_hit, distance, _ = ray_hits(points_m[part], to_eye, triangles[part])
        is_between = (distance < 1) & (distance * length[..., None] > margin_m)
        hidden[part] = (is_hit & is_between).any(axis=2)
    return hidden


def is_behind(
    points_m: Array, eyes_m: Array, distance: Callable[[Array], Array], margin_m: float
) -> NDArray[np.bool_]:
    """Return which points (P, 3) a solid hides from eyes (P, 3).

    The signed distance of the solid, as a function of points (P, 3), is as long as the next step from
    the point to the eye may be (sphere tracing). The first step is `margin_m`, so that a solid that
    touches the point does not hide it; steps are at least a share of the length, `LEAST_STEP`.
    """
    way = eyes_m - points_m
    length = np.linalg.norm(way, axis=1)
    way /= length[:, None]
    along = np.full(len(points_m), margin_m)
    hidden = np.zeros(len(points_m), dtype=bool)
    for _ in range(MOST_STEPS):
        left = np.flatnonzero(~hidden & (along < length))
        if not len(left):
            break
        gap = distance(points_m[left] + along[left, None] * way[left])
        hidden[left[gap < 0]] = True
        along[left] += np.maximum(gap, LEAST_STEP * length[left])
    return hidden


def _fitted_poses(
    points_m: Array, seen: Array, turns: Array, shifts: Array, least_m: float
) -> tuple[Array, Array, Array]:
    """Return the m converged starts (or the best) and the RMS (m,) of (P, 2) at unit depth."""
    # All starts at once: SciPy's `least_squares` from one after the other takes nine times as long.

    def differences(turns: Array, shifts: Array) -> tuple[Array, Array, Array]:
        turned = np.einsum("kij,pj->kpi", turns, points_m)
        at = turned + shifts[:, None]
        depth = np.maximum(at[..., 2:], least_m)
        return turned, depth, at[..., :2] / depth - seen

    damping, is_found = np.full(len(turns), 1e-3), np.zeros(len(turns), dtype=bool)
    turned, depth, off = differences(turns, shifts)
    for _ in range(MOST_ITERATIONS):
        # By a small rotation after the present one, and by the translation.
        moved = np.zeros((*turned.shape, 6))
        moved[..., 0, 1], moved[..., 0, 2] = turned[..., 2], -turned[..., 1]
        moved[..., 1, 0], moved[..., 1, 2] = -turned[..., 2], turned[..., 0]
        moved[..., 2, 0], moved[..., 2, 1] = turned[..., 1], -turned[..., 0]
        moved[..., 3:] = np.eye(3)
        moved[..., 2, :] *= depth > least_m
        slopes = moved[..., :2, :] - (off + seen)[..., None] * moved[..., 2:, :]
        slopes = (slopes / depth[..., None]).reshape(len(turns), -1, 6)
        squares = np.einsum("kri,krj->kij", slopes, slopes)
        gradient = np.einsum("kri,kr->ki", slopes, off.reshape(len(turns), -1))
        scale = np.einsum("kii->ki", squares)
        damped = squares + np.eye(6) * (damping[:, None] * scale + 1e-15)[..., None]
        step = -np.linalg.solve(damped, gradient[..., None])[..., 0]
        next_turns = Rotation.from_rotvec(step[:, :3]).as_matrix() @ turns
        trial = differences(next_turns, shifts + step[:, 3:])
        squared = np.sum(off**2, axis=(1, 2))
        gain = squared - np.sum(trial[2] ** 2, axis=(1, 2))
        is_better = gain > 0
        damping = np.clip(np.where(is_better, damping / 5, damping * 4), 1e-12, 1e12)
        turns = np.where(is_better[:, None, None], next_turns, turns)
        shifts = np.where(is_better[:, None], shifts + step[:, 3:], shifts)
        pairs = zip(trial, (turned, depth, off), strict=True)
        turned, depth, off = (np.where(is_better[:, None, None], *pair) for pair in pairs)
        size = np.concatenate([step[:, :3], step[:, 3:] / depth.mean(axis=1)], axis=1)
        is_found |= np.abs(size).max(axis=1) < LEAST_POSE_STEP
        if is_found.all():
            break
    errors = np.sqrt(np.mean(off**2, axis=(1, 2)))
    if not is_found.any():
        # Of inexact points near a line the steps decrease slowly, although nothing is gained.
        is_settled = np.abs(gain) <= LEAST_GAIN * squared
        best = int(np.argmin(np.where(is_settled, errors, np.inf)))
        is_found[best] = is_settled[best]
    return turns[is_found], shifts[is_found], errors[is_found]


def poses_from_points(points_m: Array, rays: Array) -> list[tuple[Array, float]]:
    """Return the poses of a camera from which known points appear in known directions, best first.

    A set of points seen from one side has two poses with similar errors, mirror images of each
    other, and more where the points are in a plane. The search therefore begins at the 24 rotations
    of a cube, and all minima that it finds are returned.

    Parameters
    ----------
    points_m : (P, 3) array
        Points in the world, at least four.
    rays : (P, 3) array
        Points at depth z = 1 in the frame of the camera in the directions of their images.

    Returns
    -------
    list of ((4, 4) array, float)
        Transform from the camera to the world, and the RMS of the differences at depth one; of
        poses with all points in front of the camera.
    """
    middle = points_m.mean(axis=0)
    centred = points_m - middle
    seen = rays[:, :2]
    spread = np.sqrt(np.sum((seen - seen.mean(axis=0)) ** 2))
    depth = np.sqrt(np.sum(centred**2) * 2 / 3) / max(spread, 1e-9)
    start = depth * np.append(seen.mean(axis=0), 1.0)

    turns = Rotation.create_group("O").as_matrix()
    shifts = np.tile(start, (len(turns), 1))
    turns, shifts, errors = _fitted_poses(centred, seen, turns, shifts, 1e-3 * depth)
    found: list[tuple[Array, float]] = []
    for turn, shift, error in zip(turns, shifts, errors.tolist(), strict=True):
        if (centred @ turn[2] + shift[2] <= 0).any():
            continue
        pose = np.eye(4)
        pose[:3, :3] = turn.T
        pose[:3, 3] = middle - turn.T @ shift
        same = [
            k
            for k, (other, _) in enumerate(found)
            if Rotation.from_matrix(other[:3, :3].T @ pose[:3, :3]).magnitude() < SAME_TURN_RAD
        ]
        if not same:
            found.append((pose, error))
        elif error < found[same[0]][1]:
            found[same[0]] = pose, error
    return sorted(found, key=lambda each: each[1])
