"""Wrenches at a force–torque sensor on the time grid, as variables of the program.

    W_k − Σ_g moment(x_g, R_g) − tool(φ) = 0,  variables W_k,
    Y_k − e Y_{k−1} − a W_{k−1} − b W_k = 0,   variables Y_k, where a low-pass is estimated,

see `wrench_channel`; without a low-pass Y is W. The loss is a function of Y, whose Hessian couples
only the few grid times around a sample. R are the lifted reaction forces of `reaction_rows`. W and
Y are scaled by their measurement uncertainty, so that the loss has similar curvature by them as by
positions; their equations are scaled like other equations.
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
    """Lifted wrenches W and filtered wrenches Y of one sensor.

    Attributes
    ----------
    reading_number : int
        Index of the measurement among those of the segment.
    reading : Reading
        The measurement.
    reactions : Reactions
        Lifted reaction forces of the experiment.
    """

    reading_number: int
    reading: Reading
    reactions: Reactions
    called = "wrench"

    @property
    def channel(self) -> GraspWrench:
        """Wrench of the grasp as an observable."""
        return cast(GraspWrench, self.reading.channel)

    @property
    def _each(self) -> int:
        """Number of components of W at all grid times."""
        return 6 * self.channel.count

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (1 or 2, times, 6): W and, with a low-pass, Y; grid times; forces and moments."""
        return 1 + len(self.channel.lag_phi), self.channel.count, 6

    @cached_property
    def _unit(self) -> Array:
        """Unit (6,) of W and Y [N, N m], for which the mean loss has a curvature of about one."""
        count = max(1, int(self.reading.components.sum()))
        sigmas = self.reading.looked_sigmas
        return np.where(np.isfinite(sigmas), np.sqrt(count) * sigmas, self._reaction_unit)

    @cached_property
    def _row_unit(self) -> Array:
        """Unit (6,) of the equations [N, N m], between `_unit` and that of R for good
        conditioning.
        """
        return self._reaction_unit**0.75 * self._unit**0.25

    @property
    def _reaction_unit(self) -> Array:
        """Unit (6,) of reaction forces and their moments [N, N m]."""
        return self.segment.force_n * np.repeat([1.0, self.segment.length_m], 3)

    def given(self, part: Part, z: Array) -> Part:
        """Return the part with Y taken from z."""
        wrench = z[self._read].reshape(-1, 6) * self._unit
        return replace(part, given={**part.given, self.reading_number: wrench.reshape(-1, 2, 3)})

    @property
    def _read(self) -> slice:
        """Slice of Y in z."""
        return slice(self.variables.stop - self._each, self.variables.stop)

    def following(self, part: Part) -> Array:
        """Return the scaled W and Y (count,) that follow from the motion."""
        own = [self.channel.on_grid(part.motion.forced, part.phi)]
        if evolution := self.channel.low_passed(own[0], part.phi):
            own += [*evolution.states]
        return (np.stack(own) / self._unit).ravel()

    # Equations ----------------------------------------------------------------------------------

    @cached_property
    def patterns(self) -> tuple[Pattern, ...]:
        """Expressions of the equations: W itself, moments of the nodes, tool, and low-pass."""
        channel = self.channel
        numbers = np.arange(self.count).reshape(self.shape)
        wrench = self.places.variable + numbers[0].T
        of_wrench = numbers[0].T
        unit = self._unit[:, None]
        minus = -self._row_unit[:, None]
        own = Numbers(of_wrench, -minus)
        terms = [Pattern.of(ITSELF, np.zeros((0, 1)), [Numbers(wrench, unit)], own)]
        reaction_columns = self.reactions.places_of(channel.grid + channel.on.late, channel.places)
        units = np.array([[self.segment.length_m], [self.segment.force_n]])
        looked = [
            Numbers(np.moveaxis(each.reshape(channel.count, -1, 3), 2, 0), unit)
            for each, unit in zip((self._placed, reaction_columns), units, strict=True)
        ]
        taken = Numbers(of_wrench[..., None], minus[..., None])
        terms.append(Pattern.of(MOMENT, channel.moment_data, looked, taken))
        if len(tool := channel.tool_phi):
            data = channel.tool_at(np.zeros(len(self.phi_columns)), channel.count)[1]
            by_phi = Numbers(self.phi_columns[tool][:, None])
            terms.append(Pattern.of(channel.tool, data, [by_phi], Numbers(of_wrench, minus)))
        if len(lag := channel.lag_phi):
            places = self.places.variable + numbers
            by_phi = self.phi_columns[lag][:, None, None]
            unfiltered, filtered = (Numbers(places[k : k + 1], self._unit) for k in (0, 1))
            terms.append(
                Pattern.of_recursion(
                    LOW_PASS,
                    channel.low_pass_data[..., None],
                    states=filtered,
                    looked=unfiltered,
                    constants=Numbers(by_phi),
                    rows=Numbers(numbers[1:], self._row_unit),
                )
            )
        return tuple(terms)

    @property
    def _placed(self) -> Index:
        """Columns (n, d) in z of the positions of the grasp's dofs at n grid times."""
        dofs = self.reactions.dofs[self.channel.places]
        return self.segment.first.x + self.channel.grid[:, None] * self.segment.dofs + dofs

    # Loss ---------------------------------------------------------------------------------------

    def gradient(self, part: Part) -> Array:
        """Return the gradient of the loss by the scaled variables (count,)."""
        own = np.zeros(self.count)
        by_looked, _ = part.loss_slopes[self.reading_number]
        own[self.count - self._each :] = (by_looked.reshape(-1, 6) * self._unit).ravel()
        return own

    @cached_property
    def _slopes(self) -> sp.csr_array:
        """Derivatives of (Y, φ) by (scaled Y, φ)."""
        scale = np.tile(self._unit, self.channel.count)
        return sp.csr_array(sp.diags_array(np.append(scale, np.ones(len(self.phi_columns)))))

    @cached_property
    def _loss_entries(self) -> tuple[Index, Index]:
        """Rows and columns among (Y, φ) of the Hessian of the loss, upper triangle."""
        return self.reading.hessian_structure(self._slopes)

    def hessian_entries(self) -> tuple[Index, Index]:
        """Return rows and columns of the entries of the equations, then of the loss."""
        rows, columns = super().hessian_entries()
        both = np.concatenate([np.arange(self._read.start, self._read.stop), self.phi_columns])
        i, j = (both[each] for each in self._loss_entries)
        # Experiments that share a φ need not have them in the same order.
        return np.append(rows, np.minimum(i, j)), np.append(columns, np.maximum(i, j))

    def hessian_values(
        self, part: Part, z: Array, loss_weight: float, multipliers: Array, weights: RowWeights
    ) -> Array:
        """Return the values of `hessian_entries`; arguments as in `Carried.hessian_values`."""
        of_equations = super().hessian_values(part, z, loss_weight, multipliers, weights)
        rows, columns = self._loss_entries
        size = self._each + len(part.phi)
        observables = part.looked[self.reading_number]
        of_loss = self.reading.hessian(observables, part.phi, self._slopes, part.bent)
        positions = np.searchsorted(columns * size + rows, of_loss.columns * size + of_loss.rows)
        values = np.zeros(len(rows))
        np.add.at(values, positions, loss_weight * of_loss.values)
        return np.append(of_equations, values)
