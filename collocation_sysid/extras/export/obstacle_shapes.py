"""Obstacles as simulators represent them: simple shapes (`Primitive`), or facets (`Facets`,
`FacetedObstacle`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from ...common.array_types import Array, Index
from ...model.contact.force import contact_terms
from ...recording import Capsule, Cuboid, Cylinder, Obstacle, Plane, Solid, Sphere
from ...recording.obstacle_solids import solid_key
from .identified import IdentifiedBody

# Smallest and largest width of the facets of round surfaces [rad].
FACET_WIDTH_LIMITS_RAD = np.pi / 36, np.pi / 12
# Side of the square that represents a plane, over the extent of the body.
PLANE_SIZE_RATIO = 4.0


@dataclass(frozen=True, eq=False)
class Primitive:
    """Plane, sphere, box, cylinder or capsule in the frame of its obstacle."""

    kind: str  # "plane", "sphere", "box", "cylinder" or "capsule"
    # (k,): radius, then half the length between the ends; half of each side for a box; empty for a
    # plane.
    size_m: Array
    centre_m: Array  # (3,): centre; for a plane a point on it
    # Rotation of the z axis to the axis of the shape, or to the normal of a plane.
    rotation: Rotation

    @classmethod
    def from_solid(cls, solid: Solid) -> Primitive:
        """Return the primitive of a solid in the frame of its obstacle; rounded edges are left out."""
        kind = solid_key(solid).removesuffix("_m")
        turn = Rotation.identity()
        if isinstance(solid, Plane):
            return cls(
                kind, np.zeros(0), centre_m=solid.point_m, rotation=_rotation_of_z_to(solid.normal)
            )
        if isinstance(solid, Sphere):
            return cls(kind, np.array([solid.radius_m]), centre_m=solid.centre_m, rotation=turn)
        if isinstance(solid, Cuboid):
            return cls(
                kind,
                np.diff(solid.corners_m, axis=0)[0] / 2,
                centre_m=solid.tilt_centre_m,
                rotation=turn,
            )
        assert isinstance(solid, (Cylinder, Capsule))
        way = np.diff(solid.ends_m, axis=0)[0]
        size = np.array([solid.radius_m, np.linalg.norm(way) / 2])
        return cls(kind, size, centre_m=solid.ends_m.mean(axis=0), rotation=_rotation_of_z_to(way))

    def pose_at(self, obstacle: Obstacle, t_s: float) -> tuple[Array, Rotation]:
        """Return position (3,) [m] and rotation of the shape in the world at a time.

        Parameters
        ----------
        obstacle : Obstacle
            Obstacle that has the shape, with its poses.
        t_s : float
            Time [s].

        Raises
        ------
        InputError
            If several poses end more than half a sample before the time, or begin that much after
            it.
        """
        (rotation,), (place,) = obstacle.poses.at([t_s])
        return place + rotation @ self.centre_m, Rotation.from_matrix(rotation) * self.rotation


def _rotation_of_z_to(axis: Array) -> Rotation:
    """Return a rotation of the z axis to a vector of any length."""
    return Rotation.align_vectors(axis[None], np.array([[0.0, 0.0, 1.0]]))[0]


def offset_solid(solid: Solid, distance_m: float) -> Solid:
    """Return a copy of a solid whose surface is further out by `distance_m`, of a box or cylinder
    on all sides; negative inwards.

    Inwards the surface moves at most by half of the solid's smallest half width (a plane by any
    distance). The radius of rounded edges stays.
    """
    if isinstance(solid, Plane):
        return replace(solid, point_m=solid.point_m + distance_m * solid.normal)
    distance_m = max(distance_m, -float(Primitive.from_solid(solid).size_m.min()) / 2)
    outwards = distance_m * np.array([[-1.0], [1.0]])
    if isinstance(solid, Cuboid):
        return replace(solid, corners_m=solid.corners_m + outwards)
    assert isinstance(solid, (Sphere, Cylinder, Capsule))
    wider = replace(solid, radius_m=solid.radius_m + distance_m)
    if not isinstance(wider, Cylinder):
        return wider
    way = np.diff(wider.ends_m, axis=0)
    return replace(wider, ends_m=wider.ends_m + outwards * way / np.linalg.norm(way))


@dataclass(frozen=True, eq=False)
class Facets:
    """Surface of a solid as flat facets, with a point behind all of them."""

    points_m: Array  # (p, 3): corners, and as the last point the one behind all facets
    triangles: Index  # (f, 3): point indices, counter-clockwise as seen from outside

    @classmethod
    def from_solid(cls, solid: Solid, centre_m: Array, size_m: float, tolerance_m: float) -> Facets:
        """Return the facets of a solid; of a plane a square.

        On round surfaces the middles of facets are as deep below the surface as their corners are
        above it: by `tolerance_m`, unless the facets would then be narrower or wider than
        `FACET_WIDTH_LIMITS_RAD`.

        Parameters
        ----------
        solid : Solid
            Solid in the frame of its obstacle.
        centre_m : (3,)
            Centre of the square for a plane.
        size_m : float
            Side of the square for a plane.
        tolerance_m : float
            Allowed distance between facets and surface.
        """
        if isinstance(solid, Plane):
            corners = solid.outline_polylines(centre_m, size_m)[0][:4]
            behind = corners.mean(axis=0) - size_m / 4 * solid.normal
            return cls(
                np.vstack([corners, behind]), np.array([(0, 1, 2), (0, 2, 3)])
            )._oriented_outwards()
        places = _hull_points(
            Primitive.from_solid(solid), getattr(solid, "rounding_m", 0.0), tolerance_m=tolerance_m
        )
        hull = ConvexHull(places)
        used, triangles = np.unique(hull.simplices, return_inverse=True)
        points = places[used]
        behind = points.mean(axis=0)
        return cls(np.vstack([points, behind]), triangles.reshape(-1, 3))._oriented_outwards()

    def max_penetration_m(self, points_m: Array) -> float:
        """Return the penetration [m] of the deepest of points (n, 3), the distance to the nearest
        facet's plane; 0 if all are outside. The facets must enclose a convex solid.
        """
        return max(0.0, -float(self._signed_distances_m(points_m).max(axis=0).min()))

    def facing(self, points_m: Array) -> Facets:
        """Return the facets that have at least one of the points (n, 3) in front of them, with only
        their points and the one behind; itself is not changed.
        """
        is_facing = (self._signed_distances_m(points_m) > 0).any(axis=1)
        used, triangles = np.unique(self.triangles[is_facing], return_inverse=True)
        return Facets(self.points_m[[*used, -1]], triangles.reshape(-1, 3))

    def _signed_distances_m(self, points_m: Array) -> Array:
        """Return the distance (f, n) [m] of points (n, 3) in front of the plane of each facet."""
        corners = self.points_m[self.triangles]
        normals = _unit_normals(corners)
        return normals @ points_m.T - np.einsum("fk,fk->f", corners[:, 0], normals)[:, None]

    def _oriented_outwards(self) -> Facets:
        """The last point is behind all facets."""
        corners = self.points_m[self.triangles]
        inwards = (
            np.einsum("fk,fk->f", self.points_m[-1] - corners[:, 0], _unit_normals(corners)) > 0
        )
        order = np.where(inwards[:, None], [2, 1, 0], [0, 1, 2])
        return replace(self, triangles=np.take_along_axis(self.triangles, order, axis=1))


def _unit_normals(corners: Array) -> Array:
    """Return unit normals (f, 3) of triangles (f, 3, 3); NaN without area."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.linalg.norm(normals, axis=1)[:, None]


def _hull_points(shape: Primitive, rounding_m: float, tolerance_m: float) -> Array:
    """The hull of the points (p, 3) is the solid, with facets in place of round surfaces."""
    radius_m = rounding_m if shape.kind == "box" else shape.size_m[0]
    wide = float(
        np.clip(4 * np.sqrt(tolerance_m / max(radius_m, tolerance_m)), *FACET_WIDTH_LIMITS_RAD)
    )
    count = int(np.ceil(np.pi / wide))
    middles = (np.arange(2 * count) + 0.5) * np.pi / count
    azimuth, inclination = np.meshgrid(middles, middles[:count])
    azimuth = azimuth.ravel()
    inclination = inclination.ravel()
    level = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], axis=1)
    axial = np.cos(inclination)[:, None] * [0.0, 0.0, 1.0]
    direction = np.sin(inclination)[:, None] * level + axial
    stretch = 1 + wide**2 / 16
    if shape.kind == "box":
        core = np.sign(direction) * (shape.size_m - rounding_m)
    elif shape.kind == "cylinder":
        core = stretch * (radius_m - rounding_m) * level
        core = core + np.sign(axial) * (shape.size_m[1] - rounding_m)
    else:
        rounding_m = radius_m
        core = np.sign(axial) * (shape.size_m[1] if shape.kind == "capsule" else 0.0)
    places = core + stretch * rounding_m * direction
    return np.unique(shape.centre_m + shape.rotation.apply(places).round(12), axis=0)


@dataclass(frozen=True, eq=False)
class FacetedObstacle:
    """Obstacle as facets whose contact pressure is proportional to the penetration.

    To match the pressure law of this package inside the obstacle, the surface is half of its width
    δ further out, and twice as stiff.
    """

    obstacle: Obstacle  # obstacle whose friction coefficient is a number
    facets: Facets  # facets in the obstacle's frame
    start_points_m: Array  # (p, 3): points of the facets at the place without contact, in the world
    # Numbers of nodes and cells of the body and of earlier walls, which precede those of this wall.
    first_node: int
    first_cell: int
    # Contact stiffness per area, and for each node.
    stiffness_pa_m: float
    node_stiffness_n_m: float
    width_m: float  # width δ of the pressure law
    faces: Index  # (k,): indices of the boundary triangles that may touch the obstacle

    def points_at_m(self, t_s: float) -> Array:
        """Return the points of the facets (p, 3) [m] in the world at a time [s], moved with the
        obstacle.
        """
        (rotation,), (place,) = self.obstacle.poses.at([t_s])
        return self.facets.points_m @ rotation.T + place

    def build_tetrahedra(self) -> Index:
        """Return the node indices (f, 4), which count on after those of the body and of earlier
        obstacles, of a tetrahedron under each facet, whose last node is the point behind all
        facets.
        """
        triangles = self.facets.triangles + self.first_node
        inner = np.full((len(triangles), 1), self.first_node + len(self.start_points_m) - 1)
        return np.hstack([triangles[:, [0, 2, 1]], inner])


def faceted_obstacles(body: IdentifiedBody) -> tuple[FacetedObstacle, ...]:
    """Return the obstacles of a body as facets, in the order of `IdentifiedBody.obstacles`; empty
    without obstacles.

    Facets that face the body at no sample are left out. Nodes and cells are numbered after those of
    the body. Stiffness and width are means of the pressure law over the area of the surface that
    may touch, the stiffness twice that (see `FacetedObstacle`). The points at the start are
    retracted so far that no node touches.
    """
    if body.experiment_with_obstacles is None:
        return ()
    times = body.experiment_with_obstacles.t_s
    shape = body.experiment_with_obstacles.rigid_positions([body.start_s])
    made: list[FacetedObstacle] = []
    nodes = len(body.nodes_m)
    cells = len(body.body.cells)
    for obstacle, contact in zip(
        body.obstacles, contact_terms(body.experiment_with_obstacles), strict=True
    ):
        law = contact.law_of_contact
        penetration_m, normal = contact.deepest_point(shape.ravel())
        rotations, places = obstacle.poses.at(times)
        rigid_m = body.experiment.rigid_positions(times)
        ends = np.stack([rigid_m.min(axis=1), rigid_m.max(axis=1)], axis=2) - places[..., None]
        corners = np.array([list(product(*each)) for each in ends])
        box_m = np.einsum("tki,tij->tkj", corners, rotations).reshape(-1, 3)
        size_m = PLANE_SIZE_RATIO * float(np.ptp(box_m, axis=0).max())
        area_m2 = law.surface.area_m2
        stiffness = 2 * float(np.average(law.stiffness_at(body.theta), weights=area_m2))
        width_m = float(np.average(law.widths_m, weights=area_m2))
        solid = offset_solid(obstacle.shape, width_m / 2)
        facets = Facets.from_solid(
            solid, box_m.mean(axis=0), size_m=size_m, tolerance_m=width_m / 2
        )
        faces = law.surface.faces
        touching = np.unique(body.body.nodes.nodes_of_faces(body.body.mesh.surface[faces]))
        # Nodes may be deeper than the contact points of this package.
        back_m = -max(penetration_m, 0.0) * normal
        nearest = (rigid_m[0, touching] - places[0] - back_m) @ rotations[0]
        back_m -= facets.max_penetration_m(nearest) * normal
        of_node = stiffness * float(area_m2.sum()) / len(touching)
        shown = facets.facing(
            np.concatenate([box_m, box_m[: len(corners[0])] - back_m @ rotations[0]])
        )
        start_m = shown.points_m @ rotations[0].T + places[0] + back_m
        made.append(
            FacetedObstacle(
                obstacle,
                shown,
                start_points_m=start_m,
                first_node=nodes,
                first_cell=cells,
                stiffness_pa_m=stiffness,
                node_stiffness_n_m=of_node,
                width_m=width_m,
                faces=faces,
            )
        )
        nodes = nodes + len(start_m)
        cells = cells + len(shown.triangles)
    return tuple(made)
