"""Solve linearised equations of motion forward and backward in time, one time step after the other.

The Jacobian c_x is block lower-triangular in time. With one factorisation per time step, c_x Y = −R
(forward) and c_xᵀ y = −g (backward) are solved without ever forming the whole matrix. With G =
∂F/∂ξ and C = ∂F/∂ν at evaluation t (see `model.schemes`), one step forward is the tangent of one
step of the scheme:

    −A Y_t = R_t + w_0 F' + Σ_{j≥1} w_j dF_{t−j} − M Σ_{i≥1} s_i Y_{t−i} / Δt²,
    F' = F_R + G Σ_{i≥1} p_i Y_{t−i} + C Σ_{i≥1} q_i Y_{t−i} / Δt,
    −A = −∂c_t/∂x_t = −w_0 (p_0 G + q_0 C / Δt) + s_0 M / Δt²,

and dF_t, the change of the force, follows from the row itself. For the feasibility step p, R is c
and F_R is zero; for the sensitivities Z = dx/dp, R is zero and F_R is ∂F/∂p. Grasped dofs whose
displacement depends on parameters have prescribed rows of Y. With material memory, F' includes the
force due to the history variables, see `model.viscoelasticity`.

Use `Sweep.forward` for Gauss–Newton steps, `Sweep.sensitivities` where memory is scarce, and
`Sweep.backward` for gradients (adjoint method).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array, Index
from ..common.limits import require_time
from ..common.step_counting import StepUnit, complete_steps
from ..errors import SimulationError
from ..fem.body import Linearisation
from ..model.dynamics import Dynamics, StencilRow, weighted_sum_of_past
from ..model.equations_at_parameters import EquationsAtParameters
from ..model.force_internal_variables import ForceForwardColumns
from ..model.internal_variables import AnyHistory
from ..model.viscoelasticity import MemoryForwardColumns
from .forward.retraction import Retraction
from .linear_algebra.block_band import Submatrix
from .linear_algebra.factorisation import Choice, Factor, Factoriser
from .linear_algebra.lapack import one_blas_thread
from .linear_algebra.reused_factor import (
    MEASURED_COLUMNS,
    FactorSequence,
    Matrix,
    NodeRotation,
    ReusedFactor,
    relative_cost,
)
from .reactions.forces import GraspForces
from .stopwatch import Stopwatch
from .transcription import Transcription

if TYPE_CHECKING:
    from ..fem.kernels.skyline import FactorMemory

# Largest size of the element results and factors that are stored at a time [bytes].
CHUNK_BYTES = 128e6
# Largest number of time steps with skyline factors that are stored at a time. They reuse memory:
# allocating it again costs half as much as a factorisation.
LARGEST_CHUNK_ROWS = 16
# Cost of a factorisation for each thread, in solutions, above which factors are reused in later
# time steps: the reuse costs about one more solution, and the factorisations are not concurrent.
LEAST_COST_OF_FACTOR = 1.5
# Number of earlier time steps from which the solution of the next one is extrapolated, and the
# weights of their solutions, latest first, by the number of those that exist.
EXTRAPOLATION = ((), (1.0,), (2.0, -1.0), (3.0, -3.0, 1.0))


@dataclass(frozen=True, eq=False)
class SweepResult:
    """Feasibility step and sensitivities of one experiment at given positions and parameters.

    Attributes
    ----------
    x : (N, 3n) array
        Positions [m], before the feasibility step.
    step : (N, 3n) array
        Feasibility step p = −c_x⁻¹ c [m].
    by_p : (N, 3n, m) array
        Sensitivities Z = −c_x⁻¹ c_p to the m parameters that change the motion [m].
    violation_n : float
        Largest |c| [N].
    indefinite_count : int
        Number of time steps whose matrix −∂c_t/∂x_t is not positive definite.
    last : ForwardState
        State of the substitution, to continue with later rows.
    grasp_forces : GraspForces
        Forces on the dofs of instrumented grasps, with their changes along the step (column 0) and
        by p.
    """

    x: Array
    step: Array
    by_p: Array
    violation_n: float
    indefinite_count: int
    last: ForwardState
    grasp_forces: GraspForces


@dataclass(frozen=True, eq=False)
class ForwardState:
    """State of a forward substitution: all that the next row depends on, most recent row first."""

    # tuple of (3n, c) arrays: Y_{t−i} for i = 1, 2, … up to the largest lag.
    solutions: tuple[Array, ...]
    # tuple of (free, c) arrays: force changes dF_{t−j} for j = 1, 2, ….
    increments: tuple[Array, ...]
    # tuple of (free,) arrays: total forces F_{t−j} at the evaluations [N].
    forces: tuple[Array, ...] = ()
    # Columns of the history variables, body first, then forces; empty without any.
    history_columns: tuple[Array, ...] = ()


class FactorisedStep(NamedTuple):
    """Linearised and factorised equations of one time step."""

    t: int  # index of the grid time
    row: StencilRow  # coefficients of the scheme, with the time step in q and s, and masses
    force: Array  # (3n,): force F at the evaluation [N]
    # (m,): lower triangles of the symmetric parts of G = ∂F/∂ξ and C = ∂F/∂ν, in the order of the
    # sparsity pattern.
    by_position: Array
    by_velocity: Array
    # Factorised matrix −∂c_t/∂x_t on the free dofs. If it is a `ReusedFactor`, the time steps must
    # be solved in their order.
    factor: Factor
    # Lower triangles of the skew parts of G and C; empty where there is none.
    skew: Array
    rate_skew: Array


@dataclass(frozen=True, eq=False)
class PrescribedColumns:
    """Prescribed rows of the solution Y: changes of the displacements of grasped dofs."""

    dofs: Index  # (g,): grasped dofs whose displacement changes
    # (N, g, c): changes of their positions [m]: the step to the prescribed position, and
    # derivatives by φ.
    columns: Array
    is_prescribed: NDArray[np.bool_]  # (N, g) of bool: whether a dof is prescribed at a grid time

    @classmethod
    def from_columns(cls, sweep: Sweep, dofs: Index, columns: Array) -> PrescribedColumns:
        """Build the prescribed rows of dofs (g,) that change by `columns` (N, g, c) [m].

        A dof counts as prescribed at the times at which a grasp of `sweep` holds it; `columns` is
        not copied.
        """
        return cls(
            dofs,
            columns,
            is_prescribed=sweep.dynamics.is_temporarily_prescribed[:, dofs]
            | ~np.isin(dofs, sweep.free),
        )

    def write_into(self, t: int, solution: Array) -> None:
        """Write the rows of the dofs that are prescribed at grid time t into `solution` (3n, c), in
        place; other rows are kept.
        """
        prescribed = self.is_prescribed[t]
        solution[self.dofs[prescribed]] = self.columns[t, prescribed]

    def forces(self, sweep: Sweep, rows: slice, at: Linearisation) -> Array:
        """Return the contributions (p_0 G + q_0 C) U_t (k, free, c) [N] of the prescribed changes U_t
        at k time steps to the changes of the force on the free dofs.
        """
        now = np.where(self.is_prescribed[rows, :, None], self.columns[rows], 0.0)
        # Columns of parameters that do not move grasps are zero.
        changed = np.flatnonzero(now.any(axis=(0, 1)))
        forces = np.zeros((len(now), len(sweep.free), now.shape[-1]))
        if len(changed):
            now = now[..., changed]
            p, q = (each[rows, :1, None] for each in _tables(sweep.dynamics))
            forces[..., changed] = _force_changes(sweep.prescribed_block, at, p * now, q * now)
        return forces


@dataclass(frozen=True, eq=False)
class SweepColumns:
    """Right-hand sides of a forward substitution."""

    equations: EquationsAtParameters  # equations of motion at the parameters
    count: int  # number of columns
    # Whether the last columns are derivatives by the parameters that change the motion; otherwise
    # only prescribed changes act.
    has_parameters: bool = True
    has_step: bool = False  # whether the first column is the feasibility step
    # Prescribed changes of grasped dofs; None if their displacements are fixed.
    prescribed: PrescribedColumns | None = None
    # (3n, c) or None: changes of given start positions [m]; None if they are fixed.
    start_m: Array | None = None

    @classmethod
    def by_parameters(
        cls, sweep: Sweep, equations: EquationsAtParameters, x: Array | None = None
    ) -> SweepColumns:
        """Build the columns of all parameters that change the motion
        (`Transcription.dynamic_parameters`), with the changes of grasps that depend on φ.

        Parameters
        ----------
        sweep : Sweep
            The sweep that uses them.
        equations : EquationsAtParameters
            Equations of motion at the parameters.
        x : (N, 3n) array, optional
            Positions [m]. If given, the feasibility step from x is prepended as column 0.
        """
        first = int(x is not None)
        count = len(sweep.transcription.dynamic_parameters)
        grasped = None
        if equations.prescribed.depends_on_phi:
            prescribed = equations.prescribed
            goals = prescribed.positions_m[: sweep.dynamics.row_count]
            columns = np.zeros((*goals.shape, first + count))
            columns[..., first + sweep.transcription.nq :] = prescribed.by_phi[: len(goals)]
            if x is not None:
                columns[..., 0] = np.nan_to_num(goals - x[:, prescribed.dofs])
            grasped = PrescribedColumns.from_columns(sweep, prescribed.dofs, columns=columns)
        return cls(equations, first + count, has_step=x is not None, prescribed=grasped)

    @classmethod
    def from_prescribed(
        cls, sweep: Sweep, equations: EquationsAtParameters, changes_m: Array
    ) -> SweepColumns:
        """Build the columns of prescribed changes `changes_m` (N, g, c) of the grasped dofs [m],
        those of `equations.prescribed`, at constant parameters.
        """
        grasped = PrescribedColumns.from_columns(
            sweep, equations.prescribed.dofs, columns=changes_m
        )
        return cls(equations, grasped.columns.shape[-1], has_parameters=False, prescribed=grasped)

    def right_hand_sides(
        self,
        rows: slice,
        linearisation: Linearisation,
        acceleration: Array,
        residual: Array | None,
        free: Index,
    ) -> tuple[Array, Array]:
        """Returns
        -------
        (k, free, c) array
            R: the residual in the first column, −∂(M a)/∂p in those of parameters; otherwise zero.
        (k, 3n, c) array
            F_R: ∂F/∂p in the columns of parameters, otherwise zero.
        """
        count, size = acceleration.shape
        right, force = (np.zeros((count, k, self.count)) for k in (len(free), size))
        if residual is not None:
            right[..., 0] = residual
        if self.has_parameters:
            first = int(self.has_step)
            force[..., first:] = self.equations.force_derivatives(rows, linearisation.by_theta)
            right[..., first:] -= self.equations.inertia_derivatives(
                rows, acceleration[:, free], dofs=free
            )
        return right, force

    def input_derivatives(self, t: int) -> Array:
        """Return the derivatives (U, c) of the U inputs at evaluation t by the columns;
        zeros for the feasibility step.
        """
        by_parameters = self.equations.input_derivatives[t]
        if not self.has_parameters:
            return np.zeros((len(by_parameters), self.count))
        of_step = np.zeros((len(by_parameters), int(self.has_step)))
        return np.hstack([of_step, by_parameters])


class Sweep:
    """Forward and backward substitution in time for the first rows of one experiment.

    A copy in another process computes its tables again and has a new stopwatch.

    Parameters
    ----------
    transcription : Transcription
        Transcription of the experiment.
    rows : int, optional
        Number of grid times to use; None means all.
    stopwatch : Stopwatch, optional
        Accumulates the time spent; a new one by default.
    factorisation : {"auto", "band", "sparse", "supernodal"}
        Choice of factorisation, see `program.linear_algebra.factorisation`.
    """

    def __init__(
        self,
        transcription: Transcription,
        rows: int | None = None,
        stopwatch: Stopwatch | None = None,
        factorisation: Choice = "auto",
    ) -> None:
        self.stopwatch = stopwatch or Stopwatch()
        self.factorisation: Choice = factorisation
        self.dynamics = transcription.dynamics.truncated_to(rows or transcription.grid_times)
        self.transcription = transcription
        self.body = transcription.body
        self.pattern = transcription.experiment.sparsity
        self.free = transcription.free_dofs
        self.sensed = transcription.sensed_dofs
        self.factoriser = Factoriser.cached(self.pattern, self.free, choice=factorisation)
        self.matrix = Submatrix(self.pattern, self.free)
        self.prescribed_block = Submatrix(
            self.pattern, self.free, columns=transcription.prescribed_motion.dofs
        )
        self.of_sensed = Submatrix(self.pattern, self.sensed)
        self._has_temporary_grasps = bool(self.dynamics.is_temporarily_prescribed.any())
        # It moves surfaces off the obstacles that hold them, and is that of solids.
        self.has_retraction = self.body.is_solid and not transcription.experiment.obstacles

    @cached_property
    def retraction(self) -> Retraction:
        """Retraction of changes of positions, with the dofs that grasps always hold prescribed."""
        prescribed = np.ones(self.pattern.size, dtype=bool)
        prescribed[self.free] = False
        return Retraction(self.body, prescribed.reshape(-1, 3))

    def __reduce__(self) -> tuple[type[Sweep], tuple[Transcription, int, None, Choice]]:
        return Sweep, (self.transcription, self.dynamics.row_count, None, self.factorisation)

    @one_blas_thread()
    def forward(
        self,
        x: Array,
        equations: EquationsAtParameters,
        known: SweepResult | None = None,
        similar: SweepResult | None = None,
        resultants: Array | None = None,
    ) -> SweepResult:
        """Compute the feasibility step p and the sensitivities Z at all grid times of this sweep.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        equations : EquationsAtParameters
            Equations of motion at the parameters.
        known : SweepResult, optional
            Result for the first rows at the same positions and parameters; it is continued, not
            modified.
        similar : SweepResult, optional
            Result at other parameters and positions, not modified. Its sensitivities are the first
            guess of solutions that are refined, which need fewer corrections then.
        resultants : (N − first row, any) array, optional
            Changes of the resultants of a rod [J] in the derivatives by position, see
            `newton_linearisation`.

        Raises
        ------
        SimulationError
            If the equations of a time step are singular or not finite.
        """
        sweep_columns = SweepColumns.by_parameters(self, equations, x=x)
        columns = np.zeros((*x.shape, sweep_columns.count))
        grasp_forces = GraspForces.zeros(len(x), len(self.sensed), columns=sweep_columns.count)
        march = ForwardSubstitution(
            self,
            sweep_columns,
            last=known.last if known else None,
            grasp_forces=grasp_forces,
            similar=None if similar is None else similar.by_p,
            resultants=resultants,
        )
        if known is not None:
            done = len(known.step)
            columns[:done, :, 0] = known.step
            columns[:done, :, 1:] = known.by_p
            march.violation_n = known.violation_n
            march.indefinite = known.indefinite_count
            grasp_forces.copy_first_rows(known.grasp_forces)
        for _ in march.iterate_rows(x, 0 if known is None else len(known.step), out=columns):
            pass
        return SweepResult(
            x,
            step=columns[:, :, 0],
            by_p=columns[:, :, 1:],
            violation_n=march.violation_n,
            indefinite_count=march.indefinite,
            last=march.copy_state(),
            grasp_forces=grasp_forces,
        )

    def sensitivities(
        self, x: Array, equations: EquationsAtParameters, grasp_forces: GraspForces | None = None
    ) -> Iterator[Array]:
        """Iterate over the sensitivities Z_t (3n, m) row by row, keeping only the last few rows in
        memory.

        Rows before the first equation of motion are yielded as zero. The arrays must not be
        modified, because later rows depend on them. Nothing is computed before the iteration.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        equations : EquationsAtParameters
            Equations of motion at the parameters.
        grasp_forces : GraspForces, optional
            Filled in place with the forces on instrumented grasps and their sensitivities.

        Raises
        ------
        SimulationError
            During the iteration, if the equations of a time step are singular or not finite.
        """
        return ForwardSubstitution(
            self, SweepColumns.by_parameters(self, equations), grasp_forces=grasp_forces
        ).iterate_rows(x)

    @one_blas_thread()
    def backward(self, x: Array, equations: EquationsAtParameters, gradient: Array) -> Array:
        """Solve the adjoint equations c_xᵀ y = −`gradient` backward in time.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        equations : EquationsAtParameters
            Equations of motion at the parameters.
        gradient : (N, 3n) array
            Gradient of a scalar by the positions [1/m]; not modified.

        Returns
        -------
        (N, 3n) array
            Multipliers y of the equations of motion [1/N]; zero at prescribed dofs and in rows
            without an equation.

        Raises
        ------
        SimulationError
            If the equations of a time step are singular or not finite.
        """
        reach = self.dynamics.largest_lag
        free = self.free
        y = np.zeros_like(x)
        remaining = -gradient[:, free]  # what is left for the rows that are still to come
        histories = self.dynamics_at(equations).histories(x)
        later = deque[StencilRow](maxlen=reach)
        adjoints = [history.adjoint() for history in histories]
        for _, _, steps in self.chunks(x, equations, backward=True, histories=histories):
            for step in reversed(steps):
                t = step.t
                row = step.row
                p = row.p
                q = row.q
                mass = row.mass_kg[free]
                by_state = by_rate = 0.0
                for own in (each.state_gradient() for each in adjoints):
                    by_state = by_state + own[0][free]
                    by_rate = by_rate + own[1][free]
                known = np.zeros(x.shape[1])
                for j, other in enumerate(later, 1):
                    known += other.w[j] * y[t + j]
                known[self.dynamics.is_temporarily_prescribed[t]] = 0
                remaining[t] -= p[0] * by_state + q[0] * by_rate
                if known.any():
                    by_position = self.matrix.extract(step.by_position, -step.skew) @ known
                    remaining[t] -= p[0] * by_position
                    remaining[t] -= q[0] * (
                        self.matrix.extract(step.by_velocity, -step.rate_skew) @ known
                    )
                # (w_0 (p_0 G + q_0 C) − s_0 M) y_t = what is left; the factor is of its negative.
                right = self.without_prescribed(t, remaining[t])
                y[t, free] = -self.solve(step, right, transposed=True)
                force_weight = known + row.w[0] * y[t]
                by_position = self.matrix.extract(step.by_position, -step.skew) @ force_weight
                by_position += by_state
                by_velocity = self.matrix.extract(step.by_velocity, -step.rate_skew) @ force_weight
                by_velocity += by_rate
                for each in adjoints:
                    each.step_back(force_weight)
                for i in range(1, min(reach, t) + 1):
                    remaining[t - i] -= p[i] * by_position + q[i] * by_velocity
                    remaining[t - i] += row.s[i] * mass * y[t, free]
                later.appendleft(row)
        return y

    def without_prescribed(self, t: int, rows: Array) -> Array:
        """Set rows (free, …) of grid time t to zero, in place, where a grasp that holds for a part
        of the time prescribes the dof; return `rows`.
        """
        if self._has_temporary_grasps:
            rows[self.dynamics.is_temporarily_prescribed[t, self.free]] = 0
        return rows

    def choose_chunk_rows(self) -> int:
        """Return the number of time steps that are linearised and factorised at a time: as many as
        `CHUNK_BYTES` allow, but at least one for each thread.
        """
        rows = self.dynamics.row_count
        # Each thread has one to factorise, however large it is.
        least = min(self.body.threads, rows)
        most = min(rows, int(CHUNK_BYTES / self._estimate_step_bytes()))
        if self.factoriser.skyline:
            most = min(most, LARGEST_CHUNK_ROWS)
        return max(least, most)

    def estimate_chunk_bytes(self) -> int:
        """Return the memory of one chunk [bytes]."""
        factor_bytes = self._estimate_factor_bytes() if self.reuses_factors else 0
        return self.choose_chunk_rows() * self._estimate_step_bytes() + factor_bytes

    def _estimate_step_bytes(self) -> int:
        """Memory of a step [bytes]: element results, and factor or matrix."""
        results_bytes = 8 * self.body.linearisation_width
        if self.reuses_factors:
            parts = 1 + self.body.is_unsymmetric
            return results_bytes + 8 * parts * self.pattern.entry_count
        return results_bytes + self._estimate_factor_bytes()

    def _estimate_factor_bytes(self) -> int:
        """Memory of a factor [bytes], unsymmetric if the body's is."""
        solver = self.factoriser
        values = (
            solver.estimate_unsymmetric_factor_size()
            if self.body.is_unsymmetric
            else solver.estimate_factor_size()
        )
        bytes_each = 4 if self.has_single_precision else 8
        return int(bytes_each * solver.memory_ratio * values)

    @property
    def has_single_precision(self) -> bool:
        """Whether factors have single precision and solutions are refined: those of large bodies in
        motion, whose masses make the matrices well conditioned.
        """
        return not self.dynamics.is_static and self.factoriser.has_single_precision

    @property
    def reuses_factors(self) -> bool:
        """Whether a factor is used for several time steps, see `linear_algebra.reused_factor`: of
        bodies so large that a factorisation costs several solutions even if every thread computes
        one.
        """
        if not self.has_single_precision:
            return False
        cost = relative_cost(self.factoriser, MEASURED_COLUMNS)
        return cost > LEAST_COST_OF_FACTOR * self.body.threads

    def solve(
        self,
        step: FactorisedStep,
        right: Array,
        transposed: bool = False,
        guess: Array | None = None,
    ) -> Array:
        """Return the solution of the system of a time step for right-hand sides (free,) or (free,
        c), in the same shape.

        Parameters
        ----------
        step : FactorisedStep
            The time step; if factors are reused, steps must be solved in their order.
        right : (free,) or (free, c) array
            Right-hand sides; not modified.
        transposed : bool
            Whether to solve with the transposed matrix.
        guess : (free, c) array, optional
            Guess of the solution; only used if factors are reused.

        Raises
        ------
        SimulationError
            If the matrix is singular or not finite.
        """
        if not isinstance(step.factor, ReusedFactor):
            return step.factor.solve(right, transposed=transposed)
        try:
            return step.factor.solve(right, transposed=transposed, guess=guess)
        except np.linalg.LinAlgError as error:
            time_s = float(self.dynamics.t_s[step.t])
            raise self._singular(error, time_s) from error

    def dynamics_at(self, equations: EquationsAtParameters) -> Dynamics:
        """Return the discrete equations of motion of `equations`, truncated to the grid times of
        this sweep.
        """
        return equations.dynamics.truncated_to(self.dynamics.row_count)

    def chunks(
        self,
        x: Array,
        equations: EquationsAtParameters,
        backward: bool = False,
        first: int = 0,
        histories: Sequence[AnyHistory] = (),
        resultants: Array | None = None,
    ) -> Iterator[tuple[slice, Linearisation, list[FactorisedStep]]]:
        """Iterate over the linearised and factorised time steps, a few at a time, using threads:
        their grid times, their forces and derivatives, and an entry for each row, ascending.

        A chunk is valid until the next one is computed, because factors reuse memory.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        equations : EquationsAtParameters
            Equations of motion at the parameters.
        backward : bool
            If true, yield the last chunk first; the steps within a chunk are still in ascending
            order.
        first : int
            Index of the grid time to begin with; rows without an equation are skipped.
        histories : sequence of histories
            History variables at x; empty if there are none.
        resultants : (N − first row, any) array, optional
            See `forward`.

        Raises
        ------
        SimulationError
            If a matrix is singular or not finite.
        """
        dynamics = self.dynamics_at(equations)
        xi, nu = dynamics.evaluation_states(x)
        starts = range(max(first, dynamics.first_row), dynamics.row_count, self.choose_chunk_rows())
        sequence = (
            FactorSequence(self.factoriser, NodeRotation(self.free, self.pattern.size // 3))
            if self.reuses_factors
            else None
        )
        buffers = [
            self.factoriser.allocate(1 + self.body.is_unsymmetric)
            for _ in range(self.choose_chunk_rows())
        ]
        for start in reversed(starts) if backward else starts:
            here = slice(start, min(start + self.choose_chunk_rows(), dynamics.row_count))
            evaluations = slice(start - dynamics.first_row, here.stop - dynamics.first_row)
            with self.stopwatch.evaluating():
                at = dynamics.forces_with_histories(histories, here).linearise(
                    xi[evaluations], nu[evaluations]
                )
                if resultants is not None:
                    change = self.body.resultant_stiffness(
                        xi[evaluations], resultants[evaluations], dynamics.theta
                    )
                    at.by_position[:] -= dynamics.forces.joint_pattern.expand(change)
            with self.stopwatch.solving():
                rows = [StencilRow.from_dynamics(dynamics, t) for t in range(start, here.stop)]
                matrix = partial(
                    self._matrix,
                    rows=rows,
                    linearisation=at,
                    is_prescribed=dynamics.is_temporarily_prescribed[here],
                )
                factors: Sequence[Factor] = (
                    self._factorise(
                        matrix, len(rows), time_s=float(dynamics.t_s[start]), buffers=buffers
                    )
                    if sequence is None
                    else [
                        ReusedFactor(sequence, Matrix(*matrix(k)), points_m=points_m.reshape(-1, 3))
                        for k, points_m in enumerate(xi[evaluations])
                    ]
                )
            steps = map(
                FactorisedStep,
                range(start, here.stop),
                rows,
                at.force,
                at.by_position,
                at.by_velocity,
                factors,
                at.by_position_skew,
                at.by_velocity_skew,
            )
            yield here, at, list(steps)

    def _factorise(
        self,
        matrix: Callable[[int], tuple[Array, Array]],
        count: int,
        time_s: float,
        buffers: Sequence[FactorMemory | None] = (),
    ) -> list[Factor]:
        """Return the factors of −∂c_t/∂x_t of some rows, computed on several threads."""
        try:
            return self.factoriser.factorise_each(
                matrix,
                count,
                threads=self.body.threads,
                buffers=buffers,
                is_single=self.has_single_precision,
            )
        except np.linalg.LinAlgError as error:
            raise self._singular(error, time_s) from error

    def _singular(self, error: np.linalg.LinAlgError, time_s: float) -> SimulationError:
        """Return the error for the user that the equations at a time [s] cannot be solved."""
        return SimulationError(
            f"experiment '{self.transcription.experiment.name}': the linearised equations of motion "
            f"cannot be solved ({error}); check mass, units and grasps, or give other guesses",
            time_s,
        )

    def _matrix(
        self,
        k: int,
        rows: list[StencilRow],
        linearisation: Linearisation,
        is_prescribed: NDArray[np.bool_],
    ) -> tuple[Array, Array]:
        """Return the lower triangles (m,) of the symmetric and of the skew part of −∂c_t/∂x_t of
        row k of some rows; the latter is empty if there is no such part.

        A dof that a grasp prescribes for a part of the time has, at these times, only a diagonal
        entry of the mean size of the diagonal.
        """
        pattern = self.pattern
        values = rows[k].block(
            linearisation.by_position[k], linearisation.by_velocity[k], pattern=pattern
        )
        skew = rows[k].skew_block(
            linearisation.by_position_skew[k], linearisation.by_velocity_skew[k]
        )
        if is_prescribed[k].any():
            size = np.abs(values[pattern.diagonal]).mean()
            removed = is_prescribed[k][pattern.rows] | is_prescribed[k][pattern.columns]
            values[removed] = 0
            values[pattern.diagonal[is_prescribed[k]]] = size
            if skew.size:
                skew[removed] = 0
        return values, skew


class ForwardSubstitution:
    """Forward substitution of several columns, row by row.

    Attributes
    ----------
    violation_n : float
        Largest residual of the equations of motion so far [N]; 0 without a feasibility step.
    indefinite : int
        Number of time steps so far whose matrix is not positive definite.

    Parameters
    ----------
    solver : Sweep
        Factorised time steps.
    columns : SweepColumns
        Right-hand sides.
    last : ForwardState, optional
        State after earlier rows; by default there are none.
    grasp_forces : GraspForces, optional
        Filled in place with the forces on instrumented grasps; ignored if there are none.
    similar : (N, 3n, m) array, optional
        Sensitivities at other parameters, as a guess of the last m columns; not modified.
    resultants : (N − first row, any) array, optional
        See `Sweep.forward`.
    """

    def __init__(
        self,
        solver: Sweep,
        columns: SweepColumns,
        last: ForwardState | None = None,
        grasp_forces: GraspForces | None = None,
        similar: Array | None = None,
        resultants: Array | None = None,
    ) -> None:
        self.solver = solver
        self._resultants = resultants
        self._similar = similar
        # Solutions of the last rows minus similar ones, latest first.
        self._deviations = deque[Array](maxlen=len(EXTRAPOLATION) - 1)
        self.columns = columns
        self.grasp_forces = grasp_forces if len(solver.sensed) else None
        self.violation_n = 0.0
        self.indefinite = 0
        size = solver.pattern.size
        reach = solver.dynamics.largest_lag
        self.shape = (size, columns.count)
        self._of_free = (len(solver.free), columns.count)
        nothing = (np.zeros(shape) for shape in (self.shape, self._of_free, len(solver.free)))
        solutions, increments, forces = ((each,) * reach for each in nothing)
        last = last or ForwardState(solutions, increments, forces=forces)
        self.past = deque(last.solutions, maxlen=reach)
        self.past_increments = deque(last.increments, maxlen=reach)
        self.past_forces = deque(last.forces, maxlen=reach)
        # Also where these rows do not: they may be continued.
        self.weighs_past = bool(solver.transcription.dynamics.tables.w[:, 1:].any())
        self.internal_states: list[MemoryForwardColumns | ForceForwardColumns] = []
        self._known = last.history_columns

    def copy_state(self) -> ForwardState:
        """Return the state that later rows depend on; its arrays are not copied."""
        return ForwardState(
            solutions=tuple(self.past),
            increments=tuple(self.past_increments),
            forces=tuple(self.past_forces),
            history_columns=tuple(each.columns for each in self.internal_states),
        )

    def iterate_rows(self, x: Array, done: int = 0, out: Array | None = None) -> Iterator[Array]:
        """Iterate over the solutions Y_t (3n, c) from row `done` on; the state is advanced in
        place.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        done : int
            Number of rows that are known already.
        out : (N, 3n, c) array, optional
            The solution of each row with an equation is written into it, in place, and yielded as a
            view. By default new arrays are yielded.

        Raises
        ------
        SimulationError
            If the equations of a time step are singular or not finite.
        """
        solver = self.solver
        columns = self.columns
        setting = self.columns.equations
        dynamics = solver.dynamics_at(setting)
        first = solver.dynamics.first_row
        histories = dynamics.histories(x)
        acceleration = dynamics.acceleration(x)
        known = self._known or [None] * len(histories)
        pairs = zip(histories, known, strict=True)
        self.internal_states = [
            each.forward_columns(columns.input_derivatives, done, known=own) for each, own in pairs
        ]
        for t in range(done, first):  # the start is given
            for each in self.internal_states:
                each.advance(partial(np.zeros, self.shape), partial(np.zeros, self.shape))
            start = np.zeros(self.shape) if columns.start_m is None else columns.start_m.copy()
            if columns.prescribed is not None:
                columns.prescribed.write_into(t, start)
            self.past.appendleft(start)
            yield np.zeros(self.shape) if columns.start_m is None else start
        for rows, linearisation, steps in solver.chunks(
            x, setting, first=done, histories=histories, resultants=self._resultants
        ):
            residual = None
            if columns.has_step:
                residual = np.stack([self._residual(s, acceleration[s.t]) for s in steps])
                self.violation_n = max(self.violation_n, float(np.abs(residual).max(initial=0.0)))
            rights, forces = columns.right_hand_sides(
                rows,
                linearisation,
                acceleration=acceleration[rows],
                residual=residual,
                free=solver.free,
            )
            on_free = forces.take(solver.free, axis=1)
            if columns.prescribed is not None:
                on_free += columns.prescribed.forces(solver, rows, linearisation)
            solutions = np.zeros((len(steps), *self.shape)) if out is None else out[rows]
            past = [*reversed(self.past)]
            for step, right, force, forced, solution in zip(
                steps, rights, forces, on_free, solutions, strict=True
            ):
                with solver.stopwatch.solving():
                    self.solve_step(step, right, force=force, forced=forced, out=solution)
                self.indefinite += not step.factor.positive_definite
                complete_steps(StepUnit.TIME_STEP)
                require_time()
            if self.grasp_forces is not None:
                self._store_grasp_forces(
                    self.grasp_forces,
                    rows,
                    linearisation,
                    forces=forces,
                    solutions=np.stack([*past, *solutions]),
                )
            yield from solutions

    def _residual(self, step: FactorisedStep, acceleration: Array) -> Array:
        """Return c_t on the free dofs (free,) [N], from the acceleration (3n,) of the row [m/s²];
        zero while a grasp prescribes the dof.

        It stores the force, which later rows need: call it once for every row, in ascending order.
        """
        solver = self.solver
        row = step.row
        force = solver.without_prescribed(step.t, step.force[solver.free])
        total = row.w[0] * force - (row.mass_kg * acceleration)[solver.free]
        if self.weighs_past:
            total += weighted_sum_of_past(row.w, self.past_forces, shape=force.shape)
            self.past_forces.appendleft(force)
        return solver.without_prescribed(step.t, total)

    def solve_step(
        self, step: FactorisedStep, right: Array, force: Array, forced: Array, out: Array
    ) -> None:
        """Solve one row, store Y_t in `out`, and advance the state to the next row.

        Parameters
        ----------
        step : FactorisedStep
            The factorised time step.
        right : (free, c) array
            R_t; modified.
        force : (3n, c) array
            F_R; the change of the force by internal variables is added.
        forced : (free, c) array
            F_R on the free dofs, with the force of prescribed changes; modified.
        out : (3n, c) array
            Y_t, overwritten.
        """
        t = step.t
        solver = self.solver
        prescribed = self.columns.prescribed
        row = step.row
        free = solver.free
        w = row.w
        s = row.s
        mass = row.mass_kg.take(free)[:, None]
        if self.weighs_past:
            right += weighted_sum_of_past(w, self.past_increments, shape=self._of_free)
        right -= mass * weighted_sum_of_past(s, self.past, shape=self.shape).take(free, axis=0)
        for each in self.internal_states:
            change = each.force_columns()
            force += change
            forced += change.take(free, axis=0)
        forced += self._past_force(step, row)
        solver.without_prescribed(t, right)
        solver.without_prescribed(t, forced)
        similar = self._similar_solution(step)
        solution = solver.solve(step, right + w[0] * forced, guess=self._guess(similar))
        if isinstance(step.factor, ReusedFactor):
            self._deviations.appendleft(solution - similar)
        if self.weighs_past:
            self.past_increments.appendleft((s[0] * mass * solution - right) / w[0])
        out[free] = solution
        if prescribed is not None:
            prescribed.write_into(t, out)
        for each in self.internal_states:
            each.advance(
                partial(self._stencil_sum, row.p, out), partial(self._stencil_sum, row.q, out)
            )
        self.past.appendleft(out)

    def _similar_solution(self, step: FactorisedStep) -> Array | float:
        """Columns (free, c) of the similar solution; 0 without."""
        if self._similar is None or not isinstance(step.factor, ReusedFactor):
            return 0.0
        similar = np.zeros(self._of_free)
        sensitivities = self._similar[step.t].take(self.solver.free, axis=0)
        similar[:, similar.shape[1] - sensitivities.shape[1] :] = sensitivities
        return similar

    def _guess(self, similar: Array | float) -> Array | None:
        """Return a guess (free, c) of the solution of the next row: the similar one, (free, c) or
        0, with the extrapolated deviations of the last rows from theirs; None if there are neither.
        """
        weights = EXTRAPOLATION[len(self._deviations)]
        terms = [
            weight * deviation for weight, deviation in zip(weights, self._deviations, strict=True)
        ]
        if isinstance(similar, float) and not terms:
            return None
        return np.asarray(sum(terms, start=similar))

    def _store_grasp_forces(
        self,
        grasp_forces: GraspForces,
        rows: slice,
        at: Linearisation,
        forces: Array,
        solutions: Array,
    ) -> None:
        """Store F_t and its changes on instrumented grasps at k time steps, from F_R (k, 3n, c) and
        Y (lags + k, 3n, c).
        """
        solver = self.solver
        dofs = solver.sensed
        # The first results are of earlier rows, and not used.
        places = np.arange(rows.stop - len(solutions), rows.stop)
        state, rate = (
            solver.dynamics.combine(table.take(places, axis=0, mode="clip"), solutions)[
                -len(forces) :
            ]
            for table in _tables(solver.dynamics)
        )
        grasp_forces.force[rows] = at.force[:, dofs]
        grasp_forces.changes[rows] = forces[:, dofs] + _force_changes(
            solver.of_sensed, at, state, rate
        )

    def _stencil_sum(self, weights: Sequence[float], solution: Array) -> Array:
        """Return Σ_i weights[i] Y_{t−i} (3n, c) with Y_t = `solution`."""
        return weights[0] * solution + weighted_sum_of_past(weights, self.past, shape=self.shape)

    def _past_force(self, step: FactorisedStep, row: StencilRow) -> Array | float:
        """Return the change of force G Σ p_i Y_{t−i} + C Σ q_i Y_{t−i} of earlier rows, i ≥ 1,
        (free, c) [N], with as few products as possible; 0 if the row has no such lag.
        """
        matrix = self.solver.matrix
        if not row.nonzero_lags:
            return 0.0
        if len(row.nonzero_lags) == 1:
            (i,) = row.nonzero_lags
            block = row.p[i] * step.by_position
            block += row.q[i] * step.by_velocity
            return (
                matrix.extract(block, row.skew(i, step.skew, by_velocity_skew=step.rate_skew))
                @ self.past[i - 1]
            )
        past = weighted_sum_of_past(row.q, self.past, shape=self.shape)
        total = matrix.extract(step.by_velocity, step.rate_skew) @ past
        if any(row.p[1:]):
            past = weighted_sum_of_past(row.p, self.past, shape=self.shape)
            total += matrix.extract(step.by_position, step.skew) @ past
        return total


def _tables(dynamics: Dynamics) -> tuple[Array, Array]:
    """Return the coefficients p and q (N, lags), the latter with the time step included."""
    return dynamics.tables.p, dynamics.tables.q / dynamics.step_s


def _force_changes(block: Submatrix, at: Linearisation, states: Array, rates: Array) -> Array:
    """Return G dξ + C dν (T, k, c) in a block, from dξ and dν (T, …, c)."""
    return block.products(at.by_position, at.by_position_skew, states) + block.products(
        at.by_velocity, at.by_velocity_skew, rates
    )
