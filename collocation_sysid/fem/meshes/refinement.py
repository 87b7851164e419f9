"""Refinement of a body: every tetrahedron is split into eight.

Use `refine_body` for the body, and `refine_nodes` for nodes that are selected on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Index
from ..elements import ELEMENTS
from ..node_force import LocatedForce, NodeForce
from ..regions import Region
from ..rest_shape import UnderGravity
from .checks import orient_elements
from .mesh import ElementNodes, TetMesh
from .selection import Along, Ball, Box, Indices, Selection

if TYPE_CHECKING:
    from ..body import Body

# Tetrahedron at each corner: the corner and its mid nodes, in the order of `elements.EDGES`.
_AT_CORNERS = ((0, 4, 6, 7), (1, 4, 5, 8), (2, 5, 6, 9), (3, 7, 8, 9))
# Octahedron in the middle: each of its diagonals, and the ring of the other mid nodes.
_DIAGONALS = np.array([(4, 9), (5, 7), (6, 8)])
_RINGS = np.array([(5, 6, 7, 8), (4, 6, 9, 8), (4, 5, 9, 7)])


def split_in_eight(mesh: TetMesh) -> TetMesh:
    """Return the mesh with a node on each edge and eight tetrahedra in place of each one.

    The octahedron in the middle is cut along its shortest diagonal, so that elements do not
    deteriorate (Zhang 1995). The nodes of the mesh come first, then the middle of each of
    `TetMesh.edges`; the eight parts of element i are 8 i … 8 i + 7. Masks of nodes are true in
    the middle of an edge if they are at both ends; other arrays of nodes are omitted. Arrays of
    cells are repeated, and face sets split.
    """
    finer = ElementNodes.for_element(mesh, ELEMENTS["tet10"])
    ends = mesh.edges
    points = finer.points_m
    nodes = finer.cells
    across = points[nodes[:, _DIAGONALS]]  # (E, 3, 2, 3)
    shortest = np.linalg.norm(across[:, :, 1] - across[:, :, 0], axis=2).round(12).argmin(axis=1)
    ring = _RINGS[shortest]
    axis = _DIAGONALS[shortest]  # (E, 4), (E, 2)
    middle = [np.column_stack([axis, ring[:, k], ring[:, k - 1]]) for k in range(4)]
    local = [np.broadcast_to(corner, (len(nodes), 4)) for corner in _AT_CORNERS] + middle
    children = np.take_along_axis(nodes[:, None], np.stack(local, axis=1), axis=2)
    masks = {n: a for n, a in mesh.point_arrays.items() if a.ndim == 1 and np.isin(a, (0, 1)).all()}
    return TetMesh(
        points,
        orient_elements(points, children.reshape(-1, 4))[0],
        point_arrays={name: np.concatenate([a, a[ends].min(axis=1)]) for name, a in masks.items()},
        cell_arrays={name: np.repeat(a, 8, axis=0) for name, a in mesh.cell_arrays.items()},
        face_sets={
            name: split_faces_in_four(faces, mesh) for name, faces in mesh.face_sets.items()
        },
        is_generated=mesh.is_generated,
    )


def split_faces_in_four(faces: Index, mesh: TetMesh) -> Index:
    """Return faces (k, 3) of a mesh split into four each, with the nodes of `split_in_eight`."""
    nodes = ElementNodes.for_element(mesh, ELEMENTS["tet10"]).nodes_of_faces(faces)
    return nodes[:, [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)]].reshape(-1, 3)


def on_mesh(
    body: Body,
    mesh: TetMesh,
    cells: Sequence[Index],
    forces: Sequence[NodeForce],
    rest_shape: UnderGravity | Literal["stress_free"] | None,
) -> Body:
    """Return a body with the properties of another on a mesh of its own; fields and axes are missing.

    Parameters
    ----------
    cells : sequence of (k,) arrays
        Elements of each of `body.parts` in the new mesh.
    """
    regions = [
        Region(
            part.name,
            own,
            material=part.material,
            density_kg_m3=part.density_kg_m3 if part.has_own_density else None,
            damping=part.damping,
            prony=part.prony,
        )
        for part, own in zip(body.parts, cells, strict=True)
        if part.name
    ]
    # A region without a density has that of the body, even if regions claim all cells.
    rest = next((part for part in body.parts if not part.has_own_density), body.parts[0])
    other = type(body)(
        mesh,
        rest.material,
        rest.density_kg_m3,
        body.element.name if body.is_solid else "tet4",
        damping=rest.damping,
        regions=regions,
        prony=rest.prony,
        forces=forces,
        rest_shape=rest_shape,
        made=body.made,
        mesh_from=body.mesh_from,
        natural_curvature=getattr(rest.material, "natural_curvature", False),
        evaluator=body.evaluator,
        threads=body.threads,
    )
    other.has_declared_mass = body.has_declared_mass
    return other.with_free_densities([part.name for part in body.parts if part.has_free_density])


def refine_body(body: Body) -> Body:
    """Return the body on a mesh with half the element size, see `split_in_eight`.

    Materials, stated and free densities, fields (not computed again), fibres, custom forces, the rest
    shape and `has_declared_mass` are those of `body`; the total mass is the same. Frames of obstacles are
    not copied.
    """
    mesh = body.kind.refined(body.mesh)
    children = np.arange(len(mesh.tetrahedra) // len(body.cells))
    finer = on_mesh(
        body,
        mesh,
        cells=[(len(children) * part.cells[:, None] + children).ravel() for part in body.parts],
        forces=[_refined_force(placed, mesh, body=body) for placed in body.placed_forces],
        rest_shape=_refined_rest_shape(body, mesh),
    )
    if not any(part.field or part.axes is not None for part in body.parts):
        return finer
    return finer.with_parts(
        tuple(
            replace(
                part,
                field=source.field
                and source.field.on_cells(
                    np.arange(len(part.cells)) // 8, mesh.volumes_m3[part.cells]
                ),
                axes=None if source.axes is None else np.repeat(source.axes, 8, axis=0),
            )
            for part, source in zip(finer.parts, body.parts, strict=True)
        )
    )


def _refined_rest_shape(body: Body, mesh: TetMesh) -> UnderGravity | Literal["stress_free"] | None:
    if body.scan_conditions is None:
        return None if body.rest_shape is None else "stress_free"
    if isinstance(body.scan_conditions.nodes, (Box, Ball)):
        return body.scan_conditions
    corners = len(body.mesh.points_m)
    is_prescribed = np.isin(np.arange(corners), body.scan_conditions.grasped_nodes(body.nodes))
    chosen = np.flatnonzero(body.mesh.refined_mask(is_prescribed))
    return replace(body.scan_conditions, nodes=Indices(chosen.tolist()))


def _refined_force(placed: LocatedForce, mesh: TetMesh, body: Body) -> NodeForce:
    chosen = np.isin(np.arange(len(body.nodes_m)), placed.points.nodes)
    chosen = body.mesh.refined_mask(chosen[: len(body.mesh.points_m)])
    if body.element.edges:
        chosen = np.concatenate([chosen, chosen[mesh.edges].all(axis=1)])
    return placed.force.on_refined_body(np.flatnonzero(chosen))


def refine_nodes(nodes: Index, selection: Selection | None, body: Body, finer: Body) -> Index:
    """Return the nodes of the refined body that correspond to nodes of the original one, sorted.

    Boxes and balls select anew. Otherwise the middle of an edge is selected if both ends are.

    Parameters
    ----------
    nodes : (k,) int
        Nodes of the original body, mid nodes included; not read for a box or ball.
    selection : Selection or None
        Selection of these nodes, if there is one.
    body, finer : Body
        Original and refined body.

    Raises
    ------
    InputError
        If a box or ball selects no node of the refined body.
    """
    if isinstance(selection, (Along, Box, Ball)):
        return finer.select(selection)
    chosen: NDArray[np.bool_] = np.isin(np.arange(len(body.nodes_m)), nodes)
    if not body.element.edges:
        chosen = body.mesh.refined_mask(chosen)
    return np.flatnonzero(finer.nodes.with_mid_nodes(chosen)).astype(np.int64)
