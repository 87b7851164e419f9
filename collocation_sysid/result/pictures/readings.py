"""What an instrument said over time, as of a wrench: measured, fitted, and simulated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ...arrays import Array
from ..style import BLACK, PAGE_MM, TEXT_PT, Picture, dress
from .models import models

HEIGHT_MM = 42.0


def readings_picture(said: Array, names: Sequence[str], units: Sequence[str] = ()) -> Figure:
    """Draw the numbers that are measured, three in a row, as force above torque.

    Parameters
    ----------
    said : (S, 1 + 3m)
        Time [s], and m numbers as measured, fitted and simulated, NaN where there are none.
    names, units : (m,)
    """
    t_s, measured, fitted, rolled_out = np.split(
        said, [1, *np.cumsum([len(names)] * 2) + 1], axis=1
    )
    there = np.asarray(np.isfinite(measured).any(axis=0))
    shown = [k for k in range(len(names)) if there[k - k % 3 : k - k % 3 + 3].any()]
    columns = min(3, len(shown))
    size = PAGE_MM / 25.4, HEIGHT_MM * -(-len(shown) // columns) / 25.4
    figure = Picture(figsize=size, layout="constrained")
    grid = figure.subplots(-(-len(shown) // columns), columns, sharex=True, squeeze=False)
    drawn = models(*(each if np.isfinite(each).any() else None for each in (fitted, rolled_out)))
    for k, each in zip(shown, grid.flat, strict=False):
        last = k in shown[-columns:]
        dress(each, names[k], "time [s]" if last else "", f"[{units[k]}]" if units else "")
        each.yaxis.set_major_locator(MaxNLocator(4))
        dots = {"ls": "", "marker": ".", "ms": 3.0, "color": BLACK, "mec": "none", "alpha": 0.5}
        each.plot(t_s[:, 0], measured[:, k], label="measured", **dots)
        for label, values, style in drawn:
            each.plot(t_s[:, 0], values[:, k], label=label, **style)
    for each in grid.flat[len(shown) :]:
        each.set_visible(False)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper left", ncols=3, fontsize=TEXT_PT, frameon=False
    )
    return figure
