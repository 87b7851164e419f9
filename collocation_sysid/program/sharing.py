"""Nuisance parameters that several recordings share: one place in p, one prior, one chart.

Recordings share those of a row of the table whose `scope` is the same word in both, and whose
label is: the place of a marker by its name, the pose of the cameras or the clamp by its axis.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..errors import InputError
from ..model.nuisance import Entry, NuisanceMap
from ..recording.experiment import Experiment
from ..recording.nuisance import PLACE, TURN, NuisanceRow
from .charts import Chart

# What a chart has for each marker.
OF_MARKERS = ("given_m", "cells", "points_m", "axes", "crossed", "again")


@dataclass(frozen=True, eq=False)
class Local:
    """Where the φ of an experiment are.

    Attributes
    ----------
    places : (k,) in p = (q, φ_1, φ_2, …), each where the first experiment has it that shares it
    counted : (k,) bool
        Not those of an experiment before.
    pivot_m : (3,) or None
        About what the pose turns, where that is shared.
    """

    places: Index
    counted: NDArray[np.bool_]
    pivot_m: Array | None = None


def locals_of(experiments: Sequence[Experiment], first: int) -> list[Local]:
    """Where the φ of each experiment are in p, in which they begin at `first`.

    Raises
    ------
    InputError
        Where recordings share what is not the same in them.
    """
    found, known, leaders = [], dict[Any, tuple[int, Entry, Experiment]](), dict[Any, Experiment]()
    for experiment in experiments:
        nuisance, scopes = NuisanceMap.of(experiment), experiment.nuisance.scope
        places, before = np.zeros(nuisance.size, dtype=np.int64), first
        for k, entry in enumerate(nuisance.entries):
            scope = scopes.get(entry.row.name)
            # What is not shared is nobody else's.
            which = (len(found), k) if scope is None else (scope, entry.label)
            places[k], other, of = known.setdefault(which, (first, entry, experiment))
            first += places[k] == first
            leader = leaders.setdefault((scope, entry.row), experiment)
            if scope is not None:
                _require_same(leader, experiment, entry.row)
                _require_alike((of, other), (experiment, entry))
        leader = leaders.get((scopes.get(TURN.name), TURN), experiment)
        pivot_m = None if leader is experiment else NuisanceMap.of(leader).pivot_m
        found.append(Local(places, places >= before, pivot_m))
    return found


def _require_same(leader: Experiment, experiment: Experiment, row: NuisanceRow) -> None:
    """Refuse to share what belongs to things that differ."""
    theirs, ours = row.same(leader), row.same(experiment)
    for thing in ours:
        if theirs[thing] != ours[thing]:
            raise _refusal(
                experiment, row, f"'{leader.name}', which has another {thing}", f"the same {thing}"
            )


def _require_alike(one: tuple[Experiment, Entry], other: tuple[Experiment, Entry]) -> None:
    """Refuse one φ with two priors, or a marker's place with two places given."""
    (leader, first), (experiment, second) = one, other
    row, label = second.row, second.label
    if not np.isclose(first.sigma, second.sigma, rtol=1e-9):
        found = f"'{leader.name}', where the {label} has the prior {first.sigma:g}"
        raise _refusal(experiment, row, found, f"the one here, {second.sigma:g}")
    if row == PLACE:
        given = [_given(*one), _given(*other)]
        if not np.allclose(*given, rtol=0, atol=1e-9, equal_nan=True):
            found = f"'{leader.name}', which gives another {label.partition(',')[0]}"
            raise _refusal(experiment, row, found, "the same place given in both, or in neither")


def _given(experiment: Experiment, entry: Entry) -> Array:
    """The place given of a marker, NaN where there is none."""
    markers = experiment.markers
    at = markers.observe(experiment.body.nodes_m)[entry.number]
    return at if markers.located[entry.number] else np.full(3, np.nan)


def _refusal(experiment: Experiment, row: NuisanceRow, found: str, expected: str) -> InputError:
    key = row.key or row.name
    message = f"{key} is shared with {found}; expected {expected}, or a scope of its own"
    return InputError(message, None, f"experiment '{experiment.name}'")


def shared_charts(locals_: Iterable[tuple[Local, NuisanceMap, Chart]]) -> list[Chart]:
    """The charts, those of shared places and clocks as the first that shares them has them."""
    leaders, samples, found = dict[int, tuple[Chart, int]](), dict[int, int](), []
    for local, nuisance, chart in locals_:
        taken = []
        for k in nuisance.places(PLACE):
            number = nuisance.entries[k].number
            leader = leaders.setdefault(int(local.places[k]), (chart, number))
            if leader[0] is not chart:
                taken.append((number, *leader))
        for k in nuisance.of_clock:
            shared = samples.setdefault(int(local.places[k]), chart.samples)
            chart = chart if shared == chart.samples else replace(chart, samples=shared)
        if taken:
            own = {name: getattr(chart, name).copy() for name in OF_MARKERS}
            for name, values in own.items():
                for number, leader, theirs in taken:
                    values[number] = getattr(leader, name)[theirs]
            chart = replace(chart, **own)
        found.append(chart)
    return found
