"""Rigid motions from markers: the pose of a cluster at every frame, and a frame change.

The rotation R and translation p that minimise Σ_b w_b ‖R X_b + p − y_b‖² follow from the singular
value decomposition of the weighted cross-covariance of X and y (Kabsch 1976; with the sign that
excludes reflections, Umeyama 1991).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ..common.array_types import Array
from ..common.checked_arrays import read_only_floats, read_only_tracks
from ..errors import InputError
from .marker_files import MarkerTable
from .poses import PoseSequence
from .sample_times import STEP_TOLERANCE

# Smallest spread of markers across their line, relative to the spread along it, that determines a
# rotation.
_LEAST_RELATIVE_SPREAD = 0.01


@dataclass(frozen=True, eq=False)
class RigidFit:
    """Poses of a cluster of markers, x = R X + p, and their residuals.

    Parameters
    ----------
    positions_m : (T, 3) array
        Translations p; NaN at missing frames.
    quaternions_xyzw : (T, 4) array
        Rotations R; NaN at missing frames.
    residual_m : (T,) array
        Weighted root mean square over the markers present; NaN at missing frames.
    missing : (T,) bool array
        Frames without three markers off one line.
    """

    positions_m: Array
    quaternions_xyzw: Array
    residual_m: Array
    missing: NDArray[np.bool_]

    def poses(self, t_s: ArrayLike) -> PoseSequence:
        """Return the poses at the times `t_s` (T,) of the frames.

        Missing frames between others are interpolated smoothly; those before the first and after
        the last pose are left out. A single pose is constant.

        Raises
        ------
        InputError
            If there is no pose at all, or times do not increase.
        """
        times = np.asarray(t_s, dtype=np.float64)
        there = np.flatnonzero(~self.missing)
        if not there.size:
            raise InputError(
                "no frame contains three markers of the grasp that are not on one line; expected at "
                "least one such frame: check the names of these markers and their missing samples"
            )
        known = PoseSequence(
            times[there], self.positions_m[there], quaternions_xyzw=self.quaternions_xyzw[there]
        )
        if len(there) == 1:
            return known
        within = times[there[0] : there[-1] + 1]
        rotations, positions = known.at(within)
        return PoseSequence(
            within, positions, quaternions_xyzw=Rotation.from_matrix(rotations).as_quat()
        )


def fit_poses(
    reference_m: ArrayLike, tracks_m: ArrayLike, weights: ArrayLike | None = None
) -> RigidFit:
    """Fit the rigid motion x = R X + p of markers at every frame, by weighted least squares.

    Where the visible markers of positive weight do not determine a rotation, the pose is NaN and
    the frame is counted as missing.

    Parameters
    ----------
    reference_m : (B, 3) array
        Places X of the markers on the undeformed body.
    tracks_m : (T, B, 3) array
        Measured positions, NaN where missing.
    weights : (B,) array, optional
        At least 0; all 1 by default. A marker of weight 0 has no influence.

    Raises
    ------
    InputError
        If shapes disagree, a weight is negative, or the places of the markers with a positive
        weight lie on one line.
    """
    reference = read_only_floats(reference_m, (None, 3), name="reference_m")
    count = len(reference)
    tracks = read_only_tracks(tracks_m, (None, count, 3), name="tracks_m")
    of_marker = read_only_floats(
        np.ones(count) if weights is None else weights, (count,), name="weights"
    )
    if (of_marker < 0).any():
        raise InputError(f"a weight is {of_marker.min():g}; expected 0 or more")
    if not _fixes_rotation(reference[None], of_marker[None])[0]:
        raise InputError(
            f"the {np.count_nonzero(of_marker)} markers of a rigid fit lie on one line or in one "
            "place; expected at least three that do not"
        )
    weight = of_marker * np.isfinite(tracks[:, :, 0])
    repeated = np.broadcast_to(reference, tracks.shape)
    missing = ~_fixes_rotation(repeated, weight)
    rotations, translations = _best_motions(repeated, tracks, weight=weight)
    fitted = np.einsum("tij,bj->tbi", rotations, reference) + translations[:, None]
    distance = np.linalg.norm(tracks - fitted, axis=2)
    total = np.where(missing, np.nan, weight.sum(axis=1))
    residual = np.sqrt(np.nansum(weight * distance**2, axis=1) / total)
    quaternions = Rotation.from_matrix(rotations).as_quat()
    gap = missing[:, None]
    return RigidFit(
        np.where(gap, np.nan, translations),
        np.where(gap, np.nan, quaternions),
        residual_m=residual,
        missing=missing,
    )


class TemplateFit(NamedTuple):
    """A rigid change of frame, x → rotation x + translation_m, and its residuals."""

    rotation: Array  # (3, 3)
    translation_m: Array  # (3,)
    # (k,): distance of each marker of the template from its place; NaN for a marker without a
    # sample in the window.
    residual_m: Array

    def apply(self, table: MarkerTable) -> MarkerTable:
        """Return all markers of a table in the new frame, with their notes; the
        table is unchanged.
        """
        positions_m = table.positions_m @ self.rotation.T + self.translation_m
        return replace(table, positions_m=positions_m, offsets_s=None)


def align_to_template(
    table: MarkerTable, template: Mapping[str, Sequence[float]], window_s: tuple[float, float]
) -> TemplateFit:
    """Fit the change from the camera's frame to the body's, from mean marker positions in a window.

    The mean is over the present samples of each marker; every marker with a sample has the same
    weight.

    Parameters
    ----------
    table : MarkerTable
        Tracks in the camera's frame.
    template : mapping of marker names to (x, y, z)
        Places [m] in the body's frame, at least three not on one line.
    window_s : (float, float)
        First and last time of the frames to average: while the body rests.

    Raises
    ------
    InputError
        If a name is not in the table, the window is empty, or fewer than three markers that are not
        on one line have samples in it.
    """
    for name in template:
        if name not in table.names:
            raise InputError(
                f"no marker '{name}' for the template; there are {', '.join(table.names)}"
            )
    slack_s = STEP_TOLERANCE * float(np.median(np.diff(table.t_s))) if len(table.t_s) > 1 else 0.0
    inside = (table.t_s >= window_s[0] - slack_s) & (table.t_s <= window_s[1] + slack_s)
    if not inside.any():
        raise InputError(
            f"the window [{window_s[0]:g}, {window_s[1]:g}] s of the template contains no sample; "
            f"expected a window within the times of the markers, from {table.t_s[0]:.9g} s to "
            f"{table.t_s[-1]:.9g} s"
        )
    places = np.array([template[name] for name in template], dtype=np.float64)
    chosen = [table.names.index(name) for name in template]
    samples = read_only_tracks(
        table.positions_m[inside][:, chosen], (None, len(chosen), 3), name="marker positions"
    )
    count = np.isfinite(samples[:, :, 0]).sum(axis=0)
    means = np.where(
        count[:, None] > 0, np.nansum(samples, axis=0) / np.maximum(count, 1)[:, None], np.nan
    )
    weight = (count > 0).astype(np.float64)[None]
    if not _fixes_rotation(places[None], weight)[0]:
        raise InputError(
            f"{np.count_nonzero(count)} of the template's markers have samples in the window, "
            "which do not determine a rotation; expected at least three that are not on one line"
        )
    rotations, translations = _best_motions(means[None], places[None], weight=weight)
    moved = means @ rotations[0].T + translations[0]
    return TemplateFit(
        rotations[0], translations[0], residual_m=np.linalg.norm(moved - places, axis=1)
    )


def least_rigid_marker(reference_m: Array, positions_m: Array) -> int:
    """Return the index, from 0, of the marker whose distances to the others differ most in sum
    between two configurations, the places `reference_m` and `positions_m`, (B, 3) each; distances
    to NaN are ignored.

    The frames of the configurations need not agree, as distances do not depend on them. A rigid fit
    would distribute one marker's motion over all of them.
    """

    def distances(points: Array) -> Array:
        """Return the distances (B, B) between points (B, 3)."""
        return np.linalg.norm(points[:, None] - points[None], axis=2)

    change = np.abs(distances(positions_m) - distances(reference_m))
    return int(np.nansum(change, axis=1).argmax())


def _fixes_rotation(points: Array, weight: Array) -> NDArray[np.bool_]:
    """Return for each frame (T,) whether at least two of the points (B, 3) are apart."""
    used = (weight > 0).astype(np.float64)
    centred = (points - _mean(points, used)[:, None]) * used[:, :, None]
    spread = (
        np.linalg.svd(centred, compute_uv=False) if points.shape[1] else np.zeros((len(points), 1))
    )
    if spread.shape[1] < 2:
        return np.zeros(len(points), dtype=bool)
    return spread[:, 1] > _LEAST_RELATIVE_SPREAD * spread[:, 0]


def _mean(points: Array, weight: Array) -> Array:
    """Return the weighted mean (T, 3) of points (T, B, 3); 0 without weights."""
    total = np.maximum(weight.sum(axis=1), np.finfo(float).tiny)
    present = np.where(weight[:, :, None] > 0, points, 0.0)
    return np.einsum("tb,tbi->ti", weight, present) / total[:, None]


def _best_motions(source: Array, target: Array, weight: Array) -> tuple[Array, Array]:
    """Return the motions (T, …) of weighted least squares; points of weight zero may be NaN."""
    source_mean = _mean(source, weight)
    target_mean = _mean(target, weight)
    used = weight[:, :, None] > 0
    a = np.where(used, source - source_mean[:, None], 0.0)
    b = np.where(used, target - target_mean[:, None], 0.0)
    u, _, vt = np.linalg.svd(np.einsum("tb,tbi,tbj->tij", weight, b, a))
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    rotations = u @ vt
    return rotations, target_mean - np.einsum("tij,tj->ti", rotations, source_mean)
