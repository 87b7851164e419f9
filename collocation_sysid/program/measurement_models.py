"""The kinds of measurements: which `MeasurementModel` belongs to which `Measurement`.

Another package adds a kind by the decorator `measurement_model`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from ..recording.custom_sensor import CustomSensor
from ..recording.depth_camera import Depth
from ..recording.experiment import Experiment
from ..recording.markers import Markers
from ..recording.measured_wrench import Wrench
from ..recording.measurement import Measurement, sensor_fields
from .custom_sensor_residual import CustomSensorModel
from .depth.depth_model import DepthModel
from .markers.marker_residual import MarkerModel
from .measurement_model import CorrespondenceModel, MeasurementModel, MotionGrid
from .wrench_residual import WrenchModel

T = TypeVar("T", bound=type[MeasurementModel])

MODELS: dict[type[Measurement], type[MeasurementModel]] = {
    Markers: MarkerModel,
    Wrench: WrenchModel,
    CustomSensor: CustomSensorModel,
    Depth: DepthModel,
}


def measurement_model(kind: type[Measurement]) -> Callable[[T], T]:
    """Return a decorator for the model of a kind of measurement, which makes it known."""

    def register(model: T) -> T:
        MODELS[kind] = model
        return model

    return register


def model_of(measurement: Measurement) -> type[MeasurementModel]:
    """Return the model of the kind of a measurement, or of the nearest base class that has one."""
    return next(MODELS[kind] for kind in type(measurement).__mro__ if kind in MODELS)


def measurement_models(grid: MotionGrid) -> tuple[MeasurementModel, ...]:
    """Return the models of the markers, also without any, and of all other measurements of an
    experiment, in the order of `Experiment.measurements`.
    """
    experiment = grid.experiment
    groups = [(experiment.markers,), experiment.wrenches]
    groups += [getattr(experiment, name) for name in sensor_fields(Experiment)]
    return tuple(
        model_of(each)(each, number, grid) for group in groups for number, each in enumerate(group)
    )


def with_correspondences(experiment: Experiment) -> list[Measurement]:
    """Return the measurements of an experiment that have correspondences, in their order."""
    return [
        each for each in experiment.measurements if issubclass(model_of(each), CorrespondenceModel)
    ]
