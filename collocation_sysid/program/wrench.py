"""What the sensor of a grasp reads: a sample at s compares

    ŷ(s) = Σ_k ℓ_k(s + τ) Y_k + tare,

Y being what `wrench_channel` has on the grid and ℓ the cubic weights of the four grid times around
it. Each sample is compared at its own time, however many there are in a step, so that no average
hides a motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..model.nuisance import NuisanceMap
from ..recording.clock import TIME_TOLERANCE_S
from ..recording.experiment import Experiment
from ..recording.nuisance import SENSOR_TIME, TARE
from ..recording.wrench import Wrench
from .channel import Forced, Motion
from .reading import Reading, Window, lagrange_weights, times_around
from .wrench_channel import GraspWrench, Grid

# Grid times that a sample is interpolated from: an error of (ωΔt)⁴ / 40 of a swing.
NEIGHBOURS = 4


@dataclass(frozen=True, eq=False)
class WrenchReading(Reading):
    """The samples of the sensor of one grasp: a force and a torque at a time.

    Attributes
    ----------
    channel : GraspWrench
    wrench : Wrench
    """

    channel: GraspWrench
    wrench: Wrench

    stated, has_offsets, has_fixed_windows = "sigma_n", True, False

    @classmethod
    def of(
        cls,
        channel: GraspWrench,
        wrench: Wrench,
        label: str = "",
        huber: float | None = None,
    ) -> WrenchReading:
        """That of a sensor, which a label such as " 2" tells from others."""
        rows = (SENSOR_TIME, TARE)
        there = wrench.present & _covered(channel, wrench.t_s, channel.count)[:, None]
        return cls(
            channel=channel,
            nuisance=channel.nuisance,
            huber=huber,
            names=(f"force{label}", f"torque{label}"),
            t_s=wrench.t_s,
            sigmas=wrench.sigmas[[0, 3]],
            measured=wrench.values[:, None],
            components=there.reshape(-1, 2, 3),
            own=np.concatenate([channel.phi_places(row) for row in rows])[None],
            wrench=wrench,
        )

    @property
    def present(self) -> NDArray[np.bool_]:
        """(S, 6) numbers that are compared."""
        return self.components.reshape(-1, 6)

    @property
    def begins_s(self) -> float:
        """The first sample, however late it is."""
        return super().begins_s + self.channel.clock_limit_s

    def covered(self, known: int) -> NDArray[np.bool_]:
        """(S,) samples that the first times suffice for, however the clock is shifted."""
        return _covered(self.channel, self.t_s, known)

    def _used(self, known: int) -> int:
        return min(2 if self.channel.on.static else NEIGHBOURS, known)

    def window(self, phi: Array, known: int) -> Window:
        """Of all samples: the grid times around each, and how much later than it they are."""
        here, used = self.channel.phi_places(SENSOR_TIME), self._used(known)
        t_s, shift_s = self.channel.t_s[:known], (phi[here] * self.nuisance.scales[here]).sum()
        times = times_around(t_s, self.t_s + shift_s, used)
        data = self.channel.t_s[times] - self.t_s[:, None]
        return Window(_both(times), data.T[..., None])

    def windows(self) -> Index:
        """(…, 1, v) neighbouring times, wherever the clock may be."""
        used = self._used(self.channel.count)
        return _both(np.arange(self.channel.count - used + 1)[:, None] + np.arange(used))

    def expression(self, looked: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """Of Y at some grid times, and of these from the sample's."""
        times, tared = data.numel(), np.flatnonzero(self.wrench.measured)
        own = phi * self.nuisance.scales[self.own[0]][:, None]
        late = len(self.channel.phi_places(SENSOR_TIME))
        at = own[0] if late else ca.SX(0)
        read = ca.reshape(looked, 6, times) @ ca.vertcat(*lagrange_weights(at, ca.vertsplit(data)))
        read[tared[: own.numel() - late]] += own[late:]
        return read

    # Of reactions -----------------------------------------------------------------------------

    def of_forced(self, forced: Forced, phi: Array) -> Array:
        """What is read (S, 6), NaN where that is not known."""
        motion = Motion(np.zeros((0, 0)), lambda: forced)
        values = self.channel.values(motion, phi)
        if not len(values):
            return np.full(self.wrench.values.shape, np.nan)
        read = self.predicted(values, phi).reshape(-1, 6)
        return np.where(self.covered(len(values))[:, None], read, np.nan)

    def on(self, grid: Grid) -> WrenchReading:
        """The same where reactions are known at other times."""
        return WrenchReading.of(replace(self.channel, on=grid), self.wrench)

    def told(self, wrench: Wrench) -> WrenchReading:
        """The same of other samples, or in another frame."""
        seen = replace(self.channel, frame=wrench.frame, point_m=wrench.point_m)
        return WrenchReading.of(seen, wrench)


def _covered(channel: GraspWrench, t_s: Array, known: int) -> NDArray[np.bool_]:
    if not known:
        return np.zeros(len(t_s), dtype=bool)
    first, last = channel.t_s[[0, known - 1]]
    rounding = 1e-6 * channel.on.step_s + TIME_TOLERANCE_S
    limit_s = channel.clock_limit_s
    return (t_s >= first + limit_s - rounding) & (t_s <= last - limit_s + rounding)


def _both(times: Index) -> Index:
    """(S, 1, 2 used) places of force and torque at some times (S, used)."""
    return (2 * times[..., None] + np.arange(2)).reshape(len(times), 1, -1)


def wrench_readings(
    experiment: Experiment, grid: Grid, nuisance: NuisanceMap, huber: float | None = None
) -> tuple[WrenchReading, ...]:
    """Those of an experiment's grasps that have a sensor."""
    found, sensors = [], [(g, g.wrench) for g in experiment.grasps if g.wrench is not None]
    for number, (grasp, wrench) in enumerate(sensors):
        how = wrench.frame, wrench.point_m, grid, nuisance, number
        label = "" if len(sensors) == 1 else f" {number + 1}"
        channel = GraspWrench.of(experiment, grasp, *how)
        found.append(WrenchReading.of(channel, wrench, label, huber))
    return tuple(found)


def without_sensors(experiment: Experiment) -> Experiment:
    """The same experiment, its wrenches not measured, nor what looks at a grasp besides."""
    grasps = [replace(grasp, wrench=None) for grasp in experiment.grasps]
    readings = [gauge for gauge in experiment.readings if gauge.grasp is None]
    return replace(experiment, grasps=grasps, readings=readings)
