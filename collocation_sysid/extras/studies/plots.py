"""Figures of a study: convergence, success and basins of the starts, tip tracks, and estimates."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from ...common.display import readable_stress
from ...common.serialisation import read
from ...fem.laws.constants import unit_of
from ...result.figure_style import (
    BLACK,
    BLUE,
    COLOUR_CYCLE,
    LINE_PT,
    PAGE_MM,
    SMALL_PT,
    TEXT_PT,
    VERMILION,
    add_figure_legend,
    add_legend_above,
    format_plain_numbers,
    make_log_axis,
    new_figure,
    own_settings,
    style_axes,
    symbol_as_mathtext,
)
from ...runs.result_content import Result
from .planning import shortened_keys
from .rows import (
    Row,
    SuccessCriterion,
    best_run,
    guess_distance,
    parameters_in,
    reference_parameters,
    wilson_interval,
)
from .run_execution import Record

Array = NDArray[Any]

# Number of groups of distances from the truth, in which successes are counted.
DISTANCE_BINS = 5
# Estimates whose ratio is larger are drawn on a logarithmic axis.
WIDE = 30.0
# Largest number of labels on an axis: more would overlap.
MOST_TICKS = 9
# Width and height of a panel [mm].
PANEL_MM = 32.0


@own_settings()
def comparison_plots(
    rows: Sequence[Row], records: Mapping[str, Record], yardstick: SuccessCriterion
) -> dict[str, Figure]:
    """Return the figures of a comparison of methods by file name without suffix; those without data
    are left out.

    They are "convergence", "tip" (if there are markers), and, if runs have several starts and there
    is a reference for these, "success" and "basins".

    Parameters
    ----------
    rows : sequence of Row
        Rows of `run_row`, one for each run, also for missing ones.
    records : mapping of key of the run to Record
        Records, at least of the runs with a result.
    yardstick : SuccessCriterion
        True values, if known, which are the reference of the starts; otherwise the estimates of the
        best run are.
    """
    figures: dict[str, Figure] = {}
    completed = [row for row in rows if row["rms_m"] is not None]
    if completed:
        figures["convergence"] = convergence_in_time(completed, records)
        if records[completed[0]["key"]]["tip"] is not None:
            figures["tip"] = tip_tracks(completed, records)
    done = [row for row in rows if row["status"] != "missing"]
    centre = reference_parameters(done, yardstick) if done else {}
    # A run without a guess that failed has no place among the starts.
    done = [row for row in done if all(row[f"guess_{name}"] is not None for name in centre)]
    if centre and len({row["start"] for row in done}) > 1:
        figures["success"] = success_by_distance(done, centre, is_truth_known=bool(yardstick.truth))
        figures["basins"] = basins(done, centre, is_truth_known=bool(yardstick.truth))
    return figures


@own_settings()
def model_plots(rows: Sequence[Row], names: Sequence[str]) -> dict[str, Figure]:
    """Return the figure "models" of a comparison of models: the prediction error of each model
    relative to the best, with its standard error, and estimates with combined intervals.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `model_rows`; models without a prediction or an interval have an empty line.
    names : sequence of str
        Estimates to draw, a panel each.

    Returns
    -------
    dict
        Empty if nothing was predicted and there are no estimates.
    """
    predicted = any(row["log_ratio"] is not None for row in rows)
    panels = [*(["prediction"] if predicted else []), *names]
    if not panels:
        return {}
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
    return {"models": figure}


def _model_ends(row: Row, panel: str) -> tuple[float, float, float] | None:
    """Return low end, value and high end of a model in a panel of `model_plots`; None if the model
    has no such value.
    """
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


def _by_method(rows: Sequence[Row]) -> dict[str, tuple[str, list[Row]]]:
    """Return colour and rows of each method by its name, in the order of their first rows; colours
    repeat if there are more methods than colours. `rows` are those of `run_row`.
    """
    methods = dict.fromkeys(row["method"] for row in rows)
    return {
        method: (
            COLOUR_CYCLE[k % len(COLOUR_CYCLE)],
            [row for row in rows if row["method"] == method],
        )
        for k, method in enumerate(methods)
    }


def convergence_in_time(rows: Sequence[Row], records: Mapping[str, Record]) -> Figure:
    """Return a figure of loss and violation of the equations of motion against time [s], a line per
    run and a colour per method; values that are not positive are left out.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `run_row` of runs with a result.
    records : mapping of key of the run to Record
        Records of these runs, with the history of each "result".
    """
    figure = new_figure(PAGE_MM, 70)
    panels = figure.subplots(1, 2)
    for method, (colour, runs) in _by_method(rows).items():
        style: dict[str, Any] = {"color": colour, "lw": LINE_PT, "marker": ".", "ms": 3}
        for k, row in enumerate(runs):
            history = read(Result, records[row["key"]]["result"]).history
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


# Starts -------------------------------------------------------------------------------------------


def success_by_distance(
    rows: Sequence[Row], centre: Mapping[str, float], is_truth_known: bool
) -> Figure:
    """Return a figure of the success rate of each method, with its 95 % interval, against the
    largest ratio of guess to reference, in `DISTANCE_BINS` logarithmic bins.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `run_row`, at least one, with a guess of each parameter in `centre`.
    centre : mapping of str to float
        Positive reference of each parameter, at least one.
    is_truth_known : bool
        Whether the reference is the truth, otherwise the best estimate; for the title.
    """
    figure = new_figure(PAGE_MM / 2, 65)
    axes = figure.subplots()
    factors = np.array([guess_distance(row, centre) for row in rows])
    edges = np.geomspace(max(1.0, factors.min()), factors.max() * (1 + 1e-9), DISTANCE_BINS + 1)
    methods = _by_method(rows)
    for k, (method, (colour, runs)) in enumerate(methods.items()):
        off = np.array([guess_distance(row, centre) for row in runs])
        places = []
        rates = []
        bars = []
        for low, high in itertools.pairwise(edges):
            hits = [row["success"] for row, f in zip(runs, off, strict=True) if low <= f < high]
            if hits:
                rate = np.mean(hits)
                least, most = wilson_interval(sum(hits), len(hits))
                shift = (k + 0.5) / len(methods)
                places.append(low ** (1 - shift) * high**shift)
                rates.append(100 * rate)
                bars.append((100 * (rate - least), 100 * (most - rate)))
        style = {"fmt": "o-", "ms": 3, "lw": LINE_PT, "elinewidth": 0.7, "capsize": 2}
        axes.errorbar(
            places, rates, np.abs(np.array(bars)).T, color=colour, label=method, **style
        )  # fmt: skip
    title = f"Success over distance from the {'true values' if is_truth_known else 'best estimate'}"
    style_axes(axes, title, xlabel="factor by which the worst guess is wrong", ylabel="success [%]")
    axes.set_xscale("log")
    axes.set_xticks(edges, [f"{edge:.2g}" for edge in edges])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_ylim(-4, 104)
    add_legend_above(axes, 2, height=1.1)
    return figure


def basins(rows: Sequence[Row], centre: Mapping[str, float], is_truth_known: bool) -> Figure:
    """Return a figure of the guesses of all runs, relative to a reference, over each pair of
    parameters, a row of panels for each method; a single parameter is paired with itself. Successes
    and failures have different marks.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `run_row`, at least one, with a guess of each parameter.
    centre : mapping of str to float
        Positive reference by name, relative to which guesses are drawn; at least one.
    is_truth_known : bool
        Whether the reference is the truth, otherwise the best estimate; for the labels.
    """
    names = list(centre)
    pairs = list(itertools.combinations(names, 2)) or [(names[0], names[0])]
    methods = _by_method(rows)
    figure = new_figure(max(PAGE_MM / 2, PANEL_MM * len(pairs)), 14 + PANEL_MM * len(methods))
    panels = figure.subplots(len(methods), len(pairs), sharex=True, sharey=True, squeeze=False)
    for (method, (_, runs)), line in zip(methods.items(), panels, strict=True):
        for axes, (first, second) in zip(line, pairs, strict=True):
            for success, colour, marker in ((False, VERMILION, "x"), (True, BLUE, "o")):
                chosen = [row for row in runs if row["success"] is success]
                axes.scatter(
                    [row[f"guess_{first}"] / centre[first] for row in chosen],
                    [row[f"guess_{second}"] / centre[second] for row in chosen],
                    s=9, marker=marker, color=colour, linewidths=0.8,
                    label="success" if success else "failure",
                )  # fmt: skip
            axes.plot(
                1, 1, "+", color=BLACK, ms=6, label="truth" if is_truth_known else "best estimate"
            )
            style_axes(
                axes,
                method if axes is line[0] else "",
                xlabel="",
                ylabel=symbol_as_mathtext(second),
            )
    for axes, (first, _) in zip(panels[-1], pairs, strict=True):
        axes.set_xlabel(symbol_as_mathtext(first), fontsize=TEXT_PT)
    _ratio_axes(panels[0, 0], max(guess_distance(row, centre) for row in rows))
    title = f"guesses relative to the {'true values' if is_truth_known else 'best estimate'}"
    add_figure_legend(
        figure, 3, loc="outside upper right", fontsize=SMALL_PT, title=title,
        title_fontsize=SMALL_PT, alignment="right",
    )  # fmt: skip
    return figure


def _ratio_axes(axes: Axes, factor: float) -> None:
    """Set both axes, in place, to a logarithmic scale around one, with ticks at 1 and at a round
    ratio and its inverse.
    """
    digit = 10 ** np.floor(np.log10(factor))
    tick = max((t for t in (1.5, 2.0, 5.0, 10.0) if t * digit <= factor), default=1.0) * digit
    axes.set(xscale="log", yscale="log")
    for axis, limit in ((axes.xaxis, axes.set_xlim), (axes.yaxis, axes.set_ylim)):
        limit(0.8 / factor, 1.25 * factor)
        axis.set_major_locator(FixedLocator([1 / tick, 1, tick]))
        format_plain_numbers(axis, ".2g")


# Answers ------------------------------------------------------------------------------------------


def tip_tracks(rows: Sequence[Row], records: Mapping[str, Record]) -> Figure:
    """Return a figure of the measured marker farthest from the grasp, and of its forward simulation
    with each method's best solution.

    Measurements are those of the first row. Methods whose best run has no simulated track are left
    out.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `run_row` of runs with a result, at least one.
    records : mapping of key of the run to Record
        Records of these runs, each with a "tip" that is not None, see `run_worker`.
    """
    figure = new_figure(PAGE_MM, 65)
    panels = figure.subplots(1, 3, sharex=True)
    tip = records[rows[0]["key"]]["tip"]
    dots: dict[str, Any] = {"ms": 3.5, "color": BLACK, "mec": "none", "zorder": 3}
    measured = 1e3 * np.array(tip["measured_m"], dtype=float)
    for axis, (axes, letter) in enumerate(zip(panels, "xyz", strict=True)):
        axes.plot(tip["t_s"], measured[:, axis], ".", label="measured", **dots)
        title = f"Tip: marker {tip['marker']} of {tip['experiment']}" if axis == 0 else ""
        style_axes(axes, title, xlabel="time [s]", ylabel=f"{letter} [mm]")
        axes.yaxis.set_major_locator(MaxNLocator(5))
    for method, (colour, runs) in _by_method(rows).items():
        best = best_run(runs)
        track = records[best["key"]]["tip"] if best is not None else {}
        if not track.get("rolled_out_m"):
            continue
        rolled = 1e3 * np.array(track["rolled_out_m"], dtype=float)
        off = f", error at most {1e3 * track['max_m']:.2g} mm" if track["max_m"] else ""
        for axis, axes in enumerate(panels):
            axes.plot(track["t_s"], rolled[:, axis], color=colour, lw=LINE_PT, label=method + off)
    add_figure_legend(figure, 2)
    return figure


@own_settings()
def sweep_plots(rows: Sequence[Row], varied_keys: Sequence[str]) -> dict[str, Figure]:
    """Return the figures of a sweep by file name without suffix: one, "sweep"; empty if no run has
    a result.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `run_row`, one for each run.
    varied_keys : sequence of str
        Swept keys.
    """
    if all(row["rms_m"] is None for row in rows):
        return {}
    return {"sweep": estimates_against(rows, varied_keys)}


def estimates_against(rows: Sequence[Row], varied_keys: Sequence[str]) -> Figure:
    """Return a figure of estimates with their combined 95 % intervals: a row for each parameter, a
    column for each swept key.

    Estimates that did not converge are crosses, unknown ones are left out. Values of the first
    other key have colours.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `run_row`, one for each run, at least one with a result.
    """
    names = parameters_in(rows)
    width = max(PAGE_MM / 2, min(PAGE_MM, 80.0 * len(varied_keys)))
    figure = new_figure(width, 14 + PANEL_MM * len(names))
    panels = figure.subplots(
        len(names), len(varied_keys), sharex="col", sharey="row", squeeze=False
    )
    shorts = dict(shortened_keys(varied_keys))
    for column, key in enumerate(varied_keys):
        places, texts = _axis_positions([row[key] for row in rows])
        for line, name in zip(panels, names, strict=True):
            for label, colour, shift, chosen in _groups(rows, varied_keys, key=key, shorts=shorts):
                _draw_estimates(
                    line[column],
                    rows,
                    places=places + shift,
                    name=name,
                    chosen=chosen,
                    colour=colour,
                    label=label,
                )
            unit = f" [{unit_of(name)}]" if unit_of(name) else ""
            style_axes(
                line[column],
                "",
                xlabel="",
                ylabel="" if column else symbol_as_mathtext(name) + unit,
            )
        bottom = panels[-1, column]
        bottom.set_xlabel(shorts[key], fontsize=TEXT_PT)
        shown = list(texts)[:: -(-len(texts) // MOST_TICKS)]
        bottom.set_xticks(shown, [texts[place] for place in shown])
        if len(varied_keys) > 1:
            add_legend_above(panels[0, column], 2)
    for line in panels:
        bars = [bar for c in line[0].collections for bar in c.get_segments()]
        # Bars without a finite end have no points.
        drawn = np.concatenate([np.empty((0, 2)), *(np.reshape(bar, (-1, 2)) for bar in bars)])[
            :, 1
        ]
        if drawn.size and drawn.min() > 0 and drawn.max() > WIDE * drawn.min():
            make_log_axis(line[0])
    return figure


def _axis_positions(values: Sequence[str]) -> tuple[Array, dict[float, str]]:
    """Return the position of each value on the axis (rows,), which counts the distinct values from
    0 in the order of their first occurrence, and the label of each position.
    """
    order = list(dict.fromkeys(values))
    names = {float(place): _shortened(value) for place, value in enumerate(order)}
    return np.array([order.index(value) for value in values], dtype=float), names


def _shortened(value: str) -> str:
    """Return the text of a swept value; if it is a number, with four digits."""
    try:
        return f"{float(value):.4g}"
    except ValueError:
        return value


def _groups(
    rows: Sequence[Row], varied_keys: Sequence[str], key: str, shorts: Mapping[str, str]
) -> Iterator[tuple[str | None, str, float, Array]]:
    """Yield label, colour, offset on the axis, and mask (rows,) of the rows that share a value of
    the first other key; one group of all rows, without a label, if `key` is the only one.
    """
    other = next((name for name in varied_keys if name != key), None)
    if other is None:
        yield None, COLOUR_CYCLE[0], 0.0, np.ones(len(rows), dtype=bool)
        return
    values = list(dict.fromkeys(row[other] for row in rows))
    for k, value in enumerate(values):
        label = f"{shorts[other]} = {_shortened(value)}"
        shift = 0.5 * ((k + 0.5) / len(values) - 0.5)
        chosen = np.array([row[other] == value for row in rows])
        yield label, COLOUR_CYCLE[k % len(COLOUR_CYCLE)], shift, chosen


def _draw_estimates(
    axes: Axes,
    rows: Sequence[Row],
    places: Array,
    name: str,
    chosen: Array,
    colour: str,
    label: str | None,
) -> None:
    """Draw the estimates and intervals of one group of rows into `axes`: dots if converged, else
    crosses; unknown ones are left out.
    """
    value, low, high = (
        np.array([row[f"{what}_{name}"] for row in rows], dtype=float)
        for what in ("value", "low", "high")
    )
    converged = np.array([row["converged"] for row in rows])
    style: dict[str, Any] = {"ms": 3.5, "lw": 0.8, "capsize": 2, "color": colour}
    for form, shown in (("o", chosen & converged), ("x", chosen & ~converged)):
        if (shown & np.isfinite(value)).any():
            bars = np.clip([value - low, high - value], 0, None)[:, shown]
            axes.errorbar(places[shown], value[shown], bars, fmt=form, label=label, **style)
            label = None
