"""Readings of one's own, of points of the body with their velocities and accelerations.

These are those of the polynomial through the five times of the grid around a sample.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..model.nuisance import NuisanceMap
from ..recording.clock import TIME_TOLERANCE_S
from ..recording.experiment import Experiment
from ..recording.gauge import Gauge, Look
from ..recording.nuisance import GAUGE
from ..recording.placement import place_markers
from .channel import Points
from .charts import Chart
from .reading import GROUP, Reading, Window, lagrange_weights

# Grid times around a sample; of equilibria, which have no velocities, the two beside it.
NEIGHBOURS, STATIC_NEIGHBOURS = 5, 2


@dataclass(frozen=True, eq=False)
class GaugeReading(Reading):
    """The samples of a gauge.

    Attributes
    ----------
    channel : Points
        Those it looks at, at all times of the grid.
    gauge : Gauge
    grid_s : (N,) the times of the grid
    static : bool
    """

    channel: Points
    gauge: Gauge
    grid_s: Array
    static: bool

    has_offsets = True

    @cached_property
    def _window(self) -> Window:
        used = min(STATIC_NEIGHBOURS if self.static else NEIGHBOURS, len(self.grid_s))
        beside = np.searchsorted(self.grid_s, self.t_s + TIME_TOLERANCE_S, side="right") - 1
        first = np.clip(beside - (used - 1) // 2, 0, len(self.grid_s) - used)
        times = first[:, None] + np.arange(used)
        each = np.arange(self.channel.each)
        places = (times[..., None] * self.channel.each + each).reshape(len(times), 1, -1)
        data = np.column_stack([self.grid_s[times] - self.t_s[:, None], self.t_s])
        return Window(places, data.T[..., None])

    def window(self, phi: Array, known: int) -> Window:
        """Of the samples whose times are all known."""
        last = self._window.places[:, 0, -1] // self.channel.each
        samples = int(np.count_nonzero(last < known))
        return Window(self._window.places[:samples], self._window.data[:, :samples])

    def expression(self, looked: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """The user's, with zeros up to a multiple of three numbers."""
        *places, t_s = ca.vertsplit(data)
        late = ca.SX.sym("late")
        weights, orders = lagrange_weights(late, places), []
        for _ in range(3):
            orders.append(ca.substitute(weights, late, ca.SX(0)))
            weights = ca.jacobian(weights, late)
        each = self.channel.each
        by_time = ca.reshape(looked, GROUP * each, len(places))
        at = [ca.reshape(by_time @ order, GROUP, each) for order in orders]
        values = ca.vertsplit(phi * self.nuisance.scales[self.own[0]][:, None])
        unknowns = dict(zip(self.gauge.unknowns, values, strict=True))
        read = ca.vec(ca.SX(self.gauge.expression(Look(t_s, *at), **unknowns)))
        count = self.gauge.measured.shape[1]
        if read.numel() != count:
            raise InputError(
                f"the expression of the reading '{self.gauge.name}' gives {read.numel()} numbers; "
                f"expected {count}, as many as its values have columns"
            )
        return ca.vertcat(read, ca.SX.zeros(self.measured.shape[2] - count))

    def of_samples(self, positions_m: Array, t_s: Array, phi: Array) -> Array:
        """What it reads (S, G, 3) of the body's positions (T, n, 3) at some times."""
        channel = replace(self.channel, rows=np.arange(len(t_s)))
        plain = replace(self, channel=channel, grid_s=t_s)
        return plain.predicted(channel.of(positions_m.reshape(len(t_s), -1), phi), phi)


def gauge_readings(
    experiment: Experiment, grid_s: Array, nuisance: NuisanceMap, huber: float | None = None
) -> tuple[GaugeReading, ...]:
    """Those of an experiment."""
    return tuple(
        _reading(experiment, number, gauge, grid_s, nuisance, huber)
        for number, gauge in enumerate(experiment.readings)
    )


def _reading(
    experiment: Experiment,
    number: int,
    gauge: Gauge,
    grid_s: Array,
    nuisance: NuisanceMap,
    huber: float | None,
) -> GaugeReading:
    body, points = experiment.body, np.asarray(gauge.points_m)
    names = [f"{gauge.name} {k + 1}" for k in range(len(points))]
    placement = place_markers(points, body.nodes_m, body, names=names)
    chart = Chart.exact(body, placement, points)
    groups = -(-gauge.measured.shape[1] // GROUP)
    padded = np.full((len(gauge.times), 1, GROUP * groups), np.nan)
    padded[:, 0, : gauge.measured.shape[1]] = gauge.measured
    which = [f" {k + 1}" if groups > 1 else "" for k in range(groups)]
    return GaugeReading(
        channel=Points(np.arange(len(grid_s)), chart, np.full((len(points), 3), -1)),
        nuisance=nuisance,
        huber=huber,
        names=tuple(f"{gauge.name}{each}" for each in which),
        t_s=gauge.times,
        sigmas=np.full(groups, gauge.sigma),
        measured=padded,
        components=np.isfinite(padded).reshape(len(padded), groups, GROUP),
        own=nuisance.places(GAUGE, of=number)[None],
        gauge=gauge,
        grid_s=grid_s,
        static=experiment.static,
    )
