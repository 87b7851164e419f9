"""Where the surface of a body may touch something: quadrature points of its faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Index
from .body import Body
from .force_points import ForcePoints
from .selection import Selection

# From the origin of a frame to a point of the surface, and to the ends of the frame's axes.
VECTORS = 4

# Barycentric points and weights of a triangle, exact to order 2 and 4 (Dunavant 1985).
_A, _B = (0.445948490915965, 0.223381589678011), (0.091576213509771, 0.109951743655322)
_TURNS = np.array([[0, 1, 1], [1, 0, 1], [1, 1, 0]])
RULES = {
    3: (np.where(_TURNS, 1 / 6, 2 / 3), np.full(3, 1 / 3)),
    6: (
        np.vstack([np.where(_TURNS, a, 1 - 2 * a) for a, _ in (_A, _B)]),
        np.repeat([w for _, w in (_A, _B)], 3),
    ),
}


@dataclass(frozen=True, eq=False)
class Touching:
    """Where the surface of a body may touch an obstacle.

    Attributes
    ----------
    points : ForcePoints
        Quadrature points of faces; of each the ways from the frame's origin to it and to the ends.
    area_m2 : (i,)
    edge_m : float
        Mean length of an edge of the faces.
    edges_m : (f,)
        Mean length of the edges of each face.
    part : int
        Of the body, that has most of the faces.
    a_face : int
        Points of each face.
    faces : (f,) rows of the mesh's surface
    """

    points: ForcePoints
    area_m2: Array
    edge_m: float
    edges_m: Array
    part: int
    a_face: int
    faces: Index

    @classmethod
    def of(cls, body: Body, frame: Index, chosen: Selection | None) -> Touching:
        """That of a body, or some of its faces, and the frame (4,) of an obstacle."""
        rows = np.arange(len(body.mesh.surface))
        if chosen is not None:
            rows = chosen.resolve_faces(body.mesh)
        triangles = body.mesh.surface[rows]
        faces = body.nodes.on_faces(triangles)
        corners = body.mesh.points_m[triangles]
        sides = np.roll(corners, -1, axis=1) - corners
        area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2
        places, weights = RULES[faces.shape[1]]
        shape, _ = on_faces(places, faces.shape[1])
        count = len(weights)
        nodes = np.hstack([faces, np.broadcast_to(frame, (len(faces), 4))])
        mix = np.zeros((count, VECTORS, nodes.shape[1]))
        mix[:, 0, : faces.shape[1]] = shape
        mix[:, 1:, faces.shape[1] + 1 :] = np.eye(3)
        mix[:, :, faces.shape[1]] = -1
        points = ForcePoints(
            np.repeat(nodes, count, axis=0), np.tile(mix, (len(faces), 1, 1)), len(body.nodes_m)
        )
        held = [np.isin(triangles, body.mesh.tetrahedra[p.cells]).all(axis=1) for p in body.parts]
        part = int(np.argmax([area[each].sum() for each in held]))
        edges_m = np.linalg.norm(sides, axis=2).mean(axis=1)
        return cls(
            points=points,
            area_m2=np.outer(area, weights).ravel(),
            edge_m=float(edges_m.mean()),
            edges_m=edges_m,
            part=part,
            a_face=count,
            faces=rows,
        )


def on_faces(places: Array, nodes: int) -> tuple[Array, Array]:
    """Weights (q, v) of so many nodes of a face at places (q, 3), and slopes (q, v, 3) by these.

    Nodes are the corners, and of six of them the middles of ab, bc and ca.
    """
    unit = np.broadcast_to(np.eye(3), (len(places), 3, 3))
    if nodes == 3:
        return places, unit
    beside = np.roll(places, -1, axis=1)
    weights = np.hstack([places * (2 * places - 1), 4 * places * beside])
    of_sides = beside[:, :, None] * unit + places[:, :, None] * np.roll(unit, 1, axis=2)
    return weights, np.hstack([(4 * places - 1)[:, :, None] * unit, 4 * of_sides])
