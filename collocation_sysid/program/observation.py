"""Observables of one experiment at given parameters, and their derivatives along the equations of
motion.

Reaction forces follow from positions x by the equations of motion, see `reaction_forces`; the
observables of measurements follow from both. Use `Observation.motion` for values,
`Observation.linearise` for residuals with derivatives, and `Observation.reaction_vjp` for
gradients.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..common.array_types import Array
from ..model.equations_at_parameters import EquationsAtParameters
from ..model.internal_variables import AnyHistory
from .linear_algebra.block_band import Submatrix
from .observables import ObservedMotion, ReactionForces
from .transcription import Transcription
from .wrench.reaction_forces import (
    GraspForces,
    forces_on_dofs,
    reaction_changes,
    reaction_forces,
)


@dataclass(frozen=True, eq=False)
class ObservableResponse:
    """Changes of the observables with the m parameters that change the motion, or with c other
    columns.

    Attributes
    ----------
    observed_changes : tuple of (R, p, m) arrays
        For each measurement, the operator of its observable applied to the changes of the R rows of
        x that it needs.
    grasp_forces : GraspForces
        Forces on the sensed dofs with their changes; column 0 may be a feasibility step.
    """

    observed_changes: tuple[Array, ...]
    grasp_forces: GraspForces


@dataclass(frozen=True, eq=False)
class Observation:
    """Observables of a segment at given parameters.

    Attributes
    ----------
    segment : Transcription
        Transcription of the experiment.
    equations : EquationsAtParameters
        Equations of motion at the parameters.
    phi : (k,) array
        Nuisance parameters.
    """

    segment: Transcription
    equations: EquationsAtParameters
    phi: Array

    def motion(
        self, x: Array, histories: Sequence[AnyHistory] = ()
    ) -> ObservedMotion:
        """Return a motion with the reaction forces that follow from it, computed on demand.

        Parameters
        ----------
        x : (rows, 3n) array
            Positions [m], or their first rows.
        histories : sequence of histories
            History variables at x; by default they are computed from x if there are any.
        """
        return ObservedMotion(x, partial(self._reactions_at, x, histories))

    def _reactions_at(
        self, x: Array, histories: Sequence[AnyHistory] = ()
    ) -> ReactionForces:
        """Return the reaction forces on the sensed dofs, without changes, at positions x (rows, 3n)
        [m]; history variables are computed from x where `histories` is empty.
        """
        dynamics = self.equations.dynamics.truncated_to(len(x))
        dofs = self.segment.sensed_dofs
        force = forces_on_dofs(dynamics, x, dofs=dofs, histories=histories)
        mass_kg = self._mass_kg[: len(x)]
        reaction = reaction_forces(
            dynamics,
            mass_kg,
            force=force,
            acceleration=dynamics.acceleration(x)[:, dofs],
        )
        return ReactionForces(reaction, x[:, dofs])

    @property
    def _mass_kg(self) -> Array:
        """Masses (N, g) of the sensed dofs [kg]."""
        return self.equations.dynamics.mass.inertia_kg[
            :, self.segment.sensed_dofs
        ]

    # Along the equations of motion ------------------------------------------------------------

    def response_of_rows(
        self, rows: Iterable[Array], grasp_forces: GraspForces
    ) -> ObservableResponse:
        """Compute the changes of the observables from changes of x, row by row, so that only
        observed rows are stored.

        Parameters
        ----------
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
        channels = [reading.observable for reading in self.segment.residuals]
        operators = [channel.operator(self.phi) for channel in channels]
        needed_rows = [frozenset(channel.rows.tolist()) for channel in channels]
        observed: list[list[Array]] = [[] for _ in channels]
        for t, row in enumerate(rows):
            for changes, operator, times in zip(
                observed, operators, needed_rows, strict=True
            ):
                if t in times:
                    changes.append(operator @ row)
        return ObservableResponse(tuple(map(np.stack, observed)), grasp_forces)

    def response_of_array(
        self, changes_m: Array, grasp_forces: GraspForces
    ) -> ObservableResponse:
        """Return the changes of the observables, computed at once.

        Parameters
        ----------
        changes_m : (rows, 3n, m) array
            Changes of the first rows of x [m]; observed rows beyond them are left out.
        grasp_forces : GraspForces
            Forces on the sensed dofs with their changes; stored.
        """
        changes = []
        _, dofs, count = changes_m.shape
        for channel in (
            reading.observable for reading in self.segment.residuals
        ):
            rows = channel.rows[channel.rows < len(changes_m)]
            columns = (
                changes_m[rows]
                .transpose(1, 0, 2)
                .reshape(dofs, len(rows) * count)
            )
            at = channel.operator(self.phi) @ columns
            changes.append(
                at.reshape(len(at), len(rows), count).transpose(1, 0, 2)
            )
        return ObservableResponse(tuple(changes), grasp_forces)

    def linearised_motions(
        self,
        x: Array,
        response: ObservableResponse,
        step: Array | None = None,
        is_by_parameters: bool = True,
    ) -> list[ObservedMotion]:
        """Return the motion as each measurement observes it, with its changes; reaction forces are
        computed on demand.

        Parameters
        ----------
        x : (rows, 3n) array
            Positions [m] at which the forces of the response were computed.
        response : ObservableResponse
            Changes of the observables.
        step : (rows, 3n) array, optional
            Step [m]. If given, values are those after the step, to first order, and column 0 of the
            forces of the response must belong to it.
        is_by_parameters : bool
            Whether the columns are derivatives by the parameters that change the motion, which also
            change the masses.

        Returns
        -------
        list of ObservedMotion
            One entry per measurement.
        """

        def forced(changes: Array) -> ReactionForces:
            return self._linearised_reactions(
                x,
                response.grasp_forces,
                changes_m=changes,
                step=step,
                by_p=is_by_parameters,
            )

        at = x if step is None else x + step
        return [
            ObservedMotion(at, partial(forced, changes), changes=changes)
            for changes in response.observed_changes
        ]

    def _linearised_reactions(
        self,
        x: Array,
        grasp_forces: GraspForces,
        changes_m: Array,
        step: Array | None,
        by_p: bool,
    ) -> ReactionForces:
        """Returns
        -------
        ReactionForces
            Values, with a step those after it to first order, and changes without the column of the
            step.
        """
        dynamics = self.equations.dynamics.truncated_to(len(x))
        dofs = self.segment.sensed_dofs
        if step is not None:
            changes_m = np.concatenate([step[:, dofs, None], changes_m], axis=2)
        acceleration = dynamics.acceleration(x)[:, dofs]
        mass_kg = self._mass_kg[: len(x)]
        reaction = reaction_forces(
            dynamics,
            mass_kg,
            force=grasp_forces.force,
            acceleration=acceleration,
        )
        at = x[:, dofs]
        by = reaction_changes(
            dynamics,
            mass_kg,
            force_changes=grasp_forces.changes,
            position_changes=changes_m,
        )
        if by_p:
            first = 0 if step is None else 1
            by[..., first:] += self.equations.inertia_derivatives(
                slice(len(x)), acceleration, dofs=dofs
            )
        if step is None:
            return ReactionForces(
                reaction, at, reaction_by=by, position_by=changes_m
            )
        return ReactionForces(
            reaction + by[..., 0],
            at + changes_m[..., 0],
            reaction_by=by[..., 1:],
            position_by=changes_m[..., 1:],
        )

    def linearise(
        self, x: Array, response: ObservableResponse, step: Array | None = None
    ) -> list[tuple[Array, Array]]:
        """Linearise the residuals of all measurements by (q, φ) along the equations of motion.

        Parameters
        ----------
        x : (rows, 3n) array
            Positions [m].
        response : ObservableResponse
            Changes of the observables with the parameters of `Transcription.dynamic_parameters`.
        step : (rows, 3n) array, optional
            Step after which residuals are computed, to first order; see `linearised_motions`.

        Returns
        -------
        list of (array, array)
            For each measurement, residuals (s, G, g) and derivatives (s, G, g, size) by all size =
            nq + k parameters, see `MeasurementResidual.linearise`.
        """
        segment = self.segment
        size = self.segment.nq + len(self.phi)
        linearisations = []
        motions = self.linearised_motions(x, response, step=step)
        for reading, motion in zip(segment.residuals, motions, strict=True):
            values_and_slopes = reading.observable.linearise(
                motion, self.phi, columns=segment.dynamic_parameters, size=size
            )
            linearisations.append(
                reading.linearise(*values_and_slopes, self.phi, size)
            )
        return linearisations

    def linearise_fixed_motion(self, x: Array) -> list[tuple[Array, Array]]:
        """Linearise the residuals of all measurements by φ, at a motion that does not change.

        Parameters
        ----------
        x : (rows, 3n) array
            First rows of the motion [m].

        Returns
        -------
        list of (array, array)
            For each measurement, residuals (s, G, 3) and derivatives (s, G, 3, k).

        Wrenches are included, with the reaction forces of the motion.
        """
        forced = self._reactions_at(x)
        none = np.zeros(0, dtype=np.int64)
        nothing = np.zeros((*forced.reaction.shape, 0))
        linearised = []
        forced = replace(forced, reaction_by=nothing, position_by=nothing)

        def reactions() -> ReactionForces:
            return forced

        for reading in self.segment.residuals:
            motion = ObservedMotion(x, reactions)
            count = len(self.phi)
            values_and_slopes = reading.observable.linearise(
                motion, self.phi, columns=none, size=count
            )
            linearised.append(
                reading.linearise(*values_and_slopes, self.phi, count)
            )
        return linearised

    def predict_wrenches(self, x: Array) -> list[Array]:
        """Return the prediction (S, 6) for each wrench sensor [N, N m] at positions x (rows, 3n);
        NaN at samples for which the rows do not suffice.
        """
        return [
            s.predict_reactions(self.motion(x).reactions, self.phi)
            for s in self.segment.sensors
        ]

    # Backward ---------------------------------------------------------------------------------

    def reaction_vjp(self, x: Array, weights: Array) -> tuple[Array, Array]:
        """Vector–Jacobian product of the reaction forces. The segment's `linearisation_buffer` is
        overwritten.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        weights : (N, g) array
            Weights of the reaction forces R [1/N].

        Returns
        -------
        ((N, 3n) array, (m,) array)
            Derivatives of Σ weights · R by x [1/m] and by the parameters that change the motion,
            including the dependence through history variables.
        """
        setting = self.equations
        segment = self.segment
        dofs = self.segment.sensed_dofs
        dynamics = setting.dynamics
        t = setting.dynamics.tables
        first = dynamics.first_row
        force_weights = np.zeros_like(x)
        force_weights[:, dofs] = -dynamics.combine_transposed(t.w, weights)
        at = dynamics.linearise(x, segment.linearisation_buffer)
        slopes = setting.force_derivatives(slice(first, None), at.by_theta)
        by_p = np.einsum(
            "tg,tgp->p", force_weights[first:, dofs], slopes[:, dofs]
        )
        if setting.mass_depends_on_parameters:
            acceleration = dynamics.acceleration(x)[:, dofs]
            own = setting.inertia_derivatives(
                slice(None), acceleration, dofs=dofs
            )
            by_p += np.einsum("tg,tgp->p", weights, own)
        rows = Submatrix(dynamics.pattern, dofs)
        state = np.zeros_like(x)
        rate = np.zeros_like(x)
        for k, weight in enumerate(force_weights[first:, dofs]):
            if weight.any():
                skew = at.by_position_skew[k]
                state[first + k] = (
                    rows.extract(at.by_position[k], skew).T @ weight
                )
                rate[first + k] = (
                    rows.extract(at.by_velocity[k], at.by_velocity_skew[k]).T
                    @ weight
                )
        by_x = dynamics.combine_transposed(t.p, state)
        by_x += dynamics.combine_transposed(t.q, rate) / dynamics.step_s
        inertia = dynamics.combine_transposed(t.s, self._mass_kg * weights)
        by_x[:, dofs] += inertia / dynamics.step_s**2
        through_histories, own = segment.history_vjp(
            x, setting, weights=force_weights
        )
        return by_x + through_histories, by_p + own
