"""The wrench of a grasp over time: measured, fitted, and rolled out."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ...arrays import Array
from ...recording.wrench import COMPONENTS, UNITS
from ..style import BLACK, PAGE_MM, TEXT_PT, Picture, dress
from .models import models

HEIGHT_MM = 42.0


def wrench_picture(sensed: Array) -> Figure:
    """Draw the components that are measured, force above torque.

    Parameters
    ----------
    sensed : (S, 19)
        Time [s], and six components as measured, fitted and rolled out, NaN where there are none.
    """
    t_s, measured, fitted, rolled_out = np.split(sensed, [1, 7, 13], axis=1)
    there = np.asarray(np.isfinite(measured).any(axis=0))
    rows = [k for k in range(2) if there[3 * k : 3 * k + 3].any()]
    figure = Picture(figsize=(PAGE_MM / 25.4, HEIGHT_MM * len(rows) / 25.4), layout="constrained")
    grid = figure.subplots(len(rows), 3, sharex=True, squeeze=False)
    drawn = models(*(each if np.isfinite(each).any() else None for each in (fitted, rolled_out)))
    for axes, kind in zip(grid, rows, strict=True):
        for place, each in enumerate(axes):
            k = 3 * kind + place
            dress(each, COMPONENTS[k], "time [s]" if kind == rows[-1] else "", f"[{UNITS[k]}]")
            each.yaxis.set_major_locator(MaxNLocator(4))
            dots = {"ls": "", "marker": ".", "ms": 3.0, "color": BLACK, "mec": "none", "alpha": 0.5}
            each.plot(t_s[:, 0], measured[:, k], label="measured", **dots)
            for label, values, style in drawn:
                each.plot(t_s[:, 0], values[:, k], label=label, **style)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper left", ncols=3, fontsize=TEXT_PT, frameon=False
    )
    return figure
