"""The equations of motion of one experiment at a point, and what parameters do to them."""

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
    """Inputs u at parameters p = (q, φ that move the body), and the equations with them.

    Attributes
    ----------
    inputs : Inputs
    p : (m,)
    nq : int
        Number of q.
    by_p : (N, U, m) derivatives of u
    dynamics : Dynamics at u
    held : Held
        Where the grasps are.
    """

    inputs: Inputs
    p: Array
    nq: int
    by_p: Array
    dynamics: Dynamics
    held: Held

    @property
    def theta(self) -> Array:
        """(k,) constants of the body."""
        return self.dynamics.theta

    @cached_property
    def theta_p(self) -> Array:
        """(k, m) derivatives of θ."""
        return np.array(self.by_p[0, : len(self.theta)])

    @property
    def theta_q(self) -> Array:
        """(k, nq) those by q: no φ changes θ."""
        return self.theta_p[:, : self.nq]

    def force_slopes(self, rows: int | slice, by_u: Array) -> Array:
        """∂F/∂p of total forces, (…, 3n, m), from ∂F/∂u (…, 3n, U) at some evaluations."""
        return by_u @ (self.by_p[0] if self._steady else self.by_p[rows])

    @property
    def _steady(self) -> bool:
        """Whether ∂u/∂p is the same at all times, also at those to come."""
        return self.by_p.strides[0] == 0

    @property
    def mass_moves(self) -> bool:
        """Whether M depends on p: on densities, or on when masses join."""
        return bool(self.dynamics.forces.mass_by_input)

    @cached_property
    def _of_rows(self) -> Array:
        """(N, U, m) ∂u/∂p of rows instead of evaluations: the mean of theirs."""
        return self.by_p if self._steady else self.dynamics.of_rows(self.by_p)

    def inertia_slopes(
        self, rows: int | slice, acceleration: Array, dofs: Index | slice
    ) -> Array | float:
        """∂(M a)/∂p, (…, k, m), of rows at accelerations (…, k) of dofs."""
        if not self.mass_moves:
            return 0.0
        masses = self.dynamics.forces.mass_by_input
        by_p = self._of_rows[0 if self._steady else rows][..., [*masses], :]
        mass = np.array([*masses.values()])[:, dofs]
        return acceleration[..., None] * (mass.T @ by_p)

    def curvature(self, x: Array, of_forces: Curvature, row_weights: Array) -> tuple[Array, Array]:
        """Second derivatives of Σ weights · c by (x, p), (N, 3n, m), and by p, (m, m).

        Parameters
        ----------
        x : (N, 3n)
        of_forces : Curvature of the forces at the evaluations, by x, v and u
        row_weights : (N, 3n) of c
        """
        dynamics, step_s = self.dynamics, self.dynamics.step_s
        by_xi = of_forces.position_theta @ self.by_p
        by_nu = of_forces.velocity_theta @ self.by_p / step_s
        by_x = dynamics.combine_transposed(dynamics.state_weights, by_xi)
        by_x += dynamics.combine_transposed(dynamics.tables.q, by_nu)
        by_u, inertia = of_forces.theta, np.zeros_like(of_forces.theta)
        if self.mass_moves:
            acceleration = dynamics.acceleration(x)
            masses = dynamics.forces.mass_by_input
            mass, places = np.array([*masses.values()]), [*masses]
            pulled = row_weights[..., None] * (mass.T @ self._of_rows[:, places])
            by_x -= dynamics.combine_transposed(dynamics.tables.s, pulled) / step_s**2
            inertia[:, places] = (row_weights * acceleration) @ mass.T
            by_u = by_u - dynamics.to_evaluations(inertia)
        twice = self.by_p.swapaxes(1, 2) @ of_forces.theta_theta @ self.by_p
        return by_x, twice.sum(axis=0) + self.inputs.curvature(self.p, by_u)
