"""Marker–element association: the element of each marker's place.

The place X of a marker on the undeformed body is estimated. Predictions are smooth functions of it
within one element; a `MarkerAssociation` states which. When estimates leave it,
`MarkerAssociation.follow_estimates` returns another association, and the problem stays the same up
to the tolerances below.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ...common.array_types import Array, Index
from ...fem.body import Body
from ...recording.experiment import Experiment
from ...recording.placement import LocatedBody, Placement

# A place leaves its element when another contains it better by this barycentric coordinate, so that
# it cannot alternate between two.
BETTER = 0.01
# Number of times in succession that a place may leave the surface across the same edge; after that
# it stays in its plane.
LARGEST_CROSSING_COUNT = 2
# Distance below which edges are the same, relative to the mean edge length.
SAME_EDGE_DISTANCE = 1e-6


class ShapeFunctions(NamedTuple):
    """Weights of the npe nodes of an element in the place of each marker, and their derivatives by
    the k coordinates of the place, which are in prior standard deviations.
    """

    weights: Array  # (M, npe): shape functions, npe being the nodes per element
    gradients: Array  # (M, npe, k): first derivatives; zero for exact places
    hessians: Array  # (M, npe, k, k): second derivatives; zero for exact places


@dataclass(frozen=True, eq=False)
class MarkerAssociation:
    """Element of each marker, and directions in which its place may move."""

    body: Body
    sigma_m: Array  # (M,): prior standard deviation of each place [m], zero where it is exact
    prior_places_m: Array  # (M, 3): places at the centres of the priors [m]
    # Whether places move in the plane of the nearest face (k = 2), or freely (k = 3).
    on_surface: bool
    # (M, npe): nodes and shape functions of exact places.
    nodes: Index
    weights: Array
    cells: Index  # (M,): elements of estimated places
    centre_places_m: Array  # (M, 3): places at the centre of the association [m]
    axes: Array  # (M, 3, k): orthonormal directions in which places may move
    # (M, 2, 3): point and direction of the edge across which each place last left the surface; NaN
    # if it did not.
    crossed_edges: Array
    # (M,): how often in succession it left the surface across this edge before.
    crossing_counts: Index

    @classmethod
    def from_experiment(cls, experiment: Experiment) -> MarkerAssociation:
        """Return the association for the stated places of an experiment's markers.

        Markers without a stated place get the place where their first sample lies on the undeformed
        body in its grasp; `Transcription.place_unknown_markers` replaces it before a solve.
        """
        body = experiment.body
        markers = experiment.markers
        placement = markers.placement
        sigma_m = experiment.place_sigma_m
        points = markers.predict_positions(body.nodes_m)
        k = markers.place_dimension(body)
        association = body.kind.association(
            body,
            sigma_m,
            prior_places_m=points,
            on_surface=k < 3,
            nodes=placement.nodes,
            weights=placement.weights,
            cells=np.zeros(len(points), dtype=np.int64),
            centre_places_m=points,
            axes=np.zeros((len(points), 3, k)),
            crossed_edges=np.full((len(points), 2, 3), np.nan),
            crossing_counts=np.zeros(len(points), dtype=np.int64),
        )
        return association.centred_at(points)

    @classmethod
    def from_exact_places(
        cls, body: Body, placement: Placement, points_m: Array
    ) -> MarkerAssociation:
        """Return the association for places (M, 3) [m] that are not estimated, with the nodes and
        weights of `placement`, and k = 3 coordinates without effect.
        """
        count = len(points_m)
        none = np.zeros(count, dtype=np.int64)
        return cls(
            body=body,
            sigma_m=np.zeros(count),
            prior_places_m=points_m,
            on_surface=False,
            nodes=placement.nodes,
            weights=placement.weights,
            cells=none,
            centre_places_m=points_m,
            axes=np.zeros((count, 3, 3)),
            crossed_edges=np.full((count, 2, 3), np.nan),
            crossing_counts=none,
        )

    def matches(self, experiment: Experiment) -> bool:
        """Return whether the association belongs to the experiment's body (the same object), and
        has the same priors.
        """
        return (
            self.body is experiment.body
            and self.axes.shape[2] == experiment.markers.place_dimension(self.body)
            and np.array_equal(self.sigma_m, experiment.place_sigma_m)
        )

    @cached_property
    def estimated(self) -> Index:
        """Indices of the markers whose places are estimated."""
        return np.flatnonzero(self.sigma_m > 0)

    @cached_property
    def centre_coordinates(self) -> Array:
        """Coordinates φ (M, k) of the places at the centre of the association."""
        return self.coordinates(self.centre_places_m)

    def coordinates(self, points_m: Array) -> Array:
        """Return coordinates (M, k) in prior standard deviations; zero for exact places."""
        away_m = np.einsum("mik,mi->mk", self.axes, points_m - self.prior_places_m)
        return self._in_deviations(away_m)

    def _in_deviations(self, away_m: Array) -> Array:
        return away_m / np.where(self.sigma_m > 0, self.sigma_m, np.inf)[:, None]

    def places_m(self, phi: Array) -> Array:
        """Return the places (M, 3) on the undeformed body [m] for coordinates `phi` (M, k) in prior
        standard deviations along `axes`, linear about the centre; exact places do not move.
        """
        moved = np.einsum("mik,mk->mi", self.axes, phi - self.centre_coordinates)
        return self.centre_places_m + self.sigma_m[:, None] * moved

    def shape_functions(self, phi: Array) -> tuple[Index, ShapeFunctions]:
        """Return the nodes (M, npe) of each marker's element, and their shape functions at its
        place with derivatives by the k coordinates of the place.

        The element is that of the association, also if the place is outside; exact places have
        their stated nodes and weights.

        Parameters
        ----------
        phi : (M, k) array
            Coordinates of the places, in prior standard deviations along `axes`.
        """
        element = self.body.place_element
        k = self.axes.shape[2]
        nodes = self.nodes.copy()
        weights = self.weights.copy()
        slopes = np.zeros((*nodes.shape, k))
        curvatures = np.zeros((*nodes.shape, k, k))
        estimated = self.estimated
        if len(estimated):
            cells = self.cells[estimated]
            local = self._shape.barycentric(self.places_m(phi)[estimated], cells)
            gradients = self._shape.barycentric_gradients(cells) @ (
                self.sigma_m[estimated, None, None] * self.axes[estimated]
            )
            nodes[estimated] = self.body.place_cells[cells]
            weights[estimated] = element.shape_functions(local)
            slopes[estimated] = element.shape_gradients(local) @ gradients
            curvatures[estimated] = np.einsum(
                "mail,mik,mln->makn", _second_derivatives(element, local), gradients, gradients
            )
        return nodes, ShapeFunctions(weights, slopes, hessians=curvatures)

    @cached_property
    def _shape(self) -> LocatedBody:
        return LocatedBody(self.body.nodes_m, self.body)

    # Following the estimates ------------------------------------------------------------------

    def centred_at(self, points_m: Array) -> MarkerAssociation:
        """Return the association with its centre at places (M, 3) [m] of the estimated markers:
        their elements, and the axes along which the places may move.

        With `on_surface` the centres are the nearest points of the surface. Exact places are
        centred at the points too, but keep their nodes and weights.
        """
        points = points_m.copy()
        cells = self.cells.copy()
        axes = self.axes.copy()
        for m in self.estimated:
            if self.on_surface:
                points[m], axes[m] = self._shape.nearest_surface_point(points[m])
            else:
                axes[m] = np.eye(3)
            cells[m] = self._cell_at(points[m])
        return replace(self, centre_places_m=points, cells=cells, axes=axes)

    def follow_estimates(self, phi: Array) -> tuple[MarkerAssociation, Array]:
        """Return an association for estimates that have left this one, and φ in it.

        If a place has left its element, all centres are moved to the estimates.

        Parameters
        ----------
        phi : (M, k) array
            Coordinates of the places, in prior standard deviations along `axes`.

        Returns
        -------
        (MarkerAssociation, (M, k) array)
            The new association, which is self if nothing has left it, and φ in it.
        """
        points = self.places_m(phi)
        changed_cell = False
        for m in self.estimated:
            changed_cell = changed_cell or self._is_outside(points[m], int(self.cells[m]))
        if not changed_cell:
            return self, phi
        association = self._without_alternation(points)
        return association, association.centre_coordinates

    def _without_alternation(self, points_m: Array) -> MarkerAssociation:
        """Return the association at places (M, 3) [m], of which none alternates for ever."""
        # Where a marker stands off an edge, the plane of each face may lead back to the other. A
        # place that has crossed the same edge `LARGEST_CROSSING_COUNT` times stays in its plane.
        centred = self.centred_at(points_m)
        if centred.axes.shape[2] != 2:
            return centred
        points = centred.centre_places_m.copy()
        axes = centred.axes.copy()
        cells = centred.cells.copy()
        crossed = self.crossed_edges.copy()
        again = self.crossing_counts.copy()
        same_m = SAME_EDGE_DISTANCE * self._shape.mean_edge_m
        for m in self.estimated:
            beyond = points_m[m] - points[m]
            is_free = again[m] < LARGEST_CROSSING_COUNT
            if is_free and np.linalg.norm(beyond) > same_m:
                edge = np.cross(np.cross(*self.axes[m].T), beyond)
                off_m = np.linalg.norm(np.cross(points[m] - crossed[m, 0], crossed[m, 1]))
                again[m] = again[m] + 1 if off_m < same_m else 0
                crossed[m] = points[m], edge / np.linalg.norm(edge)
            if again[m] == LARGEST_CROSSING_COUNT:
                points[m] = points_m[m]
                axes[m] = self.axes[m]
                cells[m], _ = self._shape.nearest_cell(points_m[m])
        return replace(
            centred,
            centre_places_m=points,
            axes=axes,
            cells=cells,
            crossed_edges=crossed,
            crossing_counts=again,
        )

    def _is_outside(self, point: Array, cell: int) -> bool:
        """Whether another element contains a point better, by more than `BETTER`; false for NaN."""
        if not np.isfinite(point).all():
            return False
        if self._shape.barycentric(point, np.array([cell])).min() >= 0:
            return False  # no other element contains it better
        best = self._cell_at(point)
        smallest = self._shape.barycentric(np.stack([point, point]), np.array([cell, best])).min(
            axis=1
        )
        return bool(smallest[1] > smallest[0] + BETTER)

    def _cell_at(self, point: Array) -> int:
        return self._shape.nearest_cell(point)[0]

    def places_of_points(self, nodes_m: Array, points_m: Array) -> Array:
        """Return the places (M, 3) on the undeformed body of points measured in another
        configuration.

        A point outside the body gets the place of the nearest point of its surface.

        Parameters
        ----------
        nodes_m : (n, 3) array
            Node positions of the configuration [m].
        points_m : (M, 3) array
            Points [m].

        Returns
        -------
        (M, 3) array
            Places [m]; NaN where a point is not finite.
        """
        return LocatedBody(nodes_m, self.body).places_of_points(points_m)


def _second_derivatives(element, local: Array) -> Array:
    """Return ∂²N/∂L² (m, npe, 4, 4) at L (m, 4), for gradients that are linear in L."""
    at = element.shape_gradients(local)
    steps = [element.shape_gradients(local + unit) - at for unit in np.eye(4)]
    return np.stack(steps, axis=3)
