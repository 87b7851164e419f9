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

from ...common.array_types import Array, Index
from ...errors import InputError
from ...methods.callbacks import NlpFunctions, TimedFunction
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
    vectors less one, and the other limits (both ≤ 0).

    Parameters
    ----------
    program : PlannedProgram
        The optimal-control problem.

    Raises
    ------
    InputError
        If the body or a force has history variables, or the body has limits.
    """

    def __init__(self, program: PlannedProgram) -> None:
        self.program = program
        self.driven = program.driven
        self.collocation = program.driven.collocation
        if self.collocation.has_eliminated_histories or program.body_limits is not None:
            raise InputError(
                "interior-point supports neither memory of a body or force, nor limits of [avoid]; "
                "expected reduced-space",
                None,
                where="--solver",
            )
        transcription = self.driven.transcription
        self.length_m = transcription.length_m
        self.position_count = transcription.variable_count
        self.variable_count = self.position_count + program.space.size
        self.motion_count = self.collocation.constraint_count
        limits = program.hand_limits
        self.limit_count = len(limits.names)
        self.vector_count = len(limits.t_s) * len(limits.at_time.vector_names)
        self.constraint_count = self.motion_count + self.limit_count
        per_time = transcription.constraints_per_time
        place = np.searchsorted(transcription.constrained_dofs, self.driven.dofs)
        times = np.arange(transcription.constraint_times)
        self._grasp_times = slice(transcription.dynamics.first_row, None)
        self._grasp_rows: Index = (times[:, None] * per_time + place).ravel()

    # Variables ------------------------------------------------------------------------------------

    def pack(self, c: Array, x: Array) -> Array:
        """Return the variables of unknowns c (c,) and a motion x (N, 3n) [m]."""
        return np.concatenate([x.ravel() / self.length_m, c])

    def unpack(self, w: Array) -> tuple[Array, Array]:
        """Return the unknowns c (c,) and the motion x (N, 3n) [m] of variables."""
        x = self.length_m * w[: self.position_count]
        return w[self.position_count :], x.reshape(len(self.program.grid_since_s), -1)

    def _point(self, w: Array) -> Array:
        """Return the variables of the collocation program, with the parameters of the plan."""
        return np.concatenate([self.driven.q, w[: self.position_count]])

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
        return np.concatenate([by_x, 2 * by_jerk.T @ (by_jerk @ c + jerk)])

    # Constraints ----------------------------------------------------------------------------------

    def constraint_values(self, w: Array) -> Array:
        """Return the constraints (constraints,)."""
        c, _ = self.unpack(w)
        rows = self.collocation.constraint_values(self._point(w))
        rows[self._grasp_rows] -= self._shift(c)
        return np.concatenate([rows, self._limits(c)[0]])

    def constraints_and_jacobian(self, w: Array, out: Array | None = None) -> tuple[Array, Array]:
        """Return the constraints, and the values of their Jacobian in the order of
        `jacobian_structure`, written to `out` if given.
        """
        c, _ = self.unpack(w)
        rows, values = self.collocation.constraints_and_jacobian(self._point(w))
        rows[self._grasp_rows] -= self._shift(c)
        limits, by_c = self._limits(c)
        drive = self.program.drive(c).by_control[self._grasp_times]
        of_grasps = drive.reshape(len(self._grasp_rows), -1) / -self.length_m
        columns = np.concatenate([of_grasps, by_c]).T.ravel()
        result = np.empty(len(self.jacobian_structure[1])) if out is None else out
        result[:] = np.concatenate([values[self._first_entry :], columns])
        return np.concatenate([rows, limits]), result

    def jacobian(self, w: Array) -> sp.csc_array:
        """Return the Jacobian (constraints, variables)."""
        indptr, indices = self.jacobian_structure
        values = self.constraints_and_jacobian(w)[1]
        shape = (self.constraint_count, self.variable_count)
        return sp.csc_array((values, indices, indptr), shape=shape)

    @cached_property
    def jacobian_structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of the Jacobian."""
        indptr, indices = self.collocation.jacobian_structure
        size = self.program.space.size
        first = self._first_entry
        in_column = np.concatenate(
            [self._grasp_rows, self.motion_count + np.arange(self.limit_count)]
        )
        of_x = indptr[self.collocation.nq :] - first
        ends = of_x[-1] + len(in_column) * np.arange(1, size + 1)
        return np.concatenate([of_x, ends]), np.concatenate(
            [indices[first:], np.tile(in_column, size)]
        )

    @property
    def _first_entry(self) -> int:
        """Number of entries of the columns of q, which come first in the collocation program."""
        return int(self.collocation.jacobian_structure[0][self.collocation.nq])

    def _shift(self, c: Array) -> Array:
        """Return the scaled displacement of the prescribed positions from those of the standing
        hand, of each constraint of the grasps.
        """
        moved = self.program.drive(c).goals_m - self.driven.stated_goals_m
        return moved[self._grasp_times].ravel() / self.length_m

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
        upper = np.arange(1, self.program.space.size + 1)
        of_x = self._keys % self.position_count
        counts = np.bincount(self._keys // self.position_count, minlength=self.position_count)
        of_c = [self.position_count + np.arange(count) for count in upper]
        indptr = np.concatenate([[0], np.cumsum(np.concatenate([counts, upper]))])
        return indptr, np.concatenate([of_x, *of_c])

    @cached_property
    def _motion_entries(self) -> tuple[Index, Index]:
        """Entries of the collocation program's Hessian in rows and columns of x, and the key of
        each: column · position_count + row.
        """
        indptr, rows = self.collocation.hessian_structure
        columns = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
        nq = self.collocation.nq
        chosen = np.flatnonzero((rows >= nq) & (columns >= nq))
        return chosen, (columns[chosen] - nq) * self.position_count + rows[chosen] - nq

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
        return np.unique(np.concatenate([self._motion_entries[1], self._objective_entries[0]]))

    def hessian_values(self, w: Array, weight: float, multipliers: Array, out: Array) -> None:
        """Write the upper triangle of the Hessian of weight · objective + multipliers · constraints
        to `out`, in the order of `hessian_structure`.
        """
        c, _ = self.unpack(w)
        of_motion = multipliers[: self.motion_count]
        of_x = np.zeros(len(self._keys))
        chosen, keys = self._motion_entries
        values = self.collocation.hessian_values(self._point(w), 0.0, multipliers=of_motion)
        np.add.at(of_x, np.searchsorted(self._keys, keys), values[chosen])
        keys, values = self._objective_entries
        np.add.at(of_x, np.searchsorted(self._keys, keys), weight * values)
        by_jerk, _ = self.program.effort
        of_c = 2 * weight * by_jerk.T @ by_jerk
        of_c += self._grasp_hessian(c, of_motion) + self._limit_hessian(
            c, multipliers[self.motion_count :]
        )
        rows, columns = np.tril_indices(len(c))  # the upper triangle, column by column
        out[:] = np.concatenate([of_x, of_c[rows, columns]])

    def _grasp_hessian(self, c: Array, multipliers: Array) -> Array:
        """Return Σ multipliers · ∂²constraint/∂c² (c, c) of the prescribed positions."""
        program = self.program
        matrix, constant = program.coordinates_at_grid
        weights = np.zeros((len(constant), len(self.driven.dofs)))
        by_time = multipliers[self._grasp_rows].reshape(-1, len(self.driven.dofs))
        weights[self._grasp_times] = by_time / -self.length_m
        planned = weights[:, program.planned_columns].reshape(len(constant), -1, 3)
        curvature = program.frame.weighted_hessian(matrix @ c + constant, planned)
        return np.einsum("tic,tij,tjd->cd", matrix, curvature, matrix, optimize=True)

    def _limit_hessian(self, c: Array, multipliers: Array) -> Array:
        """Return Σ multipliers · ∂²constraint/∂c² (c, c) of the limits of the hand."""
        limits = self.program.hand_limits
        of_vectors = multipliers[: self.vector_count].reshape(len(limits.t_s), -1)
        of_rows = multipliers[self.vector_count :].reshape(len(limits.t_s), -1)
        states = limits.matrix @ c + limits.constant
        stacked = np.concatenate([states, of_vectors, of_rows], axis=1).T
        values = self._limit_curvature(stacked).full().reshape(18, len(limits.t_s), 18)
        curvature = values.transpose(1, 0, 2)
        return np.einsum("tic,tij,tjd->cd", limits.matrix, curvature, limits.matrix, optimize=True)

    @cached_property
    def _limit_curvature(self) -> ca.Function:
        """Second derivatives (18, 18) of the weighted limits by the state of the hand, at all times."""
        at_time = self.program.hand_limits.at_time
        counts = len(at_time.vector_names), len(at_time.row_names)
        data = ca.SX.sym("data", 18 + sum(counts))
        state, of_vectors, of_rows = ca.vertsplit(data, [0, 18, 18 + counts[0], data.numel()])
        squares = ca.sum1(ca.reshape(at_time.vectors(state), 3, -1) ** 2).T
        total = ca.dot(of_vectors, squares) + ca.dot(of_rows, at_time.rows(state))
        hessian = ca.densify(ca.hessian(total, state)[0])
        return ca.Function("limits", [data], [hessian]).map(len(self.program.hand_limits.t_s))


def solve_full(
    program: PlannedProgram,
    start: PlanAnswer,
    tolerance: float = TOLERANCE,
    iterations: int = MOST_ITERATIONS,
    watch: Watch | None = None,
) -> PlanAnswer:
    """Solve a plan by IPOPT; Ctrl-C, and a search without an answer, keep the initial plan.

    Parameters
    ----------
    program : PlannedProgram
        The problem.
    start : PlanAnswer
        Initial plan.
    tolerance : float
        IPOPT's tolerance of the scaled optimality conditions.
    iterations : int
        Largest number of iterations.
    watch : callable, optional
        Called with the number of each iterate and its objective.

    Raises
    ------
    InputError
        If the body or a force has history variables, or the body has limits.
    """
    full = FullProgram(program)
    errors: list[BaseException] = []
    functions = NlpFunctions(cast(Any, full), full.hessian_values, errors)
    w = ca.MX.sym("w", full.variable_count)
    value, rows = functions.nlp(w, ca.MX(0, 1))
    seen = itertools.count(len(start.history))

    def report(outputs: list[Array], _: object) -> None:
        if watch is not None:
            watch(next(seen), float(outputs[1][0]))

    # Variables, objective, constraints, and the multipliers of bounds, constraints and parameters.
    sizes = [full.variable_count, 1, full.constraint_count, full.variable_count]
    outputs = [ca.Sparsity.dense(size) for size in (*sizes, full.constraint_count, 0)]
    monitor = TimedFunction("monitor", outputs, [ca.Sparsity.dense(1)], report, errors)
    options = {
        "iteration_callback": monitor,
        "print_time": False,
        "error_on_fail": False,
        "show_eval_warnings": False,
        "no_nlp_grad": True,
        "jac_g": functions.function("jac_g", "g", "jac_g"),
        "grad_f": functions.function("grad_f", "f", "grad_f"),
        "hess_lag": functions.function("hess_lag", "triu_hess"),
        "ipopt.linear_solver": "mumps",
        "ipopt.tol": tolerance,
        "ipopt.max_iter": iterations,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.option_file_name": "",  # IPOPT reads ipopt.opt of the working folder otherwise
        "ipopt.mu_init": INITIAL_BARRIER,
        "ipopt.bound_push": INITIAL_DISTANCE,
        "ipopt.bound_frac": INITIAL_DISTANCE,
    }
    solver = ca.nlpsol("plan", "ipopt", {"x": w, "f": value, "g": rows}, options)
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
    multipliers = found["lam_g"].full().ravel()[full.motion_count :]
    multipliers[full.vector_count :] /= 2
    history = [float(value) for value in solver.stats()["iterations"]["obj"]]
    return PlanAnswer(c, x, multipliers, "converged", [*start.history, *history])
