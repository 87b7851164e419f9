"""Drawing of bodies with grasped nodes and markers on a sheet with millimetres as coordinates, in
parallel projection: the 3-D axes of matplotlib cost tenths of a second each and leave wide margins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ...common.array_types import Array
from ..figure_style import BLACK, BLUE, SMALL_PT, VERMILION, fixed_figure

EDGE_COLOUR = "#5A6B7B"
# Colours of the parts of a body, repeated for further parts.
PART_COLOURS = ("#B4D0EA", "#F0D3A0", "#B9DDC2", "#E2C3D9", "#D9D9A8", "#C9C3E6")
# Triangles above which edges are not drawn, because they would hide the faces.
MAX_EDGED_TRIANGLES = 6000
_MARKER_STYLE = {"ls": "", "marker": "o", "ms": 3.2, "mec": VERMILION, "mew": 0.7}
_CAMERA_POINT_STYLE = {"ls": "", "marker": ".", "ms": 2.4, "mec": "none", "mfc": BLUE}
# Largest number of drawn points of cameras; more only take longer to draw.
MAX_CAMERA_POINTS = 1000
_GRASPED_STYLE = {"ls": "", "marker": "s", "ms": 2.2, "mfc": BLACK, "mec": "none"}


def sheet(width_mm: float, height_mm: float) -> tuple[Figure, Axes]:
    """Return a figure of a size [mm] and its only axes, which are invisible and fill it; their
    coordinates are millimetres from the lower left corner.
    """
    figure = fixed_figure(width_mm, height_mm)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, width_mm), ylim=(0, height_mm))
    axes.set_axis_off()
    return figure, axes


@dataclass(frozen=True, eq=False)
class SheetView:
    """Parallel projection of a body onto the sheet, with scale and position."""

    camera: ParallelCamera  # viewing direction
    mm_per_m: float  # scale: millimetres on the sheet per metre in space
    origin_mm: Array  # (2,): position on the sheet of the origin of space

    @classmethod
    def fit_points(
        cls, camera: ParallelCamera, points_m: Array, room_mm: ArrayLike, corner_mm: ArrayLike
    ) -> SheetView:
        """Return the view that shows all points as large as possible in the middle of a box on the
        sheet.

        Parameters
        ----------
        camera : ParallelCamera
            Viewing direction.
        points_m : (…, 3)
            Points to show [m], at least one of them finite; NaN is ignored.
        room_mm, corner_mm : (2,)
            Width and height of the box, and its lower left corner.
        """
        low, high = _projected_extent(camera, points_m)
        room = np.asarray(room_mm, dtype=float)
        corner = np.asarray(corner_mm, dtype=float)
        scale = float(np.min(room / np.maximum(high - low, 1e-12)))
        return cls(camera, scale, origin_mm=corner + room / 2 - scale * (low + high) / 2)

    def to_sheet_mm(self, points_m: ArrayLike) -> Array:
        """Return the positions (…, 2) [mm] on the sheet of points (…, 3) [m]."""
        return self.origin_mm + self.mm_per_m * self.camera.project(points_m)


def aspect_ratio(camera: ParallelCamera, points_m: Array) -> float:
    """Return width over height of points (…, 3) in the picture of a camera; NaN is ignored, and the
    height must not be zero.
    """
    low, high = _projected_extent(camera, points_m)
    return float((high - low)[0] / (high - low)[1])


def _projected_extent(camera: ParallelCamera, points_m: Array) -> tuple[Array, Array]:
    """Return the corners (2,) [m] of points in a picture, without NaN."""
    places = camera.project(points_m).reshape(-1, 2)
    return np.nanmin(places, axis=0), np.nanmax(places, axis=0)


def with_nearby_outlines(points_m: Array, outlines_m: Array | None) -> Array:
    """Return the points (T, n, 3) of a body joined with the outlines (T, o, 3) of obstacles near
    it, as (T, n + o, 3).

    Outline points that are, along an axis, further from the body's bounding box at that sample than
    half of its largest side are moved to that distance along the axis; NaN stays NaN. At each
    sample one point of the body at least must not be NaN. Without outlines (None) the points alone
    are returned.
    """
    if outlines_m is None:
        return points_m
    low = np.nanmin(points_m, axis=1)
    high = np.nanmax(points_m, axis=1)
    margin = (high - low).max(axis=1, keepdims=True) / 2
    clipped_m = np.clip(outlines_m, (low - margin)[:, None], (high + margin)[:, None])
    return np.concatenate([points_m, clipped_m], axis=1)


class BodyDrawing:
    """Body with its grasped nodes and markers on a sheet, which can be updated for another sample.

    Parameters
    ----------
    axes : Axes
        Axes of a `sheet`.
    view : SheetView
        Projection onto the sheet.
    surface : (F, 3)
        Nodes of the boundary triangles.
    parts : (F,), optional
        Index of the part of the body of each triangle, which defines its colour; one part by
        default.
    face_outlines : (F, k), optional
        Nodes along the edge of each triangle, of which grasped ones are marked; the corners by
        default.
    edge_colour : str, optional
        Colour of the triangles' edges; then only these edges are drawn, above everything else.
    """

    def __init__(
        self,
        axes: Axes,
        view: SheetView,
        surface: Triangles,
        parts: NDArray[np.integer] | None = None,
        face_outlines: NDArray[np.integer] | None = None,
        edge_colour: str | None = None,
    ) -> None:
        self.view = view
        self.surface = surface
        self.edge_colour = edge_colour
        self.face_outlines = surface if face_outlines is None else face_outlines
        indices = (
            np.zeros(len(surface), dtype=np.int64) if parts is None else parts % len(PART_COLOURS)
        )
        self.part_colours = np.array([to_rgb(skin) for skin in PART_COLOURS])[indices]
        self.has_edges = len(surface) <= MAX_EDGED_TRIANGLES
        self.faces = PolyCollection(
            [], linewidths=0.3 if self.has_edges else 0.1, edgecolors=EDGE_COLOUR
        )
        self.faces.set_joinstyle("round")
        if edge_colour is not None:
            self.faces.set(facecolor="none", edgecolor=edge_colour, zorder=2.5)
            self.faces.set_linewidth(0.6 if self.has_edges else 0.1)
        axes.add_collection(self.faces, autolim=False)
        self.grasped = axes.add_line(Line2D([], [], zorder=3, **_GRASPED_STYLE))
        self.outlines = axes.add_line(Line2D([], [], zorder=0.5, lw=0.6, color=BLACK))
        self.camera_points = axes.add_line(Line2D([], [], zorder=3.5, **_CAMERA_POINT_STYLE))
        self.hidden_markers = axes.add_line(Line2D([], [], mfc="none", zorder=4, **_MARKER_STYLE))
        self.visible_markers = axes.add_line(
            Line2D([], [], mfc=VERMILION, zorder=5, **_MARKER_STYLE)
        )

    def update(
        self,
        positions_m: Array,
        is_grasped: NDArray[np.bool_],
        markers_m: Array,
        colours: Array | None = None,
        outlines_m: Array | None = None,
        camera_points_m: Array | None = None,
    ) -> None:
        """Update the drawing.

        Markers hidden by the body are drawn as rings. Grasped nodes on faces turned away are left
        out, and so are points of cameras that the body hides. A drawing with an `edge_colour`
        shows the edges alone, and uses only the positions.

        Parameters
        ----------
        positions_m : (n, 3)
            Positions of the nodes [m].
        is_grasped : (n,) bool
            Whether a node is grasped.
        markers_m : (M, 3)
            Markers [m], NaN where missing.
        colours : (F, 3), optional
            Colours of the triangles, from 0 to 1; those of their parts by default.
        outlines_m : (o, 3), optional
            Outlines of obstacles [m], NaN between lines; unchanged by default.
        camera_points_m : (P, 3), optional
            Points of cameras [m]; unchanged by default.
        """
        camera = self.view.camera
        brightness, faces = camera.visible_faces(positions_m, self.surface)
        polygons = positions_m[self.face_outlines[faces]] @ camera.axes[:2].T
        if colours is not None:
            # Colours of a field are shaded half as much, so that they can be compared.
            brightness = (1 + brightness) / 2
        unshaded = self.part_colours if colours is None else colours
        shaded: Any = brightness[:, None] * unshaded[faces]
        self.faces.set_verts(list(self.view.origin_mm + self.view.mm_per_m * polygons))
        if self.edge_colour is not None:
            return
        self.faces.set_facecolor(shaded)
        if not self.has_edges:
            self.faces.set_edgecolor(shaded)
        visible = np.unique(self.face_outlines[faces])
        self.grasped.set_data(*self.view.to_sheet_mm(positions_m[visible[is_grasped[visible]]]).T)
        if outlines_m is not None:
            self.outlines.set_data(*self.view.to_sheet_mm(outlines_m).T)
        if camera_points_m is not None:
            few_m = camera_points_m[:: 1 + len(camera_points_m) // MAX_CAMERA_POINTS]
            self.camera_points.set_data(
                *self.view.to_sheet_mm(
                    few_m[~camera.are_hidden(few_m, positions_m, surface=self.surface)]
                ).T
            )
        hidden = camera.are_hidden(markers_m, positions_m, surface=self.surface)
        self.hidden_markers.set_data(*self.view.to_sheet_mm(markers_m[hidden]).T)
        self.visible_markers.set_data(*self.view.to_sheet_mm(markers_m[~hidden]).T)


def draw_scale(axes: Axes, mm_per_m: float, corner_mm: ArrayLike, longest_mm: float = 20.0) -> None:
    """Draw a scale bar of a round length from `corner_mm` to the right, with its length beside it.

    Parameters
    ----------
    mm_per_m : float
        Scale of the view.
    corner_mm : (2,)
        Left end of the bar on the sheet [mm].
    longest_mm : float
        Largest length of the bar on the sheet [mm].
    """
    x, y = np.asarray(corner_mm, dtype=float)
    length_m = round_length(longest_mm / mm_per_m)
    end = x + length_m * mm_per_m
    axes.plot([x, end], [y, y], color=BLACK, lw=1.2, solid_capstyle="butt")
    axes.text(end + 1, y, f"{1e3 * length_m:g} mm", va="center", fontsize=SMALL_PT)


def round_length(longest: float) -> float:
    """Return the largest of 1, 2, 5 · 10ᵏ that is not above `longest`, a positive number."""
    decade = 10.0 ** np.floor(np.log10(longest))
    return float(max(f * decade for f in (1, 2, 5) if f * decade <= longest * (1 + 1e-9)))


def draw_directions(
    axes: Axes, camera: ParallelCamera, origin_mm: ArrayLike, length_mm: float = 5.0
) -> None:
    """Draw arrows of `length_mm` along x, y and z from `origin_mm` (2,) on a sheet, as the camera
    projects them; an axis nearly along the viewing direction is left out.
    """
    start = np.asarray(origin_mm, dtype=float)
    for letter, direction in zip("xyz", camera.project(np.eye(3)), strict=True):
        size = float(np.linalg.norm(direction))
        if size < 0.2:
            continue
        tip: Any = start + length_mm * direction
        arrow = {"arrowstyle": "->,head_length=0.15,head_width=0.1", "lw": 0.7, "shrinkA": 0}
        axes.annotate("", tip, tuple(start), arrowprops={**arrow, "shrinkB": 0})
        x, y = tip + 1.6 * direction / size
        axes.text(x, y, letter, ha="center", va="center", fontsize=SMALL_PT)


def legend_handles(*entries: str, camera_points: str = "") -> list[Line2D]:
    """Return legend handles of the named marks.

    Parameters
    ----------
    *entries : {"grasped", "markers", "measured", "behind the body"}
    camera_points : str
        Name of a last entry for points of cameras; none by default.
    """
    styles = {
        "grasped": {**_GRASPED_STYLE, "ms": 3.0},
        "behind the body": {**_MARKER_STYLE, "mfc": "none"},
        camera_points: {**_CAMERA_POINT_STYLE, "ms": 4.0},
    }
    return [
        Line2D([], [], label=name, **styles.get(name, {**_MARKER_STYLE, "mfc": VERMILION}))
        for name in (*entries, camera_points)
        if name
    ]


def part_legend_handle(part: int, name: str) -> Line2D:
    """Return the legend handle of the part of the body with index `part`, with the label `name`."""
    look: Any = {
        **_GRASPED_STYLE,
        "ms": 4.0,
        "mec": EDGE_COLOUR,
        "mew": 0.3,
        "mfc": PART_COLOURS[part % len(PART_COLOURS)],
    }
    return Line2D([], [], label=name, **look)


def draw_legend(axes: Axes, entries: Sequence[Line2D], corner_mm: ArrayLike) -> None:
    """Draw a legend with these entries, which have labels, in one line into the axes of a sheet;
    its upper left corner is at `corner_mm` (2,), and earlier legends stay.
    """
    names = [str(entry.get_label()) for entry in entries]
    place: Any = tuple(np.asarray(corner_mm))
    box = Legend(
        axes, list(entries), names, loc="upper left", bbox_to_anchor=place,
        bbox_transform=axes.transData, ncols=len(entries), fontsize=SMALL_PT, frameon=False,
        handletextpad=0.0, columnspacing=0.8, borderaxespad=0.0, borderpad=0.0,
    )  # fmt: skip
    axes.add_artist(box)


Triangles = NDArray[np.integer]

# Angle between the view and the normal of the plane of motion, to show its third axis.
AZIMUTH_DEG = 25.0
# Angle by which the view looks down.
ELEVATION_DEG = 18.0
# Brightness of a face turned away from the light.
AMBIENT_BRIGHTNESS = 0.62
# Direction towards the light in the axes of the camera.
LIGHT_DIRECTION = np.array([-0.4, 0.5, 0.8]) / np.linalg.norm([-0.4, 0.5, 0.8])


@dataclass(frozen=True, eq=False)
class ParallelCamera:
    """Parallel projection along a viewing direction."""

    # (3, 3): orthonormal rows in the world: right and top of the picture, and towards the viewer.
    axes: Array

    @classmethod
    def from_direction(cls, direction: ArrayLike, up: ArrayLike) -> ParallelCamera:
        """Return the camera that is in the direction `direction` (3,) from the body, with `up` (3,)
        upright.

        Neither vector needs to have unit length; they must not be parallel.
        """
        direction = np.asarray(direction, dtype=float)
        direction = direction / np.linalg.norm(direction)
        right = np.cross(np.asarray(up, dtype=float), direction)
        right /= np.linalg.norm(right)
        return cls(np.array([right, np.cross(direction, right), direction]))

    @classmethod
    def facing_motion(cls, positions_m: Array, up: ArrayLike) -> ParallelCamera:
        """Return a camera that faces the plane in which a body moves most, or is widest.

        The direction is horizontal, then turned by `AZIMUTH_DEG` and raised by `ELEVATION_DEG`.

        Parameters
        ----------
        positions_m : (T, n, 3)
            Finite positions of its nodes.
        up : (3,)
            Unit vector against gravity.
        """
        up = np.asarray(up, dtype=float)
        level = np.linalg.svd(up[None])[2][1:]
        motion = (positions_m - positions_m.mean(axis=0)) @ level.T
        extent = (positions_m[0] - positions_m[0].mean(axis=0)) @ level.T
        # A body hardly moving is seen from its broad side.
        spread = sum(np.einsum("ki,kj->ij", d, d) / len(d) for d in (motion.reshape(-1, 2), extent))
        least = np.linalg.eigh(spread)[1][:, 0] @ level
        # Of the two opposite directions the one nearer to +x, −y.
        if least @ (1.0, -1.1, 0.01) < 0:
            least = -least
        return cls.from_direction(least, up).turned(AZIMUTH_DEG, up).raised(ELEVATION_DEG)

    def turned(self, angle_deg: float, up: ArrayLike) -> ParallelCamera:
        """Return the camera moved around the body by an angle [°] about `up` (3,), a unit vector;
        counter-clockwise as seen from above.
        """
        turn = Rotation.from_rotvec(np.radians(angle_deg) * np.asarray(up, dtype=float))
        return ParallelCamera(turn.apply(self.axes))

    def raised(self, angle_deg: float) -> ParallelCamera:
        """Return the camera raised by an angle [°]; negative to look from further below."""
        angle = np.radians(angle_deg)
        right, top, forward = self.axes
        direction = np.cos(angle) * forward + np.sin(angle) * top
        return ParallelCamera(np.array([right, np.cross(direction, right), direction]))

    def project(self, points_m: ArrayLike) -> Array:
        """Return the positions (…, 2) [m] in the picture of points (…, 3) [m]."""
        return np.asarray(points_m) @ self.axes[:2].T

    def coordinates_to_viewer_m(self, points_m: ArrayLike) -> Array:
        """Return the coordinate (…) [m] of points (…, 3) [m] towards the viewer."""
        return np.asarray(points_m) @ self.axes[2]

    def visible_faces(
        self, positions_m: Array, surface: Triangles
    ) -> tuple[Array, NDArray[np.int64]]:
        """Return the triangles that are turned towards the viewer, from far to near; those that
        others hide are included: brightness (k,) up to 1, and indices (k,) in the surface.

        Parameters
        ----------
        positions_m : (n, 3)
            Positions of the nodes.
        surface : (F, 3)
            Nodes of the triangles, counter-clockwise as seen from outside.
        """
        corners = positions_m[surface] @ self.axes.T
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        front = np.flatnonzero(normals[:, 2] > 0)
        order = front[np.argsort(corners[front, :, 2].mean(axis=1), kind="stable")]
        light = np.clip(normals[order] @ LIGHT_DIRECTION, 0.0, 1.0)
        brightness = AMBIENT_BRIGHTNESS + (1 - AMBIENT_BRIGHTNESS) * light
        return brightness, order

    def are_hidden(
        self, points_m: Array, positions_m: Array, surface: Triangles
    ) -> NDArray[np.bool_]:
        """Return for each point (k, 3) whether it is behind the surface; False for NaN.

        Points less than 5 % of the body's largest dimension below the surface count as visible,
        because noise moves markers on the surface into the body.

        Parameters
        ----------
        points_m : (k, 3)
            Points [m]; NaN where missing.
        positions_m : (n, 3)
            Positions of the nodes.
        surface : (F, 3)
            Nodes of the boundary triangles.
        """
        corners = positions_m[surface] @ self.axes.T
        points = np.asarray(points_m) @ self.axes.T
        size = np.ptp(positions_m, axis=0).max()
        a, b, c = (corners[:, i, :2] for i in range(3))
        area = _plane_cross_product(b - a, c - a)
        facing = area > 1e-9 * size**2
        a = a[facing]
        b = b[facing]
        c = c[facing]
        area = area[facing]
        to_viewer = corners[facing, :, 2]
        behind = np.zeros(len(points), dtype=bool)
        for k, point in enumerate(points):
            place = point[:2]
            opposite_a = _plane_cross_product(b - place, c - place)
            opposite_b = _plane_cross_product(c - place, a - place)
            weights = np.stack([opposite_a, opposite_b], axis=1) / area[:, None]
            weights = np.column_stack([weights, 1 - weights.sum(axis=1)])
            is_inside = (weights >= 0).all(axis=1)
            surface_coordinate = np.einsum("kc,kc->k", weights[is_inside], to_viewer[is_inside])
            # A marker on the surface, or a noise's breadth below, is not hidden by it.
            behind[k] = bool((surface_coordinate > point[2] + 0.05 * size).any())
        return behind


def _plane_cross_product(a: Array, b: Array) -> Array:
    """Return the cross product (…) of vectors in the plane (…, 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
