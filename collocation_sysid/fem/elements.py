"""Finite elements as table entries: shape functions, quadrature and mass lumping.

Use `element_named` to look an element up. A new element is a new entry of `ELEMENTS`; kernels,
assembly and marker embedding read only this table.

The quadratic tetrahedron has four corners and a node on each edge, in VTK's order. Its shape
functions and lumping assume straight sides, with each mid node in the middle of its edge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..errors import InputError

# Corners at the ends of the edge of each mid node, nodes 4 to 9: VTK's and meshio's order.
EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
_FROM, _TO = np.array(EDGES).T

# Four points of degree 2 (Keast 1986; Hughes 2000, table 3.I.1). Straight sides make the shape
# gradients linear, so the stiffness of linear elasticity is integrated exactly, and for any
# material the error keeps the element's order (Ciarlet 1978, theorem 4.1.6). Four points see
# 4 · 6 = 24 strains, as many as 30 displacements less 6 rigid motions: none is without energy.
# Fewer points would leave some that are; more would cost in proportion and gain no order.
_BARYCENTRIC_OFFSET = (5 - 5**0.5) / 20
# Barycentric coordinates (4, 4) of the points.
POINTS = _BARYCENTRIC_OFFSET + (1 - 4 * _BARYCENTRIC_OFFSET) * np.eye(4)
WEIGHTS = np.full(4, 0.25)

# The row sums of the consistent mass are negative at the corners. Its diagonal is not:
# ∫N²/V = 1/70 at a corner and 8/105 at a mid node, which scaled to the sum one are these
# (Hinton, Rock & Zienkiewicz 1976).
MASS_SHARES = np.repeat([1 / 36, 4 / 27], [4, 6])


def shape_functions(barycentric: Array) -> Array:
    """Return the quadratic shape functions (k, 10) at barycentric points (k, 4).

    They are L_a (2 L_a − 1) at the corners and 4 L_a L_b at the mid nodes.
    """
    L = np.asarray(barycentric, dtype=float)
    return np.hstack([L * (2 * L - 1), 4 * L[:, _FROM] * L[:, _TO]])


def shape_gradients(barycentric: Array) -> Array:
    """Return the derivatives (k, 10, 4) of the quadratic shape functions at barycentric points (k,
    4).
    """
    L = np.asarray(barycentric, dtype=float)
    mid = np.arange(len(EDGES))
    gradients = np.zeros((len(L), 10, 4))
    gradients[:, range(4), range(4)] = 4 * L - 1
    gradients[:, 4 + mid, _FROM] = 4 * L[:, _TO]
    gradients[:, 4 + mid, _TO] = 4 * L[:, _FROM]
    return gradients


@dataclass(frozen=True, eq=False)
class Element:
    """Tetrahedral element in barycentric coordinates L = (L0, L1, L2, L3), ΣL = 1."""

    name: str
    nodes: int  # nodes per element, the four corners first
    shape_functions: Callable[[Array], Array]  # (k, 4) barycentric points to (k, nodes) values
    # (k, 4) barycentric points to (k, nodes, 4) derivatives with respect to L.
    shape_gradients: Callable[[Array], Array]
    points: Array  # (q, 4): quadrature points in barycentric coordinates
    weights: Array  # (q,): quadrature weights as fractions of the volume; their sum is one
    # (nodes,): fraction of the element's mass lumped at each node: all positive, sum one.
    mass_shares: Array
    meshio_type: str  # cell name for writing files
    # Number of columns c of the gradient (3, c) at a point: 3 for the deformation gradient; more if
    # further derivatives of the positions, such as those of directors, follow it.
    columns: int = 3
    # Number of stresses at a point, of a law with strains of its own.
    stresses: int = 0
    # Number of values of the rest shape, which a point has beside shape gradients and volume.
    rest_values: int = 0
    # For each node after the corners, the two corners between which it lies halfway.
    edges: tuple[tuple[int, int], ...] = ()
    # Whether the material is evaluated at the mean dilatation of the element, see
    # `mean_dilatation`.
    mean_dilatation: bool = False

    def __reduce__(self) -> str | tuple[Callable[[str], Element], tuple[str]]:
        return "ROD" if self.name == "rod" else (element_named, (self.name,))


_TET10 = Element(
    name="tet10",
    nodes=10,
    shape_functions=shape_functions,
    shape_gradients=shape_gradients,
    points=POINTS,
    weights=WEIGHTS,
    mass_shares=MASS_SHARES,
    meshio_type="tetra10",
    edges=EDGES,
)

ELEMENTS: dict[str, Element] = {
    # One point integrates the constant deformation gradient exactly; equal mass shares.
    "tet4": Element(
        name="tet4",
        nodes=4,
        shape_functions=lambda L: np.asarray(L, dtype=float),
        shape_gradients=lambda L: np.broadcast_to(np.eye(4), (len(L), 4, 4)),
        points=np.full((1, 4), 0.25),
        weights=np.ones(1),
        mass_shares=np.full(4, 0.25),
        meshio_type="tetra",
    ),
    # Bends without locking; quadrature and mass lumping are justified above.
    "tet10": _TET10,
    # One pressure for its ten nodes: keeps its volume without locking, however incompressible.
    "tet10-p0": replace(_TET10, name="tet10-p0", mean_dilatation=True),
}
# Part of a slender body between two cross-sections, see `rods`; it has no barycentric coordinates.
ROD = Element(
    name="rod",
    nodes=6,
    shape_functions=lambda L: np.zeros((len(L), 6)),
    shape_gradients=lambda L: np.zeros((len(L), 6, 4)),
    points=np.full((1, 4), 0.25),
    weights=np.ones(1),
    mass_shares=np.full(6, 1 / 6),
    meshio_type="wedge",
    columns=5,
    stresses=12,
    rest_values=8,
)


def face_shape_functions(places: Array, nodes: int) -> tuple[Array, Array]:
    """Return the shape functions (q, v) of faces with v nodes, and derivatives (q, v, 3).

    Nodes are the corners and, for six of them, the middles of ab, bc and ca.

    Parameters
    ----------
    places : (q, 3)
        Barycentric coordinates, by which the derivatives are taken.
    nodes : {3, 6}
        Number v of nodes.
    """
    unit = np.broadcast_to(np.eye(3), (len(places), 3, 3))
    if nodes == 3:
        return places, unit
    next_places = np.roll(places, -1, axis=1)
    weights = np.hstack([places * (2 * places - 1), 4 * places * next_places])
    side_slopes = next_places[:, :, None] * unit + places[:, :, None] * np.roll(unit, 1, axis=2)
    return weights, np.hstack([(4 * places - 1)[:, :, None] * unit, 4 * side_slopes])


def element_named(name: str) -> Element:
    """Return the element of this name in `ELEMENTS`.

    Raises
    ------
    InputError
        If there is no such element.
    """
    if name not in ELEMENTS:
        raise InputError(f"no element {name!r}; available: {', '.join(ELEMENTS)}")
    return ELEMENTS[name]


def reference_geometry(points_m: Array, cells: NDArray[np.int64], element: Element) -> Array:
    """Return shape gradients and volumes at every quadrature point of the undeformed mesh.

    Orientation is not checked: volumes of inverted cells are negative.

    Parameters
    ----------
    points_m : (n, 3)
        Undeformed node positions.
    cells : (E, nodes)
        Node indices, corners first; sides are straight.

    Returns
    -------
    (E, q, 3 * nodes + 1) ndarray
        ∂N_a/∂X_j [1/m] at column 3a + j, then the volume assigned to the point [m³].
    """
    corners = points_m[cells[:, :4]]
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)  # columns are edge vectors
    inverse = np.linalg.inv(edges)  # rows are ∂L1..L3/∂X
    barycentric_gradients = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    volumes = np.linalg.det(edges) / 6.0
    gradients = np.einsum(
        "qal,elj->eqaj", element.shape_gradients(element.points), barycentric_gradients
    )
    gradient_rows = gradients.reshape(len(cells), len(element.points), 3 * element.nodes)
    return np.concatenate([gradient_rows, (volumes[:, None] * element.weights)[..., None]], axis=2)
