"""A package of another author: string potentiometers as a kind of measurement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from collocation_sysid import CustomSensor
from collocation_sysid.common.schema_tables import Vector
from collocation_sysid.common.validated_types import Positive, Text
from collocation_sysid.problem.measurement_section import MeasurementSection, RecordingFolder


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class StringPotentiometer(CustomSensor):
    """Distance between a point of the body and a fixed eyelet, with an unknown zero."""

    name: str
    t_s: np.ndarray
    values: np.ndarray | None
    sigma: float
    points_m: np.ndarray
    eyelet_m: np.ndarray
    unknowns: Mapping[str, float] = field(default_factory=lambda: {"zero_m": 2e-3})
    unit: str = "m"

    def predict(self, at, zero_m):
        """Return the length of the string [m]."""
        return ca.norm_2(at.position_m[:, 0] - ca.DM(np.array(self.eyelet_m))) + zero_m


class StringPotentiometerSection(MeasurementSection):
    """A string potentiometer.

    Attributes
    ----------
    file : str, optional
        Table with the columns t_s and length_m.
    sigma_m : float
        Standard deviation of the noise [m].
    point_m : list
        Point [x, y, z] on the undeformed body.
    eyelet_m : list
        Eyelet [x, y, z] in the world.
    """

    file: Text | None = None
    sigma_m: Positive
    point_m: Vector
    eyelet_m: Vector

    def read(self, folder: RecordingFolder, where: str, t_s: np.ndarray) -> StringPotentiometer:
        """Return the measurements within the times of the experiment."""
        at_s, values, _ = folder.read_samples(self.file, where, t_s)
        return StringPotentiometer(
            name=self.name,
            t_s=at_s,
            values=values,
            sigma=self.sigma_m,
            points_m=np.array([self.point_m]),
            eyelet_m=np.array(self.eyelet_m),
        )
