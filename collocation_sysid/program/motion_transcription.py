"""Transcription of the motion of one experiment: its variables, constraints and their derivatives.

The constraints are the discrete equations of motion of a collocation scheme. Values are scaled:
variables x / `length_m`, equations of motion c / `force_n`, and constraints of grasped dofs (x − u
x̄) / `length_m`, which prescribe the pose u of the grasp applied to the undeformed position x̄.
Measurements are added by the subclass `Transcription`, which is what the rest of the program uses.

Symbols: N grid times, n nodes, q shared parameters, φ nuisance parameters of the experiment, z all
variables and g all constraints of the nonlinear program.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array, Index
from ..common.time_dependence import at_times
from ..fem.body import Body, Linearisation, SecondDerivatives
from ..fem.schemes import Scheme
from ..model.dynamics import Dynamics, StencilRow
from ..model.equations_at_parameters import EquationsAtParameters
from ..model.grasp_constraint import GraspConstraint, PrescribedDisplacements
from ..model.inputs import Inputs, inputs_from_experiment, with_inputs
from ..model.internal_variables import AnyHistory
from ..model.nuisance_map import NuisanceIndices, NuisanceMap
from ..model.parameters import Parameters, ThetaMap
from ..recording.experiment import Experiment
from .linear_algebra.block_band import (
    BandBlock,
    BlockBand,
    BlockTerm,
    full_skew_values,
    skew_block_band,
)
from .measurement_model import MeasurementModel, MotionGrid
from .measurement_models import measurement_models
from .motion_jacobian import MotionJacobian, shifted_back
from .reactions.resultant import ReactionGrid, sensed_dofs

T = TypeVar("T", bound=np.generic)
# Coefficients of ∂²φ/∂x² and ∂²φ/∂x∂v from the stencils (p, q) of two positions, see
# `_state_factors`.
Factors = Callable[[Array, Array, Array, Array], tuple[Array, Array]]
# History variables and their weights in a Lagrangian.
WeightedHistory = tuple[AnyHistory, Array]


@dataclass(frozen=True)
class Offsets:
    """Offsets in the nonlinear program: of a transcription, or of a group of lifted variables."""

    variable: int  # index in z of the first variable, of a transcription the first position
    row: int  # index in g of the first constraint


@dataclass(frozen=True, eq=False)
class RowWeights:
    """Weights of the constraints and forces of one transcription in a Lagrangian."""

    multipliers: Array  # (constraints,): weights of the scaled constraints
    rows: Array  # (N, 3n): the same for the residuals c in newtons [1/N]
    forces: Array  # (N, 3n): weights of the forces at the evaluations [1/N]


@dataclass(frozen=True, eq=False)
class MotionTranscription:
    """Variables x_{t,i} and constraints of one experiment, at grid time t and dof i.

    Nothing here depends on the association of the measurements with the body, see `Transcription`.
    Instances are immutable apart from cached values; a copy in another process has none of them.

    Attributes
    ----------
    experiment : Experiment
        The experiment; it is not modified.
    parameters : Parameters
        Shared parameters; constraints are scaled at their guess.
    scheme : str or Scheme
        Time discretisation, see `Collocation`.
    substeps : int
        Grid steps between samples.
    has_grasp_constraints : bool
        If true, every prescribed displacement is a constraint instead of a bound. Dofs that are
        prescribed for a part of the time always have constraints, and so do all grasped dofs if the
        pose of the body in its grasps is estimated.
    huber : float or None
        Threshold of Huber's loss in standard deviations; None means a quadratic loss.
    offsets : Offsets
        Offsets of its variables and constraints.
    nuisance_indices : NuisanceIndices
        Indices of its φ in p = (q, φ_1, φ_2, …).
    """

    experiment: Experiment
    parameters: Parameters
    scheme: str | Scheme
    substeps: int
    has_grasp_constraints: bool
    huber: float | None
    offsets: Offsets
    nuisance_indices: NuisanceIndices

    def __getstate__(self) -> dict[str, Any]:
        # Cached values are computed again where they are needed.
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def body(self) -> Body:
        """Body whose motion is measured; several experiments may share one."""
        return self.experiment.body

    @cached_property
    def constants(self) -> ThetaMap:
        """Map from the shared parameters q to the constants θ of the body."""
        return ThetaMap(self.parameters, self.body)

    @cached_property
    def dynamics(self) -> Dynamics:
        """Discrete equations of motion with the inputs as stated in the experiment, before any
        estimate; the constants of the body are not set.
        """
        return with_inputs(
            self.experiment,
            Dynamics.from_experiment(self.experiment, self.scheme, substeps=self.substeps),
            self.nuisance,
        )

    @cached_property
    def nuisance(self) -> NuisanceMap:
        """Nuisance parameters φ of the experiment."""
        return NuisanceMap.from_experiment(self.experiment, self.nuisance_indices.pivot_m)

    @cached_property
    def measurement_grid(self) -> MotionGrid:
        """Times at which the measurements know the motion."""
        reaction_grid = ReactionGrid.from_dynamics(self.dynamics)
        return MotionGrid(
            self.experiment,
            self.nuisance,
            t_s=reaction_grid.t_s,
            reaction_grid=reaction_grid,
            sample_rows=np.arange(len(self.experiment.t_s)) * self.substeps,
            huber=self.huber,
            is_initially_at_rest=not self.dynamics.start_velocity_m_s.any(),
        )

    @property
    def sample_rows(self) -> Index:
        """Rows (T,) of x at the samples."""
        return self.measurement_grid.sample_rows

    @cached_property
    def measurement_models(self) -> tuple[MeasurementModel, ...]:
        """Models of the measurements, for any association, see `measurement_models`."""
        return measurement_models(self.measurement_grid)

    @cached_property
    def sensed_dofs(self) -> Index:
        """Dofs (g,) of the nodes of grasps whose reaction forces are measured, ascending."""
        return sensed_dofs(self.experiment)

    # Sizes and places -------------------------------------------------------------------------

    @property
    def nq(self) -> int:
        """Number of shared parameters q."""
        return len(self.parameters.free)

    @property
    def dof_count(self) -> int:
        """Number of dofs of the body, 3n: three displacements for each of n nodes."""
        return self.experiment.sparsity.size

    @cached_property
    def free_dofs(self) -> Index:
        """Dofs (f,) that are free at some time, ascending; the columns "free" of arrays are in this
        order.
        """
        return self.experiment.free_dofs

    @cached_property
    def prescribed_dofs(self) -> Index:
        """Dofs that are prescribed at all times, ascending."""
        return self.experiment.prescribed_dofs

    @cached_property
    def constrained_dofs(self) -> Index:
        """Dof of each constraint of one grid time, ascending: all dofs if prescribed displacements
        are constraints, otherwise the free ones.
        """
        return np.arange(self.dof_count) if self.has_constraints_of_grasps else self.free_dofs

    @property
    def has_constraints_of_grasps(self) -> bool:
        """Whether all prescribed displacements are constraints instead of bounds: because it was
        requested, or because the pose of the body in its grasps is estimated.
        """
        return self.has_grasp_constraints or self.nuisance.affects_grasps

    @property
    def constraints_per_time(self) -> int:
        """Number of constraints of one grid time: free dofs, or all dofs if prescribed
        displacements are constraints.
        """
        return len(self.constrained_dofs)

    @property
    def grid_times(self) -> int:
        """Number N of grid times."""
        return self.dynamics.row_count

    @property
    def variable_count(self) -> int:
        """Number of position variables, N · 3n."""
        return self.grid_times * self.dof_count

    @property
    def constraint_times(self) -> int:
        """Number of grid times with constraints: N, or N − 1 if the start is given and row 0 has no
        equation.
        """
        return self.grid_times - self.dynamics.first_row

    @property
    def constraint_count(self) -> int:
        """Number of scaled constraints of this experiment: `constraint_times` ·
        `constraints_per_time`.
        """
        return self.constraint_times * self.constraints_per_time

    @property
    def columns(self) -> slice:
        """Slice of its scaled positions in z, grid time by grid time."""
        return slice(self.offsets.variable, self.offsets.variable + self.variable_count)

    @property
    def rows(self) -> slice:
        """Slice of its constraints in g."""
        return slice(self.offsets.row, self.offsets.row + self.constraint_count)

    @property
    def parameter_indices(self) -> Index:
        """Indices (nq + k,) of its (q, φ) in p."""
        return np.concatenate([np.arange(self.nq), self.nuisance_indices.indices])

    @property
    def next_offsets(self) -> Offsets:
        """Offsets of the transcription that follows."""
        return Offsets(self.columns.stop, self.rows.stop)

    # Grasps and scales ------------------------------------------------------------------------

    @cached_property
    def prescribed_motion(self) -> GraspConstraint:
        """Prescribed displacements of the grasps as a function of φ."""
        return GraspConstraint(self.experiment, self.nuisance, t_s=self.dynamics.t_s)

    def _prescribed_positions(self, prescribed: PrescribedDisplacements) -> Array:
        """Return (N, 3n) [m] with prescribed dofs, NaN elsewhere."""
        goals = np.full((self.grid_times, self.dof_count), np.nan)
        goals[:, prescribed.dofs] = prescribed.positions_m
        return goals

    @cached_property
    def length_m(self) -> float:
        """Mean edge length ℓ of the mesh [m], the unit of positions."""
        edges = np.diff(self.body.nodes_m[self.body.mesh.edges], axis=1)
        return float(np.linalg.norm(edges, axis=2).mean())

    @cached_property
    def force_n(self) -> float:
        """Unit of equations of motion [N]: `stiffness_n`; of a body that hardly stretches, whose
        stiffness would leave no other force visible, the force whose moment at one edge length bends
        it by 1 rad.
        """
        if self.body.is_solid:
            return self.stiffness_n
        theta = self.constants.theta(self.parameters.guess_q)
        return self.body.kind.given_stresses.unit_moment_n_m(self.body, theta) / self.length_m

    @cached_property
    def stiffness_n(self) -> float:
        """Mean of |∂c_t/∂x_t| ℓ over the diagonal at the undeformed shape and the guess
        [N], to which rounding errors are in proportion.
        """
        theta = self.constants.theta(self.parameters.guess_q)
        at_rest = self.body.nodes_m
        dynamics = self.dynamics.with_theta(theta)
        pattern = self.experiment.sparsity
        at_last = at_times(dynamics.forces, slice(dynamics.row_count - 1, None))
        forces = at_last.linearise(at_rest, np.zeros_like(at_rest))
        last = StencilRow.from_dynamics(dynamics, dynamics.row_count - 1)
        block = last.block(forces.by_position[0], forces.by_velocity[0], pattern=pattern)
        stiffness = np.abs(block[pattern.diagonal[self.free_dofs]]).mean()
        return self.length_m * float(stiffness)

    def start_positions(self) -> Array | None:
        """Return the initial positions (3n,) [m]; None if the experiment starts in equilibrium.

        They are those stated in the experiment, by default the undeformed shape in the pose of the
        grasps at the first time.
        """
        experiment = self.experiment
        if experiment.is_balanced_at_start:
            return None
        if experiment.start_positions_m is not None:
            return experiment.start_positions_m.ravel()
        return experiment.rigid_positions(self.dynamics.t_s[:1]).ravel()

    def bounds(self) -> tuple[Array, Array]:
        """Return lower and upper bounds (N, 3n) of the positions [m], equal where a value
        is prescribed.

        Free positions have infinite bounds; so have prescribed ones if `has_constraints_of_grasps`.
        Unless the start is an equilibrium, all dofs of the first time are prescribed.
        """
        lower = np.full((self.grid_times, self.dof_count), -np.inf)
        upper = np.full((self.grid_times, self.dof_count), np.inf)
        if not self.has_constraints_of_grasps:
            lower[:, self.prescribed_dofs] = self.dynamics.prescribed_m[:, self.prescribed_dofs]
            upper[:, self.prescribed_dofs] = lower[:, self.prescribed_dofs]
        start = self.start_positions()
        if start is not None:
            lower[0] = upper[0] = start
        return lower, upper

    # Parameters -------------------------------------------------------------------------------

    @cached_property
    def dynamic_parameters(self) -> Index:
        """Indices in (q, φ) of the parameters that change the motion, not only the measurements."""
        return np.concatenate([np.arange(self.nq), self.nq + self.nuisance.motion_indices])

    def dynamic_columns(self, first_phi: int) -> Index:
        """Return the indices in z of the parameters that change the motion: all of q, then φ; in
        the order of `dynamic_parameters`.

        Parameters
        ----------
        first_phi : int
            Index in z where the nuisance parameters of all experiments begin.
        """
        phi = first_phi - self.nq + self.nuisance_indices.indices[self.nuisance.motion_indices]
        return np.concatenate([np.arange(self.nq), phi])

    def has_histories(self) -> bool:
        """Return whether its body (viscoelastic memory) or a force on it has history variables."""
        return self.body.has_memory or bool(self.dynamics.forces.terms_with_internal_variables)

    def equations_at(self, q: Array, phi: Array) -> EquationsAtParameters:
        """Return the equations of motion, on all N grid times, at shared parameters q (nq,) and
        nuisance parameters φ (k,).
        """
        p = np.concatenate([q, phi[self.nuisance.motion_indices]])
        u, by_p = self.inputs.evaluate_at(p)
        dynamics = self.dynamics.with_inputs(u)
        prescribed = self.prescribed_motion.evaluate_at(phi)
        if prescribed.depends_on_phi:
            dynamics = replace(dynamics, prescribed_m=self._prescribed_positions(prescribed))
        return EquationsAtParameters(
            self.inputs,
            p,
            nq=self.nq,
            input_derivatives=by_p,
            dynamics=dynamics,
            prescribed=prescribed,
        )

    @cached_property
    def inputs(self) -> Inputs:
        """Map from the parameters (q, φ) to the inputs of the equations of motion at all
        evaluations.
        """
        return inputs_from_experiment(
            self.experiment,
            self.parameters,
            nuisance=self.nuisance,
            evaluated_s=self.dynamics.evaluated_s,
        )

    def corrected_experiment(self, phi: Array) -> Experiment:
        """Return the experiment with gravity, stiffness, grasps, loads, actuators and times as estimated
        by φ (k,), in the body's frame; the experiment itself if no nuisance parameter changes the
        motion.
        """
        if not len(self.nuisance.motion_indices):
            return self.experiment
        grasps = self.experiment.grasps
        if self.nuisance.affects_grasps:
            grasps = self.nuisance.with_grasps(grasps, phi)
        drive_errors = iter(self.nuisance.actuator_calibration(phi))
        tendons, pressures = (
            tuple(actuator.with_calibration(*next(drive_errors)) for actuator in actuators)
            for actuators in (self.experiment.tendons, self.experiment.pressures)
        )
        changed = replace(
            self.experiment,
            gravity_m_s2=self.nuisance.gravity(phi),
            grasps=grasps,
            tendons=tendons,
            pressures=pressures,
        )
        changed = self.nuisance.with_start(self.nuisance.with_stiffness(changed, phi), phi)
        return self.nuisance.with_times(changed, phi)

    def with_prescribed_positions(self, x: Array, phi: Array) -> Array:
        """Return a copy of positions x (N, 3n) [m] in which each dof is, while a grasp prescribes
        it, at the position to which its grasp moves at φ (k,).
        """
        goals = self._prescribed_positions(self.prescribed_motion.evaluate_at(phi))
        return np.where(np.isnan(goals), x, goals)

    # Values ---------------------------------------------------------------------------------

    def constraint_values(
        self, x: Array, equations: EquationsAtParameters, histories: Sequence[AnyHistory] = ()
    ) -> Array:
        """Return the scaled constraints (constraints,).

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        histories : sequence of histories
            History variables at x, of the body and of forces; empty if there are none, or if they
            are to be computed from x.
        """
        return self._scaled_constraints(
            x, equations.dynamics.residual(x, histories), equations=equations
        )

    def _scaled_constraints(
        self, x: Array, residual: Array, equations: EquationsAtParameters
    ) -> Array:
        """Return the scaled constraints (constraints,) from the residual of the motion."""
        rows = residual / self.force_n
        goals = equations.dynamics.prescribed_m
        grasped = ~np.isnan(goals)
        rows[grasped] = (x[grasped] - goals[grasped]) / self.length_m
        return self.select_rows(rows)

    def select_rows(self, values: NDArray[T]) -> NDArray[T]:
        """Return a copy of those of values (N, 3n) that belong to constraints, (constraints,), grid
        time by grid time.
        """
        return values[self.dynamics.first_row :, self.constrained_dofs].ravel()

    @cached_property
    def is_grasp_constraint(self) -> NDArray[np.bool_]:
        """Mask (constraints,) of the constraints that prescribe a displacement instead of an
        equation of motion.
        """
        grasped = self.dynamics.is_temporarily_prescribed.copy()
        grasped[:, self.prescribed_dofs] = True
        return self.select_rows(grasped)

    def residual_n(
        self, x: Array, equations: EquationsAtParameters, histories: Sequence[AnyHistory] = ()
    ) -> Array:
        """Return the residuals of the equations of motion (N, free dofs) [N], zero while a grasp
        prescribes the dof; arguments as in `constraint_values`.
        """
        residual = equations.dynamics.residual(x, histories)
        return self.dynamics.zero_prescribed_forces(residual)[:, self.free_dofs]

    @cached_property
    def motion_rows(self) -> MotionJacobian:
        """Sparsity structure and entries of ∂c/∂x."""
        return MotionJacobian(
            self.dynamics,
            self.constrained_dofs,
            free_dofs=self.free_dofs,
            length_m=self.length_m,
            force_n=self.force_n,
        )

    def constraints_and_jacobian(
        self, x: Array, equations: EquationsAtParameters, forces: Linearisation, values: Array
    ) -> tuple[Array, Array]:
        """Evaluate the constraints and their derivatives.

        History variables are treated as constant; their contribution is that of `history_vjp`.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        forces : Linearisation
            Forces and their derivatives at the evaluations of x.
        values : (jacobian.nnz,) array
            Entries of ∂c/∂x for scaled positions, in the order of `jacobian`; overwritten.

        Returns
        -------
        ((constraints,) array, (constraints, m) array)
            Scaled constraints c, and ∂c/∂p by the m parameters p of the equations: those of
            `dynamic_parameters`, or the controls of a `Drive`.
        """
        dynamics = equations.dynamics
        count = equations.input_derivatives.shape[2]
        self.motion_rows.fill(
            values,
            forces,
            dynamics=dynamics,
            has_variable_mass=equations.mass_depends_on_parameters,
        )
        by_p = np.zeros((self.grid_times, self.dof_count, count))
        rows = slice(dynamics.first_row, None)
        by_p[rows] = equations.force_derivatives(rows, forces.by_theta)
        by_p = dynamics.combine(dynamics.tables.w, dynamics.zero_prescribed_forces(by_p))
        if equations.mass_depends_on_parameters:
            all_rows = slice(None)
            by_p -= equations.inertia_derivatives(all_rows, dynamics.acceleration(x), dofs=all_rows)
        by_p /= self.force_n
        dynamics.zero_prescribed_forces(by_p)
        by_p[:, self.prescribed_dofs] = 0
        if equations.prescribed.depends_on_phi:
            by_p[:, equations.prescribed.dofs, equations.nq :] -= (
                equations.prescribed.by_phi / self.length_m
            )
        by_p = by_p[dynamics.first_row :, self.constrained_dofs]
        rows = self._scaled_constraints(
            x, dynamics.assemble_residual(x, forces.force), equations=equations
        )
        return rows, by_p.reshape(self.constraint_count, count)

    def lagrangian_weights(
        self, multipliers: Array, reaction_weights: Array | float = 0.0
    ) -> RowWeights:
        """Return the weights of constraints and forces in Σ multipliers · c.

        Parameters
        ----------
        multipliers : (constraints,) array
            Weights of the scaled constraints of this experiment.
        reaction_weights : (N, 3n) array or 0
            Additional weights of the residuals c [1/N], applied to the complete force balance
            including dofs that are prescribed at that time. A number means none.

        Returns
        -------
        RowWeights
            The given multipliers, and the weights of the residuals c and of the forces. Weights of
            grasp constraints are in the multipliers alone.
        """
        dynamics = self.dynamics
        t = self.dynamics.tables
        rows = np.zeros((self.grid_times, self.dof_count))
        by_time = multipliers.reshape(self.constraint_times, self.constraints_per_time)
        rows[dynamics.first_row :, self.constrained_dofs] = by_time / self.force_n
        rows[:, self.prescribed_dofs] = 0
        rows = dynamics.zero_prescribed_forces(rows)
        forces = dynamics.zero_prescribed_forces(dynamics.combine_transposed(t.w, rows))
        if isinstance(reaction_weights, np.ndarray):
            rows = rows + reaction_weights
            forces = forces + dynamics.combine_transposed(t.w, reaction_weights)
        return RowWeights(multipliers, rows, forces=forces)

    def history_vjp(
        self, x: Array, equations: EquationsAtParameters, weights: Array
    ) -> tuple[Array, Array]:
        """Vector–Jacobian product of the forces through the history variables; zero without any.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        weights : (N, 3n) array
            Weights of the forces F at the evaluations [1/N].

        Returns
        -------
        ((N, 3n) array, (m,) array)
            Derivatives of Σ weights · F through history variables alone, by x [1/m] and by the m
            parameters of `dynamic_parameters`.
        """
        dynamics = equations.dynamics
        by_x = np.zeros_like(x)
        by_p = np.zeros(len(self.dynamic_parameters))
        for history in dynamics.histories(x):
            by_xi, by_nu, own = history.vector_jacobian_product(
                weights, equations.input_derivatives
            )
            by_x += dynamics.combine_transposed(dynamics.state_weights, by_xi)
            by_x += dynamics.combine_transposed(dynamics.tables.q, by_nu) / dynamics.step_s
            by_p += own
        return by_x, by_p

    @cached_property
    def linearisation_buffer(self) -> Array:
        """Work space (constraint_times, width) for linearisations; overwritten by each of them."""
        # Kept between calls: fresh pages would cost as much as the numbers in them.
        return np.zeros((self.constraint_times, self.dynamics.forces.body.linearisation_width))

    # Second derivatives -----------------------------------------------------------------------

    @cached_property
    def hessian(self) -> BlockBand:
        """Sparsity structure of the upper triangle of the Lagrangian's Hessian in the columns of x.

        The nq rows of q stand above the rows of x.
        """
        blocks = self._hessian_blocks(_state_factors)
        return BlockBand(
            self.dof_count, self._list_hessian_starts(), blocks=blocks, top_rows=self.nq
        )

    @cached_property
    def _skew_hessian(self) -> BlockBand:
        """Structure that adds the skew part of ∂²φ/∂x∂v to `hessian`."""
        blocks = self._hessian_blocks(lambda p, q, pp, qq: (pp * q - qq * p, 0 * q))
        return skew_block_band(
            self.dof_count, self._list_hessian_starts(), blocks=blocks, top_rows=self.nq
        )

    @cached_property
    def _rate_hessian(self) -> BlockBand:
        """Structure that adds the contribution of ∂²φ/∂v² to the values of `hessian`."""
        blocks = self._hessian_blocks(lambda p, q, pp, qq: (q * qq, 0 * q))
        return BlockBand(
            self.dof_count, self._list_hessian_starts(), blocks=blocks, top_rows=self.nq, adds=True
        )

    def _list_hessian_starts(self) -> Index:
        """Return the Hessian's row of each time (N,), q first."""
        return self.nq + np.arange(self.grid_times) * self.dof_count

    def _hessian_blocks(self, factors: Factors) -> list[BandBlock]:
        """Return the blocks ∂²φ/∂x_{t−distance}∂x_t of a potential φ (no nuisance parameters)."""
        # One for each distance up to the largest lag with entries; that of 0 has the upper triangle.
        rows, columns, source = self.experiment.sparsity.full
        blocks = []
        for distance in range(self.dynamics.largest_lag + 1):
            if distance > 0 and not self._curvature_terms(distance, _state_factors):
                continue
            is_stored = rows <= columns if distance == 0 else np.ones(len(rows), dtype=bool)
            entries = np.flatnonzero(is_stored)
            terms = self._curvature_terms(distance, factors)
            blocks.append(
                BandBlock(
                    -distance,
                    rows[is_stored],
                    columns=columns[is_stored],
                    lower_positions=source[is_stored],
                    terms=terms,
                    full_positions=entries,
                )
            )
        return blocks

    def _curvature_terms(self, distance: int, factors: Factors) -> list[BlockTerm]:
        """Terms of the block between rows at a distance in time."""
        p = self.dynamics.state_weights
        q = self.dynamics.tables.q / self.dynamics.step_s
        terms = []
        for i in range(self.dynamics.largest_lag + 1 - distance):
            pair = factors(p[:, i], q[:, i], p[:, i + distance], q[:, i + distance])
            if any(each.any() for each in pair):
                terms.append(
                    BlockTerm(i, *(shifted_back(self.length_m**2 * each, i) for each in pair))
                )
        return terms

    def constraint_hessian_values(
        self,
        x: Array,
        phi: Array,
        equations: EquationsAtParameters,
        weights: RowWeights,
        loss_weight: float,
        values: Array,
        lifted_histories: Sequence[WeightedHistory] = (),
    ) -> tuple[Array, list[Array]]:
        """Second derivatives of multipliers · c of this transcription, in scaled variables.

        The priors of φ are included, times `loss_weight`, for those φ that no earlier experiment
        has; the priors of q are not.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        phi : (k,) array
            Nuisance parameters in units of their priors.
        weights : RowWeights
            Weights of the constraints, see `lagrangian_weights`.
        loss_weight : float
            Factor of the priors.
        values : (hessian.nnz,) array
            Derivatives in the columns of x, in the order of `hessian`; overwritten.
        lifted_histories : sequence of (history, array)
            History variables that are lifted, each with the weights μ_k of its values h_k in the
            Lagrangian, Σ μ_k h_k.

        Returns
        -------
        ((nq, nq) array, list of arrays)
            Second derivatives by q, and the values of `constraint_hessian_entries`.
        """
        dynamics = equations.dynamics
        band = self.hessian
        by_x, twice = self.motion_hessian_values(x, equations, weights, values, lifted_histories)
        of_q = self.length_m * by_x[..., : self.nq]
        values[band.top_positions] = of_q.reshape(band.top_positions.shape)
        by_phi = np.diag(2 * loss_weight * self.nuisance_indices.is_first)  # the prior
        of_motion = twice[self.nq :, self.nq :]
        if equations.prescribed.depends_on_phi:
            of_goals = np.zeros((self.grid_times, self.dof_count))
            by_time = weights.multipliers.reshape(self.constraint_times, self.constraints_per_time)
            of_goals[dynamics.first_row :, self.constrained_dofs] = -by_time / self.length_m
            grasped = ~np.isnan(equations.prescribed.positions_m)
            of_goals = np.where(grasped, of_goals[:, equations.prescribed.dofs], 0.0)
            of_motion = of_motion + self.prescribed_motion.weighted_hessian(phi, of_goals)
        by_phi[np.ix_(self.nuisance.motion_indices, self.nuisance.motion_indices)] += of_motion
        of_states = self.length_m * by_x[..., self.state_dependent_nuisance].ravel()
        of_pairs = by_phi[np.triu_indices(len(by_phi))]
        further = [twice[: self.nq, self.nq :].ravel(), of_states, of_pairs]
        return twice[: self.nq, : self.nq], further

    def motion_hessian_values(
        self,
        x: Array,
        equations: EquationsAtParameters,
        weights: RowWeights,
        values: Array,
        lifted_histories: Sequence[WeightedHistory] = (),
    ) -> tuple[Array, Array]:
        """Write the second derivatives by x to `values`, in the order of `hessian` without its rows
        of q, and return those by (x, p), (N, 3n, m) [1/m], and by p, (m, m), for the parameters p of
        the equations; arguments as of `constraint_hessian_values`.

        Those through prescribed positions are not included.
        """
        curvature = self._curvature(
            x, equations, weights=weights.forces, lifted_histories=lifted_histories
        )
        self.hessian.fill(
            values,
            curvature.position_position,
            b=curvature.position_velocity,
            threads=self.body.threads,
        )
        if curvature.velocity_velocity.size:
            rates = curvature.velocity_velocity
            self._rate_hessian.fill(values, rates, b=rates, threads=self.body.threads)
        skew = full_skew_values(self.experiment.sparsity, curvature.position_velocity_skew)
        if skew.size:
            self._skew_hessian.fill(values, skew, b=skew, threads=self.body.threads)
        return equations.weighted_second_derivatives(x, curvature, row_weights=weights.rows)

    def _curvature(
        self,
        x: Array,
        equations: EquationsAtParameters,
        weights: Array,
        lifted_histories: Sequence[WeightedHistory],
    ) -> SecondDerivatives:
        """Return second derivatives of Σ weights · F and Σ μ · h; overwritten by the next call."""
        dynamics = equations.dynamics
        forces = dynamics.forces
        xi, nu = dynamics.all_evaluation_states(x)
        for history, mu in lifted_histories:
            forces = history.with_variable_weights(forces, mu)
        curvature = forces.weighted_hessian(xi, nu, weights=weights, out=self._curvature_buffer)
        for history, mu in lifted_histories:
            history.add_curvature(curvature, mu)
        return curvature

    @cached_property
    def state_dependent_nuisance(self) -> Index:
        """Indices in (q, φ that change the motion), see `dynamic_parameters`, of the nuisance
        parameters for which the equations of motion have mixed second derivatives with positions or
        velocities.
        """
        return self.nq + np.flatnonzero(self.inputs.is_coupled_to_state[self.nq :])

    @cached_property
    def _curvature_buffer(self) -> Array:
        """Work space (N, width) for second derivatives; overwritten by each evaluation."""
        return np.zeros((self.grid_times, self.dynamics.forces.body.curvature_width))

    def find_hessian_diagonal(self) -> Index:
        """Return the positions (N · 3n,) of the diagonal entries of x in the values of `hessian`."""
        dofs = np.arange(self.dof_count)
        return self.hessian.positions(
            np.arange(self.grid_times), 0, rows=dofs, columns=dofs
        ).ravel()

    def constraint_hessian_entries(self, first_phi: int) -> list[tuple[Index, Index]]:
        """Return rows and columns in z of the Hessian's entries besides those of `hessian` and of q
        with q, upper triangle.

        The list has three groups: the motion by q and φ; the motion by x and φ; φ by φ. An entry
        may occur in several groups; the values of all are summed.

        Parameters
        ----------
        first_phi : int
            Index in z where the nuisance parameters of all experiments begin.
        """
        of_x = self.offsets.variable + np.arange(self.variable_count)
        of_phi = first_phi - self.nq + self.nuisance_indices.indices
        moving = of_phi[self.nuisance.motion_indices]
        states = moving[self.state_dependent_nuisance - self.nq]
        pairs = np.triu_indices(len(of_phi))
        entries = [
            (np.repeat(np.arange(self.nq), len(moving)), np.tile(moving, self.nq)),
            (np.repeat(of_x, len(states)), np.tile(states, len(of_x))),
            (of_phi[pairs[0]], of_phi[pairs[1]]),
        ]
        # Experiments that share a φ need not have them in the same order.
        return [(np.minimum(*each), np.maximum(*each)) for each in entries]


def _state_factors(p: Array, q: Array, p_second: Array, q_second: Array) -> tuple[Array, Array]:
    """Return the coefficients of ∂²φ/∂x² and ∂²φ/∂x∂v in the block of two positions."""
    return p * p_second, p * q_second + q * p_second
