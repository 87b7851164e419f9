"""Custom sensors whose points on the body follow the estimates, see `FollowingSensor`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..fem.body import Body
from ..recording.custom_sensor import FollowingSensor
from ..recording.placement import Placement
from .association import Association
from .correspondences import Correspondences
from .custom_sensor_residual import CorrespondingSensorResidual
from .markers.association import MarkerAssociation
from .measurement_model import CorrespondenceModel
from .measurement_residual import GROUP, SampledMotion
from .observables import PointPositions


@dataclass(frozen=True, eq=False)
class NodesOfSamples(Correspondences):
    """Nodes to which the samples of a sensor refer."""

    sensor: FollowingSensor
    body: Body
    nodes: NDArray[np.integer]  # (S, P): nodes of each sample

    @property
    def measured(self) -> FollowingSensor:
        return self.sensor

    def with_start_values(self, phi: Array) -> Array:
        """Return a copy of φ: the nodes do not depend on it."""
        return phi.copy()

    def in_shapes(self, shapes_m: Array) -> NodesOfSamples:
        """Return the correspondences with the first s samples in shapes (s, n, 3) [m]; self if the
        nodes are the same.
        """
        nodes = self.nodes.copy()
        if len(shapes_m):
            nodes[: len(shapes_m)] = self.sensor.nodes_of_samples(self.body, shapes_m)
        return self if np.array_equal(nodes, self.nodes) else replace(self, nodes=nodes)


@dataclass(frozen=True, eq=False)
class FollowingSensorResidual(CorrespondingSensorResidual):
    """Residual of a custom sensor at given nodes; its observable are all nodes of the body."""

    correspondences: NodesOfSamples

    @property
    def point_indices(self) -> NDArray[np.integer]:
        return self.correspondences.nodes

    @property
    def observable_sigmas(self) -> Array:
        """Standard deviations (3n,) of the node positions as one sample determines them, from the
        derivatives for the undeformed body; infinite where no sample depends on them.
        """
        nodes_m = self.correspondences.body.nodes_m
        still = np.broadcast_to(nodes_m, (self.observable.count, *nodes_m.shape))
        samples = self._evaluate(still, np.zeros(self.nuisance.size))
        nodes = np.repeat(samples.stencil.indices[:, 0] % len(nodes_m), GROUP, axis=1)
        components = GROUP * nodes + np.arange(nodes.shape[1]) % GROUP
        squares = np.zeros(GROUP * len(nodes_m))
        by_nodes = samples.by_inputs[:, 0, :, : components.shape[1]]
        np.add.at(squares, components, np.sum(np.nan_to_num(by_nodes) ** 2, axis=1))
        with np.errstate(divide="ignore"):
            return 1 / np.sqrt(squares / max(1, self.is_compared.sum()))

    def reassociated(self, x: Array, phi: Array) -> NodesOfSamples:
        return self.correspondences.in_shapes(self._shapes(x))

    def aligned_correspondences(
        self, x: Array, phi: Array, only_pose: bool = False
    ) -> NodesOfSamples:
        """Return the nodes of the shapes that the first rows x reach, of the last row if that is
        none; the present ones with `only_pose`, because the sensor has no pose.
        """
        shapes_m = self._shapes(x)
        if only_pose:
            return self.correspondences
        return self.correspondences.in_shapes(
            shapes_m if len(shapes_m) else x[-1:].reshape(1, -1, 3)
        )

    def correspondences_of(self, measured: Any, x: Array, phi: Array) -> NodesOfSamples:
        return replace(self.correspondences, sensor=measured).in_shapes(self._shapes(x))

    def simulated(self, motion: SampledMotion, phi: Array) -> Array:
        """Return the numbers (S, m) for the nodes that belong to a simulated motion."""
        other = self.at_samples(motion.t_s, motion.reaction_grid)
        nodes = other.reassociated(motion.observed.x, phi)
        followed = replace(other, correspondences=nodes)
        return followed.numbers(followed.predict_motion(motion.observed, phi))


def all_nodes(body: Body, rows: int) -> PointPositions:
    """Return all nodes of a body as an observable at the first `rows` grid times."""
    count = len(body.nodes_m)
    nodes = Placement(
        np.arange(count)[:, None], np.ones((count, 1)), distance_m=np.zeros(count), node_count=count
    )
    association = MarkerAssociation.from_exact_places(body, nodes, points_m=body.nodes_m)
    return PointPositions(np.arange(rows), association, np.full((count, 3), -1))


class FollowingSensorModel(CorrespondenceModel):
    """Custom sensor whose points on the body follow the estimates."""

    measurement: FollowingSensor

    @cached_property
    def _observable(self) -> PointPositions:
        return all_nodes(self.grid.experiment.body, len(self.grid.t_s))

    def first_correspondences(self) -> NodesOfSamples:
        experiment = self.grid.experiment
        at_s = np.clip(self.measurement.sample_times_s, *experiment.t_s[[0, -1]])
        nodes = self.measurement.nodes_of_samples(experiment.body, experiment.rigid_positions(at_s))
        return NodesOfSamples(self.measurement, experiment.body, nodes)

    def residuals(
        self, association: Association, correspondences: Correspondences | None
    ) -> tuple[FollowingSensorResidual]:
        assert isinstance(correspondences, NodesOfSamples)
        residual = FollowingSensorResidual.from_sensor(
            self.measurement,
            self.number,
            observable=self._observable,
            at_s=self.grid.t_s,
            nuisance=self.grid.nuisance,
            huber=self.grid.huber,
            static=self.grid.experiment.is_static,
            correspondences=correspondences,
        )
        vars(residual)["_expressions"] = self._expressions
        return (residual,)
