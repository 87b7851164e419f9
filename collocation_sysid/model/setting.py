"""Equations of motion of one experiment at given parameters, with the chain rule to parameters.

Every force provides derivatives by the inputs u; this module turns them into derivatives by the
parameters p. Methods and statistics use `Setting` wherever derivatives by parameters are needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arrays import Array, Index
from ..fem.body import Curvature
from .dynamics import Dynamics
from .grasp_constraint import Held
from .inputs import Inputs


@dataclass(frozen=True, eq=False)
class Setting:
    """Equations of motion at parameters p = (q, φ of the motion), with the derivatives of the
    inputs.

    Attributes
    ----------
    inputs : Inputs
        Inputs u as a function of p.
    p : (m,)
        Shared coordinates q, then the nuisance parameters that affect the motion.
    nq : int
        Length of q.
    by_p : (N, U, m)
        Derivatives of the inputs by p at the N evaluations.
    dynamics : Dynamics
        Equations of motion at these inputs.
    held : Held
        Prescribed displacements of the grasped dofs.
    """

    inputs: Inputs
    p: Array
    nq: int
    by_p: Array
    dynamics: Dynamics
    held: Held

    @property
    def theta(self) -> Array:
        """Constants θ of the body (k,)."""
        return self.dynamics.theta

    @cached_property
    def theta_p(self) -> Array:
        """Derivatives ∂θ/∂p of the constants (k, m)."""
        return np.array(self.by_p[0, : len(self.theta)])

    @property
    def theta_q(self) -> Array:
        """Derivatives ∂θ/∂q of the constants (k, nq); nuisance parameters do not change θ."""
        return self.theta_p[:, : self.nq]

    def force_slopes(self, rows: int | slice, by_u: Array) -> Array:
        """Return the derivatives ∂F/∂p (…, 3n, m) of the total forces at some evaluations.

        Parameters
        ----------
        rows : int or slice
            Indices of the evaluations.
        by_u : (…, 3n, U)
            Derivatives of the forces by the inputs at these evaluations.
        """
        return by_u @ (self.by_p[0] if self._steady else self.by_p[rows])

    @property
    def _steady(self) -> bool:
        """Whether ∂u/∂p is the same at all times, including later ones of a stream."""
        return self.by_p.strides[0] == 0

    @property
    def mass_moves(self) -> bool:
        """Whether the mass M depends on p: on densities, or on times at which masses join."""
        return bool(self.dynamics.forces.mass_by_input)

    @cached_property
    def _of_rows(self) -> Array:
        """Derivatives ∂u/∂p averaged over the evaluations of each row (N, U, m)."""
        return self.by_p if self._steady else self.dynamics.of_rows(self.by_p)

    def inertia_slopes(
        self, rows: int | slice, acceleration: Array, dofs: Index | slice
    ) -> Array | float:
        """Return ∂(M a)/∂p (…, k, m) of rows at given accelerations; 0 if M is independent of p.

        Parameters
        ----------
        rows : int or slice
            Indices of the rows.
        acceleration : (…, k)
            Accelerations of the selected dofs [m/s²].
        dofs : (k,) or slice
            Indices of the selected dofs.
        """
        if not self.mass_moves:
            return 0.0
        masses = self.dynamics.forces.mass_by_input
        by_p = self._of_rows[0 if self._steady else rows][..., [*masses], :]
        mass = np.array([*masses.values()])[:, dofs]
        return acceleration[..., None] * (mass.T @ by_p)

    def curvature(self, x: Array, of_forces: Curvature, row_weights: Array) -> tuple[Array, Array]:
        """Return the second derivatives of Σ weights · c by (x, p), (N, 3n, m), and by p, (m, m).

        Parameters
        ----------
        x : (N, 3n)
            Positions [m].
        of_forces : Curvature
            Weighted second derivatives of the forces at the evaluations, by x, v and u.
        row_weights : (N, 3n)
            Weights of the residuals c.
        """
        dynamics = self.dynamics
        step_s = self.dynamics.step_s
        by_xi = of_forces.position_theta @ self.by_p
        by_nu = of_forces.velocity_theta @ self.by_p / step_s
        by_x = dynamics.combine_transposed(dynamics.state_weights, by_xi)
        by_x += dynamics.combine_transposed(dynamics.tables.q, by_nu)
        by_u = of_forces.theta
        inertia = np.zeros_like(of_forces.theta)
        if self.mass_moves:
            acceleration = dynamics.acceleration(x)
            masses = dynamics.forces.mass_by_input
            mass = np.array([*masses.values()])
            places = [*masses]
            mass_derivatives = row_weights[..., None] * (mass.T @ self._of_rows[:, places])
            by_x -= dynamics.combine_transposed(dynamics.tables.s, mass_derivatives) / step_s**2
            inertia[:, places] = (row_weights * acceleration) @ mass.T
            by_u = by_u - dynamics.to_evaluations(inertia)
        second_order = self.by_p.swapaxes(1, 2) @ of_forces.theta_theta @ self.by_p
        return by_x, second_order.sum(axis=0) + self.inputs.curvature(self.p, by_u)
