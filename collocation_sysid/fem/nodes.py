"""The nodes of a body: those of the mesh, then one halfway along each edge if the element asks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index

if TYPE_CHECKING:
    from .elements import Element


class Mesh(Protocol):
    """What is needed of a `TetMesh`, which describes it."""

    @property
    def points_m(self) -> np.ndarray:
        """(n, 3) [m]."""
        ...

    @property
    def tetrahedra(self) -> np.ndarray:
        """(E, 4) corners."""
        ...

    @cached_property
    def edges(self) -> np.ndarray:
        """(m, 2) pairs of nodes, sorted."""
        ...

    @property
    def bounds_m(self) -> np.ndarray:
        """(2, 3) lowest and highest coordinates."""
        ...

    @property
    def point_arrays(self) -> Mapping[str, np.ndarray]:
        """Values per node, by name."""
        ...

    @property
    def cell_arrays(self) -> Mapping[str, np.ndarray]:
        """Values per cell, by name."""
        ...

    @property
    def face_sets(self) -> Mapping[str, np.ndarray]:
        """Triangles (k, 3), by name."""
        ...

    @cached_property
    def surface(self) -> np.ndarray:
        """(F, 3) boundary triangles."""
        ...

    @cached_property
    def centres_m(self) -> np.ndarray:
        """(E, 3) of the cells."""
        ...

    @property
    def file_index(self) -> np.ndarray:
        """(n,) number of each node in the file."""
        ...

    @property
    def file_node_count(self) -> int:
        """Nodes in the file."""
        ...


@dataclass(frozen=True, eq=False)
class Nodes:
    """Where nodes are, and which of them make up each element.

    Attributes
    ----------
    mesh : TetMesh
        Its nodes are the corners and come first, with their numbers.
    points_m : (n, 3)
    cells : (E, nodes per element)
    ends : (k, 2) the corners at the ends of each mid node's edge: rows of `mesh.edges`, or none
    """

    mesh: Mesh
    points_m: Array
    cells: Index
    ends: Index

    @classmethod
    def corners(cls, mesh: Mesh) -> Nodes:
        """Only the mesh's own."""
        return cls(mesh, mesh.points_m, mesh.tetrahedra, np.empty((0, 2), dtype=np.int64))

    @classmethod
    def of_element(cls, mesh: Mesh, element: Element) -> Nodes:
        """All that the element has."""
        if not element.edges:
            return cls.corners(mesh)
        count, ends = len(mesh.points_m), mesh.edges
        points = np.vstack([mesh.points_m, mesh.points_m[ends].mean(axis=1)])
        pairs = np.sort(mesh.tetrahedra[:, element.edges], axis=2)
        edge = np.searchsorted(ends @ [count, 1], pairs @ [count, 1])
        points.flags.writeable = False
        return cls(mesh, points, np.hstack([mesh.tetrahedra, count + edge]), ends)

    def with_mid_nodes(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Extend a choice of mesh nodes to mid nodes: chosen when both ends of the edge are."""
        return np.concatenate([chosen, chosen[self.ends].all(axis=1)])

    def on_faces(self, triangles: Index) -> Index:
        """Nodes (F, 3) or (F, 6) of triangles of corners: then those on the edges ab, bc, ca."""
        if not len(self.ends):
            return triangles
        count = len(self.mesh.points_m)
        pairs = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2)
        edge = np.searchsorted(self.ends @ [count, 1], pairs @ [count, 1])
        return np.hstack([triangles, count + edge])
