"""Constraints that repeat one small expression at many instances, with generated derivatives.

The values y(u, data) of all instances are added to constraints; index arrays state which variables
are the inputs u and which constraints the values belong to.
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
    """Variables or constraints of instances.

    Attributes
    ----------
    places : (k, …) array
        Their indices in z or g.
    unit : array
        Physical value of one unit of each; of the same shape as `places` or one that broadcasts to
        it.
    """

    places: Index
    unit: Array = ONE


@dataclass(frozen=True, eq=False)
class Pattern:
    """An expression at I instances.

    Attributes
    ----------
    expression : Generated
        Function y(u, data) with derivatives.
    data : (d, I) array
        Data of the instances.
    looked : Numbers, (k, I)
        Variables that are the inputs u.
    rows : Numbers, (m, I)
        Constraints that the values y are added to.
    """

    expression: Generated
    data: Array
    looked: Numbers
    rows: Numbers

    @classmethod
    def of(
        cls, expression: Generated, data: Array, looked: Sequence[Numbers], rows: Numbers
    ) -> Pattern:
        """Build a pattern of instances of any shape.

        Parameters
        ----------
        expression : Generated
            Function y(u, data).
        data : (d, …) array
            Data; broadcast to the shape of the instances.
        looked : sequence of Numbers, each (k, …)
            Inputs, concatenated along the first axis after broadcasting.
        rows : Numbers, (m, …)
            Constraints.
        """
        shapes = (data.shape, rows.places.shape, *(each.places.shape for each in looked))
        shape = np.broadcast_shapes(*(shape[1:] for shape in shapes))

        def flat(values: NDArray[T], length: int) -> NDArray[T]:
            broadcast = np.broadcast_to(values, (length, *shape))
            return broadcast.reshape(length, int(np.prod(shape)))

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
        """Build the pattern h_k − R(h_{k−1}, s_k, s_{k−1}; c) of a recursion R.

        At the first evaluation, the first states and inputs stand for those before; the recursion
        must ignore them.

        Parameters
        ----------
        recursion : Recursion
            The recursion R.
        data : array
            Data of the recursion.
        states : Numbers, (n, N, I)
            States h.
        looked : Numbers, (i, N, I)
            Inputs s.
        constants : Numbers
            Constants c.
        rows : Numbers
            Constraints.
        """

        def gap(u: ca.SX, data: ca.SX) -> ca.SX:
            own, inputs = ca.vertsplit(u, [0, recursion.state, u.numel()])
            return own - recursion.step.expression(inputs, data)

        before = np.maximum(np.arange(states.places.shape[1]) - 1, 0)
        parts = [states, _at(states, before), looked, _at(looked, before), constants]
        size = recursion.state + recursion.ends[-1]
        return cls.of(Generated(gap, size, recursion.data), data, parts, rows)

    def _u(self, z: Array) -> Array:
        """Return the inputs (k, I) in physical units."""
        return self.looked.unit * z[self.looked.places]

    def values(self, z: Array, count: int) -> Array:
        """Return the contributions to the constraints (count,)."""
        return self._summed(self.expression.value(self._u(z), self.data), count)

    def _summed(self, y: Array, count: int) -> Array:
        """Add up values y (m, I) into constraints (count,)."""
        assembled = np.zeros(count)
        np.add.at(assembled, self.rows.places, y / self.rows.unit)
        return assembled

    def jacobian_entries(self) -> tuple[Index, Index]:
        """Return constraint, and index in z, of each derivative that may be non-zero."""
        y, u = np.nonzero(self.expression.slope_pattern)
        return self.rows.places[y].ravel(), self.looked.places[u].ravel()

    def jacobian_values(self, z: Array, count: int) -> tuple[Array, Array]:
        """Return the contributions to the constraints (count,), and the values of
        `jacobian_entries`.
        """
        value, slopes = self.expression.slopes(self._u(z), self.data)
        y, u = np.nonzero(self.expression.slope_pattern)
        slopes = slopes[y, u] * self.looked.unit[u] / self.rows.unit[y]
        return self._summed(value, count), slopes.ravel()

    @cached_property
    def _crossing(self) -> tuple[Index, Index, NDArray[np.bool_]]:
        """Pairs (i, j) of inputs with second derivatives, and a mask of the instances where
        they are in the upper triangle.
        """
        i, j = np.nonzero(self.expression.curvature_pattern)
        return i, j, self.looked.places[i] <= self.looked.places[j]

    def hessian_entries(self) -> tuple[Index, Index]:
        """Return rows and columns in z of the second derivatives, upper triangle."""
        i, j, above = self._crossing
        return self.looked.places[i][above], self.looked.places[j][above]

    def hessian_values(self, z: Array, multipliers: Array) -> Array:
        """Return the second derivatives of multipliers (count,) · constraints, in the order
        of `hessian_entries`.
        """
        i, j, above = self._crossing
        unit = self.looked.unit
        weights = multipliers[self.rows.places] / self.rows.unit
        curvature = self.expression.curvature(self._u(z), self.data, weights)
        return (curvature[i, j] * unit[i] * unit[j])[above]


def _at(numbers: Numbers, evaluations: Index) -> Numbers:
    """Return the indices of other evaluations; units must be the same at all evaluations."""
    return Numbers(numbers.places[:, evaluations], numbers.unit)
