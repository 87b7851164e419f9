"""Surface of a body as seen by a depth camera: facing and hidden parts, and nearest points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...common.array_types import Array, Index
from ...fem.body import Body
from ...fem.elements import face_shape_functions
from ...recording.depth_camera import Depth
from ...recording.experiment import Experiment
from ...recording.placement import barycentric_in_triangles, nearest_points_of_triangles

# Number of triangles, nearest by their middles, among which the nearest point is searched.
NEARBY = 10
# Relative difference of distances below which triangles are equally near.
TIE = 1e-9
# Largest number of Newton steps to the nearest point on a curved face.
SETTLING = 3
# Change of barycentric coordinates below which these steps end.
STILL = 1e-6
# Cosine between normal and view below which a point is seen at a grazing angle; measured normals
# may be off by as much.
GRAZING = 0.3
# Cosine between the normals of two flat triangles below which their common edge is a crease:
# 30 degrees, more than between the facets of usual meshes of curved surfaces.
CREASE_COSINE = 0.87
# Distance between the points that stand for a crease, relative to the distance that is compared.
CREASE_STEP = 0.5

# Barycentric coordinates of the nodes of a face: corners a, b, c, then the middles of ab, bc, ca.
CORNERS = np.vstack([np.eye(3), [[0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5]]])
# Flat triangles, by the nodes at their corners, that stand for a face of three or of six nodes.
TRIANGLES_OF_FACE = {
    3: np.array([[0, 1, 2]]),
    6: np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]),
}


@dataclass(frozen=True, eq=False)
class VisibleSurface:
    """Faces of a body's surface, each divided into flat triangles."""

    nodes: Index  # (n,): indices of the body's nodes on the surface, ascending
    # (F, 3) or (F, 6): indices into `nodes` of each face: three corners, then for six nodes the
    # middles of its edges.
    faces: Index
    # (F,) of bool: faces that the camera may see according to the problem.
    is_selected: NDArray[np.bool_]

    @classmethod
    def from_body(cls, body: Body, depth: Depth | None = None) -> VisibleSurface:
        """Build the surface of a body, with the faces that a depth camera may see according to the
        problem; all of them if it does not state any, and without a depth camera.
        """
        triangles = body.mesh.surface
        chosen = np.ones(len(triangles), dtype=bool)
        if depth is not None and depth.faces is not None:
            chosen[:] = False
            chosen[depth.faces.resolve_faces(body.mesh)] = True
        nodes, faces = np.unique(body.nodes.nodes_of_faces(triangles), return_inverse=True)
        return cls(nodes, faces.reshape(len(triangles), -1), is_selected=chosen)

    def initial_positions_m(self, experiment: Experiment, depth: Depth) -> Array:
        """Return the node positions (n, 3) of the undeformed body in its grasps at the
        camera's first image with points [m].
        """
        return experiment.rigid_positions(depth.sample_times_s[[depth.first_sample_with_points]])[
            0, self.nodes
        ]

    @property
    def plane_triangles(self) -> Index:
        """Flat triangles (F·k, 3) as indices into `nodes`; those of a face are consecutive."""
        return self.faces[:, TRIANGLES_OF_FACE[self.faces.shape[1]]].reshape(-1, 3)

    @cached_property
    def edges(self) -> tuple[Index, Index]:
        """Edges (K, 2) between two flat triangles, as indices into `nodes`, and the indices (K, 2)
        of these triangles; edges with another number of triangles are omitted.
        """
        triangles = self.plane_triangles
        ends = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        unique, number, counts = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
        order = np.argsort(number.ravel(), kind="stable")
        first = np.cumsum(counts) - counts
        paired = counts == 2
        faces_of_edges = np.stack([order[first[paired]], order[first[paired] + 1]], axis=1) // 3
        return unique[paired], faces_of_edges

    def to_faces(self, triangles: Index, barycentric: Array) -> tuple[Index, Array]:
        """Return faces (P,), and barycentric coordinates (P, 3) on them, of points on flat
        triangles.

        Parameters
        ----------
        triangles : (P,) array
            Indices of flat triangles.
        barycentric : (P, 3) array
            Barycentric coordinates in the triangles.
        """
        parts = TRIANGLES_OF_FACE[self.faces.shape[1]]
        corners = CORNERS[parts[triangles % len(parts)]]
        return triangles // len(parts), np.einsum("pc,pci->pi", barycentric, corners)

    def evaluate(self, x: Array, faces: Index, barycentric: Array) -> tuple[Array, Array, Array]:
        """Return the shape functions (P, v) of the v nodes of each point's face, the positions
        (P, 3) [m] of points on a deformed surface, and its outward unit normals (P, 3) there, zero
        on a degenerate face.

        Parameters
        ----------
        x : (n, 3) array
            Node positions [m].
        faces : (P,) array
            Faces.
        barycentric : (P, 3) array
            Barycentric coordinates on them.
        """
        weights, points_m, tangents = self._evaluate_tangents(x, faces, barycentric)
        normals = np.cross(tangents[:, 0], tangents[:, 1])
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
        return weights, points_m, normals

    def _evaluate_tangents(
        self, x: Array, faces: Index, barycentric: Array
    ) -> tuple[Array, Array, Array]:
        """Return also tangents (P, 2, 3) [m] by two coordinates, the third changing oppositely."""
        weights, slopes = face_shape_functions(barycentric, self.faces.shape[1])
        corners = x[self.faces[faces]]
        tangents = np.einsum("pak,pai->pki", slopes[:, :, :2] - slopes[:, :, 2:], corners)
        return weights, np.einsum("pa,pai->pi", weights, corners), tangents

    def subdivided_triangles(self, x: Array, divisions: int = 4) -> Array:
        """Return the corners (F · divisions², 3, 3) [m] of triangles on a surface deformed to x (n,
        3) [m], with each side of a face divided into `divisions`; those of a face are consecutive.
        """
        i, j = np.indices((divisions, divisions)).reshape(2, -1)
        up = i + j < divisions
        down = i + j < divisions - 1
        upward = np.stack([[i, j], [i + 1, j], [i, j + 1]])[..., up]
        downward = np.stack([[i + 1, j], [i + 1, j + 1], [i, j + 1]])[..., down]
        of_b, of_c = np.concatenate([upward, downward], axis=2).transpose(1, 2, 0) / divisions
        places = np.stack([1 - of_b - of_c, of_b, of_c], axis=-1).reshape(-1, 3)
        faces = np.repeat(np.arange(len(self.faces)), len(places))
        barycentric = np.tile(places, (len(self.faces), 1))
        return self.evaluate(x, faces, barycentric=barycentric)[1].reshape(-1, 3, 3)

    def is_facing(
        self, x: Array, eye_m: Array | None, minimum_cosine: float = 0.0
    ) -> NDArray[np.bool_]:
        """Return the mask (F·k,) of flat triangles that face a camera; other parts of the body may
        still hide them.

        Parameters
        ----------
        x : (n, 3) array
            Node positions [m].
        eye_m : (3,) array or None
            Position of the camera [m]; None, for a point cloud without camera, gives all.
        minimum_cosine : float
            The cosine between the normal and the direction to the camera must be larger.
        """
        if eye_m is None:
            return np.ones(len(self.plane_triangles), dtype=bool)
        a, b, c = x[self.plane_triangles].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        way = eye_m - (a + b + c) / 3
        sizes = np.linalg.norm(normal, axis=1) * np.linalg.norm(way, axis=1)
        return np.sum(normal * way, axis=1) > minimum_cosine * sizes

    def is_hidden(
        self, x: Array, eye_m: Array | None, points_m: Array, front_m: float
    ) -> NDArray[np.bool_]:
        """Return the mask (P,) of points that another part of the surface hides from a camera.

        Only parts that face the camera and are completely in front of it hide points.

        Parameters
        ----------
        x : (n, 3) array
            Node positions [m].
        eye_m : (3,) array or None
            Position of the camera [m]; for None no point is hidden.
        points_m : (P, 3) array
            Points [m].
        front_m : float
            A part hides a point if it is more than this nearer to the camera along the optical axis
            [m].
        """
        behind = np.zeros(len(points_m), dtype=bool)
        if eye_m is None or not len(points_m):
            return behind
        # Seen from there in the plane at distance one.
        optical_axis, *across = np.linalg.svd((x.mean(axis=0) - eye_m)[None])[2]
        optical_axis *= np.sign(optical_axis @ (x.mean(axis=0) - eye_m))
        depths = (x - eye_m) @ optical_axis
        away = (points_m - eye_m) @ optical_axis
        corners = self.plane_triangles[self.is_facing(x, eye_m, minimum_cosine=0.0)]
        corners = corners[(depths[corners] > 0).all(axis=1)]
        places = ((x - eye_m) @ np.transpose(across) / depths[:, None])[corners]
        projected = (points_m - eye_m) @ np.transpose(across) / away[:, None]
        middles = places.mean(axis=1)
        reach = np.linalg.norm(places - middles[:, None], axis=2).max(initial=0.0)
        pairs = KDTree(projected).sparse_distance_matrix(
            KDTree(middles), reach, output_type="ndarray"
        )
        point = pairs["i"]
        triangle = pairs["j"]
        nearest_m = depths[corners].min(axis=1)
        is_first = nearest_m[triangle] < (away - front_m)[point]
        point = point[is_first]
        triangle = triangle[is_first]
        a, b, c = places.transpose(1, 0, 2)
        # Shares of the corners, and one over the depth, are linear on a triangle in the projection.
        double_areas = _cross_2d(b - a, c - a)
        slopes_of_b = _turned(c - a) / double_areas[:, None]
        slopes_of_c = -_turned(b - a) / double_areas[:, None]
        way = projected[point] - a[triangle]
        of_b = np.einsum("pi,pi->p", way, slopes_of_b[triangle])
        of_c = np.einsum("pi,pi->p", way, slopes_of_c[triangle])
        of_a = 1 - of_b - of_c
        is_on = (of_a >= 0) & (of_b >= 0) & (of_c >= 0)
        point = point[is_on]
        shares = np.column_stack([of_a[is_on], of_b[is_on], of_c[is_on]])
        inverse = np.sum(shares / depths[corners[triangle[is_on]]], axis=1)
        behind[point[1 / inverse < away[point] - front_m]] = True
        return behind

    def is_near_crease(
        self, x: Array, eye_m: Array | None, points_m: Array, reach_m: float
    ) -> NDArray[np.bool_]:
        """Return the mask (P,) of points whose ray passes a visible crease at a small distance.

        A crease is an edge between two flat triangles that face the camera, with normals whose
        cosine is below `CREASE_COSINE`. Noise of the depth moves a point along its ray, and so does
        not change the result.

        Parameters
        ----------
        x : (n, 3) array
            Node positions [m].
        eye_m : (3,) array or None
            Position of the camera [m]; for None, which has no rays, no point is near.
        points_m : (P, 3) array
            Points [m].
        reach_m : float
            Largest distance, perpendicular to the ray at the depth of the crease [m].
        """
        near = np.zeros(len(points_m), dtype=bool)
        if eye_m is None or not len(points_m):
            return near
        ends, triangles = self.edges
        a, b, c = x[self.plane_triangles].transpose(1, 0, 2)
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
        cosines = np.sum(normals[triangles[:, 0]] * normals[triangles[:, 1]], 1)
        is_crease = (cosines < CREASE_COSINE) & self.is_facing(x, eye_m)[triangles].all(axis=1)
        start, end = x[ends[is_crease]].transpose(1, 0, 2)
        lengths_m = np.linalg.norm(end - start, axis=1)
        counts = 1 + np.ceil(lengths_m / (CREASE_STEP * reach_m)).astype(int)
        crease = np.repeat(np.arange(len(counts)), counts)
        number = np.arange(len(crease)) - np.repeat(np.cumsum(counts) - counts, counts)
        share = (number / (counts[crease] - 1))[:, None]
        on_crease = (1 - share) * start[crease] + share * end[crease] - eye_m
        if not len(on_crease):
            return near
        away_m = np.linalg.norm(on_crease, axis=1)
        rays = points_m - eye_m
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        # Beyond this bound, which is larger than any reach, the query finds nothing, in less time.
        bound = 1.001 * reach_m / away_m.min()
        apart, nearest = KDTree(on_crease / away_m[:, None]).query(rays, distance_upper_bound=bound)
        is_within = np.isfinite(apart)
        away_m = np.take(away_m, nearest, mode="clip")
        near[is_within] = (apart * away_m)[is_within] <= reach_m
        return near

    def nearest_points(self, x: Array, points: Array, candidates: Index) -> tuple[Index, Array]:
        """Return the nearest points of some flat triangles, and of the curved faces they belong to.

        Triangles are searched among the `NEARBY` nearest by their middles; on curved faces the
        point is corrected by a few Newton steps, without leaving the face.

        Parameters
        ----------
        x : (n, 3) array
            Node positions [m].
        points : (P, 3) array
            Points [m].
        candidates : (c,) array
            Indices of the flat triangles, at least one.

        Returns
        -------
        ((P,) array, (P, 3) array)
            Faces, and barycentric coordinates on them.
        """
        corners = x[self.plane_triangles[candidates]]
        middles = corners.mean(axis=1)
        _, neighbours = KDTree(middles).query(points, min(NEARBY, len(corners)))
        triangles, in_triangles = _nearest_of_triangles(
            points, corners, neighbours=np.reshape(neighbours, (len(points), -1))
        )
        faces, places = self.to_faces(candidates[triangles], in_triangles)
        moving = np.arange(len(points) if self.faces.shape[1] > 3 else 0)
        for _ in range(SETTLING):
            # Faces are curved: the nearest point of a face is beside that of the flat triangle.
            _, feet, tangents = self._evaluate_tangents(x, faces[moving], places[moving])
            by_a, by_b = tangents.transpose(1, 0, 2)
            aa, ab, bb = (
                np.sum(u * v, axis=1) for u, v in ((by_a, by_a), (by_a, by_b), (by_b, by_b))
            )
            to_a, to_b = (np.sum(u * (points[moving] - feet), axis=1) for u in (by_a, by_b))
            step = np.column_stack([bb * to_a - ab * to_b, aa * to_b - ab * to_a])
            step /= (aa * bb - ab**2)[:, None]
            settled = np.clip(places[moving] + np.column_stack([step, -step.sum(axis=1)]), 0.0, 1.0)
            settled /= settled.sum(axis=1, keepdims=True)
            has_moved = np.abs(settled - places[moving]).max(axis=1) > STILL
            places[moving] = settled
            moving = moving[has_moved]
        return faces, places


def _turned(vectors: Array) -> Array:
    """Return plane vectors (P, 2) turned by −90 degrees, so that w · turned(v) = w × v."""
    return np.column_stack([vectors[:, 1], -vectors[:, 0]])


def _nearest_of_triangles(
    points: Array, triangles: Array, neighbours: Index
) -> tuple[Index, Array]:
    """Return the nearest of some flat triangles to each point, and the nearest point on it."""
    # Distances from the plane and the lines of the sides are lower bounds: only for triangles that
    # these do not exclude is the distance from the sides themselves computed.
    first = triangles[:, 0]
    sides = np.roll(triangles, -1, axis=1) - triangles
    normals = np.cross(sides[:, 0], -sides[:, 2])
    double_areas = np.linalg.norm(normals, axis=1)
    has_area = double_areas > 0
    normals /= np.where(has_area, double_areas, 1.0)[:, None]
    outwards = np.cross(sides, normals[:, None])
    lengths = np.linalg.norm(outwards, axis=2)
    outwards /= np.where(lengths > 0, lengths, 1.0)[:, :, None]
    # Distances from the plane and, outwards, from the lines of the sides, as functions of the
    # point.
    functions = [normals, *outwards.transpose(1, 0, 2)]
    through = [first, *triangles.transpose(1, 0, 2)]
    height, *beyond = (
        _affine_values(slopes, through=origin, points=points, rows=neighbours)
        for slopes, origin in zip(functions, through, strict=True)
    )
    side_distance = np.maximum(np.maximum(beyond[0], beyond[1]), beyond[2])
    bounds = np.hypot(height, np.maximum(side_distance, 0.0))
    is_above = (side_distance <= 0) & has_area[neighbours]
    exact = np.where(is_above, bounds, np.inf)
    bounds[is_above] = np.inf
    # First the one with the smallest bound, then all whose bounds are not larger than the least
    # distance.
    is_lowest = np.arange(neighbours.shape[1]) == bounds.argmin(axis=1)[:, None]
    for is_next in (is_lowest, ~is_lowest):
        least = exact.min(axis=1, keepdims=True)
        point, rank = np.nonzero(is_next & (bounds <= (1 + TIE) * least))
        on = nearest_points_of_triangles(points[point], triangles[neighbours[point, rank]])
        exact[point, rank] = np.linalg.norm(on - points[point], axis=1)
    # Of equally near triangles the one with the nearest middle counts, not a rounding error.
    rows = np.arange(len(points))
    is_nearest = exact <= (1 + TIE) * exact.min(axis=1, keepdims=True)
    rank = is_nearest.argmax(axis=1)
    nearest = neighbours[rows, rank]
    feet = points - height[rows, rank, None] * normals[nearest]
    (not_above,) = np.nonzero(~is_above[rows, rank])
    feet[not_above] = nearest_points_of_triangles(points[not_above], triangles[nearest[not_above]])
    return nearest, barycentric_in_triangles(feet, triangles[nearest])


def _affine_values(slopes: Array, through: Array, points: Array, rows: Index) -> Array:
    """Return s · (p − o) (P, k) at p (P, 3), with s and o (T, 3) of the functions `rows` (P, k)."""
    values = np.take(-np.einsum("ti,ti->t", slopes, through), rows)
    for slope, coordinate in zip(slopes.T, points.T, strict=True):
        values += np.take(slope, rows) * coordinate[:, None]
    return values


def _cross_2d(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
