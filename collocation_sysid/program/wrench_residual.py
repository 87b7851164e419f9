"""Force–torque sensors in the grasps: a sample at time s is compared with

    ŷ(s) = Σ_k ℓ_k(s + τ) Y_k + tare,

where Y is the resultant of the reactions on the grid (`reactions.resultant`), τ the shift
of the sensor's clock, and ℓ are the weights of the six grid times around the sample. Each sample is
compared at its own time, however many there are in a step, so that no averaging hides a motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array, Index
from ..recording.measured_wrench import Wrench
from ..recording.nuisance import SENSOR_TIME, TARE
from ..recording.sample_times import TIME_TOLERANCE_S
from .association import Association
from .correspondences import Correspondences
from .measurement_model import MeasurementModel
from .measurement_residual import (
    MeasurementResidual,
    RowStencil,
    neighbouring_times,
    smooth_weights,
)
from .observables import ObservedMotion
from .reactions.resultant import TIMES_PER_SAMPLE, ReactionResultant


@dataclass(frozen=True, eq=False)
class WrenchResidual(MeasurementResidual):
    """Measurement model of the force–torque sensor of one grasp."""

    observable: ReactionResultant  # resultant of the reactions on the grid as an observable
    wrench: Wrench  # measured samples

    sigma_key = "sigma_n"
    has_fixed_stencils = False

    @classmethod
    def from_sensor(
        cls,
        observable: ReactionResultant,
        wrench: Wrench,
        label: str = "",
        huber: float | None = None,
    ) -> WrenchResidual:
        """Build the measurement model of a sensor.

        Samples are compared only where the observable covers them for any shift of the clock.

        Parameters
        ----------
        observable : ReactionResultant
            Resultant of the reactions on the grid as an observable.
        label : str
            Suffix of the names of force and torque, such as " 2", if there are several sensors.
        huber : float or None
            Threshold of Huber's loss; None means a quadratic loss.
        """
        rows = (SENSOR_TIME, TARE)
        is_compared = (
            wrench.is_measured
            & _is_covered(observable, wrench.t_s, known=observable.count)[:, None]
        )
        return cls(
            observable=observable,
            nuisance=observable.nuisance,
            huber=huber,
            names=(f"force{label}", f"torque{label}"),
            t_s=wrench.t_s,
            sigmas=wrench.value_sigmas[[0, 3]],
            measured=wrench.values[:, None],
            is_compared=is_compared.reshape(-1, 2, 3),
            own_parameters=np.concatenate([observable.parameter_indices(row) for row in rows])[
                None
            ],
            wrench=wrench,
        )

    @property
    def measurement(self) -> Wrench:
        return self.wrench

    def is_covered(self, known: int) -> NDArray[np.bool_]:
        return _is_covered(self.observable, self.t_s, known=known)

    def _neighbour_count(self, known: int) -> int:
        """Times that a sample is interpolated from: six, two if static."""
        return min(2 if self.observable.reaction_grid.is_static else TIMES_PER_SAMPLE, known)

    def stencil(self, phi: Array, known: int) -> RowStencil:
        """Return the stencil of all samples: the grid times around each, among the first `known`
        ones, at the clock shift of φ, and their distances from the sample without that shift [s].
        Samples that are not covered are extrapolated.
        """
        clock = self.observable.parameter_indices(SENSOR_TIME)
        used = self._neighbour_count(known)
        t_s = self.observable.t_s[:known]
        shift_s = (phi[clock] * self.nuisance.scales[clock]).sum()
        times = neighbouring_times(t_s, self.t_s + shift_s, count=used)
        data = self.observable.t_s[times] - self.t_s[:, None]
        return RowStencil(_vector_indices(times), data.T[..., None])

    def all_stencils(self) -> Index:
        """Return the indices (…, 1, v) of all sequences of neighbouring times, one for each first
        time and not for each sample.
        """
        used = self._neighbour_count(self.observable.count)
        return _vector_indices(
            np.arange(self.observable.count - used + 1)[:, None] + np.arange(used)
        )

    def expression(self, values: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """Return the prediction (6,) [N, N m], interpolated in time, with the tare added."""
        times = data.numel()
        tared = np.flatnonzero(self.wrench.measured_components)
        own = phi * self.nuisance.scales[self.own_parameters[0]][:, None]
        has_clock = len(self.observable.parameter_indices(SENSOR_TIME))
        at = own[0] if has_clock else ca.SX(0)
        predicted = ca.reshape(values, 6, times) @ ca.vertcat(
            *smooth_weights(at, ca.vertsplit(data))
        )
        tare = own[has_clock:]
        if tare.numel():
            predicted[tared[: tare.numel()]] += tare
        return predicted

    def predict_motion(self, motion: ObservedMotion, phi: Array) -> Array:
        values = self.observable.evaluate(motion, phi)
        if not len(values):
            return np.full((len(self.t_s), 2, 3), np.nan)
        predicted = self.predict(values, phi)
        return np.where(self.is_covered(len(values))[:, None, None], predicted, np.nan)


def _is_covered(observable: ReactionResultant, t_s: Array, known: int) -> NDArray[np.bool_]:
    """Return which samples lie in the known times for any shift of the clock."""
    if not known:
        return np.zeros(len(t_s), dtype=bool)
    first, last = observable.t_s[[0, known - 1]]
    rounding = 1e-6 * observable.reaction_grid.step_s + TIME_TOLERANCE_S
    limit_s = observable.clock_limit_s
    return (t_s >= first + limit_s - rounding) & (t_s <= last - limit_s + rounding)


def _vector_indices(times: Index) -> Index:
    """Return the indices (S, 1, 2 used) of force and torque vectors at times (S, used)."""
    return (2 * times[..., None] + np.arange(2)).reshape(len(times), 1, -1)


class WrenchModel(MeasurementModel):
    """Force–torque sensor of a grasp; its residual is the same for all associations."""

    measurement: Wrench

    @cached_property
    def _residual(self) -> WrenchResidual:
        experiment = self.grid.experiment
        sensed = [grasp for grasp in experiment.grasps if grasp.wrench is not None]
        observable = ReactionResultant.from_experiment(
            experiment,
            sensed[self.number],
            frame=self.measurement.frame,
            point_m=self.measurement.point_m,
            grid=self.grid.reaction_grid,
            nuisance=self.grid.nuisance,
            number=self.number,
        )
        label = "" if len(sensed) == 1 else f" {self.number + 1}"
        return WrenchResidual.from_sensor(
            observable, self.measurement, label=label, huber=self.grid.huber
        )

    def residuals(
        self, association: Association, correspondences: Correspondences | None
    ) -> tuple[WrenchResidual]:
        return (self._residual,)
