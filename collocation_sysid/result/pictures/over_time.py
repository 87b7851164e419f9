"""Pictures over time of markers and sensors: measured, fitted, simulated, residual; and the spectrum
of the markers with the natural frequencies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.mlab import psd  # scipy.signal takes half a second to import
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from ...common.array_types import Array
from ..figure_style import (
    BLACK,
    BLUE,
    COLUMN_MM,
    LINE_PT,
    PAGE_MM,
    SMALL_PT,
    TEXT_PT,
    VERMILION,
    NotebookFigure,
    add_figure_legend,
    add_legend_above,
    fixed_figure,
    framed_figure,
    make_log_axis,
    style_axes,
)


def drawn_models(
    fitted_m: Array | None, simulated_m: Array | None
) -> list[tuple[str, Array, dict[str, Any]]]:
    """Return label, values and line style of the fitted and then the simulated trajectory.

    A trajectory that is None is left out. The line of the simulated one is always dashed, so that
    the fitted one remains visible where they agree.

    Parameters
    ----------
    fitted_m, simulated_m : array or None
        Values of any shape, such as markers (T, M, 3) [m], which are returned as they are.

    Returns
    -------
    list of (str, array, dict)
        Label "fitted" or "simulated", values, and keyword arguments of ``Axes.plot``.
    """
    named = (
        ("fitted", fitted_m, {"color": BLUE, "lw": LINE_PT}),
        ("simulated", simulated_m, {"color": VERMILION, "lw": LINE_PT, "ls": (0, (4, 2))}),
    )
    return [(label, model, style) for label, model, style in named if model is not None]


# Left, bottom, width and height of axes, in shares of the figure.
Box = tuple[float, float, float, float]

# Style of measured samples.
DOTS: dict[str, Any] = {
    "ls": "", "marker": ".", "ms": 3.5, "color": BLACK, "mec": "none", "alpha": 0.7, "zorder": 3
}  # fmt: skip

# Largest number of markers, with which the figure fits on a page.
MAX_SHOWN_MARKERS = 3


@dataclass(frozen=True)
class TrackLayout:
    """Measures of the figure of marker tracks, three columns wide."""

    row_mm: float = 27.0  # height of a marker's row: its tracks above its residuals
    row_gap_mm: float = 6.5  # distance of two rows, for the labels of the times
    # Height of the legend above the rows, and of the time axis below them.
    legend_mm: float = 12.0
    foot_mm: float = 10.0
    # Width of the margins at the left, with labels, and at the right.
    first_margin_mm: float = 15.0
    last_margin_mm: float = 2.0
    column_gap_mm: float = 10.0  # distance of two columns, with labels
    # Share of a row's height for the tracks; the others are for the residuals.
    upper_share: float = 0.64


TRACK_LAYOUT = TrackLayout()


def marker_tracks(
    t_s: Array,
    names: Sequence[str],
    measured_m: Array,
    fitted_m: Array | None,
    simulated_m: Array | None = None,
) -> Figure:
    """Return a figure of the coordinates of markers over time, each with model minus measurement
    below.

    All error axes have the same scale, so that errors can be compared. Of more than
    `MAX_SHOWN_MARKERS` markers, those with the largest residuals of the fit, or else of the
    simulation, are shown; without both the first ones.

    Parameters
    ----------
    t_s : (T,)
        Times of the samples.
    measured_m : (T, M, 3)
        Measured markers, NaN where missing.
    fitted_m, simulated_m : (T, M, 3) or None
        Fitted markers, and those of a simulation with the estimated parameters; None is left out.
    """
    drawn = drawn_models(fitted_m, simulated_m)
    shown = _worst_markers(measured_m, [model for _, model, _ in drawn])
    some = f"{len(shown)} of {len(names)} markers, those with the largest errors"
    title = some if len(shown) < len(names) else ""
    head = TRACK_LAYOUT.legend_mm + (5.0 if title else 0.0)
    rows_mm = len(shown) * (TRACK_LAYOUT.row_mm + TRACK_LAYOUT.row_gap_mm)
    height = head + rows_mm - TRACK_LAYOUT.row_gap_mm + TRACK_LAYOUT.foot_mm
    figure = fixed_figure(PAGE_MM, height)
    errors = [1e3 * (model - measured_m)[:, shown] for _, model, _ in drawn]
    reach = max((float(np.nanmax(np.abs(e), initial=0.0)) for e in errors), default=0.0) or 1.0
    margin = 0.03 * (t_s[-1] - t_s[0]) or 1.0
    start = t_s[0] - margin
    stop = t_s[-1] + margin
    for row, marker in enumerate(shown):
        for axis, letter in enumerate("xyz"):
            upper_box, lower_box = _axes_boxes(row, axis, height=height, head=head)
            upper = figure.add_axes(upper_box)
            lower = figure.add_axes(lower_box)
            measured = 1e3 * measured_m[:, marker, axis]
            style_axes(
                upper, f"{names[marker]}, {letter}", xlabel="", ylabel="" if axis else "[mm]"
            )
            style_axes(lower, "", xlabel="", ylabel="" if axis else "error")
            for each in (upper, lower):
                each.set_xlim(start, stop)
                each.xaxis.set_major_locator(MaxNLocator(4))
                each.yaxis.set_label_coords(
                    (3.5 - TRACK_LAYOUT.first_margin_mm) / _column_width_mm(), 0.5
                )
            upper.plot(t_s, measured, label="measured", **DOTS)
            lower.axhline(0.0, color=BLACK, lw=0.6)
            for label, model_m, style in drawn:
                model = 1e3 * model_m[:, marker, axis]
                upper.plot(t_s, model, label=label, **style)
                lower.plot(t_s, model - measured, **style)
            upper.yaxis.set_major_locator(MaxNLocator(3))
            upper.tick_params(labelbottom=False)
            lower.set_ylim(-1.1 * reach, 1.1 * reach)
            lower.yaxis.set_major_locator(MaxNLocator(3, symmetric=True))
            lower.tick_params(labelbottom=row == len(shown) - 1)
            if row == len(shown) - 1:
                lower.set_xlabel("time [s]", fontsize=TEXT_PT)
    placement = {
        "loc": "upper left",
        "bbox_to_anchor": (0.005, 1 - 1.0 / height),
        "borderaxespad": 0.0,
    }
    title_style = {"title": title, "title_fontsize": TEXT_PT, "alignment": "left"}
    add_figure_legend(figure, 3, markerscale=2, **placement, **title_style)
    return figure


def _axes_boxes(row: int, axis: int, height: float, head: float) -> tuple[Box, Box]:
    """Return upper and lower axes as (left, bottom, width, height) in shares."""
    width = _column_width_mm()
    layout = TRACK_LAYOUT
    x = (layout.first_margin_mm + axis * (width + layout.column_gap_mm)) / PAGE_MM
    bottom = height - head - row * (layout.row_mm + layout.row_gap_mm) - layout.row_mm
    split = (1 - layout.upper_share) * layout.row_mm
    return (
        (
            x,
            (bottom + split) / height,
            width / PAGE_MM,
            layout.upper_share * layout.row_mm / height,
        ),
        (x, bottom / height, width / PAGE_MM, (split - 2.0) / height),
    )


def _column_width_mm() -> float:
    layout = TRACK_LAYOUT
    return (PAGE_MM - layout.first_margin_mm - layout.last_margin_mm - 2 * layout.column_gap_mm) / 3


def _worst_markers(measured_m: Array, models_m: Sequence[Array]) -> list[int]:
    """Return the markers with the largest RMS residuals of the first model, in their order."""
    if measured_m.shape[1] <= MAX_SHOWN_MARKERS or not models_m:
        return list(range(min(MAX_SHOWN_MARKERS, measured_m.shape[1])))
    squares = np.nansum((models_m[0] - measured_m) ** 2, axis=(0, 2))
    present = np.maximum(1, np.isfinite(measured_m).any(axis=2).sum(axis=0))
    return sorted(np.argsort(-squares / present)[:MAX_SHOWN_MARKERS].tolist())


# Errors whose ratio is larger are drawn on a logarithmic axis.
LOG_AXIS_RATIO = 15.0


def marker_errors(
    t_s: Array, measured_m: Array, fitted_m: Array | None, simulated_m: Array | None = None
) -> Figure:
    """Return a figure of the root mean square distance [mm] of the markers over time, fitted and
    simulated, with that over all samples in the legend.

    The axis is logarithmic if the two differ by more than a factor of `LOG_AXIS_RATIO`.

    Parameters
    ----------
    t_s : (T,)
        Times of the samples [s].
    measured_m : (T, M, 3)
        Measured markers [m], NaN where missing; samples without any marker leave a gap.
    fitted_m, simulated_m : (T, M, 3) or None
        Fitted and simulated markers [m]. None is left out, and so is a trajectory without any
        finite distance; without both the axes are empty.
    """
    figure = framed_figure(COLUMN_MM, 52, left_mm=13, right_mm=2, foot_mm=9.5, top_mm=9)
    axes = figure.subplots()
    totals = []
    for label, model_m, style in drawn_models(fitted_m, simulated_m):
        apart_m = model_m - measured_m
        lost = np.isnan(apart_m).all(axis=2)
        squares = np.where(lost, np.nan, np.nansum(apart_m**2, axis=2))
        if not np.isfinite(squares).any():
            continue
        totals.append(float(1e3 * np.sqrt(np.nanmean(squares))))
        label = f"{label}: {totals[-1]:.3g} mm RMS in total"
        axes.plot(t_s, 1e3 * rms_over_markers(squares), label=label, **style)
    style_axes(axes, "", xlabel="time [s]", ylabel="RMS over markers [mm]")
    if totals and max(totals) > LOG_AXIS_RATIO * min(totals) > 0:
        make_log_axis(axes)
    else:
        axes.set_ylim(bottom=0.0)
    if totals:
        add_legend_above(axes, columns=1)
    return figure


def rms_over_markers(squares: Array) -> Array:
    """Return the root mean square distance (T,) from squared distances (T, M) of the markers, of
    which NaN are left out; NaN for samples without any marker.
    """
    present = np.isfinite(squares)
    total = np.where(present, squares, 0.0).sum(axis=1)
    with np.errstate(invalid="ignore"):
        return np.sqrt(total / present.sum(axis=1))


# Height of a row of three panels [mm].
HEIGHT_MM = 42.0
# Largest prediction, and largest root mean square of the measurements, of a number that vanishes,
# over the largest of those of the same unit: an identity up to rounding, and noise.
VANISHING_PREDICTION = 1e-6
VANISHING_MEASUREMENT = 0.02
# Largest number of panels, with which the figure fits on a page.
MOST_PANELS = 15


def sensor_picture(samples: Array, names: Sequence[str], units: Sequence[str] = ()) -> Figure:
    """Return a figure of the numbers of a sensor over time, three in a row, as the force above the
    torque.

    Numbers without any measurement are left out, and those that vanish, as the tangential force of
    an obstacle without friction does; at least one must be measured. Of more than `MOST_PANELS`,
    those with the largest errors are shown.

    Parameters
    ----------
    samples : (S, 1 + 3m)
        Time [s], and m numbers as measured, fitted and simulated; NaN where there are none.
    names : sequence of m str
        Titles of the numbers.
    units : sequence of m str, or empty
        Units of the numbers; not written if empty.
    """
    t_s, measured, fitted, rolled_out = np.split(
        samples, [1, *np.cumsum([len(names)] * 2) + 1], axis=1
    )
    shown = _shown_numbers(measured, np.vstack([fitted, rolled_out]), units)
    title = ""
    if len(shown) > MOST_PANELS:
        title = f"{MOST_PANELS} of {len(shown)} numbers, those with the largest errors"
        model = fitted if np.isfinite(fitted).any() else rolled_out
        errors = (model - measured)[:, shown]
        known = np.maximum(1, np.isfinite(errors).sum(axis=0))
        worst = np.argsort(-np.nansum(errors**2, axis=0) / known, kind="stable")[:MOST_PANELS]
        shown = [shown[k] for k in sorted(worst.tolist())]
    columns = min(3, len(shown))
    size = PAGE_MM / 25.4, HEIGHT_MM * -(-len(shown) // columns) / 25.4
    figure = NotebookFigure(figsize=size, layout="constrained")
    grid = figure.subplots(-(-len(shown) // columns), columns, sharex=True, squeeze=False)
    drawn = drawn_models(
        *(each if np.isfinite(each).any() else None for each in (fitted, rolled_out))
    )
    for k, each in zip(shown, grid.flat, strict=False):
        last = k in shown[-columns:]
        style_axes(
            each,
            names[k],
            xlabel="time [s]" if last else "",
            ylabel=f"[{units[k]}]" if units else "",
        )
        each.yaxis.set_major_locator(MaxNLocator(4))
        each.plot(t_s[:, 0], measured[:, k], label="measured", **DOTS)
        for label, values, style in drawn:
            each.plot(t_s[:, 0], values[:, k], label=label, **style)
    for each in grid.flat[len(shown) :]:
        each.set_visible(False)
    title_style = {"title": title, "title_fontsize": TEXT_PT, "alignment": "left"}
    add_figure_legend(figure, 3, markerscale=2, **title_style)
    return figure


def _shown_numbers(measured: Array, predicted: Array, units: Sequence[str]) -> list[int]:
    """Return numbers that are measured and do not vanish beside others of the same unit."""
    is_measured = np.asarray(np.isfinite(measured).any(axis=0))
    squares = np.nansum(measured**2, axis=0) / np.maximum(1, np.isfinite(measured).sum(axis=0))
    rms = np.sqrt(squares)
    largest = np.max(np.abs(np.nan_to_num(predicted)), axis=0, initial=0.0)
    is_predicted = np.asarray(np.isfinite(predicted).any(axis=0))
    of_unit = np.array(units or [""] * len(rms))
    shown = []
    for k in np.flatnonzero(is_measured):
        same = is_measured & (of_unit == of_unit[k])
        vanishes = (
            is_predicted[k]
            and largest[k] <= VANISHING_PREDICTION * largest[same].max()
            and rms[k] <= VANISHING_MEASUREMENT * rms[same].max()
            and rms[k] < rms[same].max()
        )
        if not vanishes:
            shown.append(int(k))
    return shown


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
