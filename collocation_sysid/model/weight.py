"""Weight of a body, its masses, and loads that join or leave at estimated times.

Every dof has the mass M(u) = M(ρ) + m + Σ_l s_l m_l, where m are the point masses tied to the body
as stated, m_l is the mass of load l and s_l(t) its share. With the force f_l of load l and the
mass-proportional damping γ_m,

    F_k = (M(u_k) − D) g + f_k + Σ_l s_l,k (f_l,k − γ_m m_l ν_k),    c_t ∋ −(M(ū_t) + A) a_t.

D is the mass of the air that the body displaces and A the added mass of the air that moves with it,
on which neither γ_m nor gravity acts, see `fem.node_force`. ū_t is the mean over the evaluations with the
weights of row t, so that a free fall continues unchanged, whatever joins the body. Inputs are
gravity, where a parameter rotates it, and each s_l as a change from the stated share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from ..common.array_types import Array
from ..common.time_dependence import LOAD, PARTS_OVER_TIME, over_time
from ..fem.body import Body, Linearisation, SecondDerivatives
from ..fem.node_force import ADDED_MASS_SHARE
from ..fem.regions import Theta
from ..recording.experiment import Experiment
from ..recording.loads import Force, PointMass
from ..recording.start_motion import start_forces_n
from .force_term import AssemblyIndices, ForceTerm, States


@dataclass(frozen=True, eq=False)
class DofMasses:
    """Masses of every dof at T times: the body, what is tied to it, and the air."""

    own_kg: Array  # (3n,): mass of the body itself; of B bodies with free densities (B, 3n)
    tied_kg: Array = field(metadata=over_time())  # (T, 3n): point masses
    # (3n,): air that the body displaces; buoyancy reduces the weight by the weight of this air.
    displaced_kg: Array
    # (3n,): air that moves with the body: inertia without weight and mass-proportional damping.
    added_kg: Array

    @cached_property
    def inertia_kg(self) -> Array:
        """Inertia M + A (T, 3n): all mass that accelerates with the dofs, including the air."""
        return self._plus_tied(self.own_kg + self.added_kg)

    @cached_property
    def damped_kg(self) -> Array:
        """Mass M (T, 3n) damped by γ_m: the body and what is tied to it, without the air."""
        return self._plus_tied(self.own_kg)

    @cached_property
    def weight_kg(self) -> Array:
        """Mass M − D (T, 3n) whose weight acts on the dofs: less the air that the body
        displaces.
        """
        return self._plus_tied(self.own_kg - self.displaced_kg)

    def inertia_at(self, t: int) -> Array:
        """Return the inertia M + A (3n,) at the time with index t."""
        return self.own_kg + self.added_kg + self.tied_kg[t]

    def _plus_tied(self, constant_kg: Array) -> Array:
        """Return constant (3n,) plus tied masses (T, 3n); a view with stride 0 if those are one."""
        if constant_kg.ndim == 1 and len(self.tied_kg) and self.tied_kg.strides[0] == 0:
            return np.broadcast_to(constant_kg + self.tied_kg[0], self.tied_kg.shape)
        return constant_kg + self.tied_kg

    @cached_property
    def compact_tied_kg(self) -> Array | None:
        """Tied masses as (3n,) if they are stored as constant in time (a view with stride 0), else
        (T, 3n); None if they are constant and zero.
        """
        if not len(self.tied_kg) or self.tied_kg.strides[0]:
            return self.tied_kg
        return self.tied_kg[0] if self.tied_kg[0].any() else None


@dataclass(frozen=True, eq=False)
class Weight(ForceTerm):
    """Weight of a body and its loads at T times."""

    body: Body
    # Masses of the dofs, including all tied masses.
    mass: DofMasses = field(metadata=PARTS_OVER_TIME)
    gravity_m_s2: Array = field(metadata=LOAD)  # (3,)
    # (T, 3n): applied nodal forces, independent of the positions of the nodes.
    applied_n: Array = field(metadata=over_time(is_load=True))
    has_gravity_input: bool  # whether gravity is an input
    joining_kg: Array  # (L, 3n): masses m_l of the loads whose time is estimated
    # (L, T, 3n): forces f_l of these loads.
    joining_n: Array = field(metadata=over_time(axis=1, is_load=True))
    # (T, L): shares s_l of these loads, as a change from the stated share.
    share: Array = field(metadata=over_time())

    couplings = None

    @classmethod
    def from_experiment(cls, experiment: Experiment, t_s: ArrayLike) -> Weight:
        """Return the weight and loads of an experiment at the times `t_s` (T,); a free density
        gives NaN masses until `with_theta`.
        """
        applied = experiment.declared_node_forces_n(t_s)
        if experiment.start_motion is not None:
            starting = start_forces_n(experiment, np.atleast_1d(t_s))
            moving = np.tensordot(experiment.start_motion, starting, 1)
            applied = applied + moving.reshape(applied.shape)
        body = experiment.body
        tied = np.repeat(experiment.point_mass_at_nodes_kg(t_s), 3, axis=1)
        air_kg = experiment.air_density_kg_m3 * body.sum_dof_volumes_m3()
        mass = DofMasses(
            body.mass_of_dofs(np.full(len(body.constants), np.nan)),
            _as_constant_view(tied),
            displaced_kg=air_kg,
            added_kg=ADDED_MASS_SHARE * air_kg,
        )
        applied = _as_constant_view(applied.reshape(len(applied), -1))
        return cls(
            body,
            mass,
            gravity_m_s2=experiment.gravity_m_s2,
            applied_n=applied,
            has_gravity_input=False,
            **_zero_loads(applied),
        )

    def with_theta(self, theta: Theta) -> Self:
        """Return this weight for a body with constants θ (k,); self if no density is free, because
        then masses do not depend on θ.
        """
        if not self.body.mass_derivatives:
            return self
        return replace(self, mass=replace(self.mass, own_kg=self.body.mass_of_dofs(theta)))

    def with_load_inputs(
        self,
        has_gravity_input: bool,
        loads: Sequence[PointMass | Force],
        t_s: Array,
        starting_n: Array,
    ) -> Weight:
        """Return this weight with gravity, the shares of some loads and the motion at the first time as
        inputs; other loads stay as they are.

        Parameters
        ----------
        has_gravity_input : bool
            Whether gravity is an input.
        loads : sequence of PointMass or Force
            Loads whose shares are inputs.
        t_s : (T,)
            Times of the evaluations [s].
        starting_n : (k, T, 3n) array
            Forces by the motion at the first time, whose factors are inputs after the shares.
        """
        joining = _zero_loads(self.applied_n, len(loads) + len(starting_n))
        joining["joining_n"][len(loads) :] = starting_n
        nodes = self.body.pattern.size // 3
        for k, load in enumerate(loads):
            if isinstance(load, PointMass):
                joining["joining_kg"][k] = np.repeat(load.node_mass_kg(nodes), 3)
            else:
                forces_n = load.node_forces_n(t_s, nodes)
                joining["joining_n"][k] = forces_n.reshape(len(t_s), -1)
        return replace(self, has_gravity_input=has_gravity_input, **joining)

    @property
    def size(self) -> int:  # type: ignore[override]
        """Number of inputs: 3 for gravity, if it is one, and 1 for each joining load."""
        return 3 * self.has_gravity_input + len(self.joining_kg)

    def with_inputs(self, u: Array) -> Self:
        """Return this weight at inputs u (T, size): gravity from the first time if it is an input,
        then the shares of the loads, as changes from the stated shares.

        Tied masses and applied forces follow the shares. The result keeps views of u; it is self if
        there are no inputs. Self is unchanged.
        """
        if not self.size:
            return self
        weight = replace(self, gravity_m_s2=u[0, :3]) if self.has_gravity_input else self
        if not len(self.joining_kg):
            return weight
        share = u[:, 3 * self.has_gravity_input :]
        change = share - self.share
        tied_kg = self.mass.tied_kg + change @ self.joining_kg
        applied_n = self.applied_n + np.einsum("tl,ltd->td", change, self.joining_n)
        mass = replace(self.mass, tied_kg=tied_kg)
        return replace(weight, mass=mass, applied_n=applied_n, share=share)

    @cached_property
    def gravity(self) -> Array:
        """Gravity of every dof (3n,) [m/s²]."""
        return np.tile(self.gravity_m_s2, self.body.pattern.size // 3)

    def mass_derivatives(self, first: int) -> dict[int, Array]:
        """Return ∂M/∂u (3n,) by the index of each input on which M depends.

        Parameters
        ----------
        first : int
            Index in u of the first input of this term.
        """
        shares = enumerate(self.joining_kg, first + 3 * self.has_gravity_input)
        return self.body.mass_derivatives | dict(shares)

    def force(self, states: States) -> Array:
        """Return weight and applied forces; the damping of tied masses is part of `Body.force`."""
        return self.external_n

    @cached_property
    def external_n(self) -> Array:
        """Weight and applied forces (T, 3n) [N], independent of the state."""
        return self.mass.weight_kg * self.gravity + self.applied_n

    def add_derivatives(
        self, linearisation: Linearisation, places: AssemblyIndices, states: States
    ) -> None:
        """Add derivatives by the inputs and by free densities; `places` needs no entries."""
        # Velocities and θ enter by the shares of loads, through the damping γ_m of their masses;
        # the damping force itself is part of `Body.force`.
        np.add(linearisation.force, self.external_n, out=linearisation.force)
        for density, slope in self.body.mass_derivatives.items():
            linearisation.by_theta[:, :, density] += slope * self.gravity
        first_column = places.inputs.start
        if self.has_gravity_input:
            for axis in range(3):
                linearisation.by_theta[:, axis::3, first_column + axis] += self.mass.weight_kg[
                    :, axis::3
                ]
        for k, (kg, newtons) in enumerate(
            zip(self.joining_kg, self.joining_n, strict=True),
            first_column + 3 * self.has_gravity_input,
        ):
            linearisation.by_theta[:, :, k] += kg * self._load_acceleration(states) + newtons

    def add_second_derivatives(
        self, curvature: SecondDerivatives, places: AssemblyIndices, states: States, weights: Array
    ) -> None:
        """Add derivatives by inputs, free densities and velocities; `places` needs no entries."""
        # Those by velocities and γ_m follow from the damping of joining masses.
        for density, slope in self.body.mass_derivatives.items():
            curvature.theta[:, density] += weights @ (slope * self.gravity)
        first_column = places.inputs.start
        if self.has_gravity_input:
            gravity_columns = slice(first_column, first_column + 3)
            curvature.theta[:, gravity_columns] += _sum_over_nodes(weights * self.mass.weight_kg)
            for place, kg in self.mass_derivatives(first_column).items():
                mixed = _sum_over_nodes(weights * kg)
                curvature.theta_theta[:, place, gravity_columns] += mixed
                curvature.theta_theta[:, gravity_columns, place] += mixed
        for k, (kg, newtons) in enumerate(
            zip(self.joining_kg, self.joining_n, strict=True),
            first_column + 3 * self.has_gravity_input,
        ):
            share_derivative = kg * self._load_acceleration(states) + newtons
            curvature.theta[:, k] += np.einsum("ti,ti->t", weights, share_derivative)
            curvature.velocity_theta[:, :, k] -= (
                self.body.tied_damping_rate(states.theta) * kg * weights
            )
            for gamma, share in self.body.tied_shares.items():
                mixed = (weights * kg * states.nu) @ share
                curvature.theta_theta[:, gamma, k] -= mixed
                curvature.theta_theta[:, k, gamma] -= mixed

    def _load_acceleration(self, states: States) -> Array:
        """Return the acceleration g − γ_m ν (T, 3n) by which a tied mass loads the body [m/s²]."""
        return self.gravity - self.body.tied_damping_rate(states.theta) * states.nu


def _zero_loads(rows: Array, count: int = 0) -> dict[str, Array]:
    """Return zero masses (L, 3n), forces (L, T, 3n) and shares (T, L) of loads, by name."""
    times, dofs = rows.shape
    return {
        "joining_kg": np.zeros((count, dofs)),
        "joining_n": np.zeros((count, times, dofs)),
        "share": np.zeros((times, count)),
    }


def _sum_over_nodes(dofs: Array) -> Array:
    return dofs.reshape(len(dofs), -1, 3).sum(axis=1)


def _as_constant_view(rows: Array) -> Array:
    """Return equal rows as a read-only view with stride 0; another array itself."""
    return np.broadcast_to(rows[0].copy(), rows.shape) if (rows == rows[:1]).all() else rows
