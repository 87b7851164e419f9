"""The part of the loss that measured wrenches have, at positions x of one experiment.

L_w = Σ ρ(‖(ŷ − w) / σ‖) over the forces, and the torques, of all samples of all sensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..arrays import Array, Index
from .reaction import HeldForces, forces_on, reaction_slopes, reactions
from .sensor import Forced, Sensor
from .unsymmetric import Submatrix

if TYPE_CHECKING:
    from .segment import Segment
    from .setting import Setting


NOTHING = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Sensing:
    """The sensors of a segment at a point.

    Attributes
    ----------
    segment : Segment
    setting : Setting
    phi : (k,)
    """

    segment: Segment
    setting: Setting
    phi: Array

    @property
    def size(self) -> int:
        """Length of (q, φ)."""
        return self.segment.nq + len(self.phi)

    # What acts on the sensed dofs -------------------------------------------------------------

    def at(self, x: Array) -> Forced:
        """The reactions at positions x (N, 3n), or at its first rows."""
        dynamics, dofs = self.setting.dynamics.first_rows(len(x)), self.segment.sensed_dofs
        force, mass_kg = forces_on(dynamics, x, self.setting.theta, dofs), self._mass_kg[: len(x)]
        reaction = reactions(dynamics, mass_kg, force, dynamics.acceleration(x)[:, dofs])
        return Forced.still(reaction, x[:, dofs])

    @property
    def _mass_kg(self) -> Array:
        """(N, g) of the sensed dofs."""
        dynamics = self.setting.dynamics
        return dynamics.mass.at(self.setting.theta)[:, self.segment.sensed_dofs]

    def along(self, x: Array, held: HeldForces, moved: Array, first: int | None = None) -> Forced:
        """The same of the first rows x, from their forces, and how they change.

        Parameters
        ----------
        moved : (rows, g, c) how the dofs move
        first : int, optional
            Column from which on they are those of what moves the body.
        """
        dynamics, dofs = self.setting.dynamics.first_rows(len(x)), self.segment.sensed_dofs
        acceleration, mass_kg = dynamics.acceleration(x)[:, dofs], self._mass_kg[: len(x)]
        reaction = reactions(dynamics, mass_kg, held.force, acceleration)
        by = reaction_slopes(dynamics, mass_kg, held.slopes, moved)
        if first is not None:
            rows = slice(len(x))
            by[..., first:] += self.setting.inertia_slopes(rows, acceleration, dofs)
        return Forced(reaction, x[:, dofs], by, moved)

    # Residuals --------------------------------------------------------------------------------

    def linearised(self, forced: Forced, columns: Index) -> list[tuple[Array, Array]]:
        """Residuals (S, 2, 3) of each sensor, and slopes (S, 2, 3, size) by (q, φ)."""
        return [
            sensor.linearised(forced, columns, self.phi, self.size)
            for sensor in self.segment.sensors
        ]

    def response(self, forced: Forced) -> list[Array]:
        """Changes (S, 2, 3, c) of the residuals of each sensor by the c changes of `forced`."""
        count = forced.reaction_by.shape[2]
        columns, size = np.arange(count), count + len(self.phi)
        return [
            sensor.linearised(forced, columns, self.phi, size)[1][..., :count]
            for sensor in self.segment.sensors
        ]

    def projected(self, x: Array, held: HeldForces, moved: Array) -> list[tuple[Array, Array]]:
        """The same after a feasibility step, which is the first of the columns, to first order."""
        forced = self.along(x, held, moved, first=1)
        after = Forced(
            forced.reaction + forced.reaction_by[..., 0],
            forced.position_m + forced.position_by[..., 0],
            forced.reaction_by[..., 1:],
            forced.position_by[..., 1:],
        )
        return self.linearised(after, self.segment.moving)

    def readings(self, x: Array) -> list[Array]:
        """What each sensor should read (S, 6), NaN where that is not known."""
        return self.of(self.segment.sensors, self.at(x))

    def of(self, sensors: Sequence[Sensor], forced: Forced) -> list[Array]:
        """The same of the experiment's sensors on any grid, from the reactions there."""
        return [sensor.readings(forced, self.phi) for sensor in sensors]

    # Loss -------------------------------------------------------------------------------------

    def loss(self, x: Array) -> float:
        """L_w."""
        if not self.segment.sensors:
            return 0.0
        forced = self.at(x)
        given = [
            sensor.given(forced, NOTHING, self.phi, self.size) for sensor in self.segment.sensors
        ]
        pairs = zip(self.segment.sensors, given, strict=True)
        return sum(sensor.loss(value, self.phi) for sensor, (value, _) in pairs)

    def gradient(self, x: Array) -> tuple[Array, Array]:
        """∂L_w/∂x (N, 3n) and ∂L_w/∂(q, φ) (nq + k,)."""
        forced, by_p = self.at(x), np.zeros(self.size)
        of_reaction, of_place = np.zeros_like(forced.reaction), np.zeros_like(forced.reaction)
        for sensor in self.segment.sensors:
            value, by_phi = sensor.given(forced, NOTHING, self.phi, self.size)
            by_given, by_own = sensor.loss_slopes(value, self.phi)
            by_p += np.einsum("ka,kap->p", by_given, by_phi)
            by_p[self.segment.nq + sensor.read_phi] += by_own
            by_force, by_place = sensor.arms(forced)
            k, on_grid = sensor.grid[: len(value)], sensor.before_low_pass(by_given, self.phi)
            rows = np.ix_(k + sensor.late, sensor.places), np.ix_(k, sensor.places)
            of_reaction[rows[0]] += np.einsum("ka,kag->kg", on_grid, by_force)
            of_place[rows[1]] += np.einsum("ka,kag->kg", on_grid, by_place)
        by_x, through = self.pulled(x, of_reaction)
        by_x[:, self.segment.sensed_dofs] += of_place
        by_p[self.segment.moving] += through
        return by_x, by_p

    def pulled(self, x: Array, weights: Array) -> tuple[Array, Array]:
        """Slopes of Σ weights · R by x (N, 3n) and by what moves the body, at weights (N, g)."""
        setting, segment, dofs = self.setting, self.segment, self.segment.sensed_dofs
        dynamics, t = setting.dynamics, setting.dynamics.tables
        first, whole = dynamics.first_row, np.zeros_like(x)
        whole[:, dofs] = -dynamics.combine_transposed(t.w, weights)
        at = dynamics.linearise(x, setting.theta, segment.linearisation_rows)
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
                rate[first + k] = rows.of(at.by_velocity[k], skew[:0]).T @ weight
        by_x = dynamics.combine_transposed(t.p, state)
        by_x += dynamics.combine_transposed(t.q, rate) / dynamics.step_s
        inertia = dynamics.combine_transposed(t.s, self._mass_kg * weights)
        by_x[:, dofs] += inertia / dynamics.step_s**2
        of_memory, of_q = segment.pulled_through_memory(x, setting, whole)
        by_p[: segment.nq] += of_q
        return by_x + of_memory, by_p
