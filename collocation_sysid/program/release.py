"""Jacobian entries that differ from the scheme's where a grasp ends or begins.

A dof that is held for a while has a grasp row at those times instead of an equation of motion, and
the force on it then counts in no later row, see `Dynamics.taken`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Index
from ..fem.pattern import SymmetricPattern
from ..model.dynamics import Dynamics
from .block_band import BlockBand


@dataclass(frozen=True, eq=False)
class _Dropped:
    """Entries a G + b C of one evaluation that are not there."""

    positions: Index
    evaluation: int
    source: Index
    whole: Index  # the same in both triangles, as `unsymmetric.skew_values` has them
    a: float
    b: float


@dataclass(frozen=True, eq=False)
class ReleasedGrasps:
    """What to correct in the values of ∂c/∂x."""

    dropped: tuple[_Dropped, ...]
    zeros: Index
    ones: Index

    @classmethod
    def of(
        cls,
        dynamics: Dynamics,
        band: BlockBand,
        row_starts: Index,
        pattern: SymmetricPattern,
        row_dofs: Index,
        scale: float,
    ) -> ReleasedGrasps:
        """The corrections of a segment's Jacobian, whose rows are scaled by `scale`."""
        taken = dynamics.taken
        nothing = np.zeros(0, dtype=np.int64)
        place = np.full(pattern.size, -1)
        place[row_dofs] = np.arange(len(row_dofs))
        times, dofs = np.nonzero(taken)
        times, dofs = times[times >= dynamics.first_row], dofs[times >= dynamics.first_row]
        zeros = np.flatnonzero(np.isin(band.indices, row_starts[times] + place[dofs]))
        ones = [
            band.positions(np.array([t]), 0, place[[dof]], np.array([dof])).ravel()
            for t, dof in zip(times, dofs, strict=True)
        ]
        dropped = tuple(_dropped(dynamics, band, pattern, place, scale))
        return cls(dropped, zeros, np.concatenate([nothing, *ones]))

    def correct(self, values: Array, by_position: Array, by_velocity: Array, skew: Array) -> None:
        """Correct the values in place.

        G and C are (evaluations, m) lower triangles; `skew` has the entries of G's skew part.
        """
        for gone in self.dropped:
            force = gone.a * by_position[gone.evaluation, gone.source]
            values[gone.positions] -= force + gone.b * by_velocity[gone.evaluation, gone.source]
            if skew.size:
                values[gone.positions] -= gone.a * skew[gone.evaluation, gone.whole]
        values[self.zeros] = 0.0
        values[self.ones] = 1.0


def _dropped(
    dynamics: Dynamics, band: BlockBand, pattern: SymmetricPattern, place: Index, scale: float
) -> list[_Dropped]:
    tables, step_s, found = dynamics.tables, dynamics.step_s, []
    rows, columns, source = pattern.full
    for k in range(dynamics.first_row, dynamics.rows):
        for j in range(1, min(dynamics.reach, dynamics.rows - 1 - k) + 1):
            weight = scale * tables.w[k + j, j]
            let_go = dynamics.taken[k] & ~dynamics.taken[k + j]
            if weight == 0 or not let_go.any():
                continue
            kept = np.flatnonzero(let_go[rows])
            for i in range(min(dynamics.reach - j, k) + 1):
                a, b = weight * tables.p[k, i], weight * tables.q[k, i] / step_s
                if a or b:
                    positions = band.positions(
                        np.array([k - i]), i + j, place[rows[kept]], columns[kept]
                    )
                    here = positions.ravel(), k - dynamics.first_row
                    found.append(_Dropped(*here, source[kept], kept, a, b))
    return found
