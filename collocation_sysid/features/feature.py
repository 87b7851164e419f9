"""Concerns and notes of one kind of measurement or force.

Runs and checks iterate over those of `features.registry.FEATURES` whose kind the recordings have, and call
their functions; they name no feature. A function that a feature does not set contributes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from ..program.collocation import ExperimentIterate
from ..recording.experiment import Experiment
from ..statistics.concerns import Concern, Topic
from .measurements import PredictionErrors


def _nothing(*_: object) -> tuple[()]:
    return ()


@dataclass(frozen=True, eq=False)
class Feature:
    """Contributions of one kind of measurement or force to checks and runs.

    Attributes
    ----------
    kind : type
        Class of the measurements, or of the obstacles.
    topics : mapping of str to Topic
        Topics of concerns that only this feature has, with their messages, by key.
    messages : mapping of str to str
        Messages of its concerns of general topics, by code.
    require_valid : callable
        ``require_valid(experiment)`` raises an `InputError` for data that cannot be fitted.
    guess_concerns : callable
        ``guess_concerns(parts, is_complete)``: concerns about the simulation at the guess, of which
        `is_complete` is false if it ends before the recordings.
    concerns : callable
        ``concerns(parts)``: concerns about the fit of all experiments.
    simulation_concerns : callable
        ``simulation_concerns(name, error)``: concerns about any forward simulation.
    notes : callable
        ``notes(part)``: notes on the fit of one experiment.
    """

    kind: type
    topics: Mapping[str, Topic] = field(default_factory=dict)
    messages: Mapping[str, str] = field(default_factory=dict)
    require_valid: Callable[[Experiment], object] = _nothing
    guess_concerns: Callable[[Sequence[ExperimentIterate], bool], Iterable[Concern]] = _nothing
    concerns: Callable[[Sequence[ExperimentIterate]], Iterable[Concern]] = _nothing
    simulation_concerns: Callable[[str, PredictionErrors], Iterable[Concern]] = _nothing
    notes: Callable[[ExperimentIterate], Iterable[str]] = _nothing
