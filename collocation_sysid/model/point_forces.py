"""Forces that act point by point: their derivatives are generated, those of users among them."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np

from ..arrays import Array, Index
from ..fem.body import Body, Curvature, Linearisation
from ..fem.force_points import ForcePoints
from ..fem.node_force import DATA, NodeForce, PlacedForce
from ..fem.pattern import SymmetricPattern
from .force_term import ForceTerm, Slots, States
from .generated import Generated


class Pointwise(ForceTerm):
    """A law of what is at points of a body: of their vectors y, of ẏ, and of constants c.

    Attributes
    ----------
    points : ForcePoints
    law : Generated
        Forces (d,) on y, of (y, ẏ, c), or of (y, c) where nothing depends on ẏ, and of data.
    share : float
    """

    points: ForcePoints
    share: float

    @property
    @abstractmethod
    def law(self) -> Generated:
        """F(y, ẏ, c)."""

    @property
    def by_velocity(self) -> bool:
        """Whether it depends on ẏ."""
        return True

    def acting(self, states: States) -> Index | None:
        """The instances at which it may be more than nothing; None for all."""
        return None

    @abstractmethod
    def constants(self, states: States) -> Array:
        """C (c, T) or (c, 1)."""

    @abstractmethod
    def columns(self, places: Slots) -> Index:
        """(c,) places of the constants in u."""

    @abstractmethod
    def data(self, chosen: Index | None) -> Array:
        """(D, T, i) of the law."""

    @property
    def couplings(self) -> SymmetricPattern:  # type: ignore[override]
        """Of the nodes at each point."""
        return self.points.couplings

    def scaled(self, share: float) -> Self:
        """A share of it."""
        return replace(self, share=share * self.share)  # type: ignore[type-var]

    def _at(self, states: States) -> _At:
        chosen = self.acting(states)
        y, constants = self.points.vectors(states.xi, chosen), self.constants(states)
        moving = (self.points.vectors(states.nu, chosen),) if self.by_velocity else ()
        shape = len(constants), *y.shape[1:]
        u = np.concatenate([y, *moving, np.broadcast_to(constants[..., None], shape)])
        return _At(chosen, u, self.data(chosen), len(y), len(u) - len(constants))

    def force(self, states: States) -> Array:
        """(T, 3n) [N]."""
        at = self._at(states)
        return self.share * self.points.summed(self.law.value(at.u, at.data), at.chosen)

    def add_slopes(self, at: Linearisation, places: Slots, states: States) -> None:
        """Add F and its slopes."""
        here, points = self._at(states), self.points
        value, slopes = self.law.slopes(here.u, here.data)
        slopes = self.share * slopes
        at.force[:] += self.share * points.summed(value, here.chosen)
        by_x, by_v, by_c = (slopes[:, part] for part in (here.y, here.v, here.c))
        both = by_x + by_x.swapaxes(0, 1)
        at.by_position[:, places.entries] += points.entries(both, here.chosen) / 2
        if at.by_position_skew.size:
            skew = points.entries(by_x - by_x.swapaxes(0, 1), here.chosen, skew=True) / 2
            at.by_position_skew[:, places.entries] += skew
        if self.by_velocity:
            at.by_velocity[:, places.entries] += points.entries(by_v, here.chosen)
        for k, column in enumerate(self.columns(places)):
            at.by_theta[:, :, column] += points.summed(by_c[:, k], here.chosen)

    def add_curvature(self, at: Curvature, places: Slots, states: States, weights: Array) -> None:
        """Add the derivatives of weightsᵀ F."""
        here, points, entries = self._at(states), self.points, places.entries
        w, x, v = self.share * points.vectors(weights, here.chosen), here.y, here.v
        whole = self.law.curvature(here.u, here.data, w)
        at.position_position[:, entries] += points.entries(whole[x, x], here.chosen)
        if self.by_velocity:
            xv = whole[x, v]
            both = points.entries(xv + xv.swapaxes(0, 1), here.chosen)
            at.position_velocity[:, entries] += both / 2
            if at.position_velocity_skew.size:
                skew = points.entries(xv - xv.swapaxes(0, 1), here.chosen, skew=True) / 2
                at.position_velocity_skew[:, entries] += skew
            at.velocity_velocity[:, entries] += points.entries(whole[v, v], here.chosen)
        _, slopes = self.law.slopes(here.u, here.data)
        columns = list(enumerate(self.columns(places), here.c.start))
        for k, column in columns:
            at.position_theta[:, :, column] += points.summed(whole[x, k], here.chosen)
            if self.by_velocity:
                at.velocity_theta[:, :, column] += points.summed(whole[v, k], here.chosen)
            at.theta[:, column] += np.einsum("itk,itk->t", w, slopes[:, k])
            for other, place in columns:
                at.theta_theta[:, column, place] += whole[k, other].sum(axis=1)


@dataclass(frozen=True, eq=False)
class _At:
    """Inputs u = (y, ẏ, c) and data of a law at states.

    Attributes
    ----------
    chosen : (i,) of the instances, or None for all
    u, data : (…, T, i)
    moving, steady : int
        Where ẏ, and c, begin in u.
    """

    chosen: Index | None
    u: Array
    data: Array
    moving: int
    steady: int

    @property
    def y(self) -> slice:
        """Of the vectors."""
        return slice(self.moving)

    @property
    def v(self) -> slice:
        """Of their velocities."""
        return slice(self.moving, self.steady)

    @property
    def c(self) -> slice:
        """Of the constants."""
        return slice(self.steady, len(self.u))


@dataclass(frozen=True, eq=False)
class PointForces(Pointwise):
    """A user's force at T times.

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
    def points(self) -> ForcePoints:  # type: ignore[override]
        """Its nodes or faces."""
        return self.placed.points

    @property
    def law(self) -> Generated:
        """The user's."""
        return generated(self.placed.force, self.points.dofs)

    def at(self, u: Array) -> Self:
        """It has no inputs but constants."""
        return self

    def rows(self, rows: slice) -> Self:
        """The same at some of the times."""
        return replace(self, t_s=self.t_s[rows])

    def towards(self, other: Self, share: float) -> Self:
        """With a share of the way to another time."""
        return replace(self, t_s=self.t_s + share * (other.t_s - self.t_s))

    def constants(self, states: States) -> Array:
        """Those of the body."""
        return states.theta[self.placed.columns][:, None]

    def columns(self, places: Slots) -> Index:
        """Their places in θ."""
        return self.placed.columns

    def data(self, chosen: Index | None) -> Array:
        """Of an `AtNode`."""
        data = np.empty((DATA, len(self.t_s), self.points.count))
        data[0], data[1:] = self.t_s[:, None], self.placed.data[:, None]
        return data


@lru_cache(maxsize=32)
def generated(force: NodeForce, dofs: int) -> Generated:
    """Its law with derivatives at so many dofs; those of the last few are kept."""
    return Generated(force.expression, force.inputs(dofs), DATA)


def point_forces(body: Body, t_s: Array) -> tuple[PointForces, ...]:
    """Those that a body's users declared, at times (T,)."""
    return tuple(PointForces(placed, t_s) for placed in body.placed_forces)
