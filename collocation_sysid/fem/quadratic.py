"""The quadratic tetrahedron: four corners and a node on each edge, in VTK's order.

Shape functions and lumping are those of straight sides, where each mid node lies halfway; files
whose sides are curved are straightened, or refused, by `straightened`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import InputError
from .mesh_checks import refuse_unknown_nodes

# Corners at the ends of the edge of each mid node, nodes 4 to 9: VTK's and meshio's order.
EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
_FROM, _TO = np.array(EDGES).T

# How far a mid node may lie off the middle, in edge lengths: round-off of a file in single
# precision, and what may be straightened without asking.
ROUND_OFF = 1e-5
SLIGHTLY_CURVED = 0.05

# Four points of degree 2 (Keast 1986; Hughes 2000, table 3.I.1). Straight sides make the shape
# gradients linear, so the stiffness of linear elasticity is integrated exactly, and for any
# material the error keeps the element's order (Ciarlet 1978, theorem 4.1.6). Four points see
# 4 · 6 = 24 strains, as many as 30 displacements less 6 rigid motions: none is without energy.
# Fewer points would leave some that are; more would cost in proportion and gain no order.
_NEAR = (5 - 5**0.5) / 20
POINTS = _NEAR + (1 - 4 * _NEAR) * np.eye(4)
WEIGHTS = np.full(4, 0.25)

# The row sums of the consistent mass are negative at the corners. Its diagonal is not:
# ∫N²/V = 1/70 at a corner and 8/105 at a mid node, which scaled to the sum one are these
# (Hinton, Rock & Zienkiewicz 1976).
MASS_SHARES = np.repeat([1 / 36, 4 / 27], [4, 6])


def shape_functions(barycentric: Array) -> Array:
    """L_a (2 L_a − 1) at the corners, 4 L_a L_b at the mid nodes: (k, 4) to (k, 10)."""
    L = np.asarray(barycentric, dtype=float)
    return np.hstack([L * (2 * L - 1), 4 * L[:, _FROM] * L[:, _TO]])


def shape_gradients(barycentric: Array) -> Array:
    """Derivatives of the shape functions by L: (k, 4) to (k, 10, 4)."""
    L = np.asarray(barycentric, dtype=float)
    mid = np.arange(len(EDGES))
    gradients = np.zeros((len(L), 10, 4))
    gradients[:, range(4), range(4)] = 4 * L - 1
    gradients[:, 4 + mid, _FROM] = 4 * L[:, _TO]
    gradients[:, 4 + mid, _TO] = 4 * L[:, _FROM]
    return gradients


def straightened(points_m: Array, cells: NDArray[np.int64]) -> tuple[str, ...]:
    """Notes on what is lost when quadratic tetrahedra are taken by their corners alone.

    Parameters
    ----------
    points_m : (n, 3)
    cells : (E, 10)

    Returns
    -------
    tuple of str
        Empty where all sides are straight.

    Raises
    ------
    InputError
        If a node does not exist, or a mid node lies further off the middle than those of
        slightly curved sides.
    """
    refuse_unknown_nodes(cells, len(points_m))
    start, stop = points_m[cells[:, _FROM]], points_m[cells[:, _TO]]
    length = np.linalg.norm(stop - start, axis=2)
    off = np.linalg.norm(points_m[cells[:, 4:]] - (start + stop) / 2, axis=2)
    bad = np.argwhere(~(off <= SLIGHTLY_CURVED * length))
    if len(bad):
        e, k = bad[0]
        a, b, mid = cells[e, _FROM[k]], cells[e, _TO[k]], cells[e, 4 + k]
        raise InputError(
            f"quadratic element {e}: mid node {mid} lies {off[e, k]:.3g} m off the middle of the "
            f"edge from node {a} to node {b}, which is {length[e, k]:.3g} m long; expected at most "
            f"{SLIGHTLY_CURVED:.0%} of that ({len(bad)} such in all), since sides are taken as "
            "straight: refine the mesh, or save it with linear tetrahedra"
        )
    curved = off > ROUND_OFF * length
    if not curved.any():
        return ()
    largest = (off[curved] / length[curved]).max()
    count = len(np.unique(cells[:, 4:][curved]))
    return (
        f"Curved sides were straightened: {count} mid nodes lie off the middle of their edges, "
        f"by up to {largest:.2g} of the edge's length.",
    )
