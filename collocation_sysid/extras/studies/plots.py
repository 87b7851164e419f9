"""Pictures of a study: violations by methods, and predictions and estimates of models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ...common.display import readable_stress
from ...fem.laws.constants import is_damping, unit_of, without_region
from ...result.figure_style import (
    BLUE,
    COLOUR_CYCLE,
    LINE_PT,
    PAGE_MM,
    VERMILION,
    add_figure_legend,
    make_log_axis,
    new_figure,
    own_settings,
    style_axes,
    symbol_as_mathtext,
)
from .model_choice import display_unit
from .rows import Row
from .run_execution import Record

# Moduli at small strain, which mean the same in every law, as damping coefficients do.
MODULI = ("young_pa", "poisson")
# Styles of lines that lie on each other.
LINE_STYLES = ("-", "--", "-.", ":")


@own_settings()
def method_figure(rows: Sequence[Row], records: Mapping[str, Record]) -> Figure | None:
    """Return a figure of the violation of the equations of motion over the time of the first
    recording, and of the error of the forward simulation, a line per run and a colour per method.
    None if no run has an answer.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `run_row`, one for each run, also for missing ones.
    records : mapping of label of the run to Record
        Records, at least of the runs with an answer.
    """
    answers: dict[str, list[Any]] = {}
    for row in rows:
        if fit := records.get(row["label"], {}).get("fit"):
            answers.setdefault(row["method"], []).append(fit)
    if not answers:
        return None
    found = [fit for fits in answers.values() for fit in fits]
    factor, unit = display_unit(next((fit["unit"] for fit in found if "unit" in fit), ""))
    # Name in the record, factor, title, and label of each panel; a simulation may have failed.
    panels = [
        ("violation", 1.0, "Violation of the equations of motion", "largest residual [N]"),
        ("simulation", factor, "Forward simulation with the estimates", f"RMS error [{unit}]"),
    ][: 1 + any("simulation" in fit for fit in found)]
    figure = new_figure(PAGE_MM, 85)
    subplots = figure.subplots(1, len(panels), sharex=True, squeeze=False)[0]
    for axes, (name, scale, title, label) in zip(subplots, panels, strict=True):
        for number, (method, fits) in enumerate(answers.items()):
            for k, fit in enumerate(fits):
                t_s, values = np.array(fit.get(name, ([], [])), dtype=float)
                axes.plot(
                    t_s,
                    scale * np.where(values > 0, values, np.nan),
                    label=None if k else method,
                    color=COLOUR_CYCLE[number % len(COLOUR_CYCLE)],
                    ls=LINE_STYLES[number % len(LINE_STYLES)],
                    lw=LINE_PT,
                    alpha=max(0.2, len(fits) ** -0.5),
                )
        style_axes(axes, title, "time [s]", label)
        make_log_axis(axes)
    add_figure_legend(figure, 3)
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
