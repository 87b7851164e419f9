"""A strip of the body's shapes over time, with the measured markers."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from ...arrays import Array
from ..style import PAGE_MM, SMALL_PT
from .camera import Camera, Triangles
from .scene import (
    Drawn,
    View,
    draw_directions,
    draw_key,
    draw_scale,
    key,
    sheet,
)

SHOWN = 6
HEAD_MM, FOOT_MM, CORNER_MM = 5.0, 5.0, 14.0
TALLEST_MM, GAP_MM = 60.0, 4.0


def shapes(
    t_s: Array,
    positions_m: Array,
    surface: Triangles,
    held: NDArray[np.bool_],
    measured_m: Array,
    up: ArrayLike = (0.0, 0.0, 1.0),
    count: int = SHOWN,
    surface_nodes: NDArray[np.integer] | None = None,
) -> Figure:
    """Draw the body at evenly spaced samples, side by side in one scale.

    Heights are true; sideways the shapes are moved together.

    Parameters
    ----------
    t_s : (T,)
    positions_m : (T, n, 3)
        Samples of a simulation that went astray, which are not finite, are left out.
    surface : (F, 3)
    held : (T, n) bool, grasped nodes
    measured_m : (T, M, 3) NaN where missing
    up : (3,)
    count : int
        How many shapes.
    surface_nodes : (F, k), optional
        The nodes of each triangle, its corners by default.
    """
    there = np.flatnonzero(np.isfinite(positions_m).all(axis=(1, 2)))
    shown = there[np.unique(np.linspace(0, len(there) - 1, count).astype(int))]
    outer = positions_m[:, np.unique(surface)]
    camera = Camera.facing(outer[there], up)
    places = camera.project(np.concatenate([outer[shown], measured_m[shown]], axis=1))
    left, right = np.nanmin(places[..., 0], axis=1), np.nanmax(places[..., 0], axis=1)
    low, high = float(np.nanmin(places[..., 1])), float(np.nanmax(places[..., 1]))
    room = PAGE_MM - CORNER_MM - len(shown) * GAP_MM
    scale = min(room / float((right - left).sum()), TALLEST_MM / (high - low))
    gap = GAP_MM + (room - scale * float((right - left).sum())) / len(shown)
    total = HEAD_MM + scale * (high - low) + FOOT_MM
    figure, axes = sheet(PAGE_MM, total)
    start = CORNER_MM
    for t, first, last in zip(shown, left, right, strict=True):
        view = View(camera, scale, np.array([start - scale * first, FOOT_MM - scale * low]))
        Drawn(axes, view, surface, nodes=surface_nodes).show(positions_m[t], held[t], measured_m[t])
        text = {"ha": "center", "va": "center", "fontsize": SMALL_PT}
        middle = start + scale * (last - first) / 2
        axes.text(middle, FOOT_MM / 2, f"{t_s[t] - t_s[0]:.3g} s", **text)
        start += scale * (last - first) + gap
    draw_directions(axes, camera, (6.0, FOOT_MM + 3.0))
    draw_scale(axes, scale, (2.0, total - 2.5))
    draw_key(axes, key("grasped", "measured", "behind the body"), (PAGE_MM * 0.3, total - 1.0))
    return figure
