"""Readings of one's own: of points of the body with their velocities and accelerations, or of what
a grasp gives.

These are those of the polynomial through the five times around a sample.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..model.nuisance import NuisanceMap
from ..recording.clock import TIME_TOLERANCE_S
from ..recording.experiment import Experiment
from ..recording.gauge import Gauge
from ..recording.nuisance import GAUGE
from ..recording.placement import place_markers
from .channel import Motion, Points
from .charts import Chart
from .reading import GROUP, Channel, Reading, Window, lagrange_weights, times_around
from .wrench_channel import GraspWrench, Grid

# Times around a sample; of equilibria, which have no velocities, the two beside it.
NEIGHBOURS, STATIC_NEIGHBOURS = 5, 2


@dataclass(frozen=True, eq=False)
class GaugeReading(Reading):
    """The samples of a gauge.

    Attributes
    ----------
    gauge : Gauge
    at_s : (n,) the times of the channel
    static : bool
    """

    gauge: Gauge
    at_s: Array
    static: bool

    stated, has_offsets = "sigma", True

    @classmethod
    def of(
        cls,
        gauge: Gauge,
        number: int,
        channel: Channel,
        at_s: Array,
        nuisance: NuisanceMap,
        huber: float | None,
        static: bool,
    ) -> GaugeReading:
        """That of a gauge of some number, which looks at a channel that is known at some times."""
        count = gauge.measured.shape[1]
        groups = -(-count // GROUP)
        padded = np.full((len(gauge.times), 1, GROUP * groups), np.nan)
        padded[:, 0, :count] = gauge.measured
        there = np.isfinite(padded) & _within(gauge.times, at_s)[:, None, None]
        which = [f" {k + 1}" if groups > 1 else "" for k in range(groups)]
        return cls(
            channel=channel,
            nuisance=nuisance,
            huber=huber,
            names=tuple(f"{gauge.name}{each}" for each in which),
            t_s=gauge.times,
            sigmas=np.full(groups, gauge.sigma),
            measured=padded,
            components=there.reshape(len(padded), groups, GROUP),
            own=nuisance.places(GAUGE, of=number)[None],
            gauge=gauge,
            at_s=at_s,
            static=static,
        )

    def of_some(self, known_s: Array, t_s: Array, numbers: Array, **changes: Any) -> GaugeReading:
        """That of other samples (S, m), of a channel that is known at some times."""
        return super().of_some(known_s, t_s, numbers, at_s=known_s, **changes)

    @cached_property
    def _window(self) -> Window:
        used = min(STATIC_NEIGHBOURS if self.static else NEIGHBOURS, len(self.at_s))
        times = times_around(self.at_s, self.t_s + TIME_TOLERANCE_S, used)
        each = np.arange(self.channel.each)
        places = (times[..., None] * self.channel.each + each).reshape(len(times), 1, -1)
        data = np.column_stack([self.at_s[times] - self.t_s[:, None], self.t_s])
        return Window(places, data.T[..., None])

    def window(self, phi: Array, known: int) -> Window:
        """Of the samples whose times are all known."""
        last = self._window.places[:, 0, -1] // self.channel.each
        samples = int(np.count_nonzero(last < known))
        return Window(self._window.places[:samples], self._window.data[:, :samples])

    @property
    def begins_s(self) -> float:
        """The last time that the first sample is read from."""
        first = int(self.components.any(axis=(1, 2)).argmax())
        return float(self.at_s[self._window.places[first, 0, -1] // self.channel.each])

    def expression(self, looked: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """The user's, with zeros up to a multiple of three numbers."""
        *places, t_s = ca.vertsplit(data)
        late, each = ca.SX.sym("late"), self.channel.each
        by_time = ca.reshape(looked, GROUP * each, -1)
        weights = ca.vertcat(*lagrange_weights(late, places))
        at = []
        for _ in range(3):
            now = by_time @ ca.substitute(weights, late, ca.SX(0))
            at.append(ca.reshape(now, GROUP, each))
            weights = ca.jacobian(weights, late)
        if self.gauge.grasp is not None:
            at = ca.horzsplit(at[0])
        unknowns = ca.vertsplit(phi * self.nuisance.scales[self.own[0]][:, None])
        read = self.gauge.read(t_s, at, unknowns)
        return ca.vertcat(read, ca.SX.zeros(self.measured.shape[2] - read.numel()))

    @cached_property
    def looked_sigmas(self) -> Array:
        """From the slopes where all is zero."""
        nothing = np.zeros((self.channel.count, self.channel.each, GROUP))
        _, _, by_u = self._read(nothing, np.zeros(self.nuisance.size))
        by_looked = np.nan_to_num(by_u[..., : by_u.shape[3] - self.own.shape[1]])
        each = GROUP * self.channel.each
        squares = np.sum(by_looked.reshape(-1, each) ** 2, axis=0) / max(1, self.components.sum())
        with np.errstate(divide="ignore"):
            return 1 / np.sqrt(squares)

    def of_motion(self, motion: Motion, phi: Array) -> Array:
        """What it reads (S, G, 3) of a motion at the channel's times, NaN beyond them."""
        read = self.predicted(self.channel.values(motion, phi), phi)
        return np.where(_within(self.t_s, self.at_s)[:, None, None], read, np.nan)

    def said(self, read: Array) -> Array:
        """(S, m) numbers of these groups."""
        return read.reshape(len(read), -1)[:, : self.gauge.measured.shape[1]]


def _within(t_s: Array, at_s: Array) -> NDArray[np.bool_]:
    """Which samples lie among some times."""
    if not len(at_s):
        return np.zeros(len(t_s), dtype=bool)
    return (t_s >= at_s[0] - TIME_TOLERANCE_S) & (t_s <= at_s[-1] + TIME_TOLERANCE_S)


def gauge_readings(
    experiment: Experiment,
    t_s: Array,
    grid: Grid,
    nuisance: NuisanceMap,
    huber: float | None = None,
) -> tuple[GaugeReading, ...]:
    """Those of an experiment.

    Parameters
    ----------
    t_s : (N,) times of the rows of x
    grid : Grid
        Of those that tell reactions.
    """
    found = []
    for number, gauge in enumerate(experiment.readings):
        if gauge.grasp is None:
            channel, at_s = points_of(experiment, gauge, len(t_s)), t_s
        else:
            grasp, origin = experiment.grasps[gauge.grasp - 1], np.zeros(3)
            channel = GraspWrench.of(experiment, grasp, gauge.frame, origin, grid, nuisance)
            at_s = channel.t_s
        how = channel, at_s, nuisance, huber, experiment.static
        found.append(GaugeReading.of(gauge, number, *how))
    return tuple(found)


def points_of(experiment: Experiment, gauge: Gauge, rows: int) -> Points:
    """The places that a gauge looks at in all rows."""
    body, points = experiment.body, np.asarray(gauge.points_m)
    names = [f"{gauge.name} {k + 1}" for k in range(len(points))]
    placement = place_markers(points, body.nodes.points_m, body, names=names)
    chart = Chart.exact(body, placement, points)
    return Points(np.arange(rows), chart, np.full((len(points), 3), -1))
