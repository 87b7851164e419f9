"""What a depth camera saw over the surface of the body, and how far they are apart."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ...arrays import Array
from ..style import PAGE_MM, SMALL_PT, VERMILION

MM_PER_INCH = 25.4
# No panel is wider than this share of the page; titles are so high, and panels between these.
WIDEST, TITLES, HIGH = 0.6, 0.4, (0.3, 1.0)
# Lines are of one point for so many rows of outlines, and thinner for more.
FACES = 600
# Points cover about this share of where they lie.
COVERED = 0.3
# The scale ends where this share of the points does.
SHOWN = 95
# Outlines are shown so far beyond the points, in sizes of what these cover.
BEYOND = 0.5


def depth_picture(seen: Array) -> Figure:
    """Draw an image and the outlines of the surface over it, and below it how far they are apart.

    Of several samples those that have outlines are shown. Without a fit there is nothing below;
    where no point counts only that is said.

    Parameters
    ----------
    seen : (k, 8) see `Replay.seen`
    """
    times = np.unique(seen[np.isnan(seen[:, 3]), 0])
    points = seen[np.isfinite(seen[:, 3])]
    if not len(points):
        return _sentence("no point is near enough to the body to count")
    fitted = bool(np.isfinite(points[:, 4]).any())
    axes, dot = _sheet(points, times, 1 + fitted)
    near, far = np.percentile(points[:, 3], [1, 99])
    depth = {"cmap": "viridis", "vmin": near, "vmax": far, "s": dot}
    end = max(1e-3, 1e3 * float(np.nanpercentile(np.abs(points[:, 4]), SHOWN))) if fitted else 1.0
    behind = {"cmap": "RdBu", "vmin": -end, "vmax": end, "s": dot}
    for column, t_s in zip(axes.T, times, strict=True):
        here = points[points[:, 0] == t_s]
        lines = seen[(seen[:, 0] == t_s) & np.isnan(seen[:, 3]), 1:3]
        image = _panel(column[0], here[:, 1:3], here[:, 3], lines, VERMILION, depth)
        scales = [(image, "depth [m]")]
        title = f"t = {t_s:.4g} s" if len(times) > 1 else ""
        column[0].set_title(title, fontsize=SMALL_PT)
        if fitted:
            used = here[np.isfinite(here[:, 4])]
            left = here[~np.isfinite(here[:, 4])]
            column[1].plot(*left[:, 1:3].T, ".", ms=1.5, color="0.7")
            apart = _panel(column[1], used[:, 1:3], 1e3 * used[:, 4], lines, "0.6", behind)
            scales.append((apart, "behind surface [mm]"))
            rms = np.sqrt(np.mean((1e3 * used[:, 4]) ** 2))
            column[1].set_title(f"{rms:.2g} mm RMS, {len(used):,} points", fontsize=SMALL_PT)
    for row, (scale, label) in zip(axes, scales, strict=True):
        bar = row[0].figure.colorbar(scale, ax=row)
        bar.set_label(label, fontsize=SMALL_PT)
        bar.ax.tick_params(labelsize=SMALL_PT, width=0.6)
        row[0].set_ylabel("v", fontsize=SMALL_PT)
    for panel in axes[-1]:
        panel.set_xlabel("u", fontsize=SMALL_PT)
    return axes[0, 0].figure


def _sentence(text: str) -> Figure:
    """What is said where there is nothing to draw."""
    figure = Figure(figsize=(WIDEST * PAGE_MM / MM_PER_INCH, TITLES), layout="constrained")
    axes = figure.subplots()
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, ha="center", va="center", fontsize=SMALL_PT)
    return figure


def _sheet(points: Array, times: Array, rows: int) -> tuple[NDArray[np.object_], float]:
    """Panels (rows, times) of the shape of what points cover, and the area of a point there."""
    inch, count = PAGE_MM / MM_PER_INCH, len(times)
    across = min(1 / count, WIDEST)
    width, height = np.ptp(points[:, 1:3], axis=0)
    panel = across * inch * float(np.clip(height / max(width, 1e-12), *HIGH)) + TITLES
    size = (max(WIDEST, across * count) * inch, panel * rows)
    dot = COVERED * (72 * across * inch) ** 2 * HIGH[0] / max(1, len(points) / count)
    return Figure(figsize=size, layout="constrained").subplots(rows, count, squeeze=False), dot


def _panel(
    axes: Axes, places: Array, values: Array, lines: Array, colour: str, looks: dict[str, Any]
) -> PathCollection:
    """Points and outlines; what of these is far from all points is cut off."""
    drawn = axes.scatter(*places.T, c=values, linewidths=0, zorder=1, **looks)
    # Of more faces thinner ones, or these would hide the points.
    thin = min(0.5, FACES / max(1, len(lines)))
    axes.plot(*lines.T, color=colour, linewidth=thin, zorder=2)
    low, high = places.min(axis=0), places.max(axis=0)
    room = BEYOND * (high - low).max()
    both = np.vstack([places, lines[np.isfinite(lines).all(axis=1)]])
    low, high = np.maximum(both.min(axis=0), low - room), np.minimum(both.max(axis=0), high + room)
    margin = 0.03 * (high - low).max()
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(high[1] + margin, low[1] - margin))
    axes.set(aspect="equal")
    axes.tick_params(labelsize=SMALL_PT, width=0.6)
    if not ((lines >= low) & (lines <= high)).all(axis=1).any():
        axes.text(0.5, 0.02, "the body is not in view", transform=axes.transAxes, ha="center")
    return drawn
