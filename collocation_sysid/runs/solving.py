"""Solving a problem: choice of the start, and repetition from other starts where that helps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Protocol

from numpy.typing import ArrayLike

from ..common.array_types import Array
from ..common.limits import TimeLimitReached, time_limit
from ..common.step_counting import search_activity
from ..common.validated_classes import validated
from ..errors import InputError
from ..features.measurements import present
from ..features.registry import FEATURES
from ..fem.laws.constants import symbol_of, unit_of, without_region
from ..methods.experiment_executors import ExperimentExecutor, connect_executor
from ..methods.interior_point import InteriorPoint
from ..methods.reduced_space import UNLIMITED_S, ReducedSpace
from ..methods.solution import Method, Solution, Status, Watch, multipliers_at
from ..methods.solve_recorder import answers_as, best_iterate, keep
from ..methods.starts.initial_trajectories import associated_at_guess
from ..methods.starts.start import Scan, Start
from ..methods.starts.stiffness_scan import EXPLAINED, rescue, start_problem
from ..problem import Problem
from ..program.collocation import Collocation
from ..statistics.field_estimates import field_estimates_at
from .branch_order import with_ascending_times
from .check.cost import require_memory
from .facts import facts, sentences
from .forward_simulation import fit_misfits
from .several_starts import (
    KnownMinimum,
    follow_starts,
    second_start,
    start_beyond_bounds,
    until_known,
    without_limitless_shares,
)
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
# Outcomes of a failed search, after which another start may help.
FAILED_STATUSES = (
    Status.INFEASIBLE,
    Status.STALLED,
    Status.DIVERGED,
    Status.NUMERICAL_FAILURE,
    Status.NOT_SIMULABLE,
)
# Outcomes after which no other start is tried.
FINAL_STATUSES = (
    Status.REFUSED,
    Status.TIME_LIMIT,
    Status.CLUSTER_DISCONNECTED,
    Status.NOT_SIMULABLE,
)
# Least decrease of χ² for which the solution from a second start is preferred.
LEAST_GAIN = 1e-3
# Most searches that continue beyond a default bound: those of two shares of memory and a modulus.
MOST_BOUNDS = 3
# Most iterations of each: those that found a better fit took 5 to 40.
MOST_BEYOND_BOUNDS = 60
# Least tolerance of a solve on a coarser mesh: below the difference between both meshes.
COARSE_TOLERANCE = 1e-4
# Poisson's ratio from which elements that do not average the volume need many small steps.
INCOMPRESSIBLE = 0.499
# Longest search for a start with such elements if no limit is stated [s].
START_S = 40.0
# Most repetitions of a solve whose estimates change the correspondences of the measurements.
MOST_REREADINGS = 5


@validated
def solve(
    problem: Problem | str | Path,
    method: str | Method | None = None,
    watch: Watch | None = None,
    start: AnyStart | None = None,
    scheduler: str | None = None,
) -> Solution:
    """Solve a problem, without the checks of `run`.

    There may be several searches, one after another: from the results of a scan, if guesses are
    missing or a search from guesses fails; a second one in reduced space, where the first may have
    ended in a worse optimum or on the way, see `several_starts`; with correspondences of measurements that
    the estimates change; with other correlation lengths of fields; and, of a large body,
    one on a coarser mesh first, see `smaller_problem`. `watch` receives the iterations of all of them,
    and one of them gives the solution: its history and counts are of that search alone, and its
    times too, with those of the search on a coarser mesh if it started from there. Nothing is
    written.

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
        solve_once = partial(_solve_once, solver=solver, watch=watch, workers=workers)
        solution = solve_once(problem, start)
        tried = [problem.lengths_m]
        lengths_m = _likeliest_lengths(problem, solution)
        while lengths_m is not None and lengths_m not in tried:
            tried.append(lengths_m)
            problem = problem.with_lengths(lengths_m)
            solution = solve_once(problem, WarmStart.of(solution))
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
    smaller: SmallerProblem,
    problem: Problem,
    solver: ReducedSpace,
    watch: Watch | None,
    workers: ExperimentExecutor | None,
) -> Solution:
    """Count iterations on the given problem only, but the times of both solves."""
    rough = replace(solver, tolerance=max(solver.tolerance, COARSE_TOLERANCE))
    as_given = partial(smaller.interrupted, problem)
    with search_activity(smaller.activity), answers_as(as_given, of_given_problem=False):
        try:
            first = _solve_once(smaller.problem, None, rough, watch=watch, workers=workers)
        except InputError as error:
            raise NoStartError(error.message) from error
    search, size = smaller.search
    if not first.status.converged:
        raise NoStartError(f"the {search} {size} ended with: {first.message}")
    collocation = smaller.given_collocation(problem, first)
    try:
        require_memory(problem, collocation, method=solver)
    except InputError as error:
        raise error.located(problem.path) from error
    start = smaller.start(collocation, first)
    method = with_workers(replace(solver, tolerance=smaller.tolerance(solver)), workers)
    solution = solve_with_renewed_correspondences(
        method, start.collocation, watch=watch, start=start.variables
    )
    if solution.status in FAILED_STATUSES:
        raise NoStartError(f"the search from the solution {size} ended with: {solution.message}")
    replaced = [*_feature_notes(solution), *_feature_notes(first)]
    notes = smaller.notes(first, solution, replaced)
    if smaller.has_second_start and solution.status.converged:
        solution = best_of_second_start(method, solution, watch=watch)
    return replace(
        solution,
        scan=first.scan,
        timing=solution.timing + first.timing,
        notes=(*notes, *solution.notes, *_feature_notes(solution)),
    )


def _solve_once(
    problem: Problem,
    warm_start: WarmStart | None,
    solver: Method,
    watch: Watch | None,
    workers: ExperimentExecutor | None,
) -> Solution:
    """Solve with fixed correlation lengths, from guesses, a scan, or an earlier solution."""
    notes: list[str] = []
    if warm_start is None and isinstance(solver, ReducedSpace):
        for kind in (CoarseStart, ThinnedStart):
            try:
                smaller = kind.of(problem, solver)
                if smaller is None:
                    continue
                solution = _solve_from_smaller(smaller, problem, solver, watch, workers)
            except NoStartError as reason:
                notes.append(f"{kind.missing}: {reason}")
            else:
                return replace(solution, notes=(*notes, *solution.notes))
    if warm_start is not None:
        problem = warm_start.apply_to_problem(problem)
    scan: Scan | None = None

    def finished(solution: Solution) -> Solution:
        of_start = [scan.sentence] if scan else []
        return replace(
            solution,
            scan=scan or solution.scan,
            notes=(*notes, *of_start, *solution.notes, *_feature_notes(solution)),
        )

    try:
        start = _program_and_start(problem, solver, warm_start=warm_start)
        scan = start.scan
        solver = with_workers(solver, workers)
        if isinstance(solver, InteriorPoint) and start.multipliers is not None:
            solver = partial(solver, multipliers=start.multipliers)
        solution = None
        with answers_as(finished):
            if scan is not None:
                solve_again = partial(solve_with_renewed_correspondences, watch=watch)
                start, solution = follow_starts(solver, start, scan, solve=solve_again)
                scan = start.scan
                if solution is None:
                    start = replace(start, collocation=associated_at_guess(start.collocation))
            notes += [start.note] if start.note else []
            if solution is None:
                solution = solve_with_renewed_correspondences(
                    solver, start.collocation, watch=watch, start=start.variables
                )
            if start.stated is not None:
                scan, solution = _search_of_stated(solver, start, solution, watch=watch)
            elif scan is None and solution.status in FAILED_STATUSES:
                scan, solution = _solve_from_scan(solver, solution, watch=watch)
            if warm_start is None and solution.method == ReducedSpace.name:
                solution = best_of_second_start(solver, solution, watch=watch)
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
        for feature in present(FEATURES, [experiment]):
            feature.require_valid(experiment)
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
    start = replace(start, collocation=associated_at_guess(start.collocation))
    if warm_start is None:
        return start
    is_whole = isinstance(solver, InteriorPoint) and (
        solver.initial == "simulation" or warm_start.has_multipliers
    )
    warm = warm_start.start(start.collocation, is_whole)
    if is_whole and warm.variables is not None and warm.multipliers is None:
        # Those that belong to the positions.
        warm = replace(warm, multipliers=multipliers_at(warm.collocation, warm.variables))
    return replace(warm, note=start.note)


def _feature_notes(solution: Solution) -> list[str]:
    parts = solution.parts
    features = present(FEATURES, [part.transcription.experiment for part in parts])
    return [note for part in parts for feature in features for note in feature.notes(part)]


def with_workers(solver: Method, workers: ExperimentExecutor | None) -> Method:
    """Return the method `solver` with workers that solve its experiments, as a `functools.partial`
    of it, if it is an instance of `ReducedSpace`; any other method, also a partial of that one, and
    any method if `workers` is None, is returned unchanged.
    """
    if workers is None or not isinstance(solver, ReducedSpace):
        return solver
    return partial(solver, workers=workers)


def _search_of_stated(
    solver: Method, start: Start, of_scan: Solution, watch: Watch | None
) -> tuple[Scan | None, Solution]:
    """Solve from the stated guesses, too, as long as that may fit better than the scan's start."""
    assert start.stated is not None
    stated = Start(start.stated, note="the search from the stated guess")
    method = solver
    if of_scan.status.converged and isinstance(solver, ReducedSpace):
        limited = replace(solver, largest_loss=max(of_scan.history[-1].loss, LEAST_GAIN))
        method = until_known(limited, [of_scan])
    try:
        best = _better_of(method, of_scan, watch, choose=lambda _: stated)
    except KnownMinimum:
        best = of_scan
    return (start.scan if best.z is of_scan.z else None), best


def _solve_from_scan(
    solver: Method, failed: Solution, watch: Watch | None
) -> tuple[Scan | None, Solution]:
    """Solve from the result of a scan after a search from the guess failed."""
    reason = f"the search from the guess failed ({failed.status.value})"
    needs_complete_start = getattr(solver, "needs_complete_start", False)
    scan = rescue(failed.collocation, reason, is_complete=needs_complete_start)
    if scan is None:
        return None, failed
    again = associated_at_guess(failed.collocation.with_parameters(scan.parameters))
    solution = solve_with_renewed_correspondences(solver, again, watch=watch)
    return (scan, solution) if solution.status.converged else (None, failed)


def best_of_second_start(solver: Method, first: Solution, watch: Watch | None) -> Solution:
    """Return the best of a solution, of the solution from its `second_start`, and of the one that
    continues at default bounds, see `start_beyond_bounds`; with a note on each that is better.

    Another solution is better if it converges, and the one before did not or has a χ² that is
    higher by more than `LEAST_GAIN`, an absolute difference. There is no other search after one
    that was refused, or ended at the limit of time.

    Otherwise `first` itself is returned. The history, counts and times of the result are those of its
    own search alone. Exceptions of the method are not caught.

    Parameters
    ----------
    solver : Method
        Method to use, also with workers, see `with_workers`.
    watch : callable or None
        Called with every iteration of the other searches.
    """
    best = _better_of(solver, first, watch, choose=second_start)
    return continued_beyond_bounds(solver, best, watch)


def continued_beyond_bounds(solver: Method, first: Solution, watch: Watch | None) -> Solution:
    """Return the better of a solution and of the one that continues at default bounds, as
    `best_of_second_start`; shares of memory without limit are then held, as of a liquid.
    """
    best, short = first, solver
    if isinstance(solver, ReducedSpace):
        most = min(solver.max_iterations, MOST_BEYOND_BOUNDS)
        short = replace(solver, max_iterations=most)
    for _ in range(MOST_BOUNDS):
        better = _better_of(short, best, watch, choose=start_beyond_bounds)
        moved, best = better.z is not best.z, better
        if not moved:  # the same start would be searched again
            break
    limited = without_limitless_shares(best) if best.status.converged else None
    if limited is None:
        return best
    again = _search(solver, best.collocation.with_parameters(limited), watch)
    if not again.history or again.history[-1].loss > best.history[-1].loss + LEAST_GAIN:
        return best
    # A restart at the optimum may find no decrease that exceeds rounding.
    return replace(again, status=best.status, message=best.message, notes=best.notes)


def _better_of(
    solver: Method, first: Solution, watch: Watch | None, choose: Callable[[Solution], Start | None]
) -> Solution:
    """Return the better of a solution and of that from the start chosen for it."""
    if first.status in FINAL_STATUSES or not first.history:
        return first
    other = choose(first)
    if other is None:
        return first
    again = associated_at_guess(other.collocation)
    second = solve_with_renewed_correspondences(solver, again, watch=watch)
    gain = first.history[-1].loss - second.history[-1].loss if second.history else 0.0
    if first.status.converged and not second.status.converged and gain > LEAST_GAIN:
        note = (
            f"{other.note} fitted better (χ² lower by {gain:.3g}), but did not converge: "
            f"{second.message}"
        )
        return replace(first, notes=(*first.notes, note))
    if not second.status.converged or (first.status.converged and gain <= LEAST_GAIN):
        return first
    note = f"{other.note} found a better fit (χ² lower by {gain:.3g})"
    if not first.status.converged:
        note = f"{other.note} converged, after a first search that did not"
    return replace(second, notes=(note, *second.notes))


def solve_with_renewed_correspondences(
    solver: Method, collocation: Collocation, watch: Watch | None, start: Array | None = None
) -> Solution:
    """Solve, and repeat while estimates change the correspondences of the measurements.

    These are the elements of markers, the correspondences of points, and the sample intervals of
    clocks. There are at most `MOST_REREADINGS` repetitions, and none after a solve that does not
    converge. The last solution is returned, also if it has not converged; its history, counts and
    times are those of the last solve alone.

    Parameters
    ----------
    solver : Method
        Method to use, whose exceptions are not caught.
    collocation : Collocation
        Program with guesses; not modified.
    watch : callable or None
        Called with every iteration.
    start : (variables,) array, optional
        Start of the first solve; by default the method chooses it from the guesses.

    Raises
    ------
    KeyboardInterrupt
        If a solve was interrupted; its best iterate is kept, see `best_iterate`.
    """
    solution = _search(solver, collocation, watch, start)
    for _ in range(MOST_REREADINGS):
        if not solution.status.converged:
            break
        p, positions = solution.collocation.unpack(solution.z)
        collocation, moved = solution.collocation.follow_estimates(p, positions)
        if collocation is solution.collocation:
            break
        solution = _search(solver, collocation, watch, collocation.pack(moved, positions))
    return solution


def _search(
    solver: Method, collocation: Collocation, watch: Watch | None, start: Array | None = None
) -> Solution:
    solution = solver(collocation, watch, start)
    loss, share = float("inf"), 0.0
    if solution.history:
        loss, share = solution.history[-1].loss, solution.history[-1].share
    keep(solution, lambda: solution, loss, share)
    return solution.unless_interrupted()
