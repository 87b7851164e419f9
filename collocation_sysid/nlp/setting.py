"""The physical parameters of one experiment at a point, with their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Index
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
    gravity_phi, gravity_phi_phi : (3, m) and (3, m, m) derivatives of gravity by the φ that move
        the body
    drive_phi : (2 A, m)
        Derivatives of what tensions and pressures are off by, see `Drives`.
    held : Held
        Where the grasps are.
    joining : tuple of Joining
        Loads that join or leave at estimated times.
    """

    theta: Array
    theta_q: Array
    theta_qq: Array
    dynamics: Dynamics
    gravity_phi: Array
    gravity_phi_phi: Array
    drive_phi: Array
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
        by_theta : (…, 3n, k + 2 A)
        nu : (…, 3n) velocities
        """
        of_q = self.by_q(by_theta)
        if not self.gravity_phi.shape[1]:
            return of_q
        pull = np.tile(self.gravity_phi, (by_theta.shape[-2] // 3, 1))
        weighed_kg = self.dynamics.forces.mass.row(rows, self.theta)
        of_phi = weighed_kg[..., None] * pull + self.by_drive(by_theta)
        for load in self.joining:
            of_phi[..., load.column] += load.slope(rows, self._falling(nu))
        return np.concatenate([of_q, of_phi], axis=-1)

    def by_q(self, by_theta: Array) -> Array:
        """(…, nq) derivatives by q from those by θ and what drives are off by, (…, k + 2 A)."""
        return by_theta[..., : len(self.theta)] @ self.theta_q

    def by_drive(self, by_theta: Array) -> Array:
        """(…, m) the same by the φ of drives."""
        return by_theta[..., len(self.theta) :] @ self.drive_phi

    def _falling(self, nu: Array) -> Array:
        """Acceleration g − γ_m ν of what is tied to the body, at velocities (…, 3n) [m/s²]."""
        gravity = np.tile(self.dynamics.forces.gravity_m_s2, nu.shape[-1] // 3)
        return gravity - self.dynamics.body.tied_drag(self.theta) * nu

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
        shares = dynamics.body.tied_shares
        by_drag = -np.sum(pulled * nu, axis=0)
        by_q = np.sum([by_drag @ share * self.theta_q[k] for k, share in shares.items()], axis=0)
        braked = -dynamics.body.tied_drag(self.theta) * pulled
        by_x = dynamics.combine_transposed(dynamics.tables.q, braked) / dynamics.step_s
        by_x -= dynamics.combine_transposed(dynamics.tables.s, carried) / dynamics.step_s**2
        by_phi = pulled.sum(axis=0).reshape(-1, 3).sum(axis=0) @ self.gravity_phi
        change = load.share[2, :, None] * (mass * self._falling(nu) + load.force_n)
        inertia = load.row_share[2, :, None] * mass * dynamics.acceleration(x)
        by_phi[load.column] = np.sum(force_weights * change) - np.sum(row_weights * inertia)
        return by_q, by_x, by_phi

    @property
    def mass_moves(self) -> bool:
        """Whether M depends on (q, φ): on densities, or on when masses join."""
        return bool(self.dynamics.body.mass_slopes or self.joining)

    def inertia_slopes(
        self, rows: int | slice, acceleration: Array, dofs: Index | slice
    ) -> Array | float:
        """∂(M a)/∂(q, φ), (…, k, nq + m), of rows at accelerations (…, k) of dofs."""
        if not self.mass_moves:
            return 0.0
        nq = self.theta_q.shape[1]
        found = np.zeros((*acceleration.shape, nq + self.gravity_phi.shape[1]))
        for density, slope in self.dynamics.body.mass_slopes.items():
            found[..., :nq] += (slope[dofs] * acceleration)[..., None] * self.theta_q[density]
        for load in self.joining:
            mass = load.row_share[1, rows][..., None] * load.mass_kg[dofs]
            found[..., nq + load.column] += mass * acceleration
        return found
