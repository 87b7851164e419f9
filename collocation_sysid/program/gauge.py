"""Custom sensors: measurements defined by a user's expression.

The expression is a function of positions, velocities and accelerations of points of the body, or of
the force and torque of a grasp. Velocities and accelerations are those of the polynomial through
the five grid times around a sample.
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

# Grid times around a sample, for positions, velocities and accelerations.
NEIGHBOURS = 5
# The same for equilibria, which have no velocities.
STATIC_NEIGHBOURS = 2


@dataclass(frozen=True, eq=False)
class GaugeReading(Reading):
    """Measurement model of one custom sensor.

    Attributes
    ----------
    gauge : Gauge
        The user's sensor with its samples.
    at_s : (n,) array
        Times of the observable [s].
    static : bool
        Whether the experiment is static: there are no velocities, and two times around a sample are
        used.
    """

    gauge: Gauge
    at_s: Array
    static: bool

    stated = "sigma"
    has_offsets = True

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
        """Build the measurement model of a custom sensor.

        Parameters
        ----------
        gauge : Gauge
            The user's sensor with its samples.
        number : int
            Index of the sensor in the experiment.
        channel : Channel
            Observable.
        at_s : (n,) array
            Times of the observable [s]; samples outside are not compared.
        nuisance : NuisanceMap
            Nuisance parameters of the experiment.
        huber : float or None
            Threshold of Huber's loss; None means a quadratic loss.
        static : bool
            Whether the experiment is static.
        """
        count = gauge.measured.shape[1]
        groups = -(-count // GROUP)
        padded = np.full((len(gauge.times), 1, GROUP * groups), np.nan)
        padded[:, 0, :count] = gauge.measured
        is_compared = np.isfinite(padded) & _within(gauge.times, at_s)[:, None, None]
        which = [f" {k + 1}" if groups > 1 else "" for k in range(groups)]
        return cls(
            channel=channel,
            nuisance=nuisance,
            huber=huber,
            names=tuple(f"{gauge.name}{each}" for each in which),
            t_s=gauge.times,
            sigmas=np.full(groups, gauge.sigma),
            measured=padded,
            components=is_compared.reshape(len(padded), groups, GROUP),
            own=nuisance.places(GAUGE, of=number)[None],
            gauge=gauge,
            at_s=at_s,
            static=static,
        )

    def of_some(self, known_s: Array, t_s: Array, numbers: Array, **changes: Any) -> GaugeReading:
        """Return the model of other samples, see `Reading.of_some`."""
        return super().of_some(known_s, t_s, numbers, at_s=known_s, **changes)

    @cached_property
    def _window(self) -> Window:
        """Stencil of all samples: indices of the neighbouring times, and the data of the
        expression.
        """
        used = min(STATIC_NEIGHBOURS if self.static else NEIGHBOURS, len(self.at_s))
        times = times_around(self.at_s, self.t_s + TIME_TOLERANCE_S, used)
        each = np.arange(self.channel.each)
        places = (times[..., None] * self.channel.each + each).reshape(len(times), 1, -1)
        data = np.column_stack([self.at_s[times] - self.t_s[:, None], self.t_s])
        return Window(places, data.T[..., None])

    def window(self, phi: Array, known: int) -> Window:
        """Return the stencil of those first samples whose times are among the first `known`
        ones.
        """
        last = self._window.places[:, 0, -1] // self.channel.each
        samples = int(np.count_nonzero(last < known))
        return Window(self._window.places[:samples], self._window.data[:, :samples])

    @property
    def begins_s(self) -> float:
        """Last time [s] that the first compared sample is computed from."""
        first = int(self.components.any(axis=(1, 2)).argmax())
        return float(self.at_s[self._window.places[first, 0, -1] // self.channel.each])

    def expression(self, looked: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """Return the user's expression, padded with zeros to a multiple of three numbers."""
        *places, t_s = ca.vertsplit(data)
        late = ca.SX.sym("late")
        each = self.channel.each
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
        predicted = self.gauge.read(t_s, at, unknowns)
        return ca.vertcat(predicted, ca.SX.zeros(self.measured.shape[2] - predicted.numel()))

    @cached_property
    def looked_sigmas(self) -> Array:
        """Standard deviations (3 e,) of the observable as one sample determines it, from
        the derivatives at zero.
        """
        nothing = np.zeros((self.channel.count, self.channel.each, GROUP))
        _, _, by_u = self._read(nothing, np.zeros(self.nuisance.size))
        by_looked = np.nan_to_num(by_u[..., : by_u.shape[3] - self.own.shape[1]])
        each = GROUP * self.channel.each
        squares = np.sum(by_looked.reshape(-1, each) ** 2, axis=0) / max(1, self.components.sum())
        with np.errstate(divide="ignore"):
            return 1 / np.sqrt(squares)

    def of_motion(self, motion: Motion, phi: Array) -> Array:
        """Return predictions (S, G, 3) for a motion at the observable's times; NaN for
        samples outside.
        """
        predicted = self.predicted(self.channel.values(motion, phi), phi)
        return np.where(_within(self.t_s, self.at_s)[:, None, None], predicted, np.nan)

    def said(self, read: Array) -> Array:
        """Return the m numbers (S, m) of the sensor from predictions (S, G, 3)."""
        return read.reshape(len(read), -1)[:, : self.gauge.measured.shape[1]]


def _within(t_s: Array, at_s: Array) -> NDArray[np.bool_]:
    """Return the mask (S,) of samples within the range of ascending times; none if there
    are no times.
    """
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
    """Build the measurement models of all custom sensors of an experiment.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    t_s : (N,) array
        Times of the rows of x [s].
    grid : Grid
        Times at which reaction forces are known.
    nuisance : NuisanceMap
        Nuisance parameters of the experiment.
    huber : float or None
        Threshold of Huber's loss; None means a quadratic loss.
    """
    models = []
    for number, gauge in enumerate(experiment.readings):
        if gauge.grasp is None:
            channel = points_of(experiment, gauge, len(t_s))
            at_s = t_s
        else:
            grasp = experiment.grasps[gauge.grasp - 1]
            origin = np.zeros(3)
            channel = GraspWrench.of(experiment, grasp, gauge.frame, origin, grid, nuisance)
            at_s = channel.t_s
        models.append(
            GaugeReading.of(
                gauge,
                number,
                channel=channel,
                at_s=at_s,
                nuisance=nuisance,
                huber=huber,
                static=experiment.static,
            )
        )
    return tuple(models)


def points_of(experiment: Experiment, gauge: Gauge, rows: int) -> Points:
    """Return the points of a custom sensor as an observable at the first `rows` grid times."""
    body = experiment.body
    points = np.asarray(gauge.points_m)
    names = [f"{gauge.name} {k + 1}" for k in range(len(points))]
    placement = place_markers(points, body.nodes.points_m, body, names=names)
    chart = Chart.exact(body, placement, points)
    return Points(np.arange(rows), chart, np.full((len(points), 3), -1))
