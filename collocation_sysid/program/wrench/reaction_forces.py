"""Reaction forces of grasps: the residual of the equations of motion at the prescribed dofs.

On the dofs g of grasps whose wrench is measured,

    R_t = M a_t − Σ_j w_j F_{t−j} = −c_{t,g},

with the stencils of the scheme, see `model.schemes`. Changes along the equations of motion use the
rows g of G = ∂F/∂ξ and C = ∂F/∂ν:

    dF_k = G Σ_i p_i Y_{k−i} + C Σ_i q_i Y_{k−i} + ∂F/∂p + change due to history variables.

A row belongs to the time in the middle of its stencil: with the midpoint rule row t is the balance
of momentum about t − 1. Rows of the start know the acceleration to first order only and are left
out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ...model.dynamics import Dynamics
from ...model.internal_variables import AnyHistory


def centred_rows(dynamics: Dynamics) -> tuple[NDArray[np.bool_], int]:
    """Return the rows that determine a reaction force, and their delay.

    Those are the rows whose acceleration is second-order accurate in the middle of the stencil; in
    a static problem all rows, at their own times.

    Returns
    -------
    ((N,) array of bool, int)
        Mask of the rows, and the number of grid times by which the reaction force precedes its row;
        0 if there is no such row.
    """
    t = dynamics.tables
    lags = np.arange(dynamics.largest_lag + 1.0)
    second = np.column_stack(
        [t.s.sum(axis=1), t.s @ lags, t.s @ lags**2 - 2, t.r]
    )
    is_complete = np.isclose(t.w.sum(axis=1), 1.0)
    moving = is_complete & np.isclose(second, 0.0).all(axis=1)
    rows = moving if moving.any() else is_complete & ~t.s.any(axis=1)
    evaluated = t.p @ lags
    last = int(np.flatnonzero(rows)[-1]) if rows.any() else 0
    delay = sum(
        t.w[last, j] * (j + evaluated[last]) for j in range(t.w.shape[1])
    )
    return rows, round(float(delay))


@dataclass(frozen=True, eq=False)
class GraspForces:
    """Forces F on the sensed dofs at every evaluation, and their changes.

    Attributes
    ----------
    force : (rows, g) array
        Forces [N].
    changes : (rows, g, columns) array
        Changes dF of each column of a forward substitution.
    """

    force: Array
    changes: Array

    @classmethod
    def zeros(cls, rows: int, dofs: int, columns: int) -> GraspForces:
        """Allocate zeros for `rows` evaluations, `dofs` dofs and `columns` columns."""
        return cls(np.zeros((rows, dofs)), np.zeros((rows, dofs, columns)))

    def copy_first_rows(self, known: GraspForces) -> None:
        """Copy the rows of `known`, which may be fewer, into the first rows, in place."""
        done = len(known.force)
        self.force[:done] = known.force
        self.changes[:done] = known.changes


def forces_on_dofs(
    dynamics: Dynamics,
    x: Array,
    dofs: Index,
    histories: Sequence[AnyHistory] = (),
) -> Array:
    """Return the forces F (N, g) [N] on selected dofs at the evaluations, including those on
    prescribed dofs.

    Parameters
    ----------
    dynamics : Dynamics
        Equations of motion of the N rows of x.
    x : (N, 3n) array
        Positions [m].
    dofs : (g,) array
        Selected dofs.
    histories : sequence of histories
        History variables at x; computed from x if it is empty.

    Returns
    -------
    (N, g) array
        Forces; zero in rows before the first equation of motion.
    """
    force = np.zeros((len(x), len(dofs)))
    force[dynamics.first_row :] = dynamics.force(x, histories)[:, dofs]
    return force


def reaction_forces(
    dynamics: Dynamics, mass_kg: Array, force: Array, acceleration: Array
) -> Array:
    """Return the reaction forces R (N, g) [N] of dofs.

    Parameters
    ----------
    dynamics : Dynamics
        Equations of motion.
    mass_kg : (N, g) array
        Masses of the dofs [kg].
    force : (N, g) array
        Forces F on the dofs [N].
    acceleration : (N, g) array
        Accelerations of the dofs [m/s²].
    """
    return mass_kg * acceleration - dynamics.combine(dynamics.tables.w, force)


def reaction_changes(
    dynamics: Dynamics,
    mass_kg: Array,
    force_changes: Array,
    position_changes: Array,
) -> Array:
    """Return the changes dR (N, g, columns) of reaction forces at constant masses.

    Parameters
    ----------
    dynamics : Dynamics
        Equations of motion.
    mass_kg : (N, g) array
        Masses of the dofs [kg].
    force_changes : (N, g, columns) array
        Changes dF of the forces [N].
    position_changes : (N, g, columns) array
        Changes of the positions of the dofs [m].
    """
    second = (
        dynamics.combine(dynamics.tables.s, position_changes)
        / dynamics.step_s**2
    )
    return mass_kg[..., None] * second - dynamics.combine(
        dynamics.tables.w, force_changes
    )
