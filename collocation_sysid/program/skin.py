"""A body's surface as depth cameras see it: what faces them, is hidden, or nearest to points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..arrays import Array, Index
from ..fem.body import Body
from ..fem.touching import on_faces
from ..recording.depth import Depth
from ..recording.experiment import Experiment
from ..recording.placement import nearest_on

# Triangles, by their middles, of which the nearest point is taken.
NEARBY = 10
# Steps to it on a curved face, and shorter ones that end them.
SETTLING, STILL = 3, 1e-6
# Below this cosine between normal and view a point is seen at a grazing angle; measured normals
# may be off by as much.
GRAZING = 0.3

# Flat triangles that stand for a face of three nodes, or of six with those on ab, bc, ca.
CORNERS = np.vstack([np.eye(3), [[0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5]]])
FLAT = {3: np.array([[0, 1, 2]]), 6: np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])}


@dataclass(frozen=True, eq=False)
class Skin:
    """The faces of a body, each of them some flat triangles.

    Attributes
    ----------
    nodes : (n,) of the body
    faces : (F, 3) or (F, 6) which of these each has
    chosen : (F,) those that may be seen
    """

    nodes: Index
    faces: Index
    chosen: NDArray[np.bool_]

    @classmethod
    def of(cls, body: Body, depth: Depth) -> Skin:
        """That of a body, and what of it a camera may see."""
        triangles = body.mesh.surface
        chosen = np.ones(len(triangles), dtype=bool)
        if depth.faces is not None:
            chosen[:] = False
            chosen[depth.faces.resolve_faces(body.mesh)] = True
        nodes, faces = np.unique(body.nodes.on_faces(triangles), return_inverse=True)
        return cls(nodes, faces.reshape(len(triangles), -1), chosen)

    def first_m(self, experiment: Experiment, depth: Depth) -> Array:
        """(n, 3) as grasps carry it, undeformed, when a camera first sees anything."""
        return experiment.rigid_positions(depth.times[[depth.first]])[0, self.nodes]

    @property
    def flat(self) -> Index:
        """(F·k, 3) flat triangles, those of a face after each other."""
        return self.faces[:, FLAT[self.faces.shape[1]]].reshape(-1, 3)

    @cached_property
    def edges(self) -> tuple[Index, Index]:
        """Edges (K, 2) between two flat triangles, by their nodes, and (K, 2) these triangles."""
        flat = self.flat
        ends = np.sort(flat[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        unique, number, counts = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
        order = np.argsort(number.ravel(), kind="stable")
        first = np.cumsum(counts) - counts
        paired = counts == 2
        beside = np.stack([order[first[paired]], order[first[paired] + 1]], axis=1) // 3
        return unique[paired], beside

    def at(self, triangles: Index, shares: Array) -> tuple[Index, Array]:
        """Faces (P,), and places (P, 3) on them, of places on flat triangles (P,)."""
        parts = FLAT[self.faces.shape[1]]
        corners = CORNERS[parts[triangles % len(parts)]]
        return triangles // len(parts), np.einsum("pc,pci->pi", shares, corners)

    def points(self, x: Array, faces: Index, places: Array) -> tuple[Array, Array, Array]:
        """Weights (P, v) of the nodes, points (P, 3) and outward normals of a shape x (n, 3)."""
        weights, points, along = self._along(x, faces, places)
        normals = np.cross(along[:, 0], along[:, 1])
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
        return weights, points, normals

    def _along(self, x: Array, faces: Index, places: Array) -> tuple[Array, Array, Array]:
        """Weights, points, and slopes (P, 2, 3) of these along the faces."""
        weights, slopes = on_faces(places, self.faces.shape[1])
        corners = x[self.faces[faces]]
        along = np.einsum("pak,pai->pki", slopes[:, :, :2] - slopes[:, :, 2:], corners)
        return weights, np.einsum("pa,pai->pi", weights, corners), along

    def triangles(self, x: Array, parts: int = 4) -> Array:
        """(F·parts², 3, 3) of a shape x (n, 3), faces divided along each side into so many."""
        i, j = np.indices((parts, parts)).reshape(2, -1)
        up, down = i + j < parts, i + j < parts - 1
        upward = np.stack([[i, j], [i + 1, j], [i, j + 1]])[..., up]
        downward = np.stack([[i + 1, j], [i + 1, j + 1], [i, j + 1]])[..., down]
        of_b, of_c = np.concatenate([upward, downward], axis=2).transpose(1, 2, 0) / parts
        places = np.stack([1 - of_b - of_c, of_b, of_c], axis=-1).reshape(-1, 3)
        faces = np.repeat(np.arange(len(self.faces)), len(places))
        points = self.points(x, faces, np.tile(places, (len(self.faces), 1)))[1]
        return points.reshape(-1, 3, 3)

    def facing(self, x: Array, eye_m: Array | None, least: float = 0.0) -> NDArray[np.bool_]:
        """(F·k,) flat triangles whose cosine to the way to a camera is larger; all of a cloud."""
        if eye_m is None:
            return np.ones(len(self.flat), dtype=bool)
        a, b, c = x[self.flat].transpose(1, 0, 2)
        normal, way = np.cross(b - a, c - a), eye_m - (a + b + c) / 3
        sizes = np.linalg.norm(normal, axis=1) * np.linalg.norm(way, axis=1)
        return np.sum(normal * way, axis=1) > least * sizes

    def hidden(
        self, x: Array, eye_m: Array | None, points_m: Array, front_m: float
    ) -> NDArray[np.bool_]:
        """(P,) whether another part is in front of points (P, 3), seen by a camera, by so much."""
        behind = np.zeros(len(points_m), dtype=bool)
        if eye_m is None or not len(points_m):
            return behind
        # Seen from there in the plane at distance one.
        ahead, *across = np.linalg.svd((x.mean(axis=0) - eye_m)[None])[2]
        ahead *= np.sign(ahead @ (x.mean(axis=0) - eye_m))
        depths, away = (x - eye_m) @ ahead, (points_m - eye_m) @ ahead
        corners = self.flat[self.facing(x, eye_m, 0.0)]
        corners = corners[(depths[corners] > 0).all(axis=1)]
        places = ((x - eye_m) @ np.transpose(across) / depths[:, None])[corners]
        seen = (points_m - eye_m) @ np.transpose(across) / away[:, None]
        middles = places.mean(axis=1)
        reach = np.linalg.norm(places - middles[:, None], axis=2).max(initial=0.0)
        near = KDTree(middles).query_ball_point(seen, reach)
        point = np.repeat(np.arange(len(seen)), [len(each) for each in near])
        triangle = np.concatenate([*near, []]).astype(int)
        first = depths[corners[triangle]].min(axis=1) < away[point] - front_m
        point, triangle = point[first], triangle[first]
        a, b, c = places[triangle].transpose(1, 0, 2)
        way, whole = seen[point] - a, _cross(b - a, c - a)
        of_b, of_c = _cross(way, c - a) / whole, _cross(b - a, way) / whole
        shares = np.column_stack([1 - of_b - of_c, of_b, of_c])
        # What is linear on a triangle is one over the depth in the plane.
        hit = 1 / np.sum(shares / depths[corners[triangle]], axis=1) < away[point] - front_m
        behind[point[(shares >= 0).all(axis=1) & hit]] = True
        return behind

    def nearest(self, x: Array, points: Array, among: Index) -> tuple[Index, Array]:
        """Faces (P,), and places (P, 3) on them, nearest to points (P, 3), of some triangles."""
        corners = x[self.flat[among]]
        middles = corners.mean(axis=1)
        sizes = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
        found = KDTree(middles).query(points, min(NEARBY, len(corners)))
        away, near = (np.reshape(each, (len(points), -1)) for each in found)
        # Triangles whose middles are farther than this by their own size cannot be nearer.
        triangles, least = near[:, 0].copy(), np.full(len(points), np.inf)
        feet = np.zeros_like(points)
        for rank, own in enumerate(near.T):
            here = np.flatnonzero(away[:, rank] - sizes[own] < least)
            on = nearest_on(points[here], corners[own[here]])
            apart = np.linalg.norm(on - points[here], axis=1)
            nearer = apart < least[here]
            here, on, apart = here[nearer], on[nearer], apart[nearer]
            triangles[here], feet[here], least[here] = own[here], on, apart
        a, b, c = corners[triangles].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        squares = np.sum(normal**2, axis=1)
        of_b = np.sum(np.cross(feet - a, c - a) * normal, axis=1) / squares
        of_c = np.sum(np.cross(b - a, feet - a) * normal, axis=1) / squares
        faces, places = self.at(among[triangles], np.column_stack([1 - of_b - of_c, of_b, of_c]))
        moving = np.arange(len(points) if self.faces.shape[1] > 3 else 0)
        for _ in range(SETTLING):
            # Faces are curved: what is nearest on the flat triangle is beside what is on them.
            _, feet, along = self._along(x, faces[moving], places[moving])
            by_a, by_b = along.transpose(1, 0, 2)
            aa, ab, bb = (
                np.sum(u * v, axis=1) for u, v in ((by_a, by_a), (by_a, by_b), (by_b, by_b))
            )
            to_a, to_b = (np.sum(u * (points[moving] - feet), axis=1) for u in (by_a, by_b))
            step = np.column_stack([bb * to_a - ab * to_b, aa * to_b - ab * to_a])
            step /= (aa * bb - ab**2)[:, None]
            settled = np.clip(places[moving] + np.column_stack([step, -step.sum(axis=1)]), 0.0, 1.0)
            settled /= settled.sum(axis=1, keepdims=True)
            far = np.abs(settled - places[moving]).max(axis=1) > STILL
            places[moving] = settled
            moving = moving[far]
        return faces, places


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
