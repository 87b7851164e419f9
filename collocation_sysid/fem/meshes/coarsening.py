"""Coarser mesh of the same body, by half-edge collapses.

A collapse moves a node onto a neighbour and removes the elements between them (Hoppe 1996; for
tetrahedra Cutler, Dorsey and McMillan 2004). Nodes of the coarse mesh are therefore nodes of the
given one, surface nodes stay on the surface, and elements stay in their group. A collapse is
admissible if the elements around the removed node keep positive volumes and sufficient quality,
and if the surface stays near the old one, measured by the quadrics of Garland and Heckbert (1997).
Collapses of nodes that share no element do not affect each other: each round does many at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from .checks import boundary_of, edge_lengths, mean_ratios, signed_volumes, unique_edges
from .mesh import TetMesh

# Smallest mean ratio of a new element; where the old ones are worse, they must not deteriorate.
LEAST_QUALITY = 0.15
# Largest root mean square distance of a new surface node from the planes of the old surface at the
# removed node, in edge lengths of the coarse mesh.
SURFACE_TOLERANCE = 0.15
# Largest length of an edge that is collapsed, in edge lengths of the coarse mesh.
LONGEST_EDGE = 1.3
# Largest length of an edge of a new element, in the same unit.
LONGEST_NEW_EDGE = 2.2
# Number of neighbours of a node that are tried in a round, the nearest first.
NEIGHBOURS = 3
# Largest number of rounds; each removes about a tenth of the nodes.
MOST_ROUNDS = 100


@dataclass(frozen=True, eq=False)
class CoarseMesh:
    """Coarse mesh and its relation to the given mesh."""

    mesh: TetMesh  # coarse mesh, without arrays of nodes and cells and without face sets
    kept_nodes: Index  # (m,) int: node of the given mesh for each node of the coarse mesh
    # (n,) int: node of the coarse mesh onto which each node of the given mesh was moved.
    coarse_nodes: Index
    # (E,) int: element of the given mesh from which each coarse element was made by moving its
    # corners; both belong to the same group.
    source_cells: Index


def coarsen_mesh(
    mesh: TetMesh, node_count: int, node_labels: Index, cell_groups: Index
) -> CoarseMesh:
    """Return a mesh of the same body with about the given number of nodes.

    It has more nodes where no further collapse is admissible, which is not an error.

    Parameters
    ----------
    node_count : int
        Desired number of nodes.
    node_labels : (n,) int
        Label of each node: a node is moved only onto nodes with the same label. Use one label for
        each combination of node sets, such as grasps, that the coarse mesh must have too.
    cell_groups : (E,) int
        Group of each element, from 0, such as its region; interfaces of groups are preserved as the
        surface is.

    Raises
    ------
    InputError
        If the coarse mesh is invalid.
    """
    lengths_m = np.linalg.norm(np.diff(mesh.points_m[mesh.edges], axis=1), axis=2)
    ratio = len(mesh.points_m) / max(node_count, 4)
    coarse_edge_m = float(lengths_m.mean()) * ratio ** (1 / 3)
    state = _CollapseState(mesh, node_labels, cell_groups, coarse_edge_m)
    for _ in range(MOST_ROUNDS):
        excess = state.node_count - node_count
        if excess <= 0:
            break
        removed = state.collapse_round(at_most=excess)
        if removed <= 2e-3 * state.node_count:
            break
    return state.result(mesh)


class _CollapseState:
    """Mesh during its coarsening.

    Attributes
    ----------
    points : (n, 3)
        Positions of all nodes of the given mesh, relative to their mean [m].
    cells : (E, 4) int
        Present elements.
    sources : (E,) int
        Index of each present element in the given mesh.
    moved_to : (n,) int
        Node onto which each node was moved; the node itself if it is present.
    node_count : int
        Number of present nodes.
    """

    def __init__(
        self, mesh: TetMesh, node_labels: Index, cell_groups: Index, coarse_edge_m: float
    ) -> None:
        self.points = mesh.points_m - mesh.points_m.mean(axis=0)
        self.cells = np.array(mesh.tetrahedra)
        self.sources = np.arange(len(self.cells))
        self.moved_to = np.arange(len(self.points))
        self.node_count = len(self.points)
        self.labels = node_labels
        self.groups = cell_groups
        self.coarse_edge_m = coarse_edge_m
        self._set_quadrics()

    def collapse_round(self, at_most: int) -> int:
        pairs = self._candidates()
        if not len(pairs):
            return 0
        cost = self._costs(*pairs.T)
        is_valid = np.isfinite(cost)
        pairs = pairs[is_valid][np.argsort(cost[is_valid], kind="stable")]
        _, first = np.unique(pairs[:, 0], return_index=True)
        pairs = pairs[np.sort(first)]
        chosen = self._independent(pairs[:, 0])[:at_most]
        self._apply(*pairs[chosen].T)
        return len(chosen)

    def result(self, mesh: TetMesh) -> CoarseMesh:
        kept = np.unique(self.cells)
        coarse_index = np.full(len(self.points), -1)
        coarse_index[kept] = np.arange(len(kept))
        return CoarseMesh(
            TetMesh(mesh.points_m[kept], coarse_index[self.cells], is_generated=mesh.is_generated),
            kept_nodes=kept,
            coarse_nodes=coarse_index[self.moved_to],
            source_cells=self.sources,
        )

    def _faces(self) -> Index:
        """Return the triangles (F, 3) between groups and on the boundary, corners sorted."""
        groups = self.groups[self.sources]
        faces = [boundary_of(self.cells[groups == group])[0] for group in np.unique(groups)]
        return np.unique(np.sort(np.concatenate(faces), axis=1), axis=0)

    def _set_quadrics(self) -> None:
        """Set area-weighted quadrics (n, 4, 4) of the boundary planes and the areas (n,)."""
        faces = self._faces()
        a, b, c = np.moveaxis(self.points[faces], 1, 0)
        normals = np.cross(b - a, c - a) / 2
        areas = np.linalg.norm(normals, axis=1)
        normals = normals / areas[:, None]
        planes = np.column_stack([normals, -(normals * a).sum(axis=1)])
        each = areas[:, None, None] * planes[:, :, None] * planes[:, None]
        self.quadrics = np.zeros((len(self.points), 4, 4))
        self.areas = np.zeros(len(self.points))
        for corner in faces.T:
            np.add.at(self.quadrics, corner, each)
            np.add.at(self.areas, corner, areas)

    def _candidates(self) -> Index:
        """Return pairs (k, 2): removed nodes, and their nearest neighbours that are kept."""
        n = len(self.points)
        edges = unique_edges(self.cells)
        faces = self._faces()
        on_surface = np.zeros(n, dtype=bool)
        on_surface[faces] = True
        pairs = np.concatenate([edges, edges[:, ::-1]])
        removed, kept = pairs.T
        lengths = np.linalg.norm(self.points[removed] - self.points[kept], axis=1)
        is_allowed = (
            (self.labels[removed] == self.labels[kept])
            & (lengths <= LONGEST_EDGE * self.coarse_edge_m)
            & (~on_surface[removed] | np.tile(_is_smooth(edges, faces, n), 2))
            & self._stays_in_groups(removed, kept)
        )
        pairs = pairs[is_allowed]
        lengths = lengths[is_allowed]
        is_near_surface = (
            self._surface_distances(*pairs.T) <= SURFACE_TOLERANCE * self.coarse_edge_m
        )
        pairs = pairs[is_near_surface]
        order = np.lexsort((lengths[is_near_surface], pairs[:, 0]))
        pairs = pairs[order]
        rank = np.arange(len(pairs)) - np.searchsorted(pairs[:, 0], pairs[:, 0])
        return pairs[rank < NEIGHBOURS]

    def _stays_in_groups(self, removed: Index, kept: Index) -> NDArray[np.bool_]:
        """Return whether each kept node (k,) has elements of all groups of the removed one."""
        groups = self.groups[self.sources]
        in_group = np.zeros((len(self.points), int(groups.max()) + 1), bool)
        in_group[self.cells, groups[:, None]] = True
        outside = in_group[removed] & ~in_group[kept]
        return np.asarray(~outside.any(axis=1))

    def _surface_distances(self, removed: Index, kept: Index) -> Array:
        """RMS distances (k,) [m] of kept nodes from the planes at the removed ones."""
        at = np.column_stack([self.points[kept], np.ones(len(kept))])
        squares = np.einsum("ki,kij,kj->k", at, self.quadrics[removed], at)
        areas = self.areas[removed]
        mean = np.divide(squares, areas, out=np.zeros_like(squares), where=areas > 0)
        return np.sqrt(np.maximum(mean, 0.0))

    def _costs(self, removed: Index, kept: Index) -> Array:
        """Return minus the smallest quality (k,) of the new elements; infinite if inadmissible."""
        incidence = self._incidence()
        starts = incidence.indptr[removed]
        counts = incidence.indptr[removed + 1] - starts
        of_collapse = np.repeat(np.arange(len(counts)), counts)
        offsets = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        elements = incidence.indices[np.repeat(starts, counts) + offsets]
        corners = self.cells[elements]
        removed = removed[of_collapse, None]
        kept = kept[of_collapse, None]
        stays = ~(corners == kept).any(axis=1)
        of_collapse = of_collapse[stays]
        before = corners[stays]
        after = np.where(before == removed[stays], kept[stays], before)
        limit = np.full(len(counts), LEAST_QUALITY)
        own_quality = mean_ratios(self.points, self.cells)
        np.minimum.at(limit, of_collapse, own_quality[elements[stays]])
        quality = np.full(len(counts), np.inf)
        np.minimum.at(quality, of_collapse, self._qualities(after))
        return np.where((quality >= limit) & np.isfinite(quality), -quality, np.inf)

    def _qualities(self, cells: Index) -> Array:
        """Return `mean_ratios` (k,); −1 for inverted, flat or too long elements."""
        volumes = signed_volumes(self.points, cells)
        is_valid = volumes > 1e-6 * self.coarse_edge_m**3
        lengths = edge_lengths(self.points, cells[is_valid])
        ratios = 12 * (3 * volumes[is_valid]) ** (2 / 3)
        ratios /= (lengths**2).sum(axis=1)
        is_long = lengths.max(axis=1) > LONGEST_NEW_EDGE * self.coarse_edge_m
        quality = np.full(len(cells), -1.0)
        quality[is_valid] = np.where(is_long, -1.0, ratios)
        return quality

    def _incidence(self) -> sp.csr_array:
        """Return the sparse matrix (n, E) whose row of a node names its elements."""
        places = (self.cells.ravel(), np.repeat(np.arange(len(self.cells)), 4))
        shape = (len(self.points), len(self.cells))
        return sp.csr_array((np.ones(self.cells.size), places), shape=shape)

    def _independent(self, removed: Index) -> Index:
        """Return indices of nodes of which no two share an element, earlier ones first."""
        rank = np.full(len(self.points), len(removed))
        rank[removed] = np.arange(len(removed))
        chosen: list[Index] = []
        for _ in range(3):
            best = np.full(len(self.points), len(removed))
            lowest = rank[self.cells].min(axis=1)
            for corner in self.cells.T:
                np.minimum.at(best, corner, lowest)
            is_best = (best == rank) & (rank < len(removed))
            chosen.append(rank[is_best])
            blocked = self.cells[is_best[self.cells].any(axis=1)]
            rank[blocked] = len(removed)
        return np.sort(np.concatenate(chosen))

    def _apply(self, removed: Index, kept: Index) -> None:
        """Do collapses whose removed nodes share no element, in place."""
        target = np.arange(len(self.points))
        target[removed] = kept
        np.add.at(self.quadrics, kept, self.quadrics[removed])
        np.add.at(self.areas, kept, self.areas[removed])
        cells = target[self.cells]
        repeated = np.diff(np.sort(cells, axis=1), axis=1) == 0
        remains = ~repeated.any(axis=1)
        self.cells = cells[remains]
        self.sources = self.sources[remains]
        self.moved_to = target[self.moved_to]
        self.node_count -= len(removed)


def _is_smooth(edges: Index, faces: Index, n: int) -> NDArray[np.bool_]:
    """Return whether edges (m, 2) of a surface (F, 3) collapse without folds (link condition):"""
    # both ends have no other common neighbours on the surface than the third corners of the
    # triangles at the edge.
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [0, 2]], faces[:, 1:]])
    codes, triangles = np.unique(sides @ [n, 1], return_counts=True)
    own = edges @ [n, 1]
    place = np.minimum(np.searchsorted(codes, own), len(codes) - 1)
    is_side = codes[place] == own
    first, second = np.divmod(codes, n)
    pairs = (np.append(first, second), np.append(second, first))
    adjacency = sp.csr_array((np.ones(2 * len(codes)), pairs), shape=(n, n))
    common = sp.csr_array(adjacency @ adjacency)
    shared = np.asarray(common[edges[:, 0], edges[:, 1]]).ravel()
    return is_side & (shared <= triangles[place])
