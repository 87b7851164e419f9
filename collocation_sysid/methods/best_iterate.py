"""The best iterate of all searches of a solve, which is its answer after an interruption.

`best_iterate` holds it for a block. Searches and the simulations of a scan offer what they have
reached by `keep`, and `answers_as` states how the answer of a part of a solve becomes one of the
given problem. Offers outside of a block have no effect.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace

from ..common.time_limit import unlimited
from .solution import Solution, Status

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
