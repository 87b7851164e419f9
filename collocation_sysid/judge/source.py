"""Likely mistakes of one kind of measurement or force, which the features contribute."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from ..methods.solution import Solution
from ..problem import Problem
from ..program.collocation import Collocation, ExperimentIterate
from ..recording.experiment import Experiment
from ..statistics.hypothesis import Hypothesis
from .fit import Candidate, TestedFit


def _nothing(*_: object) -> tuple[()]:
    return ()


@dataclass(frozen=True, eq=False)
class SimulatedCheck:
    """Simulation at the guess, with which a check compares the description of a problem."""

    problem: Problem  # checked problem
    collocation: Collocation  # its nonlinear program
    # Experiments simulated at the guess, perhaps only their first samples.
    parts: Sequence[ExperimentIterate]
    causes: Sequence[Hypothesis]  # likely errors that are known already
    is_full: bool  # whether comparisons are made however long they take
    # ``fit_s(samples)``, the estimated time [s] to fit the first samples to the markers.
    fit_s: Callable[[int], float]
    report_progress: Callable[[str], None]  # called with progress messages
    # Whether `parts` are simulated; false if a simulation failed, and a body is only moved rigidly
    # with its grasp.
    is_simulated: bool = True


@dataclass(frozen=True, eq=False)
class Source:
    """Likely mistakes of one kind of measurement or force.

    Attributes
    ----------
    described : callable
        ``described(experiment)``: likely mistakes that the description shows without a simulation.
    simulated : callable
        ``simulated(check)``: the same by comparison with a simulation, and notes.
    fitted : callable
        ``fitted(solution)``: the same that the residuals of an inconsistent fit show.
    candidates : callable
        ``candidates(fit)``: those that may be corrected and fitted again.
    consistent : callable
        ``consistent(solution)``: those that a consistent fit does not exclude.
    """

    described: Callable[[Experiment], Iterable[Hypothesis]] = _nothing
    simulated: Callable[[SimulatedCheck], tuple[Sequence[Hypothesis], Sequence[str]]] = lambda _: (
        (),
        (),
    )
    fitted: Callable[[Solution], Iterable[Hypothesis]] = _nothing
    candidates: Callable[[TestedFit], Iterable[Candidate]] = _nothing
    consistent: Callable[[Solution], Iterable[Hypothesis]] = _nothing
