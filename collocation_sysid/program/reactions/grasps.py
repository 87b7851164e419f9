"""Reaction forces of instrumented grasps, one time step after the other.

The reaction is the residual of the equations of motion at the grasped dofs (see
`reaction_forces`). It is available one time step late: the midpoint rule evaluates
forces between two steps, and the acceleration of a tool needs the next pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...common.array_types import Array, Index
from ...model.equations_at_parameters import EquationsAtParameters
from ...recording.poses import Poses
from ..observables import ReactionForces
from .forces import GraspForces
from .resultant import ReactionGrid, ReactionResultant

# Number of time steps after which the resultant of a time is available.
DELAY_STEPS = 1

# Resultant of a grasp's reactions, and the index of the grasp.
Sensor = tuple[ReactionResultant, int]
# Weights of the forces and of the positions: two matrices (rows, rows) of the template.
Weights = tuple[Array, Array]


@dataclass(frozen=True, eq=False)
class StreamedResultant(ReactionResultant):
    """Resultant of the reactions of a grasp at consecutive time steps."""

    # (n + 2, 3, 3): rotations of the poses, with one more time step on either side.
    rotations: Array
    shifts: Array  # (n + 2, 3): translations of the poses [m]
    step_s: float  # time step [s]

    @classmethod
    def from_poses(
        cls, channel: ReactionResultant, rotations: Array, shifts: Array, step_s: float
    ) -> StreamedResultant:
        """Return the resultant of the reactions of a grasp at n consecutive time steps.

        Parameters
        ----------
        channel : ReactionResultant
            Resultant in the still recording, whose other properties are copied; generated functions
            are shared.
        rotations : (n + 2, 3, 3)
            Rotations of the grasp at these steps, and at the ones before and after.
        shifts : (n + 2, 3)
            Translations at the same times [m].
        step_s : float
            Time between two steps [s].
        """
        properties = {
            name: getattr(channel, name) for name in ReactionResultant.__dataclass_fields__
        }
        properties["reaction_grid"] = ReactionGrid.from_times(
            step_s * np.arange(len(rotations) - 2, dtype=np.float64)
        )
        resultant = cls(**properties, rotations=rotations, shifts=shifts, step_s=step_s)
        if len(channel.tool_parameters):
            vars(resultant)["tool"] = channel.tool
        return resultant

    def poses_at(self, rows: Index) -> tuple[Array, Array]:
        """Return rotations (k, 3, 3) and translations (k, 3) [m] at k of the n time steps, given by
        index (k,) from 0.
        """
        return self.rotations[1 + rows], self.shifts[1 + rows]

    def pose_accelerations(self, count: int) -> tuple[Array, Array]:
        """Return the second time derivatives of rotations (count, 3, 3) [1/s²] and translations
        (count, 3) [m/s²] at the first `count` time steps, by central differences.
        """
        turn, shift = (
            (each[2:] - 2 * each[1:-1] + each[:-2])[:count] / self.step_s**2
            for each in (self.rotations, self.shifts)
        )
        return turn, shift


@dataclass(frozen=True, eq=False)
class GraspReactions:
    """Forces and columns at the sensed dofs g in the rows of a template, and the poses of all G
    grasps.

    The template is a fixed-size array of the latest time steps.
    """

    forces: GraspForces  # forces at the sensed dofs, with derivatives
    # (rows, g, 1 + m): columns of the positions of these dofs: Newton correction and sensitivities.
    position_columns: Array
    rotations: Array  # (rows, G, 3, 3): rotations of the grasps
    shifts: Array  # (rows, G, 3): translations of the grasps

    @classmethod
    def zeros(cls, rows: int, dofs: int, columns: int, grasps: int) -> GraspReactions:
        """Return zero arrays for a number of rows, dofs, columns and grasps."""
        moved = np.zeros((rows, dofs, columns))
        rotations = np.zeros((rows, grasps, 3, 3))
        return cls(
            GraspForces.zeros(rows, dofs, columns=columns),
            moved,
            rotations=rotations,
            shifts=rotations[..., 0].copy(),
        )

    @property
    def arrays(self) -> tuple[Array, ...]:
        """All arrays whose first axis is the row, not copied: forces and their changes, columns,
        rotations and translations.
        """
        return (
            self.forces.force,
            self.forces.changes,
            self.position_columns,
            self.rotations,
            self.shifts,
        )

    def copy(self) -> GraspReactions:
        """Return a copy that can be modified.

        All arrays are copied.
        """
        force, slopes, *others = (each.copy() for each in self.arrays)
        return GraspReactions(GraspForces(force, slopes), *others)

    def set_poses(self, first: int, poses: Sequence[Poses]) -> None:
        """Store the poses of consecutive rows, in place.

        Parameters
        ----------
        first : int
            Index of the first of these rows in the template.
        poses : sequence of sequences
            For each row the poses of all G grasps, each a rotation (3, 3) and a translation (3,)
            [m].
        """
        rows = slice(first, first + len(poses))
        self.rotations[rows] = [[turn for turn, _ in each] for each in poses]
        self.shifts[rows] = [[shift for _, shift in each] for each in poses]

    def apply_correction(self, here: slice, moved: Array) -> None:
        """Add the Newton correction to the forces of `here` and store the sensitivities, in place.

        The correction of the forces is column 0 of `forces.changes`, which is zero afterwards.

        Parameters
        ----------
        here : slice
            Rows that have just been solved.
        moved : (rows, g, 1 + m)
            Newton correction (column 0, not used) and sensitivities of the positions of the sensed
            dofs.
        """
        self.forces.force[here] += self.forces.changes[here, :, 0]
        self.forces.changes[here, :, 0] = 0.0
        self.position_columns[here, :, 1:] = moved[..., 1:]

    def moved_to(self, step: Array, grown: Array) -> GraspReactions:
        """Return a copy with the forces and sensitivities at another linearisation point, to first
        order.

        Parameters
        ----------
        step : (m,)
            Change of the parameters of the columns.
        grown : (1 + m,)
            Factors by which the columns are multiplied afterwards, because the unit of their
            parameters changes.
        """
        force = self.forces.force + self.forces.changes[..., 1:] @ step
        grasp_forces = GraspForces(force, self.forces.changes * grown)
        return GraspReactions(
            grasp_forces,
            self.position_columns * grown,
            rotations=self.rotations.copy(),
            shifts=self.shifts.copy(),
        )

    def resultants(
        self,
        sensors: Sequence[Sensor],
        setting: EquationsAtParameters,
        x: Array,
        weights: Weights,
        rows: Index,
    ) -> tuple[ReactionForces, list[StreamedResultant]]:
        """Return the reactions at some time steps with derivatives, and the resultants of the
        sensors.

        Forces, sensitivities and poses are those that this object has stored; nothing is changed.

        Parameters
        ----------
        sensors : sequence of Sensor
            At least one; all with the same sensed dofs.
        setting : EquationsAtParameters
            Equations of motion at the linearisation point; the masses are those of time 0.
        x : (known, g)
            Positions of the sensed dofs in the first rows of the template [m], from which the
            accelerations follow.
        weights : (w, s)
            Stencil matrices (rows, rows) of the template, of forces and positions; s includes the
            time step.
        rows : (n,) int
            Consecutive rows at which the reactions become available. The reactions belong to the
            rows `DELAY_STEPS` before; poses are needed from one row before to one after these.

        Returns
        -------
        ReactionForces
            Reactions and positions (n, g) of the sensed dofs, and their sensitivities (n, g, m).
        list of StreamedResultant
            In the order of the sensors.
        """
        dynamics = setting.dynamics
        channel, _ = sensors[0]
        known = slice(len(x))
        at = rows - DELAY_STEPS
        dofs = channel.sensed_dofs
        of_force, of_x = (each[at + channel.reaction_grid.delay_steps, known] for each in weights)
        mass_kg = dynamics.mass.inertia_kg[0, dofs]
        acceleration = of_x @ x
        reaction = mass_kg * acceleration - of_force @ self.forces.force[known]
        position_slopes = self.position_columns[known, :, 1:]
        slopes = self.forces.changes[known, :, 1:]
        by = mass_kg[:, None] * np.tensordot(of_x, position_slopes, 1) - np.tensordot(
            of_force, slopes, 1
        )
        by += setting.inertia_derivatives(0, acceleration, dofs=dofs)
        pose_rows = slice(at[0] - 1, at[-1] + 2)
        channels = [
            StreamedResultant.from_poses(
                channel,
                self.rotations[pose_rows, grasp],
                shifts=self.shifts[pose_rows, grasp],
                step_s=dynamics.step_s,
            )
            for channel, grasp in sensors
        ]
        return ReactionForces(
            reaction, x[at], reaction_by=by, position_by=position_slopes[at]
        ), channels
