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
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..experiment.clock import TIME_TOLERANCE_S
from ..experiment.experiment import Experiment
from ..experiment.grasp import Grasp
from ..experiment.wrench import Wrench
from ..fem.pattern import dofs_of
from .dynamics import Dynamics
from .nuisance import SENSOR_DEVIATIONS, NuisanceMap
from .reaction import centred_rows

# Grid times that a sample is interpolated from: an error of (ωΔt)⁴ / 40 of a swing.
NEIGHBOURS = 4


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
class Tool:
    """What a tool takes on the grid, and how: at the force `pull` a kilogram, `arm` off the point.

    Attributes
    ----------
    mass_kg : float
    pull, arm : (n, 3)
    axes : (n, 3, 3) Q, of the sensor
    turns, turn_rates : (n, 3, 3) of the grasp, and their second derivatives
    """

    mass_kg: float
    pull: Array
    arm: Array
    axes: Array
    turns: Array
    turn_rates: Array

    @property
    def value(self) -> Array:
        """(n, 6)."""
        return self.mass_kg * self._unit

    @property
    def _unit(self) -> Array:
        return self._both(self.pull[:, :, None])[:, :, 0]

    def _both(self, force: Array) -> Array:
        axes = np.swapaxes(self.axes, 1, 2)
        return np.concatenate([axes @ force, axes @ _cross(self.arm) @ force], axis=1)

    @property
    def slopes(self) -> Array:
        """(n, 6, 7) by mass, centre and gravity."""
        by_centre = self._both(self.turn_rates)
        by_centre[:, 3:] -= np.swapaxes(self.axes, 1, 2) @ _cross(self.pull) @ self.turns
        by_gravity = -self._both(np.broadcast_to(np.eye(3), self.axes.shape))
        both = self.mass_kg * np.concatenate([by_centre, by_gravity], axis=2)
        return np.concatenate([self._unit[..., None], both], axis=2)

    def curvature(self, weights: Array) -> Array:
        """(7, 7) second derivatives of Σ weights (n, 6) · value by the same."""
        force, torque = (
            np.einsum("kij,kj->ki", self.axes, each) for each in np.split(weights, 2, axis=1)
        )
        lever = force + np.cross(torque, self.arm)
        crossed = _cross(torque) @ self.turns
        found = np.zeros((7, 7))
        found[0, 1:4] = np.einsum("kij,ki->j", self.turn_rates, lever)
        found[0, 1:4] += np.einsum("kij,ki->j", self.turns, np.cross(self.pull, torque))
        found[0, 4:] = -lever.sum(axis=0)
        found[1:4, 4:] = -self.mass_kg * crossed.sum(axis=0).T
        found[1:4, 1:4] = self.mass_kg * np.einsum("kij,kil->jl", self.turn_rates, crossed)
        return found + found.T


@dataclass(frozen=True, eq=False)
class Interpolation:
    """Lagrange's weights (S, u) of samples at values `around` (S, u); zero where not covered.

    `slopes` and `curvatures` are their derivatives by the samples' times.
    """

    around: Index
    values: Array
    slopes: Array
    curvatures: Array

    @classmethod
    def of(cls, at_s: Array, t_s: Array, most: int, covered: NDArray[np.bool_]) -> Interpolation:
        """From the values at `most` of the times `t_s` (n,) around each of `at_s` (S,)."""
        count, used = len(t_s), min(most, len(t_s))
        first = np.searchsorted(t_s, at_s, side="right") - 1 - (used - 1) // 2
        around = np.clip(first, 0, count - used)[:, None] + np.arange(used)
        found = np.zeros((3, len(at_s), used))
        for i in range(used):
            # Of a product with two derivatives, as a polynomial in a shift of its factors.
            found[0, :, i] = 1.0
            for j in range(used):
                if j != i:
                    span = t_s[around[:, i]] - t_s[around[:, j]]
                    factor, slope = (at_s - t_s[around[:, j]]) / span, 1 / span
                    found[2, :, i] = found[2, :, i] * factor + 2 * found[1, :, i] * slope
                    found[1, :, i] = found[1, :, i] * factor + found[0, :, i] * slope
                    found[0, :, i] *= factor
        return cls(around, *(found * covered[:, None]))

    def matrix(self, weights: Array, count: int) -> sp.csr_array:
        """(S, count) from weights (S, u), any of the three."""
        rows = np.repeat(np.arange(len(weights)), weights.shape[1])
        return sp.csr_array((weights.ravel(), (rows, self.around.ravel())), (len(weights), count))


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
    """

    number: int
    grasp: Grasp
    wrench: Wrench
    on: Grid
    nuisance: NuisanceMap
    places: Index
    held: Array

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
        here = self.phi_places("sensor-time")
        return float(SENSOR_DEVIATIONS * self.nuisance.scales[here].sum())

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

    def phi_places(self, kind: str) -> Index:
        """Positions in φ of what is not known of this sensor."""
        return self.nuisance.of_sensor(kind, self.number)

    def _value(self, kind: str, phi: Array) -> Array:
        here = self.phi_places(kind)
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

    def tool(self, gravity_m_s2: Array, phi: Array, count: int) -> Tool | None:
        """What the tool takes; None where there is none."""
        if not len(self.phi_places("tool-mass")):
            return None
        (mass,), off = self._value("tool-mass", phi), self._value("tool-centre", phi)
        axes, points = (each[:count] for each in self.frames)
        turns, shifts = self._poses(self.grid[:count])
        turn_rates, shift_rates = self._accelerations(count)
        about = self.wrench.frame == "grasp"
        centre = self.wrench.point_m if about else self.nuisance.grasp_pivot_m
        centre = centre + off if len(off) else centre
        pull = turn_rates @ centre + shift_rates - gravity_m_s2
        arm = turns @ centre + shifts - points
        return Tool(float(mass), pull, arm, axes, turns, turn_rates)

    def tool_by_phi(self, gravity_phi: Array) -> Array:
        """(7, k) derivatives of the tool's mass and centre, and of gravity (3, k), by φ."""
        found = np.concatenate([np.zeros((4, gravity_phi.shape[1])), gravity_phi])
        for first, kind in ((0, "tool-mass"), (1, "tool-centre")):
            here = self.phi_places(kind)
            found[first + np.arange(len(here)), here] = self.nuisance.scales[here]
        return found

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

    def interpolation(self, phi: Array, count: int) -> Interpolation:
        """ℓ, of the first `count` times of the grid."""
        shift = self._value("sensor-time", phi)
        covered = self.covered(int(self.grid[count - 1]) + self.late + 1)
        at_s = self.wrench.t_s + (float(shift[0]) if len(shift) else 0.0)
        used = 2 if self.on.static else NEIGHBOURS
        return Interpolation.of(at_s, self.on.t_s[self.grid[:count]], used, covered)

    def lag_s(self, phi: Array) -> float | None:
        """T of the low-pass, None where there is none."""
        lag = self._value("sensor-lag", phi)
        return float(lag[0]) if len(lag) else None

    def kernels(self, phi: Array, count: int) -> tuple[sp.csr_array, sp.csr_array, Array]:
        """From the grid to the samples (S, n): ℓ L, its slope by the shift, and that by the lag.

        The last is of shape (0, 0) where no lag is estimated.
        """
        around, lag_s = self.interpolation(phi, count), self.lag_s(phi)
        value, slope = (around.matrix(each, count) for each in (around.values, around.slopes))
        if lag_s is None:
            return value, slope, np.zeros((0, 0))
        smoothing, by_lag = low_pass(lag_s, self.on.step_s, count)
        smooth = (sp.csr_array(np.asarray(each @ smoothing)) for each in (value, slope))
        return next(smooth), next(smooth), np.asarray(value @ by_lag)

    def with_tare(self, read: Array, phi: Array) -> Array:
        """Readings (S, 6), in place."""
        read[:, self.tared] += self._value("tare", phi)
        return read

    @property
    def tared(self) -> Index:
        """The components of its tares."""
        return np.flatnonzero(self.wrench.measured)[: len(self.phi_places("tare"))]

    def read(
        self, forced: Forced, columns: Index, phi: Array, gravity: tuple[Array, Array], size: int
    ) -> tuple[Array, Array]:
        """ŷ (S, 6) and its slopes (S, 6, size); zero where it cannot be read.

        Parameters
        ----------
        forced : Forced
        columns : (c,) positions in (q, φ) of what `forced` changes by
        phi : (k,) the last of (q, φ)
        gravity : (3,) and (3, k) its slopes by φ
        size : int
            Length of (q, φ).
        """
        value, changes = self.on_grid(forced)
        slope = np.zeros((*value.shape, size))
        slope[..., columns] = changes
        first = size - len(phi)
        if (tool := self.tool(gravity[0], phi, len(value))) is not None:
            value = value + tool.value
            slope[..., first:] += tool.slopes @ self.tool_by_phi(gravity[1])
        if not len(value):
            return np.zeros((len(self.wrench.t_s), 6)), np.zeros((len(self.wrench.t_s), 6, size))
        return self._sampled(value, slope, phi, first)

    def _sampled(self, value: Array, slope: Array, phi: Array, first: int) -> tuple[Array, Array]:
        kernel, by_shift, by_lag = self.kernels(phi, len(value))
        count, size = len(value), slope.shape[2]
        read = kernel @ value
        of_read = (kernel @ slope.reshape(count, 6 * size)).reshape(len(read), 6, size)
        scales = self.nuisance.scales
        for kind, own in (("sensor-time", by_shift), ("sensor-lag", by_lag)):
            for place in self.phi_places(kind):
                of_read[..., first + place] += scales[place] * (own @ value)
        tare = self.phi_places("tare")
        of_read[:, self.tared, first + tare] += scales[tare]
        return self.with_tare(read, phi), of_read

    def readings(self, forced: Forced, phi: Array, gravity_m_s2: Array) -> Array:
        """ŷ (S, 6), NaN where it is not known."""
        still = gravity_m_s2, np.zeros((3, len(phi)))
        nothing = np.zeros(0, dtype=np.int64)
        read, _ = self.read(forced, nothing, phi, still, len(phi))
        return np.where(self.covered(len(forced.reaction))[:, None], read, np.nan)

    # Residuals --------------------------------------------------------------------------------

    def linearised(
        self, forced: Forced, columns: Index, phi: Array, gravity: tuple[Array, Array], size: int
    ) -> tuple[Array, Array]:
        """Residuals (ŷ − w) / σ, (S, 2, 3) force and torque, and slopes; zero where missing."""
        read, slope = self.read(forced, columns, phi, gravity, size)
        here = self.wrench.present & self.covered(len(forced.reaction))[:, None]
        weight = here / self.wrench.sigmas
        residual = weight * (read - np.nan_to_num(self.wrench.values))
        slope = weight[..., None] * slope
        return residual.reshape(-1, 2, 3), slope.reshape(len(slope), 2, 3, size)

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
        read = self.kernels(phi, count)[0] @ change.reshape(count, -1)
        weight = self.present / self.wrench.sigmas
        return (weight[..., None] * read.reshape(len(read), 6, -1)).reshape(len(read), 2, 3, -1)


def sensors_of(experiment: Experiment, grid: Grid, nuisance: NuisanceMap) -> tuple[Sensor, ...]:
    """The sensors of an experiment's grasps."""
    dofs, found = sensed_dofs(experiment), []
    for grasp in experiment.grasps:
        if grasp.wrench is not None:
            own = dofs_of(grasp.nodes)
            held, places = np.isin(own, grasp.dofs).astype(np.float64), np.searchsorted(dofs, own)
            found.append(Sensor(len(found), grasp, grasp.wrench, grid, nuisance, places, held))
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
    share = lag_s / step_s
    e = float(np.exp(-1 / share))
    by_e = e / (share * lag_s)
    twice = by_e * (1 / share - 2) / lag_s
    a = share * (1 - e) - e
    by_a = (1 - e) / step_s - share * by_e - by_e
    twice_a = -2 * by_e / step_s - (share + 1) * twice
    return np.array(
        [[e, by_e, twice], [a, by_a, twice_a], [1 - e - a, -by_e - by_a, -twice - twice_a]]
    )
