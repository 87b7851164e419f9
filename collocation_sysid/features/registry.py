"""Registry of the features that contribute to checks, runs and reports."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from .contact_feature import CONTACT
from .custom_sensor_feature import CUSTOM_SENSORS
from .depth_feature import DEPTH
from .feature import Feature, Fields
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
