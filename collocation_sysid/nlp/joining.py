"""Loads that join or leave at estimated times: what they add to the equations of motion.

With s(t) the share of a load that is there, m its mass at every dof and f its force, the force at
evaluation k and the inertia of row t have

    F_k ∋ s_k (m (g − γ_m ν_k) + f_k),    c_t ∋ −s̄_t m a_t,    s̄_t = Σ_j w_j s_{t−j} / Σ_j w_j,

so that what falls freely goes on falling so, whatever joins it. s depends on one φ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Index
from ..experiment.experiment import Experiment
from ..experiment.loads import PointMass, ramp
from ..experiment.nuisance import JOINING
from .dynamics import Dynamics
from .nuisance import NuisanceMap


@dataclass(frozen=True, eq=False)
class Joining:
    """One load at φ.

    Attributes
    ----------
    column : place of its φ among those that move the body
    mass_kg : (3n,) m
    force_n : (N, 3n) f at the evaluations
    share : (3, N) s at the evaluations, as a change from that stated, and its two derivatives by φ
    row_share : (3, N) the same of the rows' s̄
    """

    column: int
    mass_kg: Array
    force_n: Array
    share: Array
    row_share: Array

    @property
    def dofs(self) -> Index:
        """Those on which it acts."""
        return np.flatnonzero((self.mass_kg != 0) | self.force_n.any(axis=0))

    def slope(self, rows: int | slice, falling_m_s2: Array) -> Array:
        """∂F/∂φ (…, 3n) at evaluations, at g − γ_m ν (…, 3n)."""
        slope = self.share[1, rows]
        return slope[..., None] * (self.mass_kg * falling_m_s2 + self.force_n[rows])


@dataclass(frozen=True, eq=False)
class Joinings:
    """The loads of an experiment that join or leave at estimated times."""

    experiment: Experiment
    nuisance: NuisanceMap
    dynamics: Dynamics

    def at(self, phi: Array) -> tuple[Joining, ...]:
        """All of them at φ."""
        nuisance, dynamics = self.nuisance, self.dynamics
        half_s, found = self.experiment.timestep_s, []
        columns = np.flatnonzero(np.isin(nuisance.moving, nuisance.places(JOINING)))
        for column, timed in zip(columns, nuisance.timed, strict=True):
            k = nuisance.moving[column]
            scale, sign = nuisance.scales[k] / half_s, 1.0 if timed.change == "from_s" else -1.0
            stated = (dynamics.evaluated_s - timed.stated_s) / half_s
            u = stated - scale * phi[k]
            change = ramp(u) - ramp(stated)
            share = sign * np.stack([change, -scale * ramp(u, 1), scale**2 * ramp(u, 2)])
            rows = dynamics.of_rows(share.T).T
            found.append(Joining(int(column), *self._profile(timed.load), share, rows))
        return tuple(found)

    def _profile(self, load: object) -> tuple[Array, Array]:
        dynamics, nodes = self.dynamics, len(self.experiment.body.nodes_m)
        if isinstance(load, PointMass):
            nothing = np.broadcast_to(0.0, (dynamics.rows, 3 * nodes))
            return np.repeat(load.at_nodes(nodes), 3), nothing
        force = load.at_nodes(dynamics.evaluated_s, nodes)  # type: ignore[attr-defined]
        return np.zeros(3 * nodes), force.reshape(dynamics.rows, -1)
