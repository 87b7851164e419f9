"""Custom sensors: measurements defined by a user's expression.

The expression is a function of positions, velocities and accelerations of points of the body, or of
the force and torque of a grasp. Velocities and accelerations are those of the polynomial through
the five grid times around a sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..model.nuisance_map import NuisanceMap
from ..recording.custom_sensor import CustomSensor
from ..recording.experiment import Experiment
from ..recording.placement import place_markers
from ..recording.sample_times import TIME_TOLERANCE_S
from .association import Association
from .correspondences import CorrespondenceResidual, Correspondences
from .markers.association import MarkerAssociation
from .measurement_model import MeasurementModel
from .measurement_residual import (
    GROUP,
    MeasurementResidual,
    Observable,
    RowStencil,
    lagrange_weights,
    neighbouring_times,
)
from .observables import ObservedMotion, PointPositions
from .reactions.resultant import ReactionGrid, ReactionResultant

# Grid times around a sample, for positions, velocities and accelerations.
NEIGHBOURS = 5
# The same for equilibria, which have no velocities.
STATIC_NEIGHBOURS = 2


@dataclass(frozen=True, eq=False)
class CustomSensorResidual(MeasurementResidual):
    """Measurement model of one custom sensor."""

    sensor: CustomSensor  # the user's sensor with its samples
    observable_s: Array  # (n,): times of the observable [s]
    # Whether the experiment is static: there are no velocities, and two times around a sample are
    # used.
    is_static: bool

    sigma_key = "sigma"

    @classmethod
    def from_sensor(
        cls,
        sensor: CustomSensor,
        number: int,
        observable: Observable,
        at_s: Array,
        nuisance: NuisanceMap,
        huber: float | None,
        static: bool,
        **more: Any,
    ) -> Self:
        """Build the measurement model of a custom sensor.

        Its numbers are padded with NaN to groups of three, and all have the sensor's σ.

        Parameters
        ----------
        sensor : CustomSensor
            The user's sensor with its samples.
        number : int
            Index of the sensor in the experiment, from 0.
        at_s : (n,) array
            Times of the observable [s]; samples outside are not compared.
        huber : float or None
            Threshold of Huber's loss; None means a quadratic loss.
        **more
            Further attributes of a subclass.
        """
        count = sensor.measured_values.shape[1]
        groups = -(-count // GROUP)
        padded = np.full((len(sensor.sample_times_s), 1, GROUP * groups), np.nan)
        padded[:, 0, :count] = sensor.measured_values
        is_compared = np.isfinite(padded) & is_within(sensor.sample_times_s, at_s)[:, None, None]
        which = [f" {k + 1}" if groups > 1 else "" for k in range(groups)]
        return cls(
            observable=observable,
            nuisance=nuisance,
            huber=huber,
            names=tuple(f"{sensor.name}{each}" for each in which),
            t_s=sensor.sample_times_s,
            sigmas=np.full(groups, sensor.sigma),
            measured=padded,
            is_compared=is_compared.reshape(len(padded), groups, GROUP),
            own_parameters=nuisance.indices_of_labels(map(sensor.unknown_label, sensor.unknowns))[
                None
            ],
            sensor=sensor,
            observable_s=at_s,
            is_static=static,
            **more,
        )

    @property
    def measurement(self) -> CustomSensor:
        return self.sensor

    def at_samples(self, t_s: Array, grid: ReactionGrid) -> Self:
        other = super().at_samples(t_s, grid)
        observable = other.observable
        at_s = observable.t_s if isinstance(observable, ReactionResultant) else t_s
        return replace(other, observable_s=at_s)

    @property
    def point_indices(self) -> NDArray[np.integer]:
        """Indices (S, P) or (1, P) of the observable's vectors on which each sample depends."""
        return np.arange(self.observable.vector_count)[None]

    @property
    def at_s(self) -> Array:
        """Times (S,) [s] around which each sample is computed; here those of the samples."""
        return self.t_s

    @cached_property
    def _times(self) -> NDArray[np.int64]:
        """Indices (S, k) of the observable's times from which each sample is computed."""
        used = min(STATIC_NEIGHBOURS if self.is_static else NEIGHBOURS, len(self.observable_s))
        return neighbouring_times(self.observable_s, self.at_s + TIME_TOLERANCE_S, count=used)

    @cached_property
    def _stencil(self) -> RowStencil:
        """Stencil of all samples; data are distances of neighbouring times, and the time [s]."""
        # A sample beyond the known times uses the nearest ones.
        times = self._times
        vectors = times[..., None] * self.observable.vector_count + self.point_indices[:, None]
        places = vectors.reshape(len(times), 1, -1)
        data = np.column_stack([self.observable_s[times] - self.t_s[:, None], self.t_s])
        return RowStencil(places, data.T[..., None])

    def stencil(self, phi: Array, known: int) -> RowStencil:
        samples = int(np.count_nonzero(self._times[:, -1] < known))
        return RowStencil(self._stencil.indices[:samples], self._stencil.data[:, :samples])

    def expression(self, values: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """Return the user's expression (m,), padded with zeros to a multiple of three numbers."""
        *places, t_s = ca.vertsplit(data)
        late = ca.SX.sym("late")
        each = self.point_indices.shape[1]
        by_time = ca.reshape(values, GROUP * each, -1)
        weights = ca.vertcat(*lagrange_weights(late, places))
        at = []
        for _ in range(3):
            now = by_time @ ca.substitute(weights, late, ca.SX(0))
            at.append(ca.reshape(now, GROUP, each))
            weights = ca.jacobian(weights, late)
        if self.sensor.grasp is not None:
            at = ca.horzsplit(at[0])
        unknowns = ca.vertsplit(phi * self.nuisance.scales[self.own_parameters[0]][:, None])
        predicted = self.sensor.read(t_s, at, unknowns=unknowns)
        return ca.vertcat(predicted, ca.SX.zeros(self.measured.shape[2] - predicted.numel()))

    @cached_property
    def observable_sigmas(self) -> Array:
        """From the derivatives at zero values; infinite where the readings do not depend on it."""
        nothing = np.zeros((self.observable.count, self.observable.vector_count, GROUP))
        by_u = self._evaluate(nothing, np.zeros(self.nuisance.size)).by_inputs
        by_observables = np.nan_to_num(by_u[..., : by_u.shape[3] - self.own_parameters.shape[1]])
        each = GROUP * self.observable.vector_count
        squares = np.sum(by_observables.reshape(-1, each) ** 2, axis=0) / max(
            1, self.is_compared.sum()
        )
        with np.errstate(divide="ignore"):
            return 1 / np.sqrt(squares)

    def predict_motion(self, motion: ObservedMotion, phi: Array) -> Array:
        predicted = super().predict_motion(motion, phi)
        return np.where(is_within(self.at_s, self.observable_s)[:, None, None], predicted, np.nan)

    def numbers(self, predicted: Array) -> Array:
        return super().numbers(predicted)[:, : self.sensor.measured_values.shape[1]]


@dataclass(frozen=True, eq=False)
class CorrespondingSensorResidual(CustomSensorResidual, CorrespondenceResidual):
    """Measurement model of a custom sensor whose correspondences follow the shapes of the body."""

    @property
    def first_row(self) -> int:
        return int(self._times[0, -1])

    def _shapes(self, x: Array, at_s: Array | None = None) -> Array:
        """Return the nodes (s, n, 3) [m] at those first samples that rows x (rows, 3n) reach, or at
        times near `at_s`.
        """
        known = int(np.count_nonzero(self._times[:, -1] < len(x)))
        nodes_m = x.reshape(len(x), -1, 3)
        distances_s = (
            self.observable_s[self._times] - (self.at_s if at_s is None else at_s)[:, None]
        )
        shapes = [
            np.tensordot(lagrange_weights(0.0, late_s.tolist()), nodes_m[times], 1)
            for times, late_s in zip(self._times[:known], distances_s[:known], strict=True)
        ]
        return np.reshape(shapes, (known, *nodes_m.shape[1:]))


def is_within(t_s: Array, at_s: Array) -> NDArray[np.bool_]:
    """Return the mask (S,) of samples at times `t_s` (S,) within the range of ascending times
    `at_s`, ends included with `TIME_TOLERANCE_S`; all false if there are no times.
    """
    if not len(at_s):
        return np.zeros(len(t_s), dtype=bool)
    return (t_s >= at_s[0] - TIME_TOLERANCE_S) & (t_s <= at_s[-1] + TIME_TOLERANCE_S)


class CustomSensorModel(MeasurementModel):
    """Custom sensor of points or of a grasp; its residual is the same for all associations."""

    measurement: CustomSensor

    @cached_property
    def _residual(self) -> CustomSensorResidual:
        grid, sensor = self.grid, self.measurement
        experiment = grid.experiment
        if sensor.grasp is None:
            observable = observed_points(experiment, sensor, rows=len(grid.t_s))
            at_s = grid.t_s
        else:
            observable = ReactionResultant.from_experiment(
                experiment,
                experiment.grasps[sensor.grasp - 1],
                frame=sensor.frame,
                point_m=np.zeros(3),
                grid=grid.reaction_grid,
                nuisance=grid.nuisance,
            )
            at_s = observable.t_s
        return CustomSensorResidual.from_sensor(
            sensor,
            self.number,
            observable=observable,
            at_s=at_s,
            nuisance=grid.nuisance,
            huber=grid.huber,
            static=experiment.is_static,
        )

    def residuals(
        self, association: Association, correspondences: Correspondences | None
    ) -> Sequence[CustomSensorResidual]:
        return (self._residual,)


def observed_points(experiment: Experiment, sensor: CustomSensor, rows: int) -> PointPositions:
    """Return the points of a custom sensor as an observable at the first `rows` grid times; their
    places are exact, without estimated coordinates.

    Raises
    ------
    InputError
        If a point is not on or in the body, see `place_markers`.
    """
    body = experiment.body
    points = np.asarray(sensor.points_m)
    placement = place_markers(points, body.nodes.points_m, body=body, sensor=sensor.name)
    association = MarkerAssociation.from_exact_places(body, placement, points_m=points)
    return PointPositions(
        np.arange(rows), association, coordinate_parameters=np.full((len(points), 3), -1)
    )
