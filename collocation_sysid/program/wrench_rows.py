"""What a sensor is given on the grid, as variables of a program.

    W_k − Σ_g moment(x_g, R_g) − tool(φ) = 0,  variables W_k,
    Y_k − e Y_{k−1} − a W_{k−1} − b W_k = 0,   variables Y_k, where a low-pass is estimated,

see `wrench_channel`; without one Y is W. The loss is that of a reading of Y, which has entries
between the few grid times around a sample only. R are those of `reaction_rows`. W and Y are scaled
by how well they are known, so that the loss curves as it does by positions; their equations as
others are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ..arrays import Array, Index
from .carried import Carried
from .channel import Forced
from .part import Part
from .reaction_rows import Reactions
from .reading import Reading
from .segment import RowWeights
from .wrench_channel import GraspWrench, smoothed, stepped


@dataclass(frozen=True, eq=False)
class WrenchRows(Carried):
    """W and Y of one sensor.

    Attributes
    ----------
    reading_number : int
        Of the reading among those of the segment.
    reading : Reading
    channel : GraspWrench
        What it looks at.
    reactions : Reactions
        R of its experiment.
    """

    reading_number: int
    reading: Reading
    channel: GraspWrench
    reactions: Reactions

    @property
    def _times(self) -> Index:
        return self.channel.grid

    @property
    def _lag(self) -> Index:
        """The φ of the low-pass, if there is one."""
        return self.channel.lag_phi

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

    @cached_property
    def _unit(self) -> Array:
        """(6,) in which W and Y are counted [N, N m]: where the mean loss bends by about one."""
        count, sigmas = max(1, int(self.reading.components.sum())), self.reading.looked_sigmas
        return np.where(np.isfinite(sigmas), np.sqrt(count) * sigmas, self._reaction_unit)

    @cached_property
    def _row_unit(self) -> Array:
        """(6,) of the equations [N, N m], between this unit and that of R: solvers want both."""
        return self._reaction_unit**0.75 * self._unit**0.25

    @property
    def _reaction_unit(self) -> Array:
        """(6,) of R [N, N m]."""
        return self.segment.force_n * np.repeat([1.0, self.segment.length_m], 3)

    # Values -------------------------------------------------------------------------------------

    def given(self, part: Part, z: Array) -> Part:
        """The experiment with Y at z."""
        looked = self._own(z)[-1].reshape(-1, 2, 3)
        return replace(part, given={**part.given, self.reading_number: looked})

    def _forced(self, part: Part, z: Array) -> Forced:
        return Forced(self.reactions.newtons(z), part.x[:, self.reactions.dofs])

    def _own(self, z: Array) -> list[Array]:
        """W, and Y where it is another, (n, 6) each."""
        return [*(z[self.variables].reshape(-1, len(self._times), 6) * self._unit)]

    def _fading(self, part: Part) -> Array:
        found = self.channel.fading(part.phi)
        assert found is not None
        return found

    def following(self, part: Part) -> Array:
        """W and Y as they follow from the motion."""
        own = [self.channel.on_grid(part.motion.forced, part.phi)]
        if len(self._lag):
            own.append(smoothed(self._fading(part)[:, 0], own[0]))
        return (np.stack(own) / self._unit).ravel()

    def values(self, part: Part, z: Array) -> Array:
        """The equations."""
        own = self._own(z)
        found = [own[0] - self.channel.on_grid(self._forced(part, z), part.phi)]
        if len(self._lag):
            found.append(own[1] - stepped(self._fading(part)[:, 0], own[0], own[1]))
            found[1][0] -= own[0][0]
        return (np.stack(found) / self._row_unit).ravel()

    # Entries ------------------------------------------------------------------------------------

    @cached_property
    def _pulling(self) -> Index:
        """(n, d) places of R in z."""
        late = self.channel.on.late
        return self.reactions.places_of(self._times + late, self.channel.places)

    @cached_property
    def _placed(self) -> Index:
        """(n, d) places of x in z."""
        dofs = self.reactions.dofs[self.channel.places]
        return self.segment.first.x + self._times[:, None] * self.segment.dofs + dofs

    @property
    def _tool(self) -> Index:
        return self.channel.tool_phi

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
        by_force, by_place = self.channel.arms(self._forced(part, z))
        own, count = self._unit / self._row_unit, len(self._times)
        force_n, unit = self.segment.force_n, self._row_unit[:, None]
        found = [np.tile(own, self.count // 6), -by_force * force_n / unit]
        found.append(-by_place[:, 3:] * self.segment.length_m / unit[3:])
        if len(self._tool):
            by_phi = self.channel.tool.slopes(*self.channel.tool_at(part.phi, count))[1]
            found.append(-np.moveaxis(by_phi, 2, 0) / unit)
        if len(self._lag):
            e, a, b = self._fading(part)[:, 0]
            before, wrench = np.tile(own, count - 1), np.tile(-b * own, (count, 1))
            wrench[0] = -own
            by_lag = stepped(self._fading(part)[:, 1], *self._own(z)) * self._lag_scale
            found += [-e * before, -a * before, wrench, -by_lag / self._row_unit]
        return self.values(part, z), np.concatenate([each.ravel() for each in found])

    @property
    def _lag_scale(self) -> float:
        return float(self.segment.nuisance.scales[self._lag[0]])

    # Second derivatives -------------------------------------------------------------------------

    @cached_property
    def _crossing(self) -> tuple[Index, Index, Index]:
        """Of a grid time's pairs of x and R that torques multiply: dof of x, of R, and node.

        Other grasps may hold these nodes along other axes.
        """
        pattern = self.channel.moment.curvature_pattern[:3, 3:]
        axes, held = np.argwhere(pattern), self.channel.held.reshape(-1, 3)
        pair, node = np.nonzero(held.T[axes[:, 1]])
        return 3 * node + axes[pair, 0], 3 * node + axes[pair, 1], node

    @cached_property
    def _slopes(self) -> sp.csr_array:
        """∂(Y, φ)/∂(Y in its unit, φ)."""
        scale = np.tile(self._unit, len(self._times))
        return sp.csr_array(sp.diags_array(np.append(scale, np.ones(len(self.phi_columns)))))

    @cached_property
    def _loss_entries(self) -> tuple[Index, Index, Index]:
        """Rows and columns among (Y, φ) of ∂²loss, upper triangle; and which are in Y."""
        rows, columns = self.reading.hessian_structure(self._slopes)
        return rows, columns, np.flatnonzero(rows < self._each)

    def hessian_entries(self) -> tuple[Index, Index]:
        """The same of the Hessian: x by R, Y by Y and φ, and T by W and Y."""
        phi, own = self.phi_columns, self._numbered(self.places.variable)
        given = own + self.count - self._each
        of_x, of_reaction, _ = self._crossing
        pairs = [(self._placed[:, of_x], self._pulling[:, of_reaction])]
        rows, columns, here = self._loss_entries
        both = np.concatenate([given.ravel(), phi])
        pairs.append((both[rows[here]], both[columns[here]]))
        if len(self._lag):
            pairs += [(phi[self._lag], given[:-1]), (phi[self._lag], own)]
        i, j = np.triu_indices(len(phi))
        return _sorted(*_all([*pairs, (phi[i], phi[j])]))

    def hessian_values(
        self, part: Part, z: Array, loss_weight: float, multipliers: Array, weights: RowWeights
    ) -> Array:
        """The values of these entries; multipliers are those of all of g."""
        segment, of_rows = self.segment, self._of_rows(multipliers)
        u, data = self.channel.moments_at(self._forced(part, z))
        weight = np.broadcast_to(-of_rows[0].T[:, :, None], (6, *u.shape[1:]))
        bent = self.channel.moment.curvature(u, data, weight)[:3, 3:]
        of_x, of_reaction, node = self._crossing
        found = [bent[of_x % 3, of_reaction % 3, :, node].T * segment.length_m * segment.force_n]
        found.append(loss_weight * self._loss_values(part)[self._loss_entries[2]])
        if len(self._lag):
            (e, a, b), mu = self._fading(part)[:, 1] * self._lag_scale, of_rows[1] * self._unit
            of_wrench = np.zeros_like(mu)
            of_wrench[1:] -= b * mu[1:]
            of_wrench[:-1] -= a * mu[1:]
            found += [-e * mu[1:], of_wrench]
        of_phi = self._phi_curvature(part, z, loss_weight, of_rows)
        found.append(of_phi[np.triu_indices(len(of_phi))])
        return np.concatenate([each.ravel() for each in found])

    def _loss_values(self, part: Part) -> Array:
        """∂²loss at `_loss_entries`."""
        (rows, columns, _), size = self._loss_entries, self._each + len(part.phi)
        codes, values = columns * size + rows, np.zeros(len(rows))
        looked = part.looked[self.reading_number]
        found = self.reading.hessian(looked, part.phi, self._slopes, part.bent)
        wanted = np.searchsorted(codes, found.columns * size + found.rows)
        np.add.at(values, wanted, found.values)
        return values

    def _of_rows(self, multipliers: Array) -> list[Array]:
        """What W − …, and Y − …, count in newtons and newton metres, (n, 6) each."""
        by_row = multipliers[self.rows].reshape(-1, len(self._times), 6) / self._row_unit
        return [*by_row]

    def _phi_curvature(
        self, part: Part, z: Array, loss_weight: float, of_rows: list[Array]
    ) -> Array:
        """Second derivatives (k, k) by φ of loss_weight · loss + multipliers · g."""
        found = np.zeros((len(part.phi),) * 2)
        if len(self._tool):
            at = self.channel.tool_at(part.phi, len(self._times))
            bent = self.channel.tool.curvature(*at, of_rows[0].T)
            found[np.ix_(self._tool, self._tool)] -= bent.sum(axis=2)
        if len(self._lag):
            bent = stepped(self._fading(part)[:, 2], *self._own(z)) * self._lag_scale**2
            found[self._lag, self._lag] -= np.sum(of_rows[1] * bent)
        rows, columns, _ = self._loss_entries
        values, here = loss_weight * self._loss_values(part), rows >= self._each
        i, j = rows[here] - self._each, columns[here] - self._each
        found[i, j] += values[here]
        found[j, i] += np.where(i == j, 0.0, values[here])
        return found

    def gradient(self, part: Part) -> Array:
        """∂loss by the variables (count,)."""
        own, (by_looked, _) = np.zeros(self.count), part.loss_slopes[self.reading_number]
        own[self.count - self._each :] = (by_looked.reshape(-1, 6) * self._unit).ravel()
        return own


def _sorted(rows: Index, columns: Index) -> tuple[Index, Index]:
    """Entries of the upper triangle: rows before columns."""
    return np.minimum(rows, columns), np.maximum(rows, columns)


def _all(pairs: list[tuple[Index, Index]]) -> tuple[Index, Index]:
    """Rows and columns of all entries from pairs that broadcast."""
    both = [np.broadcast_arrays(*pair) for pair in pairs]
    rows, columns = ([each[side].ravel() for each in both] for side in (0, 1))
    return np.concatenate(rows), np.concatenate(columns)
