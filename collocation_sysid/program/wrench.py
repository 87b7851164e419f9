"""Force–torque sensors in the grasps: a sample at time s is compared with

    ŷ(s) = Σ_k ℓ_k(s + τ) Y_k + tare,

where Y is the wrench on the grid (`wrench_channel`), τ the shift of the sensor's clock, and ℓ are
the cubic weights of the four grid times around the sample. Each sample is compared at its own time,
however many there are in a step, so that no averaging hides a motion.
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
    """Measurement model of the force–torque sensor of one grasp.

    Attributes
    ----------
    channel : GraspWrench
        Wrench on the grid as an observable.
    wrench : Wrench
        Measured samples.
    """

    channel: GraspWrench
    wrench: Wrench

    stated = "sigma_n"
    has_offsets = True
    has_fixed_windows = False

    @classmethod
    def of(
        cls,
        channel: GraspWrench,
        wrench: Wrench,
        label: str = "",
        huber: float | None = None,
    ) -> WrenchReading:
        """Build the measurement model of a sensor.

        Parameters
        ----------
        channel : GraspWrench
            Wrench on the grid as an observable.
        wrench : Wrench
            Measured samples.
        label : str
            Suffix of the names of force and torque, such as " 2", if there are several sensors.
        huber : float or None
            Threshold of Huber's loss; None means a quadratic loss.
        """
        rows = (SENSOR_TIME, TARE)
        is_compared = wrench.present & _covered(channel, wrench.t_s, channel.count)[:, None]
        return cls(
            channel=channel,
            nuisance=channel.nuisance,
            huber=huber,
            names=(f"force{label}", f"torque{label}"),
            t_s=wrench.t_s,
            sigmas=wrench.sigmas[[0, 3]],
            measured=wrench.values[:, None],
            components=is_compared.reshape(-1, 2, 3),
            own=np.concatenate([channel.phi_places(row) for row in rows])[None],
            wrench=wrench,
        )

    @property
    def present(self) -> NDArray[np.bool_]:
        """Mask (S, 6) of the numbers that are compared."""
        return self.components.reshape(-1, 6)

    @property
    def begins_s(self) -> float:
        """Time [s] of the first sample with the largest possible shift of the clock."""
        return super().begins_s + self.channel.clock_limit_s

    def covered(self, known: int) -> NDArray[np.bool_]:
        """Return the mask (S,) of the samples for which the first `known` times suffice,
        for any shift of the clock.
        """
        return _covered(self.channel, self.t_s, known)

    def _used(self, known: int) -> int:
        """Return the number of grid times that a sample is interpolated from."""
        return min(2 if self.channel.on.static else NEIGHBOURS, known)

    def window(self, phi: Array, known: int) -> Window:
        """Return the stencil of all samples: the grid times around each, and their
        distances from it.
        """
        clock = self.channel.phi_places(SENSOR_TIME)
        used = self._used(known)
        t_s = self.channel.t_s[:known]
        shift_s = (phi[clock] * self.nuisance.scales[clock]).sum()
        times = times_around(t_s, self.t_s + shift_s, used)
        data = self.channel.t_s[times] - self.t_s[:, None]
        return Window(_both(times), data.T[..., None])

    def windows(self) -> Index:
        """Return the indices (…, 1, v) of neighbouring times, for any shift of the clock."""
        used = self._used(self.channel.count)
        return _both(np.arange(self.channel.count - used + 1)[:, None] + np.arange(used))

    def expression(self, looked: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """Return the prediction (6,) from wrenches at neighbouring grid times, the shift of
        the clock and the tare.
        """
        times = data.numel()
        tared = np.flatnonzero(self.wrench.measured)
        own = phi * self.nuisance.scales[self.own[0]][:, None]
        has_clock = len(self.channel.phi_places(SENSOR_TIME))
        at = own[0] if has_clock else ca.SX(0)
        predicted = ca.reshape(looked, 6, times) @ ca.vertcat(
            *lagrange_weights(at, ca.vertsplit(data))
        )
        predicted[tared[: own.numel() - has_clock]] += own[has_clock:]
        return predicted

    # Of reactions -----------------------------------------------------------------------------

    def of_forced(self, forced: Forced, phi: Array) -> Array:
        """Return the prediction (S, 6) from reaction forces [N, N m]; NaN for samples
        outside the known times.
        """

        def reactions() -> Forced:
            return forced

        motion = Motion(np.zeros((0, 0)), reactions)
        values = self.channel.values(motion, phi)
        if not len(values):
            return np.full(self.wrench.values.shape, np.nan)
        predicted = self.predicted(values, phi).reshape(-1, 6)
        return np.where(self.covered(len(values))[:, None], predicted, np.nan)

    def on(self, grid: Grid) -> WrenchReading:
        """Return the model with reaction forces at the times of another grid."""
        return WrenchReading.of(replace(self.channel, on=grid), self.wrench)

    def told(self, wrench: Wrench) -> WrenchReading:
        """Return the model of other samples, in their own frame."""
        observable = replace(self.channel, frame=wrench.frame, point_m=wrench.point_m)
        return WrenchReading.of(observable, wrench)


def _covered(channel: GraspWrench, t_s: Array, known: int) -> NDArray[np.bool_]:
    """Return the mask (S,) of the samples within the first `known` grid times for any shift
    of the clock.
    """
    if not known:
        return np.zeros(len(t_s), dtype=bool)
    first, last = channel.t_s[[0, known - 1]]
    rounding = 1e-6 * channel.on.step_s + TIME_TOLERANCE_S
    limit_s = channel.clock_limit_s
    return (t_s >= first + limit_s - rounding) & (t_s <= last - limit_s + rounding)


def _both(times: Index) -> Index:
    """Return the indices (S, 1, 2 used) of force and torque vectors at times (S, used)."""
    return (2 * times[..., None] + np.arange(2)).reshape(len(times), 1, -1)


def wrench_readings(
    experiment: Experiment, grid: Grid, nuisance: NuisanceMap, huber: float | None = None
) -> tuple[WrenchReading, ...]:
    """Build the measurement models of all grasps of an experiment that have a force–torque sensor.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    grid : Grid
        Times at which reaction forces are known.
    nuisance : NuisanceMap
        Nuisance parameters of the experiment.
    huber : float or None
        Threshold of Huber's loss; None means a quadratic loss.
    """
    models = []
    sensors = [(g, g.wrench) for g in experiment.grasps if g.wrench is not None]
    for number, (grasp, wrench) in enumerate(sensors):
        label = "" if len(sensors) == 1 else f" {number + 1}"
        channel = GraspWrench.of(
            experiment,
            grasp,
            frame=wrench.frame,
            point_m=wrench.point_m,
            grid=grid,
            nuisance=nuisance,
            number=number,
        )
        models.append(WrenchReading.of(channel, wrench, label, huber))
    return tuple(models)


def without_sensors(experiment: Experiment) -> Experiment:
    """Return the experiment without force–torque sensors and custom sensors of grasps."""
    grasps = [replace(grasp, wrench=None) for grasp in experiment.grasps]
    readings = [gauge for gauge in experiment.readings if gauge.grasp is None]
    return replace(experiment, grasps=grasps, readings=readings)
