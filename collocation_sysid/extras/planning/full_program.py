"""Solution of a plan as one nonlinear program: positions of all nodes and the motion of the hand are
variables, the equations of motion and the limits of the hand constraints. IPOPT solves it with exact
first and second derivatives.

The reduced space of the hand gives the initial point. Both solvers find the same motion; this one
has no need of sweeps, and its derivatives come from other code.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cached_property
from typing import Any, cast

import casadi as ca
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ...errors import InputError
from ...methods.nlpsol import create_solver, ipopt_settings
from ...program.casadi_functions import NlpFunctions, TimedFunction
from .path_terms import keyed_entries
from .planned_program import PlannedProgram
from .reduced_solver import PlanAnswer, Watch

# IPOPT's tolerance of the scaled optimality conditions, and its largest number of iterations.
TOLERANCE, MOST_ITERATIONS = 1e-9, 300
# Initial barrier parameter, and distance of the initial point from the limits: it is near the answer.
INITIAL_BARRIER, INITIAL_DISTANCE = 1e-5, 1e-6


class FullProgram:
    """Values and derivatives of the nonlinear program of a plan.

    Variables are the scaled positions x (N · 3n,) and then the unknowns c of the hand. Constraints
    are the scaled equations of motion and prescribed positions (= 0), the squared norms of limited
    vectors less one, the other limits of the hand, and those of the path (all ≤ 0).

    Parameters
    ----------
    program : PlannedProgram
        The optimal-control problem.

    Raises
    ------
    InputError
        See `require_full_program`.
    """

    def __init__(self, program: PlannedProgram) -> None:
        self.program = program
        self.driven = program.driven
        require_full_program(program)
        self.transcription = self.driven.transcription
        self.length_m = self.transcription.length_m
        self.position_count = self.transcription.variable_count
        self.variable_count = self.position_count + program.space.size
        self.motion_count = self.transcription.constraint_count
        limits = program.hand_limits
        self.limit_count = len(limits.names)
        self.vector_count = len(limits.t_s) * len(limits.at_time.vector_names)
        self.path_count = 0
        if program.path_limits is not None:
            self.path_count = program.path_limits.value_count
        self.constraint_count = self.motion_count + self.limit_count + self.path_count

    # Variables ------------------------------------------------------------------------------------

    def pack(self, c: Array, x: Array) -> Array:
        """Return the variables of unknowns c (c,) and a motion x (N, 3n) [m]."""
        return np.concatenate([x.ravel() / self.length_m, c])

    def unpack(self, w: Array) -> tuple[Array, Array]:
        """Return the unknowns c (c,) and the motion x (N, 3n) [m] of variables."""
        x = self.length_m * w[: self.position_count]
        return w[self.position_count :], x.reshape(len(self.program.grid_since_s), -1)

    # Objective ------------------------------------------------------------------------------------

    def objective(self, w: Array) -> float:
        """Return the objective at variables."""
        return self.program.objective(*self.unpack(w))

    def gradient(self, w: Array) -> Array:
        """Return the gradient (variables,) of the objective."""
        c, x = self.unpack(w)
        matrix, target = self.program.residuals
        by_jerk, jerk = self.program.effort
        by_x = 2 * self.length_m * (matrix.T @ (matrix @ x.ravel() - target))
        if self.program.path_costs is not None:
            values, slopes = self.program.path_costs.linearise(x)
            by_x = by_x + 2 * self.length_m * (slopes.T @ values.ravel())
        return np.concatenate([by_x, 2 * by_jerk.T @ (by_jerk @ c + jerk)])

    # Constraints ----------------------------------------------------------------------------------

    def constraint_values(self, w: Array) -> Array:
        """Return the constraints (constraints,)."""
        c, x = self.unpack(w)
        equations = self.driven.equations(self.program.drive(c).without_controls)
        rows = self.transcription.constraint_values(x, equations)
        path = self.program.path_limits
        of_path = np.zeros(0) if path is None else path.evaluate(x).ravel()
        return np.concatenate([rows, self._limits(c)[0], of_path])

    def constraints_and_jacobian(self, w: Array, out: Array | None = None) -> tuple[Array, Array]:
        """Return the constraints, and the values of their Jacobian in the order of
        `jacobian_structure`, written to `out` if given.
        """
        c, x = self.unpack(w)
        equations = self.driven.equations(self.program.drive(c))
        forces = equations.dynamics.linearise(x, self.transcription.linearisation_buffer)
        of_x = np.zeros(self.transcription.motion_rows.structure.nnz)
        rows, of_motion = self.transcription.constraints_and_jacobian(
            x, equations, forces=forces, values=of_x
        )
        limits, of_limits = self._limits(c)
        by_hand = np.concatenate([of_motion, of_limits, np.zeros((self.path_count, len(c)))])
        by_c = by_hand.T[self._depends_on_c]
        result = np.empty(len(self.jacobian_structure[1])) if out is None else out
        path, of_path, by_x = self.program.path_limits, np.zeros(0), of_x
        if path is not None:
            values, slopes = path.linearise(x)
            of_path = values.ravel()
            keys, entries = keyed_entries(self.length_m * slopes)
            by_path = np.zeros(len(self._path_keys))
            by_path[np.searchsorted(self._path_keys, keys)] = entries
            by_x = np.concatenate([of_x, by_path])[self._columns_of_x[2]]
        result[:] = np.concatenate([by_x, by_c])
        return np.concatenate([rows, limits, of_path]), result

    def jacobian(self, w: Array) -> sp.csc_array:
        """Return the Jacobian (constraints, variables)."""
        indptr, indices = self.jacobian_structure
        values = self.constraints_and_jacobian(w)[1]
        shape = (self.constraint_count, self.variable_count)
        return sp.csc_array((values, indices, indptr), shape=shape)

    @cached_property
    def jacobian_structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of the Jacobian."""
        pointers, rows, _ = self._columns_of_x
        ends = len(rows) + np.cumsum(self._depends_on_c.sum(axis=1))
        return (
            np.concatenate([pointers, ends]),
            np.concatenate([rows, np.nonzero(self._depends_on_c)[1]]),
        )

    @cached_property
    def _path_keys(self) -> Index:
        """Keys of the entries of the limits of the path, ascending."""
        path = self.program.path_limits
        return (
            np.zeros(0, np.int64) if path is None else np.sort(keyed_entries(path.patterns[0])[0])
        )

    @cached_property
    def _columns_of_x(self) -> tuple[Index, Index, Index]:
        """Column pointers and rows of the entries by x, and their places among the entries of the
        motion followed by those of the limits of the path.
        """
        motion = self.transcription.motion_rows.structure
        if not self.path_count:
            return motion.indptr, motion.indices, np.arange(motion.nnz)
        columns, rows = np.divmod(self._path_keys, self.path_count)
        all_columns = np.concatenate(
            [np.repeat(np.arange(self.position_count), np.diff(motion.indptr)), columns]
        )
        all_rows = np.concatenate([motion.indices, self.motion_count + self.limit_count + rows])
        places = np.lexsort([all_rows, all_columns])
        counts = np.bincount(all_columns, minlength=self.position_count)
        return np.concatenate([[0], np.cumsum(counts)]), all_rows[places], places

    @cached_property
    def _depends_on_c(self) -> NDArray[np.bool_]:
        """Whether each constraint depends on each unknown, (c, constraints): prescribed positions on
        those of the hand, equations of motion on those of the signals, limits on all.
        """
        moves_hand = self.program.space.moves_hand[:, None]
        of_motion = moves_hand == self.transcription.is_grasp_constraint
        of_limits = np.ones((len(moves_hand), self.limit_count), dtype=bool)
        of_path = np.zeros((len(moves_hand), self.path_count), dtype=bool)
        return np.concatenate([of_motion, of_limits, of_path], axis=1)

    def _limits(self, c: Array) -> tuple[Array, Array]:
        """Return the limits of the hand as smooth constraints, and their derivatives (k, c)."""
        near = self.program.hand_limits.linearise(c)
        squares = np.sum(near.vectors**2, axis=1) - 1
        slopes = 2 * np.einsum("ki,kic->kc", near.vectors, near.vector_slopes)
        return np.concatenate([squares, near.rows]), np.concatenate([slopes, near.row_slopes])

    # Second derivatives ---------------------------------------------------------------------------

    @cached_property
    def hessian_structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of the upper triangle of the Lagrangian's Hessian."""
        of_x = self._keys % self.position_count
        counts = np.bincount(self._keys // self.position_count, minlength=self.position_count)
        of_c = [
            np.arange(0 if is_coupled else self.position_count, self.position_count + number)
            for number, is_coupled in enumerate(~self.program.space.moves_hand, 1)
        ]
        indptr = np.cumsum([0, *counts, *map(len, of_c)])
        return indptr, np.concatenate([of_x, *of_c])

    @cached_property
    def _motion_entries(self) -> tuple[Index, Index]:
        """Entries of the transcription's Hessian in rows of x, and the key of each: column ·
        position_count + row.
        """
        structure, nq = self.transcription.hessian, self.transcription.nq
        columns = np.repeat(np.arange(self.position_count), np.diff(structure.indptr))
        chosen = np.flatnonzero(structure.indices >= nq)
        rows = structure.indices[chosen] - nq
        return chosen, columns[chosen] * self.position_count + rows

    @cached_property
    def _objective_entries(self) -> tuple[Index, Array]:
        """Keys and values of the upper triangle of the objective's Hessian by x."""
        matrix, _ = self.program.residuals
        product = sp.coo_array(sp.triu(2 * self.length_m**2 * (matrix.T @ matrix)))
        rows, columns = (each.astype(np.int64) for each in product.coords)
        return columns * self.position_count + rows, np.asarray(product.data, dtype=np.float64)

    @cached_property
    def _keys(self) -> Index:
        """Keys of all entries by x, ascending."""
        terms = (self.program.path_costs, self.program.path_limits)
        of_path = [keyed_entries(sp.triu(t.patterns[1]))[0] for t in terms if t is not None]
        return np.unique(
            np.concatenate([self._motion_entries[1], self._objective_entries[0], *of_path])
        )

    @cached_property
    def _places(self) -> tuple[Index, Index]:
        """Places of the entries of the motion, and of the objective, among all entries by x."""
        return (
            np.searchsorted(self._keys, self._motion_entries[1]),
            np.searchsorted(self._keys, self._objective_entries[0]),
        )

    def hessian_values(self, w: Array, weight: float, multipliers: Array, out: Array) -> None:
        """Write the upper triangle of the Hessian of weight · objective + multipliers · constraints
        to `out`, in the order of `hessian_structure`.
        """
        c, x = self.unpack(w)
        of_motion = multipliers[: self.motion_count]
        values = np.zeros(self.transcription.hessian.nnz)
        by_x, by_c = self.transcription.motion_hessian_values(
            x,
            self.driven.equations(self.program.drive(c)),
            self.transcription.lagrangian_weights(of_motion),
            values,
        )
        of_x = np.zeros(len(self._keys))
        places_of_motion, places_of_objective = self._places
        of_x[places_of_motion] += values[self._motion_entries[0]]
        of_x[places_of_objective] += weight * self._objective_entries[1]
        self._add_path_hessian(x, weight, multipliers[self.motion_count + self.limit_count :], of_x)
        by_jerk, _ = self.program.effort
        of_c = by_c + 2 * weight * by_jerk.T @ by_jerk
        of_c += self._grasp_hessian(c, of_motion) + self._limit_hessian(
            c, multipliers[self.motion_count : self.motion_count + self.limit_count]
        )
        mixed = self.length_m * by_x.reshape(self.position_count, -1)
        columns = [
            np.concatenate([mixed[:0 if moves_hand else None, k], of_c[: k + 1, k]])
            for k, moves_hand in enumerate(self.program.space.moves_hand)
        ]  # fmt: skip
        out[:] = np.concatenate([of_x, *columns])

    def _add_path_hessian(self, x: Array, weight: float, multipliers: Array, of_x: Array) -> None:
        """Add the second derivatives of the costs and limits of the path to those by x."""
        costs, limits = self.program.path_costs, self.program.path_limits
        found = []
        if costs is not None:
            values, slopes = costs.linearise(x)
            curvature = costs.weighted_hessian(x, values)
            found.append(2 * weight * (slopes.T @ slopes + curvature))
        if limits is not None:
            found.append(limits.weighted_hessian(x, multipliers.reshape(-1, limits.t_s.shape[1])))
        for each in found:
            keys, entries = keyed_entries(sp.triu(self.length_m**2 * each))
            of_x[np.searchsorted(self._keys, keys)] += entries

    def _grasp_hessian(self, c: Array, multipliers: Array) -> Array:
        """Return Σ multipliers · ∂²constraint/∂c² (c, c) of the prescribed positions."""
        program, transcription = self.program, self.transcription
        matrix, constant = program.coordinates_at_grid
        weights = np.zeros((len(constant), transcription.dof_count))
        by_time = multipliers.reshape(transcription.constraint_times, -1) / -self.length_m
        weights[transcription.dynamics.first_row :, transcription.constrained_dofs] = by_time
        planned = weights[:, self.driven.dofs[program.planned_columns]]
        curvature = program.frame.weighted_hessian(
            matrix @ c + constant, planned.reshape(len(constant), -1, 3)
        )
        return np.einsum("tic,tij,tjd->cd", matrix, curvature, matrix, optimize=True)

    def _limit_hessian(self, c: Array, multipliers: Array) -> Array:
        """Return Σ multipliers · ∂²constraint/∂c² (c, c) of the limits of the hand."""
        limits = self.program.hand_limits
        of_vectors = multipliers[: self.vector_count].reshape(len(limits.t_s), -1)
        of_rows = multipliers[self.vector_count :].reshape(len(limits.t_s), -1)
        states = limits.matrix @ c + limits.constant
        stacked = np.concatenate([states, of_vectors, of_rows], axis=1).T
        size = states.shape[1]
        values = self._limit_curvature(stacked).full().reshape(size, len(limits.t_s), size)
        curvature = values.transpose(1, 0, 2)
        return np.einsum("tic,tij,tjd->cd", limits.matrix, curvature, limits.matrix, optimize=True)

    @cached_property
    def _limit_curvature(self) -> ca.Function:
        """Second derivatives of the weighted limits by coordinates and their derivatives, at all
        times.
        """
        at_time = self.program.hand_limits.at_time
        sizes = at_time.vectors.numel_in(0), len(at_time.vector_names), len(at_time.row_names)
        data = ca.SX.sym("data", sum(sizes))
        state, of_vectors, of_rows = ca.vertsplit(data, [0, *np.cumsum(sizes).tolist()])
        squares = ca.sum1(ca.reshape(at_time.vectors(state), 3, sizes[1]) ** 2).T
        total = ca.dot(of_vectors, squares) + ca.dot(of_rows, at_time.rows(state))
        hessian = ca.densify(ca.hessian(total, state)[0])
        return ca.Function("limits", [data], [hessian]).map(len(self.program.hand_limits.t_s))


def require_full_program(program: PlannedProgram) -> None:
    """Raise an `InputError` if the body or a force has history variables, the body has limits, or
    the task has information.
    """
    reasons = {
        "the body or a force has memory, whose history variables are no variables of its program":
            program.driven.collocation.has_eliminated_histories,
        "the task has [avoid], and principal stretches and distances have no second derivatives "
        "where the largest or nearest one changes": program.body_limits is not None,
        "the task has [information], which has no second derivatives": program.criterion is not None,
    }  # fmt: skip
    for reason, applies in reasons.items():
        if applies:
            raise InputError(
                f"interior-point cannot plan this: {reason}; expected reduced-space",
                None,
                where="--solver",
            )


def solve_full(
    program: PlannedProgram, start: PlanAnswer, watch: Watch | None = None
) -> PlanAnswer:
    """Solve a plan by IPOPT; Ctrl-C, and a search without an answer, keep the initial plan.

    Parameters
    ----------
    program : PlannedProgram
        The problem.
    start : PlanAnswer
        Initial plan.
    watch : callable, optional
        Called with the number of each iterate and its objective.

    Raises
    ------
    InputError
        See `require_full_program`.
    """
    full = FullProgram(program)
    errors: list[BaseException] = []
    functions = NlpFunctions(cast(Any, full), full.hessian_values, errors)
    monitor = iteration_monitor(full, watch, len(start.history), errors)
    settings = {
        **ipopt_settings(functions, "mumps", TOLERANCE, MOST_ITERATIONS),
        "iteration_callback": monitor,
        # The gradient at the initial point may be large: IPOPT would scale the jerk away.
        "ipopt.nlp_scaling_method": "none",
        "ipopt.mu_init": INITIAL_BARRIER,
        "ipopt.bound_push": INITIAL_DISTANCE,
        "ipopt.bound_frac": INITIAL_DISTANCE,
    }
    solver = create_solver("ipopt", functions, settings)
    lower = np.zeros(full.constraint_count)
    lower[full.motion_count :] = -np.inf
    try:
        found = solver(x0=full.pack(start.c, start.x), lbg=lower, ubg=0.0)
    except RuntimeError:  # of a failed callback
        found = None
    if errors and not isinstance(errors[0], KeyboardInterrupt):
        raise errors[0]
    if found is None or errors:
        return replace(start, status="interrupted" if errors else "stalled")
    status = str(solver.stats()["return_status"])
    if status not in ("Solve_Succeeded", "Solved_To_Acceptable_Level"):
        ended = "iteration limit" if status == "Maximum_Iterations_Exceeded" else "stalled"
        return replace(start, status=ended)
    c, x = full.unpack(found["x"].full().ravel())
    # Of half the objective and of the norms of vectors, as in the reduced space.
    multipliers = found["lam_g"].full().ravel()[full.motion_count :][: full.limit_count]
    multipliers[full.vector_count :] /= 2
    history = [float(value) for value in solver.stats()["iterations"]["obj"]]
    return PlanAnswer(c, x, multipliers, "converged", [*start.history, *history])


def iteration_monitor(
    full: FullProgram, watch: Watch | None, first: int, errors: list[BaseException]
) -> TimedFunction:
    """Return CasADi's callback of each iteration, which calls `watch` with numbers from `first` on
    and never asks the solver to stop.
    """
    seen = itertools.count(first)

    def report(arguments: list[Array], stops: list[Array | None]) -> None:
        if watch is not None:
            watch(next(seen), float(arguments[1][0]))
        if stops[0] is not None:
            stops[0][0] = 0.0

    # Variables, objective, constraints, and the multipliers of bounds, constraints and parameters.
    sizes = [full.variable_count, 1, full.constraint_count, full.variable_count]
    inputs = [ca.Sparsity.dense(size) for size in (*sizes, full.constraint_count, 0)]
    return TimedFunction("monitor", inputs, [ca.Sparsity.dense(1)], report, errors)
