"""The pose of a depth camera by what it sees: its points are brought to the surface of a shape.

Points of the surface look for the nearest of the cloud, within a gate that narrows, and a step of
Gauss and Newton brings them together along the normals, against the prior of the pose (iterative
closest points: Chen & Medioni 1992).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ..arrays import Array
from ..recording.nuisance import DEPTH_SHIFT, DEPTH_TURN
from .skin import GRAZING, Skin
from .view import View

# Points of the surface, iterations, the share of a body's size that it may be off at first, and the
# weight of how far points are beside those of how far they are along normals. They count as so many
# independent ones beside the prior.
SAMPLES, ITERATIONS, REACH, SLIDING, INDEPENDENT = 250, 25, 0.35, 0.2, 10000
# Turns [rad] that it is begun from besides none, and how many are followed to the end.
TURNED, KEPT = 0.2, 2
# More points of a cloud only make it slower.
ENOUGH = 2000


def thinned(cloud: Array) -> Array:
    """No more points of a cloud (P, k) than are enough, from all over it."""
    return cloud[:: 1 + len(cloud) // ENOUGH]


def alignment(view: View, skin: Skin, x: Array, sample: int) -> tuple[Array, Array]:
    """Turn (3,) and shift (3,) of the camera that bring what it sees to a shape x (n, 3).

    From where the camera is stated to be, or with what it sees there brought to the middle of the
    shape, and turned from there both ways about each axis: the best of all. What is not of the body
    is nearest to nothing.
    """
    rotations, translations = view.motion
    corners = ((x - translations[sample]) @ rotations[sample])[skin.flat]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(sides, axis=1)
    whole = area * np.repeat(skin.chosen, len(area) // len(skin.faces))
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(area), SAMPLES, p=whole / whole.sum())
    places = np.einsum("pc,pci->pi", rng.dirichlet(np.ones(3), SAMPLES), corners[chosen])
    normals = sides[chosen] / area[chosen, None]
    size_m = float(np.linalg.norm(np.ptp(x, axis=0)))
    tree = KDTree(thinned(view.depth.points_m[sample]))
    gates = np.geomspace(REACH * size_m, view.depth.gate_m, ITERATIONS)
    turns = np.vstack([np.zeros(3), TURNED * np.eye(3), -TURNED * np.eye(3)])
    seen = np.asarray(tree.data)[KDTree(places).query(tree.data)[0] < gates[0]]
    shifts = [np.zeros(3), places.mean(axis=0) - seen.mean(axis=0) if len(seen) else np.zeros(3)]
    tried = [(1.0, Rotation.from_rotvec(turn), shift) for turn in turns for shift in shifts]
    for some in np.array_split(gates, 2):
        tried = [_aligned(view, tree, places, normals, some, *start) for _, *start in tried]
        tried = sorted(tried, key=lambda each: each[0])[:KEPT]
    _, turn, shift = tried[0]
    return turn.as_rotvec(), shift


def _aligned(
    view: View,
    tree: KDTree,
    places: Array,
    normals: Array,
    gates: Array,
    turn: Rotation,
    shift: Array,
) -> tuple[float, Rotation, Array]:
    """How much of the surface at (P, 3) misses the cloud, turn and shift, from some on."""
    pivot = view.pivot_m
    prior = np.concatenate([view.prior(row) for row in (DEPTH_TURN, DEPTH_SHIFT)])
    missed = 1.0
    for gate in gates:
        # Cloud points p are at R (p − c) + c + d: the surface looks for them in their own frame.
        _, nearest = tree.query(turn.inv().apply(places - pivot - shift) + pivot)
        moved = turn.apply(np.asarray(tree.data)[nearest] - pivot) + pivot + shift
        away, turned = moved - places, np.ones(len(places), dtype=bool)
        if view.depth.camera.matrix is not None:
            ways = turn.apply(-pivot) + pivot + shift - places
            turned = np.sum(normals * ways, axis=1) > GRAZING * np.linalg.norm(ways, axis=1)
        squares = np.sum(away**2, axis=1)
        missed = float(np.minimum(squares / gate**2, 1.0)[turned].mean()) if turned.any() else 1.0
        weight = np.sqrt(INDEPENDENT / max(turned.sum(), 1)) * turned / gate
        weight /= 1 + squares / (gate / 2) ** 2
        by = np.concatenate(
            [-_skew(moved - pivot - shift), np.tile(np.eye(3), (len(places), 1, 1))], axis=2
        )
        along = np.einsum("pi,pij->pj", normals, by), np.sum(normals * away, axis=1)
        rows = [along[0] * weight[:, None], *(SLIDING * by * weight[:, None, None]).swapaxes(0, 1)]
        right = [along[1] * weight, *(SLIDING * away * weight[:, None]).T]
        off = prior * np.concatenate([turn.as_rotvec(), shift])
        step = np.linalg.lstsq(
            np.concatenate([*rows, np.diag(prior)]), -np.concatenate([*right, off])
        )[0]
        turn, shift = Rotation.from_rotvec(step[:3]) * turn, shift + step[3:]
    return missed, turn, shift


def _skew(vectors: Array) -> Array:
    """(P, 3, 3) matrices of cross products with vectors (P, 3)."""
    x, y, z = vectors.T
    none = np.zeros_like(x)
    return np.stack([[none, -z, y], [z, none, -x], [-y, x, none]]).transpose(2, 0, 1)
