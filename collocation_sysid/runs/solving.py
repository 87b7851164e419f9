"""Solving a problem: where to start, again from elsewhere where that helps, and no checks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..fem.constants import bare, usual_value
from ..methods.reduced_space import ReducedSpace
from ..methods.scan import Scan, rescue, started
from ..methods.solution import Method, Solution, Status, Watch
from ..methods.start import placed_at_guess
from ..methods.workers import Workers, workers_of
from ..model.parameters import Parameters
from ..problem import Problem
from ..program.collocation import Collocation
from ..statistics.cameras import require_depth_units
from ..statistics.fields import fields_by_information
from ..statistics.linearised import values_of
from .check.cost import require_memory
from .several_starts import best_start
from .two_phases import solve_two_phases
from .warm_start import Earlier

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
        is found, for a scheduler that does not answer, and when the solver refuses the problem.
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
        return _likeliest(
            problem, start, partial(_solved, solver=solver, watch=watch, workers=workers)
        )


def _likeliest(
    problem: Problem,
    start: str | Path | Earlier | None,
    solved: Callable[[Problem, str | Path | Earlier | None], Solution],
) -> Solution:
    """Solve with the likeliest of the lengths that fields have to choose from.

    An answer tells, to first order, which of them that is, see `statistics.fields`; with that it is
    solved again from there, until it is the likeliest by its own answer or one that was tried.
    """
    if any(not modes.has_phases for modes in problem.two_phase_fields.values()):
        return solve_two_phases(problem, start, solved)
    solution, tried = solved(problem, start), [problem.lengths_m]
    fields = {part.field for body in problem.bodies for part in body.parts if part.field}
    if all(len(field.field.lengths_m) == 1 for field in fields):
        return solution
    while solution.status.converged:
        known = fields_by_information(solution.collocation, solution.z)
        best = {name: max(f.modes.field.lengths_m, key=f.likelier) for name, f in known.items()}
        if best in tried:
            break
        tried.append(best)
        problem = problem.with_lengths(best)
        solution = solved(problem, Earlier.of(solution))
    return solution


def _solved(
    problem: Problem,
    start: str | Path | Earlier | None,
    solver: Method,
    watch: Watch | None,
    workers: Workers | None,
) -> Solution:
    earlier = Earlier.read(start) if isinstance(start, (str, Path)) else start
    problem = problem if earlier is None else earlier.started(problem)
    try:
        whole, collocation = getattr(solver, "needs_whole_start", False), problem.collocation()
        started_from: list[str] = []
        for experiment in collocation.experiments:
            require_depth_units(experiment)
        if earlier is not None and problem.substeps == "auto":
            collocation = replace(collocation, substeps=earlier.substeps)
        has_guesses = not collocation.parameters.unguessed
        if has_guesses:
            require_memory(problem, collocation, solver)
        collocation, scan = started(collocation, whole)
        if not has_guesses:  # the estimate evaluates the program at a guess
            require_memory(problem, collocation, solver)
        collocation, variables = placed_at_guess(collocation), None
        if earlier is not None and not scan:
            collocation = earlier.placed(collocation)
            variables = earlier.variables(collocation)
        solver = shared(solver, workers)
        solution = None
        if scan is not None:
            begun = best_start(
                solver, collocation, scan, watch, lambda by, of: read_where_found(by, of, watch)
            )
            collocation, scan = placed_at_guess(begun.collocation), begun.scan
            solution = begun.solution
            started_from = [begun.note] if begun.note else []
        if solution is None:
            solution = read_where_found(solver, collocation, watch, variables)
        if scan is None and solution.status in LOST:
            scan, solution = _again(solver, solution, watch)
        if solution.status.converged and earlier is None and solution.method == ReducedSpace.name:
            solution = _from_elsewhere(solver, solution, watch)
    except InputError as error:
        raise error.located(problem.path) from error
    if solution.status is Status.REFUSED:
        reasons = "; ".join(solution.notes)
        raise InputError(f"{solution.message} {reasons}".strip(), problem.path, "solver")
    said = [] if scan is None else [scan.sentence]
    notes = (*said, *started_from, *solution.notes, *_seen(solution))
    return replace(solution, scan=scan or solution.scan, notes=notes)


def _seen(solution: Solution) -> Iterator[str]:
    """How near the surface is to what depth cameras saw, and what of that was left out."""
    for part in solution.parts:
        for reading, looked in part.sights:
            apart_m, seen = reading.apart_m(looked, part.phi), reading.sighting
            said = ", ".join(f"{count} {why}" for why, count in seen.left_out.items() if count)
            off = "count, as none is near enough to the body"
            if seen.used.any():
                off = (
                    f"are off by {1e3 * np.sqrt(np.nanmean(apart_m**2)):.3g} mm (RMS; half of them "
                    f"by less than {1e3 * np.nanmedian(np.abs(apart_m)):.3g})"
                )
            yield (
                f"experiment '{part.segment.experiment.name}': {seen.used.sum()} points of "
                f"'{seen.view.depth.name}' {off}; left out: {said or 'none'}"
            )
        for outline, apart_px in part.outline_distances_px:
            if len(apart_px):
                yield (
                    f"experiment '{part.segment.experiment.name}': {len(apart_px)} points of the "
                    f"body's outline are off the edges in '{outline.sighting.view.depth.name}' by "
                    f"{np.sqrt(np.mean(apart_px**2)):.2g} pixels (RMS)"
                )


def shared(solver: Method, workers: Workers | None) -> Method:
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
    solution = read_where_found(solver, again, watch)
    ended = solution.status.converged or solution.status is Status.INTERRUPTED
    return (scan, solution) if ended else (None, lost)


def _from_elsewhere(solver: Method, first: Solution, watch: Watch | None) -> Solution:
    """The better of an answer and that of a second start, where there is reason for one."""
    other = second_start(first)
    if other is None:
        return first
    again = placed_at_guess(replace(first.collocation, parameters=other))
    second = read_where_found(solver, again, watch)
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


def read_where_found(
    solver: Method, collocation: Collocation, watch: Watch | None, start: Array | None = None
) -> Solution:
    """Solve, and again from there as long as estimates leave where the recordings are read."""
    solution = solver(collocation, watch, start)
    for _ in range(REREADINGS):
        if not solution.status.converged:
            break
        p, positions = solution.collocation.unpack(solution.z)
        collocation, moved = solution.collocation.following(p, positions)
        if collocation is solution.collocation:
            break
        solution = solver(collocation, watch, collocation.pack(moved, positions))
    return solution


# Linear elements lock towards ν = ½: with a smaller modulus and a ratio near one half a body can
# move almost like a stiffer, compressible one. Beyond this Poisson's ratio an answer is looked for
# from the usual one at the same Young's modulus too, and the better counts; less does not lock.
NEARLY_INCOMPRESSIBLE, USUAL = 0.42, 0.3
LAME = ("young_pa", "poisson", "lambda_pa", "mu_pa")


def second_start(solution: Solution) -> Parameters | None:
    """The answer with other Poisson's ratios where those it found are high; None where none is.

    Only ratios that were estimated count, by both of the moduli that tell them.
    """
    collocation, values = solution.collocation, values_of(solution.collocation, solution.q)
    free = {item.name: item for item in collocation.parameters.free}
    changed: dict[str, float] = {}
    for name, ratio in values.items():
        if bare(name) == "poisson" and ratio > NEARLY_INCOMPRESSIBLE:
            region = name.removesuffix("poisson")
            own = [region + each for each in LAME if region + each in free]
            if len(own) == 2 or own == [name]:
                young_pa = values[region + "young_pa"]
                changed |= {each: _usual(each, young_pa) for each in own}
    if not changed or any(not free[n].lower < v < free[n].upper for n, v in changed.items()):
        return None
    return collocation.parameters.with_guess({name: values[name] for name in free} | changed)


def _usual(name: str, young_pa: float) -> float:
    value = USUAL if bare(name) == "poisson" else usual_value(name, young_pa, USUAL)
    assert value is not None
    return value
