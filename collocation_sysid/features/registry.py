"""Kinds of the measurements, obstacles and specimens of experiments, with their messages."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from ..kinds.kind import Kind
from ..kinds.registry import KINDS, kind_of
from ..recording.experiment import Experiment
from ..statistics.concerns import TOPICS

for _kind in KINDS:
    TOPICS.update(_kind.topics)
    for _code, _message in _kind.messages.items():
        _key, _, _rest = _code.partition("/")
        _messages = {**TOPICS[_key].messages, _rest: _message}
        TOPICS[_key] = replace(TOPICS[_key], messages=_messages)


def present(experiments: Collection[Experiment]) -> list[Kind]:
    """Return the kinds of which experiments have a body, a measurement, an obstacle or a specimen."""
    declared = (each for e in experiments for each in (*e.measurements, *e.obstacles, e.specimen))
    found = {e.body.kind for e in experiments}.union(map(kind_of, declared))
    return [kind for kind in KINDS if kind in found]
