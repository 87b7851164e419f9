"""Law of contact pressure and friction between a deformable body and a rigid obstacle.

At points of the surface with
undeformed areas A and the gap g(x, X) to an obstacle whose frame has the pose X, the contact energy
Ψ, the normal force N and the dissipation potential of friction D are

    Ψ = Σ A κ/(3δ) (⟨δ − g⟩³ − ⟨−g⟩³),    N = A κ/δ (⟨δ − g⟩² − ⟨−g⟩²),
    D = Σ μ N (√(|v_t|² + ε²) − ε),

with stiffness κ, width δ, friction coefficient μ, slip ε and the tangential velocity v_t relative
to the obstacle. The forces are −∂Ψ/∂(x, X) − ∂D/∂(v, V), where V is the velocity of the frame;
forces on the frame are the reaction of the obstacle and balance those on the body. Ψ has continuous
second derivatives and couples only the nodes of one face. At negative gaps N is linear, so that
Newton's method removes any penetration in one step, where a quadratic law would halve it each time.
In a static experiment v is the displacement since the previous sample, so that friction holds each
point where it was then.

Contact as complementarity, 0 ≤ b ⟂ g ≥ 0 with the pressure κ b, is relaxed to b g = r δ². The
relaxation r is given by `Obstacle.relaxed`; for every r the motion is unique, as with the energy,
and all points have a pressure. Programs with b as variables use the constraint
b + g − √((b − g)² + 4 r δ²) = 0, which has derivatives of order one at any gap and is satisfied
only by positive b and g.

Under the midpoint rule the pressure is the mean of its values between both ends of a step,

    N = A κ/δ (m(δ − g_0, δ − g_1) − m(−g_0, −g_1)),   m(a, b) = ∫₀¹ ⟨a + s (b − a)⟩² ds,

with the gaps g_0 and g_1 at ξ ∓ Δt ν/2. The work of the pressure in a step is then the decrease of
Ψ, and contact conserves energy for any length of the step (Gonzalez, J. Nonlinear Sci. 6, 1996;
averaged vector field: Quispel & McLaren, J. Phys. A 41, 2008): exactly where the gap is linear in
the position, to third order in the step where an obstacle is curved or rotates. BDF2 and backward
Euler evaluate the pressure at the end of a step, and lose energy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from ...common.array_types import Array, Index
from ...fem.body import Body
from ...fem.contact_surface import VECTORS_PER_POINT, ContactSurface
from ...fem.laws.moduli import engineering_constants
from ...recording.obstacle import Obstacle
from ..generated_functions import GeneratedFunction

# Stiffness κ in multiples of E / (mean edge length of the face); sets the penetration.
STIFFNESS = 100.0
# Width δ in mean edge lengths of the face: contact begins at this gap, and the pressure κδ at a gap
# of zero is E/50. With ten times the width, a sphere on a mesh of two elements per contact radius
# gives 6 % more force.
WIDTH = 2e-4
# Width δ of contact with friction, in the same unit: where points slip, friction with a stiffer
# pressure law destabilises static equilibria.
FRICTION_WIDTH = 2e-3
# Slip ε of dynamic and of static experiments, in mean edge lengths of all faces per second or per
# sample: the largest creep of a body at rest under friction.
SLIP = (0.01, 1e-4)
# Number of data of a point: area, r δ², δ, κ in units of `stiffness`, and the length of the step
# over which the pressure is averaged.
DATA_COUNT = 5
# Points are evaluated in multiples of this number, so that only a few sizes are compiled.
POINT_BATCH = 16
# Largest b of relaxed contact in widths, which limits the pressure at gaps near zero or below.
LARGEST_SCALED_PRESSURE = 50.0


@dataclass(frozen=True, eq=False)
class ContactLaw:
    """Contact force of one obstacle at a surface point, as an expression with derivatives.

    Below, y (12,) are the contact point and the ends of the three axes of the obstacle's frame,
    relative to the origin of the frame; b is the pressure divided by κ, a length.
    """

    body: Body
    obstacle: Obstacle
    surface: ContactSurface  # points and areas of the surface that may touch the obstacle
    # Whether the experiment is static, so that ν is the displacement since the previous sample.
    is_static: bool
    # Whether the pressure is the mean over a time step instead of that at ξ.
    is_averaged: bool = False

    @property
    def depends_on_velocity(self) -> bool:
        """Whether the force depends on ν: with friction, or if averaged over a step."""
        return self.obstacle.has_friction or self.is_averaged

    @cached_property
    def edges_m(self) -> Array:
        """Mean edge length (i,) of the face at each point [m]; of all faces if contact is
        relaxed.
        """
        if self.obstacle.relaxed is not None:
            return np.full(len(self.surface.area_m2), self.surface.edge_m)
        return np.repeat(self.surface.edges_m, self.surface.points_per_face)

    @cached_property
    def widths_m(self) -> Array:
        """Width δ (i,) of the pressure law at each point [m]: the stated one, else in proportion to
        `edges_m`, with the factor of relaxed contact, of friction, or of neither.
        """
        if self.obstacle.width_m is not None:
            return np.full(len(self.edges_m), self.obstacle.width_m)
        if self.obstacle.relaxed is not None:
            return 2e-3 * self.edges_m
        return (FRICTION_WIDTH if self.obstacle.has_friction else WIDTH) * self.edges_m

    @property
    def largest_width_m(self) -> float:
        """Largest width δ of all points [m]."""
        return float(self.widths_m.max())

    @property
    def slip(self) -> float:
        """Slip ε of friction, in m/s or, in a static experiment, in m per sample."""
        return self.obstacle.slip or SLIP[self.is_static] * self.surface.edge_m

    @cached_property
    def constant_columns(self) -> Index:
        """Indices (c,) in θ of the constants on which the force depends: the elastic ones that
        determine κ, unless it is stated, then the friction coefficient if it is a parameter.
        """
        part = self.surface.part
        columns = []
        if self.obstacle.stiffness_pa_m is None:
            offset = self.body.starts[part]
            columns = [offset + k for k in range(len(self.body.parts[part].material.constants))]
        if (friction := self.obstacle.friction_constant) is not None:
            columns.append(list(self.body.constants).index(friction.name))
        return np.array(columns, dtype=np.int64)

    def stiffness(self, constants: ca.SX) -> ca.SX:
        """Return κ [Pa/m] if it is stated, else κ times the edge length of the face [Pa].

        Parameters
        ----------
        constants : (c,) SX
            Constants of `constant_columns`.
        """
        if self.obstacle.stiffness_pa_m is not None:
            return ca.SX(self.obstacle.stiffness_pa_m)
        material = self.body.parts[self.surface.part].material
        lame = material.lame(constants[: len(material.constants)])
        return STIFFNESS * engineering_constants(lame[0], lame[1])[0]

    def stiffness_at(self, theta: Array) -> Array:
        """Return κ (i,) at each point of a body with constants θ (k,) [Pa/m]."""
        stiffness = float(ca.evalf(self.stiffness(ca.SX(ca.DM(theta[self.constant_columns])))))
        return stiffness * self.data[3]

    def friction_coefficient(self, constants: ca.SX) -> ca.SX:
        """Return the friction coefficient μ: the stated number (0 without friction), or the last of
        the law's constants (c,) if it is a parameter.
        """
        coefficient = self.obstacle.friction
        return constants[-1] if isinstance(coefficient, str) else ca.SX(coefficient)

    def to_obstacle_frame(self, y: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Express a contact point in the axes of its obstacle.

        Parameters
        ----------
        y : (12,) SX
            Contact point and ends of the axes of the obstacle's frame, relative to its origin [m].

        Returns
        -------
        point : (3,) SX
            Contact point in obstacle axes, relative to the origin of the frame [m].
        axes : (3, 3) SX
            Axes of the obstacle, one per column.
        """
        point, *ends = ca.vertsplit(y, 3)
        axes = ca.horzcat(*ends) / self._frame_size_m
        return axes.T @ point, axes

    @property
    def _frame_size_m(self) -> float:
        """Length of the axes of the obstacle's frame before it moves [m]."""
        return float(self.body.frame_nodes_m[1, 0] - self.body.frame_nodes_m[0, 0])

    def gap_at(self, point_m: ca.SX) -> ca.SX:
        """Return the signed gap g [m] at a point in obstacle axes; negative inside the obstacle.

        Parameters
        ----------
        point_m : (3,) SX
            Point relative to the origin of the frame, see `to_obstacle_frame` [m].
        """
        return self.obstacle.shape.signed_distance(point_m + ca.DM(self.body.frame_nodes_m[0]))

    def scaled_pressure(self, gap: ca.SX, data: ca.SX) -> ca.SX:
        """Return b, the pressure divided by κ [m], at a gap.

        With relaxed contact b is r δ² / g, limited to `LARGEST_SCALED_PRESSURE` widths δ; otherwise
        it is (⟨δ − g⟩² − ⟨−g⟩²) / δ.

        Parameters
        ----------
        gap : SX
            Signed gap g [m].
        data : (5,) SX
            Data of the point, see `data`.
        """
        width_m = data[2]
        if not self.obstacle.relaxed:
            reach = ca.fmax(width_m - gap, 0)
            overlap = ca.fmax(-gap, 0)
            return (reach**2 - overlap**2) / width_m
        return data[1] / ca.fmax(gap, data[1] / (LARGEST_SCALED_PRESSURE * width_m))

    def mean_scaled_pressure(self, gaps: tuple[ca.SX, ca.SX], data: ca.SX) -> ca.SX:
        """Return the mean of b [m] over a step in which the gap changes linearly from the first to
        the second of `gaps` [m]; `data` (5,) are those of the point. Relaxed contact has no such
        mean.
        """
        width_m = data[2]
        reach = mean_square(*(width_m - gap for gap in gaps))
        overlap = mean_square(*(-gap for gap in gaps))
        return (reach - overlap) / width_m

    @cached_property
    def data(self) -> Array:
        """Data (5, i) of the points: area A, r δ², δ, κ in units of `stiffness`, and the time step.

        The time step is 0 here; `data_of` inserts it.
        """
        relaxed = (self.obstacle.relaxed or 0.0) * self.widths_m**2
        has_stiffness = self.obstacle.stiffness_pa_m is not None
        per_unit = np.ones_like(self.edges_m) if has_stiffness else 1 / self.edges_m
        step_s = np.zeros_like(self.edges_m)
        return np.array([self.surface.area_m2, relaxed, self.widths_m, per_unit, step_s])

    def data_of(self, points: Index | slice, step_s: float) -> Array:
        """Return the data (5, i) of some points, with the time step `step_s` [s]."""
        data = self.data[:, points].copy()
        data[4] = step_s
        return data

    @cached_property
    def gap_function(self) -> GeneratedFunction:
        """Expression of the gap g [m] of y (12,), with derivatives; it has no data."""
        return GeneratedFunction(
            lambda y, _: self.gap_at(self.to_obstacle_frame(y)[0]),
            3 * VECTORS_PER_POINT,
            data_size=0,
            is_compiled=True,
        )

    def gaps(self, y: Array) -> Array:
        """Return the gaps g (T, i) [m] at y (12, T, i)."""
        return self.gap_function.evaluate(y, _no_data(y))[0]

    def gaps_with_slopes(self, y: Array) -> tuple[Array, Array]:
        """Return the gaps g (T, i) [m] at y (12, T, i), and their derivatives by y (12, T, i)."""
        gaps, slopes = self.gap_function.evaluate_with_jacobian(y, _no_data(y))
        return gaps[0], slopes[0]

    @cached_property
    def force_function(self) -> GeneratedFunction:
        """Expression of the forces (12,) of (y, ẏ, c), or (y, c) without velocities, and of
        data.
        """
        moving = 3 * VECTORS_PER_POINT * self.depends_on_velocity
        return GeneratedFunction(
            self.force_expression,
            3 * VECTORS_PER_POINT + moving + len(self.constant_columns),
            data_size=DATA_COUNT,
            is_compiled=True,
        )

    @cached_property
    def point_force_function(self) -> GeneratedFunction:
        """Expression of the force (3,) on a point as a function of its position and velocity alone.

        Data are, in this order, the other entries of (y, ẏ), the constants and the data of the
        point.
        """
        moving = 1 + self.depends_on_velocity

        def force(u: ca.SX, data: ca.SX) -> ca.SX:
            moving_parts = ca.vertsplit(u, 3)
            frame = ca.vertsplit(data, [0, 9 * moving, data.numel()])
            frame_ends = ca.vertsplit(frame[0], 9)
            y = [part for pair in zip(moving_parts, frame_ends, strict=True) for part in pair]
            constants, point_data = ca.vertsplit(
                frame[1], [0, len(self.constant_columns), len(self.constant_columns) + DATA_COUNT]
            )
            return self.force_expression(ca.vertcat(*y, constants), point_data)[:3]

        return GeneratedFunction(
            force,
            3 * moving,
            data_size=9 * moving + len(self.constant_columns) + DATA_COUNT,
            is_compiled=True,
        )

    @cached_property
    def complementarity_function(self) -> GeneratedFunction:
        """Expression of forces (12,) at given b and of the complementarity residual, of (y, c,
        b).
        """
        return GeneratedFunction(
            self._complementarity_expression,
            3 * VECTORS_PER_POINT + len(self.constant_columns) + 1,
            data_size=DATA_COUNT,
            is_compiled=True,
        )

    def _complementarity_expression(self, u: ca.SX, data: ca.SX) -> ca.SX:
        """Return contact forces (12,) on y and b + g − √((b − g)² + 4 r δ²), 0 where b g = r δ²."""
        inputs, b = ca.vertsplit(u, [0, u.numel() - 1, u.numel()])
        gap = self.gap_at(self.to_obstacle_frame(inputs[: 3 * VECTORS_PER_POINT])[0])
        residual = b + gap - ca.sqrt((b - gap) ** 2 + 4 * data[1])
        return ca.vertcat(self.force_expression(inputs, data, scaled_pressure=b), residual)

    @cached_property
    def scaled_pressure_function(self) -> GeneratedFunction:
        """Expression of b [m] of the gap [m] and the data (5,) of the point."""
        return GeneratedFunction(self.scaled_pressure, 1, data_size=DATA_COUNT)

    def force_expression(
        self, u: ca.SX, data: ca.SX, scaled_pressure: ca.SX | None = None
    ) -> ca.SX:
        """Return the contact forces (12,) on y: on the point, then on the ends of the frame's axes
        [N].

        Parameters
        ----------
        u : SX
            Stacked (y, ẏ, c), or (y, c) if the force does not depend on velocities.
        data : (5,) SX
            Data of the point.
        scaled_pressure : SX, optional
            Given b; that of the gap by default.
        """
        place, axes, slope, force_n = self._normal_contact(u, data, pressing=scaled_pressure)
        # The forces on the ends of the axes follow from the coordinates of the point in these axes.
        push = force_n * slope
        force = ca.vertcat(axes @ push, ca.vec(u[:3] @ push.T) / self._frame_size_m)
        if not self.obstacle.has_friction:
            return force
        _, friction, _ = self._friction(u, place, axes @ slope, force_n)
        return force + ca.vertcat(friction, -ca.vec(friction @ (place / self._frame_size_m).T))

    def _normal_contact(
        self, u: ca.SX, data: ca.SX, pressing: ca.SX | None
    ) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Return point [m], axes (3, 3) and ∂gap/∂point in obstacle axes, and normal force [N]."""
        place, axes = self.to_obstacle_frame(u[: 3 * VECTORS_PER_POINT])
        symbol = ca.SX.sym("place", 3)
        gap = self.gap_at(symbol)
        slope = ca.gradient(self.gap_at(symbol), symbol)
        gap, slope = ca.substitute([gap, slope], [symbol], [place])
        if pressing is not None:
            scaled_pressure = pressing
        elif self.is_averaged:
            scaled_pressure = self.mean_scaled_pressure(self._end_gaps(u, half_s=data[4] / 2), data)
        else:
            scaled_pressure = self.scaled_pressure(gap, data)
        force_n = data[0] * data[3] * self.stiffness(self._constants(u)) * scaled_pressure
        return place, axes, slope, force_n

    def _end_gaps(self, u: ca.SX, half_s: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Return the gaps [m] `half_s` before and after the state in u, at constant velocities."""
        y = u[: 3 * VECTORS_PER_POINT]
        v = u[3 * VECTORS_PER_POINT : 6 * VECTORS_PER_POINT]
        before, after = (
            self.gap_at(self.to_obstacle_frame(y + way * v)[0]) for way in (-half_s, half_s)
        )
        return before, after

    def _constants(self, u: ca.SX) -> ca.SX:
        """Return the constants (c,), which are the last entries of u."""
        return u[u.numel() - len(self.constant_columns) :]

    def _friction(
        self, u: ca.SX, place: ca.SX, slope: ca.SX, force_n: ca.SX
    ) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Return limit μ N [N], friction (3,) [N] and tangential velocity (3,) [m/s] (world)."""
        relative, *ends = ca.vertsplit(u[3 * VECTORS_PER_POINT : 6 * VECTORS_PER_POINT], 3)
        relative -= ca.horzcat(*ends) @ (place / self._frame_size_m)
        normal = slope / ca.norm_2(slope)
        tangential = relative - normal * ca.dot(normal, relative)
        limit_n = self.friction_coefficient(self._constants(u)) * force_n
        speed = ca.sqrt(ca.sumsqr(tangential) + self.slip**2)
        return limit_n, -limit_n / speed * tangential, tangential

    @cached_property
    def friction_function(self) -> GeneratedFunction:
        """Expression of friction of (y, ẏ, c), 6 values; only for an obstacle with friction.

        These are the limit μ N [N], the same where the point slips (else 0), the friction force
        (3,) [N] in the axes of the world, and the dissipated power [W].
        """

        def friction_values(u: ca.SX, data: ca.SX) -> ca.SX:
            place, axes, slope, force_n = self._normal_contact(u, data, pressing=None)
            limit_n, force, velocity = self._friction(u, place, axes @ slope, force_n)
            # Friction is then at least 95 % of its limit.
            slip_speed = 3.0 * self.slip
            slips = ca.sumsqr(velocity) > slip_speed**2
            return ca.vertcat(limit_n, limit_n * slips, force, -ca.dot(force, velocity))

        return GeneratedFunction(
            friction_values, self.force_function.input_size, data_size=DATA_COUNT
        )


def _no_data(y: Array) -> Array:
    return np.zeros((0, *y.shape[1:]))


@lru_cache(maxsize=32)
def contact_law(
    body: Body, obstacle: Obstacle, *, static: bool, averaged: bool = False
) -> ContactLaw:
    """Return the contact law between an obstacle and a body; the last 32 laws are cached, so that
    the same arguments give the same object.

    Parameters
    ----------
    averaged : bool
        Whether the pressure is the mean over a time step.
    """
    return ContactLaw(
        body,
        obstacle,
        surface=obstacle.contact_surface(body),
        is_static=static,
        is_averaged=averaged,
    )


def mean_square(first: ca.SX, second: ca.SX) -> ca.SX:
    """Return the mean ∫₀¹ ⟨a + s (b − a)⟩² ds between two numbers a = `first` and b = `second`,
    without cancellation; ⟨·⟩ is the positive part.
    """
    high = ca.fmax(first, second)
    low = ca.fmin(first, second)
    both = (high**2 + high * low + low**2) / 3
    # Where low is negative, high − low is at least high.
    one = high**3 / (3 * ca.if_else(low > 0, 1.0, ca.fmax(high - low, 1e-30)))
    return ca.if_else(low > 0, both, ca.if_else(high > 0, one, 0.0))
