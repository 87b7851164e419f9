"""What cameras see of markers on the body, from node positions x and nuisance parameters φ:

    y = R(a) (Σ_i ℓ_i(τ) h(x_i) − c) + c + d + b,

with ℓ the Lagrange weights of up to five neighbouring samples at the shifted time, and the plain
h(x_t) without φ, see `channel` and `nuisance`.
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
    """The tracks of all markers.

    Attributes
    ----------
    channel : Points
        Where they are on the body at the samples.
    markers : Markers
    from_rest : bool
        The body rests in its first state before the first time: a shifted marker reads that there.
    earlier : int
        How many of the channel's times are before the first sample.
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
        """That of markers, looked at in some rows of the grid."""
        places = np.full((len(markers.names), chart.axes.shape[2]), -1)
        places[chart.estimated] = nuisance.places(PLACE).reshape(-1, places.shape[1])
        shifted = earlier + np.arange(len(markers.t_s)) + chart.samples
        covered = (shifted < len(rows)) & ((shifted >= 0) | from_rest)
        there = markers.present & covered[:, None]
        return cls(
            channel=Points(rows, chart, places),
            nuisance=nuisance,
            huber=huber,
            names=markers.names,
            t_s=markers.t_s,
            sigmas=markers.sigma_m,
            measured=markers.positions_m,
            components=np.repeat(there[..., None], 3, axis=2),
            own=nuisance.of_markers(len(markers.names)),
            markers=markers,
            from_rest=from_rest,
            earlier=earlier,
        )

    @property
    def grid_rows(self) -> Index:
        """(T,) row of the collocation grid at each sample."""
        return self.channel.rows

    @property
    def place_places(self) -> Index:
        """(M, k) positions in φ of the places of the markers; −1 for exact ones."""
        return self.channel.places

    @property
    def present(self) -> NDArray[np.bool_]:
        """(T, M) samples that are compared."""
        return self.components[..., 0]

    # One sample -------------------------------------------------------------------------------

    @property
    def _times(self) -> Index:
        """(T,) which of the channel's times the samples are at."""
        return self.earlier + np.arange(len(self.t_s))

    @cached_property
    def _neighbours(self) -> int:
        return min(NEIGHBOURS, self.channel.count) if len(self.nuisance.of_clock) else 1

    @cached_property
    def _first_neighbour(self) -> Index:
        """(T,) the first sample that each one is interpolated from; negative before the start."""
        first = self._times + self.channel.chart.samples - self._neighbours // 2
        first = np.minimum(first, self.channel.count - self._neighbours)
        return first if self.from_rest else np.maximum(first, 0)

    @cached_property
    def _around(self) -> Index:
        """(T, neighbours) samples that each one is interpolated from."""
        return np.maximum(self._first_neighbour[:, None] + np.arange(self._neighbours), 0)

    @cached_property
    def _window(self) -> Window:
        count = len(self.markers.names)
        place = np.array([self._times - self._first_neighbour, self.t_s], dtype=np.float64)
        places = self._around[:, None] * count + np.arange(count)[:, None]
        return Window(places, np.repeat(place[..., None], count, axis=2))

    def window(self, phi: Array, known: int) -> Window:
        """Of the samples that the first ones known suffice to read."""
        samples = int(np.count_nonzero(self._around[:, -1] < known))
        return Window(self._window.places[:samples], self._window.data[:, :samples])

    def later(self, by_s: float) -> MarkerReading:
        """The same of samples so much later."""
        if not self._first.residual.takes(1):
            return self
        other, data, instruments = copy(self), self._window.data.copy(), self._instruments
        data[1] += by_s
        moved = self._window._replace(data=data)
        vars(other).update(_window=moved, _instruments=instruments)
        return other

    def expression(self, looked: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """Y of a marker, from its plain places at neighbouring samples."""
        place, t_s = ca.vertsplit(data)
        own = phi, self.own[0] if len(self.own) else np.zeros(0, dtype=np.int64)
        reading = looked[:, 0]
        if len(self.nuisance.of_clock):
            late = self.nuisance.late_s(*own, t_s) / self.nuisance.interval_s
            places = [ca.SX(k) for k in range(self._neighbours)]
            reading = looked @ ca.vertcat(*lagrange_weights(place + late, places))
        return self.nuisance.read(reading, *own, t_s)

    # Of positions -----------------------------------------------------------------------------

    def of_samples(self, positions_m: Array, phi: Array) -> Array:
        """Readings (T, M, 3) [m] of the body's positions (T, n, 3) at the samples."""
        plain = replace(self, channel=replace(self.channel, rows=np.arange(len(positions_m))))
        return plain.of_positions(positions_m.reshape(len(positions_m), -1), phi)

    def of_positions(self, x: Array, phi: Array) -> Array:
        """Those (t, M, 3) of the first grid positions x (rows, 3n), as far as they go."""
        return self.predicted(self.channel.of(x, phi), phi)

    def squared_distances_m2(self, x: Array, phi: Array) -> Array:
        """Squared distances between readings of the first grid positions and present samples."""
        read = self.of_positions(x, phi)
        tracks, present = self.markers.positions_m[: len(read)], self.present[: len(read)]
        return np.sum((read - tracks) ** 2, axis=2)[present]
