"""Record of a running solve: history, time, notes, and the resulting `Solution`; and the best iterate
of all searches, which is the answer after an interruption.

`best_iterate` holds it for a block. Searches and the simulations of a scan offer what they have
reached by `keep`, and `answers_as` states how the answer of a part of a solve becomes one of the
given problem. Offers outside of a block have no effect.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace

import numpy as np

from ..common.array_types import Array
from ..common.limits import TimeLimitReached, unlimited
from ..errors import SimulationError
from ..program.collocation import Collocation
from ..program.stopwatch import Stopwatch
from .solution import Iteration, Solution, Status, Timing, Watch
from .starts.initial_trajectories import initial_variables


class SearchEnded(Exception):
    """Exception that ends a search from within.

    Attributes
    ----------
    status : Status
        Reason.
    message : str
        Sentence for the user; by default that of the status.
    """

    def __init__(self, status: Status, message: str = "") -> None:
        super().__init__(message)
        self.status = status
        self.message = message or status.sentence


# Exceptions that end a search with a status, see `status_of_end`.
SEARCH_ENDS = (SearchEnded, SimulationError, TimeLimitReached, KeyboardInterrupt)


def status_of_end(
    end: SearchEnded | SimulationError | TimeLimitReached | KeyboardInterrupt,
) -> tuple[Status, str]:
    """Return the status and message of a search that one of the `SEARCH_ENDS` has ended.

    `SearchEnded` gives its own status, `SimulationError` gives `NOT_SIMULABLE`,
    `TimeLimitReached` gives `TIME_LIMIT`, and `KeyboardInterrupt` gives `INTERRUPTED`.
    """
    if isinstance(end, SearchEnded):
        return end.status, end.message
    if isinstance(end, KeyboardInterrupt):
        return Status.INTERRUPTED, Status.INTERRUPTED.sentence
    if isinstance(end, TimeLimitReached):
        return Status.TIME_LIMIT, Status.TIME_LIMIT.sentence
    # Another stiffness does not prevent that a surface wrinkles: stretches decide.
    is_physical = end.stability_loss is not None and end.stability_loss.is_surface_instability
    sentence = (
        "The recording cannot be simulated to its end:"
        if is_physical
        else Status.NOT_SIMULABLE.sentence
    )
    return Status.NOT_SIMULABLE, f"{sentence} {end}."


class Recorder:
    """History, clock and notes of one solve.

    Attributes
    ----------
    history : list of Iteration
        Entries so far.
    notes : list of str
        Remarks for the user.
    start_s : float
        `time.perf_counter()` at construction [s].
    answer : callable or None
        Returns the best iterate as a solution; it is kept with each entry, see `keep`.

    Parameters
    ----------
    collocation : Collocation
        Problem; methods replace it when measurements are associated again.
    watch : callable, optional
        Function that is called with every new `Iteration`.
    max_time_s : float
        Time after which `is_late` becomes true [s].
    """

    def __init__(
        self,
        method: str,
        collocation: Collocation,
        watch: Watch | None = None,
        max_time_s: float = np.inf,
    ) -> None:
        self.start_s = time.perf_counter()
        self.method = method
        self.collocation = collocation
        self.watch = watch
        self.max_time_s = max_time_s
        self.history: list[Iteration] = []
        self.notes: list[str] = []
        self.answer: Answer | None = None
        self.stopwatch = Stopwatch()

    def measure_elapsed_s(self) -> float:
        """Return the wall-clock time since the recorder was made [s]."""
        return time.perf_counter() - self.start_s

    def is_late(self) -> bool:
        """Return whether the elapsed time exceeds `max_time_s`."""
        return self.measure_elapsed_s() > self.max_time_s

    def initial_variables(self, start: Array | None) -> Array:
        """Return the initial variables (variables,).

        Parameters
        ----------
        start : (variables,) array or None
            Variables to start from, which are returned themselves. None means a simulation at the
            guess, whose notes on failures are added to `notes`; every parameter must then have a
            guess.
        """
        if start is not None:
            return start
        z, notes = initial_variables(self.collocation)
        self.notes += notes
        return z

    def add_variables(self, number: int, z: Array, loss: float) -> None:
        """Evaluate the problem at variables z, and add the result to the history, see `add`.

        The entry contains the parameters, the misfit, the largest residual of the equations of motion
        [N] and the time since the recorder was made [s].

        Parameters
        ----------
        number : int
            Number of the iteration.
        z : (variables,) array
            Variables.
        loss : float
            Loss L at z, without the scaling of the NLP; it is not evaluated again.
        """
        collocation = self.collocation
        violation_n = max(float(np.abs(r).max(initial=0.0)) for r in collocation.residuals_n(z))
        line = Iteration(
            number,
            loss,
            misfit_of(collocation, loss),
            violation_n=violation_n,
            parameters=collocation.parameters.scalar_values(z[: collocation.nq]),
            time_s=self.measure_elapsed_s(),
        )
        self.add(line)

    def add(self, line: Iteration) -> None:
        """Add an entry to the history and pass it to `watch`, unless that is None; exceptions of
        `watch` are not caught.
        """
        self.history.append(line)
        if self.answer is not None:
            keep(self, self.answer, line.loss, share=line.share)
        if self.watch is not None:
            self.watch(line)

    def solution(
        self,
        status: Status,
        message: str,
        z: Array,
        multipliers: Array | None,
        iterations: int,
        evaluations: int,
    ) -> Solution:
        """Return the solution with the recorded history, times and notes.

        Parameters
        ----------
        message : str
            Sentence for the user.
        z : (variables,) array
            Final variables.
        multipliers : (constraints,) array or None
            Multipliers of the method; None if it has none, and then also in the solution.
        evaluations : int
            Evaluations of whole trajectories.
        """
        return Solution(
            status,
            message,
            method=self.method,
            collocation=self.collocation,
            z=z,
            initial_multipliers=multipliers,
            iterations=iterations,
            history=tuple(self.history),
            timing=Timing.since(self.stopwatch, self.start_s),
            notes=tuple(self.notes),
            evaluations=evaluations,
        )


def misfit_of(collocation: Collocation, loss: float, share: float = 1.0) -> float:
    """Return the root mean square of the residuals in standard deviations, from the loss of a share of
    the time steps.
    """
    return float(np.sqrt(loss / max(1.0, share * collocation.measurement_count)))


def interrupted_solution(method: str, collocation: Collocation, z: Array) -> Solution:
    """Return variables at which no search has ended as an interrupted solution; its history has one
    entry, the evaluation there.
    """
    recorder = Recorder(method, collocation)
    recorder.add_variables(0, z, collocation.objective(z))
    return recorder.solution(
        Status.INTERRUPTED,
        Status.INTERRUPTED.sentence,
        z=z,
        multipliers=np.zeros(collocation.constraint_count),
        iterations=0,
        evaluations=0,
    )


Answer = Callable[[], Solution]
Change = Callable[[Solution], Solution]


class BestIterate:
    """Holder of the best iterate."""

    def __init__(self) -> None:
        self.answer: Answer | None = None
        self.source: object = None
        self.rank: tuple[bool, float, float] = (False, 0.0, float("-inf"))
        self.changes: tuple[Change, ...] = ()
        self.is_of_given_problem = True

    def solution(self) -> Solution:
        """Return the best iterate as an interrupted solution; raise `KeyboardInterrupt` if there is
        none.
        """
        if self.answer is None:
            raise KeyboardInterrupt
        with unlimited():
            solution = self.answer()
        status = Status.INTERRUPTED
        return replace(solution, status=status, message=status.sentence)


_best: ContextVar[BestIterate | None] = ContextVar("best_iterate", default=None)


@contextmanager
def best_iterate() -> Iterator[BestIterate]:
    """Hold the best iterate of the searches in the block; an outer block does not see them."""
    best = BestIterate()
    token = _best.set(best)
    try:
        yield best
    finally:
        _best.reset(token)


@contextmanager
def answers_as(change: Change, of_given_problem: bool = True) -> Iterator[None]:
    """Change the answers that are kept in the block, such as those of a smaller problem, which are
    worse than any of the given one.
    """
    best = _best.get()
    if best is None:
        yield
        return
    outer = best.changes, best.is_of_given_problem
    best.changes = (change, *best.changes)
    best.is_of_given_problem &= of_given_problem
    try:
        yield
    finally:
        best.changes, best.is_of_given_problem = outer


def keep(source: object, answer: Answer, loss: float, share: float) -> None:
    """Keep what a search has reached, unless something better is known.

    A solve of the given problem is better than one of another, one of a larger share of the
    recordings than one of a smaller share, and then the one with the lower loss. What a search
    offers later replaces what it offered before.

    Parameters
    ----------
    source : object
        Search that offers.
    answer : callable
        Returns the solution; called at the end of the block, if at all.
    loss : float
        Its loss, comparable among offers of the same share.
    share : float
        Share of the time steps that are solved, from 0 to 1.
    """
    best = _best.get()
    if best is None:
        return
    rank = (best.is_of_given_problem, share, -loss)
    if source is not best.source and rank < best.rank:
        return
    changes = best.changes

    def changed() -> Solution:
        solution = answer()
        for change in changes:
            solution = change(solution)
        return solution

    best.source, best.rank, best.answer = source, rank, changed
