"""A user's force on nodes among the forces: its derivatives are generated, node by node."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np

from ..arrays import Array, Index
from ..fem.body import Body, Curvature, Linearisation
from ..fem.node_force import DATA, NodeForce, PlacedForce
from ..fem.pattern import SymmetricPattern, dofs_of
from .force_term import ForceTerm, Places, States
from .generated import Generated

# Entries of a lower triangle of a node, column after column as a pattern has them.
COLUMNS, ROWS = np.triu_indices(3)


@dataclass(frozen=True, eq=False)
class PointForces(ForceTerm):
    """The force at T times.

    Attributes
    ----------
    placed : PlacedForce
    t_s : (T,)
    share : float
    """

    placed: PlacedForce
    t_s: Array
    share: float = 1.0
    size = 0

    @property
    def couplings(self) -> SymmetricPattern:  # type: ignore[override]
        """Of each node's dofs."""
        return self.placed.couplings

    def at(self, u: Array) -> Self:
        """It has no inputs but constants."""
        return self

    def rows(self, rows: slice) -> Self:
        """The same at some of the times."""
        return replace(self, t_s=self.t_s[rows])

    def scaled(self, share: float) -> Self:
        """A share of it."""
        return replace(self, share=share * self.share)

    def towards(self, other: Self, share: float) -> Self:
        """With a share of the way to another time."""
        return replace(self, t_s=self.t_s + share * (other.t_s - self.t_s))

    @property
    def _dofs(self) -> Index:
        """(k, 3)."""
        return dofs_of(self.placed.nodes[:, None])

    @property
    def _law(self) -> Generated:
        return generated(self.placed.force)

    def _instances(self, states: States) -> tuple[Array, Array]:
        """U (6 + c, T, k) and data of the nodes."""
        x, v = (np.moveaxis(each[:, self._dofs], 2, 0) for each in (states.xi, states.nu))
        constants = states.theta[self.placed.columns][:, None, None]
        shape = x.shape[1:]
        u = np.concatenate([x, v, np.broadcast_to(constants, (len(constants), *shape))])
        data = np.empty((DATA, *shape))
        data[0], data[1:] = self.t_s[:, None], self.placed.data[:, None]
        return u, data

    def force(self, states: States) -> Array:
        """(T, 3n) [N]."""
        found = np.zeros_like(states.xi)
        value = self._law.value(*self._instances(states))
        found[:, self._dofs] = self.share * np.moveaxis(value, 0, 2)
        return found

    def add_slopes(self, at: Linearisation, places: Places, states: States) -> None:
        """Add F and its slopes."""
        value, slopes = self._law.slopes(*self._instances(states))
        at.force[:, self._dofs] += self.share * np.moveaxis(value, 0, 2)
        by_x, by_v, by_c = np.split(self.share * slopes, [3, 6], axis=1)
        entries = self._entries(places)
        at.by_position[:, entries] += _lower(by_x + by_x.swapaxes(0, 1)) / 2
        at.by_velocity[:, entries] += _lower(by_v)
        if at.by_position_skew.size:
            at.by_position_skew[:, entries] += _lower(by_x - by_x.swapaxes(0, 1)) / 2
        for k, column in enumerate(self.placed.columns):
            at.by_theta[:, self._dofs, column] += np.moveaxis(by_c[:, k], 0, 2)

    def add_curvature(self, at: Curvature, places: Places, states: States, weights: Array) -> None:
        """Add the derivatives of weightsᵀ F."""
        u, data = self._instances(states)
        w = self.share * np.moveaxis(weights[:, self._dofs], 2, 0)
        whole = self._law.curvature(u, data, w)
        entries, xv = self._entries(places), whole[:3, 3:6]
        at.position_position[:, entries] += _lower(whole[:3, :3])
        at.position_velocity[:, entries] += _lower(xv + xv.swapaxes(0, 1)) / 2
        if at.position_velocity_skew.size:
            at.position_velocity_skew[:, entries] += _lower(xv - xv.swapaxes(0, 1)) / 2
        at.velocity_velocity[:, entries] += _lower(whole[3:6, 3:6])
        _, slopes = self._law.slopes(u, data)
        for k, column in enumerate(self.placed.columns, 6):
            at.position_theta[:, self._dofs, column] += np.moveaxis(whole[:3, k], 0, 2)
            at.velocity_theta[:, self._dofs, column] += np.moveaxis(whole[3:6, k], 0, 2)
            at.theta[:, column] += np.einsum("itk,itk->t", w, slopes[:, k])
            for other, place in enumerate(self.placed.columns, 6):
                at.theta_theta[:, column, place] += whole[k, other].sum(axis=1)

    def _entries(self, places: Places) -> Index:
        """(k, 6) places of the nodes' lower triangles."""
        dofs = self._dofs
        return places.entries[self.couplings.position(dofs[:, ROWS], dofs[:, COLUMNS])]


@lru_cache(maxsize=32)
def generated(force: NodeForce) -> Generated:
    """Its law with derivatives; those of the last few are kept."""
    return Generated(force.expression, force.inputs, DATA)


def point_forces(body: Body, t_s: Array) -> tuple[PointForces, ...]:
    """Those that a body's users declared, at times (T,)."""
    return tuple(PointForces(placed, t_s) for placed in body.placed_forces)


def _lower(blocks: Array) -> Array:
    """(T, k, 6) lower triangles of (3, 3, T, k)."""
    return np.moveaxis(blocks[ROWS, COLUMNS], 0, 2)
