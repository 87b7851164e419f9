"""Bodies with grasped nodes and markers on a sheet measured in millimetres of paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

from ...arrays import Array
from ..style import BLACK, BLUE, SMALL_PT, VERMILION, Picture
from .camera import Camera, Triangles

EDGE = "#5A6B7B"
# Of the parts of a body in turn.
SKINS = ("#B4D0EA", "#F0D3A0", "#B9DDC2", "#E2C3D9", "#D9D9A8", "#C9C3E6")
# Of more triangles than this one would see nothing but edges.
EDGED = 6000
_DOT = {"ls": "", "marker": "o", "ms": 3.2, "mec": VERMILION, "mew": 0.7}
_SEEN = {"ls": "", "marker": ".", "ms": 2.4, "mec": "none", "mfc": BLUE}
# More points of depth cameras only take longer to draw.
MOST_SEEN = 1000
_SQUARE = {"ls": "", "marker": "s", "ms": 2.2, "mfc": BLACK, "mec": "none"}


def sheet(width_mm: float, height_mm: float) -> tuple[Figure, Axes]:
    """A figure with one invisible pair of axes in millimetres from the lower left corner."""
    figure = Picture(figsize=(width_mm / 25.4, height_mm / 25.4))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, width_mm), ylim=(0, height_mm))
    axes.set_axis_off()
    return figure, axes


@dataclass(frozen=True, eq=False)
class View:
    """Where on the sheet, how large, and from where a body is seen.

    Attributes
    ----------
    camera : Camera
    mm_per_m : float
    origin_mm : (2,) where on the sheet the origin of space is
    """

    camera: Camera
    mm_per_m: float
    origin_mm: Array

    @classmethod
    def fitting(
        cls, camera: Camera, points_m: Array, room_mm: ArrayLike, corner_mm: ArrayLike
    ) -> View:
        """Show all `points_m` (…, 3) as large as fits, in the middle of a box on the sheet."""
        low, high = _extent(camera, points_m)
        room, corner = np.asarray(room_mm, dtype=float), np.asarray(corner_mm, dtype=float)
        scale = float(np.min(room / np.maximum(high - low, 1e-12)))
        return cls(camera, scale, corner + room / 2 - scale * (low + high) / 2)

    def shifted(self, by_mm: ArrayLike) -> View:
        """The same elsewhere on the sheet."""
        return replace(self, origin_mm=self.origin_mm + np.asarray(by_mm))

    def places(self, points_m: ArrayLike) -> Array:
        """(…, 3) to (…, 2) millimetres on the sheet."""
        return self.origin_mm + self.mm_per_m * self.camera.project(points_m)


def width_over_height(camera: Camera, points_m: Array) -> float:
    """Aspect of what is to be shown."""
    low, high = _extent(camera, points_m)
    return float((high - low)[0] / (high - low)[1])


def _extent(camera: Camera, points_m: Array) -> tuple[Array, Array]:
    places = camera.project(points_m).reshape(-1, 2)
    return np.nanmin(places, axis=0), np.nanmax(places, axis=0)


def with_outlines(points_m: Array, outlines_m: Array | None) -> Array:
    """Points (T, n, 3) of a body, and what of outlines (T, o, 3) is no farther than half of it."""
    if outlines_m is None:
        return points_m
    low, high = np.nanmin(points_m, axis=1), np.nanmax(points_m, axis=1)
    far = (high - low).max(axis=1, keepdims=True) / 2
    near_m = np.clip(outlines_m, (low - far)[:, None], (high + far)[:, None])
    return np.concatenate([points_m, near_m], axis=1)


class Drawn:
    """A body with its grasped nodes and markers on a sheet; it can be moved.

    Parameters
    ----------
    axes : Axes of a `sheet`
    view : View
    surface : (F, 3)
    parts : (F,) the part of the body that each triangle belongs to; one part by default
    nodes : (F, k) the nodes of each triangle, of which grasped ones are marked; by default corners
    wire : str, optional
        Colour of the edges of its triangles, which alone are drawn then, over all else.
    """

    def __init__(
        self,
        axes: Axes,
        view: View,
        surface: Triangles,
        parts: NDArray[np.integer] | None = None,
        nodes: NDArray[np.integer] | None = None,
        wire: str | None = None,
    ) -> None:
        self.view, self.surface, self.wire = view, surface, wire
        self.nodes = surface if nodes is None else nodes
        numbers = np.zeros(len(surface), dtype=np.int64) if parts is None else parts % len(SKINS)
        self.skins = np.array([to_rgb(skin) for skin in SKINS])[numbers]
        self.edged = len(surface) <= EDGED
        self.skin = PolyCollection([], linewidths=0.3 if self.edged else 0.1, edgecolors=EDGE)
        self.skin.set_joinstyle("round")
        if wire is not None:
            self.skin.set(facecolor="none", edgecolor=wire, zorder=2.5)
            self.skin.set_linewidth(0.6 if self.edged else 0.1)
        axes.add_collection(self.skin, autolim=False)
        self.grasped = axes.add_line(Line2D([], [], zorder=3, **_SQUARE))
        self.outlines = axes.add_line(Line2D([], [], zorder=0.5, lw=0.6, color=BLACK))
        self.seen = axes.add_line(Line2D([], [], zorder=3.5, **_SEEN))
        self.rings = axes.add_line(Line2D([], [], mfc="none", zorder=4, **_DOT))
        self.dots = axes.add_line(Line2D([], [], mfc=VERMILION, zorder=5, **_DOT))

    def show(
        self,
        positions_m: Array,
        held: NDArray[np.bool_],
        markers_m: Array,
        skins: Array | None = None,
        outlines_m: Array | None = None,
        seen_m: Array | None = None,
    ) -> None:
        """Show nodes (n, 3), those of them that are grasped, markers (M, 3), and outlines (o, 3).

        Markers that the body hides are rings; grasped nodes turned away are left out, and so are
        points (P, 3) that depth cameras saw, where the body hides them. Triangles
        have the colours `skins` (F, 3), by default those of their parts.
        """
        camera = self.view.camera
        polygons, brightness, faces = camera.faces(positions_m, self.surface)
        if skins is not None:  # colours that tell something are shaded half as much
            brightness = (1 + brightness) / 2
        colours: Any = brightness[:, None] * (self.skins if skins is None else skins)[faces]
        self.skin.set_verts(list(self.view.origin_mm + self.view.mm_per_m * polygons))
        if self.wire is not None:
            return
        self.skin.set_facecolor(colours)
        if not self.edged:
            self.skin.set_edgecolor(colours)
        outer = np.unique(self.nodes[faces])
        self.grasped.set_data(*self.view.places(positions_m[outer[held[outer]]]).T)
        if outlines_m is not None:
            self.outlines.set_data(*self.view.places(outlines_m).T)
        if seen_m is not None:
            few_m = seen_m[:: 1 + len(seen_m) // MOST_SEEN]
            self.seen.set_data(
                *self.view.places(few_m[~camera.hidden(few_m, positions_m, self.surface)]).T
            )
        hidden = camera.hidden(markers_m, positions_m, self.surface)
        self.rings.set_data(*self.view.places(markers_m[hidden]).T)
        self.dots.set_data(*self.view.places(markers_m[~hidden]).T)


def draw_scale(axes: Axes, mm_per_m: float, corner_mm: ArrayLike, longest_mm: float = 20.0) -> None:
    """A bar of a round length, from `corner_mm` to the right, with its length beside it."""
    x, y = np.asarray(corner_mm, dtype=float)
    length_m = round_length(longest_mm / mm_per_m)
    end = x + length_m * mm_per_m
    axes.plot([x, end], [y, y], color=BLACK, lw=1.2, solid_capstyle="butt")
    axes.text(end + 1, y, f"{1e3 * length_m:g} mm", va="center", fontsize=SMALL_PT)


def round_length(longest: float) -> float:
    """Largest of 1, 2, 5 · 10ᵏ not above `longest`."""
    decade = 10.0 ** np.floor(np.log10(longest))
    return float(max(f * decade for f in (1, 2, 5) if f * decade <= longest * (1 + 1e-9)))


def draw_directions(
    axes: Axes, camera: Camera, origin_mm: ArrayLike, length_mm: float = 5.0
) -> None:
    """Arrows along x, y and z, but for one that points at the viewer or away."""
    start = np.asarray(origin_mm, dtype=float)
    for letter, along in zip("xyz", camera.project(np.eye(3)), strict=True):
        size = float(np.linalg.norm(along))
        if size < 0.2:
            continue
        tip: Any = start + length_mm * along
        arrow = {"arrowstyle": "->,head_length=0.15,head_width=0.1", "lw": 0.7, "shrinkA": 0}
        axes.annotate("", tip, tuple(start), arrowprops={**arrow, "shrinkB": 0})
        x, y = tip + 1.6 * along / size
        axes.text(x, y, letter, ha="center", va="center", fontsize=SMALL_PT)


def key(*entries: str) -> list[Line2D]:
    """Legend handles of "grasped", "markers", "measured", "behind the body", "seen in depth"."""
    styles = {
        "grasped": {**_SQUARE, "ms": 3.0},
        "behind the body": {**_DOT, "mfc": "none"},
        "seen in depth": {**_SEEN, "ms": 4.0},
    }
    return [
        Line2D([], [], label=name, **styles.get(name, {**_DOT, "mfc": VERMILION}))
        for name in entries
    ]


def skin_key(part: int, name: str) -> Line2D:
    """Legend handle of a part of the body."""
    look: Any = {**_SQUARE, "ms": 4.0, "mec": EDGE, "mew": 0.3, "mfc": SKINS[part % len(SKINS)]}
    return Line2D([], [], label=name, **look)


def draw_key(axes: Axes, entries: Sequence[Line2D], corner_mm: ArrayLike) -> None:
    """One line of legend whose upper left corner is at `corner_mm`."""
    names = [str(entry.get_label()) for entry in entries]
    place: Any = tuple(np.asarray(corner_mm))
    box = Legend(
        axes, list(entries), names, loc="upper left", bbox_to_anchor=place,
        bbox_transform=axes.transData, ncols=len(entries), fontsize=SMALL_PT, frameon=False,
        handletextpad=0.0, columnspacing=0.8, borderaxespad=0.0, borderpad=0.0,
    )  # fmt: skip
    axes.add_artist(box)
