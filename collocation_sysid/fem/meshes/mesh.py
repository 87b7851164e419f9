"""Tetrahedral mesh of a body: generated or read, cleaned and checked once, then immutable.

`TetMesh` holds the mesh. `ElementNodes` are the nodes of a body's elements: those of the mesh,
then, for quadratic elements, one in the middle of each edge.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...common.array_types import Array, Index
from ...common.validated_classes import validated
from ...errors import InputError
from ...kinds.kind import SOLID, Kind
from ..elements import Element, element_named, reference_geometry
from ..laws.constants import NaturalCurvature
from .checks import (
    MeshQuality,
    boundary_of,
    checked_arrays,
    checked_faces,
    checked_points,
    checked_tetrahedra,
    clean_mesh,
    mean_ratios,
    signed_volumes,
    unique_edges,
)
from .cutting import with_nodes_in_planes
from .files import length_in_metres, read_tetrahedra, read_triangles, write_tetrahedra
from .surface import tetrahedralize_surface


class NodeSelection(Protocol):
    """Selection of nodes, such as those of `selection`."""

    def resolve(self, nodes: ElementNodes) -> np.ndarray:
        """Return the indices of the selected nodes, sorted."""
        ...


@validated
@dataclass(frozen=True, eq=False)
class TetMesh:
    """Mesh of linear tetrahedra in metres; its arrays are read-only.

    The constructor drops nodes that are no element's corner and reverses negatively oriented
    elements, and reports this in `notes`. The order of nodes and elements is kept.

    Parameters
    ----------
    points_m : (n, 3) array
        Node positions in metres.
    tetrahedra : (E, 4) integer array
        Nodes of each element, counted from 0.
    point_arrays : mapping of name to (n, ...) array, optional
        Values per node, such as the 0/1 masks of `Named` selections; rows of dropped nodes are
        dropped.
    cell_arrays : mapping of name to (E, ...) array, optional
        Values per element.
    face_sets : mapping of name to (k, 3) integer array, optional
        Corners of triangles, such as those of a cavity's wall; counted like `tetrahedra`, stored
        with the indices after dropping, where −1 stands for a dropped node.
    is_generated : bool, default False
        Whether the mesh was made of stated lengths, as those of `structured` are, not of a scan.

    Attributes
    ----------
    file_index : (n,) int64
        Index of each node before others were dropped; increasing.
    file_node_count : int
        Number of nodes before any were dropped.
    notes : tuple of str
        Sentences about what was cleaned and what looks suspicious.

    Raises
    ------
    InputError
        For wrong shapes, indices out of range, coordinates that are not finite, and elements that
        are degenerate or given twice.
    """

    kind: ClassVar[Kind] = SOLID  # record of the kind of bodies with such a mesh
    points_m: np.ndarray
    tetrahedra: np.ndarray
    point_arrays: dict[str, np.ndarray]
    cell_arrays: dict[str, np.ndarray]
    face_sets: dict[str, np.ndarray]
    file_index: np.ndarray
    file_node_count: int
    notes: tuple[str, ...]
    is_generated: bool

    def __init__(
        self,
        points_m: ArrayLike,
        tetrahedra: ArrayLike,
        point_arrays: Mapping[str, ArrayLike] | None = None,
        cell_arrays: Mapping[str, ArrayLike] | None = None,
        face_sets: Mapping[str, ArrayLike] | None = None,
        *,
        is_generated: bool = False,
    ) -> None:
        raw_points = checked_points(points_m)
        elements = checked_tetrahedra(tetrahedra, len(raw_points))
        for arrays_by_name in (point_arrays, cell_arrays, face_sets):
            if not isinstance(arrays_by_name, Mapping | None):
                kind = type(arrays_by_name).__name__
                raise InputError(f"arrays of a mesh are a {kind}; expected a mapping of names")
        arrays = checked_arrays(point_arrays or {}, len(raw_points), kind="point", of="nodes")
        element_arrays = checked_arrays(
            cell_arrays or {}, len(elements), kind="cell", of="elements"
        )
        points, oriented, used, notes = clean_mesh(raw_points, elements)
        new_index = np.full(len(raw_points), -1)
        new_index[used] = np.arange(len(used))
        faces = {
            name: new_index[checked_faces(f, len(raw_points))]
            for name, f in (face_sets or {}).items()
        }
        self._set(
            points_m=_read_only(points),
            tetrahedra=_read_only(oriented),
            point_arrays={name: _read_only(values[used]) for name, values in arrays.items()},
            cell_arrays={name: _read_only(values) for name, values in element_arrays.items()},
            face_sets={name: _read_only(corners) for name, corners in faces.items()},
            file_index=_read_only(used),
            file_node_count=len(raw_points),
            notes=notes,
            is_generated=is_generated,
        )

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        return f"TetMesh({len(self.points_m)} nodes, {len(self.tetrahedra)} tetrahedra)"

    @classmethod
    @validated
    def read(cls, path: str | Path, length_unit: str = "m") -> TetMesh:
        """Read the tetrahedra of any file that meshio can read.

        Other cells are omitted with a note.

        Quadratic tetrahedra are reduced to their corners: the element of the body determines the
        nodes on edges. Slightly curved sides are straightened, with a note.

        Point arrays of the file, and its point sets as boolean arrays, become `point_arrays`; cell
        arrays, cell sets and physical groups of the tetrahedra become `cell_arrays`. The nodes of
        sets and groups, including those of triangles, lines or points, also become `point_arrays`,
        and their triangles `face_sets`.

        Parameters
        ----------
        length_unit : {"m", "cm", "mm", "um", "in"}
            Unit of the coordinates in the file.

        Raises
        ------
        InputError
            If the file cannot be read, contains no tetrahedra, has sides curved by more than 5 % of
            their length, or its mesh is invalid.
        """
        content = read_tetrahedra(path, length_unit)
        try:
            mesh = cls(
                content.points_m,
                content.tetrahedra,
                point_arrays=content.point_arrays,
                cell_arrays=content.cell_arrays,
                face_sets=content.face_sets,
            )
        except InputError as error:
            raise error.located(path) from None
        mesh._set(notes=(*content.notes, *mesh.notes))
        return mesh

    @classmethod
    @validated
    def from_surface(
        cls,
        surface: str | Path | tuple[ArrayLike, ArrayLike],
        edge_length_m: float,
        length_unit: str = "m",
        cache: str | Path | None = None,
        planes_m: Mapping[str, Sequence[float]] | None = None,
    ) -> TetMesh:
        """Fill a closed surface with tetrahedra by `surface.tetrahedralize_surface`.

        Parameters
        ----------
        surface : str, Path or pair of arrays
            STL, OBJ or PLY file, or vertices (p, 3) and triangles (F, 3).
        edge_length_m : float
            Desired edge length in metres, whatever the unit of the surface.
        length_unit : {"m", "cm", "mm", "um", "in"}
            Unit of the surface's coordinates.
        cache : str or Path, optional
            Folder in which the mesh is kept, since meshing again would give a different mesh.
        planes_m : mapping of "x", "y" or "z" to coordinates, optional
            Planes that no element crosses, such as those where the fingers of a gripper end: a body
            is free from its last held nodes on. Problem files have those of the boxes of grasps.

        Raises
        ------
        InputError
            If the file cannot be read, its surface is invalid, or pytetwild is not installed.
        """
        if isinstance(surface, (str, Path)):
            path = surface
            points, triangles = read_triangles(surface, length_unit)
        else:
            path = None
            points = checked_points(surface[0]) * length_in_metres(length_unit)
            triangles = surface[1]
        try:
            mesh = tetrahedralize_surface(
                points, triangles, edge_length_m=edge_length_m, cache_dir=cache
            )
            return cls(*with_nodes_in_planes(*mesh, planes_m=planes_m or {}))
        except InputError as error:
            raise error.located(path) from error.__cause__

    def write(self, path: str | Path) -> None:
        """Write the mesh, in metres, to any format that meshio knows by the file's extension.

        Point and cell arrays are written (booleans as integers), face sets are not. A file that
        exists is replaced.

        Raises
        ------
        InputError
            If the format is unknown or cannot hold the mesh.
        OSError
            If the file cannot be created.
        """
        write_tetrahedra(
            path,
            self.points_m,
            tetrahedra=self.tetrahedra,
            point_arrays=self.point_arrays,
            cell_arrays=self.cell_arrays,
        )

    def select(self, selection: NodeSelection) -> np.ndarray:
        """Return the nodes of a `selection.Selection`, as sorted int64 indices.

        For nodes on edges, which quadratic elements have, see `Body.select`.

        Raises
        ------
        InputError
            If no node is selected, or the mesh does not have what the selection names.
        """
        return selection.resolve(ElementNodes.corners(self))

    @cached_property
    def volumes_m3(self) -> np.ndarray:
        """Volume of each element (E,) [m³], all positive."""
        return _read_only(signed_volumes(self.points_m, self.tetrahedra))

    @cached_property
    def centres_m(self) -> np.ndarray:
        """Centre of each element (E, 3) [m]."""
        return _read_only(self.points_m[self.tetrahedra].mean(axis=1))

    @property
    def volume_m3(self) -> float:
        """Volume of the whole mesh [m³]."""
        return float(self.volumes_m3.sum())

    @property
    def bounds_m(self) -> np.ndarray:
        """Lowest and highest coordinates (2, 3) [m]."""
        return np.array([self.points_m.min(axis=0), self.points_m.max(axis=0)])

    @property
    def surface(self) -> np.ndarray:
        """Boundary triangles (F, 3) int64, counter-clockwise as seen from outside."""
        return self._boundary[0]

    @property
    def surface_cells(self) -> np.ndarray:
        """Index of the element to which each boundary triangle belongs (F,)."""
        return self._boundary[1]

    @cached_property
    def _boundary(self) -> tuple[np.ndarray, np.ndarray]:
        faces, owners = boundary_of(self.tetrahedra)
        return _read_only(faces), _read_only(owners)

    @cached_property
    def edges(self) -> np.ndarray:
        """Pairs of nodes that share an element, (m, 2) int64, each once, the lower index first,
        sorted.
        """
        return _read_only(unique_edges(self.tetrahedra))

    def nodes_of(self, element: Element) -> ElementNodes:
        """Return the nodes of the elements of a kind: corners, and mid nodes if it has any."""
        return ElementNodes.for_element(self, element)

    def geometry(self, nodes: ElementNodes, element: Element, parts: Sequence[Index]) -> Array:
        """Return shape gradients and volumes, see `elements.reference_geometry`, of a body with
        these elements in each of its parts.
        """
        return reference_geometry(nodes.points_m, nodes.cells, element=element)

    def gradients(self, points_m: Array, cells: Index) -> tuple[Array, Array]:
        """Return weights (E, 5, 6) of the nodes in the gradient of elements (E, 6) of a rod, and their
        lengths (E,) [m], from positions (n, 3) at rest.
        """
        raise InputError("found a force on elements of a rod; expected a rod", where="forces")

    def geometry_at(self, positions_m: Array, cells: Index, geometry: Array) -> Array:
        """Return a geometry (E, q, any) of elements (E, nodes) with their nodes at other positions
        (n, 3) [m].
        """
        count, points = geometry.shape[:2]
        slopes = geometry[..., :-1].reshape(count, points, -1, 3)
        G = np.einsum("ean,eqai->eqni", positions_m[cells], slopes)
        gradients = np.einsum("eqai,eqin->eqan", slopes, np.linalg.inv(G)).reshape(
            count, points, -1
        )
        volumes = geometry[..., -1:] * np.linalg.det(G)[..., None]
        return np.concatenate([gradients, volumes], axis=2)

    def partly_straightened(self, cells: Index, geometry: Array, share: float) -> Array:
        """Return `geometry` with a share of the change of the rest shape, see
        `Body.partly_straightened`; itself if nothing changes.
        """
        return geometry

    def element_and_law(
        self, element: str, material: Any, natural_curvature: NaturalCurvature
    ) -> tuple[Element, Any]:
        """Return the element and the law of a body with this mesh, by the arguments of `Body`."""
        if natural_curvature:
            raise InputError(
                "found natural_curvature for a body of tetrahedra; expected a mesh by cs.rod_mesh",
                where="natural_curvature",
            )
        return element_named(element), material

    @property
    def places_in_refined(self) -> Index:
        """Index (n,) of each node in the refined mesh."""
        return np.arange(len(self.points_m))

    def refined_mask(self, is_chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the mask of the nodes of the refined mesh that are nodes of a mask (n,), or between
        two of them.
        """
        return np.concatenate([is_chosen, is_chosen[self.edges].all(axis=1)])

    @property
    def surface_factor(self) -> float:
        """Area of the surface of the body over that of the mesh."""
        return 1.0

    @property
    def extents_m(self) -> tuple[float, float, float]:
        """Lengths of the body along its axes [m]."""
        x, y, z = np.ptp(self.bounds_m, axis=0).tolist()
        return x, y, z

    @property
    def arc_lengths_m(self) -> Array | None:
        """Arc length of each node along a rod (n,) [m]; None for other bodies."""
        return None

    @property
    def cell_of_tetrahedra(self) -> Index:
        """Index of the element of a body to which each tetrahedron belongs."""
        return np.arange(len(self.tetrahedra))

    def mid_node_indices(self, pairs: np.ndarray) -> np.ndarray:
        """Return the indices (…) of the mid nodes between pairs (…, 2) of corners, in either order.

        Mid nodes follow the corners, in the order of `edges`. Pairs must be edges of the mesh; this
        is not checked.
        """
        count = len(self.points_m)
        codes = np.sort(pairs, axis=-1) @ [count, 1]
        return count + np.searchsorted(self.edges @ [count, 1], codes)

    @cached_property
    def sha256(self) -> str:
        """Hash of the points and tetrahedra alone, in their order, as 64 hexadecimal digits."""
        digest = hashlib.sha256(f"{self.points_m.shape} {self.tetrahedra.shape}".encode())
        digest.update(self.points_m.astype("<f8").tobytes())
        digest.update(self.tetrahedra.astype("<i8").tobytes())
        return digest.hexdigest()

    def quality(self) -> MeshQuality:
        """Return edge lengths and mean ratios of the elements."""
        lengths = np.linalg.norm(np.diff(self.points_m[self.edges], axis=1), axis=2)
        ratios = mean_ratios(self.points_m, self.tetrahedra)
        return MeshQuality(
            edge_min_m=float(lengths.min()),
            edge_mean_m=float(lengths.mean()),
            edge_max_m=float(lengths.max()),
            quality_min=float(ratios.min()),
            quality_median=float(np.median(ratios)),
        )


def _read_only(array: np.ndarray) -> np.ndarray:
    """Return the array, contiguous and read-only; a copy only if it is not contiguous."""
    array = np.ascontiguousarray(array)
    array.flags.writeable = False
    return array


@dataclass(frozen=True, eq=False)
class ElementNodes:
    """Nodes of the elements of a body."""

    mesh: TetMesh  # mesh whose nodes are the corners; they come first, with the same indices
    points_m: Array  # (n, 3): undeformed positions
    cells: Index  # (E, nodes per element): node indices of each element
    # (k, 2): corners at the ends of the edge of each mid node: the rows of `mesh.edges`, or none.
    ends: Index

    @classmethod
    def corners(cls, mesh: TetMesh) -> ElementNodes:
        """Return the nodes of the mesh only."""
        return cls(
            mesh, mesh.points_m, cells=mesh.tetrahedra, ends=np.empty((0, 2), dtype=np.int64)
        )

    @classmethod
    def for_element(cls, mesh: TetMesh, element: Element) -> ElementNodes:
        """Return the nodes of a kind of element: corners, and mid nodes if it has any."""
        if not element.edges:
            return cls.corners(mesh)
        points = _read_only(np.vstack([mesh.points_m, mesh.points_m[mesh.edges].mean(axis=1)]))
        middles = mesh.mid_node_indices(mesh.tetrahedra[:, element.edges])
        return cls(mesh, points, cells=np.hstack([mesh.tetrahedra, middles]), ends=mesh.edges)

    def with_mid_nodes(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Extend a mask of mesh nodes (corners,) to all nodes (n,): a mid node is selected if both
        ends of its edge are.
        """
        return np.concatenate([chosen, chosen[self.ends].all(axis=1)])

    def nodes_of_faces(self, triangles: Index) -> Index:
        """Return the nodes of triangles of corners (F, 3): the corners and, for quadratic elements,
        the mid nodes of the edges ab, bc, ca, (F, 6).
        """
        if not len(self.ends):
            return triangles
        pairs = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2)
        return np.hstack([triangles, self.mesh.mid_node_indices(pairs)])

    @cached_property
    def surface_shares(self) -> tuple[Array, Array]:
        """Surface area (n,) [m²] and outward unit normal (n, 3) of every node; zero inside.

        The area belongs to the corners, a third of each face, or to the mid nodes of quadratic
        faces, whose corners have zero area and normal. The normal is the mean by area over the
        faces.
        """
        faces = self.nodes_of_faces(self.mesh.surface)
        a, b, c = np.moveaxis(self.points_m[faces[:, :3]], 1, 0)
        share = np.cross(b - a, c - a) / 6 * self.mesh.surface_factor
        normal = np.zeros((len(self.points_m), 3))
        area = np.zeros(len(normal))
        for node in faces[:, -3:].T:
            np.add.at(normal, node, share)
            np.add.at(area, node, np.linalg.norm(share, axis=1))
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        return area, np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
