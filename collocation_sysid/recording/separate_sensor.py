"""Sensors with times of their own, in addition to markers and the sensors of grasps.

Fields of `Experiment` that contain such sensors have the metadata `SENSORS`. Functions that select
or thin the measurements of an experiment treat all of them by the methods of `SeparateSensor`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import cache
from typing import ClassVar, Self

import numpy as np

# Key of the mark in the metadata of a field.
MARK = "separate sensors"
# Metadata of a field that is a tuple of such sensors.
SENSORS: Mapping[str, bool] = {MARK: True}


@cache
def sensor_fields(kind: type) -> tuple[str, ...]:
    """Return the names of the fields of a dataclass that are marked by `SENSORS`, in their order."""
    return tuple(each.name for each in fields(kind) if MARK in each.metadata)


class SeparateSensor:
    """Base class of the declarations of sensors with times of their own.

    Attributes
    ----------
    measurement_text : str
        What it measures, as plural text.
    noise_key : str
        Key that states its noise, as in messages.
    points_name : str
        Plural of its unlabelled points; not used without any.
    measures_shape : bool
        Whether its measurements show the shape of the body at many points.
    """

    measurement_text: ClassVar[str]
    noise_key: ClassVar[str]
    points_name: ClassVar[str] = "points"
    measures_shape: ClassVar[bool] = False

    @property
    def point_counts(self) -> Sequence[int]:
        """Numbers of unlabelled points of each sample; empty if the sensor measures none."""
        return ()

    def thinned(self, most: int) -> Self:
        """Return a sensor with at most `most` unlabelled points in each sample; here self."""
        return self

    def needed_until_s(self, fewest: int) -> float:
        """Return the time [s] that the beginning of a recording must include so that the sensor is
        useful in it, if possible with the number `fewest` of samples; here any time, −∞.
        """
        return -np.inf

    def until_time(self, end_s: float) -> Self | None:
        """Return the sensor for a recording that ends at `end_s` [s], this time included; None if
        it has no measurement then. Here self: later samples are ignored.
        """
        return self

    def without_later_values(self, end_s: float) -> Self | None:
        """Return the sensor without measurements after `end_s` [s] in a recording that continues;
        None to leave the sensor out. Here the same as `until_time`.
        """
        return self.until_time(end_s)
