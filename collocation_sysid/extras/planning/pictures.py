"""Pictures of a plan: points beside their references, and the motion of the hand."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ...result.figure_style import (
    COLOUR_CYCLE,
    LINE_PT,
    PAGE_MM,
    add_legend_above,
    new_figure,
    own_settings,
    style_axes,
)
from ..design.page import motion_picture_of
from .motion_plan import MotionPlan


@own_settings()
def plan_figures(plan: MotionPlan) -> dict[str, Figure]:
    """Return the figures of a plan by file name without suffix: "hand" if it may move, "tracking" if
    the plan has references of positions, and "commands" if it has tensions or pressures.
    """
    figures = {}
    if plan.program.space.moves_hand.any():
        figures["hand"] = motion_picture_of(plan.motion, plan.program.limits)
    if plan.program.signals:
        figures["commands"] = commands_picture(plan)
    if any(np.isfinite(each.position_m).any() for each in plan.program.references):
        figures["tracking"] = tracking_picture(plan)
    return figures


def commands_picture(plan: MotionPlan) -> Figure:
    """Return a figure with a panel for each planned tension or pressure, with its limits, dashed."""
    signals = plan.program.signals
    figure = new_figure(PAGE_MM, 15 + 40 * len(signals))
    panels = figure.subplots(len(signals), 1, sharex=True, squeeze=False)[:, 0]
    t_s = np.linspace(0.0, plan.t_s[-1], 400)
    for panel, each, values in zip(panels, signals, plan.commands(t_s).values(), strict=True):
        panel.plot(t_s, values, color=COLOUR_CYCLE[0], lw=LINE_PT)
        for limit in (each.lowest, each.highest):
            panel.axhline(limit, color="black", lw=0.6, ls="--")
        panel.axvline(plan.program.task.duration_s, color="black", lw=0.6, ls=":")
        style_axes(panel, "", xlabel="", ylabel=f"{each.name} [{each.unit}]")
    panels[-1].set_xlabel("time [s]")
    return figure


def tracking_picture(plan: MotionPlan) -> Figure:
    """Return a figure with a panel for each reference: the displacement of the point from its
    initial place [mm] with its 95 % band, and the reference, dashed.
    """
    references = [each for each in plan.program.references if np.isfinite(each.position_m).any()]
    figure = new_figure(PAGE_MM, 15 + 45 * len(references))
    panels = figure.subplots(len(references), 1, sharex=True, squeeze=False)[:, 0]
    half_widths = plan.half_widths_m
    for panel, reference in zip(panels, references, strict=True):
        points = plan.points_m[reference.name]
        for axis, colour in zip(range(3), COLOUR_CYCLE, strict=False):
            middle = 1e3 * (points[:, axis] - points[0, axis])
            panel.plot(plan.t_s, middle, color=colour, lw=LINE_PT, label="xyz"[axis])
            wanted = 1e3 * (reference.position_m[:, axis] - points[0, axis])
            panel.plot(plan.t_s, wanted, color=colour, lw=LINE_PT, ls="--")
            if half_widths is not None:
                half = 1e3 * half_widths[reference.name][:, axis]
                panel.fill_between(
                    plan.t_s, middle - half, middle + half, color=colour, alpha=0.2, lw=0
                )
        panel.axvline(plan.program.task.duration_s, color="black", lw=0.6, ls=":")
        style_axes(panel, "", xlabel="", ylabel=f"{reference.name} [mm]")
    panels[-1].set_xlabel("time [s]")
    add_legend_above(panels[0], columns=3)
    return figure
