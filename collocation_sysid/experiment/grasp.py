"""How the robot holds the body: grasped nodes, and the rigid motion that carries them.

A pose maps undeformed to current positions, x = R X + p. Between the samples of a sequence it is
either interpolated (linear in position, SLERP in rotation) or held (zero-order hold).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ..arrays import Array, Index
from ..errors import InputError
from .arrays import read_only_floats, read_only_nodes
from .clock import first_time_fault

Interpolation = Literal["linear", "hold"]

QUATERNION_NORM_TOLERANCE = 1e-3
# A held pose starts at its sample, also where the time asked for is rounded to just before it.
_HOLD_SNAP = 1e-6
_TIME_TOLERANCE_S = 1e-9


@dataclass(frozen=True, eq=False)
class PoseSequence:
    """Rigid motion x(t) = R(t) X + p(t) from undeformed to current positions.

    Parameters
    ----------
    t_s : (m,) array
        Sample times, strictly increasing. A single sample is a pose that never changes.
    positions_m : (m, 3) array
        p.
    quaternions_xyzw : (m, 4) array
        R, scalar last as in SciPy. Norms within 1e-3 of one are normalised; signs are made
        continuous in time.
    interpolation : {"linear", "hold"}
        Between samples: linear in position with SLERP in rotation, or the latest sample.

    Raises
    ------
    InputError
        If shapes disagree, a value is not finite, time does not increase, or a quaternion is not
        of unit norm; the first bad row is named, counting from 1.
    """

    t_s: Array
    positions_m: Array
    quaternions_xyzw: Array
    interpolation: Interpolation = "linear"

    def __post_init__(self) -> None:
        t_s = read_only_floats(self.t_s, (None,), "t_s of the poses", finite=False)
        m = len(t_s)
        if m == 0:
            raise InputError("a pose sequence needs at least one pose")
        positions = read_only_floats(self.positions_m, (m, 3), "positions_m", finite=False)
        quaternions = read_only_floats(
            self.quaternions_xyzw, (m, 4), "quaternions_xyzw", finite=False
        )
        if self.interpolation not in get_args(Interpolation):
            raise InputError(
                f"interpolation of poses is {self.interpolation!r}; expected 'linear' or 'hold'"
            )
        if fault := first_pose_fault(t_s, positions, quaternions):
            raise InputError(fault[1], where=f"row {fault[0] + 1}")
        object.__setattr__(self, "t_s", t_s)
        object.__setattr__(self, "positions_m", positions)
        object.__setattr__(self, "quaternions_xyzw", _unit_and_continuous(quaternions))

    @classmethod
    def fixed(cls, t0_s: float = 0.0) -> PoseSequence:
        """Return the identity pose for all time: grasped nodes stay where they are undeformed."""
        return cls(np.array([t0_s]), np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0, 1.0]]))

    def at(self, t_s: ArrayLike) -> tuple[Array, Array]:
        """Return the poses at the times `t_s` (k,).

        Up to half a sample before the first and after the last pose is allowed: "linear" continues
        the motion of the end interval there, "hold" repeats the end pose.

        Returns
        -------
        rotation_matrices : (k, 3, 3) array
        translations : (k, 3) array
            Metres.

        Raises
        ------
        InputError
            If a time lies outside the sequence.
        """
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        if len(self.t_s) == 1:
            first = np.zeros(len(times), dtype=np.int64)
            return self._rotations.as_matrix()[first], self.positions_m[first]
        self._require_covered(times)
        if self.interpolation == "hold":
            snap_s = _HOLD_SNAP * np.diff(self.t_s).min() + _TIME_TOLERANCE_S
            k = np.maximum(np.searchsorted(self.t_s, times + snap_s, side="right") - 1, 0)
            return self._rotations.as_matrix()[k], self.positions_m[k]
        k = np.clip(np.searchsorted(self.t_s, times, side="right") - 1, 0, len(self.t_s) - 2)
        fraction = ((times - self.t_s[k]) / (self.t_s[k + 1] - self.t_s[k]))[:, None]
        step_m = self.positions_m[k + 1] - self.positions_m[k]
        turn = Rotation.from_rotvec(fraction * self._turns[k])
        rotations = (Rotation.from_quat(self.quaternions_xyzw[k]) * turn).as_matrix()
        return rotations, self.positions_m[k] + fraction * step_m

    def carry(self, points_m: ArrayLike, t_s: ArrayLike) -> Array:
        """Return where the undeformed points (k, 3) are carried at `t_s` (T,), as (T, k, 3)."""
        rotations, translations = self.at(t_s)
        points = np.asarray(points_m, dtype=np.float64)
        return np.einsum("tij,kj->tki", rotations, points) + translations[:, None, :]

    @cached_property
    def _rotations(self) -> Rotation:
        return Rotation.from_quat(self.quaternions_xyzw)

    @cached_property
    def _turns(self) -> Array:
        """Rotation vector from each sample to the next, in the frame of the earlier one."""
        return (self._rotations[:-1].inv() * self._rotations[1:]).as_rotvec()

    def _require_covered(self, times: Array) -> None:
        first_step, last_step = np.diff(self.t_s)[[0, -1]]
        earliest = self.t_s[0] - max(0.5 * first_step, _TIME_TOLERANCE_S)
        latest = self.t_s[-1] + max(0.5 * last_step, _TIME_TOLERANCE_S)
        outside = ~((times >= earliest) & (times <= latest))
        if outside.any():
            raise InputError(
                f"a pose is needed at t = {times[outside][0]:.9g} s, but the poses run from "
                f"{self.t_s[0]:.9g} s to {self.t_s[-1]:.9g} s; record poses over the whole "
                "experiment, or cut it with window_s"
            )


@dataclass(frozen=True, eq=False)
class Grasp:
    """Nodes held by the robot, and the motion that carries them.

    Parameters
    ----------
    nodes : (h,) int array
        Node numbers; kept sorted and without repeats.
    poses : PoseSequence
        Where they are held.
    from_s, until_s : float
        First and last time at which they are held; throughout by default.
    """

    nodes: Index
    poses: PoseSequence
    from_s: float = -np.inf
    until_s: float = np.inf

    def __post_init__(self) -> None:
        if not self.from_s <= self.until_s:
            raise InputError(
                f"a grasp holds from {self.from_s:g} s until {self.until_s:g} s; "
                "expected from_s <= until_s"
            )
        nodes = np.unique(read_only_nodes(self.nodes, (None,), "nodes of the grasp"))
        if nodes.size == 0:
            raise InputError("a grasp must hold at least one node; its selection found none")
        nodes.setflags(write=False)
        object.__setattr__(self, "nodes", nodes)

    def holds(self, t_s: ArrayLike) -> NDArray[np.bool_]:
        """Return whether the nodes are held at the times `t_s` (T,)."""
        times = np.asarray(t_s, dtype=np.float64)
        return (times >= self.from_s - _TIME_TOLERANCE_S) & (
            times <= self.until_s + _TIME_TOLERANCE_S
        )

    def carry(self, nodes_m: Array, t_s: ArrayLike) -> Array:
        """Return where the body's nodes (n, 3) that it holds are at `t_s` (T,), (T, h, 3)."""
        return self.poses.carry(nodes_m[self.nodes], t_s)


def held_nodes(grasps: Sequence[Grasp]) -> Index:
    """Return all nodes that are grasped at some time, sorted.

    Raises
    ------
    InputError
        If two grasps hold the same node at the same time.
    """
    for (i, first), (j, second) in combinations(enumerate(grasps, start=1), 2):
        shared = np.intersect1d(first.nodes, second.nodes)
        if shared.size and max(first.from_s, second.from_s) <= min(first.until_s, second.until_s):
            raise InputError(
                f"node {shared[0]} is held by the grasps {i} and {j} at the same time; "
                "select nodes so that each is held once"
            )
    return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(g.nodes for g in grasps)]))


def first_pose_fault(
    t_s: Array, positions_m: Array, quaternions_xyzw: Array
) -> tuple[int, str] | None:
    """Return the index of the first unusable pose and what is wrong with it; None if all are fine.

    Values that are not finite are looked for first, then times that do not increase, then
    quaternions that are not of unit norm.
    """
    finite = np.isfinite(np.column_stack([t_s, positions_m, quaternions_xyzw])).all(axis=1)
    if not finite.all():
        return int(np.argmin(finite)), "the pose holds a value that is not a finite number"
    if fault := first_time_fault(t_s):
        return fault
    norms = np.linalg.norm(quaternions_xyzw, axis=1)
    off = np.flatnonzero(np.abs(norms - 1.0) > QUATERNION_NORM_TOLERANCE)
    if off.size:
        row = int(off[0])
        return row, (
            f"the quaternion at t_s = {t_s[row]:.9g} has the norm {norms[row]:.6g}; expected 1 "
            f"within {QUATERNION_NORM_TOLERANCE:g} (order x, y, z, w)"
        )
    return None


def _unit_and_continuous(quaternions: Array) -> Array:
    """Normalise, and flip signs so that neighbours lie in the same half of the sphere."""
    unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    aligned = np.sum(unit[1:] * unit[:-1], axis=1) >= 0.0
    signs = np.cumprod(np.concatenate([[1.0], np.where(aligned, 1.0, -1.0)]))
    continuous = unit * signs[:, None]
    continuous.setflags(write=False)
    return continuous
