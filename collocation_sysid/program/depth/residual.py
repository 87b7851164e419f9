"""Points of depth cameras as a measurement: distances from the surface of the body along its
normal.

    r = n · (Σ_i ℓ_i(τ) Σ_a N_a x_{a,i} − T (R(a) ((1 + s) p + b d − c) + c + e)) / σ,

with the measured point p, the stated pose T of the camera, its rotation error R(a) about the pivot
c, its translation error e, scale s and bias b of the depth along the ray d, and the weights ℓ of
the grid times around a sample shifted by τ. The shape functions N_a and the normal n of the
corresponding surface point are those of a `SurfaceCorrespondences`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import scipy
import scipy.sparse as sp
from numpy.typing import NDArray

from ...common.array_types import Array
from ...model.nuisance_map import NuisanceMap
from ...recording.depth_camera import Depth
from ...recording.nuisance import DEPTH_TIME
from ...recording.placement import Placement
from ...recording.sample_times import TIME_TOLERANCE_S
from ..association import SAMPLES_OFF
from ..correspondences import CorrespondenceResidual
from ..markers.association import MarkerAssociation
from ..measurement_residual import (
    GROUP,
    PooledResiduals,
    ResidualExpression,
    RowStencil,
    SampledMotion,
    lagrange_weights,
    neighbouring_times,
)
from ..observables import ObservedMotion, PointPositions
from .outline import Outline
from .surface_comparison import HUBER, SurfaceComparison
from .surface_correspondences import SurfaceCorrespondences

# Grid times around an image that it is interpolated from.
NEIGHBOURS = 4
# Fewest samples of a motion that are interpolated by a cubic spline; fewer are by lines.
FEWEST_FOR_SPLINE = 4
# Largest number of patches that statistics combine the points into.
PATCHES = 60
# Most images that are compared with a surface without correspondences.
ROUGH_IMAGES = 10
# Factor by which patches grow until there are few enough.
GROWING = 1.2


def _surface_positions(correspondences: SurfaceCorrespondences, times: int) -> PointPositions:
    """Return the surface nodes as an observable, stored with the camera's model."""
    stored = correspondences.camera.surface_observables
    if times not in stored:
        body = correspondences.body
        nodes = correspondences.surface.nodes
        count = len(nodes)
        placement = Placement(
            nodes[:, None],
            np.ones((count, 1)),
            distance_m=np.zeros(count),
            node_count=len(body.nodes_m),
        )
        stored[times] = PointPositions(
            np.arange(times),
            MarkerAssociation.from_exact_places(body, placement, points_m=body.nodes_m[nodes]),
            coordinate_parameters=np.full((count, 3), -1),
        )
    return stored[times]


@dataclass(frozen=True, eq=False)
class DepthResidual(CorrespondenceResidual):
    """Measurement model of the points of a depth camera, with one number each: the distance from
    the surface, whose measured value is zero.
    """

    observable: PointPositions  # surface nodes at all grid times
    correspondences: SurfaceCorrespondences  # correspondences of the points with the surface
    observable_s: Array  # (n,): times of the observable [s]

    group_size = 1
    sigma_key = "sigma_m of depth"
    is_compiled = True

    @classmethod
    def from_correspondences(
        cls,
        correspondences: SurfaceCorrespondences,
        at_s: Array,
        nuisance: NuisanceMap,
        huber: float | None,
    ) -> DepthResidual:
        """Build the measurement model of a camera.

        Parameters
        ----------
        correspondences : SurfaceCorrespondences
            Correspondences of the points with the surface.
        at_s : (n,) array
            Times at which positions are known [s].
        huber : float or None
            Threshold of Huber's loss; None means 3 standard deviations, because outliers are
            normal.
        """
        view = correspondences.camera
        correspondences = correspondences.within(at_s)
        samples, points = correspondences.is_compared.shape
        return cls(
            observable=_surface_positions(correspondences, len(at_s)),
            nuisance=nuisance,
            huber=HUBER if huber is None else huber,
            names=(view.depth.name,) * points,
            t_s=view.depth.sample_times_s,
            sigmas=np.full(points, view.depth.sigma_m),
            measured=np.zeros((samples, points, 1)),
            is_compared=correspondences.is_compared[..., None],
            own_parameters=np.tile(view.parameter_indices, (points, 1)),
            correspondences=correspondences,
            observable_s=at_s,
        )

    @property
    def measurement(self) -> Depth:
        return self.correspondences.camera.depth

    @property
    def _expressions(self) -> dict[tuple[int, int], ResidualExpression]:
        return self.correspondences.camera.depth_expressions

    @property
    def correspondences_in_use(self) -> SurfaceCorrespondences | Outline:
        """Corresponding points of surface and image that this model compares; those of the outline
        in a subclass.
        """
        return self.correspondences

    @cached_property
    def _neighbour_times(self) -> NDArray[np.int64]:
        """Indices (S, k) of the observable's times around each image; k = 1 if at its time."""
        return self._times_around(self.correspondences.taken_s, self.observable_s)

    def _times_around(self, taken_s: Array, at_s: Array) -> NDArray[np.int64]:
        nearest = np.abs(at_s - taken_s[:, None]).argmin(axis=1)
        is_off_grid = np.abs(at_s[nearest] - taken_s).max(initial=0.0) > TIME_TOLERANCE_S
        clock = self.nuisance.indices_of_rows(
            DEPTH_TIME, component=self.correspondences.camera.camera_index
        )
        if not (is_off_grid or len(clock)) or len(at_s) < 2:
            return nearest[:, None]
        used = min(NEIGHBOURS, len(at_s))
        return neighbouring_times(at_s, taken_s + TIME_TOLERANCE_S, count=used)

    @cached_property
    def _stencil(self) -> RowStencil:
        """Stencil of all images: indices of the surface nodes, and the data of the expression.

        The data are, in this order: distances of the neighbouring times from the image [s], shape
        functions, normal in the world and in the camera's frame, translation of the camera along
        the normal [m], measured point [m] and ray in the camera's frame.
        """
        pairs = self.correspondences_in_use
        times = self._neighbour_times
        samples, points = pairs.is_compared.shape
        rotations, translations = self.correspondences.camera.poses
        in_camera = np.einsum("sji,sej->sei", rotations, pairs.normals)
        normal_motion = np.einsum("sei,si->se", pairs.normals, translations)[..., None]
        offsets_s = np.broadcast_to(
            (self.observable_s[times] - self.t_s[:, None])[:, None],
            (samples, points, times.shape[1]),
        )
        parts = [
            offsets_s,
            pairs.weights,
            pairs.normals,
            in_camera,
            normal_motion,
            pairs.points,
            pairs.rays,
        ]
        places = times[:, None, :, None] * self.observable.vector_count + pairs.nodes[:, :, None]
        return RowStencil(
            places.reshape(samples, points, -1), np.moveaxis(np.concatenate(parts, axis=2), 2, 0)
        )

    def stencil(self, phi: Array, known: int) -> RowStencil:
        samples = int(np.count_nonzero(self._neighbour_times[:, -1] < known))
        return RowStencil(self._stencil.indices[:samples], self._stencil.data[:, :samples])

    @property
    def first_row(self) -> int:
        return int(self._neighbour_times[0, -1])

    def reassociated(self, x: Array, phi: Array) -> SurfaceCorrespondences:
        largest_s = SAMPLES_OFF * np.diff(self.observable_s).max(initial=0.0)
        return self.correspondences.updated(self.surface_shapes(x, phi), phi, largest_s)

    def correspondences_of(self, measured: Depth, x: Array, phi: Array) -> SurfaceCorrespondences:
        return self.correspondences.with_depth(measured, self.surface_shapes(x, phi), phi=phi)

    def aligned_correspondences(
        self, x: Array, phi: Array, only_pose: bool = False
    ) -> SurfaceCorrespondences:
        correspondences = self.correspondences
        shapes = self.surface_shapes(x, phi)
        if not len(shapes):
            shapes = x[-1:].reshape(1, -1, 3)[:, correspondences.surface.nodes]
        all_shapes = np.concatenate([shapes, correspondences.shapes_m[len(shapes) :]])
        if correspondences.is_aligned_with(all_shapes, phi):
            return correspondences
        if only_pose:
            return correspondences.with_aligned_pose(all_shapes, phi)
        return SurfaceCorrespondences.from_alignment(
            correspondences.camera, correspondences.body, shapes_m=all_shapes, phi=phi
        )

    def expression(self, values_in: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """Return the distance (1,) of a point behind the surface [m], positive inside the body."""
        view = self.correspondences.camera
        nodes = self.correspondences_in_use.nodes.shape[2]
        sizes = np.cumsum([0, self._neighbour_times.shape[1], nodes, 3, 3, 1, 3, 3]).tolist()
        offsets, weights, normal, in_camera, normal_motion, point, ray = ca.vertsplit(data, sizes)
        values = self.nuisance.values_by_row(phi, self.own_parameters[0])
        clock_shift = values.get(DEPTH_TIME, ca.SX(0))
        times = ca.vertsplit(offsets)
        in_time = ca.vertcat(*lagrange_weights(clock_shift, times))
        surface = values_in @ ca.kron(in_time, weights)
        corrected = view.corrected_expression(point, ray, values=values)
        return ca.dot(normal, surface) - ca.dot(in_camera, corrected) - normal_motion

    def rough_residuals(self, x: Array, phi: Array) -> Array:
        """Return distances of the surface to the first images, at most `ROUGH_IMAGES` of them evenly,
        in standard deviations; NaN for parts that the camera does not see.
        """
        pairs = self.correspondences
        seen_from = pairs.with_start_values(phi)
        shapes, seen = self.surface_shapes(x, phi), self.surface_shapes(x, seen_from)
        useful = np.flatnonzero(pairs.measured.presence["points"][: len(shapes)])
        images = np.linspace(0, len(useful) - 1, min(len(useful), ROUGH_IMAGES)).astype(int)
        away_m = [
            np.where(
                pairs.is_facing(seen[k], seen_from, k),
                pairs.distance_to_cloud_m(shapes[k], phi, k),
                np.nan,
            )
            for k in useful[images].tolist()
        ]
        return np.concatenate([*away_m, np.zeros(0)]) / pairs.camera.depth.sigma_m

    @property
    def excluded_loss(self) -> float:
        """Loss of the points beyond the gate of the present correspondences, each counted as if its
        distance were the stated gate.
        """
        depth = self.correspondences.camera.depth
        deviations = depth.gate_m / depth.sigma_m
        if self.huber is not None and deviations > self.huber:
            return self.correspondences.excluded_counts["far"] * (
                2 * self.huber * deviations - self.huber**2
            )
        return self.correspondences.excluded_counts["far"] * deviations**2

    # In statistics ----------------------------------------------------------------------------

    @cached_property
    def _patch_indices(self) -> NDArray[np.int64]:
        """Index of the patch (S, E) of each compared point, −1 for others; at most `PATCHES`."""
        # Residuals of neighbouring points are correlated; their means over patches nearly are not.
        pairs = self.correspondences_in_use
        patches = np.full(self.correspondences_in_use.is_compared.shape, -1)
        places = pairs.places_m[pairs.is_compared]
        edge_m = 2 * self.correspondences.camera.depth.spacing_m
        while True:
            cubes, number = np.unique(np.floor(places / edge_m), axis=0, return_inverse=True)
            if len(cubes) <= PATCHES:
                break
            edge_m *= GROWING
        patches[pairs.is_compared] = number.ravel()
        return patches

    @cached_property
    def _pooling(self) -> tuple[sp.csr_array, NDArray[np.int64]]:
        """Matrix (S · 3M, S · E) from points to patches, entries 1/√count, and counts (S, 3M)."""
        # The number of patches is rounded up to a multiple of three.
        samples, points = self._patch_indices.shape
        patches = GROUP * -(-(int(self._patch_indices.max(initial=0)) + 1) // GROUP)
        sample, point = np.nonzero(self._patch_indices >= 0)
        row = sample * patches + self._patch_indices[sample, point]
        counts = np.bincount(row, minlength=samples * patches)
        share = 1 / np.sqrt(counts[row])
        shape = samples * patches, samples * points
        return sp.csr_array((share, (row, sample * points + point)), shape=shape), counts.reshape(
            samples, patches
        )

    @cached_property
    def pooled_groups(self) -> PooledResiduals:
        """Patches of the surface, in groups of three, with σ of a single point; a patch is compared
        in images in which it has points, and its place is the mean of its points in all images.
        """
        means, counts = self._pooling
        name = self.names[0]
        count = counts.shape[1] // GROUP
        of_points = self.correspondences_in_use.places_m.reshape(-1, 3)
        sums = (means @ of_points).reshape(*counts.shape, 3) * np.sqrt(counts)[..., None]
        places = sums.sum(axis=0) / np.maximum(counts.sum(axis=0), 1)[:, None]
        return PooledResiduals(
            tuple(f"{name} {k + 1}" for k in range(count)),
            np.full(count, self.sigmas[0]),
            is_compared=(counts > 0).reshape(len(counts), count, GROUP),
            places_m=places,
        )

    def pool_values(self, values: Array) -> Array:
        """Return sums over patches (S, M, 3, …) of residuals (S, E, 1, …), divided by
        √count so that white noise keeps its variance.
        """
        means, counts = self._pooling
        columns = int(np.prod(values.shape[3:]))  # zero where nothing is estimated
        value_rows = means @ values.reshape(
            values.shape[0] * values.shape[1] * values.shape[2], columns
        )
        return value_rows.reshape(len(counts), counts.shape[1] // GROUP, GROUP, *values.shape[3:])

    # Of motions -------------------------------------------------------------------------------

    def fitted(self, motion: ObservedMotion, phi: Array) -> SurfaceComparison:
        return SurfaceComparison(
            self.correspondences,
            self.surface_shapes(motion.x, phi),
            signed_distances_m=self.signed_distances_m(self.observable.evaluate(motion, phi), phi),
            phi=phi,
        )

    def simulated(self, motion: SampledMotion, phi: Array) -> SurfaceComparison:
        """Associate the points with a motion and compare them; images after its end are compared
        with its last positions.
        """
        shapes_m = self.surface_shapes(self._interpolated(motion), phi)
        return SurfaceComparison.from_shapes(self.correspondences, shapes_m, phi)

    def _interpolated(self, motion: SampledMotion) -> Array:
        """Return positions (n, 3n') by a spline, by lines below `FEWEST_FOR_SPLINE` times."""
        t_s, x = motion.t_s, motion.observed.x
        at_s = np.clip(self.observable_s, t_s[0], t_s[-1])
        if len(t_s) >= FEWEST_FOR_SPLINE:
            return np.asarray(scipy.interpolate.CubicSpline(t_s, x)(at_s))
        return np.array([np.interp(at_s, t_s, each) for each in x.T]).T

    def changes(
        self,
        values: Array,
        fitted: SampledMotion,
        simulated: SampledMotion,
        phi: Array,
        share: float,
    ) -> Array:
        """Return the changes of the residuals, see `MeasurementResidual.changes`; of first order,
        at the correspondences of the fit.
        """
        change_m = share * (simulated.observed.x - fitted.observed.x)
        way_m = [np.interp(self.observable_s, fitted.t_s, each) for each in change_m.T]
        displacements_m = np.transpose(way_m).reshape(len(self.observable_s), -1, 3, 1)
        nodes = self.correspondences.surface.nodes
        return self.residual_changes(values, displacements_m[:, nodes], phi=phi)[..., 0]

    # In pictures ------------------------------------------------------------------------------

    def signed_distances_m(self, values: Array, phi: Array) -> Array:
        """Return how far points (s, E) of the first s images are behind the surface [m]; NaN where
        they are not compared.

        Parameters
        ----------
        values : (n, e, 3) array
            Positions of the surface nodes at the first n times of the observable [m].
        phi : (k,) array
            Nuisance parameters.
        """
        distances = self.predict(values, phi)[..., 0]
        return np.where(
            self.correspondences_in_use.is_compared[: len(distances)], distances, np.nan
        )

    def surface_shapes(self, x: Array, phi: Array) -> Array:
        """Return the surface nodes (s, n, 3) [m] at the times of those first s images for which the
        first rows x (rows, 3n) [m] suffice, with the clock shift of φ (k,); s may be 0. Images
        before and after these rows have their first and last shape.
        """
        known = int((self._neighbour_times[:, -1] < len(x)).sum())
        at_s = self.observable_s[: len(x)]
        late_s = self.correspondences.camera.clock_shift_s(phi)
        taken_s = np.clip(self.t_s[:known] + late_s, at_s[0], at_s[-1])
        around = self._times_around(taken_s, at_s)
        nodes = x.reshape(len(x), -1, 3)[:, self.correspondences.surface.nodes]
        return np.array(
            [
                np.tensordot(lagrange_weights(t, at_s[times].tolist()), nodes[times], 1)
                for t, times in zip(taken_s, around, strict=True)
            ]
        ).reshape(known, *nodes.shape[1:])
