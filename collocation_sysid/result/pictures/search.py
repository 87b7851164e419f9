"""Pictures of the search: the initial scan of the stiffness, and the iterations of the method;
and the structure of the constraint Jacobian, after Fig. 3 of the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sp
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator

from ...common.array_types import Array
from ...fem.laws.constants import unit_of
from ...methods.solution import Iteration
from ...program.collocation import Collocation
from ...recording.measurement_selection import shortened_experiment
from ..figure_style import (
    BLACK,
    BLUE,
    COLOUR_CYCLE,
    COLUMN_MM,
    LINE_PT,
    ORANGE,
    PAGE_MM,
    SMALL_PT,
    TEXT_PT,
    VERMILION,
    add_legend_above,
    framed_figure,
    make_log_axis,
    own_settings,
    style_axes,
    symbol_as_mathtext,
)

_STAGE_COLOUR = "#808080"


def convergence(history: Sequence[Iteration], names: Sequence[str] | None = None) -> Figure:
    """Return a figure of loss, violation of the equations of motion, trust region, noise of the
    loss, and parameters against the iteration number; values that are not positive are left out, and
    quantities without any others, such as the trust region of a method that has none.

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
            ("loss", [i.loss for i in history], BLUE),
            ("violation [N]", [i.violation_n for i in history], VERMILION),
            ("trust region", [i.trust for i in history], ORANGE),
            ("noise of loss", [i.noise for i in history], BLACK),
        )
        if label == "loss" or np.isfinite(_positive_or_nan(values)).any()
    ]
    count = len(curves)
    height_mm = 48 + 22 * count
    figure = framed_figure(COLUMN_MM, height_mm, left_mm=14, right_mm=2, foot_mm=9.5, top_mm=5)
    heights = (*[1.0] * count, 0.2, 1.4)  # a gap for the legend
    grid = figure.add_gridspec(count + 2, 1, height_ratios=heights, hspace=0.12)
    panels = [figure.add_subplot(grid[row]) for row in (*range(count), count + 1)]
    for axes in panels[1:]:
        axes.sharex(panels[0])
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


# Timesteps shown: enough to see the band, few enough to see its blocks.
SHOWN_STEPS = 6
# Further samples evaluated: rows of the last shown steps depend on two steps ahead.
SPARE_SAMPLES = 4
# Picture elements across a panel.
RASTER_SIZE = 400
# Decades of magnitude that the colour scale spans.
DECADES = 6


@own_settings()
def jacobian_sparsity(collocation: Collocation, z: Array) -> Figure:
    """Return a figure of the constraint Jacobian of the first timesteps, and of one of its blocks,
    coloured by magnitude.

    At the left are the dense columns of the parameters, in the middle the block band of the
    positions, at the right the last shown block on the diagonal. Entries are scaled as in the
    nonlinear program; structural entries that are zero or tiny have the lightest colour.

    Parameters
    ----------
    collocation : Collocation
        Its first experiment is shown.
    z : (variables,)
        Variables at which the Jacobian is evaluated.
    """
    total = collocation.transcriptions[0].grid_times
    collocation, z = _first_steps(collocation, z)
    transcription = collocation.transcriptions[0]
    nq = collocation.nq
    first = transcription.dynamics.first_row
    steps = min(SHOWN_STEPS, transcription.grid_times)
    height = transcription.constraints_per_time
    width = transcription.dof_count
    rows = (steps - first) * height
    matrix = abs(collocation.jacobian(z)[:, : nq + steps * width])[:rows]
    band = matrix[:, nq:]
    block = band[rows - height :, (steps - 1) * width :]
    largest = float(np.nan_to_num(matrix.data).max(initial=1e-300))
    norm = LogNorm(largest * 10.0**-DECADES, largest, clip=True)

    figure = framed_figure(PAGE_MM, 88, left_mm=12, right_mm=13, foot_mm=10.5, top_mm=6)
    widths = (0.05 * max(1, nq), 1, 0.2, 0.95, 0.01, 0.03)
    grid = figure.add_gridspec(1, 6, width_ratios=widths, wspace=0.03)
    full_axes, middle, right, bar_axes = (figure.add_subplot(grid[k]) for k in (0, 1, 3, 5))
    if nq:
        _draw_magnitudes(full_axes, matrix[:, :nq], norm=norm)
    _draw_magnitudes(middle, band, norm=norm)
    image = _draw_magnitudes(right, block, norm=norm)
    style_axes(full_axes, "", xlabel="", ylabel="equations of motion")
    full_axes.set_xticks(
        np.arange(nq) + 0.5, [symbol_as_mathtext(p.name) for p in collocation.parameters.free]
    )
    full_axes.set_ylim(rows, 0)
    _tick_blocks(full_axes, "y", letter="c", times=range(first, steps), size=height)
    style_axes(middle, f"{steps} of {total} timesteps", xlabel="node positions")
    _tick_blocks(middle, "x", letter="x", times=range(steps), size=width)
    _tick_blocks(middle, "y", letter="c", times=range(first, steps), size=height)
    middle.tick_params(labelleft=False, left=False)
    name = rf"$\partial c_{{{steps - 1}}} / \partial x_{{{steps - 1}}}$"
    free = "" if transcription.has_constraints_of_grasps else ", free dofs only"
    meaning = "" if transcription.experiment.specimen else ": connectivity of the mesh"
    style_axes(right, f"{name}{meaning}", xlabel="column, 3 node + axis", ylabel=f"row{free}")
    for axes in (full_axes, middle, right):
        axes.grid(False)
        axes.spines[:].set_visible(True)
    bar = figure.colorbar(image, cax=bar_axes)
    bar.set_label("|entry|, scaled", fontsize=SMALL_PT)
    bar.ax.tick_params(which="both", labelsize=SMALL_PT, width=0.6)
    bar.outline.set_linewidth(0.6)  # type: ignore[operator]
    return figure


def _first_steps(collocation: Collocation, z: Array) -> tuple[Collocation, Array]:
    """Return the fitted experiments on at least `SHOWN_STEPS` time steps, and variables."""
    count = -(-SHOWN_STEPS // collocation.substeps) + SPARE_SAMPLES
    few = [
        shortened_experiment(transcription.experiment, count, shortens_sensors=True)
        for transcription in collocation.transcriptions
    ]
    short = replace(collocation, experiments=few, associations={})
    p = np.concatenate([z[: collocation.nq], *(s.guess_phi for s in short.transcriptions)])
    pairs = zip(collocation.iterates(z), short.transcriptions, strict=True)
    return short, short.pack(
        p, [part.x[: transcription.grid_times] for part, transcription in pairs]
    )


def _draw_magnitudes(axes: Axes, matrix: sp.csc_array, norm: LogNorm) -> AxesImage:
    """Draw a sparse matrix on a raster no finer than the picture."""
    rows, columns = matrix.shape  # type: ignore[misc]
    entries = sp.coo_array(matrix)
    raster = np.full((min(RASTER_SIZE, rows), min(RASTER_SIZE, columns)), -1.0)
    places = (
        entries.row.astype(np.int64) * raster.shape[0] // rows,
        entries.col.astype(np.int64) * raster.shape[1] // columns,
    )
    np.maximum.at(raster, places, np.nan_to_num(entries.data))
    return axes.imshow(
        np.ma.masked_less(raster, 0.0),
        norm=norm,
        cmap="cividis_r",
        aspect="auto",
        interpolation="nearest",
        extent=(0, columns, rows, 0),
    )


def _tick_blocks(axes: Axes, side: str, letter: str, times: Sequence[int], size: int) -> None:
    """Label the blocks of a matrix along one side, and draw lines between them."""
    labels = [f"${letter}_{{{t}}}$" for t in times]
    axes.set(**{f"{side}ticks": (np.arange(len(times)) + 0.5) * size, f"{side}ticklabels": labels})
    rule = axes.axvline if side == "x" else axes.axhline
    for k in range(1, len(times)):
        rule(k * size, color="#B0B0B0", lw=0.4)
