"""Coordinates of markers over time: measured, fitted, simulated, and what is left."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ...arrays import Array
from ..style import BLACK, PAGE_MM, TEXT_PT, Picture, dress
from .models import models

Box = tuple[float, float, float, float]

MOST_MARKERS = 6
ROW_MM, GAP_MM, LEGEND_MM, FOOT_MM = 27.0, 6.5, 12.0, 10.0
LEFT_MM, RIGHT_MM, BETWEEN_MM = 15.0, 2.0, 10.0
UPPER_SHARE = 0.64


def tracks(
    t_s: Array,
    names: Sequence[str],
    measured_m: Array,
    fitted_m: Array | None,
    rolled_out_m: Array | None = None,
    max_markers: int = MOST_MARKERS,
) -> Figure:
    """Draw coordinates of markers over time, each with model minus measurement below.

    The errors have one scale, so that they compare.

    Parameters
    ----------
    t_s : (T,)
    names : M marker names
    measured_m : (T, M, 3) NaN where missing
    fitted_m, rolled_out_m : (T, M, 3) or None
        Markers of the fitted trajectory, and of a simulation with the parameters found.
    max_markers : int
        Of more markers those with the largest residuals are shown.
    """
    drawn = models(fitted_m, rolled_out_m)
    shown = _worst_markers(measured_m, [model for _, model, _ in drawn], max_markers)
    title = _chosen(len(shown), len(names))
    head = LEGEND_MM + (5.0 if title else 0.0)
    height = head + len(shown) * (ROW_MM + GAP_MM) - GAP_MM + FOOT_MM
    figure = Picture(figsize=(PAGE_MM / 25.4, height / 25.4))
    errors = [1e3 * (model - measured_m)[:, shown] for _, model, _ in drawn]
    reach = max((float(np.nanmax(np.abs(e), initial=0.0)) for e in errors), default=0.0) or 1.0
    margin = 0.03 * (t_s[-1] - t_s[0]) or 1.0
    start, stop = t_s[0] - margin, t_s[-1] + margin
    dots = {"ls": "", "marker": ".", "ms": 3.5, "color": BLACK, "mec": "none", "alpha": 0.7}
    for row, marker in enumerate(shown):
        for axis, letter in enumerate("xyz"):
            upper_box, lower_box = _boxes(row, axis, height, head)
            upper, lower = figure.add_axes(upper_box), figure.add_axes(lower_box)
            measured = 1e3 * measured_m[:, marker, axis]
            dress(upper, f"{names[marker]}, {letter}", "", "" if axis else "[mm]")
            dress(lower, "", "", "" if axis else "error")
            for each in (upper, lower):
                each.set_xlim(start, stop)
                each.xaxis.set_major_locator(MaxNLocator(4))
                each.yaxis.set_label_coords((3.5 - LEFT_MM) / _width_mm(), 0.5)
            upper.plot(t_s, measured, label="measured", zorder=3, **dots)
            lower.axhline(0.0, color=BLACK, lw=0.6)
            for label, model_m, style in drawn:
                model = 1e3 * model_m[:, marker, axis]
                upper.plot(t_s, model, label=label, **style)
                lower.plot(t_s, model - measured, **style)
            upper.yaxis.set_major_locator(MaxNLocator(3))
            upper.tick_params(labelbottom=False)
            lower.set_ylim(-1.1 * reach, 1.1 * reach)
            lower.yaxis.set_major_locator(MaxNLocator(3, symmetric=True))
            lower.tick_params(labelbottom=row == len(shown) - 1)
            if row == len(shown) - 1:
                lower.set_xlabel("time [s]", fontsize=TEXT_PT)
    _legend(figure, height, title)
    return figure


def _boxes(row: int, axis: int, height: float, head: float) -> tuple[Box, Box]:
    """Places of a pair of axes, upper and lower, in shares of the figure."""
    width = _width_mm()
    x = (LEFT_MM + axis * (width + BETWEEN_MM)) / PAGE_MM
    bottom = height - head - row * (ROW_MM + GAP_MM) - ROW_MM
    split = (1 - UPPER_SHARE) * ROW_MM
    return (
        (x, (bottom + split) / height, width / PAGE_MM, UPPER_SHARE * ROW_MM / height),
        (x, bottom / height, width / PAGE_MM, (split - 2.0) / height),
    )


def _width_mm() -> float:
    return (PAGE_MM - LEFT_MM - RIGHT_MM - 2 * BETWEEN_MM) / 3


def _legend(figure: Figure, height: float, title: str) -> None:
    handles, labels = figure.axes[0].get_legend_handles_labels() if figure.axes else ([], [])
    figure.legend(
        handles, labels, loc="upper left", bbox_to_anchor=(0.005, 1 - 1.0 / height), ncols=3,
        fontsize=TEXT_PT, frameon=False, title=title, title_fontsize=TEXT_PT, alignment="left",
        borderaxespad=0.0, markerscale=2,
    )  # fmt: skip


def _worst_markers(measured_m: Array, models_m: Sequence[Array], count: int) -> list[int]:
    """The markers to show, in their order."""
    if measured_m.shape[1] <= count or not models_m:
        return list(range(min(count, measured_m.shape[1])))
    squares = np.nan_to_num(np.sum((models_m[0] - measured_m) ** 2, axis=2)).sum(axis=0)
    present = np.maximum(1, np.isfinite(measured_m[:, :, 0]).sum(axis=0))
    return sorted(np.argsort(-squares / present)[:count].tolist())


def _chosen(shown: int, total: int) -> str:
    return "" if shown == total else f"{shown} of {total} markers, those with the largest errors"
