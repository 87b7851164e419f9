"""Starts from smaller problems, with fewer unknowns or measurements, which are solved first.

Their answer replaces the scan of the stiffness, the simulations and the horizons of increasing
length on the given problem. The criterion of convergence is that of the given problem, and so is the
answer. The kinds are in `coarse_start` and `thinned_start`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

from ..errors import SimulationError
from ..methods.horizon import Horizon
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution
from ..methods.solve_recorder import interrupted_solution
from ..methods.starts.start import Start
from ..problem import Problem
from ..program.collocation import Collocation

# Largest standard error of a parameter's coordinate, a logarithm as a rule, with which a smaller
# problem determines it.
LARGEST_STANDARD_ERROR = 1.0
# Distance of a coordinate from a bound below which the parameter is at the bound.
BOUND_DISTANCE = 1e-6


class NoStartError(Exception):
    """Reason why a smaller problem gives no start, as a part of a sentence."""


@dataclass(frozen=True, eq=False)
class SmallerProblem(ABC):
    """A smaller problem and its relation to the given one.

    Attributes
    ----------
    missing : str
        Beginning of the note on a start that was not found.
    has_second_start : bool
        Whether there may be another optimum of the given problem.
    """

    missing: ClassVar[str]
    has_second_start: ClassVar[bool]

    problem: Problem  # the smaller problem, with the parameters of the given one

    @classmethod
    @abstractmethod
    def of(cls, problem: Problem, method: ReducedSpace) -> SmallerProblem | None:
        """Return the smaller problem of a given one; None if it would save no time.

        Raises
        ------
        NoStartError
            If it would, but cannot be made.
        """

    @property
    @abstractmethod
    def activity(self) -> str:
        """Name of the search, for progress."""

    @property
    @abstractmethod
    def search(self) -> tuple[str, str]:
        """Name of the search, and the size of the problem with its preposition, for messages."""

    def tolerance(self, method: ReducedSpace) -> float:
        """Return the tolerance of the search on the given problem."""
        return method.tolerance

    @abstractmethod
    def given_collocation(self, problem: Problem, solution: Solution) -> Collocation:
        """Return the program of the given problem with the estimates of a converged solution.

        Raises
        ------
        NoStartError
            If the solution does not determine parameters that it should.
        """

    @abstractmethod
    def start(self, collocation: Collocation, solution: Solution) -> Start:
        """Return the start from a solution, with all variables, in a program of
        `given_collocation`.
        """

    @abstractmethod
    def interrupted_start(self, problem: Problem, solution: Solution) -> Start:
        """Return the present point of an interrupted search, with a note."""

    @abstractmethod
    def notes(self, first: Solution, given: Solution, replaced: Sequence[str]) -> list[str]:
        """Return notes on the solutions of the smaller and of the given problem; `replaced` are
        notes of the first that others replace.
        """

    def interrupted(self, problem: Problem, first: Solution) -> Solution:
        """Return the present point of an interrupted search as an interrupted solution of the given
        problem.
        """
        start = self.interrupted_start(problem, first)
        assert start.variables is not None
        solution = interrupted_solution(ReducedSpace.name, start.collocation, start.variables)
        timing = solution.timing + first.timing
        return replace(solution, notes=(start.note,), scan=first.scan, timing=timing)


def undetermined_names(solution: Solution) -> tuple[str, ...]:
    """Return the names of the estimated parameters, coefficients of fields included, that a
    solution does not determine, in their order.

    They are those within `BOUND_DISTANCE` of a bound, and those with a statistical standard error
    above `LARGEST_STANDARD_ERROR` or not finite, both in the coordinates q of the solver, as a rule
    logarithms. On a mesh that is too coarse, weakly determined parameters compensate its error: a
    search from such values would take many steps. One sweep is needed; where it fails, only bounds
    count.
    """
    collocation = solution.collocation
    q = solution.q
    lower, upper = collocation.parameters.bounds_q
    is_excluded = (q - lower < BOUND_DISTANCE) | (upper - q < BOUND_DISTANCE)
    p, positions = collocation.unpack(solution.z)
    rows = [transcription.grid_times for transcription in collocation.transcriptions]
    try:
        fit = Horizon(collocation, rows).evaluate(p, positions).fit
    except SimulationError:
        pass
    else:
        errors = fit.standard_errors[: len(q)]
        is_excluded |= ~(errors <= LARGEST_STANDARD_ERROR)
    names = zip(collocation.parameters.free, is_excluded, strict=True)
    return tuple(item.name for item, excluded in names if excluded)
