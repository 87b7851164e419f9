"""Distances between the points of a depth camera and the surface of a given motion.

A motion that is simulated or predicted is associated with the points anew, which defines the points
that are compared; a fit has its own association, see `surface_correspondences`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...common.array_types import Array
from ...recording.measurement import root_mean
from .surface_correspondences import SurfaceCorrespondences, initial_gate_m

# Default threshold of Huber's loss [σ]: depth images contain other things too.
HUBER = 3.0


@dataclass(frozen=True)
class DepthError:
    """Distances of the points of one depth camera from the surface, along its normal.

    Compared are the points that lie within `reach_m` of a part of the surface that the camera can
    see (not grazing, not hidden, among the stated faces), see `SurfaceComparison`.
    """

    points: int  # number of points that are compared
    # Number of all points in the images, including those that are not compared because they belong
    # to other things.
    compared_points: int
    rms_m: float | None  # root mean square distance of the compared points [m]; None without any
    reach_m: float  # points farther from the surface are taken to belong to something else [m]
    gate_m: float  # gate stated in the problem [m], at most `reach_m`
    # Share of the compared points that are farther from the surface than `gate_m`; 0 without any.
    share_beyond_gate: float
    # Root mean square distance of the points within `gate_m` [m]; None without any.
    rms_within_gate_m: float | None
    sigmas: float  # root mean square distance over the stated σ; 0 without any
    # Root mean square distance over the stated σ, with distances beyond Huber's threshold shortened
    # as in a fit, so that a few outliers do not make a prediction wrong; 0 without any.
    tame_sigmas: float

    @property
    def text(self) -> str:
        """Distances in words."""
        if self.rms_m is None:
            return "no point near the body"
        sentence = f"{1e3 * self.rms_m:.3g} mm RMS of {self.points} points"
        gate = f"the limit of {1e3 * self.gate_m:.3g} mm (gate_m)"
        if not self.share_beyond_gate:
            return f"{sentence}, all within {gate}"
        beyond = f"{sentence}, {self.share_beyond_gate:.0%} beyond {gate}"
        if self.rms_within_gate_m is None:
            return beyond
        return f"{beyond}, the others {1e3 * self.rms_within_gate_m:.3g} mm RMS"


@dataclass(frozen=True, eq=False)
class SurfaceComparison:
    """Points of a depth camera compared with the surface of a motion.

    A first association takes every point within a quarter of the body's size of the surface. The
    reach is then six times the median distance, at least `gate_m` and at most that quarter; the
    points within it are associated again, without hidden ones, and compared.
    """

    correspondences: SurfaceCorrespondences  # correspondences of the points with the surface
    shapes_m: Array  # (S, n, 3): surface nodes at the images [m]
    # (S, E): distances of points behind the surface [m]; NaN where they are not compared.
    signed_distances_m: Array
    phi: Array  # (k,): nuisance parameters

    @classmethod
    def from_shapes(
        cls, correspondences: SurfaceCorrespondences, shapes_m: Array, phi: Array
    ) -> SurfaceComparison:
        """Associate the points with given shapes and compare them.

        Parameters
        ----------
        correspondences : SurfaceCorrespondences
            Correspondences of the same camera and body, which are not used themselves.
        shapes_m : (S, n, 3) array
            Surface nodes at the images [m].
        phi : (k,) array
            Nuisance parameters.
        """
        view = correspondences.camera
        body = correspondences.body
        widest_m = max(initial_gate_m(body.nodes_m), view.depth.gate_m)
        first = SurfaceCorrespondences.from_shapes(
            view, body, shapes_m=shapes_m, phi=phi, gate_m=widest_m
        )
        reach_m = first.next_gate_m(shapes_m, phi)
        sighting = SurfaceCorrespondences.from_shapes(
            view, body, shapes_m=shapes_m, phi=phi, gate_m=reach_m, settled=True
        )
        return cls(
            sighting,
            shapes_m,
            signed_distances_m=sighting.signed_distances_m(shapes_m, phi),
            phi=phi,
        )

    @cached_property
    def error(self) -> DepthError:
        """Distances summarised as numbers, see `DepthError`."""
        depth = self.correspondences.camera.depth
        distances_m = np.abs(self.signed_distances_m[np.isfinite(self.signed_distances_m)])
        within_m = distances_m[distances_m <= depth.gate_m]
        sigmas = distances_m / depth.sigma_m
        shortened = np.where(sigmas > HUBER, HUBER * sigmas, sigmas**2)
        return DepthError(
            points=len(distances_m),
            compared_points=sum(map(len, depth.clouds)),
            rms_m=root_mean(distances_m**2) if len(distances_m) else None,
            reach_m=max(self.correspondences.gate_m, depth.gate_m),
            gate_m=depth.gate_m,
            share_beyond_gate=1 - len(within_m) / len(distances_m) if len(distances_m) else 0.0,
            rms_within_gate_m=root_mean(within_m**2) if len(within_m) else None,
            sigmas=root_mean(sigmas**2) if len(distances_m) else 0.0,
            tame_sigmas=root_mean(shortened) if len(distances_m) else 0.0,
        )
