"""Distances between the points of a depth camera and the surface of a given motion.

For motions that are simulated forward or predicted; a fit has its own association of points with
the surface, see `sighting`. Which points are compared is defined by `SurfaceComparison`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from ..arrays import Array, root_mean
from .depth import HUBER, DepthReading
from .sighting import Sighting, wide_m

# Fewest samples of a motion between which a cubic spline is drawn; lines between fewer.
FEWEST_FOR_SPLINE = 4


@dataclass(frozen=True)
class DepthError:
    """Distances of the points of one depth camera from the surface, along its normal.

    Compared are the points that lie within `reach_m` of a part of the surface that the camera can
    see (not grazing, not hidden, among the stated faces), see `SurfaceComparison`.

    Attributes
    ----------
    points : int
        How many points are compared.
    seen : int
        How many points there are in the images; those of other things count too.
    rms_m : float or None
        Root mean square distance of these points; None without any.
    reach_m : float
        Farther from the surface, points are taken to belong to something else.
    gate_m : float
        What the problem states as `gate_m`. It is at most `reach_m`.
    share_beyond_gate : float
        Share of the compared points that are farther from the surface than `gate_m`.
    rms_within_gate_m : float or None
        Root mean square distance of the points within `gate_m`; None without any.
    sigmas : float
        Root mean square distance over the stated σ.
    tame_sigmas : float
        The same, where distances beyond Huber's threshold count by the threshold, as in a fit: a
        few wild points do not make a prediction wrong.
    """

    points: int
    seen: int
    rms_m: float | None
    reach_m: float
    gate_m: float
    share_beyond_gate: float
    rms_within_gate_m: float | None
    sigmas: float
    tame_sigmas: float


@dataclass(frozen=True, eq=False)
class SurfaceComparison:
    """The points of a depth camera on the surface of a motion.

    A first association takes every point within a quarter of the body's size of the surface. The
    reach is then six times the median distance, at least `gate_m` and at most that quarter, and the
    points within it, associated again with what is not hidden, are compared.

    Attributes
    ----------
    sighting : Sighting
    shapes_m : (S, n, 3) nodes of the surface at the images
    apart_m : (S, E) how far points are behind the surface, NaN where they do not count
    phi : (k,) nuisance parameters
    """

    sighting: Sighting
    shapes_m: Array
    apart_m: Array
    phi: Array

    @classmethod
    def from_fit(
        cls, reading: DepthReading, x: Array, looked: Array, phi: Array
    ) -> SurfaceComparison:
        """Return the points as they are associated in a fit.

        Parameters
        ----------
        reading : DepthReading
        x : (N, 3n) positions of the fit
        looked : what the reading looks at, see `Part.sights`
        phi : (k,)
        """
        return cls(reading.sighting, reading.shapes(x, phi), reading.apart_m(looked, phi), phi)

    @classmethod
    def from_motion(
        cls, reading: DepthReading, t_s: Array, positions_m: Array, phi: Array
    ) -> SurfaceComparison:
        """Associate the points with a motion.

        Parameters
        ----------
        reading : DepthReading
        t_s : (T,) times of the motion
        positions_m : (T, n, 3) of all nodes
        phi : (k,)
        """
        shapes_m = reading.shapes(_at_rows(reading, t_s, positions_m), phi)
        view, body = reading.sighting.view, reading.sighting.body
        widest_m = max(wide_m(body.nodes_m), view.depth.gate_m)
        first = Sighting.of(view, body, shapes_m, phi, widest_m)
        reach_m = first.next_gate_m(shapes_m, phi)
        sighting = Sighting.of(view, body, shapes_m, phi, reach_m, settled=True)
        return cls(sighting, shapes_m, sighting.apart_m(shapes_m, phi), phi)

    @cached_property
    def error(self) -> DepthError:
        """The distances in numbers."""
        depth = self.sighting.view.depth
        apart_m = np.abs(self.apart_m[np.isfinite(self.apart_m)])
        within_m = apart_m[apart_m <= depth.gate_m]
        sigmas = apart_m / depth.sigma_m
        shortened = np.where(sigmas > HUBER, HUBER * sigmas, sigmas**2)
        return DepthError(
            points=len(apart_m),
            seen=sum(map(len, depth.clouds)),
            rms_m=root_mean(apart_m**2) if len(apart_m) else None,
            reach_m=max(self.sighting.gate_m, depth.gate_m),
            gate_m=depth.gate_m,
            share_beyond_gate=1 - len(within_m) / len(apart_m) if len(apart_m) else 0.0,
            rms_within_gate_m=root_mean(within_m**2) if len(within_m) else None,
            sigmas=root_mean(sigmas**2) if len(apart_m) else 0.0,
            tame_sigmas=root_mean(shortened) if len(apart_m) else 0.0,
        )


def _at_rows(reading: DepthReading, t_s: Array, positions_m: Array) -> Array:
    """Return positions (N, 3n) of a motion at the times that a reading is interpolated from."""
    flat = positions_m.reshape(len(t_s), -1)
    at_s = np.clip(reading.at_s, t_s[0], t_s[-1])
    if len(t_s) >= FEWEST_FOR_SPLINE:
        return np.asarray(CubicSpline(t_s, flat)(at_s))
    return np.array([np.interp(at_s, t_s, each) for each in flat.T]).T
