"""Points of depth cameras and outlines of the body's surface, as pictures and films need them.

`visible_points` and `surface_rows` are for a fitted or simulated surface, `undeformed_rows` for the
undeformed body before anything is fitted. All give the rows of `MotionRecord.visible_points`: time
[s], image coordinates u and v (pixels, or mm for a point cloud), depth [m], distance behind the
surface [m] (NaN for points that do not count), and position in the world [m]. For some samples,
rows of outlines follow: time, u, v, and NaN else; a row without u and v ends each face.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..common.array_types import Array
from ..features.measurements import Predictions, surfaces
from ..model.nuisance_map import NuisanceMap
from ..program.depth.camera_model import DepthCameraModel
from ..program.depth.surface_comparison import SurfaceComparison
from ..program.depth.visible_surface import VisibleSurface
from ..recording.experiment import Experiment
from ..runs.forward_simulation import ForwardSimulation
from ..runs.solved_problem import SolvedProblem
from .figure_style import own_settings
from .pictures.album import save_pictures, with_unique_names
from .pictures.cameras import KIND, depth_picture
from .pictures.scene import ParallelCamera
from .replay import image_unit

# Description of the pictures of `save_overlays`, for the terminal.
OVERLAY_TEXT = "depth over the undeformed body"
# Number of samples whose outlines are drawn.
MAX_OUTLINED_SAMPLES = 4
# Distance of the viewer from a point cloud, over the size of the body: nearly parallel rays.
VIEWER_DISTANCE_RATIO = 1e3


@dataclass(frozen=True, eq=False)
class DepthProjection:
    """Projection into the image of a depth camera or, for a point cloud, onto the body's broad
    side.
    """

    view: DepthCameraModel
    skin: VisibleSurface  # visible surface of the body
    # (k,): nuisance parameters, of which those of the camera correct its pose, bias and scale.
    phi: Array
    # Parallel projection for point clouds, which have no image of their own.
    parallel_camera: ParallelCamera

    @classmethod
    def facing_shape(
        cls, view: DepthCameraModel, skin: VisibleSurface, phi: Array, shape_m: Array, up: Array
    ) -> DepthProjection:
        """Return the projection whose parallel view faces the broad side of the body.

        Parameters
        ----------
        phi : (k,)
        shape_m : (n, 3)
            Node positions that define the broad side.
        up : (3,)
            Unit vector against gravity.
        """
        return cls(
            view, skin, phi=phi, parallel_camera=ParallelCamera.facing_motion(shape_m[None], up)
        )

    def image_points(self, camera_m: Array, world_m: Array) -> Array:
        """Return image coordinates u, v [pixels] and depth [m] of points, as (P, 3).

        The depth is along the camera's axis, and the pixels are those of the image without
        distortion. For a point cloud, u and v are millimetres to the right and downwards in the
        parallel view, and the depth is measured from the origin of the world away from the viewer;
        it may be negative.

        Parameters
        ----------
        camera_m : (P, 3)
            Points in the camera's frame [m].
        world_m : (P, 3)
            The same points in the world [m].
        """
        camera = self.view.depth.camera
        if camera.matrix is not None:
            return np.column_stack([camera.undistorted_pixels(camera_m), camera_m[:, 2]])
        right_top_mm = 1e3 * self.parallel_camera.project(world_m)
        return np.column_stack(
            [right_top_mm * [1, -1], -self.parallel_camera.coordinates_to_viewer_m(world_m)]
        )

    def outlines(self, shape_m: Array, sample: int) -> Array:
        """Return u and v (5 F, 2) of the edges of the F faces that are turned to the camera, as
        closed lines: for each face its three corners, the first corner again, and a row of NaN.

        They are pixels of the image without distortion, and for a point cloud millimetres in the
        parallel view. Faces that are partly behind a camera with an image are left out.

        Parameters
        ----------
        shape_m : (n, 3)
            Node positions [m].
        sample : int
            Index of the camera's sample, which defines its pose.
        """
        eye_m = self.view.eye_m(self.phi, sample)
        if eye_m is None:
            size_m = float(np.linalg.norm(np.ptp(shape_m, axis=0)))
            eye_m = (
                shape_m.mean(axis=0) + VIEWER_DISTANCE_RATIO * size_m * self.parallel_camera.axes[2]
            )
        corners = shape_m[self.skin.plane_triangles[self.skin.is_facing(shape_m, eye_m)]]
        closed = corners[:, [0, 1, 2, 0]].reshape(-1, 3)
        own_m = self.view.to_camera_m(self.phi, closed, sample=sample)
        if self.view.depth.camera.matrix is not None:
            is_in_front = np.repeat((own_m[:, 2].reshape(-1, 4) > 0).all(axis=1), 4)
            closed = closed[is_in_front]
            own_m = own_m[is_in_front]
        image = self.image_points(own_m, closed)[:, :2].reshape(-1, 4, 2)
        return np.pad(image, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 2)

    def point_rows(self, sample: int, points_m: Array, rays: Array, distances_m: Array) -> Array:
        """Return the rows (P, 8) of `MotionRecord.visible_points` for all P given points of one
        sample.

        Parameters
        ----------
        sample : int
            Index of the camera's sample.
        points_m, rays : (P, 3)
            Points [m] and viewing directions in the camera's frame.
        distances_m : (P,)
            Distance behind the surface [m]; NaN for points that do not count, whose rows are
            returned, too.
        """
        world = self.view.to_world(self.phi, points_m, rays=rays, image=sample)
        t_s = np.full(len(points_m), self.view.depth.sample_times_s[sample])
        return np.column_stack([t_s, self.image_points(points_m, world), distances_m, world])

    def outline_rows(self, sample: int, shape_m: Array) -> Array:
        """Return rows (k, 8) of `MotionRecord.visible_points` with the outlines of a shape.

        The last row has the time alone, so that the sample is known also if no face is in view.

        Parameters
        ----------
        sample : int
            Index of the camera's sample.
        shape_m : (n, 3)
            Node positions [m].
        """
        drawn = np.vstack([self.outlines(shape_m, sample), np.full((1, 2), np.nan)])
        rows = np.full((len(drawn), 8), np.nan)
        rows[:, 0] = self.view.depth.sample_times_s[sample]
        rows[:, 1:3] = drawn
        return rows


def surface_rows(surface: SurfaceComparison, up: Array) -> Array:
    """Return the points of the images of a depth camera with their distances from a fitted or
    simulated surface.

    Only points within the gate of the correspondences are contained, those of images without any
    compared point are left out. Points within the gate that are not compared, such as grazing ones,
    have the distance NaN.

    Parameters
    ----------
    surface : SurfaceComparison
        Points of one depth camera and the surface.
    up : (3,)
        Unit vector against gravity.

    Returns
    -------
    (k, 8) array
        Rows of `MotionRecord.visible_points`: the points of all images, then the outlines of the
        surface in at most `MAX_OUTLINED_SAMPLES` evenly chosen ones of these images; no rows if no
        point of any image is compared.
    """
    correspondences = surface.correspondences
    shapes_m = surface.shapes_m
    phi = surface.phi
    shown = DepthProjection.facing_shape(
        correspondences.camera, correspondences.surface, phi=phi, shape_m=shapes_m[0], up=up
    )
    samples = np.flatnonzero(correspondences.is_compared[: len(shapes_m)].any(axis=1)).tolist()
    rows = [np.zeros((0, 8))]
    for k in samples:
        within = correspondences.weights[k].any(axis=1)
        sights = (correspondences.points[k], correspondences.rays[k], surface.signed_distances_m[k])
        rows.append(shown.point_rows(k, *(each[within] for each in sights)))
    few = np.unique(np.linspace(0, len(samples) - 1, MAX_OUTLINED_SAMPLES).round().astype(int))
    rows += [shown.outline_rows(samples[k], shapes_m[samples[k]]) for k in few if samples]
    return np.vstack(rows)


def visible_points(finished: SolvedProblem, experiment: Experiment) -> dict[str, Array]:
    """Return the points of each depth camera on the fitted surface, or else on the simulated one.

    The arrays (k, 8), by name of the camera, have the rows of `MotionRecord.visible_points`. The
    mapping is empty where neither surface is known, or without depth cameras.
    """
    part = finished.solution.part_of(experiment.name)
    rollout = finished.rollouts[experiment.name]
    predicted: Predictions = ()
    if part is not None:
        predicted = finished.solution.fitted_values[experiment.name]
    elif isinstance(rollout, ForwardSimulation):
        predicted = rollout.trajectory.predicted
    return {
        name: surface_rows(surface, experiment.upward_direction)
        for name, surface in surfaces(experiment, predicted).items()
    }


def undeformed_rows(experiment: Experiment) -> dict[str, Array]:
    """Return the first image of each depth camera with the undeformed body, before anything is
    fitted.

    The arrays (k, 8), by name of the camera, have the rows of `MotionRecord.visible_points`; empty
    without depth cameras. The body is where the grasps carry it rigidly, and distances from it are
    NaN. The first image is the first one that has points.
    """
    nuisance = NuisanceMap.from_experiment(experiment)
    by_camera = {}
    for number, depth in enumerate(experiment.depths):
        view = DepthCameraModel.from_experiment(experiment, number, nuisance=nuisance)
        skin = VisibleSurface.from_body(experiment.body, depth)
        shape_m = skin.initial_positions_m(experiment, depth)
        shown = DepthProjection.facing_shape(
            view, skin, phi=np.zeros(nuisance.size), shape_m=shape_m, up=experiment.upward_direction
        )
        points_m = depth.points_m[depth.first_sample_with_points]
        rows = shown.point_rows(
            depth.first_sample_with_points,
            points_m,
            rays=view.rays[depth.first_sample_with_points],
            distances_m=np.full(len(points_m), np.nan),
        )
        by_camera[depth.name] = np.vstack(
            [rows, shown.outline_rows(depth.first_sample_with_points, shape_m)]
        )
    return by_camera


@own_settings()
def save_overlays(experiments: Iterable[Experiment], folder: Path) -> list[Path]:
    """Draw the first image of each depth camera with the outlines of the undeformed body, see
    `undeformed_rows`, and return the files; empty without depth cameras.

    The pictures are written to `folder`, which must exist, as ``depth_<experiment>_<camera>.png``;
    existing ones are replaced.

    Raises
    ------
    InputError
        If a picture cannot be written.
    """
    return save_pictures(
        folder,
        with_unique_names(
            (
                f"{KIND}_{experiment.name}_{depth.name}",
                depth_picture(rows[depth.name], image_unit(depth.camera.matrix is not None)),
            )
            for experiment in experiments
            if (rows := undeformed_rows(experiment))
            for depth in experiment.depths
        ),
    )
