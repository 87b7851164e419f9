"""Time of the first image by the clock of the poses of the gripper.

Pixels of points that move with the gripper are, to first order, linear in its position and rotation:
the time is that at which poses explain the motion of the points best.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from ...common.array_types import Array
from ...errors import InputError
from ...recording import PoseSequence

# Candidates for each image.
PER_IMAGE = 4
# Fewest images, and their least share of the motion in the video, that a candidate compares.
LEAST_IMAGES = 12
LEAST_SHARE = 0.8
# Motions of the gripper that are less than this share of the largest are left out.
LEAST_MOTION = 0.01
# Length by which rotations are compared with positions [m].
ARM_M = 0.1
# Largest share of the motion that poses may leave unexplained, and least ratio of what the second
# best time leaves to what the best one does.
MOST_UNEXPLAINED = 0.1
LEAST_RATIO = 1.5
# Share of the points that are used: those that follow the gripper best.
BEST_SHARE = 0.25


class StartTime(NamedTuple):
    """Time of the first image, and which points it is from."""

    start_s: float
    sigma_s: float  # statistical standard deviation
    unexplained: float  # share of the motion in pixels that does not follow the poses
    names: tuple[str, ...]


def start_time(t_s: Array, pixels: Array, names: list[str], poses: PoseSequence) -> StartTime:
    """Return the time by the clock of poses at which the first image of tracks was taken.

    Parameters
    ----------
    t_s : (S,)
        Times of the images since the first one [s].
    pixels : (S, N, 2)
        Points that move with the gripper, or others too: those that follow it best are used.

    Raises
    ------
    InputError
        If the points do not move, are lost, or do not follow the poses at one time alone.
    """
    known = np.isfinite(pixels).all(axis=(0, 2))
    moves = known & (np.ptp(pixels, axis=0).max(axis=-1) > 1.0)
    if not moves.any() or len(t_s) < LEAST_IMAGES:
        raise InputError(
            f"found {int(moves.sum())} points that move and are seen in all of {len(t_s)} images; "
            f"expected one in at least {LEAST_IMAGES} images: state start_s yourself, or --gripper U,V",
            where="--poses",
        )
    u = pixels[:, moves]
    tracked = [name for name, used in zip(names, moves, strict=True) if used]
    frame_s = float(np.median(np.diff(t_s)))
    first_s, last_s = float(poses.t_s[0]), float(poses.t_s[-1])
    grid_s = np.arange(first_s - t_s[-1], last_s, frame_s / PER_IMAGE)
    errors = np.array([_unexplained(s, t_s, u, poses) for s in grid_s])  # (C, N, 2): rest, all
    share = errors[..., 0] / errors[..., 1]
    if not np.isfinite(share).any():
        raise InputError(
            f"the poses from {first_s:g} s to {last_s:g} s do not move, or not during the motion of the "
            f"video of {t_s[-1]:.3g} s; expected poses of the same motion",
            where="--poses",
        )
    best = np.argsort(np.nanmin(np.where(np.isfinite(share), share, np.inf), axis=0))
    used = np.sort(best[: max(1, round(BEST_SHARE * len(best)))])

    def rest(s: float) -> float:
        part = _unexplained(s, t_s, u[:, used], poses).sum(axis=0)
        return float(part[0] / part[1])

    total = errors[:, used].sum(axis=1)
    curve = np.where(np.isfinite(total[:, 0]), total[:, 0] / total[:, 1], np.inf)
    k = int(np.argmin(curve))
    step_s = frame_s / PER_IMAGE
    found: Any = minimize_scalar(
        rest, bounds=(grid_s[k] - step_s, grid_s[k] + step_s), method="bounded",
        options={"xatol": 1e-3 * step_s},
    )  # fmt: skip
    start_s, least = float(found.x), float(found.fun)
    inner = curve[1:-1]
    is_minimum = (
        (inner < curve[:-2]) & (inner <= curve[2:]) & (abs(grid_s[1:-1] - start_s) > frame_s)
    )
    second = float(inner[is_minimum].min(initial=np.inf))
    if not least < MOST_UNEXPLAINED or second < LEAST_RATIO * least:
        reason = (
            f"also {grid_s[1:-1][is_minimum][np.argmin(inner[is_minimum])]:.4g} s fits"
            if least < MOST_UNEXPLAINED
            else f"{least:.0%} of the motion remains"
        )
        raise InputError(
            f"the points follow the poses best if the first image is at {start_s:.4g} s, but {reason}; "
            "expected --gripper U,V on the gripper, a motion that does not repeat, and the poses of "
            "this video",
            where="--poses",
        )
    curvature = (rest(start_s + step_s) - 2 * least + rest(start_s - step_s)) / step_s**2
    samples = 2 * len(used) * len(t_s)
    sigma_s = np.sqrt(2 * least / samples / curvature) if curvature > 0 else frame_s
    return StartTime(start_s, float(sigma_s), least, tuple(tracked[k] for k in used))


def _unexplained(start_s: float, t_s: Array, pixels: Array, poses: PoseSequence) -> Array:
    """Return for each point (N, 2) the squares that remain and all squares of its motion; NaN if most
    of the motion is outside the poses, or the gripper is at rest.
    """
    times_s = t_s + start_s
    seen = (times_s >= poses.t_s[0]) & (times_s <= poses.t_s[-1])
    none = np.full((pixels.shape[1], 2), np.nan)
    if seen.sum() < LEAST_IMAGES:
        return none
    here = pixels[seen] - pixels[seen].mean(axis=0)
    squares = (here**2).sum(axis=(0, 2))
    everything = ((pixels - pixels.mean(axis=0)) ** 2).sum(axis=(0, 2))
    matrices, positions_m = poses.at(times_s[seen])
    turned = Rotation.from_matrix(matrices[0].T @ matrices).as_rotvec()
    motion = np.hstack([positions_m, ARM_M * turned])
    motion -= motion.mean(axis=0)
    modes, sizes, _ = np.linalg.svd(motion, full_matrices=False)
    if not sizes[0] > 1e-6:
        return none
    modes = modes[:, sizes > LEAST_MOTION * sizes[0]]
    explained = (np.tensordot(modes, here, axes=(0, 0)) ** 2).sum(axis=(0, 2))
    rest = np.where(squares >= LEAST_SHARE * everything, squares - explained, np.nan)
    return np.stack([rest, squares], axis=-1)
