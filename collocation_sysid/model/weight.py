"""Weight, and loads that join or leave at estimated times.

With M(u) = M(ρ) + m + Σ_l s_l m_l the mass of every dof, of which m is tied to the body as stated
and m_l joins with a load whose share is s_l(t), f_l a load's force and γ_m what damps all mass,

    F_k = (M(u_k) − D) g + f_k + Σ_l s_l,k (f_l,k − γ_m m_l ν_k),    c_t ∋ −(M(ū_t) + A) a_t,

D being the mass of the air that the body displaces and A that of the air that moves with it, which
γ_m does not damp and gravity does not pull at, see `fem.air`,
ū_t being the mean over the evaluations as row t weighs them, so that what falls freely goes on
falling so, whatever joins it. Inputs are gravity, where a parameter turns it, and each s_l, as a
change from the share that is stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from ..fem.air import ADDED_MASS_SHARE
from ..fem.body import Body, Curvature, Linearisation
from ..fem.regions import Theta
from ..recording.experiment import Experiment
from ..recording.loads import Force, PointMass
from .force_term import ForceTerm, Slots, States


@dataclass(frozen=True, eq=False)
class Mass:
    """Mass of every dof at T times: the body's own, what is tied to it, and that of the air.

    Attributes
    ----------
    own_kg : (3n,)
        The body's own.
    tied_kg : (T, 3n)
        Point masses.
    displaced_kg : (3n,)
        Air that the body displaces: buoyancy makes its weight less by the weight of this air.
    added_kg : (3n,)
        Air that moves with the body: inertia, without weight or mass-proportional damping.
    """

    own_kg: Array
    tied_kg: Array
    displaced_kg: Array
    added_kg: Array

    def rows(self, rows: slice) -> Mass:
        """The same at some of the times."""
        return replace(self, tied_kg=self.tied_kg[rows])

    @cached_property
    def kg(self) -> Array:
        """Inertia M + A (T, 3n): all that accelerates with the dofs, the air included."""
        return self._with(self.own_kg + self.added_kg)

    @cached_property
    def damped_kg(self) -> Array:
        """M (T, 3n), which γ_m damps: the body and what is tied to it, without the air."""
        return self._with(self.own_kg)

    @cached_property
    def weighed_kg(self) -> Array:
        """M − D (T, 3n), whose weight acts on the dofs: less the air that the body displaces."""
        return self._with(self.own_kg - self.displaced_kg)

    def row_kg(self, t: int) -> Array:
        """Inertia M + A (3n,) at the time with index t."""
        return self.own_kg + self.added_kg + self.tied_kg[t]

    def _with(self, constant_kg: Array) -> Array:
        """(T, 3n) sum of a constant mass (3n,) and what is tied, in the memory of one row if so."""
        if len(self.tied_kg) and self.tied_kg.strides[0] == 0:
            return np.broadcast_to(constant_kg + self.tied_kg[0], self.tied_kg.shape)
        return constant_kg + self.tied_kg

    @cached_property
    def tied(self) -> Array | None:
        """(3n,) or (T, 3n) what is tied; None where nothing is."""
        if not len(self.tied_kg) or self.tied_kg.strides[0]:
            return self.tied_kg
        return self.tied_kg[0] if self.tied_kg[0].any() else None


@dataclass(frozen=True, eq=False)
class Weight(ForceTerm):
    """What gravity and loads do at T times.

    Attributes
    ----------
    body : Body
        What it pulls at.
    mass : Mass
        With all that is tied.
    gravity_m_s2 : (3,)
    applied_n : (T, 3n)
        All forces on the nodes, wherever these are.
    turns : bool
        Whether gravity is an input.
    joining_kg, joining_n : (L, 3n) and (L, T, 3n), m_l and f_l
    share : (T, L) s
    """

    body: Body
    mass: Mass
    gravity_m_s2: Array
    applied_n: Array
    turns: bool
    joining_kg: Array
    joining_n: Array
    share: Array

    couplings = None

    @classmethod
    def of(cls, experiment: Experiment, t_s: ArrayLike) -> Weight:
        """That of an experiment at the times `t_s` (T,)."""
        applied, body = experiment.node_forces_n(t_s), experiment.body
        tied = np.repeat(experiment.tied_mass_kg(t_s), 3, axis=1)
        air_kg = experiment.air_density_kg_m3 * body.dof_volume_m3
        mass = Mass(_own_kg(body), _compact(tied), air_kg, ADDED_MASS_SHARE * air_kg)
        applied = _compact(applied.reshape(len(applied), -1))
        return cls(body, mass, experiment.gravity_m_s2, applied, False, *_no_loads(applied))

    @classmethod
    def none(cls, body: Body) -> Weight:
        """That of a body that nothing acts on, at one time."""
        nothing = np.zeros((1, body.pattern.size))
        no_air_kg = nothing[0]
        mass = Mass(_own_kg(body), nothing, no_air_kg, no_air_kg)
        return cls(body, mass, np.zeros(3), nothing, False, *_no_loads(nothing))

    def with_theta(self, theta: Theta) -> Self:
        """The same on a body of these constants."""
        if not self.body.mass_slopes:
            return self
        return replace(self, mass=replace(self.mass, own_kg=self.body.mass_of_dofs(theta)))

    def with_inputs(self, turns: bool, loads: Sequence[PointMass | Force], t_s: Array) -> Weight:
        """The same with gravity, and the shares of some loads, as inputs."""
        kg, newtons, share = _no_loads(self.applied_n, len(loads))
        for k, load in enumerate(loads):
            nodes = kg.shape[1] // 3
            if isinstance(load, PointMass):
                kg[k] = np.repeat(load.at_nodes(nodes), 3)
            else:
                newtons[k] = load.at_nodes(t_s, nodes).reshape(len(t_s), -1)
        return replace(self, turns=turns, joining_kg=kg, joining_n=newtons, share=share)

    @property
    def size(self) -> int:  # type: ignore[override]
        """Number of its inputs."""
        return 3 * self.turns + len(self.joining_kg)

    def at(self, u: Array) -> Self:
        """The same at inputs (T, size)."""
        if not self.size:
            return self
        found = replace(self, gravity_m_s2=u[0, :3]) if self.turns else self
        if not len(self.joining_kg):
            return found
        share = u[:, 3 * self.turns :]
        change = share - self.share
        tied_kg = self.mass.tied_kg + change @ self.joining_kg
        applied_n = self.applied_n + np.einsum("tl,ltd->td", change, self.joining_n)
        mass = replace(self.mass, tied_kg=tied_kg)
        return replace(found, mass=mass, applied_n=applied_n, share=share)

    def rows(self, rows: slice) -> Self:
        """The same at some of the times."""
        return replace(
            self,
            mass=self.mass.rows(rows),
            applied_n=self.applied_n[rows],
            joining_n=self.joining_n[:, rows],
            share=self.share[rows],
        )

    def scaled(self, share: float) -> Self:
        """A share of what acts, on the same mass."""
        return replace(
            self,
            gravity_m_s2=share * self.gravity_m_s2,
            applied_n=share * self.applied_n,
            joining_n=share * self.joining_n,
        )

    def towards(self, other: Self, share: float) -> Self:
        """With a share of the way to another time."""

        def between(a: Array, b: Array) -> Array:
            return a + share * (b - a)

        mass = replace(self.mass, tied_kg=between(self.mass.tied_kg, other.mass.tied_kg))
        return replace(
            self,
            mass=mass,
            applied_n=between(self.applied_n, other.applied_n),
            joining_n=between(self.joining_n, other.joining_n),
            share=between(self.share, other.share),
        )

    @cached_property
    def gravity(self) -> Array:
        """(3n,)."""
        return np.tile(self.gravity_m_s2, self.body.pattern.size // 3)

    def mass_by_input(self, first: int) -> dict[int, Array]:
        """∂M/∂u (3n,) of each input that M depends on, own ones from the place `first` on."""
        shares = enumerate(self.joining_kg, first + 3 * self.turns)
        return self.body.mass_slopes | dict(shares)

    def force(self, states: States) -> Array:
        """(T, 3n) [N]; what drags at what is tied is the body's, see `Body.force`."""
        return self.external_n

    @cached_property
    def external_n(self) -> Array:
        """The same: it does not depend on the state."""
        return self.mass.weighed_kg * self.gravity + self.applied_n

    def add_slopes(self, at: Linearisation, places: Slots, states: States) -> None:
        """Add F and its slopes."""
        np.add(at.force, self.external_n, out=at.force)
        for density, slope in self.body.mass_slopes.items():
            at.by_theta[:, :, density] += slope * self.gravity
        own = places.inputs.start
        if self.turns:
            for axis in range(3):
                at.by_theta[:, axis::3, own + axis] += self.mass.weighed_kg[:, axis::3]
        for k, (kg, newtons) in enumerate(self._joining, own + 3 * self.turns):
            at.by_theta[:, :, k] += kg * self._falling(states) + newtons

    def add_curvature(self, at: Curvature, places: Slots, states: States, weights: Array) -> None:
        """Add the derivatives of weightsᵀ F."""
        for density, slope in self.body.mass_slopes.items():
            at.theta[:, density] += weights @ (slope * self.gravity)
        own = places.inputs.start
        if self.turns:
            here = slice(own, own + 3)
            at.theta[:, here] += _of_axes(weights * self.mass.weighed_kg)
            for place, kg in self.mass_by_input(own).items():
                mixed = _of_axes(weights * kg)
                at.theta_theta[:, place, here] += mixed
                at.theta_theta[:, here, place] += mixed
        for k, (kg, newtons) in enumerate(self._joining, own + 3 * self.turns):
            change = kg * self._falling(states) + newtons
            at.theta[:, k] += np.einsum("ti,ti->t", weights, change)
            at.velocity_theta[:, :, k] -= self.body.tied_drag(states.theta) * kg * weights
            for gamma, share in self.body.tied_shares.items():
                mixed = (weights * kg * states.nu) @ share
                at.theta_theta[:, gamma, k] -= mixed
                at.theta_theta[:, k, gamma] -= mixed

    @property
    def _joining(self) -> zip[tuple[Array, Array]]:
        return zip(self.joining_kg, self.joining_n, strict=True)

    def _falling(self, states: States) -> Array:
        """(T, 3n) acceleration g − γ_m ν of what is tied to the body [m/s²]."""
        return self.gravity - self.body.tied_drag(states.theta) * states.nu


def _own_kg(body: Body) -> Array:
    """(3n,) of a body whose constants are not known yet."""
    return body.mass_of_dofs(np.full(len(body.constants), np.nan))


def _no_loads(rows: Array, count: int = 0) -> tuple[Array, Array, Array]:
    times, dofs = rows.shape
    return np.zeros((count, dofs)), np.zeros((count, times, dofs)), np.zeros((times, count))


def _of_axes(dofs: Array) -> Array:
    """(T, 3) sums over the nodes of (T, 3n)."""
    return dofs.reshape(len(dofs), -1, 3).sum(axis=1)


def _compact(rows: Array) -> Array:
    """The same rows; where all are equal they take the memory of one."""
    return np.broadcast_to(rows[0].copy(), rows.shape) if (rows == rows[:1]).all() else rows
