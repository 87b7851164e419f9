"""Places on a rod, which move along its centreline."""

from __future__ import annotations

import numpy as np

from ...common.array_types import Array, Index
from ...program.markers.association import MarkerAssociation, ShapeFunctions
from .element import RodMesh


class CentrelineAssociation(MarkerAssociation):
    """Association of places on a rod, which move along its centreline (k = 1); the element of a place
    is that between two sections.
    """

    @property
    def _rod(self) -> RodMesh:
        assert isinstance(self.body.mesh, RodMesh)
        return self.body.mesh

    def coordinates(self, points_m: Array) -> Array:
        """Return coordinates (M, 1) in prior standard deviations; zero for exact places."""
        away_m = self._rod.nearest_s_m(points_m) - self._rod.nearest_s_m(self.prior_places_m)
        return self._in_deviations(away_m[:, None])

    def _s_m(self, phi: Array) -> Array:
        """Return the arc lengths (M,) of places [m] for coordinates `phi` (M, 1)."""
        return self._rod.nearest_s_m(self.prior_places_m) + self.sigma_m * phi[:, 0]

    def places_m(self, phi: Array) -> Array:
        """Return the places (M, 3) on the undeformed centreline [m] for coordinates `phi` (M, 1)."""
        along = self._rod.places_m(self._s_m(phi))
        return np.where(self.sigma_m[:, None] > 0, along, self.centre_places_m)

    def shape_functions(self, phi: Array) -> tuple[Index, ShapeFunctions]:
        """Return `MarkerAssociation.shape_functions`, of the nodes of four sections."""
        here = self.estimated
        if not len(here):
            return super().shape_functions(phi)
        s_m = self._s_m(phi)[here]
        sections, *weights = self._rod.smooth_interpolation(s_m, self.cells[here])
        node_count = 3 * sections.shape[1]
        beyond = ((0, 0), (0, node_count - self.nodes.shape[1]))
        nodes = np.pad(self.nodes, beyond)
        nodes[here] = (3 * sections[..., None] + np.arange(3)).reshape(len(here), -1)
        by_order = np.zeros((3, *nodes.shape))
        by_order[0] = np.pad(self.weights, beyond)
        by_order[:, here] = np.repeat(weights, 3, axis=2) / 3
        by_order *= self.sigma_m[:, None] ** np.arange(3)[:, None, None]
        return nodes, ShapeFunctions(
            by_order[0], by_order[1, ..., None], by_order[2, ..., None, None]
        )

    def _is_outside(self, point: Array, cell: int) -> bool:
        return bool(np.isfinite(point).all()) and self._cell_at(point) != cell

    def _cell_at(self, point: Array) -> int:
        return int(self._rod.elements_at(self._rod.nearest_s_m(point[None]))[0])
