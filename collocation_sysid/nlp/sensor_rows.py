"""What a sensor is given on the grid, as variables of a program, and its loss by them.

    W_k − A_k(x) R − tool(φ) = 0,          variables W_k,
    Y_k − e Y_{k−1} − a W_{k−1} − b W_k = 0,  variables Y_k, where a low-pass is estimated,

see `sensor`; without one Y is W. The loss is that of Σ_k ℓ_k Y_k + tare, which has entries between
the few grid times around a sample only. R are those of `reaction_rows`. W and Y are scaled by how
well they are known, so that the loss curves as it does by positions; their equations as others are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement

import numpy as np

from ..arrays import Array, Index
from ..experiment.nuisance import SENSOR_LAG
from .addition import Addition
from .collocation import Part
from .reaction_rows import Reactions
from .segment import Weights
from .sensor import NEIGHBOURS, Forced, Samples, Sensor, fading

# e_{abc}: what turns and arms a × b have in c.
LEVI_CIVITA = np.zeros((3, 3, 3))
for _a, _b, _c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    LEVI_CIVITA[_a, _b, _c], LEVI_CIVITA[_b, _a, _c] = 1.0, -1.0


@dataclass(frozen=True, eq=False)
class SensorRows(Addition):
    """W and Y of one sensor.

    Attributes
    ----------
    sensor : Sensor
    reactions : Reactions
        R of its experiment.
    """

    sensor: Sensor
    reactions: Reactions

    @property
    def _times(self) -> Index:
        return self.sensor.grid

    @cached_property
    def _lag(self) -> Index:
        """The φ of the low-pass, if there is one."""
        return self.sensor.phi_places(SENSOR_LAG)

    @property
    def _each(self) -> int:
        """Length of W."""
        return 6 * len(self._times)

    @property
    def count(self) -> int:
        """Number of variables, and of equations."""
        return self._each * (1 + len(self._lag))

    def _numbered(self, first: int) -> Index:
        return first + np.arange(self._each).reshape(-1, 6)

    @property
    def _given(self) -> Index:
        """(n, 6) places of Y among the variables."""
        return self._numbered(self.count - self._each)

    @cached_property
    def _unit(self) -> Array:
        """(6,) in which W and Y are counted [N, N m]: where the mean loss bends by about one."""
        count = max(1, int(self.sensor.present.sum()))
        return np.sqrt(count) * self.sensor.wrench.sigmas

    @cached_property
    def _row_unit(self) -> Array:
        """(6,) of the equations [N, N m], between this unit and that of R: solvers want both."""
        of_reactions = self.segment.force_n * np.repeat([1.0, self.segment.length_m], 3)
        return of_reactions**0.75 * self._unit**0.25

    # Values -------------------------------------------------------------------------------------

    def _on_grid(self, part: Part, forced: Forced) -> Array:
        """W (n, 6)."""
        value = self.sensor.on_grid(forced)[0]
        return value + self.sensor.tool.value(*self._tool_at(part)).T if len(self._tool) else value

    @property
    def _tool(self) -> Index:
        return self.sensor.tool_phi

    def _tool_at(self, part: Part) -> tuple[Array, Array]:
        """The φ and the data of what the tool takes on the grid."""
        count = len(self._times)
        own = np.broadcast_to(part.phi[self._tool, None], (len(self._tool), count))
        return own, self.sensor.tool_data(count)

    def _forced(self, part: Part, z: Array) -> Forced:
        return Forced.still(self.reactions.newtons(z), part.x[:, self.reactions.dofs])

    def _own(self, z: Array) -> list[Array]:
        """W, and Y where it is another, (n, 6) each."""
        own = z[self.variables].reshape(-1, len(self._times), 6) * self._unit
        return [*own]

    def _fading(self, part: Part) -> Array:
        lag_s = self.sensor.lag_s(part.phi)
        assert lag_s is not None
        return fading(lag_s, self.sensor.on.step_s)

    def _smoothed(self, part: Part, wrench: Array, before: Array, order: int = 0) -> Array:
        """What Y should be, e Y_{k−1} + a W_{k−1} + b W_k (n, 6), or its slopes by T."""
        e, a, b = self._fading(part)[:, order]
        found = np.zeros_like(wrench)
        found[0] = wrench[0] if order == 0 else 0.0
        found[1:] = e * before[:-1] + a * wrench[:-1] + b * wrench[1:]
        return found

    def following(self, part: Part) -> Array:
        """W and Y as they follow from the motion."""
        own = [self._on_grid(part, part.sensing.at(part.x))]
        if len(self._lag):
            given = own[0].copy()
            for k in range(1, len(given)):
                given[: k + 1] = self._smoothed(part, own[0][: k + 1], given[: k + 1])
            own.append(given)
        return (np.stack(own) / self._unit).ravel()

    def values(self, part: Part, z: Array) -> Array:
        """The equations."""
        own = self._own(z)
        found = [own[0] - self._on_grid(part, self._forced(part, z))]
        if len(self._lag):
            found.append(own[1] - self._smoothed(part, own[0], own[1]))
        return (np.stack(found) / self._row_unit).ravel()

    # Entries ------------------------------------------------------------------------------------

    @cached_property
    def _pulling(self) -> Index:
        """(n, d) places of R in z."""
        return self.reactions.places_of(self._times + self.sensor.late, self.sensor.places)

    @cached_property
    def _placed(self) -> Index:
        """(n, d) places of x in z."""
        dofs = self.reactions.dofs[self.sensor.places]
        return self.segment.first.x + self._times[:, None] * self.segment.dofs + dofs

    def jacobian_entries(self) -> tuple[Index, Index]:
        """Rows and columns: by W and Y, by R, by x, and by φ."""
        rows, own = self._numbered(self.places.row), self._numbered(self.places.variable)
        pairs = [
            (np.arange(self.count) + self.places.row, np.arange(self.count) + own[0, 0]),
            (rows[:, :, None], self._pulling[:, None]),
            (rows[:, 3:, None], self._placed[:, None]),
            (rows[:, :, None], self.phi_columns[self._tool]),
        ]
        if len(self._lag):
            smooth, given = rows + self._each, own + self._each
            pairs += [(smooth[1:], given[:-1]), (smooth[1:], own[:-1]), (smooth, own)]
            pairs += [(smooth, self.phi_columns[self._lag])]
        return _all(pairs)

    def jacobian_values(self, part: Part, z: Array) -> tuple[Array, Array]:
        """The equations, and the values of these entries."""
        by_force, by_place = self.sensor.arms(self._forced(part, z))
        own, count = self._unit / self._row_unit, len(self._times)
        force_n, unit = self.segment.force_n, self._row_unit[:, None]
        found = [np.tile(own, self.count // 6), -by_force * force_n / unit]
        found.append(-by_place[:, 3:] * self.segment.length_m / unit[3:])
        if len(self._tool):
            _, by_phi = self.sensor.tool.slopes(*self._tool_at(part))
            found.append(-np.moveaxis(by_phi, 2, 0) / unit)
        if len(self._lag):
            e, a, b = self._fading(part)[:, 0]
            before, wrench = np.tile(own, count - 1), np.tile(-b * own, (count, 1))
            wrench[0] = -own
            by_lag = self._smoothed(part, *self._own(z), order=1) * self._lag_scale
            found += [-e * before, -a * before, wrench, -by_lag / self._row_unit]
        return self.values(part, z), np.concatenate([each.ravel() for each in found])

    @property
    def _lag_scale(self) -> float:
        return float(self.segment.nuisance.scales[self._lag[0]])

    @property
    def _reading(self) -> Index:
        return self.sensor.read_phi

    @cached_property
    def _bands(self) -> list[tuple[int, Index]]:
        """Grid times apart of the entries of Y by Y, and which (2, 3, 3) of a pair are there."""
        used = min(2 if self.sensor.on.static else NEIGHBOURS, len(self._times))
        upper = np.broadcast_to(np.triu(np.ones((3, 3), dtype=bool)), (2, 3, 3))
        both = np.flatnonzero(upper), np.arange(18)
        return [(apart, both[apart > 0]) for apart in range(used)]

    @cached_property
    def _crossing(self) -> list[tuple[int, int, Index]]:
        """Axes of x and of R that a torque multiplies, and of which nodes: those held along it.

        Other grasps may hold these nodes along other axes.
        """
        crossed = zip(*np.nonzero(~np.eye(3, dtype=bool)), strict=True)
        return [(b, c, np.flatnonzero(self.sensor.held[c::3])) for b, c in crossed]

    def hessian_entries(self) -> tuple[Index, Index]:
        """The same of the Hessian: x by R, φ by Y, Y by Y, and T by W and Y."""
        given, phi = self.places.variable + self._given, self.phi_columns
        pairs = []
        for b, c, nodes in self._crossing:
            pairs.append((self._placed[:, b::3][:, nodes], self._pulling[:, c::3][:, nodes]))
        pairs.append((phi[self._reading], given[..., None]))
        for apart, kept in self._bands:
            count = len(given) - apart
            rows = given[:count].reshape(count, 2, 3, 1)
            columns = given[apart:].reshape(count, 2, 1, 3)
            full = [np.broadcast_to(e, (count, 2, 3, 3)) for e in (rows, columns)]
            pairs.append((full[0].reshape(count, 18)[:, kept], full[1].reshape(count, 18)[:, kept]))
        if len(self._lag):
            own, lag = self._numbered(self.places.variable), phi[self._lag]
            pairs += [(lag, given[:-1]), (lag, own)]
        return _all(pairs)

    def hessian_values(
        self, part: Part, z: Array, loss_weight: float, multipliers: Array, weights: Weights
    ) -> Array:
        """The values of these entries; multipliers are those of all of g."""
        segment, of_rows = self.segment, self._of_rows(multipliers)
        turned = np.einsum("kij,kj->ki", self.sensor.frames[0], of_rows[0][:, 3:])
        crossed = -np.einsum("abc,ka->kbc", LEVI_CIVITA, turned)
        scale = segment.length_m * segment.force_n
        found = [np.repeat(crossed[:, b, c], len(nodes)) * scale for b, c, nodes in self._crossing]
        found += [loss_weight * each for each in self._loss_curvature(part, z)]
        if len(self._lag):
            (e, a, b), mu = self._fading(part)[:, 1] * self._lag_scale, of_rows[1] * self._unit
            of_wrench = np.zeros_like(mu)
            of_wrench[1:] -= b * mu[1:]
            of_wrench[:-1] -= a * mu[1:]
            found += [-e * mu[1:], of_wrench]
        return np.concatenate([each.ravel() for each in found])

    def _of_rows(self, multipliers: Array) -> list[Array]:
        """What W − …, and Y − …, count in newtons and newton metres, (n, 6) each."""
        by_row = multipliers[self.rows].reshape(-1, len(self._times), 6) / self._row_unit
        return [*by_row]

    def phi_curvature(
        self, part: Part, z: Array, loss_weight: float, multipliers: Array
    ) -> Array | float:
        """Second derivatives (k, k) by φ of loss_weight · loss + multipliers · g."""
        found, of_rows = np.zeros((len(part.phi),) * 2), self._of_rows(multipliers)
        if len(self._tool):
            bent = self.sensor.tool.curvature(*self._tool_at(part), of_rows[0].T)
            found[np.ix_(self._tool, self._tool)] -= bent.sum(axis=2)
        if len(self._lag):
            bent = self._smoothed(part, *self._own(z), order=2) * self._lag_scale**2
            found[self._lag, self._lag] -= np.sum(of_rows[1] * bent)
        own = self._samples(part, z).loss_curvature(part.bent)[2]
        found[np.ix_(self._reading, self._reading)] += loss_weight * own
        return found

    # Loss ---------------------------------------------------------------------------------------

    def _samples(self, part: Part, z: Array) -> Samples:
        return self.sensor.samples(self._own(z)[-1], part.phi, self.sensor.weight)

    def loss(self, part: Part, z: Array) -> float:
        """L_w of this sensor."""
        return self.sensor.loss(self._own(z)[-1], part.phi)

    def gradient(self, part: Part, z: Array) -> tuple[Array, Array]:
        """∂L_w by the variables (count,) and by φ (k,)."""
        of_phi, own = np.zeros(len(part.phi)), np.zeros(self.count)
        by_given, of_phi[self._reading] = self.sensor.loss_slopes(self._own(z)[-1], part.phi)
        own[self._given] = by_given * self._unit
        return own, of_phi

    def _loss_curvature(self, part: Part, z: Array) -> list[Array]:
        """∂²L_w: φ of `_reading` by Y (n, 6, m), then each of `_bands` (n − apart, entries)."""
        samples, count = self._samples(part, z), len(self._times)
        window, (twice, by_phi, _) = samples.window, samples.loss_curvature(part.bent)
        of_phi = np.zeros((count, 6, len(self._reading)))
        np.add.at(of_phi, window, by_phi)
        # Forces and torques are groups of their own.
        grouped = twice.reshape(*twice.shape[:2], 2, 3, -1, 2, 3)
        bands = [np.zeros((count, 2, 3, 3)) for _ in self._bands]
        for i, j in combinations_with_replacement(range(window.shape[1]), 2):
            pairs = np.einsum("sgagb->sgab", grouped[:, i, :, :, j])
            np.add.at(bands[j - i], window[:, i], pairs)
        unit = self._unit.reshape(2, 3)
        scale = unit[:, :, None] * unit[:, None, :]
        kept = [
            (scale * band[: count - apart]).reshape(-1, 18)[:, entries]
            for band, (apart, entries) in zip(bands, self._bands, strict=True)
        ]
        return [of_phi * self._unit[:, None], *kept]


def _all(pairs: list[tuple[Index, Index]]) -> tuple[Index, Index]:
    """Rows and columns of all entries from pairs that broadcast."""
    both = [np.broadcast_arrays(*pair) for pair in pairs]
    rows, columns = ([each[side].ravel() for each in both] for side in (0, 1))
    return np.concatenate(rows), np.concatenate(columns)
