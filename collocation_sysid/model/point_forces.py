"""Forces that act point by point: their derivatives are generated, those of users among them.

A law may carry numbers h of each instance from one evaluation to the next, such as how far a
dashpot has crept or where friction's anchor is:

    (F, h)_k = L(y_k, ẏ_k, c_k, h_{k−1}; data_k).

To the equations of motion h_{k−1} is as what a memory brings: at that, F and its slopes are those
of any other force; what it does along a motion is in `force_history`, for all methods.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple, Self

import numpy as np

from ..arrays import Array, Index
from ..fem.air import unit_drag
from ..fem.body import Body, Curvature, Linearisation
from ..fem.force_points import ForcePoints
from ..fem.node_force import DATA, NodeForce, PlacedForce
from ..fem.pattern import SymmetricPattern
from ..recording.experiment import Experiment
from .force_term import ForceTerm, Slots, States
from .generated import Generated


class Brought(NamedTuple):
    """What instances bring to T evaluations.

    before : (n, T, I) h_{k−1}
    since_s : (T,) time since the evaluation before, zero at the start, which brings nothing
    """

    before: Array
    since_s: Array


class Pointwise(ForceTerm):
    """A law of what is at points of a body: of their vectors y, of ẏ, and of constants c.

    Attributes
    ----------
    points : ForcePoints
    law : Generated
        Forces (d,) on y, of (y, ẏ, c), or of (y, c) where nothing depends on ẏ, and of data. One
        that carries n numbers takes them behind c, and gives those for the next behind its forces.
    share : float
        Of the force; what is carried is the same.
    brought : Brought, optional
        Of one that carries; as at the start by default.
    weighed : (n, T, I), optional
        What each h_k counts in second derivatives, beside the force.
    """

    points: ForcePoints
    share: float
    brought: Brought | None = None
    weighed: Array | None = None

    @property
    def turns(self) -> bool:
        """Whether its slopes by positions have a skew part."""
        return True

    @property
    @abstractmethod
    def law(self) -> Generated:
        """F(y, ẏ, c), or (F, h)(y, ẏ, c, h_{k−1})."""

    @property
    def by_velocity(self) -> bool:  # type: ignore[override]
        """Whether it depends on ẏ."""
        return True

    def acting(self, states: States) -> tuple[Index | None, Array]:
        """The instances at which it may be more than nothing, None for all, and y of these.

        Others leave nothing either.
        """
        return None, self.points.vectors(states.xi)

    @abstractmethod
    def constants(self, states: States) -> Array:
        """C (c, T) or (c, 1)."""

    @abstractmethod
    def columns(self, places: Slots) -> Index:
        """(c,) places of the constants in u."""

    @abstractmethod
    def data(self, chosen: Index | None) -> Array:
        """(D, T, i) of the law, or (D, 1, i)."""

    @property
    def couplings(self) -> SymmetricPattern:  # type: ignore[override]
        """Of the nodes at each point."""
        return self.points.couplings

    def scaled(self, share: float) -> Self:
        """A share of it."""
        return replace(self, share=share * self.share)  # type: ignore[type-var]

    def bringing(self, brought: Brought, weighed: Array | None = None) -> Self:
        """The same at what instances bring."""
        return replace(self, brought=brought, weighed=weighed)  # type: ignore[type-var]

    def began(self, times: int) -> tuple[Array, Array]:
        """(T,) time since the evaluation before, and one where there is none, else zero."""
        since_s = np.zeros(times) if self.brought is None else self.brought.since_s
        return since_s, (since_s == 0).astype(float)

    def _at(self, states: States) -> _At:
        (chosen, y), constants = self.acting(states), self.constants(states)
        moving = (self.points.vectors(states.nu, chosen),) if self.by_velocity else ()
        steady = np.broadcast_to(constants[..., None], (len(constants), *y.shape[1:]))
        before = np.zeros((self.carries, *y.shape[1:]))
        if self.brought is not None:
            before = self.brought.before[..., slice(None) if chosen is None else chosen]
        u = np.concatenate([y, *moving, steady, before])
        ends = len(y), len(y) * (2 if self.by_velocity else 1), len(u) - len(before)
        data = self.data(chosen)
        return _At(chosen, u, np.broadcast_to(data, (len(data), *y.shape[1:])), *ends)

    def force(self, states: States) -> Array:
        """(T, 3n) [N]."""
        at = self._at(states)
        value = self.law.value(at.u, at.data)[at.y]
        return self.share * self.points.summed(value, at.chosen)

    def add_slopes(self, at: Linearisation, places: Slots, states: States) -> None:
        """Add F and its slopes."""
        here, points = self._at(states), self.points
        value, slopes = self.law.slopes(here.u, here.data)
        value, slopes = value[here.y], self.share * slopes[here.y]
        at.force[:] += self.share * points.summed(value, here.chosen)
        by_x, by_v, by_c = (slopes[:, part] for part in (here.y, here.v, here.c))
        at_x, add = (places.entries, by_x, here.chosen), points.add_entries
        depends_on_place = bool(self.law.depends[here.y].any())
        if depends_on_place:
            add(at.by_position, *at_x)
        if depends_on_place and self.turns and at.by_position_skew.size:
            add(at.by_position_skew, *at_x, skew=True)
        at_v = places.entries, by_v, here.chosen
        if self.by_velocity:
            add(at.by_velocity, *at_v)
        if self.spins:
            add(at.by_velocity_skew, *at_v, skew=True)
        for k, column in enumerate(self.columns(places)):
            at.by_theta[:, :, column] += points.summed(by_c[:, k], here.chosen)

    def add_curvature(self, at: Curvature, places: Slots, states: States, weights: Array) -> None:
        """Add the derivatives of weightsᵀ F + `weighed` · h."""
        here, points, entries = self._at(states), self.points, places.entries
        w, x, v = self._weights(here, weights), here.y, here.v
        whole = self.law.curvature(here.u, here.data, w)
        add, chosen = points.add_entries, here.chosen
        depends_on_place = bool(self.law.depends[x].any())
        if depends_on_place:
            add(at.position_position, entries, whole[x, x], chosen)
        if self.by_velocity and depends_on_place:
            add(at.position_velocity, entries, whole[x, v], chosen)
            if at.position_velocity_skew.size:
                add(at.position_velocity_skew, entries, whole[x, v], chosen, skew=True)
        if self.by_velocity:
            add(at.velocity_velocity, entries, whole[v, v], chosen)
        _, slopes = self.law.slopes(here.u, here.data)
        columns = list(enumerate(self.columns(places), here.c.start))
        for k, column in columns:
            at.position_theta[:, :, column] += points.summed(whole[x, k], here.chosen)
            if self.by_velocity:
                at.velocity_theta[:, :, column] += points.summed(whole[v, k], here.chosen)
            at.theta[:, column] += np.einsum("itk,itk->t", w, slopes[:, k])
            for other, place in columns:
                at.theta_theta[:, column, place] += whole[k, other].sum(axis=1)

    def _weights(self, here: _At, weights: Array) -> Array:
        """(d + n, T, i) what the force on the vectors, and what is left, count."""
        own = self.share * self.points.vectors(weights, here.chosen)
        if not self.carries:
            return own
        shape = self.carries, *own.shape[1:]
        some = slice(None) if here.chosen is None else here.chosen
        left = np.zeros(shape) if self.weighed is None else self.weighed[..., some]
        return np.concatenate([own, left])

    # Of one that carries ----------------------------------------------------------------------

    def left(self, states: States) -> Array:
        """H (n, T, I)."""
        here = self._at(states)
        return self._of_all(self.law.value(here.u, here.data)[here.y.stop :], here)

    def parts(self, states: States) -> Parts:
        """Slopes of F and h, (d + n, …, T, I)."""
        here = self._at(states)
        _, slopes = self.law.slopes(here.u, here.data)
        slopes[here.y] *= self.share
        return here.split(self._of_all(slopes, here), 1)

    def bent(self, states: States, weights: Array) -> Parts:
        """Second derivatives by u and h_{k−1}, (…, n, T, I), of weights · F + `weighed` · h."""
        here = self._at(states)
        whole = self.law.curvature(here.u, here.data, self._weights(here, weights))
        return here.split(self._of_all(whole[:, here.b], here), 0)

    def _of_all(self, values: Array, here: _At) -> Array:
        """(…, T, I) of all instances from those chosen."""
        if here.chosen is None:
            return values
        found = np.zeros((*values.shape[:-1], self.points.count))
        found[..., here.chosen] = values
        return found


class Parts(NamedTuple):
    """What stands by y, ẏ, c and h_{k−1}."""

    y: Array
    v: Array
    c: Array
    b: Array


@dataclass(frozen=True, eq=False)
class _At:
    """Inputs u = (y, ẏ, c, h_{k−1}) and data of a law at states.

    Attributes
    ----------
    chosen : (i,) of the instances, or None for all
    u, data : (…, T, i)
    moving, steady, brought : int
        Where ẏ, c and h_{k−1} begin in u.
    """

    chosen: Index | None
    u: Array
    data: Array
    moving: int
    steady: int
    brought: int

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
        return slice(self.steady, self.brought)

    @property
    def b(self) -> slice:
        """Of what is brought."""
        return slice(self.brought, len(self.u))

    def split(self, values: Array, axis: int) -> Parts:
        """What stands by each along an axis."""
        return Parts(*np.split(values, [self.moving, self.steady, self.brought], axis=axis))


@dataclass(frozen=True, eq=False)
class PointForces(Pointwise):
    """A user's force, or the drag of the air, at T times.

    Attributes
    ----------
    placed : PlacedForce
    t_s : (T,)
    share : float
    """

    placed: PlacedForce
    t_s: Array
    share: float = 1.0
    brought: Brought | None = None
    weighed: Array | None = None
    size = 0

    @property
    def spins(self) -> bool:  # type: ignore[override]
        """Whether the user's law does."""
        return self.placed.force.spins

    @property
    def turns(self) -> bool:
        """Whether the user's law does."""
        return self.placed.force.turns

    @property
    def carries(self) -> int:  # type: ignore[override]
        """How many numbers the user's law leaves."""
        return self.placed.force.carries

    @property
    def of_air(self) -> bool:
        """Whether this is the drag of the air around the body, not a user's law."""
        return self.placed.force is unit_drag()

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
        """With a share of the way to another time, at what that brings."""
        return replace(other, t_s=self.t_s + share * (other.t_s - self.t_s))

    def constants(self, states: States) -> Array:
        """Those of the body."""
        return states.theta[self.placed.columns][:, None]

    def columns(self, places: Slots) -> Index:
        """Their places in θ."""
        return self.placed.columns

    def data(self, chosen: Index | None) -> Array:
        """Of an `AtNode`."""
        data = np.empty((DATA, len(self.t_s), self.points.count))
        data[0], data[1:-2] = self.t_s[:, None], self.placed.data[:, None]
        data[-2:] = np.array(self.began(len(self.t_s)))[..., None]
        return data


@lru_cache(maxsize=32)
def generated(force: NodeForce, dofs: int) -> Generated:
    """Its law with derivatives at so many dofs; those of the last few are kept."""
    return Generated(force.expression, force.inputs(dofs), DATA, compiled=force.compiled)


def air_drag(experiment: Experiment, t_s: Array) -> tuple[PointForces, ...]:
    """Return the drag of the air on an experiment's body at times (T,); none where nothing is.

    Drag is linear in the density of the air, which is the share of that at a density of one.
    """
    if not experiment.has_air_drag:
        return ()
    placed = experiment.body.unit_air_drag
    return (PointForces(placed, t_s, share=experiment.air_density_kg_m3),)


def point_forces(body: Body, t_s: Array) -> tuple[PointForces, ...]:
    """Those that a body's users declared, at times (T,)."""
    return tuple(PointForces(placed, t_s) for placed in body.placed_forces)
