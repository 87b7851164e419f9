"""Reaction forces of grasps: the residual of the equations of motion at the prescribed dofs.

On the dofs g of grasps whose force or torque is measured,

    R_t = M a_t − Σ_j w_j F_{t−j} = −c_{t,g},

with the stencils of the scheme, see `model.schemes`. Changes along the equations of motion use the
rows g of G = ∂F/∂ξ and C = ∂F/∂ν:

    dF_k = G Σ_i p_i Y_{k−i} + C Σ_i q_i Y_{k−i} + ∂F/∂p + change due to history variables.

A row belongs to the time in the middle of its stencil: with the midpoint rule row t is the balance
of momentum about t − 1. Rows of the start know the acceleration to first order only and are left
out.

Use `reactions_at` for values, `linearised_reactions` for changes along the equations of motion, and
`reaction_vjp` for gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ...model.dynamics import Dynamics
from ...model.equations_at_parameters import EquationsAtParameters
from ...model.internal_variables import AnyHistory
from ..linear_algebra.block_band import Submatrix
from ..observables import ReactionForces


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
    second = np.column_stack([t.s.sum(axis=1), t.s @ lags, t.s @ lags**2 - 2, t.r])
    is_complete = np.isclose(t.w.sum(axis=1), 1.0)
    moving = is_complete & np.isclose(second, 0.0).all(axis=1)
    rows = moving if moving.any() else is_complete & ~t.s.any(axis=1)
    evaluated = t.p @ lags
    last = int(np.flatnonzero(rows)[-1]) if rows.any() else 0
    delay = sum(t.w[last, j] * (j + evaluated[last]) for j in range(t.w.shape[1]))
    return rows, round(float(delay))


@dataclass(frozen=True, eq=False)
class GraspForces:
    """Forces F on the sensed dofs at every evaluation, and their changes."""

    force: Array  # (rows, g): forces [N]
    changes: Array  # (rows, g, columns): changes dF of each column of a forward substitution

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
    dynamics: Dynamics, x: Array, dofs: Index, histories: Sequence[AnyHistory] = ()
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


def reactions_at(
    dynamics: Dynamics, x: Array, dofs: Index, histories: Sequence[AnyHistory] = ()
) -> ReactionForces:
    """Return the reaction forces on selected dofs (g,) of a motion, without changes.

    Parameters
    ----------
    dynamics : Dynamics
        Equations of motion; rows after those of x are not used.
    x : (rows, 3n) array
        Positions [m].
    dofs : (g,) array
        Selected dofs.
    histories : sequence of histories
        History variables at x; computed from x if it is empty.
    """
    dynamics = dynamics.truncated_to(len(x))
    reaction = reaction_forces(
        dynamics,
        dynamics.mass.inertia_kg[:, dofs],
        force=forces_on_dofs(dynamics, x, dofs=dofs, histories=histories),
        acceleration=dynamics.acceleration(x)[:, dofs],
    )
    return ReactionForces(reaction, x[:, dofs])


def linearised_reactions(
    equations: EquationsAtParameters,
    x: Array,
    grasp_forces: GraspForces,
    position_changes: Array,
    dofs: Index,
    step: Array | None = None,
    is_by_parameters: bool = True,
) -> ReactionForces:
    """Return the reaction forces on selected dofs with their changes along the equations of motion.

    Parameters
    ----------
    x : (rows, 3n) array
        Positions [m].
    grasp_forces : GraspForces
        Forces on the dofs at x, with their changes.
    position_changes : (rows, g, c) array
        Changes of the positions of the dofs [m].
    dofs : (g,) array
        Selected dofs.
    step : (rows, 3n) array, optional
        Step of the positions [m]. If given, values are those after the step, to first order, and
        column 0 of the forces must belong to it; it has no column in the result.
    is_by_parameters : bool
        Whether the columns are derivatives by the parameters that change the motion, which also
        change the masses.
    """
    dynamics = equations.dynamics.truncated_to(len(x))
    if step is not None:
        position_changes = np.concatenate([step[:, dofs, None], position_changes], axis=2)
    acceleration = dynamics.acceleration(x)[:, dofs]
    mass_kg = dynamics.mass.inertia_kg[:, dofs]
    reaction = reaction_forces(
        dynamics, mass_kg, force=grasp_forces.force, acceleration=acceleration
    )
    by = reaction_changes(
        dynamics, mass_kg, force_changes=grasp_forces.changes, position_changes=position_changes
    )
    if is_by_parameters:
        first = 0 if step is None else 1
        by[..., first:] += equations.inertia_derivatives(slice(len(x)), acceleration, dofs=dofs)
    if step is None:
        return ReactionForces(reaction, x[:, dofs], reaction_by=by, position_by=position_changes)
    return ReactionForces(
        reaction + by[..., 0],
        x[:, dofs] + position_changes[..., 0],
        reaction_by=by[..., 1:],
        position_by=position_changes[..., 1:],
    )


def reaction_vjp(
    equations: EquationsAtParameters, x: Array, weights: Array, dofs: Index, buffer: Array
) -> tuple[Array, Array, Array]:
    """Vector–Jacobian product of the reaction forces R on selected dofs, with history variables
    kept constant.

    Parameters
    ----------
    x : (N, 3n) array
        Positions [m].
    weights : (N, g) array
        Weights of the reaction forces [1/N].
    dofs : (g,) array
        Selected dofs.
    buffer : array
        Work space of `Dynamics.linearise`, overwritten.

    Returns
    -------
    by_x : (N, 3n) array
        Derivatives by the positions [1/m].
    by_parameters : (m,) array
        Derivatives by the parameters that change the motion.
    force_weights : (N, 3n) array
        Weights of the forces at the evaluations [1/N], by which history variables contribute.
    """
    dynamics = equations.dynamics
    t = dynamics.tables
    first = dynamics.first_row
    force_weights = np.zeros_like(x)
    force_weights[:, dofs] = -dynamics.combine_transposed(t.w, weights)
    at = dynamics.linearise(x, buffer)
    slopes = equations.force_derivatives(slice(first, None), at.by_theta)
    by_p = np.einsum("tg,tgp->p", force_weights[first:, dofs], slopes[:, dofs])
    if equations.mass_depends_on_parameters:
        acceleration = dynamics.acceleration(x)[:, dofs]
        own = equations.inertia_derivatives(slice(None), acceleration, dofs=dofs)
        by_p += np.einsum("tg,tgp->p", weights, own)
    rows = Submatrix(dynamics.pattern, dofs)
    state = np.zeros_like(x)
    rate = np.zeros_like(x)
    for k, weight in enumerate(force_weights[first:, dofs]):
        if weight.any():
            skew = at.by_position_skew[k]
            state[first + k] = rows.extract(at.by_position[k], skew).T @ weight
            rate[first + k] = rows.extract(at.by_velocity[k], at.by_velocity_skew[k]).T @ weight
    by_x = dynamics.combine_transposed(t.p, state)
    by_x += dynamics.combine_transposed(t.q, rate) / dynamics.step_s
    mass_kg = dynamics.mass.inertia_kg[:, dofs]
    inertia = dynamics.combine_transposed(t.s, mass_kg * weights)
    by_x[:, dofs] += inertia / dynamics.step_s**2
    return by_x, by_p, force_weights


def reaction_forces(dynamics: Dynamics, mass_kg: Array, force: Array, acceleration: Array) -> Array:
    """Return the reaction forces R (N, g) [N] of dofs.

    Parameters
    ----------
    mass_kg : (N, g) array
        Masses of the dofs [kg].
    force : (N, g) array
        Forces F on the dofs [N].
    acceleration : (N, g) array
        Accelerations of the dofs [m/s²].
    """
    return mass_kg * acceleration - dynamics.combine(dynamics.tables.w, force)


def reaction_changes(
    dynamics: Dynamics, mass_kg: Array, force_changes: Array, position_changes: Array
) -> Array:
    """Return the changes dR (N, g, columns) of reaction forces at constant masses.

    Parameters
    ----------
    mass_kg : (N, g) array
        Masses of the dofs [kg].
    force_changes : (N, g, columns) array
        Changes dF of the forces [N].
    position_changes : (N, g, columns) array
        Changes of the positions of the dofs [m].
    """
    second = dynamics.combine(dynamics.tables.s, position_changes) / dynamics.step_s**2
    return mass_kg[..., None] * second - dynamics.combine(dynamics.tables.w, force_changes)
