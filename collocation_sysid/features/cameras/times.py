"""Misspecification of the times of depth images: late clocks, reversed order, images of one moment.

The measured points are compared with a simulated or fitted motion of the body's surface, as stated
and with each common mistake corrected. The camera is aligned with all images together, within the
prior of its pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...common.array_types import Array
from ...judge.doubt import Doubt, accepted
from ...program.collocation import ExperimentIterate
from ...program.depth.camera_alignment import thinned
from ...program.depth.comparison import camera_residuals
from ...program.depth.residual import DepthResidual
from ...recording.nuisance import DEPTH_SHIFT, DEPTH_TURN
from ...statistics.hypothesis import Hypothesis
from ...statistics.thresholds import LEAST_IMPROVEMENT

# Fewest images whose order can be tested.
FEWEST_IMAGES = 3
# Most images that are compared, evenly spread.
MOST_IMAGES = 12
# Points of the surface that are compared in each image.
SAMPLES = 150
# Cosine between normal and view below which a point is not compared.
GRAZING = 0.3
# Largest distance of corresponding points, over the diagonal of the body.
GATE = 0.1
# Distance over the diagonal that a wrong stiffness explains.
ROUGHLY = 0.02
# Alignments of the camera with the images, one after the other.
ALIGNMENTS = 3
# Clock lags that are tried [s].
LAGS_S = np.concatenate([-np.arange(20, 0, -1), np.arange(1, 21)]) * 0.01
# Longest lag over the time between the first and the last image.
LONGEST_LAG = 0.5
# Motion of the surface over the diagonal from which on images must differ.
MOVING = 0.05


@dataclass(frozen=True, eq=False)
class ImageTimes:
    """Assignment of images to times of the motion."""

    images: NDArray[np.int64]  # (k,) of int: indices of images
    times_s: Array  # (k,): times at which they were taken [s]


def camera_clock_hypotheses(part: ExperimentIterate) -> Iterator[Hypothesis]:
    """Yield hypotheses about the times of each depth camera's images, for an experiment at a
    simulated or fitted motion; none for cameras with few images.
    """
    name = part.transcription.experiment.name
    for residual in camera_residuals(part.transcription):
        times_s = residual.correspondences.camera.depth.sample_times_s
        within = times_s <= residual.observable_s[-1] + 1e-9
        if np.count_nonzero(within) < FEWEST_IMAGES:
            continue
        positions_m = part.x.reshape(len(part.x), -1, 3)
        comparison = _MotionComparison(residual, positions_m, is_simulated=within)
        yield from comparison.hypotheses(name)


class _MotionComparison:
    """Comparison of the images of one camera with a motion (T, n, 3) [m] of the surface."""

    def __init__(
        self, residual: DepthResidual, positions_m: Array, is_simulated: NDArray[np.bool_]
    ) -> None:
        self.camera = residual.correspondences.camera
        surface = residual.correspondences.surface
        depth = self.camera.depth
        self.at_s = residual.observable_s
        images = np.array(
            [k for k in np.flatnonzero(is_simulated).tolist() if len(depth.clouds[k])]
        )
        spread = np.linspace(0, len(images) - 1, min(len(images), MOST_IMAGES)).astype(int)
        images = images[np.unique(spread)]
        self.stated = ImageTimes(images, depth.sample_times_s[images])
        self.trees = {k: KDTree(thinned(depth.points_m[k])) for k in images}
        rng = np.random.default_rng(0)
        selected = np.flatnonzero(surface.is_selected)
        faces = rng.choice(selected, SAMPLES)
        barycentric = rng.dirichlet(np.ones(3), SAMPLES)
        evaluated = [
            surface.evaluate(x[surface.nodes], faces, barycentric=barycentric) for x in positions_m
        ]
        self.places_m = np.array([each[1] for each in evaluated])
        self.normals = np.array([each[2] for each in evaluated])
        self.gate_m = GATE * self.camera.size_m
        self.rough_m = max(depth.sigma_m, ROUGHLY * self.camera.size_m)

    def hypotheses(self, experiment: str) -> Iterator[Hypothesis]:
        """Yield the mistakes whose correction fits far better."""
        if self.misfit_m(self.stated) <= self.rough_m:
            return
        rows = self._mistakes(f"'{self.camera.depth.name}' of '{experiment}'")
        least_m = self.rough_m / LEAST_IMPROVEMENT
        yield from accepted(rows, self.stated, self.misfit_m, LEAST_IMPROVEMENT, least_m)

    def _mistakes(self, subject: str) -> Iterator[Doubt]:
        stated = self.stated
        reversed_order = ImageTimes(stated.images[::-1], stated.times_s)
        yield Doubt.whole("camera-order", reversed_order, subject)
        moved_m = np.linalg.norm(self.places_m - self.places_m[0], axis=2)
        if moved_m.max() > MOVING * self.camera.size_m:
            same = np.full(len(stated.images), stated.times_s[0])
            without = ImageTimes(stated.images, same)
            yield Doubt.whole("camera-constant", without, subject, by_mm=1e3 * moved_m.max())
        span_s = float(np.ptp(stated.times_s))
        for lag_s in LAGS_S[np.abs(LAGS_S) <= LONGEST_LAG * span_s]:
            times_s = stated.times_s - lag_s
            covered = times_s <= self.at_s[-1] + 1e-9
            if np.count_nonzero(covered) < FEWEST_IMAGES:
                continue
            yield Doubt.whole(
                "camera-clock",
                ImageTimes(stated.images[covered], times_s[covered]),
                subject,
                by_ms=1e3 * abs(lag_s),
                when="late" if lag_s > 0 else "early",
                do="subtract this from" if lag_s > 0 else "add this to",
            )

    def misfit_m(self, described: ImageTimes) -> float:
        """Return the root mean square distance of the visible surface from the measured points
        along its normal [m], at most the gate for each point, after an alignment of the camera.

        Before its first time the body rests at its first position.
        """
        shapes = self._shapes_in_camera(described)
        estimate = np.zeros(6)
        misfit_m = np.inf
        for _ in range(ALIGNMENTS):
            estimate, misfit_m = self._align(described.images, shapes, estimate)
        return misfit_m

    def _shapes_in_camera(self, described: ImageTimes) -> list[tuple[Array, Array]]:
        """Return visible points [m] and normals (P, 3) of each image."""
        rows = np.interp(described.times_s, self.at_s, np.arange(len(self.at_s)))
        rotations, translations_m = self.camera.poses
        shapes = []
        for image, row in zip(described.images, rows, strict=True):
            before = min(int(row), len(self.at_s) - 1)
            after = min(before + 1, len(self.at_s) - 1)
            share = row - before
            places_m = (1 - share) * self.places_m[before] + (share * self.places_m[after])
            normals = self.normals[before if share < 0.5 else after]
            in_camera_m = (places_m - translations_m[image]) @ rotations[image]
            turned = normals @ rotations[image]
            is_facing = np.ones(len(turned), dtype=bool)
            if self.camera.depth.camera.matrix is not None:
                lengths_m = np.linalg.norm(in_camera_m, axis=1)
                is_facing = -np.sum(turned * in_camera_m, axis=1) > GRAZING * lengths_m
            shapes.append((in_camera_m[is_facing], turned[is_facing]))
        return shapes

    def _align(
        self,
        images: Sequence[int] | NDArray[np.int64],
        shapes: list[tuple[Array, Array]],
        estimate: Array,
    ) -> tuple[Array, float]:
        """Return rotation vector [rad] and shift [m] of the points (6,) about the camera's pivot
        after one more Gauss–Newton step, and the RMS distance along the normals [m] before it.
        """
        turn_rad, shift_m = np.split(estimate, 2)
        pivot_m = self.camera.pivot_m
        rows = []
        right = []
        distances_m = []
        for image, (places_m, normals) in zip(images, shapes, strict=True):
            # To first order, points p are at p + a × (p − c) + e.
            offsets_m = np.cross(turn_rad, places_m - pivot_m) + shift_m
            nearest_m, nearest = self.trees[image].query(places_m - offsets_m)
            points_m = np.asarray(self.trees[image].data)[nearest]
            ways_m = points_m + offsets_m - places_m
            along_m = np.sum(ways_m * normals, axis=1)
            near = nearest_m < self.gate_m
            distances_m.append(np.where(near, np.abs(along_m), self.gate_m))
            by_turn = np.cross(points_m - pivot_m, normals)
            rows.append(np.hstack([by_turn, normals])[near] / self.rough_m)
            right.append(along_m[near] / self.rough_m)
        prior = np.concatenate(
            [self.camera.prior_weights(DEPTH_TURN), self.camera.prior_weights(DEPTH_SHIFT)]
        )
        step = np.linalg.lstsq(
            np.vstack([*rows, np.diag(prior)]), -np.concatenate([*right, prior * estimate])
        )[0]
        return estimate + step, float(np.sqrt(np.mean(np.concatenate(distances_m) ** 2)))
