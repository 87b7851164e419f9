"""One run: solve a problem, verify the answer by simulating forward, and find the error bars."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError, SimulationError, hint_at
from .fem.constants import unit_of
from .methods.method import Method, Watch
from .methods.solution import Solution, Status
from .problem import Problem
from .rollout import Rollout, roll_out
from .statistics.diagnostics import MarkerDiagnosis, diagnose
from .statistics.estimates import Estimate
from .statistics.identifiability import verdicts
from .statistics.linearised import Derived, linearised_fit
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

    def __repr__(self) -> str:
        solution = self.solution
        free = [item.name for item in self.problem.parameters.free]
        found = ", ".join(f"{name} = {_with_error(self.estimates[name])}" for name in free)
        rms = f"{1e3 * solution.rms_m:.3g} mm RMS"
        return f"Run({solution.method}, {solution.status.value}: {found}; {rms})"

    @property
    def parameters(self) -> dict[str, float]:
        """Every parameter, by name."""
        return self.solution.parameters

    @cached_property
    def derived(self) -> dict[str, float]:
        """Moduli that follow from the parameters, by name."""
        constants = (segment.constants for segment in self.solution.collocation.segments)
        return dict(Derived.of(constants, self.solution.q).values)

    @cached_property
    def estimates(self) -> dict[str, Estimate]:
        """Parameters and derived moduli with their error bars, where there are any."""
        found = self.uncertainty
        known = {} if found is None else {**found.estimates, **found.derived}
        values = self.parameters | self.derived
        return {name: known.get(name, Estimate(value)) for name, value in values.items()}

    def interval(self, name: str) -> tuple[float, float] | None:
        """95 % interval of a parameter or derived modulus; None where there is none.

        Raises
        ------
        InputError
            For an unknown name.
        """
        return self._estimate(name).ci95

    def std_error(self, name: str) -> float | None:
        """Standard error of a parameter or derived modulus; None where there is none.

        Raises
        ------
        InputError
            For an unknown name.
        """
        return self._estimate(name).std_error

    def table(self) -> str:
        """The parameters with their error bars as the terminal shows them."""
        from .terminal import parameter_table, plain_text  # how it looks is no part of a run

        return plain_text(parameter_table(self))

    def to_frame(self) -> Any:
        """The estimates as a pandas DataFrame: value, std_error, lower, upper, guess, unit.

        Raises
        ------
        InputError
            Without pandas.
        """
        try:
            pandas = import_module("pandas")
        except ImportError as error:
            raise InputError("a data frame needs pandas: pip install pandas") from error
        items = self.problem.parameters.items
        guesses = {item.name: item.guess for item in items if item.tied is None}
        rows = {}
        for name, estimate in self.estimates.items():
            lower, upper = estimate.ci95 or (np.nan, np.nan)
            rows[name] = {
                "value": estimate.value,
                "std_error": np.nan if estimate.std_error is None else estimate.std_error,
                "lower": lower,
                "upper": upper,
                "guess": guesses.get(name, np.nan),
                "unit": unit_of(name),
            }
        return pandas.DataFrame.from_dict(rows, orient="index")

    def save(self, folder: str | Path, frames: bool = True) -> Path:
        """Write the run folder, whole or not at all, and return it.

        Raises
        ------
        InputError
            If there is anything but an earlier run.
        """
        from .output.record import write_run  # what files hold is no part of a run

        return write_run(self, folder, frames)

    def _estimate(self, name: str) -> Estimate:
        if name not in self.estimates:
            known = list(self.estimates)
            expected = f"expected one of {', '.join(known)}{hint_at(name, known)}"
            raise InputError(f"no parameter {name!r}; {expected}")
        return self.estimates[name]

    @property
    def all_notes(self) -> tuple[str, ...]:
        """What the user should know after the solve, and what the data say of the parameters."""
        if self.uncertainty is None:
            return self.notes
        said = (*self.notes, *self.uncertainty.notes, *verdicts(self.uncertainty))
        return (*dict.fromkeys(said), *(profile.sentence for profile in self.profiles))


def _with_error(estimate: Estimate) -> str:
    error = "" if estimate.std_error is None else f" ± {estimate.std_error:.2g}"
    return f"{estimate.value:.5g}{error}"


def solve(
    problem: Problem, method: str | Method | None = None, watch: Watch | None = None
) -> Solution:
    """Solve a problem, without the checks of `run`.

    Parameters
    ----------
    problem : Problem
    method : str or Method, optional
        A name, or anything that solves a `Collocation`, such as a method with other options; the
        problem's own by default.
    watch : callable, optional
        Called with every `Iteration`.

    Raises
    ------
    InputError
        For an unknown method, and when the solver refuses the problem.
    """
    solver = problem.solver(method)
    try:
        solution = solver(problem.collocation(), watch)
    except InputError as error:
        raise error.located(problem.path) from error
    if solution.status is Status.REFUSED:
        reasons = "; ".join(solution.notes)
        raise InputError(f"{solution.message} {reasons}".strip(), problem.path, "solver")
    return solution


def run(
    problem: Problem,
    method: str | Method | None = None,
    watch: Watch | None = None,
    log: Log | None = None,
) -> Run:
    """Solve a problem, simulate every experiment with the answer, and find the error bars.

    Parameters
    ----------
    problem : Problem
    method, watch
        See `solve`.
    log : callable, optional
        Called with what is being done now, a text.

    Raises
    ------
    InputError
        As `solve` does.
    """
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
    options = problem.uncertainty
    try:
        uncertainty = uncertainty_of(
            fit, problem.parameters, solution.q, options.noise, options.errors
        )
        profiles = []
        for name in options.profile:
            say(f"profile likelihood of {name}")
            profiles.append(profile_of(solution, fit, uncertainty, name))
    except InputError as error:
        raise error.located(problem.path) from error
    return Run(problem, solution, rollouts, uncertainty, diagnoses, tuple(profiles))
