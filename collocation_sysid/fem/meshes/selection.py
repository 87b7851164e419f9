"""Selections of nodes, cells or boundary faces: by position, index or name.

Use them to state which nodes are grasped, loaded or observed, which cells make up a region, and on
which faces of the boundary a pressure acts. A box or ball contains a cell if it contains its
centre, and a face if it contains its corners.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ...common.checked_arrays import as_array
from ...common.validated_classes import validated
from ...common.validated_types import NotNegative, Positive, Text
from ...errors import InputError, hint_at, require_among
from .mesh import ElementNodes, TetMesh

# Tolerance in diagonals of the body: nodes on a box's face must not be lost by rounding.
ROUND_OFF = 1e-9
OF_CELLS = "cells, by their centres"
FaceName = Literal["top", "bottom", "side_x", "side_y"]


class _PositionSelection:
    def resolve(self, nodes: ElementNodes) -> np.ndarray:
        """Return the sorted indices of the selected nodes, mid nodes included."""
        hint = self._nearest_hint(nodes.points_m)
        mask = self._contains(nodes.points_m)
        _require_whole_sections(mask, nodes.mesh, what=str(self))
        return _indices_or_error(mask, nodes.mesh, what=str(self), of="nodes" + hint)

    def resolve_cells(self, mesh: TetMesh) -> np.ndarray:
        """Return the indices of the cells whose centres are inside, sorted int64."""
        return _indices_or_error(self._contains(mesh.centres_m), mesh, what=str(self), of=OF_CELLS)

    def resolve_faces(self, mesh: TetMesh) -> np.ndarray:
        """Return the rows of `mesh.surface` whose three corners are inside, sorted int64."""
        return _select_faces(self._contains(mesh.points_m), mesh, what=str(self))

    def _contains(self, points_m: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def _nearest_hint(self, points_m: np.ndarray) -> str:
        """Return text that is appended to the message if no point is inside; "" by default."""
        return ""


@dataclass(frozen=True)
class Box(_PositionSelection):
    """Selection of an axis-aligned box, including its faces; bounds may be infinite.

    Parameters
    ----------
    low_m, high_m : three numbers
        Lowest and highest coordinates in metres; stored as tuples of floats.

    Raises
    ------
    InputError
        If a corner is not three numbers, or the low corner is above the high one along an axis.
    """

    low_m: Sequence[float]
    high_m: Sequence[float]

    def __post_init__(self) -> None:
        low = _vector(self.low_m, "box: low_m")
        high = _vector(self.high_m, "box: high_m")
        for axis, below, above in zip("xyz", low, high, strict=True):
            if below > above:
                raise InputError(
                    f"box: its low corner has {axis} = {below:g} m, above {above:g} m of its high "
                    "corner; give the lowest coordinates first, then the highest"
                )
        object.__setattr__(self, "low_m", low)
        object.__setattr__(self, "high_m", high)

    def _contains(self, points_m: np.ndarray) -> np.ndarray:
        slack = _tolerance_m(points_m)
        above = points_m >= np.subtract(self.low_m, slack)
        below = points_m <= np.add(self.high_m, slack)
        return np.all(above & below, axis=1)

    def __str__(self) -> str:
        low, high = (", ".join(f"{x:g}" for x in corner) for corner in (self.low_m, self.high_m))
        return f"the box from ({low}) to ({high}) m"


@validated
@dataclass(frozen=True)
class Ball(_PositionSelection):
    """Selection of a ball, including its surface.

    Parameters
    ----------
    center_m : three numbers
        Centre in metres; stored as a tuple of floats.
    radius_m : float
        Largest distance from the centre in metres.

    Raises
    ------
    InputError
        If the centre is not three numbers, or the radius not a positive number.
    """

    center_m: Sequence[float]
    radius_m: Positive

    def __post_init__(self) -> None:
        object.__setattr__(self, "center_m", _vector(self.center_m, "ball: center_m"))
        if not np.isfinite(self.center_m).all():
            raise InputError(f"ball: center_m is {self.center_m}; expected finite numbers")

    def _nearest_hint(self, points_m: np.ndarray) -> str:
        least_m = self._distance_m(points_m).min()
        return f"; the nearest node is {least_m:.4g} m from its centre"

    def _distance_m(self, points_m: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points_m - np.array(self.center_m), axis=1)

    def _contains(self, points_m: np.ndarray) -> np.ndarray:
        return self._distance_m(points_m) <= self.radius_m + _tolerance_m(points_m)

    def __str__(self) -> str:
        center = ", ".join(f"{x:g}" for x in self.center_m)
        return f"the ball of radius {self.radius_m:g} m about ({center}) m"


@validated
@dataclass(frozen=True)
class Face(_PositionSelection):
    """Selection of the nodes on an end or a plane side of the body, without stating a length.

    Parameters
    ----------
    name : {"top", "bottom", "side_x", "side_y"}
        "top" and "bottom": the nodes with the highest and the lowest z of the body. "side_x" and
        "side_y": those with its lowest x or y, as in a plane of symmetry, that are neither on the
        top nor on the bottom, so that grasps of a side and of an end can be combined. As a
        selection of faces a side includes its edges.

    Raises
    ------
    InputError
        For another name.
    """

    name: FaceName

    def __post_init__(self) -> None:
        require_among(self.name, get_args(FaceName), where="face")

    def resolve(self, nodes: ElementNodes) -> np.ndarray:
        """Sides do not include the nodes of the top and the bottom."""
        points_m = nodes.points_m
        mask = self._contains(points_m)
        if self.name.startswith("side"):
            mask &= ~(Face("top")._contains(points_m) | Face("bottom")._contains(points_m))
        _require_whole_sections(mask, nodes.mesh, what=str(self))
        return _indices_or_error(mask, nodes.mesh, what=str(self))

    def resolve_cells(self, mesh: TetMesh) -> np.ndarray:
        """Raise an `InputError`: a face of the body contains no cells."""
        raise InputError(
            f"{self} selects nodes, and no cells; expected box_m, ball_m, indices or name"
        )

    def _contains(self, points_m: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the points in the plane through the outermost one."""
        axis, sign = {"top": (2, -1), "bottom": (2, 1), "side_x": (0, 1), "side_y": (1, 1)}[
            self.name
        ]
        inwards_m = sign * points_m[:, axis]
        # Nodes of a file in single precision on one plane are this close to it.
        tolerance_m = 1e-6 * float(np.linalg.norm(np.ptp(points_m, axis=0)))
        return np.asarray(inwards_m <= inwards_m.min() + tolerance_m)

    def __str__(self) -> str:
        return f"the face {self.name}"


@validated
@dataclass(frozen=True)
class Along:
    """Selection of the cross-sections of a rod between two arc lengths, or of its cells by their
    middles.

    Parameters
    ----------
    first_m, last_m : float
        Arc lengths from the beginning of the rod [m].
    """

    first_m: NotNegative
    last_m: NotNegative

    def __post_init__(self) -> None:
        if not self.first_m <= self.last_m:
            raise InputError(
                f"found [{self.first_m:g}, {self.last_m:g}]; expected the first arc length, then the "
                "last",
                where="s_m",
            )

    def resolve(self, nodes: ElementNodes) -> np.ndarray:
        """Return the indices of the nodes of all selected sections, sorted."""
        return _indices_or_error(self._contains(nodes.mesh), nodes.mesh, what=str(self))

    def resolve_cells(self, mesh: TetMesh) -> np.ndarray:
        """Return the indices of the cells whose middle is in between, sorted."""
        chosen = self._contains(mesh, cells=mesh.tetrahedra)
        return _indices_or_error(chosen, mesh, what=str(self), of=OF_CELLS)

    def resolve_faces(self, mesh: TetMesh) -> np.ndarray:
        """Return the rows of `mesh.surface` between the selected sections, sorted."""
        return _select_faces(self._contains(mesh), mesh, what=str(self))

    def _contains(self, mesh: TetMesh, cells: np.ndarray | None = None) -> np.ndarray:
        """Return the mask of the nodes (n,), or of cells (E, 4) by their middles."""
        if mesh.arc_lengths_m is None:
            raise InputError(
                "found arc lengths for a body that is not a rod; expected a selection by position, "
                "such as box_m"
            )
        slack = _tolerance_m(mesh.points_m)
        length_m = mesh.arc_lengths_m[-1]
        if self.first_m < -slack or self.last_m > length_m + slack:
            raise InputError(
                f"found [{self.first_m:g}, {self.last_m:g}]; expected arc lengths from 0 to "
                f"{length_m:g} m, the length of the rod"
            )
        s_m = mesh.arc_lengths_m
        if cells is not None:
            s_m = (s_m[cells].min(axis=1) + s_m[cells].max(axis=1)) / 2
        return np.asarray((s_m >= self.first_m - slack) & (s_m <= self.last_m + slack))

    def __str__(self) -> str:
        return f"the part of the rod from {self.first_m:g} to {self.last_m:g} m"


@dataclass(frozen=True)
class Indices:
    """Selection of nodes or cells by index, counted from 0, as in the mesh file or the given array.

    Indices of nodes differ from the rows of `mesh.points_m` if nodes were dropped. Only corners can
    be given: a node on an edge is selected if both ends of the edge are.

    Parameters
    ----------
    indices : sequence of int
        In any order, with repetitions; stored as a tuple. Their range is checked when they are
        resolved.

    Raises
    ------
    InputError
        If they are not a list of integers.
    """

    indices: Sequence[int]

    def __post_init__(self) -> None:
        indices = np.atleast_1d(as_array(self.indices, "indices"))
        if indices.ndim != 1 or (indices.size and indices.dtype.kind not in "iu"):
            raise InputError(
                f"indices must be a list of whole numbers from 0, not {self.indices!r}"
            )
        object.__setattr__(self, "indices", tuple(indices.tolist()))

    def resolve(self, nodes: ElementNodes) -> np.ndarray:
        """Return the selected nodes as sorted int64 indices into `nodes.points_m`; a mid node is
        selected if both ends of its edge are.

        Raises
        ------
        InputError
            If there is no index, or one is not that of a node of the file, or that of a node that
            is not the corner of an element.
        """
        mesh = nodes.mesh
        requested = np.unique(np.array(self.indices, dtype=np.int64))
        outside = requested[(requested < 0) | (requested >= mesh.file_node_count)]
        if len(outside):
            raise InputError(
                f"indices: node {outside[0]} does not exist; the mesh has "
                f"{mesh.file_node_count} nodes, numbered 0 to {mesh.file_node_count - 1}"
            )
        dropped = np.setdiff1d(requested, mesh.file_index)
        if len(dropped):
            raise InputError(
                f"indices: node {dropped[0]} was dropped from the mesh because it is not the "
                "corner of an element; leave it out (a node on an edge is selected when both of "
                "its ends are)"
            )
        chosen = nodes.with_mid_nodes(np.isin(mesh.file_index, requested))
        return _indices_or_error(chosen, mesh, what="an empty list of indices")

    def resolve_cells(self, mesh: TetMesh) -> np.ndarray:
        """Return the indices of the selected cells, sorted and without duplicates.

        Raises
        ------
        InputError
            If an index is not that of a cell, or no cell is selected.
        """
        count = len(mesh.tetrahedra)
        outside = [index for index in self.indices if not 0 <= index < count]
        if outside:
            raise InputError(
                f"indices: cell {outside[0]} does not exist; the mesh has {count} tetrahedra, "
                f"numbered 0 to {count - 1}"
            )
        chosen = np.isin(np.arange(count), self.indices)
        return _indices_or_error(chosen, mesh, what="an empty list of indices", of=OF_CELLS)

    def resolve_faces(self, mesh: TetMesh) -> np.ndarray:
        """Return the rows of `mesh.surface` whose corners are all selected, sorted.

        Raises
        ------
        InputError
            If an index is not that of a node, or no face of the boundary has all its corners
            selected.
        """
        nodes = self.resolve(ElementNodes.corners(mesh))
        chosen = np.isin(np.arange(len(mesh.points_m)), nodes)
        return _select_faces(chosen, mesh, what="the list of indices")


@validated
@dataclass(frozen=True)
class Named:
    """Selection by a point array of the mesh, or for cells a cell array, of booleans or 0 and 1.

    A node on an edge is selected if both ends of the edge are. A physical group of a .msh file
    selects the nodes of its elements, whether points, lines, triangles or tetrahedra, and a group
    of tetrahedra selects cells.

    Parameters
    ----------
    name : str
        Name of the array or group.
    """

    name: Text

    def resolve(self, nodes: ElementNodes) -> np.ndarray:
        """Return the selected nodes as sorted int64 indices into `nodes.points_m`; a mid node is
        selected if both ends of its edge are.

        Raises
        ------
        InputError
            If the mesh has no point array of this name, its values are not booleans or 0 and 1, or
            none is true.
        """
        what = f'point array "{self.name}"'
        mask = self._mask(nodes.mesh.point_arrays, len(nodes.mesh.points_m), what=what)
        return _indices_or_error(nodes.with_mid_nodes(mask), nodes.mesh, what=what)

    def resolve_cells(self, mesh: TetMesh) -> np.ndarray:
        """Return the indices of the cells whose value in the cell array is 1, sorted.

        Raises
        ------
        InputError
            If the mesh has no cell array of this name, its values are not booleans or 0 and 1, or
            none is true.
        """
        what = f'cell array "{self.name}"'
        mask = self._mask(mesh.cell_arrays, len(mesh.tetrahedra), what=what)
        return _indices_or_error(mask, mesh, what=what, of=OF_CELLS)

    def resolve_faces(self, mesh: TetMesh) -> np.ndarray:
        """Return the selected rows of `mesh.surface`, sorted.

        They are the triangles of a face set, or those whose corners are all in a point array.

        Raises
        ------
        InputError
            If the mesh has neither of this name, no face is selected, or a face is not on the
            boundary.
        """
        if self.name not in mesh.face_sets:
            what = f'point array "{self.name}"'
            count = len(mesh.points_m)
            mask = self._mask(mesh.point_arrays, count, what=what, lacking="group of faces")
            return _select_faces(mask, mesh, what=what)
        faces = np.unique(np.sort(mesh.face_sets[self.name], axis=1), axis=0)
        rows = rows_of_faces(faces, mesh.surface)
        if inner := int((rows < 0).sum()):
            raise InputError(
                f'{inner} of the {len(rows)} faces of "{self.name}" are not on the boundary of the '
                "body; expected faces that have the material on one side only"
            )
        return np.sort(rows)

    def _mask(
        self, arrays: Mapping[str, np.ndarray], count: int, what: str, lacking: str = ""
    ) -> np.ndarray:
        kind = what.split(" ", 1)[0]
        if self.name not in arrays:
            names = ", ".join(f'"{name}"' for name in arrays if not name.startswith("gmsh:"))
            available = f"it has {names}" if names else "it has none"
            hint = hint_at(self.name, arrays)
            raise InputError(
                f'the mesh has no {lacking or f"{kind} array or group"} "{self.name}"; '
                f"{available}{hint}"
            )
        values = arrays[self.name]
        if values.size != count:
            each = {"point": "node", "cell": "cell"}[kind]
            raise InputError(
                f"{what} has {values.size // count} values per {each}; expected one value per {each} in a "
                "selection, 0 or 1"
            )
        values = values.ravel()
        odd = values[~np.isin(values, (0, 1))]
        if len(odd):
            raise InputError(
                f"{what} contains the value {odd[0]}; expected only 0 and 1 in a selection"
            )
        return values.astype(bool)


Selection = Along | Box | Ball | Face | Indices | Named


def rows_of_faces(faces: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Return for each of the faces (k, 3) the row of the surface (F, 3) with the same three nodes
    in any order, (k,); −1 if there is none.
    """
    row_of_face = {tuple(face): row for row, face in enumerate(np.sort(surface, axis=1).tolist())}
    sorted_faces = np.sort(faces, axis=1).tolist()
    return np.array([row_of_face.get(tuple(face), -1) for face in sorted_faces], dtype=np.int64)


def _select_faces(chosen_nodes: np.ndarray, mesh: TetMesh, what: str) -> np.ndarray:
    """Return the rows of `mesh.surface` whose corners are all in the mask `chosen_nodes` (n,)."""
    mask = np.asarray(chosen_nodes[mesh.surface].all(axis=1))
    return _indices_or_error(
        mask, mesh, what=what, missed="holds no face of the boundary with all its corners"
    )


def _indices_or_error(
    mask: np.ndarray, mesh: TetMesh, what: str, of: str = "nodes", missed: str = ""
) -> np.ndarray:
    if not mask.any():  # no mid node lies beyond the corners
        missed = missed or f"selects none of the {len(mask)} {of}"
        raise InputError(f"{what} {missed}; the body spans {_describe_bounds(mesh.bounds_m)}")
    return np.flatnonzero(mask).astype(np.int64)


def _require_whole_sections(mask: np.ndarray, mesh: TetMesh, what: str) -> None:
    """Raise an `InputError` if a mask of nodes cuts a cross-section of a rod."""
    if mesh.arc_lengths_m is None:
        return
    s_m, section = np.unique(mesh.arc_lengths_m, return_inverse=True)
    count = np.bincount(section, weights=mask)
    cut = np.flatnonzero((count > 0) & (count < np.bincount(section)))
    if len(cut):
        raise InputError(
            f"{what} has only some nodes of the rod's section at {s_m[cut[0]]:.4g} m; expected whole "
            "sections, such as s_m = [first, last]"
        )


def _describe_bounds(bounds_m: np.ndarray) -> str:
    axes = zip("xyz", *bounds_m, strict=True)
    return ", ".join(f"{axis} from {low:.4g} to {high:.4g} m" for axis, low, high in axes)


def _tolerance_m(points_m: np.ndarray) -> float:
    """Return the tolerance for rounding [m]: a fraction of the diagonal of points (n, 3)."""
    return ROUND_OFF * float(np.linalg.norm(np.ptp(points_m, axis=0)))


def _is_number(value: object) -> bool:
    is_real = isinstance(value, (int, float, np.integer, np.floating))
    return is_real and not isinstance(value, bool)


def _vector(values: Iterable[float], what: str) -> tuple[float, float, float]:
    components = (
        list(values) if isinstance(values, Iterable) and not isinstance(values, str) else []
    )
    if len(components) != 3 or not all(_is_number(x) and not np.isnan(x) for x in components):
        raise InputError(f"{what} must be three numbers [x, y, z] in metres, not {values!r}")
    x, y, z = (float(value) for value in components)
    return x, y, z
