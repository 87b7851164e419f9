"""The plate of "Material Fingerprinting" on its own mesh: linear triangles in plane strain.

The published data were simulated by FEniCSx with these elements; `study_fingerprints` compares its
own equilibria with them. The energy is the authors' sum of terms, of which a law has some.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import casadi as ca
import meshio
import numpy as np
from scipy.linalg import solve_banded
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from collocation_sysid.common.array_types import Array

# Hole of this radius about (1, 1) in a unit plate.
RADIUS = 0.3
STEPS = 11
CONSTANTS = ("kappa_pa", "c10_pa", "c01_pa", "demiray_pa", "demiray", "gent_pa", "gent")


def energy(first: Any, second: Any, volume: Any, values: Mapping[str, Any], of: Any = np) -> Any:
    """Return the energy density of the isochoric invariants I₁ and I₂ and of J."""
    p = dict.fromkeys(CONSTANTS, 0.0) | dict(values)
    return (
        p["kappa_pa"] / 2 * (volume - 1) ** 2
        + p["c10_pa"] * (first - 3)
        + p["c01_pa"] * (second - 3)
        + p["demiray_pa"] * (of.exp(p["demiray"] * (first - 3)) - 1)
        - p["gent_pa"] * of.log(1 - p["gent"] * (first - 3))
    )


def energy_error(found: Mapping[str, float], truth: Mapping[str, float]) -> float:
    """Return ∫|W − W_true| / ∫|W_true| over the principal stretches from 0.75 to 1.25."""
    count = 40
    stretches = np.meshgrid(*[0.75 + 0.5 * (np.arange(count) + 0.5) / count] * 3)
    squares = [each**2 for each in stretches]
    volume = stretches[0] * stretches[1] * stretches[2]
    first = sum(squares) / volume ** (2 / 3)
    second = sum(volume**2 / each for each in squares) / volume ** (4 / 3)
    true = energy(first, second, volume, truth)
    return np.abs(energy(first, second, volume, found) - true).sum() / np.abs(true).sum()


class Plate:
    """Triangles of a mesh file of the plate, with its loading in eleven equilibria."""

    def __init__(self, path: Path) -> None:
        flat = meshio.read(path)
        cells = np.concatenate([b.data for b in flat.cells if b.type == "triangle"])
        used, inverse = np.unique(cells, return_inverse=True)
        self.triangles = inverse.reshape(cells.shape)
        self.points = np.asarray(flat.points)[used, :2]
        x, y = self.points.T
        close = 1e-6
        edges = [x < close, y < close, x > 1 - close, y > 1 - close]
        self.left, self.bottom, right, top = map(np.flatnonzero, edges)
        arc = np.flatnonzero(np.abs(np.hypot(x - 1, y - 1) - RADIUS) < close)
        self.arc = arc[np.argsort(-y[arc])]
        self.held = np.concatenate([2 * self.left, 2 * self.bottom + 1, 2 * right, 2 * top + 1])
        self.free = np.setdiff1d(np.arange(2 * len(x)), self.held)
        corners = self.points[self.triangles]
        sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], 2)
        self.areas = np.abs(np.linalg.det(sides)) / 2
        inner = np.linalg.inv(sides)
        self.gradients = np.stack([-inner.sum(1), inner[:, 0], inner[:, 1]], 1)
        self.numbers = (2 * self.triangles[:, :, None] + np.arange(2)).reshape(-1, 6)
        self._stress = self._compiled()
        self._lay_out()

    def _lay_out(self) -> None:
        """Number the free displacements for a narrow band, and find each entry's place in it."""
        rows, columns = np.repeat(self.numbers, 6, axis=1).ravel(), np.tile(self.numbers, 6).ravel()
        position = np.full(2 * len(self.points), -1)
        position[self.free] = np.arange(len(self.free))
        self._kept = np.flatnonzero((position[rows] >= 0) & (position[columns] >= 0))
        rows, columns = position[rows[self._kept]], position[columns[self._kept]]
        pattern = csr_matrix((np.ones(len(rows)), (rows, columns)))
        self._order = reverse_cuthill_mckee(pattern, symmetric_mode=True)
        rank = np.argsort(self._order)
        rows, columns = rank[rows], rank[columns]
        below = int(np.abs(rows - columns).max())
        self._band = np.zeros((2 * below + 1, len(self.free)))
        self._places = (below + rows - columns) * len(self.free) + columns

    def _compiled(self) -> ca.Function:
        """Return stress (4) and stiffness (16) of F (2 × 2, row by row), of many triangles."""
        f, p = ca.SX.sym("F", 4), ca.SX.sym("p", len(CONSTANTS))
        volume = f[0] * f[3] - f[1] * f[2]
        trace = ca.sumsqr(f) + 1
        # The third stretch is 1: I₂ = J² tr C⁻¹ with the inverse in the plane.
        second = ca.sumsqr(f) + volume**2
        values = {name: p[k] for k, name in enumerate(CONSTANTS)}
        density = energy(
            volume ** (-2 / 3) * trace, volume ** (-4 / 3) * second, volume, values, ca
        )
        stiffness, stress = ca.hessian(density, f)
        function = ca.Function("stress", [f, p], [stress, ca.densify(ca.vec(stiffness))])
        return function.map(len(self.triangles))

    def equilibria(
        self, values: Mapping[str, float], guess: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """Return reactions (22,), displacements of the arc (242,), and all displacements (11, 2N).

        The first two are in the order of the published files. A guess is the third of a similar law.

        :raises RuntimeError: An equilibrium was not found.
        """
        p = np.array([values.get(name, 0.0) for name in CONSTANTS])
        moved = np.zeros((STEPS, 2 * len(self.points)))
        reactions = np.zeros((2, STEPS))
        for step in range(1, STEPS):
            shift = -0.3 * step / (STEPS - 1)
            prescribed = np.zeros(moved.shape[1])
            prescribed[2 * self.left], prescribed[2 * self.bottom + 1] = 0.5 * shift, shift
            u = (moved[step - 1] if guess is None else guess[step]).copy()
            force, blocks = self._assembled(u, p)
            for _ in range(30):
                if not np.isfinite(blocks).all():
                    raise RuntimeError("the energy has no value at the strains of this step")
                change = np.zeros(len(u))
                change[self.held] = (prescribed - u)[self.held]
                pushed = np.einsum("tab,tb->ta", blocks, change[self.numbers])
                load = force + np.bincount(self.numbers.ravel(), pushed.ravel(), len(u))
                change[self.free] = -self._solved(blocks, load[self.free])
                u += change
                if np.abs(change).max() > 1.0:
                    raise RuntimeError("the search for an equilibrium diverged")
                force, blocks = self._assembled(u, p)
                if np.abs(change).max() < 1e-9:
                    break
            else:
                raise RuntimeError("no equilibrium was found")
            moved[step] = u
            reactions[:, step] = force[2 * self.left].sum(), force[2 * self.bottom + 1].sum()
        places = 2 * self.arc[:, None] + np.arange(2)
        return reactions.ravel(), moved[:, places].transpose(2, 1, 0).ravel(), moved

    def _assembled(self, u: Array, p: Array) -> tuple[Array, Array]:
        """Return internal forces (2N,) and the stiffness of each triangle (T, 6, 6)."""
        f = np.einsum("tai,taj->tij", u[self.numbers].reshape(-1, 3, 2), self.gradients)
        stress, tangent = self._stress((f + np.eye(2)).reshape(-1, 4).T, p)
        stress = np.asarray(stress).T.reshape(-1, 2, 2)
        forces = np.einsum("tij,taj->tai", stress, self.gradients) * self.areas[:, None, None]
        # Derivative of F (row by row) with respect to the six displacements.
        slopes = np.einsum("ik,taj->tijak", np.eye(2), self.gradients).reshape(-1, 4, 6)
        tangent = np.asarray(tangent).T.reshape(-1, 4, 4) * self.areas[:, None, None]
        blocks = slopes.transpose(0, 2, 1) @ tangent @ slopes
        total = np.bincount(self.numbers.ravel(), forces.ravel(), len(u))
        return total.astype(float), blocks

    def _solved(self, blocks: Array, load: Array) -> Array:
        """Solve the stiffness of the free displacements for a load, in a band."""
        band = np.bincount(self._places, blocks.ravel()[self._kept], self._band.size)
        solution = np.empty(len(load))
        below = len(self._band) // 2
        solution[self._order] = solve_banded(
            (below, below), band.reshape(self._band.shape), load[self._order]
        )
        return solution
