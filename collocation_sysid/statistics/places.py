"""Places of the markers on the undeformed body as they were found, with their errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..arrays import Array
from ..program.collocation import Part
from .uncertainty import Uncertainty


@dataclass(frozen=True, eq=False)
class Place:
    """Where a marker sits.

    Attributes
    ----------
    position_m : (3,) on the undeformed body
    std_error_m : (3,) or None
        Standard error of each coordinate, zero for a place that is exact; None without error bars.
    prior_m : float
        Standard deviation of the prior of each coordinate, zero for a place that is exact.
    given_m : (3,) or None
        The place that was given; None where it was not known.
    """

    position_m: Array
    std_error_m: Array | None
    prior_m: float
    given_m: Array | None
    TOLD: ClassVar = ("given",)

    @property
    def given(self) -> bool:
        """Whether a place was given."""
        return self.given_m is not None

    @property
    def moved_m(self) -> float | None:
        """How far it was found from the place given."""
        given = self.given_m
        return None if given is None else float(np.linalg.norm(self.position_m - given))


def places_of(part: Part, uncertainty: Uncertainty | None = None) -> dict[str, Place]:
    """Places of an experiment's markers at a solution, by name."""
    segment = part.segment
    chart, markers = segment.chart, segment.experiment.markers
    errors = _std_errors_m(part, uncertainty)
    return {
        name: Place(
            position,
            None if errors is None or not np.isfinite(errors[m]).all() else errors[m],
            float(chart.sigma_m[m]),
            chart.given_m[m] if markers.located[m] else None,
        )
        for m, (name, position) in enumerate(
            zip(markers.names, segment.places_m(part.phi), strict=True)
        )
    }


def _std_errors_m(part: Part, uncertainty: Uncertainty | None) -> Array | None:
    """(M, 3) of the coordinates; on a surface they move together."""
    if uncertainty is None:
        return None
    segment, chart = part.segment, part.segment.chart
    row = {name: k for k, name in enumerate(uncertainty.nuisance)}
    at = np.array([row[name] for name in segment.nuisance.names], dtype=np.int64)
    errors = np.zeros(chart.points_m.shape)
    for m in chart.estimated:
        here = at[segment.markers.place_places[m]]
        of_phi = uncertainty.nuisance_covariance[np.ix_(here, here)]
        along = chart.sigma_m[m] * chart.axes[m]
        errors[m] = np.sqrt(np.einsum("ik,kl,il->i", along, of_phi, along))
    return errors
