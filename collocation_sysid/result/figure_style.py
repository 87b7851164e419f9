"""Common look of all figures: sizes in millimetres, small type, and colours for any colour vision.

Figures are `matplotlib.figure.Figure` objects without pyplot: no display, no global state.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from math import inf
from typing import Any

import numpy as np
from matplotlib import rc_context, rcParamsDefault
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backend_bases import RendererBase
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogFormatterSciNotation, LogLocator, NullLocator
from numpy.typing import NDArray

from ..common.array_types import Array
from ..fem.laws.constants import symbol_of

# Okabe & Ito's palette, distinguishable with any colour vision.
BLACK = "#000000"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
BLUE = "#0072B2"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"
COLOUR_CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)

# Sizes for a journal page, in whose column or width figures are printed without scaling.
TEXT_PT = 8.0
# Size of labels within figures [pt].
SMALL_PT = 7.0
# Width of curves [pt].
LINE_PT = 1.1
# Width of a column [mm].
COLUMN_MM = 85.0
# Width of a page without its margins [mm].
PAGE_MM = 178.0
# Resolution of PNG files [pixels per inch]: sharp on a screen and in a report.
RESOLUTION_DPI = 200


_GREY = "#606060"


@contextmanager
def own_settings() -> Iterator[None]:
    """Draw with matplotlib's defaults; no settings of the user or the working folder have an effect.

    It is a decorator, too: of functions that make figures. The figures are written with the same
    settings.
    """
    # `rcdefaults` reads all styles of matplotlib.
    with rc_context({key: rcParamsDefault[key] for key in rcParamsDefault if key != "backend"}):
        yield


class NotebookFigure(Figure):
    """Figure that a notebook shows, with or without pyplot."""

    def savefig(self, *arguments: Any, **options: Any) -> None:
        with own_settings():
            super().savefig(*arguments, **options)

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        """Return PNG bytes, with the width in pixels at 96 per inch."""
        png = BytesIO()
        self.savefig(png, dpi=RESOLUTION_DPI)
        return png.getvalue(), {"width": round(96 * self.get_figwidth())}

    def draw(self, renderer: RendererBase) -> None:
        """Letters that the font lacks, as in a marker's name, give no warnings."""
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=r"Glyph \d+ .* missing from")
            super().draw(renderer)


def symbol_as_mathtext(name: str) -> str:
    """Return the symbol of a parameter, followed by the name of its region, if any, with an index as
    mathematical text of matplotlib, which takes longer than the other texts of a figure.
    """
    symbol, _, region = symbol_of(name).partition(" ")
    letter, _, index = symbol.partition("_")
    written = rf"$\mathrm{{{letter}}}_{{\mathrm{{{index}}}}}$" if index else symbol
    return f"{written} {region}".strip()


def new_figure(width_mm: float, height_mm: float) -> Figure:
    """Return an empty figure of a size [mm] that arranges its axes automatically."""
    figure = NotebookFigure(figsize=(width_mm / 25.4, height_mm / 25.4), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.03, h_pad=0.03)  # type: ignore[union-attr]
    return figure


def fixed_figure(width_mm: float, height_mm: float) -> Figure:
    """Return an empty figure of a size [mm] whose axes stay in place, also if matplotlib is
    configured to arrange axes automatically.
    """
    size = (width_mm / 25.4, height_mm / 25.4)
    return NotebookFigure(figsize=size, layout="none")  # type: ignore[arg-type]


def framed_figure(
    width_mm: float,
    height_mm: float,
    left_mm: float,
    right_mm: float,
    foot_mm: float,
    top_mm: float,
) -> Figure:
    """Return an empty figure, without axes yet, whose margins around all axes are fixed; it draws
    in half the time of a `new_figure`.

    Parameters
    ----------
    width_mm, height_mm : float
        Size of the figure [mm].
    left_mm, right_mm, foot_mm, top_mm : float
        Margins around the axes that are added [mm].
    """
    figure = fixed_figure(width_mm, height_mm)
    figure.subplots_adjust(
        left_mm / width_mm, foot_mm / height_mm, 1 - right_mm / width_mm, 1 - top_mm / height_mm
    )
    return figure


def style_axes(axes: Axes, title: str = "", xlabel: str = "", ylabel: str = "") -> None:
    """Give axes a title, labels of the x and the y axis (empty for none), the type sizes of this
    module, and a light frame and grid.
    """
    axes.set_title(title, fontsize=TEXT_PT, loc="left")
    axes.set_xlabel(xlabel, fontsize=TEXT_PT)
    axes.set_ylabel(ylabel, fontsize=TEXT_PT)
    axes.tick_params(which="both", labelsize=SMALL_PT, width=0.6, color=_GREY)
    axes.tick_params(which="major", length=2.5)
    axes.tick_params(which="minor", length=1.5)
    axes.yaxis.get_offset_text().set_fontsize(SMALL_PT)
    axes.grid(True, which="major", color="#E4E4E4", linewidth=0.6)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set(linewidth=0.6, color=_GREY)


def is_alone(values: Array) -> NDArray[np.bool_]:
    """Return at which of some values (T,) no line is drawn, because both neighbours are missing."""
    known = np.pad(np.isfinite(values), 1)
    return known[1:-1] & ~known[:-2] & ~known[2:]


def add_legend_above(axes: Axes, columns: int) -> None:
    """Add a legend above the axes, where it hides nothing.

    Parameters
    ----------
    columns : int
        Number of entries in a row.
    """
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, fontsize=SMALL_PT,
        frameon=False, borderaxespad=0.1, borderpad=0.1, columnspacing=1.2, handlelength=1.6,
        labelspacing=0.2,
    )  # fmt: skip


def add_figure_legend(figure: Figure, columns: int, **how: Any) -> None:
    """Add a legend above all axes of a figure, with the lines of its first axes.

    Parameters
    ----------
    columns : int
        Number of entries in a row.
    **how
        Further arguments of `Figure.legend`, which replace the default place and look.
    """
    handles, labels = figure.axes[0].get_legend_handles_labels() if figure.axes else ([], [])
    place = {"loc": "outside upper left", "fontsize": TEXT_PT, "frameon": False}
    figure.legend(handles, labels, ncols=columns, **place | how)


def format_plain_numbers(axis: Axis) -> None:
    """Write the numbers of a logarithmic axis without powers of ten, and remove ticks between them."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: format(value, "g")))
    axis.set_minor_locator(NullLocator())


def make_log_axis(axes: Axes) -> None:
    """Make the y axis logarithmic, with plain numbers where these are short (from 0.001 to
    100,000).

    The limits are widened to span at least a ratio of 4, of numbers that are powers 100, so that at
    least two numbers are shown. Data must have been drawn before.
    """
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    plain = low > 1e-3 and high < 1e5
    widen = max(1.0, (4.0 if plain else 100.0) / (high / low)) ** 0.5
    axes.set_ylim(low / widen, high * widen)
    few = plain and high / low < 1e3  # powers beside all else are too wide
    subs = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0) if high / low < 10 else (1.0, 2.0, 5.0)
    axes.yaxis.set_major_locator(LogLocator(subs=subs if few else (1.0,), numticks=7))
    axes.yaxis.set_minor_locator(NullLocator())
    if few:
        format_plain_numbers(axes.yaxis)
    else:
        axes.yaxis.set_major_formatter(LogFormatterSciNotation(minor_thresholds=(inf, inf)))
