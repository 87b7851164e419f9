"""Frequency spectrum of the markers' motion with the body's natural frequencies."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.mlab import psd  # scipy.signal takes half a second to import
from numpy.typing import NDArray

from ...common.array_types import Array
from ..figure_style import (
    BLACK,
    BLUE,
    COLUMN_MM,
    LINE_PT,
    SMALL_PT,
    add_legend_above,
    framed_figure,
    make_log_axis,
    style_axes,
)

# Length of the zero-padded signal over its own: smoother curve, same resolution.
PADDING_FACTOR = 4
# Smallest share of samples with a marker: gaps are interpolated linearly.
MIN_PRESENT_SHARE = 0.5
# Decades below the largest density that are shown; smaller densities are rounding errors.
SHOWN_DECADES = 8


def spectrum_picture(
    t_s: Array, measured_m: Array, fitted_m: Array | None, natural_hz: Array | None
) -> Figure:
    """Return a figure of the spectral density of the measured tracks and of the residual, with the
    natural frequencies.

    Parameters
    ----------
    t_s : (T,)
        Evenly spaced times [s], at least two.
    measured_m : (T, M, 3)
        Measured markers [m], NaN where missing: gaps are interpolated linearly, and markers that
        are missing too often are left out, see `spectral_density`.
    fitted_m : (T, M, 3) or None
        Fitted markers [m]; None draws no spectrum of the residual.
    natural_hz : (k,) or None
        Natural frequencies [Hz], ascending; those above half the sampling rate are left out, and
        None draws none.
    """
    figure = framed_figure(COLUMN_MM, 58, left_mm=14, right_mm=2, foot_mm=9.5, top_mm=9)
    axes = figure.subplots()
    rate = (len(t_s) - 1) / (t_s[-1] - t_s[0])
    hertz, density = spectral_density(measured_m, rate)
    axes.plot(hertz, density, color=BLACK, lw=LINE_PT, label="measured")
    if fitted_m is not None:
        _, rest = spectral_density(measured_m - fitted_m, rate)
        axes.plot(hertz, rest, color=BLUE, lw=LINE_PT, label="measured − fitted")
    style_axes(axes, "", xlabel="frequency [Hz]", ylabel="density [mm²/Hz]")
    make_log_axis(axes)
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, np.nanmax(density, initial=0.0) * 10.0**-SHOWN_DECADES), 4 * high)
    axes.set_xlim(0, rate / 2)
    _draw_modes(axes, natural_hz if natural_hz is not None else np.zeros(0), limit_hz=rate / 2)
    add_legend_above(axes, columns=2)
    return figure


def spectral_density(tracks_m: Array, rate_hz: float) -> tuple[Array, Array]:
    """Return frequencies [Hz] and the power spectral density [mm²/Hz] of the markers' mean motion.

    Linear trends are removed and a Hann window is applied; the densities of x, y and z are added,
    those of markers averaged. Gaps are interpolated linearly, and markers present in less than
    the share `MIN_PRESENT_SHARE` of the samples are left out.

    Parameters
    ----------
    tracks_m : (T, M, 3)
        Positions, NaN where missing.

    Returns
    -------
    hertz, density : (k,)
        Frequencies above zero and below half the sampling rate. The density is NaN where it is
        zero, or if no marker is present often enough.
    """
    present = np.asarray(np.isfinite(tracks_m).all(axis=2))
    markers = np.flatnonzero(present.mean(axis=0) >= MIN_PRESENT_SHARE)
    padded = PADDING_FACTOR * len(tracks_m)
    hertz = np.arange(1, padded // 2) * rate_hz / padded
    density = np.zeros(len(hertz))
    t = np.arange(len(tracks_m))
    hann = np.hanning(len(t) + 1)[:-1]
    for marker in markers:
        known = np.flatnonzero(present[:, marker])
        for moved_m in tracks_m[known, marker].T:
            filled_mm = 1e3 * np.interp(t, known, moved_m)
            powers, _ = psd(filled_mm, len(t), rate_hz, "linear", hann, pad_to=padded)
            density += np.asarray(powers)[1:-1] / len(markers)
    return hertz, np.where(density > 0, density, np.nan)


def _draw_modes(axes: Axes, natural_hz: Array, limit_hz: float) -> None:
    """Number the modes from 1 at the top; neighbours that are too near share a label."""
    shown = natural_hz[natural_hz < limit_hz]
    for group in _neighbour_groups(shown, 0.05 * limit_hz):
        for hertz in shown[group]:
            axes.axvline(hertz, color="#808080", lw=0.8, ls=(0, (2, 1.5)), zorder=0.9)
        mode_label = f"{group[0] + 1}" if len(group) == 1 else f"{group[0] + 1}–{group[-1] + 1}"
        axes.annotate(
            mode_label, (shown[group].mean(), 1.0), xycoords=("data", "axes fraction"),
            xytext=(0, -1), textcoords="offset points", ha="center", va="top",
            fontsize=SMALL_PT, bbox={"fc": "white", "ec": "none", "pad": 0.8},
        )  # fmt: skip
    if len(shown):
        axes.plot([], [], color="#808080", lw=0.8, ls=(0, (2, 1.5)), label="natural frequencies")


def _neighbour_groups(ascending: Array, gap: float) -> list[NDArray[np.int64]]:
    """Return groups of indices, in which neighbours are nearer to each other than `gap`."""
    breaks = np.flatnonzero(np.diff(ascending) >= gap) + 1
    return [group for group in np.split(np.arange(len(ascending)), breaks) if len(group)]
