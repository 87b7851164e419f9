"""Nuisance parameters φ of an experiment: marker offsets, a time shift, corrections of the frame.

Every φ is a number of prior standard deviations, so that its prior is φ² in the loss. In their
order, those that the experiment's `Nuisance` names:

=====================  ====================================================================
offset of each marker  b_m, three a marker [m]
time shift             τ [s]
turn of the pose       a (3), Cayley's parameters times two: to third order a rotation vector
shift of the pose      d (3) [m]
tilt of gravity        two angles about axes across it [rad]
=====================  ====================================================================

Grasps and body are off by the rigid motion x' = R(a) (x − c) + c + d in the frame of the markers,
c being the middle of the undeformed body in its first pose. In the body's frame that changes
nothing but what the markers read, and the direction of gravity, which becomes R(a)ᵀ g.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..experiment.experiment import Experiment

# A time shift stays within this many samples: markers are read between neighbouring samples.
LARGEST_SHIFT_SAMPLES = 2.0
KINDS = ("offset", "time", "turn", "shift", "tilt")


@dataclass(frozen=True, eq=False)
class NuisanceMap:
    """φ of one experiment: what each is, and the gravity it makes.

    Attributes
    ----------
    names : (k,) with units, such as "swing: offset of tip, x [m]"
    kinds : (k,) of `KINDS`
    scales : (k,) prior standard deviations, in the names' units
    limits : (k,) largest |φ|
    gravity_m_s2 : (3,) as stated
    pivot_m : (3,) c
    """

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    scales: Array
    limits: Array
    gravity_m_s2: Array
    pivot_m: Array

    @classmethod
    def of(cls, experiment: Experiment) -> NuisanceMap:
        """What the experiment wants estimated."""
        wanted, entries = experiment.nuisance, []
        if wanted.marker_offset_m:
            entries += [
                ("offset", f"offset of {marker}, {axis} [m]", wanted.marker_offset_m)
                for marker in experiment.markers.names
                for axis in "xyz"
            ]
        if wanted.time_shift_s:
            entries.append(("time", "time shift [s]", wanted.time_shift_s))
        if wanted.pose_turn_rad:
            entries += [
                ("turn", f"turn of the pose, {axis} [rad]", wanted.pose_turn_rad) for axis in "xyz"
            ]
        if wanted.pose_shift_m:
            entries += [
                ("shift", f"shift of the pose, {axis} [m]", wanted.pose_shift_m) for axis in "xyz"
            ]
        if wanted.gravity_rad:
            entries += [
                ("tilt", f"tilt of gravity, {side} [rad]", wanted.gravity_rad)
                for side in ("first", "second")
            ]
        kinds, labels, scales = zip(*entries, strict=True) if entries else ((), (), ())
        scales = np.array(scales, dtype=float)
        limits = np.full(len(scales), np.inf)
        late = np.array([kind == "time" for kind in kinds], dtype=bool)
        limits[late] = LARGEST_SHIFT_SAMPLES * experiment.timestep_s / scales[late]
        names = tuple(f"{experiment.name}: {label}" for label in labels)
        pivot = experiment.rigid_positions(experiment.t_s[:1])[0].mean(axis=0)
        return cls(names, tuple(kinds), scales, limits, np.array(experiment.gravity_m_s2), pivot)

    @property
    def size(self) -> int:
        """Number k of φ."""
        return len(self.names)

    def places(self, *kinds: str) -> NDArray[np.int64]:
        """Positions in φ of some kinds."""
        return np.array([i for i, kind in enumerate(self.kinds) if kind in kinds], dtype=np.int64)

    @cached_property
    def moving(self) -> NDArray[np.int64]:
        """Positions in φ of what changes the motion: those that turn gravity."""
        return self.places("turn", "tilt")

    @property
    def reach(self) -> Array:
        """(k,) φ that a step may move at a time: what enters linearly needs no trust region."""
        linear = np.isin(self.kinds, ("offset", "shift"))
        return np.where(linear, 1e3, 1.0) if self.size else np.ones(0)

    def gravity(self, phi: Array) -> tuple[Array, Array, Array]:
        """Gravity (3,) in the body's frame, and its derivatives by φ: (3, k) and (3, k, k)."""
        value, first, *second = self._gravity(phi)
        return value.full().ravel(), first.full(), np.array([h.full() for h in second])

    @cached_property
    def _gravity(self) -> ca.Function:
        phi = ca.SX.sym("phi", self.size)
        values = phi * self.scales
        gravity = ca.DM(self.gravity_m_s2)
        if len(tilt := self.places("tilt")):
            gravity = self._tilted(values[tilt.tolist()])
        if len(turn := self.places("turn")):
            gravity = rotation(values[turn.tolist()]).T @ gravity
        gravity = ca.SX(gravity)
        second = [ca.densify(ca.hessian(gravity[i], phi)[0]) for i in range(3)]
        return ca.Function("gravity", [phi], [gravity, ca.jacobian(gravity, phi), *second])

    def _tilted(self, angles: ca.SX) -> ca.SX:
        size = float(np.linalg.norm(self.gravity_m_s2))
        if size == 0:
            return ca.SX(ca.DM(self.gravity_m_s2))
        down = self.gravity_m_s2 / size
        # Two axes across gravity: those that complete it to a basis.
        across = np.linalg.svd(down[None])[2][1:]
        tilted = down + ca.mtimes(ca.DM(across.T), angles)
        return ca.SX(size * tilted / ca.norm_2(tilted))


def rotation(turn: ca.SX) -> ca.SX:
    """Rotation matrix of Cayley's parameters `turn` / 2; smooth and rational."""
    half = ca.skew(turn / 2)
    return ca.SX.eye(3) + 2 / (1 + ca.sumsqr(turn) / 4) * (half + half @ half)
