"""Contact pressure and friction between a deformable body and rigid obstacles.

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

Under the midpoint rule the pressure is the mean of its values between both ends of a step,

    N = A κ/δ (m(δ − g_0, δ − g_1) − m(−g_0, −g_1)),   m(a, b) = ∫₀¹ ⟨a + s (b − a)⟩² ds,

g_0 and g_1 being the gaps at ξ ∓ Δt ν/2. So the work of the pressure in a step is the loss of Ψ,
and contact neither gains nor loses energy, however long the step is (Gonzalez, J. Nonlinear Sci. 6,
1996; averaged vector field: Quispel & McLaren, J. Phys. A 41, 2008): exactly where the gap is
linear in the position, to third order in the step where an obstacle is curved or turns. BDF2 and
backward Euler evaluate the pressure at the end of a step, and lose energy.
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

# κ in E over the mean edge of the face at the point.
STIFFNESS = 100.0
# δ in the same edges: force begins so early, and the pressure κδ at a gap of zero is E/50. With ten
# times that, a sphere on a mesh of two elements per contact radius gives 6 % more force.
WIDTH = 2e-4
# δ of contact with friction: where points slip, friction that follows a stiffer pressure takes the
# stability of static equilibria away.
FRICTION_WIDTH = 2e-3
# δ of contact as complementarity, whose pressures are relaxed in shares of κδ².
RELAXED_WIDTH = 2e-3
# ε in mean edges of all faces a second, or a sample of a static experiment: by up to that much a
# body creeps that lies where it is held by friction.
SLIP = (0.01, 1e-4)
# Data of a point: area, product of relaxed contact, δ, κ in units of `stiffness`, and the length of
# the step that a pressure is averaged over.
DATA = 5
# Many ε fast the friction is 95 % of its limit, and more: it slips.
FAST = 3.0
# Evaluations are of so many points at a time, or a multiple: that few sizes are compiled.
AT_A_TIME = 16
# Below it no gap differs from another [m].
TINY_M = 1e-30
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
    averaged : bool
        Whether the pressure is a mean over a time step; that at ξ if not.
    """

    body: Body
    obstacle: Obstacle
    surface: Touching
    static: bool
    averaged: bool = False

    @property
    def by_velocity(self) -> bool:
        """Whether the force depends on the velocity: with friction, or averaged over a step."""
        return self.obstacle.rubs or self.averaged

    @cached_property
    def edges_m(self) -> Array:
        """(i,) mean edge of the face at each point; of relaxed contact, of all faces."""
        if self.obstacle.relaxed is not None:
            return np.full(len(self.surface.area_m2), self.surface.edge_m)
        return np.repeat(self.surface.edges_m, self.surface.a_face)

    @cached_property
    def widths_m(self) -> Array:
        """(i,) δ at each point."""
        if self.obstacle.width_m is not None:
            return np.full(len(self.edges_m), self.obstacle.width_m)
        if self.obstacle.relaxed is not None:
            return RELAXED_WIDTH * self.edges_m
        return (FRICTION_WIDTH if self.obstacle.rubs else WIDTH) * self.edges_m

    @property
    def width_m(self) -> float:
        """The largest δ of all points."""
        return float(self.widths_m.max())

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
        """Return κ where it is stated [Pa/m], or else κ times the edge of the face [Pa]."""
        if self.obstacle.stiffness_pa_m is not None:
            return ca.SX(self.obstacle.stiffness_pa_m)
        material = self.body.parts[self.surface.part].material
        lame = material.lame(constants[: len(material.constants)])
        return STIFFNESS * engineering(lame[0], lame[1])[0]

    def stiffness_at(self, theta: Array) -> Array:
        """Return κ (i,) at each point of a body of constants θ (k,) [Pa/m]."""
        stiffness = float(ca.evalf(self.stiffness(ca.SX(ca.DM(theta[self.columns])))))
        return stiffness * self.data[3]

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

    def near(self, gap: ca.SX, data: ca.SX) -> ca.SX:
        """Return b, the pressure over κ, at a gap; where contact is relaxed, their product is."""
        width_m = data[2]
        if not self.obstacle.relaxed:
            near, within = ca.fmax(width_m - gap, 0), ca.fmax(-gap, 0)
            return (near**2 - within**2) / width_m
        return data[1] / ca.fmax(gap, data[1] / (MOST * width_m))

    def mean_near(self, gaps: tuple[ca.SX, ca.SX], data: ca.SX) -> ca.SX:
        """Return the mean of b while the gap goes evenly from the first to the second value."""
        width_m = data[2]
        above = mean_square(*(width_m - gap for gap in gaps))
        within = mean_square(*(-gap for gap in gaps))
        return (above - within) / width_m

    @cached_property
    def data(self) -> Array:
        """(5, i) area A, r δ², δ, κ in units of `stiffness`, and room for the time step."""
        relaxed = (self.obstacle.relaxed or 0.0) * self.widths_m**2
        stated = self.obstacle.stiffness_pa_m is not None
        per_unit = np.ones_like(self.edges_m) if stated else 1 / self.edges_m
        step_s = np.zeros_like(self.edges_m)
        return np.array([self.surface.area_m2, relaxed, self.widths_m, per_unit, step_s])

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
        moving = 3 * VECTORS * self.by_velocity
        return Generated(self.force, 3 * VECTORS + moving + len(self.columns), DATA, compiled=True)

    @cached_property
    def push(self) -> Generated:
        """The force (3,) on a point by its own part of (y, ẏ); the rest and c are data, first."""
        moving = 1 + self.by_velocity

        def force(u: ca.SX, data: ca.SX) -> ca.SX:
            own, frame = ca.vertsplit(u, 3), ca.vertsplit(data, [0, 9 * moving, data.numel()])
            ends = ca.vertsplit(frame[0], 9)
            y = [part for pair in zip(own, ends, strict=True) for part in pair]
            constants, given = ca.vertsplit(
                frame[1], [0, len(self.columns), len(self.columns) + DATA]
            )
            return self.force(ca.vertcat(*y, constants), given)[:3]

        return Generated(force, 3 * moving, 9 * moving + len(self.columns) + DATA, compiled=True)

    @cached_property
    def pressed(self) -> Generated:
        """The forces at b, and what is zero where b is right, of (y, c, b)."""
        return Generated(self._pressed, 3 * VECTORS + len(self.columns) + 1, DATA, compiled=True)

    def _pressed(self, u: ca.SX, data: ca.SX) -> ca.SX:
        own, b = ca.vertsplit(u, [0, u.numel() - 1, u.numel()])
        gap = self.gap(self.seen(own[: 3 * VECTORS])[0])
        apart = b + gap - ca.sqrt((b - gap) ** 2 + 4 * data[1])
        return ca.vertcat(self.force(own, data, b), apart)

    @cached_property
    def pressing(self) -> Generated:
        """B of a gap."""
        return Generated(self.near, 1, DATA)

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
        if pressing is not None:
            near = pressing
        elif self.averaged:
            near = self.mean_near(self._end_gaps(u, half_s=data[4] / 2), data)
        else:
            near = self.near(gap, data)
        return place, axes, slope, data[0] * data[3] * self.stiffness(self._constants(u)) * near

    def _end_gaps(self, u: ca.SX, half_s: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Return the gaps at both ends of a step, half a step before and after ξ."""
        y, v = u[: 3 * VECTORS], u[3 * VECTORS : 6 * VECTORS]
        before, after = (self.gap(self.seen(y + way * v)[0]) for way in (-half_s, half_s))
        return before, after

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

        return Generated(told, self.generated.inputs, DATA)


@dataclass(frozen=True, eq=False)
class Contact(Pointwise):
    """What one obstacle does to a body, at any times.

    Attributes
    ----------
    contact : ContactLaw
    share : float
    brought : Brought, optional
        Of a program that has b as variables: these; they follow from the gap by default.
    step_s : float
        Length of the time steps over which an averaged pressure is a mean.
    """

    contact: ContactLaw
    share: float = 1.0
    brought: Brought | None = None
    weighed: Array | None = None
    step_s: float = 0.0
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
        data = np.broadcast_to(self.contact.data[:, None], (DATA, *gaps.shape))
        return self.contact.pressing.value(gaps[None], data)

    def rigid_limit_n(self, states: States) -> Array:
        """Return the change (T, 3n) of the forces if contact were rigid, to first order [N].

        With κ/ε and ε δ the pressure depends on the gap by g/ε alone. So at ε → 0 it is what it is
        now at a gap that is larger by g, where it is not zero: points come back to the surface of
        the obstacle from where they are inside it or before it. The states must be those of
        a pressure that is not averaged.
        """
        here = self._at(states)
        y = here.u[here.y]
        gap, normal = self.contact.distance.slopes(y, _no_data(y))
        _, slopes = self.law.slopes(here.u, here.data)
        change = np.einsum("vkti,kti->vti", slopes[here.y, :3], normal[0, :3] * gap[0])
        return self.share * self.points.summed(change, here.chosen)

    def rubbing(self, states: States) -> Array:
        """(6, T) sums over its points of what friction does, see the law's."""
        here = self._at(states)
        return self.contact.rubbing.value(here.u, here.data).sum(axis=2)

    @property
    def by_velocity(self) -> bool:
        """Where it rubs, or where the pressure is averaged over a step."""
        return self.contact.by_velocity

    @property
    def turns(self) -> bool:
        """As `by_velocity`; else its slopes have no skew part, to the last digit."""
        return self.contact.by_velocity

    @property
    def spins(self) -> bool:  # type: ignore[override]
        """Where the pressure is averaged over a step."""
        return self.contact.averaged

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
        near = np.any(self._least_gaps(states, y) < self.contact.widths_m, axis=0)
        near[np.flatnonzero(~near)[: -near.sum() % AT_A_TIME]] = True
        chosen = np.flatnonzero(near)
        return chosen, y[..., chosen]

    def _least_gaps(self, states: States, y: Array) -> Array:
        """Return the gaps (T, i) at y; where pressures are averaged, the smaller of both ends."""
        half_s = self.step_s / 2
        if not half_s:
            return self.contact.gaps(y)
        way = half_s * self.points.vectors(states.nu)
        return np.minimum(self.contact.gaps(y - way), self.contact.gaps(y + way))

    def deepest(self, x: Array) -> tuple[float, Array]:
        """How far within δ the point is at x (3n,) that is deepest, and the normal (3,) there."""
        y = self.points.vectors(x[None])
        gap, slopes = self.contact.distance.slopes(y, _no_data(y))
        place = int(gap[0, 0].argmin())
        return self.contact.widths_m[place] - float(gap[0, 0, place]), slopes[0, :3, 0, place]

    def constants(self, states: States) -> Array:
        """What κ follows, and the friction."""
        return states.theta[self.contact.columns][:, None]

    def columns(self, places: Slots) -> Index:
        """Their places in θ."""
        return self.contact.columns

    def data(self, chosen: Index | None) -> Array:
        """Of the law."""
        return self.data_of(slice(None) if chosen is None else chosen)[:, None]

    def data_of(self, points: Index | slice) -> Array:
        """Return the data (5, i) of some points, with the time step."""
        data = self.contact.data[:, points].copy()
        data[4] = self.step_s
        return data


def _no_data(y: Array) -> Array:
    return np.zeros((0, *y.shape[1:]))


def contacts(experiment: Experiment, step_s: float = 0.0) -> tuple[Contact, ...]:
    """Return the contact terms of an experiment's obstacles.

    Parameters
    ----------
    step_s : float
        Length of the time steps over which pressures are averaged; 0 for those at each state.
        Relaxed contact is not averaged.
    """
    terms = []
    for obstacle in experiment.obstacles:
        averaged = step_s > 0 and obstacle.relaxed is None
        law = contact_law(experiment.body, obstacle, static=experiment.static, averaged=averaged)
        terms.append(Contact(law, step_s=step_s if averaged else 0.0))
    return tuple(terms)


@lru_cache(maxsize=32)
def contact_law(
    body: Body, obstacle: Obstacle, *, static: bool, averaged: bool = False
) -> ContactLaw:
    """Return what an obstacle does to a body; the last few laws are kept, with derivatives."""
    return ContactLaw(body, obstacle, obstacle.surface(body), static, averaged)


def mean_square(first: ca.SX, second: ca.SX) -> ca.SX:
    """Return the mean ∫₀¹ ⟨a + s (b − a)⟩² ds of ⟨·⟩² from a to b, without cancellation."""
    high, low = ca.fmax(first, second), ca.fmin(first, second)
    both = (high**2 + high * low + low**2) / 3
    # Where low is negative, high − low is at least high.
    one = high**3 / (3 * ca.if_else(low > 0, 1.0, ca.fmax(high - low, TINY_M)))
    return ca.if_else(low > 0, both, ca.if_else(high > 0, one, 0.0))
