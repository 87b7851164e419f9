"""Where a search began: the misfit against the stiffness, and the start that was chosen."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ...arrays import Array
from ..style import (
    BLUE,
    COLUMN_MM,
    LINE_PT,
    ORANGE,
    VERMILION,
    dress,
    framed_figure,
    legend_above,
    log_axis,
)

HEIGHT_MM = 52


def scan_picture(young_pa: Array, misfit: Array, best: int) -> Figure:
    """Draw a scan of the stiffness.

    Parameters
    ----------
    young_pa : (k,) Young's moduli, ascending
    misfit : (k,) in standard deviations, NaN where it could not be simulated
    best : int
        Position of the start.
    """
    figure = framed_figure(COLUMN_MM, HEIGHT_MM, 14, 2, 9.5, 6)
    axes = figure.subplots()
    axes.plot(young_pa, misfit, "o-", ms=2.5, lw=LINE_PT, color=BLUE, label="simulated")
    dress(axes, "", "Young's modulus E [Pa]", "misfit [σ]")
    axes.set_xscale("log")
    log_axis(axes)
    failed = np.isnan(misfit)
    if failed.any():
        foot = np.full(int(failed.sum()), axes.get_ylim()[0])
        axes.plot(
            young_pa[failed], foot, "x", ms=5, color=VERMILION, clip_on=False, zorder=3,
            label="not simulable",
        )  # fmt: skip
    axes.plot(young_pa[best], misfit[best], "D", ms=5, color=ORANGE, zorder=3, label="start")
    legend_above(axes, columns=3)
    return figure
