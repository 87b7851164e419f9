"""The tetrahedral mesh: read, cleaned, checked and measured once, then never changed."""

from __future__ import annotations

import contextlib
import hashlib
import io
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ..errors import InputError

if TYPE_CHECKING:
    from .selection import Selection

LENGTH_UNITS_M = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}

# Volume over mean edge length cubed; 0.118 for the regular tetrahedron. Below this a
# single-precision file cannot tell the element from a flat one.
DEGENERATE_RATIO = 1e-6

_EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
_OUTWARD_FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
_SOLID_CELLS = ("tetra", "hexahedron", "wedge", "pyramid", "polyhedron")


@dataclass(frozen=True)
class MeshQuality:
    """Size and shape of a mesh's elements.

    The quality of an element is its mean ratio 12 (3V)^(2/3) / Σ l² over its six edges: 1 for
    the regular tetrahedron, towards 0 the flatter it gets.
    """

    nodes: int
    elements: int
    volume_m3: float
    edge_min_m: float
    edge_mean_m: float
    edge_max_m: float
    quality_min: float
    quality_median: float
    worst_element: int

    def describe(self) -> str:
        """Return the numbers as a sentence."""
        low, mean, high = (1e3 * x for x in (self.edge_min_m, self.edge_mean_m, self.edge_max_m))
        return (
            f"{self.nodes} nodes, {self.elements} tetrahedra, {self.volume_m3:.4g} m³; "
            f"edges {low:.3g} to {high:.3g} mm (mean {mean:.3g} mm); "
            f"mean-ratio quality {self.quality_min:.2f} at worst (element {self.worst_element}), "
            f"{self.quality_median:.2f} in the median."
        )


@dataclass(frozen=True, eq=False)
class TetMesh:
    """A mesh of linear tetrahedra in metres; its arrays are read-only.

    The constructor drops nodes that no element uses and reverses negatively oriented elements,
    and says so in `notes`. The order of the nodes and of the elements is kept.

    Parameters
    ----------
    points_m : (n, 3) array
        Node positions in metres.
    tetrahedra : (E, 4) integer array
        Nodes of each element, counted from 0.
    point_arrays : mapping of name to (n, ...) array, optional
        Values per node, such as the 0/1 masks that a `Named` selection looks up.

    Attributes
    ----------
    file_index : (n,) int64
        The number each node had before unused ones were dropped; increasing.
    file_node_count : int
        How many nodes there were before unused ones were dropped.
    notes : tuple of str
        What was cleaned and what looks suspicious, in sentences.

    Raises
    ------
    InputError
        For wrong shapes, indices out of range, coordinates that are not finite, and elements
        that are degenerate or given twice.
    """

    points_m: np.ndarray
    tetrahedra: np.ndarray
    point_arrays: dict[str, np.ndarray]
    file_index: np.ndarray
    file_node_count: int
    notes: tuple[str, ...]

    def __init__(
        self,
        points_m: ArrayLike,
        tetrahedra: ArrayLike,
        point_arrays: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        points = _checked_points(points_m)
        elements = _checked_tetrahedra(tetrahedra, len(points))
        arrays = _checked_point_arrays(point_arrays or {}, len(points))
        used, renumbered = np.unique(elements, return_inverse=True)
        _refuse_non_finite(points, used)
        _refuse_duplicates(elements)
        _refuse_degenerate(points, elements)
        kept = points[used]
        oriented, reversed_elements = orient(kept, renumbered.reshape(-1, 4))
        notes = (
            *_note_dropped(len(points), used),
            *_note_reversed(len(reversed_elements), len(elements)),
            *_note_parts(kept, oriented),
        )
        self._set(
            points_m=_read_only(kept),
            tetrahedra=_read_only(oriented),
            point_arrays={name: _read_only(values[used]) for name, values in arrays.items()},
            file_index=_read_only(used),
            file_node_count=len(points),
            notes=notes,
        )

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        return f"TetMesh({len(self.points_m)} nodes, {len(self.tetrahedra)} tetrahedra)"

    @classmethod
    def read(cls, path: str | Path, length_unit: str = "m") -> TetMesh:
        """Read the tetrahedra of any file meshio knows; other cells are left out and noted.

        Point arrays of the file, and its point sets as boolean arrays, become `point_arrays`.

        Parameters
        ----------
        path : str or Path
        length_unit : {"m", "cm", "mm", "um", "in"}
            The unit of the file's coordinates.

        Raises
        ------
        InputError
            If the file cannot be read, holds no linear tetrahedra, or its mesh is refused.
        """
        metres = length_in_metres(length_unit)
        data = read_meshio(path)
        counts = cell_counts(data)
        blocks = [block.data for block in data.cells if block.type == "tetra" and len(block.data)]
        if not blocks:
            raise InputError(_explain_no_tetrahedra(counts), path)
        arrays = {**_point_sets(data), **data.point_data}
        try:
            mesh = cls(_checked_points(data.points) * metres, np.concatenate(blocks), arrays)
        except InputError as error:
            raise error.located(path) from None
        mesh._set(notes=(*_note_left_out(counts), *mesh.notes))
        return mesh

    @classmethod
    def from_surface(
        cls,
        surface: str | Path | tuple[ArrayLike, ArrayLike],
        edge_length_m: float,
        length_unit: str = "m",
        cache: str | Path | None = None,
    ) -> TetMesh:
        """Tetrahedralise a closed surface: a file, or (points, triangles) in `length_unit`.

        See `meshing.mesh_surface_file` and `meshing.tetrahedralize_surface`; `cache` is a folder.
        """
        from . import meshing  # it builds on this module

        if isinstance(surface, (str, Path)):
            return meshing.mesh_surface_file(surface, edge_length_m, length_unit, cache)
        points = _checked_points(surface[0]) * length_in_metres(length_unit)
        return meshing.tetrahedralize_surface(points, surface[1], edge_length_m, cache)

    def write(self, path: str | Path) -> None:
        """Write the mesh, in metres, to any format meshio knows by the file's ending."""
        import meshio

        # Few formats have a boolean type.
        arrays: dict[str, ArrayLike] = {
            name: values.astype(np.uint8) if values.dtype == bool else values
            for name, values in self.point_arrays.items()
        }
        mesh = meshio.Mesh(self.points_m, [("tetra", self.tetrahedra)], point_data=arrays)
        with _meshio_failures(path, "written"):
            meshio.write(path, mesh)

    def select(self, selection: Selection) -> np.ndarray:
        """Return the nodes of a `selection.Selection`, as sorted int64 indices."""
        return selection.resolve(self)

    @cached_property
    def volumes_m3(self) -> np.ndarray:
        """Volume of each element, (E,), all positive."""
        return _read_only(signed_volumes(self.points_m, self.tetrahedra))

    @property
    def volume_m3(self) -> float:
        """Volume of the whole mesh."""
        return float(self.volumes_m3.sum())

    @property
    def bounds_m(self) -> np.ndarray:
        """Lowest and highest coordinates, (2, 3)."""
        return np.array([self.points_m.min(axis=0), self.points_m.max(axis=0)])

    @cached_property
    def surface(self) -> np.ndarray:
        """Boundary triangles, (F, 3) int64, counter-clockwise when seen from outside."""
        faces = self.tetrahedra[:, _OUTWARD_FACES].reshape(-1, 3)
        _, first, count = np.unique(
            np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
        )
        return _read_only(faces[np.sort(first[count == 1])])

    @cached_property
    def edges(self) -> np.ndarray:
        """Pairs of nodes that share an element, (m, 2) int64, each once, sorted."""
        return _read_only(_unique_edges(self.tetrahedra))

    @cached_property
    def sha256(self) -> str:
        """Hash of the points and tetrahedra, as 64 hexadecimal digits."""
        digest = hashlib.sha256(f"{self.points_m.shape} {self.tetrahedra.shape}".encode())
        digest.update(self.points_m.astype("<f8").tobytes())
        digest.update(self.tetrahedra.astype("<i8").tobytes())
        return digest.hexdigest()

    def quality(self) -> MeshQuality:
        """Measure the elements."""
        squared = (_edge_lengths(self.points_m, self.tetrahedra) ** 2).sum(axis=1)
        quality = 12 * (3 * self.volumes_m3) ** (2 / 3) / squared
        lengths = np.linalg.norm(np.diff(self.points_m[self.edges], axis=1), axis=2)
        return MeshQuality(
            nodes=len(self.points_m),
            elements=len(self.tetrahedra),
            volume_m3=self.volume_m3,
            edge_min_m=float(lengths.min()),
            edge_mean_m=float(lengths.mean()),
            edge_max_m=float(lengths.max()),
            quality_min=float(quality.min()),
            quality_median=float(np.median(quality)),
            worst_element=int(quality.argmin()),
        )


def length_in_metres(length_unit: str) -> float:
    """Return the length of one "m", "cm", "mm", "um" or "in" in metres."""
    if length_unit not in LENGTH_UNITS_M:
        known = ", ".join(f'"{unit}"' for unit in LENGTH_UNITS_M)
        raise InputError(f"length unit {length_unit!r} is unknown; use one of {known}")
    return LENGTH_UNITS_M[length_unit]


def signed_volumes(points_m: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Volume of each tetrahedron, (E,) m³; positive if (x₁−x₀, x₂−x₀, x₃−x₀) is right-handed."""
    corner = points_m[tetrahedra]
    a, b, c = (corner[:, i] - corner[:, 0] for i in (1, 2, 3))
    return np.einsum("ei,ei->e", np.cross(a, b), c) / 6


def orient(points_m: np.ndarray, tetrahedra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the tetrahedra with positive volumes, and the indices of those that were reversed."""
    reversed_elements = np.flatnonzero(signed_volumes(points_m, tetrahedra) < 0)
    oriented = tetrahedra.copy()
    oriented[reversed_elements, 2:] = tetrahedra[reversed_elements, :1:-1]
    return oriented, reversed_elements


def read_meshio(path: str | Path) -> Any:
    """Read a file into a `meshio.Mesh`.

    Raises
    ------
    InputError
        If there is no such file, or meshio cannot read it.
    """
    import meshio

    if not Path(path).is_file():
        raise InputError("there is no such file", path)
    with _meshio_failures(path, "read"):
        return meshio.read(path)


def cell_counts(data: Any) -> dict[str, int]:
    """Count the cells of a `meshio.Mesh` by type."""
    counts: dict[str, int] = {}
    for block in data.cells:
        counts[block.type] = counts.get(block.type, 0) + len(block.data)
    return counts


@contextlib.contextmanager
def _meshio_failures(path: str | Path, done: str):
    """Turn whatever meshio does on a bad file into one InputError."""
    # Its readers raise whatever their parsing trips over, print, warn, and may exit.
    said = io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(said),
            contextlib.redirect_stderr(said),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            yield
    except (Exception, SystemExit) as error:
        reason = " ".join(said.getvalue().split()) or f"{type(error).__name__}: {error}"
        raise InputError(
            f"the file cannot be {done} as a mesh ({reason}); formats such as .vtu, .vtk, .msh, "
            ".mesh and .inp are known, told by the file's ending",
            path,
        ) from error


def _read_only(array: np.ndarray) -> np.ndarray:
    array = np.ascontiguousarray(array)
    array.flags.writeable = False
    return array


def _edge_lengths(points: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    ends = points[tetrahedra[:, _EDGES]]
    return np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2)


def _unique_edges(tetrahedra: np.ndarray) -> np.ndarray:
    return np.unique(np.sort(tetrahedra[:, _EDGES].reshape(-1, 2), axis=1), axis=0)


def _checked_points(points_m: ArrayLike) -> np.ndarray:
    try:
        points = np.array(points_m, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError("points_m must be an (n, 3) array of numbers") from None
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points_m must have shape (n, 3), not {points.shape}")
    return points


def _checked_tetrahedra(tetrahedra: ArrayLike, node_count: int) -> np.ndarray:
    try:
        array = np.array(tetrahedra)
    except ValueError:
        raise InputError("tetrahedra must be an (E, 4) array of node numbers") from None
    if array.ndim != 2 or array.shape[1] != 4 or not len(array):
        raise InputError(f"tetrahedra must have shape (E, 4) with E > 0, not {array.shape}")
    if array.dtype.kind not in "iu":
        raise InputError(f"tetrahedra must hold integer node numbers, not {array.dtype}")
    bad = np.flatnonzero(((array < 0) | (array >= node_count)).any(axis=1))
    if len(bad):
        hint = (
            "; they seem to count from 1" if (array.min(), array.max()) == (1, node_count) else ""
        )
        raise InputError(
            f"element {bad[0]} has nodes {array[bad[0]].tolist()}, but there are {node_count} "
            f"nodes, counted from 0{hint} ({len(bad)} such in all)"
        )
    return array.astype(np.int64)


def _checked_point_arrays(
    arrays: Mapping[str, ArrayLike], node_count: int
) -> dict[str, np.ndarray]:
    checked = {name: np.asarray(values) for name, values in arrays.items()}
    for name, values in checked.items():
        if values.ndim == 0 or len(values) != node_count:
            raise InputError(
                f'point array "{name}" has shape {values.shape}; '
                f"its first length must be the number of nodes, {node_count}"
            )
    return checked


def _refuse_non_finite(points: np.ndarray, used: np.ndarray) -> None:
    bad = used[~np.isfinite(points[used]).all(axis=1)]
    if len(bad):
        raise InputError(
            f"node {bad[0]} lies at {points[bad[0]].tolist()}: "
            f"coordinates must be finite ({len(bad)} such in all)"
        )


def _refuse_duplicates(tetrahedra: np.ndarray) -> None:
    _, first, inverse = np.unique(
        np.sort(tetrahedra, axis=1), axis=0, return_index=True, return_inverse=True
    )
    twin = first[inverse.ravel()]
    again = np.flatnonzero(twin != np.arange(len(tetrahedra)))
    if len(again):
        raise InputError(
            f"element {again[0]} has the same nodes {tetrahedra[again[0]].tolist()} as element "
            f"{twin[again[0]]}; remove the duplicates ({len(again)} in all)"
        )


def _refuse_degenerate(points: np.ndarray, tetrahedra: np.ndarray) -> None:
    volumes = np.abs(signed_volumes(points, tetrahedra))
    cubes = _edge_lengths(points, tetrahedra).mean(axis=1) ** 3
    bad = np.flatnonzero(volumes <= DEGENERATE_RATIO * cubes)
    if len(bad):
        raise InputError(
            f"element {bad[0]} with nodes {tetrahedra[bad[0]].tolist()} is degenerate: its volume "
            f"is {volumes[bad[0]]:.3g} m³, which must exceed {DEGENERATE_RATIO:g} of its mean edge "
            f"length cubed, {cubes[bad[0]]:.3g} m³ ({len(bad)} such in all); remove it or remesh"
        )


def _note_dropped(node_count: int, used: np.ndarray) -> tuple[str, ...]:
    dropped = np.setdiff1d(np.arange(node_count), used)
    if not len(dropped):
        return ()
    return (
        f"{len(dropped)} of {node_count} nodes were dropped (node {dropped[0]} is the first): "
        "no element uses them.",
    )


def _note_reversed(reversed_count: int, element_count: int) -> tuple[str, ...]:
    if not reversed_count:
        return ()
    return (
        f"{reversed_count} of {element_count} elements had a negative volume and were re-oriented.",
    )


def _note_parts(points: np.ndarray, tetrahedra: np.ndarray) -> tuple[str, ...]:
    edges, n = _unique_edges(tetrahedra), len(points)
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    parts, label = connected_components(graph, directed=False)
    if parts == 1:
        return ()
    sizes = ", ".join(str(size) for size in np.sort(np.bincount(label))[:-6:-1])
    twins = n - len(np.unique(points, axis=0))
    hint = f"; {twins} of {n} nodes lie exactly on others: merge them" if twins else ""
    return (f"The mesh is in {parts} unconnected parts (the largest have {sizes} nodes){hint}.",)


def _note_left_out(counts: dict[str, int]) -> tuple[str, ...]:
    others = {name: count for name, count in counts.items() if name != "tetra" and count}
    if not others:
        return ()
    solid = any(name.startswith(_SOLID_CELLS) for name in others)
    warning = ": that part of the body is missing" if solid else ""
    return (f"Cells other than tetrahedra were left out ({_listed(others)}){warning}.",)


def _explain_no_tetrahedra(counts: dict[str, int]) -> str:
    if "tetra10" in counts:
        return (
            f"found only quadratic tetrahedra ({_listed(counts)}), which are for the quadratic "
            "element and not supported yet; save the mesh with linear tetrahedra"
        )
    found = f"found {_listed(counts)}" if counts else "it has no cells at all"
    surface = "; a closed surface can be filled by TetMesh.from_surface" * ("triangle" in counts)
    return f"no tetrahedra in this file, {found}{surface}"


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def _point_sets(data: Any) -> dict[str, np.ndarray]:
    sets = {}
    for name, nodes in (data.point_sets or {}).items():
        sets[name] = np.zeros(len(data.points), dtype=bool)
        sets[name][np.asarray(nodes, dtype=np.int64)] = True
    return sets
