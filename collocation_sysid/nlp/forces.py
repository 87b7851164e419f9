"""All forces on a body at some times: F(ξ, ν, t; θ) = f(ξ, ν; θ) + M(θ) g + what is applied.

Whatever acts on the body of an experiment joins here, and nothing else adds forces: the internal
ones f of its materials and dampings, see `fem.body`, the weight of its mass with what is tied to
it, the forces on its nodes, and tendons and pressures, see `drives`. Slopes are on the
experiment's pattern.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from ..experiment.experiment import Experiment
from ..fem.body import Body, Curvature, Linearisation
from ..fem.memory import Carried
from ..fem.model import Theta
from ..fem.pattern import SymmetricPattern
from .drives import Drives


@dataclass(frozen=True, eq=False)
class Mass:
    """What moves with every dof at T times: M(θ), the body's own and what is tied to it.

    Attributes
    ----------
    body : Body
    tied_kg : (T, 3n)
    """

    body: Body
    tied_kg: Array

    @classmethod
    def of(cls, experiment: Experiment, t_s: ArrayLike) -> Mass:
        """Of an experiment at the times `t_s` (T,)."""
        tied = np.repeat(experiment.tied_mass_kg(t_s), 3, axis=1)
        return cls(experiment.body, compact(tied))

    def rows(self, rows: slice) -> Mass:
        """The same at some of the times."""
        return replace(self, tied_kg=self.tied_kg[rows])

    def at(self, theta: Theta) -> Array:
        """M (T, 3n) [kg]."""
        return _sum_of_rows(self.body.mass_of_dofs(theta), self.tied_kg)

    @cached_property
    def tied(self) -> Array | None:
        """(3n,) or (T, 3n) what is tied; None where nothing is."""
        if not len(self.tied_kg) or self.tied_kg.strides[0]:
            return self.tied_kg
        return self.tied_kg[0] if self.tied_kg[0].any() else None

    def row(self, t: int | slice, theta: Theta) -> Array:
        """The same (3n,) at one of the times, or (…, 3n) at some."""
        return self.body.mass_of_dofs(theta) + self.tied_kg[t]


@dataclass(frozen=True, eq=False)
class Forces:
    """The forces on a body at T times.

    States ξ, ν are (T, 3n) positions [m] and velocities [m/s], or one (3n,) where T is one.

    Attributes
    ----------
    body : Body
    mass : Mass
        What gravity pulls at and γ_m damps.
    gravity_m_s2 : (3,)
    applied_n : (T, 3n)
        Forces on the nodes, wherever these are.
    drives : Drives
    """

    body: Body
    mass: Mass
    gravity_m_s2: Array
    applied_n: Array
    drives: Drives

    @classmethod
    def of(cls, experiment: Experiment, t_s: ArrayLike) -> Forces:
        """Those of an experiment at the times `t_s` (T,)."""
        applied = experiment.node_forces_n(t_s)
        return cls(
            experiment.body,
            Mass.of(experiment, t_s),
            experiment.gravity_m_s2,
            compact(applied.reshape(len(applied), -1)),
            Drives.of(experiment, t_s),
        )

    @classmethod
    def on(cls, body: Body) -> Forces:
        """Those on a body that nothing acts on, at one time."""
        nothing = np.zeros((1, body.pattern.size))
        return cls(body, Mass(body, nothing), np.zeros(3), nothing, Drives.none(body))

    @property
    def pattern(self) -> SymmetricPattern:
        """Of the slopes."""
        return self.drives.joined.pattern

    def rows(self, rows: slice) -> Forces:
        """The same at some of the times."""
        return replace(
            self,
            mass=self.mass.rows(rows),
            applied_n=self.applied_n[rows],
            drives=self.drives.rows(rows),
        )

    def under_gravity(self, change_m_s2: Array) -> Forces:
        """The same with a constant (3,) added to gravity."""
        return replace(self, gravity_m_s2=self.gravity_m_s2 + change_m_s2)

    def joined_by(self, tied_kg: Array, applied_n: Array) -> Forces:
        """The same with more mass tied to it, and more forces on its nodes, (T, 3n) both."""
        mass = replace(self.mass, tied_kg=self.mass.tied_kg + tied_kg)
        return replace(self, mass=mass, applied_n=self.applied_n + applied_n)

    def scaled(self, share: float) -> Forces:
        """The same with a share of the loads, those of tendons and pressures too."""
        return replace(
            self,
            gravity_m_s2=share * self.gravity_m_s2,
            applied_n=share * self.applied_n,
            drives=replace(self.drives, share=share * self.drives.share),
        )

    def towards(self, other: Forces, share: float) -> Forces:
        """The same with a share of the way to what acts at other times."""
        tied_kg = self.mass.tied_kg + share * (other.mass.tied_kg - self.mass.tied_kg)
        applied_n = self.applied_n + share * (other.applied_n - self.applied_n)
        drives = self.drives.towards(other.drives, share)
        mass = replace(self.mass, tied_kg=tied_kg)
        return replace(self, mass=mass, applied_n=applied_n, drives=drives)

    def undriven(self) -> Forces:
        """The same without tensions and pressures."""
        return replace(self, drives=Drives.none(self.body))

    def driven(self, values: Array) -> Forces:
        """The same with tensions and pressures that are off by values (A, 2), see `Drives`."""
        return replace(self, drives=self.drives.off_by(values))

    @cached_property
    def _gravity(self) -> Array:
        """(3n,)."""
        return np.tile(self.gravity_m_s2, self.body.pattern.size // 3)

    def external_n(self, theta: Theta) -> Array:
        """(T, 3n) those that do not depend on the state: weight, and forces on nodes."""
        if not self.body.mass_slopes:
            return self._external_n
        return self.mass.at(theta) * self._gravity + self.applied_n

    @cached_property
    def _external_n(self) -> Array:
        """The same of densities as stated; once for the iterations of a small body's row."""
        return _sum_of_rows(self.body.dof_mass, self.mass.tied_kg) * self._gravity + self.applied_n

    def total(self, xi: Array, nu: Array, theta: Array, carried: Carried | None = None) -> Array:
        """F, (T, 3n) [N]; `carried` is what the states of a body with memory bring."""
        internal = self.body.force(xi, nu, theta, self.mass.tied, carried)
        return internal + self.external_n(theta) + self.drives.force(xi)

    def linearise(
        self,
        xi: Array,
        nu: Array,
        theta: Array,
        out: Array | None = None,
        carried: Carried | None = None,
    ) -> Linearisation:
        """F and its slopes, at the memory as it is; views of `out` (T, `linearisation_width`).

        Slopes by θ have two more columns for each of the drives.
        """
        at = self.body.linearise(xi, nu, theta, out, self.mass.tied, carried)
        np.add(at.force, self.external_n(theta), out=at.force)
        for density, slope in self.body.mass_slopes.items():
            at.by_theta[:, :, density] += slope * self._gravity
        return self.drives.added_to(at, xi)

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
        tied = self.mass.tied
        found = self.body.curvature(xi, nu, weights, theta, out, tied, carried, stress_weights)
        for density, slope in self.body.mass_slopes.items():
            found.theta[:, density] += weights @ (slope * self._gravity)
        return self.drives.bent(found, xi, weights)

    @property
    def curvature_width(self) -> int:
        """Length of one time's row of `curvature`."""
        return self.body.curvature_width


def compact(rows: Array) -> Array:
    """The same rows; where all are equal they take the memory of one."""
    return np.broadcast_to(rows[0].copy(), rows.shape) if (rows == rows[:1]).all() else rows


def _sum_of_rows(one: Array, rows: Array) -> Array:
    """(3n,) + (T, 3n), in the memory of one row where all rows are."""
    if len(rows) and rows.strides[0] == 0:
        return np.broadcast_to(one + rows[0], rows.shape)
    return one + rows
