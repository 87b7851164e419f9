"""Pictures of the search: the initial scan of the stiffness, and the iterations of the method."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ...common.array_types import Array
from ...fem.laws.constants import unit_of
from ...methods.solution import Iteration
from ..figure_style import (
    BLACK,
    BLUE,
    COLOUR_CYCLE,
    COLUMN_MM,
    LINE_PT,
    ORANGE,
    SMALL_PT,
    TEXT_PT,
    VERMILION,
    add_legend_above,
    framed_figure,
    make_log_axis,
    style_axes,
    symbol_as_mathtext,
)

_STAGE_COLOUR = "#808080"


def convergence(history: Sequence[Iteration], names: Sequence[str] | None = None) -> Figure:
    """Return a figure of misfit, loss, violation of the equations of motion, and parameters
    against the iteration number; values that are not positive are left out, and quantities without
    any others, such as the violation of a specimen.

    Parameters
    ----------
    history : sequence of Iteration
        Iterations of a search; if empty, the axes are empty.
    names : sequence of str, optional
        Parameters to draw; those of the first iteration by default.

    Raises
    ------
    KeyError
        If one of the parameters is missing in an iteration.
    """
    numbers = [iteration.number for iteration in history]
    curves = [
        (label, values, colour)
        for label, values, colour in (
            ("misfit [σ]", [i.misfit for i in history], BLUE),
            ("loss", [i.loss for i in history], BLUE),
            ("violation [N]", [i.violation_n for i in history], VERMILION),
        )
        if label == "loss" or np.isfinite(_positive_or_nan(values)).any()
    ]
    count = len(curves)
    height_mm = 48 + 28 * count
    figure = framed_figure(COLUMN_MM, height_mm, left_mm=14, right_mm=2, foot_mm=9.5, top_mm=4)
    heights = (*[1.0] * count, 0.2, 1.4)  # a gap for the legend
    grid = figure.add_gridspec(count + 2, 1, height_ratios=heights, hspace=0.12)
    panels = [figure.add_subplot(grid[row]) for row in (*range(count), count + 1)]
    rungs = _continuation_stages(history)
    for axes, (label, values, colour) in zip(panels, curves, strict=False):
        for part in rungs:
            style: dict[str, Any] = {"ms": 2.5, "lw": LINE_PT, "color": colour}
            axes.plot(numbers[part], _positive_or_nan(values[part]), "o-", **style)
        style_axes(axes, "", xlabel="", ylabel=label)
        make_log_axis(axes)
    _mark_continuation_stages(panels[:-1], history, stages=rungs)
    drawn = list(history[0].parameters) if names is None and history else list(names or ())
    _draw_parameters(panels[-1], history, names=drawn)
    panels[-1].set_xlabel("iteration", fontsize=TEXT_PT)
    for axes in panels:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.yaxis.set_label_coords(-0.145, 0.5)
        axes.tick_params(labelbottom=axes is panels[-1])
    return figure


def _continuation_stages(history: Sequence[Iteration]) -> list[slice]:
    """Return slices of `history` over which the same share was fitted."""
    shares = [iteration.share for iteration in history]
    starts = [k for k in range(len(shares)) if k == 0 or shares[k] != shares[k - 1]]
    return [slice(a, b) for a, b in pairwise([*starts, len(shares)])] if starts else []


def _mark_continuation_stages(
    panels: Sequence[Axes], history: Sequence[Iteration], stages: Sequence[slice]
) -> None:
    """Mark where the fit takes in more time steps: loss and error increase there."""
    if len(stages) < 2:
        return
    for part in stages:
        first = history[part.start]
        if part.start:
            between = (history[part.start - 1].number + first.number) / 2
            for axes in panels:
                axes.axvline(between, color=_STAGE_COLOUR, lw=0.8, ls=(0, (2, 2)), zorder=0.5)
    shares = ", ".join(f"{100 * history[part.start].share:.3g}" for part in stages)
    panels[0].set_title(f"continuation: {shares} % of the time steps in turn", fontsize=SMALL_PT)


def _draw_parameters(axes: Axes, history: Sequence[Iteration], names: Sequence[str]) -> None:
    """A reference of zero counts as 1, and ratios that are not positive are left out."""
    axes.axhline(1.0, color=BLACK, lw=0.6)
    numbers = [iteration.number for iteration in history]
    for k, name in enumerate(names if history else ()):
        values = np.array([iteration.parameters[name] for iteration in history], dtype=float)
        symbol = symbol_as_mathtext(name)
        unit = unit_of(name)
        label = f"{symbol} = {values[-1]:.4g} {unit}"
        style = {"ms": 2.5, "lw": LINE_PT, "color": COLOUR_CYCLE[k % len(COLOUR_CYCLE)]}
        axes.plot(
            numbers, _positive_or_nan(values / (values[-1] or 1.0)), "o-", label=label, **style
        )
    style_axes(axes, "", xlabel="", ylabel="θ / final θ")
    make_log_axis(axes)
    if history and names:
        add_legend_above(axes, columns=2)


def _positive_or_nan(values: Sequence[float] | Array) -> Array:
    """Return values with NaN where they are not positive and finite, for a logarithmic axis."""
    array = np.asarray(values, dtype=float)
    return np.where((array > 0) & np.isfinite(array), array, np.nan)


# Height of the picture of a scan [mm].
HEIGHT_MM = 52


def scan_picture(young_pa: Array, misfit: Array, best: int) -> Figure:
    """Return a figure of the misfit of a scan over Young's modulus; failed simulations are crosses
    at the lower edge.

    Parameters
    ----------
    young_pa : (k,)
        Young's moduli, ascending.
    misfit : (k,)
        Misfit in standard deviations, NaN where the motion could not be simulated.
    best : int
        Index of the modulus at which the solve starts.
    """
    figure = framed_figure(COLUMN_MM, HEIGHT_MM, left_mm=14, right_mm=2, foot_mm=9.5, top_mm=6)
    axes = figure.subplots()
    axes.plot(young_pa, misfit, "o-", ms=2.5, lw=LINE_PT, color=BLUE, label="simulated")
    style_axes(axes, "", xlabel="Young's modulus E [Pa]", ylabel="misfit [σ]")
    axes.set_xscale("log")
    make_log_axis(axes)
    failed = np.isnan(misfit)
    if failed.any():
        foot = np.full(int(failed.sum()), axes.get_ylim()[0])
        axes.plot(
            young_pa[failed], foot, "x", ms=5, color=VERMILION, clip_on=False, zorder=3,
            label="simulation failed",
        )  # fmt: skip
    axes.plot(young_pa[best], misfit[best], "D", ms=5, color=ORANGE, zorder=3, label="start")
    add_legend_above(axes, columns=3)
    return figure
