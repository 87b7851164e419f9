"""Equations of motion of selected dofs as rows of a sparse Jacobian, in scaled quantities.

Rows are c / `force_n`, differentiated by x / `length_m`; a prescribed dof has the row (x − u x̄) /
`length_m` instead. A dof that is prescribed for a part of the time has a grasp row at those times
instead of an equation of motion, and the force on it at those times counts in no later row (see
`Dynamics.is_temporarily_prescribed`): where a grasp begins or ends, entries differ from those of
the scheme, and `ReleasedGrasps` corrects them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..common.array_types import Array, Index
from ..fem.body import Linearisation
from ..fem.pattern import SymmetricPattern
from ..model.dynamics import Dynamics
from .linear_algebra.block_band import (
    BandBlock,
    BlockBand,
    BlockTerm,
    full_skew_values,
    skew_block_band,
)


@dataclass(frozen=True, eq=False)
class MotionJacobian:
    """Structure and values of ∂c/∂x of one experiment; row indices count from its first row."""

    dynamics: Dynamics  # equations of motion with inputs as stated; determines the structure
    constrained_dofs: Index  # (k,): dof of each row of a grid time, ascending
    # Those of `constrained_dofs` with an equation of motion; the others are prescribed at all
    # times.
    free_dofs: Index
    length_m: float  # unit of positions [m]
    force_n: float  # unit of forces [N]

    @cached_property
    def structure(self) -> BlockBand:
        """Sparsity structure of ∂c/∂x by columns."""
        return BlockBand(
            self.dynamics.pattern.size, self._compute_row_starts(), blocks=self._blocks()
        )

    @cached_property
    def _skew(self) -> BlockBand:
        """Plan that adds the skew parts of ∂F/∂x and ∂F/∂v to the values of `structure`."""
        has_skew_damping = self.dynamics.forces.has_skew_damping
        return skew_block_band(
            self.dynamics.pattern.size,
            self._compute_row_starts(),
            blocks=self._blocks(),
            by_velocity=has_skew_damping,
        )

    def _compute_row_starts(self) -> Index:
        """Return the index of the first row of each grid time, (N,); −1 where there are no rows."""
        first_row = self.dynamics.first_row
        starts = (np.arange(self.dynamics.row_count) - first_row) * len(self.constrained_dofs)
        return np.maximum(starts, -1) if first_row else starts

    def _blocks(self) -> list[BandBlock]:
        """Return the blocks of ∂c_t/∂x_{t−lag}, from lag 0 on, times `length_m` / `force_n`."""
        # A block without terms has only the diagonal of the free dofs, for the inertia. Block 0 also
        # has the diagonal of prescribed dofs that are constrained.
        rows, columns, source = self.dynamics.pattern.full
        place = np.full(self.dynamics.pattern.size, -1)
        moving = np.zeros(self.dynamics.pattern.size, dtype=bool)
        place[self.constrained_dofs] = np.arange(len(self.constrained_dofs))
        moving[self.free_dofs] = True
        has_motion = moving[rows]
        is_prescribed = ~moving[rows] & (place[rows] >= 0)
        scale = self.length_m / self.force_n
        blocks = []
        for lag in range(self.dynamics.largest_lag + 1):
            terms = [
                # Column time t has the block of row t + lag, whose coefficients are at t + lag.
                BlockTerm(
                    lag - j - self.dynamics.first_row,
                    scale * shifted_back(a, lag),
                    b=scale * shifted_back(b, lag),
                )
                for j, a, b in self.dynamics.block_terms(lag)
            ]
            is_stored = has_motion.copy() if terms else has_motion & (rows == columns)
            if lag == 0:
                is_stored |= is_prescribed & (rows == columns)
            # Grasp rows hold constants only: they are written after the terms.
            blocks.append(
                BandBlock(
                    offset=lag,
                    rows=place[rows[is_stored]],
                    columns=columns[is_stored],
                    lower_positions=source[is_stored],
                    terms=terms,
                    full_positions=np.flatnonzero(is_stored),
                )
            )
        return blocks

    def _inertia_rows(self, lag: int) -> Index:
        """Times whose equations contain inertia of x `lag` earlier."""
        rows = np.arange(max(self.dynamics.first_row, lag), self.dynamics.row_count)
        return rows[self.dynamics.inertia_coefficient(lag)[rows] != 0]

    @cached_property
    def _constant_positions(self) -> tuple[Index, Index]:
        """Places in `structure` of inertia and of unit entries."""
        place = np.searchsorted(self.constrained_dofs, self.free_dofs)
        positions = [np.zeros(0, dtype=np.int64)]
        for lag in range(self.dynamics.largest_lag + 1):
            columns = self._inertia_rows(lag) - lag
            positions.append(
                self.structure.positions(columns, lag, rows=place, columns=self.free_dofs).ravel()
            )
        prescribed = np.setdiff1d(self.constrained_dofs, self.free_dofs)
        rows = np.arange(self.dynamics.first_row, self.dynamics.row_count)
        grasps = self.structure.positions(
            rows, 0, rows=np.searchsorted(self.constrained_dofs, prescribed), columns=prescribed
        )
        return np.concatenate(positions), grasps.ravel()

    def _inertia(self, dynamics: Dynamics) -> Array:
        """Return the scaled inertia entries of ∂c/∂x in their order."""
        mass = dynamics.mass.inertia_kg[:, self.free_dofs] * self.length_m / self.force_n
        values = [np.zeros(0)]
        for lag in range(self.dynamics.largest_lag + 1):
            rows = self._inertia_rows(lag)
            coefficient = self.dynamics.inertia_coefficient(lag)
            values.append((coefficient[rows, None] * mass[rows]).ravel())
        return np.concatenate(values)

    @cached_property
    def _constant_inertia(self) -> Array:
        """Inertia entries of ∂c/∂x at the stated masses."""
        return self._inertia(self.dynamics)

    @cached_property
    def _released_grasps(self) -> ReleasedGrasps:
        """Corrections where grasps that hold for a part of the time begin or end."""
        scale = self.length_m / self.force_n
        return ReleasedGrasps.from_dynamics(
            self.dynamics,
            self.structure,
            row_starts=self._compute_row_starts(),
            pattern=self.dynamics.pattern,
            row_dofs=self.constrained_dofs,
            scale=scale,
        )

    def fill(
        self, values: Array, forces: Linearisation, dynamics: Dynamics, has_variable_mass: bool
    ) -> None:
        """Write the values of ∂c/∂x of the scaled rows by the scaled positions.

        Parameters
        ----------
        values : (structure.nnz,) array
            Values in the order of `structure`, overwritten.
        forces : Linearisation
            Derivatives of the forces at the evaluations.
        has_variable_mass : bool
            Whether the mass depends on the parameters; if not, the stated mass is used.
        """
        threads = dynamics.body.threads
        self.structure.fill(values, forces.by_position, b=forces.by_velocity, threads=threads)
        positions, grasps = self._constant_positions
        values[positions] += (
            self._inertia(dynamics) if has_variable_mass else self._constant_inertia
        )
        skew = full_skew_values(self.dynamics.pattern, forces.by_position_skew)
        of_rates = full_skew_values(self.dynamics.pattern, forces.by_velocity_skew)
        if skew.size:
            self._skew.fill(values, skew, b=of_rates if of_rates.size else skew, threads=threads)
        self._released_grasps.correct(
            values,
            forces.by_position,
            by_velocity=forces.by_velocity,
            skew=skew,
            rate_skew=of_rates,
        )
        values[grasps] = 1.0


def shifted_back(values: Array, steps: int) -> Array:
    """Return a copy with values[t + steps] at index t, zero beyond the end; `steps` is not
    negative.
    """
    shifted = np.zeros_like(values)
    shifted[: len(values) - steps] = values[steps:]
    return shifted


@dataclass(frozen=True, eq=False)
class _DroppedForce:
    """Entries a G + b C that the Jacobian does not have, because a grasp prescribed the dof."""

    positions: Index  # (e,): positions in the values of the Jacobian
    evaluation: int  # index of the evaluation
    source: Index  # (e,): entries in lower triangles
    complete: Index  # (e,): entries in both triangles, in the order of `full_skew_values`
    # Coefficients of G = ∂F/∂ξ and C = ∂F/∂ν.
    a: float
    b: float


@dataclass(frozen=True, eq=False)
class ReleasedGrasps:
    """Corrections of ∂c/∂x for grasps that hold for a part of the time; empty without any."""

    dropped: tuple[_DroppedForce, ...]  # forces to subtract
    # Positions in the values of the Jacobian that are set to zero: the rows of dofs while they are
    # prescribed.
    zeros: Index
    ones: Index  # positions that are set to one: the diagonal entries of these rows

    @classmethod
    def from_dynamics(
        cls,
        dynamics: Dynamics,
        band: BlockBand,
        row_starts: Index,
        pattern: SymmetricPattern,
        row_dofs: Index,
        scale: float,
    ) -> ReleasedGrasps:
        """Compute the corrections of an experiment's Jacobian.

        Parameters
        ----------
        row_starts : (N,) array
            First row of each grid time, −1 where there are no rows.
        row_dofs : (k,) array
            Dof of each row of a grid time.
        scale : float
            Factor of the rows, `length_m` / `force_n`.
        """
        is_prescribed = dynamics.is_temporarily_prescribed.copy()
        is_prescribed[: dynamics.first_row] = False
        place = np.full(pattern.size, -1)
        place[row_dofs] = np.arange(len(row_dofs))
        times = np.flatnonzero(is_prescribed.any(axis=1))
        dofs = np.flatnonzero(is_prescribed.any(axis=0))
        is_prescribed = is_prescribed[np.ix_(times, dofs)]
        rows = row_starts[times][:, None] + place[dofs]
        is_constant_row = np.zeros(int(row_starts.max()) + len(row_dofs), dtype=bool)
        is_constant_row[rows[is_prescribed]] = True
        diagonal = band.positions(times, 0, rows=place[dofs], columns=dofs)
        dropped = tuple(_dropped_forces(dynamics, band, pattern=pattern, place=place, scale=scale))
        return cls(
            dropped, np.flatnonzero(is_constant_row[band.indices]), ones=diagonal[is_prescribed]
        )

    def correct(
        self, values: Array, by_position: Array, by_velocity: Array, skew: Array, rate_skew: Array
    ) -> None:
        """Correct the values of ∂c/∂x in place.

        Parameters
        ----------
        values : (band.nnz,) array
            Values without corrections, modified.
        by_position, by_velocity : (evaluations, m) arrays
            Lower triangles of the symmetric parts of G and C.
        skew, rate_skew : arrays
            Entries of the skew parts of G and C, see `full_skew_values`; empty where there are
            none.
        """
        for entry in self.dropped:
            force = entry.a * by_position[entry.evaluation, entry.source]
            values[entry.positions] -= force + entry.b * by_velocity[entry.evaluation, entry.source]
            if skew.size:
                values[entry.positions] -= entry.a * skew[entry.evaluation, entry.complete]
            if rate_skew.size:
                values[entry.positions] -= entry.b * rate_skew[entry.evaluation, entry.complete]
        values[self.zeros] = 0.0
        values[self.ones] = 1.0


def _dropped_forces(
    dynamics: Dynamics, band: BlockBand, pattern: SymmetricPattern, place: Index, scale: float
) -> list[_DroppedForce]:
    """Return forces while a dof is prescribed, in later rows where it is free."""
    tables = dynamics.tables
    step_s = dynamics.step_s
    dropped = []
    rows, columns, source = pattern.full
    for k in range(dynamics.first_row, dynamics.row_count):
        for j in range(1, min(dynamics.largest_lag, dynamics.row_count - 1 - k) + 1):
            weight = scale * tables.w[k + j, j]
            released = (
                dynamics.is_temporarily_prescribed[k] & ~dynamics.is_temporarily_prescribed[k + j]
            )
            if weight == 0 or not released.any():
                continue
            entries = np.flatnonzero(released[rows])
            for i in range(min(dynamics.largest_lag - j, k) + 1):
                a = weight * tables.p[k, i]
                b = weight * tables.q[k, i] / step_s
                if a or b:
                    positions = band.positions(
                        np.array([k - i]),
                        i + j,
                        rows=place[rows[entries]],
                        columns=columns[entries],
                    )
                    dropped.append(
                        _DroppedForce(
                            positions.ravel(),
                            evaluation=k - dynamics.first_row,
                            source=source[entries],
                            complete=entries,
                            a=a,
                            b=b,
                        )
                    )
    return dropped
