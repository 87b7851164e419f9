"""One run: solve a problem, verify the answer by simulating forward, and find the error bars."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .arrays import Array
from .check.memory import require_memory
from .check.motion import Motion
from .earlier import Earlier
from .errors import InputError, SimulationError, hint_at
from .experiment.turning import turning_warnings
from .fem.constants import unit_of
from .methods.method import Method, Watch
from .methods.reduced_space import ReducedSpace
from .methods.scan import Scan, rescue, started
from .methods.solution import Solution, Status
from .methods.start import marched, placed_at_guess
from .methods.workers import Workers, workers_of
from .nlp.collocation import Collocation
from .nlp.parameters import Parameters
from .nlp.schemes import as_scheme
from .problem import Problem
from .rollout import Rollout, roll_outs, step_error
from .second_start import USUAL, second_start
from .statistics.cause import Cause
from .statistics.causes import likely_causes
from .statistics.diagnostics import MarkerDiagnosis, diagnose
from .statistics.estimates import Estimate
from .statistics.identifiability import verdicts
from .statistics.linearised import Derived, linearised_fit
from .statistics.numerical import MOST_SUBSTEPS, Refinement
from .statistics.places import Place, places_of
from .statistics.pose_noise import pose_noise_draws
from .statistics.profile import Profile
from .statistics.profiling import profile_of
from .statistics.trust import Trust, cause_concerns, numerical_concerns
from .statistics.uncertainty import Uncertainty, uncertainty_of
from .verdict import concerns, expected_rms_m, motions_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # which takes a while to import

Log = Callable[[str], None]
# How a search ends that went astray; another start may help.
LOST = (
    Status.INFEASIBLE,
    Status.STALLED,
    Status.DIVERGED,
    Status.NUMERICAL_FAILURE,
    Status.NOT_SIMULABLE,
)

# By how much χ² must be lower for another answer to count.
NOTICEABLE = 1e-3
# A solve is repeated so often where markers turn out to sit in other elements.
REREADINGS = 5


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
    causes : tuple of Cause
        What is likely described wrongly, likeliest first.
    refinement : Refinement or None
        What the discretisation does: solved again where that was asked for, else what the step
        does, to first order, from roll-outs with a finer one; None where these are missing.
    missing : str
        What Ctrl-C left out after there was an answer.
    """

    problem: Problem
    solution: Solution
    rollouts: Mapping[str, Rollout | str]
    uncertainty: Uncertainty | None
    diagnoses: tuple[MarkerDiagnosis, ...] = ()
    profiles: tuple[Profile, ...] = ()
    notes: tuple[str, ...] = ()
    causes: tuple[Cause, ...] = ()
    refinement: Refinement | None = None
    missing: str = ""

    def __str__(self) -> str:
        return self.table()

    def __repr__(self) -> str:
        solution = self.solution
        free = [item.name for item in self.problem.parameters.free]
        found = ", ".join(f"{name} = {_with_error(self.estimates[name])}" for name in free)
        rms = f"{1e3 * solution.rms_m:.3g} mm RMS"
        said = f"{solution.method}, {solution.status.value}, {self.trust.verdict}"
        return f"Run({said}: {found}; {rms})"

    @property
    def parameters(self) -> dict[str, float]:
        """Every parameter, by name."""
        return self.solution.parameters

    @property
    def started_from(self) -> Parameters:
        """The parameters with the guesses that the search started from."""
        return self.solution.collocation.parameters

    @cached_property
    def derived(self) -> dict[str, float]:
        """Moduli that follow from the parameters, by name."""
        constants = (segment.constants for segment in self.solution.collocation.segments)
        return dict(Derived.of(constants, self.solution.q).values)

    @cached_property
    def estimates(self) -> dict[str, Estimate]:
        """Parameters and derived moduli, with intervals for all that `interval_holds` names."""
        errors = {} if self.refinement is None else self.refinement.errors
        return {
            name: replace(estimate, ci95=errors[name].ci95) if name in errors else estimate
            for name, estimate in self.noise_estimates.items()
        }

    @property
    def interval_holds(self) -> tuple[str, ...]:
        """What the intervals hold: "noise", and of "step" and "mesh" what is known."""
        if self.uncertainty is None:
            return ()
        return ("noise",) if self.refinement is None else self.refinement.holds

    @cached_property
    def noise_estimates(self) -> dict[str, Estimate]:
        """The same with intervals for the noise alone."""
        found = self.uncertainty
        known = {} if found is None else {**found.estimates, **found.derived}
        values = self.parameters | self.derived
        return {name: known.get(name, Estimate(value)) for name, value in values.items()}

    @cached_property
    def places(self) -> dict[str, dict[str, Place]]:
        """Where the markers sit on the undeformed body, by fitted experiment and by marker."""
        parts = self.solution.collocation.parts(self.solution.z)
        return {p.segment.experiment.name: places_of(p, self.uncertainty) for p in parts}

    @cached_property
    def trust(self) -> Trust:
        """How far the answer can be trusted, in one word, with the reasons."""
        found = concerns(
            self.solution, self.rollouts, self.motions.values(), self.uncertainty, self.diagnoses
        )
        numerical = numerical_concerns(self.estimates, self.refinement)
        if not self.missing:
            return Trust.of((*cause_concerns(self.causes), *found, *numerical))
        interrupted = (f"interrupted: {self.missing}", "doubtful")
        return Trust.of((interrupted, *(found if self.uncertainty is not None else ())))

    @cached_property
    def motions(self) -> dict[str, Motion]:
        """How each experiment's body oscillates with the answer, by name."""
        return motions_of(self.problem, self.solution)

    @property
    def noise_rms_m(self) -> float:
        """RMS distance of the fitted markers that noise of the sigma_m given would leave."""
        return expected_rms_m(self.solution, self.uncertainty)

    def interval(self, name: str) -> tuple[float, float] | None:
        """95 % interval of a parameter or derived modulus; None where there is none.

        It holds what `interval_holds` names.

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
        """Parameters, intervals, what these hold, and the verdict, as the terminal shows them."""
        from .terminal import answer, plain_text  # how it looks is no part of a run

        return plain_text(answer(self))

    def to_frame(self) -> Any:
        """The estimates as a pandas DataFrame, a row each.

        Columns value, std_error, lower, upper, interval_holds, verdict, guess, unit.

        Raises
        ------
        InputError
            Without pandas.
        """
        try:
            pandas = import_module("pandas")
        except ImportError as error:
            raise InputError("a data frame needs pandas: pip install pandas") from error
        items = self.started_from.items
        guesses = {item.name: item.guess for item in items if item.tied is None}
        rows = {}
        for name, estimate in self.estimates.items():
            lower, upper = estimate.ci95 or (np.nan, np.nan)
            rows[name] = {
                "value": estimate.value,
                "std_error": np.nan if estimate.std_error is None else estimate.std_error,
                "lower": lower,
                "upper": upper,
                "interval_holds": "" if estimate.ci95 is None else ", ".join(self.interval_holds),
                "verdict": self.trust.verdict,
                "guess": guesses.get(name, np.nan),
                "unit": unit_of(name),
            }
        return pandas.DataFrame.from_dict(rows, orient="index")

    def plot(
        self, experiment: str | None = None, field: str | None = "von_mises_pa", count: int = 6
    ) -> Figure:
        """Draw the body as it moved, fitted or else simulated with the answer, and its markers.

        Parameters
        ----------
        experiment : str, optional
            By default the first.
        field : {"von_mises_pa", "energy_density_j_m3", "det_f"} or None
            What colours it, element by element; None for its regions.
        count : int
            How many shapes, from the first sample to the last; 20 at most.

        Returns
        -------
        Figure
            Of matplotlib. A notebook shows it, ``savefig`` writes it.

        Raises
        ------
        InputError
            For an unknown experiment or field, a count that cannot be, or a run without motion.
        """
        from .output.animation import chosen  # how it looks is no part of a run
        from .output.portrait import portrait
        from .output.record import replays

        replay = chosen(replays(self), experiment)
        bodies = {each.name: each.body for each in self.problem.experiments}
        return portrait(replay, bodies[replay.name], self.parameters, field, count)

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
    interval = "" if estimate.ci95 is None else " [{:.5g}, {:.5g}]".format(*estimate.ci95)
    return f"{estimate.value:.5g}{error}{interval}"


def solve(
    problem: Problem,
    method: str | Method | None = None,
    watch: Watch | None = None,
    start: str | Path | Earlier | None = None,
    scheduler: str | None = None,
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
    start : str, Path or Earlier, optional
        An earlier answer or the folder of its run, of any mesh or timestep; it takes the place of
        the guesses where names match.
    scheduler : str, optional
        Address of a dask.distributed scheduler, whose workers share the experiments of the search;
        for reduced space only.

    Raises
    ------
    InputError
        For an unknown method, a start that is no run or has no parameter of these, where no start
        is found, for a scheduler that does not answer or has lost its workers, and when the
        solver refuses the problem.
    """
    solver = problem.solver(method)
    if scheduler is not None and not isinstance(solver, ReducedSpace):
        raise InputError(
            f"{getattr(solver, 'name', solver)} does not share its experiments; expected "
            "the method 'reduced-space', or leave the scheduler out",
            None,
            "--scheduler",
        )
    with workers_of(scheduler) as workers:
        return _solved(problem, solver, watch, start, workers)


def _solved(
    problem: Problem,
    solver: Method,
    watch: Watch | None,
    start: str | Path | Earlier | None,
    workers: Workers | None,
) -> Solution:
    earlier = Earlier.read(start) if isinstance(start, (str, Path)) else start
    problem = problem if earlier is None else earlier.started(problem)
    try:
        whole, collocation = getattr(solver, "needs_whole_start", False), problem.collocation()
        require_memory(problem, collocation, solver)
        collocation, scan = started(collocation, whole)
        collocation, variables = placed_at_guess(collocation), None
        if earlier is not None and not scan:
            collocation = earlier.placed(collocation)
            variables = earlier.variables(collocation)
        solver = _shared(solver, workers)
        solution = _read_where_found(solver, collocation, watch, variables)
        if scan is None and solution.status in LOST:
            scan, solution = _again(solver, solution, watch)
        if solution.status.converged and earlier is None and solution.method == ReducedSpace.name:
            solution = _from_elsewhere(solver, solution, watch)
    except InputError as error:
        raise error.located(problem.path) from error
    if solution.status is Status.REFUSED:
        reasons = "; ".join(solution.notes)
        raise InputError(f"{solution.message} {reasons}".strip(), problem.path, "solver")
    if scan is None:
        return solution
    return replace(solution, scan=scan, notes=(scan.sentence, *solution.notes))


def _shared(solver: Method, workers: Workers | None) -> Method:
    """The method with the workers that share its experiments, where there are any."""
    if workers is None or not isinstance(solver, ReducedSpace):
        return solver
    return partial(solver, workers=workers)


def _again(solver: Method, lost: Solution, watch: Watch | None) -> tuple[Scan | None, Solution]:
    """Solve from a scan what could not be solved from its guess; the loser where that fails too."""
    reason = f"the search from the guess was lost ({lost.status.value})"
    whole = getattr(solver, "needs_whole_start", False)
    scan = rescue(lost.collocation, reason, whole)
    if scan is None:
        return None, lost
    again = placed_at_guess(replace(lost.collocation, parameters=scan.parameters))
    found = _read_where_found(solver, again, watch)
    ended = found.status.converged or found.status is Status.INTERRUPTED
    return (scan, found) if ended else (None, lost)


def _from_elsewhere(solver: Method, first: Solution, watch: Watch | None) -> Solution:
    """The better of an answer and that of a second start, where there is reason for one."""
    other = second_start(first)
    if other is None:
        return first
    again = placed_at_guess(replace(first.collocation, parameters=other))
    second = _read_where_found(solver, again, watch)
    gain = first.history[-1].loss - second.history[-1].loss
    if second.status is Status.INTERRUPTED:
        return replace(first, status=second.status, message=second.message)
    if not second.status.converged or gain <= NOTICEABLE:
        return first
    note = (
        f"Poisson's ratio ended near one half; a second start, from the usual {USUAL}, found an "
        f"answer that fits better (χ² lower by {gain:.3g})"
    )
    return replace(second, notes=(note, *second.notes))


def _read_where_found(
    solver: Method, collocation: Collocation, watch: Watch | None, start: Array | None = None
) -> Solution:
    """Solve, and again from there as long as estimates leave where the recordings are read."""
    solution = solver(collocation, watch, start)
    for _ in range(REREADINGS):
        if not solution.status.converged:
            break
        p, positions = solution.collocation.unpack(solution.z)
        collocation, moved = solution.collocation.following(p)
        if collocation is solution.collocation:
            break
        solution = solver(collocation, watch, collocation.pack(moved, positions))
    return solution


def run(
    problem: Problem,
    method: str | Method | None = None,
    watch: Watch | None = None,
    log: Log | None = None,
    start: str | Path | Earlier | None = None,
    seek_causes: bool = True,
    scheduler: str | None = None,
) -> Run:
    """Solve a problem, simulate every experiment with the answer, and find the error bars.

    Once there is an answer, Ctrl-C ends what comes after it: `Run.missing` says what is left out.

    Parameters
    ----------
    problem : Problem
    method, watch, start, scheduler
        See `solve`.
    log : callable, optional
        Called with what is being done now, a text.
    seek_causes : bool
        Whether a misfit's cause is looked for, see `likely_causes`.

    Raises
    ------
    InputError
        As `solve` does.
    """
    say = log or (lambda _: None)
    found = Run(problem, solve(problem, method, watch, start, scheduler), {}, None)
    missing = "no forward simulation has checked the answer, and there are no error bars"
    try:
        found = _checked(problem, found.solution, say)
        missing = "what comes after the error bars is left out: finer steps, causes of the misfit"
        if problem.substeps == "auto":
            found = _fine_enough(found, problem.solver(method), watch, say, scheduler)
        substeps = found.solution.collocation.substeps
        turns = (t for e in problem.experiments for t in turning_warnings(e, substeps))
        found = replace(found, notes=(*turns, *found.notes), profiles=_profiles(found, say))
        if not seek_causes or found.solution.status is Status.INTERRUPTED:
            return found
        say("looking for causes of the misfit")
        found = replace(found, causes=likely_causes(found.solution))
        if problem.uncertainty.numerical and found.uncertainty is not None:
            from .refine import refine  # which solves, as this module does

            return refine(found, say=say)
        return found
    except KeyboardInterrupt:
        unsimulated = dict.fromkeys((e.name for e in problem.experiments), "interrupted")
        return replace(found, rollouts=unsimulated | dict(found.rollouts), missing=missing)


def _checked(problem: Problem, solution: Solution, say: Log) -> Run:
    """A solution simulated forward, with its error bars, where there are any."""
    say("checking the answer by a forward simulation")
    rollouts = roll_outs(problem, solution)
    if not solution.status.converged:
        return Run(problem, solution, rollouts, None)
    say("finding the error bars")
    try:
        fit = linearised_fit(solution.collocation, solution.z)
        say("finding what noise of the poses does")
        extra, noises = pose_noise_draws(solution.collocation, solution.z)
    except SimulationError as error:
        return Run(problem, solution, rollouts, None, notes=(f"no error bars: {error}",))
    found = Run(problem, solution, rollouts, None, diagnose(fit, extra))
    if not solution.collocation.nq:
        return found
    options = problem.uncertainty
    try:
        uncertainty = uncertainty_of(
            fit, solution.collocation.parameters, solution.q, options.noise, options.errors, extra
        )
    except InputError as error:
        raise error.located(problem.path) from error
    found = replace(found, uncertainty=uncertainty, notes=tuple(n.sentence for n in noises))
    estimates = found.noise_estimates
    return replace(found, refinement=step_error(problem, solution, fit, rollouts, estimates))


def _profiles(found: Run, say: Log) -> tuple[Profile, ...]:
    """The profile likelihoods that are asked for."""
    asked, profiles = found.problem.uncertainty.profile, []
    if found.uncertainty is None or not asked:
        return ()
    fit = linearised_fit(found.solution.collocation, found.solution.z)
    for name in asked:
        say(f"profile likelihood of {name}")
        try:
            profiles.append(profile_of(found.solution, fit, found.uncertainty, name))
        except InputError as error:
            raise error.located(found.problem.path) from error
    return tuple(profiles)


def _fine_enough(
    coarse: Run, solver: Method, watch: Watch | None, say: Log, scheduler: str | None
) -> Run:
    """The run again from its answer, with as many substeps as its error bars ask for."""
    if coarse.refinement is None:
        return coarse
    first, problem = coarse.solution, coarse.problem
    substeps = coarse.refinement.substeps(coarse.noise_estimates, as_scheme(problem.scheme).order)
    if substeps == 1:
        return coarse
    say(f"solving again with {substeps} steps a sample")
    worst, many = coarse.refinement.worst(coarse.noise_estimates)
    why = f"with one step a sample, the step moves {worst} by {many:.2g} standard errors"
    again = replace(first.collocation, substeps=substeps)
    p, _ = first.collocation.unpack(first.z)
    try:
        require_memory(problem, again, solver)
        positions, failure = marched(again, p)
        if failure is not None:
            raise failure
        with workers_of(scheduler) as workers:
            shared = _shared(solver, workers)
            finer = _read_where_found(shared, again, watch, again.pack(p, positions))
        message = finer.message
    except (InputError, SimulationError) as error:
        finer, message = None, str(error)
    if finer is not None and finer.status is Status.INTERRUPTED:
        raise KeyboardInterrupt  # the first answer is whole
    if finer is None or not finer.status.converged:
        note = f"{why}; with {substeps} it was not solved: {message}"
        return replace(coarse, notes=(note, *coarse.notes))
    most = ", the most that are chosen" if substeps == MOST_SUBSTEPS else ""
    said = f"{why}; so it was solved again with {substeps}{most}"
    return _checked(problem, finer.after(first, said), say)
