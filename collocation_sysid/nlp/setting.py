"""The physical parameters of one experiment at a point, with their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from .dynamics import Dynamics
from .held import Held
from .joining import Joining


@dataclass(frozen=True, eq=False)
class Setting:
    """θ and gravity at the parameters (q, φ) of one experiment.

    Attributes
    ----------
    theta : (k,) constants of the body
    theta_q, theta_qq : (k, nq) and (k, nq, nq) derivatives of θ
    dynamics : Dynamics under that gravity, with those loads
    gravity_m_s2 : (3,) its change from that stated
    gravity_phi, gravity_phi_phi : (3, m) and (3, m, m) derivatives of gravity by the φ that move
        the body
    held : Held
        Where the grasps are.
    joining : tuple of Joining
        Loads that join or leave at estimated times.
    """

    theta: Array
    theta_q: Array
    theta_qq: Array
    dynamics: Dynamics
    gravity_m_s2: Array
    gravity_phi: Array
    gravity_phi_phi: Array
    held: Held
    joining: tuple[Joining, ...]

    def columns(self, count: int, first: int = 1) -> Array:
        """(k, count) θ's derivatives by what columns stand for, those of q from `first` on."""
        found = np.zeros((len(self.theta), count))
        found[:, first : first + self.theta_q.shape[1]] = self.theta_q
        return found

    def force_slopes(self, rows: int | slice, by_theta: Array, nu: Array) -> Array:
        """∂F/∂(q, φ) of total forces, (…, 3n, nq + m).

        Parameters
        ----------
        rows : the evaluations
        by_theta : (…, 3n, k) of the internal forces
        nu : (…, 3n) velocities
        """
        of_q = by_theta @ self.theta_q
        if not self.gravity_phi.shape[1]:
            return of_q
        pull = np.tile(self.gravity_phi, (by_theta.shape[-2] // 3, 1))
        of_phi = self.dynamics.weighed_kg[rows][..., None] * pull
        for load in self.joining:
            of_phi[..., load.column] += load.slope(rows, self.braking(nu))
        return np.concatenate([of_q, of_phi], axis=-1)

    def braking(self, nu: Array) -> Array:
        """Change of gravity, and −γ_m ν, at velocities (…, 3n) [m/s²]."""
        change = np.tile(self.gravity_m_s2, nu.shape[-1] // 3)
        return change - self.dynamics.body.drag(self.theta) * nu

    def curvature(
        self, load: Joining, x: Array, force_weights: Array, row_weights: Array
    ) -> tuple[Array, Array, Array]:
        """Derivatives by q (nq,), x (N, 3n) and φ (m,) of what a load's φ does to weighted rows.

        Parameters
        ----------
        load : one of `joining`
        x : (N, 3n)
        force_weights, row_weights : (N, 3n), of F and of c
        """
        dynamics, mass = self.dynamics, load.mass_kg
        nu = dynamics.combine(dynamics.tables.q, x) / dynamics.step_s
        pulled = load.share[1, :, None] * mass * force_weights
        carried = load.row_share[1, :, None] * mass * row_weights
        shares = dynamics.body.drag_shares
        by_drag = -np.sum(pulled * nu, axis=0)
        by_q = np.sum([by_drag @ share * self.theta_q[k] for k, share in shares.items()], axis=0)
        braked = -dynamics.body.drag(self.theta) * pulled
        by_x = dynamics.combine_transposed(dynamics.tables.q, braked) / dynamics.step_s
        by_x -= dynamics.combine_transposed(dynamics.tables.s, carried) / dynamics.step_s**2
        by_phi = pulled.sum(axis=0).reshape(-1, 3).sum(axis=0) @ self.gravity_phi
        change = load.share[2, :, None] * (mass * self.braking(nu) + load.force_n)
        inertia = load.row_share[2, :, None] * mass * dynamics.acceleration(x)
        by_phi[load.column] = np.sum(force_weights * change) - np.sum(row_weights * inertia)
        return by_q, by_x, by_phi

    def inertia_slopes(self, rows: int | slice, acceleration: Array) -> Array:
        """∂c/∂(q, φ) (…, 3n, nq + m) through the mass that moves, at accelerations (…, 3n)."""
        moving = self.theta_q.shape[1] + self.gravity_phi.shape[1]
        slopes = np.zeros((*acceleration.shape, moving))
        for load in self.joining:
            own = load.row_share[1, rows][..., None] * load.mass_kg * acceleration
            slopes[..., self.theta_q.shape[1] + load.column] -= own
        return slopes
