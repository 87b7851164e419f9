"""Interior point: the whole NLP to IPOPT, with exact sparse derivatives from the assembly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import BeforeValidator

from ..arrays import Array
from ..checked import Count, Finite, NotNegative, Positive, Text, Whole
from ..nlp.collocation import Collocation
from . import nlpsol
from .callbacks import NlpFunctions
from .method import Watch
from .options import Options
from .recorder import Recorder
from .solution import Solution, Status


def _ipopt_value(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise ValueError(
            f"found {str(value).lower()}; expected text or a number, as IPOPT's manual has it: its "
            'switches are "yes" and "no"'
        )
    return value


IpoptValue = Annotated[Text | Whole | Finite, BeforeValidator(_ipopt_value)]

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
class InteriorPoint(Options):
    """Interior point, by IPOPT.

    Attributes
    ----------
    hessian : {"exact", "gauss-newton", "limited-memory"}
        Second derivatives of the Lagrangian: all of them once parameters move by less than
        `warm_up`, the loss's only, or IPOPT's own.
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
        Iterations after which it ends.
    max_time_s : float
        Seconds after which it ends.
    ipopt : mapping
        Further IPOPT options by name; they win over the ones above.
    """

    name: ClassVar[str] = "interior-point"

    hessian: Literal["exact", "gauss-newton", "limited-memory"] = "exact"
    warm_up: NotNegative = 0.1
    proximal: NotNegative = 1e-5
    linear_solver: Text = "mumps"
    tolerance: Positive = 1e-8
    max_iterations: Count = 200
    max_time_s: Positive = 1e6
    ipopt: Mapping[str, IpoptValue] = field(default_factory=dict)

    def __call__(
        self, collocation: Collocation, watch: Watch | None = None, start: Array | None = None
    ) -> Solution:
        """Solve the NLP, see `Method`.

        Raises
        ------
        InputError
            If IPOPT does not know an option.
        """
        recorder = Recorder(self.name, collocation, watch)

        def hessian(program: Collocation) -> _DampedHessian:
            return _DampedHessian(program, self)

        found = nlpsol.solve(recorder, start, "ipopt", hessian, self._settings, IPOPT_STATUS)
        if found.said == "Invalid_Option":
            recorder.notes.append(
                f"linear_solver = '{self.linear_solver}' needs a library that is not installed; "
                "'mumps' and 'spral' come with CasADi"
            )
        return recorder.solution(
            found.status,
            f"{found.status.sentence} (IPOPT: {found.said})",
            found.z,
            found.multipliers,
            found.iterations,
            found.evaluations,
        )

    def _settings(self, functions: NlpFunctions) -> dict[str, Any]:
        settings: dict[str, Any] = {
            "ipopt.linear_solver": self.linear_solver,
            "ipopt.tol": self.tolerance,
            "ipopt.max_iter": self.max_iterations,
            "ipopt.max_wall_time": self.max_time_s,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.nlp_scaling_method": "none",  # the NLP is scaled already
            "jac_g": functions.function("jac_g", "g", "jac_g"),
            "grad_f": functions.function("grad_f", "f", "grad_f"),
        }
        if self.linear_solver == "mumps":  # METIS ordering, no scaling: a little faster here
            settings |= {"ipopt.mumps_pivot_order": 5, "ipopt.mumps_scaling": 0}
        if self.hessian == "limited-memory":
            settings["ipopt.hessian_approximation"] = "limited-memory"
        else:
            settings["hess_lag"] = functions.function("hess_lag", "triu_hess")
        return settings | {f"ipopt.{name}": value for name, value in self.ipopt.items()}


class _DampedHessian:
    """Hessian of the Lagrangian with the warm-up and proximal terms of the options."""

    def __init__(self, collocation: Collocation, options: InteriorPoint) -> None:
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
