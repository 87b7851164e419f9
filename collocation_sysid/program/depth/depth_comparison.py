"""Distances between the points of a depth camera and the surface of a given motion.

`SurfaceComparison` is for motions that are simulated forward or predicted, and defines which points
are compared. A fit has its own association of points with the surface, see
`surface_correspondences`; `depth_residuals` and `outline_distances_px` are its residuals.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from ...common.array_types import Array, root_mean
from ..experiment_iterate import ExperimentIterate
from ..simulation import Trajectory
from ..transcription import Transcription
from .depth_residual import HUBER, DepthResidual
from .outline_residual import OutlineResidual
from .surface_correspondences import SurfaceCorrespondences, initial_gate_m

# Fewest samples of a motion that are interpolated by a cubic spline; fewer are by lines.
FEWEST_FOR_SPLINE = 4


@dataclass(frozen=True)
class DepthError:
    """Distances of the points of one depth camera from the surface, along its normal.

    Compared are the points that lie within `reach_m` of a part of the surface that the camera can
    see (not grazing, not hidden, among the stated faces), see `SurfaceComparison`.

    Attributes
    ----------
    points : int
        Number of points that are compared.
    compared_points : int
        Number of all points in the images, including those that are not compared because they
        belong to other things.
    rms_m : float or None
        Root mean square distance of the compared points [m]; None without any.
    reach_m : float
        Points farther from the surface are taken to belong to something else [m].
    gate_m : float
        Gate stated in the problem [m], at most `reach_m`.
    share_beyond_gate : float
        Share of the compared points that are farther from the surface than `gate_m`; 0 without any.
    rms_within_gate_m : float or None
        Root mean square distance of the points within `gate_m` [m]; None without any.
    sigmas : float
        Root mean square distance over the stated σ; 0 without any.
    tame_sigmas : float
        Root mean square distance over the stated σ, with distances beyond Huber's threshold
        shortened as in a fit, so that a few outliers do not make a prediction wrong; 0 without any.
    """

    points: int
    compared_points: int
    rms_m: float | None
    reach_m: float
    gate_m: float
    share_beyond_gate: float
    rms_within_gate_m: float | None
    sigmas: float
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

    Attributes
    ----------
    correspondences : SurfaceCorrespondences
        Correspondences of the points with the surface.
    shapes_m : (S, n, 3) array
        Surface nodes at the images [m].
    signed_distances_m : (S, E) array
        Distances of points behind the surface [m]; NaN where they are not compared.
    phi : (k,) array
        Nuisance parameters.
    """

    correspondences: SurfaceCorrespondences
    shapes_m: Array
    signed_distances_m: Array
    phi: Array

    @classmethod
    def from_fit(
        cls, residual: DepthResidual, x: Array, values: Array, phi: Array
    ) -> SurfaceComparison:
        """Return the comparison with the correspondences of a fit, which are not renewed.

        Parameters
        ----------
        residual : DepthResidual
            Measurement model of the camera.
        x : (N, 3n) array
            Positions of the fit [m].
        values : (n, e, 3) array
            Values of the observable, see `depth_residuals`.
        phi : (k,) array
            Nuisance parameters.
        """
        return cls(
            residual.correspondences,
            residual.surface_shapes(x, phi),
            signed_distances_m=residual.signed_distances_m(values, phi),
            phi=phi,
        )

    @classmethod
    def from_motion(
        cls, residual: DepthResidual, trajectory: Trajectory, phi: Array
    ) -> SurfaceComparison:
        """Associate the points with a motion and compare them; images after its end are compared
        with its last positions.

        Parameters
        ----------
        residual : DepthResidual
            Measurement model of the camera; its correspondences are not used.
        trajectory : Trajectory
            Simulated motion.
        phi : (k,) array
            Nuisance parameters.
        """
        shapes_m = residual.surface_shapes(_positions_at_observable(residual, trajectory), phi)
        view = residual.correspondences.camera
        body = residual.correspondences.body
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


def _positions_at_observable(residual: DepthResidual, trajectory: Trajectory) -> Array:
    """Return positions (R, 3n) at the times of a measurement's observable, interpolated from those
    of a motion by a cubic spline, or by lines between fewer than `FEWEST_FOR_SPLINE`; outside its
    times the end positions.
    """
    t_s = trajectory.t_s
    position_rows = trajectory.observed.x
    at_s = np.clip(residual.observable_s, t_s[0], t_s[-1])
    if len(t_s) >= FEWEST_FOR_SPLINE:
        return np.asarray(CubicSpline(t_s, position_rows)(at_s))
    return np.array([np.interp(at_s, t_s, each) for each in position_rows.T]).T


def camera_residuals(transcription: Transcription) -> list[DepthResidual]:
    """Return the measurement models of the points of the depth cameras, in their order, without
    those of outlines.
    """
    return [each for each in transcription.reassociable if isinstance(each, DepthResidual)]


def depth_residuals(iterate: ExperimentIterate) -> list[tuple[DepthResidual, Array]]:
    """Return the measurement models of the depth cameras, each with the values (n, e, 3) of its
    observable: positions of the surface nodes [m].
    """
    return [
        (residual, values)
        for residual, values in surface_residuals(iterate)
        if not isinstance(residual, OutlineResidual)
    ]


def surface_residuals(iterate: ExperimentIterate) -> list[tuple[DepthResidual, Array]]:
    """Return the measurement models of the depth cameras, then of the outlines, each with the
    values (n, e, 3) of its observable.
    """
    pairs = zip(iterate.transcription.residuals, iterate.observables, strict=True)
    return [(residual, values) for residual, values in pairs if isinstance(residual, DepthResidual)]


def outline_distances_px(iterate: ExperimentIterate) -> list[tuple[OutlineResidual, Array]]:
    """Return the measurement models of the outlines, each with the signed distances (n,) of outline
    points from their edges [pixels]; points without an edge are left out.
    """
    distances = []
    for residual, values in surface_residuals(iterate):
        if isinstance(residual, OutlineResidual):
            distances_px = residual.signed_distances_px(values, iterate.phi)
            distances.append((residual, distances_px[np.isfinite(distances_px)]))
    return distances
