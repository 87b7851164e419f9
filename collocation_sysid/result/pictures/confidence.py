"""Pictures of uncertainty: confidence ellipses, correlations, and shares of each variance."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from ...common.array_types import Array
from ...fem.laws.constants import symbol_of
from ...judge.posterior import main_sources
from ...runs.result_content import Result
from ...statistics.budget.combined_intervals import NORMAL_95
from ...statistics.budget.systematic_effects import source_label
from ...statistics.combinations import WIDE, Direction
from ...statistics.distributions import chi2_isf, normal_isf
from ...statistics.estimates import correlation_from_covariance
from ..figure_style import (
    BLACK,
    BLUE,
    COLOUR_CYCLE,
    COLUMN_MM,
    ORANGE,
    SKY,
    SMALL_PT,
    TEXT_PT,
    framed_figure,
    style_axes,
    symbol_as_mathtext,
)
from .scene import round_length

# Radius of the joint 95 % region of two normal parameters over the half width of one interval.
JOINT_RADIUS = float(np.sqrt(chi2_isf(0.05, 2)) / normal_isf(0.025))
# Half width of the logarithm beyond which an interval is cut off at the edge of the panel.
MAX_HALF_WIDTH = np.log(1e3)
# Deviation of a logarithm beyond which axes show factors instead of percent.
FACTOR_THRESHOLD = 1.0


# Width of a letter of a label and of a cell of the correlations [mm], and most letters of a label
# that is not turned.
LETTER_MM = 1.7
CELL_MM = 7.0
LONGEST_FLAT = 4
# Most letters in a line of the labels of combinations.
LABEL_WIDTH = 30


@dataclass(frozen=True, eq=False)
class Confidence:
    """Estimates and the covariance of their logarithms, for estimates that have an uncertainty."""

    names: Sequence[str]  # (k,) str: names of the parameters
    values: Array  # (k,): the estimates
    covariance: Array  # (k, k): covariance of their logarithms, finite
    quantiles: Array  # (k,): half widths of the 95 % intervals in standard deviations
    is_combined: bool = False  # whether the covariance contains systematic effects, not noise alone

    @classmethod
    def from_result(cls, result: Result) -> Confidence | None:
        """Return the estimates of a result that have an uncertainty, with the combined covariance if
        it is known, else the statistical one; those at a bound have none.

        None if the result has no error bars.
        """
        if (uncertainty := result.uncertainty) is None:
            return None
        covariance, quantiles = uncertainty.covariance, uncertainty.quantiles
        if (combined := uncertainty.combined_covariance) is not None:
            covariance, quantiles = combined, np.full(len(combined), NORMAL_95)
        known = np.isfinite(np.diag(covariance)) & np.isfinite(quantiles)
        indices = np.flatnonzero(known).tolist()
        names = [uncertainty.names[k] for k in indices]
        values = np.array([result.parameters[name].value for name in names])
        return cls(
            names,
            values,
            covariance=covariance[np.ix_(indices, indices)],
            quantiles=quantiles[indices],
            is_combined=combined is not None,
        )


def ellipse_outline(confidence: Confidence, i: int, j: int) -> Array:
    """Return the outline (181, 2) of the joint 95 % region of the logarithms of parameters i and j,
    about their estimates.
    """
    pair = [i, j]
    angle = np.linspace(0.0, 2 * np.pi, 181)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    deviation = np.sqrt(np.diag(confidence.covariance)[pair])
    rho = float(np.clip(confidence.covariance[i, j] / deviation.prod(), -1.0, 1.0))
    root = np.array([[1.0, 0.0], [rho, np.sqrt(1 - rho**2)]])
    return JOINT_RADIUS * confidence.quantiles[pair] * deviation * (circle @ root.T)


def confidence_ellipses(confidence: Confidence) -> Figure:
    """Return a figure of the joint 95 % region of every pair of parameters.

    Axes are deviations from the estimate, in percent, or factors where these are large; the cross
    is the 95 % interval of each parameter alone. A narrow slanted region means that the data
    determine only a combination of the two parameters.

    Parameters
    ----------
    confidence : Confidence
        At least two parameters.
    """
    count = len(confidence.names) - 1
    half = (confidence.quantiles * np.sqrt(np.diag(confidence.covariance))).tolist()
    reaches = [1.15 * min(JOINT_RADIUS * each, MAX_HALF_WIDTH) for each in half]
    ticks, texts, units = zip(*map(_ticks, reaches), strict=True)
    titles = [symbol_as_mathtext(n) + u for n, u in zip(confidence.names, units, strict=True)]
    figure = framed_figure(
        COLUMN_MM, COLUMN_MM if count > 1 else 62, left_mm=14, right_mm=2, foot_mm=11, top_mm=2
    )
    spaces = {"wspace": 0.12, "hspace": 0.12}
    panels = figure.subplots(count, count, squeeze=False, gridspec_kw=spaces)
    for (row, column), axes in np.ndenumerate(panels):
        if column > row:
            axes.set_axis_off()
            continue
        i = column
        j = row + 1
        _draw_pair(
            axes, ellipse_outline(confidence, i, j=j), half_width=half[i], half_height=half[j]
        )
        style_axes(axes)
        axes.set(xlim=(-reaches[i], reaches[i]), ylim=(-reaches[j], reaches[j]))
        last = row == count - 1
        first = column == 0
        axes.set_xticks(ticks[i], texts[i] if last else [""] * 3)
        axes.set_yticks(ticks[j], texts[j] if first else [""] * 3)
        axes.set_xlabel(titles[i] if last else "", fontsize=TEXT_PT)
        if first:
            axes.set_ylabel(titles[j], fontsize=TEXT_PT)
            axes.yaxis.set_label_coords(-0.13 * count, 0.5)
    what = "combined" if confidence.is_combined else "statistical"
    note = f"{what} uncertainty"
    if count > 1:
        note += ";\ndeviation from the estimate:\n95 % region of each pair,\n95 % interval of each alone"
    figure.text(0.98, 0.97, note, ha="right", va="top", fontsize=SMALL_PT)
    return figure


def _draw_pair(axes: Axes, outline: Array, half_width: float, half_height: float) -> None:
    """All sizes are deviations of logarithms."""
    axes.fill(*outline.T, facecolor=to_rgba(SKY, 0.35), edgecolor=BLUE, lw=1.0)
    for line in ([[-half_width, half_width], [0, 0]], [[0, 0], [-half_height, half_height]]):
        axes.plot(*line, color=BLACK, lw=0.8, solid_capstyle="butt")


def _ticks(reach: float) -> tuple[list[float], list[str], str]:
    """Return ticks up to a deviation of a logarithm, their texts in percent, or else in factors if
    the axis is wide, and their unit.
    """
    if reach > FACTOR_THRESHOLD:
        factor = round_length(np.exp(0.9 * reach))
        size = float(np.log(factor))
        return [-size, 0.0, size], [f"÷{factor:g}", "1", f"×{factor:g}"], ""
    share = round_length(1 - np.exp(-0.9 * reach))
    number = f"{100 * share:g}"
    ticks = [float(np.log1p(-share)), 0.0, float(np.log1p(share))]
    return ticks, [f"−{number}", "0", f"+{number}"], " [%]"


def correlation_matrix(confidence: Confidence) -> Figure:
    """Return a figure of the correlation of every pair of parameters, as colours and numbers.

    Parameters
    ----------
    confidence : Confidence
        At least two parameters.
    """
    correlation = correlation_from_covariance(confidence.covariance)
    count = len(confidence.names)
    # Cells for numbers of two digits, and room for labels with the names of regions.
    symbols = [symbol_as_mathtext(name) for name in confidence.names]
    longest = max(len(symbol_of(name)) for name in confidence.names)
    label_mm = max(8.0, 4 + LETTER_MM * longest)
    cells_mm = max(41.0, CELL_MM * count)
    upright = longest > LONGEST_FLAT
    figure = framed_figure(
        label_mm + cells_mm + 15, cells_mm + 5 + (label_mm if upright else 6), left_mm=label_mm,
        right_mm=7, foot_mm=label_mm if upright else 6, top_mm=5,
    )  # fmt: skip
    axes, bar_axes = figure.subplots(1, 2, width_ratios=(1, 0.06), gridspec_kw={"wspace": 0.06})
    image = axes.imshow(correlation, cmap="PuOr", vmin=-1, vmax=1)
    for (i, j), value in np.ndenumerate(correlation):
        axes.text(
            j, i, f"{value:.2f}".replace("-", "−"), ha="center", va="center",
            fontsize=SMALL_PT, color="white" if abs(value) > 0.65 else BLACK,
        )  # fmt: skip
    style_axes(axes, "correlation")
    axes.grid(False)
    axes.set_xticks(range(count), symbols, fontsize=TEXT_PT, rotation=90 if upright else 0)
    axes.set_yticks(range(count), symbols, fontsize=TEXT_PT)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    bar = figure.colorbar(image, cax=bar_axes, ticks=(-1, 0, 1))
    bar.ax.tick_params(labelsize=SMALL_PT, width=0.6)
    bar.outline.set_linewidth(0.6)  # type: ignore[operator]
    return figure


# Half widths of intervals with a tick in the picture of combinations, as factors with their texts;
# and the largest one that is drawn.
PRECISION_TICKS = {1.001: "0.1 %", 1.01: "1 %", 1.1: "10 %", 2.0: "×2", 10.0: "×10"}
WIDEST_DRAWN = 1e4


def combinations_picture(alone: Mapping[str, float], directions: Sequence[Direction]) -> Figure:
    """Return a figure of the 95 % intervals of constants alone and of their independent
    combinations, as bars over a logarithmic axis.

    Intervals narrower than their value are blue, wider ones orange; a bar that ends in an arrow is
    longer than the axis.

    Parameters
    ----------
    alone : mapping of str to float
        Half width of the interval of each constant, as a factor.
    directions : sequence of Direction
        Combinations, the best determined first.
    """
    rows = [(symbol_of(name), factor) for name, factor in alone.items()]
    rows += [(each.formula(), each.factor) for each in directions]
    rows = [(_folded(text), factor) for text, factor in rows]
    longest = max(len(line) for text, _ in rows for line in text.splitlines())
    left_mm = 6 + LETTER_MM * longest
    lines = len(rows) * (1 + 0.45 * max(text.count("\n") for text, _ in rows))
    figure = framed_figure(
        max(COLUMN_MM, left_mm + 45), 16 + 6 * lines, left_mm=left_mm, right_mm=5, foot_mm=11,
        top_mm=4,
    )  # fmt: skip
    axes = figure.subplots()
    shortest = np.log(1.0003)
    for row, (_, factor) in enumerate(rows):
        reach = min(np.log(factor), np.log(WIDEST_DRAWN))
        colour = BLUE if factor < WIDE else ORANGE
        axes.barh(row, max(0.0, reach - shortest), left=shortest, color=colour, height=0.6)
        if factor > WIDEST_DRAWN:
            axes.plot(reach, row, ">", color=colour, markersize=5, clip_on=False)
    style_axes(axes, "", xlabel="half width of the 95 % interval", ylabel="")
    axes.axhline(len(alone) - 0.5, color=BLACK, lw=0.6)
    axes.set_xscale("log")
    axes.set_xlim(shortest, np.log(WIDEST_DRAWN))
    axes.set_xticks([np.log(factor) for factor in PRECISION_TICKS], [*PRECISION_TICKS.values()])
    axes.minorticks_off()
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_yticks(range(len(rows)), [text for text, _ in rows], fontsize=SMALL_PT)
    axes.grid(False, axis="y")
    return figure


def _folded(text: str) -> str:
    """Return a formula in lines of at most `LABEL_WIDTH` letters, which begin with an operator."""
    whole = text.replace(" ", "\u00a0")
    parts = re.sub(r"\u00a0([·/+]|\S+,)\u00a0", " \\1\u00a0", whole)
    return textwrap.fill(parts, LABEL_WIDTH, break_long_words=False)


# Smallest share of a variance with a colour of its own; smaller ones are drawn together, and so are
# all but the largest sources, because there are only as many distinguishable colours.
SMALLEST_DRAWN_SHARE = 0.03
OTHERS = "others"
GREY = "#B4B4B4"
# Columns of the legend.
LEGEND_COLUMNS = 2
# Height of a line of the legend.
LEGEND_LINE_MM = 3.8


def budget_picture(shares: Mapping[str, Mapping[str, float]]) -> Figure:
    """Return a figure of the contributions to the variance of each estimate as stacked bars.

    The largest sources have colours of their own; the rest, and sources below
    `SMALLEST_DRAWN_SHARE` of every variance, are drawn together as "others".

    Parameters
    ----------
    shares : mapping of estimate to mapping of source to share
        Shares of the variance, from 0 to 1.
    """
    drawn = main_sources(shares, SMALLEST_DRAWN_SHARE)[: len(COLOUR_CYCLE)]
    rows = list(shares)[::-1]
    sources = [*drawn, OTHERS]
    legend_mm = LEGEND_LINE_MM * -(-len(sources) // LEGEND_COLUMNS) + 3
    figure = framed_figure(
        COLUMN_MM,
        12 + legend_mm + 7 * len(rows),
        left_mm=14,
        right_mm=4,
        foot_mm=10,
        top_mm=legend_mm,
    )
    axes = figure.subplots()
    starts = [0.0] * len(rows)
    for source, colour in zip(sources, [*COLOUR_CYCLE[: len(drawn)], GREY], strict=True):
        widths = [
            1 - sum(shares[row].get(s, 0.0) for s in drawn)
            if source == OTHERS
            else shares[row].get(source, 0.0)
            for row in rows
        ]
        bars = axes.barh(
            range(len(rows)), widths, left=starts, color=colour, label=source_label(source)
        )
        for bar in bars:  # a white line keeps neighbours apart
            bar.set(edgecolor="white", linewidth=0.4)
        starts = [a + b for a, b in zip(starts, widths, strict=True)]
    axes.set_yticks(range(len(rows)), [symbol_as_mathtext(row) for row in rows])
    axes.set_xlim(0, 1)
    style_axes(axes, "", xlabel="share of the variance", ylabel="")
    figure.legend(
        loc="upper left", ncols=LEGEND_COLUMNS, frameon=False, fontsize=SMALL_PT,
        handlelength=1.2, labelspacing=0.3, columnspacing=1.5,
    )  # fmt: skip
    return figure
