"""What a depth camera saw over the fitted surface, and how far they are apart."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ...arrays import Array
from ..style import PAGE_MM

MM_PER_INCH, HIGH = 25.4, 0.6
# The scale ends where this share of the points does.
SHOWN = 95


def depth_picture(seen: Array) -> Figure:
    """Draw points over outlines of the surface, coloured by how far behind it they are.

    Parameters
    ----------
    seen : (k, 3) see `Replay.seen`
    """
    points, lines = seen[np.isfinite(seen[:, 2])], seen[~np.isfinite(seen[:, 2])]
    width = PAGE_MM / MM_PER_INCH
    figure = Figure(figsize=(width, HIGH * width), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(*lines[:, :2].T, color="0.6", linewidth=0.5, zorder=1)
    apart_mm = 1e3 * points[:, 2]
    end = max(1e-3, float(np.percentile(np.abs(apart_mm), SHOWN)) if len(apart_mm) else 1.0)
    drawn = axes.scatter(*points[:, :2].T, c=apart_mm, cmap="RdBu", vmin=-end, vmax=end, s=5)
    figure.colorbar(drawn, ax=axes, label="behind the surface [mm]", shrink=0.8)
    axes.set(aspect="equal", xlabel="u", ylabel="v")
    axes.invert_yaxis()
    return figure
