"""Nuisance parameters shared by several experiments: one entry of p, one prior, one association.

Experiments share those nuisance parameters whose `scope` is the same word in both, and whose label
is the same: the place of a marker by its name, the pose of the cameras or of the clamp by its axis.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array, Index
from ..errors import InputError
from ..model.nuisance_map import NuisanceEntry, NuisanceMap
from ..recording.deviation import Deviation
from ..recording.experiment import Experiment
from ..recording.nuisance import PLACE, POSE_TURN
from .association import Association
from .markers.association import MarkerAssociation

# Attributes of a `MarkerAssociation` with one row for each marker.
OF_MARKERS = (
    "prior_places_m",
    "cells",
    "centre_places_m",
    "axes",
    "crossed_edges",
    "crossing_counts",
)


@dataclass(frozen=True, eq=False)
class NuisanceIndices:
    """Indices of an experiment's nuisance parameters φ in p."""

    # (k,): index in p = (q, φ_1, φ_2, …) of each, that of the first experiment that shares it.
    indices: Index
    # (k,) of bool: false for those that an earlier experiment has already.
    is_first: NDArray[np.bool_]
    # (3,) or None: point about which the shared camera pose rotates [m]; None means the
    # experiment's own.
    pivot_m: Array | None = None


def nuisance_indices(experiments: Sequence[Experiment], first: int) -> list[NuisanceIndices]:
    """Assign the nuisance parameters of each experiment to entries of p.

    A parameter gets a new entry, in the order of the experiments, unless an earlier experiment
    shares it.

    Parameters
    ----------
    first : int
        Index in p of the first nuisance parameter.

    Returns
    -------
    list of NuisanceIndices
        One entry for each experiment.

    Raises
    ------
    InputError
        If experiments share a parameter of objects that differ, with different priors, or a marker
        with different stated places.
    """
    indices = []
    known = dict[Any, tuple[int, NuisanceEntry, Experiment]]()
    leaders = dict[Any, Experiment]()
    for experiment in experiments:
        nuisance = NuisanceMap.from_experiment(experiment)
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
                _require_same_objects(leader, experiment, row=entry.row)
                _require_same_prior((of, other), (experiment, entry))
        leader = leaders.get((scopes.get(POSE_TURN.name), POSE_TURN), experiment)
        pivot_m = None if leader is experiment else NuisanceMap.from_experiment(leader).pivot_m
        indices.append(NuisanceIndices(places, places >= before, pivot_m=pivot_m))
    return indices


def _require_same_objects(leader: Experiment, experiment: Experiment, row: Deviation) -> None:
    theirs = row.same(leader)
    ours = row.same(experiment)
    for entry in ours:
        if theirs[entry] != ours[entry]:
            raise _sharing_error(
                experiment,
                row,
                result=f"'{leader.name}', which has another {entry}",
                expected=f"the same {entry}",
            )


def _require_same_prior(
    one: tuple[Experiment, NuisanceEntry], other: tuple[Experiment, NuisanceEntry]
) -> None:
    """Check that a shared parameter has one prior, a marker one stated place."""
    leader, first = one
    experiment, second = other
    row = second.row
    label = second.label
    if not np.isclose(first.sigma, second.sigma, rtol=1e-9):
        difference = f"'{leader.name}', where the {label} has the prior {first.sigma:g}"
        raise _sharing_error(
            experiment, row, result=difference, expected=f"the same prior as here, {second.sigma:g}"
        )
    if row == PLACE:
        places = [_declared_place(*one), _declared_place(*other)]
        if not np.allclose(*places, rtol=0, atol=1e-9, equal_nan=True):
            difference = (
                f"'{leader.name}', which states another {label.partition(',')[0]} on the body"
            )
            raise _sharing_error(
                experiment,
                row,
                result=difference,
                expected="the same position in both recordings, or in neither",
            )


def _declared_place(experiment: Experiment, entry: NuisanceEntry) -> Array:
    """Return the stated place (3,) of a marker on the undeformed body [m], NaN if there is none."""
    markers = experiment.markers
    at = markers.predict_positions(experiment.body.nodes_m)[entry.number]
    return at if markers.located[entry.number] else np.full(3, np.nan)


def _sharing_error(
    experiment: Experiment, row: Deviation, result: str, expected: str
) -> InputError:
    key = row.key or row.name
    message = f"{key} is shared with {result}; expected {expected}, or a separate scope"
    return InputError(message, None, where=f"experiment '{experiment.name}'")


def shared_associations(
    experiments: Iterable[tuple[NuisanceIndices, NuisanceMap, Association]],
) -> list[Association]:
    """Return the association of each experiment, with shared places and clocks equal to those of
    the first experiment that shares them; an association without such differences is returned as it
    is.

    Parameters
    ----------
    experiments : iterable of (NuisanceIndices, NuisanceMap, Association)
        The experiments in their order.
    """
    leaders = dict[int, tuple[MarkerAssociation, int]]()
    samples = dict[int, int]()
    associations = []
    for local, nuisance, own in experiments:
        association = own
        replaced = []
        for k in nuisance.indices_of_rows(PLACE):
            number = nuisance.entries[k].number
            leader = leaders.setdefault(int(local.indices[k]), (own.markers, number))
            if leader[0] is not own.markers:
                replaced.append((number, *leader))
        for k in nuisance.clock_indices:
            shared = samples.setdefault(int(local.indices[k]), own.clock_samples)
            if shared != association.clock_samples:
                association = replace(association, clock_samples=shared)
        if replaced:
            places = {name: getattr(own.markers, name).copy() for name in OF_MARKERS}
            for name, values in places.items():
                for number, leader, theirs in replaced:
                    values[number] = getattr(leader, name)[theirs]
            association = replace(association, markers=replace(own.markers, **places))
        associations.append(association)
    return associations
