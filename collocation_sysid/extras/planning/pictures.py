"""Pictures of a plan: points beside their references, and the motion of the hand."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ...result.figure_style import (
    BLUE,
    COLOUR_CYCLE,
    LINE_PT,
    PAGE_MM,
    VERMILION,
    add_legend_above,
    is_alone,
    new_figure,
    own_settings,
    style_axes,
)
from .hand_limits import Limits
from .hand_motion import angular_motion
from .motion_plan import MotionPlan
from .spline_motion import SplineMotion


@own_settings()
def plan_figures(plan: MotionPlan) -> dict[str, Figure]:
    """Return the figures of a plan by file name without suffix: "hand" if it may move, "tracking" if
    the plan has references of positions, and "commands" if it has tensions or pressures.
    """
    figures = {}
    if plan.program.space.moves_hand.any():
        figures["hand"] = motion_picture(plan.motion, plan.program.limits)
    if plan.program.signals:
        figures["commands"] = commands_picture(plan)
    if any(np.isfinite(each.position_m).any() for each in plan.program.references):
        figures["tracking"] = tracking_picture(plan)
    return figures


def motion_picture(motion: SplineMotion, limits: Limits) -> Figure:
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
            alone = is_alone(wanted)  # of a reference at one time, for example
            panel.plot(plan.t_s[alone], wanted[alone], color=colour, ls="", marker="o", ms=3)
            if half_widths is not None:
                half = half_widths[reference.name][:, axis]
                about = plan.expected_m[reference.name][:, axis] - points[0, axis]
                ends = 1e3 * (about - half), 1e3 * (about + half)
                panel.fill_between(plan.t_s, *ends, color=colour, alpha=0.2, lw=0)
        panel.axvline(plan.program.task.duration_s, color="black", lw=0.6, ls=":")
        style_axes(panel, "", xlabel="", ylabel=f"{reference.name} [mm]")
    panels[-1].set_xlabel("time [s]")
    add_legend_above(panels[0], columns=3)
    return figure
