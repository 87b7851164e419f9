"""Folder of a plan: poses for the robot, tensions and pressures, prediction, pictures, report and
plan.json.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...common.display import Line, Picture, Shown, Table, TitledParts
from ...common.files import write_text_file
from ...common.serialisation import as_json
from ...common.signal_handling import INTERRUPTS
from ...common.validated_classes import validated
from ...errors import listed
from ...fem.laws.constants import symbol_of
from ...recording import write_markers_csv, write_poses_csv
from ...recording.writers import write_columns_csv
from ...result.animation import film
from ...result.pictures.album import save_pictures
from ...result.replay import MotionRecord
from ...result.report import report_html
from ...result.run_writers import replaced_folder
from ...statistics.budget.systematic_effects import source_label
from ...statistics.concerns import remedy_for
from .band import DESCRIPTION, OF_GRIP, OTHERS
from .execution_problems import (
    CHECK_FILE,
    POSES_FILE,
    execution_problems,
    problem_text,
    write_commands,
)
from .hand_motion import angular_motion
from .motion_plan import BandContribution, MotionPlan
from .pictures import plan_figures
from .trajectory_log import write_trajectory_mcap

PLAN_FILE = "plan.json"
HAND_FILE = "hand.csv"
PREDICTION_FILE = "predicted_points.csv"
FILM_FILE = "motion.gif"
TRAJECTORY_FILE = "trajectory.mcap"
REPORT_FILE = "report.html"
CAPTIONS = {
    "hand": "The hand over time",
    "commands": "Tensions and pressures, with their limits",
    "tracking": "Displacements of the points with their 95 % band, and references, dashed or dots",
}
# What reduces sources of the band that no budget has.
REMEDIES = {
    OTHERS: "record longer, measure the places of the markers, or refine the mesh",
    DESCRIPTION: "use a finer mesh or another law",
    OF_GRIP: 'keep the body in the gripper, and state hand_eye = { scope = "shared" }',
}
# Form of plan.json.
SCHEMA = 2
FRAMES_PER_SECOND = 25.0


@validated
def write_plan(
    plan: MotionPlan,
    folder: str | Path,
    rate_hz: float | None = None,
    with_film: bool = True,
    with_mcap: bool = False,
    say: Callable[[str], None] = lambda _: None,
) -> Path:
    """Write the folder of a plan atomically, and return its path; pictures, report and film are drawn
    into the finished folder, and Ctrl-C leaves out the remaining ones.

    It contains poses.csv (poses in the format of the problem), hand.csv (the hand with velocity and
    acceleration), command_<name>.csv of each planned tendon and pressure, predicted_points.csv,
    pictures, report.html, plan.json, with `with_film` motion.gif, and, if the problem was read from a file,
    check.toml and identify.toml for a recorded execution.

    Parameters
    ----------
    folder : str or Path
        Folder, which may contain an earlier plan; that is replaced.
    rate_hz : float, optional
        Rate of poses, hand and commands; four times that of the samples by default.
    with_film : bool
        Whether to render the motion as a film.
    with_mcap : bool
        Whether to write trajectory.mcap, see `write_trajectory_mcap`.
    say : callable
        Called with the present activity.

    Raises
    ------
    InputError
        If the folder contains anything but an earlier plan, or cannot be written, or a package for
        the MCAP file is missing.
    """
    target, is_written = Path(folder), False
    try:
        with INTERRUPTS.deferred():
            with replaced_folder(target, marker_file=PLAN_FILE, content_word="plan") as place:
                _write_results(plan, place, target, rate_hz=rate_hz, with_mcap=with_mcap)
            is_written = True
        _draw(plan, target, with_film, say)
    except KeyboardInterrupt:
        if not is_written:
            raise
    return target


def _draw(plan: MotionPlan, folder: Path, with_film: bool, say: Callable[[str], None]) -> None:
    """Draw the pictures into the folder of a plan, and write its report and film."""
    figures = plan_figures(plan)
    save_pictures(folder, figures)
    pictures = (Picture(folder / f"{name}.png", CAPTIONS[name]) for name in figures)
    title = f"Plan for {plan.program.body.template.name!r}"
    report = TitledParts(title, (*plan_summary(plan), *pictures), level=1)
    write_text_file(folder / REPORT_FILE, report_html(report))
    if with_film:
        say("rendering the film of the motion (Ctrl-C keeps the plan)")
        film(
            motion_record(plan),
            folder / FILM_FILE,
            fps=FRAMES_PER_SECOND,
            names=("predicted", ""),
            measured="reference",
            paths_m=drawn_paths_m(plan),
        )


def _write_results(
    plan: MotionPlan, place: Path, target: Path, *, rate_hz: float | None, with_mcap: bool
) -> None:
    """Write what a plan is without its pictures; plan.json at the end."""
    t_s = command_times_s(plan, rate_hz)
    write_poses_csv(place / POSES_FILE, plan.poses(t_s))
    write_columns_csv(place / HAND_FILE, hand_columns(plan, t_s))
    write_commands(plan, place, t_s)
    for name, content in execution_problems(plan, place, target.resolve()).items():
        (place / name).write_text(problem_text(name, content), encoding="utf-8")
    if with_mcap:
        write_trajectory_mcap(plan, place / TRAJECTORY_FILE, t_s)
    if plan.points_m:
        write_markers_csv(
            place / PREDICTION_FILE,
            plan.t_s,
            names=[*plan.points_m],
            positions_m=np.stack([*plan.points_m.values()], axis=1),
        )
    (place / PLAN_FILE).write_text(as_json(plan_json(plan)), encoding="utf-8")


def command_times_s(plan: MotionPlan, rate_hz: float | None = None) -> Array:
    """Return the times (P,) since the start at which a controller gets poses [s]: at a rate, to the
    end of the plan.
    """
    last_s = plan.t_s[-1]
    rate = float(4 / plan.t_s[1]) if rate_hz is None else rate_hz
    return np.arange(int(np.ceil(last_s * rate - 1e-9)) + 1) / rate


def hand_columns(plan: MotionPlan, t_s: Array) -> dict[str, Array]:
    """Return the hand over time, by name of the column: position, rotation vector from the initial
    orientation, velocity, angular velocity, acceleration and angular acceleration in world axes.
    """
    value, rate, growth = plan.motion.derivatives(t_s)
    spin, spin_rate = angular_motion(value[:, 3:], rate[:, 3:], curvature=growth[:, 3:])
    blocks = {
        "{}_m": value[:, :3] + plan.program.frame.position_m,
        "r{}_rad": value[:, 3:],
        "v{}_m_s": rate[:, :3],
        "w{}_rad_s": spin,
        "a{}_m_s2": growth[:, :3],
        "alpha_{}_rad_s2": spin_rate,
    }
    return {"t_s": t_s} | {
        name.format(axis): values[:, k]
        for name, values in blocks.items()
        for k, axis in enumerate("xyz")
    }


def drawn_paths_m(plan: MotionPlan) -> dict[str, Array]:
    """Return the paths (T, 1, 3) of the hand and (T, P, 3) of the points of a plan [m]."""
    hand_m = plan.program.frame.position_m + plan.motion.derivatives(plan.t_s).value[:, :3]
    return {"hand": hand_m[:, None], "points": np.stack([*plan.points_m.values()], axis=1)}


def motion_record(plan: MotionPlan) -> MotionRecord:
    """Return the predicted motion, with the references of positions in place of measured markers."""
    wanted: dict[str, Array] = {}
    for each in plan.program.references:
        known = wanted.setdefault(each.name, np.full((len(plan.t_s), 3), np.nan))
        wanted[each.name] = np.where(np.isfinite(each.position_m), each.position_m, known)
    wanted = {name: path_m for name, path_m in wanted.items() if np.isfinite(path_m).any()}
    fine = plan.fine
    record = MotionRecord.from_experiment(fine.experiment, (fine.positions_m, fine.markers_m))
    predicted_m = np.zeros((len(plan.t_s), len(wanted), 3))
    reference_m = np.zeros_like(predicted_m)
    for k, (name, path_m) in enumerate(wanted.items()):
        predicted_m[:, k] = plan.points_m[name]
        # A free coordinate is shown as predicted.
        known = np.where(np.isfinite(path_m), path_m, plan.points_m[name])
        reference_m[:, k] = np.where(np.isfinite(path_m).any(axis=1, keepdims=True), known, np.nan)
    return replace(record, marker_names=[*wanted], measured_m=reference_m, markers_m=predicted_m)


def plan_json(plan: MotionPlan) -> dict[str, Any]:
    """Return the content of plan.json, in types that JSON has."""
    program = plan.program
    times_s = command_times_s(plan)
    commands = plan.commands(times_s)
    return {
        "schema": SCHEMA,
        "experiment": program.body.template.name,
        "run": None if program.body.run is None else str(program.body.run),
        "warnings": list(program.body.warnings),
        "status": plan.answer.status,
        "duration_s": program.task.duration_s,
        "samples": len(plan.t_s),
        "time_steps": len(program.grid_since_s) - 1,
        "unknowns": program.space.size,
        "seconds": plan.seconds,
        "objective": program.objective_parts(plan.answer.c, plan.answer.x),
        "history": plan.answer.history,
        "references": [
            {"point": each.name, **vars(plan.tracking_error(each))} for each in program.references
        ],
        "lowest_frequency_hz": program.lowest_hz if np.isfinite(program.lowest_hz) else None,
        "residual_vibration_m": plan.residual_vibration_m,
        "time_step_error_m": plan.time_step_error_m,
        "description_std_m": program.body.description_std_m,
        "band_contributions": [each._asdict() for each in plan.band_contributions],
        "limits": {}
        if not program.task.hand.free
        else {
            name: {"limit": getattr(program.limits, name), "share_used": float(share)}
            for name, share in plan.shares.items()
        },
        "limits_reached": plan.active_limits,
        "binding_limits": [each._asdict() for each in plan.binding_limits],
        "body": plan.body_extremes,
        "intervals": plan.intervals,
        "largest_error_m": plan.largest_error_m,
        "accepted_error_m": program.task.largest_error_m,
        "sufficient_duration_s": plan.sufficient_duration_s,
        "signals": [
            {
                "name": each.name,
                "unit": each.unit,
                "lowest": float(values.min()),
                "highest": float(values.max()),
                "largest_rate": float(np.abs(np.gradient(values, times_s)).max()),
            }
            for each, values in zip(program.signals, commands.values(), strict=True)
        ],
        "hand": {
            "intervals": program.space.intervals,
            "coefficients": plan.motion.coefficients,
            "initial_position_m": program.frame.position_m,
        },
    }


def _missed_lines(plan: MotionPlan) -> list[Shown]:
    """Return by how much a plan misses what is accepted, and what limits it."""
    enough_s = plan.sufficient_duration_s
    longer = (
        ""
        if enough_s is None
        else f"duration_s = {enough_s:.3g} with the times of references in proportion, or "
    )
    limits = listed([each.name for each in plan.binding_limits if each.gain_per_percent > 0])
    exceeding = [
        (each, error)
        for each in plan.program.references
        if (error := plan.tracking_error(each)).largest_m > error.accepted_m
    ]
    if limits:
        cause, remedy = f"limited by {limits}", "wider limits"
    elif exceeding and all(e.at_waypoints_m <= e.accepted_m for _, e in exceeding):
        cause = "the waypoints are reached: the path between them is the cause"
        remedy = 'more time between them, or interpolation = "none"'
    else:
        cause = "no limit of the hand binds"
        remedy = "a reference that the free coordinates, the end and the other references allow"
    if plan.program.task.largest_error_m is not None:
        missed = [
            f"the largest error is {1e3 * plan.largest_error_m:.3g} mm, more than largest_error_m"
        ]
    else:
        missed = [
            f"{each.name} misses its reference by {1e3 * error.largest_m:.3g} mm, more than "
            f"{1e3 * error.accepted_m:.3g} mm: half of its way, or its band"
            for each, error in exceeding
        ]
    return [Line(f"{each}; {cause}; expected {longer}{remedy}", "check") for each in missed]


def _limit_lines(plan: MotionPlan) -> list[Shown]:
    """Return the lines about limits, and about an error that is larger than accepted."""
    lines: list[Shown] = []
    task = plan.program.task
    if task.shortest:
        lines.append(f"shortest duration: {task.duration_s:.3g} s")
    for each, values in zip(plan.program.signals, plan.commands(plan.t_s).values(), strict=True):
        lines.append(
            f"{each.name}: {values.min():.4g} to {values.max():.4g} {each.unit} "
            f"(limits {each.lowest:.4g} to {each.highest:.4g} {each.unit})"
        )
    if plan.exceeds_error:
        lines += _missed_lines(plan)
    units = {
        "largest_stretch": ("largest stretch", 1.0, ""),
        "clearance_m": ("clearance", 1e3, " mm"),
    }
    for key, value in plan.body_extremes.items():
        words, factor, unit = units[key]
        limit = factor * getattr(task.avoid, key)
        lines.append(f"{words}: {factor * value:.4g}{unit} (limit {limit:.4g}{unit})")
    if plan.exceeds_body_limits:
        lines.append(
            Line("no motion was found that keeps the limits of the body ([avoid], or own)", "check")
        )
    if not plan.binding_limits:
        lines.append(f"limits reached: {', '.join(plan.active_limits) or 'none'}")
    for each in plan.binding_limits:
        spans = ", ".join(f"{first:.3g}–{last:.3g}" for first, last in each.spans_s)
        lines.append(
            f"{each.name} binds at {spans} s; 1 % more would improve the objective by "
            f"{100 * each.gain_per_percent:.2g} %"
        )
    return lines


def _interval_lines(plan: MotionPlan) -> list[Shown]:
    """Return the table of the intervals after a recording of the plan, and what they contain; empty
    without information in the task.
    """
    section, body = plan.program.task.information, plan.program.body
    if section is None:
        return []
    rows = tuple(
        (symbol_of(name), f"{100 * half_width:.3g}", f"{100 * section.half_width:.3g}")
        for name, half_width in plan.intervals.items()
    )
    data = "this recording" if body.run is None else "the recordings of the run and this one"
    lines: list[Shown] = [
        Table("", ("constant", "95 % interval ± [%]", "wanted ± [%]"), rows=rows),
        f"intervals by the noise of {data}; systematic effects come in addition",
    ]
    if plan.exceeds_width:
        lines.append(
            Line("not all intervals are as narrow as half_width; expected a longer duration_s or "
                 "wider limits", "check")
        )  # fmt: skip
    return lines


def _improvement(largest: BandContribution) -> str:
    """Return the line about the largest contribution to the band, and what reduces it."""
    remedy = REMEDIES.get(largest.source) or remedy_for(largest.source)
    percent = f"{100 * largest.share:.0f} % of the band's variance"
    return f"{percent} come from {source_label(largest.source)}; to reduce it, {remedy}"


def plan_summary(plan: MotionPlan, folder: Path | None = None) -> list[Shown]:
    """Return a plan on one screen, and where it is, if it was written to a folder."""
    notes: list[Shown] = [Line(f"warning: {text}", "check") for text in plan.program.body.warnings]
    if plan.interrupted:
        notes.append(Line("interrupted: the best plan so far", "check"))
    elif not plan.is_complete:
        notes.append(Line(f"the search ended early: {plan.answer.status}", "check"))
    rows = []
    for each in plan.program.references:
        error = plan.tracking_error(each)
        if not np.isfinite(error.rms_m):
            continue
        rows.append(
            (
                each.name,
                f"{1e3 * error.rms_m:.3g}",
                f"{1e3 * error.largest_m:.3g}",
                "" if error.band_m is None else f"{1e3 * error.band_m:.3g}",
                f"{round(1e3 * each.from_lines_m, 3):.3g}",
            )
        )
    shown: list[Shown] = [*notes, *_interval_lines(plan)]
    if rows:
        heads = ("point", "RMS error [mm]", "largest [mm]", "95 % band ± [mm]", "from polygon [mm]")
        shown.append(Table("", heads, rows=tuple(rows)))
    if plan.residual_vibration_m is not None:
        shown.append(f"residual vibration: {1e3 * plan.residual_vibration_m:.3g} mm")
    if plan.band_contributions:
        shown.append(_improvement(plan.band_contributions[0]))
    if plan.fine.experiment.is_static:
        shown.append("static: each sample is an equilibrium")
    else:
        shown.append(f"time steps change the points by {1e3 * plan.time_step_error_m:.2g} mm")
    if (change := plan.fine.branch_change) is not None:
        shown.append(
            Line(
                f"the body does not reach the equilibrium at {change.time_s:.4g} s along a path of "
                f"stable ones; expected a shorter sample_s, or a task with less load",
                "check",
            )
        )
    shown += _limit_lines(plan)
    if folder is None:
        return shown
    page = f"; the page is {REPORT_FILE}" if (folder / REPORT_FILE).is_file() else ""
    shown.append(f"written to {folder}{page}")
    if (folder / CHECK_FILE).is_file() and not plan.exceeds_error:
        shown.append(
            "next: execute the plan, replace poses.csv and predicted_markers.csv with the recorded "
            f"files, and run collocation-sysid solve {folder / CHECK_FILE}"
        )
    return shown
