"""Penalty method and augmented Lagrangian: violations of the equations of motion cost ρ/2 ‖g‖².

    minimise   L(z) + yᵀ g(z) + ρ/2 ‖g(z)‖²

in stages, each started from the previous solution. The penalty method, as in the paper, has y = 0
and one ρ or an increasing sequence. A finite ρ always leaves a violation: forces −g that no robot
applied, which decrease as 1/ρ and bias the parameters.

The augmented Lagrangian updates the multipliers, y ← y + ρ g, so that ρ need not become large: it
increases only where the violation ‖g‖ did not decrease enough (ALGENCAN, R. Andreani et al., SIAM
J. Optim. 18, 2007: the fixed sequence of LANCELOT expects constraints of order one, and would make
ρ larger than the multipliers need). It converges to the optimum of interior point and reduced space.

A solution is converged if the gradient is within `tolerance` and the violation within `violation`;
the message states the violation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from ...common.array_types import Array
from ...common.limits import time_limit
from ...common.validated_classes import validated
from ...common.validated_types import AboveOne, AtLeastOne, Count, Positive
from ...errors import InputError
from ...program.collocation import Collocation, convert_variables
from ..options import MethodOptions
from ..solution import Solution, Status, Watch
from ..solve_recorder import SEARCH_ENDS, Recorder, SearchEnded, status_of_end
from .conjugate_gradients import minimise_conjugate_gradients
from .levenberg_marquardt import minimise_levenberg_marquardt
from .merit import MeritFunction, PenaltyProblem

# ρ increases if a stage leaves more than this share of the violation.
FALL = 0.25
# The augmented Lagrangian ends if the largest ρ leaves more than this share of the violation.
STUCK = 0.9
# Iterations between entries of the history; those of conjugate gradients are many and cheap.
EVERY = {"levenberg-marquardt": 1, "scipy-cg": 20}
# Rounding leaves about this much of the gradient for every unit of curvature, of the loss or ρ.
ROUNDING = 1e-14


@dataclass(frozen=True)
class ConstraintViolation:
    """Violation of the equations of motion at a point."""

    newtons: float = np.inf  # largest residual [N]
    relative: float = np.inf  # largest residual over the largest force in the equations
    scaled: float = np.inf  # largest entry of g

    def __str__(self) -> str:
        """Return the violation in words, for messages."""
        return f"slack of {self.newtons:.2g} N ({self.relative:.1g} of the largest force)"


@dataclass(frozen=True)
class Stage:
    """One minimisation with fixed ρ and y: its merit function, and its result once it has ended."""

    merit: MeritFunction
    # Largest entry of the merit's projected gradient at the end of the stage; infinite before.
    gradient: float = np.inf
    # Whether the minimum was reached, as far as rounding allows at large ρ.
    is_minimum: bool = False
    violation: ConstraintViolation = ConstraintViolation()  # violation at the end of the stage


@validated
class PenaltyOptions(MethodOptions):
    """Base class of both methods: the increase of ρ, and limits.

    Attributes
    ----------
    inner : {"scipy-cg", "levenberg-marquardt"}
        Solver that minimises the merit function: the conjugate gradients of SciPy ("scipy-cg"), or
        damped Newton steps with a sparse factorisation ("levenberg-marquardt"), which alone come
        near a minimum at large ρ.
    rho : float
        First ρ; loss and constraints are in the scaling of the NLP, where both are of order one.
    rho_max : float
        Last ρ.
    rho_factor : float
        Factor by which ρ increases.
    inner_iterations : int
        Largest number of iterations of a stage.
    tolerance : float
        Largest entry of the gradient at the end, in the scaling of the NLP; not less than 1e-14
        times the sum of ρ and the loss's largest curvature, because of rounding.
    violation : float
        Largest violation of the equations of motion at the end, over the largest force in them. If
        a stage ends with a smaller violation, the solve ends.
    max_iterations : int
        Largest number of iterations of all stages together.
    max_time_s : float
        Largest computing time in seconds.
    """

    inner: Literal["scipy-cg", "levenberg-marquardt"] = "levenberg-marquardt"
    rho: Positive = 1e5
    rho_max: Positive = 1e9
    rho_factor: AboveOne = 10.0
    inner_iterations: AtLeastOne = 1000
    tolerance: Positive = 1e-6
    violation: Positive = 1e-7
    max_iterations: Count = 10_000
    max_time_s: Positive = 1e6

    def __post_init__(self) -> None:
        """Raise an `InputError` if an option is invalid, or the last ρ is below the first."""
        if self.last_rho < self.rho:
            raise InputError(
                f"found {self.rho_max:g}, which is less than rho = {self.rho:g}; expected rho or "
                "more",
                None,
                where="rho_max",
            )

    def __call__(
        self, collocation: Collocation, watch: Watch | None = None, start: Array | None = None
    ) -> Solution:
        """Solve the NLP from `start`, by default from a simulation at the guess; see `Method`.
        Entries of the history, with which `watch` is called, count inner iterations.
        """
        climb = _PenaltySolve(
            self,
            Recorder(self.name, collocation, watch=watch, max_time_s=self.max_time_s),
            start=start,
        )
        try:
            with time_limit(self.max_time_s):
                status, message = climb.run()
        except SEARCH_ENDS as end:
            status, message = status_of_end(end)
        return climb.solution(status, message)

    @property
    def last_rho(self) -> float:
        """Largest ρ of the solve, `rho_max`."""
        return self.rho_max

    def next_stage(self, stage: Stage, previous_violation: ConstraintViolation, z: Array) -> Stage:
        """Return the next stage.

        Parameters
        ----------
        stage : Stage
            Stage that has ended.
        previous_violation : ConstraintViolation
            Violation at the end of the stage before it.
        z : (variables,) array
            Variables at its end.

        Raises
        ------
        SearchEnded
            If further stages would not improve the solution.
        """
        raise NotImplementedError


@validated
class Penalty(PenaltyOptions):
    """Penalty method: violations of the equations of motion are penalised, as in the paper.

    Attributes
    ----------
    schedule : {"geometric", "constant"}
        How ρ increases from `rho` to `rho_max`: by `rho_factor` after every stage, or not at all.
    """

    name: ClassVar[str] = "penalty"

    inner: Literal["scipy-cg", "levenberg-marquardt"] = "scipy-cg"
    rho: Positive = 1e2
    rho_max: Positive = 1e8
    violation: Positive = 1e-3
    schedule: Literal["geometric", "constant"] = "geometric"

    @property
    def last_rho(self) -> float:
        """Largest ρ of the solve: `rho` for a constant schedule, else `rho_max`."""
        return self.rho if self.schedule == "constant" else self.rho_max

    def next_stage(self, stage: Stage, previous_violation: ConstraintViolation, z: Array) -> Stage:
        """Return the next stage, with ρ larger by `rho_factor`, up to `last_rho`; see
        `PenaltyOptions.next_stage` for the arguments. The multipliers stay zero.

        Raises
        ------
        SearchEnded
            If ρ is at its limit: with the status `STALLED` if the stage reached its minimum, else
            with `ITERATION_LIMIT`.
        """
        rho = stage.merit.rho
        if rho >= self.last_rho:
            if stage.is_minimum:
                message = (
                    "The merit function is at its minimum, but the equations of motion "
                    "are violated; raise rho_max."
                )
                raise SearchEnded(Status.STALLED, message)
            raise SearchEnded(
                Status.ITERATION_LIMIT,
                f"The last stage ended before its minimum: its gradient is {stage.gradient:.2g}, above "
                f"the tolerance {self.tolerance:.2g}. Raise inner_iterations or choose another inner "
                "solver.",
            )
        rho = min(self.rho_factor * rho, self.last_rho)
        return Stage(replace(stage.merit, rho=rho))


@validated
class AugmentedLagrangian(PenaltyOptions):
    """Augmented Lagrangian: a penalty with multipliers, so that ρ need not become large."""

    name: ClassVar[str] = "augmented-lagrangian"

    def next_stage(self, stage: Stage, previous_violation: ConstraintViolation, z: Array) -> Stage:
        """Return the next stage with updated multipliers, and a larger ρ if much violation remains;
        see `PenaltyOptions.next_stage` for the arguments.

        Raises
        ------
        SearchEnded
            With the status `STALLED`, if ρ is at its limit or the violation within `violation`, and
            more than the share `STUCK` of it remained.
        """
        rho = stage.merit.rho
        slack = stage.violation
        is_feasible = slack.relative <= self.violation
        is_last = rho >= self.rho_max or is_feasible
        if is_last and slack.scaled > STUCK * previous_violation.scaled:
            if stage.is_minimum:
                raise SearchEnded(
                    Status.STALLED,
                    "The equations of motion are violated although the penalty ρ reached rho_max; raise "
                    "rho_max.",
                )
            raise SearchEnded(
                Status.STALLED,
                f"The last stage ended with a gradient of {stage.gradient:.2g}, above its tolerance "
                f"{self.tolerance:.2g}; choose another inner solver, which may reach the tolerance.",
            )
        if not is_feasible and slack.scaled > FALL * previous_violation.scaled:
            rho = min(self.rho_factor * rho, self.rho_max)
        rows = stage.merit.problem.constraint_values(z)
        merit = replace(stage.merit, rho=rho, multipliers=stage.merit.multiplier_estimate(rows))
        return Stage(merit)


class _PenaltySolve:
    """State of a solve in stages: last iterate, which is the best as the merit decreases, and
    counts.

    Parameters
    ----------
    options : PenaltyOptions
    recorder : Recorder
    start : (variables,) array or None
        Initial variables of the given problem; None for a simulation at the guess.

    Attributes
    ----------
    variables : (variables,) array
        Last iterate of `problem`, within its bounds.
    stage : Stage
        Present stage.
    iterations : int
        Number of inner iterations of all stages.
    gradient : float
        Largest entry of the projected gradient at the last iterate.

    Raises
    ------
    InputError
        If elements are inverted at the start.
    """

    def __init__(self, options: PenaltyOptions, recorder: Recorder, start: Array | None) -> None:
        self.options = options
        self.recorder = recorder
        self.problem = PenaltyProblem(recorder.collocation, recorder.stopwatch)
        nlp = self.problem.nlp
        began = convert_variables(
            recorder.initial_variables(start), recorder.collocation, target=nlp
        )
        self.variables = np.clip(began, self.problem.lower, self.problem.upper)
        if not self.problem.has_valid_elements(self.variables):
            raise InputError("elements are inverted at the initial point; give another guess")
        no_weights = np.zeros(nlp.constraint_count)
        merit = MeritFunction(self.problem, options.rho, multipliers=no_weights)
        self.stage = Stage(merit)
        self.iterations = 0
        self.gradient = np.inf
        curvature = nlp.hessian(self.variables, 1.0, multipliers=no_weights).diagonal()
        self._curvature = float(curvature.max(initial=0.0))

    def run(self) -> tuple[Status, str]:
        """Solve one stage after the other; return status and message.

        Raises
        ------
        SearchEnded
            If no further progress is possible or a limit is reached; `variables` are then the last
            iterate.
        InputError
            If the factor of the inner solver needs too much memory.
        SimulationError
            If the body has no stress-free shape at the parameters of a trial.
        """
        options = self.options
        previous_violation = ConstraintViolation()
        while True:
            ended_stage = self._minimise()
            is_feasible = ended_stage.violation.relative <= options.violation
            if ended_stage.is_minimum and is_feasible:
                message = (
                    "Converged: the gradient and the violation of the equations of motion are within "
                    "their tolerances."
                )
                return Status.CONVERGED, message
            self.stage = options.next_stage(ended_stage, previous_violation, z=self.variables)
            previous_violation = ended_stage.violation

    def solution(self, status: Status, reason: str) -> Solution:
        """Return the last iterate as a solution of the given problem with a status, with the
        multipliers y + ρ g; `reason` is the first sentence of its message. The constraints are
        evaluated and counted.
        """
        merit = self.stage.merit
        estimate = merit.multiplier_estimate(self.problem.constraint_values(self.variables))
        return self.recorder.solution(
            status,
            f"{reason} Remaining violation of the equations of motion at ρ = {merit.rho:.3g}: "
            f"{self._violation()}.",
            z=self._original_variables(),
            multipliers=estimate[: self.recorder.collocation.constraint_count],
            iterations=self.iterations,
            evaluations=self.problem.evaluations,
        )

    def _minimise(self) -> Stage:
        """Minimise the merit of the present stage from the last iterate, and return the stage with
        its result.

        Variables, gradient and number of iterations are updated with every iterate. The history
        gets an entry now and then, and one for the last iterate. The tolerance is larger where ρ or
        the curvature of the loss makes rounding dominate. A stage that reaches `inner_iterations`
        ends without an error; its `is_minimum` is False.
        """
        stage = self.stage
        options = self.options
        recorder = self.recorder
        tolerance = max(options.tolerance, ROUNDING * (stage.merit.rho + self._curvature))
        before = self.iterations
        done = 0

        def report(z: Array, gradient: float) -> None:
            """Store an iterate z with its largest projected gradient, add it to the history now and
            then, and raise `SearchEnded` if a limit is reached.
            """
            nonlocal done
            self.variables = z
            self.gradient = gradient
            self.iterations = before + done
            if (done % EVERY[options.inner] == 0 and done > 0) or not recorder.history:
                self._record()
            if recorder.is_late():
                raise SearchEnded(Status.TIME_LIMIT)
            if self.iterations >= options.max_iterations and self.gradient > tolerance:
                raise SearchEnded(Status.ITERATION_LIMIT)
            done += 1

        minimise = (
            minimise_conjugate_gradients
            if options.inner == "scipy-cg"
            else minimise_levenberg_marquardt
        )
        reached = minimise(
            stage.merit,
            self.variables,
            tolerance=tolerance,
            max_iterations=options.inner_iterations,
            report=report,
        )
        if recorder.history[-1].number < self.iterations:
            self._record()
        return replace(
            stage, gradient=self.gradient, is_minimum=reached, violation=self._violation()
        )

    def _original_variables(self) -> Array:
        """Return the variables of the given problem at the last iterate."""
        return convert_variables(self.variables, self.problem.nlp, target=self.recorder.collocation)

    def _record(self) -> None:
        """Add the last iterate to the history, with the loss of the given problem."""
        nlp = self.recorder.collocation
        z = self._original_variables()
        self.recorder.add_variables(self.iterations, z, loss=nlp.objective(z) / nlp.loss_scale)

    def _violation(self) -> ConstraintViolation:
        """Return the violation at the last iterate."""
        nlp = self.recorder.collocation
        z = self._original_variables()
        newtons = max(float(np.abs(r).max(initial=0.0)) for r in nlp.residuals_n(z))
        rows = self.problem.constraint_values(self.variables)
        scaled = float(np.abs(rows).max(initial=0.0))
        return ConstraintViolation(
            newtons, newtons / max(nlp.largest_force_n(z), 1e-300), scaled=scaled
        )
