"""What a grasp gives the body, where a sensor stands: force and torque on the grid.

In the frame of the sensor with axes Q_k and the point o_k,

    W_k = Σ_g (Q_kᵀ R_g, Q_kᵀ (x_g − o_k) × R_g) + what the tool takes,

R being the reactions of `reaction` and x_g the grasped nodes. A tool of the mass m between sensor
and body, with its centre at c in the frame of the grasp, takes m (a_c − g) at its centre. What is
read are values of L W, L being a first-order low-pass.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..fem.pattern import dofs_of
from ..model.dynamics import Dynamics
from ..model.generated import Generated
from ..model.nuisance import NuisanceMap
from ..model.recursion import Evolution, Recursion
from ..recording.experiment import Experiment
from ..recording.grasp import Grasp
from ..recording.nuisance import (
    SENSOR_LAG,
    SENSOR_TIME,
    TOOL_CENTRE,
    TOOL_MASS,
    NuisanceRow,
    rotation,
)
from ..recording.wrench import Frame
from .channel import Forced, Motion, Pulled, Slopes
from .reaction import centred_rows

# Numbers of Q, the grasp's turn and its rate, its shift from the sensor's point, and its rate.
TOOL_DATA = (9, 9, 9, 3, 3)


@dataclass(frozen=True, eq=False)
class Grid:
    """Times of the rows that tell reactions.

    Attributes
    ----------
    t_s : (N,) evenly spaced
    rows : (N,) bool, those that tell one
    late : int
        Row t tells of the time t − late.
    reach : int
        It depends on the grasp from the time t − reach on.
    static : bool
        Equilibria, at times that need not be evenly spaced; between them the wrench is linear.
    """

    t_s: Array
    rows: NDArray[np.bool_]
    late: int
    reach: int
    static: bool = False

    @classmethod
    def of(cls, dynamics: Dynamics) -> Grid:
        """That of discrete equations of motion."""
        return cls(dynamics.t_s, *centred_rows(dynamics), dynamics.reach, dynamics.static)

    @classmethod
    def at(cls, t_s: Array) -> Grid:
        """Where the reactions at the very times are known."""
        return cls(t_s, np.ones(len(t_s), dtype=bool), 0, 0)

    @property
    def step_s(self) -> float:
        """Time between rows, on the average."""
        return float(self.t_s[-1] - self.t_s[0]) / max(1, len(self.t_s) - 1)

    def told(self, grasp: Grasp) -> Index:
        """Times, by their numbers, at which the reactions of a grasp are known."""
        held = grasp.holds(self.t_s)
        rows = self.rows & held
        for lag in range(1, self.reach + 1):
            rows[lag:] &= held[:-lag]
        return np.flatnonzero(rows) - self.late


@dataclass(frozen=True, eq=False)
class GraspWrench:
    """Force and torque (n, 2, 3) that one grasp gives.

    Attributes
    ----------
    number : int
        Of the sensor among those of the experiment; −1 of what has no nuisance parameters of one.
    grasp : Grasp
    frame, point_m
        See `Wrench`.
    on : Grid
    nuisance : NuisanceMap
    dofs : int
        Of the body, 3n.
    sensed : (g,) dofs whose reactions are known
    places : (d,) of the dofs of the grasp's nodes among these
    held : (d,) one along the axes that it holds, else zero
    """

    number: int
    grasp: Grasp
    frame: Frame
    point_m: Array
    on: Grid
    nuisance: NuisanceMap
    dofs: int
    sensed: Index
    places: Index
    held: Array

    each = 2
    local = None

    @property
    def late(self) -> int:
        """How many rows after its time a value is known."""
        return self.on.late

    @cached_property
    def grid(self) -> Index:
        """(n,) grid times whose wrench is known, one after the other."""
        return self.on.told(self.grasp)

    @property
    def count(self) -> int:
        """How many these are."""
        return len(self.grid)

    @cached_property
    def t_s(self) -> Array:
        """(n,) when they are."""
        return self.on.t_s[self.grid]

    @property
    def rows(self) -> Index:
        """All of the grid: accelerations are taken from positions."""
        return np.arange(len(self.on.t_s))

    def operator(self, phi: Array) -> sp.csr_array:
        """The sensed dofs of a row, (g, 3n)."""
        count = len(self.sensed)
        entries = np.ones(count), (np.arange(count), self.sensed)
        return sp.csr_array(entries, shape=(count, self.dofs))

    def reached(self, rows: int) -> int:
        """How many of the times the first grid rows tell."""
        return int(np.count_nonzero(self.grid + self.on.late < rows))

    def phi_places(self, row: NuisanceRow) -> Index:
        """Positions in φ of what is not known of this sensor."""
        return self.nuisance.places(row, of=self.number)

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        grasp: Grasp,
        frame: Frame,
        point_m: Array,
        grid: Grid,
        nuisance: NuisanceMap,
        number: int = -1,
    ) -> GraspWrench:
        """What one of an experiment's grasps gives."""
        sensed, own = sensed_dofs(experiment), dofs_of(grasp.nodes)
        held, places = np.isin(own, grasp.dofs).astype(np.float64), np.searchsorted(sensed, own)
        where = nuisance, 3 * len(experiment.body.nodes_m), sensed, places, held
        return cls(number, grasp, frame, point_m, grid, *where)

    @property
    def clock_limit_s(self) -> float:
        """Largest shift of the sensor's clock."""
        here = self.phi_places(SENSOR_TIME)
        return float(SENSOR_TIME.high * self.nuisance.scales[here].sum())

    # Moments ----------------------------------------------------------------------------------

    @cached_property
    def frames(self) -> tuple[Array, Array]:
        """Q (n, 3, 3) and o (n, 3)."""
        turns, shifts = self.poses_at(self.grid)
        if self.frame == "grasp":
            return turns, shifts + turns @ self.point_m
        shape = (self.count, 1)
        return np.tile(np.eye(3), (*shape, 1)), np.tile(self.point_m, shape)

    def poses_at(self, rows: Index) -> tuple[Array, Array]:
        """Turns (k, 3, 3) and shifts (k, 3) of the grasp at some rows."""
        return self.grasp.poses.at(self.on.t_s[rows])

    @cached_property
    def moment_data(self) -> Array:
        """(15, n, h) of `MOMENT`."""
        axes, points = self.frames
        nodes = len(self.held) // 3
        of_time = np.concatenate([axes.reshape(-1, 9), points], axis=1).T
        held = np.broadcast_to(self.held.reshape(nodes, 3).T[:, None], (3, self.count, nodes))
        return np.concatenate([np.repeat(of_time[:, :, None], nodes, axis=2), held])

    def moments_at(self, forced: Forced) -> tuple[Array, Array]:
        """Inputs (6, n, h) and data of `MOMENT`, at as many times as are told."""
        k = self.grid[: self.reached(len(forced.reaction))]
        both = forced.position_m[k], forced.reaction[k + self.on.late]
        shape = len(k), len(self.places) // 3, 3
        u = [np.moveaxis(each[:, self.places].reshape(shape), 2, 0) for each in both]
        return np.concatenate(u), self.moment_data[:, : len(k)]

    def arms(self, forced: Forced) -> tuple[Array, Array]:
        """A and B (n, 6, d) of dW = A dR + B dx, W = A R."""
        by_u = MOMENT.slopes(*self.moments_at(forced))[1]
        by_u = np.transpose(by_u, (2, 0, 3, 1))
        return _by_dof(by_u[..., 3:]), _by_dof(by_u[..., :3])

    def without_tool(self, forced: Forced) -> Array:
        """W (n, 6) of the body alone."""
        return MOMENT.value(*self.moments_at(forced)).sum(axis=2).T

    # The tool ---------------------------------------------------------------------------------

    @cached_property
    def tool_phi(self) -> Index:
        """Positions in φ of what a tool's share depends on; none where there is no tool."""
        if not len(mass := self.phi_places(TOOL_MASS)):
            return mass
        centre = self.phi_places(TOOL_CENTRE)
        return np.concatenate([mass, centre, self.nuisance.of_gravity])

    @cached_property
    def tool(self) -> Generated:
        """What it takes (6,), m (a_c − g) at c: of `tool_phi`, see `tool_at`."""
        return Generated(self._tool_takes, len(self.tool_phi), sum(TOOL_DATA))

    def _tool_takes(self, phi: ca.SX, data: ca.SX) -> ca.SX:
        axes, turn, turn_rate, shift, shift_rate = ca.vertsplit(data, np.cumsum([0, *TOOL_DATA]))
        axes, turn, turn_rate = (ca.reshape(each, 3, 3).T for each in (axes, turn, turn_rate))
        count = len(self.tool_phi) - len(self.nuisance.of_gravity)
        own, tilts = ca.vertsplit(phi, [0, count, len(self.tool_phi)])
        own *= self.nuisance.scales[self.tool_phi[:count]][:, None]
        about = self.frame == "grasp"
        centre = ca.DM(self.point_m if about else self.nuisance.grasp_pivot_m)
        centre = centre + own[1:] if own.numel() > 1 else centre
        gravity = self.nuisance.gravity_expression(tilts)
        pull = own[0] * (turn_rate @ centre + shift_rate - gravity)
        return ca.vertcat(axes.T @ pull, axes.T @ ca.cross(turn @ centre + shift, pull))

    def tool_at(self, phi: Array, count: int) -> tuple[Array, Array]:
        """Inputs (k,) and data (33, n) of `tool`.

        These are Q, the turn of the grasp with its rate, and its shift from o with its rate.
        """
        axes, points = (each[:count] for each in self.frames)
        turns, shifts = self.poses_at(self.grid[:count])
        turn_rates, shift_rates = self.pose_rates(count)
        parts = (axes, turns, turn_rates, shifts - points, shift_rates)
        data = np.concatenate([each.reshape(count, -1) for each in parts], axis=1)
        return phi[self.tool_phi], data.T

    def pose_rates(self, count: int) -> tuple[Array, Array]:
        """Second derivatives (n, 3, 3) and (n, 3) of the poses, by differences."""
        step_s, poses = self.on.step_s, self.grasp.poses
        if len(poses.t_s) < 3 or self.on.static:
            return np.zeros((count, 3, 3)), np.zeros((count, 3))
        around = poses.t_s[0] + step_s, poses.t_s[-1] - step_s
        middle = np.clip(self.t_s[:count], *around)
        before, now, after = (poses.at(middle + way * step_s) for way in (-1, 0, 1))
        pairs = zip(before, now, after, strict=True)
        turn, shift = ((b - 2 * n + a) / step_s**2 for b, n, a in pairs)
        return turn, shift

    def on_grid(self, forced: Forced, phi: Array) -> Array:
        """W (n, 6)."""
        value = self.without_tool(forced)
        if len(self.tool_phi):
            value = value + self.tool.value(*self.tool_at(phi, len(value))).T
        return value

    # The low-pass -----------------------------------------------------------------------------

    @cached_property
    def lag_phi(self) -> Index:
        """Position in φ of what its time constant T is not known by; none without a low-pass."""
        return self.phi_places(SENSOR_LAG)

    def low_passed(self, value: Array, phi: Array) -> Evolution | None:
        """What the low-pass makes of W (n, 6); None without one."""
        if not len(self.lag_phi) or not len(value):
            return None
        data = self.low_pass_data[:, : len(value), None]
        return Evolution.of(LOW_PASS, phi[self.lag_phi], data, value[None])

    @cached_property
    def low_pass_data(self) -> Array:
        """(2, n) of `LOW_PASS`."""
        per_step = self.nuisance.scales[self.lag_phi] / self.on.step_s
        return np.stack([np.arange(self.count) == 0, np.repeat(per_step, self.count)])

    # As channels are --------------------------------------------------------------------------

    def values(self, motion: Motion, phi: Array) -> Array:
        """Y = L W (n, 2, 3)."""
        value = self.on_grid(motion.forced, phi)
        evolution = self.low_passed(value, phi)
        return (evolution.states[0] if evolution else value).reshape(-1, 2, 3)

    def linearised(
        self, motion: Motion, phi: Array, columns: Index, size: int
    ) -> tuple[Array, Slopes]:
        """Y (n, 2, 3), and its slopes by all parameters."""
        forced, first = motion.forced, size - len(phi)
        assert forced.reaction_by is not None
        assert forced.position_by is not None
        of_force, of_place = self.arms(forced)
        k = self.grid[: len(of_force)]
        value, slope = self.on_grid(forced, phi), np.zeros((len(k), 6, size))
        slope[..., columns] = of_force @ forced.reaction_by[k + self.on.late][:, self.places]
        slope[..., columns] += of_place @ forced.position_by[k][:, self.places]
        if len(self.tool_phi):
            by_phi = self.tool.slopes(*self.tool_at(phi, len(k)))[1]
            slope[..., first + self.tool_phi] += np.moveaxis(by_phi, 2, 0)
        if evolution := self.low_passed(value, phi):
            by_lag = np.arange(size) == first + self.lag_phi[:, None]
            value, slope = evolution.states[0], evolution.forward(slope[None], by_lag)[0]
        slope = slope.reshape(len(k), 2, 3, size)
        return value.reshape(len(k), 2, 3), Slopes.along(np.arange(size), slope)

    def pulled(self, motion: Motion, phi: Array, by_values: Array) -> Pulled:
        """Slopes of a scalar from those by Y."""
        forced, by_phi = motion.forced, np.zeros(len(phi))
        by_x, by_reaction = np.zeros_like(motion.x), np.zeros_like(forced.reaction)
        by_w = by_values.reshape(-1, 6)
        if evolution := self.low_passed(self.on_grid(forced, phi), phi):
            (by_w,), by_phi[self.lag_phi] = evolution.backward(by_w[None])
        if len(self.tool_phi):
            slopes = self.tool.slopes(*self.tool_at(phi, len(by_w)))[1]
            by_phi[self.tool_phi] += np.einsum("na,abn->b", by_w, slopes)
        of_force, of_place = self.arms(forced)
        k = self.grid[: len(by_w)]
        by_reaction[np.ix_(k + self.on.late, self.places)] = np.einsum("ka,kag->kg", by_w, of_force)
        by_x[np.ix_(k, self.sensed[self.places])] = np.einsum("ka,kag->kg", by_w, of_place)
        return Pulled(by_x, by_reaction, by_phi)

    def carried(
        self, grasp: Grasp, motion: Motion, phi: Array, shifts: Array, turns: Array
    ) -> Array | float:
        """Changes (n, 2, 3, c) of Y where poses are off, by the frame that is carried along."""
        if grasp is not self.grasp or self.frame != "grasp":
            return 0.0
        value = self.without_tool(motion.forced)
        axes = self.frames[0][: len(value)]
        data = [axes.reshape(-1, 9), value, np.tile(self.point_m, (len(value), 1))]
        slopes = SEEN_FROM.slopes(np.zeros((6, len(value))), np.concatenate(data, axis=1).T)[1]
        k = self.grid[: len(value)]
        off = np.concatenate([turns[k], shifts[k]], axis=2)
        change = np.einsum("abn,ncb->nac", slopes, off)
        if evolution := self.low_passed(value, phi):
            (change,) = evolution.forward(change[None], np.zeros((1, change.shape[2])))
        return change.reshape(len(change), 2, 3, change.shape[2])


def sensed_dofs(experiment: Experiment) -> Index:
    """(g,) dofs of the nodes of all grasps that something looks at, ascending."""
    held = [dofs_of(experiment.grasps[k].nodes) for k in experiment.sensed]
    return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *held]))


def _moment(u: ca.SX, data: ca.SX) -> ca.SX:
    place, reaction = ca.vertsplit(u, 3)
    axes, point, held = ca.vertsplit(data, [0, 9, 12, 15])
    axes, force = ca.reshape(axes, 3, 3), held * reaction
    return ca.vertcat(axes @ force, axes @ ca.cross(place - point, force))


def _seen_from(off: ca.SX, data: ca.SX) -> ca.SX:
    turn, shift = ca.vertsplit(off, 3)
    axes, force, torque, point = ca.vertsplit(data, [0, 9, 12, 15, 18])
    axes = ca.reshape(axes, 3, 3).T
    turned, force = rotation(turn) @ axes, axes @ force
    moved = shift + (turned - axes) @ point
    return ca.vertcat(turned.T @ force, turned.T @ (axes @ torque - ca.cross(moved, force)))


def _by_dof(by_node: Array) -> Array:
    """(n, 6, d) from (n, 6, h, 3)."""
    return np.ascontiguousarray(by_node).reshape(*by_node.shape[:2], -1)


def _low_pass(before: ca.SX, now: ca.SX, last: ca.SX, lag: ca.SX, data: ca.SX) -> ca.SX:
    """Y' = (W − Y) / T, W linear between grid times, and steady before the first."""
    began, share = data[0], lag * data[1]
    e = ca.exp(-1 / ca.fmax(share, 1e-6))
    a = share * (1 - e) - e
    return began * now + (1 - began) * (e * before + a * last + (1 - e - a) * now)


# Force and torque (6,) of one node, by x_g and R_g; data are Q, o and what is held.
MOMENT = Generated(_moment, 6, 15)
# W (6,) by a turn and a shift of the frame; data are Q, W and the point in the frame.
SEEN_FROM = Generated(_seen_from, 6, 18)
# Of T by the φ of `lag_phi`; data are whether it is the start, and T / Δt of a φ of one.
LOW_PASS = Recursion(_low_pass, 1, 1, 1, 2)
