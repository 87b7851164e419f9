"""Registry of the features that contribute to checks, runs and reports."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .contact_feature import CONTACT
from .custom_sensor_feature import CUSTOM_SENSORS
from .depth_feature import DEPTH
from .feature import Feature
from .marker_feature import MARKERS
from .wrench_feature import WRENCH

# In the order of the residuals of an experiment, see `Transcription.residuals`.
FEATURES: tuple[Feature, ...] = (
    MARKERS,
    WRENCH,
    CUSTOM_SENSORS,
    CONTACT,
    DEPTH,
)


def merged_fields(contribution: str, *arguments: Any) -> dict[str, Any]:
    """Return the fields that all features contribute by one of their functions.

    Parameters
    ----------
    contribution : str
        Name of the function, such as "fit_fields".
    *arguments
        Its arguments.
    """
    fields: dict[str, Any] = {}
    for feature in FEATURES:
        own: Mapping[str, Any] = getattr(feature, contribution)(*arguments)
        fields |= own
    return fields
