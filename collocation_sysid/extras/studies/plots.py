"""Pictures of a study: convergence of methods, and predictions and estimates of models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator

from ...common.display import readable_stress
from ...common.serialisation import read
from ...fem.laws.constants import is_damping, unit_of, without_region
from ...result.figure_style import (
    BLUE,
    COLOUR_CYCLE,
    LINE_PT,
    PAGE_MM,
    VERMILION,
    add_legend_above,
    format_plain_numbers,
    make_log_axis,
    new_figure,
    own_settings,
    style_axes,
    symbol_as_mathtext,
)
from ...runs.result_content import Result
from .rows import Row
from .run_execution import Record

# Moduli at small strain, which mean the same in every law, as damping coefficients do.
MODULI = ("young_pa", "poisson")


@own_settings()
def convergence_figure(rows: Sequence[Row], records: Mapping[str, Record]) -> Figure | None:
    """Return a figure of loss and violation of the equations of motion against time [s], a line per
    run and a colour per method; values that are not positive are left out. None if no run has a
    result.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `run_row`, one for each run, also for missing ones.
    records : mapping of label of the run to Record
        Records, at least of the runs with a result, with its history.
    """
    runs_of_method: dict[str, list[Row]] = {}
    for row in rows:
        if row["rms_m"] is not None:
            runs_of_method.setdefault(row["method"], []).append(row)
    if not runs_of_method:
        return None
    figure = new_figure(PAGE_MM, 70)
    panels = figure.subplots(1, 2)
    for number, (method, runs) in enumerate(runs_of_method.items()):
        colour = COLOUR_CYCLE[number % len(COLOUR_CYCLE)]
        style: dict[str, Any] = {"color": colour, "lw": LINE_PT, "marker": ".", "ms": 3}
        for k, row in enumerate(runs):
            history = read(Result, records[row["label"]]["result"]).history
            times = [line.time_s for line in history]
            for axes, name in zip(panels, ("loss", "violation_n"), strict=True):
                values = np.array([getattr(line, name) for line in history], dtype=float)
                values[~(values > 0)] = np.nan
                label = None if k else method
                axes.plot(times, values, label=label, alpha=max(0.2, len(runs) ** -0.5), **style)
    style_axes(panels[0], "Loss", xlabel="time [s]", ylabel="Σ (residual / σ)²")
    style_axes(
        panels[1],
        "Violation of the equations of motion",
        xlabel="time [s]",
        ylabel="largest residual [N]",
    )
    for axes in panels:
        make_log_axis(axes)
        axes.set_xscale("log", nonpositive="mask")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=7))
        format_plain_numbers(axes.xaxis)
    add_legend_above(panels[0], 3, height=1.1)
    return figure


@own_settings()
def model_figure(rows: Sequence[Row]) -> Figure | None:
    """Return a figure of the prediction error of each model relative to the best, with its standard
    error, and of the estimates that mean the same in every model, with combined intervals; None if
    nothing was predicted and there are no intervals.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `model_rows`; models without a prediction or an interval have an empty line.
    """
    parameters = dict.fromkeys(name for row in rows for name in row["parameters"])
    names = [
        name
        for name in parameters
        if (without_region(name) in MODULI or is_damping(name))
        and any(name in row["budget"] for row in rows)
    ]
    predicted = any(row["log_ratio"] is not None for row in rows)
    panels = [*(["prediction"] if predicted else []), *names]
    if not panels:
        return None
    figure = new_figure(max(PAGE_MM / 2, 45 * len(panels)), 20 + 7 * len(rows))
    places = np.arange(len(rows))
    axes_of_panels = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, panel in zip(axes_of_panels, panels, strict=True):
        factor, unit = 1.0, unit_of(panel)
        if unit == "Pa":
            factor, unit = readable_stress(row["parameters"].get(panel) or 0.0 for row in rows)
        for place, row in zip(places, rows, strict=True):
            ends = _model_ends(row, panel)
            if ends is None:
                continue
            low, value, high = (factor * end for end in ends)
            colour = VERMILION if row["chosen"] else BLUE
            bar = [[value - low], [high - value]]
            axes.errorbar(
                [value], [place], xerr=bar, fmt="o", ms=3, lw=LINE_PT, capsize=2, color=colour
            )
        if panel == "prediction":
            style_axes(axes, "Held-out data", xlabel="error relative to the best", ylabel="")
        else:
            label = f"{symbol_as_mathtext(panel)} [{unit}]".removesuffix(" []")
            style_axes(axes, "95 % interval", xlabel=label, ylabel="")
        axes.xaxis.set_major_locator(MaxNLocator(3))
        axes.ticklabel_format(axis="x", useOffset=False)
    axes_of_panels[0].set_yticks(places, [row["model"] for row in rows])
    axes_of_panels[0].set_ylim(len(rows) - 0.5, -0.5)
    return figure


def _model_ends(row: Row, panel: str) -> tuple[float, float, float] | None:
    """Return low end, value and high end; None if the model has no such value."""
    if panel == "prediction":
        if row["log_ratio"] is None or not np.isfinite(row["log_ratio_error"]):
            return None
        low, value, high = np.exp(row["log_ratio"] + row["log_ratio_error"] * np.array([-1, 0, 1]))
        return float(low), float(value), float(high)
    line = row["budget"].get(panel)
    if line is None:
        return None
    low, high = line["combined95"]
    value = min(max(row["parameters"][panel], low), high)
    return low, value, high
