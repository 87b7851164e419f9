"""What is looked at of one experiment at a point, and how residuals follow the parameters.

Reactions follow from positions x by the equations of motion, see `reaction`; readings from both.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

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
    """How what is looked at follows the m parameters that move the body, or c poses.

    Attributes
    ----------
    looked : of each reading (R, p, m), what its channel's operator takes of the rows of x
    held : HeldForces
        On the sensed dofs; its first column may be that of a step.
    """

    looked: tuple[Array, ...]
    held: HeldForces


@dataclass(frozen=True, eq=False)
class Sensing:
    """A segment at a point.

    Attributes
    ----------
    segment : Segment
    setting : Setting
    phi : (k,)
    """

    segment: Segment
    setting: Setting
    phi: Array

    def motion(self, x: Array, along: Sequence[AnyHistory] = ()) -> Motion:
        """Positions x (N, 3n), or the first rows, with the reactions that follow from them."""
        return Motion(x, lambda: self._forced(x, along))

    def _forced(self, x: Array, along: Sequence[AnyHistory] = ()) -> Forced:
        dynamics, dofs = self.setting.dynamics.first_rows(len(x)), self.segment.sensed_dofs
        force = forces_on(dynamics, x, dofs, along)
        mass_kg = self._mass_kg[: len(x)]
        reaction = reactions(dynamics, mass_kg, force, dynamics.acceleration(x)[:, dofs])
        return Forced(reaction, x[:, dofs])

    @property
    def _mass_kg(self) -> Array:
        """(N, g) of the sensed dofs."""
        return self.setting.dynamics.mass.kg[:, self.segment.sensed_dofs]

    # Along the equations of motion ------------------------------------------------------------

    def read_along(self, rows: Iterable[Array], held: HeldForces) -> Response:
        """What changes (3n, m) of row after row of x change of what is looked at."""
        channels = [reading.channel for reading in self.segment.readings]
        operators = [channel.operator(self.phi) for channel in channels]
        wanted = [frozenset(channel.rows.tolist()) for channel in channels]
        looked: list[list[Array]] = [[] for _ in channels]
        for t, row in enumerate(rows):
            for found, operator, times in zip(looked, operators, wanted, strict=True):
                if t in times:
                    found.append(operator @ row)
        return Response(tuple(map(np.stack, looked)), held)

    def looked_along(self, by: Array, held: HeldForces) -> Response:
        """The same of the first rows (rows, 3n, m) at once."""
        found, (_, dofs, count) = [], by.shape
        for channel in (reading.channel for reading in self.segment.readings):
            rows = channel.rows[channel.rows < len(by)]
            columns = by[rows].transpose(1, 0, 2).reshape(dofs, len(rows) * count)
            at = channel.operator(self.phi) @ columns
            found.append(at.reshape(len(at), len(rows), count).transpose(1, 0, 2))
        return Response(tuple(found), held)

    def moving(
        self, x: Array, response: Response, step: Array | None = None, by_p: bool = True
    ) -> list[Motion]:
        """The motion as each reading looks at it, and how it changes.

        Parameters
        ----------
        x : (rows, 3n), at which the forces of the response are
        step : (rows, 3n), optional
            After it everything is looked at, to first order; its forces are their first column.
        by_p : whether the columns are those of what moves the body
        """

        def forced(moved: Array) -> Forced:
            return self._along(x, response.held, moved, step, by_p)

        at = x if step is None else x + step
        return [
            Motion(at, lambda moved=looked: forced(moved), looked) for looked in response.looked
        ]

    def _along(
        self, x: Array, held: HeldForces, moved: Array, step: Array | None, by_p: bool
    ) -> Forced:
        dynamics, dofs = self.setting.dynamics.first_rows(len(x)), self.segment.sensed_dofs
        if step is not None:
            moved = np.concatenate([step[:, dofs, None], moved], axis=2)
        acceleration, mass_kg = dynamics.acceleration(x)[:, dofs], self._mass_kg[: len(x)]
        reaction, at = reactions(dynamics, mass_kg, held.force, acceleration), x[:, dofs]
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
        """Residuals (s, G, 3) of each reading, and slopes (s, G, 3, size), see `moving`."""
        segment, size, found = self.segment, self.segment.nq + len(self.phi), []
        motions = self.moving(x, response, step)
        for reading, motion in zip(segment.readings, motions, strict=True):
            looked = reading.channel.linearised(motion, self.phi, segment.moving, size)
            found.append(reading.linearised(*looked, self.phi, size))
        return found

    def still(self, x: Array) -> list[tuple[Array, Array]]:
        """The same, and slopes (s, G, 3, k) by φ, at the first rows x, none of which move."""
        forced, none = self._forced(x), np.zeros(0, dtype=np.int64)
        nothing, found = np.zeros((*forced.reaction.shape, 0)), []
        forced = replace(forced, reaction_by=nothing, position_by=nothing)
        for reading in self.segment.readings:
            motion, count = Motion(x, lambda: forced), len(self.phi)
            looked = reading.channel.linearised(motion, self.phi, none, count)
            found.append(reading.linearised(*looked, self.phi, count))
        return found

    def wrenches(self, x: Array) -> list[Array]:
        """What each sensor should read (S, 6), NaN where that is not known."""
        return [s.of_forced(self.motion(x).forced, self.phi) for s in self.segment.sensors]

    # Backward ---------------------------------------------------------------------------------

    def pulled(self, x: Array, weights: Array) -> tuple[Array, Array]:
        """Slopes of Σ weights · R by x (N, 3n) and by what moves the body, at weights (N, g)."""
        setting, segment, dofs = self.setting, self.segment, self.segment.sensed_dofs
        dynamics, t = setting.dynamics, setting.dynamics.tables
        first, whole = dynamics.first_row, np.zeros_like(x)
        whole[:, dofs] = -dynamics.combine_transposed(t.w, weights)
        at = dynamics.linearise(x, segment.linearisation_rows)
        slopes = setting.force_slopes(slice(first, None), at.by_theta)
        by_p = np.einsum("tg,tgp->p", whole[first:, dofs], slopes[:, dofs])
        if setting.mass_moves:
            acceleration = dynamics.acceleration(x)[:, dofs]
            own = setting.inertia_slopes(slice(None), acceleration, dofs)
            by_p += np.einsum("tg,tgp->p", weights, own)
        rows = Submatrix(dynamics.pattern, dofs)
        state, rate = np.zeros_like(x), np.zeros_like(x)
        for k, weight in enumerate(whole[first:, dofs]):
            if weight.any():
                skew = at.by_position_skew[k]
                state[first + k] = rows.of(at.by_position[k], skew).T @ weight
                rate[first + k] = rows.of(at.by_velocity[k], at.by_velocity_skew[k]).T @ weight
        by_x = dynamics.combine_transposed(t.p, state)
        by_x += dynamics.combine_transposed(t.q, rate) / dynamics.step_s
        inertia = dynamics.combine_transposed(t.s, self._mass_kg * weights)
        by_x[:, dofs] += inertia / dynamics.step_s**2
        of_carried, own = segment.pulled_through(x, setting, whole)
        return by_x + of_carried, by_p + own
