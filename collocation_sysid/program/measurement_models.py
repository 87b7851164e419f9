"""Which `MeasurementModel` belongs to which `Measurement`, unless its kind has one."""

from __future__ import annotations

from collections import Counter

from ..kinds.registry import kind_of
from ..recording.custom_sensor import CustomSensor, FollowingSensor
from ..recording.depth_camera import Depth
from ..recording.experiment import Experiment
from ..recording.markers import Markers
from ..recording.measured_wrench import Wrench
from ..recording.measurement import Measurement
from .association import Association
from .custom_sensor_residual import CustomSensorModel
from .following_sensor import FollowingSensorModel
from .markers.association import MarkerAssociation
from .markers.residual import MarkerModel
from .measurement_model import CorrespondenceModel, MeasurementModel, MotionGrid
from .wrench_residual import WrenchModel

MODELS: dict[type[Measurement], type[MeasurementModel]] = {
    Markers: MarkerModel,
    Wrench: WrenchModel,
    CustomSensor: CustomSensorModel,
    FollowingSensor: FollowingSensorModel,
}
# Kinds whose measurements are numbered together.
NUMBERED = (Markers, Wrench, CustomSensor, Depth)


def model_of(measurement: Measurement) -> type[MeasurementModel]:
    """Return the model of the kind of a measurement, or of the nearest base class that has one."""
    kind = kind_of(measurement)
    if kind is not None:
        return kind.model
    return next(MODELS[kind] for kind in type(measurement).__mro__ if kind in MODELS)


def measurement_models(grid: MotionGrid) -> tuple[MeasurementModel, ...]:
    """Return the models of `Experiment.measurements`, in their order."""
    numbers: Counter[type[Measurement]] = Counter()
    models = []
    for each in grid.experiment.measurements:
        kind = next(kind for kind in NUMBERED if isinstance(each, kind))
        models.append(model_of(each)(each, numbers[kind], grid))
        numbers[kind] += 1
    return tuple(models)


def with_correspondences(experiment: Experiment) -> list[Measurement]:
    """Return the measurements of an experiment that have correspondences, in their order."""
    return [
        each for each in experiment.measurements if issubclass(model_of(each), CorrespondenceModel)
    ]


def first_association(experiment: Experiment) -> Association:
    """Return the association for the stated places of an experiment's markers and sensors, with a
    clock that is not shifted.
    """
    models = ()
    if with_correspondences(experiment):
        models = measurement_models(MotionGrid.at_samples(experiment))
    return Association(
        MarkerAssociation.from_experiment(experiment),
        correspondences=tuple(
            model.first_correspondences()
            for model in models
            if isinstance(model, CorrespondenceModel)
        ),
    )


def belongs_to(association: Association, experiment: Experiment) -> bool:
    """Return whether an association is one of the experiment's body (the same object), with the
    same priors and the same measurements with correspondences.
    """
    measured = [each.measured for each in association.correspondences]
    return association.markers.matches(experiment) and measured == with_correspondences(experiment)
