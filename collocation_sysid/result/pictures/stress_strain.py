"""Pictures of specimens: stress or lateral stretch over strain, measured, fitted and simulated."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ...common.array_types import Array
from ..figure_style import BLACK, COLUMN_MM, add_legend_above, framed_figure, style_axes
from .over_time import drawn_models

# Readable units of stress, the largest first: name and factor from pascal.
STRESS_UNITS = (("MPa", 1e-6), ("kPa", 1e-3), ("Pa", 1.0))
# Largest measured value, in a readable unit, from which on that unit is used.
READABLE = 1.0
HEIGHT_MM = 58


def strain_picture(strain: Array, t_s: Array, samples: Array, name: str, unit: str) -> Figure:
    """Return a figure of one measurement of a specimen over its strain, in the order of time.

    Parameters
    ----------
    strain : (T,) array
        Strain at the times of the experiment, a ratio and not percent; drawn as it is.
    t_s : (T,) array
        Times of the experiment [s].
    samples : (S, 4) array
        Time [s], and the value as measured, fitted and simulated; NaN where there is none. A
        fitted or simulated column of NaN alone is left out.
    name : str
        Name of the measurement, for the axis.
    unit : str
        "Pa" for a stress, which is drawn in a readable multiple such as kPa; other units are
        written as they are, "1" and "" not at all.
    """
    at = np.interp(samples[:, 0], t_s, strain)
    shown_unit, factor = _readable_unit(samples[:, 1], unit)
    measured, fitted, simulated = factor * samples[:, 1:].T
    figure = framed_figure(COLUMN_MM, HEIGHT_MM, left_mm=15, right_mm=2, foot_mm=9.5, top_mm=9)
    axes = figure.subplots()
    dots = {"ls": "", "marker": ".", "ms": 4.0, "color": BLACK, "mec": "none", "alpha": 0.6}
    axes.plot(at, measured, label="measured", zorder=3, **dots)
    models = (each if np.isfinite(each).any() else None for each in (fitted, simulated))
    for label, values, style in drawn_models(*models):
        axes.plot(at, values, label=label, **style)
    label = f"{name} [{shown_unit}]" if shown_unit else name
    style_axes(axes, "", xlabel="strain", ylabel=label)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    add_legend_above(axes, columns=3)
    return figure


def _readable_unit(values: Array, unit: str) -> tuple[str, float]:
    """Return a readable unit for values, and the factor to it.

    Stresses ("Pa") get the largest unit in which the largest magnitude is at least `READABLE`;
    other units are kept with the factor 1, and "1" becomes "".
    """
    if unit != "Pa":
        return ("" if unit == "1" else unit), 1.0
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    fitting = (each for each in STRESS_UNITS if each[1] * largest >= READABLE)
    return next(fitting, STRESS_UNITS[-1])
