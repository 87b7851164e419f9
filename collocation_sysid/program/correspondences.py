"""Correspondences between unlabelled measurements and the body, which follow the estimates.

Points that a sensor measures without saying which point of the body they are have corresponding
points on the body, for the current shape. A `CorrespondenceResidual` is the measurement model at
given `Correspondences`, and finds those of other estimates. Search and transcription need nothing
else of such a sensor.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

from ..common.array_types import Array
from .measurement_residual import MeasurementResidual


class Correspondences(ABC):
    """Points of the body that correspond to the measurements of one sensor.

    Attributes
    ----------
    is_labelled : bool
        Whether the measurements state which points they are, so that other estimates change places
        and visibility only: the correspondences are then valid far from the estimates, too.
    """

    is_labelled: ClassVar[bool] = False

    @property
    @abstractmethod
    def measured(self) -> Any:
        """Measurements, as the experiment declares them (the same object)."""

    @abstractmethod
    def with_start_values(self, phi: Array) -> Array:
        """Return a copy of φ (k,) of the experiment with those nuisance parameters of the sensor
        for which the correspondences were found.
        """

    def continued(self, phi: Array, previous: Correspondences) -> Array:
        """Return φ (k,), relative to the previous correspondences of the sensor, relative to these;
        here φ itself.
        """
        return phi


@dataclass(frozen=True, eq=False)
class CorrespondenceResidual(MeasurementResidual):
    """Measurement model of one sensor at given correspondences."""

    correspondences: Correspondences  # corresponding points on the body

    @property
    @abstractmethod
    def first_row(self) -> int:
        """Index of the last row of the motion on which the first sample depends."""

    @abstractmethod
    def reassociated(self, x: Array, phi: Array) -> Correspondences:
        """Return the correspondences at other estimates; the present object if they have settled.

        Parameters
        ----------
        x : (rows, 3n) array
            First rows of the motion [m]; samples that they do not reach keep their shapes.
        phi : (k,) array
            Nuisance parameters; not modified.
        """

    @abstractmethod
    def aligned_correspondences(
        self, x: Array, phi: Array, only_pose: bool = False
    ) -> Correspondences:
        """Align the sensor with the first rows of a motion and return the correspondences.

        Parameters
        ----------
        x : (rows, 3n) array
            First rows [m]; if they do not reach the first sample, the last row is used for it.
            Samples that they do not reach keep their shapes.
        phi : (k,) array
            Nuisance parameters; not modified.
        only_pose : bool
            Whether to keep the present correspondences, with the new pose of the sensor.

        Returns
        -------
        Correspondences
            The present correspondences if they are those of an alignment with the same shapes.
        """

    @abstractmethod
    def correspondences_of(self, measured: Any, x: Array, phi: Array) -> Correspondences:
        """Return the correspondences of other points of the same sensor and samples, such as all
        points in place of thinned ones.

        Parameters
        ----------
        measured : object
            Measurements of the same sensor with its other points, as an experiment declares them.
        x : (N, 3n) array
            The motion [m].
        phi : (k,) array
            Nuisance parameters; not modified.
        """
