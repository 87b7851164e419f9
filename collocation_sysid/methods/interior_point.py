"""Interior-point method: IPOPT solves the complete NLP with exact sparse derivatives.

IPOPT starts from a solution by reduced space (`initial_point`) or from a simulation at the guess.
Use it where reduced space fails, because no simulation at the guess succeeds, or for contact as
complementarity.

The first-order conditions (Karush, Kuhn and Tucker) are stationarity of the Lagrangian L = f + yᵀ g,
feasibility, and complementarity of bounds. The second-order condition is that the reduced Hessian
Wᵀ ∇²L W is positive definite; the columns of W, a basis of the null space of the constraints,
are the changes of all variables per change of a parameter, along the linearised constraints. If
both hold, the solution is a strict local minimum (Nocedal and Wright, Numerical Optimization,
theorem 12.6).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import scipy.sparse.linalg as spla
from pydantic import BeforeValidator

from ..common.array_types import Array
from ..common.validated_classes import validated
from ..common.validated_types import Count, Finite, NotNegative, Positive, StrictInteger, Text
from ..errors import SimulationError, located
from ..program.casadi_functions import NlpFunctions
from ..program.collocation import BOUND_TOLERANCE, Collocation, convert_variables
from ..program.lifted.collocation import lifted_count, with_lifted_variables
from ..recording.experiment import Experiment
from . import nlpsol
from .complementarity import require_frictionless, solve_complementarity
from .condensed_program import complete_program, condense
from .loss_curvature import reduced_hessian, sensitivities, tangent_directions
from .options import MethodOptions
from .ordering import AMD, METIS, cheaper_ordering
from .solution import Solution, Status, Watch
from .solve_recorder import Recorder
from .starts.initial_point import InitialPoint, adjoint_multipliers, compute_initial_point


def _require_ipopt_value(value: Any) -> Any:
    """Booleans are refused: IPOPT has "yes" and "no"."""
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise ValueError(
            f"found {str(value).lower()}; expected text or a number as in IPOPT's manual; its "
            'switches are "yes" and "no"'
        )
    return value


IpoptValue = Annotated[Text | StrictInteger | Finite, BeforeValidator(_require_ipopt_value)]

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
class IpoptPolicy:
    """Accuracies of the matrices that IPOPT factorises, and of its start near an optimum."""

    # A row without a pivot of its own on the diagonal waits for its columns' pivots, and fills the
    # factor on the way. With a constant there a step leaves a violation of that constant times the
    # change of the multipliers, which are some hundreds. So it must be small: with 1e-9 the fit of a
    # soft bar with unknown places gains a third of the remaining distance per iteration near the
    # optimum, and hardly moves far from it.
    row_pivot: float = 1e-11
    # That of slender bodies, whose rows of strains are steeper: with 1e-11 the growth of the factor
    # leaves the inertia wrong in nearly every iteration.
    thin_row_pivot: float = 1e-8
    # Pivot tolerance of MUMPS: below the pivots that this diagonal gives, above those that rounding
    # gives in place of zero.
    pivot_tolerance: float = 1e-12
    # Number that is added to the diagonal entries of the Hessian that belong to positions, and to
    # stresses of rods, most of which would otherwise be zero. It changes the steps slightly, but not
    # the solution, and avoids factorisations that fail because of rounding (wrong inertia).
    proximal: float = 1e-5
    # Near the optimum variables stay where they are, to this distance from their bounds.
    warm_push: float = 1e-9
    # Least multiplier of a bound there: with a logarithm of 20 from its bound, a fifth of the
    # tolerance of complementarity.
    warm_multiplier: float = 1e-10
    # The barrier parameter begins there at this share of the tolerance, near where it ends.
    warm_barrier: float = 0.1
    # Least tolerance for slender bodies: rounding errors of their positions, which the rigid sections
    # multiply, change the gradient by about 2e-8.
    thin_tolerance: float = 1e-7
    # Eigenvalues of the reduced Hessian below this share of the largest are rounding.
    smallest_curvature: float = 1e-12


POLICY = IpoptPolicy()


@validated
class InteriorPoint(MethodOptions):
    """Interior-point method (IPOPT) for parameters and trajectories together.

    Attributes
    ----------
    hessian : {"exact", "gauss-newton", "limited-memory"}
        Second derivatives of the Lagrangian: all of them once parameters move by less than
        `warm_up` ("exact"), those of the loss with linearised measurements ("gauss-newton"), or
        IPOPT's own approximation ("limited-memory").
    initial : {"reduced-space", "simulation"}
        Where IPOPT starts, unless the start has multipliers, with which it begins. "reduced-space":
        near the optimum, after a solution of the same program by reduced space, with multipliers of
        its adjoint; IPOPT takes no iteration if its conditions hold there. "simulation": from a
        simulation at the guess, or from the given start, with multipliers of zero; this is also the
        fallback if reduced space finds no motion.
    warm_up : float
        While an iteration still changes a parameter by more than this share (or a nuisance
        parameter by more than this many prior deviations), the exact Hessian is replaced by that of
        Gauss–Newton with Levenberg's damping. The damping limits a step to about a factor of two in
        every parameter and decreases as steps become shorter. Far from the solution the residuals
        are large, so that the full Hessian is indefinite and its steps are too long. 0 uses the
        exact Hessian from the start.
    contact : {"energy", "complementarity"}
        Model of contact with obstacles. "energy": an energy that increases as the body approaches
        an obstacle. "complementarity": pressures are additional variables with 0 ≤ pressure ⟂ gap ≥
        0, and the product of pressure and gap is decreased in a few more solves; friction is not
        supported.
    linear_solver : str
        IPOPT's linear solver; the wheel contains "mumps" and "spral".
    tolerance : float
        IPOPT's `tol` on the scaled optimality conditions.
    max_iterations : int
        Largest number of iterations.
    max_time_s : float
        Largest computing time in seconds. A factorisation that lasts longer is abandoned after two
        further seconds, with the best iterate.
    ipopt : mapping
        Further IPOPT options by name; they override the ones above.
    """

    name: ClassVar[str] = "interior-point"

    hessian: Literal["exact", "gauss-newton", "limited-memory"] = "exact"
    initial: Literal["reduced-space", "simulation"] = "reduced-space"
    warm_up: NotNegative = 0.1
    contact: Literal["energy", "complementarity"] = "energy"
    linear_solver: Text = "mumps"
    tolerance: Positive = 1e-8
    max_iterations: Count = 200
    max_time_s: Positive = 1e6
    ipopt: Mapping[str, IpoptValue] = field(default_factory=dict)

    def require(self, experiments: Iterable[Experiment]) -> None:
        """Raise an `InputError` if contact is a complementarity and an obstacle has friction; the
        message names experiment and obstacle.
        """
        if self.contact == "complementarity":
            for each in experiments:
                with located(where=f"experiment '{each.name}'"):
                    require_frictionless(each.obstacles)

    def __call__(
        self,
        collocation: Collocation,
        watch: Watch | None = None,
        start: Array | None = None,
        multipliers: Array | None = None,
    ) -> Solution:
        """Solve the NLP from `start`, by default from the guess, as `initial` states; `watch` is
        called with every entry of the history. See `Method`. With `multipliers` (constraints,)
        IPOPT itself begins at `start` with these, near the bounds and with a small barrier.

        With contact as complementarity, and obstacles, further solves follow a converged one, see
        `solve_complementarity`; the limits of iterations and time hold for each of them. Exceptions
        of `watch` are not caught.
        """
        experiments = [transcription.experiment for transcription in collocation.transcriptions]
        self.require(experiments)
        is_hard = self.contact == "complementarity" and any(e.obstacles for e in experiments)
        solution = self._solve(collocation, watch, start=start, multipliers=multipliers)
        if not is_hard or not solution.status.converged:
            return solution
        relaxed_method = replace(self, initial="simulation")
        return solve_complementarity(
            solution, lambda relaxed, z: relaxed_method._solve(relaxed, watch, z, multipliers=None)
        )

    def _solve(
        self,
        collocation: Collocation,
        watch: Watch | None,
        start: Array | None,
        multipliers: Array | None,
    ) -> Solution:
        recorder = Recorder(self.name, collocation, watch=watch, max_time_s=self.max_time_s)
        if start is not None and multipliers is not None:
            return self._solve_by_ipopt(recorder, start, known=multipliers)
        if self.initial == "simulation":
            return self._solve_by_ipopt(recorder, start)
        initial = compute_initial_point(recorder, start, max_time_s=self.max_time_s)
        coarse = initial.coarse
        spent = coarse.timing
        recorder.stopwatch.add(spent.build, spent.evaluations, linear_algebra=spent.linear_algebra)
        recorder.notes.append(initial.note)
        if coarse.status in (Status.INTERRUPTED, Status.TIME_LIMIT):
            recorder.collocation = coarse.collocation
            return recorder.solution(
                coarse.status,
                coarse.status.sentence,
                z=coarse.z,
                multipliers=coarse.initial_multipliers,
                iterations=0,
                evaluations=coarse.evaluations,
            )
        if not initial.is_usable:
            return self._solve_by_ipopt(recorder, start)
        recorder.collocation = coarse.collocation
        solution = self._solve_by_ipopt(recorder, coarse.z, initial=initial)
        return replace(solution, evaluations=solution.evaluations + coarse.evaluations)

    def _solve_by_ipopt(
        self,
        recorder: Recorder,
        start: Array | None,
        initial: InitialPoint | None = None,
        known: Array | None = None,
    ) -> Solution:
        multipliers = None
        with recorder.stopwatch.building():
            program = condense(with_lifted_variables(recorder.collocation))
            if initial is not None and initial.is_close:
                multipliers = adjoint_multipliers(program, recorder.collocation, z=initial.coarse.z)
            if start is not None and known is not None:
                multipliers = adjoint_multipliers(program, recorder.collocation, start, known)
            is_warm = multipliers is not None
            hessian = _DampedHessian(program, replace(self, warm_up=0.0) if is_warm else self)

        def settings(functions: NlpFunctions) -> dict[str, Any]:
            options = self._settings(functions, program, is_warm=is_warm)
            # IPOPT refuses zero.
            remaining_s = max(1e-9, self.max_time_s - recorder.measure_elapsed_s())
            return {"ipopt.max_wall_time": remaining_s} | options

        solution = nlpsol.solve(
            recorder,
            program,
            start=start,
            plugin="ipopt",
            hessian=hessian,
            settings=settings,
            statuses=IPOPT_STATUS,
            initial_multipliers=multipliers,
        )
        if solution.status.converged and not recorder.is_late():
            certificate = certify(recorder.collocation, solution.z, solution.multipliers)
            if certificate is not None:
                solution = replace(solution, notes=(*solution.notes, certificate.sentence))
        if "Invalid_Option" not in solution.message:
            return solution
        linear_solver = self.ipopt.get("linear_solver", self.linear_solver)
        missing = (
            f"IPOPT refused one of its options: linear_solver = '{linear_solver}' probably "
            "needs a library that is not installed; expected 'mumps' or 'spral', which come with "
            "CasADi"
        )
        return replace(solution, notes=(*solution.notes, missing))

    def _settings(
        self, functions: NlpFunctions, program: Collocation, *, is_warm: bool
    ) -> dict[str, Any]:
        """Return the options except the time limit; those of the user replace the others."""
        is_solid = all(each.body.is_solid for each in program.transcriptions)
        tolerance = self.tolerance if is_solid else max(self.tolerance, POLICY.thin_tolerance)
        settings = nlpsol.ipopt_settings(
            functions, self.linear_solver, tolerance, self.max_iterations
        )
        settings |= {
            "ipopt.nlp_scaling_method": "none",  # the NLP is scaled already
            "ipopt.constr_mult_init_max": 0.0,  # the warm-up needs no multipliers
        }
        if is_warm:
            settings |= {
                "ipopt.warm_start_init_point": "yes",
                "ipopt.warm_start_bound_push": POLICY.warm_push,
                "ipopt.warm_start_bound_frac": POLICY.warm_push,
                "ipopt.warm_start_mult_bound_push": POLICY.warm_multiplier,
                "ipopt.mu_init": POLICY.warm_barrier * tolerance,
            }
        if self.linear_solver == "mumps":  # the matrix as it is: IPOPT refines
            settings |= {"ipopt.mumps_scaling": 0, "ipopt.mumps_pivtol": POLICY.pivot_tolerance}
            settings["ipopt.mumps_pivot_order"] = METIS if is_solid else AMD
            if is_solid and not (is_warm or "mumps_pivot_order" in self.ipopt):
                with_hessian = self.hessian != "limited-memory"
                settings["ipopt.mumps_pivot_order"] = cheaper_ordering(program, with_hessian)
        if self.hessian == "limited-memory":
            settings["ipopt.hessian_approximation"] = "limited-memory"
        settings |= {
            # Rows of pressures are nearly dependent where a surface lies on another.
            "ipopt.perturb_always_cd": "no"
            if lifted_count(complete_program(program), "pressure")
            else "yes",
            "ipopt.jacobian_regularization_exponent": 0.0,
            "ipopt.jacobian_regularization_value": POLICY.row_pivot
            if is_solid
            else POLICY.thin_row_pivot,
        }
        return settings | {f"ipopt.{name}": value for name, value in self.ipopt.items()}


class _DampedHessian:
    """Hessian of the Lagrangian with the warm-up and proximal terms."""

    # Each call compares parameters with those of the previous call, and adapts the damping.

    def __init__(self, collocation: Collocation, options: InteriorPoint) -> None:
        self.collocation = collocation
        self.options = options
        self._last_p = np.full(collocation.nq + collocation.nphi, np.inf)
        self._damping = 1.0

    def __call__(self, z: Array, weight: float, multipliers: Array, values: Array) -> None:
        """Write the upper triangle, with the proximal term and, in warm-up, damping of q."""
        is_settled = self._ends_warm_up(self.collocation.parameters_from(z))
        is_exact = self.options.hessian == "exact" and is_settled
        self.collocation.hessian_values(
            z, weight, multipliers=multipliers if is_exact else None, out=values
        )
        of_q, of_x = self.collocation.hessian_diagonals
        values[of_x] += POLICY.proximal
        if not is_settled:
            # With S = ∂r/∂q a step (SᵀS + κ) Δq = −Sᵀr is no longer than |r| / 2√κ.
            largest = self.collocation.objective(z) / (2 * STEP_LIMIT**2)
            values[of_q] += weight * self._damping * largest

    def _ends_warm_up(self, p: Array) -> bool:
        """Whether the step is short; the damping is updated."""
        steps = np.abs(p - self._last_p) / self.collocation.reach_p
        self._last_p = p
        of_q = steps[: self.collocation.nq].max(initial=0.0)
        if np.isfinite(of_q):
            self._damping = min(1.0, self._damping * (of_q / STEP_LIMIT) ** 2)
        return self.options.warm_up == 0 or bool(steps.max(initial=0.0) < self.options.warm_up)


@dataclass(frozen=True)
class Certificate:
    """Conditions of optimality at a solution, in the scaling of the program."""

    # Largest violations of the conditions of first order.
    stationarity: float
    feasibility: float
    complementarity: float
    # (free parameters,): eigenvalues of the reduced Hessian, ascending; parameters at a bound are
    # not varied.
    curvatures: Array

    @property
    def flat_count(self) -> int:
        """Number of eigenvalues that are not positive."""
        return int(
            np.sum(self.curvatures <= POLICY.smallest_curvature * self.curvatures.max(initial=0))
        )

    @property
    def is_strict_minimum(self) -> bool:
        """Whether the reduced Hessian is positive definite."""
        return self.flat_count == 0

    @property
    def sentence(self) -> str:
        """Sentence for the user."""
        count = len(self.curvatures)
        meaning = (
            "is positive definite: a strict local minimum"
            if self.is_strict_minimum
            else f"has {self.flat_count} of {count} eigenvalues that are not positive: some "
            "combination of the parameters is not determined, or the point is no minimum"
        )
        return (
            f"optimality of the complete program: stationarity {self.stationarity:.1e}, feasibility "
            f"{self.feasibility:.1e}, complementarity {self.complementarity:.1e}; the reduced "
            f"Hessian of {count} free parameter{'s' * (count != 1)} {meaning}"
        )


def certify(collocation: Collocation, z: Array, multipliers: Array) -> Certificate | None:
    """Return the conditions of optimality at variables z; None if the constraints do
    not determine the positions there.

    Parameters
    ----------
    z : (variables,) array
        Variables.
    multipliers : (constraints,) array
        Multipliers of the constraints. With lifted variables the Hessian has those of the adjoint
        equations, which include them.
    """
    program = with_lifted_variables(collocation)
    try:
        by_p = sensitivities(collocation, z)
    except SimulationError:
        return None
    of_constraints = multipliers
    if added := lifted_count(program):
        adjoint = adjoint_multipliers(program, collocation, z=z)
        if adjoint is None:
            return None
        of_constraints = adjoint[0]
    variables = convert_variables(z, collocation, target=program)
    lower, upper = program.bounds()
    distance = np.minimum(variables - lower, upper - variables)
    parameters = np.r_[: program.nq, program.phi_columns]
    is_free = distance[parameters] > BOUND_TOLERANCE
    basis = tangent_directions(collocation, by_p)[:, is_free]
    if added:
        rows = program.jacobian(variables)[-added:].tocsc()
        of_lifted = np.asarray(spla.spsolve(rows[:, -added:], -rows[:, :-added] @ basis))
        basis = np.concatenate([basis, of_lifted.reshape(added, -1)])
    reduced = reduced_hessian(program, variables, of_constraints, basis)
    curvatures = np.asarray(np.linalg.eigvalsh(reduced), dtype=float)

    slope = collocation.gradient(z) + collocation.jacobian_vjp(z, multipliers)
    complementarity = np.abs(slope[parameters] * distance[parameters])[~is_free]
    return Certificate(
        collocation.kkt_residual(z, multipliers),
        float(np.abs(collocation.constraint_values(z)).max(initial=0.0)),
        float(complementarity.max(initial=0.0)),
        curvatures,
    )
