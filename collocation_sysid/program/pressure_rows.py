"""Contact pressures of a complementarity problem as variables of the program, with their equations.

For evaluations k with an equation of motion, in widths δ of the contact law,

    (b_k + g(ξ_k) − √((b_k − g(ξ_k))² + 4 r δ²)) / δ = 0,   variables b_k / δ,

with the pressure variable b, the gap g and the relaxation r, see `model.contact`. The structure is
that of a force history (`force_rows`), but b belongs to the evaluation itself instead of the one
before. The variables are not negative.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..model.contact import Contact
from .entries import Outer
from .force_rows import ForceRows
from .part import Part
from .segment import Weighed


@dataclass(frozen=True, eq=False)
class PressureRows(ForceRows):
    """Lifted pressure variables b of one obstacle of one experiment."""

    called = "pressure"
    least = 0.0  # type: ignore[override]

    @property
    def first(self) -> int:
        """Index of the evaluation that the first variables belong to."""
        return self.segment.dynamics.first_row

    @property
    def unit_m(self) -> float:
        """Unit of the variables and of the equations [m]: the width δ of the contact law."""
        return self._contact.contact.width_m

    @property
    def _contact(self) -> Contact:
        """Contact force of the obstacle."""
        term = self.segment.dynamics.forces.further[self.force_number]
        assert isinstance(term, Contact)
        return term

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (1, evaluations, I) for I contact points."""
        return 1, self.segment.constraint_times, self._points.count

    def following(self, part: Part) -> Array:
        """Return the scaled variables that satisfy the equations at the part's positions."""
        xi, _ = part.setting.dynamics.evaluation_states(part.x)
        return self._contact.pressing(xi).ravel() / self.unit_m

    def given(self, part: Part, z: Array) -> Part:
        """Return the part with b taken from z; b is zero at a stated initial state."""
        b = np.zeros((1, self.segment.grid_rows, self._points.count))
        b[:, self.first :] = self.unit_m * z[self.variables].reshape(self.shape)
        return replace(part, pressed={**part.pressed, self.force_number: b})

    def values(self, part: Part, z: Array) -> Array:
        """Return the scaled equations (count,)."""
        return self._of(part).left(slice(self.first, None)).ravel() / self.unit_m

    def weighed(self, part: Part, multipliers: Array) -> Weighed:
        """Return the history, and μ (1, N, I) such that multipliers · equations = Σ μ_k
        (unscaled equations of k).
        """
        mu = np.zeros((1, self.segment.grid_rows, self._points.count))
        mu[:, self.first :] = multipliers[self.rows].reshape(self.shape) / self.unit_m
        return self._of(part), mu

    def _jacobian(self) -> Iterator[Outer]:
        """Yield the entries of the equations by b and by x, then those of the motion by b."""
        rows = self.places.row + self._own
        columns = self.places.variable + self._own
        instance = self._points.pairs[0]
        yield Outer([rows], [columns])
        for here, x, *_ in self._lags(self.first):
            yield Outer([rows[:, here][..., instance]], [x])
        for pairs, k, row, _ in self._motion():
            yield Outer([row], [columns[:, k[:, None] - self.first, instance[pairs]]])

    def jacobian_values(self, part: Part, z: Array) -> tuple[Array, Array]:
        """Return the equations, and the values of `jacobian_entries`."""
        history = self._of(part)
        d = self._points.dofs
        slopes = history.parts(slice(None))
        by = type(slopes)(*(each[d:, :, self.first :] / self.unit_m for each in slopes))
        blocks = [self.unit_m * by.b]
        blocks += [self.segment.length_m * each for each in self._by_x(self.first, by)]
        blocks += self._motion_by_b(slopes)
        return self.values(part, z), np.concatenate([each.ravel() for each in blocks])
