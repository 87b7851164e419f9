"""Likely mistakes of one kind of measurement or force, which the features contribute."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from ..methods.solution import Solution
from ..recording.experiment import Experiment
from ..statistics.hypothesis import Hypothesis
from .fit import Candidate, TestedFit


def _nothing(*_: object) -> tuple[()]:
    return ()


@dataclass(frozen=True, eq=False)
class Source:
    """Likely mistakes of one kind of measurement or force.

    Attributes
    ----------
    kind : type
        Class of the measurements, of the obstacles or of the specimens.
    described : callable
        ``described(experiment)``: likely mistakes that the description shows without a fit.
    fitted : callable
        ``fitted(solution)``: those that an inconsistent fit shows.
    candidates : callable
        ``candidates(fit)``: those that may be corrected and fitted again.
    consistent : callable
        ``consistent(solution, deviations)``: those that a consistent fit does not exclude, with the
        standard deviations of effects of the budget that are not the usual ones.
    """

    kind: type
    described: Callable[[Experiment], Iterable[Hypothesis]] = _nothing
    fitted: Callable[[Solution], Iterable[Hypothesis]] = _nothing
    candidates: Callable[[TestedFit], Iterable[Candidate]] = _nothing
    consistent: Callable[[Solution, Mapping[str, float | None]], Iterable[Hypothesis]] = _nothing
