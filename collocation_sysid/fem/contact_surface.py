"""Quadrature points of surface faces at which a body may touch an obstacle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.array_types import Array, Index
from .body import Body
from .elements import face_shape_functions
from .force_points import ForcePoints
from .meshes.selection import Selection

# Number of vectors of a contact point: from the frame's origin to it and to the ends of three axes.
VECTORS_PER_POINT = 4

# Barycentric points and weights of a triangle, exact to order 2 and 4 (Dunavant 1985).
_A = (0.445948490915965, 0.223381589678011)
# Coordinate and weight of the second three points of the rule of order 4.
_B = (0.091576213509771, 0.109951743655322)
_ROTATIONS = np.array([[0, 1, 1], [1, 0, 1], [1, 1, 0]])
RULES = {
    3: (np.where(_ROTATIONS, 1 / 6, 2 / 3), np.full(3, 1 / 3)),
    6: (
        np.vstack([np.where(_ROTATIONS, a, 1 - 2 * a) for a, _ in (_A, _B)]),
        np.repeat([w for _, w in (_A, _B)], 3),
    ),
}


@dataclass(frozen=True, eq=False)
class ContactSurface:
    """Surface points of a body that may touch an obstacle."""

    # Quadrature points of faces; the vectors of each are from the frame's origin to the point and
    # to the ends of the frame's axes.
    points: ForcePoints
    area_m2: Array  # (i,): area assigned to each point
    edge_m: float  # mean edge length of all faces
    edges_m: Array  # (f,): mean edge length of each face
    part: int  # index of the part of the body with most of the area
    points_per_face: int  # number of points of each face
    faces: Index  # (f,): rows of the mesh's surface

    @classmethod
    def from_body(cls, body: Body, frame: Index, chosen: Selection | None) -> ContactSurface:
        """Return the contact points of a body and the frame of an obstacle: 3 on each linear face,
        6 on each quadratic one, face after face.

        Parameters
        ----------
        body : Body
            Body with frames, see `Body.with_frames`.
        frame : (4,) int
            Nodes of the obstacle's frame.
        chosen : Selection or None
            Faces that may touch; None for the whole surface.

        Raises
        ------
        InputError
            If no face is selected.
        """
        rows = np.arange(len(body.mesh.surface))
        if chosen is not None:
            rows = chosen.resolve_faces(body.mesh)
        triangles = body.mesh.surface[rows]
        faces = body.nodes.nodes_of_faces(triangles)
        corners = body.mesh.points_m[triangles]
        sides = np.roll(corners, -1, axis=1) - corners
        area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2
        places, weights = RULES[faces.shape[1]]
        shape, _ = face_shape_functions(places, faces.shape[1])
        count = len(weights)
        nodes = np.hstack([faces, np.broadcast_to(frame, (len(faces), 4))])
        mix = np.zeros((count, VECTORS_PER_POINT, nodes.shape[1]))
        mix[:, 0, : faces.shape[1]] = shape
        mix[:, 1:, faces.shape[1] + 1 :] = np.eye(3)
        mix[:, :, faces.shape[1]] = -1
        points = ForcePoints(
            np.repeat(nodes, count, axis=0),
            np.tile(mix, (len(faces), 1, 1)),
            node_count=len(body.nodes_m),
        )
        in_part = [
            np.isin(triangles, body.mesh.tetrahedra[p.cells]).all(axis=1) for p in body.parts
        ]
        part = int(np.argmax([area[each].sum() for each in in_part]))
        edges_m = np.linalg.norm(sides, axis=2).mean(axis=1)
        return cls(
            points=points,
            area_m2=np.outer(area, weights).ravel(),
            edge_m=float(edges_m.mean()),
            edges_m=edges_m,
            part=part,
            points_per_face=count,
            faces=rows,
        )
