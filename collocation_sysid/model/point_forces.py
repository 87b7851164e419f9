"""A user's force among the others: its derivatives are generated, node by node or face by face."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np

from ..arrays import Array
from ..fem.body import Body, Curvature, Linearisation
from ..fem.node_force import DATA, NodeForce, PlacedForce
from ..fem.pattern import SymmetricPattern
from .force_term import ForceTerm, Slots, States
from .generated import Generated


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
        """Of the dofs of each node or face."""
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
    def _law(self) -> Generated:
        return generated(self.placed.force, self.placed.dofs.shape[1])

    def _instances(self, states: States) -> tuple[Array, Array]:
        """U (2d + c, T, i) and data of the nodes or faces, of d dofs each."""
        dofs = self.placed.dofs
        x, v = (np.moveaxis(each[:, dofs], 2, 0) for each in (states.xi, states.nu))
        constants = states.theta[self.placed.columns][:, None, None]
        shape = x.shape[1:]
        u = np.concatenate([x, v, np.broadcast_to(constants, (len(constants), *shape))])
        data = np.empty((DATA, *shape))
        data[0], data[1:] = self.t_s[:, None], self.placed.data[:, None]
        return u, data

    def force(self, states: States) -> Array:
        """(T, 3n) [N]."""
        return self.share * self._summed(self._law.value(*self._instances(states)))

    def add_slopes(self, at: Linearisation, places: Slots, states: States) -> None:
        """Add F and its slopes."""
        value, slopes = self._law.slopes(*self._instances(states))
        at.force[:] += self.share * self._summed(value)
        dofs = self.placed.dofs.shape[1]
        by_x, by_v, by_c = np.split(self.share * slopes, [dofs, 2 * dofs], axis=1)
        at.by_position[:, places.entries] += self._lower(by_x + by_x.swapaxes(0, 1)) / 2
        at.by_velocity[:, places.entries] += self._lower(by_v)
        if at.by_position_skew.size:
            skew = self._lower(by_x - by_x.swapaxes(0, 1), skew=True) / 2
            at.by_position_skew[:, places.entries] += skew
        for k, column in enumerate(self.placed.columns):
            at.by_theta[:, :, column] += self._summed(by_c[:, k])

    def add_curvature(self, at: Curvature, places: Slots, states: States, weights: Array) -> None:
        """Add the derivatives of weightsᵀ F."""
        u, data = self._instances(states)
        w = self.share * np.moveaxis(weights[:, self.placed.dofs], 2, 0)
        whole, entries, dofs = self._law.curvature(u, data, w), places.entries, len(w)
        x, v = slice(dofs), slice(dofs, 2 * dofs)
        xv = whole[x, v]
        at.position_position[:, entries] += self._lower(whole[x, x])
        at.position_velocity[:, entries] += self._lower(xv + xv.swapaxes(0, 1)) / 2
        if at.position_velocity_skew.size:
            skew = self._lower(xv - xv.swapaxes(0, 1), skew=True) / 2
            at.position_velocity_skew[:, entries] += skew
        at.velocity_velocity[:, entries] += self._lower(whole[v, v])
        _, slopes = self._law.slopes(u, data)
        for k, column in enumerate(self.placed.columns, 2 * dofs):
            at.position_theta[:, :, column] += self._summed(whole[x, k])
            at.velocity_theta[:, :, column] += self._summed(whole[v, k])
            at.theta[:, column] += np.einsum("itk,itk->t", w, slopes[:, k])
            for other, place in enumerate(self.placed.columns, 2 * dofs):
                at.theta_theta[:, column, place] += whole[k, other].sum(axis=1)

    def _summed(self, values: Array) -> Array:
        """(T, 3n) from (d, T, i)."""
        flat = values.transpose(2, 0, 1).reshape(-1, values.shape[1])
        return (self.placed.onto_dofs @ flat).T

    def _lower(self, blocks: Array, skew: bool = False) -> Array:
        """(T, m) entries of the couplings from (d, d, T, i)."""
        columns, rows = np.triu_indices(len(blocks))
        summing, signs = self.placed.onto_couplings
        values = np.moveaxis(blocks[rows, columns], 0, 2)
        values = values * signs if skew else values
        return (summing @ values.reshape(len(values), -1).T).T


@lru_cache(maxsize=32)
def generated(force: NodeForce, dofs: int) -> Generated:
    """Its law with derivatives at so many dofs; those of the last few are kept."""
    return Generated(force.expression, force.inputs(dofs), DATA)


def point_forces(body: Body, t_s: Array) -> tuple[PointForces, ...]:
    """Those that a body's users declared, at times (T,)."""
    return tuple(PointForces(placed, t_s) for placed in body.placed_forces)
