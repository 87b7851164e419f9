"""Contact with obstacles: a pressure that grows as a surface comes near, and friction.

At points of the surface with undeformed areas A and the gap g(x, X) to an obstacle whose frame
is at X, the energy and the dissipation potential are

    Ψ = Σ A κ/(3δ) (⟨δ − g⟩³ − ⟨−g⟩³),    N = A κ/δ (⟨δ − g⟩² − ⟨−g⟩²),
    D = Σ μ N (√(|v_t|² + ε²) − ε),

v_t being the velocity along the obstacle's surface against it. Forces are −∂Ψ/∂(x, X) − ∂D/∂(v, V):
those on the frame are what the obstacle is given, and balance. Ψ has continuous second derivatives
and joins nothing but the nodes of a face. Inside, N is linear: Newton's method leaves any depth in
a step, where a parabola would halve it each time. In a static experiment v is the way since the
sample before, so that friction holds each point where it was then.

Contact as complementarity, 0 ≤ b ⟂ g ≥ 0 of a pressure κ b, is relaxed to b g = r δ², which is less
the smaller r is, see `Obstacle.relaxed`: that has one motion, as the energy has, and all points
act. Programs that have b as variables have it as b + g − √((b − g)² + 4 r δ²) = 0, whose slopes are
of order one wherever the point is, and which holds for positive b and g alone.

An impact rings, and may gain energy, under the midpoint rule; BDF2 and backward Euler lose it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Self

import casadi as ca
import numpy as np

from ..arrays import Array, Index
from ..fem.body import Body
from ..fem.force_points import ForcePoints
from ..fem.moduli import engineering
from ..fem.touching import VECTORS, Touching
from ..recording.experiment import Experiment
from ..recording.obstacle import Obstacle
from .force_term import Slots, States
from .generated import Generated
from .point_forces import Brought, Pointwise

# κ in E over an edge of the mesh, δ in edges; ε in edges a second, or a sample: by up to that much
# a body creeps that lies where it is held by friction.
STIFFNESS, WIDTH, SLIP = 100.0, 0.002, (0.01, 1e-4)
# Many ε fast the friction is 95 % of its limit, and more: it slips.
FAST = 3.0
# Evaluations are of so many points at a time, or a multiple: that few sizes are compiled.
AT_A_TIME = 16
# Widths that b of relaxed contact has at most, also where a gap is not positive.
MOST = 50.0


@dataclass(frozen=True, eq=False)
class ContactLaw:
    """The force of one obstacle at a point, as an expression.

    Attributes
    ----------
    body : Body
    obstacle : Obstacle
    surface : Touching
    static : bool
    """

    body: Body
    obstacle: Obstacle
    surface: Touching
    static: bool

    @property
    def width_m(self) -> float:
        """δ."""
        return self.obstacle.width_m or WIDTH * self.surface.edge_m

    @property
    def slip(self) -> float:
        """ε."""
        return self.obstacle.slip or SLIP[self.static] * self.surface.edge_m

    @cached_property
    def columns(self) -> Index:
        """(c,) places in θ of what κ follows, and of the friction."""
        part, found = self.surface.part, []
        if self.obstacle.stiffness_pa_m is None:
            first = self.body.starts[part]
            found = [first + k for k in range(len(self.body.parts[part].material.constants))]
        if (friction := self.obstacle.coefficient) is not None:
            found.append(list(self.body.constants).index(friction.name))
        return np.array(found, dtype=np.int64)

    def stiffness(self, constants: ca.SX) -> ca.SX:
        """κ [Pa/m]."""
        if self.obstacle.stiffness_pa_m is not None:
            return ca.SX(self.obstacle.stiffness_pa_m)
        material = self.body.parts[self.surface.part].material
        lame = material.lame(constants[: len(material.constants)])
        return STIFFNESS / self.surface.edge_m * engineering(lame[0], lame[1])[0]

    def stiffness_at(self, theta: Array) -> float:
        """The same of a body of constants θ (k,)."""
        return float(ca.evalf(self.stiffness(ca.SX(ca.DM(theta[self.columns])))))

    def friction(self, constants: ca.SX) -> ca.SX:
        """μ."""
        stated = self.obstacle.friction
        return constants[-1] if isinstance(stated, str) else ca.SX(stated)

    def seen(self, y: ca.SX) -> tuple[ca.SX, ca.SX]:
        """A point in the frame of its obstacle, from the origin on, and the axes of that."""
        point, *ends = ca.vertsplit(y, 3)
        axes = ca.horzcat(*ends) / self._size_m
        return axes.T @ point, axes

    @property
    def _size_m(self) -> float:
        """Of the frame."""
        return float(self.body.frame_m[1, 0] - self.body.frame_m[0, 0])

    def gap(self, place: ca.SX) -> ca.SX:
        """G at a place so seen."""
        return self.obstacle.shape.gap(place + ca.DM(self.body.frame_m[0]))

    def near(self, gap: ca.SX, product: ca.SX) -> ca.SX:
        """B, the pressure over κ, where its product with the gap is as relaxed."""
        if not self.obstacle.relaxed:
            near, within = ca.fmax(self.width_m - gap, 0), ca.fmax(-gap, 0)
            return (near**2 - within**2) / self.width_m
        return product / ca.fmax(gap, product / (MOST * self.width_m))

    @property
    def data(self) -> Array:
        """(2, i) area A, and r δ²."""
        relaxed = (self.obstacle.relaxed or 0.0) * self.width_m**2
        return np.array([self.surface.area_m2, np.full(len(self.surface.area_m2), relaxed)])

    @cached_property
    def distance(self) -> Generated:
        """G alone."""
        return Generated(lambda y, _: self.gap(self.seen(y)[0]), 3 * VECTORS, 0, compiled=True)

    def gaps(self, y: Array) -> Array:
        """(T, i) G at y (12, T, i)."""
        return self.distance.value(y, _no_data(y))[0]

    @cached_property
    def generated(self) -> Generated:
        """The forces, of (y, ẏ, c) or (y, c), and of data."""
        moving = 3 * VECTORS * self.obstacle.rubs
        return Generated(self.force, 3 * VECTORS + moving + len(self.columns), 2, compiled=True)

    @cached_property
    def push(self) -> Generated:
        """The force (3,) on a point by its own part of (y, ẏ); the rest and c are data, first."""
        moving = 1 + self.obstacle.rubs

        def force(u: ca.SX, data: ca.SX) -> ca.SX:
            own, frame = ca.vertsplit(u, 3), ca.vertsplit(data, [0, 9 * moving, data.numel()])
            ends = ca.vertsplit(frame[0], 9)
            y = [part for pair in zip(own, ends, strict=True) for part in pair]
            constants, given = ca.vertsplit(frame[1], [0, len(self.columns), len(self.columns) + 2])
            return self.force(ca.vertcat(*y, constants), given)[:3]

        return Generated(force, 3 * moving, 9 * moving + len(self.columns) + 2, compiled=True)

    @cached_property
    def pressed(self) -> Generated:
        """The forces at b, and what is zero where b is right, of (y, c, b)."""
        return Generated(self._pressed, 3 * VECTORS + len(self.columns) + 1, 2, compiled=True)

    def _pressed(self, u: ca.SX, data: ca.SX) -> ca.SX:
        own, b = ca.vertsplit(u, [0, u.numel() - 1, u.numel()])
        gap = self.gap(self.seen(own[: 3 * VECTORS])[0])
        apart = b + gap - ca.sqrt((b - gap) ** 2 + 4 * data[1])
        return ca.vertcat(self.force(own, data, b), apart)

    @cached_property
    def pressing(self) -> Generated:
        """B of a gap."""
        return Generated(lambda gap, data: self.near(gap, data[1]), 1, 2)

    def force(self, u: ca.SX, data: ca.SX, pressing: ca.SX | None = None) -> ca.SX:
        """(12,) on the ways to the point and to the ends of the frame, at b as it is or given."""
        place, axes, slope, normal_n = self._normal(u, data, pressing)
        # What turns the frame is as the point is seen along its axes.
        push = normal_n * slope
        force = ca.vertcat(axes @ push, ca.vec(u[:3] @ push.T) / self._size_m)
        if not self.obstacle.rubs:
            return force
        _, rub, _ = self._rub(u, place, axes @ slope, normal_n)
        return force + ca.vertcat(rub, -ca.vec(rub @ (place / self._size_m).T))

    def _normal(
        self, u: ca.SX, data: ca.SX, pressing: ca.SX | None
    ) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """The point in the obstacle's frame, its axes, the gap's slope there and N."""
        place, axes = self.seen(u[: 3 * VECTORS])
        here = ca.SX.sym("place", 3)
        gap, slope = self.gap(here), ca.gradient(self.gap(here), here)
        gap, slope = ca.substitute([gap, slope], [here], [place])
        near = self.near(gap, data[1]) if pressing is None else pressing
        return place, axes, slope, data[0] * self.stiffness(self._constants(u)) * near

    def _constants(self, u: ca.SX) -> ca.SX:
        return u[u.numel() - len(self.columns) :]

    def _rub(
        self, u: ca.SX, place: ca.SX, slope: ca.SX, normal_n: ca.SX
    ) -> tuple[ca.SX, ca.SX, ca.SX]:
        """What friction may be, what it is (3,), and the velocity along the obstacle (3,)."""
        against, *ends = ca.vertsplit(u[3 * VECTORS : 6 * VECTORS], 3)
        against -= ca.horzcat(*ends) @ (place / self._size_m)
        normal = slope / ca.norm_2(slope)
        along = against - normal * ca.dot(normal, against)
        limit_n = self.friction(self._constants(u)) * normal_n
        return limit_n, -limit_n / ca.sqrt(ca.sumsqr(along) + self.slip**2) * along, along

    @cached_property
    def rubbing(self) -> Generated:
        """What friction may be, that of what slips, what it is (3,), and its power; (y, ẏ, c)."""

        def told(u: ca.SX, data: ca.SX) -> ca.SX:
            place, axes, slope, normal_n = self._normal(u, data, None)
            limit_n, rub, along = self._rub(u, place, axes @ slope, normal_n)
            slips = ca.sumsqr(along) > (FAST * self.slip) ** 2
            return ca.vertcat(limit_n, limit_n * slips, rub, -ca.dot(rub, along))

        return Generated(told, self.generated.inputs, 2)


@dataclass(frozen=True, eq=False)
class Contact(Pointwise):
    """What one obstacle does to a body, at any times.

    Attributes
    ----------
    contact : ContactLaw
    share : float
    brought : Brought, optional
        Of a program that has b as variables: these; they follow from the gap by default.
    """

    contact: ContactLaw
    share: float = 1.0
    brought: Brought | None = None
    weighed: Array | None = None
    size, slides = 0, True

    @property
    def points(self) -> ForcePoints:  # type: ignore[override]
        """Of the surface."""
        return self.contact.surface.points

    @property
    def law(self) -> Generated:
        """That of the obstacle."""
        return self.contact.generated if self.brought is None else self.contact.pressed

    @property
    def relaxed(self) -> bool:
        """Whether it is complementarity."""
        return self.contact.obstacle.relaxed is not None

    @property
    def carries(self) -> int:  # type: ignore[override]
        """Where b is given."""
        return int(self.brought is not None)

    def pressing(self, xi: Array) -> Array:
        """(1, T, i) b at states (T, 3n)."""
        gaps = self.contact.gaps(self.points.vectors(xi))
        data = np.broadcast_to(self.contact.data[:, None], (2, *gaps.shape))
        return self.contact.pressing.value(gaps[None], data)

    def rubbing(self, states: States) -> Array:
        """(6, T) sums over its points of what friction does, see the law's."""
        here = self._at(states)
        return self.contact.rubbing.value(here.u, here.data).sum(axis=2)

    @property
    def by_velocity(self) -> bool:
        """Where it rubs."""
        return self.contact.obstacle.rubs

    @property
    def turns(self) -> bool:
        """Where it rubs; else its slopes have no skew part, to the last digit."""
        return self.contact.obstacle.rubs

    def at(self, u: Array) -> Self:
        """It has no inputs but constants."""
        return self

    def rows(self, rows: slice) -> Self:
        """It is the same at all times."""
        return self

    def towards(self, other: Self, share: float) -> Self:
        """Obstacles move with their frames, as grasps do."""
        return self

    def acting(self, states: States) -> tuple[Index | None, Array]:
        """Points within δ at any of the times, and some more, with their y; all if relaxed."""
        y = self.points.vectors(states.xi)
        if self.relaxed:
            return None, y
        near = np.any(self.contact.gaps(y) < self.contact.width_m, axis=0)
        near[np.flatnonzero(~near)[: -near.sum() % AT_A_TIME]] = True
        chosen = np.flatnonzero(near)
        return chosen, y[..., chosen]

    def deepest(self, x: Array) -> tuple[float, Array]:
        """How far within δ the point is at x (3n,) that is deepest, and the normal (3,) there."""
        y = self.points.vectors(x[None])
        gap, slopes = self.contact.distance.slopes(y, _no_data(y))
        place = int(gap[0, 0].argmin())
        return self.contact.width_m - float(gap[0, 0, place]), slopes[0, :3, 0, place]

    def constants(self, states: States) -> Array:
        """What κ follows, and the friction."""
        return states.theta[self.contact.columns][:, None]

    def columns(self, places: Slots) -> Index:
        """Their places in θ."""
        return self.contact.columns

    def data(self, chosen: Index | None) -> Array:
        """Of the law."""
        return self.contact.data[:, None, slice(None) if chosen is None else chosen]


def _no_data(y: Array) -> Array:
    return np.zeros((0, *y.shape[1:]))


def contacts(experiment: Experiment) -> tuple[Contact, ...]:
    """Those of an experiment's obstacles."""
    laws = (contact_law(experiment.body, o, experiment.static) for o in experiment.obstacles)
    return tuple(Contact(law) for law in laws)


@lru_cache(maxsize=32)
def contact_law(body: Body, obstacle: Obstacle, static: bool) -> ContactLaw:
    """What an obstacle does to a body; that of the last few is kept, with its derivatives."""
    return ContactLaw(body, obstacle, obstacle.surface(body), static)
