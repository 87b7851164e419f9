"""Complete identification: solve a problem, verify the answer by forward simulation, estimate
errors.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.linalg import LinAlgError

from .common.array_types import Array
from .common.display import plain_text
from .common.limits import TimeLimitReached, time_limit
from .common.step_counting import StepUnit, counted_phase
from .common.validated_classes import validated
from .errors import InputError, SimulationError
from .fem.schemes import as_scheme
from .kinds.specimen.notes import one_kind_notes, stress_offset_notes
from .methods.experiment_executors import connect_executor
from .methods.reduced_space import ReducedSpace
from .methods.solution import Method, Solution, Status, Watch
from .methods.starts.initial_trajectories import simulate_trajectories
from .methods.starts.start import Start
from .problem import Problem
from .program.collocation import Collocation
from .recording.impact_steps import IMPACT_NOTE
from .runs.branch_order import without_limitless_shares
from .runs.cost import require_memory
from .runs.expected_precision import with_measurements
from .runs.forward_simulation import simulate_experiments, step_changes, step_error
from .runs.mesh_resolution import mesh_changes
from .runs.numerical_error import refine
from .runs.result_builder import build_result
from .runs.result_content import Elapsed, Result
from .runs.searches import Searches
from .runs.several_starts import BEYOND_BOUNDS
from .runs.solved_problem import SolvedProblem
from .runs.solving import AnyStart, solve
from .statistics.assessment import impact_step_concerns, rotation_step_concerns
from .statistics.budget.discretisation_error import (
    MESH_ORDER,
    MOST_SUBSTEPS,
    SMALL_SHARE,
    extrapolated,
)
from .statistics.linearised import LinearisedFit, linearise_fit
from .statistics.pose_noise import with_pose_noise
from .statistics.profile_likelihood import Profile, profile_of_solution
from .statistics.residuals.diagnostics import diagnose_markers
from .statistics.uncertainty import uncertainty_from_fit

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # which takes a while to import

Log = Callable[[str], None]


class Run(SolvedProblem):
    """Solved problem with its verification and uncertainties, for display and storage; see
    `SolvedProblem`.
    """

    def __str__(self) -> str:
        """Return the summary of the run as text, as printed in the terminal after a solve."""
        from .result.run_summary import run_summary

        return plain_text(run_summary(self.result))

    @cached_property
    def result(self) -> Result:
        """Content of ``result.json`` as dataclasses, built at the first access."""
        return build_result(self)

    def table(self) -> str:
        """Return parameters, combined intervals, their sources and the verdict as text, as printed
        in the terminal.
        """
        from .result.run_sections import estimate_sections

        return plain_text(estimate_sections(self.result))

    def plot(
        self, experiment: str | None = None, field: str | None = "von_mises_pa", count: int = 6
    ) -> Figure:
        """Draw a sequence of deformed shapes with the markers.

        The shapes are the fitted ones, or those of the forward simulation if the experiment was not
        fitted.

        Parameters
        ----------
        experiment : str, optional
            Name; the first experiment by default.
        field : {"von_mises_pa", "energy_density_j_m3", "det_f"} or None
            Element quantity that is shown by colour; None for the regions.
        count : int
            Number of shapes, from the first sample to the last; 20 at most.

        Returns
        -------
        Figure
            Matplotlib figure. A notebook displays it, ``savefig`` writes it.

        Raises
        ------
        InputError
            For an unknown experiment or field, an invalid count, or a run without motion.
        """
        from .result.animation import experiment_named
        from .result.pictures.shapes import field_shapes
        from .result.run_record import replays

        replay = experiment_named(replays(self), experiment)
        bodies = {each.name: each.body for each in self.problem.experiments}
        return field_shapes(
            replay, bodies[replay.name], constants=self.parameters, field=field, count=count
        )

    def save(self, folder: str | Path, frames: bool = True, pictures: bool = True) -> Path:
        """Write the run folder, completely or not at all, and return its path.

        An earlier run in the folder is replaced. The pictures are drawn after the folder is in its
        place.

        Parameters
        ----------
        frames : bool
            Whether to write ParaView files of the motion.
        pictures : bool
            Whether to draw pictures, which may take as long as the search.

        Raises
        ------
        InputError
            If the folder contains anything other than an earlier run.
        """
        from .result.run_record import write_run

        return write_run(self, self.result, folder, frames=frames, pictures=pictures)


@validated
def run(
    problem: Problem | str | Path,
    method: str | Method | None = None,
    watch: Watch | None = None,
    log: Log | None = None,
    start: AnyStart | None = None,
    seek_causes: bool = True,
    scheduler: str | None = None,
) -> Run:
    """Solve a problem, simulate every experiment with the answer, and estimate uncertainties.

    Once there is an answer, Ctrl-C only ends the steps that follow, as a step does that cannot be
    computed: `Run.omitted_checks` states which results are missing.

    Parameters
    ----------
    problem, method, watch, start, scheduler
        See `solve`.
    log : callable, optional
        Called with a text at the beginning of each step after the solve.
    seek_causes : bool
        Whether to test hypotheses about the cause of a misfit, see `find_misspecifications`.

    Returns
    -------
    Run
        Also if the method did not converge; there are no uncertainties then.

    Raises
    ------
    InputError
        If `solve` raises it, or a stated uncertainty or requested profile is not possible.
    """
    say = log or (lambda _: None)
    began_s = time.perf_counter()
    if not isinstance(problem, Problem):
        problem = Problem.read(problem)
    solver = problem.solver(method)
    limit_s = solver.max_time_s if isinstance(solver, ReducedSpace) else np.inf
    solution = solve(problem, method, watch=watch, start=start, scheduler=scheduler)
    searched_s = time.perf_counter()

    def timed(answer: Run) -> Run:
        """A search with finer steps counts as search."""
        finer_s = answer.solution.timing.total - solution.timing.total
        checks_s = time.perf_counter() - searched_s - finer_s
        return replace(answer, elapsed_s=Elapsed(searched_s - began_s + finer_s, checks_s))

    answer = Run(problem, solution, rollouts={}, uncertainty=None)
    missing = "the result has no error bars and was not checked by a forward simulation"
    with time_limit(max(0.0, limit_s - (searched_s - began_s))):
        try:
            problem = _with_estimated_lengths(problem, solution)
            solution.unless_interrupted()
            answer, fit, steps = _checked(problem, answer.solution, say=say)
            missing = (
                "the steps after the error bars were skipped: a finer time step, and causes "
                "of the misfit"
            )
            if problem.substeps == "auto":
                answer, fit, steps = _fine_enough(
                    answer, fit, steps, solver=solver, watch=watch, say=say, scheduler=scheduler
                )
            answer = _with_problem_notes(answer)
            if answer.uncertainty is not None and fit is not None:
                profiles = profile_likelihoods(answer, fit, say=say)
                if answer.posterior is None:
                    answer = _with_posterior(answer, fit, steps, say=say)
                answer = replace(answer, profiles=profiles)
                answer = _with_added_measurements(answer, say)
                answer = _with_offset_notes(answer, fit)
            if seek_causes:
                from .judge.engine import cause_notes, find_misspecifications

                if not answer.is_consistent:
                    say("testing possible causes of the misfit")
                causes = find_misspecifications(
                    answer.solution, answer.is_consistent, problem.assumed_deviations
                )
                is_explained = answer.is_consistent or any(
                    each.suffices for each in answer.suspects
                )
                tested = () if is_explained else cause_notes(answer.solution, causes)
                answer = replace(answer, causes=causes, notes=(*answer.notes, *tested))
            if problem.uncertainty.numerical and answer.uncertainty is not None:
                answer = refine(answer, report_progress=say, watch=watch)
            return timed(answer)
        except (KeyboardInterrupt, TimeLimitReached, SimulationError, LinAlgError) as end:
            unsimulated = dict.fromkeys((e.name for e in problem.experiments), "interrupted")
            rollouts = unsimulated | dict(answer.rollouts)
            if isinstance(end, TimeLimitReached):
                is_late = answer.solution.status is Status.TIME_LIMIT
                why = answer.solution.message if is_late else f"at the limit of {limit_s:g} s,"
                missing = f"{why} {missing}"
            elif not isinstance(end, KeyboardInterrupt):  # a check must not lose the fit
                missing = f"a check failed ({end}): {missing}"
            return timed(replace(answer, rollouts=rollouts, omitted_checks=missing))


def _with_estimated_lengths(problem: Problem, solution: Solution) -> Problem:
    return problem.with_lengths(
        {
            name: length_m
            for transcription in solution.collocation.transcriptions
            for name, length_m in transcription.body.field_lengths_m.items()
        }
    )


def _with_problem_notes(answer: Run) -> Run:
    problem = answer.problem
    substeps = answer.solution.collocation.substeps
    may_strike = [each for each in problem.experiments if each.obstacles]
    coarse = [
        *(each for e in problem.experiments for each in rotation_step_concerns(e, substeps)),
        *(each for e in may_strike for each in impact_step_concerns(e, substeps)),
    ]
    tests: Iterable[str] = ()
    impacts = ()
    if all(each.specimen for each in problem.experiments):
        tests = one_kind_notes(problem.experiments, problem.parameters)
    if may_strike and problem.substeps == "auto" and problem.choose_first_substeps() > 1:
        impacts = (IMPACT_NOTE.format(substeps),)
    return replace(
        answer, notes=(*(each.message for each in coarse), *impacts, *tests, *answer.notes)
    )


def _with_posterior(
    answer: Run,
    fit: LinearisedFit,
    steps: Sequence[Array] | None,
    say: Log,
    coarse: Solution | None = None,
) -> Run:
    """Replace the statistical uncertainty of the solution by the posterior with all effects; that of
    the mesh is known if it was computed at a solution nearby with longer steps, `coarse`.
    """
    from .judge.augmented_fit import augmented_fit, suspects

    problem, solution = answer.problem, answer.solution
    discretisation: dict[str, Sequence[Array]] = {}
    if steps is not None:
        order = as_scheme(problem.scheme).order
        discretisation["time_step"] = [extrapolated(each[..., None], order) for each in steps]
    rows = _row_count(solution)
    by_mesh = None
    notes = answer.notes
    if not problem.uncertainty.numerical:
        say("estimating the error of the mesh")
        with counted_phase(StepUnit.TIME_STEP, rows):
            changes, by_mesh, note = mesh_changes(problem, coarse or solution, fit)
        notes = (*notes, note) if note else notes
        if by_mesh is not None:
            discretisation["mesh"] = [extrapolated(each, MESH_ORDER) for each in changes]
    say("computing the effects of assumptions")
    # One sweep for the assumptions, and one for the nuisance parameters that are not estimated.
    with counted_phase(StepUnit.TIME_STEP, 2 * rows):
        posterior = augmented_fit(problem, solution, fit, discretisation)
    judged = replace(
        answer, notes=notes, uncertainty=posterior.uncertainty, posterior=posterior, by_mesh=by_mesh
    )
    if judged.is_consistent:
        return judged
    with counted_phase(StepUnit.TIME_STEP, 2 * rows):
        return replace(judged, suspects=suspects(problem, solution, posterior))


def _with_added_measurements(answer: Run, say: Log) -> Run:
    if not answer.vague_constants or answer.uncertainty is None:
        return answer
    say("predicting the effect of another measurement")
    solution = answer.solution
    level = 1.0 if answer.uncertainty.noise == "given" else answer.uncertainty.level.pooled
    found = with_measurements(
        answer.vague_constants,
        solution.collocation,
        solution.z,
        answer.problem.assumed_deviations,
        noise=level,
    )
    added = {
        frozenset(new.determined.names): new.fixes[0]
        for old, new in zip(answer.vague_constants, found, strict=True)
        if new is not old
    }
    return replace(answer, added_measurements=added)


def _with_offset_notes(answer: Run, fit: LinearisedFit) -> Run:
    if not all(each.specimen for each in answer.solution.collocation.experiments):
        return answer
    offsets = stress_offset_notes(fit)
    return replace(answer, notes=(*answer.notes, *offsets))


Checked = tuple[Run, LinearisedFit | None, Sequence[Array] | None]


def _checked(problem: Problem, solution: Solution, say: Log) -> Checked:
    """Return the answer with its statistical uncertainty, the linearised fit, and `step_changes`; the
    fit is None if the solution did not converge or cannot be linearised.
    """
    say("checking the result by a forward simulation")
    rollouts = simulate_experiments(problem, solution)
    if not solution.status.converged:
        return Run(problem, solution, rollouts=rollouts, uncertainty=None), None, None
    say("computing the error bars")
    rows = _row_count(solution)
    try:
        with counted_phase(StepUnit.TIME_STEP, rows):
            own = linearise_fit(solution.collocation, solution.z)
        say("computing the effect of noise of the poses")
        with counted_phase(StepUnit.TIME_STEP, rows):
            fit, noises = with_pose_noise(own, solution.collocation, z=solution.z)
    except SimulationError as error:
        return (
            Run(
                problem,
                solution,
                rollouts=rollouts,
                uncertainty=None,
                notes=(f"no error bars: {error}",),
            ),
            None,
            None,
        )
    answer = Run(
        problem, solution, rollouts, uncertainty=None, fit=own, diagnoses=diagnose_markers(fit)
    )
    parameters = solution.collocation.parameters
    try:
        uncertainty = uncertainty_from_fit(
            fit, parameters, q=solution.q, error_model=problem.uncertainty
        )
    except InputError as error:
        raise error.located(problem.path) from error
    answer = replace(answer, uncertainty=uncertainty, notes=tuple(n.describe() for n in noises))
    return answer, fit, step_changes(problem, solution, rollouts)


def _row_count(solution: Solution) -> int:
    return sum(s.grid_times - s.dynamics.first_row for s in solution.collocation.transcriptions)


def profile_likelihoods(answer: Run, fit: LinearisedFit, say: Log) -> dict[str, Profile]:
    """Return the profile likelihoods that the problem requests, by parameter in that order; the run
    must have uncertainties.

    Raises
    ------
    InputError
        For a name without a profile; the error names the problem file.
    """
    profiles = {}
    assert answer.uncertainty is not None
    for name in answer.problem.uncertainty.profile:
        say(f"profile likelihood of {name}")
        try:
            profiles[name] = profile_of_solution(answer.solution, fit, answer.uncertainty, name)
        except InputError as error:
            raise error.located(answer.problem.path) from error
    return profiles


def _fine_enough(
    coarse: Run,
    fit: LinearisedFit | None,
    steps: Sequence[Array] | None,
    solver: Method,
    watch: Watch | None,
    say: Log,
    scheduler: str | None,
) -> Checked:
    """A parameter at a bound starts from its guess again: coarse steps may have driven it there."""
    first = coarse.solution
    if steps is None or fit is None or coarse.uncertainty is None or not first.collocation.nq:
        return coarse, fit, steps
    known = {**coarse.uncertainty.estimates, **coarse.uncertainty.derived}
    error = step_error(coarse.problem, first, fit, steps, known)
    problem = coarse.problem
    before = first.collocation.substeps
    order = as_scheme(problem.scheme).order
    factor = error.suggested_substeps(known, order)
    is_near = False
    if factor > 1:
        judged = _with_posterior(coarse, fit, steps, say=say)
        is_near = judged.is_consistent
        if is_near:
            coarse = judged
            shares = (line.shares.get("time_step", 0.0) for line in judged.budget.values())
            share = max(shares, default=0.0)
            excess = share / max(1e-9, 1.0 - share) * (1.0 - SMALL_SHARE) / SMALL_SHARE
            factor = ceil(excess ** (0.5 / order))  # of a variance
    substeps = min(before * factor, MOST_SUBSTEPS)
    number = "one time step" if before == 1 else f"{before} time steps"
    worst, many = error.largest_correction(known)
    why = (
        f"with {number} per sample, the estimated time-step error of {worst} is {many:.2g} "
        "standard errors"
    )
    if fit.at_bound[: fit.shared_count].all():
        substeps = MOST_SUBSTEPS
        why = f"with {number} per sample, every parameter ends at a bound"
    if substeps <= before:
        return coarse, fit, steps
    say(f"solving again with {substeps} steps per sample")
    again = replace(first.collocation, substeps=substeps)
    p, _ = first.collocation.unpack(first.z)
    p = np.where(fit.at_bound, again.guess_p, p)
    try:
        require_memory(problem, again, method=solver)
        finer = _solve_from_parameters(again, p, solver=solver, watch=watch, scheduler=scheduler)
        failure = None if finer.status.converged else finer.message
    except (InputError, SimulationError) as error:
        finer = first
        failure = str(error)
    if failure is not None:
        note = f"{why}; the solve with {substeps} steps per sample failed: {failure}"
        return replace(coarse, notes=(note, *coarse.notes)), fit, steps
    most = ", the largest number that is chosen automatically" if substeps == MOST_SUBSTEPS else ""
    reason = f"{why}; therefore the problem was solved again with {substeps} steps per sample{most}"
    answer, fit, steps = _checked(problem, finer.after(first, reason), say=say)
    if is_near and fit is not None and answer.uncertainty is not None:
        answer = _with_posterior(answer, fit, steps, say=say, coarse=first)
    return answer, fit, steps


def _solve_from_parameters(
    collocation: Collocation, p: Array, solver: Method, watch: Watch | None, scheduler: str | None
) -> Solution:
    positions, failure = simulate_trajectories(collocation, p)
    if failure is not None:
        raise failure
    if isinstance(solver, ReducedSpace):
        solver = replace(solver, tolerance=solver.tolerance_after_coarse)
    with connect_executor(scheduler) as workers:
        searches = Searches(solver, watch, workers)
        solution = searches.once(Start(collocation, collocation.pack(p, positions)))
        if isinstance(solver, ReducedSpace):
            # Errors of coarse steps may have hidden that the best value is beyond a default bound.
            solution = searches.continued(solution, BEYOND_BOUNDS)
            solution = without_limitless_shares(solution)
    return solution.unless_interrupted()
