"""Presentation of a design: the motion, and the error bars before and after."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ...common.display import Line, Shown, Table
from ...fem.laws.constants import symbol_of, symbol_with_unit
from ...result.figure_style import (
    BLUE,
    COLOUR_CYCLE,
    LINE_PT,
    PAGE_MM,
    SMALL_PT,
    VERMILION,
    add_legend_above,
    format_plain_numbers,
    new_figure,
    own_settings,
    style_axes,
    symbol_as_mathtext,
)
from .hand_limits import CheckedMotion, Limits
from .hand_motion import angular_motion
from .motion import Design


def design_summary(design: Design, folder: Path) -> list[Shown]:
    """Return a design on one screen, as lines and tables: whether the search was interrupted, the
    error bars, which recordings they refer to, the limits that are reached, and the `folder` to
    which it was written. Nothing is written here.
    """
    tried = len(design.best.history)
    interrupted = Line(f"interrupted: the best of the {tried} motions so far", "check")
    return [
        *[interrupted] * design.best.is_interrupted,
        _error_table(design),
        _column_note(design),
        f"limits reached: {', '.join(design.active_limits) or 'none'}",
        f"written to {folder}",
    ]


def _error_table(design: Design) -> Table:
    """Return the table of error bars before and after the design, a line for each parameter or
    modulus: value, relative errors in percent, their range over the draws of θ, and the factor by
    which the error is reduced. Without error bars before the design, "error before" and the factor
    are empty.
    """
    heads = ("", "value", "error before", "error after", "range over the prior", "reduction factor")
    before = design.before
    after = design.after
    rows = []
    for name, relative in after.relative.items():
        error_before = before.relative[name] if before is not None else np.nan
        rows.append(
            (
                symbol_with_unit(name),
                f"{after.values[name]:.4g}",
                _percent(error_before),
                _percent(relative),
                f"{_percent(after.lowest[name])} … {_percent(after.highest[name])}",
                f"{error_before / relative:.2g}" if np.isfinite(error_before) else "",
            )
        )
    return Table("", heads, rows=tuple(rows))


def _percent(share: float) -> str:
    """Return a relative error in percent; "" for NaN, "not determined" from 1000 % on."""
    if np.isnan(share):
        return ""
    return f"{100 * share:.3g} %" if share < 10 else "not determined"


def _column_note(design: Design) -> str:
    """Return what the columns "before" and "after" refer to."""
    duration = f"{design.experiment.duration_s:.4g} s"
    after = f"after: the designed motion of {duration}"
    if design.added:
        return f"before: the existing recordings; {after} in addition"
    if design.before is None:
        return after
    shipped = f"{design.recording.template.duration_s:.4g} s"
    return f"before: the motion of {shipped} in the problem; {after} alone"


@own_settings()
def design_figures(design: Design) -> dict[str, Figure]:
    """Return the figures of a design by file name without suffix: "motion" and "error_bars"."""
    return {"motion": motion_picture(design), "error_bars": error_bars_picture(design)}


def motion_picture(design: Design) -> Figure:
    """Return the figure of the motion of a design, see `motion_picture_of`."""
    return motion_picture_of(design.motion, design.limits)


def motion_picture_of(motion: CheckedMotion, limits: Limits) -> Figure:
    """Return a figure of four panels over time: translation [mm] and rotation vector [°] of the
    hand, and its speeds and accelerations in percent of their limits.
    """
    figure = new_figure(PAGE_MM, 100)
    shift, turn, speed, growth = figure.subplots(2, 2, sharex=True).ravel()
    t_s = motion.grid_s
    place, rate, curvature = motion.derivatives(t_s)
    angular = angular_motion(place[:, 3:], rate[:, 3:], curvature=curvature[:, 3:])
    for axis, colour in zip(range(3), COLOUR_CYCLE, strict=False):
        style = {"color": colour, "lw": LINE_PT, "label": "xyz"[axis]}
        shift.plot(t_s, 1e3 * place[:, axis], **style)
        turn.plot(t_s, np.degrees(place[:, 3 + axis]), **style)
    for axes, of_shift, of_turn, most in (
        (speed, rate, angular[0], (limits.speed_m_s, limits.angular_speed_deg_s)),
        (
            growth,
            curvature,
            angular[1],
            (limits.acceleration_m_s2, limits.angular_acceleration_deg_s2),
        ),
    ):
        used = np.linalg.norm(of_shift[:, :3], axis=1) / most[0]
        turned = np.degrees(np.linalg.norm(of_turn, axis=1)) / most[1]
        axes.plot(t_s, 100 * used, color=BLUE, lw=LINE_PT, label="of the hand")
        axes.plot(t_s, 100 * turned, color=VERMILION, lw=LINE_PT, label="angular")
        axes.axhline(100, color="black", lw=0.6, ls="--")
        axes.set_ylim(bottom=0)
    style_axes(shift, "", xlabel="", ylabel="displacement of the hand [mm]")
    style_axes(turn, "", xlabel="", ylabel="rotation vector [°]")
    style_axes(speed, "", xlabel="time [s]", ylabel="speed [% of limit]")
    style_axes(growth, "", xlabel="time [s]", ylabel="acceleration [% of limit]")
    add_legend_above(shift, columns=3)
    add_legend_above(speed, columns=2)
    return figure


def error_bars_picture(design: Design) -> Figure:
    """Return a figure of the relative error bars [%] before the design, if known, and after, a row
    for each parameter or modulus; lines show their range over the draws of θ.
    """
    names = list(design.after.relative)
    figure = new_figure(PAGE_MM / 2, 14 + 9 * len(names))
    axes = figure.subplots()
    rows = np.arange(len(names))
    before = "recordings so far" if design.added else "the problem's motion"
    after = "with the designed motion" if design.added else "designed motion"
    for bars, label, colour, shift in (
        (design.before, before, VERMILION, -0.15),
        (design.after, after, BLUE, 0.15),
    ):
        if bars is None:
            continue
        middle, low, high = (
            np.array([100 * each[name] for name in names])
            for each in (bars.relative, bars.lowest, bars.highest)
        )
        axes.hlines(rows + shift, low, high, color=colour, lw=2.5, alpha=0.4)
        axes.plot(middle, rows + shift, "o", color=colour, ms=4, mec="none", label=label)
    axes.set_xscale("log")
    format_plain_numbers(axes.xaxis)
    axes.set_yticks(rows, [symbol_as_mathtext(name) or symbol_of(name) for name in names])
    axes.set_ylim(len(names) - 0.5, -0.5)
    style_axes(axes, "", xlabel="predicted standard error [%]", ylabel="")
    axes.tick_params(axis="y", labelsize=SMALL_PT)
    add_legend_above(axes, columns=2)
    return figure
