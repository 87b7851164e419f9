"""Where a recording is read: an element for each marker's place, and the clock's whole samples.

The place X of a marker on the undeformed body, and the time shift τ, are estimated. What a marker
reads is smooth in them within one element and around one sample; a chart says which. As estimates
move on, the chart follows, and the problem stays the same up to the tolerance below.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..arrays import Array, Index
from ..fem.body import Body
from ..recording.experiment import Experiment
from ..recording.placement import Placement, Shape
from .sighting import Sighting, sightings_of

# A place leaves its element when another holds it better by this, in barycentric coordinates: so
# it cannot swing between two. The clock leaves its sample when it is off by more than this.
BETTER, SAMPLES_OFF = 0.01, 1.0
# A place that leaves the surface across an edge where it did before, so many times more, keeps to
# the plane it is in. What is nearer than this, over an edge of the mesh, is the same.
AGAIN, SAME = 2, 1e-6


class ShapeFunctions(NamedTuple):
    """Weights of the nodes in what each marker reads, and their derivatives by its φ.

    weights (M, npe), slopes (M, npe, k), curvatures (M, npe, k, k)
    """

    weights: Array
    slopes: Array
    curvatures: Array


@dataclass(frozen=True, eq=False)
class Chart:
    """The element of each marker, the plane it may move in, and the clock's sample.

    Attributes
    ----------
    body : Body
    sigma_m : (M,) deviation of each place, zero where it is exact
    given_m : (M, 3) the places that the priors are about
    on_surface : bool
        Places move in the plane of the nearest face, k = 2; freely otherwise, k = 3.
    nodes, weights : (M, npe) of the exact ones
    cells : (M,) elements
    points_m : (M, 3) places that the chart is about
    axes : (M, 3, k) orthonormal directions that places may move in
    samples : int
        Whole samples of the time shift.
    sightings : tuple of Sighting
        Where the points of depth cameras are on the surface.
    crossed : (M, 2, 3) a point and the direction of the edge that each place last left the surface
        across, NaN where it did not
    again : (M,) how often it left there before
    """

    body: Body
    sigma_m: Array
    given_m: Array
    on_surface: bool
    nodes: Index
    weights: Array
    cells: Index
    points_m: Array
    axes: Array
    crossed: Array
    again: Index
    samples: int = 0
    sightings: tuple[Sighting, ...] = ()

    @classmethod
    def of(cls, experiment: Experiment) -> Chart:
        """The chart about the places given, or where the first samples put the markers."""
        body, markers = experiment.body, experiment.markers
        placement, sigma_m = markers.placement, experiment.place_sigma_m
        points = markers.observe(body.nodes_m)
        k = 2 if markers.on_surface else 3
        chart = cls(
            body,
            sigma_m,
            points,
            markers.on_surface,
            placement.nodes,
            placement.weights,
            np.zeros(len(points), dtype=np.int64),
            points,
            np.zeros((len(points), 3, k)),
            np.full((len(points), 2, 3), np.nan),
            np.zeros(len(points), dtype=np.int64),
            sightings=sightings_of(experiment),
        )
        return chart.about(points)

    @classmethod
    def exact(cls, body: Body, placement: Placement, points_m: Array) -> Chart:
        """The chart of places that are not estimated."""
        count = len(points_m)
        none = np.zeros(count, dtype=np.int64)
        return cls(
            body=body,
            sigma_m=np.zeros(count),
            given_m=points_m,
            on_surface=False,
            nodes=placement.nodes,
            weights=placement.weights,
            cells=none,
            points_m=points_m,
            axes=np.zeros((count, 3, 3)),
            crossed=np.full((count, 2, 3), np.nan),
            again=none,
        )

    def suits(self, experiment: Experiment) -> bool:
        """Whether it is of this body, and of places known as well as the experiment's."""
        return (
            self.body is experiment.body
            and self.on_surface == experiment.markers.on_surface
            and np.array_equal(self.sigma_m, experiment.place_sigma_m)
            and [s.view.depth for s in self.sightings] == [*experiment.depths]
        )

    @cached_property
    def estimated(self) -> Index:
        """Markers whose places are not exact."""
        return np.flatnonzero(self.sigma_m > 0)

    @cached_property
    def centre(self) -> Array:
        """(M, k) φ at the chart's points."""
        return self._coordinates(self.points_m)

    def _coordinates(self, points_m: Array) -> Array:
        sigma = np.where(self.sigma_m > 0, self.sigma_m, np.inf)[:, None]
        return np.einsum("mik,mi->mk", self.axes, points_m - self.given_m) / sigma

    def places_m(self, phi: Array) -> Array:
        """(M, 3) places on the undeformed body at φ (M, k)."""
        moved = np.einsum("mik,mk->mi", self.axes, phi - self.centre)
        return self.points_m + self.sigma_m[:, None] * moved

    def reading(self, phi: Array) -> tuple[Index, ShapeFunctions]:
        """Nodes (M, npe) that each marker reads, and with what weights, at φ (M, k)."""
        element, k = self.body.element, self.axes.shape[2]
        nodes, weights = self.nodes.copy(), self.weights.copy()
        slopes = np.zeros((*nodes.shape, k))
        curvatures = np.zeros((*nodes.shape, k, k))
        here = self.estimated
        if len(here):
            cells = self.cells[here]
            local = self._shape.barycentric(self.places_m(phi)[here], cells)
            along = self._shape.gradients(cells) @ (
                self.sigma_m[here, None, None] * self.axes[here]
            )
            nodes[here] = self.body.cells[cells]
            weights[here] = element.shape_functions(local)
            slopes[here] = element.shape_gradients(local) @ along
            curvatures[here] = np.einsum(
                "mail,mik,mln->makn", _second_derivatives(element, local), along, along
            )
        return nodes, ShapeFunctions(weights, slopes, curvatures)

    @cached_property
    def _shape(self) -> Shape:
        return Shape(self.body.nodes_m, self.body)

    # Following the estimates ------------------------------------------------------------------

    def about(self, points_m: Array) -> Chart:
        """The chart about places (M, 3); on a surface they move to its nearest point."""
        points, cells, axes = points_m.copy(), self.cells.copy(), self.axes.copy()
        for m in self.estimated:
            if self.on_surface:
                points[m], axes[m] = self._shape.on_surface(points[m])
            else:
                axes[m] = np.eye(3)
            cells[m], _ = self._shape.cell_of(points[m])
        return replace(self, points_m=points, cells=cells, axes=axes)

    def following(self, phi: Array, shift_samples: float) -> tuple[Chart, Array]:
        """A chart for estimates that have left this one, and φ (M, k) in it; itself where none has.

        Parameters
        ----------
        phi : (M, k) of the places
        shift_samples : float, the time shift over the sample interval
        """
        points, left = self.places_m(phi), False
        for m in self.estimated:
            left = left or self._has_left(points[m], int(self.cells[m]))
        samples = self.samples
        if abs(shift_samples - samples) > SAMPLES_OFF:
            samples = round(shift_samples)
        if not left:
            return (self if samples == self.samples else replace(self, samples=samples)), phi
        chart = replace(self._settled(points), samples=samples)
        return chart, chart.centre

    def _settled(self, points_m: Array) -> Chart:
        """The chart about places (M, 3), of which none alternates between two faces for ever.

        Beyond an edge, as of a marker that stands off it, the plane of each face may lead back to
        the other. Such a place stays in one of the planes, also where that has left the surface.
        """
        found = self.about(points_m)
        if not self.on_surface:
            return found
        points, axes, cells = found.points_m.copy(), found.axes.copy(), found.cells.copy()
        crossed, again = self.crossed.copy(), self.again.copy()
        same_m = SAME * self._shape.mean_edge_m
        for m in self.estimated:
            beyond = points_m[m] - points[m]
            if again[m] < AGAIN and np.linalg.norm(beyond) > same_m:
                edge = np.cross(np.cross(*self.axes[m].T), beyond)
                off_m = np.linalg.norm(np.cross(points[m] - crossed[m, 0], crossed[m, 1]))
                again[m] = again[m] + 1 if off_m < same_m else 0
                crossed[m] = points[m], edge / np.linalg.norm(edge)
            if again[m] == AGAIN:
                points[m], axes[m] = points_m[m], self.axes[m]
                cells[m], _ = self._shape.cell_of(points_m[m])
        return replace(found, points_m=points, axes=axes, cells=cells, crossed=crossed, again=again)

    def _has_left(self, point: Array, cell: int) -> bool:
        if not np.isfinite(point).all():
            return False
        if self._shape.barycentric(point, np.array([cell])).min() >= 0:
            return False  # none holds it better
        best, _ = self._shape.cell_of(point)
        depth = self._shape.barycentric(np.stack([point, point]), np.array([cell, best])).min(
            axis=1
        )
        return bool(depth[1] > depth[0] + BETTER)

    def at_markers(self, nodes_m: Array, points_m: Array) -> Array:
        """(M, 3) places that lie at points (M, 3) of the body in some configuration (n, 3).

        Where a point lies off that body, the nearest of its surface; NaN where it is not finite.
        """
        shape, found = Shape(nodes_m, self.body), np.full(points_m.shape, np.nan)
        for m, point in enumerate(points_m):
            if np.isfinite(point).all():
                nodes, weights = shape.nearest(point)
                found[m] = weights @ self.body.nodes_m[nodes]
        return found


def _second_derivatives(element, local: Array) -> Array:
    """∂²N/∂L² (m, npe, 4, 4): gradients are linear in L."""
    at = element.shape_gradients(local)
    steps = [element.shape_gradients(local + unit) - at for unit in np.eye(4)]
    return np.stack(steps, axis=3)
