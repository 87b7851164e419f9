"""Rows of a program that are one small expression of a few of its variables, at many instances.

The rows y(u, data) of all instances are added up where they count; their derivatives are generated,
and go where index tables say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..model.generated import Generated
from ..model.recursion import Recursion

T = TypeVar("T", bound=np.generic)
ONE = np.ones(1)


class Numbers(NamedTuple):
    """Variables, or rows, of instances.

    places : (k, …) which they are
    unit : what one of them stands for, of the same shape or one that broadcasts
    """

    places: Index
    unit: Array = ONE


@dataclass(frozen=True, eq=False)
class Pattern:
    """An expression of I instances.

    Attributes
    ----------
    expression : Generated
        Its inputs u are `looked`, its values y count in `rows`.
    data : (d, I)
    looked : Numbers (k, I)
    rows : Numbers (m, I)
    """

    expression: Generated
    data: Array
    looked: Numbers
    rows: Numbers

    @classmethod
    def of(
        cls, expression: Generated, data: Array, looked: Sequence[Numbers], rows: Numbers
    ) -> Pattern:
        """Of instances of any shape …, to which data (d, …) and all numbers (k, …) broadcast."""
        shapes = (data.shape, rows.places.shape, *(each.places.shape for each in looked))
        shape = np.broadcast_shapes(*(shape[1:] for shape in shapes))

        def flat(values: NDArray[T], length: int) -> NDArray[T]:
            whole = np.broadcast_to(values, (length, *shape))
            return whole.reshape(length, int(np.prod(shape)))

        def joined(parts: Sequence[Numbers]) -> Numbers:
            places = [flat(part.places, len(part.places)) for part in parts]
            units = [flat(np.asarray(part.unit), len(part.places)) for part in parts]
            return Numbers(np.concatenate(places), np.concatenate(units))

        return cls(expression, flat(data, len(data)), joined(looked), joined([rows]))

    @classmethod
    def of_recursion(
        cls,
        recursion: Recursion,
        data: Array,
        states: Numbers,
        looked: Numbers,
        constants: Numbers,
        rows: Numbers,
    ) -> Pattern:
        """h_k − R(h_{k−1}, s_k, s_{k−1}; c) of states (n, N, I) that look at (i, N, I).

        At the start the first stand for those before, which do not count there.
        """

        def gap(u: ca.SX, data: ca.SX) -> ca.SX:
            own, inputs = ca.vertsplit(u, [0, recursion.state, u.numel()])
            return own - recursion.step.expression(inputs, data)

        before = np.maximum(np.arange(states.places.shape[1]) - 1, 0)
        parts = [states, _at(states, before), looked, _at(looked, before), constants]
        size = recursion.state + recursion.ends[-1]
        return cls.of(Generated(gap, size, recursion.data), data, parts, rows)

    def _u(self, z: Array) -> Array:
        return self.looked.unit * z[self.looked.places]

    def values(self, z: Array, count: int) -> Array:
        """(count,) rows."""
        return self._summed(self.expression.value(self._u(z), self.data), count)

    def _summed(self, y: Array, count: int) -> Array:
        found = np.zeros(count)
        np.add.at(found, self.rows.places, y / self.rows.unit)
        return found

    def jacobian_entries(self) -> tuple[Index, Index]:
        """Row, and place in z, of each slope that there may be."""
        y, u = np.nonzero(self.expression.slope_pattern)
        return self.rows.places[y].ravel(), self.looked.places[u].ravel()

    def jacobian_values(self, z: Array, count: int) -> tuple[Array, Array]:
        """(count,) rows, and the slopes."""
        value, slopes = self.expression.slopes(self._u(z), self.data)
        y, u = np.nonzero(self.expression.slope_pattern)
        slopes = slopes[y, u] * self.looked.unit[u] / self.rows.unit[y]
        return self._summed(value, count), slopes.ravel()

    @cached_property
    def _crossing(self) -> tuple[Index, Index, NDArray[np.bool_]]:
        """Pairs of u that bend y together, and of which instances that is above the diagonal."""
        i, j = np.nonzero(self.expression.curvature_pattern)
        return i, j, self.looked.places[i] <= self.looked.places[j]

    def hessian_entries(self) -> tuple[Index, Index]:
        """Places in z of second derivatives, upper triangle."""
        i, j, above = self._crossing
        return self.looked.places[i][above], self.looked.places[j][above]

    def hessian_values(self, z: Array, multipliers: Array) -> Array:
        """Those of multipliers (count,) · rows."""
        (i, j, above), unit = self._crossing, self.looked.unit
        weights = multipliers[self.rows.places] / self.rows.unit
        bent = self.expression.curvature(self._u(z), self.data, weights)
        return (bent[i, j] * unit[i] * unit[j])[above]


def _at(numbers: Numbers, evaluations: Index) -> Numbers:
    """Those of other evaluations; units are the same of all."""
    return Numbers(numbers.places[:, evaluations], numbers.unit)
