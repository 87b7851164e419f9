"""Figures of a run: convergence, marker tracks, errors over time, sparsity of the Jacobian.

Every function takes plain arrays and returns a `matplotlib.figure.Figure`; `save_plots` writes
them. Positions are in metres and drawn in millimetres where they are errors.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from ..nlp.parameters import DAMPING, LAME
from .solution import Iteration, Solution
from .sparsity_plot import jacobian_sparsity
from .style import (
    BLACK,
    BLUE,
    CYCLE,
    LINE_PT,
    PAGE_MM,
    SYMBOLS,
    TEXT_PT,
    VERMILION,
    dress,
    legend,
    log_axis,
    new_figure,
)

Array = NDArray[np.float64]

__all__ = [
    "convergence",
    "error_over_time",
    "jacobian_sparsity",
    "save_plots",
    "solution_plots",
    "tracks",
]

RESOLUTION_DPI = 150
# Errors whose ratio is larger are drawn on a logarithmic axis.
FAR_APART = 15.0


# Convergence ----------------------------------------------------------------------------------


def convergence(
    history: Sequence[Iteration],
    names: Sequence[str] = LAME + DAMPING,
    truth: Mapping[str, float] | None = None,
) -> Figure:
    """Marker error, loss, violation of the dynamics and parameters against iteration.

    Parameters
    ----------
    history : sequence of Iteration
    names : sequence of str
        Parameters to draw, in either convention.
    truth : mapping, optional
        Parameters are drawn relative to these; by default to their final values.
    """
    figure = new_figure(PAGE_MM, 105)
    panels = figure.subplots(2, 2, sharex=True).ravel()
    numbers = [iteration.number for iteration in history]
    curves = (
        ("Marker error", "RMS [mm]", [1e3 * i.rms_m for i in history], BLUE),
        ("Loss", "Σ (residual / σ)²", [i.loss for i in history], BLUE),
        ("Violated dynamics", "largest residual [N]", [i.violation_n for i in history], VERMILION),
    )
    for axes, (title, label, values, colour) in zip(panels, curves, strict=False):
        axes.plot(numbers, _positive(values), "o-", ms=2.5, lw=LINE_PT, color=colour)
        dress(axes, title, "", label)
        log_axis(axes)
    _draw_parameters(panels[3], history, names, truth)
    for axes in panels[2:]:
        axes.set_xlabel("iteration", fontsize=TEXT_PT)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def _draw_parameters(
    axes: Axes,
    history: Sequence[Iteration],
    names: Sequence[str],
    truth: Mapping[str, float] | None,
) -> None:
    axes.axhline(1.0, color=BLACK, lw=0.6)
    numbers = [iteration.number for iteration in history]
    for k, name in enumerate(names if history else ()):
        values = np.array([getattr(iteration.theta, name) for iteration in history], dtype=float)
        symbol, unit = SYMBOLS[name]
        reference = values[-1] if truth is None else truth[name]
        label = f"{symbol} = {values[-1]:.4g} {unit}"
        style = {"ms": 2.5, "lw": LINE_PT, "color": CYCLE[k % len(CYCLE)]}
        axes.plot(numbers, _positive(values / (reference or 1.0)), "o-", label=label, **style)
    dress(axes, "Parameters", "", f"value / {'final value' if truth is None else 'truth'}")
    log_axis(axes)
    if history and names:
        legend(axes, "at the end")


def _positive(values: Sequence[float] | Array) -> Array:
    """Values with gaps where a logarithmic axis has no place for them."""
    array = np.asarray(values, dtype=float)
    return np.where((array > 0) & np.isfinite(array), array, np.nan)


# Markers --------------------------------------------------------------------------------------


def tracks(
    t_s: Array,
    names: Sequence[str],
    measured_m: Array,
    fitted_m: Array | None,
    rolled_out_m: Array | None = None,
    max_markers: int = 6,
) -> Figure:
    """Coordinates of markers over time, each with model minus measurement below.

    Parameters
    ----------
    t_s : (T,)
    names : M marker names
    measured_m : (T, M, 3) NaN where missing
    fitted_m, rolled_out_m : (T, M, 3) or None
        Markers of the fitted trajectory, and of a simulation with the parameters found.
    max_markers : int
        Of more markers those with the largest residuals are shown.
    """
    models = _models(fitted_m, rolled_out_m)
    shown = _worst_markers(measured_m, models, max_markers)
    figure = new_figure(PAGE_MM, 18 + 34 * len(shown))
    panels = figure.subplots(
        2 * len(shown), 3, sharex=True, squeeze=False, height_ratios=(2, 1) * len(shown)
    )
    for row, marker in enumerate(shown):
        for axis, letter in enumerate("xyz"):
            upper, lower = panels[2 * row : 2 * row + 2, axis]
            measured = 1e3 * measured_m[:, marker, axis]
            dots = {"ms": 2.5, "color": BLACK, "mec": "none", "alpha": 0.6, "zorder": 3}
            upper.plot(t_s, measured, ".", label="measured", **dots)
            lower.axhline(0.0, color=BLACK, lw=0.6)
            for label, model_m, style in models:
                model = 1e3 * model_m[:, marker, axis]
                upper.plot(t_s, model, label=label, **style)
                lower.plot(t_s, model - measured, **style)
            dress(upper, "" if axis else names[marker], "", f"{letter} [mm]")
            dress(lower, "", "", "Δ [mm]")
            upper.yaxis.set_major_locator(MaxNLocator(4))
            lower.yaxis.set_major_locator(MaxNLocator(3))
    for axes in panels[-1]:
        axes.set_xlabel("time [s]", fontsize=TEXT_PT)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper left", ncols=3, fontsize=TEXT_PT, frameon=False,
        title=_chosen(len(shown), len(names)), title_fontsize=TEXT_PT, alignment="left",
        markerscale=2,
    )  # fmt: skip
    figure.align_ylabels()
    return figure


def error_over_time(
    t_s: Array, measured_m: Array, fitted_m: Array | None, rolled_out_m: Array | None = None
) -> Figure:
    """Root mean square distance of the markers over time, fitted and rolled out.

    Parameters
    ----------
    t_s, measured_m, fitted_m, rolled_out_m
        As for `tracks`. Samples at which every marker is missing leave a gap.
    """
    figure = new_figure(PAGE_MM, 60)
    axes = figure.subplots()
    totals = []
    for label, model_m, style in _models(fitted_m, rolled_out_m):
        squares = np.sum((model_m - measured_m) ** 2, axis=2)
        totals.append(float(1e3 * np.sqrt(np.nanmean(squares))))
        label = f"{label}, {totals[-1]:.3g} mm over all"
        axes.plot(t_s, 1e3 * _rms_over_markers(squares), label=label, **style)
    dress(axes, "Marker error", "time [s]", "RMS over markers [mm]")
    if max(totals) > FAR_APART * min(totals) > 0:
        log_axis(axes)
    else:
        axes.set_ylim(bottom=0.0)
    legend(axes)
    return figure


def _models(
    fitted_m: Array | None, rolled_out_m: Array | None
) -> list[tuple[str, Array, dict[str, Any]]]:
    named = (
        ("fitted", fitted_m, {"color": BLUE, "lw": LINE_PT}),
        ("rolled out", rolled_out_m, {"color": VERMILION, "lw": LINE_PT, "ls": (0, (4, 2))}),
    )
    return [(label, model, style) for label, model, style in named if model is not None]


def _rms_over_markers(squares: Array) -> Array:
    present = np.isfinite(squares)
    total = np.where(present, squares, 0.0).sum(axis=1)
    with np.errstate(invalid="ignore"):
        return np.sqrt(total / present.sum(axis=1))


def _worst_markers(measured_m: Array, models: Sequence[tuple], count: int) -> list[int]:
    """The markers to show, in their order."""
    if measured_m.shape[1] <= count or not models:
        return list(range(min(count, measured_m.shape[1])))
    squares = np.nan_to_num(np.sum((models[0][1] - measured_m) ** 2, axis=2)).sum(axis=0)
    present = np.maximum(1, np.isfinite(measured_m[:, :, 0]).sum(axis=0))
    return sorted(np.argsort(-squares / present)[:count].tolist())


def _chosen(shown: int, total: int) -> str:
    return "" if shown == total else f"{shown} of {total} markers, those with the largest errors"


# Files ----------------------------------------------------------------------------------------


def solution_plots(
    solution: Solution,
    rolled_out_m: Mapping[str, Array] | None = None,
    truth: Mapping[str, float] | None = None,
) -> dict[str, Figure]:
    """All figures of a solution by file name.

    Parameters
    ----------
    solution : Solution
    rolled_out_m : mapping of experiment name to (T, M, 3), optional
    truth : mapping, optional
        See `convergence`.
    """
    collocation = solution.collocation
    free = [item.name for item in collocation.parameters.free]
    figures = {
        "convergence": convergence(solution.history, free, truth),
        "jacobian": jacobian_sparsity(collocation, solution.z),
    }
    for segment, fitted in zip(collocation.segments, solution.readings_m, strict=True):
        experiment = segment.experiment
        measured = experiment.markers.positions_m
        rolled_out = (rolled_out_m or {}).get(experiment.name)
        figures[f"tracks_{experiment.name}"] = tracks(
            experiment.t_s, experiment.markers.names, measured, fitted, rolled_out
        )
        figures[f"error_{experiment.name}"] = error_over_time(
            experiment.t_s, measured, fitted, rolled_out
        )
    return figures


def save_plots(folder: str | Path, figures: Mapping[str, Figure]) -> list[Path]:
    """Write each figure as <name>.png and return the files.

    What a file name cannot hold becomes an underscore.
    """
    files = []
    for name, figure in figures.items():
        safe = re.sub(r"[^\w.-]+", "_", name)
        file = Path(folder) / f"{safe}.png"
        figure.savefig(file, dpi=RESOLUTION_DPI)
        files.append(file)
    return files
