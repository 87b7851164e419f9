"""What each estimate's variance is made of."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib import colormaps
from matplotlib.figure import Figure

from ...fem.constants import symbol_of
from ...statistics.budget import worded
from ..style import COLUMN_MM, dress, framed_figure

# Sources below this share of every variance are drawn together.
LITTLE = 0.03
OTHERS = "others"


def budget_picture(shares: Mapping[str, Mapping[str, float]]) -> Figure:
    """Draw a stacked bar for each estimate.

    Parameters
    ----------
    shares : mapping of estimate to mapping of source to its share of the variance
    """
    sums: dict[str, float] = {}
    for line in shares.values():
        for source, share in line.items():
            sums[source] = max(sums.get(source, 0.0), share)
    drawn = sorted((s for s in sums if sums[s] >= LITTLE), key=lambda s: -sums[s])
    rows = list(shares)[::-1]
    figure = framed_figure(COLUMN_MM, 30 + 7 * len(rows), 14, 2, 10, 20)
    axes, left = figure.subplots(), [0.0] * len(rows)
    colours = colormaps["tab20"](range(20))
    for source, colour in zip([*drawn, OTHERS], colours, strict=False):
        widths = [
            1 - sum(shares[row].get(s, 0.0) for s in drawn)
            if source == OTHERS
            else shares[row].get(source, 0.0)
            for row in rows
        ]
        axes.barh(range(len(rows)), widths, left=left, color=colour, label=worded(source))
        left = [a + b for a, b in zip(left, widths, strict=True)]
    axes.set_yticks(range(len(rows)), [symbol_of(row) for row in rows])
    axes.set_xlim(0, 1)
    dress(axes, "", "share of the variance", "")
    figure.legend(loc="upper center", ncols=3, frameon=False, fontsize="x-small")
    return figure
