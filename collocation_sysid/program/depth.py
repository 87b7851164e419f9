"""What depth cameras read: how far the points that they see are from the surface, along its normal.

    r = n · (Σ_i ℓ_i(τ) Σ_a N_a x_{a,i} − T (R(a) ((1 + s) p + b d − c) + c + e)) / σ,

T being the pose of the camera as stated, a and e what it is turned and shifted by, s and b scale
and bias of its depth along the ray d, and ℓ the weights of the times around a sample. Which point
of the surface has N_a and n says a `Sighting`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..arrays import Array
from ..model.nuisance import NuisanceMap
from ..recording.clock import TIME_TOLERANCE_S
from ..recording.nuisance import DEPTH_TIME
from ..recording.placement import Placement
from .channel import Points
from .charts import Chart
from .reading import GROUP, Instrument, Pooled, Reading, Window, lagrange_weights, times_around
from .sighting import Sighting

# Times around a sample.
NEIGHBOURS = 4
# Threshold of Huber's loss where none is given: what is seen beside the body is wild.
HUBER = 3.0
# Patches of the surface that statistics take the points of together, at most, and by how much these
# grow until they are as few.
PATCHES, GROWING = 60, 1.2


@dataclass(frozen=True, eq=False)
class DepthReading(Reading):
    """The points that a depth camera sees, one number each.

    Attributes
    ----------
    channel : Points
        The nodes of the surface in all rows.
    sighting : Sighting
    at_s : (n,) the times of the channel
    """

    channel: Points
    sighting: Sighting
    at_s: Array

    group, has_offsets, stated = 1, True, "sigma_m of depth"

    @classmethod
    def of(
        cls, sighting: Sighting, at_s: Array, nuisance: NuisanceMap, huber: float | None
    ) -> DepthReading:
        """That of a sighting, where positions are known at some times."""
        view, nodes = sighting.view, sighting.skin.nodes
        points_m = sighting.body.nodes_m[nodes]
        count, none = len(nodes), np.zeros(len(nodes))
        placement = Placement(nodes[:, None], np.ones((count, 1)), none, len(sighting.body.nodes_m))
        chart = Chart.exact(sighting.body, placement, points_m)
        samples, points = sighting.used.shape
        return cls(
            channel=Points(np.arange(len(at_s)), chart, np.full((count, 3), -1)),
            nuisance=nuisance,
            huber=HUBER if huber is None else huber,
            names=(view.depth.name,) * points,
            t_s=view.depth.times,
            sigmas=np.full(points, view.depth.sigma_m),
            measured=np.zeros((samples, points, 1)),
            components=sighting.used[..., None],
            own=np.tile(view.own, (points, 1)),
            sighting=sighting,
            at_s=at_s,
        )

    @property
    def _instruments(self) -> dict[tuple[int, int], Instrument]:
        return self.sighting.view.instruments

    @cached_property
    def _times(self) -> NDArray[np.int64]:
        """(S, k) times of the channel that each sample is read from: at it, or around."""
        nearest = np.abs(self.at_s - self.t_s[:, None]).argmin(axis=1)
        off = np.abs(self.at_s[nearest] - self.t_s).max(initial=0.0) > TIME_TOLERANCE_S
        clock = self.nuisance.places(DEPTH_TIME, of=self.sighting.view.number)
        if not (off or len(clock)) or len(self.at_s) < 2:
            return nearest[:, None]
        used = min(NEIGHBOURS, len(self.at_s))
        return times_around(self.at_s, self.t_s + TIME_TOLERANCE_S, used)

    @cached_property
    def _window(self) -> Window:
        seen, times = self.sighting, self._times
        samples, points = seen.used.shape
        rotations, translations = seen.view.motion
        in_camera = np.einsum("sji,sej->sei", rotations, seen.normals)
        beyond = np.einsum("sei,si->se", seen.normals, translations)[..., None]
        around = np.broadcast_to(
            (self.at_s[times] - self.t_s[:, None])[:, None], (samples, points, times.shape[1])
        )
        parts = [around, seen.weights, seen.normals, in_camera, beyond, seen.points, seen.rays]
        places = times[:, None, :, None] * self.channel.each + seen.nodes[:, :, None]
        return Window(
            places.reshape(samples, points, -1), np.moveaxis(np.concatenate(parts, axis=2), 2, 0)
        )

    def window(self, phi: Array, known: int) -> Window:
        """Of the samples whose times are all known."""
        samples = int(np.count_nonzero(self._times[:, -1] < known))
        return Window(self._window.places[:samples], self._window.data[:, :samples])

    @property
    def first_row(self) -> int:
        """The last time of the channel that its first sample is read from."""
        return int(self._times[0, -1])

    def aligned(self, x: Array, phi: Array) -> Sighting:
        """What is seen with the pose aligned to the first rows x (rows, 3n), to the last of these
        where they do not suffice.
        """
        seen, shapes = self.sighting, self.shapes(x, phi)
        if not len(shapes):
            shapes = x[-1:].reshape(1, -1, 3)[:, seen.skin.nodes]
        later = np.concatenate([shapes, seen.shapes_m[len(shapes) :]])
        return Sighting.aligned(seen.view, seen.body, later, phi)

    @property
    def begins_s(self) -> float:
        """The last time that the first sample is read from."""
        first = int(self.components.any(axis=(1, 2)).argmax())
        return float(self.at_s[self._times[first, -1]])

    def expression(self, looked: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """How far a point is behind the surface."""
        view, nodes = self.sighting.view, self.sighting.nodes.shape[2]
        sizes = np.cumsum([0, self._times.shape[1], nodes, 3, 3, 1, 3, 3]).tolist()
        around, weights, normal, in_camera, beyond, point, ray = ca.vertsplit(data, sizes)
        values = self.nuisance.by_row(phi, self.own[0])
        late, times = values.get(DEPTH_TIME, ca.SX(0)), ca.vertsplit(around)
        in_time = ca.vertcat(*lagrange_weights(late, times))
        surface = looked @ ca.kron(in_time, weights)
        seen = view.corrected(point, ray, values)
        return ca.dot(normal, surface) - ca.dot(in_camera, seen) - beyond

    def roughly(self, x: Array, phi: Array) -> Array:
        """How far what the first image should see is from what it sees, in deviations."""
        shapes = self.shapes(x, phi)
        return self.sighting.missed_m(shapes[0], phi) / self.sighting.view.depth.sigma_m

    # In statistics ----------------------------------------------------------------------------

    @cached_property
    def _patches(self) -> NDArray[np.int64]:
        """(S, E) the patch of each point that counts, −1 of others.

        Neighbouring points are not independent; means over patches nearly are.
        """
        seen, patches = self.sighting, np.full(self.sighting.used.shape, -1)
        places, edge_m = seen.places_m[seen.used], 2 * seen.view.depth.spacing_m
        while True:
            cubes, number = np.unique(np.floor(places / edge_m), axis=0, return_inverse=True)
            if len(cubes) <= PATCHES:
                break
            edge_m *= GROWING
        patches[seen.used] = number.ravel()
        return patches

    @cached_property
    def _pooling(self) -> tuple[sp.csr_array, NDArray[np.int64]]:
        """What patches have of the points, root of a share each, and (S, 3M) how many of these."""
        samples, points = self._patches.shape
        patches = GROUP * -(-(int(self._patches.max(initial=0)) + 1) // GROUP)
        sample, point = np.nonzero(self._patches >= 0)
        row = sample * patches + self._patches[sample, point]
        counts = np.bincount(row, minlength=samples * patches)
        share = 1 / np.sqrt(counts[row])
        shape = samples * patches, samples * points
        return sp.csr_array((share, (row, sample * points + point)), shape=shape), counts.reshape(
            samples, patches
        )

    @cached_property
    def pool(self) -> Pooled:
        """Patches, three together."""
        means, counts = self._pooling
        name, seen = self.sighting.view.depth.name, self.sighting
        count = counts.shape[1] // GROUP
        of_points = seen.places_m.reshape(-1, 3)
        sums = (means @ of_points).reshape(*counts.shape, 3) * np.sqrt(counts)[..., None]
        places = sums.sum(axis=0) / np.maximum(counts.sum(axis=0), 1)[:, None]
        return Pooled(
            tuple(f"{name} {k + 1}" for k in range(count)),
            np.full(count, seen.view.depth.sigma_m),
            (counts > 0).reshape(len(counts), count, GROUP),
            places,
        )

    def pooled(self, values: Array) -> Array:
        """(S, M, 3, …): sums over patches whose variance is that of a point."""
        means, counts = self._pooling
        columns = int(np.prod(values.shape[3:]))  # zero where nothing is estimated
        flat = means @ values.reshape(values.shape[0] * values.shape[1] * values.shape[2], columns)
        return flat.reshape(len(counts), counts.shape[1] // GROUP, GROUP, *values.shape[3:])

    # In pictures ------------------------------------------------------------------------------

    def apart_m(self, values: Array, phi: Array) -> Array:
        """(s, E) how far points are behind the surface, NaN where they do not count."""
        apart = self.predicted(values, phi)[..., 0]
        return np.where(self.sighting.used[: len(apart)], apart, np.nan)

    def shapes(self, x: Array, phi: Array) -> Array:
        """(s, n, 3) of the surface at the samples that the first rows x (rows, 3n) suffice for."""
        late, known = self.sighting.view.late_s(phi), int((self._times[:, -1] < len(x)).sum())
        nodes = x.reshape(len(x), -1, 3)[:, self.sighting.skin.nodes]
        return np.array(
            [
                np.tensordot(lagrange_weights(t + late, self.at_s[times].tolist()), nodes[times], 1)
                for t, times in zip(self.t_s[:known], self._times[:known], strict=True)
            ]
        ).reshape(known, *nodes.shape[1:])
