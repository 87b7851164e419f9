"""Observables of one experiment, linearised along the equations of motion.

An `ObservableResponse` turns changes of the positions, from a forward substitution (`sweep`), into
residuals of all measurements with their derivatives by the parameters. Use `from_rows` for changes
that are computed row by row and not stored, and `from_array` for stored ones.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..common.array_types import Array
from .experiment_iterate import ExperimentIterate
from .observables import ObservedMotion
from .reactions.forces import GraspForces, linearised_reactions


@dataclass(frozen=True, eq=False)
class ObservableResponse:
    """Changes of the observables with the m parameters that change the motion, or with c other
    columns.

    Attributes
    ----------
    iterate : ExperimentIterate
        The experiment at the positions and parameters at which the changes were computed.
    observed_changes : tuple of (R, p, m) arrays
        For each measurement, the operator of its observable applied to the changes of the R rows of
        x that it needs.
    grasp_forces : GraspForces
        Forces on the sensed dofs with their changes; with `step`, column 0 belongs to it.
    step : (rows, 3n) array or None
        Step of the positions [m], after which residuals are computed, to first order; None means no
        step.
    """

    iterate: ExperimentIterate
    observed_changes: tuple[Array, ...]
    grasp_forces: GraspForces
    step: Array | None = None

    @classmethod
    def from_rows(
        cls, iterate: ExperimentIterate, rows: Iterable[Array], grasp_forces: GraspForces
    ) -> ObservableResponse:
        """Compute the changes of the observables from changes of x, row by row, so that only
        observed rows are stored.

        Parameters
        ----------
        iterate : ExperimentIterate
            The experiment at the positions of which `rows` are changes.
        rows : iterable of (3n, m) arrays
            Changes of each row of x [m], from row 0 on; consumed.
        grasp_forces : GraspForces
            Forces on the sensed dofs with their changes; stored, and complete only after the rows
            are consumed if their iterator fills it.

        Raises
        ------
        ValueError
            If an observable is not observed at any of the rows.
        """
        channels = [residual.observable for residual in iterate.transcription.residuals]
        operators = [channel.operator(iterate.phi) for channel in channels]
        needed_rows = [frozenset(channel.rows.tolist()) for channel in channels]
        observed: list[list[Array]] = [[] for _ in channels]
        for t, row in enumerate(rows):
            for changes, operator, times in zip(observed, operators, needed_rows, strict=True):
                if t in times:
                    changes.append(operator @ row)
        return cls(iterate, tuple(map(np.stack, observed)), grasp_forces)

    @classmethod
    def from_array(
        cls,
        iterate: ExperimentIterate,
        changes_m: Array,
        grasp_forces: GraspForces,
        step: Array | None = None,
    ) -> ObservableResponse:
        """Compute the changes of the observables at once.

        Parameters
        ----------
        iterate : ExperimentIterate
            The experiment at the positions of which `changes_m` are changes.
        changes_m : (rows, 3n, m) array
            Changes of the first rows of x [m]; observed rows beyond them are left out.
        grasp_forces : GraspForces
            Forces on the sensed dofs with their changes; stored.
        step : (rows, 3n) array, optional
            Step [m], see the class; stored.
        """
        changes = []
        _, dofs, count = changes_m.shape
        for residual in iterate.transcription.residuals:
            channel = residual.observable
            rows = channel.rows[channel.rows < len(changes_m)]
            columns = changes_m[rows].transpose(1, 0, 2).reshape(dofs, len(rows) * count)
            at = channel.operator(iterate.phi) @ columns
            changes.append(at.reshape(len(at), len(rows), count).transpose(1, 0, 2))
        return cls(iterate, tuple(changes), grasp_forces, step=step)

    def motions(self, is_by_parameters: bool = True) -> list[ObservedMotion]:
        """Return the motion with its changes as each measurement observes it; reaction forces are
        computed for the observables that measure them.

        Parameters
        ----------
        is_by_parameters : bool
            Whether the columns are derivatives by the parameters that change the motion, which also
            change the masses.
        """
        iterate = self.iterate
        x = iterate.x
        moved = x if self.step is None else x + self.step
        motions = []
        for residual, changes in zip(
            iterate.transcription.residuals, self.observed_changes, strict=True
        ):
            reactions = None
            if residual.observable.measures_reactions:
                reactions = linearised_reactions(
                    iterate.equations,
                    x,
                    grasp_forces=self.grasp_forces,
                    position_changes=changes,
                    dofs=iterate.transcription.sensed_dofs,
                    step=self.step,
                    is_by_parameters=is_by_parameters,
                )
            motions.append(ObservedMotion(moved, reactions, changes=changes))
        return motions

    def linearise(self) -> list[tuple[Array, Array]]:
        """Linearise the residuals of all measurements by (q, φ) along the equations of motion.

        The changes must be those with the parameters of `Transcription.dynamic_parameters`.

        Returns
        -------
        list of (array, array)
            For each measurement, residuals (s, G, g) and derivatives (s, G, g, size) by all size =
            nq + k parameters, see `MeasurementResidual.linearise`.
        """
        transcription = self.iterate.transcription
        phi = self.iterate.phi
        size = transcription.nq + len(phi)
        linearisations = []
        for residual, motion in zip(transcription.residuals, self.motions(), strict=True):
            values_and_slopes = residual.observable.linearise(
                motion, phi, transcription.dynamic_parameters, size
            )
            linearisations.append(residual.linearise(*values_and_slopes, phi, size))
        return linearisations
