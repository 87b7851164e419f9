"""Measurements of one experiment in its nonlinear program, before they are associated with the body.

A `MeasurementModel` makes the residuals of one measurement. Models of the kinds of this package and
of others are listed in `measurement_models`; program, simulation and statistics treat all alike.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from ..common.array_types import Array, Index
from ..model.nuisance_map import NuisanceMap
from ..recording.experiment import Experiment
from .association import Association
from .correspondences import CorrespondenceResidual, Correspondences
from .measurement_residual import MeasurementResidual, ResidualExpression
from .reactions.resultant import ReactionGrid

Residual = TypeVar("Residual", bound=CorrespondenceResidual)

# Threshold of Huber's loss of images in standard deviations, if the problem states none.
HUBER = 3.0


@dataclass(frozen=True, eq=False)
class MotionGrid:
    """Times at which the motion of an experiment is known, and what its measurements share."""

    experiment: Experiment
    nuisance: NuisanceMap  # its nuisance parameters φ
    t_s: Array  # (N,): times of the rows of x [s]
    reaction_grid: ReactionGrid  # times at which reaction forces are known
    sample_rows: Index  # (T,): rows of x at the samples of the experiment
    # Threshold of Huber's loss in standard deviations; None for the default of each kind.
    huber: float | None = None
    is_initially_at_rest: bool = True  # whether the body is at rest before the first time

    @classmethod
    def at_samples(cls, experiment: Experiment, grid: ReactionGrid | None = None) -> MotionGrid:
        """Return the grid of a motion that is known at the samples, with reaction forces at the
        times of `grid`, by default the same.
        """
        grid = grid or ReactionGrid.from_times(experiment.t_s)
        nuisance = NuisanceMap.from_experiment(experiment)
        return cls(experiment, nuisance, experiment.t_s, grid, np.arange(len(experiment.t_s)))


@dataclass(frozen=True, eq=False)
class MeasurementModel(ABC):
    """One measurement of an experiment in its nonlinear program, for any association."""

    measurement: Any
    # Its index among the experiment's markers, wrenches, custom sensors, or depth cameras.
    number: int
    grid: MotionGrid  # times at which the motion is known

    @abstractmethod
    def residuals(
        self, association: Association, correspondences: Correspondences | None
    ) -> Sequence[MeasurementResidual]:
        """Return the residuals of the measurement; the first one predicts its numbers or points.

        Parameters
        ----------
        association : Association
            Association of all measurements of the experiment with the body.
        correspondences : Correspondences or None
            Those of this measurement; None unless the model is a `CorrespondenceModel`.
        """


class CorrespondenceModel(MeasurementModel):
    """Measurement that refers to points of the body which follow the estimates."""

    @cached_property
    def _expressions(self) -> dict[tuple[int, int], ResidualExpression]:
        """Generated functions, which are the same for all correspondences."""
        return {}

    @abstractmethod
    def first_correspondences(self) -> Correspondences:
        """Return the correspondences with the undeformed body in its grasps, after an alignment of
        the sensor if its pose is estimated.
        """

    @abstractmethod
    def residuals(
        self, association: Association, correspondences: Correspondences | None
    ) -> Sequence[CorrespondenceResidual]:
        """Return the residuals at given correspondences, see `MeasurementModel.residuals`."""

    def image_residual(self, kind: Callable[..., Residual], **fields: Any) -> tuple[Residual]:
        """Return the residual of a class for images, with what all images of a camera share."""
        grid = self.grid
        residual = kind(
            nuisance=grid.nuisance,
            huber=HUBER if grid.huber is None else grid.huber,
            t_s=self.measurement.sample_times_s,
            sensor=self.measurement,
            observable_s=grid.t_s,
            is_static=grid.experiment.is_static,
            experiment=grid.experiment,
            **fields,
        )
        vars(residual)["_expressions"] = self._expressions
        return (residual,)
