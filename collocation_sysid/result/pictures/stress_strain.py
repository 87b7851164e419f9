"""Pictures of specimens and test benches: stress over strain, modulus over frequency or time, and
force over displacement, measured, fitted and simulated.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from ...common.array_types import Array
from ..figure_style import BLACK, COLUMN_MM, add_legend_above, framed_figure, style_axes
from .over_time import drawn_models

# Readable units of stress, the largest first: name and factor from pascal.
STRESS_UNITS = (("MPa", 1e-6), ("kPa", 1e-3), ("Pa", 1.0))
# Largest measured value, in a readable unit, from which on that unit is used.
READABLE = 1.0
HEIGHT_MM = 76
# Colour of measured dots, behind the fit.
GREY = "#8A8A8A"
# Component of a unit vector below which a direction does not count as having it.
DIRECTION_TOLERANCE = 1e-3
# Share of the largest strain or displacement by which it must reverse to count as unloading.
REVERSAL = 0.02


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
    label = f"{name} [{shown_unit}]" if shown_unit else name
    return _curve(at, factor * samples[:, 1:], xlabel="strain", ylabel=label)


def harmonic_picture(strain: Array, t_s: Array, samples: Array) -> Figure:
    """Return a figure of storage and loss modulus over frequency; arguments as of `strain_picture`."""
    moduli_pa = samples[1:, 1:].reshape(-1, 2, 3) / strain[1::2, None, None] * [[[1], [-1]]]
    frequency_hz = 0.25 / np.diff(t_s)[::2]
    unit, factor = _readable_unit(moduli_pa, "Pa")
    figure, axes, below = _two_panels()
    order = np.argsort(frequency_hz)
    for part, (title, marker) in enumerate((("storage", "o"), ("loss", "s"))):
        measured, fitted, simulated = factor * moduli_pa[order, part].T
        dots = {"ls": "", "marker": marker, "ms": 3, "mec": GREY, "mew": 0.7, "zorder": 1}
        fill = "white" if part else GREY
        axes.plot(frequency_hz[order], measured, label=f"{title}, measured", mfc=fill, **dots)
        models = (each if np.isfinite(each).any() else None for each in (fitted, simulated))
        for label, values, style in drawn_models(*models):
            axes.plot(frequency_hz[order], values, label="" if part else label, zorder=3, **style)
            apart = 100 * (values / measured - 1)
            below.plot(frequency_hz[order], apart, marker=marker, mfc=fill, ms=2.4, **style)
    style_axes(axes, "", xlabel="", ylabel=f"modulus [{unit}]")
    style_axes(below, "", xlabel="frequency [Hz]", ylabel="error [%]")
    axes.set_xscale("log")
    axes.set_yscale("log")
    _finish(below)
    add_legend_above(axes, columns=2)
    return figure


def relaxation_picture(strain: Array, t_s: Array, samples: Array) -> Figure:
    """Return a figure of the relaxation modulus over time; arguments as of `strain_picture`."""
    moduli_pa = samples[2:, 1:] / strain[2:, None]
    unit, factor = _readable_unit(moduli_pa, "Pa")
    label = f"relaxation modulus [{unit}]"
    figure = _curve(t_s[2:], factor * moduli_pa, xlabel="time [s]", ylabel=label)
    for axes in figure.axes:
        axes.set_xscale("log")
    return figure


def force_picture(travel_m: Array, t_s: Array, samples: Array) -> Figure | None:
    """Return a figure of the force of a test bench over its displacement, both along the direction
    in which it moves farthest; None if that force is not measured.

    Parameters
    ----------
    travel_m : (T, 3) array
        Displacement along a line at the times of the experiment [m], not all zero.
    t_s : (T,) array
        Times of the experiment [s].
    samples : (S, 19) array
        Time [s], and the wrench as measured, fitted and simulated [N, N m]; NaN where there is
        none.
    """
    farthest = travel_m[np.linalg.norm(travel_m, axis=1).argmax()]
    direction = farthest / np.linalg.norm(farthest)
    axes = np.flatnonzero(np.abs(direction) > DIRECTION_TOLERANCE)
    forces_n = samples[:, 1:].reshape(-1, 3, 6)[:, :, axes] @ direction[axes]
    if not np.isfinite(forces_n[:, 0]).any():
        return None
    at_mm = 1e3 * np.interp(samples[:, 0], t_s, travel_m @ direction)
    return _curve(at_mm, forces_n, xlabel="displacement [mm]", ylabel="force [N]")


def _curve(at: Array, columns: Array, xlabel: str, ylabel: str) -> Figure:
    """Draw measured, fitted and simulated values (S, 3), and model minus measurement below;
    measurements while unloading are open.
    """
    figure, axes, below = _two_panels()
    measured, fitted, simulated = columns.T
    unloads = is_unloading(at)
    dots = {"ls": "", "marker": "o", "ms": 2.4, "mec": GREY, "mew": 0.5, "zorder": 1}
    for label, there, fill in (
        ("measured", ~unloads, GREY),
        ("measured, unloading", unloads, "white"),
    ):
        if np.isfinite(measured[there]).any():
            axes.plot(at[there], measured[there], label=label, mfc=fill, **dots)
    models = (each if np.isfinite(each).any() else None for each in (fitted, simulated))
    for label, values, style in drawn_models(*models):
        axes.plot(at, values, label=label, zorder=3, **style)
        below.plot(at, values - measured, **style)
    style_axes(axes, "", xlabel="", ylabel=ylabel)
    style_axes(below, "", xlabel=xlabel, ylabel="error")
    _finish(below)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    add_legend_above(axes, columns=2)
    return figure


def _two_panels() -> tuple[Figure, Axes, Axes]:
    """Return a figure with the panel of a curve, and below it that of its errors."""
    figure = framed_figure(COLUMN_MM, HEIGHT_MM, left_mm=15, right_mm=2, foot_mm=9.5, top_mm=13)
    spaces = {"hspace": 0.1}
    axes, below = figure.subplots(2, sharex=True, height_ratios=(3, 1), gridspec_kw=spaces)
    below.axhline(0.0, color=BLACK, lw=0.6)
    return figure, axes, below


def _finish(below: Axes) -> None:
    below.yaxis.set_major_locator(MaxNLocator(3, symmetric=True))
    reach = max(map(abs, below.get_ylim()))
    below.set_ylim(-reach, reach)


def is_unloading(at: Array) -> NDArray[np.bool_]:
    """Return of each of the values (S,), in the order of time, whether their magnitude decreases
    there; reversals by less than `REVERSAL` of the largest magnitude do not count.
    """
    size = np.abs(at)
    turn = REVERSAL * size.max(initial=0.0)
    unloads = np.zeros(len(at), dtype=bool)
    last, falls = 0, False  # the last extreme value, and what comes after it
    for k in range(1, len(at)):
        change = size[k] - size[last]
        unloads[k] = falls
        if (change <= 0) if falls else (change >= 0):
            last = k
        elif abs(change) > turn:
            falls = not falls
            unloads[last + 1 : k + 1] = falls
            last = k
    return unloads


def _readable_unit(values: Array, unit: str) -> tuple[str, float]:
    """Return a readable unit for values, and the factor to it."""
    if unit != "Pa":
        return ("" if unit == "1" else unit), 1.0
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    fitting = (each for each in STRESS_UNITS if each[1] * largest >= READABLE)
    return next(fitting, STRESS_UNITS[-1])
