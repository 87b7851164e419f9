"""Attachment of markers to the body: fixed weights of the nodes of one element each.

A marker outside the body is attached to the nearest tetrahedron, whose shape functions are
extrapolated to the marker; the distance between them is reported and limited.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..common.array_types import Array, Index
from ..common.checked_arrays import point_text, read_only_floats, read_only_nodes
from ..common.validated_classes import validated
from ..errors import InputError

if TYPE_CHECKING:
    from ..fem.body import Body

AttachmentRule = Literal["auto", "vertex", "embedded"]

# Largest distance, in mean edge lengths, at which "auto" attaches a marker to a mesh vertex.
VERTEX_SNAP_EDGES = 0.05
# Least barycentric coordinate of a point inside an element: rounding.
_INSIDE_TOLERANCE = 1e-9
# Most iterations for a point in a curved element; they stop when the distance no longer decreases.
_EMBEDDING_ITERATIONS = 30


@validated
@dataclass(frozen=True, eq=False)
class Placement:
    """Attachment of markers as fixed linear combinations of node positions.

    Parameters
    ----------
    nodes : (M, npe) int array
        Nodes each marker depends on; no repeats within a row.
    weights : (M, npe) array
        Weights of these nodes; each row sums to one.
    distance_m : (M,) array
        Distance of the marker: from the surface if it was outside the body, from the node if it was
        attached to a vertex, otherwise 0.
    node_count : int
        Number of nodes of the body.
    """

    nodes: Index
    weights: Array
    distance_m: Array
    node_count: int

    def __post_init__(self) -> None:
        nodes = read_only_nodes(self.nodes, (None, None), name="nodes of the placement")
        if nodes.size and nodes.max() >= self.node_count:
            raise InputError(
                f"the placement refers to node {nodes.max()}; expected node indices from 0 to "
                f"{self.node_count - 1}"
            )
        weights = read_only_floats(self.weights, nodes.shape, name="weights of the placement")
        distance = read_only_floats(
            self.distance_m, (len(nodes),), name="distance_m of the placement"
        )
        vars(self).update(nodes=nodes, weights=weights, distance_m=distance)


def require_body(body: Body) -> Body:
    """Return a body, or what has nodes like one; raise an `InputError` for anything else."""
    if not hasattr(body, "nodes_m"):
        raise InputError(f"the body is a {type(body).__name__}; expected a Body")
    return body


@validated
def place_markers(
    points_m: ArrayLike,
    node_positions_m: ArrayLike,
    body: Body,
    attach: AttachmentRule = "auto",
    max_distance_m: float | None = None,
    names: Sequence[str] | None = None,
    *,
    sensor: str | None = None,
) -> Placement:
    """Return the place of each marker, or of each point of a sensor, on the body.

    Parameters
    ----------
    points_m : (M, 3) array
        Marker positions.
    node_positions_m : (n, 3) array
        Node positions of the body in the same configuration.
    body : Body
        Provides `mesh`, `cells` and `element`.
    attach : {"auto", "vertex", "embedded"}
        "vertex": the nearest node. "embedded": the tetrahedron that contains the marker, or is
        nearest to it. "auto": the nearest node if within 5 % of the mean edge length, else
        embedded.
    max_distance_m : float, optional
        Largest distance between marker and body, or, of a marker on a node, between marker and
        node; by default the mean edge length.
    names : sequence of str, optional
        Marker names for messages; indices from 0 by default.
    sensor : str, optional
        Name of the custom sensor to which the points belong, for messages; None for markers.

    Raises
    ------
    InputError
        If a marker has a position that is not finite or is too far from the body, the rule is
        unknown, or names and positions differ in number.
    """
    points = read_only_floats(points_m, (None, 3), name="marker positions", finite=False)
    nodes_m = read_only_floats(node_positions_m, (None, 3), name="node positions")
    labels = [str(k) for k in range(len(points))] if names is None else list(names)
    if len(labels) != len(points):
        raise InputError(
            f"found {len(labels)} marker names for {len(points)} marker positions; expected one "
            "name for each position"
        )
    unplaced = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if unplaced.size:
        raise InputError(
            f"marker '{labels[unplaced[0]]}' has no sample from which its position on the body "
            "could be determined; give its reference_m"
        )
    shape = LocatedBody(nodes_m, require_body(body))
    snap_m = {"auto": VERTEX_SNAP_EDGES * shape.mean_edge_m, "vertex": np.inf, "embedded": -1.0}[
        attach
    ]
    limit_m = shape.mean_edge_m if max_distance_m is None else max_distance_m

    nodes = np.empty((len(points), body.place_cells.shape[1]), dtype=np.int64)
    weights = np.empty(nodes.shape)
    distance = np.empty(len(points))
    for k, point in enumerate(points):
        node_distance = np.linalg.norm(nodes_m - point, axis=1)
        vertex = int(np.argmin(node_distance))
        if node_distance[vertex] <= snap_m:
            nodes[k], weights[k] = shape.weights_at_node(vertex)
            distance[k] = node_distance[vertex]
        else:
            nodes[k], weights[k], distance[k] = shape.weights_at_point(point)
        if distance[k] > limit_m:
            what = (
                f"marker '{labels[k]}'"
                if sensor is None
                else f"point {k + 1} of the reading '{sensor}'"
            )
            remedy = (
                "check length_unit, the frame of the poses and the marker's reference_m, "
                "or raise max_distance_m"
                if sensor is None
                else "expected points_m on the undeformed body, in metres"
            )
            raise InputError(
                f"{what} at {point_text(point)} m is {distance[k]:.4g} m away from the body, more "
                f"than the {limit_m:.4g} m allowed; {remedy}"
            )
    return Placement(nodes, weights, distance_m=distance, node_count=len(nodes_m))


class LocatedBody:
    """A body in one configuration, prepared for locating points in it.

    Parameters
    ----------
    nodes_m : (n, 3) array
        Node positions.

    Attributes
    ----------
    mean_edge_m : float
        Mean length of the edges of the mesh.
    origin : (E, 3) array
        First corner of each element.
    inverse : (E, 3, 3) array
        Inverse of the matrix whose rows are the edges from that corner to the other three.
    triangles : (F, 3, 3) array
        Corners of the surface.
    """

    def __init__(self, nodes_m: Array, body: Body) -> None:
        self.nodes_m = nodes_m
        self.body = body
        corners = body.place_cells[:, :4]
        ends = nodes_m[body.mesh.edges]
        self.mean_edge_m = float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())
        self.origin = nodes_m[corners[:, 0]]
        edges = nodes_m[corners[:, 1:]] - self.origin[:, None]
        self.inverse = np.linalg.inv(edges)  # L1..L3 = (x − origin) @ inverse
        self.triangles = nodes_m[body.mesh.surface]

    def weights_at_node(self, node: int) -> tuple[Index, Array]:
        """Return nodes (npe,) and weights (npe,) of a marker on a node, by its index: nodes of the
        first element that has the node, whose weight is 1 and all others 0.
        """
        cell = self.body.place_cells[np.argmax((self.body.place_cells == node).any(axis=1))]
        return cell, (cell == node).astype(np.float64)

    def weights_at_point(self, point: Array) -> tuple[Index, Array, float]:
        """Return the nodes (npe,) of the element that contains a point (3,), the values (npe,) of
        their shape functions there, which sum to one, and the distance of the point from the
        surface [m], 0 inside the body.

        A point outside the body is an extrapolation from the nearest element.
        """
        cell, distance = self.nearest_cell(point)
        return self.body.place_cells[cell], self._shape_functions_at(point, cell), distance

    def nearest_cell(self, point: Array) -> tuple[int, float]:
        """Return the index of the element that contains a point (3,), or is nearest to it, and its
        distance from the surface [m], 0 inside. Elements are taken with straight edges.

        If several elements share the nearest edge or corner, it is the one in which the least
        barycentric coordinate of the point is largest.
        """
        least_coordinate = self.barycentric(point, slice(None)).min(axis=1)
        cell = int(np.argmax(least_coordinate))
        if least_coordinate[cell] >= -_INSIDE_TOLERANCE:
            return cell, 0.0
        to_faces = np.linalg.norm(
            point - nearest_points_of_triangles(point, self.triangles), axis=1
        )
        distance = float(to_faces.min())
        # Where an edge or corner is nearest, extrapolate from the element that must the least.
        nearest = self.body.mesh.surface_cells[to_faces <= distance + 1e-9 * self.mean_edge_m]
        return int(nearest[np.argmax(least_coordinate[nearest])]), distance

    def weights_at_nearest_point(self, point: Array) -> tuple[Index, Array]:
        """Return nodes (npe,) and weights (npe,) of the point of the body that is nearest to a
        point (3,): the point itself if it is inside.
        """
        nodes, weights, distance_m = self.weights_at_point(point)
        if distance_m > 0.0:
            nearest_m, _ = self.nearest_surface_point(point)
            nodes, weights, _ = self.weights_at_point(nearest_m)
        return nodes, weights

    def places_of_points(self, points_m: Array) -> Array:
        """Return the places (M, 3) on the undeformed body [m] of points (M, 3) [m] that are
        measured in the configuration of these nodes.

        A point outside the body gets the place of the nearest point of its surface, and a point
        that is not finite NaN.
        """
        places_m = np.full(points_m.shape, np.nan)
        for m in np.flatnonzero(np.isfinite(points_m).all(axis=1)).tolist():
            nodes, weights = self.weights_at_nearest_point(points_m[m])
            places_m[m] = weights @ self.body.nodes_m[nodes]
        return places_m

    def nearest_surface_point(self, point: Array) -> tuple[Array, Array]:
        """Return the nearest point (3,) [m] of the surface of straight triangles, and two
        orthogonal unit tangents of its face as columns (3, 2); unless the body is a solid,
        `Kind.nearest_place`.
        """
        if not self.body.is_solid:
            return self.body.kind.nearest_place(self.nodes_m, point)
        nearest = nearest_points_of_triangles(point, self.triangles)
        face = int(np.linalg.norm(point - nearest, axis=1).argmin())
        sides = self.triangles[face, 1:] - self.triangles[face, 0]
        return nearest[face], np.asarray(np.linalg.qr(sides.T)[0], dtype=np.float64)

    def barycentric(self, points: Array, cells: slice | Index) -> Array:
        """Return barycentric coordinates (k, 4) of points (k, 3), or of one point (3,), in the
        cells with the indices (k,), as of straight edges; negative outside a cell.
        """
        rest = np.einsum("ei,eij->ej", points - self.origin[cells], self.inverse[cells])
        return np.column_stack([1.0 - rest.sum(axis=1), rest])

    def barycentric_gradients(self, cells: Index) -> Array:
        """Return the derivatives (k, 4, 3) of the barycentric coordinates by the point [1/m], in
        the cells with the indices (k,).
        """
        rest = np.asarray(np.swapaxes(self.inverse[cells], 1, 2), dtype=np.float64)
        return np.concatenate([-rest.sum(axis=1, keepdims=True), rest], axis=1)

    def _shape_functions_at(self, point: Array, cell: int) -> Array:
        """Return the shape functions (npe,) of an element at a point (3,), which may be outside."""
        # Barycentric coordinates are exact for straight edges, and corrected for curved ones.
        one = np.array([cell])
        local = self.barycentric(point, one)
        best = self.body.place_element.shape_functions(local)[0]
        best_miss = np.inf
        for _ in range(_EMBEDDING_ITERATIONS):
            weights = self.body.place_element.shape_functions(local)[0]
            miss = point - weights @ self.nodes_m[self.body.place_cells[cell]]
            if not np.linalg.norm(miss) < best_miss:
                break
            best = weights
            best_miss = np.linalg.norm(miss)
            step = miss @ self.inverse[cell]
            local = local + np.concatenate([[-step.sum()], step])
        return best


def barycentric_in_triangles(points: Array, triangles: Array) -> Array:
    """Return the barycentric coordinates (..., 3) of points (..., 3) in the planes of triangles
    (..., 3, 3).
    """
    first = triangles[..., 0, :]
    ab = triangles[..., 1, :] - first
    ac = triangles[..., 2, :] - first
    away = points - first
    bb, bc, cc, to_b, to_c = (
        np.einsum("...i,...i->...", u, v)
        for u, v in ((ab, ab), (ab, ac), (ac, ac), (away, ab), (away, ac))
    )
    determinants = bb * cc - bc**2
    of_b = (cc * to_b - bc * to_c) / determinants
    of_c = (bb * to_c - bc * to_b) / determinants
    return np.stack([1 - of_b - of_c, of_b, of_c], axis=-1)


def nearest_points_of_triangles(point: Array, triangles: Array) -> Array:
    """Return the point (F, 3) of each triangle (F, 3, 3) that is nearest to one point (3,), or to
    the point (F, 3) of that triangle.

    For a degenerate triangle with three distinct corners it lies on a side.
    """
    point = point[..., None, :]
    ends = np.roll(triangles, -1, axis=1)
    sides = ends - triangles
    away = point - triangles
    share = np.einsum("fci,fci->fc", away, sides) / np.einsum("fci,fci->fc", sides, sides)
    on_sides = triangles + np.clip(share, 0.0, 1.0)[:, :, None] * sides
    best = np.linalg.norm(point - on_sides, axis=2).argmin(axis=1)
    ab = sides[:, 0]
    ac = -sides[:, 2]
    ap = away[:, 0]
    normal = np.cross(ab, ac)
    squared = np.einsum("fi,fi->f", normal, normal)
    in_c = np.einsum("fi,fi->f", np.cross(ab, ap), normal) / squared
    in_b = np.einsum("fi,fi->f", np.cross(ap, ac), normal) / squared
    above = (in_b >= 0.0) & (in_c >= 0.0) & (in_b + in_c <= 1.0)
    within = triangles[:, 0] + in_b[:, None] * ab + in_c[:, None] * ac
    return np.where(above[:, None], within, on_sides[np.arange(len(best)), best])
