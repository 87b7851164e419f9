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
from typing import cast

import numpy as np
import scipy.sparse as sp

from ..arrays import Array, Index
from ..model.generated import Generated
from .carried import Carried
from .part import Part
from .pattern_rows import Numbers, Pattern
from .reaction_rows import Reactions
from .reading import Reading
from .segment import RowWeights
from .wrench_channel import LOW_PASS, MOMENT, GraspWrench

ITSELF = Generated(lambda u, _: u, 6, 0)


@dataclass(frozen=True, eq=False)
class WrenchRows(Carried):
    """W and Y of one sensor.

    Attributes
    ----------
    reading_number : int
        Of the reading among those of the segment.
    reading : Reading
    reactions : Reactions
        R of its experiment.
    """

    reading_number: int
    reading: Reading
    reactions: Reactions
    called = "wrench"

    @property
    def channel(self) -> GraspWrench:
        """What it looks at."""
        return cast(GraspWrench, self.reading.channel)

    @property
    def _each(self) -> int:
        """Length of W."""
        return 6 * self.channel.count

    @property
    def shape(self) -> tuple[int, int, int]:
        """W and, with a low-pass, Y; samples on the grid; forces and moments."""
        return 1 + len(self.channel.lag_phi), self.channel.count, 6

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

    def given(self, part: Part, z: Array) -> Part:
        """The experiment with Y at z."""
        looked = z[self._read].reshape(-1, 6) * self._unit
        return replace(part, given={**part.given, self.reading_number: looked.reshape(-1, 2, 3)})

    @property
    def _read(self) -> slice:
        """Y in z."""
        return slice(self.variables.stop - self._each, self.variables.stop)

    def following(self, part: Part) -> Array:
        """W and Y as they follow from the motion."""
        own = [self.channel.on_grid(part.motion.forced, part.phi)]
        if evolution := self.channel.low_passed(own[0], part.phi):
            own += [*evolution.states]
        return (np.stack(own) / self._unit).ravel()

    # Equations ----------------------------------------------------------------------------------

    @cached_property
    def patterns(self) -> tuple[Pattern, ...]:
        """W itself, the moments of the nodes, the tool, and the low-pass."""
        channel, numbers = self.channel, np.arange(self.count).reshape(self.shape)
        wrench, of_wrench = self.places.variable + numbers[0].T, numbers[0].T
        unit, minus = self._unit[:, None], -self._row_unit[:, None]
        own = Numbers(of_wrench, -minus)
        found = [Pattern.of(ITSELF, np.zeros((0, 1)), [Numbers(wrench, unit)], own)]
        late = self.reactions.places_of(channel.grid + channel.on.late, channel.places)
        units = np.array([[self.segment.length_m], [self.segment.force_n]])
        looked = [
            Numbers(np.moveaxis(each.reshape(channel.count, -1, 3), 2, 0), unit)
            for each, unit in zip((self._placed, late), units, strict=True)
        ]
        taken = Numbers(of_wrench[..., None], minus[..., None])
        found.append(Pattern.of(MOMENT, channel.moment_data, looked, taken))
        if len(tool := channel.tool_phi):
            data = channel.tool_at(np.zeros(len(self.phi_columns)), channel.count)[1]
            by_phi = Numbers(self.phi_columns[tool][:, None])
            found.append(Pattern.of(channel.tool, data, [by_phi], Numbers(of_wrench, minus)))
        if len(lag := channel.lag_phi):
            places, by_phi = self.places.variable + numbers, self.phi_columns[lag][:, None, None]
            read, seen = (Numbers(places[k : k + 1], self._unit) for k in (1, 0))
            at = LOW_PASS, channel.low_pass_data[..., None], read, seen, Numbers(by_phi)
            found.append(Pattern.of_recursion(*at, Numbers(numbers[1:], self._row_unit)))
        return tuple(found)

    @property
    def _placed(self) -> Index:
        """(n, d) places of x in z."""
        dofs = self.reactions.dofs[self.channel.places]
        return self.segment.first.x + self.channel.grid[:, None] * self.segment.dofs + dofs

    # Loss ---------------------------------------------------------------------------------------

    def gradient(self, part: Part) -> Array:
        """∂loss by the variables (count,)."""
        own, (by_looked, _) = np.zeros(self.count), part.loss_slopes[self.reading_number]
        own[self.count - self._each :] = (by_looked.reshape(-1, 6) * self._unit).ravel()
        return own

    @cached_property
    def _slopes(self) -> sp.csr_array:
        """∂(Y, φ)/∂(Y in its unit, φ)."""
        scale = np.tile(self._unit, self.channel.count)
        return sp.csr_array(sp.diags_array(np.append(scale, np.ones(len(self.phi_columns)))))

    @cached_property
    def _loss_entries(self) -> tuple[Index, Index]:
        """Rows and columns among (Y, φ) of ∂²loss, upper triangle."""
        return self.reading.hessian_structure(self._slopes)

    def hessian_entries(self) -> tuple[Index, Index]:
        """Those of the equations, and of the loss."""
        rows, columns = super().hessian_entries()
        both = np.concatenate([np.arange(self._read.start, self._read.stop), self.phi_columns])
        i, j = (both[each] for each in self._loss_entries)
        # Experiments that share a φ need not have them in the same order.
        return np.append(rows, np.minimum(i, j)), np.append(columns, np.maximum(i, j))

    def hessian_values(
        self, part: Part, z: Array, loss_weight: float, multipliers: Array, weights: RowWeights
    ) -> Array:
        """The values of these entries; multipliers are those of all of g."""
        bent = super().hessian_values(part, z, loss_weight, multipliers, weights)
        (rows, columns), size = self._loss_entries, self._each + len(part.phi)
        looked = part.looked[self.reading_number]
        found = self.reading.hessian(looked, part.phi, self._slopes, part.bent)
        wanted = np.searchsorted(columns * size + rows, found.columns * size + found.rows)
        values = np.zeros(len(rows))
        np.add.at(values, wanted, loss_weight * found.values)
        return np.append(bent, values)
