"""Penalty and augmented Lagrangian: slack in the dynamics at a price ρ, with multipliers or not.

    minimise   L(z) + yᵀ g(z) + ρ/2 ‖g(z)‖²

in stages, each started from the last answer. The penalty method, as in the paper, keeps y = 0 for
one ρ or a rising sequence of them. A finite ρ always leaves some slack: forces −g that no robot
applied, which fall as 1/ρ and bias the parameters while they last.

The augmented Lagrangian learns the multipliers, y ← y + ρ g, so that ρ need not become large: it
rises only where the slack ‖g‖ did not fall well. Stages are solved to tolerances that tighten with
the slack (J. Nocedal and S. Wright, Numerical Optimization, 2nd ed., framework 17.3 and algorithm
17.4; the rule for ρ is that of ALGENCAN, R. Andreani et al., SIAM J. Optim. 18, 2007: the fixed
sequence of LANCELOT expects rows of order one, and would make ρ larger than the multipliers need).
Converges to the optimum of interior point and of the reduced space.

The answer counts as converged where the gradient is within `tolerance` and the slack within
`violation`; the message says how much of it is left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from ...arrays import Array
from ...checked import AboveOne, AtLeastOne, Count, Options, Positive
from ...errors import InputError
from ...program.collocation import Collocation
from ..recorder import Ended, Recorder
from ..solution import Solution, Status, Watch
from .inner import FIRST_ORDER, Inner, minimise
from .merit import Merit, Unconstrained

# ρ rises where a stage leaves more than this share of the slack, and the augmented Lagrangian ends
# where not even the largest ρ leaves less than the second.
FALL, STUCK = 0.25, 0.9
# Its gradient wanted of the first stage, and of a later one over that of the one before.
FIRST_GRADIENT, TIGHTER = 1e-3, 0.1
# Iterations between lines of the history; those of first order are many and cheap.
EVERY, EVERY_OF_FIRST_ORDER = 1, 20
# Rounding leaves about this much of the gradient for every unit of curvature, of the loss or ρ.
ROUNDING = 1e-14


@dataclass(frozen=True)
class Slack:
    """How far a point is from satisfying the equations of motion.

    Attributes
    ----------
    newtons : float
        Largest residual.
    relative : float
        The same over the largest force in the balance.
    scaled : float
        Largest row of g, grasps included.
    """

    newtons: float = np.inf
    relative: float = np.inf
    scaled: float = np.inf

    def __str__(self) -> str:
        return f"slack of {self.newtons:.2g} N ({self.relative:.1g} of the largest force)"


@dataclass(frozen=True)
class Stage:
    """A merit function, the gradient wanted of its minimum, and what was reached.

    Attributes
    ----------
    merit : Merit
    wanted, gradient : float
        Largest entry of the merit's projected gradient.
    reached : bool
        Whether it is small enough, which rounding decides at large ρ.
    slack : Slack
    """

    merit: Merit
    wanted: float
    gradient: float = np.inf
    reached: bool = False
    slack: Slack = Slack()


@dataclass(frozen=True)
class Stages(Options):
    """Base of both methods: a climb of ρ, and the budget.

    Attributes
    ----------
    inner : {"cg-descent", "scipy-cg", "l-bfgs-b", "levenberg-marquardt"}
        What minimises the merit function: Hager and Zhang's conjugate gradients as in the paper,
        SciPy's, a quasi-Newton method, or damped Newton steps with a sparse factorisation, which
        alone get anywhere near a minimum at large ρ.
    rho : float
        First ρ; loss and rows are in the scaling of the NLP, where both are of order one.
    rho_max : float
        Last ρ.
    rho_factor : float
        Factor by which ρ rises.
    inner_iterations : int
        Most iterations of a stage.
    tolerance : float
        Largest entry of the gradient at the end, in the scaling of the NLP, or 1e-14 of ρ plus the
        loss's largest curvature: rounding hides less.
    violation : float
        Slack that an answer may leave, over the largest force in the balance. A stage that
        ends within it ends the solve.
    max_iterations : int
        Iterations of all stages together.
    max_time_s : float
        Seconds after which it ends.
    """

    inner: Inner = "levenberg-marquardt"
    rho: Positive = 1e5
    rho_max: Positive = 1e9
    rho_factor: AboveOne = 10.0
    inner_iterations: AtLeastOne = 1000
    tolerance: Positive = 1e-6
    violation: Positive = 1e-7
    max_iterations: Count = 10_000
    max_time_s: Positive = 1e6

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.last_rho < self.rho:
            found = f"found {self.rho_max:g} with rho = {self.rho:g}"
            raise InputError(f"{found}; expected no less than rho", None, "rho_max")

    def __call__(
        self, collocation: Collocation, watch: Watch | None = None, start: Array | None = None
    ) -> Solution:
        """Solve the NLP, see `Method`; lines of the history count inner iterations.

        Held nodes of the answer are put where their grasps are, and the slack counted there.

        Raises
        ------
        InputError
            For a start with inverted elements.
        """
        climb = _PenaltyClimb(self, Recorder(self.name, collocation, watch, self.max_time_s), start)
        status, why = climb.recorder.search(climb.run)
        return climb.solution(status, why)

    @property
    def last_rho(self) -> float:
        """Where ρ ends."""
        return self.rho_max

    @property
    def first_gradient(self) -> float:
        """What is wanted of the first stage."""
        return self.tolerance

    def following(self, stage: Stage, before: Slack, z: Array) -> Stage:
        """What follows a stage that ended at z, given the slack of the one before.

        Raises
        ------
        Ended
            Where nothing is to be gained.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class Penalty(Stages):
    """The dynamics are not imposed but paid for, as in the paper.

    Attributes
    ----------
    schedule : {"geometric", "progress", "constant"}
        How ρ goes from `rho` to `rho_max`: by `rho_factor` after every stage, or only after those
        that left more than a quarter of the slack, or not at all.
    """

    name: ClassVar[str] = "penalty"

    inner: Inner = "cg-descent"
    rho: Positive = 1e2
    rho_max: Positive = 1e8
    violation: Positive = 1e-3
    schedule: Literal["geometric", "progress", "constant"] = "geometric"

    @property
    def last_rho(self) -> float:
        """Where ρ ends."""
        return self.rho if self.schedule == "constant" else self.rho_max

    def following(self, stage: Stage, before: Slack, z: Array) -> Stage:
        """The same with a larger ρ."""
        rho = stage.merit.rho
        stuck = self.schedule != "progress" or stage.slack.relative > FALL * before.relative
        if stuck and rho >= self.last_rho:
            if stage.reached:
                minimum = "The merit is at its minimum but the dynamics do not hold; raise rho_max."
                raise Ended(Status.STALLED, minimum)
            raise Ended(
                Status.ITERATION_LIMIT,
                f"The last stage ended before its minimum, with a gradient of {stage.gradient:.2g};"
                " raise inner_iterations or choose another inner solver.",
            )
        if stuck or stage.reached:
            rho = min(self.rho_factor * rho, self.last_rho)
        return Stage(replace(stage.merit, rho=rho), self.tolerance)


@dataclass(frozen=True)
class AugmentedLagrangian(Stages):
    """A penalty with multipliers, so that ρ need not become large."""

    name: ClassVar[str] = "augmented-lagrangian"

    @property
    def first_gradient(self) -> float:
        """What is wanted of the first stage."""
        return max(FIRST_GRADIENT, self.tolerance)

    def following(self, stage: Stage, before: Slack, z: Array) -> Stage:
        """The next with the multipliers of the last, and a larger ρ where it left much slack."""
        rho, wanted, slack = stage.merit.rho, stage.wanted, stage.slack
        within = slack.relative <= self.violation
        last = rho >= self.rho_max or within
        if last and wanted <= self.tolerance and slack.scaled > STUCK * before.scaled:
            if stage.reached:
                raise Ended(Status.STALLED, "rho_max does not make the dynamics hold.")
            raise Ended(
                Status.STALLED,
                f"The last stage ended with a gradient of {stage.gradient:.2g}, short of its "
                f"tolerance {wanted:.2g}; another inner solver may get farther.",
            )
        if not within and slack.scaled > FALL * before.scaled:
            rho = min(self.rho_factor * rho, self.rho_max)
        rows = stage.merit.problem.constraint_values(z)
        merit = replace(stage.merit, rho=rho, multipliers=stage.merit.estimate(rows))
        return Stage(merit, max(0.0 if within else TIGHTER * wanted, self.tolerance))


class _PenaltyClimb:
    """A solve in stages: the last iterate, which is the best as the merit falls, and the budget."""

    def __init__(self, options: Stages, recorder: Recorder, start: Array | None) -> None:
        self.options, self.recorder = options, recorder
        self.problem = Unconstrained(recorder.collocation, recorder.stopwatch)
        nlp = self.problem.nlp
        began = self.problem.began(recorder.start(start))
        self.z = np.clip(began, self.problem.lower, self.problem.upper)
        if not self.problem.is_upright(self.z):
            raise InputError("elements are inverted at the start; start from another point")
        no_weights = np.zeros(nlp.constraints)
        merit = Merit(self.problem, options.rho, no_weights)
        self.stage = Stage(merit, options.first_gradient)
        self.iterations, self.gradient = 0, np.inf
        curvature = nlp.hessian(self.z, 1.0, no_weights).diagonal()
        self._curvature = float(curvature.max(initial=0.0))
        self._every = EVERY_OF_FIRST_ORDER if options.inner in FIRST_ORDER else EVERY

    def run(self) -> tuple[Status, str]:
        """Stage after stage.

        Raises
        ------
        Ended
        """
        options, before = self.options, Slack()
        while True:
            done = self._minimise()
            within = done.slack.relative <= options.violation
            if done.reached and within and done.wanted <= options.tolerance:
                said = "Converged: gradient and slack are within their tolerances."
                return Status.CONVERGED, said
            self.stage, before = options.following(done, before, self.z), done.slack

    def solution(self, status: Status, why: str) -> Solution:
        """The last iterate as an answer of the given collocation."""
        merit = self.stage.merit
        estimate = merit.estimate(self.problem.constraint_values(self.z))
        return self.recorder.solution(
            status,
            f"{why} At ρ = {merit.rho:.3g} {self._slack()} is left.",
            self.problem.answer(self.z),
            self.problem.multipliers(estimate),
            self.iterations,
            self.problem.evaluations,
        )

    def _minimise(self) -> Stage:
        """The stage, as far as it goes from the last iterate.

        Where ρ or the loss is so curved that rounding hides the gradient wanted, it may be larger.

        Raises
        ------
        Ended
            Where the budget is spent.
        """
        stage, options, recorder = self.stage, self.options, self.recorder
        tolerance = max(stage.wanted, ROUNDING * (stage.merit.rho + self._curvature))
        before, done = self.iterations, 0

        def report(z: Array, value: float, projected: Array) -> None:
            nonlocal done
            self.z, self.gradient = z, float(np.abs(projected).max(initial=0.0))
            self.iterations = before + done
            if (done % self._every == 0 and done > 0) or not recorder.history:
                self._record()
            if recorder.late:
                raise Ended(Status.TIME_LIMIT)
            if self.iterations >= options.max_iterations and self.gradient > tolerance:
                raise Ended(Status.ITERATION_LIMIT)
            done += 1

        limit = options.inner_iterations
        reached = minimise(options.inner, stage.merit, self.z, tolerance, limit, report)
        if recorder.history[-1].number < self.iterations:
            self._record()
        return replace(stage, gradient=self.gradient, reached=reached, slack=self._slack())

    def _record(self) -> None:
        nlp, z = self.problem.given, self.problem.answer(self.z)
        self.recorder.line(self.iterations, z, nlp.objective(z) / nlp.loss_scale)

    def _slack(self) -> Slack:
        """How far the answer is from satisfying the equations of motion."""
        nlp, z = self.problem.given, self.problem.answer(self.z)
        newtons = max(float(np.abs(r).max(initial=0.0)) for r in nlp.violations_n(z))
        rows = self.problem.constraint_values(self.z)
        scaled = float(np.abs(rows).max(initial=0.0))
        return Slack(newtons, newtons / max(nlp.largest_force_n(z), 1e-300), scaled)
