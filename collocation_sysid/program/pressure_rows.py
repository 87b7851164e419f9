"""The pressures of contact as complementarity as variables of a program, and its equations.

Of evaluations k with a row of motion, in widths δ of the contact,

    (b_k + g(ξ_k) − √((b_k − g(ξ_k))² + 4 r δ²)) / δ = 0,   variables b_k / δ,

see `model.contact`: as what forces carry is, but of the evaluation itself. The variables are not
negative.
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
    """B of one obstacle of one experiment."""

    called = "pressure"
    least = 0.0  # type: ignore[override]

    @property
    def first(self) -> int:
        """The evaluation that the first b is of."""
        return self.segment.dynamics.first_row

    @property
    def unit_m(self) -> float:
        """Of b and of the equations."""
        return self._contact.contact.width_m

    @property
    def _contact(self) -> Contact:
        term = self.segment.dynamics.forces.further[self.force_number]
        assert isinstance(term, Contact)
        return term

    @property
    def shape(self) -> tuple[int, int, int]:
        """(1, evaluations, I)."""
        return 1, self.segment.constraint_times, self._points.count

    def following(self, part: Part) -> Array:
        """The variables as they follow from positions."""
        xi, _ = part.setting.dynamics.evaluation_states(part.x)
        return self._contact.pressing(xi).ravel() / self.unit_m

    def given(self, part: Part, z: Array) -> Part:
        """The experiment with b at z; that of a given start is nothing."""
        b = np.zeros((1, self.segment.grid_rows, self._points.count))
        b[:, self.first :] = self.unit_m * z[self.variables].reshape(self.shape)
        return replace(part, pressed={**part.pressed, self.force_number: b})

    def values(self, part: Part, z: Array) -> Array:
        """The equations."""
        return self._of(part).left(slice(self.first, None)).ravel() / self.unit_m

    def weighed(self, part: Part, multipliers: Array) -> Weighed:
        """And μ (1, N, I) such that multipliers · r has Σ μ_k of the equations."""
        mu = np.zeros((1, self.segment.grid_rows, self._points.count))
        mu[:, self.first :] = multipliers[self.rows].reshape(self.shape) / self.unit_m
        return self._of(part), mu

    def _jacobian(self) -> Iterator[Outer]:
        """Of r by b and by x; of the motion by b."""
        rows, columns = self.places.row + self._own, self.places.variable + self._own
        instance = self._points.pairs[0]
        yield Outer([rows], [columns])
        for here, x, *_ in self._lags(self.first):
            yield Outer([rows[:, here][..., instance]], [x])
        for pairs, k, row, _ in self._motion():
            yield Outer([row], [columns[:, k[:, None] - self.first, instance[pairs]]])

    def jacobian_values(self, part: Part, z: Array) -> tuple[Array, Array]:
        """The equations, and the values of these entries."""
        history, d = self._of(part), self._points.dofs
        slopes = history.parts(slice(None))
        by = type(slopes)(*(each[d:, :, self.first :] / self.unit_m for each in slopes))
        found = [self.unit_m * by.b]
        found += [self.segment.length_m * each for each in self._by_x(self.first, by)]
        found += self._motion_by_b(slopes)
        return self.values(part, z), np.concatenate([each.ravel() for each in found])
