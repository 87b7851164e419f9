"""Depth cameras and scanners: images or clouds of unlabelled points of a body's surface.

Points are in the camera's frame: x to the right, y downwards, z along the optical axis. Images are
converted to points when they are read; clouds are points already.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from ..common.array_types import Array
from ..common.checked_arrays import float_array, read_only_floats, unconverted
from ..common.declarations import declaration, key
from ..common.validated_classes import validated
from ..common.validated_types import AtLeastOne, Positive
from ..errors import InputError
from ..fem.meshes.selection import Selection
from .camera import Camera
from .measurement import Measurement
from .node_selection import Nodes, selection_from_section
from .sample_times import first_unordered_time

# Relative difference of the depths of neighbouring pixels above which they show two surfaces.
LARGEST_RELATIVE_JUMP = 0.02
# Points of a cloud nearer to the plane of a camera with a matrix have no viewing direction [m].
LEAST_DEPTH_M = 1e-6
# Largest number of images of a recording whose outlines are compared: they are stored in memory,
# and one of 640 x 480 pixels takes 1.2 MB.
MOST_OUTLINE_IMAGES = 40
# Usual distance to which points are thinned [m].
SPACING_M = 0.004
# Usual distance from the surface beyond which points belong to other objects [m].
GATE_M = 0.01
# Usual standard deviation of the distance of an outline from the edge of a silhouette [pixels].
OUTLINE_SIGMA_PX = 0.5
# Factor by which the distance of thinned points grows until there are few enough.
SPACING_FACTOR = 1.2

Background = Literal["auto", "empty", "unknown"]
# A depth camera is a camera whose images are depths; the model of the depth is that of `Depth`.
DepthCamera = Camera


def _require_selection(faces: Selection | None) -> Selection | None:
    if not isinstance(faces, Selection):
        raise InputError(
            f"faces of a depth camera is {faces!r}; expected a selection, such as cs.Named(…)"
        )
    return faces


def _unconverted_clouds(clouds: Sequence[ArrayLike]) -> Any:
    """Return the clouds, which `Depth` checks and thins."""
    if isinstance(clouds, str) or not isinstance(clouds, Iterable):
        raise InputError(f"found {clouds!r}; expected a list of clouds (P, 3) of a depth camera")
    return clouds


def _unconverted_images(images_m: Sequence[ArrayLike | None]) -> Any:
    """Return the images unchanged, which `Depth` checks and converts."""
    if not isinstance(images_m, list | tuple | np.ndarray):
        raise InputError(
            f"images_m of a depth camera is a {type(images_m).__name__}; expected a list of images"
        )
    return images_m


@declaration
class Depth(Measurement):
    """Depth images, or clouds of points of a body, of one camera, one for each sample time.

    Parameters
    ----------
    name : str
    t_s : (S,) array
        Sample times, ascending, within those of the experiment, at any rate.
    clouds : sequence of (P, 3) or (P, 6) arrays
        Points in the camera's frame, with normals of the surface behind them where these are known;
        NaN where missing. An empty cloud is a dropout. `Depth.of_images` makes clouds from images.
    sigma_m : float
        Standard deviation of the noise along the normal of the surface.
    camera : Camera
    spacing_m : float
        Approximate distance to which the points are thinned, because the noise of neighbouring
        pixels is correlated.
    gate_m : float
        Distance from the surface beyond which points are assumed to belong to other objects and are
        not used.
    faces : Selection, optional
        Faces that may be visible: those whose corners are all selected. All by default.
    background : {"auto", "empty", "unknown"}
        Meaning of a pixel without a depth. "empty": nothing is there, so that the body cannot be
        there. "unknown": anything may be there, as where the sensor gets no echo from dark or steep
        surfaces. "auto": "empty" in images where hardly any pixel shows something far behind the
        body, otherwise "unknown". A measured depth well behind the body shows in either case that
        the body is not there.
    outline_sigma_px : float
        Standard deviation [pixels] of the distance between the body's outline and the edge of its
        silhouette in an image, at points of the outline that are `spacing_m` apart. Rounding to
        pixels alone gives 0.3.
    images_m : sequence of (rows, columns) arrays or None
        Depth images that the clouds were made from, NaN or 0 without depth, one for each time; None
        where the outline of the body is not compared with that sample. Empty for clouds, whose
        outlines are unknown.

    Raises
    ------
    InputError
        If shapes disagree, time does not increase, or there is no point.
    """

    description_name: ClassVar[str] = "depth camera"
    measurement_text: ClassVar[str] = "points of depth cameras"
    noise_key: ClassVar[str] = "sigma_m of depth"
    sigma_text: ClassVar[str] = "its sigma_m"
    points_name: ClassVar[str] = "depth points"
    precedence: ClassVar[int] = 1
    needs_surface: ClassVar[bool] = True

    name: str
    t_s: Array = key(converter=unconverted)
    clouds: tuple[Array, ...] = key(converter=_unconverted_clouds)
    sigma_m: float = key(Positive)
    camera: Camera = key(default_factory=Camera)
    spacing_m: float = key(Positive, default=SPACING_M)
    gate_m: float = key(Positive, default=GATE_M)
    faces: Selection | None = key(
        Nodes | None, converter=_require_selection, read=selection_from_section, default=None
    )
    background: Background = key(Background, default="auto")
    outline_sigma_px: float = key(Positive, default=OUTLINE_SIGMA_PX)
    images_m: tuple[Array | None, ...] = key(converter=_unconverted_images, default=())

    def __post_init__(self) -> None:
        where = f"the depth camera '{self.name}'"
        times = read_only_floats(self.t_s, (None,), name=f"t_s of {where}")
        if fault := first_unordered_time(times):
            raise InputError(f"{fault[1]}, of {where}", where=f"row {fault[0] + 1}")
        if len(times) != len(self.clouds):
            raise InputError(
                f"{where} has {len(times)} times and {len(self.clouds)} images or clouds; expected one "
                "image or cloud for each time"
            )
        shapes = ((None, 3), (None, 6))
        clouds = tuple(
            self._thin_cloud(float_array(cloud, f"a cloud of {where}", shapes, finite=False))
            for cloud in self.clouds
        )
        if not any(len(cloud) for cloud in clouds):
            raise InputError(f"{where} has no points; check its file and the unit of its depth")
        vars(self).update(t_s=times, clouds=clouds, images_m=self._check_images(len(times)))

    def _check_images(self, count: int) -> tuple[Array | None, ...]:
        """Return `images_m` in single precision, with NaN for pixels without a positive depth."""
        where = f"the depth camera '{self.name}'"
        if not len(self.images_m):
            return ()
        if len(self.images_m) != count or self.camera.matrix is None:
            raise InputError(
                f"{where} has {len(self.images_m)} images for {count} times and "
                f"{'no' if self.camera.matrix is None else 'a'} camera matrix; expected one image for "
                "each time and the matrix of the camera, or no images"
            )
        images = []
        for image in self.images_m:
            if image is None:
                images.append(None)
                continue
            what = f"an image (rows, columns) of {where}"
            depth = float_array(image, what, (None, None), finite=False).astype(np.float32)
            depth[~(np.isfinite(depth) & (depth > 0))] = np.nan
            images.append(depth)
        return tuple(images)

    @classmethod
    @validated
    def of_images(
        cls,
        name: str,
        images_m: ArrayLike,
        camera: Camera,
        sigma_m: float,
        t_s: ArrayLike = (0.0,),
        *,
        spacing_m: float = SPACING_M,
        gate_m: float = GATE_M,
        faces: Selection | None = None,
        background: Background = "auto",
        outline_sigma_px: float = OUTLINE_SIGMA_PX,
    ) -> Depth:
        """Return the measurements of depth images [m] (S, rows, columns), or (rows, columns) for
        one.

        Pixels become points by `points_from_image`. At most `MOST_OUTLINE_IMAGES` of the images are
        stored, for the outlines of the body.

        Parameters
        ----------
        images_m : array_like
            Zero, negative or NaN where there is no depth.
        camera : Camera
            Camera with a matrix.
        sigma_m : float
            Standard deviation of the depth [m].
        t_s : (S,) array_like
            Times [s]; one time, 0, by default.
        spacing_m, gate_m, faces, background, outline_sigma_px
            See `Depth`.

        Raises
        ------
        InputError
            If the camera has no matrix, or as `Depth` does.
        """
        what = f"images_m of the depth camera '{name}'"
        shapes = ((None, None), (None, None, None))
        images = float_array(images_m, what, shapes, finite=False)
        images = images[None] if images.ndim == 2 else images
        clouds = [points_from_image(image, camera) for image in images]
        outlined = samples_with_outlines(len(images))
        return cls(
            name,
            t_s,
            clouds=clouds,
            sigma_m=sigma_m,
            camera=camera,
            spacing_m=spacing_m,
            gate_m=gate_m,
            faces=faces,
            background=background,
            outline_sigma_px=outline_sigma_px,
            images_m=[image if k in outlined else None for k, image in enumerate(images)],
        )

    def _thin_cloud(self, cloud: Array) -> Array:
        """Return the finite point of each cube that is nearest to its centre across the axis."""
        if cloud.ndim != 2 or cloud.shape[1] not in (3, 6):
            raise InputError(
                f"a cloud of the depth camera '{self.name}' has the shape {cloud.shape}; expected "
                "(points, 3), or (points, 6) with normals"
            )
        cloud = cloud[np.isfinite(cloud).all(axis=1)]
        if self.camera.matrix is not None:  # such as (0, 0, 0), where nothing was measured
            cloud = cloud[np.abs(cloud[:, 2]) > LEAST_DEPTH_M]
        cubes = np.floor(cloud[:, :3] / self.spacing_m)
        # Across the view only: noise of the depth must not choose.
        away = np.linalg.norm((cloud[:, :3] / self.spacing_m - cubes - 0.5)[:, :2], axis=1)
        order = np.lexsort((away, *cubes.T))
        first = np.ones(len(order), dtype=bool)
        first[1:] = (np.diff(cubes[order], axis=0) != 0).any(axis=1)
        return cloud[np.sort(order[first])]

    def __repr__(self) -> str:
        points = sum(map(len, self.clouds))
        return f"Depth({self.name!r}: {len(self.t_s)} images of {points} points together)"

    @property
    def title(self) -> str:
        return f"the depth of {self.name}"

    @property
    def samples_text(self) -> str:
        return f"the images of '{self.name}'"

    @property
    def presence(self) -> dict[str, NDArray[np.bool_]]:
        return {"points": np.array(self.point_counts) > 0}

    @property
    def instrument_text(self) -> str:
        return f"{sum(self.point_counts):,} points of '{self.name}'"

    @property
    def sample_times_s(self) -> Array:
        return self.t_s

    @property
    def points_m(self) -> list[Array]:
        """Points (P, 3) of each sample in the camera's frame [m], after thinning and without
        normals; (0, 3) for a dropout.
        """
        return [cloud[:, :3] for cloud in self.clouds]

    def series(self) -> Iterator[tuple[str, Array]]:
        yield self.title, np.concatenate([*self.points_m, np.zeros((0, 3))])

    def until_time(self, end_s: float) -> Depth | None:
        count = int(np.searchsorted(self.sample_times_s, end_s, side="right"))
        if not any(map(len, self.clouds[:count])):
            return None
        images_m = self.images_m[:count]
        return replace(
            self, t_s=self.sample_times_s[:count], clouds=self.clouds[:count], images_m=images_m
        )

    @property
    def first_useful_s(self) -> float:
        return float(self.sample_times_s[self.first_sample_with_points])

    @property
    def point_counts(self) -> list[int]:
        return [*map(len, self.clouds)]

    def thinned(self, most: int) -> Depth:
        """Return a copy whose clouds have at most `most` points each, at least one.

        Points are selected as on construction, at a larger distance, which also applies to the
        points of outlines; measured values are not averaged.
        """
        spacing_m = self.spacing_m * np.sqrt(max(self.point_counts) / most)
        thinned = replace(self, spacing_m=spacing_m)
        while max(thinned.point_counts) > most:
            spacing_m *= SPACING_FACTOR
            thinned = replace(self, spacing_m=spacing_m)
        return thinned

    @property
    def first_sample_with_points(self) -> int:
        """Index, from 0, of the first sample that has points."""
        return next(k for k, cloud in enumerate(self.clouds) if len(cloud))


def samples_with_outlines(count: int) -> set[int]:
    """Return the indices, from 0, of those of `count` samples whose images are stored for their
    outlines: all, or `MOST_OUTLINE_IMAGES` of them, evenly spread with the first and the last.
    """
    return set(
        np.unique(np.linspace(0, count - 1, min(count, MOST_OUTLINE_IMAGES)).astype(int)).tolist()
    )


def points_from_image(image_m: Array, camera: Camera) -> Array:
    """Return the points (P, 3) [m] in the camera's frame of a depth image (rows, columns) [m], by
    rows; zero, negative values and NaN are no depth.

    Pixels whose depth differs from that of one of the four neighbours by `LARGEST_RELATIVE_JUMP` or
    more, pixels beside one without depth, and those at the border of the image are left out, as
    they may mix two surfaces.

    Raises
    ------
    InputError
        If the camera has no matrix.
    """
    if camera.matrix is None:
        raise InputError(
            "found a depth image without the matrix of its camera; expected matrix = [[fx, 0, "
            "cx], [0, fy, cy], [0, 0, 1]] in pixels: only point clouds can be used without it"
        )
    depth = np.where(np.isfinite(image_m) & (image_m > 0), image_m, np.nan)
    is_inner = np.zeros(depth.shape, dtype=bool)
    is_inner[1:-1, 1:-1] = np.isfinite(depth)[1:-1, 1:-1]
    for axis in (0, 1):
        for way in (1, -1):
            is_inner &= np.abs(
                np.roll(depth, way, axis) - depth
            ) < LARGEST_RELATIVE_JUMP * np.nan_to_num(depth)
    v, u = np.nonzero(is_inner)
    return camera.points_at_unit_depth(np.column_stack([u, v]).astype(float)) * depth[v, u][:, None]


# Rows and columns of an image.
_ImageSize = Annotated[AtLeastOne, Field(le=20_000)]


@validated
def depth_image(camera: Camera, shape: tuple[_ImageSize, _ImageSize], triangles_m: Array) -> Array:
    """Render a depth image [m] of opaque triangles, both sides of which are visible.

    Parameters
    ----------
    camera : Camera
        Camera with a matrix; its distortion and pose are ignored.
    shape : (int, int)
        Rows and columns.
    triangles_m : (F, 3, 3) array
        Corners in the camera's frame; triangles that reach behind the camera (z ≤ 0) are left out.

    Returns
    -------
    (rows, columns) array
        Depth z of the nearest triangle at the centre of each pixel, which has whole coordinates;
        NaN where there is none.
    """
    triangles_m = float_array(triangles_m, "triangles_m", (None, 3, 3))
    image = np.full(shape, np.inf)
    for corners in triangles_m[(triangles_m[:, :, 2] > 0).all(axis=1)]:
        pixels = camera.undistorted_pixels(corners)
        low = np.maximum(np.ceil(pixels.min(axis=0)), 0).astype(int)
        high = np.minimum(np.floor(pixels.max(axis=0)), [shape[1] - 1, shape[0] - 1]).astype(int)
        sides = (pixels[1:] - pixels[0]).T
        if (high < low).any() or abs(np.linalg.det(sides)) < 1e-12:
            continue
        u, v = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
        share = np.linalg.solve(sides, np.stack([u.ravel(), v.ravel()]) - pixels[0][:, None])
        share = np.vstack([1 - share.sum(axis=0), share])
        # What is linear over a triangle in the image is one over the depth.
        depth = np.where((share >= -1e-9).all(axis=0), 1 / (share.T @ (1 / corners[:, 2])), np.inf)
        window = image[low[1] : high[1] + 1, low[0] : high[0] + 1]
        np.minimum(window, depth.reshape(window.shape), out=window)
    return np.where(np.isfinite(image), image, np.nan)
