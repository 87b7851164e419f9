"""The physical parameters of one experiment at a point, with their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Index
from .dynamics import Dynamics
from .held import Held


@dataclass(frozen=True, eq=False)
class Setting:
    """θ and gravity at the parameters (q, φ) of one experiment.

    Attributes
    ----------
    theta : (k,) constants of the body
    theta_q, theta_qq : (k, nq) and (k, nq, nq) derivatives of θ
    dynamics : Dynamics under that gravity
    gravity_phi, gravity_phi_phi : (3, m) and (3, m, m) derivatives of gravity by the φ that move
        the body
    drive_phi : (2 A, m)
        Derivatives of what tensions and pressures are off by, see `Drives`.
    held : Held
        Where the grasps are.
    """

    theta: Array
    theta_q: Array
    theta_qq: Array
    dynamics: Dynamics
    gravity_phi: Array
    gravity_phi_phi: Array
    drive_phi: Array
    held: Held

    def columns(self, count: int, first: int = 1) -> Array:
        """(k, count) θ's derivatives by what columns stand for, those of q from `first` on."""
        found = np.zeros((len(self.theta), count))
        found[:, first : first + self.theta_q.shape[1]] = self.theta_q
        return found

    def inertia_slopes(self, acceleration: Array, dofs: Index | slice) -> Array | float:
        """∂(M a)/∂(q, φ), (…, k, nq + m), at accelerations (…, k) of dofs."""
        slopes = self.dynamics.body.mass_slopes
        if not slopes:
            return 0.0  # M is known
        of_q = np.zeros((*acceleration.shape, self.theta_q.shape[1] + self.gravity_phi.shape[1]))
        for density, slope in slopes.items():
            along = (slope[dofs] * acceleration)[..., None] * self.theta_q[density]
            of_q[..., : self.theta_q.shape[1]] += along
        return of_q

    def force_slopes(self, by_theta: Array, weighed_kg: Array) -> Array:
        """∂F/∂(q, φ) of total forces, (…, 3n, nq + m).

        Parameters
        ----------
        by_theta : (…, 3n, k + 2 A)
        weighed_kg : (…, 3n) what gravity pulls at
        """
        of_q = self.by_q(by_theta)
        if not self.gravity_phi.shape[1]:
            return of_q
        pull = np.tile(self.gravity_phi, (by_theta.shape[-2] // 3, 1))
        of_phi = weighed_kg[..., None] * pull + self.by_drive(by_theta)
        return np.concatenate([of_q, of_phi], axis=-1)

    def by_q(self, by_theta: Array) -> Array:
        """(…, nq) derivatives by q from those by θ and what drives are off by, (…, k + 2 A)."""
        return by_theta[..., : len(self.theta)] @ self.theta_q

    def by_drive(self, by_theta: Array) -> Array:
        """(…, m) the same by the φ of drives."""
        return by_theta[..., len(self.theta) :] @ self.drive_phi
