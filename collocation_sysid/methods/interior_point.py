"""Interior point: the whole NLP to IPOPT, with exact sparse derivatives from the assembly."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import casadi as ca
import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..nlp.collocation import Collocation
from .callbacks import Monitor, NlpFunctions, Watch
from .nlpsol import build, interruptible, timing
from .solution import Solution, Status
from .start import initial_variables

Hessian = Literal["exact", "gauss-newton", "limited-memory"]

IPOPT_STATUS = {
    "Solve_Succeeded": Status.CONVERGED,
    "Solved_To_Acceptable_Level": Status.ACCEPTABLE,
    "Feasible_Point_Found": Status.ACCEPTABLE,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
    "Restoration_Failed": Status.INFEASIBLE,
    "Search_Direction_Becomes_Too_Small": Status.STALLED,
    "Diverging_Iterates": Status.DIVERGED,
    "User_Requested_Stop": Status.INTERRUPTED,
    "Maximum_Iterations_Exceeded": Status.ITERATION_LIMIT,
    "Maximum_CpuTime_Exceeded": Status.TIME_LIMIT,
    "Maximum_WallTime_Exceeded": Status.TIME_LIMIT,
    "Error_In_Step_Computation": Status.NUMERICAL_FAILURE,
    "Invalid_Number_Detected": Status.NUMERICAL_FAILURE,
    "Not_Enough_Degrees_Of_Freedom": Status.REFUSED,
    "Invalid_Problem_Definition": Status.REFUSED,
    "Invalid_Option": Status.REFUSED,
    "Insufficient_Memory": Status.REFUSED,
    "Unrecoverable_Exception": Status.NUMERICAL_FAILURE,
    "NonIpopt_Exception_Thrown": Status.NUMERICAL_FAILURE,
    "Internal_Error": Status.NUMERICAL_FAILURE,
}


# Longest step of a parameter's logarithm while warming up.
STEP_LIMIT = np.log(2.0)


@dataclass(frozen=True)
class InteriorPointOptions:
    """Options of the interior-point method.

    Attributes
    ----------
    hessian : {"exact", "gauss-newton", "limited-memory"}
        Second derivatives of the Lagrangian: all of them, the loss's only, or IPOPT's own.
    warm_up : float
        While an iteration still changes a parameter by more than this share, an exact Hessian is
        replaced by Gauss–Newton's with Levenberg's damping, which keeps every parameter within
        about a factor of two a step: far from the answer, multipliers of a large residual make
        the full Hessian indefinite and the steps wild. 0 is exact from the start.
    proximal : float
        Added to the Hessian's diagonal at the positions, most of which is zero otherwise. It
        changes the steps a little and the answer not at all, and spares the linear solver
        factorisations that rounding spoils (wrong inertia).
    linear_solver : str
        IPOPT's linear solver; the wheel brings "mumps" and "spral".
    tolerance : float
        IPOPT's `tol` on the scaled optimality conditions.
    max_iterations : int
    max_time_s : float
    ipopt : mapping
        Further IPOPT options by name; they win over the ones above.
    """

    hessian: Hessian = "exact"
    warm_up: float = 0.1
    proximal: float = 1e-5
    linear_solver: str = "mumps"
    tolerance: float = 1e-8
    max_iterations: int = 200
    max_time_s: float = 1e6
    ipopt: Mapping[str, str | int | float] = field(default_factory=dict)


def solve(
    collocation: Collocation,
    options: InteriorPointOptions | None = None,
    watch: Watch | None = None,
    start: Array | None = None,
) -> Solution:
    """Solve the NLP with IPOPT.

    Parameters
    ----------
    collocation : Collocation
    options : InteriorPointOptions, optional
    watch : callable, optional
        Called with every `Iteration`.
    start : (variables,) ndarray, optional
        Initial variables; a simulation at the guess by default.

    Returns
    -------
    Solution
        Also when it did not converge, or was interrupted (Ctrl-C): then the best iterate.

    Raises
    ------
    InputError
        If IPOPT does not know an option.
    """
    options = options or InteriorPointOptions()
    if options.hessian not in get_args(Hessian):
        known = ", ".join(get_args(Hessian))
        raise InputError(f"no hessian {options.hessian!r}; available: {known}", None, "solver")
    began = time.perf_counter()
    notes: list[str] = []
    if start is None:
        start, notes = initial_variables(collocation)
    errors: list[BaseException] = []
    functions = NlpFunctions(collocation, _DampedHessian(collocation, options), errors)
    monitor = Monitor(collocation, watch, began, errors)
    solver = _build_solver(functions, monitor, options)
    lower, upper = collocation.bounds()
    built = time.perf_counter()
    with interruptible(monitor):
        answer = solver(x0=start, lbx=lower, ubx=upper, lbg=0, ubg=0)
    if errors:
        raise errors[0]
    stats = solver.stats()
    spent = timing(functions, monitor, began, built)
    if stats["return_status"] == "Invalid_Option":
        notes.append(
            f"linear_solver = '{options.linear_solver}' needs a library that is not installed; "
            "'mumps' and 'spral' come with CasADi"
        )
    status = IPOPT_STATUS.get(stats["return_status"], Status.NUMERICAL_FAILURE)
    z, multipliers = answer["x"].full().ravel(), answer["lam_g"].full().ravel()
    if not status.converged and monitor.best is not None:
        z, multipliers = monitor.best
    return Solution(
        status=status,
        message=f"{status.sentence} (IPOPT: {stats['return_status']})",
        method="interior-point",
        collocation=collocation,
        z=z,
        multipliers=multipliers,
        iterations=int(stats.get("iter_count", len(monitor.history))),
        history=tuple(monitor.history),
        timing=spent,
        notes=tuple(notes),
        evaluations=functions.calls,
    )


def _build_solver(
    functions: NlpFunctions, monitor: Monitor, options: InteriorPointOptions
) -> ca.Function:
    settings: dict[str, Any] = {
        "ipopt.linear_solver": options.linear_solver,
        "ipopt.tol": options.tolerance,
        "ipopt.max_iter": options.max_iterations,
        "ipopt.max_wall_time": options.max_time_s,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.nlp_scaling_method": "none",  # the NLP is scaled already
        "print_time": False,
        "error_on_fail": False,
        "show_eval_warnings": False,  # a trial step that inverts an element is cut back
        "no_nlp_grad": True,
        "jac_g": functions.function("jac_g", "g", "jac_g"),
        "grad_f": functions.function("grad_f", "f", "grad_f"),
        "iteration_callback": monitor,
    }
    if options.linear_solver == "mumps":  # METIS ordering, no scaling: a little faster here
        settings |= {"ipopt.mumps_pivot_order": 5, "ipopt.mumps_scaling": 0}
    if options.hessian == "limited-memory":
        settings["ipopt.hessian_approximation"] = "limited-memory"
    else:
        settings["hess_lag"] = functions.function("hess_lag", "triu_hess")
    settings |= {f"ipopt.{name}": value for name, value in options.ipopt.items()}
    return build("ipopt", functions, settings, "IPOPT")


class _DampedHessian:
    """Hessian of the Lagrangian with the warm-up and proximal terms of the options."""

    def __init__(self, collocation: Collocation, options: InteriorPointOptions) -> None:
        self.collocation = collocation
        self.options = options
        self._last_q = np.full(collocation.nq, np.inf)
        self._of_q, self._of_x = collocation.hessian_diagonals

    def __call__(self, z: Array, weight: float, multipliers: Array, values: Array) -> None:
        """Write the values at z."""
        settled = self._is_settled(z[: self.collocation.nq])
        if not (self.options.hessian == "exact" and settled):
            multipliers = np.zeros_like(multipliers)
        self.collocation.hessian_values(z, weight, multipliers, values)
        values[self._of_x] += self.options.proximal
        if not settled:
            # With S = ∂r/∂q a step (SᵀS + κ) Δq = −Sᵀr is no longer than |r| / 2√κ.
            values[self._of_q] += weight * self.collocation.objective(z) / (2 * STEP_LIMIT**2)

    def _is_settled(self, q: Array) -> bool:
        """Whether the last step to q was short enough to end the warm-up."""
        moved = np.abs(q - self._last_q).max(initial=0.0)
        self._last_q = q.copy()
        return self.options.warm_up == 0 or bool(moved < self.options.warm_up)
