"""What grasps with a sensor give their dofs, as variables R of a program, and its equations.

    (R_t + c_{t,g}) / f_e = 0,   variables R_t / f_e,

the rows that held dofs lack, see `reaction`, of all grid times that have equations of motion. Their
second derivatives are those of the other rows, at other weights.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..arrays import Array, Index
from .carried import Carried
from .motion_rows import MotionRows
from .part import Part
from .reaction import reactions
from .segment import Segment


class Reactions(Carried):
    """R of one experiment."""

    called = "wrench"

    @property
    def dofs(self) -> Index:
        """(g,) which dofs."""
        return self.segment.sensed_dofs

    @property
    def shape(self) -> tuple[int, int]:
        """Grid times from the first with a row on, and dofs."""
        return self.segment.constraint_times, len(self.dofs)

    def places_of(self, times: Index, dofs: Index) -> Index:
        """Places (T, k) in z of some grid times and of dofs, by their numbers among `dofs`."""
        first = self.segment.dynamics.first_row
        return self.places.variable + (times[:, None] - first) * self.shape[1] + dofs

    def newtons(self, z: Array) -> Array:
        """R (N, g), zero before the first row."""
        found = np.zeros((self.segment.grid_rows, self.shape[1]))
        own = z[self.variables].reshape(self.shape)
        found[self.segment.dynamics.first_row :] = own * self.segment.force_n
        return found

    def row_weights(self, multipliers: Array) -> Array:
        """(N, 3n) derivative of multipliers · g by what c has in newtons."""
        found = np.zeros((self.segment.grid_rows, self.segment.dofs))
        by_row = multipliers[self.rows].reshape(self.shape) / self.segment.force_n
        found[self.segment.dynamics.first_row :, self.dofs] = by_row
        return found

    @cached_property
    def _motion(self) -> MotionRows:
        """Structure of ∂c/∂x; a force that a passing grasp takes is among what it gives."""
        segment, dynamics = self.segment, self.segment.dynamics
        untaken = replace(dynamics, taken=np.zeros_like(dynamics.taken))
        return MotionRows(untaken, self.dofs, self.dofs, segment.length_m, segment.force_n)

    def following(self, part: Part) -> Array:
        """R as it follows from positions and parameters."""
        return self._scaled(part.motion.forced.reaction)

    def _scaled(self, newtons: Array) -> Array:
        return newtons[self.segment.dynamics.first_row :].ravel() / self.segment.force_n

    def values(self, part: Part, z: Array) -> Array:
        """The equations."""
        return z[self.variables] - self.following(part)

    def jacobian_entries(self) -> tuple[Index, Index]:
        """Rows and columns: by x, by R, and by what moves the body."""
        segment, band = self.segment, self._motion.band
        equations = np.arange(self.rows.start, self.rows.stop)
        of_x = np.repeat(np.arange(segment.variables), np.diff(band.indptr))
        of_p = segment.moving_in(self.first_phi)
        columns = [segment.first.x + of_x, np.arange(self.variables.start, self.variables.stop)]
        rows = [self.places.row + band.indices, equations, np.repeat(equations, len(of_p))]
        return np.concatenate(rows), np.concatenate([*columns, np.tile(of_p, self.count)])

    def jacobian_values(self, part: Part, z: Array) -> tuple[Array, Array]:
        """The equations, and the values of these entries."""
        setting, motion = part.setting, self._motion
        dynamics, first = setting.dynamics, setting.dynamics.first_row
        by_x = np.empty(motion.band.nnz)
        motion.fill(by_x, part.forces, dynamics, setting.mass_moves)
        by_p = np.zeros((len(part.x), self.shape[1], len(self.segment.moving)))
        slopes = setting.force_slopes(slice(first, None), part.forces.by_theta)
        by_p[first:] = slopes[:, self.dofs]
        by_p = dynamics.combine(dynamics.tables.w, by_p)
        acceleration = dynamics.acceleration(part.x)[:, self.dofs]
        by_p -= setting.inertia_slopes(slice(None), acceleration, self.dofs)
        force = np.zeros(acceleration.shape)
        force[first:] = part.forces.force[:, self.dofs]
        mass_kg = dynamics.mass.kg[:, self.dofs]
        rows = z[self.variables] - self._scaled(reactions(dynamics, mass_kg, force, acceleration))
        return rows, np.concatenate([by_x, np.ones(self.count), self._scaled(by_p)])


class RowsOfMotion(NamedTuple):
    """Rows that forces count in.

    number : (3n,) of each dof among those of a grid time, −1 where it has none
    first : where they begin
    per_time : how many a grid time has
    taken : whether those that grasps take do not count
    """

    number: Index
    first: int
    per_time: int
    taken: bool


def rows_of_motion(segment: Segment, reactions: Reactions | None) -> list[RowsOfMotion]:
    """The equations of motion, and those of what grasps give, where the program has them."""
    kinds = [(segment.free_dofs, segment.row_dofs, segment.first.row, True)]
    if reactions is not None:
        kinds.append((reactions.dofs, reactions.dofs, reactions.places.row, False))
    found = []
    for moving, dofs, first, taken in kinds:
        number = np.full(segment.dofs, -1)
        number[moving] = np.searchsorted(dofs, moving)
        found.append(RowsOfMotion(number, first, len(dofs), taken))
    return found
