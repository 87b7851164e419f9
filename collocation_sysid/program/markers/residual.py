"""Marker positions measured by motion capture, from node positions x and nuisance parameters φ:

    y = R(a) (Σ_i ℓ_i(τ) h(x_i) − c) + c + d + b,

with the place h(x_i) of the marker on the body at neighbouring samples, Lagrange weights ℓ of up to
five samples at the time of the frame shifted by τ, a rotation R(a) about the pivot c, a translation
d and an offset b; without φ it is h(x_t) if frames have the times of the samples. See `observables`
for h and `model.nuisance_map` for φ.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ...model.nuisance_map import NuisanceMap
from ...recording.markers import Markers
from ...recording.nuisance import PLACE
from ..association import Association
from ..correspondences import Correspondences
from ..measurement_model import MeasurementModel
from ..measurement_residual import MeasurementResidual, RowStencil, lagrange_weights
from ..observables import PointPositions
from .association import MarkerAssociation

# Samples that a time-shifted marker is interpolated from: an error of (ωΔt)⁵ / 3500 of a swing.
NEIGHBOURS = 5


@dataclass(frozen=True, eq=False)
class MarkerResidual(MeasurementResidual):
    """Measurement model of the tracks of all markers of an experiment."""

    observable: PointPositions  # places of the markers on the body at the samples
    markers: Markers  # measured tracks
    # Whether the body rests in its first state before the first time; then a marker of an earlier
    # time is predicted there, otherwise such samples are not compared.
    is_initially_at_rest: bool
    clock_samples: int  # whole samples of the clock's shift

    @classmethod
    def from_markers(
        cls,
        markers: Markers,
        rows: Index,
        nuisance: NuisanceMap,
        association: MarkerAssociation,
        clock_samples: int = 0,
        huber: float | None = None,
        is_initially_at_rest: bool = True,
    ) -> MarkerResidual:
        """Build the measurement model of the markers of an experiment.

        Parameters
        ----------
        rows : (T,) array
            Grid times of the observable, one for each sample.
        clock_samples : int
            Whole samples of the clock's shift.
        huber : float or None
            Threshold of Huber's loss in standard deviations; None means a quadratic loss.
        is_initially_at_rest : bool
            Whether the body is at rest before the first time.
        """
        places = np.full((len(markers.names), association.axes.shape[2]), -1)
        places[association.estimated] = nuisance.indices_of_rows(PLACE).reshape(-1, places.shape[1])
        shifted = np.arange(len(markers.t_s)) + clock_samples
        covered = (shifted < len(rows)) & ((shifted >= 0) | is_initially_at_rest)
        is_compared = markers.is_measured & covered[:, None, None]
        return cls(
            observable=PointPositions(rows, association, coordinate_parameters=places),
            nuisance=nuisance,
            huber=huber,
            names=markers.names,
            t_s=markers.t_s,
            sigmas=markers.sigma_m,
            measured=markers.positions_m,
            is_compared=is_compared,
            own_parameters=nuisance.marker_indices(len(markers.names)),
            markers=markers,
            is_initially_at_rest=is_initially_at_rest,
            clock_samples=clock_samples,
        )

    @property
    def measurement(self) -> Markers:
        return self.markers

    @property
    def is_present(self) -> NDArray[np.bool_]:
        """Mask (T, M) of the samples of which a coordinate is compared."""
        return np.asarray(self.is_compared.any(axis=2))

    # One sample -------------------------------------------------------------------------------

    @cached_property
    def _neighbour_count(self) -> int:
        """1 if no clock is estimated, and all frames have the times of their samples."""
        is_shifted = len(self.nuisance.clock_indices) > 0 or self.markers.offsets_s is not None
        return min(NEIGHBOURS, self.observable.count) if is_shifted else 1

    @cached_property
    def _offsets_s(self) -> Array:
        """Time (T,) of each frame less that of its sample [s]."""
        offsets_s = self.markers.offsets_s
        return np.zeros(len(self.t_s)) if offsets_s is None else offsets_s

    @cached_property
    def _first_neighbour(self) -> Index:
        """Index (T,) of the first time for each sample; negative before the start, at rest."""
        first = np.arange(len(self.t_s)) + self.clock_samples - self._neighbour_count // 2
        first = np.minimum(first, self.observable.count - self._neighbour_count)
        return first if self.is_initially_at_rest else np.maximum(first, 0)

    @cached_property
    def _neighbour_indices(self) -> Index:
        """Indices (T, neighbours) of the samples that each one is interpolated from."""
        return np.maximum(self._first_neighbour[:, None] + np.arange(self._neighbour_count), 0)

    @cached_property
    def _stencil(self) -> RowStencil:
        """Data are the position of the frame among its neighbours, in samples, and its time [s]."""
        count = len(self.markers.names)
        indices = np.arange(len(self.t_s)) - self._first_neighbour
        place = np.array(
            [indices + self._offsets_s / self.nuisance.interval_s, self.t_s + self._offsets_s]
        )
        places = self._neighbour_indices[:, None] * count + np.arange(count)[:, None]
        return RowStencil(places, np.repeat(place[..., None], count, axis=2))

    def stencil(self, phi: Array, known: int) -> RowStencil:
        samples = int(np.count_nonzero(self._neighbour_indices[:, -1] < known))
        return RowStencil(self._stencil.indices[:samples], self._stencil.data[:, :samples])

    def expression(self, values: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        place, t_s = ca.vertsplit(data)
        own = self.own_parameters[0] if len(self.own_parameters) else np.zeros(0, dtype=np.int64)
        value = values[:, 0]
        if self._neighbour_count > 1:
            late = self.nuisance.marker_delay_s(phi, own, t_s=t_s) / self.nuisance.interval_s
            places = [ca.SX(k) for k in range(self._neighbour_count)]
            value = values @ ca.vertcat(*lagrange_weights(place + late, places))
        return self.nuisance.marker_measurement(value, phi, places=own, t_s=t_s)

    # Of positions -----------------------------------------------------------------------------

    def predict_positions(self, x: Array, phi: Array) -> Array:
        """Return predictions (t, M, 3) [m] at φ (k,) from the first grid positions x (rows, 3n)
        [m], for the t samples that they suffice for.
        """
        return self.predict(self.observable.evaluate_positions(x, phi), phi)

    def squared_distances_m2(self, x: Array, phi: Array) -> Array:
        """Return the squared distances [m²], along the measured coordinates, of predictions at
        positions x (rows, 3n) and φ (k,) from the P samples that are compared, flat, time by time;
        samples after the last row are omitted. Infinite for a trial step whose motion diverges.
        """
        predicted = self.predict_positions(x, phi)
        tracks = self.markers.positions_m[: len(predicted)]
        present = self.is_present[: len(predicted)]
        with np.errstate(over="ignore"):
            squares = np.where(self.is_compared[: len(predicted)], (predicted - tracks) ** 2, 0.0)
            return np.sum(squares, axis=2)[present]


class MarkerModel(MeasurementModel):
    """Markers of an experiment, whose places are those of the association."""

    measurement: Markers

    def residuals(
        self, association: Association, correspondences: Correspondences | None
    ) -> tuple[MarkerResidual]:
        residual = MarkerResidual.from_markers(
            self.measurement,
            self.grid.sample_rows,
            nuisance=self.grid.nuisance,
            association=association.markers,
            clock_samples=association.clock_samples,
            huber=self.grid.huber,
            is_initially_at_rest=self.grid.is_initially_at_rest,
        )
        return (residual,)
