"""Structured meshes of boxes and cylinders.

Use `box_of_edge` and `cylinder_of_edge` for a given edge length, `box_mesh` and `cylinder_mesh` for
given numbers of elements.
"""

from __future__ import annotations

from math import pi, sin, sqrt
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from ...common.checked_arrays import float_array
from ...common.validated_classes import validated
from ...common.validated_types import AtLeastOne, Positive
from ...errors import InputError
from .checks import orient_elements
from .mesh import TetMesh

# Sectors of a cylinder by edge length: a multiple of four, which a quarter of a cylinder needs.
_SECTORS = 8
# Largest number of elements that are made: more follow from a wrong unit of the edge length.
_MOST_ELEMENTS = 1_000_000
# Number of parts along one direction.
_Part = Annotated[AtLeastOne, Field(le=1_000)]


def box_of_edge(size_m: ArrayLike, edge_length_m: float) -> TetMesh:
    """Mesh a box of size (3,) [m] with its lowest corner at the origin and a whole number of cells
    along each axis, whose edges are about `edge_length_m` long; see `box_mesh`.

    Raises
    ------
    InputError
        For sizes or an edge length that are not positive, or more than a million elements.
    """
    divisions = _divisions(float_array(size_m, "size_m", (3,)), edge_length_m)
    _require_element_limit(6 * float(np.prod(divisions)))
    return box_mesh(size_m, divisions.astype(int))


def cylinder_of_edge(
    diameter_m: float, height_m: float, edge_length_m: float, quarter: bool = False
) -> TetMesh:
    """Mesh an upright cylinder with edges of about this length: axis z, base at z = 0, volume
    exactly that of the round cylinder, so that the nodes of the rim are slightly outside the
    radius.

    Parameters
    ----------
    quarter : bool
        Only x, y ≥ 0, between the planes of symmetry x = 0 and y = 0.

    Raises
    ------
    InputError
        If a length is not positive, or if this takes more than a million elements.
    """
    rings, layers = _divisions(np.array([diameter_m / 2, height_m]), edge_length_m)
    _require_element_limit(3 * _SECTORS * float(rings**2 * layers))
    corners = _SECTORS * rings
    radius_m = diameter_m / 2 * sqrt(2 * pi / corners / sin(2 * pi / corners))
    full_cylinder = cylinder_mesh(
        radius_m, height_m, rings=int(rings), layers=int(layers), sectors=_SECTORS
    )
    if not quarter:
        return full_cylinder
    points_m = np.where(
        np.abs(full_cylinder.points_m) < 1e-12 * diameter_m, 0.0, full_cylinder.points_m
    )
    is_in_quarter = (points_m[full_cylinder.tetrahedra][..., :2] >= 0).all(axis=(1, 2))
    quarter_corners, tetrahedra = np.unique(
        full_cylinder.tetrahedra[is_in_quarter], return_inverse=True
    )
    return TetMesh(points_m[quarter_corners], tetrahedra.reshape(-1, 4), is_generated=True)


def count_box_elements(size_m: ArrayLike, edge_length_m: float) -> tuple[int, int]:
    """Return the numbers of nodes and elements, in this order, of `box_of_edge` without creating
    the mesh; sizes are not checked.

    Raises
    ------
    InputError
        For an edge length that is not positive, or more than a million elements.
    """
    divisions = _divisions(np.asarray(size_m, dtype=float), edge_length_m)
    elements = float(6 * np.prod(divisions))
    _require_element_limit(elements)
    return int(np.prod(divisions + 1)), int(elements)


def count_cylinder_elements(
    diameter_m: float, height_m: float, edge_length_m: float, quarter: bool = False
) -> tuple[int, int]:
    """Return the numbers of nodes and elements, in this order, of `cylinder_of_edge` without
    creating the mesh; that of a quarter's nodes is approximate. Diameter and height are not
    checked.

    Raises
    ------
    InputError
        For an edge length that is not positive, or more than a million elements.
    """
    rings, layers = _divisions(np.array([diameter_m / 2, height_m]), edge_length_m)
    sectors = _SECTORS / 4 if quarter else _SECTORS
    nodes = (1 + sectors * rings * (rings + 1) / 2) * (layers + 1)
    elements = 3 * sectors * rings**2 * layers
    _require_element_limit(elements)
    return int(nodes), int(elements)


def _divisions(size_m: np.ndarray, edge_length_m: float) -> np.ndarray:
    """Return the numbers of elements along lengths, as floats, at least 1."""
    if not edge_length_m > 0:
        raise InputError(
            f"found {edge_length_m!r}; expected a positive length in metres",
            None,
            where="edge_length_m",
        )
    return np.maximum(np.round(size_m / edge_length_m), 1)


def _require_element_limit(elements: float) -> None:
    if elements > _MOST_ELEMENTS:
        raise InputError(
            f"with this length the mesh has {elements:.3g} elements; expected at most "
            f"{_MOST_ELEMENTS:,}: give a larger length",
            None,
            where="edge_length_m",
        )


def box_mesh(
    size_m: ArrayLike, divisions: ArrayLike, origin_m: ArrayLike = (0.0, 0.0, 0.0)
) -> TetMesh:
    """Mesh a box; each of its cells is split into the six tetrahedra around its main diagonal.

    Parameters
    ----------
    size_m : three numbers
        Lengths along x, y and z.
    divisions : three integers
        Cells along x, y and z.
    origin_m : three numbers
        Corner with the lowest coordinates.

    Returns
    -------
    TetMesh
        Nodes are ordered with z fastest, then y, then x.

    Raises
    ------
    InputError
        For lengths or divisions that are not positive.
    """
    size = float_array(size_m, "size_m", (3,))
    origin = float_array(origin_m, "origin_m", (3,))
    cells = float_array(divisions, "divisions", (3,)).astype(int)
    if not (size > 0).all():
        raise InputError(
            f"found size_m = {size_m!r} and origin_m = {origin_m!r}; expected three positive "
            "lengths and three coordinates in metres"
        )
    if np.asarray(divisions).dtype.kind not in "iu" or not (cells > 0).all():
        raise InputError(f"a box needs three positive whole divisions, not {divisions!r}")
    ticks = [np.linspace(0, 1, n + 1) for n in cells]
    points = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3) * size + origin

    stride = np.array([(cells[1] + 1) * (cells[2] + 1), cells[2] + 1, 1])
    corner = np.stack(np.meshgrid(*map(np.arange, cells), indexing="ij"), axis=-1) @ stride
    # A path along the cell's edges from its lowest to its highest corner, for each order of axes.
    orders = [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)]
    paths = np.array([[0, *np.cumsum(stride[list(order)])] for order in orders])
    tetrahedra = (corner.reshape(-1, 1, 1) + paths).reshape(-1, 4)
    return TetMesh(points, orient_elements(points, tetrahedra)[0], is_generated=True)


@validated
def cylinder_mesh(
    radius_m: Positive, height_m: Positive, rings: _Part, layers: _Part, sectors: _Part = 6
) -> TetMesh:
    """Mesh an upright cylinder: axis z, base at z = 0.

    Ring k of each cross-section has `sectors` · k nodes. The outermost ring is a polygon inscribed
    in the circle: with six sectors and one ring the volume is 17 % below that of the cylinder, with
    two rings 4.5 %, with three 2 %.

    Parameters
    ----------
    radius_m, height_m : float
    rings, layers : int
        Elements along the radius and along the height.
    sectors : int
        Nodes of the innermost ring, 3 or more (not checked). With a multiple of four no element
        crosses the planes x = 0 and y = 0. With six, a mesh has (1 + 3 rings (rings + 1)) (layers +
        1) nodes and 18 rings² layers elements.

    Returns
    -------
    TetMesh
        Nodes are ordered by layer from z = 0 up; in each layer the centre, then ring by ring.

    Raises
    ------
    InputError
        For lengths, rings or layers that are not positive, or more than 1,000 of these.
    """
    disc, triangles = _disc(rings, sectors)
    points = np.concatenate(
        [
            np.column_stack([radius_m * disc, np.full(len(disc), z)])
            for z in np.linspace(0, height_m, layers + 1)
        ]
    )
    # In a prism over a, b, c each side's diagonal starts from its node that comes first, so that
    # neighbours agree. Alternating the order from layer to layer keeps the mesh from being twisted.
    up = np.sort(triangles, axis=1)
    tetrahedra = [
        np.concatenate([np.c_[a, b, c, c_], np.c_[a, b, b_, c_], np.c_[a, a_, b_, c_]])
        for layer in range(layers)
        for a, b, c in [(up if layer % 2 == 0 else up[:, ::-1]).T + layer * len(disc)]
        for a_, b_, c_ in [(a + len(disc), b + len(disc), c + len(disc))]
    ]
    cells = orient_elements(points, np.concatenate(tetrahedra))[0]
    return TetMesh(points, cells, is_generated=True)


def _disc(rings: int, sectors: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (m, 2) and triangles (k, 3) of the unit disc: centre, then ring by ring."""
    counts = [sectors * k for k in range(1, rings + 1)]
    angles = [2 * np.pi * np.arange(count) / count for count in counts]
    circles = [
        k / rings * np.column_stack([np.cos(angle), np.sin(angle)])
        for k, angle in enumerate(angles, start=1)
    ]

    def node(ring: int, sector: int, step: int) -> int:
        """Index of a node: number `step` of a sector of a ring, or of the next sector."""
        if not ring:
            return 0
        before = 1 + sectors * ring * (ring - 1) // 2
        return before + (sector * ring + step) % (sectors * ring)

    triangles = []
    for k in range(1, rings + 1):
        for s in range(sectors):
            for i in range(k):
                rim_node = node(k, s, i + 1)
                triangles.append((node(k - 1, s, i), node(k, s, i), rim_node))
                if i < k - 1:
                    triangles.append((node(k - 1, s, i), rim_node, node(k - 1, s, i + 1)))
    return np.concatenate([np.zeros((1, 2)), *circles]), np.array(triangles)
