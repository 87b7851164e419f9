"""What depth cameras see, as pictures and films want it: points, and outlines of the surface."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..model.nuisance import NuisanceMap
from ..program.depth_comparison import SurfaceComparison
from ..program.skin import Skin
from ..program.view import View
from ..recording.experiment import Experiment
from .pictures.album import of_different_names, save_pictures
from .pictures.camera import Camera
from .pictures.depth import depth_picture

# Of so many samples outlines are drawn.
OUTLINED = 4
# A scene is looked at from so many times its size.
AWAY = 1e3


@dataclass(frozen=True, eq=False)
class Projection:
    """A camera's image or, of a cloud, a view of the body's broad side.

    Attributes
    ----------
    view : View
    skin : Skin
    phi : (k,) what the camera is off by
    scene : Camera
    """

    view: View
    skin: Skin
    phi: Array
    scene: Camera

    @classmethod
    def of(cls, view: View, skin: Skin, phi: Array, shape_m: Array, up: Array) -> Projection:
        """Of a cloud it faces a shape (n, 3)."""
        return cls(view, skin, phi, Camera.facing(shape_m[None], up))

    def points(self, own_m: Array, world_m: Array) -> Array:
        """(P, 3) u, v and depth of points (P, 3) in either frame."""
        camera = self.view.depth.camera
        if camera.matrix is not None:
            return np.column_stack([camera.pixels(own_m), own_m[:, 2]])
        right_top_mm = 1e3 * self.scene.project(world_m)
        return np.column_stack([right_top_mm * [1, -1], -self.scene.nearness(world_m)])

    def outlines(self, shape_m: Array, sample: int) -> Array:
        """(k, 2) u and v of what is turned to it of a shape, each face ended by a row of NaN."""
        eye_m = self.view.eye_m(self.phi, sample)
        if eye_m is None:
            size_m = float(np.linalg.norm(np.ptp(shape_m, axis=0)))
            eye_m = shape_m.mean(axis=0) + AWAY * size_m * self.scene.axes[2]
        corners = shape_m[self.skin.flat[self.skin.facing(shape_m, eye_m)]]
        closed = corners[:, [0, 1, 2, 0]].reshape(-1, 3)
        own = self.view.own_m(self.phi, closed, sample)
        if self.view.depth.camera.matrix is not None:
            ahead = np.repeat((own[:, 2].reshape(-1, 4) > 0).all(axis=1), 4)
            closed, own = closed[ahead], own[ahead]
        seen = self.points(own, closed)[:, :2].reshape(-1, 4, 2)
        return np.pad(seen, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 2)

    def rows(self, sample: int, points_m: Array, rays: Array, apart_m: Array) -> Array:
        """(P, 8) of points in the camera's frame, see `Replay.seen`."""
        world = self.view.corrected_at(self.phi, points_m, rays, sample)
        t_s = np.full(len(points_m), self.view.depth.times[sample])
        return np.column_stack([t_s, self.points(points_m, world), apart_m, world])

    def outline_rows(self, sample: int, shape_m: Array) -> Array:
        """(k, 8) of the outlines of a shape; a row without a place where none is in view."""
        drawn = np.vstack([self.outlines(shape_m, sample), np.full((1, 2), np.nan)])
        rows = np.full((len(drawn), 8), np.nan)
        rows[:, 0], rows[:, 1:3] = self.view.depth.times[sample], drawn
        return rows


def compared_rows(surface: SurfaceComparison, up: Array) -> Array:
    """Return the points of all images beside a fitted or simulated surface, see `Replay.seen`.

    Parameters
    ----------
    surface : SurfaceComparison
    up : (3,) unit vector against gravity

    Returns
    -------
    (k, 8) array
        With outlines of some of the samples.
    """
    seen, shapes_m, phi = surface.sighting, surface.shapes_m, surface.phi
    shown = Projection.of(seen.view, seen.skin, phi, shapes_m[0], up)
    samples = np.flatnonzero(seen.used[: len(shapes_m)].any(axis=1)).tolist()
    rows = [np.zeros((0, 8))]
    for k in samples:
        within = seen.weights[k].any(axis=1)
        sights = seen.points[k], seen.rays[k], surface.apart_m[k]
        rows.append(shown.rows(k, *(each[within] for each in sights)))
    few = np.unique(np.linspace(0, len(samples) - 1, OUTLINED).round().astype(int))
    rows += [shown.outline_rows(samples[k], shapes_m[samples[k]]) for k in few if samples]
    return np.vstack(rows)


def seen_before(experiment: Experiment) -> dict[str, Array]:
    """(k, 8) of each depth camera's first image, and of the undeformed body as grasps carry it."""
    nuisance, by_camera = NuisanceMap.of(experiment), {}
    for number, depth in enumerate(experiment.depths):
        view, skin = View.of(experiment, number, nuisance), Skin.of(experiment.body, depth)
        shape_m = skin.first_m(experiment, depth)
        shown = Projection.of(view, skin, np.zeros(nuisance.size), shape_m, experiment.up)
        points_m = depth.points_m[depth.first]
        rows = shown.rows(
            depth.first, points_m, view.rays[depth.first], np.full(len(points_m), np.nan)
        )
        by_camera[depth.name] = np.vstack([rows, shown.outline_rows(depth.first, shape_m)])
    return by_camera


def save_overlays(experiments: Iterable[Experiment], folder: Path) -> list[Path]:
    """Draw `seen_before` of all, before anything is fitted, and return the files."""
    return save_pictures(
        folder,
        of_different_names(
            (f"depth_{experiment.name}_{name}", depth_picture(rows))
            for experiment in experiments
            for name, rows in seen_before(experiment).items()
        ),
    )
