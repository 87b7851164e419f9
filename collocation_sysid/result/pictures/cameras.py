"""Points of a depth camera over outlines of the body's surface, and their distances from the
surface; edges of masks and contours of the body.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ...common.array_types import Array
from ..figure_style import BLACK, BLUE, PAGE_MM, SMALL_PT, VERMILION
from ..replay import MotionRecord, first_and_worst_images, image_key
from .scene import round_length

# Beginnings of the names of pictures.
KIND = "depth"
OUTLINE_KIND = "outline"
TRACKS_KIND = "image"
# Length of the longest arrow of an error, as a share of the extent of the points.
ARROW_SHARE = 0.12
# Share of the extent of the points that is shown beside them.
TRACKS_MARGIN = 0.08
# Name of the points in the legend of a film.
LEGEND_ENTRY = "depth image"
# Millimetres in an inch, the unit of lengths in Matplotlib.
MM_PER_INCH = 25.4
# Largest width of a panel, as a share of the page.
MAX_PANEL_SHARE = 0.6
# Height of a title [inch].
TITLE_HEIGHT_INCH = 0.4
# Smallest and largest height of a panel over its width.
PANEL_ASPECT_LIMITS = (0.3, 1.0)
# Rows of outlines above which lines are thinner than 1 pt.
THICK_LINE_ROWS = 600
# Share of the area of the points that their dots cover.
COVERED_SHARE = 0.3
# Percentile of the distances at which the colour scale ends.
SCALE_PERCENTILE = 95
# Distance from the points up to which outlines are shown, over the extent of the points.
OUTLINE_MARGIN = 0.5


def camera_pictures(replay: MotionRecord) -> Iterator[tuple[str, Figure]]:
    """Yield name and picture of the images of each camera, named "depth_<experiment>_<camera>",
    "outline_<experiment>_<camera>" for masks, or "image_<experiment>_<camera>" for tracks.
    """
    for name, rows in replay.visible_points.items():
        unit = replay.reading_units.get(image_key(name), "")
        yield f"{KIND}_{replay.name}_{name}", depth_picture(rows, unit)
    for name, rows in replay.outlines.items():
        if is_of_tracks(rows) and name in replay.readings:
            yield f"{TRACKS_KIND}_{replay.name}_{name}", tracks_picture(rows, replay.readings[name])
        else:
            yield f"{OUTLINE_KIND}_{replay.name}_{name}", outline_picture(rows)


def is_of_tracks(rows: Array | None) -> bool:
    """Return whether rows of `MotionRecord.outlines` are contours alone, as those of tracks."""
    return rows is not None and {*rows[:, 1].tolist()} == {1.0}


def tracks_picture(rows: Array, samples: Array) -> Figure:
    """Return a figure of the first and of the worst image of a camera: tracks of the points up to
    its time, fitted contour of the body, measured points, and enlarged errors of the fit as arrows.

    Parameters
    ----------
    rows : (k, 4) array
        Contours, see `MotionRecord.outlines`.
    samples : (S, 1 + 3m) array
        Times, and pixel coordinates as measured, fitted and simulated.
    """
    images = first_and_worst_images(samples)
    if not images:
        return _sentence_figure("no image has a point")
    t_s = samples[:, 0]
    measured, fitted, simulated = (
        part.reshape(len(samples), -1, 2) for part in np.split(samples[:, 1:], 3, axis=1)
    )
    model = fitted if np.isfinite(fitted).any() else simulated
    errors = model - measured
    low, high = np.nanmin(measured, axis=(0, 1)), np.nanmax(measured, axis=(0, 1))
    lines = rows[:, 2:][np.isfinite(rows[:, 2:]).all(axis=1)]
    if len(lines):
        low, high = np.minimum(low, lines.min(axis=0)), np.maximum(high, lines.max(axis=0))
    extent = float(max(*(high - low), 1.0))
    largest = float(np.nanmax(np.abs(errors[images]), initial=0.0))
    factor = max(1.0, round_length(ARROW_SHARE * extent / largest)) if largest else 1.0
    room = TRACKS_MARGIN * extent
    shown = np.pad(np.array([low - room, high + room]), ((0, 0), (1, 0)))
    axes, _ = _new_panels(shown, np.array(images), rows=1)
    for number, (panel, k) in enumerate(zip(axes[0], images, strict=True)):
        for point in range(measured.shape[1]):
            panel.plot(*measured[: k + 1, point].T, color="0.75", lw=0.8, zorder=1)
        contour = rows[rows[:, 0] == t_s[k], 2:]
        panel.plot(*contour.T, color=VERMILION, lw=0.8, zorder=2, label="fitted contour")
        panel.plot(*measured[k].T, "o", ms=2.5, color=BLACK, zorder=3, label="measured")
        known = np.isfinite(errors[k]).all(axis=1)
        panel.quiver(
            *measured[k, known].T, *(factor * errors[k, known]).T, color=BLUE, zorder=4,
            angles="xy", scale_units="xy", scale=1, width=0.006, label=f"error of the fit × {factor:g}",
        )  # fmt: skip
        rms = float(np.sqrt(np.mean(errors[k, known] ** 2))) if known.any() else np.nan
        which = "first" if number == 0 else "worst"
        which = "first and worst" if len(images) == 1 and known.any() else which
        panel.set_title(f"{which} image, t = {t_s[k]:.4g} s: {rms:.2g} px RMS", fontsize=SMALL_PT)
        panel.set(xlim=(low[0] - room, high[0] + room), ylim=(high[1] + room, low[1] - room))
        panel.set(aspect="equal")
        panel.tick_params(labelsize=SMALL_PT, width=0.6)
        panel.set_xlabel("u [px]", fontsize=SMALL_PT)
    axes[0, 0].set_ylabel("v [px]", fontsize=SMALL_PT)
    figure = axes[0, 0].figure
    figure.set_figheight(figure.get_figheight() + TITLE_HEIGHT_INCH)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=3, fontsize=SMALL_PT, frameon=False
    )
    return figure


def outline_picture(rows: Array) -> Figure:
    """Return a figure of the edges of masks (grey) and the contour of the body (red), side by side
    for all images; `rows` (k, 4) are those of `MotionRecord.outlines`.
    """
    times = np.unique(rows[:, 0])
    if not len(times):
        return _sentence_figure("no image has a mask")
    axes, dot = _new_panels(rows[:, [0, 2, 3]], times, rows=1)
    for panel, t_s in zip(axes[0], times, strict=True):
        here = rows[rows[:, 0] == t_s]
        for kind, colour in enumerate(("0.6", VERMILION)):
            pixels = here[here[:, 1] == kind, 2:]
            panel.scatter(*pixels.T, s=dot * (1 + kind), color=colour, linewidths=0)
        panel.invert_yaxis()
        panel.set(aspect="equal", title=f"t = {t_s:.4g} s" if len(times) > 1 else "")
        panel.title.set_fontsize(SMALL_PT)
        panel.tick_params(labelsize=SMALL_PT, width=0.6)
        panel.set_xlabel("u [px]", fontsize=SMALL_PT)
    axes[0, 0].set_ylabel("v [px]", fontsize=SMALL_PT)
    return axes[0, 0].figure


def depth_picture(rows: Array, unit: str = "") -> Figure:
    """Return a figure of depth images with outlines of the surface, and below them of the distances
    from the surface.

    The samples that have outlines are shown side by side. Without a fit there is no second row;
    without any point, the picture has only a sentence that none is near enough to the body to be
    compared. Points whose distance is NaN are grey in the second row.

    Parameters
    ----------
    rows : (k, 8)
        Rows of `MotionRecord.visible_points`; if it has points, also the outlines of at least one
        sample.
    unit : str
        Unit of the image coordinates; not written if empty.
    """
    times = np.unique(rows[np.isnan(rows[:, 3]), 0])
    points = rows[np.isfinite(rows[:, 3])]
    if not len(points):
        return _sentence_figure("no point is near enough to the body to be compared")
    fitted = bool(np.isfinite(points[:, 4]).any())
    axes, dot = _new_panels(points, times, rows=1 + fitted)
    nearest, farthest = np.percentile(points[:, 3], [1, 99])
    depth = {"cmap": "viridis", "vmin": nearest, "vmax": farthest, "s": dot}
    end = (
        max(1e-3, 1e3 * float(np.nanpercentile(np.abs(points[:, 4]), SCALE_PERCENTILE)))
        if fitted
        else 1.0
    )
    behind = {"cmap": "RdBu", "vmin": -end, "vmax": end, "s": dot}
    for column, t_s in zip(axes.T, times, strict=True):
        here = points[points[:, 0] == t_s]
        lines = rows[(rows[:, 0] == t_s) & np.isnan(rows[:, 3]), 1:3]
        image = _draw_panel(
            column[0], here[:, 1:3], values=here[:, 3], lines=lines, colour=VERMILION, style=depth
        )
        scales = [(image, "depth [m]")]
        title = f"t = {t_s:.4g} s" if len(times) > 1 else ""
        column[0].set_title(title, fontsize=SMALL_PT)
        if fitted:
            used = here[np.isfinite(here[:, 4])]
            unused = here[~np.isfinite(here[:, 4])]
            column[1].plot(*unused[:, 1:3].T, ".", ms=1.5, color="0.7")
            distances = _draw_panel(
                column[1],
                used[:, 1:3],
                values=1e3 * used[:, 4],
                lines=lines,
                colour="0.6",
                style=behind,
            )
            scales.append((distances, "distance behind the surface [mm]"))
            rms = np.sqrt(np.mean((1e3 * used[:, 4]) ** 2))
            column[1].set_title(f"{rms:.2g} mm RMS, {len(used):,} points", fontsize=SMALL_PT)
    for row, (scale, label) in zip(axes, scales, strict=True):
        bar = row[0].figure.colorbar(scale, ax=row)
        bar.set_label(label, fontsize=SMALL_PT)
        bar.ax.tick_params(labelsize=SMALL_PT, width=0.6)
        row[0].set_ylabel(f"v [{unit}]" if unit else "v", fontsize=SMALL_PT)
    for panel in axes[-1]:
        panel.set_xlabel(f"u [{unit}]" if unit else "u", fontsize=SMALL_PT)
    return axes[0, 0].figure


def _sentence_figure(text: str) -> Figure:
    figure = Figure(
        figsize=(MAX_PANEL_SHARE * PAGE_MM / MM_PER_INCH, TITLE_HEIGHT_INCH), layout="constrained"
    )
    axes = figure.subplots()
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, ha="center", va="center", fontsize=SMALL_PT)
    return figure


def _new_panels(points: Array, times: Array, rows: int) -> tuple[NDArray[np.object_], float]:
    """Return panels (rows, times) with the points' proportions, and a dot's area."""
    inch = PAGE_MM / MM_PER_INCH
    count = len(times)
    across = min(1 / count, MAX_PANEL_SHARE)
    width, height = np.ptp(points[:, 1:3], axis=0)
    panel = (
        across * inch * float(np.clip(height / max(width, 1e-12), *PANEL_ASPECT_LIMITS))
        + TITLE_HEIGHT_INCH
    )
    size = (max(MAX_PANEL_SHARE, across * count) * inch, panel * rows)
    dot = (
        COVERED_SHARE
        * (72 * across * inch) ** 2
        * PANEL_ASPECT_LIMITS[0]
        / max(1, len(points) / count)
    )
    return Figure(figsize=size, layout="constrained").subplots(rows, count, squeeze=False), dot


def _draw_panel(
    axes: Axes, image_points: Array, values: Array, lines: Array, colour: str, style: dict[str, Any]
) -> PathCollection:
    drawn = axes.scatter(*image_points.T, c=values, linewidths=0, zorder=1, **style)
    # Of more faces thinner ones, or these would hide the points.
    thin = min(0.5, THICK_LINE_ROWS / max(1, len(lines)))
    axes.plot(*lines.T, color=colour, linewidth=thin, zorder=2)
    low = image_points.min(axis=0)
    high = image_points.max(axis=0)
    room = OUTLINE_MARGIN * (high - low).max()
    both = np.vstack([image_points, lines[np.isfinite(lines).all(axis=1)]])
    low = np.maximum(both.min(axis=0), low - room)
    high = np.minimum(both.max(axis=0), high + room)
    margin = 0.03 * (high - low).max()
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(high[1] + margin, low[1] - margin))
    axes.set(aspect="equal")
    axes.tick_params(labelsize=SMALL_PT, width=0.6)
    if not ((lines >= low) & (lines <= high)).all(axis=1).any():
        axes.text(0.5, 0.02, "the body is not in view", transform=axes.transAxes, ha="center")
    return drawn
