"""A depth camera: where it stands, what it is off by, and where its points are in the world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ..arrays import Array, Index
from ..model.generated import Generated
from ..model.nuisance import NuisanceMap
from ..recording.depth import Depth
from ..recording.experiment import Experiment
from ..recording.nuisance import (
    DEPTH_BIAS,
    DEPTH_EDGE,
    DEPTH_SCALE,
    DEPTH_SHIFT,
    DEPTH_TIME,
    DEPTH_TURN,
    NuisanceRow,
    rotation,
)

OF_CAMERA = (DEPTH_TURN, DEPTH_SHIFT, DEPTH_BIAS, DEPTH_SCALE, DEPTH_TIME, DEPTH_EDGE)
# One over the deviation of what counts as exact.
EXACT = 1e6


@dataclass(frozen=True, eq=False)
class View:
    """A depth camera: what it is off by, and where it stands.

    Attributes
    ----------
    depth : Depth
    number : int
        Among those of the experiment.
    nuisance : NuisanceMap
    pivot_m : (3,) in its frame: its turn is about the middle of the body
    size_m : float
        Diagonal of the undeformed body [m].
    """

    depth: Depth
    number: int
    nuisance: NuisanceMap
    pivot_m: Array
    size_m: float

    @classmethod
    def of(cls, experiment: Experiment, number: int, nuisance: NuisanceMap) -> View:
        """That of an experiment's camera."""
        depth = experiment.depths[number]
        rotations, translations = depth.camera.motion(depth.times[:1])
        pivot_m = (experiment.body.nodes_m.mean(axis=0) - translations[0]) @ rotations[0]
        size_m = float(np.linalg.norm(np.ptp(experiment.body.nodes_m, axis=0)))
        return cls(depth, number, nuisance, pivot_m, size_m)

    @cached_property
    def instruments(self) -> dict[tuple[int, int], Any]:
        """Of its readings, whose derivatives are generated once."""
        return {}

    @cached_property
    def outline_instruments(self) -> dict[tuple[int, int], Any]:
        """Of the readings of its outlines, whose derivatives are generated once."""
        return {}

    @cached_property
    def own(self) -> Index:
        """Positions in φ of what is not known of it."""
        return self.nuisance.places(*OF_CAMERA, of=self.number)

    @cached_property
    def motion(self) -> tuple[Array, Array]:
        """Rotations (S, 3, 3) and translations (S, 3) from its frame to the world."""
        return self.depth.camera.motion(self.depth.times)

    @cached_property
    def rays(self) -> list[Array]:
        """(P, 3) that points of each sample move along as their depths grow; zeros of clouds."""
        seen, pinhole = self.depth.points_m, self.depth.camera.matrix is not None
        return [p / p[:, 2:] if pinhole else np.zeros_like(p) for p in seen]

    def corrected(self, point: ca.SX, ray: ca.SX, values: Mapping[NuisanceRow, ca.SX]) -> ca.SX:
        """Where a point is in the frame as stated, by what the camera is off by."""
        point = (1 + values.get(DEPTH_SCALE, 0)) * point + values.get(DEPTH_BIAS, 0) * ray
        if DEPTH_TURN in values:
            pivot = ca.DM(self.pivot_m)
            point = rotation(values[DEPTH_TURN]) @ (point - pivot) + pivot
        return point + values.get(DEPTH_SHIFT, 0)

    @cached_property
    def _corrected(self) -> Generated:
        def expression(own: ca.SX, data: ca.SX) -> ca.SX:
            values = self.nuisance.by_row(own, self.own)
            return self.corrected(data[:3], data[3:], values)

        return Generated(expression, len(self.own), 6)

    def world(self, phi: Array, sample: int) -> Array:
        """(P, 3) the points of a sample in the world, at φ (k,)."""
        return self.corrected_at(phi, self.depth.points_m[sample], self.rays[sample], sample)

    def corrected_at(self, phi: Array, points: Array, rays: Array, sample: int) -> Array:
        """The same of some points (P, 3) of its frame, that move along rays (P, 3)."""
        seen = self._corrected.value(phi[self.own], np.vstack([points.T, rays.T])).T
        rotations, translations = self.motion
        return seen @ rotations[sample].T + translations[sample]

    def middle_m(self, sample: int) -> Array:
        """Middle (3,) of the undeformed body in the camera's frame as stated, at a sample [m]."""
        rotations, translations = self.motion
        middle_m = rotations[0] @ self.pivot_m + translations[0]
        return (middle_m - translations[sample]) @ rotations[sample]

    def own_m(self, phi: Array, points_m: Array, sample: int) -> Array:
        """(P, 3) points (P, 3) of the world in its frame: what `world` says of it, but for bias."""
        basis = np.vstack([np.zeros(3), np.eye(3)])
        corner, *along = self.corrected_at(phi, basis, np.zeros((4, 3)), sample)
        return np.linalg.solve((along - corner).T, (points_m - corner).T).T

    def told(self, phi: Array) -> dict[str, float]:
        """What φ (k,) says of it, by label."""
        entries, values = self.nuisance.entries, phi * self.nuisance.scales
        return {entries[k].label: float(values[k]) for k in self.own}

    def phi(self, told: Mapping[str, float]) -> Array:
        """Φ (k,) with this, zero else."""
        values = [told.get(entry.label, 0.0) for entry in self.nuisance.entries]
        return np.array(values) / self.nuisance.scales

    def eye_m(self, phi: Array, sample: int) -> Array | None:
        """(3,) where the camera is, at φ (k,); None of a cloud."""
        if self.depth.camera.matrix is None:
            return None
        return self.corrected_at(phi, np.zeros((1, 3)), np.zeros((1, 3)), sample)[0]

    def prior(self, row: NuisanceRow) -> Array:
        """(3,) over the deviations of its turn, or shift; so good as infinite of what is exact."""
        places = self.nuisance.places(row, of=self.number)
        return 1 / self.nuisance.scales[places] if len(places) else np.full(3, EXACT)

    def late_s(self, phi: Array) -> float:
        """How much later than its times say it sees."""
        places = self.nuisance.places(DEPTH_TIME, of=self.number)
        return float((phi * self.nuisance.scales)[places].sum())

    def with_pose(self, phi: Array, turn: Array, shift_m: Array) -> Array:
        """Φ with another turn (rotation vector) and shift, as far as these are estimated."""
        moved, angle = phi.copy(), np.linalg.norm(turn)
        cayley = turn * (2 * np.tan(angle / 2) / angle if angle else 1.0)
        for row, values in ((DEPTH_TURN, cayley), (DEPTH_SHIFT, shift_m)):
            places = self.nuisance.places(row, of=self.number)
            moved[places] = values[: len(places)] / self.nuisance.scales[places]
        return moved
