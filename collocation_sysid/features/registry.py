"""Kinds of the measurements, obstacles and specimens of experiments, with their messages."""

from __future__ import annotations

from collections.abc import Iterable

from ..kinds.kind import Kind
from ..kinds.registry import KINDS, kind_of
from ..recording.experiment import Experiment
from ..statistics.concerns import declare_messages, declare_topics

for _kind in KINDS:
    declare_topics(_kind.topics)
    declare_messages(_kind.messages)


def present(experiments: Iterable[Experiment]) -> list[Kind]:
    """Return the kinds of which experiments have a measurement, an obstacle or a specimen."""
    declared = (each for e in experiments for each in (*e.measurements, *e.obstacles, e.specimen))
    found = {kind_of(each) for each in declared}
    return [kind for kind in KINDS if kind in found]
