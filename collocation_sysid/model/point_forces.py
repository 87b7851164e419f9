"""Forces that act point by point, with generated derivatives: custom forces and air drag.

Derive a force from `Pointwise` if it is a sum over points of the body of a law L of few numbers. A
law may have internal variables h of each instance (point), such as the creep of a dashpot or the
anchor of friction:

    (F, h)_k = L(y_k, ẏ_k, c_k, h_{k−1}; data_k),

with the vectors y of the instance, their velocities ẏ and constants c. With h_{k−1} given, F and
its derivatives are those of any other force; `force_history` treats h along a motion.
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
    """Internal variables of the previous evaluation, given at T evaluations.

    Attributes
    ----------
    before : (n, T, I)
        Variables h_{k−1} of I instances.
    since_s : (T,)
        Time since the previous evaluation; zero at the start, where there is none.
    """

    before: Array
    since_s: Array


class Pointwise(ForceTerm):
    """Force given by a law at points of a body.

    Attributes
    ----------
    points : ForcePoints
        Points, and their vectors y (d numbers each).
    law : Generated
        Forces (d,) on y as a function of (y, ẏ, c), or of (y, c) if nothing depends on ẏ, and of
        data. With n internal variables, h_{k−1} follows c in the inputs and h follows the forces in
        the values.
    share : float
        Factor of the force; internal variables do not depend on it.
    brought : Brought, optional
        Internal variables of the previous evaluations; zero by default, as at the start.
    weighed : (n, T, I), optional
        Weights of h in second derivatives, beside those of the force; zero by default.
    """

    points: ForcePoints
    share: float
    brought: Brought | None = None
    weighed: Array | None = None

    @property
    def turns(self) -> bool:
        """Whether derivatives by positions may have a skew part."""
        return True

    @property
    @abstractmethod
    def law(self) -> Generated:
        """Law F(y, ẏ, c), or (F, h)(y, ẏ, c, h_{k−1}), with derivatives."""

    @property
    def by_velocity(self) -> bool:  # type: ignore[override]
        """Whether the law depends on ẏ."""
        return True

    def acting(self, states: States) -> tuple[Index | None, Array]:
        """Return the indices of the instances that may have a force, None for all, and their y.

        Instances that are left out have neither a force nor internal variables.
        """
        return None, self.points.vectors(states.xi)

    @abstractmethod
    def constants(self, states: States) -> Array:
        """Return the constants c of the law, (c, T) or (c, 1)."""

    @abstractmethod
    def columns(self, places: Slots) -> Index:
        """Return the columns (c,) of the constants among all inputs."""

    @abstractmethod
    def data(self, chosen: Index | None) -> Array:
        """Return the data of the law, (D, T, i) or (D, 1, i).

        Parameters
        ----------
        chosen : array of int or None
            Indices of the instances; None for all.
        """

    @property
    def couplings(self) -> SymmetricPattern:  # type: ignore[override]
        """Pairs of dofs of the nodes at each point."""
        return self.points.couplings

    def scaled(self, share: float) -> Self:
        """Return this force multiplied by a factor."""
        return replace(self, share=share * self.share)  # type: ignore[type-var]

    def bringing(self, brought: Brought, weighed: Array | None = None) -> Self:
        """Return this force with given internal variables, and with weights of h in second
        derivatives.
        """
        return replace(self, brought=brought, weighed=weighed)  # type: ignore[type-var]

    def began(self, times: int) -> tuple[Array, Array]:
        """Return the time since the previous evaluation (T,), and 1 at the start, else 0 (T,).

        Parameters
        ----------
        times : int
            Number T of evaluations.
        """
        since_s = np.zeros(times) if self.brought is None else self.brought.since_s
        return since_s, (since_s == 0).astype(float)

    def _at(self, states: States) -> _At:
        """Return the inputs and data of the law at states."""
        chosen, y = self.acting(states)
        constants = self.constants(states)
        velocities = (self.points.vectors(states.nu, chosen),) if self.by_velocity else ()
        steady = np.broadcast_to(constants[..., None], (len(constants), *y.shape[1:]))
        before = np.zeros((self.carries, *y.shape[1:]))
        if self.brought is not None:
            before = self.brought.before[..., slice(None) if chosen is None else chosen]
        u = np.concatenate([y, *velocities, steady, before])
        data = self.data(chosen)
        return _At(
            chosen,
            u,
            np.broadcast_to(data, (len(data), *y.shape[1:])),
            moving=len(y),
            steady=len(y) * (2 if self.by_velocity else 1),
            brought=len(u) - len(before),
        )

    def force(self, states: States) -> Array:
        """Return the forces F (T, 3n) [N]."""
        at = self._at(states)
        value = self.law.value(at.u, at.data)[at.y]
        return self.share * self.points.summed(value, at.chosen)

    def add_slopes(self, at: Linearisation, places: Slots, states: States) -> None:
        """Add the forces and their first derivatives to a linearisation, in place."""
        evaluated = self._at(states)
        points = self.points
        value, slopes = self.law.slopes(evaluated.u, evaluated.data)
        value = value[evaluated.y]
        slopes = self.share * slopes[evaluated.y]
        at.force[:] += self.share * points.summed(value, evaluated.chosen)
        by_x, by_v, by_c = (slopes[:, part] for part in (evaluated.y, evaluated.v, evaluated.c))
        entries = places.entries
        chosen = evaluated.chosen
        add = points.add_entries
        depends_on_place = bool(self.law.depends[evaluated.y].any())
        if depends_on_place:
            add(at.by_position, entries, by_x, chosen)
        if depends_on_place and self.turns and at.by_position_skew.size:
            add(at.by_position_skew, entries, by_x, chosen, skew=True)
        if self.by_velocity:
            add(at.by_velocity, entries, by_v, chosen)
        if self.spins:
            add(at.by_velocity_skew, entries, by_v, chosen, skew=True)
        for k, column in enumerate(self.columns(places)):
            at.by_theta[:, :, column] += points.summed(by_c[:, k], evaluated.chosen)

    def add_curvature(self, at: Curvature, places: Slots, states: States, weights: Array) -> None:
        """Add the derivatives of weightsᵀ F + Σ `weighed` · h to a curvature, in place."""
        evaluated = self._at(states)
        points = self.points
        entries = places.entries
        w = self._weights(evaluated, weights)
        x = evaluated.y
        v = evaluated.v
        second = self.law.curvature(evaluated.u, evaluated.data, w)
        add = points.add_entries
        chosen = evaluated.chosen
        depends_on_place = bool(self.law.depends[x].any())
        if depends_on_place:
            add(at.position_position, entries, second[x, x], chosen)
        if self.by_velocity and depends_on_place:
            add(at.position_velocity, entries, second[x, v], chosen)
            if at.position_velocity_skew.size:
                add(at.position_velocity_skew, entries, second[x, v], chosen, skew=True)
        if self.by_velocity:
            add(at.velocity_velocity, entries, second[v, v], chosen)
        _, slopes = self.law.slopes(evaluated.u, evaluated.data)
        columns = list(enumerate(self.columns(places), evaluated.c.start))
        for k, column in columns:
            at.position_theta[:, :, column] += points.summed(second[x, k], evaluated.chosen)
            if self.by_velocity:
                at.velocity_theta[:, :, column] += points.summed(second[v, k], evaluated.chosen)
            at.theta[:, column] += np.einsum("itk,itk->t", w, slopes[:, k])
            for other, place in columns:
                at.theta_theta[:, column, place] += second[k, other].sum(axis=1)

    def _weights(self, here: _At, weights: Array) -> Array:
        """Return the weights (d + n, T, i) of the values of the law: of the forces on y, then of
        h.
        """
        force_weights = self.share * self.points.vectors(weights, here.chosen)
        if not self.carries:
            return force_weights
        shape = self.carries, *force_weights.shape[1:]
        some = slice(None) if here.chosen is None else here.chosen
        variable_weights = np.zeros(shape) if self.weighed is None else self.weighed[..., some]
        return np.concatenate([force_weights, variable_weights])

    # Of one that carries ----------------------------------------------------------------------

    def left(self, states: States) -> Array:
        """Return the internal variables h (n, T, I) after the evaluations."""
        evaluated = self._at(states)
        return self._of_all(
            self.law.value(evaluated.u, evaluated.data)[evaluated.y.stop :], evaluated
        )

    def parts(self, states: States) -> Parts:
        """Return the first derivatives of F and h by y, ẏ, c and h_{k−1}, (d + n, …, T, I) each."""
        evaluated = self._at(states)
        _, slopes = self.law.slopes(evaluated.u, evaluated.data)
        slopes[evaluated.y] *= self.share
        return evaluated.split(self._of_all(slopes, evaluated), 1)

    def bent(self, states: States, weights: Array) -> Parts:
        """Return second derivatives of weights · F + Σ `weighed` · h by u and h_{k−1}.

        They are split along u = (y, ẏ, c, h_{k−1}), (…, n, T, I) each.

        Parameters
        ----------
        states : States
        weights : (T, 3n)
            Weights of the forces.
        """
        evaluated = self._at(states)
        second = self.law.curvature(evaluated.u, evaluated.data, self._weights(evaluated, weights))
        return evaluated.split(self._of_all(second[:, evaluated.b], evaluated), 0)

    def _of_all(self, values: Array, here: _At) -> Array:
        """Return values (…, T, I) of all instances, zero at those that are not chosen."""
        if here.chosen is None:
            return values
        expanded = np.zeros((*values.shape[:-1], self.points.count))
        expanded[..., here.chosen] = values
        return expanded


class Parts(NamedTuple):
    """Derivatives by y, ẏ, c and h_{k−1} of a law.

    Attributes
    ----------
    y : array
        By the vectors y of the instance.
    v : array
        By their velocities ẏ.
    c : array
        By the constants.
    b : array
        By the previous internal variables h_{k−1}.
    """

    y: Array
    v: Array
    c: Array
    b: Array


@dataclass(frozen=True, eq=False)
class _At:
    """Inputs u = (y, ẏ, c, h_{k−1}) and data of a law at some states.

    Attributes
    ----------
    chosen : (i,) or None
        Indices of the instances; None for all.
    u, data : (…, T, i)
    moving, steady, brought : int
        Offsets of ẏ, c and h_{k−1} in u.
    """

    chosen: Index | None
    u: Array
    data: Array
    moving: int
    steady: int
    brought: int

    @property
    def y(self) -> slice:
        """Slice of the vectors y in the inputs u."""
        return slice(self.moving)

    @property
    def v(self) -> slice:
        """Slice of the velocities ẏ in u."""
        return slice(self.moving, self.steady)

    @property
    def c(self) -> slice:
        """Slice of the constants in u."""
        return slice(self.steady, self.brought)

    @property
    def b(self) -> slice:
        """Slice of the previous internal variables h_{k−1} in u."""
        return slice(self.brought, len(self.u))

    def split(self, values: Array, axis: int) -> Parts:
        """Split values along one axis into the parts of u."""
        return Parts(*np.split(values, [self.moving, self.steady, self.brought], axis=axis))


@dataclass(frozen=True, eq=False)
class PointForces(Pointwise):
    """Custom force, or the drag of the air, at T times.

    Attributes
    ----------
    placed : PlacedForce
        Law and the points on which it acts.
    t_s : (T,)
        Times.
    share : float
        Factor of the force.
    brought : Brought, optional
        Internal variables of the previous evaluations, see `Pointwise`.
    weighed : (n, T, I), optional
        Weights of the internal variables in second derivatives.
    """

    placed: PlacedForce
    t_s: Array
    share: float = 1.0
    brought: Brought | None = None
    weighed: Array | None = None
    size = 0

    @property
    def spins(self) -> bool:  # type: ignore[override]
        """Whether derivatives of the law by velocities may be non-symmetric."""
        return self.placed.force.spins

    @property
    def turns(self) -> bool:
        """Whether derivatives of the law by positions may have a skew part."""
        return self.placed.force.turns

    @property
    def carries(self) -> int:  # type: ignore[override]
        """Number of internal variables of the law."""
        return self.placed.force.carries

    @property
    def of_air(self) -> bool:
        """Whether this is the drag of the air around the body, not a custom force."""
        return self.placed.force is unit_drag()

    @property
    def points(self) -> ForcePoints:  # type: ignore[override]
        """Nodes or faces on which the law acts."""
        return self.placed.points

    @property
    def law(self) -> Generated:
        """Law of the force with derivatives."""
        return generated(self.placed.force, self.points.dofs)

    def at(self, u: Array) -> Self:
        """Return self: the force has no inputs beside the constants of the body."""
        return self

    def rows(self, rows: slice) -> Self:
        """Return this force at some of the times."""
        return replace(self, t_s=self.t_s[rows])

    def towards(self, other: Self, share: float) -> Self:
        """Return the force of `other`, at times interpolated linearly between both.

        Internal variables are those of `other`.
        """
        return replace(other, t_s=self.t_s + share * (other.t_s - self.t_s))

    def constants(self, states: States) -> Array:
        """Return the constants (c, 1) of the law."""
        return states.theta[self.placed.columns][:, None]

    def columns(self, places: Slots) -> Index:
        """Return the indices in θ of the constants."""
        return self.placed.columns

    def data(self, chosen: Index | None) -> Array:
        """Return the data of the law at all instances, as an `AtNode` reads them."""
        data = np.empty((DATA, len(self.t_s), self.points.count))
        data[0] = self.t_s[:, None]
        data[1:-2] = self.placed.data[:, None]
        data[-2:] = np.array(self.began(len(self.t_s)))[..., None]
        return data


@lru_cache(maxsize=32)
def generated(force: NodeForce, dofs: int) -> Generated:
    """Return the law of a force with derivatives; the last 32 are cached.

    Parameters
    ----------
    force : NodeForce
    dofs : int
        Number of dofs of one instance.
    """
    return Generated(force.expression, force.inputs(dofs), DATA, compiled=force.compiled)


def air_drag(experiment: Experiment, t_s: Array) -> tuple[PointForces, ...]:
    """Return the drag of the air on the body of an experiment; empty if there is none.

    Drag is linear in the density of the air, which is the factor of the drag at a density of 1
    kg/m³.

    Parameters
    ----------
    experiment : Experiment
    t_s : (T,)
        Times.
    """
    if not experiment.has_air_drag:
        return ()
    placed = experiment.body.unit_air_drag
    return (PointForces(placed, t_s, share=experiment.air_density_kg_m3),)


def point_forces(body: Body, t_s: Array) -> tuple[PointForces, ...]:
    """Return the custom forces declared for a body, at times (T,)."""
    return tuple(PointForces(placed, t_s) for placed in body.placed_forces)
