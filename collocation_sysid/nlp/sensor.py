"""What the sensor of a grasp reads: the wrench that the grasp gives the body.

On the grid, in the frame of the sensor with axes Q_k and the point o_k,

    W_k = (Q_kᵀ Σ_g R_g, Q_kᵀ Σ_g (x_g − o_k) × R_g) + what the tool takes,

R being the reactions of `nlp.reaction` and x_g the grasped nodes. A tool of the mass m between
sensor and body, with its centre at c in the frame of the grasp, takes m (a_c − g) at its centre.
A sample at s reads

    ŷ(s) = Σ_k ℓ_k(s + τ) (L W)_k + tare,

ℓ the cubic weights of the four grid times around it and L a first-order low-pass. Each sample is
compared at its own time, however many there are in a step, so that no average hides a motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..experiment.clock import TIME_TOLERANCE_S
from ..experiment.experiment import Experiment
from ..experiment.grasp import Grasp
from ..experiment.nuisance import (
    SENSOR_LAG,
    SENSOR_TIME,
    TARE,
    TOOL_CENTRE,
    TOOL_MASS,
    NuisanceRow,
)
from ..experiment.wrench import Wrench
from ..fem.pattern import dofs_of
from .dynamics import Dynamics
from .generated import Generated
from .nuisance import NuisanceMap
from .reaction import centred_rows
from .reading import Reading, lagrange_weights

# Grid times that a sample is interpolated from: an error of (ωΔt)⁴ / 40 of a swing.
NEIGHBOURS = 4
# Numbers of Q, the grasp's turn and its rate, its shift from the sensor's point, and its rate.
TOOL_DATA = (9, 9, 9, 3, 3)


@dataclass(frozen=True, eq=False)
class Forced:
    """The reactions on the sensed dofs of the first grid rows, and how they change.

    Attributes
    ----------
    reaction : (N, g) R of each row [N]
    position_m : (N, g) where the dofs are
    reaction_by, position_by : (N, g, c) their changes
    """

    reaction: Array
    position_m: Array
    reaction_by: Array
    position_by: Array

    @classmethod
    def still(cls, reaction: Array, position_m: Array) -> Forced:
        """Reactions that do not change by anything."""
        nothing = np.zeros((*reaction.shape, 0))
        return cls(reaction, position_m, nothing, nothing)


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
class Samples:
    """The samples of a sensor at a point.

    Attributes
    ----------
    reading : Reading
    window : (S, u) grid times that each is read between
    inputs, data : as `reading` takes them
    """

    reading: Reading
    window: Index
    inputs: Array
    data: Array

    @property
    def residual(self) -> Array:
        """(S, 6)."""
        return self.reading.residual.value(self.inputs, self.data).T

    def along(self, slope: Array) -> tuple[Array, Array, Array]:
        """Residuals (S, 6), their slopes by what Y (n, 6, c) changes by, and those by their φ."""
        residual, by_u = self.reading.residual.slopes(self.inputs, self.data)
        by_u, count = np.moveaxis(by_u, 2, 0), 6 * self.window.shape[1]
        around = slope[self.window].reshape(len(self.window), count, -1)
        return residual.T, by_u[..., :count] @ around, by_u[..., count:]

    @property
    def loss(self) -> float:
        """Σ ρ."""
        return float(self.reading.loss.value(self.inputs, self.data).sum())

    def loss_slopes(self, grid: int) -> tuple[Array, Array]:
        """∂loss by Y (grid, 6) and by φ."""
        by_u = self.reading.loss.slopes(self.inputs, self.data)[1][0]
        samples, used = self.window.shape
        of_given = np.zeros((grid, 6))
        np.add.at(of_given, self.window, by_u[: 6 * used].T.reshape(samples, used, 6))
        return of_given, by_u[6 * used :].sum(axis=1)

    def loss_curvature(self, bent: bool) -> tuple[Array, Array, Array]:
        """∂²loss of each sample: Y by Y (S, u, 6, u, 6), Y by φ (S, u, 6, m), φ by φ (m, m)."""
        by_u = np.moveaxis(self.reading.curvature(self.inputs, self.data, bent), 2, 0)
        samples, used = self.window.shape
        own, both = by_u[:, : 6 * used], (samples, used, 6)
        return (
            own[..., : 6 * used].reshape(*both, used, 6),
            own[..., 6 * used :].reshape(*both, -1),
            by_u[:, 6 * used :, 6 * used :].sum(axis=0),
        )


@dataclass(frozen=True, eq=False)
class Sensor:
    """The sensor of one grasp on the grid of its experiment.

    Attributes
    ----------
    number : int
        Of the sensor among those of the experiment.
    grasp : Grasp
    wrench : Wrench
    on : Grid
    nuisance : NuisanceMap
    places : (d,) of the dofs of the grasp's nodes among those that are sensed
    held : (d,) one along the axes that it holds, else zero
    huber : float or None
        See `Reading`.
    """

    number: int
    grasp: Grasp
    wrench: Wrench
    on: Grid
    nuisance: NuisanceMap
    places: Index
    held: Array
    huber: float | None = None

    # Where and when --------------------------------------------------------------------------

    @cached_property
    def grid(self) -> Index:
        """(n,) grid times whose wrench is known, one after the other."""
        return self.on.told(self.grasp)

    @property
    def late(self) -> int:
        """How late the rows are that tell them."""
        return self.on.late

    def reached(self, rows: int) -> int:
        """How many of them the first grid rows tell."""
        return int(np.count_nonzero(self.grid + self.late < rows))

    @cached_property
    def limit_s(self) -> float:
        """Largest shift of the clock."""
        here = self.phi_places(SENSOR_TIME)
        return float(SENSOR_TIME.high * self.nuisance.scales[here].sum())

    def covered(self, rows: int) -> NDArray[np.bool_]:
        """(S,) samples that the first grid rows suffice to read, however the clock is shifted."""
        count, t_s = self.reached(rows), self.wrench.t_s
        if not count:
            return np.zeros(len(t_s), dtype=bool)
        known = self.on.t_s[self.grid[[0, count - 1]]]
        rounding = 1e-6 * self.on.step_s + TIME_TOLERANCE_S
        early, late = known[0] + self.limit_s - rounding, known[1] - self.limit_s + rounding
        return (t_s >= early) & (t_s <= late)

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """(S, 6) components that are compared."""
        return self.wrench.present & self.covered(len(self.on.t_s))[:, None]

    @cached_property
    def frames(self) -> tuple[Array, Array]:
        """Q (n, 3, 3) and o (n, 3)."""
        turns, shifts = self._poses(self.grid)
        if self.wrench.frame == "grasp":
            return turns, shifts + turns @ self.wrench.point_m
        shape = (len(self.grid), 1)
        return np.tile(np.eye(3), (*shape, 1)), np.tile(self.wrench.point_m, shape)

    def _poses(self, rows: Index) -> tuple[Array, Array]:
        return self.grasp.poses.at(self.on.t_s[rows])

    # Its φ ------------------------------------------------------------------------------------

    def phi_places(self, row: NuisanceRow) -> Index:
        """Positions in φ of what is not known of this sensor."""
        return self.nuisance.places(row, of=self.number)

    def _value(self, row: NuisanceRow, phi: Array) -> Array:
        here = self.phi_places(row)
        return phi[here] * self.nuisance.scales[here]

    # On the grid ------------------------------------------------------------------------------

    def arms(self, forced: Forced) -> tuple[Array, Array]:
        """A and B (n, 6, d) of dW = A dR + B dx, W = A R."""
        count = self.reached(len(forced.reaction))
        k = self.grid[:count]
        turns, points = (each[:count] for each in self.frames)
        arm = forced.position_m[k][:, self.places].reshape(count, -1, 3) - points[:, None]
        own = forced.reaction[k + self.late][:, self.places] * self.held
        force = own.reshape(count, -1, 3)
        axes = np.swapaxes(turns, 1, 2)[:, None]
        of_force = np.concatenate([np.broadcast_to(axes, (*arm.shape, 3)), axes @ _cross(arm)], 2)
        of_place = np.concatenate([np.zeros((*arm.shape, 3)), -axes @ _cross(force)], 2)
        return _by_component(of_force) * self.held, _by_component(of_place)

    def on_grid(self, forced: Forced) -> tuple[Array, Array]:
        """W (n, 6) without the tool, and its changes (n, 6, c)."""
        of_force, of_place = self.arms(forced)
        k = self.grid[: len(of_force)]
        reaction = forced.reaction[k + self.late][:, self.places]
        by_reaction = forced.reaction_by[k + self.late][:, self.places]
        value = np.einsum("kag,kg->ka", of_force, reaction)
        return value, of_force @ by_reaction + of_place @ forced.position_by[k][:, self.places]

    @cached_property
    def tool_phi(self) -> Index:
        """Positions in φ of what a tool's share depends on; none where there is no tool."""
        if not len(mass := self.phi_places(TOOL_MASS)):
            return mass
        centre = self.phi_places(TOOL_CENTRE)
        return np.concatenate([mass, centre, self.nuisance.of_gravity])

    @cached_property
    def tool(self) -> Generated:
        """What it takes (6,), m (a_c − g) at c: of `tool_phi`, at a column of `tool_data`."""
        return Generated(self._tool_takes, len(self.tool_phi), sum(TOOL_DATA))

    def _tool_takes(self, phi: ca.SX, data: ca.SX) -> ca.SX:
        axes, turn, turn_rate, shift, shift_rate = ca.vertsplit(data, np.cumsum([0, *TOOL_DATA]))
        axes, turn, turn_rate = (ca.reshape(each, 3, 3).T for each in (axes, turn, turn_rate))
        count = len(self.tool_phi) - len(self.nuisance.of_gravity)
        own, tilts = ca.vertsplit(phi, [0, count, len(self.tool_phi)])
        own *= self.nuisance.scales[self.tool_phi[:count]][:, None]
        about = self.wrench.frame == "grasp"
        centre = ca.DM(self.wrench.point_m if about else self.nuisance.grasp_pivot_m)
        centre = centre + own[1:] if own.numel() > 1 else centre
        gravity = self.nuisance.gravity_expression(tilts)
        pull = own[0] * (turn_rate @ centre + shift_rate - gravity)
        return ca.vertcat(axes.T @ pull, axes.T @ ca.cross(turn @ centre + shift, pull))

    def tool_data(self, count: int) -> Array:
        """(33, n) Q, the turn of the grasp with its rate, and its shift from o with its rate."""
        axes, points = (each[:count] for each in self.frames)
        turns, shifts = self._poses(self.grid[:count])
        turn_rates, shift_rates = self._accelerations(count)
        parts = (axes, turns, turn_rates, shifts - points, shift_rates)
        return np.concatenate([each.reshape(count, -1) for each in parts], axis=1).T

    def _accelerations(self, count: int) -> tuple[Array, Array]:
        """Second derivatives (n, 3, 3) and (n, 3) of the poses, by differences."""
        step_s, poses = self.on.step_s, self.grasp.poses
        if len(poses.t_s) < 3 or self.on.static:
            return np.zeros((count, 3, 3)), np.zeros((count, 3))
        around = poses.t_s[0] + step_s, poses.t_s[-1] - step_s
        middle = np.clip(self.on.t_s[self.grid[:count]], *around)
        before, now, after = (poses.at(middle + way * step_s) for way in (-1, 0, 1))
        pairs = zip(before, now, after, strict=True)
        turn, shift = ((b - 2 * n + a) / step_s**2 for b, n, a in pairs)
        return turn, shift

    # At the samples ---------------------------------------------------------------------------

    def window(self, phi: Array, count: int) -> Index:
        """(S, u) of the first `count` times of the grid those that each sample is read between."""
        shift, t_s = self._value(SENSOR_TIME, phi), self.on.t_s[self.grid[:count]]
        used = min(2 if self.on.static else NEIGHBOURS, count)
        late = np.searchsorted(t_s, self.wrench.t_s + shift.sum(), side="right")
        first = np.clip(late - 1 - (used - 1) // 2, 0, count - used)
        return first[:, None] + np.arange(used)

    @cached_property
    def read_phi(self) -> Index:
        """Positions in φ of what a sample is read by: the shift of the clock, if any, and tares."""
        return np.concatenate([self.phi_places(row) for row in (SENSOR_TIME, TARE)])

    def _reading(self, used: int) -> Reading:
        """Of u = (Y at `used` grid times, φ of `read_phi`), with these times from the sample's."""
        late, tared = len(self.phi_places(SENSOR_TIME)), self.tared
        scales = self.nuisance.scales[self.read_phi][:, None]

        def expression(u: ca.SX, places: ca.SX) -> ca.SX:
            given, own = ca.vertsplit(u, [0, 6 * used, u.numel()])
            own = own * scales
            at = own[0] if late else ca.SX(0)
            read = ca.reshape(given, 6, used) @ lagrange_weights(at, ca.vertsplit(places))
            read[tared] += own[late:]
            return read

        return Reading(expression, 6 * used + len(self.read_phi), used, 6, self.huber)

    def samples(self, given: Array, phi: Array, weight: Array) -> Samples:
        """All of them at Y (n, 6), with weights 1/σ (S, 6)."""
        window, measured = self.window(phi, len(given)), np.nan_to_num(self.wrench.values)
        count, used = window.shape
        if used not in self._readings:
            self._readings[used] = self._reading(used)
        own = np.broadcast_to(phi[self.read_phi, None], (len(self.read_phi), count))
        places = self.on.t_s[self.grid][window] - self.wrench.t_s[:, None]
        return Samples(
            self._readings[used],
            window,
            np.concatenate([given[window].reshape(count, -1).T, own]),
            np.concatenate([places, measured, weight], axis=1).T,
        )

    @cached_property
    def _readings(self) -> dict[int, Reading]:
        return {}

    @property
    def weight(self) -> Array:
        """(S, 6) 1/σ of all samples, zero where nothing is compared."""
        return self.present / self.wrench.sigmas

    def lag_s(self, phi: Array) -> float | None:
        """T of the low-pass, None where there is none."""
        lag = self._value(SENSOR_LAG, phi)
        return float(lag[0]) if len(lag) else None

    @property
    def tared(self) -> Index:
        """The components of its tares."""
        return np.flatnonzero(self.wrench.measured)[: len(self.phi_places(TARE))]

    def given(self, forced: Forced, columns: Index, phi: Array, size: int) -> tuple[Array, Array]:
        """Y = L W (n, 6) with what the tool takes, and its slopes (n, 6, size).

        Parameters
        ----------
        forced : Forced
        columns : (c,) positions in (q, φ) of what `forced` changes by
        phi : (k,) the last of (q, φ)
        size : int
            Length of (q, φ).
        """
        value, changes = self.on_grid(forced)
        slope, first, count = np.zeros((*value.shape, size)), size - len(phi), len(value)
        slope[..., columns] = changes
        if len(self.tool_phi):
            own = np.broadcast_to(phi[self.tool_phi, None], (len(self.tool_phi), count))
            taken, by_phi = self.tool.slopes(own, self.tool_data(count))
            value = value + taken.T
            slope[..., first + self.tool_phi] += np.moveaxis(by_phi, 2, 0)
        for place in self.phi_places(SENSOR_LAG):
            smoothing, by_lag = self._low_pass(phi, count)
            slope = (smoothing @ slope.reshape(count, -1)).reshape(slope.shape)
            slope[..., first + place] += self.nuisance.scales[place] * (by_lag @ value)
            value = smoothing @ value
        return value, slope

    def _low_pass(self, phi: Array, count: int) -> tuple[Array, Array]:
        """L (n, n) and its slope by T; one where there is none."""
        lag_s = self.lag_s(phi)
        if lag_s is None:
            return np.eye(count), np.zeros((count, count))
        return low_pass(lag_s, self.on.step_s, count)

    def before_low_pass(self, by_given: Array, phi: Array) -> Array:
        """Slopes of a scalar by W (n, 6), from those by Y."""
        return self._low_pass(phi, len(by_given))[0].T @ by_given

    def readings(self, forced: Forced, phi: Array) -> Array:
        """ŷ (S, 6), NaN where it is not known."""
        value, _ = self.given(forced, np.zeros(0, dtype=np.int64), phi, len(phi))
        if not len(value):
            return np.full(self.wrench.values.shape, np.nan)
        samples = self.samples(value, phi, np.ones(self.wrench.values.shape))
        read = samples.residual + np.nan_to_num(self.wrench.values)
        return np.where(self.covered(len(forced.reaction))[:, None], read, np.nan)

    # Residuals --------------------------------------------------------------------------------

    def linearised(
        self, forced: Forced, columns: Index, phi: Array, size: int
    ) -> tuple[Array, Array]:
        """Residuals (ŷ − w) / σ, (S, 2, 3) force and torque, and slopes; zero where missing."""
        value, slope = self.given(forced, columns, phi, size)
        count = len(self.wrench.t_s)
        if not len(value):
            return np.zeros((count, 2, 3)), np.zeros((count, 2, 3, size))
        here = self.wrench.present & self.covered(len(forced.reaction))[:, None]
        samples = self.samples(value, phi, here / self.wrench.sigmas)
        residual, found, by_own = samples.along(slope)
        found[..., size - len(phi) + self.read_phi] += by_own
        return residual.reshape(count, 2, 3), found.reshape(count, 2, 3, size)

    def loss(self, given: Array, phi: Array) -> float:
        """Σ ρ at Y (n, 6)."""
        return self.samples(given, phi, self.weight).loss if len(given) else 0.0

    def loss_slopes(self, given: Array, phi: Array) -> tuple[Array, Array]:
        """∂loss by Y (n, 6), and by φ of `read_phi`."""
        if not len(given):
            return np.zeros_like(given), np.zeros(len(self.read_phi))
        return self.samples(given, phi, self.weight).loss_slopes(len(given))

    def frame_response(self, forced: Forced, phi: Array, shifts: Array, turns: Array) -> Array:
        """Changes (S, 2, 3, c) of the residuals where poses are off, by the frame carried along.

        Parameters
        ----------
        shifts, turns : (N, c, 3) of the poses at the grid times
        """
        count = self.reached(len(forced.reaction))
        if self.wrench.frame != "grasp" or not count:
            return np.zeros((len(self.wrench.t_s), 2, 3, turns.shape[1]))
        k, axes = self.grid[:count], self.frames[0][:count]
        value = self.on_grid(forced)[0].reshape(count, 2, 3)
        force, torque = np.moveaxis(np.einsum("kij,kbj->kbi", axes, value)[:, :, None], 1, 0)
        moved = shifts[k] + np.cross(turns[k], (axes @ self.wrench.point_m)[:, None])
        both = [np.cross(force, turns[k]), np.cross(torque, turns[k]) - np.cross(moved, force)]
        change = np.concatenate([np.einsum("kji,kcj->kic", axes, each) for each in both], axis=1)
        smoothed = self._low_pass(phi, count)[0] @ change.reshape(count, -1)
        samples = self.samples(np.zeros((count, 6)), phi, self.weight)
        found = samples.along(smoothed.reshape(change.shape))[1]
        return found.reshape(len(found), 2, 3, -1)


def sensors_of(
    experiment: Experiment, grid: Grid, nuisance: NuisanceMap, huber: float | None = None
) -> tuple[Sensor, ...]:
    """The sensors of an experiment's grasps."""
    dofs, found = sensed_dofs(experiment), []
    for grasp in experiment.grasps:
        if grasp.wrench is not None:
            own = dofs_of(grasp.nodes)
            held, places = np.isin(own, grasp.dofs).astype(np.float64), np.searchsorted(dofs, own)
            where = grid, nuisance, places, held
            found.append(Sensor(len(found), grasp, grasp.wrench, *where, huber))
    return tuple(found)


def without_sensors(experiment: Experiment) -> Experiment:
    """The same experiment, its wrenches not measured."""
    return replace(experiment, grasps=[replace(g, wrench=None) for g in experiment.grasps])


def sensed_dofs(experiment: Experiment) -> Index:
    """(g,) dofs of the nodes of all grasps with a sensor, ascending."""
    held = [dofs_of(grasp.nodes) for grasp in experiment.grasps if grasp.wrench is not None]
    return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *held]))


def _cross(vectors: Array) -> Array:
    """(…, 3, 3) matrices of a × b by the vectors a (…, 3)."""
    found = np.zeros((*vectors.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        found[..., i, j], found[..., j, i] = -vectors[..., k], vectors[..., k]
    return found


def _by_component(blocks: Array) -> Array:
    """(n, 6, d) from the blocks (n, h, 6, 3) of each node."""
    count, nodes = blocks.shape[:2]
    return blocks.transpose(0, 2, 1, 3).reshape(count, 6, 3 * nodes)


def low_pass(lag_s: float, step_s: float, count: int) -> tuple[Array, Array]:
    """L (n, n) of y' = (W − y) / T, W linear between grid times and steady before, and ∂L/∂T."""
    e, a, b = fading(lag_s, step_s)[:, :2]
    value, slope = np.zeros((2, count, count))
    value[0, 0] = 1.0
    for k in range(1, count):
        value[k] = e[0] * value[k - 1]
        slope[k] = e[0] * slope[k - 1] + e[1] * value[k - 1]
        value[k, k - 1 : k + 1] += a[0], b[0]
        slope[k, k - 1 : k + 1] += a[1], b[1]
    return value, slope


def fading(lag_s: float, step_s: float) -> Array:
    """(3, 3) e, a and b of y_k = e y_{k−1} + a W_{k−1} + b W_k, each with two slopes by T."""
    if lag_s < 1e-6 * step_s:
        return np.array([[0.0, 0.0, 0.0], [0.0, 1 / step_s, 0.0], [1.0, -1 / step_s, 0.0]])
    return _fading()(lag_s, step_s).full()


@cache
def _fading() -> ca.Function:
    lag_s, step_s = ca.SX.sym("lag_s"), ca.SX.sym("step_s")
    share = lag_s / step_s
    e = ca.exp(-1 / share)
    a = share * (1 - e) - e
    value = ca.vertcat(e, a, 1 - e - a)
    slope = ca.jacobian(value, lag_s)
    both = ca.horzcat(value, slope, ca.jacobian(slope, lag_s))
    return ca.Function("fading", [lag_s, step_s], [both])
