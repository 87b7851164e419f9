"""Nodes of a mesh in planes across it, such as those where the fingers of a gripper end.

A body is free from its last held nodes on. In a mesh that was made without regard to the gripper
they end somewhere within an edge length of it, and the stiffness in bending depends on the cube of
the free length. Nodes near a plane are moved into it along its normal, and the edges that still
cross it are bisected there, with all elements around them: the mesh stays conforming.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from .checks import boundary_of, edge_lengths, orient_elements, signed_volumes, unique_edges

# Distance from a plane within which nodes are moved into it, in mean edge lengths of the mesh. A plane
# so near to the end of the body is the margin of a selection of its face, and does not cut.
NEAR = 0.35
# Largest distance by which that moves the surface, in the same unit.
SURFACE_SHIFT = 0.02
# Least volume that a moved node leaves to an element, as a share of the former one.
LEAST_VOLUME = 0.2
# Distance from a plane that is rounding, in the same unit.
ROUND_OFF = 1e-6


def with_nodes_in_planes(
    points_m: np.ndarray, tetrahedra: np.ndarray, planes_m: Mapping[str, Sequence[float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (n', 3) and elements (E', 4) none of which crosses one of the planes, given by
    their coordinates [m] along "x", "y" or "z".
    """
    tetrahedra, _ = orient_elements(points_m, tetrahedra)
    for k, axis in enumerate("xyz"):
        done_m: list[float] = []
        for plane_m in planes_m.get(axis, ()):
            along_m = points_m[:, k]
            edge_m = float(edge_lengths(points_m, tetrahedra).mean())
            if along_m.min() + NEAR * edge_m < plane_m < along_m.max() - NEAR * edge_m:
                points_m = _moved_into_plane(points_m, tetrahedra, edge_m, k, plane_m, done_m)
                points_m, tetrahedra = _cut(points_m, tetrahedra, edge_m, k, plane_m)
                done_m.append(plane_m)
    return points_m, tetrahedra


def _moved_into_plane(
    points_m: np.ndarray,
    tetrahedra: np.ndarray,
    edge_m: float,
    axis: int,
    plane_m: float,
    done_m: Sequence[float],
) -> np.ndarray:
    """Return the nodes (n, 3), those near the plane in it where surface, elements and planes before
    it, `done_m`, allow it.
    """
    away_m = np.abs(points_m[:, axis] - plane_m)
    faces, _ = boundary_of(tetrahedra)
    a, b, c = points_m[faces].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    slope = np.zeros(len(points_m))  # share of a way along the axis that leaves the surface
    np.maximum.at(
        slope, faces, np.abs(normals[:, [axis]]) / np.linalg.norm(normals, axis=1)[:, None]
    )
    is_moved = (away_m < NEAR * edge_m) & (slope * away_m <= SURFACE_SHIFT * edge_m)
    for before_m in done_m:
        is_moved &= np.abs(points_m[:, axis] - before_m) > ROUND_OFF * edge_m
    volumes = signed_volumes(points_m, tetrahedra)
    while True:
        points = points_m.copy()
        points[is_moved, axis] = plane_m
        is_flat = signed_volumes(points, tetrahedra) < LEAST_VOLUME * volumes
        ways_m = np.where(is_moved, away_m, 0.0)[tetrahedra[is_flat]]
        if not ways_m.any():
            return points
        is_moved[tetrahedra[is_flat, ways_m.argmax(axis=1)]] = False


def _cut(
    points: np.ndarray, tetrahedra: np.ndarray, edge_m: float, axis: int, plane_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Bisect each edge that crosses the plane, and the elements around it."""
    height_m = points[:, axis] - plane_m
    height_m[np.abs(height_m) <= ROUND_OFF * edge_m] = 0.0
    is_cut = height_m[tetrahedra].min(axis=1) * height_m[tetrahedra].max(axis=1) < 0
    cut = tetrahedra[is_cut]
    edges = unique_edges(cut)
    edges = edges[height_m[edges].prod(axis=1) < 0]
    weights = np.abs(height_m[edges][:, ::-1])
    weights /= weights.sum(axis=1, keepdims=True)
    middles = np.einsum("ek,eki->ei", weights, points[edges])
    middles[:, axis] = plane_m
    for node, (a, b) in enumerate(edges.tolist(), start=len(points)):
        around = (cut == a).any(axis=1) & (cut == b).any(axis=1)
        halves = [np.where(cut[around] == end, node, cut[around]) for end in (a, b)]
        cut = np.concatenate([cut[~around], *halves])
    return np.concatenate([points, middles]), np.concatenate([tetrahedra[~is_cut], cut])
