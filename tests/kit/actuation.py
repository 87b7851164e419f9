"""Bodies under tendons and pressures: a box with a cavity, and an eighth of a hollow sphere."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.checks import orient_elements
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.shape import EnclosedVolume


def box_with_cavity() -> TetMesh:
    """A cube of 30 mm without the middle one of its 27 cubes."""
    whole = box_mesh((0.03, 0.03, 0.03), (3, 3, 3))
    inside = (np.abs(whole.centres_m - 0.015) < 0.005).all(axis=1)
    kept = whole.tetrahedra[~inside]
    corner = np.array([0.01, 0.02])
    wall = np.isin(whole.points_m.round(6), corner.round(6)).all(axis=1)
    return TetMesh(whole.points_m, kept, {"wall": wall})


def hollow_octant(inner_m: float, outer_m: float, divisions: int, layers: int) -> TetMesh:
    """x, y, z >= 0 of a hollow sphere: prisms on a divided triangle, each of three tetrahedra."""
    n = divisions
    corners = [(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]
    number = {corner: k for k, corner in enumerate(corners)}
    flat = np.array(corners, dtype=float)
    directions = flat / np.linalg.norm(flat, axis=1, keepdims=True)
    up = [
        (number[i, j, n - i - j], number[i + 1, j, n - i - j - 1], number[i, j + 1, n - i - j - 1])
        for i in range(n)
        for j in range(n - i)
    ]
    down = [
        (number[i + 1, j, k], number[i, j + 1, k], number[i + 1, j + 1, k - 1])
        for i in range(n)
        for j in range(n - i)
        if (k := n - i - j - 1) > 0
    ]
    triangles = np.sort(np.array(up + down), axis=1)  # the same diagonal on both sides of a wall
    radii = inner_m * (outer_m / inner_m) ** np.linspace(0, 1, layers + 1)
    points = (radii[:, None, None] * directions).reshape(-1, 3)
    a, b, c = triangles.T
    count, cells = len(directions), []
    for layer in range(layers):
        low, high = layer * count, (layer + 1) * count
        cells += [
            np.stack([a + low, b + low, c + low, c + high], axis=1),
            np.stack([a + low, b + low, b + high, c + high], axis=1),
            np.stack([a + low, a + high, b + high, c + high], axis=1),
        ]
    wall = np.isclose(np.linalg.norm(points, axis=1), inner_m)
    return TetMesh(points, orient_elements(points, np.concatenate(cells))[0], {"wall": wall})


def inflated(
    body: Body, volume: EnclosedVolume, pressure_pa: float, constants: dict[str, float], steps: int
) -> np.ndarray:
    """(n, 3) equilibrium of an octant under a pressure, its nodes in their planes of symmetry."""
    free = np.flatnonzero(np.abs(body.nodes_m).ravel() > 1e-9)
    x = body.nodes_m.ravel().copy()
    for share in np.arange(1, steps + 1) / steps:
        p = share * pressure_pa
        for _ in range(20):
            state = x.reshape(-1, 3)
            force = body.elastic_force(state, **constants).ravel() + p * volume.gradient(x[None])[0]
            bent = volume.couplings.matrix(volume.hessian(x[None])[0])
            matrix = sp.csc_matrix(body.stiffness(state, **constants) - p * bent)
            step: np.ndarray = spsolve(
                matrix[free][:, free], force[free], permc_spec="MMD_AT_PLUS_A"
            )
            x[free] += step
            if np.abs(step).max() < 1e-12:
                break
    return x.reshape(-1, 3)
