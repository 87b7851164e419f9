"""A body on a coarser mesh, with the relation of its nodes to those of the given body.

Use `coarsen_body` for a start of a search on a large body: materials, regions, fields, custom
forces and the conditions of a scan are transferred, so that both bodies have the same constants θ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
import scipy.sparse as sp
from scipy.spatial import KDTree

from ..common.array_types import Array, Index
from .meshes.coarsening import CoarseMesh, coarsen_mesh
from .meshes.mesh import ElementNodes
from .meshes.refinement import on_mesh
from .meshes.selection import Indices
from .node_force import LocatedForce, NodeForce
from .regions import BodyPart
from .rest_shape import UnderGravity
from .spatial_field import FieldModes

if TYPE_CHECKING:
    from .body import Body


@dataclass(frozen=True, eq=False)
class CoarseBody:
    """Coarse body and its relation to the given body."""

    body: Body  # given body
    coarse: Body  # body of the same shape on a coarser mesh
    meshes: CoarseMesh  # relation of their nodes and elements

    def coarse_nodes(self, nodes: Index) -> Index:
        """Return the nodes of the coarse body, sorted, onto which nodes (k,) of the given body were
        moved; a mid node of the coarse body is among them if both ends of its edge are.
        """
        return _transferred_nodes(nodes, self.meshes, self.coarse.nodes)

    def coarse_faces(self, faces: Index) -> Index:
        """Return the triangles (F, 3) of the coarse mesh onto which triangles (k, 3) of corners of
        the given mesh were moved, each once; those that became degenerate are left out.
        """
        moved = np.sort(self.meshes.coarse_nodes[faces], axis=1)
        is_triangle = (np.diff(moved, axis=1) > 0).all(axis=1)
        return np.unique(moved[is_triangle], axis=0)

    def coarse_values(self, values: Array) -> Array:
        """Return nodal values (n, …) of the given body at the nodes (m, …) of the coarse body; at
        mid nodes the mean of both ends.
        """
        at_corners = values[self.meshes.kept_nodes]
        ends = self.coarse.nodes.ends
        return np.concatenate([at_corners, at_corners[ends].mean(axis=1)])

    @cached_property
    def interpolation(self) -> sp.csr_array:
        """Matrix (n, m) of the shape functions of the coarse body at the nodes of the given one, in
        the undeformed shape, without nodes of obstacle frames.

        Nodes beyond the coarse surface are extrapolated from an element near them.
        """
        coarse_m = self.coarse.mesh.points_m[self.coarse.mesh.tetrahedra]
        points_m = self.body.nodes.points_m
        count = min(24, len(coarse_m))
        _, near = KDTree(coarse_m.mean(axis=1)).query(points_m, count)
        near = near.reshape(len(points_m), count)
        inverse = np.linalg.inv(coarse_m[:, 1:] - coarse_m[:, :1])
        offsets = points_m[:, None] - coarse_m[near, 0]
        rest = np.einsum("nki,nkij->nkj", offsets, inverse[near])
        local = np.concatenate([1.0 - rest.sum(2, keepdims=True), rest], 2)
        rows = np.arange(len(points_m))
        best = local.min(axis=2).argmax(axis=1)
        weights = self.coarse.element.shape_functions(local[rows, best])
        nodes = self.coarse.cells[near[rows, best]]
        places = (np.repeat(rows, nodes.shape[1]), nodes.ravel())
        shape = (len(points_m), len(self.coarse.nodes.points_m))
        return sp.csr_array((weights.ravel(), places), shape=shape)


def coarsen_body(body: Body, node_count: int, node_sets: Sequence[Index]) -> CoarseBody:
    """Return the body on a mesh with about a given number of nodes.

    Materials, stated and free densities, fields (not computed again), fibres, custom forces, the rest
    shape and `has_declared_mass` are those of `body`. Densities stay, so the mass changes with the volume
    that a coarse surface encloses. Frames of obstacles are not copied.

    Parameters
    ----------
    node_count : int
        Desired number of nodes, mid nodes included; there may be more.
    node_sets : sequence of (k,) int
        Node sets, such as grasps, that must consist of the corresponding nodes of the coarse body.

    Raises
    ------
    InputError
        If a field cannot be transferred, or a node set of a custom force is lost.
    """
    corners = len(body.mesh.points_m)
    sets = [*node_sets, *_own_node_sets(body)]
    is_in_set = np.zeros((corners, len(sets) + 1), dtype=bool)
    for column, nodes in enumerate(sets):
        is_in_set[nodes[nodes < corners], column] = True
    labels = np.unique(is_in_set, axis=0, return_inverse=True)[1]
    groups = np.empty(len(body.cells), dtype=np.int64)
    for number, part in enumerate(body.parts):
        groups[part.cells] = number
    meshes = coarsen_mesh(
        body.mesh, max(4, node_count * corners // len(body.nodes.points_m)), labels.ravel(), groups
    )
    return _with_properties(body, meshes, groups[meshes.source_cells])


def _own_node_sets(body: Body) -> list[Index]:
    sets = [
        np.unique(placed.points.nodes)
        for placed in body.placed_forces
        if placed.force.nodes is not None
    ]
    if body.scan_conditions is not None:
        sets.append(body.scan_conditions.grasped_nodes(body.nodes))
    return sets


def _with_properties(body: Body, meshes: CoarseMesh, groups: Index) -> CoarseBody:
    nodes = ElementNodes.for_element(meshes.mesh, body.element)
    coarse = on_mesh(
        body,
        meshes.mesh,
        cells=[np.flatnonzero(groups == k) for k in range(len(body.parts))],
        forces=[_coarse_force(each, meshes, nodes) for each in body.placed_forces],
        rest_shape=_coarse_rest_shape(body, meshes, nodes),
    )
    parts = zip(coarse.parts, body.parts, strict=True)
    coarse = coarse.with_parts(
        tuple(
            replace(
                part,
                field=_coarse_field(source, part, body, coarse),
                axes=_coarse_axes(source, part, body, coarse),
            )
            for part, source in parts
        )
    )
    return CoarseBody(body, coarse, meshes)


def _transferred_nodes(nodes: Index, meshes: CoarseMesh, coarse_nodes: ElementNodes) -> Index:
    corners = nodes[nodes < len(meshes.coarse_nodes)]
    chosen = np.zeros(len(meshes.mesh.points_m), dtype=bool)
    chosen[meshes.coarse_nodes[corners]] = True
    return np.flatnonzero(coarse_nodes.with_mid_nodes(chosen))


def _coarse_force(
    placed: LocatedForce, meshes: CoarseMesh, coarse_nodes: ElementNodes
) -> NodeForce:
    if placed.force.nodes is None:
        return placed.force
    nodes = _transferred_nodes(np.unique(placed.points.nodes), meshes, coarse_nodes)
    return replace(placed.force, nodes=Indices(nodes.tolist()))


def _coarse_rest_shape(
    body: Body, meshes: CoarseMesh, coarse_nodes: ElementNodes
) -> UnderGravity | Literal["stress_free"] | None:
    scan = body.scan_conditions
    if scan is None:
        return None if body.rest_shape is None else "stress_free"
    nodes = _transferred_nodes(scan.grasped_nodes(body.nodes), meshes, coarse_nodes)
    return replace(scan, nodes=Indices(nodes.tolist()))


def _coarse_field(source: BodyPart, part: BodyPart, body: Body, coarse: Body) -> FieldModes | None:
    """Return the field of a part on the coarse part: values of the nearest elements."""
    modes = source.field
    if modes is None:
        return None
    nearest = _nearest_cells(source, part, body, coarse)
    return modes.on_cells(nearest, coarse.mesh.volumes_m3[part.cells])


def _coarse_axes(source: BodyPart, part: BodyPart, body: Body, coarse: Body) -> Array | None:
    """Axes of fibres in the elements of the coarse part, those of the nearest elements."""
    return None if source.axes is None else source.axes[_nearest_cells(source, part, body, coarse)]


def _nearest_cells(source: BodyPart, part: BodyPart, body: Body, coarse: Body) -> Index:
    centres_m = body.mesh.centres_m[source.cells]
    return np.asarray(KDTree(centres_m).query(coarse.mesh.centres_m[part.cells])[1])
