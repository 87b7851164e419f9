"""Marker files of an experiment: tracks in the body's frame, and poses of the gripper."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..common.array_types import Array
from ..recording import MarkerTable, PoseSequence, align_to_template, fit_poses, read_markers
from ..recording.rigid_fit import least_rigid_marker
from .recording_schema import ExperimentSection, MarkersSection, MovedSection

# A frame is reported if its residual exceeds the median by this factor.
UNUSUAL = 3.0
# Residual over the markers' span that is due to rounding.
ROUNDING = 1e-6


def gripper_markers(section: ExperimentSection) -> set[str]:
    """Return the names of the markers from which poses of grasps and obstacles are computed; empty
    if there are none.
    """
    return {name for moved in section.moved_sections for name in moved.markers or ()}


def read_marker_tracks(section: ExperimentSection, file: Path) -> MarkerTable:
    """Return the tracks of the markers that an experiment uses, in the file's frame.

    They are the named markers first, then those of template, grippers and obstacles; all of the
    file if the problem names none. Labels, unit and frame rate of the section are applied.

    Raises
    ------
    InputError
        If the file is unusable or lacks a marker.
    """
    markers = section.markers
    names = None
    if markers.names is not None:
        other_names = [*(markers.template_m or ()), *sorted(gripper_markers(section))]
        names = [*markers.names, *(n for n in dict.fromkeys(other_names) if n not in markers.names)]
    return read_markers(
        file,
        names=names,
        labels=markers.labels,
        length_unit=markers.length_unit,
        rate_hz=markers.rate_hz,
    )


def transform_to_body_frame(
    markers: MarkersSection, table: MarkerTable
) -> tuple[MarkerTable, list[str]]:
    """Return the tracks moved rigidly so that the template fits, and notes on the residuals.

    The fit compares the template with the mean positions of its markers within
    `template_window_s`, and the same motion is applied to all tracks at all times. Without template
    the tracks are returned as they are, without notes.

    Parameters
    ----------
    table : MarkerTable
        Tracks in the camera's frame; not changed.

    Raises
    ------
    InputError
        If the fit fails.
    """
    if markers.template_m is None or markers.template_window_s is None:
        return table, []
    fit = align_to_template(table, markers.template_m, window_s=markers.template_window_s)
    names = list(markers.template_m)
    residuals_m = fit.residual_m
    residual_list = ", ".join(
        f"{name} {_mm(off)}"
        for name, off in zip(names, residuals_m, strict=True)
        if np.isfinite(off)
    )
    return fit.apply(table), [
        f"the markers were moved rigidly to the template; remaining distances: {residual_list}"
    ]


def poses_from_markers(
    grasp: MovedSection, table: MarkerTable, window_s: tuple[float, float] | None
) -> tuple[PoseSequence, list[str]]:
    """Return poses fitted to the tracks of a grasp's markers, and notes on residuals and missing
    frames.

    Parameters
    ----------
    grasp : MovedSection
        Grasp or obstacle with markers.
    table : MarkerTable
        Tracks in the body's frame.
    window_s : tuple of two floats or None
        First and last time that the notes refer to [s]; None for all.

    Returns
    -------
    (PoseSequence, list of str)
        Poses at all times of the table, with the interpolation of the grasp.

    Raises
    ------
    InputError
        If the fit is not possible.
    """
    assert grasp.markers is not None
    names = list(grasp.markers)
    reference_m = np.array([grasp.markers[name] for name in names])
    tracks = table.positions_m[:, [table.names.index(name) for name in names]]
    fit = fit_poses(reference_m, tracks, weights=[grasp.weights.get(name, 1.0) for name in names])
    poses = replace(fit.poses(table.t_s), interpolation=grasp.interpolation)
    first_s, last_s = window_s or (-np.inf, np.inf)
    is_in_window = (table.t_s >= first_s) & (table.t_s <= last_s)
    notes = []
    if incomplete_frames := int((fit.missing & is_in_window).sum()):
        notes.append(
            f"{incomplete_frames} of {is_in_window.sum()} frames contain fewer than three of the "
            f"markers {', '.join(names)}; the poses of these frames are interpolated"
        )
    residual_m = np.where(is_in_window, fit.residual_m, np.nan)
    if np.isfinite(residual_m).any():
        notes.append(_rigidity_note(names, reference_m, tracks, table.t_s, residual_m))
    return poses, notes


def _rigidity_note(
    names: list[str], reference_m: Array, tracks: Array, t_s: Array, residual_m: Array
) -> str:
    """Return a note on the residuals of the rigid fit, with the worst marker if a frame is unusual."""
    median_m = float(np.nanmedian(residual_m))
    worst = int(np.nanargmax(residual_m))
    size_m = float(np.linalg.norm(np.ptp(reference_m, axis=0)))
    limit_m = max(UNUSUAL * median_m, ROUNDING * size_m)
    fit_sentence = (
        f"the markers {', '.join(names)} fit a rigid motion to {_mm(median_m)} (median over "
        "the frames)"
    )
    count = int((residual_m > limit_m).sum())
    if not count:
        return f"{fit_sentence}, at worst {_mm(residual_m[worst])}"
    worst_marker = names[least_rigid_marker(reference_m, tracks[worst])]
    frames = "1 frame is" if count == 1 else f"{count} frames are"
    return (
        f"{fit_sentence}, but {frames} above {_mm(limit_m)}, the worst with "
        f"{_mm(residual_m[worst])} at t = {t_s[worst]:.6g} s (frame {worst + 1}), where "
        f"{worst_marker!r} moves relative to the others"
    )


def _mm(length_m: float) -> str:
    return f"{1e3 * length_m:.3g} mm"
