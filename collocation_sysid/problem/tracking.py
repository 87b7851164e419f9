"""What an experiment's marker file gives: tracks in the body's frame, and poses of the gripper."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..recording import MarkerTable, PoseSequence, align_to_template, fit_poses, read_markers
from ..recording.rigid import loosest_marker
from .recording_schema import ExperimentSection, MarkersSection, MovedSection

# A frame is reported when its residual is this many times the usual one, and above rounding.
UNUSUAL, ROUNDING = 3.0, 1e-6


def gripper_markers(section: ExperimentSection) -> set[str]:
    """Names of the markers that grasps are driven by."""
    return {name for moved in section.moved for name in moved.markers or ()}


def read_recorded(section: ExperimentSection, file: Path) -> MarkerTable:
    """Read the markers that an experiment uses, the gripper's included, in the camera's frame."""
    markers = section.markers
    wanted = None
    if markers.names is not None:
        further = [*(markers.template_m or ()), *sorted(gripper_markers(section))]
        wanted = [*markers.names, *(n for n in dict.fromkeys(further) if n not in markers.names)]
    return read_markers(
        file,
        names=wanted,
        labels=markers.labels,
        length_unit=markers.length_unit,
        rate_hz=markers.rate_hz,
    )


def into_body_frame(markers: MarkersSection, table: MarkerTable) -> tuple[MarkerTable, list[str]]:
    """Move the tracks so that the template fits, and tell how well.

    Raises
    ------
    InputError
        If it cannot be fitted, or a marker is farther off than `max_template_residual_m`.
    """
    if markers.template_m is None or markers.template_window_s is None:
        return table, []
    fit = align_to_template(table, markers.template_m, markers.template_window_s)
    names, off_m = list(markers.template_m), fit.residual_m
    worst = int(np.nanargmax(off_m))
    limit_m = markers.max_template_residual_m
    if limit_m is not None and off_m[worst] > limit_m:
        raise InputError(
            f"marker {names[worst]!r} is {off_m[worst]:.3g} m from its place after the rigid fit; "
            f"max_template_residual_m is {limit_m:g}. Check template_m, labels and length_unit, "
            "and that the body rests in template_window_s"
        )
    each = ", ".join(
        f"{name} {_mm(off)}" for name, off in zip(names, off_m, strict=True) if np.isfinite(off)
    )
    return fit.apply(table), [f"the markers were moved rigidly to the template; left over: {each}"]


def poses_from_markers(
    grasp: MovedSection, table: MarkerTable, window_s: tuple[float, float] | None
) -> tuple[PoseSequence, list[str]]:
    """Fit the poses of a grasp to its markers' tracks, and tell where they are not rigid.

    Only frames within `window_s` are told of.
    """
    assert grasp.markers is not None
    names = list(grasp.markers)
    places = np.array([grasp.markers[name] for name in names])
    tracks = table.positions_m[:, [table.names.index(name) for name in names]]
    fit = fit_poses(places, tracks, [grasp.weights.get(name, 1.0) for name in names])
    poses = replace(fit.poses(table.t_s), interpolation=grasp.interpolation)
    first_s, last_s = window_s or (-np.inf, np.inf)
    inside = (table.t_s >= first_s) & (table.t_s <= last_s)
    notes = []
    if lost := int((fit.missing & inside).sum()):
        notes.append(
            f"{lost} of {inside.sum()} frames lack three of {', '.join(names)}; poses between "
            "others are interpolated there"
        )
    residual_m = np.where(inside, fit.residual_m, np.nan)
    if np.isfinite(residual_m).any():
        notes.append(_rigidity(names, places, tracks, table.t_s, residual_m, grasp.max_residual_m))
    return poses, notes


def _rigidity(
    names: list[str],
    places: Array,
    tracks: Array,
    t_s: Array,
    residual_m: Array,
    max_residual_m: float | None,
) -> str:
    usual_m, worst = float(np.nanmedian(residual_m)), int(np.nanargmax(residual_m))
    size_m = float(np.linalg.norm(np.ptp(places, axis=0)))
    limit_m = max_residual_m or max(UNUSUAL * usual_m, ROUNDING * size_m)
    told = f"{', '.join(names)} fit a rigid motion to {_mm(usual_m)} (median over the frames)"
    count = int((residual_m > limit_m).sum())
    if not count:
        return f"{told}, at worst {_mm(residual_m[worst])}"
    loosest = names[loosest_marker(places, tracks[worst])]
    frames = "1 frame is" if count == 1 else f"{count} frames are"
    return (
        f"{told}, but {frames} above {_mm(limit_m)}, the worst with {_mm(residual_m[worst])} at "
        f"t = {t_s[worst]:.6g} s (frame {worst + 1}), where {loosest!r} moves against the others"
    )


def _mm(length_m: float) -> str:
    return f"{1e3 * length_m:.3g} mm"
