"""One run: solve a problem, verify the answer by simulating forward, and find the error bars."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from .errors import InputError, SimulationError
from .methods.described import require_method
from .methods.solution import Iteration, Solution, Status
from .nlp.collocation import Collocation
from .problem import Problem
from .rollout import Rollout, roll_out
from .statistics.diagnostics import MarkerDiagnosis, diagnose
from .statistics.identifiability import verdicts
from .statistics.linearised import linearised_fit
from .statistics.profile import Profile
from .statistics.profiling import profile_of
from .statistics.uncertainty import Uncertainty, uncertainty_of

Log = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Run:
    """A solved problem with its checks.

    Attributes
    ----------
    problem : Problem
    solution : Solution
    rollouts : mapping of experiment name to Rollout, or to the reason why there is none
    uncertainty : Uncertainty or None, where the solve did not converge
    diagnoses : tuple of MarkerDiagnosis, what the residuals suggest
    profiles : tuple of Profile, those asked for
    notes : tuple of str
        What went wrong after the solve.
    """

    problem: Problem
    solution: Solution
    rollouts: Mapping[str, Rollout | str]
    uncertainty: Uncertainty | None
    diagnoses: tuple[MarkerDiagnosis, ...] = ()
    profiles: tuple[Profile, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def all_notes(self) -> tuple[str, ...]:
        """What the user should know after the solve, and what the data say of the parameters."""
        if self.uncertainty is None:
            return self.notes
        said = (*self.notes, *self.uncertainty.notes, *verdicts(self.uncertainty))
        return (*dict.fromkeys(said), *(profile.sentence for profile in self.profiles))


def build_collocation(problem: Problem) -> Collocation:
    """The NLP of a problem."""
    transcription = problem.file.transcription
    return Collocation(
        problem.experiments,
        problem.parameters,
        transcription.scheme,
        transcription.substeps,
        transcription.explicit_grasps,
        problem.file.solver.huber,
    )


def solve(
    problem: Problem,
    method: str | None = None,
    watch: Callable[[Iteration], None] | None = None,
    **options: Any,
) -> Solution:
    """Solve a problem with a method.

    Parameters
    ----------
    problem : Problem
    method : str, optional
        A key of `methods.METHODS`; the problem file's by default.
    watch : callable, optional
        Called with every `Iteration`.
    **options
        Options of the method, in place of those of the problem file.

    Raises
    ------
    InputError
        For an unknown method or option, and when the solver refuses the problem.
    """
    name = method or problem.file.solver.method
    require_method(name, "--method")
    try:
        solver = problem.file.solver.method_named(name, **options)
        solution = solver(build_collocation(problem), watch)
    except InputError as error:
        raise error.located(problem.path) from error
    if solution.status is Status.REFUSED:
        reasons = "; ".join(solution.notes)
        raise InputError(f"{solution.message} {reasons}".strip(), problem.path, "solver")
    return solution


def run(
    problem: Problem,
    method: str | None = None,
    watch: Callable[[Iteration], None] | None = None,
    log: Log | None = None,
) -> Run:
    """Solve a problem, simulate every experiment with the answer, and find the error bars."""
    say = log or (lambda _: None)
    solution = solve(problem, method, watch)
    say("checking the answer by a forward simulation")
    rollouts = {e.name: roll_out(problem, e, solution) for e in problem.experiments}
    if not solution.status.converged:
        return Run(problem, solution, rollouts, None)
    say("finding the error bars")
    try:
        fit = linearised_fit(solution.collocation, solution.z)
    except SimulationError as error:
        return Run(problem, solution, rollouts, None, notes=(f"no error bars: {error}",))
    diagnoses = diagnose(fit)
    if not solution.collocation.nq:
        return Run(problem, solution, rollouts, None, diagnoses)
    section = problem.file.uncertainty
    try:
        uncertainty = uncertainty_of(
            fit, problem.parameters, solution.q, section.noise, section.errors
        )
        profiles = []
        for name in section.profile:
            say(f"profile likelihood of {name}")
            profiles.append(profile_of(solution, fit, uncertainty, name))
    except InputError as error:
        raise error.located(problem.path) from error
    return Run(problem, solution, rollouts, uncertainty, diagnoses, tuple(profiles))
