"""What grasps with a sensor give the body, row after row: their reactions as sensors look at them.

A row lacks on the grasped dofs what the grasp gives, see `program.reaction`. It is taken a row
late: rules of the midpoint tell it of the time before, and a tool's acceleration needs a pose on
either side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Index
from ..model.setting import Setting
from ..program.channel import Forced
from ..program.reaction import HeldForces
from ..program.wrench_channel import GraspWrench, Grid

# Rows after the time of a wrench when it is taken.
LATE = 1

# Of each grasp, its rotation (3, 3) and its translation (3,).
Poses = tuple[tuple[Array, Array], ...]
# What looks at a grasp, and the number of that.
Sensor = tuple[GraspWrench, int]
# Two matrices (rows, rows) of the template.
Weights = tuple[Array, Array]


@dataclass(frozen=True, eq=False)
class WrenchOfRows(GraspWrench):
    """What a grasp gives at some rows in turn.

    Attributes
    ----------
    turns, shifts : (n + 2, 3, 3) and (n + 2, 3)
        Of its poses, one row more on either side.
    step_s : float
        Between rows.
    """

    turns: Array
    shifts: Array
    step_s: float

    @classmethod
    def of_rows(
        cls, channel: GraspWrench, turns: Array, shifts: Array, step_s: float
    ) -> WrenchOfRows:
        """That of a channel."""
        known = {name: getattr(channel, name) for name in GraspWrench.__dataclass_fields__}
        known["on"] = Grid.at(step_s * np.arange(len(turns) - 2, dtype=np.float64))
        found = cls(**known, turns=turns, shifts=shifts, step_s=step_s)
        if len(channel.tool_phi):
            vars(found)["tool"] = channel.tool
        return found

    def poses_at(self, rows: Index) -> tuple[Array, Array]:
        """Turns and shifts of rows."""
        return self.turns[1 + rows], self.shifts[1 + rows]

    def pose_rates(self, count: int) -> tuple[Array, Array]:
        """Second derivatives of the poses, by differences."""
        turn, shift = (
            (each[2:] - 2 * each[1:-1] + each[:-2])[:count] / self.step_s**2
            for each in (self.turns, self.shifts)
        )
        return turn, shift


@dataclass(frozen=True, eq=False)
class Felt:
    """What rows of a template have of the dofs g whose grasp has a sensor, and all poses.

    Attributes
    ----------
    held : HeldForces
    moved : (rows, g, 1 + m) columns of the dofs
    turns, shifts : (rows, G, 3, 3) and (rows, G, 3)
    """

    held: HeldForces
    moved: Array
    turns: Array
    shifts: Array

    @classmethod
    def nothing(cls, rows: int, dofs: int, columns: int, grasps: int) -> Felt:
        """Room for rows."""
        moved, turns = np.zeros((rows, dofs, columns)), np.zeros((rows, grasps, 3, 3))
        return cls(HeldForces.nothing(rows, dofs, columns), moved, turns, turns[..., 0].copy())

    @property
    def arrays(self) -> tuple[Array, ...]:
        """All there is of each row."""
        return self.held.force, self.held.slopes, self.moved, self.turns, self.shifts

    def copy(self) -> Felt:
        """The same, to be changed."""
        force, slopes, *others = (each.copy() for each in self.arrays)
        return Felt(HeldForces(force, slopes), *others)

    def place(self, first: int, poses: Sequence[Poses]) -> None:
        """Note the poses of rows from the first on."""
        here = slice(first, first + len(poses))
        self.turns[here] = [[turn for turn, _ in each] for each in poses]
        self.shifts[here] = [[shift for _, shift in each] for each in poses]

    def corrected(self, here: slice, moved: Array) -> None:
        """Be at rows that are solved: their corrections are the first column, moved the others."""
        self.held.force[here] += self.held.slopes[here, :, 0]
        self.held.slopes[here, :, 0] = 0.0
        self.moved[here, :, 1:] = moved[..., 1:]

    def at(self, step: Array, grown: Array) -> Felt:
        """The same at another p: to first order, by a step of its columns, which have grown."""
        force = self.held.force + self.held.slopes[..., 1:] @ step
        held = HeldForces(force, self.held.slopes * grown)
        return Felt(held, self.moved * grown, self.turns.copy(), self.shifts.copy())

    def wrenches(
        self, sensors: Sequence[Sensor], setting: Setting, x: Array, weights: Weights, rows: Index
    ) -> tuple[Forced, list[WrenchOfRows]]:
        """Reactions, and what sensors look at of them, as some rows (n,) in turn tell it.

        Parameters
        ----------
        x : (known, g) of the sensed dofs at the first rows of the template
        weights : w and s of the template, the latter with its time
        """
        dynamics, (channel, _), known = setting.dynamics, sensors[0], slice(len(x))
        at, dofs = rows - LATE, channel.sensed
        of_force, of_x = (each[at + channel.on.late, known] for each in weights)
        mass_kg, acceleration = dynamics.mass.kg[0, dofs], of_x @ x
        reaction = mass_kg * acceleration - of_force @ self.held.force[known]
        moved, slopes = self.moved[known, :, 1:], self.held.slopes[known, :, 1:]
        by = mass_kg[:, None] * np.tensordot(of_x, moved, 1) - np.tensordot(of_force, slopes, 1)
        by += setting.inertia_slopes(0, acceleration, dofs)
        around = slice(at[0] - 1, at[-1] + 2)
        channels = [
            WrenchOfRows.of_rows(
                channel, self.turns[around, grasp], self.shifts[around, grasp], dynamics.step_s
            )
            for channel, grasp in sensors
        ]
        return Forced(reaction, x[at], by, moved[at]), channels
