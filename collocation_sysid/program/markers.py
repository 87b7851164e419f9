"""Marker positions measured by motion capture, from node positions x and nuisance parameters φ:

    y = R(a) (Σ_i ℓ_i(τ) h(x_i) − c) + c + d + b,

with the place h(x_i) of the marker on the body at neighbouring samples, Lagrange weights ℓ of up to
five samples at the time shifted by τ, a rotation R(a) about the pivot c, a translation d and an
offset b; without φ it is h(x_t). See `channel` for h and `model.nuisance` for φ.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..model.nuisance import NuisanceMap
from ..recording.markers import Markers
from ..recording.nuisance import PLACE
from .channel import Points
from .charts import Chart
from .reading import Reading, Window, lagrange_weights

# Samples that a time-shifted marker is interpolated from: an error of (ωΔt)⁵ / 3500 of a swing.
NEIGHBOURS = 5


@dataclass(frozen=True, eq=False)
class MarkerReading(Reading):
    """Measurement model of the tracks of all markers of an experiment.

    Attributes
    ----------
    channel : Points
        Places of the markers on the body at the samples.
    markers : Markers
        Measured tracks.
    from_rest : bool
        Whether the body rests in its first state before the first time; then a shifted marker is
        predicted there, otherwise such samples are not compared.
    earlier : int
        Number of the channel's times before the first sample.
    """

    channel: Points
    markers: Markers
    from_rest: bool
    earlier: int

    @classmethod
    def of(
        cls,
        markers: Markers,
        rows: Index,
        nuisance: NuisanceMap,
        chart: Chart,
        huber: float | None = None,
        from_rest: bool = True,
        earlier: int = 0,
    ) -> MarkerReading:
        """Build the measurement model of the markers of an experiment.

        Parameters
        ----------
        markers : Markers
            Measured tracks.
        rows : (T,) array
            Grid times of the observable, one for each sample and `earlier` ones before.
        nuisance : NuisanceMap
            Nuisance parameters of the experiment.
        chart : Chart
            Elements of the markers.
        huber : float or None
            Threshold of Huber's loss in standard deviations; None means a quadratic loss.
        from_rest : bool
            Whether the body is at rest before the first time.
        earlier : int
            Number of `rows` before the first sample.
        """
        places = np.full((len(markers.names), chart.axes.shape[2]), -1)
        places[chart.estimated] = nuisance.places(PLACE).reshape(-1, places.shape[1])
        shifted = earlier + np.arange(len(markers.t_s)) + chart.samples
        covered = (shifted < len(rows)) & ((shifted >= 0) | from_rest)
        is_compared = markers.present & covered[:, None]
        return cls(
            channel=Points(rows, chart, places),
            nuisance=nuisance,
            huber=huber,
            names=markers.names,
            t_s=markers.t_s,
            sigmas=markers.sigma_m,
            measured=markers.positions_m,
            components=np.repeat(is_compared[..., None], 3, axis=2),
            own=nuisance.of_markers(len(markers.names)),
            markers=markers,
            from_rest=from_rest,
            earlier=earlier,
        )

    @property
    def grid_rows(self) -> Index:
        """Grid time (T,) of each sample."""
        return self.channel.rows

    @property
    def place_places(self) -> Index:
        """Indices (M, k) in φ of the markers' places; −1 for exact ones."""
        return self.channel.places

    @property
    def present(self) -> NDArray[np.bool_]:
        """Mask (T, M) of the samples that are compared."""
        return self.components[..., 0]

    # One sample -------------------------------------------------------------------------------

    @property
    def _times(self) -> Index:
        """Index (T,) of each sample among the channel's times."""
        return self.earlier + np.arange(len(self.t_s))

    @cached_property
    def _neighbours(self) -> int:
        """Number of samples that a marker is interpolated from; 1 if no clock is estimated."""
        return min(NEIGHBOURS, self.channel.count) if len(self.nuisance.of_clock) else 1

    @cached_property
    def _first_neighbour(self) -> Index:
        """Index (T,) of the first sample that each one is interpolated from; negative
        before the start.
        """
        first = self._times + self.channel.chart.samples - self._neighbours // 2
        first = np.minimum(first, self.channel.count - self._neighbours)
        return first if self.from_rest else np.maximum(first, 0)

    @cached_property
    def _around(self) -> Index:
        """Indices (T, neighbours) of the samples that each one is interpolated from."""
        return np.maximum(self._first_neighbour[:, None] + np.arange(self._neighbours), 0)

    @cached_property
    def _window(self) -> Window:
        """Stencil of all samples: indices of the neighbouring places, and the data of the
        expression.
        """
        count = len(self.markers.names)
        place = np.array([self._times - self._first_neighbour, self.t_s], dtype=np.float64)
        places = self._around[:, None] * count + np.arange(count)[:, None]
        return Window(places, np.repeat(place[..., None], count, axis=2))

    def window(self, phi: Array, known: int) -> Window:
        """Return the stencil of those first samples for which `known` times of the channel
        suffice.
        """
        samples = int(np.count_nonzero(self._around[:, -1] < known))
        return Window(self._window.places[:samples], self._window.data[:, :samples])

    def later(self, by_s: float) -> MarkerReading:
        """Return the model of samples taken `by_s` seconds later, at the same stencil; self
        if time does not matter.
        """
        if not self._first.residual.takes(1):
            return self
        other = copy(self)
        data = self._window.data.copy()
        instruments = self._instruments
        data[1] += by_s
        shifted = self._window._replace(data=data)
        vars(other).update(_window=shifted, _instruments=instruments)
        return other

    def expression(self, looked: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """Return the prediction y (3,) of one marker from its places (3, neighbours), its
        φ, and the data.
        """
        place, t_s = ca.vertsplit(data)
        own = self.own[0] if len(self.own) else np.zeros(0, dtype=np.int64)
        reading = looked[:, 0]
        if len(self.nuisance.of_clock):
            late = self.nuisance.late_s(phi, own, t_s) / self.nuisance.interval_s
            places = [ca.SX(k) for k in range(self._neighbours)]
            reading = looked @ ca.vertcat(*lagrange_weights(place + late, places))
        return self.nuisance.read(reading, phi, own, t_s)

    # Of positions -----------------------------------------------------------------------------

    def of_samples(self, positions_m: Array, phi: Array) -> Array:
        """Return predictions (T, M, 3) [m] from the body's positions (T, n, 3) at the samples."""
        plain = replace(self, channel=replace(self.channel, rows=np.arange(len(positions_m))))
        return plain.of_positions(positions_m.reshape(len(positions_m), -1), phi)

    def of_positions(self, x: Array, phi: Array) -> Array:
        """Return predictions (t, M, 3) [m] from the first grid positions x (rows, 3n), for
        samples that they suffice for.
        """
        return self.predicted(self.channel.of(x, phi), phi)

    def squared_distances_m2(self, x: Array, phi: Array) -> Array:
        """Return the squared distances [m²] of predictions from all samples that are
        present, flat.
        """
        predicted = self.of_positions(x, phi)
        tracks = self.markers.positions_m[: len(predicted)]
        present = self.present[: len(predicted)]
        return np.sum((predicted - tracks) ** 2, axis=2)[present]
