"""Registry of the features that contribute to checks, runs and reports."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ..errors import InputError
from ..program.simulation import Trajectory
from ..recording.experiment import Experiment
from ..statistics.concerns import declare_messages, declare_topics
from .camera_feature import CAMERAS
from .contact_feature import CONTACT
from .custom_sensor_feature import CUSTOM_SENSORS
from .feature import Feature, Fields
from .marker_feature import MARKERS
from .measurement_results import InstrumentPrediction, PredictionResiduals
from .wrench_feature import WRENCH

# Share of the samples below which a note says what is missing, and most names in it.
LEAST_SHARE = 0.5
MOST_SHOWN = 3
# In the order of the residuals of an experiment, see `Transcription.residuals`.
FEATURES: tuple[Feature, ...] = (MARKERS, WRENCH, CUSTOM_SENSORS, CONTACT, CAMERAS)
for _feature in FEATURES:
    declare_topics(_feature.topics)
    declare_messages(_feature.messages)


def prediction_residuals(
    experiment: Experiment, trajectory: Trajectory, predicted: InstrumentPrediction
) -> PredictionResiduals:
    """Return the differences by which a prediction of an experiment is judged: those of the first
    feature that has some.

    Raises
    ------
    ValueError
        If nothing is measured by which it could be judged.
    """
    of_features = (
        each.prediction_residuals(experiment, trajectory, predicted) for each in FEATURES
    )
    for residuals in of_features:
        if residuals is not None:
            return residuals
    raise ValueError(f"nothing is measured in '{experiment.name}'")


def lost_samples(experiment: Experiment) -> list[str]:
    """Return a note for each measurement of which less than half is present.

    Raises
    ------
    InputError
        If nothing of a measurement is present within the recording.
    """
    notes = []
    for part in (part for feature in FEATURES for part in feature.samples(experiment)):
        if not part.is_present.any():
            raise InputError(
                f"nothing of {part.what} of '{experiment.name}' is measured between "
                f"{experiment.t_s[0]:.6g} s and {experiment.t_s[-1]:.6g} s; expected at least one "
                "sample: check columns, labels and times, or leave it out",
                where="experiment",
            )
        share = part.is_present.mean(axis=0)
        few = np.flatnonzero(share < LEAST_SHARE).tolist()
        if few:
            shown = ", ".join(f"{part.names[k]} ({share[k]:.0%})" for k in few[:MOST_SHOWN])
            more = ", …" if len(few) > MOST_SHOWN else ""
            notes.append(
                f"experiment '{experiment.name}': of {part.what}, {len(few)} of {len(share)} "
                f"columns are present in less than half of the samples: {shown}{more}; what is "
                "present is used"
            )
    return notes


def merged_fields(contributions: Iterable[Fields]) -> dict[str, Any]:
    """Return the fields that several features contribute, as one mapping.

    Raises
    ------
    ValueError
        If two features contribute the same field.
    """
    merged: dict[str, Any] = {}
    for fields in contributions:
        if twice := merged.keys() & fields.keys():
            raise ValueError(
                f"two features contribute the field {min(twice)!r} to one object; expected "
                "different names of fields"
            )
        merged |= fields
    return merged
