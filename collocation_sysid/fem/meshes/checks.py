"""Checks of tetrahedral meshes given as arrays: validation, cleaning and quality.

`mesh.TetMesh` applies these functions to every mesh.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ...common.checked_arrays import float_array
from ...errors import InputError
from ..elements import EDGES

# Faces of a tetrahedron, counter-clockwise as seen from outside.
OUTWARD_FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])

# Volume over mean edge length cubed; 0.118 for the regular tetrahedron. Below this a
# single-precision file cannot tell the element from a flat one.
DEGENERATE_RATIO = 1e-6

# Largest accepted coordinate [m]: larger than any body, while volumes do not overflow.
LARGEST_M = 1e50

# Largest offset of a mid node from the middle of its edge, in edge lengths, that is rounding of a
# file in single precision.
ROUND_OFF = 1e-5
# Largest offset, in edge lengths, of sides that are straightened with a note.
LARGEST_SIDE_CURVATURE = 0.05


def checked_points(points_m: ArrayLike) -> np.ndarray:
    """Return a float64 copy of (n, 3) coordinates; NaN is allowed.

    Raises
    ------
    InputError
        If the values are not numbers, of another shape, or beyond `LARGEST_M`.
    """
    points = float_array(points_m, "points_m", (None, 3), finite=False)
    if (np.abs(points) > LARGEST_M).any():
        raise InputError(
            f"a node lies {np.nanmax(np.abs(points)):.3g} m away from the origin; expected at most "
            f"{LARGEST_M:g} m: check the file and its unit of length"
        )
    return points


def checked_tetrahedra(tetrahedra: ArrayLike, node_count: int) -> np.ndarray:
    """Return an int64 copy of (E, 4) node indices.

    Raises
    ------
    InputError
        If the array has another shape, no rows, no integers, or indices outside 0 … `node_count` −
        1.
    """
    try:
        array = np.array(tetrahedra)
    except ValueError:
        raise InputError(
            "tetrahedra have rows of different lengths; expected an (E, 4) array of node indices "
            "from 0"
        ) from None
    if array.ndim != 2 or array.shape[1] != 4 or not len(array):
        raise InputError(f"tetrahedra must have shape (E, 4) with E > 0, not {array.shape}")
    if array.dtype.kind not in "iu":
        raise InputError(f"tetrahedra must hold integer node indices from 0, not {array.dtype}")
    require_known_nodes(array, node_count)
    return array.astype(np.int64)


def checked_faces(faces: ArrayLike, node_count: int) -> np.ndarray:
    """Return an int64 copy of (k, 3) node indices.

    Raises
    ------
    InputError
        If the array has another shape, no integers, or indices outside 0 … `node_count` − 1.
    """
    array = np.array(faces)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "iu":
        raise InputError(
            f"a face set must be a (k, 3) array of node indices from 0, "
            f"not {array.dtype} {array.shape}"
        )
    require_known_nodes(array, node_count)
    return array.astype(np.int64)


def require_known_nodes(cells: np.ndarray, node_count: int) -> None:
    """Raise an `InputError` if cells (E, k) have node indices outside 0 … `node_count` − 1; the
    message says if they seem to count from 1.
    """
    bad = np.flatnonzero(((cells < 0) | (cells >= node_count)).any(axis=1))
    if len(bad):
        hint = (
            "; the indices seem to count from 1: subtract 1"
            if (cells.min(), cells.max()) == (1, node_count)
            else ""
        )
        raise InputError(
            f"element {bad[0]} has nodes {cells[bad[0]].tolist()}; expected indices from 0 to "
            f"{node_count - 1} of the {node_count} nodes{hint} (number of such elements: {len(bad)})"
        )


def checked_arrays(
    arrays: Mapping[str, ArrayLike], count: int, kind: str, of: str
) -> dict[str, np.ndarray]:
    """Return named arrays whose first length is `count`, or raise an `InputError`.

    Parameters
    ----------
    kind : str
        "point" or "cell", for the message.
    of : str
        What is counted, for the message.
    """
    checked = {name: np.asarray(values) for name, values in arrays.items()}
    for name, values in checked.items():
        if values.ndim == 0 or len(values) != count:
            raise InputError(
                f'{kind} array "{name}" has shape {values.shape}; '
                f"its first length must be the number of {of}, {count}"
            )
    return checked


def clean_mesh(
    points_m: np.ndarray, tetrahedra: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[str, ...]]:
    """Drop nodes that are no element's corner and reverse negatively oriented elements.

    Orders are kept; the arguments are not changed. Return node positions (n', 3) [m], nodes (E, 4) of
    each element, the index (n',) that each node had before, and sentences about what was cleaned and
    what looks suspicious.

    Parameters
    ----------
    points_m : (n, 3)
        Node positions [m].
    tetrahedra : (E, 4) int
        Nodes of each element, in the range of `points_m`.

    Raises
    ------
    InputError
        For coordinates that are not finite, and elements that are degenerate or given twice.
    """
    used, renumbered = np.unique(tetrahedra, return_inverse=True)
    _require_finite(points_m, used)
    _require_no_duplicates(tetrahedra)
    _require_not_degenerate(points_m, tetrahedra)
    used_points = points_m[used]
    oriented, reversed_elements = orient_elements(used_points, renumbered.reshape(-1, 4))
    notes = []
    dropped = np.setdiff1d(np.arange(len(points_m)), used)
    if len(dropped):
        notes.append(
            f"{len(dropped)} of {len(points_m)} nodes were dropped (the first is node "
            f"{dropped[0]}), because no tetrahedron has them as a corner."
        )
    if len(reversed_elements):
        notes.append(
            f"{len(reversed_elements)} of {len(oriented)} elements had a negative volume and were "
            "re-oriented, which is harmless."
        )
    _, parts = connected_parts(used_points, oriented)
    notes += (f"The mesh {parts}.",) if parts else ()
    return used_points, oriented, used, tuple(notes)


def orient_elements(points_m: np.ndarray, tetrahedra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a copy of the tetrahedra (E, 4) in which no volume is negative, and the indices of
    those whose last two nodes were exchanged for it.
    """
    reversed_elements = np.flatnonzero(signed_volumes(points_m, tetrahedra) < 0)
    oriented = tetrahedra.copy()
    oriented[reversed_elements, 2:] = tetrahedra[reversed_elements, :1:-1]
    return oriented, reversed_elements


def signed_volumes(points_m: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return the volume of each tetrahedron (E,) [m³], from points (n, 3) [m] and nodes (E, 4).

    Positive if x₁−x₀, x₂−x₀, x₃−x₀ is right-handed.
    """
    corner = points_m[tetrahedra]
    a, b, c = (corner[:, i] - corner[:, 0] for i in (1, 2, 3))
    return np.einsum("ei,ei->e", np.cross(a, b), c) / 6


def unique_edges(tetrahedra: np.ndarray) -> np.ndarray:
    """Return the pairs of nodes that share an element, (m, 2), each once, the lower index first,
    sorted.
    """
    return np.unique(np.sort(tetrahedra[:, EDGES].reshape(-1, 2), axis=1), axis=0)


def boundary_of(tetrahedra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the boundary faces (F, 3) of tetrahedra and the index (F,) of the element of each.

    A boundary face belongs to one element only; it is counter-clockwise as seen from outside.
    """
    faces = tetrahedra[:, OUTWARD_FACES].reshape(-1, 3)
    _, first, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    boundary_faces = np.sort(first[count == 1])
    return faces[boundary_faces], boundary_faces // 4


@dataclass(frozen=True)
class MeshQuality:
    """Edge lengths of a mesh and mean ratios of its elements."""

    # Shortest, mean and longest edge.
    edge_min_m: float
    edge_mean_m: float
    edge_max_m: float
    # Smallest and median mean ratio, see `mean_ratios`.
    quality_min: float
    quality_median: float


def mean_ratios(points_m: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return 12 (3V)^(2/3) / Σ l² over the edges of each element (E,): 1 if regular, near 0 if
    flat; NaN for a negative volume V.
    """
    volumes = signed_volumes(points_m, tetrahedra)
    squares = edge_lengths(points_m, tetrahedra) ** 2
    return 12 * (3 * volumes) ** (2 / 3) / squares.sum(axis=1)


def edge_lengths(points: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return the lengths (E, 6) [m] of the edges between the corners of elements (E, 4) or (E, 10),
    in the order of `EDGES`.
    """
    ends = points[tetrahedra[:, EDGES]]
    return np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2)


def _require_finite(points: np.ndarray, used: np.ndarray) -> None:
    bad = used[~np.isfinite(points[used]).all(axis=1)]
    if len(bad):
        raise InputError(
            f"node {bad[0]} lies at {points[bad[0]].tolist()}; expected finite coordinates "
            f"(number of such nodes: {len(bad)})"
        )


def _require_no_duplicates(tetrahedra: np.ndarray) -> None:
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


def _require_not_degenerate(points: np.ndarray, tetrahedra: np.ndarray) -> None:
    volumes = np.abs(signed_volumes(points, tetrahedra))
    cubes = edge_lengths(points, tetrahedra).mean(axis=1) ** 3
    bad = np.flatnonzero(volumes <= DEGENERATE_RATIO * cubes)
    if len(bad):
        raise InputError(
            f"element {bad[0]} (counted from 0) with nodes {tetrahedra[bad[0]].tolist()} is "
            f"degenerate: its volume is {volumes[bad[0]]:.3g} m³; expected more than "
            f"{DEGENERATE_RATIO * cubes[bad[0]]:.3g} m³, which is {DEGENERATE_RATIO:g} times the "
            f"cube of its mean edge length (number of such elements: {len(bad)}): remove it, or "
            "mesh the body again"
        )


def connected_parts(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the number (n,) of the connected part of each node, and what the mesh consists of, as
    text; "" for one part.
    """
    n = len(points)
    first = np.repeat(cells[:, 0], cells.shape[1] - 1)
    graph = coo_array((np.ones(len(first)), (first, cells[:, 1:].ravel())), shape=(n, n))
    _, label = connected_components(graph, directed=False)
    parts, nodes = np.unique(label[np.unique(cells)], return_counts=True)
    if len(parts) == 1:
        return label, ""
    sizes = ", ".join(str(size) for size in np.sort(nodes)[:-6:-1])
    twins = n - len(np.unique(points, axis=0))
    hint = (
        f"; {twins} of {n} nodes coincide with other nodes: merge these if the parts should be "
        "connected"
        if twins
        else ""
    )
    return (
        label,
        f"consists of {len(parts)} unconnected parts (the largest have {sizes} nodes){hint}",
    )


def straightening_notes(points_m: np.ndarray, cells: np.ndarray) -> tuple[str, ...]:
    """Return notes on curved sides that are lost when quadratic tetrahedra are reduced to corners.

    Parameters
    ----------
    points_m : (n, 3)
    cells : (E, 10)

    Returns
    -------
    tuple of str
        Empty if all sides are straight.

    Raises
    ------
    InputError
        If a node does not exist, or sides are curved by more than `LARGEST_SIDE_CURVATURE`.
    """
    require_known_nodes(cells, len(points_m))
    start_of, end_of = np.array(EDGES).T
    start = points_m[cells[:, start_of]]
    stop = points_m[cells[:, end_of]]
    length = np.linalg.norm(stop - start, axis=2)
    offset = np.linalg.norm(points_m[cells[:, 4:]] - (start + stop) / 2, axis=2)
    bad = np.argwhere(~(offset <= LARGEST_SIDE_CURVATURE * length))
    if len(bad):
        e, k = bad[0]
        a = cells[e, start_of[k]]
        b = cells[e, end_of[k]]
        mid = cells[e, 4 + k]
        count = len(np.unique(cells[bad[:, 0], 4 + bad[:, 1]]))
        raise InputError(
            f"quadratic element {e}: mid node {mid} lies {offset[e, k]:.3g} m off the middle of "
            f"the edge from node {a} to node {b}, which is {length[e, k]:.3g} m long; expected at "
            f"most {LARGEST_SIDE_CURVATURE:.0%} of that (number of such nodes: {count}), because "
            "sides are assumed to be straight: refine the mesh, or save it with linear tetrahedra"
        )
    is_curved = offset > ROUND_OFF * length
    if not is_curved.any():
        return ()
    largest = (offset[is_curved] / length[is_curved]).max()
    count = len(np.unique(cells[:, 4:][is_curved]))
    return (
        f"Curved sides of elements were straightened: {count} mid nodes lie off the middle of "
        f"their edges, by up to {largest:.2g} of the edge's length.",
    )
