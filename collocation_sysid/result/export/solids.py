"""What a body may touch as simulators have it: simple shapes, or facets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from ...arrays import Array, Index
from ...errors import listed
from ...model.contact import contacts
from ...recording import Capsule, Cuboid, Cylinder, Obstacle, Plane, Solid, Sphere
from ...recording.solids import name_of
from .identified import Identified

# Facets of what is round are so wide [rad].
FACET_RAD = np.pi / 36, np.pi / 12
# Sheets for planes are so many times as long as the body.
SHEET = 4.0


@dataclass(frozen=True, eq=False)
class Primitive:
    """A plane, sphere, box, cylinder or capsule in the frame of its obstacle.

    Attributes
    ----------
    kind : str
    size_m : (k,) radius, and half the length between the ends; of a box half of each side
    place_m : (3,) its middle, of a plane a point
    turn : Rotation
        By which its z axis is the axis, or the normal of a plane.
    """

    kind: str
    size_m: Array
    place_m: Array
    turn: Rotation

    @classmethod
    def of(cls, solid: Solid) -> Primitive:
        """That of a solid; roundings of edges are left out."""
        kind, turn = name_of(solid).removesuffix("_m"), Rotation.identity()
        if isinstance(solid, Plane):
            return cls(kind, np.zeros(0), solid.point_m, _upright(solid.normal))
        if isinstance(solid, Sphere):
            return cls(kind, np.array([solid.radius_m]), solid.centre_m, turn)
        if isinstance(solid, Cuboid):
            return cls(kind, np.diff(solid.corners_m, axis=0)[0] / 2, solid.middle_m, turn)
        assert isinstance(solid, (Cylinder, Capsule))
        way = np.diff(solid.ends_m, axis=0)[0]
        size = np.array([solid.radius_m, np.linalg.norm(way) / 2])
        return cls(kind, size, solid.ends_m.mean(axis=0), _upright(way))

    def placed(self, obstacle: Obstacle, t_s: float) -> tuple[Array, Rotation]:
        """Where it is in the world, and turned how."""
        (rotation,), (place,) = obstacle.poses.at([t_s])
        return place + rotation @ self.place_m, Rotation.from_matrix(rotation) * self.turn


def _upright(axis: Array) -> Rotation:
    return Rotation.align_vectors(axis[None], np.array([[0.0, 0.0, 1.0]]))[0]


def grown(solid: Solid, by_m: float) -> Solid:
    """With its surface so much further out; inwards at most by half of what it is wide."""
    if isinstance(solid, Plane):
        return replace(solid, point_m=solid.point_m + by_m * solid.normal)
    by_m = max(by_m, -float(Primitive.of(solid).size_m.min()) / 2)
    outwards = by_m * np.array([[-1.0], [1.0]])
    if isinstance(solid, Cuboid):
        return replace(solid, corners_m=solid.corners_m + outwards)
    assert isinstance(solid, (Sphere, Cylinder, Capsule))
    wider = replace(solid, radius_m=solid.radius_m + by_m)
    if not isinstance(wider, Cylinder):
        return wider
    way = np.diff(wider.ends_m, axis=0)
    return replace(wider, ends_m=wider.ends_m + outwards * way / np.linalg.norm(way))


@dataclass(frozen=True, eq=False)
class Facets:
    """The surface of a solid in flat facets, and a point behind all of them.

    Attributes
    ----------
    points_m : (p, 3) of which the last is behind
    triangles : (f, 3) anticlockwise as seen from outside
    """

    points_m: Array
    triangles: Index

    @classmethod
    def of(cls, solid: Solid, about_m: Array, size_m: float, depth_m: float) -> Facets:
        """All of them; of a plane a square about a point and so long.

        Where it is round, the middles of facets are so deep beneath it as their corners are out of
        it; at the width of facets that this may have.
        """
        if isinstance(solid, Plane):
            corners = solid.outline(about_m, size_m)[0][:4]
            behind = corners.mean(axis=0) - size_m / 4 * solid.normal
            return cls(np.vstack([corners, behind]), np.array([(0, 1, 2), (0, 2, 3)]))._outwards()
        places = _extremes(Primitive.of(solid), getattr(solid, "rounding_m", 0.0), depth_m)
        hull = ConvexHull(places)
        used, triangles = np.unique(hull.simplices, return_inverse=True)
        points = places[used]
        behind = points.mean(axis=0)
        return cls(np.vstack([points, behind]), triangles.reshape(-1, 3))._outwards()

    def depth_m(self, places_m: Array) -> float:
        """How far the deepest of places (n, 3) is inside; 0 where none is."""
        return max(0.0, -float(self._above(places_m).max(axis=0).min()))

    def towards(self, places_m: Array) -> Facets:
        """Those with any of these places (n, 3) before them."""
        seen = (self._above(places_m) > 0).any(axis=1)
        used, triangles = np.unique(self.triangles[seen], return_inverse=True)
        return Facets(self.points_m[[*used, -1]], triangles.reshape(-1, 3))

    def _above(self, places_m: Array) -> Array:
        """(f, n) how far places are before the plane of each."""
        corners = self.points_m[self.triangles]
        normals = _normals(corners)
        return normals @ places_m.T - np.einsum("fk,fk->f", corners[:, 0], normals)[:, None]

    def _outwards(self) -> Facets:
        corners = self.points_m[self.triangles]
        inwards = np.einsum("fk,fk->f", self.points_m[-1] - corners[:, 0], _normals(corners)) > 0
        order = np.where(inwards[:, None], [2, 1, 0], [0, 1, 2])
        return replace(self, triangles=np.take_along_axis(self.triangles, order, axis=1))


def _normals(corners: Array) -> Array:
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.linalg.norm(normals, axis=1)[:, None]


def _extremes(shape: Primitive, rounding_m: float, depth_m: float) -> Array:
    """(p, 3) points of a solid that are the farthest along some direction."""
    radius_m = rounding_m if shape.kind == "box" else shape.size_m[0]
    wide = float(np.clip(4 * np.sqrt(depth_m / max(radius_m, depth_m)), *FACET_RAD))
    count = int(np.ceil(np.pi / wide))
    middles = (np.arange(2 * count) + 0.5) * np.pi / count
    turned, steep = np.meshgrid(middles, middles[:count])
    turned, steep = turned.ravel(), steep.ravel()
    level = np.stack([np.cos(turned), np.sin(turned), np.zeros_like(turned)], axis=1)
    along = np.cos(steep)[:, None] * [0.0, 0.0, 1.0]
    way, longer = np.sin(steep)[:, None] * level + along, 1 + wide**2 / 16
    if shape.kind == "box":
        core = np.sign(way) * (shape.size_m - rounding_m)
    elif shape.kind == "cylinder":
        core = longer * (radius_m - rounding_m) * level
        core = core + np.sign(along) * (shape.size_m[1] - rounding_m)
    else:
        rounding_m = radius_m
        core = np.sign(along) * (shape.size_m[1] if shape.kind == "capsule" else 0.0)
    places = core + longer * rounding_m * way
    return np.unique(shape.place_m + shape.turn.apply(places).round(12), axis=0)


@dataclass(frozen=True, eq=False)
class Wall:
    """An obstacle as facets, at which the pressure is proportional to the depth.

    That is as ours is inside: the surface is half of δ further out, and twice as stiff.

    Attributes
    ----------
    obstacle : Obstacle
        Whose friction is a number.
    facets : Facets
        In its frame.
    back_m : (3,) from where it is at the first sample to where it does not touch
    start_m : (p, 3) its facets' points there, in the world
    nodes, cells : int
        How many are numbered before its own: the body's, and those of walls before it.
    stiffness_pa_m, node_n_m : float
        Of the surface, and as much for each of its nodes.
    width_m : float
        δ.
    faces : (k,) rows of the mesh's surface that may touch it
    """

    obstacle: Obstacle
    facets: Facets
    back_m: Array
    start_m: Array
    nodes: int
    cells: int
    stiffness_pa_m: float
    node_n_m: float
    width_m: float
    faces: Index

    def points_m(self, t_s: float) -> Array:
        """(p, 3) of its facets in the world."""
        (rotation,), (place,) = self.obstacle.poses.at([t_s])
        return self.facets.points_m @ rotation.T + place

    @property
    def triangles(self) -> Index:
        """(f, 3) numbers of nodes of its facets."""
        return self.facets.triangles + self.nodes

    @property
    def tetrahedra(self) -> Index:
        """(f, 4) numbers of nodes of a tetrahedron under each facet."""
        inner = np.full((len(self.triangles), 1), self.nodes + len(self.start_m) - 1)
        return np.hstack([self.triangles[:, [0, 2, 1]], inner])


def walls(body: Identified) -> tuple[Wall, ...]:
    """What a body may touch; facets that always turn away from it are left out."""
    if body.touching is None:
        return ()
    times, shape = body.touching.t_s, body.touching.rigid_positions([body.start_s])
    made: list[Wall] = []
    nodes, cells = len(body.nodes_m), len(body.body.cells)
    for obstacle, contact in zip(body.obstacles, contacts(body.touching), strict=True):
        law, (depth_m, normal) = contact.contact, contact.deepest(shape.ravel())
        rotations, places = obstacle.poses.at(times)
        carried = body.experiment.rigid_positions(times)
        ends = np.stack([carried.min(axis=1), carried.max(axis=1)], axis=2) - places[..., None]
        corners = np.array([list(product(*each)) for each in ends])
        seen = np.einsum("tki,tij->tkj", corners, rotations).reshape(-1, 3)
        size_m = SHEET * float(np.ptp(seen, axis=0).max())
        area_m2 = law.surface.area_m2
        stiffness = 2 * float(np.average(law.stiffness_at(body.theta), weights=area_m2))
        width_m = float(np.average(law.widths_m, weights=area_m2))
        solid = grown(obstacle.shape, width_m / 2)
        facets = Facets.of(solid, seen.mean(axis=0), size_m, width_m / 2)
        faces = law.surface.faces
        touching = np.unique(body.body.nodes.on_faces(body.body.mesh.surface[faces]))
        # Nodes may be deeper than the points at which ours are pushed.
        back_m = -max(depth_m, 0.0) * normal
        nearest = (carried[0, touching] - places[0] - back_m) @ rotations[0]
        back_m -= facets.depth_m(nearest) * normal
        of_node = stiffness * float(area_m2.sum()) / len(touching)
        shown = facets.towards(
            np.concatenate([seen, seen[: len(corners[0])] - back_m @ rotations[0]])
        )
        start_m = shown.points_m @ rotations[0].T + places[0] + back_m
        law_of = stiffness, of_node, width_m, faces
        made.append(Wall(obstacle, shown, back_m, start_m, nodes, cells, *law_of))
        nodes, cells = nodes + len(start_m), cells + len(shown.triangles)
    return tuple(made)


@dataclass(frozen=True)
class OneContact:
    """What Newton has once for all that a soft body touches.

    Attributes
    ----------
    friction, node_n_m : float
    radius_m : float
        Of particles: half of δ.
    lost : tuple of str
        What is said where they touch differently.
    """

    friction: float
    node_n_m: float
    radius_m: float
    lost: tuple[str, ...]

    @classmethod
    def of(cls, touched: Sequence[Wall]) -> OneContact:
        """The friction of the first, and the largest stiffness and width."""
        told = {
            "friction": [float(wall.obstacle.friction) for wall in touched],
            "stiffness": [wall.node_n_m for wall in touched],
            "width": [wall.width_m for wall in touched],
        }
        friction, stiffness, width = (values or [0.0] for values in told.values())
        unlike = [
            name for name, values in told.items() if not np.allclose(values, values[:1], atol=0)
        ]
        lost = (
            f"obstacles differ in {listed(unlike)}, of which a soft body in Newton has one: here "
            f"the first's friction {friction[0]:.4g}, with which that of each other is averaged, "
            f"and of all the largest stiffness {max(stiffness):.4g} N/m of a node and width "
            f"{max(width):.4g} m"
        )
        return cls(friction[0], max(stiffness), max(width) / 2, (lost,) * bool(unlike))
