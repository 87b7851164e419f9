"""Observables of one experiment at given parameters, and their derivatives along the equations of
motion.

Reaction forces follow from positions x by the equations of motion, see `reaction`; the observables
of measurements follow from both. Use `Sensing.motion` for values, `Sensing.linearised` for
residuals with derivatives, and `Sensing.pulled` for gradients.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..arrays import Array
from ..model.histories import AnyHistory
from ..model.setting import Setting
from .block_band import Submatrix
from .channel import Forced, Motion
from .reaction import HeldForces, forces_on, reaction_slopes, reactions
from .segment import Segment


@dataclass(frozen=True, eq=False)
class Response:
    """Changes of the observables with the m parameters that change the motion, or with c other
    columns.

    Attributes
    ----------
    looked : tuple of (R, p, m) arrays
        For each measurement, the operator of its observable applied to the changes of the R rows of
        x that it needs.
    held : HeldForces
        Forces on the sensed dofs with their changes; column 0 may be a feasibility step.
    """

    looked: tuple[Array, ...]
    held: HeldForces


@dataclass(frozen=True, eq=False)
class Sensing:
    """Observables of a segment at given parameters.

    Attributes
    ----------
    segment : Segment
        Transcription of the experiment.
    setting : Setting
        Equations of motion at the parameters.
    phi : (k,) array
        Nuisance parameters.
    """

    segment: Segment
    setting: Setting
    phi: Array

    def motion(self, x: Array, along: Sequence[AnyHistory] = ()) -> Motion:
        """Return a motion with the reaction forces that follow from it, computed on demand.

        Parameters
        ----------
        x : (rows, 3n) array
            Positions [m], or their first rows.
        along : sequence of histories
            History variables at x; by default they are computed from x if there are any.
        """
        return Motion(x, partial(self._forced, x, along))

    def _forced(self, x: Array, along: Sequence[AnyHistory] = ()) -> Forced:
        """Return the reaction forces on the sensed dofs at positions x (rows, 3n)."""
        dynamics = self.setting.dynamics.first_rows(len(x))
        dofs = self.segment.sensed_dofs
        force = forces_on(dynamics, x, dofs, along)
        mass_kg = self._mass_kg[: len(x)]
        reaction = reactions(dynamics, mass_kg, force, dynamics.acceleration(x)[:, dofs])
        return Forced(reaction, x[:, dofs])

    @property
    def _mass_kg(self) -> Array:
        """Masses (N, g) of the sensed dofs [kg]."""
        return self.setting.dynamics.mass.kg[:, self.segment.sensed_dofs]

    # Along the equations of motion ------------------------------------------------------------

    def read_along(self, rows: Iterable[Array], held: HeldForces) -> Response:
        """Compute the changes of the observables from changes of x, row by row.

        Parameters
        ----------
        rows : iterable of (3n, m) arrays
            Changes of each row of x [m]; consumed.
        held : HeldForces
            Forces on the sensed dofs with their changes.
        """
        channels = [reading.channel for reading in self.segment.readings]
        operators = [channel.operator(self.phi) for channel in channels]
        needed_rows = [frozenset(channel.rows.tolist()) for channel in channels]
        observed: list[list[Array]] = [[] for _ in channels]
        for t, row in enumerate(rows):
            for changes, operator, times in zip(observed, operators, needed_rows, strict=True):
                if t in times:
                    changes.append(operator @ row)
        return Response(tuple(map(np.stack, observed)), held)

    def looked_along(self, by: Array, held: HeldForces) -> Response:
        """Compute the changes of the observables from changes of the first rows of x,
        (rows, 3n, m), at once.
        """
        changes = []
        _, dofs, count = by.shape
        for channel in (reading.channel for reading in self.segment.readings):
            rows = channel.rows[channel.rows < len(by)]
            columns = by[rows].transpose(1, 0, 2).reshape(dofs, len(rows) * count)
            at = channel.operator(self.phi) @ columns
            changes.append(at.reshape(len(at), len(rows), count).transpose(1, 0, 2))
        return Response(tuple(changes), held)

    def moving(
        self, x: Array, response: Response, step: Array | None = None, by_p: bool = True
    ) -> list[Motion]:
        """Return the motion as each measurement observes it, with its changes.

        Parameters
        ----------
        x : (rows, 3n) array
            Positions [m] at which the forces of the response were computed.
        response : Response
            Changes of the observables.
        step : (rows, 3n) array, optional
            Step [m]. If given, values are those after the step, to first order, and column 0 of the
            forces of the response must belong to it.
        by_p : bool
            Whether the columns are derivatives by the parameters that change the motion.

        Returns
        -------
        list of Motion
            One entry per measurement.
        """

        def forced(moved: Array) -> Forced:
            return self._along(x, response.held, moved, step, by_p)

        at = x if step is None else x + step
        return [Motion(at, partial(forced, changes), changes) for changes in response.looked]

    def _along(
        self, x: Array, held: HeldForces, moved: Array, step: Array | None, by_p: bool
    ) -> Forced:
        """Return reaction forces with their changes, see `moving`; `moved` (rows, g, c) are
        the changes of the positions of the sensed dofs [m].
        """
        dynamics = self.setting.dynamics.first_rows(len(x))
        dofs = self.segment.sensed_dofs
        if step is not None:
            moved = np.concatenate([step[:, dofs, None], moved], axis=2)
        acceleration = dynamics.acceleration(x)[:, dofs]
        mass_kg = self._mass_kg[: len(x)]
        reaction = reactions(dynamics, mass_kg, held.force, acceleration)
        at = x[:, dofs]
        by = reaction_slopes(dynamics, mass_kg, held.slopes, moved)
        if by_p:
            first = 0 if step is None else 1
            by[..., first:] += self.setting.inertia_slopes(slice(len(x)), acceleration, dofs)
        if step is None:
            return Forced(reaction, at, by, moved)
        return Forced(reaction + by[..., 0], at + moved[..., 0], by[..., 1:], moved[..., 1:])

    def linearised(
        self, x: Array, response: Response, step: Array | None = None
    ) -> list[tuple[Array, Array]]:
        """Linearise the residuals of all measurements by (q, φ).

        Parameters
        ----------
        x : (rows, 3n) array
            Positions [m].
        response : Response
            Changes of the observables with the parameters.
        step : (rows, 3n) array, optional
            Step after which residuals are computed, to first order; see `moving`.

        Returns
        -------
        list of (array, array)
            For each measurement, residuals (s, G, 3) and derivatives (s, G, 3, size) by all size =
            nq + k parameters.
        """
        segment = self.segment
        size = self.segment.nq + len(self.phi)
        found = []
        motions = self.moving(x, response, step)
        for reading, motion in zip(segment.readings, motions, strict=True):
            values_and_slopes = reading.channel.linearised(motion, self.phi, segment.moving, size)
            found.append(reading.linearised(*values_and_slopes, self.phi, size))
        return found

    def still(self, x: Array) -> list[tuple[Array, Array]]:
        """Linearise the residuals of all measurements by φ, at a motion that does not change.

        Parameters
        ----------
        x : (rows, 3n) array
            First rows of the motion [m].

        Returns
        -------
        list of (array, array)
            For each measurement, residuals (s, G, 3) and derivatives (s, G, 3, k).
        """
        forced = self._forced(x)
        none = np.zeros(0, dtype=np.int64)
        nothing = np.zeros((*forced.reaction.shape, 0))
        linearised = []
        forced = replace(forced, reaction_by=nothing, position_by=nothing)

        def reactions() -> Forced:
            return forced

        for reading in self.segment.readings:
            motion = Motion(x, reactions)
            count = len(self.phi)
            values_and_slopes = reading.channel.linearised(motion, self.phi, none, count)
            linearised.append(reading.linearised(*values_and_slopes, self.phi, count))
        return linearised

    def wrenches(self, x: Array) -> list[Array]:
        """Return the prediction (S, 6) for each wrench sensor [N, N m], NaN at samples
        outside the known times.
        """
        return [s.of_forced(self.motion(x).forced, self.phi) for s in self.segment.sensors]

    # Backward ---------------------------------------------------------------------------------

    def pulled(self, x: Array, weights: Array) -> tuple[Array, Array]:
        """Vector–Jacobian product of the reaction forces.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        weights : (N, g) array
            Weights of the reaction forces R.

        Returns
        -------
        ((N, 3n) array, (m,) array)
            Derivatives of Σ weights · R by x and by the parameters that change the motion.
        """
        setting = self.setting
        segment = self.segment
        dofs = self.segment.sensed_dofs
        dynamics = setting.dynamics
        t = setting.dynamics.tables
        first = dynamics.first_row
        force_weights = np.zeros_like(x)
        force_weights[:, dofs] = -dynamics.combine_transposed(t.w, weights)
        at = dynamics.linearise(x, segment.linearisation_rows)
        slopes = setting.force_slopes(slice(first, None), at.by_theta)
        by_p = np.einsum("tg,tgp->p", force_weights[first:, dofs], slopes[:, dofs])
        if setting.mass_moves:
            acceleration = dynamics.acceleration(x)[:, dofs]
            own = setting.inertia_slopes(slice(None), acceleration, dofs)
            by_p += np.einsum("tg,tgp->p", weights, own)
        rows = Submatrix(dynamics.pattern, dofs)
        state = np.zeros_like(x)
        rate = np.zeros_like(x)
        for k, weight in enumerate(force_weights[first:, dofs]):
            if weight.any():
                skew = at.by_position_skew[k]
                state[first + k] = rows.of(at.by_position[k], skew).T @ weight
                rate[first + k] = rows.of(at.by_velocity[k], at.by_velocity_skew[k]).T @ weight
        by_x = dynamics.combine_transposed(t.p, state)
        by_x += dynamics.combine_transposed(t.q, rate) / dynamics.step_s
        inertia = dynamics.combine_transposed(t.s, self._mass_kg * weights)
        by_x[:, dofs] += inertia / dynamics.step_s**2
        through_histories, own = segment.pulled_through(x, setting, force_weights)
        return by_x + through_histories, by_p + own
