"""Resultant of the reactions of a grasp, force and torque at a sensor, as an observable on the time
grid.

In the frame of the sensor with axes Q_k and origin o_k,

    W_k = Σ_g (Q_kᵀ R_g, Q_kᵀ (x_g − o_k) × R_g) + load of the tool,

with the reaction forces R of `reaction_forces` and the grasped nodes x_g. A tool of mass m between
sensor and body, with its centre at c in the frame of the grasp, adds the force m (a_c − g) at its
centre, a_c being the acceleration of the centre and g gravity. Values are Y = L W, where L is a
first-order low-pass with an estimated time constant, or the identity.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ...fem.pattern import dofs_of
from ...model.dynamics import Dynamics
from ...model.generated_functions import GeneratedFunction
from ...model.nuisance_map import NuisanceMap
from ...model.recursion import Recursion, RecursionTrajectory, relaxation_coefficients
from ...recording.deviation import Deviation
from ...recording.experiment import Experiment
from ...recording.grasp import Grasp
from ...recording.nuisance import SENSOR_LAG, SENSOR_TIME, TOOL_CENTRE, TOOL_MASS, cayley_rotation
from ...recording.poses import Frame
from ..observables import ObservableDerivatives, ObservedMotion, ReactionForces
from .forces import centred_rows

# Sizes of the data of the tool: the sensor's axes Q, the grasp's rotation and its second time
# derivative, its translation from the sensor's origin, and the second derivative of that.
TOOL_DATA = (9, 9, 9, 3, 3)
# Grid times that a sample is interpolated from: an error of (ωΔt)⁵ / 280 of a swing.
TIMES_PER_SAMPLE = 6


@dataclass(frozen=True, eq=False)
class ReactionGrid:
    """Grid times, and the rows of equations of motion that determine reaction forces."""

    t_s: Array  # (N,): evenly spaced times [s], unless `is_static`
    has_reaction: NDArray[np.bool_]  # (N,) of bool: rows that determine a reaction force
    delay_steps: int  # row t determines the reaction force at grid time t − `delay_steps`
    reach: int  # row t depends on the grasp from time t − reach on
    # Whether the rows are equilibria, at times that need not be evenly spaced; the resultant is
    # then linear between them.
    is_static: bool = False

    @classmethod
    def from_dynamics(cls, dynamics: Dynamics) -> ReactionGrid:
        """Build the grid of discrete equations of motion, whose rows determine reaction forces as
        `centred_rows` states.
        """
        return cls(dynamics.t_s, *centred_rows(dynamics), dynamics.largest_lag, dynamics.is_static)

    @classmethod
    def from_times(cls, t_s: Array) -> ReactionGrid:
        """Build the grid of reaction forces that are known at given times (N,) [s] themselves,
        without delay.
        """
        return cls(t_s, np.ones(len(t_s), dtype=bool), delay_steps=0, reach=0)

    @property
    def step_s(self) -> float:
        """Mean time between rows [s]; 0 for a single row."""
        return float(self.t_s[-1] - self.t_s[0]) / max(1, len(self.t_s) - 1)

    def reaction_times(self, grasp: Grasp) -> Index:
        """Return the indices of the grid times at which the reaction forces of a grasp are known,
        ascending: the grasp must hold at all times on which they depend.
        """
        is_holding = grasp.is_active(self.t_s)
        rows = self.has_reaction & is_holding
        for lag in range(1, self.reach + 1):
            rows[lag:] &= is_holding[:-lag]
        return np.flatnonzero(rows) - self.delay_steps


@dataclass(frozen=True, eq=False)
class ReactionResultant:
    """Force and torque (n, 2, 3) by which one grasp acts on the body, as an observable.

    Attributes
    ----------
    sensor_index : int
        Index of the sensor in the experiment; −1 if it has no nuisance parameters of its own.
    frame : str
        Frame of the sensor, in whose axes components are expressed.
    point_m : (3,) array
        Point of the torque [m]: fixed in the world, or in the frame "grasp" on the undeformed body.
    reaction_grid : ReactionGrid
        Times at which reaction forces are known.
    dof_count : int
        Number of dofs of the body, 3n.
    sensed_dofs : (g,) array
        Dofs whose reaction forces are known.
    node_dofs : (d,) array
        Indices among `sensed_dofs` of the dofs of the grasp's nodes.
    is_prescribed : (d,) array
        1 for dofs that the grasp prescribes, else 0.
    vector_count : int
        Number of vectors, 2.
    local : None
        The observable depends on many positions, see `observables`.
    measures_reactions : bool
        Whether values depend on reaction forces; True.
    """

    sensor_index: int
    grasp: Grasp
    frame: Frame
    point_m: Array
    reaction_grid: ReactionGrid
    nuisance: NuisanceMap
    dof_count: int
    sensed_dofs: Index
    node_dofs: Index
    is_prescribed: Array

    vector_count = 2
    local = None
    measures_reactions = True

    @property
    def delay_steps(self) -> int:
        """Number of rows after its time at which a value is known."""
        return self.reaction_grid.delay_steps

    @cached_property
    def known_rows(self) -> Index:
        """Indices (n,) of the grid times whose resultant is known, ascending."""
        return self.reaction_grid.reaction_times(self.grasp)

    @property
    def count(self) -> int:
        """Number n of grid times whose resultant is known."""
        return len(self.known_rows)

    @cached_property
    def t_s(self) -> Array:
        """Grid times (n,) with a known resultant [s]."""
        return self.reaction_grid.t_s[self.known_rows]

    @property
    def rows(self) -> Index:
        """Indices of all grid times, because accelerations are differences of positions."""
        return np.arange(len(self.reaction_grid.t_s))

    def operator(self, phi: Array) -> sp.csr_array:
        """Return the matrix (g, 3n) that selects the sensed dofs of a row; φ is not used."""
        count = len(self.sensed_dofs)
        entries = np.ones(count), (np.arange(count), self.sensed_dofs)
        return sp.csr_array(entries, shape=(count, self.dof_count))

    def known_count(self, rows: int) -> int:
        """Return how many of the n times are known if the first
        `rows` grid rows of the motion are.
        """
        return int(np.count_nonzero(self.known_rows + self.reaction_grid.delay_steps < rows))

    def parameter_indices(self, row: Deviation) -> Index:
        """Return the indices in φ of this sensor's nuisance parameters of one kind; empty if it has
        none.
        """
        return self.nuisance.indices_of_rows(row, component=self.sensor_index)

    @classmethod
    def from_experiment(
        cls,
        experiment: Experiment,
        grasp: Grasp,
        frame: Frame,
        point_m: Array,
        grid: ReactionGrid,
        nuisance: NuisanceMap,
        number: int = -1,
    ) -> ReactionResultant:
        """Build the observable of one grasp of an experiment.

        Parameters
        ----------
        frame : str
            Frame of the sensor, in whose axes components are expressed.
        point_m : (3,) array
            Origin of the sensor [m].
        grid : ReactionGrid
            Times at which reaction forces are known.
        number : int
            Index of the sensor; −1 if it has no nuisance parameters of its own.
        """
        sensed = sensed_dofs(experiment)
        own = dofs_of(grasp.nodes)
        return cls(
            number,
            grasp,
            frame=frame,
            point_m=point_m,
            reaction_grid=grid,
            nuisance=nuisance,
            dof_count=3 * len(experiment.body.nodes_m),
            sensed_dofs=sensed,
            node_dofs=np.searchsorted(sensed, own),
            is_prescribed=np.isin(own, grasp.prescribed_dofs).astype(np.float64),
        )

    @property
    def clock_limit_s(self) -> float:
        """Largest shift of the sensor's clock [s]; 0 if it is not estimated."""
        clock = self.parameter_indices(SENSOR_TIME)
        return float(SENSOR_TIME.high * self.nuisance.scales[clock].sum())

    # Moments ----------------------------------------------------------------------------------

    @cached_property
    def frames(self) -> tuple[Array, Array]:
        """Axes Q (n, 3, 3), one per column, and origins o (n, 3) [m] of the sensor in the world, at
        the known times; constant unless `frame` is "grasp".
        """
        rotations, shifts = self.poses_at(self.known_rows)
        if self.frame == "grasp":
            return rotations, shifts + rotations @ self.point_m
        axes = np.tile(np.eye(3), (self.count, 1, 1))
        return axes, np.tile(self.point_m, (self.count, 1))

    def poses_at(self, rows: Index) -> tuple[Array, Array]:
        """Return rotations (k, 3, 3) and translations (k, 3) [m] of the grasp at grid rows with
        indices (k,).
        """
        return self.grasp.poses.at(self.reaction_grid.t_s[rows])

    @cached_property
    def moment_data(self) -> Array:
        """Data (15, n, h) of `MOMENT` for the h nodes of the grasp."""
        axes, points = self.frames
        nodes = len(self.is_prescribed) // 3
        of_time = np.concatenate([axes.reshape(-1, 9), points], axis=1).T
        is_prescribed = np.broadcast_to(
            self.is_prescribed.reshape(nodes, 3).T[:, None], (3, self.count, nodes)
        )
        return np.concatenate([np.repeat(of_time[:, :, None], nodes, axis=2), is_prescribed])

    def moment_inputs(self, reactions: ReactionForces) -> tuple[Array, Array]:
        """Return inputs (6, n, h), positions [m] and reaction forces [N], and data (15, n, h) of
        `MOMENT` for the h nodes of the grasp, at the first n known times that the reaction forces
        cover.
        """
        k = self.known_rows[: self.known_count(len(reactions.reaction))]
        both = (reactions.position_m[k], reactions.reaction[k + self.reaction_grid.delay_steps])
        shape = len(k), len(self.node_dofs) // 3, 3
        u = [np.moveaxis(each[:, self.node_dofs].reshape(shape), 2, 0) for each in both]
        return np.concatenate(u), self.moment_data[:, : len(k)]

    def reaction_jacobians(self, reactions: ReactionForces) -> tuple[Array, Array]:
        """Return A and B (n, 6, d) of the change dW = A dR + B dx of the resultant without tool and
        without low-pass, by the reaction forces and positions of the d dofs of the grasp.
        """
        by_u = MOMENT.evaluate_with_jacobian(*self.moment_inputs(reactions))[1]
        by_u = np.transpose(by_u, (2, 0, 3, 1))
        return _by_dof(by_u[..., 3:]), _by_dof(by_u[..., :3])

    def evaluate_without_tool(self, reactions: ReactionForces) -> Array:
        """Return the resultant W (n, 6) without the load of the tool and without low-pass [N, N m]."""
        return MOMENT.evaluate(*self.moment_inputs(reactions)).sum(axis=2).T

    # The tool ---------------------------------------------------------------------------------

    @cached_property
    def tool_parameters(self) -> Index:
        """Indices in φ of mass and centre of the tool and of gravity, as far as they are estimated;
        empty if the tool's mass is not.
        """
        if not len(mass := self.parameter_indices(TOOL_MASS)):
            return mass
        centre = self.parameter_indices(TOOL_CENTRE)
        return np.concatenate([mass, centre, self.nuisance.gravity_indices])

    @cached_property
    def tool(self) -> GeneratedFunction:
        """Generated force and torque (6,) of the tool, m (a_c − g) at c, as a function of
        `tool_parameters`, see `tool_inputs`.
        """
        return GeneratedFunction(
            self._tool_load, len(self.tool_parameters), data_size=sum(TOOL_DATA)
        )

    def _tool_load(self, phi: ca.SX, data: ca.SX) -> ca.SX:
        """Return force and torque (6,) of the tool in the sensor's axes [N, N m]."""
        axes, turn, turn_rate, shift, shift_rate = ca.vertsplit(data, np.cumsum([0, *TOOL_DATA]))
        axes, turn, turn_rate = (ca.reshape(each, 3, 3).T for each in (axes, turn, turn_rate))
        count = len(self.tool_parameters) - len(self.nuisance.gravity_indices)
        own, tilts = ca.vertsplit(phi, [0, count, len(self.tool_parameters)])
        own *= self.nuisance.scales[self.tool_parameters[:count]][:, None]
        about = self.frame == "grasp"
        centre = ca.DM(self.point_m if about else self.nuisance.grasp_pivot_m)
        centre = centre + own[1:] if own.numel() > 1 else centre
        gravity = self.nuisance.gravity_expression(tilts)
        pull = own[0] * (turn_rate @ centre + shift_rate - gravity)
        return ca.vertcat(axes.T @ pull, axes.T @ ca.cross(turn @ centre + shift, pull))

    def tool_inputs(self, phi: Array, count: int) -> tuple[Array, Array]:
        """Return inputs (k,) and data (33, n) of `tool` at the first `count` times, at φ.

        The data are the sensor's axes Q, the rotation of the grasp and its second derivative, the
        translation of the grasp relative to the sensor's origin o, and the second derivative of the
        translation.
        """
        axes, points = (each[:count] for each in self.frames)
        rotations, shifts = self.poses_at(self.known_rows[:count])
        turn_rates, shift_rates = self.pose_accelerations(count)
        parts = (axes, rotations, turn_rates, shifts - points, shift_rates)
        data = np.concatenate([each.reshape(count, -1) for each in parts], axis=1)
        return phi[self.tool_parameters], data.T

    def pose_accelerations(self, count: int) -> tuple[Array, Array]:
        """Return second time derivatives of the grasp's rotations (count, 3, 3) [1/s²] and
        translations (count, 3) [m/s²] at the first `count` known times.

        They are central differences over a grid step, at the ends of the poses those of the next
        possible time; zero for static experiments and for fewer than three poses.
        """
        step_s = self.reaction_grid.step_s
        poses = self.grasp.poses
        if len(poses.t_s) < 3 or self.reaction_grid.is_static:
            return np.zeros((count, 3, 3)), np.zeros((count, 3))
        middle = np.clip(self.t_s[:count], poses.t_s[0] + step_s, poses.t_s[-1] - step_s)
        before, now, after = (poses.at(middle + way * step_s) for way in (-1, 0, 1))
        pairs = zip(before, now, after, strict=True)
        rotation_rates, translation_rates = ((b - 2 * n + a) / step_s**2 for b, n, a in pairs)
        return rotation_rates, translation_rates

    def evaluate_unfiltered(self, reactions: ReactionForces, phi: Array) -> Array:
        """Return the resultant W (n, 6) [N, N m] of reaction forces at φ including the tool if its
        mass is estimated, before the low-pass.
        """
        value = self.evaluate_without_tool(reactions)
        if len(self.tool_parameters):
            value = value + self.tool.evaluate(*self.tool_inputs(phi, len(value))).T
        return value

    # The low-pass -----------------------------------------------------------------------------

    @cached_property
    def low_pass_parameters(self) -> Index:
        """Index in φ of the time constant of the low-pass; empty without a low-pass."""
        return self.parameter_indices(SENSOR_LAG)

    def filter_resultant(self, value: Array, phi: Array) -> RecursionTrajectory | None:
        """Return the low-pass filtered W (n, 6) at φ (k,) as a recursion with derivatives; None
        without a low-pass or without times.
        """
        if not len(self.low_pass_parameters) or not len(value):
            return None
        data = self.low_pass_data[:, : len(value), None]
        return RecursionTrajectory.from_signal(
            LOW_PASS, phi[self.low_pass_parameters], data=data, signal=value[None]
        )

    @cached_property
    def low_pass_data(self) -> Array:
        """Data (2, n) of `LOW_PASS`; there must be a low-pass."""
        per_step = self.nuisance.scales[self.low_pass_parameters] / self.reaction_grid.step_s
        return np.stack([np.arange(self.count) == 0, np.repeat(per_step, self.count)])

    # As channels are --------------------------------------------------------------------------

    def evaluate(self, motion: ObservedMotion, phi: Array) -> Array:
        """Return the measured resultant Y = L W (n, 2, 3), force [N] and torque [N m], of a motion
        at φ, at the n times whose reaction forces the motion covers.
        """
        value = self.evaluate_unfiltered(_reactions_of(motion), phi)
        evolution = self.filter_resultant(value, phi)
        return (evolution.states[0] if evolution else value).reshape(-1, 2, 3)

    def linearise(
        self, motion: ObservedMotion, phi: Array, columns: Index, size: int
    ) -> tuple[Array, ObservableDerivatives]:
        """Return Y (n, 2, 3) [N, N m], as `evaluate` does, and its derivatives by all parameters.

        Parameters
        ----------
        motion : ObservedMotion
            Motion whose reaction forces have changes `reaction_by` and `position_by` with c
            columns; they must not be None.
        phi : (k,) array
            Nuisance parameters; they are the last of all parameters.
        columns : (c,) array
            Indices of the parameters of the changes.
        size : int
            Number of all parameters.
        """
        forced = _reactions_of(motion)
        first = size - len(phi)
        assert forced.reaction_by is not None
        assert forced.position_by is not None
        of_force, of_place = self.reaction_jacobians(forced)
        k = self.known_rows[: len(of_force)]
        value = self.evaluate_unfiltered(forced, phi)
        slope = np.zeros((len(k), 6, size))
        slope[..., columns] = (
            of_force @ forced.reaction_by[k + self.reaction_grid.delay_steps][:, self.node_dofs]
        )
        slope[..., columns] += of_place @ forced.position_by[k][:, self.node_dofs]
        if len(self.tool_parameters):
            by_phi = self.tool.evaluate_with_jacobian(*self.tool_inputs(phi, len(k)))[1]
            slope[..., first + self.tool_parameters] += np.moveaxis(by_phi, 2, 0)
        if evolution := self.filter_resultant(value, phi):
            by_lag = np.arange(size) == first + self.low_pass_parameters[:, None]
            value = evolution.states[0]
            slope = evolution.jacobian_vector_product(slope[None], by_lag)[0]
        slope = slope.reshape(len(k), 2, 3, size)
        return value.reshape(len(k), 2, 3), ObservableDerivatives.without_own(
            np.arange(size), slope
        )

    def vjp(
        self, motion: ObservedMotion, phi: Array, by_values: Array
    ) -> tuple[Array, Array, Array]:
        """Vector–Jacobian product: derivatives of a scalar by positions (N, 3n), reaction forces
        (N, g) and φ (k,) from those by Y.

        Parameters
        ----------
        phi : (k,) array
            Nuisance parameters.
        by_values : (n, 2, 3) array
            Derivatives of the scalar by Y.
        """
        forced = _reactions_of(motion)
        by_phi = np.zeros(len(phi))
        by_x = np.zeros_like(motion.x)
        by_reaction = np.zeros_like(forced.reaction)
        by_w = by_values.reshape(-1, 6)
        if evolution := self.filter_resultant(self.evaluate_unfiltered(forced, phi), phi):
            (by_w,), by_phi[self.low_pass_parameters] = evolution.vector_jacobian_product(
                by_w[None]
            )
        if len(self.tool_parameters):
            slopes = self.tool.evaluate_with_jacobian(*self.tool_inputs(phi, len(by_w)))[1]
            by_phi[self.tool_parameters] += np.einsum("na,abn->b", by_w, slopes)
        of_force, of_place = self.reaction_jacobians(forced)
        k = self.known_rows[: len(by_w)]
        by_reaction[np.ix_(k + self.reaction_grid.delay_steps, self.node_dofs)] = np.einsum(
            "ka,kag->kg", by_w, of_force
        )
        by_x[np.ix_(k, self.sensed_dofs[self.node_dofs])] = np.einsum("ka,kag->kg", by_w, of_place)
        return by_x, by_reaction, by_phi

    def frame_changes(
        self, grasp: Grasp, motion: ObservedMotion, phi: Array, shifts: Array, rotations: Array
    ) -> Array | float:
        """Return the changes (n, 2, 3, c) of Y due to pose errors that move the frame of the
        sensor; the reaction forces and the load of the tool are constant.

        Parameters
        ----------
        grasp : Grasp
            Grasp whose poses have errors; the result is 0 for another grasp, or a frame fixed in
            the world.
        motion : ObservedMotion
            Motion with its reaction forces.
        phi : (k,) array
            Nuisance parameters.
        shifts : (N, c, 3) array
            Errors of the translations [m].
        rotations : (N, c, 3) array
            Errors of the rotations as rotation vectors [rad].
        """
        if grasp is not self.grasp or self.frame != "grasp":
            return 0.0
        value = self.evaluate_without_tool(_reactions_of(motion))
        axes = self.frames[0][: len(value)]
        data = [axes.reshape(-1, 9), value, np.tile(self.point_m, (len(value), 1))]
        slopes = IN_MOVED_FRAME.evaluate_with_jacobian(
            np.zeros((6, len(value))), np.concatenate(data, axis=1).T
        )[1]
        k = self.known_rows[: len(value)]
        pose_changes = np.concatenate([rotations[k], shifts[k]], axis=2)
        change = np.einsum("abn,ncb->nac", slopes, pose_changes)
        if evolution := self.filter_resultant(value, phi):
            (change,) = evolution.jacobian_vector_product(
                change[None], np.zeros((1, change.shape[2]))
            )
        return change.reshape(len(change), 2, 3, change.shape[2])


def sensed_dofs(experiment: Experiment) -> Index:
    """Return the dofs (g,) of the nodes of all grasps that a sensor measures, ascending."""
    grasp_dofs = [dofs_of(experiment.grasps[k].nodes) for k in experiment.instrumented_grasps]
    return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *grasp_dofs]))


def _reactions_of(motion: ObservedMotion) -> ReactionForces:
    if motion.reactions is None:
        raise ValueError("a resultant needs the reaction forces of the motion")
    return motion.reactions


def _moment(u: ca.SX, data: ca.SX) -> ca.SX:
    """Return force and torque (6,) of a node, from u = (x_g, R_g) and the data of `MOMENT`."""
    place, reaction = ca.vertsplit(u, 3)
    axes, point, is_prescribed = ca.vertsplit(data, [0, 9, 12, 15])
    axes = ca.reshape(axes, 3, 3)
    force = is_prescribed * reaction
    return ca.vertcat(axes @ force, axes @ ca.cross(place - point, force))


def _in_moved_frame(offset: ca.SX, data: ca.SX) -> ca.SX:
    """Return force and torque (6,) in a frame rotated and moved by an offset."""
    turn, shift = ca.vertsplit(offset, 3)
    axes, force, torque, point = ca.vertsplit(data, [0, 9, 12, 15, 18])
    axes = ca.reshape(axes, 3, 3).T
    turned = cayley_rotation(turn) @ axes
    force = axes @ force
    moved = shift + (turned - axes) @ point
    return ca.vertcat(turned.T @ force, turned.T @ (axes @ torque - ca.cross(moved, force)))


def _by_dof(by_node: Array) -> Array:
    """Return values (n, 6, h, 3) by node as values (n, 6, d) by dof."""
    return np.ascontiguousarray(by_node).reshape(*by_node.shape[:2], -1)


def _low_pass_step(before: ca.SX, now: ca.SX, last: ca.SX, lag: ca.SX, data: ca.SX) -> ca.SX:
    """Return Y after one step of Y' = (W − Y) / T, with W linear between grid times."""
    began = data[0]
    e, c = relaxation_coefficients(lag * data[1])
    difference = e * (last - before) + c * (now - last)
    return now - (1 - began) * difference


# Force and torque (6,) of one node, by x_g and R_g; data are Q, o and one for each prescribed dof.
MOMENT = GeneratedFunction(_moment, 6, data_size=15)
# W (6,) by a rotation and a translation of the frame; data are Q, W and the point in the frame.
IN_MOVED_FRAME = GeneratedFunction(_in_moved_frame, 6, data_size=18)
# Y by W and the φ of `low_pass_parameters`; data are one at the start, otherwise zero, and the T /
# Δt of a φ of one.
LOW_PASS = Recursion(_low_pass_step, 1, signal_size=1, constant_count=1, data_size=2)
