"""Errors of the stress-free shape of a body, as smooth displacements of its nodes.

Two kinds enter the uncertainty budget. The surface of the mesh may be off along its normal by a
random field with a Gaussian correlation; its strongest modes are the components. And a mesh whose
origin is not stated may be a shape under the body's own weight, in an unknown orientation: to first
order, the stress-free shape then differs by the static deflection.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree

from ...common.array_types import Array, Index
from ...fem.body import Body
from ...fem.meshes.mesh import ElementNodes, TetMesh

# Modes of the error of the surface: with the correlation length below they have most of its
# variance, and each costs one evaluation of the forces and one column of a sweep.
SURFACE_MODES = 6
# Correlation length of the surface's error over the longest extent of the body: moulds and
# scans are off by smooth shapes, such as a taper, a bend or a swelling.
CORRELATION = 0.5
# Over this share of the correlation length the error vanishes towards nodes that are known.
KNOWN_WITHIN = 0.25
# Surface nodes of which the modes are found; others follow by the correlation (Nyström).
MOST_NODES = 600
# Largest deflection over the longest extent: a mesh that had sagged further would not be taken for
# the stress-free shape.
MOST_SAG = 0.2
# Gravity under which the mesh sags [m/s²].
GRAVITY_M_S2 = 9.81
# A body that nothing grips stood on its nodes in this share of its height.
STANDING = 0.02


def extents_m(points_m: Array) -> Array:
    """Return the extents (3,) of points (n, 3) along their principal axes, largest first [m]."""
    centred = points_m - points_m.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    return np.sort(np.ptp(centred @ axes.T, axis=0))[::-1]


def thickness_m(body: Body) -> float:
    """Return the thickness of a body [m]: its least extent, or six times its volume over its
    surface if that is less.

    Six times the volume over the surface is the edge of a cube; for bent or hollow bodies it is
    less than the extents.
    """
    a, b, c = np.moveaxis(body.mesh.points_m[body.mesh.surface], 1, 0)
    area_m2 = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    return min(6 * body.mesh.volume_m3 / area_m2, float(extents_m(body.mesh.points_m)[-1]))


# Share of its bounding box that a square section fills at least, and a round one of polygons at most
# and at least.
SQUARE, ROUND = 0.98, (0.6, 0.82)
# Largest relative difference of both widths, and least length over them.
ALIKE, LONG = 0.05, 1.2


class OtherSection(NamedTuple):
    """Another section of a straight body: "round" in place of square or "square" in place of round,
    the volume with it over that of the mesh, the displacements (n, 3) of points [m], the axes (3,) of
    the coordinates across the body, and the middle (3,) of the body [m].
    """

    name: str
    volume_ratio: float
    moved_m: Array
    is_across: NDArray[np.bool_]
    middle_m: Array


def other_section(mesh: TetMesh, points_m: Array) -> OtherSection | None:
    """Return the other section of a straight mesh with a square or a round one of the same width, and
    how points (n, 3) of the mesh move with it, by the elliptical map of a square to a disc; None for
    other bodies. The longest extent is along an axis of the coordinates.
    """
    low, high = mesh.bounds_m
    extents = high - low
    along = int(extents.argmax())
    across = [axis for axis in range(3) if axis != along]
    if np.ptp(extents[across]) > ALIKE * extents[across].mean():
        return None
    if extents[along] < LONG * extents[across].mean():
        return None
    filled = mesh.volume_m3 / float(np.prod(extents))
    half_m = extents[across] / 2
    own = (points_m[:, across] - (low + high)[across] / 2) / half_m
    if filled > SQUARE:
        name, volume = "round", np.pi / 4
        other = own * np.sqrt(np.maximum(0.5, 1 - own[:, ::-1] ** 2 / 2))
    elif ROUND[0] < filled < ROUND[1]:
        name, volume = "square", 1.0
        disc = own / np.maximum(1.0, np.linalg.norm(own, axis=1))[:, None]
        sums = 2 + disc**2 - disc[:, ::-1] ** 2
        roots = [np.sqrt(np.maximum(0.0, sums + sign * np.sqrt(8) * disc)) for sign in (1, -1)]
        other = (roots[0] - roots[1]) / 2
    else:
        return None
    moved_m = np.zeros_like(points_m)
    moved_m[:, across] = (other - own) * half_m
    is_across = np.isin(np.arange(3), across)
    return OtherSection(name, volume / filled, moved_m, is_across, (low + high) / 2)


def surface_modes(body: Body, known: Index) -> Array:
    """Return displacements (modes, n, 3) of the nodes for unit standard deviation of the surface's
    error.

    The surface is displaced along its normals by each mode in turn, scaled by the mode's standard
    deviation; inside, displacements are harmonic on the graph of the mesh.

    Parameters
    ----------
    known : (k,) array
        Nodes of the mesh near which the surface is known, such as those that touch an obstacle.

    Notes
    -----
    Near `known` nodes they vanish. There are `SURFACE_MODES` modes; if the surface has fewer nodes,
    the others are zero.
    """
    corners = ElementNodes.corners(body.mesh)
    area_m2, normals = corners.surface_shares
    surface = np.flatnonzero(area_m2 > 0)
    fields = np.zeros((len(corners.points_m), SURFACE_MODES))
    length_m = CORRELATION * float(extents_m(corners.points_m)[0])
    own = _correlation_modes(corners.points_m[surface], area_m2[surface], length_m=length_m)
    fields[surface, : own.shape[1]] = own
    if known.size:
        away_m = KDTree(corners.points_m[known]).query(corners.points_m)[0]
        fields *= 1 - np.exp(-((away_m / (KNOWN_WITHIN * length_m)) ** 2))[:, None]
    displacements = fields[:, :, None] * normals[:, None, :]
    harmonic = _harmonic_extension(corners, surface, values=displacements.reshape(len(fields), -1))
    of_corners = harmonic.reshape(len(fields), SURFACE_MODES, 3)
    return _extend_to_all_nodes(body, of_corners.transpose(1, 0, 2))


def _correlation_modes(points_m: Array, weights: Array, length_m: float) -> Array:
    """Return the strongest modes of a random field with unit variance and Gaussian correlation,
    scaled by their standard deviations.

    Of more than `MOST_NODES` points a random subset, the same in every call, determines the modes.
    """
    count = min(len(points_m), MOST_NODES)
    chosen = np.sort(np.random.default_rng(0).permutation(len(points_m))[:count])

    def covariance(a: Array, b: Array) -> Array:
        squares = np.sum((a[:, None] - b[None]) ** 2, axis=2)
        return np.asarray(np.exp(-0.5 * squares / length_m**2))

    root = np.sqrt(weights[chosen] / weights[chosen].sum())
    kernel = covariance(points_m[chosen], points_m[chosen])
    values, vectors = np.linalg.eigh(root[:, None] * kernel * root)
    modes = min(SURFACE_MODES, count)
    strongest = np.argsort(values)[::-1][:modes]
    # φ(y) = λ⁻¹ Σ w C(y, y_i) φ(y_i), times √λ.
    scaled = root[:, None] * vectors[:, strongest] / np.sqrt(values[strongest])
    return covariance(points_m, points_m[chosen]) @ scaled


def _harmonic_extension(nodes: ElementNodes, surface: Index, values: Array) -> Array:
    """Return values (n, m) with those inside the surface replaced by a solution of Laplace."""
    count = len(nodes.points_m)
    extended = values.copy()
    inside = np.setdiff1d(np.arange(count), surface)
    if not inside.size:
        return extended
    a, b = nodes.mesh.edges.T
    ones = np.ones(2 * len(a))
    rows = np.concatenate([a, b])
    columns = np.concatenate([b, a])
    adjacency = sp.csr_array((ones, (rows, columns)), shape=(count, count))
    laplacian = sp.csc_array(sp.diags_array(adjacency.sum(axis=1)) - adjacency)
    right = -(laplacian[inside][:, surface] @ values[surface])
    extended[inside] = splu(sp.csc_array(laplacian[inside][:, inside])).solve(right)
    return extended


def _extend_to_all_nodes(body: Body, corner_fields: Array) -> Array:
    """Return fields (m, n, 3) from corners: means at mid nodes, zero at obstacle frames."""
    fields = np.zeros((len(corner_fields), *body.nodes_m.shape))
    corners = corner_fields.shape[1]
    fields[:, :corners] = corner_fields
    ends = body.nodes.ends
    if len(ends):
        fields[:, corners : corners + len(ends)] = corner_fields[:, ends].mean(axis=2)
    return fields


def standing_nodes(body: Body, gravity_m_s2: Array) -> Index:
    """Return the indices of the lowest nodes of the undeformed body, up to `STANDING` of its
    height, on which it stands if nothing grips it.

    Down is the direction of gravity (3,) [m/s²]; that of −z if there is no gravity.
    """
    points_m = body.nodes.points_m
    length = float(np.linalg.norm(gravity_m_s2))
    up = -np.asarray(gravity_m_s2) / length if length else np.array([0.0, 0.0, 1.0])
    height_m = points_m @ up
    low_m = height_m.min()
    return np.flatnonzero(height_m <= low_m + STANDING * max(np.ptp(height_m), 1e-300))


def sag_m(body: Body, theta: Array, support_dofs: Index, axis: int) -> Array:
    """Return the difference (n, 3) of stress-free shape and mesh if the mesh sagged along one of
    its axes, X − Y [m].

    To first order, the negative deflection under the body's own weight; limited to `MOST_SAG` of
    the longest extent. Zero if the supported dofs do not prevent rigid motions.

    Parameters
    ----------
    theta : (k,) array
        Constants of the body.
    support_dofs : (k,) array
        Dofs that were supported.
    axis : int
        Index of the axis along which gravity acted.

    Notes
    -----
    Gravity of 9.81 m/s² acts towards positive coordinates of the axis; the other sign gives the
    opposite difference. Air is ignored.
    """
    own = body.nodes.points_m.size
    x = np.asarray(body.nodes_m, dtype=float)
    stiffness = -body.linearise(x, np.zeros_like(x), theta=theta).by_position[0]
    free = np.setdiff1d(np.arange(own), support_dofs)
    matrix = sp.csc_array(body.pattern.matrix(stiffness)[free][:, free])
    weight_n = np.zeros(own)
    weight_n[axis::3] = GRAVITY_M_S2 * body.mass_of_dofs(theta)[:own][axis::3]
    difference_m = np.zeros(body.nodes_m.size)
    try:
        difference_m[free] = -splu(matrix).solve(weight_n[free])
    except RuntimeError:
        # A body that could move freely has no deflection: what holds it was not found.
        return difference_m.reshape(-1, 3)
    largest = float(np.abs(difference_m).max(initial=0.0))
    limit_m = MOST_SAG * float(extents_m(body.mesh.points_m)[0])
    if not np.isfinite(largest):
        return np.zeros_like(x)
    return difference_m.reshape(-1, 3) * min(1.0, limit_m / max(largest, 1e-300))
