"""Equations of motion of some dofs as rows of a Jacobian, in scaled quantities.

Rows are c / `force_n` by x / `length_m`; where a dof is held instead, (x − u x̄) / `length_m`. A
dof that is held for a while has a grasp row at those times instead of an equation of motion, and
the force on it then counts in no later row, see `Dynamics.taken`: where a grasp ends or begins,
entries differ from the scheme's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arrays import Array, Index
from ..fem.body import Linearisation
from ..fem.pattern import SymmetricPattern
from ..model.dynamics import Dynamics
from .block_band import BandBlock, BlockBand, BlockTerm, adding_skew, skew_values


@dataclass(frozen=True, eq=False)
class MotionRows:
    """∂c/∂x of the rows of one experiment; row numbers count from its first.

    Attributes
    ----------
    dynamics : Dynamics
        As stated.
    row_dofs : (k,) the dof of each row of a grid time, ascending
    moving_dofs : those of them with an equation of motion; others are held throughout
    length_m, force_n : units
    """

    dynamics: Dynamics
    row_dofs: Index
    moving_dofs: Index
    length_m: float
    force_n: float

    @property
    def pattern(self) -> SymmetricPattern:
        """Sparsity of the blocks."""
        return self.dynamics.pattern

    @cached_property
    def band(self) -> BlockBand:
        """The structure."""
        return BlockBand(self.pattern.size, self._starts, self._blocks())

    @cached_property
    def _skew(self) -> BlockBand:
        """The same, to add the skew parts of ∂F/∂x and ∂F/∂v to it."""
        spins = self.dynamics.forces.spins
        return adding_skew(self.pattern.size, self._starts, self._blocks(), by_velocity=spins)

    @property
    def _starts(self) -> Index:
        first_row = self.dynamics.first_row
        starts = (np.arange(self.dynamics.rows) - first_row) * len(self.row_dofs)
        return np.maximum(starts, -1) if first_row else starts

    def _blocks(self) -> list[BandBlock]:
        rows, columns, source = self.pattern.full
        place, moving = np.full(self.pattern.size, -1), np.zeros(self.pattern.size, dtype=bool)
        place[self.row_dofs] = np.arange(len(self.row_dofs))
        moving[self.moving_dofs] = True
        whole, held = moving[rows], ~moving[rows] & (place[rows] >= 0)
        scale = self.length_m / self.force_n
        blocks = []
        for lag in range(self.dynamics.reach + 1):
            terms = [
                # Column time t has the block of row t + lag, whose coefficients are at t + lag.
                BlockTerm(
                    lag - j - self.dynamics.first_row,
                    scale * ahead(a, lag),
                    scale * ahead(b, lag),
                )
                for j, a, b in self.dynamics.block_terms(lag)
            ]
            kept = whole.copy() if terms else whole & (rows == columns)
            if lag == 0:
                kept |= held & (rows == columns)
            # Grasp rows hold constants only: they are written after the terms.
            entries = place[rows[kept]], columns[kept], source[kept]
            blocks.append(BandBlock(lag, *entries, terms, np.flatnonzero(kept)))
        return blocks

    def _inertia_rows(self, lag: int) -> Index:
        """Grid times whose rows have inertia at a lag."""
        rows = np.arange(max(self.dynamics.first_row, lag), self.dynamics.rows)
        return rows[self.dynamics.inertia_coefficient(lag)[rows] != 0]

    @cached_property
    def _constants(self) -> tuple[Index, Index]:
        """Positions of the inertia, and of the unit grasp entries."""
        place = np.searchsorted(self.row_dofs, self.moving_dofs)
        positions = [np.zeros(0, dtype=np.int64)]
        for lag in range(self.dynamics.reach + 1):
            columns = self._inertia_rows(lag) - lag
            positions.append(self.band.positions(columns, lag, place, self.moving_dofs).ravel())
        held = np.setdiff1d(self.row_dofs, self.moving_dofs)
        rows = np.arange(self.dynamics.first_row, self.dynamics.rows)
        grasps = self.band.positions(rows, 0, np.searchsorted(self.row_dofs, held), held)
        return np.concatenate(positions), grasps.ravel()

    def _inertia(self, dynamics: Dynamics) -> Array:
        """∂c/∂x of the inertia, in the order of its positions."""
        mass = dynamics.mass.kg[:, self.moving_dofs] * self.length_m / self.force_n
        values = [np.zeros(0)]
        for lag in range(self.dynamics.reach + 1):
            rows, coefficient = self._inertia_rows(lag), self.dynamics.inertia_coefficient(lag)
            values.append((coefficient[rows, None] * mass[rows]).ravel())
        return np.concatenate(values)

    @cached_property
    def _known_inertia(self) -> Array:
        """The same where it does not depend on (q, φ)."""
        return self._inertia(self.dynamics)

    @cached_property
    def _passing(self) -> ReleasedGrasps:
        scale = self.length_m / self.force_n
        return ReleasedGrasps.of(
            self.dynamics, self.band, self._starts, self.pattern, self.row_dofs, scale
        )

    def fill(
        self, values: Array, forces: Linearisation, dynamics: Dynamics, mass_moves: bool
    ) -> None:
        """Write the values (band.nnz,), from the slopes of the forces at the evaluations.

        Parameters
        ----------
        dynamics : at the parameters
        mass_moves : whether the mass depends on them
        """
        threads = dynamics.body.threads
        self.band.fill(values, forces.by_position, forces.by_velocity, threads)
        positions, grasps = self._constants
        values[positions] += self._inertia(dynamics) if mass_moves else self._known_inertia
        skew = skew_values(self.pattern, forces.by_position_skew)
        of_rates = skew_values(self.pattern, forces.by_velocity_skew)
        if skew.size:
            self._skew.fill(values, skew, of_rates if of_rates.size else skew, threads)
        skews = skew, of_rates
        self._passing.correct(values, forces.by_position, forces.by_velocity, *skews)
        values[grasps] = 1.0


def ahead(values: Array, steps: int) -> Array:
    """values[t + steps] at t, zero beyond the end."""
    shifted = np.zeros_like(values)
    shifted[: len(values) - steps] = values[steps:]
    return shifted


@dataclass(frozen=True, eq=False)
class _Dropped:
    """Entries a G + b C of one evaluation that are not there."""

    positions: Index
    evaluation: int
    source: Index
    whole: Index  # the same in both triangles, as `skew_values` has them
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

    def correct(
        self, values: Array, by_position: Array, by_velocity: Array, skew: Array, of_rates: Array
    ) -> None:
        """Correct the values in place.

        G and C are (evaluations, m) lower triangles; the others are the entries of their skew
        parts.
        """
        for gone in self.dropped:
            force = gone.a * by_position[gone.evaluation, gone.source]
            values[gone.positions] -= force + gone.b * by_velocity[gone.evaluation, gone.source]
            if skew.size:
                values[gone.positions] -= gone.a * skew[gone.evaluation, gone.whole]
            if of_rates.size:
                values[gone.positions] -= gone.b * of_rates[gone.evaluation, gone.whole]
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
