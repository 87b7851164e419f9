"""Motion of a hand and signals of actuators as cubic B-splines of their coordinates, from rest to
rest.

The first six coordinates are a shift d(t) and a rotation vector r(t) relative to the initial pose, so
that the hand is at p₀ + d(t) with the orientation exp(r(t)) R₀; the others are those of `Signal`s.
First and second derivatives are zero at both ends, because the first three and the last three
coefficients of a clamped cubic spline are equal there; after the end all coordinates stay.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from ...common.array_types import Array, Index
from ...common.files import reason
from ...errors import InputError
from .hand_limits import WITHIN, HandBounds
from .hand_motion import TimeDerivatives
from .signals import Signal

# Expression (k,), which must not be positive, of the position (3,) and the rotation (3, 3).
PoseLimit = Callable[[ca.SX, ca.SX], Any]

DEGREE = 3
# Coordinates of the hand, which come first.
HAND = 6
# Points of an interval of the spline at which limits hold; its knots are among them, where the
# acceleration has its peaks.
LIMIT_POINTS = 6
# Points of an interval at which the limits are checked.
CHECK_POINTS = 40
# Coefficients at each end that are equal, so that velocity and acceleration vanish.
EQUAL = 3
# Squared angle below which the factors of rotations are evaluated by their series [rad²].
SMALL_SQUARE = 1e-4


@dataclass(frozen=True, eq=False)
class SplineSpace:
    """Cubic splines of k coordinates, the first six those of a hand, that begin and end at rest.

    The unknowns are scaled coefficients, those of the free coordinates, time by time: first the
    inner coefficients, and last the value at the end unless it is given.
    """

    duration_s: float  # duration of the motion [s]
    intervals: int  # number of intervals of the spline
    free: Index  # indices of the coordinates that may move
    # (k,): given values at the end; NaN where the value is free. Coordinates that are not free have
    # zero.
    end: Array
    units: Array  # (k,): units of the coefficients

    @cached_property
    def knots_s(self) -> Array:
        """Knots (intervals + 7,) [s], those at the ends repeated."""
        inner = np.linspace(0.0, self.duration_s, self.intervals + 1)
        ends = np.repeat(inner[[0, -1]], DEGREE)
        return np.concatenate([ends[:DEGREE], inner, ends[DEGREE:]])

    @property
    def size(self) -> int:
        """Number of unknowns c."""
        return self._map.shape[2]

    @cached_property
    def _map(self) -> Array:
        """Matrix (intervals + 3, k, c) from unknowns to coefficients, without those given."""
        count = self.intervals + DEGREE
        columns = []
        for row in range(EQUAL, count - EQUAL + 1):
            rows = slice(row, row + 1) if row < count - EQUAL else slice(row, None)
            for axis in self.free:
                if row == count - EQUAL and np.isfinite(self.end[axis]):
                    continue
                column = np.zeros((count, len(self.end)))
                column[rows, axis] = self.units[axis]
                columns.append(column)
        return np.stack(columns, axis=2)

    @cached_property
    def moves_hand(self) -> NDArray[np.bool_]:
        """Whether each unknown (c,) belongs to the hand, and not to a signal."""
        return np.asarray(self._map[:, :HAND].any(axis=(0, 1)))

    @cached_property
    def _given(self) -> Array:
        """Coefficients (intervals + 3, k) of the motion with zero unknowns."""
        given = np.zeros((self.intervals + DEGREE, len(self.end)))
        given[-EQUAL:] = np.nan_to_num(self.end)
        return given

    def basis(self, t_s: Array, order: int = 0) -> Array:
        """Return the derivatives of an order of the B-splines (T, intervals + 3) at times, which
        are constant beyond the ends.
        """
        inside = np.clip(t_s, 0.0, self.duration_s)
        rows = np.asarray(
            BSpline(self.knots_s, np.eye(self.intervals + DEGREE), DEGREE)(inside, order)
        )
        if order:
            rows[(t_s < 0.0) | (t_s > self.duration_s)] = 0.0
        return rows

    def affine(self, t_s: Array, order: int = 0) -> tuple[Array, Array]:
        """Return the coordinates, or their derivatives of an order, as an affine function of the
        unknowns: matrix (T, k, c) and constant (T, k).
        """
        basis = self.basis(t_s, order)
        return np.tensordot(basis, self._map, axes=1), basis @ self._given

    def motion(self, unknowns: Array) -> SplineMotion:
        """Return the motion of the hand at unknowns (c,)."""
        return SplineMotion(self, (self._given + self._map @ unknowns)[:, :HAND])

    def signals(self, unknowns: Array) -> SplineMotion:
        """Return the coordinates of the signals at unknowns (c,)."""
        return SplineMotion(self, (self._given + self._map @ unknowns)[:, HAND:])

    def jerk(self) -> tuple[Array, Array]:
        """Return the jerk in each interval as an affine function of the unknowns: matrix
        (intervals, k, c) and constant (intervals, k) [m/s³, rad/s³, N/s³, Pa/s³].
        """
        middles = (np.arange(self.intervals) + 0.5) * self.duration_s / self.intervals
        return self.affine(middles, 3)


@dataclass(frozen=True, eq=False)
class SplineMotion:
    """Motion of a hand, or signals, over time."""

    space: SplineSpace
    # (intervals + 3, k): coefficients of shift [m] and rotation vector [rad], or of the signals [N,
    # Pa].
    coefficients: Array

    @property
    def duration_s(self) -> float:
        """Duration of the motion [s]."""
        return self.space.duration_s

    @property
    def grid_s(self) -> Array:
        """Times from 0 to the duration [s] that resolve all peaks of the motion."""
        return np.linspace(0.0, self.duration_s, CHECK_POINTS * self.space.intervals + 1)

    def derivatives(self, t_s: Array) -> TimeDerivatives:
        """Return the coordinates (T, k) and their first and second derivatives at times since the
        start [s].
        """
        value, first, second = (
            self.space.basis(t_s, order) @ self.coefficients for order in range(3)
        )
        return TimeDerivatives(value, first, second)


@dataclass(frozen=True, eq=False)
class HandFrame:
    """Initial pose of a hand, and what it holds."""

    rotation: Array  # (3, 3): initial orientation R₀ of the grasped body
    position_m: Array  # (3,): initial position p₀ of the hand, the middle of the grasped nodes
    arms_m: Array  # (n, 3): grasped nodes relative to the hand, in the initial orientation

    def positions(self, coordinates: Array) -> tuple[Array, Array]:
        """Return the positions of the grasped nodes (T, n, 3) [m] at coordinates (T, 6), and their
        derivatives (T, n, 3, 6) by the coordinates.
        """
        rotations, by_turn = _turns(coordinates[:, 3:])
        turned = np.einsum("tij,nj->tni", rotations, self.arms_m)
        positions = turned + (self.position_m + coordinates[:, :3])[:, None]
        slopes = np.zeros((*positions.shape, 6))
        slopes[..., :3] = np.eye(3)
        slopes[..., 3:] = np.einsum("tijk,nj->tnik", by_turn, self.arms_m)
        return positions, slopes

    def weighted_hessian(self, coordinates: Array, weights: Array) -> Array:
        """Return Σ weights · ∂²position/∂coordinates² (T, 6, 6), for weights (T, n, 3)."""
        moments = np.einsum("tni,nj->tij", weights, self.arms_m)
        stacked = np.concatenate(
            [coordinates[:, 3:].T, moments.transpose(0, 2, 1).reshape(len(moments), 9).T]
        )
        curvature = np.zeros((len(moments), 6, 6))
        values = _turn_curvature().map(stacked.shape[1])(stacked).full()
        curvature[:, 3:, 3:] = values.reshape(3, -1, 3).transpose(1, 0, 2)
        return curvature


# Expressions --------------------------------------------------------------------------------------


def _factors(square: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return sin θ/θ, (1 − cos θ)/θ² and (θ − sin θ)/θ³ of θ², smooth at zero."""
    small = square < SMALL_SQUARE
    angle = ca.sqrt(ca.if_else(small, 1.0, square))
    exact = (
        ca.sin(angle) / angle,
        (1 - ca.cos(angle)) / angle**2,
        (angle - ca.sin(angle)) / angle**3,
    )
    series = (
        1 - square / 6 + square**2 / 120,
        1 / 2 - square / 24 + square**2 / 720,
        1 / 6 - square / 120 + square**2 / 5040,
    )
    return tuple(  # type: ignore[return-value]
        ca.if_else(small, near, far) for near, far in zip(series, exact, strict=True)
    )


def rotation_expression(turn: ca.SX) -> ca.SX:
    """Return the rotation matrix exp(r) (3, 3) of a rotation vector r (3,)."""
    sinc, a, _ = _factors(ca.sumsqr(turn))
    cross = ca.skew(turn)
    return ca.SX.eye(3) + sinc * cross + a * (cross @ cross)


def _turns(vectors: Array) -> tuple[Array, Array]:
    """Return the rotation matrices (T, 3, 3) of rotation vectors (T, 3), and their derivatives
    (T, 3, 3, 3) by these.
    """
    values, slopes = (each.full() for each in _turn_function().map(len(vectors))(vectors.T))
    by_turn = slopes.reshape(3, 3, len(vectors), 3).transpose(2, 0, 1, 3)
    return values.T.reshape(-1, 3, 3), by_turn


@cache
def _turn_function() -> ca.Function:
    """Return the rows (9,) of exp(r) and their derivatives (9, 3) by r."""
    turn = ca.SX.sym("turn", 3)
    rows = ca.vec(rotation_expression(turn).T)
    return ca.Function("turns", [turn], [rows, ca.densify(ca.jacobian(rows, turn))])


@cache
def _turn_curvature() -> ca.Function:
    """Return the second derivatives (3, 3) of tr(exp(r) Mᵀ) by r, of r (3,) and M (9,)."""
    data = ca.SX.sym("data", 12)
    turn = data[:3]
    trace = ca.sum1(ca.vec(rotation_expression(turn) * ca.reshape(data[3:], 3, 3)))
    return ca.Function("turn_curvature", [data], [ca.hessian(trace, turn)[0]])


def _joint_limits(function: PoseLimit, position_m: ca.SX, rotation: ca.SX) -> ca.SX:
    """Return the expressions (k,) of a user's function."""
    where = "hand.joint_limits"
    try:
        values = function(position_m, rotation)
        rows = ca.vec(ca.vertcat(*values) if isinstance(values, (list, tuple)) else ca.SX(values))
    except Exception as error:
        raise InputError(
            f"the function failed: {reason(error)}; expected expressions of position_m (3,) and "
            "rotation (3, 3) in CasADi operations",
            None,
            where=where,
        ) from error
    if not all(ca.symvar(rows[k]) for k in range(rows.numel())) or not rows.numel():
        raise InputError(
            "a value of the function does not depend on the pose; expected expressions of position_m "
            "and rotation",
            None,
            where=where,
        )
    return rows


@dataclass(frozen=True)
class HandLimits:
    """Limits of a hand and of signals at one time, of the k coordinates and their two derivatives
    (3 k,).
    """

    vectors: ca.Function  # vectors (3 k,) whose norms must not exceed one
    vector_names: tuple[str, ...]
    rows: ca.Function  # values (m,) that must not be positive
    row_names: tuple[str, ...]  # name of the limit of each value

    @classmethod
    def from_bounds(
        cls,
        bounds: HandBounds,
        frame: HandFrame,
        free: Index,
        pose_limits: PoseLimit | None = None,
        signals: Sequence[Signal] = (),
    ) -> HandLimits:
        """Build from the limits of the robot; those of coordinates that cannot move are left out.

        Parameters
        ----------
        bounds : HandBounds
            Limits of the robot.
        frame : HandFrame
            Initial pose.
        free : (k,) array of int
            Coordinates that may move.
        pose_limits : callable, optional
            Further limits, of position (3,) [m] and rotation (3, 3) of the hand.
        signals : sequence of Signal
            The signals, whose coordinates follow those of the hand.
        """
        size = HAND + len(signals)
        state = ca.SX.sym("state", 3 * size)
        value, first, second = ca.vertsplit(state, size)
        limits = bounds.limits
        rows: list[tuple[str, Any]] = []
        for axis in range(3):
            if axis in free:
                rows.append(("workspace_m", value[axis] / (WITHIN * bounds.high_m[axis]) - 1))
                rows.append(("workspace_m", value[axis] / (WITHIN * bounds.low_m[axis]) - 1))
        moves, turns = (np.isin(free, axes).any() for axes in ((0, 1, 2), (3, 4, 5)))
        vectors: list[tuple[str, Any, float]] = []
        if moves:
            vectors += [
                ("speed_m_s", first[:3], limits.speed_m_s),
                ("acceleration_m_s2", second[:3], limits.acceleration_m_s2),
            ]
        if turns:
            turn, rate, growth = value[3:HAND], first[3:HAND], second[3:HAND]
            _, a, b = _factors(ca.sumsqr(turn))
            across = ca.cross(turn, rate)
            spin = rate + a * across + b * ca.cross(turn, across)
            acceleration = ca.jtimes(spin, turn, rate) + ca.jtimes(spin, rate, growth)
            angular = {
                "rotation_deg": turn,
                "angular_speed_deg_s": spin,
                "angular_acceleration_deg_s2": acceleration,
            }
            vectors += [
                (name, each, float(np.radians(getattr(limits, name))))
                for name, each in angular.items()
            ]
        if pose_limits is not None:
            rotation = rotation_expression(value[3:HAND]) @ ca.DM(frame.rotation)
            extra = _joint_limits(pose_limits, value[:3] + ca.DM(frame.position_m), rotation)
            rows += [("joint_limits", extra[k]) for k in range(extra.numel())]
        for k, signal in enumerate(signals, HAND):
            rows += signal.limit_rows(value[k], first[k], second[k])
        scaled = [each / (WITHIN * most) for _, each, most in vectors]
        nothing = ca.SX(0, 1)
        return cls(
            ca.Function("vectors", [state], [ca.vertcat(nothing, *scaled)]),
            tuple(name for name, _, _ in vectors),
            ca.Function("rows", [state], [ca.vertcat(nothing, *(each for _, each in rows))]),
            tuple(name for name, _ in rows),
        )
