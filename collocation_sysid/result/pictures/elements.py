"""Sizes and shapes of the elements as histograms."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from ...arrays import Array
from ...fem.mesh_checks import edge_lengths, mean_ratios
from ..style import BLUE, COLUMN_MM, VERMILION, dress, framed_figure

BINS = 24


def elements_picture(nodes_m: Array, tetrahedra: NDArray[np.integer]) -> Figure:
    """Draw how many elements have which size and which quality.

    The size is the root mean square edge, the quality the mean ratio 12 (3V)^(2/3) / Σ l²: 1 for
    the regular tetrahedron, towards 0 the flatter it is.

    Parameters
    ----------
    nodes_m : (n, 3) undeformed
    tetrahedra : (E, 4) corners
    """
    quality = np.minimum(mean_ratios(nodes_m, tetrahedra), 1.0)  # rounding
    size_mm = 1e3 * np.sqrt((edge_lengths(nodes_m, tetrahedra) ** 2).mean(axis=1))
    figure = framed_figure(COLUMN_MM, 42, 13, 2, 9.5, 5.5)
    left, right = figure.subplots(1, 2, sharey=True, gridspec_kw={"wspace": 0.08})
    widest = float(size_mm.max())
    spread = np.ptp(size_mm) > 0.02 * widest
    limits = (float(size_mm.min()), widest) if spread else (0.9 * widest, 1.1 * widest)
    left.hist(size_mm, BINS, range=limits, color=BLUE)
    right.hist(quality, BINS, range=(0.0, 1.0), color=BLUE)
    worst = float(quality.min())
    right.axvline(worst, color=VERMILION, lw=1.0)
    dress(left, f"{len(tetrahedra)} elements", "size [mm]", "elements")
    dress(right, f"worst {worst:.2f}", "quality, 1 = regular")
    right.title.set_color(VERMILION)
    for axes in (left, right):
        axes.grid(False, axis="x")
        axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    left.xaxis.set_major_locator(MaxNLocator(4))
    right.set_xticks((0.0, 0.5, 1.0))
    return figure
