"""Outlines of a body in the images of one camera, see `Outlines`."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from ...common.array_types import Array
from ...common.declarations import declaration, identity_or_none, key
from ...common.validated_types import NotNegative, Positive, Text
from ...errors import InputError
from ...program.depth.visible_surface import VisibleSurface
from ...recording.deviation import Deviation
from ...recording.experiment import Experiment
from ...recording.nuisance import GAUGE, IMAGE_REACH
from ..image_tracks.camera_images import CameraImages
from .masks import Mask, encoded

# Distance of a mask's edge from the outline of the body, all around.
EDGE = "edge_px"
# Share of the border of an image that the body may cover; above, the mask is inverted.
MOST_BORDER = 0.9
# Points of an outline for each spacing along the edge of the mask: thinned points are nearer.
POINTS_PER_SPACING = 1.5
FEWEST_POINTS = 12
# Columns and rows of a simulated mask, if the camera does not state its size.
USUAL_SIZE_PX = (1280, 720)


@declaration
class Outlines(CameraImages):
    """Masks of the body in the images of one camera: its outline is compared with their edges.

    Parameters
    ----------
    name, camera, t_s, has_known_pose, pose_sigma, focal_sigma, centre_sigma_px, clock_sigma_s
        See `CameraImages`. The pose must be known.
    clock_rate_sigma, line_delay_s, line_delay_sigma_s
        See `CameraImages`.
    masks : sequence of (rows, columns) arrays of bool or None, or None
        Pixels that show the body, of each image; None for an image without a mask. The whole body
        must be within the mask wherever nothing hides it. None before they are simulated.
    sigma_px : float
        Standard deviation of the distance between the outline of the body and the edge of a mask, at
        points of the outline that are `spacing_px` apart.
    spacing_px : float
        Distance of the points of the outline that are compared: errors of a mask are alike nearby.
    same_camera_as : str, optional
        Name of the tracks of the same camera, whose errors the outlines share.
    edge_sigma_px : float
        Standard deviation of a distance by which all masks end inside of the outline; zero if they
        end there exactly.

    Raises
    ------
    InputError
        If a mask is empty, contains the whole image, has another size than the calibration, or is
        inverted; or as for other images.
    """

    measurement_text: ClassVar[str] = "outlines"
    other_text: ClassVar[str] = "outlines"
    noise_key: ClassVar[str] = "sigma_px of outlines"
    sigma_text: ClassVar[str] = "its sigma_px"
    precedence: ClassVar[int] = 2
    needs_surface: ClassVar[bool] = True
    suffix: ClassVar[str] = ".json"

    masks: Sequence[Mask | None] | None = key(converter=identity_or_none, default=None)
    sigma_px: float = key(Positive, default=0.5)
    spacing_px: float = key(Positive, default=10.0)
    edge_sigma_px: float = key(NotNegative, default=1.0)
    same_camera_as: str | None = key(Text | None, default=None)

    def __post_init__(self) -> None:
        where = f"the outlines '{self.name}'"
        times = self._checked_times(where)
        if not self.has_known_pose:
            raise InputError(
                f"the pose of {where} is unknown, and a body may have the same outline from several "
                "sides; expected the pose of the camera, such as that which a solve with image_tracks "
                "of at least four points in the same images notes"
            )
        masks: list[Mask | None] = [None] * len(times)
        if self.masks is not None:
            if len(self.masks) != len(times):
                raise InputError(
                    f"{where} has {len(self.masks)} masks for {len(times)} times; expected one mask "
                    "for each time"
                )
            masks = [self._checked(k, mask, where) for k, mask in enumerate(self.masks)]
        count = self._point_count(masks)
        present = [mask is not None for mask in masks]
        values = np.where(np.array(present)[:, None], np.zeros((len(times), count)), np.nan)
        values.setflags(write=False)
        unknowns = self._stated_unknowns()
        if self.edge_sigma_px:
            unknowns[EDGE] = self.edge_sigma_px
        vars(self).update(
            t_s=times,
            masks=tuple(masks),
            values=values if any(present) else None,
            sigma=self.sigma_px,
            columns=tuple(f"{self.name}_{k + 1}" for k in range(count)),
            unknowns=unknowns,
            _value_count=count,
        )

    def _checked(self, number: int, mask: Any, where: str) -> Mask | None:
        if mask is None:
            return None
        what = f"the mask {number + 1} of {where}"
        array = np.asarray(mask)
        if array.ndim != 2 or not np.isin(array, (0, 1)).all():
            raise InputError(
                f"{what} has the shape {array.shape}; expected (rows, columns) of bool"
            )
        made = array.astype(bool)
        size = self.camera.size_px
        if size is not None and made.shape != (size[1], size[0]):
            raise InputError(
                f"{what} has {made.shape[1]} x {made.shape[0]} pixels, but the calibration is for "
                f"{size[0]} x {size[1]}; expected the same size"
            )
        if not made.any():
            raise InputError(f"{what} is empty; expected the pixels that show the body")
        if made.all():
            raise InputError(f"{what} contains the whole image; expected only the body")
        border = np.concatenate([made[0], made[-1], made[:, 0], made[:, -1]])
        if border.mean() > MOST_BORDER:
            raise InputError(
                f"{what} contains {border.mean():.0%} of the border of the image and seems to be "
                "inverted; expected true where the body is: invert the masks"
            )
        made.setflags(write=False)
        return made

    def _point_count(self, masks: Sequence[Mask | None]) -> int:
        lengths = [
            np.sum(mask[1:] != mask[:-1]) + np.sum(mask[:, 1:] != mask[:, :-1])
            for mask in masks
            if mask is not None
        ]
        points = POINTS_PER_SPACING * max(lengths, default=0) / self.spacing_px
        return max(FEWEST_POINTS, int(np.ceil(points)))

    def __repr__(self) -> str:
        return f"Outlines({self.name!r}: {sum(m is not None for m in self.all_masks)} masks)"

    @property
    def all_masks(self) -> Sequence[Mask | None]:
        """Masks of all images; None where there is none."""
        return self.masks or ()

    @property
    def title(self) -> str:
        return f"the outlines of {self.name}"

    @property
    def samples_text(self) -> str:
        return f"the outlines '{self.name}'"

    @property
    def instrument_text(self) -> str:
        return f"{sum(mask is not None for mask in self.all_masks)} outlines in images of '{self.name}'"

    @property
    def identity(self) -> Any:
        """Outlines of two recordings are not compared with each other."""
        return id(self)

    def series(self) -> Iterator[tuple[str, Array]]:
        edges = [
            np.flatnonzero(np.diff(mask.ravel())).astype(float)
            for mask in self.all_masks
            if mask is not None
        ]
        yield self.title, np.concatenate([*edges, np.zeros(0)])

    def with_samples(self, t_s: ArrayLike, values: ArrayLike | None) -> Self:
        """Keep masks at times with a finite value; at other times than its own there is none."""
        times = np.asarray(t_s, dtype=float)
        own_s = self.sample_times_s
        same = len(times) == len(own_s) and np.allclose(times, own_s, rtol=0, atol=1e-6)
        if not same or values is None:
            return replace(self, t_s=t_s, masks=None)
        kept = np.asarray(np.isfinite(np.asarray(values, dtype=float)).any(axis=1))
        return replace(
            self, masks=[m if k else None for m, k in zip(self.all_masks, kept, strict=True)]
        )

    # Nuisance parameters ----------------------------------------------------------------------

    @property
    def camera_name(self) -> str:
        return self.same_camera_as or self.name

    def unknown_label(self, name: str) -> str:
        return f"edge of {self.name} [px]" if name == EDGE else super().unknown_label(name)

    def unknown_rows(self, experiment: Experiment) -> Iterator[tuple[Deviation, str, float]]:
        yield from self.camera_rows(experiment, IMAGE_REACH)
        if self.edge_sigma_px:
            yield GAUGE, self.unknown_label(EDGE), self.edge_sigma_px

    # Simulation -------------------------------------------------------------------------------

    def simulated_text(self, experiment: Experiment, positions_m: Array) -> str:
        """Return masks of (T, n, 3) [m] as run lengths in JSON."""
        nearest = np.abs(np.asarray(experiment.t_s)[:, None] - self.sample_times_s).argmin(axis=0)
        masks = [
            mask_of(self, experiment, positions_m[k], float(t_s))
            for k, t_s in zip(nearest, self.sample_times_s, strict=True)
        ]
        return json.dumps([encoded(mask) for mask in masks])


def edge_pixels(mask: Mask) -> Array:
    """Return the pixels u, v (P, 2) of a mask (rows, columns) beside which the body ends."""
    inner = np.pad(mask, 1)
    inner = inner[:-2, 1:-1] & inner[2:, 1:-1] & inner[1:-1, :-2] & inner[1:-1, 2:]
    return np.argwhere(mask & ~inner)[:, ::-1].astype(float)


def mask_of(outlines: Outlines, experiment: Experiment, nodes_m: Array, t_s: float) -> Mask:
    """Return the mask (rows, columns) of a body at rest in a shape (n, 3) [m], without errors of the
    camera: pixels whose centre is within a projected triangle of its surface.
    """
    surface = VisibleSurface.from_body(experiment.body)
    rotations, translations = outlines.camera.pose_at([t_s])
    corners = surface.subdivided_triangles(nodes_m[surface.nodes])
    own = (corners.reshape(-1, 3) - translations[0]) @ rotations[0]
    columns, rows = outlines.camera.size_px or USUAL_SIZE_PX
    mask = np.zeros((rows, columns), dtype=bool)
    if (own[:, 2] <= 0).any():
        return mask
    for a, b, c in outlines.camera.distorted_pixels(own).reshape(-1, 3, 2):
        low = np.maximum(np.ceil(np.min([a, b, c], axis=0)), 0).astype(int)
        high = np.minimum(np.max([a, b, c], axis=0), [columns - 1, rows - 1])
        u, v = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
        sides = [
            (end[0] - start[0]) * (v - start[1]) - (end[1] - start[1]) * (u - start[0])
            for start, end in ((a, b), (b, c), (c, a))
        ]
        inside = np.all([s >= 0 for s in sides], axis=0) | np.all([s <= 0 for s in sides], axis=0)
        mask[v[inside].astype(int), u[inside].astype(int)] = True
    return mask
