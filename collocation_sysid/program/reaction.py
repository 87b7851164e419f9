"""What the grasps give a body: what the equations of motion lack on the dofs that are held.

On the dofs g of grasps whose wrench is measured,

    R_t = M a_t − Σ_j w_j F_{t−j} = −c_{t,g},

with the stencils of the rows, see `model.schemes`. Its changes along the equations of motion come
from the same blocks as the others', rows g of G = ∂F/∂ξ and C = ∂F/∂ν:

    dF_k = G Σ_i p_i Y_{k−i} + C Σ_i q_i Y_{k−i} + ∂F/∂p + what the memory brings.

A row belongs to the time in the middle of its stencil: of the midpoint rule row t is the balance
of momentum about t − 1. Rows of the start know the acceleration to first order only, and are left
out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..model.dynamics import Dynamics
from ..model.histories import AnyHistory


def centred_rows(dynamics: Dynamics) -> tuple[NDArray[np.bool_], int]:
    """Rows (N,) whose acceleration is that of the middle of their stencil, and how late they are.

    Of a static problem all its rows, at their own times.
    """
    t, lags = dynamics.tables, np.arange(dynamics.reach + 1.0)
    second = np.column_stack([t.s.sum(axis=1), t.s @ lags, t.s @ lags**2 - 2, t.r])
    whole = np.isclose(t.w.sum(axis=1), 1.0)
    moving = whole & np.isclose(second, 0.0).all(axis=1)
    rows = moving if moving.any() else whole & ~t.s.any(axis=1)
    evaluated = t.p @ lags
    last = int(np.flatnonzero(rows)[-1]) if rows.any() else 0
    late = sum(t.w[last, j] * (j + evaluated[last]) for j in range(t.w.shape[1]))
    return rows, round(float(late))


@dataclass(frozen=True, eq=False)
class HeldForces:
    """F on the dofs g at every evaluation, and how it changes.

    Attributes
    ----------
    force : (rows, g)
    slopes : (rows, g, columns)
    """

    force: Array
    slopes: Array

    @classmethod
    def nothing(cls, rows: int, dofs: int, columns: int) -> HeldForces:
        """Room for them."""
        return cls(np.zeros((rows, dofs)), np.zeros((rows, dofs, columns)))

    def begin(self, known: HeldForces) -> None:
        """Take over the first rows."""
        done = len(known.force)
        self.force[:done], self.slopes[:done] = known.force, known.slopes


def forces_on(dynamics: Dynamics, x: Array, dofs: Index, along: Sequence[AnyHistory] = ()) -> Array:
    """F (N, g) on some dofs at the evaluations of x (N, 3n), also those that grasps take."""
    force = np.zeros((len(x), len(dofs)))
    force[dynamics.first_row :] = dynamics.force(x, along)[:, dofs]
    return force


def reactions(dynamics: Dynamics, mass_kg: Array, force: Array, acceleration: Array) -> Array:
    """R (N, g) [N] of some dofs from their mass, the forces F on them and their acceleration."""
    return mass_kg * acceleration - dynamics.combine(dynamics.tables.w, force)


def reaction_slopes(dynamics: Dynamics, mass_kg: Array, slopes: Array, moved: Array) -> Array:
    """Changes dR (N, g, columns) from dF and from how the dofs move, both (N, g, columns)."""
    second = dynamics.combine(dynamics.tables.s, moved) / dynamics.step_s**2
    return mass_kg[..., None] * second - dynamics.combine(dynamics.tables.w, slopes)
