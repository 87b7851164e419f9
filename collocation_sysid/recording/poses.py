"""Rigid motions over time, by which grasps carry nodes of a body.

A pose maps undeformed to current positions, x = R X + p. Between the samples of a sequence the
motion is smooth (splines with continuous accelerations), linear, or constant (zero-order hold).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ..common.array_types import Array, Index
from ..common.checked_arrays import as_array, float_converter, point_text, read_only_floats
from ..common.declarations import declaration, key
from ..common.validated_classes import validated
from ..errors import InputError
from .sample_times import TIME_TOLERANCE_S, first_unordered_time

Interpolation = Literal["smooth", "linear", "hold"]
# Axes of a measured vector: those of the world, or of the undeformed body as its grasp carries it.
Frame = Literal["world", "grasp"]
# Rotation (3, 3) and translation (3,) of each grasp at one time.
Poses = tuple[tuple[Array, Array], ...]

# Largest deviation of a quaternion's norm from one: files print four digits or more.
QUATERNION_NORM_TOLERANCE = 1e-3
# A held pose starts at its sample, also if the time is rounded to just before it.
_INTERVAL_SNAP_STEPS = 1e-6
# Largest entry of RᵀR − I of a rotation: files print few digits, and mistakes are far larger.
_ORTHONORMALITY_TOLERANCE = 1e-3
# Largest deviation of a matrix's last row from 0, 0, 0, 1, which files print exactly.
_LAST_ROW_TOLERANCE = 1e-6
# A motion that its samples resolve is not this many times slower just before and just after.
_LEAST_JUMP_RATIO = 10.0
# Smallest jump as a share of the range of the values: less is rounding.
_LEAST_JUMP_SHARE = 1e-3
# Longest time between poses [s] at which they still determine a smooth motion between them.
LONGEST_STEP_S = 1.0
# Largest difference of the poses of a grasp at rest, in metres and in a quaternion's components.
LARGEST_REST_DIFFERENCE = 1e-6
# Largest relative change of the distance of two points of a rigid body, in nine of ten samples.
_LARGEST_CHANGE = 0.1
# Measured places nearest to a node that determine its displacement.
_NEAREST_PLACES = 50
# Relative spread of places along a direction below which they have no gradient along it.
_FLATNESS = 0.01


@dataclass(frozen=True, eq=False)
class FaceDeformation:
    """Measured displacements of a face beyond its rigid motion, along the axes of the world.

    Between the places they are an affine map and radial functions (`RBFInterpolator` of SciPy with
    the kernel "linear"), which agree with every measured displacement.
    """

    t_s: Array  # (m,): times of the measurement
    places_m: Array  # (k, 3): places on the undeformed body
    displacements_m: Array  # (m, k, 3)
    # Displacements (m, 3n) at points that were asked for.
    _known: dict[bytes, Array] = field(default_factory=dict, init=False)

    def at(self, points_m: Array, t_s: Array, interpolation: Interpolation) -> Array:
        """Return the displacements (T, n, 3) [m] of undeformed points (n, 3) at the times `t_s`
        (T,); constant before the first and after the last measurement.
        """
        key = points_m.tobytes()
        if key not in self._known:
            self._known[key] = self._at_points(points_m)
        values = self._known[key]
        times = np.clip(t_s, self.t_s[0], self.t_s[-1])
        if len(self.t_s) == 1 or interpolation == "hold":
            moved = values[np.searchsorted(self.t_s, times + TIME_TOLERANCE_S, side="right") - 1]
        elif interpolation == "smooth" and len(self.t_s) > 2:
            moved = smooth_spline(self.t_s, values)(times)
        else:
            moved = scipy.interpolate.interp1d(self.t_s, values, axis=0)(times)
        return moved.reshape(len(times), len(points_m), 3)

    def _at_points(self, points_m: Array) -> Array:
        """Return the displacements (m, 3n) of points (n, 3) at the times of the measurement."""
        middle_m = self.places_m.mean(axis=0)
        size_m = self.places_m.std(axis=0).max()
        measured, asked = (
            np.column_stack([np.ones(len(each)), (each - middle_m) / size_m])
            for each in (self.places_m, points_m)
        )
        values = np.moveaxis(self.displacements_m, 0, 1).reshape(len(measured), -1)
        affine = np.linalg.lstsq(measured, values, rcond=_FLATNESS)[0]
        radial = scipy.interpolate.RBFInterpolator(
            self.places_m,
            values - measured @ affine,
            neighbors=min(_NEAREST_PLACES, len(measured)),
            kernel="linear",
        )
        at_points = asked @ affine + radial(points_m)
        by_time = at_points.reshape(len(points_m), len(self.t_s), 3)
        return np.moveaxis(by_time, 1, 0).reshape(len(self.t_s), -1)

    def require_near(self, points_m: Array, edge_m: float) -> None:
        """Raise an `InputError` for a point (of n, 3) that is farther from all places than an edge
        of the mesh and than the largest distance from a place to the next.
        """
        tree = KDTree(self.places_m)
        spacing_m = float(tree.query(self.places_m, 2)[0][:, 1].max())
        away_m = np.asarray(tree.query(points_m)[0])
        if away_m.max() > 1.01 * max(edge_m, spacing_m):
            raise InputError(
                f"the node at {point_text(points_m[away_m.argmax()])} m is {away_m.max():.3g} m away "
                f"from the nearest place of a measured displacement; expected at most "
                f"{max(edge_m, spacing_m):.3g} m: select fewer nodes, or check that the places are "
                "those of the undeformed body in the frame of the mesh"
            )


@declaration
class PoseSequence:
    """Rigid motion x(t) = R(t) X + p(t) from undeformed to current positions.

    Parameters
    ----------
    t_s : (m,) array
        Sample times, strictly increasing. A single sample is a pose that never changes.
    positions_m : (m, 3) array
        Translations p.
    quaternions_xyzw : (m, 4) array
        Rotations R, scalar last as in SciPy. Norms within 1e-3 of one are normalised; signs are
        made continuous in time.
    interpolation : {"smooth", "linear", "hold"}
        Between samples: cubic splines of the position and of the quaternion, which is then
        normalised; linear in position with SLERP in rotation; or the latest sample. Across a jump
        (see `jump_intervals`) and between only two poses "smooth" is linear.
    first_motion : (4, 4) array
        Constant rigid motion [[R, p], [0, 1]] [m] that the poses contain as their first part, such
        as a hand–eye transform; set by `after`, by default the identity. It changes no pose, but
        separates the poses of a file from it when mistakes in the file are searched.
    deformation : FaceDeformation, optional
        Measured displacements of the carried nodes, which are added to the rigid motion.

    Raises
    ------
    InputError
        If shapes disagree, a value is not finite, time does not increase, or a quaternion is not of
        unit norm; the first bad row is named, counting from 1.
    """

    t_s: Array = key(converter=float_converter((None,), "t_s of the poses", finite=False))
    positions_m: Array = key(converter=as_array)
    quaternions_xyzw: Array = key(converter=as_array)
    interpolation: Interpolation = key(Interpolation, default="smooth")
    first_motion: Array = key(
        converter=float_converter((4, 4), "first_motion of the poses"),
        default_factory=lambda: np.eye(4),
    )
    deformation: FaceDeformation | None = None

    def __post_init__(self) -> None:
        t_s = self.t_s
        m = len(self.t_s)
        if not m:
            raise InputError("a pose sequence needs at least one pose")
        positions_m = read_only_floats(self.positions_m, (m, 3), name="positions_m", finite=False)
        quaternions = read_only_floats(
            self.quaternions_xyzw, (m, 4), name="quaternions_xyzw", finite=False
        )
        if fault := first_pose_fault(t_s, positions_m, quaternions_xyzw=quaternions):
            raise InputError(fault[1], where=f"row {fault[0] + 1}" if m > 1 else None)
        continuous = _unit_and_continuous(quaternions)
        vars(self).update(positions_m=positions_m, quaternions_xyzw=continuous)

    @classmethod
    @validated
    def fixed(cls, t0_s: float = 0.0) -> PoseSequence:
        """Return the identity pose for all time, as a single sample at `t0_s`: grasped nodes stay
        where they are undeformed.
        """
        return cls(
            np.array([t0_s]), np.zeros((1, 3)), quaternions_xyzw=np.array([[0.0, 0.0, 0.0, 1.0]])
        )

    @classmethod
    @validated
    def from_matrices(
        cls, t_s: ArrayLike, matrices: ArrayLike, interpolation: Interpolation = "smooth"
    ) -> PoseSequence:
        """Return the poses of 4×4 matrices [[R, p], [0, 1]], (m, 4, 4) [m], at the times `t_s`
        (m,); `interpolation` as of the class.

        Raises
        ------
        InputError
            If shapes disagree, or a matrix is no rigid motion; the first such matrix is named,
            counting from 1.
        """
        times = read_only_floats(t_s, (None,), name="t_s of the poses", finite=False)
        motions = read_only_floats(
            matrices, (len(times), 4, 4), name="matrices of the poses", finite=False
        )
        if fault := first_matrix_fault(times, motions):
            raise InputError(fault[1], where=f"matrix {fault[0] + 1}")
        quaternions = Rotation.from_matrix(motions[:, :3, :3]).as_quat()
        return cls(
            times, motions[:, :3, 3], quaternions_xyzw=quaternions, interpolation=interpolation
        )

    @classmethod
    @validated
    def from_two_points(
        cls,
        t_s: ArrayLike,
        points_m: ArrayLike,
        reference_m: ArrayLike,
        interpolation: Interpolation = "smooth",
    ) -> PoseSequence:
        """Return the poses of a gripper of which two points were measured.

        They do not show the rotation about their line, which is that of least twist: the smallest
        rotation from the undeformed body to the first sample, and from each sample to the next.

        Parameters
        ----------
        points_m : (m, 2, 3) array
            Measured positions at the times `t_s` (m,); samples with NaN are left out.
        reference_m : (2, 3) array
            Places of the points on the undeformed body.

        Raises
        ------
        InputError
            If the points coincide, their distance changes, or no sample has both.
        """
        times = read_only_floats(t_s, (None,), name="t_s of the poses", finite=False)
        measured = read_only_floats(points_m, (len(times), 2, 3), name="points_m", finite=False)
        reference = read_only_floats(reference_m, (2, 3), name="reference_m")
        known = np.isfinite(measured).all(axis=(1, 2))
        if not known.any():
            raise InputError("found no sample with both points; expected at least one")
        places = np.concatenate([reference[None], measured[known]])
        lines = places[:, 1] - places[:, 0]
        lengths_m = np.linalg.norm(lines, axis=1)
        length_m = float(lengths_m[0])
        if not length_m > 0:
            raise InputError("found two points at the same place; expected two that are apart")
        if np.quantile(np.abs(lengths_m[1:] - length_m), 0.9) > _LARGEST_CHANGE * length_m:
            raise InputError(
                f"the two points are {lengths_m[1:].min():.4g} to {lengths_m[1:].max():.4g} m apart, and "
                f"{length_m:.4g} m on the undeformed body; expected the same distance, of points on "
                "one rigid gripper: check their names, places and unit"
            )
        lines /= lengths_m[:, None]
        before, after = lines[1:-1], lines[2:]
        turns = np.column_stack([np.cross(before, after), 1 + np.sum(before * after, axis=1)])
        rotations = [Rotation.align_vectors(lines[1], lines[0])[0]]
        for turn in Rotation.from_quat(turns):
            rotations.append(turn * rotations[-1])
        whole = Rotation.concatenate(rotations)
        middles = places.mean(axis=1)
        shifts_m = middles[1:] - whole.apply(middles[0])
        return cls(times[known], shifts_m, whole.as_quat(), interpolation)

    def after(self, first: ArrayLike | PoseSequence) -> PoseSequence:
        """Return the composition of these poses with a constant rigid motion that is applied first.

        If these are poses U_t of a gripper and the matrix G places the undeformed body in the
        gripper's frame (hand–eye transform), the result is the poses of the body: x = U_t G X.

        Parameters
        ----------
        first : (4, 4) array or PoseSequence
            [[R, p], [0, 1]] in metres; of a sequence the first pose is taken.

        Raises
        ------
        InputError
            If the matrix is no rigid motion.
        """
        if not isinstance(first, PoseSequence):
            first = PoseSequence.from_matrices([0.0], np.asarray(first)[None])
        rotations = self._rotations
        positions_m = self.positions_m
        motion = np.eye(4)
        motion[:3, :3] = first._rotations[0].as_matrix()
        motion[:3, 3] = first.positions_m[0]
        return replace(
            self,
            positions_m=positions_m + rotations.as_matrix() @ first.positions_m[0],
            quaternions_xyzw=(rotations * first._rotations[0]).as_quat(),
            first_motion=self.first_motion @ motion,
        )

    def with_shift(self, shift_m: ArrayLike) -> PoseSequence:
        """Return the poses with a constant (3,) [m], in the world's frame, added to each of their
        positions.
        """
        return replace(self, positions_m=self.positions_m + np.asarray(shift_m))

    def at(self, t_s: ArrayLike) -> tuple[Array, Array]:
        """Return the poses at the times `t_s` (k,).

        Up to half a sample before the first and after the last pose is allowed: "smooth" and
        "linear" continue the motion of the end interval there, "hold" repeats the end pose. A
        single pose holds at all times.

        Parameters
        ----------
        t_s : (k,) array or float
            Times [s]; a number counts as one time.

        Returns
        -------
        rotation_matrices : (k, 3, 3) array
        translations : (k, 3) array
            Metres.

        Raises
        ------
        InputError
            If a time lies further outside a sequence of several poses.
        """
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        if len(self.t_s) == 1:
            first = np.zeros(len(times), dtype=np.int64)
            return self._rotations.as_matrix()[first], self.positions_m[first]
        self._require_times_covered(times)
        if self.interpolation == "hold":
            snap_s = _INTERVAL_SNAP_STEPS * np.diff(self.t_s).min() + TIME_TOLERANCE_S
            k = np.maximum(np.searchsorted(self.t_s, times + snap_s, side="right") - 1, 0)
            return self._rotations.as_matrix()[k], self.positions_m[k]
        if self.interpolation == "smooth" and len(self.t_s) > 2:
            turned = Rotation.from_quat(self._quaternion_spline(times))
            return turned.as_matrix(), self._position_spline(times)
        return self._interpolate_linearly(times)

    def _interpolate_linearly(self, times: Array) -> tuple[Array, Array]:
        """Return rotations (k, 3, 3) (SLERP) and translations (k, 3), also beyond samples."""
        k = np.clip(np.searchsorted(self.t_s, times, side="right") - 1, 0, len(self.t_s) - 2)
        fraction = ((times - self.t_s[k]) / (self.t_s[k + 1] - self.t_s[k]))[:, None]
        step_m = self.positions_m[k + 1] - self.positions_m[k]
        turn = Rotation.from_rotvec(fraction * self.rotation_steps[k])
        rotations = (Rotation.from_quat(self.quaternions_xyzw[k]) * turn).as_matrix()
        return rotations, self.positions_m[k] + fraction * step_m

    def moved_positions(self, points_m: ArrayLike, t_s: ArrayLike) -> Array:
        """Return positions R X + p (T, k, 3) [m] of undeformed points X (k, 3) at the times `t_s`
        (T,), with the measured deformation; errors as of `at`.
        """
        rotations, translations = self.at(t_s)
        points = np.asarray(points_m, dtype=np.float64)
        carried_m = np.einsum("tij,kj->tki", rotations, points) + translations[:, None, :]
        return carried_m + self.deformation_at(points, t_s)

    def deformation_at(self, points_m: Array, t_s: ArrayLike) -> Array:
        """Return the measured displacements (T, k, 3) [m] of undeformed points (k, 3) beyond the
        rigid motion, at the times `t_s` (T,); zero where none were measured.
        """
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        if self.deformation is None:
            return np.zeros((len(times), len(points_m), 3))
        return self.deformation.at(points_m, times, self.interpolation)

    @cached_property
    def jumps_s(self) -> Array:
        """Times (j,) of the samples after which the position or a component of the quaternion jumps
        [s], see `jump_intervals`; empty without jumps.
        """
        of_position = jump_intervals(self.t_s, self.positions_m)
        of_rotation = jump_intervals(self.t_s, self.quaternions_xyzw)
        return self.t_s[np.union1d(of_position, of_rotation)]

    @cached_property
    def _position_spline(self) -> scipy.interpolate.PPoly:
        """Spline of the positions (m, 3)."""
        return smooth_spline(self.t_s, self.positions_m)

    @cached_property
    def _quaternion_spline(self) -> scipy.interpolate.PPoly:
        # Normalised it keeps its smoothness and its order, and no frame of reference is special.
        """Spline of the quaternions (m, 4), to be normalised after evaluation."""
        return smooth_spline(self.t_s, self.quaternions_xyzw)

    @cached_property
    def _rotations(self) -> Rotation:
        """Rotations (m,) of all samples."""
        return Rotation.from_quat(self.quaternions_xyzw)

    @cached_property
    def rotation_steps(self) -> Array:
        """(m − 1, 3) rotation vector from each sample to the next, in the frame of the earlier one
        [rad].
        """
        return (self._rotations[:-1].inv() * self._rotations[1:]).as_rotvec()

    def _require_times_covered(self, times: Array) -> None:
        """Refuse times over half an interval outside, or NaN."""
        first_step, last_step = np.diff(self.t_s)[[0, -1]]
        earliest = self.t_s[0] - max(0.5 * first_step, TIME_TOLERANCE_S)
        latest = self.t_s[-1] + max(0.5 * last_step, TIME_TOLERANCE_S)
        outside = ~((times >= earliest) & (times <= latest))
        if outside.any():
            raise InputError(
                f"a pose is needed at t = {times[outside][0]:.9g} s, but the poses run from "
                f"{self.t_s[0]:.9g} s to {self.t_s[-1]:.9g} s; record poses over the whole "
                "experiment, or cut it with window_s"
            )


def first_pose_fault(
    t_s: Array, positions_m: Array, quaternions_xyzw: Array
) -> tuple[int, str] | None:
    """Return the index, from 0, of the first unusable pose and what is wrong with it; None if all
    are fine.

    Values that are not finite are reported first, then times that do not increase, then quaternions
    whose norm differs from 1 by more than `QUATERNION_NORM_TOLERANCE`.
    """
    finite = np.isfinite(np.column_stack([t_s, positions_m, quaternions_xyzw])).all(axis=1)
    if not finite.all():
        return int(np.argmin(finite)), "the pose holds a value that is not a finite number"
    if fault := first_unordered_time(t_s):
        return fault
    norms = np.linalg.norm(quaternions_xyzw, axis=1)
    off = np.flatnonzero(np.abs(norms - 1.0) > QUATERNION_NORM_TOLERANCE)
    if off.size:
        row = int(off[0])
        at = f" at t_s = {t_s[row]:.9g}" if len(t_s) > 1 else ""
        return row, (
            f"the quaternion{at} has the norm {norms[row]:.6g}; expected 1 within "
            f"{QUATERNION_NORM_TOLERANCE:g} (order x, y, z, w)"
        )
    return None


def first_matrix_fault(t_s: Array, matrices: Array) -> tuple[int, str] | None:
    """Return the index, from 0, of the first of (m, 4, 4) matrices that is no rigid motion, and the
    reason; None if all are rigid motions.

    A rigid motion has finite values, the last row 0, 0, 0, 1 and a rotation: orthonormal with
    positive determinant. The times `t_s` (m,) appear in the reason. This check is needed as SciPy
    silently orthonormalises any matrix.
    """
    rotations = matrices[:, :3, :3]
    with np.errstate(invalid="ignore"):
        gram = np.abs(rotations.transpose(0, 2, 1) @ rotations - np.eye(3)).max(axis=(1, 2))
        last = np.abs(matrices[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1)
        last_column = np.abs(matrices[:, :3, 3]).max(axis=1)
    for k, time_s in enumerate(t_s):
        at = f"the matrix at t_s = {time_s:.9g}"
        if not np.isfinite(matrices[k]).all():
            return k, f"{at} holds a value that is not a finite number"
        if last[k] > _LAST_ROW_TOLERANCE:
            row = ", ".join(f"{value:.4g}" for value in matrices[k, 3])
            hint = (
                "; is it stored column by column?" if last_column[k] <= _LAST_ROW_TOLERANCE else ""
            )
            return k, f"{at} has the last row {row}; expected 0, 0, 0, 1{hint}"
        if gram[k] > _ORTHONORMALITY_TOLERANCE:
            return k, (
                f"{at} is not a rotation: its RᵀR differs from the identity by {gram[k]:.3g}; "
                f"expected at most {_ORTHONORMALITY_TOLERANCE:g}"
            )
        if np.linalg.det(rotations[k]) < 0:
            return (k, f"{at} is a reflection (determinant −1); expected a rotation")
    return None


def _unit_and_continuous(quaternions: Array) -> Array:
    """Return normalised quaternions (m, 4) whose neighbours are in the same hemisphere."""
    unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    aligned = np.sum(unit[1:] * unit[:-1], axis=1) >= 0.0
    signs = np.cumprod(np.concatenate([[1.0], np.where(aligned, 1.0, -1.0)]))
    continuous = unit * signs[:, None]
    continuous.setflags(write=False)
    return continuous


# Interpolation -----------------------------------------------------------------------------------


def jump_intervals(t_s: Array, values: Array) -> Index:
    """Return the indices of the intervals in which values (m, k) at times `t_s` (m,) jump; interval
    i is from sample i to i + 1.

    A jump is a change that is more than 10 times as fast as the faster one of the intervals just
    before and just after, and larger than a thousandth of the range of the values. The first and
    the last interval are not tested.
    """
    change = np.linalg.norm(np.diff(values, axis=0), axis=1)
    rate = change / np.diff(t_s)
    large = change > _LEAST_JUMP_SHARE * np.linalg.norm(np.ptp(values, axis=0))
    neighbour_rate = np.maximum(rate[:-2], rate[2:])
    return 1 + np.flatnonzero(large[1:-1] & (rate[1:-1] > _LEAST_JUMP_RATIO * neighbour_rate))


def smooth_spline(t_s: Array, values: Array) -> scipy.interpolate.PPoly:
    """Return the cubic spline through values (m, k), m > 1, at times `t_s` (m,), with two
    continuous derivatives ("not-a-knot" ends).

    Across a jump, see `jump_intervals`, the spline is linear, with separate splines on either side,
    as one spline would overshoot near the jump. Three samples make a parabola and two a line.
    """
    broken = jump_intervals(t_s, values)
    coefficients = np.zeros((4, len(t_s) - 1, values.shape[1]))
    for first, end in pairwise([0, *(broken + 1), len(t_s)]):
        if end - first > 1:
            piece = scipy.interpolate.CubicSpline(t_s[first:end], values[first:end])
            coefficients[:, first : end - 1] = piece.c
    coefficients[3, broken] = values[broken]
    steps_s = (t_s[broken + 1] - t_s[broken])[:, None]
    coefficients[2, broken] = (values[broken + 1] - values[broken]) / steps_s
    return scipy.interpolate.PPoly(coefficients, t_s)


# Checks over a recording -------------------------------------------------------------------------


def require_determined_motion(
    poses: PoseSequence, t_s: Array, interval_s: tuple[float, float], file: str | Path
) -> None:
    """Raise an `InputError` if poses do not determine the motion of a grasp while it holds.

    Parameters
    ----------
    t_s : (T,) array
        Times of the recording's samples.
    interval_s : (float, float)
        First and last time at which the grasp holds; may be infinite.
    file : str or Path
        File of the poses, for messages.

    Raises
    ------
    InputError
        For a single pose; for a smooth motion that is sampled below 1 Hz; and for poses that are
        missing for more than a sample at either end. The last is not reported if the poses cover
        fewer than three samples, as they may be of another recording.
    """
    first_s = max(t_s[0], interval_s[0])
    last_s = min(t_s[-1], interval_s[1])
    lasts = f"the recording lasts from {first_s:.6g} s to {last_s:.6g} s"
    if len(poses.t_s) == 1:
        raise InputError(
            f"found only one pose, but {lasts}; expected poses over all of it. If the grasp stands "
            "still, state the same pose at the start and at the end",
            file,
        )
    step_s = _typical_step_s(poses, first_s, last_s=last_s)
    if poses.interpolation == "smooth" and step_s > LONGEST_STEP_S:
        raise InputError(
            f"the poses move and are {step_s:.6g} s apart, and {lasts}; expected several a "
            "second, with t_s in seconds and not in milliseconds; or interpolation = 'linear' or "
            "'hold' if the grasp moves so between them",
            file,
        )
    start_s, end_s = poses.t_s[[0, -1]]
    slack_s = 1.01 * float(np.median(np.diff(t_s))) if len(t_s) > 1 else 0.0
    shared = np.count_nonzero((t_s >= start_s) & (t_s <= end_s))  # none if of two recordings
    if shared > 2 and (start_s > first_s + slack_s or end_s < last_s - slack_s):
        window = f"[{max(start_s, t_s[0]):.6g}, {min(end_s, t_s[-1]):.6g}]"
        raise InputError(
            f"the poses run from {start_s:.6g} s to {end_s:.6g} s, but {lasts}; expected poses "
            f"over all of it, in seconds of the same clock: add rows, or set window_s = {window}",
            file,
        )


def _typical_step_s(poses: PoseSequence, first_s: float, last_s: float) -> float:
    """Return the median step [s] of moving poses (`LARGEST_REST_DIFFERENCE`); 0 at rest."""
    shift_m = np.abs(np.diff(poses.positions_m, axis=0)).max(axis=1)
    turn = np.abs(np.diff(poses.quaternions_xyzw, axis=0)).max(axis=1)
    within = (poses.t_s[1:] > first_s) & (poses.t_s[:-1] < last_s)
    steps_s = np.diff(poses.t_s)[within & (np.maximum(shift_m, turn) > LARGEST_REST_DIFFERENCE)]
    return float(np.median(steps_s)) if len(steps_s) else 0.0
