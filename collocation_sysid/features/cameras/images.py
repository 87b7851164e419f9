"""Misspecification of depth images: flipped images, wrong camera matrices, distances along rays.

Such a camera sees points near the body, but not its shape. The points of the first image are
compared with equilibria of the body for many stiffnesses, as stated and with each common mistake
corrected. The camera is aligned with each shape within the prior of its pose. The test needs a body
that is at rest in that image, and a pinhole camera with images.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ...common.array_types import Array
from ...errors import SimulationError
from ...fem.laws.constants import is_modulus
from ...fem.laws.moduli import engineering_constants
from ...judge.doubt import Doubt, accepted
from ...model.nuisance_map import NuisanceMap
from ...program.depth.camera_alignment import AlignedPose, ExactCloud, iterate_alignments, thinned
from ...program.depth.camera_model import DepthCameraModel
from ...program.depth.visible_surface import VisibleSurface
from ...program.forward.initial_equilibrium import equilibrium
from ...program.forward.newton_solver import NewtonSolver
from ...recording.depth_camera import DepthCamera
from ...recording.experiment import Experiment
from ...recording.nuisance import DEPTH_SHIFT, DEPTH_TURN
from ...recording.sample_times import TIME_TOLERANCE_S
from ...statistics.hypothesis import Hypothesis
from ...statistics.thresholds import CERTAIN, LEAST_IMPROVEMENT, MISFIT, ONE_OF_MANY

# Young's moduli of the equilibria [Pa], stiff to soft.
YOUNG_PA = np.geomspace(1e7, 1e2, 11)
# Deformation over the body's diagonal between neighbouring shapes: the camera follows as much.
SHAPE_STEP = 0.08
# Deformation over the diagonal from which on softer bodies are not tried.
LARGEST_DEFORMATION = 0.8
# Points of the surface that are compared.
SAMPLES = 250
# Iterations of an alignment, and of a rough one.
ITERATIONS = 12
ROUGH_ITERATIONS = 6
# Every how many shapes a rough alignment tries.
STRIDE = 3
# Initial gate of an alignment, over the diagonal.
INITIAL_GATE = 0.35
# Cosine between normal and view below which a point is not compared.
GRAZING = 0.3
# Distance over the diagonal that interpolated shapes and noise explain.
ROUGHLY = 0.003
# Standard deviations of the prior of its pose by which a camera may be off.
LARGEST_POSE_DEVIATION = 5.0
# Distance, in those of `ROUGHLY`, up to which an alignment found the body.
ALIGNED = 6.0
# Ratios of image sizes that are tried.
SIZE_RATIOS = (2.0, 0.5)


@dataclass(frozen=True, eq=False)
class MeasuredPixels:
    """Pixels of one depth image, and the camera that turns them into points."""

    pixels: Array  # (P, 2): columns u and rows v
    depth_m: Array  # (P,): depth along the optical axis [m]
    camera: DepthCamera
    # Size of the image.
    columns: int
    rows: int

    @property
    def points_m(self) -> Array:
        """Points (P, 3) in the camera's frame [m]."""
        rays = self.camera.points_at_unit_depth(self.pixels)
        return self.depth_m[:, None] * rays

    def with_pixels(self, pixels: Array) -> MeasuredPixels:
        """Return the image with its depths at other pixels (P, 2)."""
        return replace(self, pixels=pixels)

    def with_matrix(self, matrix: Array) -> MeasuredPixels:
        """Return the image of a camera with another matrix (3, 3)."""
        return replace(self, camera=replace(self.camera, matrix=matrix))

    def with_depths_of_ray_lengths(self) -> MeasuredPixels:
        """Return the image with its depths taken as distances along the rays."""
        rays = self.camera.points_at_unit_depth(self.pixels)
        return replace(self, depth_m=self.depth_m / np.linalg.norm(rays, axis=1))


def camera_image_hypotheses(
    experiment: Experiment, constants: Mapping[str, float]
) -> Iterator[Hypothesis]:
    """Yield hypotheses about the images and matrices of the depth cameras of an experiment.

    Parameters
    ----------
    constants : mapping of str to float
        Constants of the body; only ratios of stiffness within it matter.
    """
    nuisance = NuisanceMap.from_experiment(experiment)
    for index, depth in enumerate(experiment.depths):
        first = depth.first_sample_with_points
        time_s = float(depth.sample_times_s[first])
        has_image = any(image is not None for image in depth.images_m)
        if not has_image or not _is_at_rest(experiment, time_s):
            continue
        camera = DepthCameraModel.from_experiment(experiment, index, nuisance)
        comparison = _ImageComparison(
            experiment,
            replace(camera, depth=depth),
            first=first,
            shapes_m=equilibrium_shapes_m(experiment, constants, time_s=time_s),
        )
        yield from comparison.hypotheses()


def _is_at_rest(experiment: Experiment, time_s: float) -> bool:
    """Whether the body is in equilibrium at a time [s], in grasps only."""
    if experiment.obstacles or experiment.actuators:
        return False
    starts_at_rest = experiment.start == "equilibrium"
    is_start = time_s < experiment.t_s[0] + TIME_TOLERANCE_S
    return experiment.is_static or (starts_at_rest and is_start)


def equilibrium_shapes_m(
    experiment: Experiment, constants: Mapping[str, float], time_s: float
) -> list[Array]:
    """Return shapes (n, 3) of a body in equilibrium [m], from the undeformed shape to soft
    bodies, with interpolated shapes between.

    Stiffnesses without an equilibrium, and softer ones, are omitted.

    Parameters
    ----------
    constants : mapping of str to float
        Constants of the body; its moduli are scaled together.
    time_s : float
        Time of grasps and loads [s].
    """
    body = experiment.body
    size_m = float(np.linalg.norm(np.ptp(body.nodes_m, axis=0)))
    undeformed_m = experiment.rigid_positions([time_s])[0]
    shapes_m = [undeformed_m]
    stated = body.lame(body.theta_from_values(constants)).values()
    stated_pa = max(engineering_constants(*lame)[0] for lame in stated)
    solver = NewtonSolver(experiment)
    start: Array | None = None
    for young_pa in YOUNG_PA:
        scaled = {
            name: value * (young_pa / stated_pa if is_modulus(name) else 1.0)
            for name, value in constants.items()
        }
        try:
            start = equilibrium(
                experiment,
                body.theta_from_values(scaled),
                time_s=time_s,
                start=start,
                solver=solver,
            )
        except SimulationError:
            break
        shape_m = start.reshape(-1, 3)
        deformation_m = np.linalg.norm(shape_m - undeformed_m, axis=1).max()
        if deformation_m > LARGEST_DEFORMATION * size_m:
            break
        moved_m = float(np.linalg.norm(shape_m - shapes_m[-1], axis=1).max())
        count = int(moved_m / (SHAPE_STEP * size_m))
        last_m = shapes_m[-1]
        shapes_m += [
            last_m + share * (shape_m - last_m) for share in np.arange(1, count + 1) / max(1, count)
        ]
    return shapes_m


@dataclass(frozen=True)
class _Fit:
    # Root mean square distance of the visible surface from the points, each at most the gate.
    distance_m: float
    # (3,): estimated error of the camera's pose.
    turn_rad: Array
    shift_m: Array
    misfit: float  # root mean square of distance and pose error in standard deviations


class _ImageComparison:
    """Comparison of the first image of a camera with shapes (n, 3) [m] of the body."""

    stated: MeasuredPixels

    def __init__(
        self, experiment: Experiment, camera: DepthCameraModel, first: int, shapes_m: list[Array]
    ) -> None:
        depth = camera.depth
        image_m = next(each for each in depth.images_m if each is not None)
        rows, columns = image_m.shape
        points_m = thinned(depth.points_m[first])
        self.subject = f"'{depth.name}' of '{experiment.name}'"
        self.camera = camera
        self.stated = MeasuredPixels(
            depth.camera.distorted_pixels(points_m),
            points_m[:, 2],
            depth.camera,
            columns=columns,
            rows=rows,
        )
        self.rough_m = max(depth.sigma_m, ROUGHLY * camera.size_m)
        rotations, translations_m = camera.poses
        surface = VisibleSurface.from_body(experiment.body, depth)
        rng = np.random.default_rng(0)
        selected = np.flatnonzero(surface.is_selected)
        faces = rng.choice(selected, SAMPLES)
        barycentric = rng.dirichlet(np.ones(3), SAMPLES)
        self.surfaces = []
        for shape_m in shapes_m:
            nodes_m = (shape_m[surface.nodes] - translations_m[first]) @ rotations[first]
            _, places_m, normals = surface.evaluate(nodes_m, faces, barycentric=barycentric)
            self.surfaces.append((places_m, normals))
        self.known: dict[MeasuredPixels, _Fit] = {}

    def hypotheses(self) -> Iterator[Hypothesis]:
        """Yield corrections that fit far better, else a pose far off its prior."""
        stated = self.fit(self.stated)
        if stated.misfit <= LEAST_IMPROVEMENT:
            return

        def misfit_of(image: MeasuredPixels) -> float:
            return self.fit(image).misfit

        found = [
            each
            for each in accepted(self._mistakes(), self.stated, misfit_of, LEAST_IMPROVEMENT, 1.0)
            if each.strength > CERTAIN or misfit_of(each.corrected) < MISFIT
        ]
        yield from found
        if found or stated.distance_m > ALIGNED * self.rough_m:
            return
        deviation = float(np.abs(self._pose_deviations(stated)).max())
        if deviation > LARGEST_POSE_DEVIATION:
            data = {
                "degrees": np.degrees(np.linalg.norm(stated.turn_rad)),
                "by_mm": 1e3 * np.linalg.norm(stated.shift_m),
                "deviations": deviation,
            }
            strength = deviation / LARGEST_POSE_DEVIATION
            yield Hypothesis("camera-pose", self.subject, data=data, strength=strength)

    def fit(self, image: MeasuredPixels) -> _Fit:
        if image in self.known:
            return self.known[image]
        cloud = ExactCloud(image.points_m)
        rough = {
            index: self._fit_shape(cloud, index, iterations=ROUGH_ITERATIONS)
            for index in range(0, len(self.surfaces), STRIDE)
        }
        best = min(rough, key=lambda index: rough[index].misfit)
        neighbours = range(max(0, best - STRIDE + 1), min(len(self.surfaces), best + STRIDE))
        fits = [self._fit_shape(cloud, index, iterations=ITERATIONS) for index in neighbours]
        self.known[image] = min(fits, key=lambda each: each.misfit)
        return self.known[image]

    def _fit_shape(self, cloud: ExactCloud, index: int, iterations: int) -> _Fit:
        places_m, normals = self.surfaces[index]
        gate_m = self.camera.depth.gate_m
        size_m = self.camera.size_m
        (aligned,) = iterate_alignments(
            self.camera,
            cloud,
            places=places_m,
            normals=normals,
            gates=np.geomspace(INITIAL_GATE * size_m, gate_m, iterations),
            starts=[AlignedPose(Rotation.identity(), np.zeros(3))],
        )
        rotation = aligned.rotation
        shift_m = aligned.translation_m
        pivot_m = self.camera.pivot_m
        aligned_m = rotation.inv().apply(places_m - pivot_m - shift_m) + pivot_m
        turned = rotation.inv().apply(normals)
        lengths_m = np.linalg.norm(aligned_m, axis=1)
        is_facing = -np.sum(turned * aligned_m, axis=1) > GRAZING * lengths_m
        fit = _Fit(gate_m, rotation.as_rotvec(), shift_m, np.inf)
        if not is_facing.any():
            return fit
        places_m = aligned_m[is_facing]
        ways_m = cloud.points_m[cloud.nearest(places_m)] - places_m
        nearest_m = np.linalg.norm(ways_m, axis=1)
        along_m = np.abs(np.sum(ways_m * turned[is_facing], axis=1))
        distances_m = np.where(nearest_m < gate_m, along_m, gate_m)
        fit = replace(fit, distance_m=float(np.sqrt(np.mean(distances_m**2))))
        pose = float(np.mean(self._pose_deviations(fit) ** 2))
        misfit = np.sqrt((fit.distance_m / self.rough_m) ** 2 + pose)
        return replace(fit, misfit=float(misfit))

    def _pose_deviations(self, fit: _Fit) -> Array:
        errors = np.concatenate([fit.turn_rad, fit.shift_m])
        weights = np.concatenate(
            [self.camera.prior_weights(DEPTH_TURN), self.camera.prior_weights(DEPTH_SHIFT)]
        )
        return weights * errors

    def _mistakes(self) -> Iterator[Doubt]:
        image = self.stated
        size = np.array([image.columns - 1.0, image.rows - 1.0])
        u, v = image.pixels.T
        flips = {
            "from right to left (mirrored)": np.column_stack([size[0] - u, v]),
            "from the bottom to the top": np.column_stack([u, size[1] - v]),
            "upside down (rotated by 180°)": size - image.pixels,
        }
        for order, pixels in flips.items():
            yield self._row("camera-image", image.with_pixels(pixels), order=order)
        for ratio in SIZE_RATIOS:
            factor = 1 / ratio
            zoomed = np.array(image.camera.matrix)
            zoomed[[0, 1], [0, 1]] *= factor
            yield self._row("camera-matrix/focal", image.with_matrix(zoomed), factor=factor)
        matrix = image.camera.require_matrix()
        centres = {
            "counted from the opposite corner of the image": size - matrix[:2, 2],
            "exchanged": matrix[[1, 0], [2, 2]],
        }
        for how, centre in centres.items():
            other = np.array(matrix)
            other[:2, 2] = centre
            yield self._row(
                "camera-matrix/centre",
                image.with_matrix(other),
                how=how,
                centre=str(np.round(centre, 1).tolist()),
            )
        yield self._row("camera-rays", image.with_depths_of_ray_lengths())

    def _row(self, code: str, without: MeasuredPixels, **data: object) -> Doubt:
        return Doubt.whole(code, without, self.subject, ONE_OF_MANY, **data)
