"""Pictures of the undeformed mesh: grasped nodes, markers from two sides, element quality."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from ...common.array_types import Array
from ...fem.meshes.checks import edge_lengths, mean_ratios
from ..figure_style import BLUE, COLUMN_MM, SMALL_PT, VERMILION, framed_figure, style_axes
from ..replay import MotionRecord
from .scene import (
    ELEVATION_DEG,
    BodyDrawing,
    ParallelCamera,
    SheetView,
    Triangles,
    aspect_ratio,
    draw_directions,
    draw_legend,
    draw_scale,
    legend_handles,
    part_legend_handle,
    sheet,
)

# Largest number of markers whose names are written.
MAX_WRITTEN_NAMES = 24
# Height of the titles [mm].
HEAD_MM = 6.0
# Height of directions, scale and legend below the body [mm].
FOOT_MM = 14.0
# Distance between two views [mm].
GAP_MM = 3.0
# Height of a line of text [mm].
LINE_MM = 3.2
# Mean width of a letter [mm].
LETTER_MM = 1.4
# Largest height of a view [mm], so that two fit on a page.
MAX_BODY_HEIGHT_MM = 70.0
# Shortest distance on paper at which two marks are drawn apart [mm]; nearer ones overlap.
MIN_MARK_DISTANCE_MM = 0.4
DECLARED_POSITION = "position given"
UNSTATED_PLACE = "position not given"
TENDON = "tendons"
MARK_STYLES: dict[str, dict[str, Any]] = {
    DECLARED_POSITION: {"ls": "", "marker": "x", "ms": 3.2, "mec": BLUE, "mew": 0.8},
    TENDON: {"color": BLUE, "lw": 1.0, "marker": ".", "ms": 2.0},
    UNSTATED_PLACE: {"ls": "", "marker": "s", "ms": 5.0, "mfc": "none", "mec": BLUE, "mew": 0.6},
}


def mesh_picture(replay: MotionRecord) -> Figure:
    """Return a figure of the undeformed body from the front and from behind, with grasped nodes,
    markers and their names, if there are at most `MAX_WRITTEN_NAMES`.

    Tendons are drawn through the body. A cross is the stated place of a marker whose estimated
    place differs; a frame surrounds a marker whose place was not stated.

    Parameters
    ----------
    replay : MotionRecord
        Experiment with a mesh; a node counts as grasped if it is at any sample.
    """
    nodes_m = replay.undeformed_m
    surface = replay.surface
    up = replay.up
    names = replay.marker_names
    places_m = replay.marker_places_m
    declared_m = replay.declared_places_m
    is_grasped = np.asarray(replay.is_prescribed.any(axis=0))
    part_names = replay.part_names
    front = ParallelCamera.facing_motion(nodes_m[None], up)
    behind = front.raised(-ELEVATION_DEG).turned(180.0, up).raised(ELEVATION_DEG)
    everything = np.vstack([nodes_m, places_m, declared_m])
    aspect = aspect_ratio(front, everything)
    named = 0 < len(names) <= MAX_WRITTEN_NAMES
    margin = min(26.0, 4.0 + LETTER_MM * max(map(len, names))) if named else 2.0
    is_side_by_side = aspect < 1.0
    room = COLUMN_MM - 2 * margin
    width = (room - GAP_MM) / 2 if is_side_by_side else room
    height = min(width / aspect, MAX_BODY_HEIGHT_MM / (1 if is_side_by_side else 2))
    elsewhere = not np.array_equal(declared_m, places_m)
    marked = elsewhere or replay.tendons_m is not None
    head = HEAD_MM + LINE_MM * ((len(part_names) > 1) + marked)
    total = head + FOOT_MM + (height if is_side_by_side else 2 * height + GAP_MM)
    figure, axes = sheet(COLUMN_MM, total)
    corners = (
        (margin, total - head - height),
        (margin + width + GAP_MM, FOOT_MM) if is_side_by_side else (margin, FOOT_MM),
    )
    first = _are_named_in_front(front, behind, places_m=places_m, nodes_m=nodes_m, surface=surface)
    views = []
    marks = set[str]()
    for camera, corner, mine in zip((front, behind), corners, (first, ~first), strict=True):
        view = SheetView.fit_points(camera, everything, room_mm=(width, height), corner_mm=corner)
        BodyDrawing(
            axes,
            view,
            surface=surface,
            parts=replay.surface_parts,
            face_outlines=replay.face_outlines,
        ).update(nodes_m, is_grasped, markers_m=places_m)
        marks |= _draw_declared_positions(axes, view, places_m=places_m, declared_m=declared_m)
        if replay.tendons_m is not None:
            axes.plot(*view.to_sheet_mm(replay.tendons_m).T, zorder=5.5, **MARK_STYLES[TENDON])
            marks.add(TENDON)
        if named:
            dots = view.to_sheet_mm(places_m[mine])
            own = [name for name, here in zip(names, mine, strict=True) if here]
            _write_names(
                axes,
                dots,
                names=own,
                middle=COLUMN_MM / 2,
                edges=(margin - 1, COLUMN_MM - margin + 1),
            )
        views.append(view)
    for view, x in zip(views, (0.15, 0.85), strict=True):
        draw_directions(axes, view.camera, origin_mm=(COLUMN_MM * x, 5.0), length_mm=4.5)
    draw_scale(axes, views[0].mm_per_m, corner_mm=(COLUMN_MM / 2 - 12, 4.0), longest_mm=15.0)
    lines = _legend_lines(replay, marks)
    for k, handles in enumerate(lines):
        draw_legend(axes, handles, corner_mm=(1.0, total - 1.5 - k * LINE_MM))
    return figure


def _legend_lines(replay: MotionRecord, marks: set[str]) -> list[list[Line2D]]:
    """Return non-empty lines; `marks` are the keys of `MARK_STYLES` that were drawn."""
    entries = ["grasped"] if replay.is_prescribed.any() else []
    if len(replay.marker_names):
        entries += ["markers", "behind the body"]
    lines = [
        legend_handles(*entries),
        [Line2D([], [], label=name, **MARK_STYLES[name]) for name in sorted(marks)],
    ]
    if len(replay.part_names) > 1:
        lines.append(
            [part_legend_handle(k, name or "rest") for k, name in enumerate(replay.part_names)]
        )
    return [handles for handles in lines if handles]


def _draw_declared_positions(
    axes: Axes, view: SheetView, places_m: Array, declared_m: Array
) -> set[str]:
    estimated_mm = view.to_sheet_mm(places_m)
    declared_mm = view.to_sheet_mm(declared_m)
    drawn = set[str]()
    unknown = np.isnan(declared_m[:, 0])
    moved = (
        np.linalg.norm(estimated_mm - declared_mm, axis=1) > MIN_MARK_DISTANCE_MM
    )  # False for NaN
    if unknown.any():
        axes.plot(*estimated_mm[unknown].T, zorder=6, **MARK_STYLES[UNSTATED_PLACE])
        drawn.add(UNSTATED_PLACE)
    if moved.any():
        axes.plot(*declared_mm[moved].T, zorder=6, **MARK_STYLES[DECLARED_POSITION])
        segments = np.stack([declared_mm[moved], estimated_mm[moved]], axis=1)
        axes.add_collection(LineCollection(list(segments), colors=BLUE, linewidths=0.5, zorder=6))
        drawn.add(DECLARED_POSITION)
    return drawn


def _are_named_in_front(
    front: ParallelCamera,
    behind: ParallelCamera,
    places_m: Array,
    nodes_m: Array,
    surface: Triangles,
) -> NDArray[np.bool_]:
    """Return (M,): the view in which the marker is not hidden, or else the nearer one."""
    hidden = [camera.are_hidden(places_m, nodes_m, surface=surface) for camera in (front, behind)]
    is_in_front = (
        front.coordinates_to_viewer_m(places_m) >= front.coordinates_to_viewer_m(nodes_m).mean()
    )
    return np.where(hidden[0] == hidden[1], is_in_front, ~hidden[0])


def _write_names(
    axes: Axes, dots: Array, names: Sequence[str], middle: float, edges: tuple[float, float]
) -> None:
    """Write names in the margins, level with their markers, without overlap."""
    on_left = dots[:, 0] < middle
    for edge, members, align in zip(
        edges, (np.flatnonzero(on_left), np.flatnonzero(~on_left)), ("right", "left"), strict=True
    ):
        members = members[np.argsort(dots[members, 1])]
        for m, level in zip(members, spread_levels(dots[members, 1], LINE_MM), strict=True):
            inner = edge + (1.5 if align == "right" else -1.5)
            axes.plot(
                [dots[m, 0], inner, edge], [dots[m, 1], level, level], color="#707070", lw=0.4,
                zorder=3.5,
            )  # fmt: skip
            text: dict[str, Any] = {"ha": align, "va": "center_baseline", "fontsize": SMALL_PT}
            axes.text(edge + (-0.5 if align == "right" else 0.5), level, names[int(m)], **text)


def spread_levels(levels: Array, gap: float) -> Array:
    """Return ascending levels (k,), moved as little as possible (least squares) to be at least
    `gap` from each other; the given levels must be ascending.
    """
    steps = gap * np.arange(len(levels))
    # The nearest ascending sequence to levels − steps: neighbours out of order share their mean.
    blocks: list[list[float]] = []
    for value in levels - steps:
        blocks.append([value])
        while len(blocks) > 1 and np.mean(blocks[-2]) > np.mean(blocks[-1]):
            last = blocks.pop()
            blocks[-1] += last
    means = [np.full(len(block), np.mean(block)) for block in blocks]
    return np.concatenate([*means, np.zeros(0)]) + steps


# Bins of a histogram in half a column: 1.5 mm each.
HISTOGRAM_BINS = 24


def elements_picture(nodes_m: Array, tetrahedra: NDArray[np.integer]) -> Figure:
    """Return a figure with histograms of the size and the quality of the elements.

    The size is the root mean square edge, the quality the mean ratio 12 (3V)^(2/3) / Σ l², which is
    1 for the regular tetrahedron and near 0 for a flat one.

    Parameters
    ----------
    nodes_m : (n, 3)
        Nodes of the undeformed body.
    tetrahedra : (E, 4)
        Corner nodes of the elements.
    """
    quality = np.minimum(mean_ratios(nodes_m, tetrahedra), 1.0)  # rounding
    size_mm = 1e3 * np.sqrt((edge_lengths(nodes_m, tetrahedra) ** 2).mean(axis=1))
    figure = framed_figure(COLUMN_MM, 42, left_mm=13, right_mm=2, foot_mm=9.5, top_mm=5.5)
    size_axes, quality_axes = figure.subplots(1, 2, sharey=True, gridspec_kw={"wspace": 0.08})
    widest = float(size_mm.max())
    spread = np.ptp(size_mm) > 0.02 * widest
    limits = (float(size_mm.min()), widest) if spread else (0.9 * widest, 1.1 * widest)
    size_axes.hist(size_mm, HISTOGRAM_BINS, range=limits, color=BLUE)
    quality_axes.hist(quality, HISTOGRAM_BINS, range=(0.0, 1.0), color=BLUE)
    worst = float(quality.min())
    quality_axes.axvline(worst, color=VERMILION, lw=1.0)
    style_axes(size_axes, f"{len(tetrahedra)} elements", xlabel="size [mm]", ylabel="elements")
    style_axes(quality_axes, f"worst {worst:.2f}", xlabel="quality, 1 = regular")
    quality_axes.title.set_color(VERMILION)
    for axes in (size_axes, quality_axes):
        axes.grid(False, axis="x")
        axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    size_axes.xaxis.set_major_locator(MaxNLocator(4))
    quality_axes.set_xticks((0.0, 0.5, 1.0))
    return figure
