"""Reaction forces R of instrumented grasps as variables of the program, with their equations.

    (R_t + c_{t,g}) / f_e = 0,   variables R_t / f_e,

with the residual c of the equations of motion at the grasped dofs g, see `reaction`, and the force
unit f_e of the experiment, at all grid times with equations of motion. Second derivatives are those
of the equations of motion, with additional weights (`row_weights`).
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
    """Lifted reaction forces R of one experiment."""

    called = "wrench"

    @property
    def dofs(self) -> Index:
        """Dofs (g,) whose reaction forces are lifted."""
        return self.segment.sensed_dofs

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (times, g): grid times with equations of motion, and dofs."""
        return self.segment.constraint_times, len(self.dofs)

    def places_of(self, times: Index, dofs: Index) -> Index:
        """Return the columns (T, k) in z of reaction forces.

        Parameters
        ----------
        times : (T,) array
            Grid times.
        dofs : (k,) array
            Indices into `dofs`.
        """
        first = self.segment.dynamics.first_row
        return self.places.variable + (times[:, None] - first) * self.shape[1] + dofs

    def newtons(self, z: Array) -> Array:
        """Return the reaction forces R (N, g) [N] from z; zero before the first equation of
        motion.
        """
        forces_n = np.zeros((self.segment.grid_rows, self.shape[1]))
        own = z[self.variables].reshape(self.shape)
        forces_n[self.segment.dynamics.first_row :] = own * self.segment.force_n
        return forces_n

    def row_weights(self, multipliers: Array) -> Array:
        """Return the derivative (N, 3n) of multipliers · g by the residual c in newtons [1/N]."""
        weights = np.zeros((self.segment.grid_rows, self.segment.dofs))
        by_row = multipliers[self.rows].reshape(self.shape) / self.segment.force_n
        weights[self.segment.dynamics.first_row :, self.dofs] = by_row
        return weights

    @cached_property
    def _motion(self) -> MotionRows:
        """Structure of ∂c/∂x, including forces on dofs while a grasp prescribes them."""
        segment = self.segment
        dynamics = self.segment.dynamics
        untaken = replace(dynamics, taken=np.zeros_like(dynamics.taken))
        return MotionRows(untaken, self.dofs, self.dofs, segment.length_m, segment.force_n)

    def following(self, part: Part) -> Array:
        """Return the scaled reaction forces (count,) that follow from positions and parameters."""
        return self._scaled(part.motion.forced.reaction)

    def _scaled(self, newtons: Array) -> Array:
        """Return forces (N, …) [N] as scaled values, without the rows before the first
        equation of motion.
        """
        return newtons[self.segment.dynamics.first_row :].ravel() / self.segment.force_n

    def values(self, part: Part, z: Array) -> Array:
        """Return the scaled equations (count,)."""
        return z[self.variables] - self.following(part)

    def jacobian_entries(self) -> tuple[Index, Index]:
        """Return rows and columns of the entries by x, by R, and by the parameters that
        change the motion.
        """
        segment = self.segment
        band = self._motion.band
        equations = np.arange(self.rows.start, self.rows.stop)
        of_x = np.repeat(np.arange(segment.variables), np.diff(band.indptr))
        of_p = segment.moving_in(self.first_phi)
        columns = [segment.first.x + of_x, np.arange(self.variables.start, self.variables.stop)]
        rows = [self.places.row + band.indices, equations, np.repeat(equations, len(of_p))]
        return np.concatenate(rows), np.concatenate([*columns, np.tile(of_p, self.count)])

    def jacobian_values(self, part: Part, z: Array) -> tuple[Array, Array]:
        """Return the equations, and the values of `jacobian_entries`."""
        setting = part.setting
        motion = self._motion
        dynamics = setting.dynamics
        first = setting.dynamics.first_row
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
    """Constraints that contain forces: equations of motion, or those of reaction forces.

    Attributes
    ----------
    number : (3n,) array
        Index of each dof's row within a grid time, −1 where it has none.
    first : int
        Index in g of the first row.
    per_time : int
        Number of rows of a grid time.
    taken : bool
        Whether forces on dofs that a grasp prescribes at that time are left out.
    """

    number: Index
    first: int
    per_time: int
    taken: bool


def rows_of_motion(segment: Segment, reactions: Reactions | None) -> list[RowsOfMotion]:
    """Return the equations of motion of a segment, and those of its lifted reaction forces
    if there are any.
    """
    kinds = [(segment.free_dofs, segment.row_dofs, segment.first.row, True)]
    if reactions is not None:
        kinds.append((reactions.dofs, reactions.dofs, reactions.places.row, False))
    equations = []
    for moving, dofs, first, taken in kinds:
        number = np.full(segment.dofs, -1)
        number[moving] = np.searchsorted(dofs, moving)
        equations.append(RowsOfMotion(number, first, len(dofs), taken))
    return equations
