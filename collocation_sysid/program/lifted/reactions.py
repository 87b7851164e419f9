"""Reaction forces R of instrumented grasps as variables of the program, with their equations.

    (R_t + c_{t,g}) / f_e = 0,   variables R_t / f_e,

with the residual c of the equations of motion at the grasped dofs g, see `reaction_forces`, and the
force unit f_e of the experiment, at all grid times with equations of motion. Second derivatives are
those of the equations of motion, with additional weights (`residual_weights`).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ...common.array_types import Array, Index
from ..experiment_iterate import ExperimentIterate
from ..motion_jacobian import MotionJacobian
from ..reactions.forces import reaction_forces
from ..transcription import Transcription
from .variables import LiftedVariables


class LiftedReactions(LiftedVariables):
    """Lifted reaction forces R of one experiment."""

    kind = "reaction"

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (times, g): grid times with equations of motion, and dofs."""
        return self.transcription.constraint_times, len(self.transcription.sensed_dofs)

    def columns_of(self, times: Index, dofs: Index) -> Index:
        """Return the columns (T, k) in z of reaction forces.

        Parameters
        ----------
        times : (T,) array
            Indices of grid times with equations of motion.
        dofs : (k,) array
            Indices into `sensed_dofs`.
        """
        first = self.transcription.dynamics.first_row
        return self.offsets.variable + (times[:, None] - first) * self.shape[1] + dofs

    def reactions_n(self, z: Array) -> Array:
        """Return the reaction forces R (N, g) [N] from z; zero before the first equation of
        motion.
        """
        forces_n = np.zeros((self.transcription.grid_times, self.shape[1]))
        own = z[self.columns].reshape(self.shape)
        forces_n[self.transcription.dynamics.first_row :] = own * self.transcription.force_n
        return forces_n

    def residual_weights(self, multipliers: Array) -> Array:
        weights = np.zeros((self.transcription.grid_times, self.transcription.dof_count))
        by_row = multipliers[self.rows].reshape(self.shape) / self.transcription.force_n
        weights[self.transcription.dynamics.first_row :, self.transcription.sensed_dofs] = by_row
        return weights

    @cached_property
    def _motion_jacobian(self) -> MotionJacobian:
        """Structure of ∂c/∂x at sensed dofs, including forces while a grasp prescribes them."""
        transcription = self.transcription
        dynamics = self.transcription.dynamics
        untaken = replace(
            dynamics, is_temporarily_prescribed=np.zeros_like(dynamics.is_temporarily_prescribed)
        )
        return MotionJacobian(
            untaken,
            self.transcription.sensed_dofs,
            free_dofs=self.transcription.sensed_dofs,
            length_m=transcription.length_m,
            force_n=transcription.force_n,
        )

    def consistent_values(self, iterate: ExperimentIterate) -> Array:
        return self._scaled(iterate.reactions.reaction)

    def _scaled(self, newtons: Array) -> Array:
        """Return scaled forces (N, …) without rows before the first equation of motion."""
        return newtons[self.transcription.dynamics.first_row :].ravel() / self.transcription.force_n

    def residuals(self, iterate: ExperimentIterate, z: Array) -> Array:
        """Return the scaled equations (count,): the variables in z minus the reaction forces that
        follow from the iterate.
        """
        return z[self.columns] - self.consistent_values(iterate)

    def jacobian_entries(self) -> tuple[Index, Index]:
        """Return rows in g and columns in z of the entries by x, by R, and by the parameters that
        change the motion.
        """
        transcription = self.transcription
        band = self._motion_jacobian.structure
        equations = np.arange(self.rows.start, self.rows.stop)
        of_x = np.repeat(np.arange(transcription.variable_count), np.diff(band.indptr))
        of_p = transcription.dynamic_columns(self.first_phi)
        columns = [
            transcription.offsets.variable + of_x,
            np.arange(self.columns.start, self.columns.stop),
        ]
        rows = [self.offsets.row + band.indices, equations, np.repeat(equations, len(of_p))]
        return np.concatenate(rows), np.concatenate([*columns, np.tile(of_p, self.count)])

    def jacobian_values(self, iterate: ExperimentIterate, z: Array) -> tuple[Array, Array]:
        setting = iterate.equations
        motion = self._motion_jacobian
        dynamics = setting.dynamics
        first = setting.dynamics.first_row
        by_x = np.empty(motion.structure.nnz)
        motion.fill(
            by_x,
            iterate.forces,
            dynamics=dynamics,
            has_variable_mass=setting.mass_depends_on_parameters,
        )
        by_p = np.zeros((len(iterate.x), self.shape[1], len(self.transcription.dynamic_parameters)))
        slopes = setting.force_derivatives(slice(first, None), iterate.forces.by_theta)
        by_p[first:] = slopes[:, self.transcription.sensed_dofs]
        by_p = dynamics.combine(dynamics.tables.w, by_p)
        acceleration = dynamics.acceleration(iterate.x)[:, self.transcription.sensed_dofs]
        by_p -= setting.inertia_derivatives(
            slice(None), acceleration, dofs=self.transcription.sensed_dofs
        )
        force = np.zeros(acceleration.shape)
        force[first:] = iterate.forces.force[:, self.transcription.sensed_dofs]
        mass_kg = dynamics.mass.inertia_kg[:, self.transcription.sensed_dofs]
        rows = z[self.columns] - self._scaled(
            reaction_forces(dynamics, mass_kg, force=force, acceleration=acceleration)
        )
        return rows, np.concatenate([by_x, np.ones(self.count), self._scaled(by_p)])


class MotionEquations(NamedTuple):
    """Constraints that contain forces: equations of motion, or those of reaction forces."""

    row_of_dof: Index  # (3n,): index of each dof's row within a grid time, −1 where it has none
    first_row: int  # index in g of the first row
    rows_per_time: int  # number of rows of a grid time
    # Whether forces on dofs that a grasp prescribes at that time are left out.
    omits_prescribed: bool


def motion_equations(
    transcription: Transcription, reactions: LiftedReactions | None
) -> list[MotionEquations]:
    """Return the sets of constraints of an experiment that contain forces: its equations of motion
    and, unless `reactions` is None, the equations of its lifted reaction forces.
    """
    constrained = transcription.constrained_dofs
    free = transcription.free_dofs
    row_of_dof = np.full(transcription.dof_count, -1)
    row_of_dof[free] = np.searchsorted(constrained, free)
    equations = [
        MotionEquations(
            row_of_dof,
            first_row=transcription.offsets.row,
            rows_per_time=len(constrained),
            omits_prescribed=True,
        )
    ]
    if reactions is not None:
        sensed = reactions.transcription.sensed_dofs
        row_of_dof = np.full(transcription.dof_count, -1)
        row_of_dof[sensed] = np.arange(len(sensed))
        equations.append(
            MotionEquations(
                row_of_dof,
                first_row=reactions.offsets.row,
                rows_per_time=len(sensed),
                omits_prescribed=False,
            )
        )
    return equations
