"""How far the markers are off, over time."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ...arrays import Array
from ..style import COLUMN_MM, dress, framed_figure, legend_above, log_axis
from .models import models

# Errors whose ratio is larger are drawn on a logarithmic axis.
FAR_APART = 15.0


def error_over_time(
    t_s: Array, measured_m: Array, fitted_m: Array | None, rolled_out_m: Array | None = None
) -> Figure:
    """Draw the root mean square distance of the markers over time, fitted and simulated.

    Parameters
    ----------
    t_s : (T,)
    measured_m : (T, M, 3) NaN where missing
        Samples at which every marker is missing leave a gap.
    fitted_m, rolled_out_m : (T, M, 3) or None
    """
    figure = framed_figure(COLUMN_MM, 52, 13, 2, 9.5, 9)
    axes = figure.subplots()
    totals = []
    for label, model_m, style in models(fitted_m, rolled_out_m):
        squares = np.sum((model_m - measured_m) ** 2, axis=2)
        if not np.isfinite(squares).any():
            continue
        totals.append(float(1e3 * np.sqrt(np.nanmean(squares))))
        label = f"{label}: {totals[-1]:.3g} mm over all"
        axes.plot(t_s, 1e3 * _rms_over_markers(squares), label=label, **style)
    dress(axes, "", "time [s]", "RMS over markers [mm]")
    if totals and max(totals) > FAR_APART * min(totals) > 0:
        log_axis(axes)
    else:
        axes.set_ylim(bottom=0.0)
    if totals:
        legend_above(axes, columns=1)
    return figure


def _rms_over_markers(squares: Array) -> Array:
    present = np.isfinite(squares)
    total = np.where(present, squares, 0.0).sum(axis=1)
    with np.errstate(invalid="ignore"):
        return np.sqrt(total / present.sum(axis=1))
