"""Nuisance parameters shared by several experiments: one entry of p, one prior, one chart.

Experiments share those nuisance parameters whose `scope` is the same word in both, and whose label
is the same: the place of a marker by its name, the pose of the cameras or of the clamp by its axis.
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
    """Indices of an experiment's nuisance parameters φ in p.

    Attributes
    ----------
    places : (k,) array
        Index in p = (q, φ_1, φ_2, …) of each, that of the first experiment that shares it.
    counted : (k,) array of bool
        False for those that an earlier experiment has already.
    pivot_m : (3,) array or None
        Point about which the shared camera pose rotates [m]; None means the experiment's own.
    """

    places: Index
    counted: NDArray[np.bool_]
    pivot_m: Array | None = None


def locals_of(experiments: Sequence[Experiment], first: int) -> list[Local]:
    """Assign the nuisance parameters of each experiment to entries of p.

    Parameters
    ----------
    experiments : sequence of Experiment
        The experiments in their order.
    first : int
        Index in p of the first nuisance parameter.

    Raises
    ------
    InputError
        If experiments share a parameter of things that differ, or with different priors.
    """
    indices = []
    known = dict[Any, tuple[int, Entry, Experiment]]()
    leaders = dict[Any, Experiment]()
    for experiment in experiments:
        nuisance = NuisanceMap.of(experiment)
        scopes = experiment.nuisance.scope
        places = np.zeros(nuisance.size, dtype=np.int64)
        before = first
        for k, entry in enumerate(nuisance.entries):
            scope = scopes.get(entry.row.name)
            # What is not shared is nobody else's.
            which = (len(indices), k) if scope is None else (scope, entry.label)
            places[k], other, of = known.setdefault(which, (first, entry, experiment))
            first += places[k] == first
            leader = leaders.setdefault((scope, entry.row), experiment)
            if scope is not None:
                _require_same(leader, experiment, entry.row)
                _require_alike((of, other), (experiment, entry))
        leader = leaders.get((scopes.get(TURN.name), TURN), experiment)
        pivot_m = None if leader is experiment else NuisanceMap.of(leader).pivot_m
        indices.append(Local(places, places >= before, pivot_m))
    return indices


def _require_same(leader: Experiment, experiment: Experiment, row: NuisanceRow) -> None:
    """Raise InputError if a nuisance parameter is shared by experiments whose objects differ."""
    theirs = row.same(leader)
    ours = row.same(experiment)
    for thing in ours:
        if theirs[thing] != ours[thing]:
            raise _refusal(
                experiment, row, f"'{leader.name}', which has another {thing}", f"the same {thing}"
            )


def _require_alike(one: tuple[Experiment, Entry], other: tuple[Experiment, Entry]) -> None:
    """Raise InputError if a shared φ has two priors, or a shared marker two stated places."""
    leader, first = one
    experiment, second = other
    row = second.row
    label = second.label
    if not np.isclose(first.sigma, second.sigma, rtol=1e-9):
        difference = f"'{leader.name}', where the {label} has the prior {first.sigma:g}"
        raise _refusal(experiment, row, difference, f"the one here, {second.sigma:g}")
    if row == PLACE:
        given = [_given(*one), _given(*other)]
        if not np.allclose(*given, rtol=0, atol=1e-9, equal_nan=True):
            difference = f"'{leader.name}', which gives another {label.partition(',')[0]}"
            raise _refusal(
                experiment, row, difference, "the same place given in both, or in neither"
            )


def _given(experiment: Experiment, entry: Entry) -> Array:
    """Return the stated place (3,) of a marker, NaN if there is none."""
    markers = experiment.markers
    at = markers.observe(experiment.body.nodes_m)[entry.number]
    return at if markers.located[entry.number] else np.full(3, np.nan)


def _refusal(experiment: Experiment, row: NuisanceRow, found: str, expected: str) -> InputError:
    """Return the error message for a parameter that cannot be shared."""
    key = row.key or row.name
    message = f"{key} is shared with {found}; expected {expected}, or a scope of its own"
    return InputError(message, None, f"experiment '{experiment.name}'")


def shared_charts(locals_: Iterable[tuple[Local, NuisanceMap, Chart]]) -> list[Chart]:
    """Return the charts, with shared places and clocks equal to those of the first
    experiment that shares them.
    """
    leaders = dict[int, tuple[Chart, int]]()
    samples = dict[int, int]()
    charts = []
    for local, nuisance, chart in locals_:
        replaced = []
        for k in nuisance.places(PLACE):
            number = nuisance.entries[k].number
            leader = leaders.setdefault(int(local.places[k]), (chart, number))
            if leader[0] is not chart:
                replaced.append((number, *leader))
        for k in nuisance.of_clock:
            shared = samples.setdefault(int(local.places[k]), chart.samples)
            chart = chart if shared == chart.samples else replace(chart, samples=shared)
        if replaced:
            own = {name: getattr(chart, name).copy() for name in OF_MARKERS}
            for name, values in own.items():
                for number, leader, theirs in replaced:
                    values[number] = getattr(leader, name)[theirs]
            chart = replace(chart, **own)
        charts.append(chart)
    return charts
