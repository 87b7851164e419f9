"""Picture of the structure of the constraint Jacobian, after Fig. 3 of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.sparse as sp
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from ...common.array_types import Array
from ...program.collocation import Collocation
from ...recording.measurement_selection import shortened_experiment
from ..figure_style import (
    PAGE_MM,
    SMALL_PT,
    framed_figure,
    own_settings,
    style_axes,
    symbol_as_mathtext,
)

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
