"""Numerical errors of a solution, from solves with half the step and on a mesh twice as fine."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

from ..errors import InputError
from ..fem.refinement import refined
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution
from ..model.schemes import as_scheme
from ..problem import Problem
from ..recording import refinement
from ..statistics.estimates import Estimate
from ..statistics.numerical import Level, Refinement, numerical_errors
from .answer import Answer
from .solving import solve
from .warm_start import Earlier

A = TypeVar("A", bound=Answer)
# Most discretisations of each kind: three show the order of convergence, and a fourth is too large.
MOST_LEVELS = 3
# Last step of the parameters' logarithms at convergence: far below any error bar.
TOLERANCE = 1e-6


def finer_step(problem: Problem) -> Problem:
    """Return the problem with half the time step."""
    return replace(problem, substeps=2 * problem.first_substeps)


def finer_mesh(problem: Problem) -> Problem:
    """Return the problem with every tetrahedron split into eight."""
    bodies = {id(body): refined(body) for body in problem.bodies}
    experiments = [refinement.refined(e, bodies[id(e.body)]) for e in problem.experiments]
    return replace(problem, experiments=experiments)


FINER = {"step": finer_step, "mesh": finer_mesh}


def refine(finished: A, levels: int = 2, say: Callable[[str], None] | None = None) -> A:
    """Return a converged run with its numerical error, see `refinement_of`."""
    answer = Earlier.of(finished.solution)
    problem = replace(finished.problem, substeps=finished.solution.collocation.substeps)
    estimates = finished.optimum
    return replace(finished, refinement=refinement_of(problem, answer, estimates, levels, say))


def refinement_of(
    problem: Problem,
    answer: Earlier,
    estimates: Mapping[str, Estimate],
    levels: int = 2,
    say: Callable[[str], None] | None = None,
    known: Sequence[Level] = (),
    keep: Callable[[Refinement], object] | None = None,
) -> Refinement:
    """Solve again at finer discretisations, each from the previous solution.

    The step and the mesh are refined separately: their errors add up to first order. Finer problems
    are solved by the reduced space, whatever method found the answer.

    Parameters
    ----------
    problem : Problem
    answer : Earlier
        The solution of the problem.
    estimates : mapping of name to Estimate
        Estimates of that solution, with their statistical intervals.
    levels : int
        2 discretisations of each kind, or 3 to observe the orders of convergence.
    say : callable, optional
        Called with a progress message.
    known : sequence of Level
        Levels that were solved before.
    keep : callable, optional
        Called after each level with the refinement so far.

    Raises
    ------
    InputError
        For another number of levels, or where a finer problem is not solved.
    KeyboardInterrupt
        If a solve was interrupted; the levels passed to `keep` are complete.
    """
    if not 2 <= levels <= MOST_LEVELS:
        raise InputError(f"levels = {levels}; expected 2 or {MOST_LEVELS}")
    fitted = [experiment for experiment in problem.experiments if not experiment.validation]
    coarse = replace(problem, experiments=fitted, notes=())
    moving = any(not experiment.static for experiment in fitted)
    solved = {(each.halved, each.times): each for each in known}
    reached: list[Level] = []
    for kind, finer in FINER.items():
        at = coarse
        start = answer
        for level in range(1, levels if moving or kind == "mesh" else 1):  # equilibria have no step
            at = finer(at)
            if (kind, level) in solved:
                reached.append(solved[kind, level])
                start = replace(answer, values={**answer.values, **reached[-1].values})
                continue
            if say is not None:
                say(f"solving again: {kind} halved {level}×")
            solution = _solved(at, start, f"{kind} halved {level}×")
            start = Earlier.of(solution)
            reached.append(_level(kind, level, solution))
            if keep is not None:
                keep(_of_levels(reached, problem, estimates))
    return _of_levels(reached, problem, estimates)


def _of_levels(
    levels: Sequence[Level], problem: Problem, estimates: Mapping[str, Estimate]
) -> Refinement:
    """Return the numerical errors from the levels solved so far."""
    by_step, by_mesh = ([each.values for each in levels if each.halved == kind] for kind in FINER)
    order = as_scheme(problem.scheme).order
    errors = numerical_errors(estimates, by_step, by_mesh, order, problem.parameters.linear)
    return Refinement(errors, tuple(levels))


def _solved(problem: Problem, start: Earlier, what: str) -> Solution:
    """Solve a finer problem in reduced space; `what` names it in the message of the
    `InputError`.
    """
    solution = solve(problem, ReducedSpace(ladder=(1.0,), tolerance=TOLERANCE), start=start)
    if not solution.unless_interrupted().status.converged:
        raise InputError(
            f"the problem with the {what} was not solved ({solution.status.value}: "
            f"{solution.message}); solve it by itself to see why"
        )
    return solution


def _level(kind: str, level: int, solution: Solution) -> Level:
    """Return the summary of a level from its solution.

    Parameters
    ----------
    kind : {"step", "mesh"}
    level : int
        How often it was halved.
    solution : Solution
    """
    segments = solution.collocation.segments
    return Level(
        halved=kind,
        times=level,
        timesteps=sum(segment.grid_rows for segment in segments),
        nodes=sum({id(s.body): len(s.body.nodes_m) for s in segments}.values()),
        iterations=solution.iterations,
        time_s=solution.timing.total,
        values=dict(Earlier.of(solution).values),
    )
