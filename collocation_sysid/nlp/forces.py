"""All forces on a body at some times: F(ξ, ν, t; θ) = f(ξ, ν; θ) + M g + what is applied.

Whatever acts on the body of an experiment joins here, and nothing else adds forces: the internal
ones f of its materials and dampings, see `fem.body`, the weight of its mass with what is tied to
it, and the forces on its nodes. Slopes are on the experiment's pattern.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from ..experiment.experiment import Experiment
from ..fem.body import Body, Curvature, Linearisation
from ..fem.memory import Carried
from ..fem.pattern import SymmetricPattern


@dataclass(frozen=True, eq=False)
class Forces:
    """The forces on a body at T times.

    States ξ, ν are (T, 3n) positions [m] and velocities [m/s], or one (3n,) where T is one.

    Attributes
    ----------
    body : Body
    pattern : SymmetricPattern
        Of the slopes.
    mass_kg : (T, 3n)
        What moves with every dof, which gravity pulls at and γ_m damps.
    gravity_m_s2 : (3,)
    applied_n : (T, 3n)
        Forces on the nodes, wherever these are.
    """

    body: Body
    pattern: SymmetricPattern
    mass_kg: Array
    gravity_m_s2: Array
    applied_n: Array

    @classmethod
    def of(cls, experiment: Experiment, t_s: ArrayLike) -> Forces:
        """Those of an experiment at the times `t_s` (T,)."""
        applied = experiment.node_forces_n(t_s)
        return cls(
            experiment.body,
            experiment.pattern,
            per_dof(experiment.node_mass_kg(t_s)),
            experiment.gravity_m_s2,
            compact(applied.reshape(len(applied), -1)),
        )

    @classmethod
    def on(cls, body: Body) -> Forces:
        """Those on a body that nothing acts on, at one time."""
        return cls(
            body, body.pattern, body.dof_mass[None], np.zeros(3), np.zeros((1, body.pattern.size))
        )

    def rows(self, rows: slice) -> Forces:
        """The same at some of the times."""
        return replace(self, mass_kg=self.mass_kg[rows], applied_n=self.applied_n[rows])

    def under_gravity(self, change_m_s2: Array) -> Forces:
        """The same with a constant (3,) added to gravity."""
        return replace(self, gravity_m_s2=self.gravity_m_s2 + change_m_s2)

    def scaled(self, share: float) -> Forces:
        """The same with a share of the loads."""
        return replace(
            self, gravity_m_s2=share * self.gravity_m_s2, applied_n=share * self.applied_n
        )

    def towards(self, other: Forces, share: float) -> Forces:
        """The same with a share of the way to what acts at other times."""
        mass_kg = self.mass_kg + share * (other.mass_kg - self.mass_kg)
        applied_n = self.applied_n + share * (other.applied_n - self.applied_n)
        return replace(self, mass_kg=mass_kg, applied_n=applied_n)

    @property
    def external_n(self) -> Array:
        """(T, 3n) those that do not depend on the state."""
        gravity = np.tile(self.gravity_m_s2, self.body.pattern.size // 3)
        return self.mass_kg * gravity + self.applied_n

    def total(self, xi: Array, nu: Array, theta: Array, carried: Carried | None = None) -> Array:
        """F, (T, 3n) [N]; `carried` is what the states of a body with memory bring."""
        return self.body.force(xi, nu, theta, self.mass_kg, carried) + self.external_n

    def linearise(
        self,
        xi: Array,
        nu: Array,
        theta: Array,
        out: Array | None = None,
        carried: Carried | None = None,
    ) -> Linearisation:
        """F and its slopes, at the memory as it is; views of `out` (T, `linearisation_width`)."""
        at = self.body.linearise(xi, nu, theta, out, self.mass_kg, carried)
        np.add(at.force, self.external_n, out=at.force)
        return at

    @property
    def linearisation_width(self) -> int:
        """Length of one time's row of `linearise`."""
        return self.body.linearisation_width

    def curvature(
        self,
        xi: Array,
        nu: Array,
        weights: Array,
        theta: Array,
        out: Array | None = None,
        carried: Carried | None = None,
        stress_weights: Array | None = None,
    ) -> Curvature:
        """Second derivatives of weightsᵀ F + σ·S, see `Body`; `out` is (T, `curvature_width`)."""
        mass = self.mass_kg
        return self.body.curvature(xi, nu, weights, theta, out, mass, carried, stress_weights)

    @property
    def curvature_width(self) -> int:
        """Length of one time's row of `curvature`."""
        return self.body.curvature_width


def per_dof(of_nodes: Array) -> Array:
    """(T, n) values of nodes as (T, 3n) values of their dofs."""
    return compact(np.repeat(of_nodes, 3, axis=1))


def compact(rows: Array) -> Array:
    """The same rows; where all are equal they take the memory of one."""
    return np.broadcast_to(rows[0].copy(), rows.shape) if (rows == rows[:1]).all() else rows
