"""Association of the measurements of one experiment with its body and its time grid.

Predictions are smooth functions of the estimates within one element, around one sample of the clock
and for one set of corresponding surface points. An `Association` states which; when estimates leave
it, `Transcription.follow_estimates` returns another one, and the problem stays the same up to the
tolerances of its parts.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from ..common.array_types import Array
from ..model.nuisance_map import NuisanceIndices, NuisanceMap
from ..recording.nuisance import PLACE
from .correspondences import Correspondences
from .markers.association import MarkerAssociation

# The clock leaves its sample when its shift differs by more than this [samples].
SAMPLES_OFF = 1.0
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
class Association:
    """Elements of the markers, sample of the clock, and correspondences of unlabelled points.

    Attributes
    ----------
    markers : MarkerAssociation
        Elements and directions of the marker places.
    clock_samples : int
        Whole samples of the clock's shift.
    correspondences : tuple of Correspondences
        Those of each sensor that measures unlabelled points, in the order of the sensors.
    """

    markers: MarkerAssociation
    clock_samples: int = 0
    correspondences: tuple[Correspondences, ...] = ()

    def centred_at(self, places_m: Array) -> Association:
        """Return the association with the markers centred at places (M, 3) [m] on the undeformed
        body.
        """
        return replace(self, markers=self.markers.centred_at(places_m))

    def updated(
        self,
        markers: MarkerAssociation,
        shift_samples: float,
        correspondences: Sequence[Correspondences],
    ) -> Association:
        """Return the association at other estimates; self if nothing has changed.

        Parameters
        ----------
        markers : MarkerAssociation
            Association of the markers; the present object if it has not changed.
        shift_samples : float
            Shift of the clock over the sample interval. The clock is moved if it differs by more
            than `SAMPLES_OFF`.
        correspondences : sequence of Correspondences
            One for each sensor; the present object where it has not changed.
        """
        clock_samples = self.clock_samples
        if abs(shift_samples - clock_samples) > SAMPLES_OFF:
            clock_samples = round(shift_samples)
        is_same = (
            markers is self.markers
            and clock_samples == self.clock_samples
            and all(
                new is old for new, old in zip(correspondences, self.correspondences, strict=True)
            )
        )
        if is_same:
            return self
        return Association(markers, clock_samples, tuple(correspondences))


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
