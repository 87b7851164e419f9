"""Solving a problem: choice of the start, and repetition from other starts where that helps."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Protocol

from numpy.typing import ArrayLike

from ..common.limits import TimeLimitReached, time_limit
from ..common.step_counting import search_activity
from ..common.validated_classes import validated
from ..errors import InputError
from ..features.registry import present
from ..fem.laws.constants import symbol_of, unit_of, without_region
from ..methods.experiment_executors import connect_executor
from ..methods.interior_point import InteriorPoint
from ..methods.reduced_space import UNLIMITED_S, ReducedSpace
from ..methods.solution import Method, Solution, Status, Watch, multipliers_at
from ..methods.solve_recorder import answers_as, best_iterate
from ..methods.starts.initial_trajectories import associated_at_guess
from ..methods.starts.start import Start
from ..methods.starts.stiffness_scan import EXPLAINED, start_problem
from ..problem import Problem
from ..statistics.field_estimates import field_estimates_at
from .branch_order import with_ascending_times, without_limitless_shares
from .cost import require_memory
from .facts import facts, sentences
from .forward_simulation import fit_misfits
from .searches import Searches, after
from .several_starts import FAILED_STATUSES, SECOND_STARTS, after_failure, of_scan
from .smaller_problem import CoarseStart, NoStartError, SmallerProblem, ThinnedStart
from .warm_start import WarmStart


class Solved(Protocol):
    """What has a solution, such as a `Run`."""

    @property
    def solution(self) -> Solution: ...


# What `solve` accepts as a start.
AnyStart = (
    str | Path | WarmStart | Solution | Solved | ArrayLike | tuple[ArrayLike, ArrayLike | None]
)
# Poisson's ratio from which elements that do not average the volume need many small steps.
INCOMPRESSIBLE = 0.499
# Longest search for a start with such elements if no limit is stated [s].
START_S = 40.0


@validated
def solve(
    problem: Problem | str | Path,
    method: str | Method | None = None,
    watch: Watch | None = None,
    start: AnyStart | None = None,
    scheduler: str | None = None,
) -> Solution:
    """Solve a problem, without the checks of `run`.

    There may be several searches, one after another, see `searches`: of smaller problems first, see
    `smaller_problem`; from other starts, where the first may have ended in a worse optimum or on the
    way, see `several_starts`; and with other correlation lengths of fields. `watch` receives the
    iterations of all of them. The solution is the best one, with history and times of all searches with
    the last correlation lengths, and counts of its own. Nothing is written.

    Parameters
    ----------
    problem : Problem or path
        Problem to solve, which is not modified, or its file.
    method : str or Method, optional
        A name, or a callable that solves a `Collocation`, such as a method with other options; the
        problem's own by default.
    watch : callable, optional
        Called with every `Iteration`.
    start : Solution, Run, str, Path or arrays, optional
        An earlier solution, its run or the folder of the run, of any mesh or timestep; its values
        replace the guesses of parameters with the same names. Or the variables of
        `problem.collocation()`, alone or in a tuple with the multipliers, such as the x and lam_g of
        `casadi.nlpsol`. With multipliers, which solutions have, IPOPT of `InteriorPoint` begins at
        the positions of the same grids and nodes; other methods simulate the motion.
    scheduler : str, optional
        Address of a dask.distributed scheduler, whose workers share the experiments of the search;
        for reduced space only.

    Returns
    -------
    Solution
        Also if the search failed: see its `status`. After an interruption it is the best iterate of all
        searches and of the scan.

    Raises
    ------
    InputError
        For a custom sensor without values, an unknown method, a start that is no run or shares no
        parameter name, if no start is found, if the machine lacks memory, for a scheduler that does
        not answer or a method that cannot use it, and when the solver refuses the problem.
    SimulationError
        If the equations of motion are singular at a solution with a field whose correlation
        length is searched.
    KeyboardInterrupt
        After an interruption before the first simulation has ended.
    """
    if not isinstance(problem, Problem):
        problem = Problem.read(problem)
    for experiment in problem.experiments:
        experiment.require_measured_values()
    known = sentences(facts(problem))
    solver = problem.solver(method)
    warm_start = None if start is None else WarmStart.from_object(start, problem)
    limit_s = solver.max_time_s if isinstance(solver, ReducedSpace) else float("inf")
    try:
        with best_iterate() as best, time_limit(limit_s):
            try:
                solution = _solve_by(solver, problem, watch, start=warm_start, scheduler=scheduler)
            except KeyboardInterrupt:
                solution = best.solution()
            except TimeLimitReached:
                if best.answer is None or limit_s == UNLIMITED_S:
                    raise
                status = Status.TIME_LIMIT
                solution = replace(best.solution(), status=status, message=status.sentence)
    except TimeLimitReached:
        limit_s = _start_limit_s(problem, solver)
        raise InputError(
            f"no start of the search was found within {limit_s:g} s; raise the limit, "
            f"or give guesses{_incompressible_remedy(problem)}",
            problem.path,
            where="solver.reduced-space.max_time_s",
        ) from None
    if solution.status is Status.TIME_LIMIT:
        remedy = _incompressible_remedy(problem)
        solution = replace(solution, message=solution.message.rstrip(".") + f"{remedy}.")
    if solution.status in (Status.STALLED, Status.ITERATION_LIMIT):
        solution = replace(solution, message=f"{solution.message} {_end_of(solution)}")
    return replace(solution, notes=(*known, *solution.notes))


def _end_of(solution: Solution) -> str:
    """Return where a search ended, and which measurements it cannot explain there."""
    estimated = [item.name for item in solution.collocation.parameters.free_scalars]
    values = [
        f"{symbol_of(name)} = {solution.parameters[name]:.4g} {unit_of(name)}".rstrip()
        for name in estimated
    ]
    misfits = [each for own in fit_misfits(solution).values() for each in own]
    unexplained = [
        f"{each.what} ({each.sigmas:.2g} standard deviations)"
        for each in sorted(misfits, key=lambda each: -each.sigmas)
        if each.sigmas > EXPLAINED
    ]
    measurements = f", where it does not explain {', '.join(unexplained)}" if unexplained else ""
    return f"It ended at {', '.join(values)}{measurements}."


def _start_limit_s(problem: Problem, solver: Method) -> float:
    """`START_S` where none is stated and elements are not made for the Poisson's ratio."""
    limit_s = solver.max_time_s if isinstance(solver, ReducedSpace) else float("inf")
    return START_S if limit_s == UNLIMITED_S and _incompressible_remedy(problem) else limit_s


def _incompressible_remedy(problem: Problem) -> str:
    """Elements that are not made for a ratio near one half make simulations slow; else ""."""
    ratios = [
        item.guess
        for item in problem.parameters.components
        if without_region(item.name) == "poisson" and item.guess and item.guess > INCOMPRESSIBLE
    ]
    if not ratios or all(body.element.mean_dilatation for body in problem.bodies):
        return ""
    return (
        f"; with Poisson's ratio {max(ratios):g} these elements need many small steps: "
        'use element = "tet10-p0"'
    )


def _solve_by(
    solver: Method,
    problem: Problem,
    watch: Watch | None,
    start: WarmStart | None,
    scheduler: str | None,
) -> Solution:
    if scheduler is not None and not isinstance(solver, ReducedSpace):
        raise InputError(
            f"{getattr(solver, 'name', solver)} cannot distribute its experiments to workers; "
            "expected the method 'reduced-space', or no scheduler",
            None,
            where="--scheduler",
        )
    with connect_executor(scheduler) as workers:
        searches = Searches(solver, watch, workers)
        solution = _solve_once(problem, start, searches)
        tried = [problem.lengths_m]
        lengths_m = _likeliest_lengths(problem, solution)
        while lengths_m is not None and lengths_m not in tried:
            tried.append(lengths_m)
            problem = problem.with_lengths(lengths_m)
            solution = _solve_once(problem, WarmStart.of(solution), searches)
            lengths_m = _likeliest_lengths(problem, solution)
        return solution


def _likeliest_lengths(problem: Problem, solution: Solution) -> dict[str, float] | None:
    """Lengths are in metres; None without a choice."""
    fields = {part.field for body in problem.bodies for part in body.parts if part.field}
    has_choice = any(len(field.field.lengths_m) > 1 for field in fields)
    if not has_choice or not solution.status.converged:
        return None
    estimates = field_estimates_at(solution.collocation, solution.z)
    return {
        name: max(f.modes.field.lengths_m, key=f.log_evidence_ratio)
        for name, f in estimates.items()
    }


def _solve_from_smaller(
    smaller: SmallerProblem, problem: Problem, solver: ReducedSpace, searches: Searches
) -> Solution:
    as_given = partial(smaller.interrupted, problem)
    with search_activity(f"search {smaller.size}"), answers_as(as_given, of_given_problem=False):
        try:
            first = _solve_once(smaller.problem, None, searches)
        except InputError as error:
            raise NoStartError(error.message) from error
    if not first.status.converged:
        raise NoStartError(f"the search {smaller.size} ended with: {first.message}")
    start = smaller.start(problem, first)
    try:
        require_memory(problem, start.collocation, method=solver)
    except InputError as error:
        raise error.located(problem.path) from error
    method = replace(solver, tolerance=solver.tolerance_after_coarse)
    solution = replace(searches, method=method).once(start)
    if solution.status in FAILED_STATUSES:
        what = f"the search from the solution {smaller.size}"
        raise NoStartError(f"{what} ended with: {solution.message}")
    own = [*solution.notes, *_notes_of_kinds(solution)]
    known = {*own, *_notes_of_kinds(first)}
    notes = [note for note in smaller.notes(first, solution) if note not in known]
    return replace(after(solution, first), scan=first.scan, notes=(*notes, *own))


def _solve_once(problem: Problem, warm_start: WarmStart | None, searches: Searches) -> Solution:
    """Solve with fixed correlation lengths, from guesses, a scan, or an earlier solution."""
    notes: list[str] = []
    solver = searches.method
    if warm_start is None and isinstance(solver, ReducedSpace):
        for kind in (CoarseStart, ThinnedStart):
            try:
                smaller = kind.of(problem, solver)
                if smaller is None:
                    continue
                solution = _solve_from_smaller(smaller, problem, solver, searches)
            except NoStartError as reason:
                notes.append(f"no smaller problem was solved first: {reason}")
            else:
                return replace(solution, notes=(*notes, *solution.notes))
    if warm_start is not None:
        problem = warm_start.apply_to_problem(problem)

    def finished(solution: Solution) -> Solution:
        own = [*notes, *solution.notes, *_notes_of_kinds(solution)]
        return replace(solution, notes=own)

    try:
        start = _program_and_start(problem, solver, warm_start=warm_start)
        notes += [start.note] if start.note else []
        with answers_as(finished):
            solution = searches.once(start)
            is_complete = getattr(solver, "needs_complete_start", False)
            failed = partial(after_failure, is_complete=is_complete)
            solution = searches.continued(solution, [*of_scan(start), failed])
            is_answer = solution.history and solution.status is not Status.NOT_SIMULABLE
            if warm_start is None and solution.method == ReducedSpace.name and is_answer:
                solution = searches.continued(solution, SECOND_STARTS)
                solution = without_limitless_shares(solution)
            if warm_start is None and any(body.has_memory for body in problem.bodies):
                solution = with_ascending_times(solution, problem.parameters)
    except InputError as error:
        raise error.located(problem.path) from error
    if solution.status is Status.REFUSED:
        reasons = "; ".join(solution.notes)
        raise InputError(f"{solution.message} {reasons}".strip(), problem.path, where="solver")
    return finished(solution)


def _program_and_start(problem: Problem, solver: Method, warm_start: WarmStart | None) -> Start:
    """Return the start of the search in the nonlinear program of a problem."""
    collocation = problem.collocation()
    for experiment in collocation.experiments:
        for kind in present([experiment]):
            kind.require_valid(experiment)
    if warm_start is not None and problem.substeps == "auto":
        collocation = replace(collocation, substeps=warm_start.substeps)
    has_guesses = not collocation.parameters.names_without_guess
    if has_guesses:
        require_memory(problem, collocation, method=solver)
    with time_limit(_start_limit_s(problem, solver)):
        start = start_problem(collocation, getattr(solver, "needs_complete_start", False))
    if not has_guesses:  # the estimate evaluates the program at a guess
        require_memory(problem, start.collocation, method=solver)
    if start.scan is not None:
        return start
    if warm_start is None:
        return start
    start = replace(start, collocation=associated_at_guess(start.collocation))
    is_whole = isinstance(solver, InteriorPoint) and (
        solver.initial == "simulation" or warm_start.has_multipliers
    )
    warm = warm_start.start(start.collocation, is_whole)
    if is_whole and warm.variables is not None and warm.multipliers is None:
        # Those that belong to the positions.
        warm = replace(warm, multipliers=multipliers_at(warm.collocation, warm.variables))
    return replace(warm, note=start.note)


def _notes_of_kinds(solution: Solution) -> list[str]:
    parts = solution.parts
    kinds = present([part.transcription.experiment for part in parts])
    return [note for part in parts for kind in kinds for note in kind.notes(part)]
