"""Searches of one program from several starts, one after another, of which the best counts.

The first start is the guess, the best of a scan or the answer of an easier problem, see
`smaller_problem`. Further ones are a list of functions, see `several_starts`: each returns a start that
may lead to a better solution than the best so far, or None. All searches share the method, the display,
one clock and one history.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..common.array_types import Array
from ..methods.experiment_executors import ExperimentExecutor
from ..methods.interior_point import InteriorPoint
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Iteration, Method, Solution, Status, Watch
from ..methods.solve_recorder import answers_as, keep
from ..methods.starts.initial_trajectories import associated_at_guess
from ..methods.starts.start import Start
from ..program.collocation import Collocation

# Least decrease of χ² for which the solution from another start is preferred.
LEAST_GAIN = 1e-3
# Difference of losses below which two solutions are the same minimum with other correspondences:
# in simulated recordings they differ by up to 5.
SAME_LOSS = 10.0
# Relative difference of loss and all parameters below which a search is where another one was, and need
# not continue. A first share of a recording determines parameters to several per cent.
SAME_PARAMETERS = 0.1
# Most repetitions of a search whose estimates change the correspondences of the measurements.
MOST_REREADINGS = 5
# Outcomes after which no other start is tried.
FINAL_STATUSES = (Status.REFUSED, Status.TIME_LIMIT, Status.CLUSTER_DISCONNECTED)

NextStart = Callable[[Solution], Start | None]


class KnownMinimum(Exception):
    """A search has arrived where another one was."""


@dataclass(frozen=True, eq=False)
class Searches:
    """Method of all searches, the function `watch` that receives every iteration, and the workers
    that solve the experiments of the method reduced-space.
    """

    method: Method
    watch: Watch | None = None
    workers: ExperimentExecutor | None = None

    def once(self, start: Start, best: Solution | None = None) -> Solution:
        """Search, and repeat while estimates change the correspondences of the measurements:
        elements of markers, correspondences of points, and sample intervals of clocks.

        There are at most `MOST_REREADINGS` repetitions, and none after a search that does not
        converge; history, counts and times are those of the last one.

        Raises
        ------
        KnownMinimum
            If the search arrives where `best` was, which converged within the same bounds with other
            correspondences.
        KeyboardInterrupt
            If a search was interrupted; its best iterate is kept, see `best_iterate`.
        """
        notes = [start.scan.sentence] if start.scan else []

        def started(solution: Solution) -> Solution:
            return replace(solution, scan=start.scan, notes=(*notes, *solution.notes))

        method = self._method(start, best)
        collocation = start.collocation
        # Correspondences are found by the search, with the motion of its first rows.
        if start.variables is None and not has_correspondences(collocation):
            collocation = associated_at_guess(collocation)
        variables = start.variables
        with answers_as(started):
            for _ in range(1 + MOST_REREADINGS):
                solution = _search(method, collocation, self._watch_until(best, start), variables)
                if not solution.status.converged:
                    break
                p, positions = solution.collocation.unpack(solution.z)
                collocation, p = solution.collocation.follow_estimates(p, positions)
                if collocation is solution.collocation:
                    break
                variables = collocation.pack(p, positions)
        return started(solution)

    def continued(self, best: Solution, further_starts: Iterable[NextStart]) -> Solution:
        """Search from further starts, and return the best solution, with a note on what is better.

        Another solution is better if it converges, and the best one before did not, or has a loss
        that is higher by more than `LEAST_GAIN`. A search ends early where it cannot become better:
        if a part of the recordings has a higher loss than the best solution, or where that was
        found. The history and the times are those of all searches, with that of the returned solution
        last; the counts are its own.
        """
        searched = [best.collocation.parameters]
        for next_start in further_starts:
            start = None if best.status in FINAL_STATUSES else next_start(best)
            if start is None or start.collocation.parameters in searched:
                continue
            searched.append(start.collocation.parameters)
            try:
                best = _better(best, self.once(start, best), start.note)
            except KnownMinimum:
                continue
        return best

    def _method(self, start: Start, best: Solution | None) -> Method:
        method = self.method
        if isinstance(method, InteriorPoint) and start.multipliers is not None:
            return partial(method, multipliers=start.multipliers)
        if not isinstance(method, ReducedSpace):
            return method
        if best is not None and best.status.converged:
            method = replace(method, largest_loss=max(robust_loss(best), LEAST_GAIN))
        return method if self.workers is None else partial(method, workers=self.workers)

    def _watch_until(self, best: Solution | None, start: Start) -> Watch | None:
        if best is None or not (best.status.converged and has_correspondences(start.collocation)):
            return self.watch
        if not _have_same_bounds(best, start):
            return self.watch

        def watch(line: Iteration) -> None:
            if self.watch is not None:
                self.watch(line)
            if is_at(line, best):
                raise KnownMinimum

        return watch


def has_correspondences(collocation: Collocation) -> bool:
    """Return whether a fitted experiment has correspondences, which change during the search and
    can make local minima.
    """
    return any(
        transcription.association.correspondences for transcription in collocation.transcriptions
    )


def robust_loss(solution: Solution) -> float:
    """Return the loss with that of the measurements that the fit excludes."""
    return solution.history[-1].loss + solution.collocation.excluded_loss


def is_at(line: Iteration, solution: Solution) -> bool:
    """Return whether a search is where the search for a solution was."""
    return any(
        line.share == known.share
        and abs(line.loss - known.loss) <= max(SAME_LOSS, SAME_PARAMETERS * known.loss)
        and all(
            np.isclose(value, known.parameters[name], rtol=SAME_PARAMETERS, atol=0)
            for name, value in line.parameters.items()
        )
        for known in solution.history
    )


def _have_same_bounds(best: Solution, start: Start) -> bool:
    mine, others = (
        [(item.lower, item.upper) for item in each.parameters.free]
        for each in (best.collocation, start.collocation)
    )
    return mine == others


def _better(best: Solution, other: Solution, name: str) -> Solution:
    """Return the better solution, with the work of both; `name` is that of the search for the other."""
    if not other.history:
        return best
    gain = robust_loss(best) - robust_loss(other) if best.history else np.inf
    has_converged = other.status.converged
    if has_converged and not best.status.converged:
        note = f"{name} converged, after a first search that did not"
    elif has_converged and gain > LEAST_GAIN:
        note = f"{name} found a better fit (χ² lower by {gain:.3g})"
    else:
        worse = (
            f"{name} fitted better (χ² lower by {gain:.3g}), but did not converge: {other.message}"
        )
        is_noted = best.status.converged and not has_converged and gain > LEAST_GAIN
        notes = (*best.notes, worse) if is_noted else best.notes
        return replace(after(best, other), notes=notes)
    return replace(after(other, best), notes=(note, *other.notes))


def after(solution: Solution, earlier: Solution) -> Solution:
    """Return a solution with history and times of an earlier search before its own; counts are its own."""
    both = solution.after(earlier, "")
    return replace(solution, history=both.history, timing=both.timing)


def _search(
    method: Method, collocation: Collocation, watch: Watch | None, start: Array | None
) -> Solution:
    solution = method(collocation, watch, start)
    loss, share = float("inf"), 0.0
    if solution.history:
        loss, share = solution.history[-1].loss, solution.history[-1].share
    keep(solution, lambda: solution, loss, share)
    return solution.unless_interrupted()
