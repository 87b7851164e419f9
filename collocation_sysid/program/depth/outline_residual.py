"""Outline of a body in depth images as a measurement: how many pixels the body reaches too far.

    r = (n · (Σ_i ℓ_i(τ) Σ_a N_a x_{a,i} − T (R(a) ((1 + s) p − c) + c + e)) / h − w) / σ,

with n the normal of a plane through the camera and an edge in its image (see `outline`), p a
point of that plane, h the width of a pixel there [m], w how many pixels inside the outline of the
body its silhouette ends all around, and the other symbols as in `depth`. σ is in pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from ...common.array_types import Array
from ...recording.nuisance import DEPTH_EDGE
from ..measurement_residual import ResidualExpression, RowStencil
from .outline import Outline
from .residual import DepthResidual


@dataclass(frozen=True, eq=False)
class OutlineResidual(DepthResidual):
    """Measurement model of a body's outline: distances of outline points from edges in a
    camera's images [pixels].
    """

    sigma_key = "outline_sigma_px of depth"
    has_noise_floor = True

    @classmethod
    def from_depth(cls, depth: DepthResidual) -> OutlineResidual:
        """Return the measurement model of the outlines for the camera, images and correspondences
        of a depth measurement model, with its Huber threshold.
        """
        used = depth.correspondences.outline.is_compared
        samples, points = used.shape
        view = depth.correspondences.camera
        return cls(
            observable=depth.observable,
            nuisance=depth.nuisance,
            huber=depth.huber,
            names=(f"{view.depth.name} outline",) * points,
            t_s=depth.t_s,
            sigmas=np.full(points, view.depth.outline_sigma_px),
            measured=np.zeros((samples, points, 1)),
            is_compared=used[..., None],
            own_parameters=np.tile(view.parameter_indices, (points, 1)),
            correspondences=depth.correspondences,
            observable_s=depth.observable_s,
        )

    @property
    def correspondences_in_use(self) -> Outline:
        return self.correspondences.outline

    @property
    def _expressions(self) -> dict[tuple[int, int], ResidualExpression]:
        return self.correspondences.camera.outline_expressions

    @cached_property
    def _stencil(self) -> RowStencil:
        """As for depth, with the width of a pixel [m] (or one) as last datum."""
        places, data = super()._stencil
        width_m = np.where(
            self.correspondences_in_use.is_compared, self.correspondences_in_use.pixel_m, 1.0
        )
        return RowStencil(places, np.concatenate([data, width_m[None]]))

    def expression(self, values: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """Return how far an outline point is outside of its edge [pixels], minus the estimated
        offset of edges; arguments as in `DepthResidual.expression`, with the width of a pixel [m]
        as last datum.
        """
        count = data.numel() - 1
        outside_m = super().expression(values, phi, data=data[:count])
        inside_px = self.nuisance.values_by_row(phi, self.own_parameters[0]).get(DEPTH_EDGE, 0)
        return outside_m / data[count] - inside_px

    def signed_distances_px(self, values: Array, phi: Array) -> Array:
        """Return how far outline points (s, E) of the first s images are outside of their edges
        [pixels]; NaN where there is no edge.

        Parameters
        ----------
        values : (n, e, 3) array
            Positions of the surface nodes at the first n times of the observable [m].
        phi : (k,) array
            Nuisance parameters in units of their priors.
        """
        return self.signed_distances_m(values, phi)

    def rough_residuals(self, x: Array, phi: Array) -> Array:
        """Return an empty array: before anything is fitted, the distances to the points suffice."""
        return np.zeros(0)
