"""The undeformed mesh with its grasped nodes and markers, from two opposite sides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

from ...arrays import Array
from ..style import BLUE, COLUMN_MM, SMALL_PT
from .camera import ELEVATION_DEG, Camera, Triangles
from .scene import (
    Drawn,
    View,
    draw_directions,
    draw_key,
    draw_scale,
    key,
    sheet,
    skin_key,
    width_over_height,
)

# More names than this would be a list, not a picture.
MOST_NAMES = 24
HEAD_MM, FOOT_MM, GAP_MM, LINE_MM, LETTER_MM = 6.0, 14.0, 3.0, 3.2, 1.4
TALLEST_MM = 70.0
# A way between two places that is shorter on paper would hide below their marks.
SEEN_MM = 0.4
GIVEN, UNKNOWN = "place given", "no place given"
TENDON = "tendons"
LOOKS: dict[str, dict[str, Any]] = {
    GIVEN: {"ls": "", "marker": "x", "ms": 3.2, "mec": BLUE, "mew": 0.8},
    TENDON: {"color": BLUE, "lw": 1.0, "marker": ".", "ms": 2.0},
    UNKNOWN: {"ls": "", "marker": "s", "ms": 5.0, "mfc": "none", "mec": BLUE, "mew": 0.6},
}


def mesh_picture(
    nodes_m: Array,
    surface: Triangles,
    held: NDArray[np.bool_],
    places_m: Array,
    names: Sequence[str],
    up: ArrayLike = (0.0, 0.0, 1.0),
    parts: NDArray[np.integer] | None = None,
    part_names: Sequence[str] = (),
    given_m: Array | None = None,
    surface_nodes: NDArray[np.integer] | None = None,
    tendons_m: Array | None = None,
) -> Figure:
    """Draw the undeformed body from the front and from behind, with its markers' names.

    Parameters
    ----------
    nodes_m : (n, 3)
    surface : (F, 3)
    held : (n,) bool, nodes that are grasped at any time
    places_m : (M, 3) of the markers
    names : (M,) str
    up : (3,)
    parts : (F,) the part of the body that each triangle belongs to
    part_names : (P,) str
    given_m : (M, 3), optional
        The places that were given for the markers, NaN where there was none: a cross where a
        marker was found elsewhere, and a frame about a marker without.
    surface_nodes : (F, k), optional
        The nodes of each triangle, its corners by default.
    tendons_m : (p, 3), optional
        Points of the tendons, a row of NaN after each; they are drawn through the body.
    """
    given_m = places_m if given_m is None else given_m
    front = Camera.facing(nodes_m[None], up)
    behind = front.raised(-ELEVATION_DEG).turned(180.0, up).raised(ELEVATION_DEG)
    everything = np.vstack([nodes_m, places_m, given_m])
    aspect = width_over_height(front, everything)
    named = 0 < len(names) <= MOST_NAMES
    margin = min(26.0, 4.0 + LETTER_MM * max(map(len, names))) if named else 2.0
    beside = aspect < 1.0
    room = COLUMN_MM - 2 * margin
    width = (room - GAP_MM) / 2 if beside else room
    height = min(width / aspect, TALLEST_MM / (1 if beside else 2))
    elsewhere = not np.array_equal(given_m, places_m)
    marked = elsewhere or tendons_m is not None
    head = HEAD_MM + LINE_MM * ((len(part_names) > 1) + marked)
    total = head + FOOT_MM + (height if beside else 2 * height + GAP_MM)
    figure, axes = sheet(COLUMN_MM, total)
    corners = (
        (margin, total - head - height),
        (margin + width + GAP_MM, FOOT_MM) if beside else (margin, FOOT_MM),
    )
    first = _seen_first(front, behind, places_m, nodes_m, surface)
    views, unlike = [], set[str]()
    for camera, corner, mine in zip((front, behind), corners, (first, ~first), strict=True):
        view = View.fitting(camera, everything, (width, height), corner)
        Drawn(axes, view, surface, parts, surface_nodes).show(nodes_m, held, places_m)
        unlike |= _draw_given(axes, view, places_m, given_m)
        if tendons_m is not None:
            axes.plot(*view.places(tendons_m).T, zorder=5.5, **LOOKS[TENDON])
            unlike.add(TENDON)
        if named:
            dots = view.places(places_m[mine])
            own = [name for name, here in zip(names, mine, strict=True) if here]
            _write_names(axes, dots, own, COLUMN_MM / 2, (margin - 1, COLUMN_MM - margin + 1))
        views.append(view)
    for view, x in zip(views, (0.15, 0.85), strict=True):
        draw_directions(axes, view.camera, (COLUMN_MM * x, 5.0), 4.5)
    draw_scale(axes, views[0].mm_per_m, (COLUMN_MM / 2 - 12, 4.0), 15.0)
    entries = ["grasped"] if held.any() else []
    entries += ["markers", "behind the body"] if len(names) else []
    lines = [key(*entries), [Line2D([], [], label=w, **LOOKS[w]) for w in sorted(unlike)]]
    if len(part_names) > 1:
        lines.append([skin_key(k, name or "rest") for k, name in enumerate(part_names)])
    for k, handles in enumerate(filter(None, lines)):
        draw_key(axes, handles, (1.0, total - 1.5 - k * LINE_MM))
    return figure


def _draw_given(axes: Axes, view: View, places_m: Array, given_m: Array) -> set[str]:
    """Mark markers that are not where they were given, or were not given; what was drawn."""
    found, given, drawn = view.places(places_m), view.places(given_m), set[str]()
    unknown = np.isnan(given_m[:, 0])
    moved = np.linalg.norm(found - given, axis=1) > SEEN_MM  # False for NaN
    if unknown.any():
        axes.plot(*found[unknown].T, zorder=6, **LOOKS[UNKNOWN])
        drawn.add(UNKNOWN)
    if moved.any():
        axes.plot(*given[moved].T, zorder=6, **LOOKS[GIVEN])
        ways = np.stack([given[moved], found[moved]], axis=1)
        axes.add_collection(LineCollection(list(ways), colors=BLUE, linewidths=0.5, zorder=6))
        drawn.add(GIVEN)
    return drawn


def _seen_first(
    front: Camera, behind: Camera, places_m: Array, nodes_m: Array, surface: Triangles
) -> NDArray[np.bool_]:
    """Which markers are to be named in the front view."""
    hidden = [camera.hidden(places_m, nodes_m, surface) for camera in (front, behind)]
    nearer = front.nearness(places_m) >= front.nearness(nodes_m).mean()
    return np.where(hidden[0] == hidden[1], nearer, ~hidden[0])


def _write_names(
    axes: Axes,
    dots: Array,
    names: Sequence[str],
    middle: float,
    edges: tuple[float, float],
) -> None:
    """Write names in the margins, level with their markers but apart, with a line to each."""
    on_left = dots[:, 0] < middle
    for edge, members, align in zip(
        edges, (np.flatnonzero(on_left), np.flatnonzero(~on_left)), ("right", "left"), strict=True
    ):
        members = members[np.argsort(dots[members, 1])]
        for m, level in zip(members, apart(dots[members, 1], LINE_MM), strict=True):
            inner = edge + (1.5 if align == "right" else -1.5)
            line = ([dots[m, 0], inner, edge], [dots[m, 1], level, level])
            axes.plot(*line, color="#707070", lw=0.4, zorder=3.5)
            text: dict[str, Any] = {"ha": align, "va": "center_baseline", "fontsize": SMALL_PT}
            axes.text(edge + (-0.5 if align == "right" else 0.5), level, names[int(m)], **text)


def apart(levels: Array, gap: float) -> Array:
    """Ascending levels, moved as little as leaves `gap` between them."""
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
