"""Where markers sit on the body: fixed weights on the nodes of one element each.

A marker outside the body belongs to the tetrahedron nearest to it, whose shape functions are
extrapolated to the marker; the distance bridged is reported and limited.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, Index
from ..errors import InputError
from .arrays import read_only_floats, read_only_nodes

if TYPE_CHECKING:
    from ..fem.body import Body

Attachment = Literal["auto", "vertex", "embedded"]

# "auto" takes a mesh vertex for the marker when it is this near, in mean edge lengths.
VERTEX_SNAP = 0.05
_INSIDE_TOLERANCE = 1e-9
_EMBEDDING_ITERATIONS = 30


@dataclass(frozen=True, eq=False)
class Placement:
    """Markers as fixed linear combinations of node positions.

    Parameters
    ----------
    nodes : (M, npe) int array
        Nodes each marker depends on; no repeats within a row.
    weights : (M, npe) array
        Their weights; each row sums to one.
    distance_m : (M,) array
        Distance bridged: from the marker to the surface if it was outside the body, to the node
        if it was attached to a vertex, otherwise 0.
    node_count : int
        Number of nodes of the body.
    """

    nodes: Index
    weights: Array
    distance_m: Array
    node_count: int

    def __post_init__(self) -> None:
        nodes = read_only_nodes(self.nodes, (None, None), "nodes of the placement")
        if nodes.size and nodes.max() >= self.node_count:
            raise InputError(
                f"the placement refers to node {nodes.max()}, but the body has {self.node_count}"
            )
        weights = read_only_floats(self.weights, nodes.shape, "weights of the placement")
        distance = read_only_floats(self.distance_m, (len(nodes),), "distance_m of the placement")
        vars(self).update(nodes=nodes, weights=weights, distance_m=distance)


def place_markers(
    points_m: ArrayLike,
    node_positions_m: ArrayLike,
    body: Body,
    attach: Attachment = "auto",
    max_distance_m: float | None = None,
    names: Sequence[str] | None = None,
) -> Placement:
    """Find each marker's place on the body.

    Parameters
    ----------
    points_m : (M, 3) array
        Marker positions.
    node_positions_m : (n, 3) array
        Node positions at that moment.
    body : Body
        Provides `cells` and `element`.
    attach : {"auto", "vertex", "embedded"}
        "vertex": the nearest node. "embedded": the tetrahedron holding the marker, or nearest to
        it. "auto": the nearest node if within 5 % of the mean edge length, else embedded.
    max_distance_m : float, optional
        Largest distance that may be bridged; by default the mean edge length.
    names : sequence of str, optional
        Marker names for messages.

    Raises
    ------
    InputError
        If a marker has no position or is too far from the body.
    """
    points = read_only_floats(points_m, (None, 3), "marker positions", finite=False)
    nodes_m = read_only_floats(node_positions_m, (None, 3), "node positions")
    labels = [str(k) for k in range(len(points))] if names is None else list(names)
    if len(labels) != len(points):
        raise InputError(f"{len(labels)} marker names for {len(points)} marker positions")
    if attach not in get_args(Attachment):
        raise InputError(f"attach is {attach!r}; expected one of {', '.join(get_args(Attachment))}")
    lost = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if lost.size:
        raise InputError(
            f"marker '{labels[lost[0]]}' has no position from which to find its place on the body; "
            "give its reference_m"
        )
    shape = Shape(nodes_m, body)
    snap_m = {"auto": VERTEX_SNAP * shape.mean_edge_m, "vertex": np.inf, "embedded": -1.0}[attach]
    limit_m = shape.mean_edge_m if max_distance_m is None else max_distance_m

    nodes = np.empty((len(points), body.cells.shape[1]), dtype=np.int64)
    weights = np.empty(nodes.shape)
    distance = np.empty(len(points))
    for k, point in enumerate(points):
        node_distance = np.linalg.norm(nodes_m - point, axis=1)
        vertex = int(np.argmin(node_distance))
        if node_distance[vertex] <= snap_m:
            nodes[k], weights[k] = shape.vertex(vertex)
            distance[k] = node_distance[vertex]
        else:
            nodes[k], weights[k], distance[k] = shape.embed(point)
        if distance[k] > limit_m:
            raise InputError(
                f"marker '{labels[k]}' at ({', '.join(f'{x:.4g}' for x in point)}) m is "
                f"{distance[k]:.4g} m away from the body, more than the {limit_m:.4g} m allowed; "
                "check length_unit, the frame of the poses and the marker's reference_m, "
                "or raise max_distance_m"
            )
    return Placement(nodes, weights, distance, len(nodes_m))


class Shape:
    """The body in one configuration, prepared for locating points."""

    def __init__(self, nodes_m: Array, body: Body) -> None:
        self.nodes_m = nodes_m
        self.body = body
        corners = body.cells[:, :4]
        pairs = np.concatenate([corners[:, pair] for pair in combinations(range(4), 2)])
        pairs = np.unique(np.sort(pairs, axis=1), axis=0)
        self.mean_edge_m = float(
            np.linalg.norm(nodes_m[pairs[:, 0]] - nodes_m[pairs[:, 1]], axis=1).mean()
        )
        self.origin = nodes_m[corners[:, 0]]
        edges = nodes_m[corners[:, 1:]] - self.origin[:, None]
        self.inverse = np.linalg.inv(edges)  # L1..L3 = (x − origin) @ inverse
        faces, self.face_owner = _boundary_faces(corners)
        self.triangles = nodes_m[faces]

    def vertex(self, node: int) -> tuple[Index, Array]:
        """Nodes and weights of a marker on a node: an element around it, all weight on the node."""
        cell = self.body.cells[np.argmax((self.body.cells == node).any(axis=1))]
        return cell, (cell == node).astype(np.float64)

    def embed(self, point: Array) -> tuple[Index, Array, float]:
        """Nodes, weights and distance to the surface of a marker inside or outside the body."""
        cell, distance = self.cell_of(point)
        return self.body.cells[cell], self._weights(point, cell), distance

    def cell_of(self, point: Array) -> tuple[int, float]:
        """The element that holds a point (3,), or is nearest to it, and the distance between."""
        depth = self.barycentric(point, slice(None)).min(axis=1)
        cell = int(np.argmax(depth))
        if depth[cell] >= -_INSIDE_TOLERANCE:
            return cell, 0.0
        to_faces = _distance_to_triangles(point, self.triangles)
        distance = float(to_faces.min())
        # Where an edge or corner is nearest, extrapolate from the element that must the least.
        nearest = self.face_owner[to_faces <= distance + 1e-9 * self.mean_edge_m]
        return int(nearest[np.argmax(depth[nearest])]), distance

    def nearest(self, point: Array) -> tuple[Index, Array]:
        """Nodes and weights of the point of the body that is nearest to a point (3,)."""
        nodes, weights, distance = self.embed(point)
        if distance == 0.0:
            return nodes, weights
        nodes, weights, _ = self.embed(self.on_surface(point)[0])
        return nodes, weights

    def on_surface(self, point: Array) -> tuple[Array, Array]:
        """The nearest point of the surface, and two directions (3, 2) in its face."""
        face = int(np.argmin(_distance_to_triangles(point, self.triangles)))
        corners = self.triangles[face]
        along = np.asarray(np.linalg.qr((corners[1:] - corners[0]).T)[0], dtype=np.float64)
        return _nearest_in_triangle(point, corners), along

    def barycentric(self, points: Array, cells: slice | Index) -> Array:
        """Barycentric coordinates (k, 4) of points (k, 3), or of one (3,), in cells (k,)."""
        rest = np.einsum("ei,eij->ej", points - self.origin[cells], self.inverse[cells])
        return np.column_stack([1.0 - rest.sum(axis=1), rest])

    def gradients(self, cells: Index) -> Array:
        """Their derivatives (k, 4, 3) by the point."""
        rest = np.asarray(np.swapaxes(self.inverse[cells], 1, 2), dtype=np.float64)
        return np.concatenate([-rest.sum(axis=1, keepdims=True), rest], axis=1)

    def _weights(self, point: Array, cell: int) -> Array:
        """Shape functions at the point.

        The corners' barycentric coordinates are exact for straight sides. Where deformation has
        curved a quadratic element they are corrected until the element maps them to the point.
        """
        one = np.array([cell])
        local = self.barycentric(point, one)
        best, best_miss = self.body.element.shape_functions(local)[0], np.inf
        for _ in range(_EMBEDDING_ITERATIONS):
            weights = self.body.element.shape_functions(local)[0]
            miss = point - weights @ self.nodes_m[self.body.cells[cell]]
            if not np.linalg.norm(miss) < best_miss:
                break
            best, best_miss = weights, np.linalg.norm(miss)
            step = miss @ self.inverse[cell]
            local = local + np.concatenate([[-step.sum()], step])
        return best


def _nearest_in_triangle(point: Array, corners: Array) -> Array:
    """The point of a triangle (3, 3) that is nearest to a point (3,)."""
    a, edges = corners[0], (corners[1:] - corners[0]).T
    share = np.linalg.lstsq(edges, point - a, rcond=None)[0]
    if (share >= 0).all() and share.sum() <= 1:
        return np.asarray(a + edges @ share, dtype=np.float64)
    ends = [(corners[i], corners[j]) for i, j in combinations(range(3), 2)]
    feet = [
        p + np.clip((point - p) @ (q - p) / ((q - p) @ (q - p)), 0.0, 1.0) * (q - p)
        for p, q in ends
    ]
    nearest = int(np.argmin([np.linalg.norm(point - foot) for foot in feet]))
    return np.asarray(feet[nearest], dtype=np.float64)


def _boundary_faces(corners: Index) -> tuple[Index, Index]:
    """Triangles that belong to one tetrahedron only, and that tetrahedron."""
    faces = np.concatenate([corners[:, triple] for triple in combinations(range(4), 3)])
    owner = np.tile(np.arange(len(corners)), 4)
    _, first, uses = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    outer = first[uses == 1]
    return faces[outer], owner[outer]


def _distance_to_triangles(point: Array, triangles: Array) -> Array:
    """Distance from a point (3,) to each triangle (F, 3, 3)."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = np.cross(b - a, c - a)
    area_squared = np.einsum("fi,fi->f", normal, normal)
    in_c = np.einsum("fi,fi->f", np.cross(b - a, point - a), normal) / area_squared
    in_b = np.einsum("fi,fi->f", np.cross(point - a, c - a), normal) / area_squared
    above = (in_b >= 0.0) & (in_c >= 0.0) & (in_b + in_c <= 1.0)
    to_plane = np.abs(np.einsum("fi,fi->f", point - a, normal)) / np.sqrt(area_squared)
    to_edges = np.min([_distance_to_segments(point, p, q) for p, q in ((a, b), (b, c), (c, a))], 0)
    return np.where(above, to_plane, to_edges)


def _distance_to_segments(point: Array, start: Array, end: Array) -> Array:
    along = end - start
    fraction = np.einsum("fi,fi->f", point - start, along) / np.einsum("fi,fi->f", along, along)
    nearest = start + np.clip(fraction, 0.0, 1.0)[:, None] * along
    return np.linalg.norm(point - nearest, axis=1)
