"""Numerical errors of a solution, from solves with half the step and on a mesh twice as fine."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

from ..common.step_counting import search_activity
from ..common.validated_classes import validated
from ..common.validated_types import AtLeastOne
from ..errors import InputError
from ..fem.meshes.refinement import refine_body
from ..fem.schemes import as_scheme
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution, Watch
from ..problem import Problem
from ..recording import experiment_refinement
from ..statistics.budget.discretisation_error import (
    Refinement,
    RefinementLevel,
    discretisation_errors,
)
from ..statistics.estimates import Estimate
from .solved_problem import SolvedProblem
from .solving import solve
from .warm_start import WarmStart

A = TypeVar("A", bound=SolvedProblem)
# Largest number of discretisations of each kind, the coarsest included: three show the order of
# convergence, a fourth is too large.
MOST_LEVELS = 3
# Step of the parameters' logarithms at which a solve has converged: far below any error bar.
TOLERANCE = 1e-6


def finer_step(problem: Problem) -> Problem:
    """Return a copy of the problem with half the time step, that is twice the substeps of its first
    solve.
    """
    return replace(problem, substeps=2 * problem.choose_first_substeps())


def finer_mesh(problem: Problem) -> Problem:
    """Return the problem with every tetrahedron of its bodies split into eight, and experiments,
    grasps included, that refer to the new meshes.

    Bodies that experiments share stay shared; specimens without a mesh stay as they are. The
    problem itself is not modified.
    """
    meshed = [each.body for each in problem.experiments if each.specimen is None]
    bodies = {id(body): refine_body(body) for body in {id(b): b for b in meshed}.values()}
    experiments = [
        e
        if e.specimen is not None
        else experiment_refinement.refined_experiment(e, bodies[id(e.body)])
        for e in problem.experiments
    ]
    return replace(problem, experiments=experiments)


REFINEMENTS = {"step": finer_step, "mesh": finer_mesh}


@validated
def refine(
    run: A,
    levels: AtLeastOne = 2,
    report_progress: Callable[[str], None] | None = None,
    watch: Watch | None = None,
) -> A:
    """Return a copy of a converged run with its numerical error; nothing else of the run is changed
    or computed again.

    Parameters
    ----------
    run : SolvedProblem
        Run that has converged, which is not checked; not modified, apart from cached properties.
    levels : int
        Number of discretisations of each kind, see `solve_refined`.
    report_progress : callable, optional
        Called with a progress message before each solve.
    watch : callable, optional
        Called with each iteration of the solves.

    Raises
    ------
    InputError, KeyboardInterrupt
        As in `solve_refined`.
    """
    answer = WarmStart.of(run.solution)
    problem = replace(run.problem, substeps=run.solution.collocation.substeps)
    estimates = run.optimum
    return replace(
        run,
        refinement=solve_refined(
            problem,
            answer,
            estimates=estimates,
            levels=levels,
            report_progress=report_progress,
            watch=watch,
        ),
    )


def solve_refined(
    problem: Problem,
    solution: WarmStart,
    estimates: Mapping[str, Estimate],
    levels: int = 2,
    report_progress: Callable[[str], None] | None = None,
    solved_levels: Sequence[RefinementLevel] = (),
    save_progress: Callable[[Refinement], object] | None = None,
    watch: Watch | None = None,
) -> Refinement:
    """Solve again at finer discretisations, each from the previous solution, and return the
    numerical errors of the estimates with the solved levels.

    The step and the mesh are refined separately: their errors add up to first order. Finer problems
    are solved by the reduced space, whatever method found the answer.

    Equilibria have no step: if all fitted experiments are static, only the mesh is refined.

    Parameters
    ----------
    problem : Problem
        Problem that was solved; its experiments for validation are left out.
    estimates : mapping of name to Estimate
        Estimates of that solution, with their statistical intervals.
    levels : int
        Number of discretisations of each kind, that of `solution` included: 2, or 3 to observe the
        orders of convergence.
    report_progress : callable, optional
        Called with a progress message before each solve.
    solved_levels : sequence of RefinementLevel
        Levels that were solved before, which are used instead of being solved again.
    save_progress : callable, optional
        Called with the refinement so far after each level that is solved, but not after those of
        `solved_levels`.
    watch : callable, optional
        Called with each iteration of the solves.

    Raises
    ------
    InputError
        For another number of levels, where a finer problem is not solved, where no parameter is
        estimated, or where all recordings are specimens without a mesh.
    KeyboardInterrupt
        If a solve was interrupted; the levels passed to `save_progress` are complete.
    """
    if not 2 <= levels <= MOST_LEVELS:
        raise InputError(f"levels = {levels}; expected 2 or {MOST_LEVELS}")
    fitted = [experiment for experiment in problem.experiments if not experiment.validation]
    if not problem.parameters.free:
        raise InputError(
            "no parameter was estimated, and only estimates have a discretisation error; expected "
            "at least one parameter without a fixed value"
        )
    if all(experiment.specimen is not None for experiment in fitted):
        raise InputError(
            "the deformation of specimens is homogeneous and exact, without a mesh and time steps; "
            "expected a recording of a body with a mesh to refine"
        )
    coarse = replace(problem, experiments=fitted, notes=())
    moving = any(not experiment.is_static for experiment in fitted)
    solved = {(each.refined, each.halvings): each for each in solved_levels}
    reached: list[RefinementLevel] = []
    for kind, finer in REFINEMENTS.items():
        at = coarse
        start = solution
        for level in range(1, levels if moving or kind == "mesh" else 1):  # equilibria have no step
            at = finer(at)
            if (kind, level) in solved:
                reached.append(solved[kind, level])
                start = replace(solution, values={**solution.values, **reached[-1].values})
                continue
            what = f"{kind} halved {level}×"
            activity = f"solving again: {what}"
            if report_progress is not None:
                report_progress(activity)
            with search_activity(activity):
                refined = _solve_refined_problem(at, start, what=what, watch=watch)
            start = WarmStart.of(refined)
            reached.append(_level_summary(kind, level, solution=refined))
            if save_progress is not None:
                save_progress(_errors_from_levels(reached, problem, estimates=estimates))
    return _errors_from_levels(reached, problem, estimates=estimates)


def _errors_from_levels(
    levels: Sequence[RefinementLevel], problem: Problem, estimates: Mapping[str, Estimate]
) -> Refinement:
    by_step, by_mesh = (
        [each.values for each in levels if each.refined == kind] for kind in REFINEMENTS
    )
    order = as_scheme(problem.scheme).order
    errors = discretisation_errors(
        estimates,
        by_step,
        by_mesh=by_mesh,
        step_order=order,
        linear=problem.parameters.linear_names,
    )
    return Refinement(errors, tuple(levels))


def _solve_refined_problem(
    problem: Problem, start: WarmStart, what: str, watch: Watch | None
) -> Solution:
    method = ReducedSpace(ladder=(1.0,), tolerance=TOLERANCE)
    solution = solve(problem, method, watch=watch, start=start)
    if not solution.unless_interrupted().status.converged:
        raise InputError(
            f"the refinement with the {what} was not solved ({solution.status.value}: "
            f"{solution.message}); solve the problem with more transcription.substeps or a finer "
            "mesh yourself to find the cause"
        )
    return solution


def _level_summary(kind: str, level: int, solution: Solution) -> RefinementLevel:
    transcriptions = solution.collocation.transcriptions
    return RefinementLevel(
        refined=kind,
        halvings=level,
        timesteps=sum(transcription.grid_times for transcription in transcriptions),
        nodes=sum({id(s.body): len(s.body.nodes_m) for s in transcriptions}.values()),
        iterations=solution.iterations,
        time_s=solution.timing.total,
        values=dict(WarmStart.of(solution).values),
    )
